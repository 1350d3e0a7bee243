"""`identifiability`: which parameters a set of logs can identify, before and after a fit.

Every decision about it stands here, with its thresholds side by side; only a running search decides by itself which
parameters its data do not determine (`shooting.convergence`, thresholds in `shooting.scaling`).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import Lack, Start
from pneuopt.dynamics.runnable import HasSystem, check_smooth
from pneuopt.identification.examination import pose_problem
from pneuopt.identification.problem import EstimationProblem, as_estimation_model
from pneuopt.identification.profiles import Profile
from pneuopt.identification.result import (
    IdentifiableRow,
    Verdict,
    join_names,
    missing_excitation,
    remedy,
    summarise_motion,
    with_values_in_words,
)
from pneuopt.identification.tolerances import (
    HARMLESS_DEVIATION,
    INFORMATION_ROUNDING,
    LEVEL,
    MAX_EXPECTED_DEVIATION,
    MAX_INFLATION,
    MAX_PRIOR_DEVIATION,
    MAX_PRIOR_VARIANCE_SHARE,
    MAX_REDUCTION_SEGMENTS,
    MAX_RELATIVE_DEVIATION,
    MIN_COMBINATION_SHARE,
    UNIDENTIFIABLE_DEVIATION,
)
from pneuopt.identification.widths import excerpts
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.least_squares import Fit, LeastSquares
from pneuopt.shooting.segments import Segments, choose_integration, segment, start_nodes
from pneuopt.shooting.tolerances import MAX_SEARCH_SUBSTEPS

if TYPE_CHECKING:
    import pandas as pd

MAX_RELATIVE_INTERVAL = 4 * MAX_RELATIVE_DEVIATION  # width of a profile's interval over the value: rough beyond it


UNIDENTIFIED = "the logs do not identify"
VAGUER_THAN_PRIOR = "its standard deviation is as wide as a factor of ten"


def identifiability(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
) -> Verdict:
    """Find which free parameters the logs can identify, before anything is fitted.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`.
    experiments : Experiment or sequence of Experiment
        The logs, as read.
    parameters : ParameterSet
        As for `identify`.
    method : LeastSquares, optional
        Its segments and integration steps count.

    Returns
    -------
    Verdict
        From the sensitivities of the measured outputs along the model's own first start, at the noise that the logs
        declare or show (Cramer-Rao: no estimate is better), and from what the motion lacks. The
        deviations of a wrong model are larger.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    check_smooth(as_estimation_model(system))
    problem = pose_problem(system, experiments, parameters, method or LeastSquares())
    return verdict_from_sensitivities(problem, problem.candidates()[0])


def verdict_from_sensitivities(problem: EstimationProblem, start: Start, variance: float = 1.0) -> Verdict:
    """The verdict from the sensitivities at a start or fit; `variance` of the residuals in noise variances."""
    return _make_verdict(problem, start, _root_information(problem, start) / math.sqrt(variance))


def verdict_from_covariance(
    problem: EstimationProblem, fit: Start, covariance: "pd.DataFrame", *, trusted: bool
) -> Verdict:
    """The verdict from the covariance of a fit, NaN at a bound.

    Where the model explains the logs to their noise (`trusted`) its deviations count whatever motion the logs lack.
    """
    unknowns = problem.unknowns().with_values(fit.parameters)
    chain = np.array([unknowns[str(n)].value if unknowns[str(n)].log else 1.0 for n in covariance.index])
    searched = covariance.to_numpy() / np.outer(chain, chain)
    keep = np.isfinite(np.diag(searched))
    root = np.zeros_like(searched)
    if keep.any():
        known = searched[np.ix_(keep, keep)]
        deviation = np.sqrt(np.diag(known))  # by which covariances of any units meet in one matrix
        values, vectors = np.linalg.eigh(known / np.outer(deviation, deviation))
        root[np.ix_(keep, keep)] = (vectors / np.sqrt(np.maximum(values, 1e-14))).T / deviation
    return _make_verdict(problem, fit, root, inside_bounds=keep, trusted=trusted)


def foresee_unidentifiable(problem: EstimationProblem) -> tuple[str, ...]:
    """Sentences on what logs cannot identify, before the search: motion and outputs show it too little."""
    if not problem.system.states:  # a static map is fitted as soon
        return ()
    start, free = problem.candidates()[0], problem.unknowns().free_names
    hints = problem.system.plant.identification_hints
    values = problem.parameters.with_values({n: v for n, v in start.parameters.items() if n in problem.parameters})
    seen = summarise_motion(problem.experiments, start.states, values, problem.parameters)
    lacking = [n for n in free if missing_excitation(hints, n, free, seen) is not None]
    if not lacking:
        return ()
    part = replace(problem, experiments=excerpts(problem.experiments))
    verdict = verdict_from_sensitivities(part, part.candidates()[0])
    alike, table = {n for group in verdict.indistinguishable for n in group}, verdict.table
    by_reason: dict[str, list[str]] = {}
    for name in (n for n in lacking if n in verdict.reasons):  # a stretch has own names for what each log has its own
        relative = table["relative"][name]
        if name in alike if math.isnan(relative) else relative > MAX_EXPECTED_DEVIATION:
            by_reason.setdefault(verdict.reasons[name], []).append(name)
    return tuple(f"before the search: {UNIDENTIFIED} {join_names(n)}: {reason}" for reason, n in by_reason.items())


def add_profiles(verdict: Verdict, profiles: Mapping[str, Profile]) -> Verdict:
    """The verdict with the intervals of profiles: a parameter with two open ends is unidentifiable."""
    reasons, identifiable = dict(verdict.reasons), verdict.table["identifiable"].copy()
    for name, found in profiles.items():
        is_unidentifiable = math.isinf(found.low) and math.isinf(found.high)
        identifiable[name] = bool(identifiable[name]) and not is_unidentifiable
        reasons.pop(name, None)
        if not found.high - found.low < MAX_RELATIVE_INTERVAL * abs(found.estimate):
            reasons[name] = f"{found.sentence}; {remedy(verdict.identification_hints, [name])}"
    return replace(verdict, table=verdict.table.assign(identifiable=identifiable), reasons=reasons)


def add_unidentifiable(verdict: Verdict, names: Sequence[str], local: Verdict, unchanged: Sequence[str]) -> Verdict:
    """The verdict with parameters marked that rest on a prior; their figures come from `local`, by sensitivities."""
    table, own = verdict.table.copy(), list(names)
    table.loc[own] = local.table.loc[own]
    table.loc[own, "identifiable"] = False
    groups = tuple(group for group in local.indistinguishable if {*group} & {*names})
    grouped = {n for group in groups for n in group}
    reasons = {n: reason for n, reason in verdict.reasons.items() if n not in names}
    vague = {n: f"{VAGUER_THAN_PRIOR}; {remedy(verdict.identification_hints, [n])}" for n in names if n not in grouped}
    reasons |= {**vague, **{n: local.reasons[n] for n in names if n in local.reasons}}
    ordered = tuple(str(n) for n in table.index if n in unchanged)
    return Verdict(table, (*verdict.indistinguishable, *groups), reasons, ordered, verdict.identification_hints)


def rejects_fixed_values(fit: Fit, first: Fit, held: int) -> bool:
    """Whether a likelihood-ratio test rejects the values of `held` parameters that `first` was free in.

    A rise of the gaps' cost alone does not count: finer integration steps show gaps that the first fit missed.
    """
    before, after = first.stats["cost"], fit.stats["cost"]
    rise = min(2 * (after - before), fit.chi_square - first.chi_square)
    noise = max(1.0, 2 * before / max(1, first.count))
    return not rise <= noise * chi2.ppf(LEVEL, held)


def prior_influenced(covariance: Array, prior_covariance: Array) -> Mask:
    """The mask of estimates whose variance the priors of held parameters dominate; covariances of shape (k, k)."""
    return np.asarray(np.diag(prior_covariance) > MAX_PRIOR_VARIANCE_SHARE * np.diag(covariance))


def prior_dominated(covariance: Array, prior_covariance: Array, values: Array, held: Iterable[float]) -> Mask:
    """The mask of estimates that the logs do not identify: they lean on priors, and are not known well even so.

    A factor of ten says nothing of what is held at zero, so nothing that leans on it is known.
    """
    is_close = np.sqrt(np.diag(covariance)) <= MAX_PRIOR_DEVIATION * np.abs(values)
    is_close &= all(held)
    return prior_influenced(covariance, prior_covariance) & ~is_close


def _make_verdict(
    problem: EstimationProblem, start: Start, root: Array, inside_bounds: Mask | None = None, *, trusted: bool = False
) -> Verdict:
    """The verdict from a square root of the information matrix and from the logged motion."""
    import pandas as pd

    unknowns = problem.unknowns().with_values(start.parameters)
    free = {n: unknowns[n] for n in unknowns.free_names}
    names, (spread, alone, weak) = list(free), _standard_deviations(root)
    values = problem.parameters.with_values({n: v for n, v in start.parameters.items() if n in problem.parameters})
    seen = summarise_motion(problem.experiments, start.states, values, problem.parameters)
    rows, reasons, hints = {}, {}, with_values_in_words(problem.system.plant.identification_hints, values)
    for i, (name, p) in enumerate(free.items()):
        if inside_bounds is not None and not inside_bounds[i]:
            rows[name] = [p.value, *[math.nan] * 4, True]
            reasons[name] = "the best fit is at its bound, and the other intervals hold for that value only"
            continue
        unit, size = p.value if p.log else 1.0, 1.0 if p.log else _comparison_size(name, p, problem)
        relative = spread[i] / size if size > 0 else math.nan
        lack = None if trusted else missing_excitation(hints, name, names, seen)
        is_unidentifiable = (
            lack is not None
            or math.isinf(spread[i])
            or relative > (MAX_EXPECTED_DEVIATION if inside_bounds is None else UNIDENTIFIABLE_DEVIATION)
        )
        if is_unidentifiable or relative > MAX_RELATIVE_DEVIATION:
            reasons[name] = _unidentifiable_reason(alone[i], relative, lack, remedy(hints, [name]))
        inflation = spread[i] / alone[i] if math.isfinite(spread[i]) else spread[i]
        rows[name] = [p.value, unit * spread[i], relative, unit * alone[i], inflation, not is_unidentifiable]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=list(IdentifiableRow.__annotations__))
    groups = (tuple(names[i] for i in np.flatnonzero(row)) for row in weak)
    harmful = tuple(group for group in groups if _is_harmful(table.loc[list(group)]))
    return Verdict(table, harmful, reasons, identification_hints=hints)


def _is_harmful(members: "pd.DataFrame") -> bool:
    """Whether a weak combination leaves one of its parameters noticeably uncertain."""
    return bool(members["inflation"].max() > MAX_INFLATION and members["relative"].max() > HARMLESS_DEVIATION)


def _comparison_size(name: str, p: Parameter, problem: EstimationProblem) -> float:
    """The size that a standard deviation is divided by; 0 for an offset, whose usual size is unknown."""
    if p.lower < 0 and p.unit != "1":
        return 0.0
    given = problem.parameters[name.partition("[")[0]].value
    return max(abs(p.value), abs(given), 1.0 if p.unit == "1" else 0.0)


def _unidentifiable_reason(alone: float, relative: float, lack: Lack | None, usual_remedy: str) -> str:
    """The reason why the logs do not identify a parameter, and the remedy."""
    if lack is not None:
        return f"{lack.reason}; {lack.remedy}"
    if math.isinf(alone):
        return "nothing measured depends on it; fix it, or log a run that does"
    message = (
        f"within {relative:.0%} (1 standard deviation)" if relative < UNIDENTIFIABLE_DEVIATION else VAGUER_THAN_PRIOR
    )
    return f"{message}; {usual_remedy}"


def _standard_deviations(root: Array) -> tuple[Array, Array, Mask]:
    """Standard deviations (all unknown; all others known), and the members of each weak combination."""
    size = np.linalg.norm(root, axis=0)
    if not np.isfinite(root).all():
        return size * np.nan, size * np.nan, np.zeros((0, len(size)), dtype=bool)
    informed = size > INFORMATION_ROUNDING * float(np.max(size, initial=0.0))
    with np.errstate(divide="ignore"):
        alone = np.where(informed, 1 / size, math.inf)
    spread, weak = alone.copy(), np.zeros((0, len(size)), dtype=bool)
    if informed.any():
        _, singular, right = np.linalg.svd(root[:, informed] / size[informed])
        inverse = 1 / np.maximum(singular, INFORMATION_ROUNDING)
        spread[informed] = np.linalg.norm(right * inverse[:, None], axis=0) / size[informed]
        parts = np.abs(right[inverse > MAX_INFLATION])
        member = (
            parts > MIN_COMBINATION_SHARE * parts.max(axis=1, keepdims=True)
            if parts.size
            else np.zeros_like(parts, dtype=bool)
        )
        weak = np.zeros((len(member), len(size)), dtype=bool)
        weak[:, informed] = member
    return spread, alone, weak[weak.sum(axis=1) > 1]


def _root_information(problem: EstimationProblem, start: Start) -> Array:
    """A square root of the information about the free parameters, as searched, with the start states eliminated.

    It is taken along the start's states and without gaps: a segment begins with the sensitivities of all before it. It
    is NaN where it is not finite, or the start so stiff that integrating it would take hours.
    """
    segments = segment(problem.transcription(start))
    parameters = segments.transcription.parameters
    q = np.array([p.value for p in parameters.values()])
    chain = np.array([p.value if p.log else 1.0 for p in parameters.values() if p.free])
    nodes = start_nodes(segments)
    segments, substeps = choose_integration(segments, nodes, q, problem.method.substeps)
    if substeps > MAX_SEARCH_SUBSTEPS:
        return np.full((len(chain), len(chain)), np.nan)
    run = segments.run(nodes, q, substeps, sensitivities=True)
    assert run.dy is not None
    assert run.dx_end is not None
    weighted = np.where(np.isfinite(segments.measured)[..., None], run.dy / segments.noise[..., None], 0.0)
    roots = [np.zeros((0, len(chain)))]
    ends = (np.flatnonzero(~segments.linked) + 1).tolist()  # of each chain of linked segments
    for first, last in zip([0, *ends[:-1]], ends, strict=True):
        roots.append(_log_root_information(segments, weighted[first:last], run.dx_end[first:last], first, chain))
    return _triangularise(np.concatenate(roots))


def _log_root_information(
    segments: Segments, weighted: Array, end_sensitivities: Array, first: int, chain: Array
) -> Array:
    """Square root of one log's information about the parameters; QR eliminates its start state, ordered first."""
    n, k = end_sensitivities.shape[1], len(chain)
    carried = np.concatenate([np.eye(n), np.zeros((n, k))], axis=1)
    carried[np.isfinite(segments.fixed_start[first])] = 0.0
    root, rows = np.zeros((0, n + k)), []
    index = np.full(len(segments.transcription.parameters), -1, dtype=np.intp)
    index[segments.transcription.free] = np.arange(k)
    unknown = index[segments.parameter_positions[first, segments.columns]]
    by_parameter = np.where(unknown[:, None] == np.arange(k), chain, 0.0)  # of each column, alike in all segments
    chosen = np.concatenate([np.zeros((len(segments.columns), n)), by_parameter], axis=1)
    for i, (y, x) in enumerate(zip(weighted, end_sensitivities, strict=True)):
        moved = np.concatenate([carried, chosen])
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append(y.reshape(-1, y.shape[-1]) @ moved)
            carried = x @ moved
        if len(rows) == MAX_REDUCTION_SEGMENTS or i == len(weighted) - 1:
            root, rows = _triangularise(np.concatenate([root, *rows])), []
    return np.asarray(root[n:, n:])


def _triangularise(rows: Array) -> Array:
    """The square upper triangle (QR) that has the same Gram matrix."""
    width = rows.shape[1]
    padded = np.concatenate([rows, np.zeros((max(0, width - len(rows)), width))])
    finite = bool(np.isfinite(padded).all())
    return np.asarray(np.linalg.qr(padded, mode="r")) if finite else np.full((width, width), np.nan)
