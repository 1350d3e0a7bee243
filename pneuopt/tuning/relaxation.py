"""How far requirements that contradict each other have to give way: each alone, or all of them together.

For one limit alone the question is a tuning of its own, whose objective is that requirement and whose limits are the
others. For all together it is the least share by which every limit has to be wider: a minimax over the simulator's
values, from the points that the tunings found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil, floor, inf, isfinite, log10, nan
from typing import Any

import numpy as np
from scipy.optimize import minimize

from pneuopt.control.reference import Step
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import SettlingTime, metric_name, upper_limit, user_limit, with_user_limit
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space

RELAXED_LIMIT_DIGITS = 3  # of a relaxed limit, rounded so that the design that was found keeps it
UNSETTLED_EXCESS = 10.0  # relative excess of what never settles, before what it is off at the end
MAX_LOCAL_SIMULATIONS = 200  # of the local search for all limits together


def relaxation_specification(
    spec: Specification, requirement: Requirement, references: Sequence[Step]
) -> Specification:
    """The tuning that finds how small a limited requirement can be where the others are kept.

    Where a settling time is minimised, the response still has to settle. The objective is of the order of the horizon,
    as the searches' penalties are.
    """
    limits, horizon = limits_with_settling(spec, references), min(r.horizon - r.at for r in references)
    weights = {with_user_limit(requirement, None): horizon / upper_limit(requirement)}
    return replace(spec, weights=weights, limits=tuple(q for q in limits if q is not requirement))


def limits_with_settling(spec: Specification, references: Sequence[Step]) -> tuple[Requirement, ...]:
    """The limits, and where a settling time is only minimised, that there is one."""
    horizon = min(r.horizon - r.at for r in references)
    if not spec.weight(SettlingTime) or any(isinstance(q, SettlingTime) for q in spec.limits):
        return spec.limits
    return (*spec.limits, SettlingTime(spec.band, max=(1 - TAIL_SHARE) * horizon))


def relax_all(simulator: Simulator, space: Space, spec: Specification, points: Sequence[Array]) -> Array:
    """The point whose limits have to be widened by the least common share, by Nelder-Mead from the best of `points`.

    Parameters
    ----------
    simulator : Simulator
    space : Space
    spec : Specification
    points : sequence of ndarray, shape (n,)
        Starts.

    Returns
    -------
    ndarray, shape (n,)
    """

    def share(unit: Array) -> Array:
        return limit_excess(simulator.values(space.from_unit(np.clip(unit, 0.0, 1.0)), spec), spec)

    starts = np.array([space.to_unit(point) for point in points])
    best = starts[np.argmin(share(starts))]
    steps = np.where(best < 0.5, 0.02, -0.02) * np.eye(len(best))
    options = {
        "maxfev": MAX_LOCAL_SIMULATIONS,
        "initial_simplex": np.vstack([best, best + steps]),
        "xatol": 1e-5,
        "fatol": 1e-5,
    }
    settings: Any = {"method": "Nelder-Mead", "bounds": [(0.0, 1.0)] * len(best), "options": options}

    def cost(unit: Array) -> float:
        return float(share(unit[None])[0])

    found = minimize(cost, best, **settings)
    return space.from_unit(np.clip(found.x, 0.0, 1.0))


def limit_excess(values: Mapping[str, Array], spec: Specification) -> Array:
    """The share by which every limit would have to be wider, shape (m,); graded where nothing settles."""
    unsettled = UNSETTLED_EXCESS + np.minimum(values["Excess"], UNSETTLED_EXCESS)
    worst = np.full_like(unsettled, -np.inf)
    if spec.concerns(SettlingTime):
        worst = np.where(np.isfinite(values["SettlingTime"]), worst, unsettled)
    for q in spec.limits:
        used = np.where(np.isfinite(values[metric_name(q)]), values[metric_name(q)] / upper_limit(q) - 1, unsettled)
        worst = np.maximum(worst, used)
    return worst


def relaxation_row(
    requirement: Requirement | None, value: float, point: Array, names: Sequence[str]
) -> dict[str, float]:
    """A row of `TuningResult.relaxations`.

    Parameters
    ----------
    requirement : Requirement or None
        None: all together.
    value : float
        As the user writes it, NaN where no design was found; of all together the share.
    point : ndarray, shape (n,)
    names : sequence of str
    """
    gains = dict(zip(names, point.tolist(), strict=True)) if np.isfinite(value) else dict.fromkeys(names, nan)
    if requirement is None:
        return {"asked": nan, "needed": nan, "share": _round_outwards(value, upwards=True), **gains}
    asked, least = user_limit(requirement), requirement.metric.sense is Sense.AT_LEAST
    assert asked is not None
    needed = _round_outwards(value, upwards=not least)
    return {"asked": asked, "needed": needed, "share": (asked - needed if least else needed - asked) / asked, **gains}


def describe_relaxations(rows: Mapping[str, Mapping[str, float]]) -> str:
    """What the table says, in words."""
    able = {n: r for n, r in rows.items() if n != "all" and isfinite(r["needed"])}
    each = ", or ".join(f"{n} relaxed to {r['needed']:.6g} ({r['asked']:.6g} asked)" for n, r in able.items())
    share = rows["all"]["share"] if "all" in rows else nan
    alone = "one alone would do" if "all" in rows else "this would do"
    parts = [f"{alone}: {each}" if each else "no limit relaxed alone would do"]
    parts += [f"all limits relaxed by {100 * share:.3g} %"] if isfinite(share) else []
    return "; or ".join(parts)


def _round_outwards(value: float, *, upwards: bool) -> float:
    """Rounded so that the design that was found keeps it.

    Examples
    --------
    >>> _round_outwards(0.08112, upwards=True), _round_outwards(1.8467, upwards=False)
    (0.0812, 1.84)
    """
    if not 0 < abs(value) < inf:
        return value
    place = 10.0 ** (floor(log10(abs(value))) - RELAXED_LIMIT_DIGITS + 1)
    steps = (ceil if upwards else floor)(value / place * (1 - 1e-12 if upwards else 1 + 1e-12))
    return float(f"{steps * place:.{RELAXED_LIMIT_DIGITS}g}")
