"""`identifiability`: what a set of logs can tell of a model's parameters, before and after a fit, in words."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.excitation import Excitation, Lack
from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.dynamics.system import System
from pneuopt.identification.checks import check_content, check_free, check_logs
from pneuopt.identification.excitation import missing_excitation, remedy, summarise_motion
from pneuopt.identification.problem import EstimationProblem, as_estimation_model
from pneuopt.identification.profiles import Profile
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.least_squares import MAX_SEARCH_SUBSTEPS, LeastSquares
from pneuopt.shooting.segments import Segments, segment, stable_substeps, start_nodes

if TYPE_CHECKING:
    import pandas as pd

MAX_RELATIVE_DEVIATION = 0.3  # relative standard deviation beyond which a number says nothing (PHYSICS section 6)
MAX_INFLATION = (
    30.0  # times that a standard deviation shrinks if the others were known, from which parameters act alike
)
HARMLESS_DEVIATION = (
    0.01  # relative standard deviation below which a combination does no harm, whatever the model's own error
)
UNIDENTIFIABLE_DEVIATION = 10 / 3  # beyond which a factor of ten about the value says more
MAX_RELATIVE_INTERVAL = 4 * MAX_RELATIVE_DEVIATION  # of an interval, over the value
MAX_EXPECTED_DEVIATION = 1.0  # the same, beyond which a fit need not be tried
INFINITE_INFLATION = 1e5  # times of that kind that are as good as infinite
MIN_COMBINATION_SHARE = 0.3  # of a weak combination's largest part
INFORMATION_ROUNDING = 1e-9  # root of information, relative to the largest, that is rounding
MAX_REDUCTION_SEGMENTS = 2000  # segments whose sensitivities are reduced together
_VAGUER_THAN_PRIOR = "they say less of it than a factor of ten about its value would"


@dataclass(frozen=True, eq=False)
class Verdict:
    """What logs can tell.

    Attributes
    ----------
    table : DataFrame
        A row a free parameter: value, expected standard deviation (`stderr`) and that over the value (`relative`), the
        one if all others were known (`alone`), their ratio (`inflation`), and whether the logs tell it (`told`).
    indistinguishable : tuple of tuple of str
        Parameters that only count together.
    reasons : mapping of str to str
        By parameter: why the logs do not tell it, or only roughly, and what run would.
    unchanged : tuple of str
        Parameters that a fit left at their given values.
    excitation : Excitation
        The model's: which runs would show or separate its parameters.
    """

    table: "pd.DataFrame"
    indistinguishable: tuple[tuple[str, ...], ...]
    reasons: Mapping[str, str]
    unchanged: tuple[str, ...] = ()
    excitation: Excitation = field(default_factory=Excitation)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """The parameters of which the logs say nothing."""
        return tuple(str(n) for n, told in self.table["told"].items() if not told)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is amiss, in words; empty if nothing is."""
        by_reason: dict[tuple[bool, str], list[str]] = {}
        for name, reason in self.reasons.items():
            by_reason.setdefault((name in self.unidentifiable, reason), []).append(name)
        single = [
            f"the logs {'do not tell' if untold else 'tell only roughly'} {join_names(names)}: {reason}"
            for (untold, reason), names in by_reason.items()
        ]
        groups = [_describe_group(group, self.table["inflation"], self.excitation) for group in self.indistinguishable]
        return (*single, *groups, *([self._describe_left_alone()] if self.unchanged else []))

    def _describe_left_alone(self) -> str:
        """What became of the parameters that a fit has left alone."""
        values = join_names([f"{n} ({self.table['value'][n]:.4g})" for n in self.unchanged])
        verb = "keep their given values" if len(self.unchanged) > 1 else "keeps its given value"
        return f"{values} {verb}, on which the other intervals do not rest"

    def to_dict(self) -> dict[str, Any]:
        """All but the table, for a file."""
        reasons = {str(n): reason for n, reason in self.reasons.items()}
        words = {"sentences": list(self.sentences), "untold": list(self.unidentifiable), "kept": list(self.unchanged)}
        return {**words, "together": [list(group) for group in self.indistinguishable], "reasons": reasons}

    def with_profiles(self, profiles: Mapping[str, Profile]) -> "Verdict":
        """The verdict with what profiles have found: a parameter with two open ends is not told."""
        reasons, identifiable = dict(self.reasons), self.table["told"].copy()
        for name, found in profiles.items():
            is_blind = math.isinf(found.low) and math.isinf(found.high)
            identifiable[name] = bool(identifiable[name]) and not is_blind
            reasons.pop(name, None)
            if not found.high - found.low < MAX_RELATIVE_INTERVAL * abs(found.estimate):
                reasons[name] = f"{found.sentence}; {remedy(self.excitation, [name])}"
        return replace(self, table=self.table.assign(told=identifiable), reasons=reasons)

    def with_unidentifiable(self, names: Sequence[str], seen: "Verdict", kept: Sequence[str]) -> "Verdict":
        """The verdict with parameters that rest on a prior, as the sensitivities alone have `seen` them."""
        table, own = self.table.copy(), list(names)
        table.loc[own] = seen.table.loc[own]
        table.loc[own, "told"] = False
        together = tuple(group for group in seen.indistinguishable if {*group} & {*names})
        grouped = {n for group in together for n in group}
        reasons = {n: reason for n, reason in self.reasons.items() if n not in names}
        vague = {n: f"{_VAGUER_THAN_PRIOR}; {remedy(self.excitation, [n])}" for n in names if n not in grouped}
        reasons |= {**vague, **{n: seen.reasons[n] for n in names if n in seen.reasons}}
        unchanged = tuple(str(n) for n in table.index if n in kept)
        return Verdict(table, (*self.indistinguishable, *together), reasons, unchanged, self.excitation)

    def __str__(self) -> str:
        return "\n".join(self.sentences) or "the logs tell every free parameter"


def identifiability(
    system: System | ClosedLoop,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
) -> Verdict:
    """What the logs can tell of the free parameters, before anything is fitted.

    Parameters
    ----------
    system : System or ClosedLoop
    experiments : sequence of Experiment
    parameters : ParameterSet
        As for `identify`.
    method : LeastSquares, optional

    Returns
    -------
    Verdict
        From the sensitivities of the measured outputs along the model's own first start, at the noise that the logs
        declare or show (Cramer-Rao: no estimate is better), and from what the motion lacks. A model that is wrong
        does worse.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    model = as_estimation_model(system)
    check_smooth(model)
    logs = check_logs(model, experiments, parameters)
    check_free(logs, parameters)
    check_content(logs)
    problem = EstimationProblem(model, tuple(logs), model.parameters | parameters, method or LeastSquares())
    return verdict_from_sensitivities(problem, problem.candidates()[0])


def verdict_from_sensitivities(problem: EstimationProblem, start: Start, variance: float = 1.0) -> Verdict:
    """The verdict at a start, or at a fit.

    Parameters
    ----------
    problem : Problem
    start : Start
    variance : float
        Of the residuals, in units of the noise's.
    """
    return _make_verdict(problem, start, _root_information(problem, start) / math.sqrt(variance))


def verdict_from_covariance(
    problem: EstimationProblem, fit: Start, covariance: "pd.DataFrame", *, trusted: bool
) -> Verdict:
    """The verdict after a fit.

    Parameters
    ----------
    problem : Problem
    fit : Start
    covariance : DataFrame
        Of the estimates in their own units; NaN at a bound.
    trusted : bool
        The model explains the logs to their noise, so that its figures stand whatever the motion lacks.
    """
    unknowns = problem.unknowns().with_values(fit.parameters)
    chain = np.array([unknowns[str(n)].value if unknowns[str(n)].log else 1.0 for n in covariance.index])
    searched = covariance.to_numpy() / np.outer(chain, chain)
    keep = np.isfinite(np.diag(searched))
    root = np.zeros_like(searched)
    if keep.any():
        root[np.ix_(keep, keep)] = _root_of_inverse(searched[np.ix_(keep, keep)])
    return _make_verdict(problem, fit, root, inside_bounds=keep, trusted=trusted)


def _make_verdict(
    problem: EstimationProblem, start: Start, root: Array, inside_bounds: Mask | None = None, *, trusted: bool = False
) -> Verdict:
    """Put what the information says, and what the motion lacks, in words; what is not judged is at a bound."""
    import pandas as pd

    unknowns = problem.unknowns().with_values(start.parameters)
    free = {n: unknowns[n] for n in unknowns.free_names}
    names, (spread, alone, weak) = list(free), _standard_deviations(root)
    values = problem.parameters.with_values({n: v for n, v in start.parameters.items() if n in problem.parameters})
    seen = summarise_motion(problem.experiments, start.states, values, problem.parameters)
    rows, reasons, excitation = {}, {}, problem.system.plant.excitation
    for i, (name, p) in enumerate(free.items()):
        if inside_bounds is not None and not inside_bounds[i]:
            rows[name] = [p.value, *[math.nan] * 4, True]
            reasons[name] = "the best fit is at its bound, and the other intervals hold for that value only"
            continue
        unit, size = p.value if p.log else 1.0, 1.0 if p.log else _comparison_size(name, p, problem)
        relative = spread[i] / size if size > 0 else math.nan
        lack = None if trusted else missing_excitation(excitation, name, names, seen)
        is_blind = (
            lack is not None
            or math.isinf(spread[i])
            or relative > (MAX_EXPECTED_DEVIATION if inside_bounds is None else UNIDENTIFIABLE_DEVIATION)
        )
        if is_blind or relative > MAX_RELATIVE_DEVIATION:
            reasons[name] = _unidentifiable_reason(alone[i], relative, lack, remedy(excitation, [name]))
        inflation = spread[i] / alone[i] if math.isfinite(spread[i]) else spread[i]
        rows[name] = [p.value, unit * spread[i], relative, unit * alone[i], inflation, not is_blind]
    columns = ["value", "stderr", "relative", "alone", "inflation", "told"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    groups = (tuple(names[i] for i in np.flatnonzero(row)) for row in weak)
    together = tuple(group for group in groups if _matters(table.loc[list(group)]))
    return Verdict(table, together, reasons, excitation=excitation)


def _matters(members: "pd.DataFrame") -> bool:
    """Whether a combination hides anything: what is known far better than needed need not be told apart any better."""
    return bool(members["inflation"].max() > MAX_INFLATION and members["relative"].max() > HARMLESS_DEVIATION)


def _comparison_size(name: str, p: Parameter, problem: EstimationProblem) -> float:
    """What a standard deviation is compared with; 0 for an offset, of which nothing says how large it may be."""
    if p.lower < 0 and p.unit != "1":
        return 0.0
    given = problem.parameters[name.partition("[")[0]].value
    return max(abs(p.value), abs(given), 1.0 if p.unit == "1" else 0.0)


def _unidentifiable_reason(alone: float, relative: float, lack: Lack | None, usual_remedy: str) -> str:
    """Why the logs do not tell a parameter, and what to do."""
    if lack is not None:
        return f"{lack.reason}; {lack.remedy}"
    if math.isinf(alone):
        return "nothing measured depends on it; fix it, or log a run that does"
    message = (
        f"within {relative:.0%} (1 standard deviation)" if relative < UNIDENTIFIABLE_DEVIATION else _VAGUER_THAN_PRIOR
    )
    return f"{message}; {usual_remedy}"


def _describe_group(group: Sequence[str], inflation: "pd.Series[float]", excitation: Excitation) -> str:
    times = float(inflation[list(group)].max())
    message = (
        f"known {times:.0f} times better if the others were"
        if times < INFINITE_INFLATION
        else "nothing tells them apart"
    )
    return f"{join_names(group)} only count together ({message}): {remedy(excitation, group)}"


def join_names(names: Sequence[str]) -> str:
    """Names in a sentence: "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _root_information(problem: EstimationProblem, start: Start) -> Array:
    """A square root of the information about the free parameters, as searched, once the start states are solved for.

    Along the start's states, with no gaps: what a segment begins with is what all before it hand on. NaN where that is
    not finite, or the start so stiff that integrating it would take hours.
    """
    segments = segment(problem.transcription(start))
    parameters = segments.transcription.parameters
    q = np.array([p.value for p in parameters.values()])
    chain = np.array([p.value if p.log else 1.0 for p in parameters.values() if p.free])
    nodes = start_nodes(segments)
    substeps = problem.method.substeps or stable_substeps(segments, nodes, q)
    if substeps > MAX_SEARCH_SUBSTEPS:
        return np.full((len(chain), len(chain)), np.nan)
    run = segments.run(nodes, q, substeps, sensitivities=True)
    assert run.dy is not None
    assert run.dx_end is not None
    seen = np.where(np.isfinite(segments.measured)[..., None], run.dy / segments.noise[..., None], 0.0)
    roots = [np.zeros((0, len(chain)))]
    for first, last in _log_chains(segments):
        roots.append(_log_root_information(segments, seen[first:last], run.dx_end[first:last], first, chain))
    return _triangularise(np.concatenate(roots))


def _log_chains(segments: Segments) -> list[tuple[int, int]]:
    """First and last segment (exclusive) of each chain of linked ones."""
    ends = np.flatnonzero(~segments.linked) + 1
    return list(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True))


def _log_root_information(segments: Segments, seen: Array, handed_on: Array, first: int, chain: Array) -> Array:
    """One log's root of information about the parameters: a QR with its start state in front, which is then cut off."""
    n, k = handed_on.shape[1], len(chain)
    carried = np.concatenate([np.eye(n), np.zeros((n, k))], axis=1)
    carried[np.isfinite(segments.fixed_start[first])] = 0.0
    root, rows = np.zeros((0, n + k)), []
    chosen = np.concatenate([np.zeros((len(segments.columns), n)), _column_derivatives(segments, first, chain)], axis=1)
    for i, (y, x) in enumerate(zip(seen, handed_on, strict=True)):
        moved = np.concatenate([carried, chosen])
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append(y.reshape(-1, y.shape[-1]) @ moved)
            carried = x @ moved
        if len(rows) == MAX_REDUCTION_SEGMENTS or i == len(seen) - 1:
            root, rows = _triangularise(np.concatenate([root, *rows])), []
    return np.asarray(root[n:, n:])


def _column_derivatives(segments: Segments, first: int, chain: Array) -> Array:
    """d(sensitivity column)/d(free parameter, as searched), the same in all segments of a log."""
    index = np.full(len(segments.transcription.parameters), -1, dtype=np.intp)
    index[segments.transcription.free] = np.arange(len(chain))
    unknown = index[segments.parameter_positions[first, segments.columns]]
    return np.where(unknown[:, None] == np.arange(len(chain)), chain, 0.0)


def _triangularise(rows: Array) -> Array:
    """A square upper triangle with the same Gram matrix."""
    width = rows.shape[1]
    padded = np.concatenate([rows, np.zeros((max(0, width - len(rows)), width))])
    finite = bool(np.isfinite(padded).all())
    return np.asarray(np.linalg.qr(padded, mode="r")) if finite else np.full((width, width), np.nan)


def _root_of_inverse(covariance: Array) -> Array:
    """R with R'R the inverse of a covariance, whatever its units."""
    deviation = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    return np.asarray((vectors / np.sqrt(np.maximum(values, 1e-14))).T / deviation)


def _standard_deviations(root: Array) -> tuple[Array, Array, Mask]:
    """Standard deviations (all unknown; all others known), and who takes part in each weak combination."""
    size = np.linalg.norm(root, axis=0)
    if not np.isfinite(root).all():
        return size * np.nan, size * np.nan, np.zeros((0, len(size)), dtype=bool)
    felt = size > INFORMATION_ROUNDING * float(np.max(size, initial=0.0))
    with np.errstate(divide="ignore"):
        alone = np.where(felt, 1 / size, math.inf)
    spread, weak = alone.copy(), np.zeros((0, len(size)), dtype=bool)
    if felt.any():
        _, singular, right = np.linalg.svd(root[:, felt] / size[felt])
        inverse = 1 / np.maximum(singular, 1e-9)
        spread[felt] = np.linalg.norm(right * inverse[:, None], axis=0) / size[felt]
        parts = np.abs(right[inverse > MAX_INFLATION])
        member = (
            parts > MIN_COMBINATION_SHARE * parts.max(axis=1, keepdims=True)
            if parts.size
            else np.zeros_like(parts, dtype=bool)
        )
        weak = np.zeros((len(member), len(size)), dtype=bool)
        weak[:, felt] = member
    return spread, alone, weak[weak.sum(axis=1) > 1]
