"""From logs to estimates: whole fits, their options and budgets, what is printed; a drive from whatever was logged."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom
from threadpoolctl import threadpool_info, threadpool_limits

import pneuopt as po
from pneuopt.dynamics.compiled.rollout import Gram, Pieces, Rollout
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import Symbols, System, define, discretise, names, parameter_vector
from pneuopt.identification.forecast import predict, validate
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.identification.select_model import select_model
from pneuopt.logs.experiment import Experiment
from pneuopt.models.catalog import b32
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import (
    Asymmetric,
    Coulomb,
    FrictionModel,
    LoadDependent,
    LuGre,
    PressureDependent,
    Stribeck,
)
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, LogError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity, usual_intersample
from pneuopt.quantities.status import Code, Progress
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares
from problems.shared.b32 import FREE as RIG_FREE
from problems.shared.b32 import LOGGED, VALVE, generate

TRUTH = {
    "load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0, "friction.static": 42.0,
    "friction.stribeck_velocity": 0.025, "friction.bristle_stiffness": 6e4, "friction.coulomb_asymmetry": 0.1,
    "friction.viscous_asymmetry": -0.2,
}  # fmt: skip
NOISE = {"position": 2e-5, "speed": 1e-3, "force": 0.2}


def generated(
    system: System, inputs: Mapping[str, Array], t: Array, truth: Mapping[str, float], seed: int, *channels: str
) -> Experiment:
    """A noisy log from rest, by 40 steps of RK4 a sample; never the estimator's own steps.

    Within a sample each step has an input of its own where that is not held.
    """
    sampled, rng = discretise(system), np.random.default_rng(seed)
    known = {n: v for n, v in truth.items() if n in system.parameters}
    p = parameter_vector(system.parameters, system.parameters.with_values(known))
    u, h = np.column_stack(list(inputs.values())), np.append(np.diff(t), t[-1] - t[-2])
    linear = [usual_intersample(q.name, q.unit) is Intersample.LINEAR for q in system.inputs]
    rise = np.where(linear, np.diff(u, axis=0, append=u[-1:]), 0.0)
    within = (np.arange(40) + 0.5) / 40
    fine_u = (u[:, None] + within[:, None] * rise[:, None]).reshape(-1, u.shape[1])
    fine_h, fine_t = np.repeat(h / 40, 40), (t[:, None] + h[:, None] * np.arange(40) / 40).ravel()
    x0 = np.zeros((1, len(system.states)))
    y = Rollout(Pieces(sampled.step)).run(x0, fine_u[None], p, fine_t[None], fine_h[None]).y[0, ::40]
    found = dict(zip(names(system.outputs), y.T, strict=True))
    noisy = {c: found[c] + NOISE[c] * rng.standard_normal(t.size) for c in channels}
    return Experiment(Trajectory(t, {**inputs, **noisy}), name=f"run {seed}")


def times(seconds: float, jitter: float = 0.0) -> Array:
    n = round(1000 * seconds)
    t = np.linspace(0, seconds, n, endpoint=False)
    return np.asarray(t + 1e-3 * jitter * np.random.default_rng(99).uniform(-0.5, 0.5, n))


def pushed(
    friction: FrictionModel, *channels: str, seed: int = 0, seconds: float = 2.0, jitter: float = 0.0, **truth: float
) -> Experiment:
    """A drive that slides, sticks and turns under a known force."""
    t = times(seconds, jitter)
    force = 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t + seed)
    values = {**TRUTH, **{n.replace("__", "."): v for n, v in truth.items()}}
    return generated(ForceDrive(friction).system(), {"force": force}, t, values, seed, *(channels or ("position",)))


def known(friction: FrictionModel) -> ParameterSet:
    """The drive's true values; what is freed starts from them, but no start finder reads those."""
    parameters = ForceDrive(friction).parameters
    return parameters.with_values({n: v for n, v in TRUTH.items() if n in parameters})


def read(table: pd.DataFrame, row: str | tuple[str, str], column: str) -> float:
    return float(np.asarray(table.loc[[row], column])[0])


def deviations(result: IdentificationResult, truth: Mapping[str, float] = TRUTH) -> dict[str, float]:
    """Distance of each estimate from the truth, in its own standard deviations."""
    rows, own = (
        result.estimates,
        {n: truth.get(n, truth.get(n.split("[")[0], math.nan)) for n in result.estimates.index},
    )
    return {n: abs(read(rows, n, "value") - own[n]) / read(rows, n, "stderr") for n in rows.index}


def assert_recovered(result: IdentificationResult, most: float = 4.0) -> None:
    assert result.status.converged
    off = deviations(result)
    assert max(off.values()) < most, off
    assert result.stats["chi_square_ratio"] == pytest.approx(1, abs=0.15)


FREE = ("load.mass", "load.force", "friction.coulomb", "friction.viscous")
CASES: dict[str, tuple[FrictionModel, tuple[str, ...]]] = {
    "coulomb": (Coulomb(), FREE),
    "stribeck": (Stribeck(), (*FREE, "friction.static", "friction.stribeck_velocity")),
    "lugre": (LuGre(), (*FREE, "friction.static", "friction.stribeck_velocity", "friction.bristle_stiffness")),
    "asymmetric": (Asymmetric(Coulomb()), ("load.mass", "friction.*")),
}


@pytest.mark.parametrize("channels", [("position",), ("speed",), ("position", "speed")])
@pytest.mark.parametrize("name", ["coulomb", "stribeck", "lugre"])
def test_known_parameters_are_recovered_without_a_guess(name: str, channels: tuple[str, ...]) -> None:
    friction, free = CASES[name]
    defaults = ForceDrive(friction).parameters  # none of them true
    result = identify(ForceDrive(friction).system(), [pushed(friction, *channels)], defaults.freed(*free))
    assert_recovered(result)
    assert tuple(result.fit.index.get_level_values("channel")) == channels
    assert result.stats["largest_gap"] < 1e-4
    assert result.stats["integration_error"] < 0.02
    for channel in channels:
        for column in ("rmse", "noise"):
            assert read(result.fit, ("run 0", channel), column) == pytest.approx(NOISE[channel], rel=0.1)
    relative = result.estimates["stderr"] / result.estimates["value"]
    assert relative[["load.mass", "friction.coulomb", "friction.viscous"]].max() < 0.01


def test_directions_are_separated() -> None:
    friction = Asymmetric(Coulomb())
    free = ("load.mass", "friction.coulomb", "friction.viscous", "friction.*_asymmetry")
    fixed = known(friction).with_values({"friction.coulomb_asymmetry": 0.0, "friction.viscous_asymmetry": 0.0})
    assert_recovered(identify(ForceDrive(friction).system(), [pushed(friction)], fixed.freed(*free)))


def test_jittered_time_and_missing_samples() -> None:
    log = pushed(Coulomb(), jitter=0.8)
    holed = log.trajectory["position"].copy()
    rng = np.random.default_rng(0)
    holed[rng.random(holed.size) < 0.2] = math.nan
    holed[500:540] = math.nan
    log = replace(log, trajectory=log.trajectory.with_columns({"position": holed}))
    result = identify(ForceDrive(Coulomb()).system(), [log], ForceDrive(Coulomb()).parameters.freed(*FREE))
    assert_recovered(result)
    assert result.fit["samples"].iloc[0] == np.isfinite(holed).sum()


def test_conditions_and_own_values_of_each_log() -> None:
    """Two logs: another mass, which is known, and another force, which is not."""
    a = pushed(Coulomb(), seed=1, load__mass=2.0, load__force=-4.0).with_conditions({"load.mass": 2.0})
    b = pushed(Coulomb(), seed=2, load__mass=6.0, load__force=9.0).with_conditions({"load.mass": 6.0})
    free = ForceDrive(Coulomb()).parameters.freed("friction.coulomb", "friction.viscous", "load.force")
    result = identify(ForceDrive(Coulomb()).system(), [a, b], free.per_log("load.force"))
    assert list(result.estimates.index) == [
        "friction.coulomb",
        "friction.viscous",
        "friction.smoothing",
        "load.force[run 1]",
        "load.force[run 2]",
    ]
    truth = {**TRUTH, "load.force[run 1]": -4.0, "load.force[run 2]": 9.0}
    off = deviations(result, truth)
    assert max(off.values()) < 4, off
    assert result.parameters.value("load.force") == free.value("load.force")
    light = b.with_conditions({"load.mass": 2.0})
    with pytest.raises(LogError, match=r"those of (5\.9|6\.0)\d kg, [\d.]+ times the stated load\.mass of 2 kg"):
        identify(ForceDrive(Coulomb()).system(), [light], free)
    wrong = identify(ForceDrive(Coulomb()).system(), [light], free, accept=["mass"], throw=False)
    assert wrong.stats["chi_square_ratio"] > 100


def test_a_condition_makes_a_free_parameter_known_in_its_log() -> None:
    a = pushed(Coulomb(), seed=1).with_conditions({"load.mass": 3.0})
    b = pushed(Coulomb(), seed=2)
    free = ForceDrive(Coulomb()).parameters.freed(*FREE)
    assert_recovered(identify(ForceDrive(Coulomb()).system(), [a, b], free))
    own = identify(ForceDrive(Coulomb()).system(), [a, b], free.per_log("load.mass"))
    assert "load.mass[run 2]" in own.estimates.index
    assert "load.mass[run 1]" not in own.estimates.index
    assert_recovered(own)


def rig_log(name: str, pressure: float, offset: float, seed: int) -> Experiment:
    system = MotionDrive(PressureDependent(Coulomb(), ("pressure_a",))).system()
    t = np.linspace(0, 8, 800, endpoint=False)
    inputs = {"speed": 0.01 * np.sin(2 * np.pi * t / 4), "pressure_a": np.full_like(t, pressure)}
    truth = {"friction.coulomb": 4.0, "friction.coulomb_pressure_a": 1.5e-5, "friction.viscous": 0.0}
    log = generated(system, inputs, t, {**truth, "rig.force_offset": offset}, seed, "force")
    return replace(log, name=name)


def test_a_rigs_friction_rises_with_pressure() -> None:
    logs = [rig_log(f"{k}", 1e5 * k, 0.5 * k, k) for k in (2, 4, 6)]
    rig = MotionDrive(PressureDependent(Coulomb(), ("pressure_a",)))
    p = rig.parameters.with_values({"friction.viscous": 0.0})
    p = p.freed("friction.coulomb", "friction.coulomb_pressure_a", "rig.force_offset").per_log("rig.force_offset")
    result = identify(rig.system(), logs, p)
    truth = {"friction.coulomb": 4.0, "friction.coulomb_pressure_a": 1.5e-5}
    truth |= {f"rig.force_offset[{k}]": 0.5 * k for k in (2, 4, 6)}
    assert max(deviations(result, truth).values()) < 4
    assert result.stats["largest_gap"] == 0


@cache
def tiny(seed: int) -> IdentificationResult:
    log = pushed(Coulomb(), seed=seed, seconds=0.6)
    return identify(ForceDrive(Coulomb()).system(), [log], ForceDrive(Coulomb()).parameters.freed(*FREE), throw=False)


def covered(seeds: int) -> tuple[int, int]:
    """How many intervals without a mark hold the truth, and how many there are."""
    tables = [tiny(seed).estimates for seed in range(seeds)]
    rows = [(r, n) for r in tables for n in FREE if r["mark"][n] in (Mark.EXACT, Mark.WIDENED)]
    return sum(int(read(r, n, "ci_low") <= TRUTH[n] <= read(r, n, "ci_high")) for r, n in rows), len(rows)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """40 noise draws (and excitations) of 4 parameters, which are correlated: so a wide binomial range."""
    assert all(tiny(seed).status.converged for seed in range(40))
    inside, count = covered(40)
    assert count > 100
    assert binom.ppf(0.001, count, 0.95) - 4 <= inside <= binom.ppf(0.9999, count, 0.95), f"{inside} of {count}"


@pytest.mark.slow
def test_intervals_hold_the_truth_over_many_draws() -> None:
    inside, count = covered(400)
    assert 0.93 <= inside / count <= 0.97, f"{inside} of {count}"


def test_a_parameter_at_its_bound_is_marked_and_has_no_interval() -> None:
    free = known(Coulomb()).with_values({"friction.coulomb": 20.0}).with_bounds({"friction.coulomb": (0.0, 29.5)})
    result = identify(ForceDrive(Coulomb()).system(), [pushed(Coulomb())], free.freed(*FREE), throw=False)
    row = result.estimates.loc["friction.coulomb"]
    assert row["value"] == 29.5
    assert row["at_bound"]
    assert np.isnan([row["stderr"], row["ci_low"], row["ci_high"]]).all()
    others = result.estimates.drop("friction.coulomb")
    assert not others["at_bound"].any()
    assert np.isfinite(others["stderr"]).all()


def doubled() -> System:
    """A drive whose viscous friction has a twin: only the sum of both acts."""
    base = ForceDrive(Coulomb()).system()

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        drag = (p["friction.viscous"] + p["twin"]) * x["speed"]
        rub = p["friction.coulomb"] * ca.tanh(x["speed"] / p["friction.smoothing"])
        rates = {"position": x["speed"], "speed": (u["force"] - p["load.force"] - rub - drag) / p["load.mass"]}
        return rates, {"position": x["position"], "speed": x["speed"]}

    parameters = base.parameters | ParameterSet({"twin": Parameter(0.0, "N*s/m")})
    return define(base.states, base.inputs, base.outputs, parameters, rhs, base.start_hook)


def test_twins_never_get_an_interval_and_spoil_no_other() -> None:
    """One of them stays where it was given, the other makes up their sum; neither is a number."""
    system, log = doubled(), pushed(Coulomb())
    result = identify(system, [log], system.parameters.freed(*FREE, "twin"))
    alone = identify(system, [log], system.parameters.freed(*FREE))
    twins, rows = ["friction.viscous", "twin"], result.estimates
    assert rows["note"][rows["note"] == "unidentifiable"].index.tolist() == twins
    assert np.isnan(rows.loc[twins, ["value", "stderr", "ci_low", "ci_high"]]).all(axis=None)
    assert sum(result.parameters.value(n) for n in twins) == pytest.approx(60, rel=0.01)
    assert result.parameters.value("twin") == 0.0
    assert "the logs do not identify friction.viscous and twin" in result.status.sentences
    assert result.verdict is not None
    assert "friction.viscous and twin act only together" in " ".join(result.verdict.sentences)
    others = alone.estimates.drop("friction.viscous")[["value", "stderr"]]
    pd.testing.assert_frame_equal(rows.drop(twins)[["value", "stderr"]], others, rtol=1e-3)


def test_a_parameter_that_the_log_does_not_reach_is_named() -> None:
    """The drive never moves fast enough to show anything else than sticking."""
    t = times(1.0)
    force = 5 + 8 * np.sin(2 * np.pi * t)  # well below 30 N
    log = generated(ForceDrive(Coulomb()).system(), {"force": force}, t, TRUTH, 0, "position")
    free = ForceDrive(Coulomb()).parameters.freed("load.mass", "friction.coulomb", "friction.viscous")
    result = identify(ForceDrive(Coulomb()).system(), [log], free, throw=False)
    spread = result.estimates["stderr"] / result.estimates["value"].abs()
    for name in ("load.mass", "friction.viscous"):
        assert not spread[name] < 0.1  # NaN, or wide


@pytest.mark.parametrize("throw", [True, False])
def test_no_convergence_is_raised_or_marked(throw: bool) -> None:
    """A log of which the model knows nothing: the position of another force."""
    log = pushed(Coulomb())
    other = pushed(Coulomb(), seed=5).trajectory["force"]
    log = replace(log, trajectory=log.trajectory.with_columns({"force": other[::-1]}))
    free = ForceDrive(Coulomb()).parameters.freed(*FREE)
    short = LeastSquares(stages=LeastSquares().stages[:1])
    if throw:
        with pytest.raises(ConvergenceError, match="identification NOT converged") as caught:
            identify(ForceDrive(Coulomb()).system(), [log], free, method=short)
        result = caught.value.solution
    else:
        result = identify(ForceDrive(Coulomb()).system(), [log], free, method=short, throw=False)
    assert result.status.code is Code.NOT_CONVERGED
    assert "gaps between segments carry" in result.status.message


def test_an_interruption_keeps_the_best_iterate() -> None:
    seen: list[str] = []

    def progress(line: str) -> None:
        seen.append(line)
        if len(seen) == 5:
            raise KeyboardInterrupt

    free = ForceDrive(Coulomb()).parameters.freed(*FREE)
    method = LeastSquares(progress=progress)
    result = identify(ForceDrive(Coulomb()).system(), [pushed(Coulomb())], free, method=method, throw=False)
    assert result.status.code is Code.INTERRUPTED
    assert len(seen) == 5
    assert result.estimates["value"]["friction.coulomb"] == pytest.approx(30, rel=0.05)
    seen.clear()
    with pytest.raises(ConvergenceError, match="interrupted"):
        identify(ForceDrive(Coulomb()).system(), [pushed(Coulomb())], free, method=method)


def test_the_result_says_where_it_comes_from() -> None:
    log = replace(pushed(Coulomb()), sha256="abc")
    result = identify(ForceDrive(Coulomb()).system(), [log], ForceDrive(Coulomb()).parameters.freed(*FREE))
    assert result.provenance["sha256[run 0]"] == "abc"
    assert result.provenance["start"] == "equation error"
    assert {"pneuopt", "casadi", "numpy", "scipy", "python", "options"} <= set(result.provenance)
    assert result.covariance.index.tolist() == result.estimates.index.tolist()
    variance = read(result.covariance, "load.mass", "load.mass")
    assert math.sqrt(variance) == pytest.approx(read(result.estimates, "load.mass", "stderr"))
    assert result.trajectories["run 0"].names == ("position", "speed")
    assert result.parameters.free_names == (*FREE, "friction.smoothing")  # whose width nobody has stated


def test_a_wrong_basin_is_not_the_answer_if_another_start_is_better() -> None:
    """Of two starts the first converges elsewhere; the second's residuals are at the noise."""
    base = ForceDrive(Coulomb()).system()
    truth = known(Coulomb())

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        # two values of "turn" give a minimum: the true one at 2, a worse one at -1
        coulomb = 30 - 4 * (p["turn"] - 2) ** 2 * (p["turn"] + 1) ** 2 - 2 * (p["turn"] - 2) ** 2
        rub = coulomb * ca.tanh(x["speed"] / 1e-3)
        rates = {"position": x["speed"], "speed": (u["force"] - 5 - rub - 60 * x["speed"]) / 3}
        return rates, {"position": x["position"], "speed": x["speed"]}

    turn = ParameterSet({"turn": Parameter(2.0, "1", free=True)})

    def finder(logs: Mapping[str, object]) -> list[object]:
        from pneuopt.dynamics.hooks import Log, Start

        (start,) = base.starts({n: Log(e.measured, truth) for n, e in logs.items()})  # type: ignore[attr-defined]
        return [Start(start.states, {"turn": value}, f"{value}") for value in (-0.9, -1.1, 2.1)]

    system = define(base.states, base.inputs, base.outputs, turn, rhs, finder)  # type: ignore[arg-type]
    result = identify(system, [pushed(Coulomb())], turn)
    assert result.estimates["value"]["turn"] == pytest.approx(2.0, abs=0.1)


def test_a_held_out_run_is_predicted() -> None:
    stated = ForceDrive(Stribeck()).parameters.with_values({"friction.smoothing": 1e-3})
    free = stated.freed(*CASES["stribeck"][1])
    logs = [pushed(Stribeck(), "position", "speed", seed=seed) for seed in range(4)]
    fit = identify(ForceDrive(Stribeck()).system(), logs, free)
    held_out = pushed(Stribeck(), "position", "speed", seed=7, seconds=1.0)
    table = validate(ForceDrive(Stribeck()).system(), [held_out], fit.parameters)
    assert read(table, ("run 7", "position"), "rmse") < 1.5 * NOISE["position"]
    assert read(table, ("run 7", "speed"), "fit_percent") > 95
    wrong = validate(
        ForceDrive(Stribeck()).system(), [held_out], fit.parameters.with_values({"friction.coulomb": 20.0})
    )
    assert read(wrong, ("run 7", "position"), "rmse") > 100 * NOISE["position"]
    run = predict(ForceDrive(Stribeck()).system(), held_out, fit.parameters)
    assert len(run) == len(held_out.trajectory)


def test_validation_says_what_is_left_in_the_residuals() -> None:
    log, system = pushed(Coulomb(), "position", seed=3, seconds=0.5), ForceDrive(Coulomb()).system()
    good = validate(system, [log], known(Coulomb())).iloc[0]
    assert good["whiteness_p"] > 0.001
    assert good["correlation[force]"] < 4
    assert 0 <= good["lag[force]"] <= 20
    heavier = validate(system, [log], known(Coulomb()).with_values({"load.mass": 3.3})).iloc[0]
    assert heavier["whiteness_p"] < 1e-6
    assert heavier["correlation[force]"] > 5


def test_validation_reads_conditions_and_defaults() -> None:
    log = pushed(Coulomb(), seed=3, seconds=0.5, load__mass=7.0)
    partly = known(Coulomb()).select([n for n in known(Coulomb()) if n != "load.mass"])
    system = ForceDrive(Coulomb()).system()
    good = validate(system, [log.with_conditions({"load.mass": 7.0})], partly)["rmse"].iloc[0]
    assert good < 1.5 * NOISE["position"]
    assert validate(system, [log], partly)["rmse"].iloc[0] > 10 * good


def blas_threads() -> set[int]:
    return {int(library["num_threads"]) for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_has_one_thread_during_a_fit_and_its_own_again_after_it() -> None:
    drive, t = po.ForceDrive(po.Coulomb()), np.arange(1000) * 1e-3
    truth = drive.parameters.with_values({"load.mass": 3.0, "friction.coulomb": 30.0, "friction.viscous": 60.0})
    force = po.Trajectory(t, {"force": 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t)})
    run, noise = po.simulate(drive.system(), force, truth), np.random.default_rng(0).standard_normal(t.size)
    log = po.Experiment(force.with_columns({"position": run["position"] + 2e-5 * noise}), name="run")
    used = set[int]()
    with threadpool_limits(3, user_api="blas"):
        before = blas_threads()
        po.identify(drive.system(), [log], truth.freed("friction.*"), progress=lambda _: used.update(blas_threads()))
        assert used == {1}
        assert blas_threads() == before
        assert 1 not in before


DRIVE = ForceDrive(Coulomb())
PARAMETERS = DRIVE.parameters.freed(*FREE)


def fit_within(budget: float, parameters: ParameterSet = PARAMETERS) -> IdentificationResult:
    return identify(DRIVE, [pushed(Coulomb())], parameters, cpu_seconds=budget, throw=False)


def test_a_spent_budget_leaves_the_best_values_and_says_so_first() -> None:
    result = fit_within(1e-9)
    assert result.status.code is Code.BUDGET
    assert not result.status.converged
    assert result.status.verdict.startswith("the CPU budget of 1e-09 s is spent")
    assert str(result.status).startswith("NOT converged (the CPU budget is spent)")
    assert np.isfinite(result.estimates["value"]).all()
    assert result.estimates["ci_low"].isna().all()


def test_a_search_begins_again_where_a_budget_has_ended_it(monkeypatch: pytest.MonkeyPatch) -> None:
    gram, evaluations = Rollout.gram, list[Gram]()

    def evaluate(*given: Any, **options: Any) -> Gram:
        evaluations.append(gram(*given, **options))  # each takes a second
        return evaluations[-1]

    monkeypatch.setattr(Rollout, "gram", evaluate)
    monkeypatch.setattr("pneuopt.shooting.least_squares.time.process_time", lambda: float(len(evaluations)))
    stated = PARAMETERS.with_values({"friction.smoothing": 1.1e-3})  # no width is left to choose before the search
    ended = fit_within(4.0, stated)
    monkeypatch.undo()
    assert ended.status.code is Code.BUDGET
    assert ended.stats["iterations"] == 2
    again = identify(DRIVE, [pushed(Coulomb())], stated, start=ended, throw=False)
    assert again.status.converged
    assert again.estimates["value"]["friction.coulomb"] == pytest.approx(30, rel=0.05)


def test_a_budget_that_suffices_changes_nothing() -> None:
    with_budget, without = fit_within(1e3), fit_within(math.inf)
    assert with_budget.status == without.status
    assert (with_budget.estimates["value"] == without.estimates["value"]).all()


def test_a_spent_budget_is_no_convergence() -> None:
    with pytest.raises(ConvergenceError, match="CPU budget of 1e-09 s") as caught:
        identify(DRIVE, [pushed(Coulomb())], PARAMETERS, cpu_seconds=1e-9)
    assert isinstance(caught.value.solution, IdentificationResult)


def step_log() -> Experiment:
    t = np.arange(0, 0.5, 2e-3)
    noise = np.random.default_rng(0).normal(0, 1e-3, len(t))
    moves = t >= 0.05
    speed = np.where(moves, 2.0 * (1 - np.exp(-(t - 0.05) / 0.08)), 0.0) + noise
    command = moves.astype(float)
    return Experiment(Trajectory(t, {"valve_voltage": command, "speed": speed}), {"speed": 1e-3}, name="step")


@pytest.fixture(scope="module")
def step_fit() -> IdentificationResult:
    plant = FirstOrder()
    heard: list[Progress] = []
    free = plant.system().parameters.freed("plant.gain", "plant.time_constant")
    found = identify(plant, step_log(), free, progress=heard.append)
    assert heard
    assert {report.job for report in heard} == {"identify"}
    assert all(a.seconds <= b.seconds for a, b in pairwise(heard))
    return found


@pytest.mark.parametrize("columns", ["60", "80"])
def test_a_fit_is_printed_verdict_first_with_intervals_and_no_doubt(
    step_fit: IdentificationResult, columns: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    text = str(step_fit)
    assert text == repr(step_fit) == step_fit.summary().to_text()
    assert text.startswith("converged: ")
    assert max(map(len, text.splitlines())) <= int(columns)
    (line,) = [line for line in text.splitlines() if line.startswith("plant.gain")]
    assert re.search(r" [\d.]+ to ", line)
    assert line.endswith(step_fit.estimates["unit"]["plant.gain"])
    page = step_fit._repr_html_()
    assert page.count("<table>") == 2
    assert "plant.time_constant" in page


def test_predictions_and_selections_tell_how_far_they_are(step_fit: IdentificationResult) -> None:
    heard: list[Progress] = []
    validate(FirstOrder(), step_log(), step_fit.parameters, progress=heard.append)
    predict(FirstOrder(), step_log(), step_fit.parameters, progress=heard.append)
    models: dict[str, FirstOrder | SecondOrder] = {"first": FirstOrder(), "second": SecondOrder()}
    free = ["plant.gain", "plant.time_constant", "plant.damping", "plant.natural_frequency"]
    found = select_model(models, step_log(), ParameterSet(), free=free, progress=heard.append)
    assert list(dict.fromkeys(report.job for report in heard)) == ["validate", "predict", "select_model"]
    assert "fitting first, 1 of 2 candidates" in heard
    text = found.summary().to_text(80)
    assert text.startswith("first, of ")
    assert max(map(len, text.splitlines())) <= 80


WRONG = {"valve.conductance": 5e-8, "valve.leak": 0.0, "load.mass": 4.0, "supply.pressure": 6.5e5}
WRONG |= {"valve.critical_ratio": 0.3, "valve.dead_zone": 0.0}
RIG_TRUTH = {"supply.pressure": 6e5, "load.mass": 3.0}


@pytest.fixture(scope="module")
def drive_log() -> po.Experiment:
    drive, truth = b32()
    return generate(drive, truth, seconds=2.0)


def blind(drive: PneumaticDrive, truth: po.ParameterSet, *free: str) -> po.ParameterSet:
    """Free parameters start from the drive's defaults or from wrong values; no start finder reads friction's."""
    return truth.with_values({n: WRONG.get(n, drive.parameters.value(n)) for n in free}).freed(*free)


def check_estimates(fit: po.IdentificationResult, truth: Mapping[str, float], near: float) -> None:
    """Within some percent, and within four deviations."""
    for name, row in fit.estimates.iterrows():
        true = truth[str(name)]
        assert row["value"] == pytest.approx(true, rel=near), name
        assert abs(row["value"] - true) < 4 * row["stderr"], name


def numbers(truth: po.ParameterSet) -> dict[str, float]:
    return {n: p.value for n, p in truth.items()}


@pytest.mark.parametrize(
    ("channels", "free"),
    [
        (("position", "pressure_a"), (*RIG_FREE, *VALVE)),
        (("position", "pressure_b"), (*RIG_FREE, *VALVE)),
        (("position",), RIG_FREE),
        (("position",), (*RIG_FREE, *VALVE)),
    ],
)
def test_fewer_channels_still_tell(drive_log: po.Experiment, channels: tuple[str, ...], free: tuple[str, ...]) -> None:
    drive, truth = b32()
    fit = po.identify(drive.system(), [drive_log.select(("valve_voltage", *channels))], blind(drive, truth, *free))
    check_estimates(fit, numbers(truth), 0.05)


@pytest.mark.parametrize("off", [0.0, -0.02])
def test_speed_alone_identifies_friction_and_where_it_began(drive_log: po.Experiment, off: float) -> None:
    """The air in both chambers identifies the position, if the log begins elsewhere than it is said to."""
    drive, truth = b32()
    true = float(drive_log.trajectory["position"][0])
    begin = {"cylinder.start": (true + off) / truth.value("cylinder.stroke")}
    speed = drive_log.select(("valve_voltage", "speed")).with_conditions(begin)
    fit = po.identify(drive.system(), [speed], blind(drive, truth, *RIG_FREE))
    check_estimates(fit, numbers(truth), 0.15)
    assert fit.trajectories["b32"]["position"][0] == pytest.approx(true, abs=1e-3)


def test_supply_and_load_are_known_of_each_log_or_found_for_each(drive_log: po.Experiment) -> None:
    drive, truth = b32()
    other = replace(generate(drive, truth.with_values(RIG_TRUTH), seconds=2.0).select(LOGGED), name="other")
    logs = [replace(drive_log.select(LOGGED), name="first"), other]
    known = [logs[0], other.with_conditions(RIG_TRUTH)]
    check_estimates(po.identify(drive.system(), known, blind(drive, truth, *RIG_FREE, *VALVE)), numbers(truth), 0.02)
    own = blind(drive, truth, *RIG_FREE, *VALVE, *RIG_TRUTH).per_log(*RIG_TRUTH)
    each = {f"{n}[first]": truth.value(n) for n in RIG_TRUTH} | {f"{n}[other]": v for n, v in RIG_TRUTH.items()}
    fit = po.identify(drive.system(), logs, own)
    assert set(each) <= set(fit.estimates.index)
    check_estimates(fit, numbers(truth) | each, 0.02)


def test_dead_zone_and_critical_ratio_are_found_with_friction() -> None:
    drive, truth = b32()
    truth = truth.with_values({"valve.dead_zone": 0.05, "valve.critical_ratio": 0.4})
    free = (*RIG_FREE, *VALVE, "valve.dead_zone", "valve.critical_ratio")
    drive_log = generate(drive, truth, seconds=2.0).select(LOGGED)
    check_estimates(po.identify(drive.system(), [drive_log], blind(drive, truth, *free)), numbers(truth), 0.05)


def test_friction_from_the_force_of_the_logged_pressures_comes_near(drive_log: po.Experiment) -> None:
    drive, truth = b32()
    force = drive.air_force(drive_log.trajectory, truth)
    p = numbers(truth)
    areas = np.pi / 4 * p["cylinder.bore"] ** 2 * np.array([1, 1 - (p["cylinder.rod"] / p["cylinder.bore"]) ** 2])
    gauge = drive_log.trajectory.matrix(["pressure_a", "pressure_b"]) - p["ambient.pressure"]
    assert force == pytest.approx(gauge @ (areas * [1, -1]))
    load = po.ForceDrive(drive.friction, drive.load)
    pushed = replace(drive_log, trajectory=drive_log.trajectory.with_columns({"force": force})).select(
        ["force", "position"]
    )
    known = truth.select(load.parameters)
    free = {n: load.parameters.value(n) for n in RIG_FREE}
    fit = po.identify(load.system(), [pushed], known.with_values(free).freed(*RIG_FREE), throw=False)
    for name in ("friction.coulomb", "friction.static", "friction.viscous"):
        assert fit.parameters.value(name) == pytest.approx(truth.value(name), rel=0.1), name


MASS, COULOMB, VISCOUS, SMOOTHING, FORCE_NOISE = 5.0, 20.0, 80.0, 5e-3, 5e-6
FORCE_TRUTH = {"load.mass": MASS, "friction.coulomb": COULOMB, "friction.viscous": VISCOUS}
HELD = {"force": Intersample.HELD}


def push(t: Array) -> Array:
    """A force of up to 6 Hz [N], continuous."""
    turns = 2 * math.pi * np.asarray(t)
    return np.asarray(60 * np.sin(1.3 * turns) + 25 * np.sin(3.1 * turns + 1) + 10 * np.sin(5.7 * turns + 2))


@cache
def response(rate: float, seconds: float, load: float) -> Array:
    """The position that SciPy finds at the samples, friction rising by `load` times the force."""

    def slope(t: float, x: Array) -> list[float]:
        force = float(push(np.array(t)))
        friction = (COULOMB + load * abs(force)) * math.tanh(x[1] / SMOOTHING) + VISCOUS * x[1]
        return [x[1], (force - friction) / MASS]

    t = np.arange(round(seconds * rate) + 1) / rate
    run = solve_ivp(slope, (0, t[-1]), [0.1, 0.0], "LSODA", t, rtol=1e-9, atol=1e-12, max_step=2e-3)
    return np.asarray(run.y[0])


def logged(rate: float, seconds: float = 6.0, load: float = 0.0, **others: object) -> Experiment:
    t = np.arange(round(seconds * rate) + 1) / rate
    x = response(rate, seconds, load) + FORCE_NOISE * np.random.default_rng(1).standard_normal(t.size)
    return Experiment(Trajectory(t, {"force": push(t), "position": x}), {"position": FORCE_NOISE}, name="run", **others)  # type: ignore[arg-type]


def fitted_force_log(log: Experiment, load: float = 0.0, *, throw: bool = True) -> IdentificationResult:
    drive = ForceDrive(LoadDependent(Coulomb()) if load else Coulomb())
    free = drive.parameters.with_values({"friction.smoothing": SMOOTHING}).freed(*FORCE_TRUTH)
    return identify(drive, log, free.freed("friction.coulomb_load") if load else free, throw=throw)


def errors(result: IdentificationResult) -> dict[str, float]:
    found: pd.Series = result.estimates["value"]
    return {n: float(found[n]) / true - 1 for n, true in FORCE_TRUTH.items()}


@pytest.mark.parametrize(("rate", "off"), [(50.0, 0.02), (100.0, 0.005), (500.0, 0.001)])
def test_a_measured_force_is_not_held_over_the_sample(rate: float, off: float) -> None:
    found = errors(fitted_force_log(logged(rate)))
    assert max(map(abs, found.values())) < off, found


def test_held_over_the_sample_the_same_log_gives_another_mass() -> None:
    assert errors(fitted_force_log(logged(50.0, intersample=HELD), throw=False))["load.mass"] < -0.1


def test_load_dependent_friction_from_four_seconds_at_100_hz() -> None:
    found = errors(fitted_force_log(logged(100.0, 4.0, load=0.1), load=0.1))
    assert max(abs(found["load.mass"]), abs(found["friction.coulomb"])) < 0.05, found


@pytest.mark.parametrize("size", [0.05, 50.0])
def test_the_friction_of_a_gear_is_found_on_an_axis_of_5_n_and_of_5_kn(size: float) -> None:
    small = logged(500.0, 4.0, load=0.1)  # scaled alike, force, mass and friction give the same motion
    force = {"force": size * small.trajectory["force"]}
    drive, truth = ForceDrive(LoadDependent(Coulomb())), {n: size * v for n, v in FORCE_TRUTH.items()}
    truth |= {"friction.coulomb_load": 0.1}
    given = drive.parameters.with_values({n: 1.4 * v for n, v in truth.items()}).freed(*truth)
    fit = identify(drive, replace(small, trajectory=small.trajectory.with_columns(force)), given)
    for name, true in truth.items():
        assert fit.parameters.value(name) == pytest.approx(true, rel=5e-3), name


def test_a_third_of_the_rows_missing_does_not_move_the_mass() -> None:
    log = logged(500.0)
    kept = np.random.default_rng(0).random(len(log.trajectory)) > 1 / 3
    part = Trajectory(log.trajectory.t[kept], {n: log.trajectory[n][kept] for n in log.trajectory})
    found = errors(fitted_force_log(Experiment(part, log.noise, name="run")))
    assert max(map(abs, found.values())) < 0.003, found


def test_a_prediction_reads_the_inputs_as_the_fit_does() -> None:
    log, drive = logged(50.0), ForceDrive(Coulomb())
    known = drive.parameters.with_values({**FORCE_TRUTH, "friction.smoothing": SMOOTHING})
    linear, held = (float(validate(drive, e, known)["rmse"].iloc[0]) for e in (log, log.with_intersample(HELD)))
    assert linear < 0.15 * held
    run = predict(drive, log, known)
    assert float(np.sqrt(np.mean((run["position"] - log.trajectory["position"]) ** 2))) == pytest.approx(linear)


def test_two_logs_of_one_fit_may_differ_in_what_they_hold() -> None:
    measured, drive = logged(100.0), ForceDrive(Coulomb()).system()
    t, force = measured.trajectory.t, measured.trajectory["force"]
    known = drive.parameters.with_values({**FORCE_TRUTH, "friction.smoothing": SMOOTHING})
    held = simulate(drive, Trajectory(t, {"force": force}), known, initial={"position": 0.1}, rtol=1e-8)["position"]
    noisy = held + FORCE_NOISE * np.random.default_rng(2).standard_normal(t.size)
    commanded = Experiment(
        Trajectory(t, {"force": force, "position": noisy}), measured.noise, name="commanded", intersample=HELD
    )
    found = errors(identify(drive, [measured, commanded], known.freed(*FORCE_TRUTH)))
    assert max(map(abs, found.values())) < 0.005, found


def test_a_linear_plant_starts_from_a_measured_input() -> None:
    plant = FirstOrder(input=Quantity("force", "N")).system()
    true = plant.parameters.with_values({"plant.time_constant": 0.08, "plant.gain": 0.02})
    t = np.arange(0, 4, 0.02)
    x = solve_ivp(lambda s, v: (0.02 * push(np.array(s)) - v) / 0.08, (0, 4), [0.0], t_eval=t, rtol=1e-9, atol=1e-12).y[
        0
    ]
    log = Trajectory(t, {"force": push(t), "speed": x})
    start = {
        kind: plant.starts({"run": Log(log, true.freed("plant.*"), {"force": kind})})[0].parameters
        for kind in Intersample
    }
    off = {kind: abs(values["plant.time_constant"] / 0.08 - 1) for kind, values in start.items()}
    assert off[Intersample.LINEAR] < 0.05 < off[Intersample.HELD]
