"""Scenarios: further plants that a design must suit: corners of a box, samples of it, draws of a fit's covariance.

Scenarios are a mapping from a name to the parameter values that differ from the nominal plant, as `sweep` and `tune`
take it. `tolerances` varies parameters that are still to be tuned, by factors.

Random numbers are a function of a seed and of the name of what is drawn: the kind of the draw, and each axis of it. So
two kinds, two axes, and a search and the plants on which its result is tried never see the same numbers, whatever seeds
a user gives them, equal ones included; and an axis more leaves the numbers of the others as they were.

A newcomer adds a way to fill a box to `Sampling` and `_POINTS`; or a distribution, a class like these, to
`DISTRIBUTIONS`, whose word study.toml and tuning.toml take:
``"load.mass" = { distribution = "normal", spread = "5 %" }``.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import ceil, inf, isfinite, log1p, log2
from numbers import Integral
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from pneuopt.evaluation.tolerances import MAX_CORNERS, MAX_DRAWS_PER_SAMPLE, MIN_PROBABILITY
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet

if TYPE_CHECKING:
    import pandas as pd


Seed = int | tuple[int | str, ...]
"""A user's number, or that with words after it which say for what it is taken: (0, "validation")."""


class Sampling(Enum):
    """Choice of points in the unit cube; a newcomer adds a word here and a row of `_POINTS`."""

    RANDOM = "random"
    """Independent of each other: Monte Carlo, whose scatter tells its own error."""
    LATIN_HYPERCUBE = "latin_hypercube"
    """Each of n equal parts of each axis has one point: means of smooth figures converge faster."""
    SOBOL = "sobol"
    """A scrambled Sobol sequence: as even in several axes at once; best with a power of two."""


def further(seed: Seed, *words: str) -> Seed:
    """A seed of another stream: what is drawn with it shares no number with what is drawn with the first."""
    return (*(seed if isinstance(seed, tuple) else (seed,)), *words)


def generator(seed: Seed, *stream: str) -> np.random.Generator:
    """Random numbers of a stream, the same on every machine; those of two streams, of two names, are independent."""
    parts: list[int | str] = []
    for part in (*(seed if isinstance(seed, tuple) else (seed,)), *stream):
        if isinstance(part, str):
            parts.append(part)
        elif isinstance(part, Integral) and not isinstance(part, bool) and part >= 0:
            parts.append(int(part))
        else:
            raise InputError(f"a seed is a whole number, not below 0, got {part!r}")
    digest = hashlib.sha256(json.dumps(parts).encode()).digest()  # no two lists of parts have one text
    return np.random.default_rng(int.from_bytes(digest, "big"))


def unit_points(sampling: Sampling, count: int, axes: Sequence[str], seed: Seed, kind: str) -> Array:
    """Points of the unit cube, shape (count, n_axes); `kind` and each axis's name say which random numbers it has."""
    return _POINTS[sampling](count, axes, further(seed, kind, sampling.value))


def _sobol_points(count: int, axes: Sequence[str], seed: Seed) -> Array:
    """The first points of a scrambled sequence, which is balanced at powers of two, in an order of their own.

    In their own order the first axes of any two sequences go along with each other, however they are scrambled.
    """
    from scipy.stats import qmc  # now: it takes as long to import as all else of a certificate

    rng = generator(seed, *axes)
    points = qmc.Sobol(len(axes), scramble=True, rng=rng).random_base2(ceil(log2(count)))
    return np.asarray(rng.permutation(points[:count]))


_POINTS: Mapping[Sampling, Callable[[int, Sequence[str], Seed], Array]] = {
    Sampling.RANDOM: lambda count, axes, seed: np.column_stack([generator(seed, axis).random(count) for axis in axes]),
    Sampling.LATIN_HYPERCUBE: lambda count, axes, seed: np.column_stack(
        # a permutation of the parts of each axis, and a point anywhere in each
        [(rng.permutation(count) + rng.random(count)) / count for rng in (generator(seed, axis) for axis in axes)]
    ),
    Sampling.SOBOL: _sobol_points,
}


class Distribution(Protocol):
    """Distribution of a parameter from plant to plant."""

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
    """Values below which the given shares of a distribution lie [SI], the part of it within a parameter's bounds."""
    p, frozen = parameter, distribution.freeze(parameter.value)
    lower = max(p.lower, 0.0) if p.log else p.lower
    below, above = float(frozen.cdf(lower)), float(frozen.sf(p.upper))
    inside = 1.0 - below - above
    message = f"{name}: {distribution} leaves its bounds, {p.lower:g} to {p.upper:g} {p.unit}; move one of them"
    require(inside > MIN_PROBABILITY, message)
    least = float(np.finfo(float).epsneg)  # at 0 and 1 themselves a quantile is infinite
    probability = np.clip(below + np.asarray(shares) * inside, least, 1 - least)
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


AxisNames = str | tuple[str, ...]
TOGETHER = " + "  # between names of parameters that vary together, where they are one text
Spread = float | tuple[float, float]
Spreads = Mapping[str, Spread] | Mapping[AxisNames, Spread]
SampleSpreads = Spreads | Mapping[str, Spread | Distribution] | Mapping[AxisNames, Spread | Distribution]
ScenarioValues = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Factor:
    """A parameter value as a multiple of a candidate's: a tolerance on a parameter that is still to be tuned.

    Parameters
    ----------
    share : float
        The factor; 1.01 is one per cent more.
    """

    share: float

    def __post_init__(self) -> None:
        require(0 < self.share < math.inf, f"Factor: share must be positive and finite, got {self.share}")


Scenarios = Mapping[str, Mapping[str, float | Factor]]
NO_SCENARIOS: Scenarios = MappingProxyType({})  # no scenario: the nominal plant alone


def corners(parameters: ParameterSet, spreads: Spreads) -> ScenarioValues:
    """Plants at the corners of a box: every combination of least and greatest value, 2^n plants for n axes.

    Parameters
    ----------
    parameters : ParameterSet
        The nominal values, and the bounds.
    spreads : mapping of str, or tuple of str, to float or pair
        The axes of the box. A key names parameters, or patterns of names, that vary together, as a tuple or as one text
        with " + " between them; its value is a fraction
        of each parameter's value, 0.3 for +-30 %, or the least and the greatest value [SI].

    Returns
    -------
    dict of str to dict of str to float

    Raises
    ------
    InputError
        If a name is unknown or on two axes, a spread is empty or leaves the bounds, or there are too many corners.

    Examples
    --------
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "friction.coulomb": Parameter(40.0, "N")})
    >>> corners(rig, {"load.mass": 0.2, "friction.*": (30.0, 60.0)})["load.mass low, friction.* high"]
    {'load.mass': 4.0, 'friction.coulomb': 60.0}
    """
    sides = {}
    for axis, (names, spread) in _axis_names(parameters, spreads).items():
        ends = {n: _spread_ends(parameters, n, spread) for n in names}
        sides[axis] = [(f"{axis} {side}", {n: e[k] for n, e in ends.items()}) for k, side in enumerate(("low", "high"))]
    count = 2 ** len(sides)
    require(count <= MAX_CORNERS, f"{len(sides)} axes have {count} corners, more than {MAX_CORNERS}; draw samples")
    return {
        ", ".join(label for label, _ in corner): {n: v for _, values in corner for n, v in values.items()}
        for corner in itertools.product(*sides.values())
    }


def tolerances(
    parameters: ParameterSet,
    shares: Mapping[str, float] | Mapping[AxisNames, float],
    count: int | None = None,
    *,
    seed: Seed = 0,
) -> Scenarios:
    """Tolerances on parameters, tuned ones included: every combination of least and greatest factor, or draws between.

    Parameters
    ----------
    parameters : ParameterSet
    shares : mapping of str, or tuple of str, to float
        The axes. A key names parameters, or patterns, that vary together; its value is the fraction of a candidate's
        value by which they vary.
    count : int, optional
        Number of uniform draws from the box, instead of its corners.
    seed : int or tuple

    Returns
    -------
    mapping of str to mapping of str to Factor

    Raises
    ------
    InputError
        As for `corners`; a share lies between 0 and 1.

    Examples
    --------
    >>> from pneuopt.quantities.parameters import Parameter
    >>> gains = ParameterSet({"pid.Kp": Parameter(2.0, "V*s/m", free=True), "pid.Ki": Parameter(5.0, "V/m")})
    >>> tolerances(gains, {"pid.*": 0.01})["pid.* low"]
    {'pid.Kp': Factor(share=0.99), 'pid.Ki': Factor(share=0.99)}
    """
    for axis, share in shares.items():
        require(0 < share < 1, f"{axis}: a tolerance is a fraction between 0 and 1, got {share:g}; 0.01 is +-1 %")
    units = ParameterSet({n: replace(p, value=1.0, lower=0.0, upper=2.0, log=False) for n, p in parameters.items()})
    factors = (
        corners(units, shares) if count is None else samples(units, shares, count, seed=further(seed, "tolerances"))
    )
    return {name: {n: Factor(v) for n, v in values.items()} for name, values in factors.items()}


def apply_scenario(parameters: ParameterSet, values: Mapping[str, float | Factor]) -> ParameterSet:
    """Parameters of one scenario; a factor may leave the bounds, which hold for the candidate itself.

    Parameters
    ----------
    parameters : ParameterSet
    values : mapping of str to float or Factor
    """
    spread = {n: parameters.value(n) * v.share for n, v in values.items() if isinstance(v, Factor)}
    room = {n: (min(parameters[n].lower, v), max(parameters[n].upper, v)) for n, v in spread.items()}
    plain = {n: v for n, v in values.items() if not isinstance(v, Factor)}
    return parameters.with_bounds(room).with_values(spread | plain)


def samples(
    parameters: ParameterSet,
    spreads: SampleSpreads,
    count: int,
    *,
    seed: Seed = 0,
    sampling: Sampling = Sampling.RANDOM,
) -> ScenarioValues:
    """Plants drawn from the box whose corners `corners` gives, or from stated distributions.

    Parameters
    ----------
    parameters : ParameterSet
    spreads : mapping
        As for `corners`, drawn uniformly; or a `Distribution`, cut off at the bounds. Parameters on one axis vary
        together.
    count : int
    seed : int or tuple
        Draws of another kind, or of other parameters, are independent of these for the same seed, too.
    sampling : Sampling
        How the draws fill the box.

    Returns
    -------
    dict of str to dict of str to float
        "sample 1" and so on.

    Raises
    ------
    InputError
        As for `corners`, or if next to nothing of a distribution lies within the bounds.

    Examples
    --------
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "load.force": Parameter(0.0, "N")})
    >>> from pneuopt.evaluation.scenarios import Normal
    >>> spreads = {"load.mass": Normal(0.05), "load.force": (-20.0, 20.0)}
    >>> len(samples(rig, spreads, 100, sampling=Sampling.LATIN_HYPERCUBE))
    100
    """
    require(count >= 1, f"count must be at least 1, got {count}")
    shares = unit_points(sampling, count, axis_labels(parameters, spreads), seed, "samples")
    return {f"sample {k}": row for k, row in enumerate(values_at(parameters, spreads, shares), 1)}


def axis_labels(parameters: ParameterSet, spreads: SampleSpreads) -> tuple[str, ...]:
    """The axes of a box of spreads: "load.mass", or "friction.coulomb + friction.static" where these vary together."""
    return tuple(_axis_names(parameters, spreads))


def values_at(parameters: ParameterSet, spreads: SampleSpreads, shares: Array) -> list[dict[str, float]]:
    """Parameter values [SI] at points of a box of spreads, `shares` of its width or probability, shape (n, n_axes)."""
    columns = dict[str, list[float]]()
    for k, (names, spread) in enumerate(_axis_names(parameters, spreads).values()):
        for n in names:
            if isinstance(spread, float | int | tuple):
                low, high = _spread_ends(parameters, n, spread)
                columns[n] = (low + shares[:, k] * (high - low)).tolist()
            else:
                columns[n] = quantiles(spread, n, parameters[n], shares[:, k]).tolist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def draws(
    parameters: ParameterSet,
    covariance: "pd.DataFrame",
    count: int,
    *,
    seed: Seed = 0,
    dof: Mapping[str, float] = MappingProxyType({}),
) -> ScenarioValues:
    """Plants drawn from a fit's covariance: the uncertainty that the logs leave, correlations included.

    Parameters
    ----------
    parameters : ParameterSet
        The estimates, and the bounds within which every draw lies.
    covariance : DataFrame
        `IdentificationResult.covariance`: rows and columns by parameter. A parameter that is searched by its logarithm
        is drawn by it.
    count : int
    seed : int or tuple
        Draws of another kind, or of other parameters, are independent of these for the same seed, too.
    dof : mapping of str to float, optional
        Degrees of freedom of a parameter's variance, ``fit.estimates["dof"]``: each parameter is then drawn by
        Student's t, as its confidence interval is, with normal scores that are correlated as the estimates are.

    Returns
    -------
    dict of str to dict of str to float
        "draw 1" and so on.

    Raises
    ------
    InputError
        If the covariance names a parameter that the set lacks, or holds NaN: the logs could not identify that one.
    """
    from scipy.stats import norm, t

    require(count >= 1, f"count must be at least 1, got {count}")
    names = [str(n) for n in covariance.index]
    check_names("parameter", names, parameters, "covariance")
    matrix = covariance.to_numpy(dtype=float)
    unknown = [n for n, row in zip(names, matrix, strict=True) if not np.isfinite(row).all()]
    message = f"no covariance of {' and '.join(unknown)}: the fit could not identify them; give corners instead"
    require(not unknown, message)
    centre = np.array([parameters.value(n) for n in names])
    log = np.array([parameters[n].log for n in names])
    scale = np.where(log, centre, 1.0)
    mean = np.where(log, np.log(np.where(log, centre, 1.0)), centre)
    scaled = matrix / np.outer(scale, scale)
    variances, axes = np.linalg.eigh((scaled + scaled.T) / 2)
    factor = np.asarray(axes * np.sqrt(np.maximum(variances, 0.0)))  # rounding makes some variances negative
    rng = generator(seed, "draws", *names)
    freedom, sizes = np.array([dof.get(n, math.inf) for n in names]), np.linalg.norm(factor, axis=1)
    few = np.isfinite(freedom) & (sizes > 0)

    def draw_within_bounds() -> dict[str, float]:
        for _ in range(MAX_DRAWS_PER_SAMPLE):
            z = factor @ rng.standard_normal(len(names))
            z[few] = sizes[few] * t.ppf(norm.cdf(z[few] / sizes[few]), freedom[few])  # of Student's t
            z += mean
            drawn = np.where(log, np.exp(np.where(log, z, 0.0)), z)
            values = dict(zip(names, drawn.tolist(), strict=True))
            if all(parameters[n].lower <= v <= parameters[n].upper for n, v in values.items()):
                return values
        message = f"of {MAX_DRAWS_PER_SAMPLE} draws none lies within the bounds of {', '.join(names)}"
        raise InputError(f"{message}; widen them, or give corners")

    return {f"draw {k}": draw_within_bounds() for k in range(1, count + 1)}


def _axis_names(
    parameters: ParameterSet, spreads: SampleSpreads
) -> dict[str, tuple[tuple[str, ...], Spread | Distribution]]:
    """The parameters of each axis, and how they spread."""
    require(len(spreads) > 0, "no spread: give at least one parameter and how far it spreads")
    out: dict[str, tuple[tuple[str, ...], Spread | Distribution]] = {}
    taken: dict[str, str] = {}
    for key, spread in spreads.items():
        patterns = tuple(key.split(TOGETHER)) if isinstance(key, str) else key
        axis = TOGETHER.join(patterns)
        names = parameters.match_names(*patterns)
        for name in names:
            require(name not in taken, f"{name} is on two axes, {taken.get(name)!r} and {axis!r}; leave it on one")
            taken[name] = axis
        out[axis] = names, spread
    return out


def _spread_ends(parameters: ParameterSet, name: str, spread: Spread | Distribution) -> tuple[float, float]:
    p = parameters[name]
    if not isinstance(spread, float | int | tuple):
        raise InputError(f"{name}: {spread} has no corners; draw samples")
    if isinstance(spread, tuple):
        low, high = spread
    else:
        require(spread > 0, f"{name}: a spread is a positive fraction, got {spread:g}; 0.3 is +-30 %")
        low, high = sorted((p.value * (1 - spread), p.value * (1 + spread)))
    require(low < high, f"{name}: the spread from {low:g} to {high:g} {p.unit} is empty")
    inside = p.lower <= low and high <= p.upper
    require(inside, f"{name}: {low:g} to {high:g} {p.unit} leaves its bounds, {p.lower:g} to {p.upper:g} {p.unit}")
    return low, high
