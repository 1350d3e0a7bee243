"""What no gains within the bounds can do is refused before a search, an unstable loop only where that is proved."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import cont2discrete

from pneuopt.control.compensators import DeadZoneInverse
from pneuopt.control.controller import PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID, Form
from pneuopt.control.reference import Reference, Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import System, define
from pneuopt.evaluation.evaluate import respond
from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.requirements import (
    IAE,
    FollowingError,
    MaxSensitivity,
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
from pneuopt.models.friction import LuGre, Stribeck, Viscous
from pneuopt.models.linear import FirstOrder, Integrator
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet, Quantity
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
    best = tune(loop, Step(1.0), wild, minimise=SettlingTime(), method=method, plants={}, progress=lines.append)
    assert lines[0] == "with the given gains the loop never settles at 0 to 1, 1 of 1 cases; searching on"
    assert best.certified.loc["SettlingTime"].max() < 0.5


Bounds = Mapping[str, tuple[float, float]]
Transfer = tuple[NDArray[np.float64], NDArray[np.float64]]
PI = {"pid.Kp": (1.0, 40.0), "pid.Ki": (5.0, 200.0)}
TURN, ACTUATOR = "turn the sign of the gains' bounds", "turn the sign of the actuator"
TURN_BOTH = f"{TURN}, or {ACTUATOR}"


def plant(numerator: Sequence[float], denominator: Sequence[float]) -> System:
    """A transfer function in controllable canonical form, strictly proper."""
    lead, n = denominator[0], len(denominator) - 1
    a = [c / lead for c in denominator[1:]][::-1]
    b = [c / lead for c in [0.0] * (n - len(numerator)) + list(numerator)][::-1]
    states = [Quantity(f"x{k}", "1") for k in range(n)]

    def rhs(_t: object, x: Mapping[str, object], u: Mapping[str, object], _p: object) -> tuple[dict, dict]:  # type: ignore[type-arg]
        x_all = [x[q.name] for q in states]
        last = u["u"] - sum(c * q for c, q in zip(a, x_all, strict=True))  # type: ignore[operator,misc]
        rates = {q.name: v for q, v in zip(states, [*x_all[1:], last], strict=True)}
        return rates, {"y": sum(c * q for c, q in zip(b, x_all, strict=True))}  # type: ignore[operator,misc]

    return define(states, [Quantity("u", "1")], [Quantity("y", "1")], ParameterSet(), rhs)


def sign_refusal(loop: ClosedLoop, bounds: Bounds, step: Step | None = None, **given: float) -> str:
    """What is said before the search; empty where nothing is refused."""
    values = {n.replace("_", ".", 1): v for n, v in given.items()}
    middle = {n: 0.5 * (low + up) for n, (low, up) in bounds.items()}
    p = loop.parameters.with_values(values | middle).with_bounds(bounds).freed(*bounds)
    try:
        prepare_task(loop, step or Step(1.0, horizon=2.0), p, specify(SettlingTime()))
    except InputError as error:
        if "every gain allowed makes the loop unstable" not in str(error):
            raise
        return str(error)
    return ""


def turned(bounds: Bounds) -> Bounds:
    return {n: (-up, -low) for n, (low, up) in bounds.items()}


@pytest.mark.parametrize("sample_time", [None, 1e-2])
@pytest.mark.parametrize("gain", [1.0, -2.0])
def test_the_wrong_sign_is_refused_and_the_right_one_is_not(gain: float, sample_time: float | None) -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time))
    right = PI if gain > 0 else turned(PI)
    assert sign_refusal(loop, right, plant_gain=gain) == ""
    words = sign_refusal(loop, turned(right), plant_gain=gain)
    low, high = turned(right)["pid.Kp"]
    assert f"pid.Kp within [{low:g}, {high:g}], pid.Ki within" in words
    assert "linearised at 1 m/s, where the reference ends" in words
    assert words.endswith(TURN_BOTH)


def test_the_growth_that_is_named_is_the_slowest_of_all_gains() -> None:
    """``1/s`` with Kp from -5 to -2 has its pole at 2 1/s or beyond: a deviation grows e-fold in .5 s or less."""
    loop = ClosedLoop(Integrator().system(), PID(limits=False))
    words = sign_refusal(loop, {"pid.Kp": (-5.0, -2.0)})
    named = float(words.partition("e-fold in ")[2].split()[0])
    assert named == pytest.approx(0.5, rel=0.01)


def test_a_small_gain_of_the_wrong_sign_leaves_a_stable_plant_stable() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    assert sign_refusal(loop, {"pid.Kp": (-0.9, -0.1)}) == ""
    assert sign_refusal(loop, {"pid.Kp": (-40.0, -0.1)}) == ""
    assert sign_refusal(loop, {"pid.Kp": (-40.0, -1.5)}).endswith(TURN_BOTH)
    assert sign_refusal(loop, {"pid.Kp": (-40.0, -0.1), "pid.Ki": (-10.0, 10.0)}) == ""


UNSTABLE: dict[str, tuple[System, Bounds, Bounds]] = {  # the plant, gains that hold it, gains that cannot
    "one unstable pole": (plant([2.0], [0.05, 0.975, -1.0]), {"pid.Kp": (1.0, 20.0)}, {"pid.Kp": (-20.0, 0.4)}),
    "with an integral": (plant([1.0], [1.0, -2.0]), {"pid.Kp": (3.0, 9.0), "pid.Ki": (0.5, 5.0)}, turned(PI)),
    "two unstable poles": (
        plant([1.0], [1.0, -3.0, 2.0]),
        {"pid.Kp": (1.0, 90.0), "pid.Kd": (0.0, 20.0)},
        {"pid.Kp": (-90.0, -3.0), "pid.Kd": (-20.0, 0.0)},
    ),
    "two that swing": (plant([1.0, 4.0], [1.0, -1.0, 9.0]), {"pid.Kp": (0.1, 30.0)}, {"pid.Kp": (-30.0, -3.0)}),
    "a zero beyond the pole": (
        plant([-1.0, 8.0], [0.01, 0.99, -1.0]),
        {"pid.Kp": (0.05, 0.9)},
        {"pid.Kp": (-0.9, -0.05)},
    ),
    "a pendulum": (
        plant([1.0], [1.0, 0.1, -9.81]),
        {"pid.Kp": (1.0, 90.0), "pid.Ki": (0.0, 90.0), "pid.Kd": (0.0, 20.0)},
        {"pid.Kp": (-90.0, 9.0), "pid.Kd": (-20.0, 20.0)},
    ),
    "two integrals": (
        plant([3.0], [1.0, 0.0, 0.0]),
        {"pid.Kp": (1.0, 9.0), "pid.Kd": (1.0, 9.0)},
        {"pid.Kp": (-9.0, -1.0), "pid.Kd": (1.0, 9.0)},
    ),
    "an integral and a zero": (plant([-1.0, 1.0], [1.0, 1.0, 0.0]), {"pid.Kp": (0.1, 0.9)}, {"pid.Kp": (-9.0, -0.1)}),
    "falling friction's slope": (plant([1.0], [5.0, -300.0]), {"pid.Kp": (50.0, 900.0)}, {"pid.Kp": (1.0, 250.0)}),
}


@pytest.mark.parametrize("case", UNSTABLE)
@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_plants_that_run_away_or_integrate(case: str, sample_time: float | None) -> None:
    system, right, wrong = UNSTABLE[case]
    loop = ClosedLoop(system, PID(sample_time, limits=False))
    assert sign_refusal(loop, right) == ""
    assert sign_refusal(loop, wrong) != ""


def test_gains_too_small_for_an_unstable_plant_are_not_told_to_turn() -> None:
    loop = ClosedLoop(plant([1.0], [1.0, -2.0]), PID(limits=False))
    words = sign_refusal(loop, {"pid.Kp": (0.1, 1.5)})
    assert words.endswith("widen the gains' bounds, for some gains ten times as large hold the loop")
    assert sign_refusal(loop, {"pid.Kp": (0.01, 0.015)}).endswith(
        "neither turned signs nor gains ten times as large hold it"
    )
    loop = ClosedLoop(plant([1.0], [1.0, 1.0]), PID(limits=False))
    assert sign_refusal(loop, {"pid.Ki": (-9.0, -2.0)}, pid_Kp=3.0).endswith(
        f"; {TURN}"
    )  # the actuator turns Kp as well


@pytest.mark.parametrize(("form", "gain"), [(Form.STANDARD, "pid.Kp"), (Form.SERIES, "pid.K")])
def test_the_gains_of_every_form_have_a_sign(form: Form, gain: str) -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(2e-3, form=form))
    times = {"pid.Ti": (0.02, 1.0), "pid.Td": (1e-3, 0.1)}
    assert sign_refusal(loop, {gain: (1.0, 30.0), **times}) == ""
    assert sign_refusal(loop, {gain: (-30.0, -1.0), **times}).endswith(TURN_BOTH)


FALLING = {"load.mass": 5.0, "friction.coulomb": 25.0, "friction.static": 45.0, "friction.stribeck_velocity": 0.02}
SPEED_GAINS = {"pid.Kp": (50.0, 5000.0), "pid.Ki": (100.0, 1e5)}


@pytest.mark.parametrize("friction", [Stribeck(), LuGre()])
@pytest.mark.parametrize("speed", [0.006, 0.02, 0.2, -0.02])
def test_crawl_does_not_turn_the_sign(friction: Stribeck | LuGre, speed: float) -> None:
    loop = ClosedLoop(ForceDrive(friction), PID(1e-3, limits=False))
    step = Step(speed, horizon=0.8)
    own = {n.replace(".", "_", 1): v for n, v in FALLING.items()}
    assert sign_refusal(loop, SPEED_GAINS, step, **own) == ""
    assert TURN_BOTH in sign_refusal(loop, turned(SPEED_GAINS), step, **own)


def test_a_free_dither_that_stabilises_crawl_counts() -> None:
    """Without dither these gains are too small for the falling friction; dither turns its slope."""
    bounds = {"pid.Kp": (1.0, 5.0), "pid.Ki": (1.0, 10.0)}
    own = {n.replace(".", "_", 1): v for n, v in FALLING.items()} | {"friction_viscous": 60.0, "pid_Tf": 0.01}
    step, drive = Step(0.02, horizon=0.8), ForceDrive(Stribeck())
    dithered = ClosedLoop(drive, PID(1e-3, limits=False), Dither(20.0))
    assert "every gain" in sign_refusal(ClosedLoop(drive, PID(1e-3, limits=False)), bounds, step, **own)
    assert "every gain" in sign_refusal(dithered, bounds, step, **own)
    assert sign_refusal(dithered, {**bounds, "dither.amplitude": (0.0, 200.0)}, step, **own) == ""


def test_a_drift_that_no_gains_remove_is_not_the_gains_fault() -> None:
    """Under dither a piston near an end of its stroke drifts, e-fold in minutes, where no integral holds its speed."""
    drive, rig = t32()
    loop = ClosedLoop(drive.system(), PID(1e-3), Dither(60.0))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    hardware = {"valve.dead_zone": 0.05, "friction.coulomb": 10.0, "friction.static": 14.0}
    start = {"pid.Kp": 2.0, "pid.Ki": 0.0, "dither.amplitude": 0.3, "pid.lower": -5.0, "pid.upper": 5.0}
    given = (rig.fixed("*") | own).with_values(hardware | start).with_bounds({"pid.Kp": (0.2, 30.0)}).freed("pid.Kp")
    prepare_task(loop, Step(0.05, horizon=0.8, start={"position": 0.42}), given, specify(SettlingTime()))


def test_a_loop_that_may_rest_elsewhere_is_not_judged_at_the_reference() -> None:
    """A P controller that is too weak for the falling friction at 20 mm/s may rest below; a linear plant cannot."""
    step, limits = Step(0.02, horizon=0.8), [SteadyStateError(0.9)]
    falling = ClosedLoop(ForceDrive(Stribeck()), PID(1e-3, limits=False))
    given = (
        falling.parameters.with_values(FALLING | {"pid.Kp": 5.0}).with_bounds({"pid.Kp": (1.0, 9.0)}).freed("pid.Kp")
    )
    prepare_task(falling, step, given, specify(IAE(), limits))
    with pytest.raises(InputError, match="every gain allowed makes the loop unstable"):
        prepare_task(falling, step, given, specify(SettlingTime(), limits))
    linear = ClosedLoop(plant([1.0], [1.0, -2.0]), PID(limits=False))
    given = linear.parameters.with_values({"pid.Kp": 1.0}).with_bounds({"pid.Kp": (0.1, 1.5)}).freed("pid.Kp")
    with pytest.raises(InputError, match="every gain allowed makes the loop unstable"):
        prepare_task(linear, Step(1.0), given, specify(IAE(), limits))


def test_loops_with_further_feedback() -> None:
    """A cascade, a sensor's lag and a dead zone's inverse; what is fixed counts as well."""
    drive = ForceDrive(Viscous())
    cascade = ClosedLoop(drive, PID(1e-3, limits=False), outer=PositionLoop())
    bounds = {"pid.Kp": (20.0, 400.0), "pid.Ki": (0.0, 900.0), "position_loop.Kp": (1.0, 20.0)}
    step = Step(0.1, horizon=0.8)
    assert sign_refusal(cascade, bounds, step) == ""
    wrong = {**bounds, **turned({n: bounds[n] for n in ("pid.Kp", "pid.Ki")}), "pid.Kp": (-400.0, -60.0)}
    assert TURN_BOTH in sign_refusal(cascade, wrong, step)
    lagging = ClosedLoop(FirstOrder().system(), PID(limits=False), sensor=SensorLag(0.01))
    assert sign_refusal(lagging, PI) == ""
    assert sign_refusal(lagging, turned(PI)) != ""
    inverse = ClosedLoop(FirstOrder().system(), PID(1e-3), compensators=(DeadZoneInverse(),))
    assert sign_refusal(inverse, PI) == ""
    assert sign_refusal(inverse, turned(PI)) != ""


def closed_poles(transfer: Transfer, gains: NDArray[np.float64], h: float | None) -> NDArray[np.complex128]:
    """Poles of loops under PIDs with gains Kp, Ki, Kd, Tf, shape (m, 4); of sampled ones in z."""
    (numerator, denominator), (Kp, Ki, Kd, Tf) = transfer, gains.T
    zero, one = np.zeros_like(Tf), np.ones_like(Tf)
    if h is None:  # C = (Kp s (Tf s + 1) + Ki (Tf s + 1) + Kd s^2)/(s (Tf s + 1))
        above, below = [Kp * Tf + Kd, Kp + Ki * Tf, Ki], [Tf, one, zero]
    else:  # the same with q = (z - 1)/(h z) for s, times z^2: z q = (z - 1)/h, z (Tf q + 1) = ((Tf + h) z - Tf)/h
        lag = [Tf + h, -Tf]
        above = [
            Kp * lag[0] + Ki * h * lag[0] + Kd,
            Kp * (lag[1] - lag[0]) + Ki * h * lag[1] - 2 * Kd,
            Kd - Kp * lag[1],
        ]
        below = [lag[0], lag[1] - lag[0], -lag[1]]
        B, A, _ = cont2discrete((numerator, denominator), h)
        numerator, denominator = np.asarray(B)[0], np.asarray(A)
    full = [
        np.array([np.convolve(row, by) for row in np.transpose(c)])
        for c, by in ((below, denominator), (above, numerator))
    ]
    full[0][:, -full[1].shape[1] :] += full[1]
    n = full[0].shape[1] - 1
    companion = np.tile(np.eye(n, k=-1), (len(gains), 1, 1))
    companion[:, 0] = -full[0][:, 1:] / full[0][:, :1]
    return np.linalg.eigvals(companion).astype(complex)


pole = st.one_of(st.floats(-20.0, -0.2), st.floats(-20.0, -0.2), st.floats(0.2, 6.0), st.just(0.0))
swing = st.tuples(st.floats(-5.0, 3.0), st.floats(0.5, 15.0))
ends = st.tuples(st.floats(0.0, 10.0), st.floats(0.1, 30.0), st.sampled_from((1.0, -1.0, 0.0)))
zeros, gains = st.lists(st.floats(-15.0, 15.0), max_size=2), st.sampled_from((1.0, -2.0, 20.0))
plants = st.tuples(st.lists(pole, max_size=3), st.lists(swing, max_size=1), zeros, gains)
stable_plants = st.tuples(
    st.lists(st.floats(-20.0, -0.2), min_size=1, max_size=3),
    st.lists(st.tuples(st.floats(-5.0, -1e-3), st.floats(0.5, 15.0)), max_size=1),
    zeros,
    gains,
)


def transfer_function(drawn: tuple) -> Transfer:  # type: ignore[type-arg]
    real, pairs, zeros, gain = drawn
    every = [*real, *(a + s * b * 1j for a, b in pairs for s in (1, -1))]
    assume(len(every) > len(zeros))
    return gain * np.real(np.poly(zeros)) * np.ones(1), np.real(np.poly(every))


def box(end: tuple[float, float, float]) -> tuple[float, float]:
    """A one-sided or two-sided range of a gain."""
    low, width, sign = end
    return (-width, width) if sign == 0 else (low, low + width) if sign > 0 else (-low - width, -low)


@settings(max_examples=60)
@given(drawn=plants, Kp=ends, Ki=st.none() | ends, Kd=st.none() | ends, h=st.sampled_from((None, 0.01, 0.1)))
def test_what_is_refused_has_no_stable_gains(drawn: tuple, Kp: tuple, Ki: tuple, Kd: tuple, h: float | None) -> None:  # type: ignore[type-arg]
    numerator, denominator = transfer_function(drawn)
    bounds = {n: box(e) for n, e in (("pid.Kp", Kp), ("pid.Ki", Ki), ("pid.Kd", Kd)) if e is not None}
    loop = ClosedLoop(plant(numerator.tolist(), denominator.tolist()), PID(h, limits=False))
    if not sign_refusal(loop, bounds, pid_Tf=0.02):
        return
    rng, ranges = np.random.default_rng(0), [bounds.get(f"pid.{n}", (0.0, 0.0)) for n in ("Kp", "Ki", "Kd")]
    gains = np.column_stack([*(rng.uniform(*r, 2000) for r in ranges), np.full(2000, 0.02)])
    found = closed_poles(transfer_function(drawn), gains, h)
    assert ((np.abs(found).max(axis=1) > 1) if h else (found.real.max(axis=1) > 0)).all()


@settings(max_examples=40)
@given(
    drawn=stable_plants,
    Kp=ends,
    Ki=st.tuples(st.floats(0.5, 5.0), st.floats(0.1, 30.0)),
    h=st.sampled_from((None, 0.01)),
)
def test_an_integral_of_the_wrong_sign_on_a_stable_plant_is_refused(
    drawn: tuple,  # type: ignore[type-arg]
    Kp: tuple[float, float, float],
    Ki: tuple[float, float],
    h: float | None,
) -> None:
    numerator, denominator = transfer_function(drawn)
    static = numerator[-1] / denominator[-1]
    assume(abs(static) > 1e-2)
    loop = ClosedLoop(plant(numerator.tolist(), denominator.tolist()), PID(h, limits=False))
    bounds = {"pid.Kp": box(Kp), "pid.Ki": box((*Ki, -float(np.sign(static))))}
    assert sign_refusal(loop, bounds, Step(1.0, horizon=100.0)) != ""


def test_an_unstable_plant_is_tuned_and_certified() -> None:
    """``1/((.5 s - 1)(.05 s + 1))``: right gains, which were once refused by the sign of the gain at rest, -1."""
    loop = ClosedLoop(plant([1.0], [0.025, 0.45, -1.0]), PID(limits=False))
    bounds = {"pid.Kp": (1.1, 30.0), "pid.Ki": (0.0, 60.0), "pid.Kd": (0.0, 1.0), "pid.b": (0.0, 1.0)}
    values = {"pid.Kp": 5.0, "pid.Ki": 4.0, "pid.Kd": 0.2, "pid.Tf": 0.005, "pid.b": 0.5}
    p = loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)
    step = Step(1.0, horizon=4.0)
    best = tune(loop, step, p, minimise=SettlingTime(), subject_to=[Overshoot(0.2)], plants={})
    gains = np.array([[best.parameters.value(f"pid.{n}") for n in ("Kp", "Ki", "Kd", "Tf")]])
    assert closed_poles((np.ones(1), np.array([0.025, 0.45, -1.0])), gains, None).real.max() < 0
    assert best.certified.loc["SettlingTime"].max() < 0.2


@pytest.mark.parametrize("friction", [Stribeck(), pytest.param(LuGre(), marks=pytest.mark.slow)])
def test_a_crawl_step_is_tuned_and_certified(friction: Stribeck | LuGre) -> None:
    loop = ClosedLoop(ForceDrive(friction), PID(1e-3))
    own = FALLING | {"friction.viscous": 30.0, "pid.lower": -300.0, "pid.upper": 300.0, "pid.Kp": 1500.0, "pid.Ki": 2e4}
    p = loop.parameters.with_values(own).with_bounds(SPEED_GAINS).freed(*SPEED_GAINS)
    step = Step(0.02, horizon=0.8)
    best = tune(loop, step, p, minimise=SettlingTime(), subject_to=[Overshoot(0.2)], plants={})
    assert best.certified.loc["SettlingTime"].max() < 0.15
    assert best.parameters.value("pid.Kp") > 0


TUNED: dict[str, tuple[System, Bounds, Mapping[str, float], float | None]] = {  # plant, bounds, fixed values, sampling
    "one unstable pole": (
        plant([1.0], [1.0, -1.0]),
        {"pid.Kp": (1.5, 8.0), "pid.Ki": (0.1, 8.0)},
        {"pid.Tf": 0.1},
        None,
    ),
    "two unstable poles": (
        plant([1.0], [1.0, -3.0, 2.0]),
        {"pid.Kp": (9.0, 51.0), "pid.Ki": (0.0, 60.0), "pid.Kd": (0.0, 18.0)},
        {"pid.Tf": 0.005},
        None,
    ),
    "a sampled pendulum": (
        plant([1.0], [1.0, 0.1, -9.81]),
        {"pid.Kp": (10.0, 90.0), "pid.Ki": (0.0, 90.0), "pid.Kd": (0.0, 18.0)},
        {"pid.Tf": 0.02, "pid.b": 0.5},
        0.01,
    ),
    "a zero beyond the pole": (
        plant([-1.0, 8.0], [0.01, 0.99, -1.0]),
        {"pid.Kp": (0.05, 0.6), "pid.Ki": (0.0, 0.2)},
        {"pid.b": 0.3},
        None,
    ),
    "two integrals": (plant([3.0], [1.0, 0.0, 0.0]), {"pid.Kp": (1.0, 9.0), "pid.Kd": (1.0, 9.0)}, {}, None),
    "a negative gain": (plant([-2.0], [0.5, 1.0]), {"pid.Kp": (-9.0, -0.1), "pid.Ki": (-20.0, -0.1)}, {}, None),
}


@pytest.mark.slow  # 1 to 3 s each
@pytest.mark.parametrize("case", TUNED)
def test_plants_that_run_away_or_turn_the_sign_are_tuned_and_certified(case: str) -> None:
    system, bounds, fixed, h = TUNED[case]
    loop = ClosedLoop(system, PID(h, limits=False))
    middle = {n: 0.5 * (low + up) for n, (low, up) in bounds.items()}
    p = loop.parameters.with_values({**middle, **fixed}).with_bounds(bounds).freed(*bounds)
    limits = [Overshoot(0.6), MaxSensitivity(3.0)]
    best = tune(loop, Step(1.0, horizon=10.0), p, minimise=SettlingTime(), subject_to=limits, plants={})
    assert best.certified.loc["MaxSensitivity"].max() <= 3.0
