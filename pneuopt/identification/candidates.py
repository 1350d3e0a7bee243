"""`fit_candidates`: fits of several models to the same logs, made alike so that their residuals can be compared.

Residuals compare where the models run alike: whole logs, or windows of one length, without gaps that take a misfit in
their place. And they compare at common widths: a width is a means of integration, and one that each candidate has
chosen for itself would be a hidden parameter, which Coulomb friction can use to imitate presliding or the Stribeck
curve. So the widths of the candidate that predicts the logs best hold for all, and two candidates differ by their terms
alone; a width that is a property of the friction is freed, in a candidate of its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pneuopt.dynamics.system import System, names
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.least_squares import LeastSquares

COMMON_WIDTH = "common to all candidates"
"""Source of a width that is the same in all candidates."""

# samples of a window where candidates jump from segment to segment and none has chosen one: fewer hardly tell models
# apart, with more a wrong one may run away
JUMPING_WINDOW_SAMPLES = 100


@dataclass(frozen=True)
class Candidate:
    """A model and its parameters, of which the free ones are estimated."""

    system: System
    parameters: ParameterSet

    def extends(self, other: "Candidate") -> bool:
        """Whether the other has the same states, and a part of this one's free parameters."""
        alike = names(other.system.states) == names(self.system.states)
        return alike and set(other.parameters.free_names) < set(self.parameters.free_names)


def fit_candidates(
    candidates: Mapping[str, Candidate],
    experiments: tuple[Experiment, ...],
    method: LeastSquares | None,
    window: float | None,
) -> dict[str, IdentificationResult]:
    """Fit every candidate alike; one that does not converge by itself begins again at the richest one within it.

    Parameters
    ----------
    candidates : mapping of str to Candidate
    experiments : tuple of Experiment
    method : LeastSquares or None
    window : float or None
        As of `identify`; None: whole logs, or the windows of the first candidate that needs some.

    Returns
    -------
    dict of str to IdentificationResult
        Whatever their status.
    """
    alike = _Alike(experiments, method or LeastSquares(), window)
    order = sorted(candidates, key=lambda n: len(candidates[n].parameters.free_names))
    first: dict[str, IdentificationResult] = {}
    for name in order:
        alike.announce(name, len(first) + 1, len(order))
        first[name] = alike.fit(candidates[name], candidates[name].parameters)
        alike = alike.with_window_of(first[name])
    widths, out = _common_widths(first), dict[str, IdentificationResult]()
    for name in order:
        given, fit = _with_widths(candidates[name].parameters, first[name], widths), first[name]
        if given != candidates[name].parameters or _duration(fit) != alike.window:
            fit = alike.fit(candidates[name], given)
        inside = [n for n in out if out[n].status.converged and candidates[name].extends(candidates[n])]
        if inside and not fit.status.converged:
            richest = max(inside, key=lambda n: len(candidates[n].parameters.free_names))
            again = alike.fit(candidates[name], given, out[richest])
            fit = again if again.status.converged else fit
        out[name] = fit
    return {n: out[n] for n in candidates}


@dataclass(frozen=True)
class _Alike:
    """How all candidates are fitted."""

    experiments: tuple[Experiment, ...]
    method: LeastSquares
    window: float | None

    def fit(
        self, candidate: Candidate, given: ParameterSet, start: IdentificationResult | None = None
    ) -> IdentificationResult:
        """The fit of a candidate: of whole logs, or of windows in one segment each, which a start follows well."""
        method = self.method if self.window is None else replace(self.method, segment_time=self.window)
        window, logs = self.window, self.experiments
        return identify(candidate.system, logs, given, method=method, window=window, start=start, throw=False)

    def announce(self, name: str, number: int, count: int) -> None:
        """Say whose fit begins."""
        if self.method.progress is not None:
            self.method.progress(f"fitting {name}, {number} of {count} candidates")

    def with_window_of(self, fit: IdentificationResult) -> "_Alike":
        """The same with the window that a fit has needed; a fit whose states jump needs one, too."""
        if self.window is not None or not fit.status.converged:
            return self
        if fit.window is None and fit.stats["gap_deviation"] > self.method.stages[-1].gap:
            step = max(float(np.median(np.diff(e.trajectory.t))) for e in self.experiments)
            return replace(self, window=JUMPING_WINDOW_SAMPLES * step)
        return replace(self, window=_duration(fit))


def _duration(fit: IdentificationResult) -> float | None:
    """The duration of a fit's windows; None for whole logs."""
    return fit.window.duration if fit.window else None


def _common_widths(fits: Mapping[str, IdentificationResult]) -> dict[str, float]:
    """The chosen widths of all candidates, each from the one with the least error of free runs that has it."""
    ranked = sorted(fits.values(), key=lambda fit: (not fit.status.converged, _free_error(fit)))
    return {width.name: width.value for fit in reversed(ranked) for width in fit.widths}


def _free_error(fit: IdentificationResult) -> float:
    error = float(fit.fit["free_run_nrmse"].mean())
    return error if np.isfinite(error) else np.inf


def _with_widths(given: ParameterSet, fit: IdentificationResult, widths: Mapping[str, float]) -> ParameterSet:
    """The parameters with the common widths where the fit's own ones differ."""
    own = {w.name: w.value for w in fit.widths}
    moved = {n: widths[n] for n, value in own.items() if widths[n] != value}
    return given | ParameterSet({n: replace(given[n], value=v, source=COMMON_WIDTH) for n, v in moved.items()})
