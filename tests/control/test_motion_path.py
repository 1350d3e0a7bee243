from typing import Any

import numpy as np
import pytest

from pneuopt.control.motion_path import MotionPath
from pneuopt.control.reference import Reference
from pneuopt.quantities.errors import InputError

T = np.array([0.0, 0.5, 1.0, 1.5])


def test_a_path_goes_through_its_points_and_nowhere_beyond() -> None:
    points = np.array([0.0, 0.1, 0.1, 0.3])
    path = MotionPath(T, points)
    assert isinstance(path, Reference)
    np.testing.assert_allclose(path.values(T), points, atol=1e-15)
    t = np.linspace(0, path.horizon, 2001)
    r, v, _ = path.motion(t)
    assert (r.min(), v[-1]) == (0.0, 0.0)
    assert [r.max(), r[-1]] == pytest.approx([0.3, 0.3], rel=1e-12)
    np.testing.assert_allclose(r[(t >= 0.5) & (t <= 1.0)], 0.1, atol=1e-15)
    np.testing.assert_allclose(np.gradient(r, t)[5:1480], v[5:1480], atol=5e-3)
    assert path.with_horizon(0.9).trajectory(0.1)["reference"] == pytest.approx(path.values(np.linspace(0.0, 0.9, 10)))


def test_a_path_that_returns_is_measured_by_its_range() -> None:
    path = MotionPath(T, [0.1, 0.3, 0.2, 0.1])
    assert (path.size, path.changes) == (0.0, False)
    assert path.nominal_size == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"points": [0.0, 1.0]}, "rows of two or more, got shapes"),
        ({"t": [0.0, 1.0, 1.0, 2.0]}, "does not at point 3"),
        ({"t": [1.0, 2.0, 3.0, 4.0]}, "time begins at 0, got 1 s"),
        ({"points": [1.0, 1.0, 1.0, 1.0]}, "nothing moves"),
        ({"points": [1.0, np.nan, 1.0, 1.0]}, "not finite"),
        ({"dwell": -2.0}, "ends the experiment before it begins"),
    ],
)
def test_impossible_paths_are_refused(fields: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"t": T, "points": [0.0, 0.1, 0.2, 0.3]}
    with pytest.raises(InputError, match=message):
        MotionPath(**(given | fields))
