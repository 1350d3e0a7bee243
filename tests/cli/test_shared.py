"""What every command does at its end, and says of the files that it is given."""

from pathlib import Path

import pytest

from pneuopt.cli.run import ExitStatus
from pneuopt.cli.shared import Outputs, finish, warn_of_status
from pneuopt.files.drive import read_fit
from pneuopt.quantities.status import Code, Status


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (None, ExitStatus.SUCCESS),
        (Code.CONVERGED, ExitStatus.SUCCESS),
        (Code.MISFIT, ExitStatus.FAILURE),
        (Code.NOT_CERTIFIED, ExitStatus.FAILURE),
        (Code.INTERRUPTED, ExitStatus.INTERRUPTED),
    ],
)
def test_a_fit_far_beyond_its_noise_is_no_success(code: Code | None, expected: int) -> None:
    assert finish(Outputs(None, None, None), {}, {}, code and Status(code, ("said",))) == expected


@pytest.mark.parametrize(("mark", "warns"), [("exact", False), ("widened", False), ("bias possible", True)])
def test_estimates_that_may_be_biased_are_named_by_later_commands(
    mark: str, warns: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "fit.toml"
    head = '[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\n'
    path.write_text(f'{head}[estimates]\n"friction.coulomb" = {{ mark = "{mark}" }}\n', encoding="utf-8")
    warn_of_status(read_fit(path))
    assert ("may be biased by a model error: friction.coulomb" in capsys.readouterr().err) is warns


@pytest.mark.parametrize(
    ("code", "status"), [(Code.CONVERGED, 0), (Code.PARTIAL, 0), (Code.MISFIT, 1), (Code.NOT_CONVERGED, 1)]
)
def test_a_part_of_an_answer_ends_as_an_answer(code: Code, status: int) -> None:
    assert finish(Outputs(None, None, None), {}, {}, Status(code, ("said",))) == status
