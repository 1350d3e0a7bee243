"""The convergence test of a lifted least squares, and the parameters that its data do not determine."""

import math
from typing import NamedTuple

import numpy as np

from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.arrow import ReducedEquations, positive_definite_inverse
from pneuopt.shooting.equations import NormalEquations, describe_misfit
from pneuopt.shooting.scaling import UNIDENTIFIABLE_PRIOR_RATIO, ParameterScaling

# share of the cost [1] that the gaps may carry: above it they absorb the misfit of a model; lower refuses good fits
MAX_GAP_SHARE = 0.05
# squared residuals a sample, in noise variances [1], up to which a fit explains the log to its noise: lower takes
# chance for misfit, higher passes a wrong model
MAX_CHI_SQUARE_RATIO = 1.2
NO_POSITIONS = np.zeros(0, dtype=np.intp)


class ConvergenceTest(NamedTuple):
    """The status of an iterate, and the positions of free parameters that the data do not determine there.

    `unsettled` is the one that would still move most where nothing else is wrong; `largest_step` is that of a converged
    iterate, in standard deviations.
    """

    status: Status
    unidentifiable: Indices = NO_POSITIONS
    unsettled: Indices = NO_POSITIONS
    largest_step: float = 0.0


def assess_convergence(
    equations: NormalEquations, space: ParameterScaling, z: Array, tolerance: float, message: str, *, noisy_gaps: bool
) -> ConvergenceTest:
    """Test an iterate: converged means that a full undamped step would move no parameter noticeably.

    Parameters
    ----------
    equations : NormalEquations
    space : ParameterScaling
    z : ndarray, shape (k,)
        The free parameters as searched.
    tolerance : float
        Largest step of a converged iterate, in standard deviations.
    message : str
        The first sentence of a converged status.
    noisy_gaps : bool
        Whether the gaps stand for noise of the states.

    Returns
    -------
    ConvergenceTest
    """
    names = np.array(equations.segments.transcription.parameters.free_names, dtype=object)
    no_sensitivity = np.diag(equations.arrow.corner) == 0  # even at a bound
    idle = ~space.held & ~space.has_effect(equations) & (no_sensitivity | ~space.at_bound(z))
    if idle.any():
        sentences = f"the data do not depend on {' and '.join(names[idle])}", "fix it, or log a run that does"
        return ConvergenceTest(Status(Code.NOT_CONVERGED, sentences), np.flatnonzero(idle))
    reduced = equations.arrow.eliminate(0.0)
    if reduced is None:
        return ConvergenceTest(
            Status(Code.NOT_CONVERGED, ("the data do not determine the states", "log another output"))
        )
    keep = space.movable(z, equations, reduced)
    own = np.flatnonzero(keep)
    alike, solved = own[equations.unidentifiable_parameters(reduced, keep)], reduced.step(keep)
    noise = max(1.0, math.sqrt(equations.chi_square / max(1, equations.count)))
    if alike.size or solved is None:
        verdict = f"the data do not determine {' and '.join(names[np.sort(alike)])}"
        status = Status(Code.NOT_CONVERGED, (verdict, "fix one, or log a run that separates them"))
        weakest = _least_sensitive(own, space, reduced, noise, z)
        return ConvergenceTest(status, weakest if weakest.size else alike[-1:])
    spread = np.sqrt(np.diag(positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])))
    step = np.abs(solved.parameters[keep]) / (noise * spread)
    if np.max(step, initial=0.0) > tolerance:
        worst = int(np.argmax(step))
        verdict = f"{names[keep][worst]} would still move by {step[worst]:.2g} standard deviations"
        remedy = "try more iterations, other start values, or fix a parameter"
        status = Status(Code.NOT_CONVERGED, (verdict, remedy))
        return ConvergenceTest(status, _least_certain(own, noise * spread, space, z), own[[worst]])
    bounded = np.flatnonzero(space.at_bound(z) & ~space.held)
    return ConvergenceTest(
        _optimum_status(equations, message, noisy_gaps=noisy_gaps),
        _least_sensitive(bounded, space, reduced, noise, z),
        largest_step=float(np.max(step, initial=0.0)),
    )


def largest_parameter_step(equations: NormalEquations, keep: Mask, reduced: ReducedEquations, step: Array) -> float:
    """The largest step of a kept parameter, of shape (k,) in all, in its standard deviations.

    It is infinite where the data do not determine all of them.
    """
    if equations.unidentifiable_parameters(reduced, keep).size:
        return math.inf
    spread = np.sqrt(np.diag(positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])))
    return float(np.max(np.abs(step[keep]) / spread, initial=0.0))


def _optimum_status(equations: NormalEquations, message: str, *, noisy_gaps: bool) -> Status:
    """The status of an optimum: converged, unless its gaps absorb the misfit of the model."""
    gap, misfit = equations.largest_gap, 2 * equations.cost / max(1, equations.count)
    if equations.gap_share > MAX_GAP_SHARE and not (noisy_gaps and misfit <= MAX_CHI_SQUARE_RATIO):
        verdict = f"the gaps between segments carry {equations.gap_share:.0%} of the cost"
        detail = f"the largest is {gap:.1g} of a state's nominal size: the model cannot follow the log"
        return Status(Code.NOT_CONVERGED, (verdict, detail, "check its terms, inputs and units"))
    verdict = f"{message}, largest gap {gap:.1g} of a state's nominal size"
    misfit_sentences = describe_misfit(equations, MAX_CHI_SQUARE_RATIO, noisy_gaps=noisy_gaps)
    return Status(Code.CONVERGED, (verdict, *misfit_sentences))


def _least_sensitive(
    positions: Indices, space: ParameterScaling, reduced: ReducedEquations, noise: float, z: Array
) -> Indices:
    """The position of the parameter with the least effect on the data, the others known; none if a prior is vaguer."""
    return _least_certain(positions, noise / np.sqrt(np.maximum(np.diag(reduced.schur)[positions], 1e-300)), space, z)


def _least_certain(positions: Indices, spread: Array, space: ParameterScaling, z: Array) -> Indices:
    """The position of the least certain parameter, if a weak prior would be more certain; or none.

    A linear parameter is as large as the larger of its start and its value here: a start near zero tells no size.
    """
    larger = np.where(np.abs(z) > np.abs(space.start), z, space.start)
    share = spread / space.weak_prior(larger)[positions]
    if not share.size or not share.max() > UNIDENTIFIABLE_PRIOR_RATIO:
        return NO_POSITIONS
    return positions[[int(np.argmax(share))]]
