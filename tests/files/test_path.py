from pathlib import Path

import numpy as np
import pytest

from pneuopt.files.path import read_path
from pneuopt.quantities.errors import InputError


def written(folder: Path, head: str, points: np.ndarray) -> Path:
    path = folder / "cam.csv"
    rows = "\n".join(f"{t:.6g};{y:.9g}".replace(".", ",") for t, y in points)
    path.write_text(f"{head}\n{rows}\n", encoding="utf-8")
    return path


def test_a_path_is_read_with_its_units(tmp_path: Path) -> None:
    t = np.linspace(0, 500, 21)
    y = 50 * (1 - np.cos(2 * np.pi * t / 1000))
    path = read_path(written(tmp_path, "time [ms];position [mm]", np.column_stack([t + 2000, y])), dwell=0.2)
    assert path.label == "cam"
    np.testing.assert_allclose(path.t, t / 1000, atol=1e-12)
    np.testing.assert_allclose(path.points, y / 1000, atol=1e-9)
    assert path.horizon == pytest.approx(0.7)


def test_a_table_without_a_motion_is_refused(tmp_path: Path) -> None:
    t = np.linspace(0, 1, 21)
    with pytest.raises(InputError, match=r"cam\.csv: no column of a path; name one position \[mm\]"):
        read_path(written(tmp_path, "time [s];force [N]", np.column_stack([t, t])))
    with pytest.raises(InputError, match=r"cam\.csv.*nothing moves, every point is 0\.005"):
        read_path(written(tmp_path, "time [s];position [mm]", np.column_stack([t, 5 + 0 * t])))
    with pytest.raises(InputError, match="unknown channel 'postion'"):
        read_path(written(tmp_path, "time [s];position [mm]", np.column_stack([t, t])), channel="postion")
