"""What a lifted least squares has reached: converged or not, in words; and which parameter its data do not tell."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneuopt.shooting.arrow import Reduced, scaled_inverse
from pneuopt.shooting.equations import Equations, unexplained
from pneuopt.shooting.scaling import Space
from pneuopt.shooting.solution import Code, Status

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
MOST_GAP_SHARE = 0.05  # of the cost: the gaps' residuals above it mean that they take up what the model cannot
NOISE_LEVEL = 1.2  # squared residuals a sample, in noise variances, up to which a fit is as good as the noise allows
SILENT = 1 / 3  # standard deviation, over a weak prior's, from which that says a tenth of what data and it say together
NOBODY = np.zeros(0, dtype=np.intp)


class Judgement(NamedTuple):
    """How a search stands, and the positions of free parameters that its data do not tell there."""

    status: Status
    silent: Indices = NOBODY


def judged(equations: Equations, space: Space, z: Array, tolerance: float, told: str, *, is_loose: bool) -> Judgement:
    """Judge an iterate: converged means that a full undamped step would move nothing that the data can tell apart.

    Parameters
    ----------
    equations : Equations
    space : Space
    z : ndarray, shape (k,)
        The free parameters as searched.
    tolerance : float
        Of the step, in standard deviations.
    told : str
        What a success says of the search.
    is_loose : bool
        The gaps stand for noise of the states.

    Returns
    -------
    Judgement
    """
    names = np.array(equations.segments.transcription.parameters.free_names, dtype=object)
    nothing = np.diag(equations.arrow.corner) == 0  # even at a bound
    idle = ~space.held & ~space.felt(equations) & (nothing | ~space.at_bound(z))
    if idle.any():
        said = f"the data do not feel {' and '.join(names[idle])}; fix it, or log a run that does"
        return Judgement(Status(Code.NOT_CONVERGED, said), np.flatnonzero(idle))
    reduced = equations.arrow.eliminate(0.0)
    if reduced is None:
        return Judgement(Status(Code.NOT_CONVERGED, "the data do not determine the states; log another output"))
    keep = space.movable(z, equations, reduced)
    own = np.flatnonzero(keep)
    alike, solved = own[equations.undetermined(reduced, keep)], reduced.step(keep)
    noise = max(1.0, math.sqrt(equations.chi_square / max(1, equations.count)))
    if alike.size or solved is None:
        said = f"the data do not determine {' and '.join(names[np.sort(alike)])}; "
        status = Status(Code.NOT_CONVERGED, said + "fix one, or log a run that tells them apart")
        blind = _blind(own, space, reduced, noise)
        return Judgement(status, blind if blind.size else alike[-1:])
    spread = np.sqrt(np.diag(scaled_inverse(reduced.schur[np.ix_(keep, keep)])))
    step = np.abs(solved.parameters[keep]) / spread
    if np.max(step, initial=0.0) > tolerance * noise:
        worst = int(np.argmax(step))
        said = f"{names[keep][worst]} would still move by {step[worst] / noise:.2g} standard deviations; "
        status = Status(Code.NOT_CONVERGED, said + "try more iterations, other start values, or fix a parameter")
        return Judgement(status, _weakest(own, noise * spread, space))
    pressed = np.flatnonzero(space.at_bound(z) & ~space.held)
    return Judgement(_agreed(equations, told, is_loose=is_loose), _blind(pressed, space, reduced, noise))


def _agreed(equations: Equations, told: str, *, is_loose: bool) -> Status:
    """The status of an optimum: converged, unless its gaps take up what the model cannot."""
    gap, misfit = equations.largest_gap, 2 * equations.cost / max(1, equations.count)
    if equations.gap_share > MOST_GAP_SHARE and not (is_loose and misfit <= NOISE_LEVEL):
        said = f"the gaps between segments carry {equations.gap_share:.0%} of the cost, the largest is {gap:.1g} "
        remedy = "of a state's nominal size: the model cannot follow the log; check its terms, inputs and units"
        return Status(Code.NOT_CONVERGED, said + remedy)
    said = f"{told}, largest gap {gap:.1g} of a state's nominal size"
    return Status(Code.CONVERGED, said + unexplained(equations, NOISE_LEVEL, jumps=is_loose))


def _blind(positions: Indices, space: Space, reduced: Reduced, noise: float) -> Indices:
    """Of these the one that the data hardly feel, were even the others known."""
    return _weakest(positions, noise / np.sqrt(np.maximum(np.diag(reduced.schur)[positions], 1e-300)), space)


def _weakest(positions: Indices, spread: Array, space: Space) -> Indices:
    """Of these the one that is known least, if a weak prior about its start would know it better."""
    share = spread / space.weak_prior(space.start)[positions]
    if not share.size or not share.max() > SILENT:
        return NOBODY
    return positions[[int(np.argmax(share))]]
