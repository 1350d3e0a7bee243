"""`bootstrap`: does a fit hold? Its logs are simulated with its own estimates, and identified again, many times.

A simulated log has the inputs of the logged one, its noise, its resolution and its missing samples. It begins in the
fitted state, and again wherever the simulation has left the fitted motion (`MAX_WANDER`), as an axis without its loop
does: the motion is that of the log. What the fits of simulated logs make of estimates that are known then shows
what the one fit of the real logs has made of the truth. Source: Efron, Tibshirani, An Introduction to the Bootstrap,
1993, chapters 6 (the parametric bootstrap) and 10 (the value less its bias).
"""

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem, Runnable, as_runnable
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import names
from pneuopt.evaluation.rig import Rig, Sensor, record
from pneuopt.identification.identify import identify
from pneuopt.identification.problem import (
    NEEDED,
    as_estimation_model,
    check_logs,
    input_behaviour,
    known_runs,
    outputs_in_log,
)
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.logs.doctor import CHECKS
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.noise import estimate_noise
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, check_number
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import Progress
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares
from pneuopt.studies.sweep import sweep
from pneuopt.studies.tolerances import MAX_WANDER, MIN_CHANCE, MIN_ROWS, SIGNIFICANT

if TYPE_CHECKING:
    import pandas as pd

_DRAW = "draw"
_RIGHT = tuple(check for check in CHECKS if check not in NEEDED)  # a simulated log jumps where it begins anew


@dataclass(frozen=True, eq=False, repr=False)
class Bootstrap(Shown):
    """Estimates that fits of simulated logs give for known values.

    Attributes
    ----------
    table : DataFrame
        A row an estimate: value, the fit's, with which the logs were simulated; unit; corrected, the value less the
        bias; bias, the mean of the draws less the value; bias_error, its standard error; spread, the standard deviation
        of the draws; stderr, as the fit of the real logs claims it; intervals, the draws that had one, and covered,
        those whose interval holds the value.
    draws : DataFrame
        A row a draw: "error", empty where it was fitted; "verdict"; by estimate its value and the ends of its interval.
    """

    table: "pd.DataFrame"
    draws: "pd.DataFrame"

    @property
    def doubts(self) -> Mapping[str, str]:
        """By estimate, why its value or its interval is not to be trusted; what is not here may be."""
        from scipy.stats import binom

        found = dict[str, str]()
        for name, row in self.table.iterrows():
            reasons = []
            if abs(row["bias"]) > max(SIGNIFICANT * row["bias_error"], row["stderr"]):
                share = f"{100 * abs(row['bias'] / row['value']):.2g} % " if row["value"] else ""
                reasons.append(f"it comes out {share}too {'high' if row['bias'] * row['value'] > 0 else 'low'}")
            if binom.cdf(row["covered"], row["intervals"], 0.95) < MIN_CHANCE:
                reasons.append(f"{row['covered']:.0f} of {row['intervals']:.0f} intervals hold its value")
            found |= {str(name): ", and ".join(reasons)} if reasons else {}
        return found

    def summary(self) -> Report:
        """Which estimates to doubt, and why; then a row an estimate."""
        failed = self.draws["error"][self.draws["error"] != ""]
        fitted, wrong = len(self.draws) - len(failed), self.doubts
        if not fitted:
            return Report(
                (Line(f"none of {len(failed)} simulated sets of logs is fitted: {failed.iloc[0]}", Tone.BAD),)
            )
        lead = f"{fitted} of {len(self.draws)} simulated sets of logs are fitted"
        good = f"{lead}; no estimate is to be doubted"
        head = [Line(f"{lead}; doubt {', '.join(wrong)}", Tone.DOUBTFUL) if wrong else Line(good, Tone.GOOD)]
        head += [Line(f"{name}: {why}", indent=2) for name, why in wrong.items()]
        head += [Line(f"{len(failed)} not fitted, the first one: {failed.iloc[0]}", indent=2)] if len(failed) else []
        figures = ("value", "bias", "corrected", "spread", "claimed")
        rows = []
        for name, row in self.table.iterrows():
            held = f"{row['covered']:.0f} of {row['intervals']:.0f}"
            figures_of_row = (row["value"], row["bias"], row["corrected"], row["spread"], row["stderr"])
            numbers = (format_number(v, digits) for v, digits in zip(figures_of_row, (4, 2, 4, 2, 2), strict=True))
            rows.append((str(name), *numbers, held, str(row["unit"])))
        columns = *text_columns("parameter"), *number_columns(*figures, "interval holds"), *text_columns("unit")
        return Report((*head, Table(columns, tuple(rows))))


def bootstrap(
    system: HasSystem,
    experiments: Experiment | Sequence[Experiment],
    fit: IdentificationResult,
    *,
    rig: HasSystem | Rig | None = None,
    count: int = 20,
    seed: int = 0,
    executor: Executor | None = None,
    method: LeastSquares | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Bootstrap:
    """Simulate the logs of a fit with its estimates, identify them again, and see what becomes of the estimates.

    Parameters
    ----------
    system : drive or System
        That of the fit; a loop is refused.
    experiments : Experiment or sequence of Experiment
        Those of the fit.
    fit : IdentificationResult
        A converged one.
    rig : drive, System or Rig, optional
        What the logs are simulated with: by default the fitted system itself, which shows the intervals of a right
        model. The drive with Karnopp's friction, or a `Rig` with its actuator and sensors, shows what these do to the
        estimates of a model that lacks them. Parameters that the fit does not have keep the rig's defaults.
    count : int
        Sets of logs, at least 2.
    seed : int
        The same seed gives the same logs, whatever the executor.
    executor : concurrent.futures.Executor, optional
        As for `sweep`: by default a process a CPU.
    method : LeastSquares, optional
        That of the fit. The search begins at the fit.
    progress : callable, optional
        Receives a `Progress` after each draw.

    Returns
    -------
    Bootstrap

    Raises
    ------
    InputError
        If the logs are not those of the fit, the fit has not converged, or the count is below 2.
    ConvergenceError
        If the rig cannot be simulated along a log.
    """
    require(not isinstance(system, ClosedLoop), "a bootstrap simulates logs of a plant; give the drive", ModelError)
    check_number("count", count, "a whole number, as 20", whole=True)
    require(count >= 2, f"count = {count}: a spread takes two sets of logs at least")
    check_number("seed", seed, "a whole number, not below 0", least=0, whole=True)
    require(fit.status.converged, f"the fit has not converged: {fit.status.verdict}; mend it first")
    model = as_estimation_model(system)
    logs = check_logs(model, experiments, fit.parameters)
    log_names = [e.name for e in logs]
    require(
        log_names == [*fit.trajectories], f"the fit is of {', '.join(fit.trajectories)}, not of {', '.join(log_names)}"
    )
    plants = [_rig_of(rig or model.plant, log, fit, outputs_in_log(model, log)) for log in logs]
    runs = [_find_runs(plant, log, fit) for plant, log in zip(plants, logs, strict=True)]
    behaviour = [replace(log, intersample=input_behaviour(model, log)) for log in logs]
    refit = partial(_refit, system=system, plants=plants, logs=behaviour, runs=runs, fit=fit, seed=seed, method=method)
    start = ParameterSet({_DRAW: Parameter(0.0, "1")})
    cases = {f"{_DRAW} {k}": {_DRAW: float(k)} for k in range(1, count + 1)}
    draws = sweep(refit, start, cases, executor=executor, progress=progress)
    return Bootstrap(_tabulate(fit, draws), draws)


def _rig_of(rig: HasSystem | Rig | Runnable, log: Experiment, fit: IdentificationResult, outputs: Sequence[str]) -> Rig:
    """The rig with the log's own sensors where it has none."""
    sensors = {}
    for n in outputs:  # the noise that the fit counts, and the resolution that the log shows
        resolution = estimate_noise(log.trajectory[n], log.trajectory.t).resolution
        noise = math.sqrt(max(float(fit.fit["noise"][log.name, n]) ** 2 - resolution**2 / 12, 0.0))
        sensors[n] = Sensor(noise=noise, resolution=resolution)
    if isinstance(rig, Rig):
        return replace(rig, sensors=sensors | {n: s for n, s in rig.sensors.items() if n in sensors})
    plant = as_runnable(rig, "rig").plant
    return Rig(plant, sensors, actuated=names(plant.inputs)[0])


def _find_runs(rig: Rig, log: Experiment, fit: IdentificationResult) -> list[tuple[int, int]]:
    """Begin and end of the parts of a log along which the rig stays near the fitted motion."""
    fitted, parts = fit.trajectories[log.name], known_runs(log)
    spans = {n: MAX_WANDER * float(np.nanmax(fitted[n]) - np.nanmin(fitted[n])) for n in rig.sensors}
    quiet, runs = replace(rig, sensors=dict.fromkeys(rig.sensors, Sensor())), list[tuple[int, int]]()
    while parts:
        begin, end = parts.pop(0)
        run = _simulate(quiet, log, fit, begin, end, seed=0)
        stays = all(bool((np.abs(run[n] - fitted[n][begin:end]) <= span).all()) for n, span in spans.items())
        middle = (begin + end) // 2
        if stays or middle - begin < MIN_ROWS:
            runs.append((begin, end))
        else:
            parts[:0] = [(begin, middle), (middle, end)]
    return runs


def _simulate(
    rig: Rig, log: Experiment, fit: IdentificationResult, begin: int, end: int, *, seed: int
) -> Mapping[str, Array]:
    """Readings of the rig over rows of a log, from the fitted state at the first one."""
    plant, fitted, estimates = rig.plant, fit.trajectories[log.name], fit.estimates["value"]
    per_log = {n: f"{n}[{log.name}]" for n in fit.parameters.free_names}
    values = {n: float(estimates[row]) for n, row in per_log.items() if row in estimates.index}
    parameters = fit.parameters.with_values({**values, **log.conditions})
    initial = {n: float(fitted[n][begin]) for n in names(plant.states) if n in fitted}
    rows = log.trajectory.rows(begin, end)
    inputs = Trajectory(rows.t, {n: rows[n] for n in names(plant.inputs)})
    rig_parameters = parameters.select(n for n in parameters if n in plant.parameters)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an end stop: the part is cut where the motion leaves the log's
        if rig.actuator != type(rig.actuator)() or any(s.lag for s in rig.sensors.values()):
            read = record(rig, inputs, rig_parameters, initial=initial, seed=seed).experiment.trajectory
            return {n: read[n] for n in rig.sensors}
        run = simulate(
            plant, inputs, rig_parameters, initial=initial, intersample=log.intersample, rtol=1e-8, atol=1e-10
        )
    draw = np.random.default_rng(seed)
    return {
        n: np.array([s.reading(v, z) for v, z in zip(run[n], draw.standard_normal(len(rows)), strict=True)])
        for n, s in rig.sensors.items()
    }


def _simulate_log(
    rig: Rig, log: Experiment, runs: Sequence[tuple[int, int]], fit: IdentificationResult, seed: int
) -> Experiment:
    """A log in the place of the given one: its inputs and gaps, the rig's readings."""
    columns = {n: np.full(len(log.trajectory), np.nan) for n in rig.sensors}
    for k, (begin, end) in enumerate(runs):
        part_seed = int(np.random.SeedSequence([seed, k]).generate_state(1)[0])
        readings = _simulate(rig, log, fit, begin, end, seed=part_seed)
        for n, column in columns.items():
            column[begin:end] = np.where(np.isnan(log.trajectory[n][begin:end]), np.nan, readings[n])
    joints = {(end, end) for (_, end), (begin, _) in itertools.pairwise(runs) if end == begin}
    inputs = {n: log.trajectory[n] for n in names(rig.plant.inputs)}
    trajectory = Trajectory(log.trajectory.t, inputs | columns)
    noise = {n: float(fit.fit["noise"][log.name, n]) for n in columns}
    kept = {n: how for n, how in log.intersample.items() if n in trajectory}
    holes = tuple(sorted({*log.holes, *joints}))
    return replace(log, trajectory=trajectory, noise=noise, intersample=kept, holes=holes, source=None, sha256="")


def _refit(
    draw: ParameterSet,
    *,
    system: HasSystem,
    plants: Sequence[Rig],
    logs: Sequence[Experiment],
    runs: Sequence[Sequence[tuple[int, int]]],
    fit: IdentificationResult,
    seed: int,
    method: LeastSquares | None,
) -> dict[str, float | str]:
    """One set of simulated logs, identified: each estimate and the ends of its interval."""
    number = int(draw.value(_DRAW))
    sets = zip(plants, logs, runs, strict=True)
    seeds = (int(np.random.SeedSequence([seed, number, k]).generate_state(1)[0]) for k in range(len(logs)))
    made = [_simulate_log(*one, fit, own) for one, own in zip(sets, seeds, strict=True)]
    window = None if fit.window is None else fit.window.duration
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = identify(
            system, made, fit.parameters, start=fit, method=method, window=window, accept=_RIGHT, throw=False
        )
    if not again.status.converged:
        raise ConvergenceError(again.status.verdict, again)
    row_of_draw: dict[str, float | str] = {"verdict": again.status.verdict}
    for name, row in again.estimates.iterrows():
        row_of_draw |= {f"{name}.{part}": float(row[part]) for part in ("value", "ci_low", "ci_high")}
    return row_of_draw


def _tabulate(fit: IdentificationResult, draws: "pd.DataFrame") -> "pd.DataFrame":
    """A row an estimate that the fit has given a value."""
    from pneuopt.quantities.frames import WideFrame

    rows = {}
    for name, row in fit.estimates.iterrows():
        if row["mark"] == Mark.UNIDENTIFIABLE or f"{name}.value" not in draws:
            continue
        value, drawn = float(row["value"]), draws[f"{name}.value"].dropna()
        bias = float(drawn.mean()) - value
        low, high = (draws[f"{name}.{end}"] for end in ("ci_low", "ci_high"))
        spread = float(drawn.std())
        rows[name] = {
            "value": value,
            "unit": row["unit"],
            "corrected": value - bias,
            "bias": bias,
            "bias_error": spread / math.sqrt(max(len(drawn), 1)),
            "spread": spread,
            "stderr": float(row["stderr"]),
            "intervals": int(low.notna().sum()),
            "covered": int(((low <= value) & (value <= high)).sum()),
        }
    return WideFrame.from_dict(rows, orient="index")
