"""`fit_candidates`: fits of several models to the same logs, made alike so that their residuals can be compared.

Residuals compare where the models run alike: whole logs, or windows of one length, without gaps that take a misfit in
their place. And they compare at common widths: a width is a means of integration, and one that each candidate has
chosen for itself would be a hidden parameter, which Coulomb friction can use to imitate presliding or the Stribeck
curve. A width that is a property of the friction is freed, in a candidate of its own.

Windows and widths are those of the leader, the simplest of the candidates that follow the logs best in short searches
with loose gaps; a model that is too simple would cut the logs into windows so short that nothing tells the others
apart. Candidates that such searches show to be hopeless beside the leader's fit are not searched any longer.
"""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pneuopt.dynamics.system import System, names
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.trials import Trial, try_candidate
from pneuopt.identification.widths import COMMON_WIDTH
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.least_squares import LeastSquares

# samples of a window where candidates jump from segment to segment and none has chosen one: fewer hardly tell models
# apart, with more a wrong one may run away
JUMPING_WINDOW_SAMPLES = 100
# squares of a trial over the least of all [1], up to which the simplest candidate leads: lower lets idle terms lead,
# higher a model that does not follow the logs
LEADER_RATIO = 1.1
# squares that a short search promises over the leader's [1] above which a candidate is hopeless: lower gives up models
# that a whole search may save, higher searches for minutes what comes out last
HOPELESS_RATIO = 4.0


@dataclass(frozen=True)
class Candidate:
    """A model and its parameters, of which the free ones are estimated."""

    system: System
    parameters: ParameterSet

    def extends(self, other: "Candidate") -> bool:
        """Whether the other has the same states, and a part of this one's free parameters."""
        return self.has_states_of(other) and set(other.parameters.free_names) < set(self.parameters.free_names)

    def has_states_of(self, other: "Candidate") -> bool:
        """Whether a start of the other's states is one of this one's."""
        return names(other.system.states) == names(self.system.states)


@dataclass(frozen=True)
class Refutation:
    """Why a candidate was not fitted: its squares by a short search, and a few words.

    Parameters
    ----------
    chi_square : float
        Of its fit, at least, in variances of the declared noise.
    free : tuple of str
        The parameters that it would estimate.
    reason : str
    """

    chi_square: float
    free: tuple[str, ...]
    reason: str


Fits = dict[str, IdentificationResult | Refutation]


def fit_candidates(
    candidates: Mapping[str, Candidate],
    experiments: tuple[Experiment, ...],
    method: LeastSquares | None,
    window: float | None,
) -> Fits:
    """Fit every candidate alike, or refute it.

    Parameters
    ----------
    candidates : mapping of str to Candidate
    experiments : tuple of Experiment
    method : LeastSquares or None
    window : float or None
        As of `identify`; None: whole logs, or the windows of the leader if it needs some.

    Returns
    -------
    dict of str to IdentificationResult or Refutation
        The results whatever their status. One that did not converge by itself has begun again at the richest one
        within it.
    """
    alike = _Alike(experiments, method or LeastSquares(), window)
    trials, out = dict[str, Trial](), Fits()
    for name, candidate in candidates.items():
        alike.announce("trying", name, len(trials), len(candidates))
        trials[name] = alike.try_shortly(candidate)
    for name in _by_rank(candidates, trials):
        alike.announce("fitting", name, len(out), len(candidates))
        out[name] = fit = alike.fit(candidates[name])
        if fit.status.converged:
            out = _fit_beside(name, fit, candidates, trials, alike)
            break
    return {n: out[n] for n in candidates}


def _by_rank(candidates: Mapping[str, Candidate], trials: Mapping[str, Trial]) -> list[str]:
    """The candidates' names, the leader first: the simplest near the least squares, the others by their squares."""
    least = min(trial.squares for trial in trials.values())
    near = [n for n, trial in trials.items() if trial.squares <= LEADER_RATIO * least]
    leader = min(near or trials, key=lambda n: len(candidates[n].parameters.free_names))
    return sorted(trials, key=lambda n: (n != leader, trials[n].squares))


def _fit_beside(
    leader: str,
    fit: IdentificationResult,
    candidates: Mapping[str, Candidate],
    trials: Mapping[str, Trial],
    alike: "_Alike",
) -> Fits:
    """The fit of the leader and those of the others, as alike to it as can be, the simplest first."""
    widths, out = {width.name: width.value for width in fit.widths}, Fits({leader: fit})
    for name in candidates.keys() - {leader}:
        if (refutation := _refute(name, leader, fit, candidates, trials, alike)) is not None:
            out[name] = refutation
    others = sorted(candidates.keys() - out.keys(), key=lambda n: len(candidates[n].parameters.free_names))
    if others and alike.window is None:
        alike = alike.with_window_of(fit)
        if fit.window is None and alike.window != math.inf:
            out[leader] = alike.fit(candidates[leader])
    for name in others:
        alike.announce("fitting", name, len(out), len(candidates))
        out[name] = found = _fit_one(_with_widths(candidates[name], widths), leader, candidates, alike, out)
        widths = {**{width.name: width.value for width in found.widths}, **widths}
    return out


def _refute(
    name: str,
    leader: str,
    fit: IdentificationResult,
    candidates: Mapping[str, Candidate],
    trials: Mapping[str, Trial],
    alike: "_Alike",
) -> Refutation | None:
    """The refutation of a candidate beside the leader's fit; None where it may explain the logs as well.

    A static map is always fitted, for that is as short.
    """
    candidate = _with_widths(candidates[name], {width.name: width.value for width in fit.widths})
    known = trials[name] if candidate == candidates[name] else None
    squares = max(trials[leader].squares, alike.squares(fit), float(fit.fit["samples"].sum()))
    enough = HOPELESS_RATIO * squares
    if not candidate.system.states or (known is not None and known.least <= enough):
        return None
    near = fit if candidate.has_states_of(candidates[leader]) else None
    trial = alike.try_shortly(candidate, near, known, enough)
    if not enough < trial.least < math.inf:
        return None
    words = f"short searches with loose gaps leave {trial.least / squares:.3g} times the squares of {leader}"
    return Refutation(trial.least, candidate.parameters.free_names, words)


def _fit_one(
    candidate: Candidate, leader: str, candidates: Mapping[str, Candidate], alike: "_Alike", fits: Fits
) -> IdentificationResult:
    """The fit of a candidate, from the leader's where one is nested in the other, or else from its own starts."""
    within = {
        n: fit
        for n, fit in fits.items()
        if isinstance(fit, IdentificationResult) and fit.status.converged and candidate.extends(candidates[n])
    }
    own = fits[leader]
    assert isinstance(own, IdentificationResult)
    is_nested = leader in within or candidates[leader].extends(candidate)
    fit = alike.fit(candidate, own) if is_nested else alike.fit(candidate)
    if is_nested and not fit.status.converged:
        fit = alike.fit(candidate)
    if within and not fit.status.converged:
        richest = max(within, key=lambda n: len(candidates[n].parameters.free_names))
        again = alike.fit(candidate, within[richest])
        fit = again if again.status.converged else fit
    return fit


@dataclass(frozen=True)
class _Alike:
    """How all candidates are fitted."""

    experiments: tuple[Experiment, ...]
    method: LeastSquares
    window: float | None

    @property
    def length(self) -> float:
        """The duration of a window [s]; infinite for whole logs."""
        return math.inf if self.window is None else self.window

    @property
    def _own_method(self) -> LeastSquares:
        """The method, with windows in one segment each, which a start follows well."""
        return self.method if math.isinf(self.length) else replace(self.method, segment_time=self.length)

    def fit(self, candidate: Candidate, start: IdentificationResult | None = None) -> IdentificationResult:
        """The fit of a candidate; one whose states jump within whole logs has not converged."""
        given, logs, method = candidate.parameters, self.experiments, self._own_method
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="before the search")  # the table says what is unidentifiable
            fit = identify(candidate.system, logs, given, method=method, window=self.window, start=start, throw=False)
        if self.window == math.inf and fit.status.converged and _has_jumps(fit, self.method):
            words = "it follows whole logs only with jumps of its states", *fit.status.sentences
            fit = replace(fit, status=Status(Code.NOT_CONVERGED, words))
        return fit

    def try_shortly(
        self,
        candidate: Candidate,
        near: IdentificationResult | None = None,
        known: Trial | None = None,
        enough: float = math.inf,
    ) -> Trial:
        """The short search of a candidate."""
        given = candidate.system, self.experiments, candidate.parameters, self._own_method
        return try_candidate(*given, window=self.length, near=near, known=known, enough=enough)

    def announce(self, action: str, name: str, done: int, count: int) -> None:
        """Say whose search begins."""
        if self.method.progress is not None:
            self.method.progress(f"{action} {name}, {done + 1} of {count} candidates")

    def with_window_of(self, fit: IdentificationResult) -> "_Alike":
        """The same with the window that a fit has needed, or whole logs; a fit whose states jump needs one, too."""
        if _has_jumps(fit, self.method):
            step = max(float(np.median(np.diff(e.trajectory.t))) for e in self.experiments)
            return replace(self, window=JUMPING_WINDOW_SAMPLES * step)
        return replace(self, window=fit.window.duration if fit.window else math.inf)

    def squares(self, fit: IdentificationResult) -> float:
        """The squared residuals of a fit of whole logs in variances of the noise; zero of one that jumps."""
        table = fit.fit
        jumps = fit.window is not None or _has_jumps(fit, self.method)
        return 0.0 if jumps else float(((table["rmse"] / table["noise"]) ** 2 * table["samples"]).sum())


def _has_jumps(fit: IdentificationResult, method: LeastSquares) -> bool:
    """Whether gaps stand for noise of the states in a fit of whole logs."""
    return fit.window is None and fit.stats["gap_deviation"] > method.stages[-1].gap


def _with_widths(candidate: Candidate, widths: Mapping[str, float]) -> Candidate:
    """The candidate with the common widths, where the user has stated none."""
    own, known = candidate.parameters, candidate.system.excitation.widths
    every = {name for width in known for name in (width.name, *width.follows)} & own.keys() & widths.keys()
    edits = {n: replace(own[n], value=widths[n], source=COMMON_WIDTH) for n in every}
    return replace(candidate, parameters=own | ParameterSet(edits))
