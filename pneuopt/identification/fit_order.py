"""`rank`: which of several fits of the same logs is the best; `are_alike`: whether two have found one optimum."""

from pneuopt.identification.problem import EstimationProblem
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import MAX_CHI_SQUARE_RATIO, MAX_GAP_SHARE, Fit, SearchEnd

# excess of a parameter over another one that bounds it [1] below which another start is tried: lower takes a basin that
# has lost it for the answer, higher searches drives twice that have as good as none
MIN_EXCESS = 0.03
SAME_COST_RATIO = 1.001  # costs of two fits up to which both are one optimum; lower, and rounding makes two of it


def is_optimum(fit: Fit) -> bool:
    """Whether a search ended at an optimum, be it of a model so wrong that the gaps absorb its misfit."""
    is_settled = not (fit.unsettled or fit.unidentifiable)
    is_missed = fit.status.code is Code.NOT_CONVERGED and is_settled and fit.stats["gap_share"] > MAX_GAP_SHARE
    is_missed &= fit.end is not SearchEnd.ABANDONED
    return fit.status.converged or is_missed


def is_in_order(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether each free parameter that another one bounds is clearly above it, as static friction above Coulomb's.

    Where it is not, a search may have lost it: it has ended so at the noise, with a Stribeck velocity 13 times too
    high, while the logs showed static friction of nearly twice Coulomb's.
    """
    order, found = problem.system.plant.excitation.at_least, fit.parameters
    bounded = [n for n in found.free_names if n not in problem.held and order.get(n) in found]
    return all(found.value(n) >= (1 + MIN_EXCESS) * found.value(order[n]) for n in bounded)


def rank(fit: Fit, tightest: float) -> tuple[int, float]:
    """The order of fits: by cost among fits of one kind.

    Noise of the states, or the wide gaps in which an interruption leaves a search, lower the cost of any model; such
    fits come after those that explain the log without.
    """
    cost = fit.stats["cost"]
    is_cut = fit.end is SearchEnd.ABANDONED or fit.status.code is Code.INTERRUPTED
    if is_cut and fit.stats["gap_deviation"] > tightest:
        return 3, cost
    if fit.jumps is not None:
        return 1, cost
    return 0 if 2 * cost <= MAX_CHI_SQUARE_RATIO * fit.count else 2, cost


def are_alike(best: Fit, second: Fit) -> bool:
    """Whether both ended at an optimum, at the same cost."""
    same = (best.jumps is None) == (second.jumps is None)
    return (
        is_optimum(best)
        and is_optimum(second)
        and same
        and second.stats["cost"] <= SAME_COST_RATIO * best.stats["cost"]
    )
