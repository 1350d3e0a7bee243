from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import LogError

TIME = 0.1 * np.arange(12)


def written(folder: Path, **columns: object) -> Path:
    path = folder / "run.parquet"
    pd.DataFrame({"time [s]": TIME, **columns}).to_parquet(path)
    return path


def test_names_may_hold_units_in_brackets_and_points(tmp_path: Path) -> None:
    path = written(tmp_path, **{"position [mm]": np.arange(12, dtype=np.int16), "rig.force": TIME.astype(np.float32)})
    assert read_log(path).trajectory["position"] == pytest.approx(1e-3 * np.arange(12), rel=1e-15)
    columns: dict[str, str | dict[str, str | float]]
    columns = {"time": "time [s]", "force": {"column": "rig.force", "unit": "N"}}
    assert read_log(path, columns=columns).trajectory["force"] == pytest.approx(TIME, rel=1e-7)


def test_a_null_among_whole_numbers_is_a_missing_sample(tmp_path: Path) -> None:
    counts = pd.array([None, *range(1, 12)], dtype="Int32")
    position = read_log(written(tmp_path, **{"position [mm]": counts})).trajectory["position"]
    assert np.flatnonzero(np.isnan(position)).tolist() == [0]


def test_text_is_left_alone_where_it_is_not_used_and_refused_where_it_is(tmp_path: Path) -> None:
    path = written(tmp_path, **{"position [mm]": TIME, "note": [None, "good", *[""] * 10]})
    assert read_log(path).trajectory.names == ("position",)
    with pytest.raises(LogError, match=r"row 2, column 'note': 'good' is not a number, as the column's type is"):
        read_log(path, columns={"time": "time [s]", "force": {"column": "note", "unit": "N"}})
