"""The plain C simulation of random loops, and what the study calls a fault."""

import shutil
from collections.abc import Callable

import numpy as np
import pytest

import pneuopt as po
from pneuopt.evaluation.specification import specify
from pneuopt.quantities.arrays import Array
from problems.shared.plain_loop import PlainResponse, plain_kind, simulate_plainly
from problems.tune.random_designs import HORIZONS, KINDS, draw_plant, draw_steps, find_faults, period_mean

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
    np.testing.assert_allclose(plain.y, theirs, atol=3e-4 * abs(step.size))


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
