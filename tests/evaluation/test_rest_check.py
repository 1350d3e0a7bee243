"""Whether a loop comes to rest is read off break-aways and standstills: hunting, its cure, and what pushes on."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.evaluation.rest_check import RestCheck, RestKind, check_rest
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.files.results import load_result
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck
from pneuopt.models.karnopp import Karnopp
from pneuopt.quantities.arrays import Array

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
