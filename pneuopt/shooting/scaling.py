"""`ParameterScaling`: the free parameters in the units of a search, logarithms or values, within their bounds."""

import math
from dataclasses import replace

import numpy as np

from pneuopt.quantities.arrays import Array, Mask
from pneuopt.shooting.arrow import ReducedEquations
from pneuopt.shooting.equations import NormalEquations
from pneuopt.shooting.transcription import Transcription

# What the data of a search do not determine; each threshold is in the units in which the search moves.
WEAK_PRIOR_DEVIATION = math.log(10)  # standard deviation of a weak prior, in e-folds: a factor of ten either way
# standard deviation over a weak prior's from which a parameter is held: there the prior makes up a tenth of the
# information of both; smaller holds what the data do determine, larger lets a search crawl along a valley
UNIDENTIFIABLE_PRIOR_RATIO = 1 / 3
# standard deviation of the prior about a start, in e-folds: lower holds wrong guesses, higher lets what wide gaps hide
# drift to where tight ones cannot tell it any more
START_PRIOR_DEVIATION = 1.0
# squared residuals that an e-fold change of a log parameter has to move, or it has no effect: smaller searches in
# rounding, larger holds what good data would show
MIN_LOG_INFORMATION = 1e-6


class ParameterScaling:
    """Free parameters as searched (z, shape (k,)), and all the problem's values at them.

    Attributes
    ----------
    log : ndarray of bool, shape (k,)
    lower, upper : ndarray, shape (k,)
        As searched.
    held : ndarray of bool, shape (k,)
        Which parameters have equal bounds.
    start : ndarray, shape (k,)
        The given values, within the bounds.
    """

    def __init__(self, transcription: Transcription) -> None:
        self._free = [p for p in transcription.parameters.values() if p.free]
        self._positions = transcription.free
        self._given = np.array([p.value for p in transcription.parameters.values()])
        self.log = np.array([p.log for p in self._free], dtype=bool)
        self.lower, self.upper = (
            self._to_search_units(np.array([getattr(p, b) for p in self._free])) for b in ("lower", "upper")
        )
        self.held = np.array([p.lower == p.upper for p in self._free], dtype=bool)
        self.start = self.project_to_bounds(self._to_search_units(self._given[self._positions]))

    def project_to_bounds(self, z: Array) -> Array:
        """The nearest point within the bounds."""
        return np.asarray(np.clip(z, self.lower, self.upper))

    def values(self, z: Array) -> Array:
        """All the problem's parameter values."""
        q = self._given.copy()
        own = np.where(self.log, np.exp(np.where(self.log, z, 0.0)), z)
        # at a bound exactly the bound, which a logarithm there and back would miss by a rounding
        low, up = ([getattr(p, b) for p in self._free] for b in ("lower", "upper"))
        own = np.where(z <= self.lower, low, np.where(z >= self.upper, up, own))
        q[self._positions] = [min(max(v, p.lower), p.upper) for v, p in zip(own, self._free, strict=True)]
        return q

    def chain(self, z: Array) -> Array:
        """d(parameter)/d(searched parameter), shape (k,)."""
        return np.where(self.log, np.exp(np.where(self.log, z, 0.0)), 1.0)

    def at_bound(self, z: Array) -> Mask:
        """The mask of parameters on a bound."""
        return np.asarray((z <= self.lower) | (z >= self.upper))

    def weak_prior(self, z: Array) -> Array:
        """Standard deviation of a weak prior: a factor of ten, or for linear parameters ten times their size."""
        size = np.abs(np.where(self.log, 0.0, z))
        sized = size > np.finfo(float).tiny  # a start at a bound of 0 may leave rounding only
        return np.where(self.log, WEAK_PRIOR_DEVIATION, np.where(sized, 10 * size, np.inf))

    def start_prior_cost(self, z: Array) -> float:
        """What a prior that draws log parameters to their start adds to the cost at z."""
        return 0.5 * float(self._prior_weight @ (z - self.start) ** 2)

    def add_start_prior(self, equations: NormalEquations, z: Array) -> NormalEquations:
        """Equations at z that draw log parameters to their start, where the data hardly tell of them."""
        weight, arrow = self._prior_weight, equations.arrow
        gradient = arrow.gradient + weight * (z - self.start)
        drawn = replace(arrow, corner=arrow.corner + np.diag(weight), gradient=gradient)
        return replace(equations, arrow=drawn, cost=equations.cost + self.start_prior_cost(z))

    @property
    def _prior_weight(self) -> Array:
        """One over the prior's variance, shape (k,); zero where it draws nothing."""
        return np.where(self.log & ~self.held, START_PRIOR_DEVIATION**-2, 0.0)

    def has_effect(self, equations: NormalEquations) -> Mask:
        """The mask of parameters that have an effect on the residuals here."""
        return np.asarray(np.diag(equations.arrow.corner) > np.where(self.log, MIN_LOG_INFORMATION, 0.0))

    def movable(self, z: Array, equations: NormalEquations, reduced: ReducedEquations) -> Mask:
        """The mask of parameters with an effect on the residuals that are neither held nor pressed against a bound."""
        below, above = (z <= self.lower) & (reduced.gradient > 0), (z >= self.upper) & (reduced.gradient < 0)
        # a held one may have no gradient that presses it
        return np.asarray(self.has_effect(equations) & ~(below | above | self.held))

    def _to_search_units(self, values: Array) -> Array:
        """Logarithms of log parameters; a bound that is not positive is minus infinity there."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.where(values > 0, np.log(values), -np.inf), values)
