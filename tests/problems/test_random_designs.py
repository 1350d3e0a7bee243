"""The plain C simulation of random loops, and what the study calls a fault."""

import shutil
from collections.abc import Callable

import numpy as np
import pytest

import pneuopt as po
from pneuopt.evaluation.specification import specify
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.method import SearchResult
from pneuopt.tuning.tune import prepare_search, prepare_task
from problems.shared.plain_loop import PlainResponse, plain_kind, simulate_plainly
from problems.tune.random_designs import (
    HORIZONS,
    KINDS,
    draw_plant,
    draw_specification,
    draw_steps,
    find_faults,
    holds,
    period_mean,
)

needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler")


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_the_plain_simulation_and_the_certificate_see_one_response(kind: str) -> None:
    rng = np.random.default_rng((3, KINDS.index(kind)))
    plant = draw_plant(kind, rng)
    step, given = draw_steps(plant, rng)[0], plant.parameters
    if plant.loop.dither:
        given = given.with_bounds({"dither.amplitude": (0.0, 1e3), "dither.offset": (-1e3, 1e3)})
        given = given.with_values({"dither.amplitude": 0.2, "dither.offset": 0.1})
    plain = simulate_plainly(plain_kind(kind, plant.loop), plant.loop, given, step, 1.0)
    tight = po.respond(plant.loop, step, given)
    theirs = np.interp(plain.t, tight.t, tight[plant.loop.feedback.name])
    late = given.value("plant.dead_time") if "plant.dead_time" in given else 0.0
    after = plain.t >= step.at + 3 * late  # before, the certificate's approximant of the delay ripples
    np.testing.assert_allclose(plain.y[after], theirs[after], atol=3e-4 * abs(step.size))
    np.testing.assert_allclose(plain.y, theirs, atol=0.02 * abs(step.size))


def test_a_search_takes_shorter_steps_where_bristles_need_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """RK4 with one step a sample claimed an ITAE of .0185 s^2 and a settling in .2 s; neither is true."""
    rng = np.random.default_rng((32, 12))
    plant = draw_plant("t32_position", rng)
    steps, spec = draw_steps(plant, rng), specify(po.ITAE(), [po.Overshoot(0.005)])
    search = prepare_search(prepare_task(plant.loop, steps, plant.parameters, spec))
    gains = {"pid.Kp": 20.97, "pid.Ki": 0.01603, "pid.Kd": 0.03215}
    found = SearchResult(np.array(list(gains.values())), Status(Code.CONVERGED), (), simulations=1)
    true = po.evaluate(plant.loop, steps, plant.parameters.with_values(gains)).loc["ITAE"].to_numpy(dtype=float)

    def claim() -> float:
        return float(search.simulator.values(found.point[None], spec)["ITAE"][0])

    assert claim() < 0.6 * true[0]
    monkeypatch.setattr(po.Racing, "find", lambda *_: found)
    assert search.find(0.015, search.space.start, 0) is found
    assert claim() == pytest.approx(true[0], rel=5e-3)


def test_brute_force_answers_to_the_certificate() -> None:
    """The design that seed 140 ended in keeps its limits over the horizon, and hunts after it."""
    rng = np.random.default_rng((140, 12))
    plant = draw_plant("t32", rng)
    steps, spec = draw_steps(plant, rng), draw_specification(rng)
    hunts = plant.parameters.with_values({"pid.Kp": 2.436, "pid.Ki": 19.88})
    assert not holds(plant, steps, hunts, spec)
    assert holds(plant, steps, plant.parameters.with_values({"pid.Kp": 2.797, "pid.Ki": 19.44}), spec)


def faults(error: Callable[[Array], Array], settled: float) -> list[str]:
    """What is said of a unit step whose error over five horizons is a function of time."""
    t = np.linspace(0.0, HORIZONS, 5001)
    mean = np.asarray(1.0 - error(t))
    return find_faults(PlainResponse(t, mean, np.zeros_like(t), ended=False), mean, po.Step(1.0), settled, SPEC)[0]


SPEC = specify(po.SettlingTime(), [po.Overshoot(0.05)])


def test_a_response_that_settles_and_stays_has_no_fault() -> None:
    assert faults(lambda t: np.exp(-10 * t), settled=np.log(50) / 10) == []
    assert faults(lambda t: np.exp(-2 * t), settled=np.nan) == []


@pytest.mark.parametrize(
    ("error", "settled", "word"),
    [
        (lambda t: np.exp(-10 * t) + 1e-3 * np.exp(2 * t) * np.sin(50 * t), 0.4, "unstable"),
        (lambda t: np.exp(-1e-3 * t), 0.4, "standing"),
        (lambda t: np.exp(-10 * t), 0.3, "leaves the band"),
        (lambda t: np.exp(-10 * t) + 0.03 * (t > 2.5), 0.4, "leaves the band"),
        (lambda t: np.exp(-0.9 * t), np.nan, "leaves the band"),
        (lambda t: np.exp(-10 * t) * np.cos(20 * t), 0.4, "overshoot"),
    ],
)
def test_each_fault_is_named(error: Callable[[Array], Array], settled: float, word: str) -> None:
    assert any(word in why for why in faults(error, settled))


def test_the_mean_over_a_period_is_that_of_the_signal_without_its_ripple() -> None:
    t = np.linspace(0.0, 1.0, 4001)
    run = PlainResponse(t, t + 0.1 * np.sin(2 * np.pi * 50 * t), np.zeros_like(t), ended=False)
    inside = (t > 0.02) & (t < 0.98)
    np.testing.assert_allclose(period_mean(run, 0.02, 0.0)[inside], t[inside], atol=1e-6)
