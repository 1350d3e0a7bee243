"""`predict`, `validate`: the free run of a log; with a fit a forecast from the log's first tenth, with a 95 % band.

The start state is fitted to that tenth (of a long log to 1000 segments, 10 s); from there on the inputs alone drive the
run, and so nothing in run or band rests on what is forecast. The band's variance is a sum: of the parameters, by runs
at one deviation to both sides along each principal direction of their covariance (central differences, which stay
finite where a linearised stick-slip does not), and of what the start state, the noise and the model's error add. These
are learned (Ljung, Model validation and model error modeling, 1999) as split conformal prediction calibrates (Lei et
al., J. Am. Stat. Assoc. 113, 2018): the fit forecasts parts of its own logs by the same rule, from starts that are
fitted alike, and the mean square of the errors by time since the start is what it must expect of itself elsewhere.
`problems/identify/forecast_band.py` measures the share inside.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.stats import norm

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.runnable import Fittable, HasSystem
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import names
from pneuopt.identification.problem import (
    EstimationProblem,
    apply_conditions,
    as_estimation_model,
    as_experiments,
    check_logs,
    find_centre,
    input_behaviour,
    known_runs,
    outputs_in_log,
    window_runs,
)
from pneuopt.identification.search import check_window
from pneuopt.identification.statistics import agreement, cross_correlation, ljung_box
from pneuopt.identification.tolerances import (
    ENDLESS,
    EXCERPT_SEGMENTS,
    FORECAST_LANES,
    FORECAST_LEVELS,
    FORECAST_STARTS,
    LEVEL,
    MIN_WINDOW_SAMPLES,
    REFIT_STAGES,
    START_SHARE,
)
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import ParameterSet, check_argument, check_number
from pneuopt.quantities.status import Progress, ProgressReporter
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares, solve_least_squares
from pneuopt.shooting.segments import Segments, choose_integration, segment, start_nodes

if TYPE_CHECKING:
    import pandas as pd

QUANTILE = float(norm.ppf(0.5 + LEVEL / 2))


class Fitted(Protocol):
    """What gives a forecast its band: the result of `identify`, or the file of one."""

    @property
    def parameters(self) -> ParameterSet:
        """All parameters of the system."""
        ...

    @property
    def covariance(self) -> "pd.DataFrame | None":
        """Of the estimates; NaN where one has none."""
        ...

    @property
    def forecast_error(self) -> "pd.DataFrame | None":
        """As of `IdentificationResult`."""
        ...


def validate(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Sequence[Experiment],
    parameters: "ParameterSet | Fitted",
    *,
    window: float | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> "pd.DataFrame":
    """Predict logs with known parameters: the start state is fitted, then an independent simulation runs freely.

    With parameters alone the start is fitted to the whole log, so that what is left is the model's error. With a fit
    the run is a forecast: its start is fitted to the first tenth (10 s at most), and a 95 % band is given of the rest.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`.
    experiments : Experiment or sequence of Experiment
        Preferably runs that no fit has seen.
    parameters : ParameterSet, IdentificationResult or StoredFit
        None is estimated; a fit, whole or from its file, gives a forecast with its band.
    window : float, optional
        Start the simulation anew after this time [s], from a fitted state: a plant that integrates runs away from a
        long log for the smallest misfit.
    progress : callable, optional
        As of `identify`.

    Returns
    -------
    DataFrame
        A row a log and channel: rmse, nrmse, fit_percent, samples, unit; free_run_rmse and free_run_nrmse, the same of
        a simulation from end to end, which has no windows; whiteness_p, the probability of residuals so
        little white by chance (`ljung_box`); of each input how much is left in them (`cross_correlation`, about 3 is
        what chance reaches) and at which lag in samples: "correlation[force]", "lag[force]"; of a forecast (NaN
        without a fit) inside, the share of its samples within the band, half_band, the root mean square of half the
        band's width, and forecast_rmse, that of the error over the same samples.
    """
    return predict_logs(system, experiments, parameters, window=window, progress=progress, verb="validate")[0]


def predict(
    system: HasSystem | ClosedLoop,
    experiment: Experiment,
    parameters: "ParameterSet | Fitted",
    *,
    window: float | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Trajectory:
    """Simulate a log freely with known parameters, as `validate` does to compare.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`.
    experiment : Experiment
        Its inputs drive the simulation, its outputs give the start state.
    parameters, window, progress
        As of `validate`.

    Returns
    -------
    Trajectory
        States and outputs on the log's grid; NaN in holes of its inputs, behind which the state is fitted anew. With a
        fit also "position_low", "position_high", ...: the 95 % band of what a sensor would show, NaN over the samples
        that give the start.
    """
    check_argument("experiment", experiment, Experiment, "an Experiment, as read_log(path) gives it")
    return predict_logs(system, experiment, parameters, window=window, progress=progress)[1][0]


def predict_logs(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Sequence[Experiment],
    parameters: "ParameterSet | Fitted",
    *,
    window: float | None = None,
    progress: Callable[[Progress], None] | None = None,
    verb: str = "predict",
) -> "tuple[pd.DataFrame, list[Trajectory]]":
    """What `validate` and `predict` return, by one fit of the start states of each log."""
    from pneuopt.quantities.frames import WideFrame

    if window is not None:
        check_number("window", window, "a time in seconds, as 0.5, math.inf for whole logs, or None")
    model, method = as_estimation_model(system), LeastSquares(progress=ProgressReporter(progress, verb))
    window = None if window == math.inf else window
    fit: Any = parameters if hasattr(parameters, "forecast_error") else None
    given: Any = parameters if fit is None else fit.parameters
    logs = check_logs(model, [_with_noise(e, fit) for e in as_experiments(experiments)], given)
    known, rows, runs = _fixed_parameters(model, find_centre(model, logs, given)), [], list[Trajectory]()
    share = START_SHARE if fit is not None and fit.forecast_error is not None else 1.0
    for log in logs:
        check_window(EstimationProblem(model, (log,), known, method, window=window or math.inf))
        whole = _forecast(model, _cut(log, known_runs(log)), known, method, share)
        run = free = whole.join(log, fit if window is None else None)
        if window is not None:
            run = _forecast(model, _cut(log, window_runs(log, window)), known, method, share).join(log, fit)
        runs.append(run)
        rows += [
            row
            | residual_diagnosis(model, log, run, str(row["channel"]))
            | _band_figures(log, run, str(row["channel"]))
            for row in agreement_rows(model, log, run, free)
        ]
    return WideFrame(rows).set_index(["log", "channel"]), runs


def _with_noise(experiment: Experiment, fit: Fitted | None) -> Experiment:
    """The log with the noise of a fit's own logs where it states none: that of its own samples would look ahead."""
    learned = None if fit is None else fit.forecast_error
    if learned is None:
        return experiment
    unknown = [str(n) for n in learned if n in experiment.trajectory and n not in experiment.noise]
    levels = {n: float(learned[n].iloc[0]) for n in unknown}
    return experiment.with_noise(levels)


def _band_figures(experiment: Experiment, run: Trajectory, channel: str) -> dict[str, float]:
    """What `validate` says of the band."""
    figures = dict.fromkeys(("inside", "half_band", "forecast_rmse"), math.nan)
    if f"{channel}_low" not in run:
        return figures
    measured, low, high = experiment.trajectory[channel], run[f"{channel}_low"], run[f"{channel}_high"]
    counts = np.isfinite(measured) & ~np.isnan(low)
    if counts.any():
        y, low, high = measured[counts], low[counts], high[counts]
        figures["inside"] = float(np.mean((y >= low) & (y <= high)))
        figures["half_band"] = float(np.sqrt(np.mean((high - low) ** 2))) / 2
        figures["forecast_rmse"] = float(np.sqrt(np.mean((y - run[channel][counts]) ** 2)))
    return figures


@dataclass(frozen=True, eq=False)
class _Forecast:
    """Parts of logs, each run freely from a state that is fitted to its first samples."""

    system: Fittable
    parameters: ParameterSet  # none free
    experiments: tuple[Experiment, ...]
    segments: Segments  # a part each, whole
    nodes: Array  # (m, n_states): where they start
    values: Array  # of all parameters
    substeps: int
    heads: Indices  # (m,): samples to which the start is fitted

    @cached_property
    def y(self) -> Array:
        """The outputs of the runs, (m, n, n_outputs), by the steps of the search."""
        with np.errstate(all="ignore"):
            return self.segments.run(self.nodes, self.values, self.substeps).y

    def join(self, log: Experiment, fit: Fitted | None) -> Trajectory:
        """The run of a log along its parts, by an independent simulation, with its band."""
        errors, columns = None if fit is None else fit.forecast_error, dict[str, Array]()
        covariance = None if fit is None else fit.covariance
        variance = np.zeros(self.segments.measured.shape) if covariance is None else self.variance(covariance)
        known, behaviour = apply_conditions(self.parameters, log), input_behaviour(self.system, log)
        for part, own in enumerate(self.experiments):
            inputs = own.trajectory
            state = dict(zip(names(self.system.states), self.nodes[part].tolist(), strict=True))
            run = simulate(self.system, inputs, known, initial=state, intersample=behaviour)
            found = {n: run[n] for n in run}
            for k, output in enumerate(names(self.system.outputs)):
                if errors is not None and output in errors:
                    expected = np.interp(inputs.t - inputs.t[0], errors.index, errors[output] ** 2)
                    half = QUANTILE * np.sqrt(variance[part, : len(inputs), k] + expected)
                    half[: self.heads[part]] = math.nan
                    found |= {f"{output}_low": run[output] - half, f"{output}_high": run[output] + half}
            begin = int(np.searchsorted(log.trajectory.t, inputs.t[0]))
            for name, column in found.items():
                columns.setdefault(name, np.full(len(log.trajectory), np.nan))[begin : begin + len(inputs)] = column
        return Trajectory(log.trajectory.t, columns)

    def variance(self, covariance: "pd.DataFrame") -> Array:
        """Variance of the outputs (m, n, n_outputs) by the parameters."""
        order, total = list(self.segments.transcription.parameters), np.zeros(self.segments.measured.shape)
        matrix = covariance.to_numpy(dtype=float)
        rows = [i for i, n in enumerate(covariance.index) if n in order and matrix[i, i] > 0]
        place, scale = [order.index(str(covariance.index[i])) for i in rows], np.sqrt(np.diag(matrix)[rows])
        shares, directions = np.linalg.eigh(matrix[np.ix_(rows, rows)] / np.outer(scale, scale))
        changes = np.zeros((len(rows), len(order)))
        changes[:, place] = (directions * np.sqrt(np.maximum(shares, 0.0)) * scale[:, None]).T
        for half in self._half_differences(changes):
            total += half**2
        return total

    def _half_differences(self, changes: Array) -> Iterator[Array]:
        """Half the difference of the outputs (m, n, n_outputs) between both signs of each change of the values."""
        own, m, parts = self.segments.transcription.parameters.values(), len(self.nodes), self.segments
        logs, lower, upper = (np.array([getattr(p, n) for p in own]) for n in ("log", "lower", "upper"))
        lanes = max(1, FORECAST_LANES // m)
        for first in range(0, len(changes), lanes):
            signed = np.repeat(changes[first : first + lanes], 2, axis=0)
            signed[1::2] *= -1
            with np.errstate(all="ignore"):  # infinite where the model leaves its range
                folds = np.clip(signed / self.values, -1.0, 1.0)  # of an unidentifiable parameter it would be hundreds
                factors = np.exp(np.where(logs, folds, 0.0))
                values = np.clip(np.where(logs, self.values * factors, self.values + signed), lower, upper)
                p = values[:, parts.parameter_positions].reshape(len(signed) * m, -1)
                x, u, t, h = (np.concatenate([a] * len(signed)) for a in (self.nodes, parts.inputs, parts.t, parts.h))
                y = parts.plain_rollout.run(x, u, p, t, h, substeps=self.substeps).y
                high, low = np.swapaxes(y.reshape(len(signed) // 2, 2, m, *y.shape[1:]), 0, 1)
                half = (high - low) / 2
            yield from np.where(np.isfinite(half), half, math.inf)


def _forecast(
    system: Fittable, parts: Sequence[Experiment], known: ParameterSet, method: LeastSquares, share: float
) -> _Forecast:
    """Fit the start states of all parts at once, each to the first share of its part, and run freely from there."""
    longest = math.inf if share == 1 else EXCERPT_SEGMENTS * method.segment_time
    heads = np.array([_head(system, part, share, longest) for part in parts])
    short = [replace(e, trajectory=e.trajectory.rows(0, n)) for e, n in zip(parts, heads, strict=True)]
    problem = EstimationProblem(system, tuple(short), known, method)
    starts, substeps = [np.zeros(0)] * len(parts), 1
    if system.states:
        try:
            guess = problem.candidates[0]
        except LogError:  # as of inputs that do not move yet, which tell nothing of parameters
            rest = {s.name: v for s, v in zip(system.states, system.rest_state(known), strict=True)}
            guess = Start({e.name: _constant(e, rest) for e in short}, {})
        last = replace(method, stages=method.stages[-REFIT_STAGES:], checks_steps=False, allows_state_noise=False)
        settled = problem.filter_states(guess, last.stages[-1].gap)
        fit = solve_least_squares(problem.transcription(settled), last)
        starts, substeps = [run.matrix(names(system.states))[0] for run in fit.trajectories], int(fit.stats["substeps"])
    guesses = {
        part.name: _constant(part, dict(zip(names(system.states), start, strict=True)))
        for part, start in zip(parts, starts, strict=True)
    }
    whole = replace(problem, experiments=tuple(parts), method=replace(method, segment_time=math.inf))
    segments = segment(whole.transcription(Start(guesses, {})))
    values = np.array([p.value for p in segments.transcription.parameters.values()])
    nodes = start_nodes(segments)
    segments, substeps = choose_integration(segments, nodes, values, substeps)
    return _Forecast(system, known, tuple(parts), segments, nodes, values, substeps, heads)


def _constant(log: Experiment, states: Mapping[str, float]) -> Trajectory:
    return Trajectory(log.trajectory.t, {n: np.full(len(log.trajectory), v) for n, v in states.items()})


def _head(system: Fittable, part: Experiment, share: float, longest: float) -> int:
    """The first samples of a part, to which its start is fitted: a share of its time, or the `longest` [s]."""
    t = part.trajectory.t
    measured = np.isfinite(part.trajectory.matrix(outputs_in_log(system, part))).any(axis=1)
    enough = int(np.searchsorted(np.cumsum(measured), MIN_WINDOW_SAMPLES)) + 1
    return min(max(int(np.searchsorted(t, t[0] + min(share * (t[-1] - t[0]), longest), "right")), enough), len(t))


def _cut(experiment: Experiment, runs: Iterable[tuple[int, int]]) -> list[Experiment]:
    """Parts of a log as logs of their own."""
    return [
        replace(experiment, trajectory=experiment.trajectory.rows(a, b), name=f"{experiment.name}@{k}", holes=())
        for k, (a, b) in enumerate(runs)
    ]


def learn_forecast_error(
    problem: EstimationProblem, parameters: ParameterSet, method: LeastSquares
) -> "pd.DataFrame | None":
    """Root mean square of what a fit's forecasts of its own logs miss (`IdentificationResult.forecast_error`)."""
    import pandas as pd

    system, parts = problem.system, list[Experiment]()
    for log in problem.experiments:
        cuts = [(k, b) for a, b in known_runs(log) for k in np.linspace(a, b, FORECAST_STARTS + 1).astype(int).tolist()]
        parts += _cut(log, [(k, b) for k, b in dict.fromkeys(cuts) if b - k >= 2 * MIN_WINDOW_SAMPLES])
    if not parts:
        return None
    run = _forecast(system, parts, _fixed_parameters(system, parameters), method, START_SHARE)
    measured, since = run.segments.measured, run.segments.t - run.segments.t[:, :1]
    missed = np.where(np.isfinite(run.y), measured - run.y, math.inf) ** 2
    later = np.arange(since.shape[1]) >= run.heads[:, None]
    edges = float(since.max()) * np.append(0.0, 0.5 ** np.arange(FORECAST_LEVELS - 1, -1, -1))
    level, table = np.searchsorted(edges, since) - 1, dict[str, Array]()
    for k, channel in enumerate(names(system.outputs)):
        noise = [e.noise[channel] for e in problem.experiments if channel in outputs_in_log(system, e)]
        counts = later & np.isfinite(measured[..., k])
        if noise and counts.any():
            own, squares = level[counts], np.minimum(missed[counts, k], ENDLESS**2)
            weights, sums = (np.bincount(own, w, FORECAST_LEVELS) for w in (np.ones(len(own)), squares))
            means = sums / np.maximum(weights, 1)
            rising = isotonic_regression(
                means, weights=np.maximum(weights, 1 / ENDLESS)
            ).x  # no forecast becomes surer with time
            table[channel] = np.sqrt(np.maximum(np.append(0.0, rising), float(np.median(noise)) ** 2))
    return pd.DataFrame(table, index=pd.Index(np.append(0.0, (edges[1:] + edges[:-1]) / 2), name="time"))


def _fixed_parameters(system: Fittable, parameters: ParameterSet) -> ParameterSet:
    """Every parameter of the system, none free."""
    return system.parameters | parameters.fixed(*parameters.free_names)


def agreement_rows(
    system: Fittable, experiment: Experiment, run: Trajectory, free_run: Trajectory
) -> list[dict[str, object]]:
    """A row a channel of a log: how well a run agrees with it, and a simulation from end to end."""
    units = {q.name: q.unit for q in system.outputs}
    rows: list[dict[str, object]] = []
    for channel in outputs_in_log(system, experiment):
        figures, measured = agreement(experiment.trajectory[channel], run[channel]), experiment.trajectory[channel]
        free = agreement(measured, free_run[channel])
        free_figures = {f"free_run_{n}": free[n] for n in ("rmse", "nrmse")}
        known = {"noise": experiment.noise[channel], "unit": units[channel]}
        rows.append({"log": experiment.name, "channel": channel, **figures, **free_figures, **known})
    return rows


def residual_diagnosis(system: Fittable, experiment: Experiment, run: Trajectory, channel: str) -> dict[str, object]:
    """Whiteness of a channel's residuals, and their correlation with each input."""
    log = experiment.trajectory
    residuals = log[channel] - run[channel]
    found: dict[str, object] = {"whiteness_p": ljung_box(residuals)[1]}
    for name in (n for n in names(system.inputs) if n in log):
        size, lag = cross_correlation(residuals, log[name])
        found |= {f"correlation[{name}]": size, f"lag[{name}]": lag}
    return found
