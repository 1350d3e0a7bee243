"""Distributions of a parameter from plant to plant, by which `samples` draws; the parameter's bounds cut them off.

A newcomer adds a class like these, and a row of `DISTRIBUTIONS`, whose word study.toml and tuning.toml take:
``"load.mass" = { distribution = "normal", spread = "5 %" }``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite, log1p
from typing import Any, Protocol

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter

MIN_PROBABILITY = 1e-6
"""Probability [1] that a distribution must leave within a parameter's bounds: below it, its tail has no digits left;
a larger one refuses what is only cut off."""
_EDGE = 2.0**-53  # share nearest to 0 and 1 [1]: at these themselves a quantile is infinite


class Distribution(Protocol):
    """How a parameter varies from plant to plant."""

    def __init__(self, spread: float | tuple[float, float]) -> None: ...

    @property
    def spread(self) -> float | tuple[float, float]:
        """A fraction of the parameter's value, which is then the middle; or two numbers, as the class says."""

    def freeze(self, value: float) -> Any:
        """SciPy's distribution, where the parameter's value is `value`."""


@dataclass(frozen=True)
class Uniform:
    """Equally probable between two values.

    Parameters
    ----------
    spread : float or pair
        A fraction of the value, 0.3 for +-30 %; or the least and the greatest value [SI].
    """

    spread: float | tuple[float, float]

    def __post_init__(self) -> None:
        _check_spread(self, "0.3 for +-30 %")
        if isinstance(self.spread, tuple):
            require(self.spread[0] < self.spread[1], f"Uniform: {self.spread} is empty; the least value comes first")

    def freeze(self, value: float) -> Any:
        """SciPy's distribution."""
        from scipy import stats

        low, high = self.spread if isinstance(self.spread, tuple) else _ends_about(value, self.spread)
        return stats.uniform(low, high - low)


@dataclass(frozen=True)
class LogUniform:
    """Its logarithm is equally probable between two values: what is known to a power of ten.

    Parameters
    ----------
    spread : float or pair
        A fraction, 1.0 for half to twice the value; or the least and the greatest value [SI].
    """

    spread: float | tuple[float, float]

    def __post_init__(self) -> None:
        _check_spread(self, "1 for half to twice the value")
        if isinstance(self.spread, tuple):
            low, high = self.spread
            require(0 < low < high, f"LogUniform: {self.spread} must be positive, the least value first")

    def freeze(self, value: float) -> Any:
        """SciPy's distribution."""
        from scipy import stats

        if isinstance(self.spread, tuple):
            return stats.loguniform(*self.spread)
        require(value > 0, f"LogUniform: the value must be positive, got {value:g}")
        return stats.loguniform(value / (1 + self.spread), value * (1 + self.spread))


@dataclass(frozen=True)
class Normal:
    """Normal (Gaussian) about a mean.

    Parameters
    ----------
    spread : float or pair
        The standard deviation as a fraction of the value, which is the mean; or mean and standard deviation [SI].
    """

    spread: float | tuple[float, float]

    def __post_init__(self) -> None:
        _check_spread(self, "0.05 for a standard deviation of 5 %")
        _check_deviation(self)

    def freeze(self, value: float) -> Any:
        """SciPy's distribution."""
        from scipy import stats

        if isinstance(self.spread, tuple):
            return stats.norm(*self.spread)
        low, high = _ends_about(value, self.spread)
        return stats.norm(value, (high - low) / 2)


@dataclass(frozen=True)
class LogNormal:
    """Its logarithm is normal: what is positive, and off by a factor rather than by an amount.

    Parameters
    ----------
    spread : float or pair
        By which fraction one standard deviation raises the value, which is the median: 0.2 for a factor of 1.2 either
        way; or the median [SI] and that fraction [1].
    """

    spread: float | tuple[float, float]

    def __post_init__(self) -> None:
        _check_spread(self, "0.2 for a factor of 1.2 either way")
        _check_deviation(self)

    def freeze(self, value: float) -> Any:
        """SciPy's distribution."""
        from scipy import stats

        median, fraction = self.spread if isinstance(self.spread, tuple) else (value, self.spread)
        require(median > 0, f"LogNormal: the median must be positive, got {median:g}")
        return stats.lognorm(log1p(fraction), scale=median)


DISTRIBUTIONS: Mapping[str, type[Distribution]] = {
    "uniform": Uniform,
    "log_uniform": LogUniform,
    "normal": Normal,
    "log_normal": LogNormal,
}
"""Each distribution by the word that a file has for it."""


def quantiles(distribution: Distribution, name: str, parameter: Parameter, shares: Array) -> Array:
    """Values below which the given shares of a distribution lie, the part of it within a parameter's bounds.

    Parameters
    ----------
    distribution : Distribution
    name : str
        The parameter's, for messages.
    parameter : Parameter
        Its value is the middle of a distribution that is given by a fraction; its bounds cut the distribution off.
    shares : array_like
        From 0 to 1 [1].

    Returns
    -------
    ndarray
        [SI]

    Raises
    ------
    InputError
        If next to nothing of the distribution lies within the bounds.

    Examples
    --------
    >>> mass = Parameter(5.0, "kg", 0.0, 5.0)
    >>> quantiles(Uniform((4.0, 6.0)), "load.mass", mass, np.array([0.0, 0.5, 1.0])).round(6).tolist()
    [4.0, 4.5, 5.0]
    """
    p, frozen = parameter, distribution.freeze(parameter.value)
    lower = max(p.lower, 0.0) if p.log else p.lower
    below, above = float(frozen.cdf(lower)), float(frozen.sf(p.upper))
    inside = 1.0 - below - above
    message = f"{name}: {distribution} leaves its bounds, {p.lower:g} to {p.upper:g} {p.unit}; move one of them"
    require(inside > MIN_PROBABILITY, message)
    probability = np.clip(below + np.asarray(shares) * inside, _EDGE, 1 - _EDGE)
    return np.asarray(np.clip(frozen.ppf(probability), lower, p.upper))


def _check_spread(distribution: Distribution, example: str) -> None:
    spread, kind = distribution.spread, type(distribution).__name__
    if isinstance(spread, tuple):
        require(len(spread) == 2 and all(map(isfinite, spread)), f"{kind}: give two finite numbers, got {spread}")
    else:
        require(0 < spread < inf, f"{kind}: a spread is a positive fraction, {example}, got {spread:g}")


def _check_deviation(distribution: Distribution) -> None:
    spread = distribution.spread
    if isinstance(spread, tuple):
        kind = type(distribution).__name__
        require(spread[1] > 0, f"{kind}: the deviation, the second of the two, must be positive, got {spread[1]:g}")


def _ends_about(value: float, fraction: float) -> tuple[float, float]:
    """The values that lie a fraction of a value below and above it."""
    require(value != 0, f"a fraction of 0 is 0: give two numbers in place of {fraction:g}")
    low, high = sorted((value * (1 - fraction), value * (1 + fraction)))
    return low, high
