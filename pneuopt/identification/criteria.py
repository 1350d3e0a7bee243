"""`DOptimal`, `AOptimal`, `Precision`, `WantedPrecision`: what judges a planned experiment, by one number.

A newcomer adds a class like these: the parameters that it is about, and its figure of their covariance. Source:
Atkinson, Donev, Tobias, Optimum Experimental Designs, with SAS, 2007, chapter 10.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require

_LARGEST = 6
"""Power of the sum that stands for the largest [1]: with a higher one a search sees the worst alone, and is slow."""


class Criterion(Protocol):
    """What a planned experiment is to make small."""

    @property
    def targets(self) -> tuple[str, ...]:
        """Names or shell patterns of the parameters; empty: all free ones."""
        ...

    def deviation(self, covariance: Array) -> Array:
        """The figure of covariances of the targets, each in units of its value; shape (..., k, k) -> (...)."""
        ...


class DOptimal:
    """The volume of the targets' joint confidence region: the geometric mean of its half axes.

    Parameters
    ----------
    *targets : str
        Names or shell patterns, "friction.*"; none: every free parameter.

    Examples
    --------
    >>> round(float(DOptimal().deviation(np.diag([0.01, 0.04]) ** 2)), 4)
    0.02
    """

    def __init__(self, *targets: str) -> None:
        self.targets = targets

    def __repr__(self) -> str:
        return f"DOptimal({', '.join(map(repr, self.targets))})"

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        sign, log = np.linalg.slogdet(covariance)
        return np.asarray(np.where(sign > 0, np.exp(log / (2 * covariance.shape[-1])), np.inf))


class AOptimal:
    """The root mean square of the targets' relative standard deviations: the worst-known ones count most.

    Parameters
    ----------
    *targets : str
        As for `DOptimal`.

    Examples
    --------
    >>> round(float(AOptimal().deviation(np.diag([0.01, 0.07]) ** 2)), 4)
    0.05
    """

    def __init__(self, *targets: str) -> None:
        self.targets = targets

    def __repr__(self) -> str:
        return f"AOptimal({', '.join(map(repr, self.targets))})"

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        variances = np.diagonal(covariance, axis1=-2, axis2=-1)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(np.mean(variances, axis=-1)))


@dataclass(frozen=True)
class Precision:
    """The relative standard deviation of one parameter, whatever becomes of the others.

    Parameters
    ----------
    parameter : str
    """

    parameter: str

    @property
    def targets(self) -> tuple[str, ...]:
        """The parameter."""
        return (self.parameter,)

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(covariance[..., 0, 0]))


class WantedPrecision:
    """Each target's relative standard deviation over the one that is wanted: nearly the largest of these ratios.

    At 1 or below, each parameter is known as well as is wanted; above, the one counts that is farthest from it.

    Parameters
    ----------
    wanted : mapping of str to float
        By the parameter's name its relative standard deviation [1].

    Raises
    ------
    InputError
        If one is not positive.

    Examples
    --------
    >>> wanted = WantedPrecision({"friction.coulomb": 0.01, "friction.viscous": 0.1})
    >>> round(float(wanted.deviation(np.diag([0.02, 0.02]) ** 2)), 2)
    2.0
    """

    def __init__(self, wanted: Mapping[str, float]) -> None:
        wrong = [n for n, size in wanted.items() if not 0 < size < math.inf]
        require(bool(wanted), "WantedPrecision: name a parameter and its relative standard deviation")
        require(not wrong, f"WantedPrecision: the standard deviation of {', '.join(wrong)} must be positive")
        self.wanted = dict(wanted)

    def __repr__(self) -> str:
        return f"WantedPrecision({self.wanted})"

    @property
    def targets(self) -> tuple[str, ...]:
        """The parameters."""
        return tuple(self.wanted)

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        with np.errstate(invalid="ignore"):
            ratios = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)) / np.array(list(self.wanted.values()))
            return np.asarray(np.sum(ratios**_LARGEST, axis=-1) ** (1 / _LARGEST))
