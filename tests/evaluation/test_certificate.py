"""What a certificate refuses, whatever was asked of a design, and the figures of designs that it certifies.

How a response ends, read off records that are made by hand.

A settling band below what an encoder's counts show is noted beside the certificate's figures.

A response that is continued up to an end stop is judged by what it did before the stop's rounded edge slowed it.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.simulate import continue_simulation, simulate
from pneuopt.dynamics.system import System, define
from pneuopt.evaluation.certificate import (
    Certificate,
    ContinuedResponse,
    Defect,
    Ending,
    certificate,
    continue_response,
    describe_counts,
)
from pneuopt.evaluation.dither import Usefulness, _settling_time, judge_dither
from pneuopt.evaluation.evaluate import evaluate_cases
from pneuopt.evaluation.metric import Tolerance, longest_stay
from pneuopt.evaluation.response import loop_inputs
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from problems.dither import dither_map

Signals = Mapping[str, ca.SX]
GAIN, TIME_CONSTANT = 1.0, 0.1  # of the first-order plants below [m/s/V], [s]


def second_order(Kp: float, Ki: float) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    return loop, loop.parameters.with_values({"pid.Kp": Kp, "pid.Ki": Ki})


def first_order(Kp: float, Ki: float, sample_time: float | None = None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=sample_time, limits=False))
    values = {"plant.gain": GAIN, "plant.time_constant": TIME_CONSTANT, "pid.Kp": Kp, "pid.Ki": Ki}
    return loop, loop.parameters.with_values(values)


def routh_limit(parameters: ParameterSet, Kp: float) -> float:
    """The largest Ki of a PI controller on ``K w^2/(s^2 + 2 d w s + w^2)``: ``2 d w (1 + K Kp)/K``."""
    K, w, d = (parameters.value(n) for n in ("plant.gain", "plant.natural_frequency", "plant.damping"))
    return float(2 * d * w * (1 + K * Kp) / K)


def with_a_hidden_mode(rate: float) -> System:
    """A lag with a second, weakly excited mode that grows at this rate [1/s]: nothing of it shows within a second."""

    def ode(_t: ca.SX, x: Signals, u: Signals, _p: Signals) -> tuple[Signals, Signals]:
        rates = {"lag": (u["command"] - x["lag"]) / 0.02, "mode": rate * x["mode"] + 1e-5 * u["command"]}
        return rates, {"speed": x["lag"] + x["mode"]}

    states = (Quantity("lag", "m/s"), Quantity("mode", "m/s"))
    return define(states, (Quantity("command", "V"),), (Quantity("speed", "m/s"),), ParameterSet(), ode)


def position_loop(Kp: float, Ki: float, Kd: float) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(), measured="position")
    gains = {"pid.Kp": Kp, "pid.Ki": Ki, "pid.Kd": Kd, "pid.Tf": 2e-3, "pid.lower": -500.0, "pid.upper": 500.0}
    return loop, loop.parameters.with_values(gains)


def defects(found: Certificate) -> list[Defect]:
    return [finding.defect for finding in found.findings]


@cache
def hunting() -> Certificate:
    return certificate(position_loop(1, 1, 1)[0], Step(0.05), position_loop(2000.0, 20000.0, 100.0)[1])


def test_a_loop_on_either_side_of_the_limit_of_stability() -> None:
    loop, values = second_order(0.5, 1.0)
    limit = routh_limit(values, 0.5)
    stable, unstable = (certificate(loop, Step(1.0), second_order(0.5, share * limit)[1]) for share in (0.3, 1.05))
    assert defects(stable) == []
    assert defects(unstable) == [Defect.UNSTABLE, Defect.GROWS]
    assert "unstable" in unstable.findings[0].sentence
    assert [bool(np.all(f.margins["stable"])) for f in (stable, unstable)] == [True, False]


def test_what_grows_beyond_the_horizon_is_found() -> None:
    loop = ClosedLoop(with_a_hidden_mode(2.0), PID(limits=False))
    values = loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 40.0})
    found = certificate(loop, Step(1.0), values)
    assert Defect.GROWS in defects(found)
    assert np.isnan(found.metrics["0 to 1"]["SettlingTime"])
    assert next(evaluate_cases(loop, Step(1.0), values)).metrics["SettlingTime"] < 0.3


@pytest.mark.parametrize(
    ("Kp", "Ki", "defect", "words"),
    [
        (0.0, 0.0, Defect.STANDS_STILL, "moved by 0 % of the step"),
        (1.0, 0.0, Defect.MISSES_REFERENCE, "rests 50 % of the step away"),
        (1.0, 0.05, Defect.CREEPS, "still moving"),
    ],
)
def test_a_loop_that_does_not_arrive(Kp: float, Ki: float, defect: Defect, words: str) -> None:
    found = certificate(*_at(Step(1.0), first_order(Kp, Ki)))
    assert defects(found) == [defect]
    assert words in found.findings[0].sentence


def _at(step: Step, case: tuple[ClosedLoop, ParameterSet]) -> tuple[ClosedLoop, Step, ParameterSet]:
    return case[0], step, case[1]


def test_a_disturbance_that_hardly_moves_the_loop_is_no_standstill() -> None:
    loop, values = first_order(20.0, 200.0)
    push = Step(0.0, initial=1.0, disturbance={"valve_voltage": 0.5})
    assert defects(certificate(loop, push, values)) == []


def test_a_drive_that_sticks_and_slips_hunts() -> None:
    assert defects(hunting()) == [Defect.HUNTS]
    assert "limit cycle" in hunting().findings[0].sentence
    assert np.isnan(hunting().metrics["0 to 0.05"]["SettlingTime"])


def test_a_settling_time_that_the_horizon_makes_up_is_none() -> None:
    """A position loop that enters the band after 0.13 s, slips out of it and comes to rest seconds later."""
    loop, values = position_loop(8000.0, 5000.0, 100.0)
    short = next(evaluate_cases(loop, Step(0.05, horizon=0.8), values)).metrics
    long = next(evaluate_cases(loop, Step(0.05, horizon=8.0), values)).metrics
    assert short["SettlingTime"] < 0.2
    found = certificate(loop, Step(0.05, horizon=0.8), values)
    assert np.isnan(found.metrics["0 to 0.05"]["SettlingTime"])
    assert "leaves the band of 2 % again after its horizon" in found.notes[0]
    said = float(found.notes[1].partition("only ")[2].split()[0])
    assert said == pytest.approx(long["SettlingTime"], abs=0.01)


def test_an_overshoot_beyond_the_horizon_counts() -> None:
    loop, values = position_loop(4000.0, 20000.0, 100.0)
    short, long = (next(evaluate_cases(loop, Step(0.05, horizon=h), values)).metrics["Overshoot"] for h in (0.8, 8.0))
    assert short < 0.6 * long
    found = certificate(loop, Step(0.05, horizon=0.8), values).metrics["0 to 0.05"]
    assert found["Overshoot"] == pytest.approx(long, rel=1e-3)


def test_an_undecided_response_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pneuopt.evaluation.certificate.MAX_CONTINUATION_INSTANTS", 1500)
    found = certificate(*_at(Step(0.05), position_loop(2000.0, 20000.0, 100.0)))
    assert defects(found) == [Defect.UNDECIDED]
    assert "budget" in found.findings[0].sentence


def test_a_response_that_settles_later_says_so() -> None:
    loop, values = first_order(1.0, 10.0)  # a pole-zero cancellation: 1/(0.1 s), settled after ln(50)/10 s
    short, long = (certificate(loop, Step(1.0, horizon=h), values) for h in (0.2, 1.0))
    assert defects(short) == defects(long) == []
    assert "beyond the horizon" in short.notes[0]
    assert long.notes == ()


def test_a_settled_linear_loop_is_not_simulated_any_longer() -> None:
    loop, step, values = _at(Step(1.0), first_order(2.0, 20.0))
    continued = continue_response(next(evaluate_cases(loop, step, values)), 0.02)
    assert continued.t[-1] == pytest.approx(1.0)
    assert continued.is_decided(0.02)


@pytest.mark.parametrize(("rate", "is_decided"), [(0.0, True), (5e-4, True), (1e-3, False)])
def test_a_command_that_drifts_under_a_standing_signal_is_followed(rate: float, is_decided: bool) -> None:
    """An integral that winds up behind static friction: over the 15 horizons to come it would change by 15 rates."""
    t = np.linspace(0.0, 1.0, 101)
    stuck = np.where(t < 0.2, t / 0.2, 1.0)
    continued = ContinuedResponse(
        first_order(5.0, 20.0)[0], Step(1.0, horizon=1.0), None, t, stuck, 1.0 - rate + rate * t
    )
    assert continued.stands(0.02)
    assert continued.is_decided(0.02) is is_decided


def test_the_stroke_may_end_first() -> None:
    loop = ClosedLoop(PneumaticDrive(friction=Stribeck()).system(), PID())
    gains = {"pid.Kp": 1.0, "pid.Ki": 20.0, "pid.Kd": 0.03, "pid.Tf": 3e-3, "pid.lower": -5.0, "pid.upper": 5.0}
    values = loop.parameters.with_values(gains)
    found = certificate(loop, Step(0.2, horizon=0.4, start={"position": 0.05}), values)
    ends = [note for note in found.notes if "end stop" in note]
    assert len(ends) == 1
    assert "position 199.9 mm" in ends[0]


@pytest.mark.parametrize("sample_time", [None, 5e-3])
def test_a_continued_run_is_the_run_that_was_not_cut(sample_time: float | None) -> None:
    loop, values = first_order(1.0, 8.0, sample_time)
    full = loop.complete(values)
    run = loop_inputs(loop, Step(1.0, horizon=0.4), 5e-3)
    whole = simulate(loop, run, full)
    half = len(run) // 2
    first = Trajectory(run.t[: half + 1], {n: run[n][: half + 1] for n in run})
    second = Trajectory(run.t[half:], {n: run[n][half:] for n in run})
    state = np.array([simulate(loop, first, full)[q.name][-1] for q in loop.states])
    rest, met = continue_simulation(loop, second, full, state)
    assert met == ()
    for n in ("speed", "control"):
        assert rest[n] == pytest.approx(whole[n][half:], abs=1e-8)


@pytest.mark.parametrize(("Kp", "Ki"), [(2.0, 40.0), (1.0, 40.0), (0.4, 9.0)])
def test_certified_figures_are_those_of_a_plain_integration(Kp: float, Ki: float) -> None:
    """The plant and the controller are written out here, and SciPy's DOP853 integrates them."""

    def rates(_t: float, x: Array) -> list[float]:
        error = 1.0 - x[0]
        command = Kp * error + x[1]
        return [(GAIN * command - x[0]) / TIME_CONSTANT, Ki * error, abs(error), _t * abs(error)]

    t = np.linspace(0.0, 1.0, 20001)
    run = solve_ivp(rates, (0.0, 1.0), np.zeros(4), method="DOP853", t_eval=t, rtol=1e-11, atol=1e-13)
    error = run.y[0] - 1.0
    found = certificate(*_at(Step(1.0), first_order(Kp, Ki)))
    assert found.findings == ()
    ours = found.metrics["0 to 1"]
    assert ours["SettlingTime"] == pytest.approx(t[np.flatnonzero(np.abs(error) > 0.02)[-1]], abs=1e-4)
    assert ours["Overshoot"] == pytest.approx(100 * max(0.0, error.max()), abs=1e-4)
    assert ours["IAE"] == pytest.approx(run.y[2, -1], abs=1e-6)
    assert ours["ITAE"] == pytest.approx(run.y[3, -1], abs=1e-6)


def test_a_design_that_takes_many_horizons_creeps() -> None:
    """An integral alone on a lag of .1 s, its slow pole at -1.127 1/s, takes ln(1.14 50)/1.127 = 3.59 s."""
    loop, p = first_order(0.0, 1.0)
    (found,) = certificate(loop, Step(1.0, horizon=0.5), p).findings
    assert found.defect is Defect.CREEPS
    assert "in the band for good only 3.59" in found.sentence
    late = certificate(loop, Step(1.0, horizon=1.5), p)
    assert late.findings == ()
    assert any("beyond the horizon" in note for note in late.notes)


STEP, BAND = Step(1.0, horizon=1.0), 0.02


def ending(t: Array, error: Array) -> Ending:
    """The ending of a response with this error that the end of the stroke cuts."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    return Ending(
        ContinuedResponse(loop, STEP, None, t, 1.0 + error, np.ones_like(t), "the piston left the stroke"), BAND, "a"
    )


def decay(t: Array, dip: float) -> Array:
    """A decay into the band that touches its edge at .8 s, is outside once more until .9 s, and then dies out."""
    error = -np.exp(-t / 0.2)
    return np.asarray(np.where((t > 0.84) & (t < 0.9), -dip, error))


@pytest.mark.parametrize(("dip", "settled"), [(0.01, 0.78), (0.0205, 0.9)])
def test_a_response_that_leaves_the_band_for_a_moment_has_settled(dip: float, settled: float) -> None:
    """The record ends at 1.5 s; this was "creeps: 1.1 s after the step it is .3 % of the step away"."""
    t = np.linspace(0.0, 1.5, 3001)
    found = ending(t, decay(t, dip))
    assert found.is_settled
    assert found.settling_time == pytest.approx(settled, abs=5e-3)
    assert list(found.findings()) == []


def test_a_response_that_is_inside_as_long_as_ever_hunts_on() -> None:
    """Of 1 s: .3 s inside, .3 s outside, and .25 s inside again, as in slow hunting."""
    t = np.linspace(0.0, 1.0, 2001)
    error = np.where(t < 0.15, -1.0, np.where((t < 0.45) | (t > 0.75), 0.01, 0.03 + 0.01 * t))
    found = ending(t, np.asarray(error))
    assert longest_stay(t, found.is_inside(error)) == pytest.approx(0.3, abs=2e-3)
    assert not found.is_settled
    assert [f.defect for f in found.findings()] != []
    assert found.returns(0.0) == 1


@pytest.mark.parametrize(("share", "inside"), [(1.0, True), (1.0005, False), (1.01, False)])
def test_a_response_that_rests_beyond_the_band_is_outside(share: float, inside: bool) -> None:
    """Exactly on the edge is inside; half a thousandth of the band beyond it is outside, as in the metrics."""
    t = np.linspace(0.0, 1.5, 3001)
    found = ending(t, -np.maximum(np.exp(-t / 0.1), share * BAND))
    assert found.is_settled == inside
    assert ([f.defect for f in found.findings()] == []) == inside


@pytest.mark.parametrize(("share", "refutes"), [(1.0, False), (1.0007, False), (1.002, True), (np.nan, True)])
def test_a_touch_of_the_edge_refutes_no_settling_within_the_horizon(share: float, refutes: bool) -> None:
    """A ripple 3e-4 of the band beyond its edge made a dither "harmful" that settles in two thirds of the time."""
    t = np.linspace(0.0, 1.5, 3001)
    error = np.where(t > 1.2, share * BAND, 0.0)  # the horizon is 1 s
    found = ending(t, error)
    assert found.leaves(t, error) == found.refutes(0.5) == refutes
    assert (_settling_time(found, 0.5, t, np.abs(error)) == 0.5) != refutes


@pytest.mark.parametrize(("horizons", "refused"), [(0.9, False), (3.0, False), (5.0, True), (9.0, True)])
def test_a_response_must_be_in_its_band_for_good_within_a_few_horizons(horizons: float, refused: bool) -> None:
    """Three horizons are a user's who underrated the settling; five are none that a user would wait for."""
    t = np.linspace(0.0, 30.0, 30001)
    found = ending(t, np.where(t < horizons * STEP.horizon, -0.05, -0.5 * BAND))
    assert found.is_settled
    assert [f.defect for f in found.findings()] == [Defect.CREEPS] * refused


def test_a_response_that_never_was_in_the_band_has_no_stay() -> None:
    t = np.linspace(0.0, 1.0, 1001)
    error = -0.5 * np.exp(-t / 5.0)
    found = ending(t, error)
    assert longest_stay(t, found.is_inside(error)) == 0.0
    assert [f.defect for f in found.findings()] == [Defect.CREEPS]


@pytest.mark.parametrize(("settled", "defects"), [(3.9, []), (4.1, [Defect.CREEPS])])
def test_who_needs_more_than_four_horizons_creeps(settled: float, defects: list[Defect]) -> None:
    """The step's horizon is 1 s; what comes in within four is settled, later than its user thought."""
    t = np.linspace(0.0, 16.0, 8001)
    found = ending(t, np.where(t < settled, -0.05, 0.0))
    assert found.settling_time == pytest.approx(settled, abs=5e-3)
    assert [f.defect for f in found.findings()] == defects


@pytest.mark.parametrize(("ratio", "settles"), [(1.8, False), (2.2, True)])
def test_who_came_in_late_must_stay_twice_as_long_as_before(ratio: float, settles: bool) -> None:
    """Of the 1 s that is judged: .15 s inside, then outside until the last stay, which lasts a multiple of that."""
    t = np.linspace(0.0, 1 / 0.9, 4001)
    inside = ((t > 0.3) & (t < 0.45)) | (t > 1 - ratio * 0.15)
    assert ending(t, np.where(inside, 0.01, 0.05)).is_settled == settles


STEP_COUNTS = Step(0.02, horizon=0.05)


def counted(measured: str = "position", resolution: float = 1e-3, dither: Dither | None = None) -> ClosedLoop:
    sensor = Encoder(resolution)
    return ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), dither, measured=measured, sensor=sensor)


def test_a_certificate_notes_a_band_below_half_a_count() -> None:
    loop = counted()
    given = loop.parameters.with_values({"pid.Kp": 100.0, "pid.Kd": 20.0, "pid.Tf": 0.01})
    (note,) = [n for n in certificate(loop, STEP_COUNTS, given).notes if "narrower" in n]
    assert note == (
        "at 0 to 0.02 the settling band of +-0.4 mm is narrower than half the encoder's count of 1 mm, the controller "
        "cannot tell inside from outside; take band = 0.025 or more, a larger step or a finer encoder"
    )


def test_a_reading_within_half_a_count_is_blind() -> None:
    """Within half a count of the reference, outside the band too, the controller sees the reference."""
    loop = counted()
    given = loop.parameters.with_values({"pid.Kp": 100.0, "pid.Ki": 50.0})
    assert describe_counts(loop, given, STEP_COUNTS, 0.024) is not None
    starts = [loop.initial(given, [0.02 + off, 0.0], reference=0.02) for off in (-0.49e-3, 0.0, 0.49e-3)]
    reading = [q.name for q in loop.states].index("sensor.reading")
    assert [x[reading] for x in starts] == pytest.approx([0.02] * 3, abs=1e-15)


@pytest.mark.parametrize(("band", "resolution"), [(0.025, 1e-3), (0.02, 8e-4), (1e-6, 0.0)])
def test_a_band_of_half_a_count_is_seen(band: float, resolution: float) -> None:
    loop = counted(resolution=resolution)
    assert describe_counts(loop, loop.parameters, STEP_COUNTS, band) is None


def test_a_tolerance_below_half_a_count_is_named_in_its_unit() -> None:
    loop = ClosedLoop(
        ForceDrive(Viscous()).system(), PID(sample_time=1e-3), measured="position", sensor=Encoder(resolution=1e-3)
    )
    told = describe_counts(loop, loop.parameters, Step(0.1), Tolerance(1e-4))
    assert told is not None
    assert told.startswith("the settling band of +-0.1 mm is narrower than half the encoder's count of 1 mm")
    assert "take band = 0.5 mm or more" in told
    assert describe_counts(loop, loop.parameters, Step(0.1), Tolerance(5e-4)) is None


def test_a_sensor_without_counts_shows_every_band() -> None:
    for sensor in (None, SensorLag(5e-3)):
        loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), measured="position", sensor=sensor)
        assert describe_counts(loop, loop.parameters, STEP_COUNTS, 1e-6) is None


def test_a_dither_may_show_what_lies_between_counts() -> None:
    loop = counted(dither=Dither(20.0))
    for amplitude, ripple in ((0.0, False), (1.0, True)):
        told = describe_counts(loop, loop.parameters.with_values({"dither.amplitude": amplitude}), STEP_COUNTS, 0.02)
        assert told is not None
        assert ("only by its dither's ripple" in told) == ripple


def test_a_count_of_a_speed_is_that_of_its_filter() -> None:
    """A count of 1 mm is 1/6 m/s behind a filter of 5 ms at 1 ms."""
    loop, step = counted("speed"), Step(1.0, horizon=0.2)
    assert loop.controller.sensor_resolution(loop.parameters) == pytest.approx(1 / 6, rel=1e-12)
    told = describe_counts(loop, loop.parameters, step, 0.02)
    assert told == (
        "the settling band of +-20 mm/s is narrower than half the 0.167 m/s by which one count changes the reading; "
        "take band = 0.0834 or more, a finer encoder or a longer filter of the sensor"
    )
    assert describe_counts(loop, loop.parameters, step, 0.0834) is None


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
