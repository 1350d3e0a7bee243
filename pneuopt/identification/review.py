"""`review_fit`: corrected intervals of a fit, what its logs do not identify, and the worst place of a failed fit.

`FixedValueTest`: whether a wrong fixed value explains why a model misses its logs, and which one. Each fixed parameter
counts as one more unknown where a search has ended, and the gradient of the cost by it tells how much of the misfit its
freeing would take away (Rao's score test, Proc. Cambridge Philos. Soc. 44, 1948). The promise is linear, and a wrong
model promises much; so the best are tried, each by a fit with it freed, and named by what that fit finds.
"""

import math
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.identifiability import (
    add_profiles,
    add_unidentifiable,
    verdict_from_covariance,
    verdict_from_sensitivities,
)
from pneuopt.identification.problem import EstimationProblem, outputs_in_log
from pneuopt.identification.profiles import Profile, trace_profile
from pneuopt.identification.result import (
    AT_BOUND_NOTE,
    UNIDENTIFIABLE_NOTE,
    IdentificationResult,
    Mark,
    Verdict,
    join_names,
)
from pneuopt.identification.tolerances import (
    ALIKE_SQUARES,
    CLEAR_DEVIATIONS,
    LAST_TRIAL_ITERATIONS,
    MAX_FREED_TRIALS,
    MAX_LINEAR_DEVIATION,
    MIN_EXPLAINED_SHARE,
    MIN_PROMISED_SHARE,
    MIN_RELATIVE_CHANGE,
    MODEL_ERROR_LEVEL,
    PROFILE_DRAG_DEVIATIONS,
    TRIAL_FIT_ITERATIONS,
    WHOLE_SHARE,
)
from pneuopt.identification.widths import estimated_widths
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import write_value
from pneuopt.shooting.equations import segment_gaps
from pneuopt.shooting.least_squares import Fit, SearchEnd, solve_least_squares, start_search
from pneuopt.shooting.segments import segment, start_nodes
from pneuopt.shooting.tolerances import MAX_CHI_SQUARE_RATIO

if TYPE_CHECKING:
    import pandas as pd


def review_fit(
    problem: EstimationProblem, result: IdentificationResult, unidentifiable: Sequence[str] = ()
) -> tuple[IdentificationResult, tuple[Profile, ...]]:
    """Review the intervals of a fit, mark what its logs do not identify, and return the profiles traced on the way.

    Without convergence no interval stays, and the status names the worst place.
    """
    start = problem.start_from(result)
    if not result.status.converged:
        return _review_failure(problem, start, result), ()
    result = replace(result, estimates=_blank_intervals(result.estimates, unidentifiable))
    profiles, waiting = _profiles(problem, result)
    result = _widen_dragged(result, profiles)
    trusted = result.stats["chi_square_ratio"] <= MAX_CHI_SQUARE_RATIO
    known, names = result.covariance.copy(), list(unidentifiable)
    known.loc[names] = math.nan
    known[names] = math.nan
    verdict = verdict_from_covariance(problem, start, known, trusted=trusted)
    verdict = add_profiles(verdict, profiles)
    widths = estimated_widths(problem.parameters)
    if asked := [n for n in unidentifiable if n not in widths]:
        local = _verdict_at(problem, start, result)
        given = problem.unknowns()
        unchanged = [n for n in asked if problem.fixed.get(n) == given.value(n) and n not in problem.unseen]
        verdict = add_unidentifiable(verdict, asked, local, unchanged)
    unknown = {*unidentifiable, *verdict.unidentifiable}
    estimates = _blank_intervals(result.estimates, unknown)
    for name, found in profiles.items():
        # the linear interval is that of the curvature at the peak, which says little of the side on which it is flat
        ends = [found.low, found.high]
        if estimates["bias"][name] > 0:
            ends = [min(found.low, estimates["ci_low"][name]), max(found.high, estimates["ci_high"][name])]
        estimates.loc[name, ["ci_low", "ci_high"]] = ends
        farther = max(found.high - found.estimate, found.estimate - found.low) / math.sqrt(found.threshold)
        deviation = math.nan if found.is_open else max(farther, float(result.estimates["stderr"][name]))
        estimates.loc[name, "stderr"] = deviation
    estimates = _add_notes(estimates, unknown)
    covariance, status = _widen_covariance(result.covariance, estimates["stderr"]), result.status
    if waiting:
        words = f"the estimates are found, the interval of {waiting[0]} is not"
        detail = f"the intervals of {join_names(waiting)} are of the linear model, which is doubtful here"
        status = Status(Code.INTERRUPTED, (words, detail, *status.sentences[1:], "run again for the intervals"))
    status = _name_part(problem, status, verdict)
    result = replace(result, estimates=estimates, covariance=covariance, status=status, verdict=verdict)
    return result, tuple(profiles.values())


def _widen_covariance(covariance: "pd.DataFrame", stderr: "pd.Series[float]") -> "pd.DataFrame":
    """The covariance with the correlations as they are and these standard deviations; NaN where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = stderr.to_numpy(dtype=float) / np.sqrt(np.diag(covariance))
    return covariance * np.outer(ratio, ratio)


def _blank_intervals(estimates: "pd.DataFrame", names: Iterable[str]) -> "pd.DataFrame":
    """The estimates without intervals for the named parameters."""
    out = estimates.copy()
    out.loc[list(names), ["stderr", "ci_low", "ci_high", "bias"]] = math.nan
    return out


def _verdict_at(problem: EstimationProblem, start: Start, result: IdentificationResult) -> Verdict:
    """The verdict from the sensitivities at a start, with the residuals of a result."""
    return verdict_from_sensitivities(
        problem, start, max(1.0, result.stats["chi_square_ratio"] * result.stats["variance_inflation"])
    )


def _profiles(problem: EstimationProblem, result: IdentificationResult) -> tuple[dict[str, Profile], list[str]]:
    """Profiles where a linear interval is doubtful, or moves far along an open one; and the names that Ctrl-C left."""
    found: dict[str, Profile] = {}
    rows = result.estimates
    known = rows.index[np.isfinite(rows["stderr"])]
    is_missed = result.stats["chi_square_ratio"] > MODEL_ERROR_LEVEL**2
    if is_missed or result.stats["gap_deviation"] > problem.method.stages[-1].gap:
        return found, []  # an error of the model, or noise of the states: the bias is not in a profile
    unknowns = problem.unknowns()
    doubtful = (n for n in known if unknowns[n].log and rows["stderr"][n] > MAX_LINEAR_DEVIATION * rows["value"][n])
    waiting = [n for n in doubtful if n not in estimated_widths(problem.parameters)]  # nobody asks for their intervals
    try:
        while waiting:
            name = waiting[0]
            found[name] = trace_profile(problem, result, name)
            dragged = [
                n
                for n in _parameters_outside_interval(found[name], rows)
                if n in known and n not in found and n not in waiting
            ]
            waiting = [*waiting[1:], *(dragged if found[name].is_open else [])]
    except KeyboardInterrupt:
        return found, waiting
    return found, []


def _widen_dragged(result: IdentificationResult, profiles: Mapping[str, Profile]) -> IdentificationResult:
    """The result with intervals that hold where a closed profile drags parameters that have none of their own.

    Static friction over a Stribeck velocity that was known to a factor of thirty was 16 deviations off, with +-2 N.
    """
    estimates = result.estimates.copy()
    for profile in profiles.values():
        inside = profile.curve[profile.curve["deviance"] <= profile.threshold]
        for name in _parameters_outside_interval(profile, result.estimates):
            if name in profiles or not math.isfinite(estimates["stderr"][name]):
                continue
            value, low, high = float(estimates["value"][name]), float(inside[name].min()), float(inside[name].max())
            farther = max(high - value, value - low) / math.sqrt(profile.threshold)
            row = [min(low, estimates["ci_low"][name]), max(high, estimates["ci_high"][name])]
            estimates.loc[name, ["ci_low", "ci_high"]] = row
            estimates.loc[name, "stderr"] = max(farther, float(estimates["stderr"][name]))
    return replace(result, estimates=estimates, covariance=_widen_covariance(result.covariance, estimates["stderr"]))


def _parameters_outside_interval(profile: Profile, estimates: "pd.DataFrame") -> Iterator[str]:
    """Other parameters that leave their linear interval within the interval of the profiled one."""
    inside = profile.curve[profile.curve["deviance"] <= profile.threshold]
    for name in estimates.index.drop(profile.name):
        moved = (inside[name] - estimates["value"][name]).abs().max()
        if moved > PROFILE_DRAG_DEVIATIONS * estimates["stderr"][name]:
            yield str(name)


def _add_notes(estimates: "pd.DataFrame", unidentifiable: Container[str]) -> "pd.DataFrame":
    """A note on each estimate at a bound or unidentifiable; NaN for the value of the latter."""
    bound = estimates["at_bound"]
    notes = [AT_BOUND_NOTE if bound[n] else UNIDENTIFIABLE_NOTE if n in unidentifiable else "" for n in estimates.index]
    out = estimates.assign(note=notes)
    known = out["note"] != UNIDENTIFIABLE_NOTE
    return out.assign(value=out["value"].where(known), mark=out["mark"].where(known, Mark.UNIDENTIFIABLE))


def _review_failure(problem: EstimationProblem, start: Start, result: IdentificationResult) -> IdentificationResult:
    """The result without intervals; its status names the worst place and the remedies, unless it was interrupted."""
    verdict, status = _verdict_at(problem, start, result), result.status
    estimates = _add_notes(_blank_intervals(result.estimates, result.estimates.index), verdict.unidentifiable)
    if status.code is not Code.INTERRUPTED:
        status = status.with_details(_worst_residual(problem, start), _worst_gap(problem, start))
        status = status.with_remedies(_name_unidentifiable(verdict.unidentifiable))
    unknown = result.covariance * math.nan
    return replace(result, estimates=estimates, covariance=unknown, status=status, verdict=verdict)


def _name_part(problem: EstimationProblem, status: Status, verdict: Verdict) -> Status:
    """The status of a fit with what its logs do not identify, and where that is held; first where it is good."""
    unknowns = problem.unknowns()
    fixed = {n: v for n, v in problem.fixed.items() if n not in estimated_widths(problem.parameters)}
    held = [f"{n} at {write_value(fixed[n], p.unit, 3)}" for n, p in unknowns.items() if n in fixed]
    words = f"held: {join_names(held)}; the intervals of the others allow for a factor of ten" if held else ""
    asked = [
        n for n in verdict.unidentifiable if n not in estimated_widths(problem.parameters)
    ]  # nobody asks for a width
    said = tuple(filter(None, (_name_unidentifiable(asked), words)))
    if not said or status.code is not Code.CONVERGED:
        return status.with_details(*said)
    return Status(Code.PARTIAL, (*said, *status.sentences))


def _name_unidentifiable(names: Sequence[str]) -> str:
    """A sentence on what the logs do not identify; empty if they identify all."""
    return f"the logs do not identify {join_names(names)}" if names else ""


def _worst_residual(problem: EstimationProblem, start: Start, block: int = 50) -> str:
    """A sentence on the block of samples with the largest residuals; empty if all are near the noise."""
    worst, message = MAX_CHI_SQUARE_RATIO, ""
    for log in problem.experiments:
        t, run = log.trajectory.t, start.states[log.name]
        for channel in outputs_in_log(problem.system, log):
            residuals = (log.trajectory[channel] - run[channel]) / log.noise[channel]
            for first in range(0, len(t), block):
                part = residuals[first : first + block]
                size = math.sqrt(float(np.nanmean(part**2))) if np.isfinite(part).any() else 0.0
                if size > worst:
                    last = min(first + block, len(t)) - 1
                    worst, message = size, f"{channel} of {log.name} from {t[first]:.4g} to {t[last]:.4g} s"
    return f"the worst residuals, {worst:.3g} times the noise, are {message}" if message else ""


def _worst_gap(problem: EstimationProblem, start: Start, substeps: int = 20, smallest: float = 1e-4) -> str:
    """A sentence on the state, log and time of the largest gap; of less than `smallest` [nominal sizes] it is empty."""
    segments = segment(problem.transcription(start))
    q = np.array([p.value for p in segments.transcription.parameters.values()])
    nodes = start_nodes(segments)
    ends = segments.run(nodes, q, substeps, sensitivities=False).x_end
    gaps = np.abs(segment_gaps(segments, nodes, ends))
    if not gaps.size or not np.isfinite(gaps).all() or gaps.max() < smallest:
        return ""
    row, column = np.unravel_index(int(np.argmax(gaps)), gaps.shape)
    state = problem.system.states[int(column)]
    log, at = segments.transcription.phases[int(segments.phase[row])].name, segments.t[row + 1, 0]
    return (
        f"the largest gap: {state.name} jumps by {gaps.max() * state.nominal:.2g} {state.unit} at {at:.4g} s of {log}"
    )


# what a user knows better than any value of a rig: of values that logs do not tell apart, it is named last
NATURE = ("ambient.", "gas.")


@dataclass(frozen=True)
class WrongValue:
    """A fixed value that is wrong by the logs."""

    name: str
    given: float  # the fixed value [unit]
    found: float  # that of a fit with it freed [unit]
    unit: str
    share: float  # of the squared residuals beyond the noise that this fit explains [1]
    squares: float  # residuals and gaps that this fit leaves, in noise variances
    alike: tuple[str, ...] = ()  # other fixed values of which each would explain as much
    # the dead time in place of which the value may stand [s]; 0 where it is no bandwidth, or not a lower one
    lag: float = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether it explains the misfit but for a small rest."""
        return self.share >= WHOLE_SHARE

    def __str__(self) -> str:
        found, given = (write_value(v, self.unit, 3) for v in (self.found, self.given))
        others = f"; {' or '.join(self.alike)} would explain as much" if self.alike else ""
        lag = f"; a dead time of {write_value(self.lag, 's', 2)} before it looks the same" if self.lag else ""
        return (
            f"freeing {self.name} explains {self.share:.0%} of the misfit, with {found} in place of {given}{lag}"
            f"{others}: correct it, or free it"
        )


@dataclass
class FixedValueTest:
    """The test of the fixed values of one problem, after the searches that have missed its logs."""

    found: WrongValue | None = None  # the value that explains most of the misfit
    tests: int = field(default=0)  # how many fits have been tested

    def explains(self, problem: EstimationProblem, fit: Fit) -> bool:
        """Whether a fixed value explains most of the misfit of a fit; `found` then names it."""
        is_cut = fit.status.code in (Code.INTERRUPTED, Code.DIVERGED)
        if (
            is_cut
            or problem.weights
            or self.tests >= MAX_FREED_TRIALS
            or not (2 * fit.stats["cost"] > MAX_CHI_SQUARE_RATIO * fit.count or fit.jumps is not None)
            or not math.isfinite(fit.stats["cost"])
        ):
            return False
        self.tests += 1
        self.found = find_wrong_value(problem, fit)
        return self.found is not None


def find_wrong_value(problem: EstimationProblem, fit: Fit) -> WrongValue | None:
    """The fixed value whose freeing explains most of the misfit of a fit; None where none explains enough."""
    # a wrong value drives widths to their bounds, where short fits do not follow: they stay at their starts
    given = problem.parameters
    problem = replace(problem, fixed={**problem.fixed, **{n: given.value(n) for n in estimated_widths(given)}})
    without, freed = promised_squares(problem, fit)
    excess = (without if fit.jumps is not None else 2 * fit.stats["cost"]) - fit.count
    promised = [((without - squares) / max(excess, without - fit.count), name) for name, squares in freed.items()]
    worthwhile = sorted((p for p in promised if p[0] >= MIN_PROMISED_SHARE), reverse=True)[:MAX_FREED_TRIALS]
    trials = list[WrongValue]()
    for share, name in worthwhile:
        if trials and trials[-1].is_whole and share < WHOLE_SHARE * worthwhile[0][0]:
            break
        trials += [found] if (found := _try_freed(problem, fit, name, excess)) else []
    if not trials:
        return None
    least = min(trial.squares for trial in trials)
    level = least + ALIKE_SQUARES * max(1.0, least / fit.count)
    alike = sorted(
        (t for t in trials if t.squares <= level), key=lambda trial: (trial.name.startswith(NATURE), trial.squares)
    )
    best, axis, lag = alike[0], problem.system.plant.axis, 0.0
    if axis is not None and axis.final_element is not None and best.name == axis.final_element.bandwidth:
        # a dead time delays slow commands as a lower bandwidth does
        lag = max(0.0, (1 / best.found - 1 / best.given) / (2 * math.pi))
    return replace(best, alike=tuple(t.name for t in alike[1:]), lag=lag)


def promised_squares(
    problem: EstimationProblem, fit: Fit, only: Container[str] | None = None
) -> tuple[float, dict[str, float]]:
    """The squares with tight gaps by the equations linearised at a fit, and those with each fixed value freed.

    `only` says which of these; None: all.
    """
    # a fixed parameter may be wrong unless it is a width, or each log has or states one of its own
    widths = {w.name for w in problem.system.plant.identification_hints.widths}
    stated = {n for e in problem.experiments for n in e.conditions} | widths
    fixed = {n: p for n, p in problem.parameters.items() if not (p.free or p.per_log) and n not in stated}
    names = [n for n, p in fixed.items() if p.lower < p.value < p.upper and (only is None or n in only)]
    if not names:
        return math.nan, {}
    freed = replace(problem, parameters=problem.parameters.freed(*names))
    here = replace(problem.method, stages=problem.method.stages[-1:], progress=None)
    begun = start_search(segment(freed.transcription(freed.start_from(fit))), here)
    equations, scaling, free = begun.iterate.equations, begun.setup.scaling, freed.unknowns().free_names
    tested = np.isin(free, names)
    movable = scaling.has_effect(equations) & ~scaling.fixed & ~scaling.at_bound(begun.iterate.z)
    squares = {name: equations.promised_squares(movable & (~tested | (np.array(free) == name))) for name in names}
    return equations.promised_squares(movable & ~tested), squares


def free_shown_offset(problem: EstimationProblem, fit: Fit) -> EstimationProblem | None:
    """The problem with the zero of the command freed, where nobody has stated it and the fit promises to gain by it."""
    name = problem.system.plant.centre
    if name is None or problem.parameters[name].stated or not math.isfinite(fit.stats["cost"]):
        return None
    without, freed = promised_squares(problem, fit, {name})
    is_shown = name in freed and gains_beyond_chance(fit, freed[name], without)
    return replace(problem, parameters=problem.parameters.freed(name)) if is_shown else None


def gains_beyond_chance(fit: Fit, squares: float, without: float | None = None) -> bool:
    """Whether one more parameter is worth it by Schwarz's criterion (Annals of Statistics 6(2), 1978).

    `without` is what the squares are without it, those of the fit by default.
    """
    before = 2 * fit.stats["cost"] if without is None else without
    return bool(before > squares * fit.count ** (1 / fit.count))


def _try_freed(problem: EstimationProblem, fit: Fit, name: str, excess: float) -> WrongValue | None:
    """The value that a short fit finds with it freed; None where that explains too little, or it hardly changes."""
    freed = replace(problem, parameters=problem.parameters.freed(name))
    allowed = 1 + (1 - MIN_EXPLAINED_SHARE) * excess / fit.count  # squares a sample
    *others, last = (replace(stage, iterations=TRIAL_FIT_ITERATIONS) for stage in freed.method.stages[1:])
    method, found = replace(freed.method, max_misfit=allowed, allows_state_noise=False), fit
    for stages in ((*others, replace(last, refine=1)), (replace(last, iterations=LAST_TRIAL_ITERATIONS),)):
        found = solve_least_squares(freed.transcription(freed.start_from(found)), replace(method, stages=stages))
        if found.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        optimum, is_left = found.optimum, found.end is SearchEnd.ABANDONED
        if is_left or optimum is None or optimum.equations.promised_squares(optimum.keep) > allowed * fit.count:
            return None
    place, given = found.parameters.free_names.index(name), problem.parameters[name]
    squares = 2 * found.stats["cost"]
    share = 1 - (squares - fit.count) / excess
    value, deviation = found.parameters.value(name), math.inf
    if found.covariance is not None:
        noise = max(1.0, found.chi_square / found.count)
        deviation = math.sqrt(noise * found.covariance[place, place])
    least = max(CLEAR_DEVIATIONS * deviation, MIN_RELATIVE_CHANGE * abs(given.value))
    is_clear = abs(value - given.value) > least and not found.at_bound[place]
    if not (share >= MIN_EXPLAINED_SHARE and is_clear and found.jumps is None):
        return None
    return WrongValue(name, given.value, value, given.unit, min(1.0, share), squares)
