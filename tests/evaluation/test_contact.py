"""A response that is continued up to an end stop is judged by what it did before the stop's rounded edge slowed it."""

from dataclasses import replace

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import ContinuedResponse, certificate
from pneuopt.evaluation.dither import Usefulness, judge_dither
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from problems.dither import dither_map


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_speed_that_holds_until_the_stop_does_not_creep(side: float) -> None:
    loop = ClosedLoop(PneumaticDrive(friction=Viscous()).system(), PID(sample_time=2e-3))
    gains = loop.parameters.with_values({"pid.Kp": 1.0, "pid.Ki": 20.0, "friction.viscous": 300.0})
    found = certificate(loop, Step(0.1 * side, horizon=0.5), gains)
    assert found.findings == ()
    assert any("reached the" in note and "end stop" in note for note in found.notes)
    settling = found.metrics.T["SettlingTime"].to_list()
    assert 0 < settling[0] < 0.5


def test_what_the_signal_does_shortly_before_a_contact_is_not_judged() -> None:
    loop = ClosedLoop(PneumaticDrive(friction=Viscous()).system(), PID())
    t = np.linspace(0.0, 10.0, 1001)
    signal = np.where(t < 9.5, 0.1, 0.6)
    continued = ContinuedResponse(
        loop, Step(0.1, horizon=1.0), None, t, signal, np.zeros_like(t), contact="the end stop"
    )
    assert continued.signal[continued.before_contact].max() == pytest.approx(0.1)
    assert np.abs(continued.error).max() == pytest.approx(0.0, abs=1e-12)
    free = replace(continued, contact="")
    assert free.signal[free.before_contact].max() == pytest.approx(0.6)
    assert free.error.max() == pytest.approx(5.0)
    averaged = replace(continued, period=4.0)
    assert averaged.times[-1] == pytest.approx(8.0), "half a period before the end, where that lies before the contact"


@pytest.mark.slow  # 6 s
def test_a_dither_is_not_blamed_for_the_end_of_the_stroke() -> None:
    loop = dither_map.controlled()
    gains = dither_map.filled(loop).with_values({"pid.Kp": 3.31, "pid.Ki": 47.83, "pid.Kd": 0.2765})
    dithered = gains.with_values({"dither.amplitude": 0.8299, "dither.frequency": 111.7})
    alone = gains.with_values({"pid.Kp": 2.79, "pid.Ki": 22.35, "pid.Kd": 0.1259})
    verdict = judge_dither(loop, dither_map.STEPS, dithered, without=alone, band=dither_map.BAND)
    assert verdict.usefulness is Usefulness.USEFUL
    assert verdict.table["with"]["RemainingError"] < verdict.table["without"]["RemainingError"] < 50
