"""Limit cycles: known signals, an oscillator with a known period, hunting under LuGre friction; and what is none.

Whether a loop comes to rest is read off break-aways and standstills: hunting, its cure, and what pushes on.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.limit_cycle import RestCheck, RestKind, check_rest, find_limit_cycle
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.files.outputs import load_result
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, LuGre, Stribeck
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory

T = np.linspace(0.0, 4.0, 2001)


def sine(frequency: float, amplitude: float = 0.02) -> Array:
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * T + 0.4))


@pytest.mark.parametrize("frequency", [2.0, 5.0, 23.0])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_sines_amplitude_and_frequency_are_found_through_noise(frequency: float, noise: float) -> None:
    rough = 0.02 * noise * np.random.default_rng(1).normal(size=len(T))
    found = find_limit_cycle(T, 0.05 + sine(frequency) + rough)
    assert found is not None
    assert found.frequency == pytest.approx(frequency, rel=0.01)
    assert found.amplitude == pytest.approx(0.02, rel=0.02 if noise == 0 else 0.35)


def test_a_triangles_and_a_crawls_peaks_are_their_own() -> None:
    found = find_limit_cycle(T, 0.03 * Waveform.TRIANGLE.at(2 * np.pi * 3.0 * T))
    assert found is not None
    assert found.amplitude == pytest.approx(0.03, rel=0.03)
    phase = (2.5 * T) % 1.0
    crawl = np.where(phase < 0.6, 0.0, 0.04 * np.sin(np.pi * (phase - 0.6) / 0.4))
    found = find_limit_cycle(T, crawl)
    assert found is not None
    assert (found.frequency, found.amplitude) == pytest.approx((2.5, 0.02), rel=0.02)
    assert found.stick_share == pytest.approx(0.6, abs=0.02)
    assert found.describe("m/s").startswith("a limit cycle of +-0.02 m/s at 2.5 Hz, at a standstill 6")


def test_van_der_pols_cycle_has_its_known_period() -> None:
    """Period 11.6122 and amplitude 2.0215 at mu = 5 (Strogatz; Urabe 1960), from a small start."""
    run = solve_ivp(
        lambda _t, z: [z[1], 5 * (1 - z[0] ** 2) * z[1] - z[0]], (0, 150), [0.1, 0.0], rtol=1e-9, max_step=0.1
    )
    found = find_limit_cycle(run.t, run.y[0])
    assert found is not None
    assert found.frequency == pytest.approx(1 / 11.6122, rel=0.01)
    assert found.amplitude == pytest.approx(2.0215, rel=0.01)


@pytest.mark.parametrize("lag", [0, 5, 50, 300])
def test_noise_is_no_limit_cycle_however_it_is_filtered(lag: int) -> None:
    rng, kept = np.random.default_rng(2), lag / (1 + lag)
    for _ in range(20):
        y, noise = np.zeros(len(T)), rng.normal(size=len(T))
        for k in range(1, len(T)):
            y[k] = kept * y[k - 1] + (1 - kept) * noise[k]
        assert find_limit_cycle(T, 1.0 + y) is None


@pytest.mark.parametrize("damping", [0.3, 0.05, 0.01])
def test_a_ringing_that_dies_out_is_none(damping: float) -> None:
    w = 2 * np.pi * 5.0
    assert find_limit_cycle(T, 1 - np.exp(-damping * w * T) * np.cos(w * T), min_amplitude=1e-9) is None


@pytest.mark.parametrize(
    "y", [np.zeros_like(T), np.ones_like(T), T, 1 - np.exp(-3 * T), 0.001 * sine(5.0) + np.exp(-20 * T)]
)
def test_rest_a_ramp_an_approach_and_what_is_too_small_are_none(y: Array) -> None:
    assert find_limit_cycle(T, y) is None


def test_the_dithers_ripple_is_averaged_away_and_a_cycle_beneath_it_is_not() -> None:
    ripple = sine(40.0, 0.05)
    assert find_limit_cycle(T, 0.1 + ripple) is not None
    assert find_limit_cycle(T, 0.1 + ripple, dither_period=1 / 40.0) is None
    found = find_limit_cycle(T, 0.1 + ripple + sine(3.0), dither_period=1 / 40.0)
    assert found is not None
    assert (found.frequency, found.amplitude) == pytest.approx((3.0, 0.02), rel=0.03)


def test_size_and_time_scale_with_the_signal() -> None:
    found, scaled = find_limit_cycle(T, sine(3.0)), find_limit_cycle(7.0 + 10 * T, 5 - 100 * sine(3.0))
    assert found is not None
    assert scaled is not None
    assert scaled.amplitude == pytest.approx(100 * found.amplitude, rel=0.01)
    assert scaled.frequency == pytest.approx(found.frequency / 10, rel=0.01)


def test_an_integrals_hunting_under_lugre_friction_is_found_and_ends_without_the_integral() -> None:
    """A mass under position control sticks, winds up, jumps: the classic hunting of integral action with stiction."""
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID(limits=False), measured="position")
    values = {"friction.coulomb": 10.0, "friction.static": 20.0, "friction.viscous": 10.0, "load.mass": 2.0}
    gains = {"friction.stribeck_velocity": 0.01, "pid.Kp": 1000.0, "pid.Kd": 60.0, "pid.Tf": 0.005}
    t = np.linspace(0.0, 30.0, 3001)
    inputs = Trajectory(t, {q.name: np.full(len(t), 0.02 if q.name == "reference" else 0.0) for q in loop.inputs})
    cycles = []
    for Ki in (6000.0, 0.0):
        p = loop.parameters.with_values({**values, **gains, "pid.Ki": Ki})
        run = simulate(loop, inputs, p, rtol=1e-7)
        cycles.append(find_limit_cycle(t, run["position"], min_amplitude=1e-4))
    assert cycles[0] is not None
    assert cycles[0].amplitude > 1e-3
    assert cycles[1] is None


GAINS = {"pid.Kp": 5000.0, "pid.Ki": 20000.0, "pid.Kd": 200.0, "pid.Tf": 2e-3}
FALL = {"friction.stribeck_velocity": 1e-3}
STEP = Step(0.1)
MASS, COULOMB, STATIC, VISCOUS, WIDTH = 5.0, 30.0, 45.0, 70.0, 1e-3


@cache
def watch(duration: float = 60.0, pid: PID | None = None, **changed: float) -> RestCheck:
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), pid or PID(dead_band=True), measured="position")
    values = {n.replace("__", "."): value for n, value in changed.items()}
    return check_rest(loop, STEP, loop.parameters.with_values(GAINS | FALL | values), duration=duration)


def standstills(duration: float) -> list[tuple[float, float]]:
    """Instants and errors at each standstill, by hand: a slip is integrated by SciPy, a stick has a closed form."""
    Kp, Ki, Kd, Tf = GAINS.values()
    t, x, found = 0.0, np.array([0.0, 0.0, 0.0, 0.1]), []  # position, speed, integral, filtered error

    def force(x: Array) -> float:
        return float(Kp * (0.1 - x[0]) + x[2] + Kd / Tf * (0.1 - x[0] - x[3]))

    def rates(_t: float, x: Array, side: float) -> list[float]:
        error, dry = 0.1 - x[0], side * friction(x[1])
        return [x[1], (force(x) - VISCOUS * x[1] - dry) / MASS, Ki * error, (error - x[3]) / Tf]

    while t < duration:
        side = float(np.sign(force(x)))
        if abs(force(x)) < STATIC:
            error = 0.1 - x[0]
            side = float(np.sign(error))
            wait = (side * STATIC - Kp * error - x[2]) / (Ki * error)  # the integral is a ramp
            assert wait > 20 * Tf  # so that the filtered error is the error by then
            t, x = t + wait, np.array([x[0], 0.0, x[2] + Ki * error * wait, error])
        x[1] = 1e-9 * side
        event: Any = standstill
        slip: Any = solve_ivp(rates, (t, t + 50.0), x, args=(side,), events=event, rtol=1e-9, atol=1e-12)
        t, x = float(slip.t_events[0][0]), slip.y_events[0][0]
        found.append((t, float(x[0] - 0.1)))
    return found


def standstill(_t: float, x: Array, side: float) -> float:
    return float(side * x[1])


standstill.terminal, standstill.direction = True, -1.0  # type: ignore[attr-defined]


def friction(v: float) -> float:
    return COULOMB + (STATIC - COULOMB) * float(np.exp(-((v / WIDTH) ** 2)))


def test_hunting_is_found_and_explained() -> None:
    (case,) = watch().cases
    assert case.kind is RestKind.HUNTS
    assert case.sentence == (
        f"at 0 to 0.1 the loop hunts by +-{1e3 * case.amplitude:.3g} mm, a cycle in {case.period:.3g} s: the integral "
        "pushes the stuck body until it breaks away, and its static friction, 1.5 times Coulomb's, lets it jump "
        "beyond; give the integral a dead band wider than the error at rest"
    )


def test_samples_that_rounding_puts_before_the_mode_that_they_begin_are_read() -> None:
    """Of a loop sampled at 2 ms, 1.122 s is an ulp later by the controller's clock than by the instants read."""
    (case,) = watch(1.2, PID(2e-3)).cases
    assert case.last_motion < 1.2


def test_a_hand_written_simulation_hunts_alike() -> None:
    (case,) = watch().cases
    late = np.array([(t, e) for t, e in standstills(60.0) if t >= 30.0])
    assert case.slips == pytest.approx(len(late), abs=1)
    assert case.error == pytest.approx(np.abs(late[:, 1]).max(), rel=0.02)
    assert case.period == pytest.approx(2 * np.diff(late[:, 0]).mean(), rel=0.05)


def test_the_advised_dead_band_ends_it() -> None:
    error = watch().cases[0].error
    found = watch(pid__dead_band=1.01 * error)
    assert found.rests
    assert 0 < abs(found.cases[0].error) <= 1.01 * error


def test_without_excess_of_static_friction_it_rests() -> None:
    found = watch(friction__static=COULOMB)
    assert found.rests
    assert abs(found.cases[0].error) < 1e-6


def test_an_integral_that_still_pushes_is_no_rest() -> None:
    found = watch(pid__Ki=2.0)
    assert found.cases[0].kind is RestKind.PUSHED
    assert not found.rests
    assert "it will break away" in found.cases[0].sentence


def test_it_does_break_away_later() -> None:
    """The same loop, watched as long as the integral needs for the break-away force at the rate that is told."""
    gains = {"pid__Ki": 2000.0}
    push = watch(1.5, **gains).cases[0].push
    later = watch(1.5 + 2 * STATIC / abs(push), **gains).cases[0]
    assert later.last_motion > 1.5


def test_a_proportional_controller_rests_with_an_error() -> None:
    found = watch(pid__Ki=0.0)
    assert found.rests
    assert 0 < found.cases[0].error <= STATIC / GAINS["pid.Kp"]


def test_repeatability_is_the_range_of_the_errors_at_rest() -> None:
    """A P controller leaves a body anywhere that its friction holds, so where it rests depends on where it began."""
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(), measured="position")
    values = loop.parameters.with_values(GAINS | FALL | {"pid.Ki": 0.0})
    starts = [Move(0.1 - at, initial=at, speed=0.5, acceleration=5.0, dwell=1.0) for at in (0.0, 0.04, 0.17)]
    found = check_rest(loop, starts, values, duration=3.0)
    ends = [case.error for case in found.cases]
    assert len({round(e, 7) for e in ends}) == 3
    assert found.repeatability == max(ends) - min(ends)
    assert found.repeatability <= 2 * STATIC / GAINS["pid.Kp"]
    shown = f"repeatability {1e3 * found.repeatability:.3g} mm: the range of its errors at rest"
    assert shown in str(found).splitlines()[1]
    assert check_rest(loop, starts[:1], values, duration=3.0).repeatability == 0
    assert "repeatability" not in str(watch())
    assert watch().repeatability == np.inf


def test_scenarios_are_watched_and_tabled() -> None:
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(), measured="position")
    values = loop.parameters.with_values(GAINS | FALL)
    found = check_rest(loop, STEP, values, scenarios={"smooth seal": {"friction.static": COULOMB}}, duration=30.0)
    assert found.to_frame()["kind"].tolist() == ["hunts", "rests"]
    assert str(found).startswith("the loop does not come to rest in 1 of 2 cases, watched for 30 s\n")


def test_it_is_read_as_it_was_saved(tmp_path: Path) -> None:
    found = watch()
    found.save(tmp_path / "rest.json")
    again = load_result(tmp_path / "rest.json")
    assert (repr(again), again.rests) == (repr(found), found.rests)
    assert again.cases[0].kind is RestKind.HUNTS


def test_a_rig_with_an_encoder_rests_within_its_count() -> None:
    """Half a count from the reference the controller sees no error, so its integral stands."""
    pid = PID(1e-3)
    plant = ForceDrive(Karnopp(Coulomb())).system()
    loop = ClosedLoop(plant, pid, measured="position", sensor=Encoder(1e-3, position="position"))
    values = loop.parameters.with_values(GAINS | {"pid.Tf": 0.01})
    found = check_rest(Rig(loop, {"position": Sensor(resolution=1e-3)}), STEP, values, duration=3.0)
    assert found.cases[0].kind is RestKind.RESTS
    assert abs(found.cases[0].error) <= 0.5e-3
