"""The rival of a dithered design: tuned like it, with no dither at all."""

from typing import Any

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.tune import tune
from pneuopt.tuning.without_dither import tune_without_dither

RANGES = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0), "dither.amplitude": (0.05, 0.1), "dither.offset": (-0.1, 0.1)}


def design(*free: str) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False), Dither(50.0))
    return loop, loop.parameters.with_values({"dither.amplitude": 0.1}).with_bounds(RANGES).freed(*free)


def test_the_rival_is_the_tuning_of_a_loop_whose_dither_is_off() -> None:
    """Even where the range of the dithered design's amplitude excludes 0; what else was free is."""
    loop, given = design("pid.Kp", "pid.Ki", "dither.amplitude")
    asked: dict[str, Any] = {"minimise": SettlingTime(), "subject_to": [Overshoot(0.05)]}
    rival = tune_without_dither(loop, Step(1.0), given, **asked)
    off = given.with_bounds({"dither.amplitude": (0.0, 0.1)}).with_values({"dither.amplitude": 0.0})
    same = tune(loop, Step(1.0), off.fixed("dither.*"), plants={}, **asked)
    assert rival.parameters.value("dither.amplitude") == 0
    assert rival.parameters.free_names == ("pid.Kp", "pid.Ki")
    assert [rival.parameters.value(n) for n in RANGES] == [same.parameters.value(n) for n in RANGES]
    assert rival.validation is None
