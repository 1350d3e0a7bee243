"""Moves, sequences of them and paths through points."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from pneuopt.control.moves import MotionPath, Move, MoveProfile, MoveSequence, plan_s_curve
from pneuopt.control.reference import Reference
from pneuopt.quantities.errors import InputError

positive = st.floats(1e-3, 1e3)
moves = st.builds(
    Move,
    st.floats(1e-3, 10).flatmap(lambda d: st.sampled_from([d, -d])),
    speed=positive,
    acceleration=positive,
    jerk=positive | st.just(math.inf),
    profile=st.sampled_from([MoveProfile.S_CURVE, MoveProfile.MINIMUM_JERK]),
    at=st.floats(0, 2),
    initial=st.floats(-1, 1),
)


@given(moves)
def test_a_move_keeps_its_limits_and_reaches_its_end(move: Move) -> None:
    t = np.linspace(0, move.horizon, 4001)
    s, v, a = move.motion(t)
    scale = max(abs(move.distance), abs(move.initial))
    slack = 1 + 1e-9
    assert np.abs(v).max() <= move.speed * slack
    assert np.abs(a).max() <= move.acceleration * slack
    inside = (t[:-1] >= move.at) & (t[1:] <= move.at + move.duration)
    jerks = np.abs(np.diff(a))[inside] / np.diff(t)[inside]
    rounding = 1e-9 * move.acceleration / np.diff(t).min()
    assert not inside.any() or jerks.max() <= move.jerk * slack + rounding
    assert s[t <= move.at].tolist() == [move.initial] * int((t <= move.at).sum())
    assert s[-1] == move.final
    assert np.all(np.diff(math.copysign(1.0, move.distance) * s) >= -1e-12 * scale)


@given(moves)
def test_a_move_is_symmetric_and_its_columns_are_derivatives(move: Move) -> None:
    T = move.duration
    t = move.at + T * np.linspace(0.0005, 0.9995, 1500)
    s, v, a = move.motion(t)
    mirrored = move.motion(2 * move.at + T - t)
    scale = abs(move.distance)
    np.testing.assert_allclose(s - move.initial, move.final - mirrored[0], atol=1e-9 * scale + 1e-15)
    np.testing.assert_allclose(v, mirrored[1], atol=1e-8 * scale / T)
    h = t[1] - t[0]
    peak = np.abs(a).max()
    np.testing.assert_allclose(np.diff(s) / h, (v[1:] + v[:-1]) / 2, atol=peak * h + 1e-9 * scale / T)
    off, bent = np.abs(np.diff(v) / h - (a[1:] + a[:-1]) / 2), np.abs(np.diff(a))
    near = np.maximum(bent, np.maximum(np.append(bent[1:], 0.0), np.append(0.0, bent[:-1])))
    assert np.all(off <= near / 2 + 1e-6 * peak)  # a mean between two samples lies between them, but at a corner


@pytest.mark.parametrize(
    ("speed", "acceleration", "jerk"),
    [
        (0.5, 5.0, 100.0),  # all limits are reached
        (9.0, 5.0, 100.0),  # the speed is not
        (9.0, 99.0, 100.0),  # nor is the acceleration
        (0.3, 99.0, 100.0),  # the speed is, the acceleration is not
        (0.5, 5.0, math.inf),
        (9.0, 5.0, math.inf),
    ],
)
def test_no_move_within_the_limits_is_faster(speed: float, acceleration: float, jerk: float) -> None:
    """The farthest that any motion of piecewise constant jerk comes in a time, by linear programming."""
    distance = 0.2
    T = plan_s_curve(distance, speed, acceleration, jerk).duration
    assert _farthest(0.97 * T, speed, acceleration, jerk) < distance < _farthest(1.03 * T, speed, acceleration, jerk)


def _farthest(T: float, speed: float, acceleration: float, jerk: float, n: int = 100) -> float:
    h = T / n
    sums = np.tril(np.ones((n, n)))
    a = np.eye(n) if jerk == math.inf else h * sums  # of the accelerations, or of the jerks
    v = h * sums @ a
    bound = acceleration if jerk == math.inf else jerk
    rows, limits = np.vstack([a, -a, v, -v]), np.repeat([acceleration, acceleration, speed, speed], n)
    ends = np.vstack([v[-1], a[-1]] if jerk < math.inf else [v[-1]])
    ahead = h * v.sum(axis=0)
    found = linprog(-ahead, rows, limits, ends, np.zeros(len(ends)), bounds=(-bound, bound))
    return float(ahead @ found.x)


def test_the_least_jerk_has_the_published_peaks() -> None:
    move = Move(0.2, speed=9.0, acceleration=9.0, jerk=50.0, profile=MoveProfile.MINIMUM_JERK)
    T, d = move.duration, 0.2
    assert pytest.approx(math.cbrt(60 * d / 50.0)) == T
    _, v, a = move.motion(np.linspace(0, T, 100001))
    assert np.abs(v).max() == pytest.approx(15 / 8 * d / T)
    assert np.abs(a).max() == pytest.approx(10 / math.sqrt(3) * d / T**2, rel=1e-6)


def test_a_trapezoid_without_room_to_cruise_is_a_triangle() -> None:
    move = Move(0.1, speed=9.0, acceleration=10.0, profile=MoveProfile.TRAPEZOID)
    assert move.duration == pytest.approx(2 * math.sqrt(0.1 / 10.0))


def test_a_move_is_a_reference() -> None:
    move = Move(-0.2, speed=0.5, acceleration=5.0, at=0.1, initial=0.3, dwell=0.4, disturbance={"load.force": 5.0})
    assert isinstance(move, Reference)
    run = move.trajectory(0.1)
    assert run.names == ("reference", "reference_speed", "reference_acceleration", "disturbance.load.force")
    assert run["disturbance.load.force"].tolist()[:3] == [0.0, 5.0, 5.0]
    assert run["reference"][-1] == move.final
    assert move.with_horizon(0.3).horizon == pytest.approx(0.3)
    assert move.with_horizon(0.3).duration == move.duration


MOVE = Move(0.2, speed=0.5, acceleration=5.0, dwell=0.25, initial=0.1, at=0.1)
NEXT = Move(-0.3, speed=0.5, acceleration=5.0, jerk=200.0, dwell=0.5)


def test_moves_follow_each_other() -> None:
    both = MoveSequence([MOVE, NEXT])
    assert isinstance(both, Reference)
    first, second = both.chain
    assert (second.at, second.initial) == (MOVE.horizon, MOVE.final)
    assert (both.origin, both.initial, both.final) == (0.1, MOVE.final, second.final)
    t = np.linspace(0, both.horizon, 3001)
    r, v, a = both.motion(t)
    before = t < second.at
    np.testing.assert_array_equal(r[before], first.values(t)[before])
    np.testing.assert_array_equal(r[~before], second.values(t)[~before])
    assert np.abs(np.diff(r)).max() < 0.5 * (t[1] - t[0]) * 1.001
    assert (np.abs(v).max(), np.abs(a).max()) == (pytest.approx(0.5), pytest.approx(5.0))
    assert [part.label for part in both.parts] == ["0.1 to 0.3", "0.1 to 0.3 to 0"]


def test_a_sequence_runs_on_any_grid() -> None:
    run = MoveSequence([MOVE, NEXT]).trajectory(1e-2)
    assert run.names == ("reference", "reference_speed", "reference_acceleration")
    assert run["reference"][0] == 0.1
    assert run["reference_speed"][-1] == 0.0


def test_a_disturbance_comes_with_the_last_move() -> None:
    push = replace(NEXT, disturbance={"load.force": 20.0})
    both = MoveSequence([MOVE, push])
    run = both.trajectory(1e-2)
    assert run["disturbance.load.force"].tolist() == np.where(run.t >= both.at - 1e-12, 20.0, 0.0).tolist()
    with pytest.raises(InputError, match="move 1"):
        MoveSequence([push, NEXT])


def test_a_horizon_is_that_of_the_last_dwell() -> None:
    both = MoveSequence([MOVE, NEXT]).with_horizon(9.0)
    assert both.horizon == pytest.approx(9.0)
    assert both.moves[0] == MOVE


@pytest.mark.parametrize("own", [{"at": 0.1}, {"initial": 0.1}, {"start": {"pressure_b": 3e5}}])
def test_a_later_move_has_no_beginning_of_its_own(own: dict[str, float]) -> None:
    with pytest.raises(InputError, match="move 2"):
        MoveSequence([MOVE, replace(NEXT, **own)])  # type: ignore[arg-type]


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
