import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from pneuopt.quantities.errors import UnknownNameError
from pneuopt.quantities.trajectories import Trajectory

RUN = Trajectory([0.0, 1.0, 3.0], {"speed": [0.0, math.nan, 2.0], "force": [1, 2, 3]})


def test_it_is_read_only_and_keeps_no_view_of_what_it_was_given() -> None:
    t, speed = np.array([0.0, 1.0]), np.array([1.0, 2.0])
    run = Trajectory(t, {"speed": speed})
    speed[0] = t[1] = 99.0
    assert run["speed"].tolist() == [1.0, 2.0]
    assert run.duration == 1.0
    with pytest.raises(ValueError, match="read-only"):
        run["speed"][0] = 5.0


def test_columns_are_found_by_name() -> None:
    assert (len(RUN), RUN.names, RUN.duration) == (3, ("speed", "force"), 3.0)
    assert "force" in RUN
    assert list(RUN) == ["speed", "force"]
    assert_array_equal(RUN.matrix(["force", "speed"])[:, 0], [1.0, 2.0, 3.0])
    assert RUN.matrix([]).shape == (3, 0)
    with pytest.raises(UnknownNameError, match="sped"):
        RUN["sped"]


def test_copies_with_other_columns_rows_and_grids() -> None:
    assert RUN.with_columns({"force": [0, 0, 0]})["force"].sum() == 0
    assert RUN.select(["force"]).names == ("force",)
    assert RUN.rows(1, 3).t.tolist() == [1.0, 3.0]
    assert RUN.interpolate([-1.0, 0.5, 2.0, 9.0])["force"].tolist() == [1.0, 1.5, 2.5, 3.0]
    assert RUN["force"].tolist() == [1.0, 2.0, 3.0]


def test_it_tabulates_and_travels_between_processes() -> None:
    frame = RUN.to_frame()
    assert frame.index.name == "time"
    assert_array_equal(frame["speed"], RUN["speed"])
    back = pickle.loads(pickle.dumps(RUN))
    assert_array_equal(back["speed"], RUN["speed"])


@given(st.lists(st.floats(0.001, 10.0), min_size=1, max_size=30))
def test_interpolating_onto_its_own_grid_changes_nothing(steps: list[float]) -> None:
    t = np.cumsum(steps)
    run = Trajectory(t, {"position": np.sin(t)})
    assert_array_equal(run.interpolate(t)["position"], run["position"])
