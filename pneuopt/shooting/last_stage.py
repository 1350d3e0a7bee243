"""`repeat_last_stage`: the last stage again, of a search that explains the log but is held up by kinks of the model.

Friction at rest has a kink in the speed, over which Gauss-Newton steps overshoot. Nodes that do so are damped alone;
one that ends where its equations no longer move it is trapped, and keeps the rest of the log from its optimum.
A stage whose gaps stand for noise of the states is repeated, too; its gaps are what is estimated, and stay.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.status import Status
from pneuopt.shooting.convergence import largest_parameter_step

if TYPE_CHECKING:
    from pneuopt.shooting.search import Search

# times that the iterations of the last stage are repeated near the noise [1]: fewer leave a search over kinks (bristles
# at rest) before its end, for other starts that take longer; more follow one that does not end
MAX_REPEATS = 3
REPEAT_ITERATIONS = 10  # of a repeat, at most: fewer take a slow search for settled, more go on after it has
# decrease of the cost by an iteration, over itself [1], with which a search goes on that is not near the noise yet:
# lower follows one that creeps, higher ends one that is about to come there
STEEP_DECREASE = 0.1
# step [standard deviations] up to which a search has settled where a repeat has moved no estimate: lower follows what
# kinks ask for in vain (100 iterations of bristles at rest for .1 deviations), higher takes a slow search for one that
# has settled; and where the gaps stand for noise of the states, whose every estimate is marked anyway
MAX_SETTLED_STEP, MAX_NOISY_STEP = 0.5, 1.0
# damping of a node alone, over its diagonal [1], beyond which a kink traps it, for it moves less than half as far as
# its equations ask: lower moves nodes that are only slow, higher leaves some behind
TRAPPING_DAMPING = 1.0


def is_near_end(search: "Search") -> bool:
    """Whether a search explains the log to its noise in a last stage that is to converge: one that refines its steps.

    One that only settles a start ends with wide gaps, where nodes that are damped alone are left behind.
    """
    is_last = search.stage is search.method.stages[-1] and search.stage.refine > 1
    return is_last and search.is_noise(search.current.cost)


def repeat_last_stage(search: "Search") -> Status:
    """Run the last stage again while it lowers the cost steeply, or at the noise at all, but has not converged.

    Parameters
    ----------
    search : Search
        Moves to where it has come by then. Parameters that the data do not determine end this, for a caller holds them.
        Where a repeat moves no estimate, what the kinks still ask for no longer keeps it from having converged.

    Returns
    -------
    Status
        Of where it is then.
    """
    least_decrease = 0.5 * search.method.tolerance**2  # that of a step of so many deviations
    count = min(REPEAT_ITERATIONS, search.stage.iterations)
    for _ in range(MAX_REPEATS * search.stage.iterations // max(1, count)):
        found, before = search.assess(search.current), search.current
        falls = search.last_decrease > STEEP_DECREASE and search.stage.iterations > count  # a short one is but a trial
        goes_on = search.noisy_gaps or is_near_end(search) or falls
        if found.status.converged or found.unidentifiable.size or not goes_on:
            return found.status
        trapped = np.flatnonzero(search.node_damping > TRAPPING_DAMPING)
        if trapped.size and not search.noisy_gaps:
            free_nodes(search, trapped)
        else:
            search.run_stage(count)
        has_settled = moved_deviations(search, before.z) <= search.method.tolerance
        if has_settled:
            search.tolerance = max(search.tolerance, MAX_NOISY_STEP if search.noisy_gaps else MAX_SETTLED_STEP)
        is_lost = search.noisy_gaps and not has_settled  # a kink that it creeps over would take hundreds of steps
        if is_lost or before.cost - search.current.cost < least_decrease:
            break
    return search.assess(search.current).status


def moved_deviations(search: "Search", z: Array) -> float:
    """How far the parameters have moved from z, at most [standard deviations]; infinite where one has none."""
    equations, current = search.current.equations, search.current.z
    reduced = equations.arrow.eliminate(0.0)
    if reduced is None:
        return math.inf
    keep = search.scaling.movable(current, equations, reduced)
    return largest_parameter_step(equations, keep, reduced, current - z)


def unsettled_covariance(search: "Search") -> Array:
    """The covariance (own units) of the step that kinks still ask for. Shape (k, k)."""
    equations, z = search.current.equations, search.current.z
    asked, reduced = np.zeros(len(z)), equations.arrow.eliminate(0.0)
    solved = None if reduced is None else reduced.step(search.scaling.movable(z, equations, reduced))
    if solved is not None:
        asked = equations.linearisation.chain * solved.parameters
    return np.outer(asked, asked)


def free_nodes(search: "Search", trapped: Indices) -> None:
    """Run the last stage from where trapped nodes are put to the ends of the segments before them, if that helps.

    Parameters
    ----------
    search : Search
        Stays where it is unless its cost falls.
    trapped : ndarray of int
        Positions of nodes.
    """
    before, damping, nodes = search.snapshot(), search.node_damping, search.current.nodes.copy()
    behind = trapped[trapped > 0]
    nodes[behind] += search.current.equations.gaps[behind - 1] * search.segments.nominal
    search.current, search.node_damping = search.evaluate(nodes, search.current.z), np.zeros(len(nodes))
    search.run_stage(search.stage.iterations)
    if not search.current.cost < before.current.cost:
        search.restore(before)
        search.node_damping = damping
