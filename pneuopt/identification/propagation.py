"""`propagate_error`: a figure computed from estimates, with the confidence interval that theirs imply."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.statistics import confidence_interval
from pneuopt.quantities.arrays import Array

ParameterValues = Mapping[str, float]
# standard deviations over which a slope is taken: larger steps see curvature, smaller ones rounding
DELTA_METHOD_STEP = 1e-3


@dataclass(frozen=True)
class PropagatedValue:
    """A figure with its 95 % confidence interval.

    Attributes
    ----------
    value, stderr, ci_low, ci_high : float
        All but the value are NaN where the figure depends on a parameter without an interval.
    """

    value: float
    stderr: float
    ci_low: float
    ci_high: float


def propagate_error(result: IdentificationResult, function: Callable[[ParameterValues], float]) -> PropagatedValue:
    """Compute a function of the parameters, with its confidence interval by the delta method.

    Parameters
    ----------
    result : IdentificationResult
    function : callable
        Takes all parameters' values by name, "name[log]" for one of a log; returns a number.

    Returns
    -------
    PropagatedValue
        ``stderr = sqrt(g C g')`` with g the slope at the estimates (central differences) and C their covariance: right
        where the function is nearly linear within the intervals. Its interval has the fewest degrees of freedom among
        the estimates that the figure depends on.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> import pandas as pd
    >>> from pneuopt.quantities.parameters import Parameter, ParameterSet
    >>> names = ["static", "coulomb"]
    >>> fit = SimpleNamespace(
    ...     parameters=ParameterSet({n: Parameter(v, "N") for n, v in zip(names, (60.0, 40.0))}),
    ...     estimates=pd.DataFrame({"value": [60.0, 40.0], "dof": [900.0, 3.0]}, index=names),
    ...     covariance=pd.DataFrame([[4.0, 0.0], [0.0, 1.0]], index=names, columns=names),
    ... )
    >>> ratio = propagate_error(fit, lambda p: p["static"] / p["coulomb"])
    >>> ratio.value, round(ratio.stderr, 4), round(ratio.ci_high, 4)
    (1.5, 0.0625, 1.6989)
    """
    values, slopes = _linearise(result, lambda p: [function(p)])
    value, spread = float(values[0]), float(_deviations(result, slopes)[0])
    used = result.covariance.index[slopes[0] != 0]
    dof = float(result.estimates["dof"][used].min()) if len(used) else math.inf
    return PropagatedValue(value, spread, *confidence_interval(value, spread, log=False, dof=dof))


def propagate_intervals(
    result: IdentificationResult, function: Callable[[ParameterValues], ArrayLike]
) -> tuple[Array, Array]:
    """Compute several figures at once with their 95 % confidence intervals, as a curve over a grid.

    Parameters
    ----------
    result : IdentificationResult
    function : callable
        As for `propagate_error`; returns n numbers.

    Returns
    -------
    values : ndarray, shape (n,)
    intervals : ndarray, shape (n, 2)
        NaN where a figure depends on a parameter without an interval.
    """
    values, slopes = _linearise(result, function)
    dof = result.estimates["dof"][result.covariance.index].to_numpy(dtype=float)
    spreads, degrees = _deviations(result, slopes), [min(dof[row != 0], default=math.inf) for row in slopes]
    every = zip(values.tolist(), spreads.tolist(), degrees, strict=True)
    return values, np.array([confidence_interval(v, s, log=False, dof=d) for v, s, d in every])


def _linearise(result: IdentificationResult, function: Callable[[ParameterValues], ArrayLike]) -> tuple[Array, Array]:
    """The figures at the estimates, shape (n,), and their slopes by these, shape (n, k)."""
    known = {n: p.value for n, p in result.parameters.items()}
    found = {str(n): float(v) for n, v in result.estimates["value"].items()}
    at = {**known, **{n: known[n.partition("[")[0]] if math.isnan(v) else v for n, v in found.items()}}
    variances = np.diag(result.covariance.to_numpy(dtype=float))
    slopes = [
        _central_difference(function, at, str(n), v) for n, v in zip(result.covariance.index, variances, strict=True)
    ]
    value = np.asarray(function(at), dtype=float)
    return value, np.stack(slopes, axis=-1) if slopes else np.zeros((len(value), 0))


def _deviations(result: IdentificationResult, slopes: Array) -> Array:
    """Standard deviations of figures with these slopes, shape (n,)."""
    used = np.any(slopes != 0, axis=0)  # parameters without an interval do no harm where no figure depends on them
    covariance = result.covariance.to_numpy(dtype=float)[np.ix_(used, used)]
    return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", slopes[:, used], covariance, slopes[:, used])))


def _central_difference(
    function: Callable[[ParameterValues], ArrayLike], at: ParameterValues, name: str, variance: float
) -> Array:
    step = DELTA_METHOD_STEP * math.sqrt(variance) if variance > 0 else 1e-6 * max(abs(at[name]), 1e-6)
    up, down = (np.asarray(function({**at, name: at[name] + side * step}), dtype=float) for side in (1, -1))
    return np.asarray((up - down) / (2 * step))
