"""Compensators are judged as a dither is: against the same loop without them, or against gains of its own."""

import pytest

from pneuopt.control.compensators import DeadZoneInverse
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System
from pneuopt.evaluation.compensator_verdict import judge_compensators
from pneuopt.evaluation.dither_verdict import Usefulness
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet

STEP = Step(0.1, horizon=0.5)
GAINS = {"pid.Kp": 120.0, "pid.Ki": 300.0}


def rubbing(**sizes: float) -> tuple[ClosedLoop, ParameterSet]:
    """A mass with Coulomb friction, whose level the inverse of a dead zone adds to the force."""
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(1e-3), compensators=(DeadZoneInverse(),))
    return loop, loop.parameters.with_values(GAINS | {f"dead_zone_inverse.{n}": v for n, v in sizes.items()})


def test_what_friction_takes_is_useful_where_it_is_given_back() -> None:
    loop, p = rubbing(width=18.0, smoothing=1.0)
    found = judge_compensators(loop, STEP, p)
    assert found.usefulness is Usefulness.HELPS_THESE_GAINS
    assert float(found.table["with"]["SettlingTime"]) < 0.8 * float(found.table["without"]["SettlingTime"])
    assert str(found).splitlines()[0] == (
        "the dead zone inverse is useful with these gains, against the same gains without it"
    )
    assert any(reason.startswith("price: ") for reason in found.reasons)


def test_against_gains_that_need_none_it_is_not() -> None:
    loop, p = rubbing(width=18.0, smoothing=1.0)
    strong = p.with_values({"pid.Kp": 900.0, "pid.Ki": 9000.0})
    found = judge_compensators(loop, STEP, p, without=strong)
    assert found.usefulness is Usefulness.HARMFUL
    assert found.baseline == "gains tuned without it"


def test_one_of_size_zero_is_useless_and_none_cannot_be_judged(second_order: System) -> None:
    loop, p = rubbing(width=0.0)
    assert judge_compensators(loop, STEP, p).usefulness is Usefulness.USELESS
    bare = ClosedLoop(second_order, PID())
    with pytest.raises(InputError, match=r"there is nothing to judge: .*Knocker\(\)"):
        judge_compensators(bare, STEP, bare.parameters)
