"""A fixed value that is wrong is named, with what it would be; an error that no value explains names none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from pneuopt.dynamics.hooks import Axis, FinalElement
from pneuopt.dynamics.simulate import simulate
from pneuopt.identification import review
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.review import FixedValueTest, WrongValue, find_wrong_value
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import solve_least_squares
from tests.identification.test_search import posed

TIME = np.arange(0, 4.0, 2e-3)
FORCE = 150 * np.sin(2 * np.pi * 1.3 * TIME) + 60 * np.sin(2 * np.pi * 3.1 * TIME + 1)
NOISE = 1e-3  # of the speed [m/s]
DRIVE = ForceDrive(Coulomb())
GIVEN = DRIVE.parameters.with_values({"friction.coulomb": 30.0, "friction.viscous": 80.0})


def fit_with(name: str, value: float, miss: Callable[[Array], Array] = lambda v: v) -> IdentificationResult:
    """The friction of a drive of which one fixed value is not as given, and whose speed may not be the logged one."""
    inputs = Trajectory(TIME, {"force": FORCE})
    run = simulate(DRIVE.system(), inputs, GIVEN.with_values({name: value}), intersample={"force": Intersample.LINEAR})
    speed = miss(run["speed"]) + NOISE * np.random.default_rng(0).standard_normal(TIME.size)
    log = Experiment(Trajectory(TIME, {"force": FORCE, "speed": speed}), {"speed": NOISE}, name="run")
    free = GIVEN.with_values({"friction.coulomb": 10.0, "friction.viscous": 20.0}).freed("friction.coulomb")
    return identify(DRIVE.system(), log, free.freed("friction.viscous"), throw=False)


@pytest.mark.parametrize(("name", "value", "words"), [("load.mass", 6.5, "6.5 kg in place of 5 kg")])
def test_a_wrong_fixed_value_is_named_with_what_it_would_be(name: str, value: float, words: str) -> None:
    found = fit_with(name, value)
    (sentence,) = [s for s in found.status.sentences if s.startswith("freeing")]
    assert sentence.startswith(f"freeing {name} explains 100% of the misfit, with {words}")
    assert sentence in " ".join(str(found).split())  # what a user sees


def test_nothing_is_named_where_the_values_are_right() -> None:
    assert "freeing" not in str(fit_with("load.mass", GIVEN.value("load.mass")).status)


def test_nothing_is_named_where_no_value_explains_the_misfit() -> None:
    """A sensor that holds its value now and then: nothing in the plant does that."""

    def held(speed: Array) -> Array:
        rows = np.arange(speed.size)
        return np.asarray(speed[rows - rows % 40])

    found = fit_with("load.mass", GIVEN.value("load.mass"), held)
    assert found.stats["chi_square_ratio"] > 4
    assert "freeing" not in str(found.status)


def test_a_value_that_is_wrong_beside_slow_errors_is_named() -> None:
    slow = lfilter([0.02], [1, -0.999], np.random.default_rng(1).standard_normal(TIME.size)) * NOISE
    found = fit_with("load.mass", 6.5, lambda speed: np.asarray(speed + slow))
    assert any(s.startswith("freeing load.mass explains") for s in found.status.sentences)


def test_a_fit_at_the_noise_is_not_tested_and_a_small_change_not_named() -> None:
    """A Coulomb law that meets a Stribeck curve asks for 1.3 % more mass."""
    problem = posed(Coulomb())
    fit = solve_least_squares(problem.transcription(problem.candidates[0]), problem.method)
    test = FixedValueTest()
    assert not test.explains(problem, replace(fit, stats={**fit.stats, "cost": 0.5 * fit.count}))
    assert test.tests == 0
    assert not test.explains(problem, fit)
    assert test.tests == 1


def test_values_that_the_logs_do_not_tell_apart_are_named_together() -> None:
    sentence = str(WrongValue("load.force", 0.0, 9.8, "N", 0.804, 1000.0, ("ambient.pressure",)))
    assert sentence.startswith("freeing load.force explains 80% of the misfit, with 9.8 N in place of 0 N; ambient.")
    assert sentence.endswith("would explain as much: correct it, or free it")


def test_a_lower_bandwidth_may_stand_for_a_dead_time() -> None:
    value = WrongValue("valve.bandwidth", 50.0, 31.5, "Hz", 0.97, 1000.0, lag=1.87e-3)
    assert "with 31.5 Hz in place of 50 Hz; a dead time of 1.9 ms before it looks the same: correct it" in str(value)


@pytest.mark.parametrize(
    ("names", "squares", "named"),
    [
        (("ambient.pressure", "load.force"), (1000.0, 1010.0), "load.force"),  # as good: not the air pressure
        (("ambient.pressure", "load.force"), (1000.0, 1100.0), "ambient.pressure"),  # the logs tell them apart
        (("valve.bandwidth", "load.force"), (1000.0, 1010.0), "valve.bandwidth"),
    ],
)
def test_what_a_user_knows_best_is_named_last(
    names: tuple[str, ...], squares: tuple[float, ...], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, found = posed(Coulomb()), dict(zip(names, squares, strict=True))
    fit = solve_least_squares(problem.transcription(problem.candidates[0]), problem.method)
    axis = Axis(final_element=FinalElement("valve", "spool", "air", "", "", "valve.bandwidth", "", ()))
    problem = replace(problem, system=replace(problem.system.plant, axis=axis))
    monkeypatch.setattr(review, "promised_squares", lambda *_: (2e6, dict.fromkeys(names, 1e3)))
    monkeypatch.setattr(
        review, "_try_freed", lambda _p, _f, name, _e: WrongValue(name, 50.0, 25.0, "Hz", 0.99, found[name])
    )
    value = find_wrong_value(problem, fit)
    assert value is not None
    assert value.name == named
    assert value.alike == ((set(names) - {named}).pop(),) * (squares[1] < 1020)
    assert value.lag == pytest.approx(1 / (2 * np.pi * 50) if named == "valve.bandwidth" else 0.0)
