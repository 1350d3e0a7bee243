"""`fit_robustly`: a fit repeated with weights for outliers (`Huber`, `SoftL1`) and noise levels from its residuals.

Iteratively reweighted least squares: each sample's noise is divided by the root of its weight psi(r)/r, where r is its
residual over the channel's own scale (1.4826 MAD), and the next fit starts where the last one ended.
"""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pneuopt.identification.problem import EstimationProblem, outputs_in_log
from pneuopt.identification.tolerances import (
    CLEAR_DEVIATIONS,
    ESTIMATE_CHANGE_TOLERANCE,
    MAX_REFITS,
    MIN_WEIGHT,
    NOISE_CHANGE_TOLERANCE,
    REFIT_STAGES,
)
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares, solve_least_squares
from pneuopt.shooting.tolerances import MAX_CHI_SQUARE_RATIO


class Loss(Protocol):
    """A robust loss: the weight of a residual falls with its size."""

    def weight(self, r: Array) -> Array:
        """The weight psi(r)/r of residuals r in standard deviations; 1 for small ones."""
        ...

    def slope(self, r: Array) -> Array:
        """The derivative psi'(r) for residuals r in standard deviations."""
        ...


@dataclass(frozen=True)
class Huber:
    """Quadratic up to a threshold, linear beyond (Huber 1964).

    Parameters
    ----------
    threshold : float
        In standard deviations; at 1.345 the estimates' variance is 5 % above the least where there are no outliers.

    Examples
    --------
    >>> Huber(1.0).weight(np.array([-0.5, 4.0])).tolist()
    [1.0, 0.25]
    """

    threshold: float = 1.345

    def __post_init__(self) -> None:
        require(self.threshold > 0, f"Huber: the threshold must be positive, got {self.threshold:g}")

    def weight(self, r: Array) -> Array:
        """The weight psi(r)/r of residuals r in standard deviations."""
        return np.asarray(self.threshold / np.maximum(np.abs(r), self.threshold))

    def slope(self, r: Array) -> Array:
        """The derivative psi'(r) for residuals r in standard deviations."""
        return np.asarray(np.abs(r) <= self.threshold, dtype=float)


@dataclass(frozen=True)
class SoftL1:
    """``2 c^2 (sqrt(1 + (r/c)^2) - 1)``: a Huber loss without a corner.

    Parameters
    ----------
    threshold : float
        c, in standard deviations.

    Examples
    --------
    >>> SoftL1(1.0).weight(np.array([0.0])).tolist()
    [1.0]
    """

    threshold: float = 1.345

    def __post_init__(self) -> None:
        require(self.threshold > 0, f"SoftL1: the threshold must be positive, got {self.threshold:g}")

    def weight(self, r: Array) -> Array:
        """The weight psi(r)/r of residuals r in standard deviations."""
        return np.asarray(1 / np.sqrt(1 + (r / self.threshold) ** 2))

    def slope(self, r: Array) -> Array:
        """The derivative psi'(r) for residuals r in standard deviations."""
        return np.asarray((1 + (r / self.threshold) ** 2) ** -1.5)


def fit_robustly(
    problem: EstimationProblem, fit: Fit, loss: Loss | None = None, *, estimate_noise: bool = False
) -> tuple[EstimationProblem, Fit]:
    """Repeat a fit with new weights and noise levels until neither they nor the estimates move.

    Each channel's noise becomes the white part of its residuals: a wrong model's slow error stays visible.
    """
    if loss is None and not estimate_noise:
        return problem, fit
    warm = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    current, fits = problem, [fit]
    for _ in range(MAX_REFITS):
        if fit.status.code in (Code.DIVERGED, Code.INTERRUPTED):
            break
        before, (current, fit) = (current, fit), _refit(current, fit, loss, warm, estimate_noise=estimate_noise)
        fits.append(fit)
        if _is_stationary(before, (current, fit)):
            break
    current, fit = replace(current, method=problem.method), fits[-1].with_effort_of(*fits[:-1])
    status = fit.status
    if loss is not None and status.converged and fit.jumps is None:
        status = Status(status.code, _describe_outliers(current, fit, len(fits)))
    return current, replace(fit, stats={**fit.stats, "refits": len(fits) - 1.0}, status=status)


def white_chi_square(problem: EstimationProblem, fit: Fit) -> float:
    """Sum of squares of the white part of a fit's residuals, in noise variances; 0 with the weights of a robust loss.

    A fit in a wrong basin has a larger sum of squares, for slow residuals do not count here (`noise_level`).
    """
    total = 0.0
    if problem.weights:
        return total
    for e, run in zip(problem.experiments, fit.trajectories, strict=True):
        levels = _estimate_noise(problem, e, run).noise
        for channel in outputs_in_log(problem.system, e):
            samples = int(np.isfinite(e.trajectory[channel]).sum())
            total += samples * (levels[channel] / e.noise[channel]) ** 2
    return total


def _describe_outliers(problem: EstimationProblem, fit: Fit, fits: int) -> tuple[str, ...]:
    """Sentences on the outliers, and on the misfit in the other samples."""
    worst, level, beyond, count = "", 1.0, 0, 0
    for e, run in zip(problem.experiments, fit.trajectories, strict=True):
        residuals = _residuals_in_noise(problem, e, run)
        scales = _channel_scales(residuals)
        beyond += int(np.sum(np.abs(residuals) > CLEAR_DEVIATIONS * scales))
        count += int(np.isfinite(residuals).sum())
        if scales.max() > level:
            level, channel = float(scales.max()), outputs_in_log(problem.system, e)[int(np.argmax(scales))]
            worst = f"{channel} of {e.name}"
    outliers = f"{beyond} of {count} samples are outliers, beyond {CLEAR_DEVIATIONS:g} standard deviations"
    verdict = f"{fits - 1} refits, {outliers}"
    if level**2 <= MAX_CHI_SQUARE_RATIO:
        return (verdict,)
    misfit = f"residuals are {level:.2g} times that of {worst}"
    return verdict, f"the model does not explain the log to its noise: {misfit}"


def _refit(
    problem: EstimationProblem, fit: Fit, loss: Loss | None, method: LeastSquares, *, estimate_noise: bool
) -> tuple[EstimationProblem, Fit]:
    """The next fit, from the last one, with weights and noise levels from its residuals."""
    runs = dict(zip((e.name for e in problem.experiments), fit.trajectories, strict=True))
    if estimate_noise:
        logs = tuple(_estimate_noise(problem, e, runs[e.name]) for e in problem.experiments)
        problem = replace(problem, experiments=logs)
    residuals = {e.name: _residuals_in_noise(problem, e, runs[e.name]) for e in problem.experiments}
    scales = {n: _channel_scales(r) for n, r in residuals.items()}
    weights = {} if loss is None else {n: np.fmax(loss.weight(r / scales[n]), MIN_WEIGHT) for n, r in residuals.items()}
    problem = replace(problem, weights={n: np.nan_to_num(w, nan=1.0) for n, w in weights.items()}, method=method)
    found = solve_least_squares(problem.transcription(problem.start_from(fit)), method)
    if loss is None:
        return problem, replace(found, variance_inflation=1.0)
    # the variance by Huber's sandwich, E psi^2 / (E psi')^2 at each channel's scale, over that of least squares
    parts = [(r, np.broadcast_to(scales[n], r.shape), weights[n]) for n, r in residuals.items()]
    r, s, w = (np.concatenate([part[i].ravel() for part in parts]) for i in range(3))
    known = np.isfinite(r)
    r, s, w = r[known], s[known], w[known]
    inflation = float(np.mean((w * r) ** 2) * np.mean(w) / (np.mean(loss.slope(r / s)) ** 2 * np.mean(w * r**2)))
    return problem, replace(found, variance_inflation=inflation)


def _residuals_in_noise(problem: EstimationProblem, experiment: Experiment, run: Trajectory) -> Array:
    """The residuals in noise standard deviations, shape (n, n_measured)."""
    outputs = outputs_in_log(problem.system, experiment)
    noise = np.array([experiment.noise[o] for o in outputs])
    return np.asarray((experiment.trajectory.matrix(outputs) - run.matrix(outputs)) / noise)


def _channel_scales(residuals: Array) -> Array:
    """The scale of each channel's residuals: 1.4826 MAD, or the noise where more than half of them vanish."""
    scales = 1.4826 * np.nanmedian(np.abs(residuals), axis=0)
    return np.where(scales > 0, scales, 1.0)


def _estimate_noise(problem: EstimationProblem, experiment: Experiment, run: Trajectory) -> Experiment:
    levels = {}
    for channel in outputs_in_log(problem.system, experiment):
        level = noise_level(experiment.trajectory[channel] - run[channel], run.t)
        levels[channel] = level if level > 0 else experiment.noise[channel]
    return experiment.with_noise(levels)


def _is_stationary(before: tuple[EstimationProblem, Fit], after: tuple[EstimationProblem, Fit]) -> bool:
    """Whether a refit has hardly moved an estimate or a noise level."""
    (old_problem, old), (problem, fit) = before, after
    if fit.covariance is None:
        return False
    moved = np.array([fit.parameters.value(n) - old.parameters.value(n) for n in fit.parameters.free_names])
    deviation = np.sqrt(np.diag(fit.covariance))
    steps = np.abs(moved[deviation > 0]) / deviation[deviation > 0]
    logs = zip(old_problem.experiments, problem.experiments, strict=True)
    levels = [abs(math.log(b.noise[n] / a.noise[n])) for a, b in logs for n in b.noise]
    return bool(
        np.max(steps, initial=0.0) < ESTIMATE_CHANGE_TOLERANCE and max(levels, default=0.0) < NOISE_CHANGE_TOLERANCE
    )
