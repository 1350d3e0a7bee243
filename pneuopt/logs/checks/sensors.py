"""Single sensors: a pressure's zero and unit, jitter, clipping, resolution."""

from collections.abc import Iterator

import numpy as np

from pneuopt.logs.checks.findings import Evidence, LogFinding, Panel, StatedAxis, evidence
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.units import ATMOSPHERE

MIN_PRESSURE_RATIO = 0.3
"""Lowest pressure over the atmosphere [1] that counts as absolute: no chamber is exhausted further. A lower bound
lets gauge readings pass, a higher one refuses sensors with an offset."""
MAX_PRESSURE = 1e7
"""Pressure [Pa] that no pneumatic drive has, 100 bar; lower blames blow moulding, higher misses units."""
CLIPPED_SHARE = 0.02
"""Share of samples at the largest value [1] that looks clipped: lower blames rest, higher misses short clipping."""


def check_pressures(experiment: Experiment, _: StatedAxis) -> Iterator[LogFinding]:
    """Find wrong zero points: gauge pressures taken for absolute ones, or the reverse."""
    log = experiment.trajectory
    supply = experiment.conditions.get("supply.pressure")
    if supply is None and "supply_pressure" in log:
        supply = float(np.nanmedian(log["supply_pressure"]))
    for name in ("pressure_a", "pressure_b", "supply_pressure"):
        if name not in log:
            continue
        low, high = (float(np.nanpercentile(log[name], q)) for q in (1, 99))
        if low < MIN_PRESSURE_RATIO * ATMOSPHERE:
            message = f"{name!r} falls to {low / 1e5:.2f} bar(a), a vacuum; a gauge sensor's unit is written bar(g)"
            least = MIN_PRESSURE_RATIO * ATMOSPHERE
            shown = _beside(experiment, name, "no chamber is exhausted further", least, above=False)
            yield LogFinding(name, message, True, evidence=shown)
        elif high > MAX_PRESSURE:
            message = f"{name!r} rises to {high / 1e5:.3g} bar(a), more than air drives have: its unit?"
            yield LogFinding(name, message, True, evidence=_beside(experiment, name, "highest of drives", MAX_PRESSURE))
        elif supply is not None and high > 1.1 * supply and name != "supply_pressure":
            message = f"{name!r} rises to {high / 1e5:.2f} bar(a), above the supply of {supply / 1e5:.2f} bar(a)"
            shown = _beside(experiment, name, "supply", supply)
            yield LogFinding(name, f"{message}; is an absolute sensor read as bar(g)?", True, evidence=shown)


def _beside(experiment: Experiment, name: str, label: str, limit: float, *, above: bool = True) -> Evidence:
    """A pressure beside a limit that it crosses, about where it is farthest beyond."""
    p = experiment.trajectory[name]
    at = int(np.nanargmax(p) if above else np.nanargmin(p))
    panel = Panel("Pa(a)", {name: p, label: np.full(p.size, limit)})
    return evidence(experiment, panel, where=(p > limit) if above else (p < limit), at=at)


def check_sampling(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find jitter, clipping and coarse resolution."""
    log = experiment.trajectory
    steps = np.diff(log.t)
    usual = float(np.median(steps))
    jitter = float(np.median(np.abs(steps - usual))) * 1.4826
    if jitter > 0.05 * usual:
        message = f"the samples jitter by {jitter / usual:.0%} of {usual:g} s; their times are used"
        lengths = np.append(steps, steps[-1])
        uneven = np.abs(lengths - usual) > 0.05 * usual
        shown = evidence(experiment, Panel("s", {"time to the next sample": lengths}), where=uneven)
        yield LogFinding("time", message, False, evidence=shown)
    for name in log:
        y = log[name][np.isfinite(log[name])]
        levels = np.unique(y).size
        for end, which in ((y.max(initial=-np.inf), "largest"), (y.min(initial=np.inf), "smallest")):
            share = float(np.mean(y == end)) if y.size else 0.0
            if name.startswith("pressure") and levels > 50 and share > CLIPPED_SHARE:
                message = f"{share:.0%} of {name!r} are exactly its {which} value: is the sensor clipped?"
                shown = evidence(experiment, name, where=log[name] == end)
                yield LogFinding(name, message, False, evidence=shown)
        if name in (axis.position, axis.speed) and 2 < levels < min(50, y.size // 4):
            message = f"{name!r} has only {levels} levels, the resolution is coarse for the motion"
            yield LogFinding(name, message, False, evidence=evidence(experiment, name, at=len(log) // 2))
