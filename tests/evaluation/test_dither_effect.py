"""What a dither moves: golden numbers, lag, dead zone, clipping, and the sentences on them."""

from math import pi

import pytest

from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.dither_effect import DitherEffect, dither_effect, explain_effect
from pneuopt.models.catalog import r25, t32
from pneuopt.models.rotary import RotaryDrive
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
