"""What the logs cannot identify: every decision about it, with its thresholds side by side.

The search itself holds what its data do not determine (`ConvergenceTest.unidentifiable`, whose thresholds stand in
`shooting.scaling`); everything that is decided about a start or a finished fit is decided here.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from pneuopt.dynamics.excitation import Lack
from pneuopt.dynamics.hooks import Start
from pneuopt.identification.excitation import missing_excitation, remedy, summarise_motion
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.profiles import Profile
from pneuopt.identification.result import Verdict
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.parameters import Parameter
from pneuopt.shooting.least_squares import Fit

if TYPE_CHECKING:
    import pandas as pd

# Standard deviations relative to the value (or per e-fold of a logarithm):
HARMLESS_DEVIATION = 0.01  # a combination known better does no harm; larger hides some, smaller names needless groups
MAX_LINEAR_DEVIATION = 0.15  # of a log parameter: beyond it the likelihood is no parabola, and the interval is profiled
MAX_RELATIVE_DEVIATION = 0.3  # beyond it a number is only rough; larger lets it pass unmarked, smaller marks good ones
MAX_EXPECTED_DEVIATION = 1.0  # before a fit, beyond it a parameter is unidentifiable: a fit need not be tried
UNIDENTIFIABLE_DEVIATION = 10 / 3  # after a fit: beyond it a factor of ten about the value says more than the logs
MAX_RELATIVE_INTERVAL = 4 * MAX_RELATIVE_DEVIATION  # width of a profile's interval over the value: rough beyond it

# Combinations of parameters:
MAX_INFLATION = 30.0  # times that a standard deviation shrinks if the others were known: beyond it parameters act alike
MIN_COMBINATION_SHARE = 0.3  # of a weak combination's largest part: smaller names parameters that hardly take part
INFORMATION_ROUNDING = 1e-9  # root of information, relative to the largest: smaller takes rounding for information
MAX_INVERSE_SINGULAR = 1e9  # inverse singular values, at most: larger are rounding

# Parameters that were held, with a weak prior about their values:
MAX_PRIOR_VARIANCE_SHARE = (
    0.1  # of an estimate's variance: with more from the priors, it rests on them, not on the logs
)
REFUSAL_CONFIDENCE = (
    0.95  # of the likelihood ratio at which the logs refuse the held values; higher believes wrong ones
)

VAGUER_THAN_PRIOR = "they say less of it than a factor of ten about its value would"


def make_verdict(
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


def add_profiles(verdict: Verdict, profiles: Mapping[str, Profile]) -> Verdict:
    """The verdict with what profiles have found: a parameter with two open ends is unidentifiable."""
    reasons, identifiable = dict(verdict.reasons), verdict.table["told"].copy()
    for name, found in profiles.items():
        is_blind = math.isinf(found.low) and math.isinf(found.high)
        identifiable[name] = bool(identifiable[name]) and not is_blind
        reasons.pop(name, None)
        if not found.high - found.low < MAX_RELATIVE_INTERVAL * abs(found.estimate):
            reasons[name] = f"{found.sentence}; {remedy(verdict.excitation, [name])}"
    return replace(verdict, table=verdict.table.assign(told=identifiable), reasons=reasons)


def add_unidentifiable(verdict: Verdict, names: Sequence[str], seen: Verdict, unchanged: Sequence[str]) -> Verdict:
    """The verdict with parameters that rest on a prior, as the sensitivities alone have `seen` them."""
    table, own = verdict.table.copy(), list(names)
    table.loc[own] = seen.table.loc[own]
    table.loc[own, "told"] = False
    together = tuple(group for group in seen.indistinguishable if {*group} & {*names})
    grouped = {n for group in together for n in group}
    reasons = {n: reason for n, reason in verdict.reasons.items() if n not in names}
    vague = {n: f"{VAGUER_THAN_PRIOR}; {remedy(verdict.excitation, [n])}" for n in names if n not in grouped}
    reasons |= {**vague, **{n: seen.reasons[n] for n in names if n in seen.reasons}}
    kept = tuple(str(n) for n in table.index if n in unchanged)
    return Verdict(table, (*verdict.indistinguishable, *together), reasons, kept, verdict.excitation)


def refuses_held_values(fit: Fit, first: Fit, held: int) -> bool:
    """Whether the logs refuse the values at which `held` parameters are, by the likelihood ratio.

    Parameters
    ----------
    fit, first : Fit
        With the parameters held, and before that.
    held : int

    Returns
    -------
    bool
        What only the gaps cost more does not count: finer integration steps show gaps that the first has not seen.
    """
    before, after = first.stats["cost"], fit.stats["cost"]
    rise = min(2 * (after - before), fit.chi_square - first.chi_square)
    noise = max(1.0, 2 * before / max(1, first.count))
    return not rise <= noise * chi2.ppf(REFUSAL_CONFIDENCE, held)


def rests_on_prior(covariance: Array, prior_covariance: Array) -> Mask:
    """Which estimates owe too much of their variance, both of shape (k, k), to the priors of held parameters."""
    return np.asarray(np.diag(prior_covariance) > MAX_PRIOR_VARIANCE_SHARE * np.diag(covariance))


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
        f"within {relative:.0%} (1 standard deviation)" if relative < UNIDENTIFIABLE_DEVIATION else VAGUER_THAN_PRIOR
    )
    return f"{message}; {usual_remedy}"


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
        inverse = 1 / np.maximum(singular, 1 / MAX_INVERSE_SINGULAR)
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
