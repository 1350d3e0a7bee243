"""`predict_logs`: whether a fit predicts its own logs, by runs that no gap and no measurement helps.

Residuals do not tell: gaps between segments, and starts of windows, take the misfit in their place. So the model runs
freely from the fitted start to the end of each log, and its error is compared with the motion, the root mean square of
an output about its mean. A fit is useful where the error is near the noise, or well below the motion. But a position
drifts away over a long log though its speeds are right, and an axis that sticks loses the phase of its log; that does
no harm to a loop, which measures all the time. A free run that is far off is therefore excused where the model predicts
over the horizon of the motion: the time in which an output moves by as much as its spread, where its structure function
reaches its variance. The model runs over one such window after the other, each from the fitted state, and the error is
compared with the motion since the window's start. A wrong inertia, a dead time or a lost centre fail there, too: the
window is as long as the motion takes, where the gaps of a search are a hundred times as near. Nor is a free run excused
once it is known what the model lacks (`explanations`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pneuopt.identification.problem import EstimationProblem, outputs_in_log, window_runs
from pneuopt.identification.search import run_freely
from pneuopt.identification.tolerances import MAX_PREDICTION_SHARE, MODEL_ERROR_LEVEL
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit

Shares = Mapping[str, float]  # by output: the error of a prediction over the motion, root mean squares [1]


@dataclass(frozen=True)
class Prediction:
    """How well a fit predicts its own logs."""

    shares: Shares  # of the free runs, infinite where one diverges
    is_far: bool = False  # whether the free runs are far off, against the noise and against the motion
    horizon: float = math.nan  # of the motion [s]; NaN where it was not looked at
    over_horizon: Shares | None = None  # of the runs over the horizon

    @property
    def stats(self) -> dict[str, float]:
        """The largest shares, as `IdentificationResult.stats` holds them; zero without any."""
        over_horizon = max((self.over_horizon or {}).values(), default=0.0)
        return {"free_run_share": max(self.shares.values(), default=0.0), "horizon_share": over_horizon}

    @property
    def is_useless(self) -> bool:
        """Whether the model predicts the logs neither as a whole nor over the horizon."""
        return self.is_far and not _is_useful(self.over_horizon or self.shares)

    def assess(self, status: Status) -> Status:
        """The status of a fit, which begins with what it predicts."""
        if not self.is_far:
            if status.code is not Code.CONVERGED or not self.shares:
                return status
            is_seen = _is_useful(self.shares)  # else what moves is noise
            told = (
                f"a free run misses {_worst(self.shares)}" if is_seen else "a free run follows the logs to their noise"
            )
            return Status(status.code, (told, *status.sentences))
        over = f"over {self.horizon:.2g} s, from a fitted state, it misses {_worst(self.over_horizon or self.shares)}"
        if not self.is_useless:
            return status.with_details(f"the free run drifts away, it misses {_worst(self.shares)}; {over}")
        sentences = f"does not predict its own log: the free run misses {_worst(self.shares)}", over
        if status.converged:
            return Status(Code.MISFIT, (*sentences, *status.sentences))
        return status.with_details(*sentences)


def predict_logs(problem: EstimationProblem, fit: Fit, runs: Sequence[Trajectory]) -> Prediction:
    """Compare the free runs of a fit with its logs, and where these are far off its runs over the horizon."""
    shares, near = _shares(problem, runs, math.inf)
    if near or _is_useful(shares):
        return Prediction(shares)
    horizon = motion_horizon(problem)
    cut = run_freely(problem, fit, horizon)
    return Prediction(shares, True, horizon, _shares(problem, cut, horizon)[0])


def refuse_drift(status: Status, stats: Mapping[str, float]) -> Status:
    """The status of a fit of which it is known what it lacks: a free run that is far off then has no excuse."""
    is_excused = stats["free_run_share"] > MAX_PREDICTION_SHARE >= stats["horizon_share"]
    if not (status.converged and is_excused):
        return status
    verdict = f"does not predict its own log: the free run misses {_size(stats['free_run_share'])} motion"
    return Status(Code.MISFIT, (verdict, *status.sentences))


def motion_horizon(problem: EstimationProblem) -> float:
    """The time in which each output of each log moves by as much as its spread [s]."""
    logs = [(e.trajectory, outputs_in_log(problem.system, e)) for e in problem.experiments]
    return max(_horizon(log.t, log[name]) for log, outputs in logs for name in outputs)


def _shares(problem: EstimationProblem, runs: Sequence[Trajectory], window: float) -> tuple[Shares, bool]:
    """The share of each output that moves, and whether all errors are near the noise.

    The motion is that about the mean of a log, or in windows that since each one's start.
    """
    errors, motions, noise = (dict.fromkeys([q.name for q in problem.system.outputs], 0.0) for _ in range(3))
    for e, run in zip(problem.experiments, runs, strict=True):
        for name in outputs_in_log(problem.system, e):
            y = e.trajectory[name]
            about = np.full(len(y), np.nanmean(y))
            for begin, end in window_runs(e, window) if math.isfinite(window) else ():
                about[begin:end] = run[name][begin]
            known = np.isfinite(y)
            with np.errstate(over="ignore", invalid="ignore"):  # of a run that diverged
                error = np.sum((run[name] - y)[known] ** 2)
            errors[name] += float(error) if np.isfinite(error) else math.inf
            motions[name] += float(np.nansum((y - about) ** 2))
            noise[name] += float(np.count_nonzero(known)) * e.noise[name] ** 2
    shares = {n: math.sqrt(errors[n] / motion) for n, motion in motions.items() if motion > 0}
    return shares, all(errors[n] <= MODEL_ERROR_LEVEL**2 * noise[n] for n in shares)


def _horizon(t: Array, values: Array) -> float:
    """The time in which a signal moves by as much as its spread [s]; half of the log where it does not."""
    known = np.isfinite(values)
    y, step = np.interp(t, t[known], values[known]), float(np.median(np.diff(t)))
    lags = np.unique(np.geomspace(2, max(2, len(y) // 2), 60).astype(int))
    moved = np.array([np.mean((y[lag:] - y[:-lag]) ** 2) for lag in lags])
    reached = np.flatnonzero(moved >= np.var(y))
    return step * float(lags[reached[0]] if reached.size else lags[-1])


def _is_useful(shares: Shares) -> bool:
    return all(share <= MAX_PREDICTION_SHARE for share in shares.values())


def _worst(shares: Shares) -> str:
    """The output with the largest share, and that, in words."""
    name = max(shares, key=lambda n: shares[n])
    return f"{name} by {_size(shares[name])} motion"


def _size(share: float) -> str:
    if share >= 10:
        return f"{share:.2g} times the" if share < 1e4 else "far more than the"
    return f"{share:.0%} of the" if share >= 0.1 else f"{100 * share:.2g}% of the"
