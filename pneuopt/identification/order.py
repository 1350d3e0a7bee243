"""`hold_order`: what no plant has below another parameter, but a search has left there, is held at that one's value.

`mark_order` is for logs that reject this, and put one parameter below the other beyond chance: the model then lacks
something, as friction that builds up over a displacement.

Static friction of 0 N is no friction that a drive has. It only says that the logs do not show any beyond Coulomb
friction, so it is held at Coulomb friction, as what is not identified, and the others are fitted again.
"""

import math
from dataclasses import replace

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.identifiability import rejects_held_values, verdict_from_sensitivities
from pneuopt.identification.multistart import fit_holding_unidentifiable
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.shooting.least_squares import Fit

# deviations [1] by which one estimate lies below another that bounds it, beyond which the model is wrong: lower blames
# chance, higher passes friction that no drive has
MAX_BELOW_DEVIATIONS = 4.0


def hold_order(problem: EstimationProblem, fit: Fit, label: str) -> tuple[EstimationProblem, Fit]:
    """Hold parameters that no plant has below another one at that one's value, where the logs do not show them.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
    label : str
        Of the fit's start.

    Returns
    -------
    problem : EstimationProblem
        With what is held: those that ended below the other one at a bound, or were held there, and what has no effect
        beside them, as the Stribeck velocity between equal frictions, where the search had left it.
    fit : Fit
        The given one, where there are none, or where the logs reject the other one's value.
    """
    found, bound = fit.parameters, dict(zip(fit.parameters.free_names, fit.at_bound, strict=True))
    order = problem.system.plant.excitation.at_least
    below = {n: m for n, m in order.items() if bound.get(n) or n in problem.held}
    given = problem.unknowns()
    known = {n: m for n, m in below.items() if m in found and found.value(n) < found.value(m) <= given[n].upper}
    values = {n: found.value(m) for n, m in known.items()}
    if not values or not fit.status.converged:
        return problem, fit
    start = problem.start_from(fit, label)
    start = replace(start, parameters={**start.parameters, **values})
    ordered = replace(problem, held={**problem.held, **_without_effect(problem, start), **values})
    if len(ordered.held) >= len(found.free_names):
        return problem, fit
    held, other = fit_holding_unidentifiable(ordered, start)
    settled = other.status.converged and not other.unidentifiable and (other.jumps is None or fit.jumps is not None)
    rejected = not settled or rejects_held_values(other, fit, len(held.held))
    return (problem, fit) if rejected else (held, other.with_effort_of(fit))


def mark_order(problem: EstimationProblem, result: IdentificationResult) -> IdentificationResult:
    """Mark estimates that the logs put below another one beyond chance, though no plant has them there.

    Parameters
    ----------
    problem : EstimationProblem
    result : IdentificationResult

    Returns
    -------
    IdentificationResult
        Both are marked "bias possible", and the status names them.
    """
    estimates, status = result.estimates.copy(), result.status
    for low, high in problem.system.plant.excitation.at_least.items():
        if low in estimates.index and _is_below(result, low, high):
            estimates.loc[[n for n in (low, high) if n in estimates.index], "mark"] = Mark.BIAS_POSSIBLE
            words = f"{low} is below {high}, which no drive has: model error, both may be biased"
            status = status.with_details(words)
    return replace(result, estimates=estimates, status=status)


def _is_below(result: IdentificationResult, low: str, high: str) -> bool:
    """Whether an estimate is below another parameter, free or fixed, beyond chance."""
    names = [n for n in (low, high) if n in result.estimates.index]
    signs = [1.0 if n == high else -1.0 for n in names]
    values = {low: float(result.estimates["value"][low]), high: result.parameters.value(high)}
    variance = float(signs @ result.covariance.loc[names, names].to_numpy() @ signs)
    return variance >= 0 and values[high] - values[low] > MAX_BELOW_DEVIATIONS * math.sqrt(variance)


def _without_effect(problem: EstimationProblem, start: Start) -> dict[str, float]:
    """The parameters that the logs do not identify at a start, with its values."""
    values = problem.unknowns().with_values(start.parameters)
    return {n: values.value(n) for n in verdict_from_sensitivities(problem, start).unidentifiable}
