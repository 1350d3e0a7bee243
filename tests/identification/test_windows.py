"""Windows: logs that a model does not follow from end to end are fitted, and predicted, in parts that it follows."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.signal import lfilter

from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import write_fit
from pneuopt.files.toml import read_toml
from pneuopt.identification import windows
from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.profiles import profile
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Viscous
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    import pandas as pd

STEP = 2e-3  # [s]
TIME = np.arange(0, 5.0, STEP)
FORCE = 150 * np.sin(2 * np.pi * 1.3 * TIME) + 60 * np.sin(2 * np.pi * 3.1 * TIME + 1)
NOISE = 1e-6  # of the position [m]
DRIVE = ForceDrive(Coulomb())
FREE = ("load.mass", "friction.coulomb", "friction.viscous")
TRUTH = DRIVE.parameters.with_values({"load.mass": 8.0, "friction.coulomb": 30.0, "friction.viscous": 80.0})


def slow_force(seed: int) -> Array:
    """A force that no log holds, 3 N in size, which changes over a second or so: a hose, a guide, a slope."""
    normal = np.random.default_rng(seed).standard_normal(TIME.size)
    return np.asarray(3.0 * np.sqrt(2 * STEP) * lfilter([1], [1, STEP - 1], normal))


@cache
def pushed(seed: int | None = 1) -> Experiment:
    """The drive's position over five seconds; with a seed a force acts on it that is not in the log."""
    force = FORCE if seed is None else FORCE + slow_force(seed)
    run = simulate(DRIVE.system(), Trajectory(TIME, {"force": force}), TRUTH, intersample={"force": Intersample.LINEAR})
    noisy = run["position"] + NOISE * np.random.default_rng(0).standard_normal(TIME.size)
    log = Experiment(Trajectory(TIME, {"force": FORCE, "position": noisy}), name="run")
    return log.with_intersample({"force": Intersample.LINEAR})


@cache
def fitted(seed: int | None = 1) -> IdentificationResult:
    return identify(DRIVE.system(), pushed(seed), DRIVE.parameters.freed(*FREE), throw=False)


def far_off(result: IdentificationResult, truth: ParameterSet = TRUTH) -> float:
    return max(abs(result.parameters.value(n) / truth.value(n) - 1) for n in FREE)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_log_that_the_model_does_not_follow_is_fitted_in_windows(seed: int) -> None:
    result = fitted(seed)
    assert result.status.code is Code.CONVERGED, str(result.status)
    assert result.window is not None
    assert result.window.shortest <= result.window.duration <= result.window.longest
    assert f"windows of {result.window.duration:.3g} s are fitted, each with a start of its own: over" in str(
        result.status
    )
    assert far_off(result) < 0.05
    assert set(result.estimates["mark"]) == {Mark.BIAS_POSSIBLE}
    ends = result.estimates[["ci_low", "ci_high"]].to_dict(orient="index")
    assert all(ends[n]["ci_low"] <= TRUTH.value(n) <= ends[n]["ci_high"] for n in FREE), ends


def test_errors_of_a_free_run_stand_beside_those_with_windows() -> None:
    """The free run is that of a simulation which shares nothing with the fit but its parameters and its start."""
    result, log = fitted(), pushed()
    row = figures(result.fit)
    begin = {n: float(result.trajectories["run"][n][0]) for n in ("position", "speed")}
    run = simulate(
        DRIVE.system(), log.trajectory, result.parameters, initial=begin, intersample={"force": Intersample.LINEAR}
    )
    error = run["position"] - log.trajectory["position"]
    assert row["free_run_rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.02)
    assert row["free_run_nrmse"] == pytest.approx(np.linalg.norm(error) / np.linalg.norm(y_centred(log)), rel=0.02)
    assert row["rmse"] < 0.1 * row["free_run_rmse"]


def figures(table: "pd.DataFrame") -> dict[str, float]:
    """The only row of a table of logs and channels."""
    return {str(n): v for n, v in table.to_dict(orient="records")[0].items() if n != "unit"}


def y_centred(log: Experiment) -> Array:
    y = log.trajectory["position"]
    return np.asarray(y - y.mean())


def test_an_exact_log_needs_no_windows() -> None:
    result = fitted(None)
    assert result.window is None
    assert far_off(result) < 0.01
    row = figures(result.fit)
    assert row["free_run_rmse"] < 3 * row["rmse"]


def test_windows_can_be_given() -> None:
    result = identify(DRIVE.system(), pushed(), DRIVE.parameters.freed(*FREE), window=0.5)
    assert result.status.converged
    assert result.window is not None
    assert result.window.duration == 0.5
    assert "windows of 0.5 s are fitted, each with a start of its own, as given" in str(result.status)
    assert far_off(result) < 0.15
    assert list(result.trajectories) == ["run"]


def test_a_wrong_model_has_no_estimate_in_windows_that_is_not_marked() -> None:
    """Viscous friction alone."""
    model = ForceDrive(Viscous())
    result = identify(model.system(), pushed(), model.parameters.freed("load.mass", "friction.viscous"), throw=False)
    assert result.window is not None
    assert set(result.estimates["mark"]) == {Mark.BIAS_POSSIBLE}


def test_a_log_in_one_segment_has_a_covariance() -> None:
    result = identify(
        DRIVE.system(),
        replace(pushed(), trajectory=pushed().trajectory.rows(0, 250)),
        DRIVE.parameters.freed(*FREE),
        method=LeastSquares(segment_time=np.inf),
        throw=False,
    )
    assert result.status.converged
    assert np.isfinite(result.covariance).all(axis=None)


def test_a_prediction_starts_anew_in_each_window() -> None:
    wrong = TRUTH.with_values({"load.force": 1.0})
    table = validate(DRIVE.system(), pushed(None), wrong, window=0.5)
    row, free = figures(table), figures(validate(DRIVE.system(), pushed(None), wrong))
    assert row["free_run_rmse"] == free["rmse"] == free["free_run_rmse"]
    assert row["rmse"] < 0.05 * free["rmse"]
    run = predict(DRIVE.system(), pushed(None), wrong, window=0.5)
    error = run["position"] - pushed(None).trajectory["position"]
    assert row["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)))
    n = 250
    inside = simulate(
        DRIVE.system(),
        pushed(None).trajectory.rows(n, 2 * n),
        wrong,
        initial={s: float(run[s][n]) for s in ("position", "speed")},
        intersample={"force": Intersample.LINEAR},
    )
    assert run["position"][n : 2 * n] == pytest.approx(inside["position"], abs=1e-9)


@pytest.mark.parametrize(("window", "said"), [(1e-3, "hold 0 samples of run"), (11.0, "hold 5500")])
def test_windows_that_no_log_can_be_cut_into_are_refused(window: float, said: str) -> None:
    with pytest.raises(InputError, match=f"windows of {window:g} s {said}.*choose between 0.004 and 5 s"):
        identify(DRIVE.system(), pushed(), DRIVE.parameters.freed(*FREE), window=window)
    with pytest.raises(InputError, match=said):
        validate(DRIVE.system(), pushed(), TRUTH, window=window)


def test_a_profile_of_windows_is_that_of_the_fit() -> None:
    result = fitted()
    found = profile(DRIVE.system(), pushed(), result, "load.mass")
    row = result.estimates.to_dict(orient="index")["load.mass"]
    assert found.low < row["value"] < found.high
    assert found.high - found.low == pytest.approx(row["ci_high"] - row["ci_low"], rel=0.3)


def test_both_errors_are_in_the_file(tmp_path: Path) -> None:
    drive = tmp_path / "drive.toml"
    drive.write_text(
        '[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\ncoulomb = { value = "9 N", free = true }\n'
    )
    write_fit(tmp_path / "fit.toml", drive, fitted())
    agreement: Any = read_toml(tmp_path / "fit.toml")["agreement"]
    row = agreement["run"]["position"]
    assert row["free_run_rmse"] > 10 * row["rmse"] > 0


@pytest.mark.parametrize(("bias", "chosen"), [(0.5, 0.4), (3.0, 0.2)])
def test_longer_windows_are_chosen_only_if_shorter_ones_agree(
    bias: float, chosen: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Narrow intervals of long windows, in which a model's errors add up, have held no truth."""
    problem, tried = Mock(window=math.inf), list[float]()
    whole = Mock(stats={"gap_share": 0.5})

    def trial(_: EstimationProblem, start: object, length: float, __: int) -> Mock:
        tried.append(length)
        assert start is (problem.start_from.return_value if length == 0.4 else "warm")
        value, width = (10.0 + bias, 1.0) if length == 0.4 else (10.0, 1.0 + (0.4 - length))
        parameters = ParameterSet({"gain": Parameter(value, "1", free=True)})
        own = Mock(length=length, is_answer=True, rank=(0, False, math.log(width)), half_widths=np.array([width]))
        own.fit.parameters, own.problem.start_from.return_value = parameters, "warm"
        own.agrees = lambda other: windows._Trial.agrees(own, other)
        return own

    monkeypatch.setattr(windows, "_has_failed_by_gaps", lambda *_: True)
    monkeypatch.setattr(windows, "_lengths", lambda _: [0.1, 0.2, 0.4])
    monkeypatch.setattr(windows, "_try_length", trial)
    found = windows.fit_in_windows(problem, whole)
    assert found is not None
    assert found[2].duration == chosen
    assert tried == [0.4, 0.2, 0.1]  # each begins with the answer of the one before


def test_a_budget_that_ends_in_one_length_leaves_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = list[float]()

    def trial(_: EstimationProblem, __: object, length: float, ___: int) -> Mock:
        tried.append(length)
        own = Mock(length=length, is_answer=length == 0.4, rank=(0, False, 0.0))
        own.fit.status.code = Code.CONVERGED if length == 0.4 else Code.INTERRUPTED
        return own

    monkeypatch.setattr(windows, "_has_failed_by_gaps", lambda *_: True)
    monkeypatch.setattr(windows, "_lengths", lambda _: [0.1, 0.2, 0.4])
    monkeypatch.setattr(windows, "_try_length", trial)
    found = windows.fit_in_windows(Mock(window=math.inf), Mock(stats={"gap_share": 0.5}))
    assert tried == [0.4, 0.2]
    assert found is not None
    assert found[2].duration == 0.4


@cache
def linear_log(plant: FirstOrder | SecondOrder) -> tuple[Experiment, ParameterSet]:
    """Three thousand samples of a linear plant under random steps of its input, and its parameters; noise as stated."""
    rng, system = np.random.default_rng(5), plant.system()
    slow = {"plant.time_constant": 0.05} if isinstance(plant, FirstOrder) else {"plant.natural_frequency": 20.0}
    truth = system.parameters.with_values({"plant.gain": 0.5, **slow})
    t, steps = np.arange(3000) * 0.01, np.repeat(rng.choice([-2.0, 2.0], 300), 10)
    run = simulate(system, Trajectory(t, {"valve_voltage": steps}), truth)
    noisy = run["speed"] + 0.02 * rng.standard_normal(t.size)
    return Experiment(Trajectory(t, {"valve_voltage": steps, "speed": noisy}), {"speed": 0.02}, name="run"), truth


@pytest.mark.parametrize(("plant", "length"), [(FirstOrder(), n) for n in (100, 20, 5, 3)] + [(SecondOrder(), 5)])
def test_the_start_state_of_each_window_takes_a_degree_of_freedom(plant: FirstOrder | SecondOrder, length: int) -> None:
    """Residuals of the stated noise have a chi-square ratio of one, within four of its standard deviations."""
    log, truth = linear_log(plant)
    result = identify(plant.system(), log, truth.freed("plant.*"), window=0.01 * length)
    freedom = 3000 * (1 - len(plant.system().states) / length)
    assert result.stats["chi_square_ratio"] == pytest.approx(1.0, abs=4 * math.sqrt(2 / freedom))
