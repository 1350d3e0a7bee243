"""Scenarios: further plants that a design must suit: corners of a box, samples of it, draws of a fit's covariance.

Scenarios are a mapping from a name to the parameter values that differ from the nominal plant, as `sweep` and `tune`
take it. `tolerances` varies parameters that are still to be tuned, by factors.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.evaluation.distributions import Distribution, quantiles
from pneuopt.evaluation.sampling import Sampling, Seed, further, generator, unit_points
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd

AxisNames = str | tuple[str, ...]
TOGETHER = " + "  # between names of parameters that vary together, where they are one text
Spread = float | tuple[float, float]
Spreads = Mapping[str, Spread] | Mapping[AxisNames, Spread]
SampleSpreads = Spreads | Mapping[str, Spread | Distribution] | Mapping[AxisNames, Spread | Distribution]
ScenarioValues = dict[str, dict[str, float]]
MAX_CORNERS = 4096  # plants, 12 axes: each one is simulated for every candidate, and another axis doubles their number
# Draws until a sample lies within the bounds: fewer refuse a covariance that reaches beyond them, more only delay the
# error where hardly any draw fits.
MAX_DRAWS_PER_SAMPLE = 1000


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
    ends = _axis_ends(parameters, spreads)
    count = 2 ** len(ends)
    require(count <= MAX_CORNERS, f"{len(ends)} axes have {count} corners, more than {MAX_CORNERS}; draw samples")
    sides = {axis: [(f"{axis} low", low), (f"{axis} high", high)] for axis, (low, high) in ends.items()}
    return {
        ", ".join(label for label, _ in corner): _merge_values(values for _, values in corner)
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
    >>> from pneuopt.evaluation.distributions import Normal
    >>> spreads = {"load.mass": Normal(0.05), "load.force": (-20.0, 20.0)}
    >>> len(samples(rig, spreads, 100, sampling=Sampling.LATIN_HYPERCUBE))
    100
    """
    require(count >= 1, f"count must be at least 1, got {count}")
    shares = unit_points(sampling, count, axis_labels(parameters, spreads), seed, "samples")
    return {f"sample {k}": row for k, row in enumerate(values_at(parameters, spreads, shares), 1)}


def axis_labels(parameters: ParameterSet, spreads: SampleSpreads) -> tuple[str, ...]:
    """The axes of a box of spreads, in order: "load.mass", or "friction.coulomb + friction.static" that vary together.

    Raises
    ------
    InputError
        As for `samples`.
    """
    return tuple(_axis_names(parameters, spreads))


def values_at(parameters: ParameterSet, spreads: SampleSpreads, shares: Array) -> list[dict[str, float]]:
    """Parameter values at points of a box of spreads.

    Parameters
    ----------
    parameters : ParameterSet
    spreads : mapping
        As for `samples`.
    shares : ndarray, shape (n, axes)
        Of each axis, from 0 to 1: of its width, or of its distribution's probability.

    Returns
    -------
    list of dict of str to float
        A point each [SI].

    Raises
    ------
    InputError
        As for `samples`.
    """
    columns = {
        n: _sample_values(parameters, n, spread, shares[:, k]).tolist()
        for k, (names, spread) in enumerate(_axis_names(parameters, spreads).values())
        for n in names
    }
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
    rng, factor = generator(seed, "draws", *names), _square_root(matrix / np.outer(scale, scale))
    freedom = np.array([dof.get(n, math.inf) for n in names])

    def draw() -> Array:
        z = mean + _by_student_t(factor @ rng.standard_normal(len(names)), np.linalg.norm(factor, axis=1), freedom)
        return np.asarray(np.where(log, np.exp(np.where(log, z, 0.0)), z))

    return {f"draw {k}": _draw_within_bounds(parameters, names, draw) for k in range(1, count + 1)}


def _by_student_t(normal: Array, deviations: Array, dof: Array) -> Array:
    """Normal draws, moved to the same probability of Student's t where there are finite degrees of freedom."""
    from scipy.stats import norm, t

    few = np.isfinite(dof) & (deviations > 0)
    out = normal.copy()
    out[few] = deviations[few] * t.ppf(norm.cdf(normal[few] / deviations[few]), dof[few])
    return out


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


def _axis_ends(parameters: ParameterSet, spreads: Spreads) -> dict[str, tuple[dict[str, float], dict[str, float]]]:
    """Parameter values of each axis at its low and its high end."""
    out: dict[str, tuple[dict[str, float], dict[str, float]]] = {}
    for axis, (names, spread) in _axis_names(parameters, spreads).items():
        ends = [_spread_ends(parameters, name, spread) for name in names]
        out[axis] = (
            {n: e[0] for n, e in zip(names, ends, strict=True)},
            {n: e[1] for n, e in zip(names, ends, strict=True)},
        )
    return out


def _sample_values(parameters: ParameterSet, name: str, spread: Spread | Distribution, shares: Array) -> Array:
    """The values of a parameter at these shares of its axis."""
    if isinstance(spread, float | int | tuple):
        low, high = _spread_ends(parameters, name, spread)
        return np.asarray(low + shares * (high - low))
    return quantiles(spread, name, parameters[name], shares)


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


def _merge_values(parts: Iterator[dict[str, float]]) -> dict[str, float]:
    return {name: value for part in parts for name, value in part.items()}


def _square_root(matrix: Array) -> Array:
    """Factor F with F F' equal to the matrix; eigenvalues that rounding made negative count as zero."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _draw_within_bounds(parameters: ParameterSet, names: list[str], draw: Callable[[], Array]) -> dict[str, float]:
    for _ in range(MAX_DRAWS_PER_SAMPLE):
        values = dict(zip(names, draw().tolist(), strict=True))
        if all(parameters[n].lower <= v <= parameters[n].upper for n, v in values.items()):
            return values
    message = f"of {MAX_DRAWS_PER_SAMPLE} draws none lies within the bounds of {', '.join(names)}"
    raise InputError(f"{message}; widen them, or give corners")
