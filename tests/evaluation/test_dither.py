"""What a dither moves: golden numbers, lag, dead zone, clipping, and the sentences on them.

Verdicts on dither: a table of cases, each with the verdict that it deserves and why, and what the text says.

Compensators are judged as a dither is: against the same loop without them, or against gains of its own.
"""

from collections.abc import Callable
from math import pi
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from pneuopt.control.compensators import DeadZoneInverse
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.dither import (
    DitherEffect,
    Usefulness,
    begin_of_end,
    dither_effect,
    explain_effect,
    judge_compensators,
    judge_dither,
)
from pneuopt.models.catalog import r25, t32
from pneuopt.models.drives import ForceDrive, RotaryDrive
from pneuopt.models.friction import Coulomb, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.parameters import ParameterSet

GAINS = {"pid.Kp": 4.5, "pid.Ki": 24.6, "pid.Kd": 0.2, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}
TABLE = {  # of `r25` linearised, per volt: |F| [N], |v| [m/s], |y| [m]; as problems/paper/paper_dither.py prints them
    62.8: (12.1, 1.6e-2, 2.5e-4),
    125.7: (6.1, 4.0e-3, 3.2e-5),
    628.0: (1.21, 1.6e-4, 2.6e-7),
    1000.0: (0.76, 6.4e-5, 6.4e-8),
}


def paper(rate: float = 1000.0, amplitude: float = 1e-3, lugre: bool = True) -> tuple[ClosedLoop, ParameterSet]:
    drive, p = r25(lugre)
    loop = ClosedLoop(drive.system(), PID(), Dither(rate / (2 * pi)), measured="speed")
    return loop, (loop.parameters | p).with_values({**GAINS, "dither.amplitude": amplitude})


def coarse(amplitude: float, frequency: float) -> tuple[ClosedLoop, ParameterSet]:
    """A valve with a dead zone of 5 %, low-friction seals, a sensor that lags; slow gains."""
    drive, p = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), Dither(frequency))
    hardware = {"valve.dead_zone": 0.05, "friction.coulomb": 10.0, "friction.static": 14.0}
    gains = {"pid.Kp": 2.0, "pid.Ki": 20.0, "pid.lower": -5.0, "pid.upper": 5.0, "dither.amplitude": amplitude}
    return loop, (loop.parameters | p).with_values({**hardware, **gains})


STEP = Step(0.05, horizon=0.6, start={"position": 0.25, "pressure_b": 3.5e5})


@pytest.mark.parametrize("rate", TABLE)
def test_what_a_volt_moves_is_the_golden_table(rate: float) -> None:
    """At the paper's 1 mV, where it is linear; friction viscous alone, nearly at rest."""
    loop, p = paper(rate, lugre=False)
    found = dither_effect(loop, Step(1e-6), p)
    per_volt = [value / 1e-3 for value in (found.force, found.speed, found.travel)]
    assert per_volt == pytest.approx(TABLE[rate], rel=0.03)


def test_a_spool_that_lags_and_a_dead_zone_that_swallows_are_said() -> None:
    loop, p = coarse(0.2, 160.0)
    found = dither_effect(loop, STEP, p)
    lag = 1 / abs(1 - (160 / 80) ** 2 + 1j * 1.6 * 160 / 80)  # second order, 80 Hz, damping 0.8
    assert found.valve_gain == pytest.approx(lag, rel=1e-3)
    assert found.spool == pytest.approx(0.04 * lag, rel=1e-3)
    assert found.force < 0.01
    text = " ".join(explain_effect(loop, found, p))
    assert "within its dead zone of 0.05" in text
    assert "80 Hz bandwidth" in text


def test_a_triangle_moves_what_its_fundamental_does() -> None:
    drive, p = r25(lugre=False)
    found = []
    for shape in Waveform:
        loop = ClosedLoop(drive.system(), PID(), Dither(20.0, waveform=shape), measured="speed")
        given = (loop.parameters | p).with_values({"dither.amplitude": 1e-3})
        found.append(dither_effect(loop, Step(1e-6), given).force)
    assert found[1] == pytest.approx(8 / pi**2 * found[0], rel=1e-4)


@pytest.mark.parametrize(("amplitude", "offset", "cut"), [(4.0, 0.5, False), (4.0, 1.5, True), (6.0, 0.0, True)])
def test_a_dither_beyond_the_commands_limits_is_said_to_be_cut(amplitude: float, offset: float, cut: bool) -> None:
    loop, p = paper()
    given = p.with_values({"dither.amplitude": amplitude, "dither.offset": offset})
    text = " ".join(explain_effect(loop, DitherEffect(amplitude, 160.0), given))
    assert ("the peaks are cut" in text) == cut


def test_the_valves_own_span_counts_too() -> None:
    loop, p = paper()
    given = p.with_values({"pid.lower": -20.0, "pid.upper": 20.0, "dither.amplitude": 6.0})
    assert "the valve ends at -5 and 5 V" in " ".join(explain_effect(loop, DitherEffect(6.0, 160.0), given))


def test_a_rotary_axis_swings_in_radians() -> None:
    loop = ClosedLoop(RotaryDrive(), PID(), Dither(100.0), measured="speed")
    p = loop.parameters.with_values({"dither.amplitude": 0.1})
    text = " ".join(explain_effect(loop, DitherEffect(0.1, 100.0, speed=0.4, travel=0.0006), p))
    assert "a moving axis swings by +-0.4 rad/s and +-0.6 mrad" in text


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


def test_dither_through_a_dead_zone_helps_and_has_a_price() -> None:
    loop, p = coarse(0.5, 60.0)
    verdict = judge_dither(loop, STEP, p, band=0.05)
    assert verdict.usefulness is Usefulness.HELPS_THESE_GAINS
    assert "gains tuned without dither may do as well: none were compared" in str(verdict)
    assert verdict.table["with"]["IAE"] < 0.9 * verdict.table["without"]["IAE"]
    assert verdict.table["with"]["ValveTravel"] > 3 * verdict.table["without"]["ValveTravel"]
    assert "price: ripple" in str(verdict)
    assert "dead zone of 0.05" in str(verdict)


def test_dither_that_swings_the_piston_by_more_than_the_step_is_harmful() -> None:
    loop, p = coarse(4.0, 10.0)
    verdict = judge_dither(loop, STEP, p, band=0.05)
    assert verdict.usefulness is Usefulness.HARMFUL
    assert "from peak to peak" in verdict.reasons[0]


def test_the_design_without_may_be_another_one() -> None:
    loop, p = paper(amplitude=1e-3)
    slow = p.with_values({"pid.Kp": 1.0, "pid.Ki": 2.0})
    verdict = judge_dither(loop, Step(0.05, horizon=0.5), p, without=slow)
    assert "against gains tuned without it" in str(verdict)
    assert verdict.table["without"]["IAE"] > verdict.table["with"]["IAE"]


def sticky(measured: str, amplitude: float, frequency: float, **gains: float) -> tuple[ClosedLoop, ParameterSet]:
    """Five kilograms on seals that stick: 70 N to break away, 40 N while sliding."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(), Dither(frequency), measured=measured)
    friction = {"coulomb": 40.0, "static": 70.0, "stribeck_velocity": 0.02, "viscous": 80.0, "smoothing": 2e-3}
    values = {f"friction.{n}": v for n, v in friction.items()} | {f"pid.{n}": v for n, v in gains.items()}
    return loop, loop.parameters.with_values({"load.mass": 5.0, **values, "dither.amplitude": amplitude})


def crawling(amplitude: float) -> tuple[ClosedLoop, ParameterSet]:
    """A speed loop whose gains are too small for its friction's falling slope."""
    loop, p = sticky("speed", amplitude, 100.0, Kp=150.0, Ki=2000.0)
    return loop, p.with_values({"friction.viscous": 20.0})


def brisk(amplitude: float) -> tuple[ClosedLoop, ParameterSet]:
    return sticky("speed", amplitude, 50.0, Kp=400.0, Ki=8000.0)


def positioning(amplitude: float, Ki: float = 0.0) -> tuple[ClosedLoop, ParameterSet]:
    return sticky("position", amplitude, 50.0, Kp=4000.0 if Ki else 2000.0, Ki=Ki, Kd=150.0 if Ki else 100.0, Tf=0.004)


def turning(amplitude: float) -> tuple[ClosedLoop, ParameterSet]:
    """A servo on a gear that sticks: .5 N m to break away, .3 N m while it turns."""
    loop = ClosedLoop(RotaryDrive(Stribeck()), PID(), Dither(50.0), measured="angle")
    friction = {"coulomb": 0.3, "static": 0.5, "stribeck_velocity": 0.2, "viscous": 0.05, "smoothing": 0.02}
    gains = {"pid.Kp": 10.0, "pid.Kd": 0.3, "pid.Tf": 0.004, "dither.amplitude": amplitude}
    return loop, loop.parameters.with_values({**{f"friction.{n}": v for n, v in friction.items()}, **gains})


class Case(NamedTuple):
    """A design with dither, its step, the verdict against the same gains without, and a reason that the text gives."""

    design: Callable[[], tuple[ClosedLoop, ParameterSet]]
    step: Step
    expected: Usefulness
    reason: str


CASES = {
    # a short horizon shows no motion; over two seconds it hunts with the dither and without
    "hunts beyond the horizon": Case(
        lambda: crawling(10.0), Step(0.02, horizon=0.4), Usefulness.USELESS, "nothing changes: it still hunts"
    ),
    # without dither it settles beyond the horizon; with it the loop goes to a standstill every .4 s
    "makes it hunt": Case(lambda: crawling(100.0), Step(0.05, horizon=0.3), Usefulness.HARMFUL, "worse: largest error"),
    # the body leaves its standstill a little earlier, and then shakes by 8 % of the step for good
    "an earlier start": Case(
        lambda: crawling(20.0), Step(0.08, horizon=0.3), Usefulness.HARMFUL, "worse: settling time, ripple included"
    ),
    "cures crawl by a swing of twice the speed": Case(
        lambda: crawling(100.0), Step(0.02, horizon=0.4), Usefulness.HARMFUL, "worse: the dither swings speed"
    ),
    "ripples by 83 % of the step": Case(
        lambda: brisk(100.0), Step(0.15, horizon=0.5), Usefulness.HARMFUL, "only the mean settles, in 0.181 s"
    ),
    "next to nothing, from motion": Case(
        lambda: brisk(1e-3), Step(0.15, initial=0.05, horizon=0.5), Usefulness.USELESS, "nothing changes"
    ),
    # it hunts about the reference by 40 % of the step as the integral and the seals take turns
    "cures hunting in position": Case(
        lambda: positioning(100.0, 40000.0), Step(0.01, horizon=0.4), Usefulness.HELPS_THESE_GAINS, "better: largest"
    ),
    "frees a position that sticks": Case(
        lambda: positioning(100.0), Step(0.01, horizon=0.4), Usefulness.HELPS_THESE_GAINS, "better: largest error"
    ),
    "too weak for a position that sticks": Case(
        lambda: positioning(1.0), Step(0.01, horizon=0.4), Usefulness.USELESS, "nothing changes"
    ),
    "frees a servo that sticks": Case(
        lambda: turning(1.0), Step(1.0, horizon=0.4), Usefulness.HELPS_THESE_GAINS, "better: settling time, ripple"
    ),
}


@pytest.mark.parametrize(
    ("rival", "expected"),
    [
        (None, Usefulness.HELPS_THESE_GAINS),
        ({"pid.Kp": 1000.0}, Usefulness.USEFUL),
        ({"pid.Kp": 5e5, "pid.Kd": 3000.0, "pid.Tf": 1e-3}, Usefulness.HARMFUL),
    ],
)
def test_the_rival_decides(rival: dict[str, float] | None, expected: Usefulness) -> None:
    """A dither frees a position that sticks at 57 % of the step; so does a stiff PID without dither, and faster."""
    loop, p = positioning(100.0)
    verdict = judge_dither(loop, Step(0.01, horizon=0.4), p, without=None if rival is None else p.with_values(rival))
    assert verdict.usefulness is expected
    assert verdict.baseline == ("the same gains without it" if rival is None else "gains tuned without it")


def test_a_hunting_loop_is_judged_by_its_largest_error_in_the_last_cycles() -> None:
    """Not by the instant at which the horizon ends, where it is 36 % off on its way through the reference."""
    loop, p = positioning(100.0, 40000.0)
    table = judge_dither(loop, Step(0.01, horizon=0.4), p).table
    assert table["without"]["SteadyStateError"] == pytest.approx(40.6, abs=1.0)
    assert table["without"]["SettlingTime"] == np.inf


@pytest.mark.parametrize("frequency", [0.5, 5.0, 400.0])
def test_cycles_shorter_than_the_dithers_period_have_an_end_too(frequency: float) -> None:
    """Means end half a period before the record; three cycles at 400 Hz fit into that half period."""
    t = np.linspace(0.0, 2.0, 2001)
    response = SimpleNamespace(t=t, times=t[t <= 1.9875], period=0.025)
    hunting: Any = SimpleNamespace(
        response=response, cycle=SimpleNamespace(frequency=frequency), stands=False, drifts=False
    )
    assert begin_of_end(hunting) <= response.times[-1] - min(2.0, 3 / frequency) + 1e-3


@pytest.mark.parametrize("name", CASES)
def test_each_case_gets_the_verdict_that_it_deserves(name: str) -> None:
    design, step, expected, reason = CASES[name]
    loop, p = design()
    verdict = judge_dither(loop, step, p)
    assert verdict.usefulness is expected, str(verdict)
    assert reason in str(verdict)


def test_another_plant_is_judged_by_its_response_alone() -> None:
    plant = SecondOrder().system()
    loop = ClosedLoop(plant, PID(), Dither(100.0))
    p = loop.parameters.with_values({"pid.Kp": 0.5, "dither.amplitude": 1e-4})
    verdict = judge_dither(loop, Step(1.0, horizon=1.0), p)
    assert verdict.usefulness is Usefulness.USELESS
    assert np.isnan(verdict.effect.force)


RUBBING_STEP = Step(0.1, horizon=0.5)
RUBBING_GAINS = {"pid.Kp": 120.0, "pid.Ki": 300.0}


def rubbing(**sizes: float) -> tuple[ClosedLoop, ParameterSet]:
    """A mass with Coulomb friction, whose level the inverse of a dead zone adds to the force."""
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(1e-3), compensators=(DeadZoneInverse(),))
    return loop, loop.parameters.with_values(RUBBING_GAINS | {f"dead_zone_inverse.{n}": v for n, v in sizes.items()})


def test_what_friction_takes_is_useful_where_it_is_given_back() -> None:
    loop, p = rubbing(width=18.0, smoothing=1.0)
    found = judge_compensators(loop, RUBBING_STEP, p)
    assert found.usefulness is Usefulness.HELPS_THESE_GAINS
    assert float(found.table["with"]["SettlingTime"]) < 0.8 * float(found.table["without"]["SettlingTime"])
    assert str(found).splitlines()[0] == (
        "the dead zone inverse is useful with these gains, against the same gains without it"
    )
    assert any(reason.startswith("price: ") for reason in found.reasons)


def test_against_gains_that_need_none_it_is_not() -> None:
    loop, p = rubbing(width=18.0, smoothing=1.0)
    strong = p.with_values({"pid.Kp": 900.0, "pid.Ki": 9000.0})
    found = judge_compensators(loop, RUBBING_STEP, p, without=strong)
    assert found.usefulness is Usefulness.HARMFUL
    assert found.baseline == "gains tuned without it"


def test_one_of_size_zero_is_useless() -> None:
    loop, p = rubbing(width=0.0)
    assert judge_compensators(loop, RUBBING_STEP, p).usefulness is Usefulness.USELESS
