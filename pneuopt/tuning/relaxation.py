"""Relaxation of limits that no design found keeps: by how much each alone, or all together, must give way.

For one limit alone the answer is a tuning of its own, which minimises that requirement under the other limits. For all
together it is the least share by which every limit has to widen: a minimax over the simulator's values, from the points
that those tunings found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil, floor, inf, isfinite, log10, nan
from typing import Any

import numpy as np
from scipy.optimize import minimize

from pneuopt.control.reference import Reference
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import SettlingTime, upper_limit, user_limit, with_user_limit
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import TAIL_SHARE
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space
from pneuopt.tuning.tolerances import MAX_LOCAL_SIMULATIONS, UNSETTLED_EXCESS


def relaxation_specification(
    spec: Specification, requirement: Requirement, references: Sequence[Reference]
) -> Specification:
    """The tuning that makes a limited requirement as small as the other limits allow; the response still settles.

    The objective is scaled to the size of the horizon, as the searches' penalties are.
    """
    limits, horizon = limits_with_settling(spec, references), min(r.horizon - r.at for r in references)
    weights = {with_user_limit(requirement, None): horizon / upper_limit(requirement)}
    return replace(spec, weights=weights, limits=tuple(q for q in limits if q is not requirement))


def limits_with_settling(
    spec: Specification, references: Sequence[Reference], *, always: bool = False
) -> tuple[Requirement, ...]:
    """The limits, and one that the response settles at all where a settling time is minimised without a limit.

    With `always` it has to settle whatever is minimised.
    """
    horizon = min(r.horizon - r.at for r in references)
    if not (always or spec.weight(SettlingTime)) or any(isinstance(q, SettlingTime) for q in spec.limits):
        return spec.limits
    return (*spec.limits, spec.settling(spec.band, max=(1 - TAIL_SHARE) * horizon))


def relax_all(simulator: Simulator, space: Space, spec: Specification, points: Sequence[Array]) -> Array:
    """The point (n,) for which limits widen by the least common share, by Nelder-Mead from the best of the points."""

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
    """The share by which every limit has to widen for a point to keep them, shape (m,); graded where none settles."""
    unsettled = UNSETTLED_EXCESS + np.minimum(values["Excess"], UNSETTLED_EXCESS)
    worst = np.full_like(unsettled, -np.inf)
    if spec.concerns(SettlingTime):
        worst = np.where(np.isfinite(values[spec.settling.metric.name]), worst, unsettled)
    for share in spec.excess(values).values():
        worst = np.maximum(worst, np.where(np.isfinite(share), share, unsettled))
    return worst


def relaxation_row(
    requirement: Requirement | None, value: float, point: Array, names: Sequence[str]
) -> dict[str, float]:
    """A row of `TuningResult.relaxations`: a requirement with its least value, or (None) all with their least share.

    The value is on the user's scale, NaN where no design was found.
    """
    gains = dict(zip(names, point.tolist(), strict=True)) if np.isfinite(value) else dict.fromkeys(names, nan)
    if requirement is None:
        return {"asked": nan, "needed": nan, "share": round_outwards(value, upwards=True), **gains}
    asked, least = user_limit(requirement), requirement.metric.sense is Sense.AT_LEAST
    assert asked is not None
    needed = round_outwards(value, upwards=not least)
    return {"asked": asked, "needed": needed, "share": (asked - needed if least else needed - asked) / asked, **gains}


def describe_relaxations(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Say in words which limits would have to be relaxed, and by how much."""
    able = {n: r for n, r in rows.items() if n != "all" and isfinite(r["needed"])}
    each = ", or ".join(f"{n} relaxed to {r['needed']:.6g} ({r['asked']:.6g} asked)" for n, r in able.items())
    share = rows["all"]["share"] if "all" in rows else nan
    alone = "one alone would do" if "all" in rows else "this would do"
    parts = [f"{alone}: {each}" if each else "no limit relaxed alone would do"]
    parts += [f"all limits relaxed by {100 * share:.3g} %"] if isfinite(share) else []
    return "; or ".join(parts)


def round_outwards(value: float, *, upwards: bool, digits: int = 3) -> float:
    """Round a limit so that the design that was found keeps it.

    Examples
    --------
    >>> round_outwards(0.08112, upwards=True), round_outwards(1.8467, upwards=False)
    (0.0812, 1.84)
    """
    if not 0 < abs(value) < inf:
        return value
    place = 10.0 ** (floor(log10(abs(value))) - digits + 1)
    steps = (ceil if upwards else floor)(value / place * (1 - 1e-12 if upwards else 1 + 1e-12))
    return float(f"{steps * place:.{digits}g}")
