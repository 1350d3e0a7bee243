"""How a loop shall end, in a tuning.toml: a duration, or a table with the repeatability."""

from pathlib import Path

import pytest

from pneuopt.evaluation.rest_check import NoHunting
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import InputError

TUNING = """
[loop]
measured = "position"
[pid]
Kp = "2 N/m"
[[reference]]
step = "100 mm"
horizon = "1 s"
[limits]
no_hunting = {}
"""


def read(folder: Path, written: str) -> NoHunting | None:
    path = folder / "tuning.toml"
    path.write_text(TUNING.format(written), encoding="utf-8")
    return read_tuning(path, ForceDrive(Stribeck()).system()).specification.rest


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ('"20 s"', NoHunting(20.0)),
        ('{ duration = "20 s", repeatability = "0.1 mm" }', NoHunting(20.0, 1e-4)),
        ('{ repeatability = "0.2 mm" }', NoHunting(repeatability=2e-4)),
    ],
)
def test_a_file_says_for_how_long_and_how_near(tmp_path: Path, written: str, expected: NoHunting) -> None:
    found = read(tmp_path, written)
    assert found is not None
    assert (found.duration, found.repeatability) == pytest.approx((expected.duration, expected.repeatability))


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ('"20 mm"', r"\[limits\] no_hunting: unit 'mm' does not measure 's'"),
        ('{ repeatability = "1 V" }', r"\[limits\] no_hunting repeatability: unit 'V' does not measure 'm'"),
        ('{ repeatability = "0 mm" }', r"\[limits\] no_hunting: NoHunting: repeatability must be positive, got 0"),
        ('{ time = "20 s" }', r"\[limits\] no_hunting: unknown key 'time'"),
    ],
)
def test_what_it_cannot_be_is_said(tmp_path: Path, written: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, written)
