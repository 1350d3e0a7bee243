import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from pneuopt.control.moves import Move, MoveProfile
from pneuopt.control.profiles import plan_s_curve
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


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"distance": 0.0}, "distance must not be zero"),
        ({"speed": -1.0}, "speed is a limit on its size and must be positive"),
        ({"jerk": 0.0}, "jerk is a limit"),
        ({"acceleration": math.inf}, "acceleration must be a finite number"),
        ({"jerk": 5.0, "profile": MoveProfile.TRAPEZOID}, "no limit of jerk allows; leave jerk out"),
        ({"dwell": -9.0}, "before the move begins; raise dwell"),
        ({"at": -1.0}, "time starts at zero"),
    ],
)
def test_impossible_moves_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Move(**({"distance": 0.1, "speed": 1.0, "acceleration": 1.0} | fields))
