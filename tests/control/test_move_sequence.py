from dataclasses import replace

import numpy as np
import pytest

from pneuopt.control.move_sequence import MoveSequence
from pneuopt.control.moves import Move
from pneuopt.control.reference import Reference
from pneuopt.quantities.errors import InputError

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
    with pytest.raises(InputError, match="only the last move may have a disturbance, move 1 has one"):
        MoveSequence([push, NEXT])


def test_a_horizon_is_that_of_the_last_dwell() -> None:
    both = MoveSequence([MOVE, NEXT]).with_horizon(9.0)
    assert both.horizon == pytest.approx(9.0)
    assert both.moves[0] == MOVE


@pytest.mark.parametrize("own", [{"at": 0.1}, {"initial": 0.1}, {"start": {"pressure_b": 3e5}}])
def test_a_later_move_has_no_beginning_of_its_own(own: dict[str, float]) -> None:
    with pytest.raises(InputError, match="move 2 begins where the one before ends"):
        MoveSequence([MOVE, replace(NEXT, **own)])  # type: ignore[arg-type]


def test_no_move_is_refused() -> None:
    with pytest.raises(InputError, match="there is no move"):
        MoveSequence([])
