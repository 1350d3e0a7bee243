"""`free_widths`: the widths over which a model rounds its kinks, as unknowns of the fit.

Friction's sign and a valve's edges are rounded, in the model for its integration and on a rig by nature, and nobody
knows by how much. A wrong width takes the place of other parameters: at a tenth of the true one static friction was
12 % off, with it a hundredth of a per cent (problems/identify/foreign_rigs.py). So each width that the user has not
stated is estimated with the rest, between `WIDTH_RANGE` of its start and its own bounds. Below that range the model
integrates as a drive that sticks; a fit that ends there is one of a drive that sticks, or nearly so.
"""

from dataclasses import replace

import numpy as np

from pneuopt.dynamics.hooks import Width
from pneuopt.dynamics.system import System
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.tolerances import WIDTH_RANGE
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.least_squares import Fit

ESTIMATED_WIDTH = "nobody has stated it: estimated with the rest"
"""Source of a width that `free_widths` has freed."""


def free_widths(problem: EstimationProblem) -> EstimationProblem:
    """Free the widths that nobody has stated: they stand where the model has put them."""
    given, edits = problem.parameters, {}
    unstated = _unstated_widths(problem.system.plant, given)
    for name, width in unstated.items():
        if any(name in e.conditions for e in problem.experiments):
            continue
        value = width.start or given.value(name)
        lower = max(given[name].lower, value / WIDTH_RANGE)
        edits[name] = replace(given[name], value=value, lower=lower, free=True, log=True, source=ESTIMATED_WIDTH)
    return replace(problem, parameters=given | ParameterSet(edits)) if edits else problem


def count_widths(plant: System, parameters: ParameterSet) -> ParameterSet:
    """The parameters with the widths free, at their values, that the next fit will estimate with the rest."""
    known = plant.parameters | parameters
    unstated = _unstated_widths(plant, known)
    return parameters | ParameterSet({n: replace(known[n], free=True, source=ESTIMATED_WIDTH) for n in unstated})


def _unstated_widths(plant: System, given: ParameterSet) -> dict[str, Width]:
    """The widths that stand where the model has put them, by name."""
    widths = {w.name: w for w in plant.identification_hints.widths if w.name in given}
    return {n: w for n, w in widths.items() if not given[n].free and given[n] == plant.parameters[n]}


def estimated_widths(parameters: ParameterSet) -> list[str]:
    """The names of the widths that `free_widths` has freed: nobody asks whether the logs identify them."""
    return [n for n, p in parameters.items() if p.source == ESTIMATED_WIDTH]


def sticking_covariance(problem: EstimationProblem, fit: Fit) -> Array:
    """What widths at their lower bounds leave uncertain of the other free parameters, shape (k, k), in their own units.

    A rig's friction step may be any narrower, as one that sticks. To first order, and no farther than that reaches, an
    estimate then changes by as much as an e-fold of the width moves it.
    """
    free, out = fit.parameters.free_names, np.zeros((len(fit.parameters.free_names),) * 2)
    reduced = None if fit.optimum is None else fit.optimum.equations.arrow.eliminate(0.0)
    if fit.optimum is None or reduced is None:
        return out
    keep = fit.optimum.keep
    scale = np.array([p.value if p.log else 1.0 for p in (fit.parameters[n] for n in free)])
    for place in (free.index(n) for n in estimated_widths(problem.parameters) if n in free):
        if fit.at_bound[place] and not keep[place] and keep.any():
            moved = np.zeros(len(free))
            moved[keep] = (
                scale[keep] * np.linalg.lstsq(reduced.schur[np.ix_(keep, keep)], reduced.schur[keep, place])[0]
            )
            out += np.outer(moved, moved)
    return out
