"""Verdicts on dither."""

from math import pi

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.dither_verdict import Usefulness, judge_dither
from pneuopt.models.catalog import r25, t32
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet

GAINS = {"pid.Kp": 4.5, "pid.Ki": 24.6, "pid.Kd": 0.2, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}


def paper(rate: float = 1000.0, amplitude: float = 1e-3, lugre: bool = True) -> tuple[ClosedLoop, ParameterSet]:
    drive, p = r25(lugre)
    loop = ClosedLoop(drive.system(), PID(), Dither(rate / (2 * pi)), measured="speed")
    return loop, (loop.parameters | p).with_values({**GAINS, "dither.amplitude": amplitude})


def test_the_papers_dither_is_useless_and_the_reason_is_in_the_text() -> None:
    loop, p = paper()
    verdict = judge_dither(loop, Step(0.05, horizon=1.0), p)
    text = str(verdict)
    assert verdict.usefulness is Usefulness.USELESS
    assert "nothing changes" in text
    assert "0.76 mN against a static friction of 40 N" in text
    assert verdict.effect.force == pytest.approx(0.76e-3, rel=0.01)
    before, after = (verdict.table[c]["Overshoot"] for c in ("without", "with"))
    assert before == pytest.approx(40.2, abs=0.3)
    assert after == pytest.approx(before, abs=0.05)


def coarse(amplitude: float, frequency: float) -> tuple[ClosedLoop, ParameterSet]:
    """A valve with a dead zone of 5 %, low-friction seals, a sensor that lags; slow gains."""
    drive, p = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), Dither(frequency))
    hardware = {"valve.dead_zone": 0.05, "friction.coulomb": 10.0, "friction.static": 14.0}
    gains = {"pid.Kp": 2.0, "pid.Ki": 20.0, "pid.lower": -5.0, "pid.upper": 5.0, "dither.amplitude": amplitude}
    return loop, (loop.parameters | p).with_values({**hardware, **gains})


STEP = Step(0.05, horizon=0.6, start={"position": 0.25, "pressure_b": 3.5e5})


def test_dither_through_a_dead_zone_is_useful_and_has_a_price() -> None:
    loop, p = coarse(0.5, 60.0)
    verdict = judge_dither(loop, STEP, p, band=0.05)
    assert verdict.usefulness is Usefulness.USEFUL
    assert verdict.table["with"]["IAE"] < 0.9 * verdict.table["without"]["IAE"]
    assert verdict.table["with"]["ValveTravel"] > 3 * verdict.table["without"]["ValveTravel"]
    assert "price: ripple" in str(verdict)
    assert "dead zone of 0.05" in str(verdict)


def test_dither_that_swings_the_piston_by_more_than_the_step_is_harmful() -> None:
    loop, p = coarse(4.0, 10.0)
    verdict = judge_dither(loop, STEP, p, band=0.05)
    assert verdict.usefulness is Usefulness.HARMFUL
    assert "more than the step itself" in verdict.reasons[0]


def test_the_design_without_may_be_another_one() -> None:
    loop, p = paper(amplitude=1e-3)
    slow = p.with_values({"pid.Kp": 1.0, "pid.Ki": 2.0})
    verdict = judge_dither(loop, Step(0.05, horizon=0.5), p, without=slow)
    assert "a design of its own" in str(verdict)
    assert verdict.table["without"]["IAE"] > verdict.table["with"]["IAE"]


def test_another_plant_is_judged_by_its_response_alone() -> None:
    plant = SecondOrder().system()
    loop = ClosedLoop(plant, PID(), Dither(100.0))
    p = loop.parameters.with_values({"pid.Kp": 0.5, "dither.amplitude": 1e-4})
    verdict = judge_dither(loop, Step(1.0, horizon=1.0), p)
    assert verdict.usefulness is Usefulness.USELESS
    assert np.isnan(verdict.effect.force)


def test_no_dither_is_nothing_to_judge() -> None:
    loop, p = paper()
    with pytest.raises(InputError, match=r"no dither to judge: dither.amplitude is 0"):
        judge_dither(loop, Step(0.05), p.with_values({"dither.amplitude": 0.0}))
    with pytest.raises(InputError, match="no dither to judge: ClosedLoop"):
        judge_dither(ClosedLoop(loop.plant, PID(), measured="speed"), Step(0.05), p)
