"""`monte_carlo`: plants within what a fit leaves open and what is stated of the other parameters, in one draw."""

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.evaluation.sampling import Sampling, Seed, further, generator
from pneuopt.evaluation.scenarios import SampleSpreads, ScenarioValues, draws, samples
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd


def monte_carlo(
    parameters: ParameterSet,
    count: int,
    *,
    covariance: "pd.DataFrame | None" = None,
    estimates: "pd.DataFrame | None" = None,
    spreads: SampleSpreads = MappingProxyType({}),
    seed: Seed = 0,
    sampling: Sampling = Sampling.RANDOM,
) -> ScenarioValues:
    """Draw plants: what a fit has estimated from its covariance, other parameters from stated distributions.

    Parameters
    ----------
    parameters : ParameterSet
        The nominal values, and the bounds within which every draw lies.
    count : int
    covariance, estimates : DataFrame, optional
        `IdentificationResult.covariance`, and `.estimates`: with these the draws are as wide as the confidence
        intervals (Student's t), and a parameter that has a range in place of an interval is drawn from anywhere in it.
    spreads : mapping, optional
        As for `samples`; a parameter in it is drawn by it, whatever the fit says.
    seed : int or tuple
        Plants of `samples` or `draws` are independent of these for the same seed, too.
    sampling : Sampling
        How the draws of `spreads` fill their box; those of the fit are independent.

    Returns
    -------
    dict of str to dict of str to float
        "sample 1" and so on.

    Raises
    ------
    InputError
        As from `samples` and `draws`, or if nothing varies.

    Examples
    --------
    >>> import pandas as pd
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"friction.coulomb": Parameter(40.0, "N", 0.0), "load.mass": Parameter(5.0, "kg")})
    >>> variance = pd.DataFrame([[4.0]], ["friction.coulomb"], ["friction.coulomb"])
    >>> plants = monte_carlo(rig, 500, covariance=variance, spreads={"load.mass": 0.1})
    >>> len(plants), sorted(plants["sample 1"])
    (500, ['friction.coulomb', 'load.mass'])
    """
    require(count >= 1, f"count must be at least 1, got {count}")
    own_seed = further(seed, "monte_carlo")
    stated = samples(parameters, spreads, count, seed=own_seed, sampling=sampling) if spreads else {}
    own = {n for values in stated.values() for n in values}
    estimated, ranges = select_estimates(parameters, covariance, own), select_ranges(parameters, estimates, own)
    nothing = "nothing varies: state how a parameter spreads, or give a fit that has estimated one of this loop"
    require(bool(own or ranges) or estimated is not None, nothing)
    dof = degrees_of_freedom(estimates)
    fitted = {} if estimated is None else draws(parameters, estimated, count, seed=own_seed, dof=dof)
    wide = draw_in_ranges(parameters, ranges, count, own_seed)
    parts = zip(*(list(part.values()) or [{}] * count for part in (fitted, stated)), wide, strict=True)
    return {f"sample {k}": {**a, **b, **c} for k, (a, b, c) in enumerate(parts, 1)}


def select_estimates(
    parameters: ParameterSet, covariance: "pd.DataFrame | None", others: Collection[str]
) -> "pd.DataFrame | None":
    """The part of a covariance that the plants are drawn from: what is identified, without the others."""
    if covariance is None:
        return None
    spread = dict(zip(map(str, covariance.index), np.diag(covariance.to_numpy(dtype=float)).tolist(), strict=True))
    names = [n for n, v in spread.items() if n in parameters and n not in others and v > 0]
    return covariance.loc[names, names] if names else None


def degrees_of_freedom(estimates: "pd.DataFrame | None") -> dict[str, float]:
    """The degrees of freedom of each estimate's variance, where a fit tells them."""
    if estimates is None or "dof" not in estimates:
        return {}
    return {str(n): float(v) for n, v in estimates["dof"].items() if math.isfinite(v) and v > 0}


def select_ranges(
    parameters: ParameterSet, estimates: "pd.DataFrame | None", others: Collection[str]
) -> dict[str, tuple[float, float]]:
    """The ranges within the bounds of what a fit has given one in place of an interval, without the others."""
    if estimates is None or "range_low" not in estimates:
        return {}
    rows = estimates[estimates["stderr"].isna() & estimates["range_low"].notna() & estimates["range_high"].notna()]
    ends = {str(n): (float(row["range_low"]), float(row["range_high"])) for n, row in rows.iterrows()}
    return {
        n: (max(low, parameters[n].lower), min(high, parameters[n].upper))
        for n, (low, high) in ends.items()
        if n in parameters and n not in others and low < high
    }


def draw_in_ranges(
    parameters: ParameterSet, ranges: Mapping[str, tuple[float, float]], count: int, seed: Seed
) -> list[dict[str, float]]:
    """Values anywhere in each range, by their logarithm where the parameter is searched by it."""

    def draw(name: str, low: float, high: float) -> list[float]:
        share = generator(seed, "ranges", name).random(count)
        drawn = low * (high / low) ** share if parameters[name].log else low + share * (high - low)
        return [float(v) for v in drawn]

    columns = {n: draw(n, *ends) for n, ends in ranges.items()}
    return [{n: values[k] for n, values in columns.items()} for k in range(count)]
