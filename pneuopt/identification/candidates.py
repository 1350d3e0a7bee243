"""`fit_candidates`: fits of several models to the same logs, made alike so that their residuals can be compared.

Residuals compare where the models run alike: whole logs, or windows of one length, without gaps that take a misfit in
their place. And they compare at common widths: a width is a means of integration, and one that each candidate has
chosen for itself would be a hidden parameter, which Coulomb friction can use to imitate presliding or the Stribeck
curve. A width that is a property of the friction is freed, in a candidate of its own.

Windows and widths are those of the leader, the simplest of the candidates that follow the logs best in short searches
with loose gaps; a model that is too simple would cut the logs into windows so short that nothing tells the others
apart. Candidates that such searches show to be hopeless beside the leader's are not searched any longer. In windows the
others begin where the leader has ended, if they have its states.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
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
# apart, with more all gather so much misfit that no search settles
JUMPING_WINDOW_SAMPLES = 20
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
    """Why a candidate was not fitted: its squares over the leader's in short searches, and a few words.

    Parameters
    ----------
    leader : str
    ratio : float
    free : tuple of str
        The parameters that it would estimate.
    reason : str
    """

    leader: str
    ratio: float
    free: tuple[str, ...]
    reason: str


Fits = dict[str, IdentificationResult | Refutation]
Trials = dict[str, Trial]


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
    trials, out = _try_all(candidates, alike), Fits()
    for name in _by_rank(candidates, trials):
        alike.announce("fitting", name, len(out), len(candidates))
        out[name] = fit = alike.fit(candidates[name])
        if fit.status.converged:
            out = _fit_beside(name, fit, candidates, trials, alike)
            break
    return {n: out[n] for n in candidates}


def _try_all(candidates: Mapping[str, Candidate], alike: "_Alike") -> Trials:
    """A trial of each candidate's first start, the richest first, which leaves the others the fewest squares."""
    trials, allowed = Trials(), tuple[float, ...]()
    for name in _richest_first(candidates):
        alike.announce("trying", name, len(trials), len(candidates))
        trials[name] = alike.try_shortly(candidates[name], allowed=allowed)
        allowed = _hopeless_squares(min(trials.values(), key=lambda trial: trial.squares))
    return trials


def _richest_first(candidates: Mapping[str, Candidate]) -> list[str]:
    return sorted(candidates, key=lambda n: -len(candidates[n].parameters.free_names))


def _hopeless_squares(best: Trial) -> tuple[float, ...]:
    """The squares after each stage beyond which another candidate is hopeless."""
    return tuple(HOPELESS_RATIO * squares for squares in best.by_stage)


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
    trials: Trials,
    alike: "_Alike",
) -> Fits:
    """The fit of the leader and those of the others, as alike to it as can be, the simplest first."""
    widths, out = {width.name: width.value for width in fit.widths}, Fits({leader: fit})
    out |= _refute_hopeless(leader, fit, candidates, trials, alike)
    others = sorted(candidates.keys() - out.keys(), key=lambda n: (len(candidates[n].parameters.free_names), n))
    if others and alike.window is None:
        alike = alike.with_window_of(fit)
        if fit.window is None and alike.window != math.inf:
            out[leader] = alike.fit(candidates[leader], fit)
    for name in others:
        alike.announce("fitting", name, len(out), len(candidates))
        out[name] = found = _fit_one(_with_widths(candidates[name], widths), leader, candidates, alike, out)
        widths = {**{width.name: width.value for width in found.widths}, **widths}
    return out


def _refute_hopeless(
    leader: str, fit: IdentificationResult, candidates: Mapping[str, Candidate], trials: Trials, alike: "_Alike"
) -> dict[str, Refutation]:
    """The refutations of candidates beside the leader's fit; a case of a refuted one needs no more than its own trial.

    A static map is always fitted, for that is as short.
    """
    out, widths = dict[str, Refutation](), {width.name: width.value for width in fit.widths}
    for name in _richest_first({n: c for n, c in candidates.items() if n != leader and c.system.states}):
        candidate, trial = _with_widths(candidates[name], widths), trials[name]
        is_tried = candidate == candidates[name] and bool(trial.by_stage)
        if is_tried and not trial.is_hopeless:
            continue
        if not (is_tried and any(candidates[n].extends(candidate) for n in out)):
            near = fit if candidate.has_states_of(candidates[leader]) else None
            trial = alike.try_shortly(candidate, near, trial if is_tried else None, _hopeless_squares(trials[leader]))
        if trial.ratio:
            ratio = HOPELESS_RATIO * trial.ratio
            words = f"short searches with loose gaps leave {ratio:.3g} times the squares of {leader}"
            out[name] = Refutation(leader, ratio, candidate.parameters.free_names, words)
    return out


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
    is_near = candidate.has_states_of(candidates[leader]) and (
        leader in within or candidates[leader].extends(candidate) or math.isfinite(alike.length)
    )
    fit = alike.fit(candidate, own) if is_near else alike.fit(candidate)
    if is_near and not fit.status.converged:
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
        allowed: Sequence[float] = (),
    ) -> Trial:
        """The short search of a candidate."""
        given = candidate.system, self.experiments, candidate.parameters, self._own_method
        return try_candidate(*given, window=self.length, near=near, known=known, allowed=allowed)

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


def _has_jumps(fit: IdentificationResult, method: LeastSquares) -> bool:
    """Whether gaps stand for noise of the states in a fit of whole logs."""
    return fit.window is None and fit.stats["gap_deviation"] > method.stages[-1].gap


def _with_widths(candidate: Candidate, widths: Mapping[str, float]) -> Candidate:
    """The candidate with the common widths, where the user has stated none."""
    own, known = candidate.parameters, candidate.system.excitation.widths
    every = {name for width in known for name in (width.name, *width.follows)} & own.keys() & widths.keys()
    edits = {n: replace(own[n], value=widths[n], source=COMMON_WIDTH) for n in every}
    return replace(candidate, parameters=own | ParameterSet(edits))
