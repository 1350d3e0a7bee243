"""`mend_log`: what no reader takes, mended by rule, and said row by row."""

import os
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from pneuopt.logs.experiment import Experiment
from pneuopt.logs.mending import mend_log, write_mended
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import Intersample

LINES = ["time [s],position [mm],force [N],note", *(f"{0.01 * k:.2f},{k},{k % 7},a" for k in range(300))]
"""Row k + 2 holds sample k."""


def write(folder: Path, lines: list[str], sidecar: str = "") -> Path:
    path = folder / "run.csv"
    path.write_text("\n".join(lines) + "\n", "utf-8")
    if sidecar:
        path.with_suffix(".toml").write_text(sidecar, "utf-8")
    return path


def change(row: int, text: str) -> list[str]:
    return [*LINES[: row - 1], text, *LINES[row:]]


def read_again(folder: Path, path: Path) -> Experiment:
    """The log as its new file and sidecar say it."""
    (folder / "new").mkdir()
    for new, text in write_mended(mend_log(path), folder / "new" / "run.csv", {"load.mass": "kg"}).items():
        new.write_text(text, "utf-8")
    return read_log(folder / "new" / "run.csv")


def test_a_right_log_stays_as_it_is(tmp_path: Path) -> None:
    sidecar = 'accept = ["work"]\n[noise]\nposition = "2 mm"\n[intersample]\nforce = "held"\n'
    sidecar += '[conditions]\n"load.mass" = "3 kg"\n'
    path = write(tmp_path, LINES, sidecar)
    assert mend_log(path).changes == ()
    given, again = read_log(path), read_again(tmp_path, path)
    assert np.array_equal(again.trajectory.t, given.trajectory.t)
    assert all(np.array_equal(again.trajectory[n], given.trajectory[n]) for n in ("position", "force"))
    assert (again.noise, again.accept, again.conditions) == ({"position": 0.002}, ("work",), {"load.mass": 3.0})
    assert again.intersample == {"force": Intersample.HELD}


@pytest.mark.parametrize(
    ("row", "text", "said", "samples"),
    [
        (50, "0.48,ERR,3,a", "row 50: cell of 'position [mm]' emptied, for it holds no number", 300),
        (50, "0.48,9.91e37,3,a", "row 50: cell of 'position [mm]' emptied, for no sensor gives its value", 300),
        (50, "0.48,48", "row 50: left out, for the row has not 4 cells", 299),
        (50, "0.47,48,3,a", "row 50: left out, for the time repeats", 299),
        (50, "0.40,48,3,a", "row 50: left out, for the time runs backwards", 299),
        (50, ",48,3,a", "row 50: left out, for the time is missing", 299),
    ],
)
def test_a_row_is_mended_by_its_rule(row: int, text: str, said: str, samples: int, tmp_path: Path) -> None:
    path = write(tmp_path, change(row, text))
    mended = mend_log(path)
    assert mended.changes == (said,)
    t = mended.log.trajectory
    assert len(t) == samples
    other = mended.rows != row
    assert np.array_equal(t["position"][other], 1e-3 * (mended.rows[other] - 2))  # each other row as it was
    if samples == 300:
        assert np.isnan(t["position"][row - 2])
        assert t["force"][row - 2] == 3
    again = read_again(tmp_path, path)
    assert np.array_equal(again.trajectory["position"], t["position"], equal_nan=True)


def test_several_rows_are_counted(tmp_path: Path) -> None:
    lines = list(LINES)
    for row in (20, 21, 22, 90):
        lines[row - 1] = f"{0.01 * (row - 2):.2f},?,1,a"
    mended = mend_log(write(tmp_path, lines))
    assert mended.changes == ("rows 20 to 22, 90 (4 in all): cell of 'position [mm]' emptied, for it holds no number",)


def test_a_misspelt_column_is_taken_for_its_channel(tmp_path: Path) -> None:
    path = write(tmp_path, [LINES[0].replace("position", "postion"), *LINES[1:]])
    with pytest.raises(LogError, match="'position'"):
        read_log(path)
    mended = mend_log(path)
    assert mended.changes == ("column 'postion [mm]' is read as the channel 'position'",)
    assert mended.log.trajectory["position"][10] == pytest.approx(0.01)


def test_a_decimal_comma_is_no_fault(tmp_path: Path) -> None:
    lines = [line.replace(",", ";").replace(".", ",") for line in LINES]
    assert mend_log(write(tmp_path, lines)).changes == ()


def test_two_recordings_in_a_file_are_not_mended(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="300 of 600 rows"):
        mend_log(write(tmp_path, [*LINES, *LINES[1:]]))


@pytest.mark.skipif(os.name == "nt", reason="no such names on Windows")
def test_a_line_in_a_logs_name_is_no_key_of_the_sidecar(tmp_path: Path) -> None:
    path = write(tmp_path, LINES).rename(tmp_path / 'a\n[conditions]\n"load.mass" = "1 kg"\n#.csv')
    (_, _), (_, sidecar) = write_mended(mend_log(path), tmp_path / "new.csv", {}).items()
    assert "conditions" not in tomlkit.parse(sidecar)
