from pathlib import Path

import pytest

from pneuopt.files.drive import read_drive
from pneuopt.quantities.errors import ModelError


@pytest.mark.parametrize(
    ("kind", "law", "message"),
    [
        ("rotary", "coulomb", "needs pressure_a, pressure_b, which a rotary axis lacks; choose"),
        ("force", "viscous", "has no Coulomb level that could rise with pressure; take"),
    ],
)
def test_friction_that_does_not_fit_is_refused_with_its_line(tmp_path: Path, kind: str, law: str, message: str) -> None:
    path = tmp_path / "drive.toml"
    text = f'[drive]\nkind = "{kind}"\n[friction]\nmodel = "{law}"\npressure_dependent = true\n'
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError) as error:
        read_drive(path)
    assert str(error.value).startswith(f"{path}:3: [friction]: ")
    assert message in str(error.value)
