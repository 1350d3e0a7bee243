from pathlib import Path

import numpy as np
import openpyxl
import pytest

from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import LogError


def written(folder: Path, cells: dict[str, object], form: str = "General") -> Path:
    """A sheet of twelve rows every 2.5 ms, with some cells set afterwards."""
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.append(["time [s]", "position [mm]"])
    for k in range(12):
        sheet.append([46093.5 + 2.5e-3 * k / 86400 if form != "General" else 2.5e-3 * k, float(k)])
        sheet.cell(k + 2, 1).number_format = form
    for place, value in cells.items():
        sheet[place] = value  # openpyxl writes "#DIV/0!" as Excel's error, "=..." as a formula without a value
    book.save(folder / "run.xlsx")
    return folder / "run.xlsx"


def test_dates_keep_more_than_milliseconds(tmp_path: Path) -> None:
    run = read_log(written(tmp_path, {}, "yyyy-mm-dd hh:mm:ss.000"))
    np.testing.assert_allclose(run.trajectory.t, 2.5e-3 * np.arange(12), atol=1.5e-6)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("A5", 1e9, "row 5, column 'time [s]': 1e+09 is no date of Excel; write a date with its time"),
        ("A2", None, "row 2, column 'time [s]': the time is missing; delete the row"),
        ("B3", 10**100, "row 3, column 'position [mm]': inf is not a number; leave the cell empty"),
        ("B3", "12,5", "row 3, column 'position [mm]': '12,5' is not a number; leave the cell empty"),
        ("B90000", 1.0, "10001 rows are empty; delete them, or what is below them"),
        ("XFD1048576", 1.0, "10001 rows are empty; delete them, or what is below them"),
        ("B3", "#DIV/0!", "row 3, column 'position [mm]': '#DIV/0!' is not a number; leave the cell empty"),
        ("C3", 1.0, "row 3 has 3 cells, the header 2; mend it"),
    ],
)
def test_a_bad_cell_is_named(tmp_path: Path, place: str, value: object, said: str) -> None:
    with pytest.raises(LogError) as error:
        read_log(written(tmp_path, {place: value}, "yyyy-mm-dd hh:mm:ss.000"))
    assert said in str(error.value)


def test_merged_cells_and_formulas_without_a_value_are_missing_samples(tmp_path: Path) -> None:
    path = written(tmp_path, {"B5": "=1+1"})
    book = openpyxl.load_workbook(path)
    book.active.merge_cells("B8:B9")
    book.save(path)
    assert np.flatnonzero(np.isnan(read_log(path).trajectory["position"])).tolist() == [3, 7]
