"""What `tune` says of its input before it searches."""

import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import IAE, Requirement, SettlingTime
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.tune import tune


def dithered() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=1e-3), Dither(80.0))
    values = {"friction.viscous": 80.0, "pid.Kp": 200.0, "pid.Ki": 500.0, "pid.lower": -300.0, "pid.upper": 300.0}
    bounds = {"pid.Kp": (10.0, 1000.0), "dither.amplitude": (0.0, 50.0)}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


def test_a_ripple_beyond_the_band_is_said_before_the_search() -> None:
    """The first word, with band and ripple; of a calm dither, none at all, or no settling time, nothing is said."""

    class BegunError(Exception):
        """The search has begun."""

    def begin(_: str) -> None:
        raise BegunError

    def start(amplitude: float, size: float, minimise: Requirement) -> None:
        loop, parameters = dithered()
        given = parameters.with_values({"dither.amplitude": amplitude})
        with pytest.raises(BegunError):
            tune(loop, Step(size, horizon=0.4), given, minimise=minimise, progress=begin)

    words = (
        r"dither of 40 N at 80 Hz swings the speed by \+-1\d mm/s, beyond the settling band of \+-1 mm/s \(\+-2 % of"
    )
    with pytest.warns(PhysicsWarning, match=words):
        start(40.0, 0.05, SettlingTime())
    start(0.0, 0.05, SettlingTime())
    start(1.0, 0.1, SettlingTime())
    start(40.0, 0.05, IAE())
