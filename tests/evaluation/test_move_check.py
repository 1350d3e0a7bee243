"""What no controller can: too long, too fast, too violent moves, and the fastest that is left."""

import math
from dataclasses import replace

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveSequence
from pneuopt.control.pid import PID
from pneuopt.evaluation.move_check import check_move, scale_move, shortest_move
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.models.catalog import t32
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.models.karnopp import Karnopp
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.tune import tune


def pneumatic() -> tuple[ClosedLoop, ParameterSet]:
    drive, values = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), measured="position")
    given = {"pid.Kp": 20.0, "pid.lower": -5.0, "pid.upper": 5.0}
    return loop, (loop.parameters | values).with_values(given)


def pushed(limit: float = 100.0) -> tuple[ClosedLoop, ParameterSet]:
    """5 kg on 40 N of Coulomb friction."""
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(sample_time=1e-3), measured="position")
    given = {"pid.lower": -limit, "pid.upper": limit, "load.mass": 5.0, "friction.coulomb": 40.0}
    given |= {"friction.viscous": 0.0, "pid.Kp": 500.0}
    return loop, loop.parameters.with_values(given)


@pytest.mark.parametrize(
    ("move", "words"),
    [
        (Move(0.5, speed=0.5, acceleration=5.0, initial=0.05), "to the front end stop there are 450 mm"),
        (Move(-0.2, speed=0.5, acceleration=5.0, initial=0.05), "to the rear end stop there are 50 mm"),
        (Move(0.4, speed=9.0, acceleration=800.0, initial=0.05), r"at 9 m/s, .* 5 V the plant moves at [12]\.\d+ m/s"),
        (Move(0.1, speed=1.0, acceleration=200.0, initial=0.05), r"accelerates with 200 m/s\^2, full command \(5 V\)"),
    ],
)
def test_a_move_that_cannot_be_made_is_refused_with_what_can(move: Move, words: str) -> None:
    loop, values = pneumatic()
    with pytest.raises(InputError, match=words):
        check_move(loop, move, values)
    feasible = Move(0.1, speed=0.5, acceleration=5.0, jerk=200.0, initial=0.05)
    check_move(loop, feasible, values)
    check_move(loop, replace(feasible, distance=-0.1, initial=0.2), values)
    back = replace(move, initial=0.0)
    with pytest.raises(InputError):
        check_move(loop, MoveSequence([feasible, back]), values)


def test_force_less_friction_bounds_the_acceleration() -> None:
    """100 N less 40 N accelerate 5 kg by 12 m/s^2."""
    loop, values = pushed()
    check_move(loop, Move(0.5, speed=9.0, acceleration=11.0), values)
    with pytest.raises(InputError, match=r"with 13 m/s\^2, full command \(100 N\) from rest with 1[12]\.\d m/s\^2"):
        check_move(loop, Move(0.5, speed=9.0, acceleration=13.0), values)


def test_the_shortest_move_of_a_pushed_mass_is_that_of_its_force() -> None:
    """A triangle of speed at 12 m/s^2 takes 2 sqrt(d/a)."""
    loop, values = pushed()
    found = shortest_move(loop, Move(0.5, speed=9.0, acceleration=1.0), values)
    assert found.duration == pytest.approx(2 * math.sqrt(0.5 / 12), rel=0.04)
    assert found.duration >= 2 * math.sqrt(0.5 / 12)
    check_move(loop, found, values)
    with pytest.raises(InputError):
        check_move(loop, scale_move(found, 1.05), values)


def test_the_shortest_move_of_a_cylinder_is_allowed_and_hardly_a_faster_one() -> None:
    loop, values = pneumatic()
    found = shortest_move(loop, Move(0.2, speed=0.5, acceleration=5.0, jerk=200.0, initial=0.05), values)
    check_move(loop, found, values)
    with pytest.raises(InputError, match="lower its"):
        check_move(loop, scale_move(found, 1.05), values)


def test_a_body_that_full_command_does_not_move_has_no_shortest_move() -> None:
    loop = ClosedLoop(ForceDrive(Karnopp(Coulomb())).system(), PID(sample_time=1e-3), measured="position")
    given = {"pid.lower": -30.0, "pid.upper": 30.0, "friction.coulomb": 40.0}
    values = loop.parameters.with_values(given)
    with pytest.raises(InputError, match="full command"):
        shortest_move(loop, Move(0.1, speed=0.1, acceleration=1.0), values)


def test_what_nothing_limits_is_not_checked() -> None:
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(limits=False), measured="position")
    check_move(loop, Move(0.5, speed=90.0, acceleration=1e5), loop.parameters)
    with pytest.raises(InputError, match="nothing limits this move"):
        shortest_move(loop, Move(0.5, speed=90.0, acceleration=1e5), loop.parameters)


def test_a_tuning_refuses_what_no_gains_can() -> None:
    loop, values = pushed()
    free = values.with_bounds({"pid.Kp": (10.0, 1e4)}).freed("pid.Kp")
    with pytest.raises(InputError, match="lower its acceleration"):
        tune(loop, Move(0.5, speed=9.0, acceleration=50.0), free, minimise=SettlingTime())
