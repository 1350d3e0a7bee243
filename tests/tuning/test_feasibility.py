"""What no gains can mend is refused before anything is searched for, with the number and the remedy."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID
from pneuopt.control.reference import Reference, Step
from pneuopt.control.sensor import Encoder
from pneuopt.evaluation.evaluate import respond
from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.requirements import (
    IAE,
    FollowingError,
    NoiseGain,
    Overshoot,
    PeakControl,
    Requirement,
    RiseTime,
    SettlingTime,
    SteadyStateError,
    StepEnvelope,
)
from pneuopt.evaluation.response import cases
from pneuopt.evaluation.scenarios import NO_SCENARIOS
from pneuopt.evaluation.specification import specify
from pneuopt.models.catalog import s32, t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.feasibility import check_feasibility
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import prepare_task, tune

FREE = {"pid.Kp": (1.0, 40.0), "pid.Ki": (5.0, 200.0)}
CLIP = {"pid.lower": -5.0, "pid.upper": 5.0}
BRIEF = Racing(members=5, trials=1, bands=(), polish=0)


def cylinder(**dither: Any) -> tuple[ClosedLoop, ParameterSet]:
    """A stroke of 200 mm, resting in its middle."""
    loop = ClosedLoop(PneumaticDrive(friction=Stribeck()).system(), PID(sample_time=1e-3), Dither(**dither))
    return loop, loop.parameters.with_values({"pid.Kp": 5.0, "pid.Ki": 20.0, **CLIP}).with_bounds(FREE).freed(*FREE)


def lag(gain: float = 1.0) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-2))
    given = loop.parameters.with_values({"plant.gain": gain, "pid.Kp": 2.0, "pid.Ki": 10.0, **CLIP})
    return loop, given.with_bounds(FREE).freed(*FREE)


def refusal(
    model: tuple[ClosedLoop, ParameterSet],
    step: Reference,
    limits: Sequence[Requirement] = (),
    minimise: Requirement | None = None,
) -> str:
    loop, given = model
    asked = minimise or SettlingTime()
    with pytest.raises(InputError) as error:  # before the search: it says nothing
        tune(loop, step, given, minimise=asked, subject_to=limits, method=BRIEF, progress=pytest.fail)
    return str(error.value)


def test_a_stroke_too_short_names_the_horizon_that_fits() -> None:
    words = refusal(cylinder(), Step(0.4, at=0.1, horizon=0.6))
    assert "reference 0 to 0.4: it leads the piston over 200 mm" in words
    assert "from position 100 mm to the front end stop there are 99.9 mm; end it by horizon = 0.35 s" in words
    assert "rear end stop" in refusal(cylinder(), Step(-0.4, horizon=0.6))


def test_what_fits_the_stroke_is_not_refused() -> None:
    loop, given = cylinder()
    tune(loop, Step(0.4, at=0.1, horizon=0.349), given, minimise=IAE(), method=BRIEF, throw=False)


def test_a_speed_beyond_the_valve_names_the_fastest() -> None:
    """The fastest that is named can be held, and what is 2 % faster than the band allows cannot."""
    loop, given = cylinder()
    words = refusal((loop, given), Step(9.0, horizon=0.011))
    assert "supply.pressure = 701325 Pa(a)" in words
    fastest = float(words.rpartition("held is ")[2].split()[0])
    low, high = (loop.initial(given, reference=v * fastest)[:1] if v < 1 else v for v in (0.99, 1.03))
    assert np.isfinite(low).all()
    with pytest.raises(InputError, match="no steady motion"):
        loop.initial(given.with_values({"pid.lower": -np.inf, "pid.upper": np.inf}), reference=float(high) * fastest)


def test_a_command_beyond_the_clip_or_the_limit_is_named() -> None:
    """A lag of gain 1 needs as much command as it shall show."""
    words = refusal(lag(), Step(8.0))
    assert "holding 7.84 m/s takes 7.84 V, the controller's limits are -5 and 5 V" in words
    assert "the most that can be held is 5 m/s" in words
    words = refusal(lag(), Step(4.0), [PeakControl(3.0)])
    assert "holding 3.92 m/s takes 3.92 V, PeakControl allows 3 V; take a smaller step, or raise it" in words
    assert "the most that can be held is 3 m/s" in words


def test_a_plant_whose_drift_counters_a_slow_command_keeps_its_sign() -> None:
    """Under dither the mean force on a cylinder changes with its position: at low frequency the speed leads.

    Gains that were tuned are a start like others, and gains of the other sign are still refused.
    """
    drive, rig = s32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), Dither(100.0), measured="speed")
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    start = {"supply.pressure": 7.01325e5, "load.mass": 5.0, "dither.amplitude": 0.9, "pid.Kp": 2.4, "pid.Ki": 100.0}
    given = (rig.fixed("*") | own).with_values(start | {"pid.lower": -5.0, "pid.upper": 5.0})
    gains = given.with_bounds({"pid.Kp": (0.2, 60.0), "pid.Ki": (0.5, 400.0)}).freed("pid.Kp", "pid.Ki")
    prepare_task(loop, Step(0.1, horizon=0.8), gains, specify(SettlingTime()))
    turned = given.with_values({"pid.Kp": -2.4, "pid.Ki": -100.0})
    turned = turned.with_bounds({"pid.Kp": (-60.0, -0.2), "pid.Ki": (-400.0, -0.5)}).freed("pid.Kp", "pid.Ki")
    with pytest.raises(InputError, match="every gain allowed makes the loop unstable"):
        prepare_task(loop, Step(0.1, horizon=0.8), turned, specify(SettlingTime()))


def test_a_drift_slower_than_the_horizon_does_not_turn_the_sign() -> None:
    """Under this dither the cylinder drifts away at .015 rad/s: slower still, its speed falls with the voltage."""
    drive, rig = t32()
    loop = ClosedLoop(drive.system(), PID(), Dither(frequency=1000 / (2 * math.pi)))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    start = {"pid.Kp": 2.335, "pid.Ki": 118.7, "dither.amplitude": 2.097, "dither.offset": -0.2097}
    given = (rig.fixed("*") | own).with_values(start | {"pid.lower": -5.0, "pid.upper": 5.0})
    gains = given.with_bounds({"pid.Kp": (0.2, 60.0), "pid.Ki": (0.5, 400.0)}).freed("pid.Kp", "pid.Ki")
    step = Step(0.2, horizon=1.0, start={"position": 0.05, "pressure_b": 3.5e5})
    prepare_task(loop, step, gains, specify(SettlingTime()))


@pytest.mark.parametrize("position", [0.08, 0.42])
@pytest.mark.parametrize("amplitude", [0.3, 1.0])
def test_a_drift_within_the_horizon_does_not_turn_the_sign(position: float, amplitude: float) -> None:
    """Near either end of the stroke, under dither, the position drifts away, or comes back, within a few seconds."""
    drive, rig = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), Dither(60.0))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    hardware = {"valve.dead_zone": 0.05, "friction.coulomb": 10.0, "friction.static": 14.0}
    start = {"pid.Kp": 2.0, "pid.Ki": 20.0, "dither.amplitude": amplitude, "pid.lower": -5.0, "pid.upper": 5.0}
    given = (rig.fixed("*") | own).with_values(hardware | start)
    gains = given.with_bounds({"pid.Kp": (0.2, 30.0), "pid.Ki": (0.5, 300.0)}).freed("pid.Kp", "pid.Ki")
    for speed in (0.05, -0.05):
        step = Step(speed, horizon=0.8, start={"position": position})
        prepare_task(loop, step, gains, specify(SettlingTime()))


def test_a_dither_above_the_sampling_limit_is_refused_by_its_upper_bound() -> None:
    loop, given = cylinder(frequency=100.0)
    wide = given.with_values({"dither.amplitude": 0.5})
    free = wide | ParameterSet({"dither.frequency": replace(wide["dither.frequency"], lower=50.0, upper=900.0)})
    words = refusal((loop, free.freed("dither.frequency")), Step(0.2, horizon=0.3))
    assert "900 Hz cannot be sampled every 1 ms: it must lie below the Nyquist frequency 500 Hz" in words


def counted(amplitude: float = 0.0, measured: str = "position") -> tuple[ClosedLoop, ParameterSet, Step]:
    """A body seen in counts of 1 mm, or their differences, that is to stay within a band of a step of 20."""
    loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), Dither(20.0), measured=measured, sensor=Encoder(1e-3))
    given = loop.parameters.with_values(
        {"pid.Kp": 100.0, "pid.Kd": 20.0, "pid.Tf": 0.01, "dither.amplitude": amplitude}
    )
    return loop, given.with_bounds({"pid.Kp": (50.0, 200.0)}).freed("pid.Kp"), Step(0.02, horizon=0.4)


def check(model: tuple[ClosedLoop, ParameterSet, Step], asked: Requirement) -> None:
    loop, given, step = model
    space, spec = search_space(loop, given), specify(asked)
    check_feasibility(loop, cases([step], NO_SCENARIOS, space.parameters, space.names), space, spec)


def test_a_band_below_half_a_count_is_refused() -> None:
    loop, given, step = counted()
    words = refusal((loop, given), step, minimise=SettlingTime(band=0.02))
    assert "reference 0 to 0.02: the settling band of +-0.4 mm is narrower than half the encoder's count of 1" in words
    assert "cannot tell inside from outside; take band = 0.025 or more, a larger step or a finer" in words
    assert "narrower than half" in refusal((loop, given), step, [SettlingTime(0.02, max=0.1)], IAE())
    check((loop, given, step), SettlingTime(band=0.025))
    finer = given | ParameterSet({"sensor.resolution": replace(given["sensor.resolution"], value=8e-4)})
    check((loop, finer, step), SettlingTime(band=0.02))


def test_settling_before_the_reference_may_is_refused() -> None:
    """Half way, at 25 ms, a move of 20 mm lacks 10 mm, which band and following error have to make up for."""
    loop, given, step = counted()
    move = Move(0.02, speed=1.0, acceleration=32.0, dwell=0.4)
    assert move.values(np.array([0.025]))[0] == pytest.approx(0.01)
    band = Tolerance(1e-3)
    words = refusal((loop, given), move, [SettlingTime(band, max=0.025), FollowingError(8e-3)], IAE())
    assert (
        "reference 0 to 0.02 in 0.05 s: SettlingTime: max 0.025 s comes when the reference still lacks 10 mm" in words
    )
    assert "more than the band and FollowingError's max 8 mm; raise one of them, or speed and acceleration" in words
    space = search_space(loop, given)
    spec = specify(IAE(), [SettlingTime(band, max=0.025), FollowingError(9.1e-3)])
    check_feasibility(loop, cases([move], NO_SCENARIOS, space.parameters, space.names), space, spec)
    words = refusal((loop, given), step, [FollowingError(5e-3)], SettlingTime(band=0.05))
    assert "FollowingError: max 5 mm is less than the step of 20 mm, its error at once; follow a move instead" in words


def test_the_band_that_is_named_is_wide_enough() -> None:
    loop, given, _ = counted()
    for size in (0.0123, -0.0277, 0.0099, 0.6e-3):
        words = refusal((loop, given), Step(size, horizon=0.4), minimise=SettlingTime(band=1e-3))
        wide = float(words.partition("take band = ")[2].split()[0])
        assert wide == pytest.approx(0.5e-3 / abs(size), rel=0.01)
        check((loop, given, Step(size, horizon=0.4)), SettlingTime(band=wide))
    assert "outside; take a larger step" in refusal((loop, given), Step(3e-4, horizon=0.4))


def test_a_band_below_half_a_count_is_not_refused_where_it_may_be_kept() -> None:
    """A ripple shows what lies between counts, many samples a speed; and who asks for no settling needs no band."""
    check(counted(1.0), SettlingTime())
    check(counted(), IAE())
    check((*counted(measured="speed")[:2], Step(1.0, horizon=0.4)), SettlingTime())


TUBE = ((0.0, -0.1, 1.5), (0.5, 0.7, 0.9))
CONTRADICTIONS: dict[str, tuple[list[Requirement], str]] = {
    "settling after the record": ([SettlingTime(max=2.0)], "SettlingTime: max 2 s is more than 1 s after the step can"),
    "rise after the record": ([RiseTime(3.0)], "lengthen its horizon to 3.158 s, or lower max"),
    "tube off the band": ([StepEnvelope(TUBE)], "from 0.5 s on the bounds are 0.7 to 0.9, SettlingTime asks for 1 to"),
    "tube off the start": ([StepEnvelope(((0.0, 0.5, 1.1),))], "at the step itself the bounds are 0.5 to 1.1, but"),
    "tube above the overshoot": (
        [StepEnvelope(((0.0, -0.1, 1.5), (0.5, 1.01, 1.3))), Overshoot(0.001), SteadyStateError(0.5)],
        "from 0.5 s on the lower bound is 1.01, Overshoot allows 1.001",
    ),
    "tube after the record": ([StepEnvelope(((2.0, 0.9, 1.1),))], "begins 2 s after the step, the record of"),
    "noise below the least gain": (
        [NoiseGain(0.5)],
        "max 0.5 is below |Kp + Kd/Tf|, at least 1 within the gains' bounds",
    ),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradictory_limits_are_named_with_their_numbers(case: str) -> None:
    limits, message = CONTRADICTIONS[case]
    assert message in refusal(lag(), Step(1.0), limits)


def test_a_derivative_against_the_proportional_gain_may_keep_a_noise_limit() -> None:
    """At high frequency they add up to ``|Kp + Kd/Tf|``, which is zero where they have opposite signs."""
    loop, given = lag()
    bounds = {"pid.Kp": (1.0, 4.0), "pid.Kd": (-0.1, -0.01)}
    opposed = given.with_values({"pid.Kd": -0.02, "pid.Tf": 0.01}).with_bounds(bounds).freed(*bounds)
    space = search_space(loop, opposed)
    check_feasibility(
        loop, cases([Step(1.0)], NO_SCENARIOS, space.parameters, space.names), space, specify(IAE(), [NoiseGain(0.5)])
    )
    alike = given.with_values({"pid.Kd": 0.05}).with_bounds({**bounds, "pid.Kd": (0.01, 0.1)}).freed(*bounds)
    assert "is below |Kp + Kd/Tf|, at least" in refusal((loop, alike), Step(1.0), [NoiseGain(0.5)])


def test_a_start_that_never_settles_is_reported_and_searched_from() -> None:
    """Kp of 40 oscillates at 10 ms of sampling: a lag of 0.1 s allows about 20."""
    loop, given = lag()
    lines = list[str]()
    wild = given.with_values({"pid.Kp": 39.0, "plant.time_constant": 0.1})
    run = respond(loop, Step(1.0), wild)
    assert run["speed"][-50:].std() > 0.01
    method = Racing(members=8, trials=40)
    best = tune(loop, Step(1.0), wild, minimise=SettlingTime(), method=method, progress=lines.append)
    assert lines[0] == "with the given gains the loop never settles at 0 to 1, 1 of 1 cases; searching on"
    assert best.certified.loc["SettlingTime"].max() < 0.5
