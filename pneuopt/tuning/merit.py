"""`compute_merits`: how searches by simulation rank points; `search_result`: what they return of the best."""

from collections.abc import Mapping

import numpy as np

from pneuopt.evaluation.requirements import SettlingTime, describe_value, metric_name, upper_limit
from pneuopt.evaluation.specification import STABILITY_SENSITIVITY, Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.readings import WORST_MERIT, penalty_settling_time
from pneuopt.tuning.responses import to_records
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space

# Relative excess over a limit with which a search still counts as successful. At zero, rounding errors make a design
# that lies on its limit infeasible; a larger one hands over designs whose certificate is bound to fail.
LIMIT_TOLERANCE = 1e-4
# Share of the margin that limits on peaks of command and sensitivity are tightened by. A smaller one than a search's
# coarse samples miss of a peak makes the certificate fail; a larger one gives performance away.
SIMULATION_PEAK_MARGIN = 1 / 5
WIDEN_BOUNDS = "widen the gains' bounds, or lower their lower ends"  # the remedy where no stable loop is found
# Weight of a limit's relative violation beside that of never settling. With a smaller one a search stays with designs
# that settle and break a limit; with a larger one with loops so slow that they keep every limit and never settle.
VIOLATION_PENALTY = 20.0


def compute_merits(values: Mapping[str, Array], spec: Specification, scale: float) -> Array:
    """The objective of points that keep all limits; of others more than any objective, graded by their violations.

    So limits come first, whatever unit the objective has: K. Deb, An efficient constraint handling method for genetic
    algorithms, Comput. Methods Appl. Mech. Engrg. 186 (2000) 311-338. Where a settling time is minimised, a response
    that never settles counts as a violation, the larger the further from the reference it ends, so that a search can
    start.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (m,)
        As `Responses` has them.
    scale : float
        The horizon, which stands for the settling time of what never settles [s].
    """
    filled = {n: np.where(np.isfinite(value), value, WORST_MERIT) for n, value in values.items()}
    settles, late = np.isfinite(values["SettlingTime"]), penalty_settling_time(scale, filled["Excess"])
    filled["SettlingTime"] = np.where(settles, filled["SettlingTime"], late)
    missed = np.where(settles, 0.0, late / scale) if spec.weight(SettlingTime) else np.zeros_like(late)
    for share in spec.excess(filled).values():
        missed += VIOLATION_PENALTY * np.maximum(0.0, share)
    total = np.zeros_like(late)
    for q, weight in spec.weights.items():
        total += weight * filled[metric_name(q)]
    return np.where(missed > 0, WORST_MERIT * (1 + missed), np.minimum(total, WORST_MERIT))


def search_result(task: TuningTask, simulator: Simulator, spec: Specification, point: Array) -> SearchResult:
    """The result of a search by simulation: its best point, of shape (n,), with its status and what is active there.

    Parameters
    ----------
    task : TuningTask
        Whose limits the status is about.
    simulator : Simulator
    spec : Specification
        The tightened one that was searched for.
    point : ndarray, shape (n,)
    """
    values = to_records(simulator.values(point[None], spec))[0]
    active = _active_limits(task.space, spec, point, values)
    return SearchResult(point, _search_status(task.spec, values), active, {"optimum": spec.objective(values)})


def _search_status(spec: Specification, values: Mapping[str, float]) -> Status:
    """The status of a search: converged where its point keeps the limits; otherwise it says which ones are broken."""
    broken = [
        f"{metric_name(q)} {', '.join(describe_value(q, values[metric_name(q)]))}"
        for q in spec.violations(values, LIMIT_TOLERANCE)
    ]
    if not broken and spec.with_stability().violations(values):
        Ms = values["MaxSensitivity"]
        nearly = f"nearly unstable, with a MaxSensitivity of {Ms:.3g}, more than {STABILITY_SENSITIVITY:g}"
        verdict = f"the closest found is {nearly if np.isfinite(Ms) else 'no stable loop'}"
        return Status(Code.INFEASIBLE, (verdict, WIDEN_BOUNDS))
    if broken:
        verdict = f"the closest found has {' and '.join(broken)}"
        return Status(Code.INFEASIBLE, (verdict, "relax a limit or widen the bounds"))
    if not np.isfinite(spec.objective(values)):
        return Status(
            Code.NOT_CONVERGED, ("nothing found settles", "widen the band or the bounds, or lengthen the horizon")
        )
    return Status(Code.CONVERGED)


def _active_limits(space: Space, spec: Specification, point: Array, values: Mapping[str, float]) -> tuple[str, ...]:
    """The names of limits that are reached to within 2 %, and of gains within 0.1 % of their range from a bound."""
    limits = [metric_name(q) for q in spec.limits if values[metric_name(q)] >= 0.98 * upper_limit(q)]
    low, up = space.bounds.T
    near = np.minimum(point - low, up - point) <= 1e-3 * (up - low)
    return (*limits, *(n for n, held in zip(space.names, near, strict=True) if held))
