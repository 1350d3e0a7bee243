"""`hold_order`: what no plant has below another parameter, but a search has left there, is held at that one's value.

Static friction of 0 N is no friction that a drive has. It only says that the logs do not show any beyond Coulomb
friction, so it is held at Coulomb friction, as what is not identified, and the others are fitted again.
"""

from dataclasses import replace

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.identifiability import rejects_held_values, verdict_from_sensitivities
from pneuopt.identification.multistart import fit_holding_unidentifiable
from pneuopt.identification.problem import EstimationProblem
from pneuopt.shooting.solution import Fit


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


def _without_effect(problem: EstimationProblem, start: Start) -> dict[str, float]:
    """The parameters that the logs do not identify at a start, with its values."""
    values = problem.unknowns().with_values(start.parameters)
    return {n: values.value(n) for n in verdict_from_sensitivities(problem, start).unidentifiable}
