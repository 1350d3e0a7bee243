"""`validate_design`: a design's metrics on new plants, or with gains off by a tolerance, that no search has used."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.disturbance import add_disturbances
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Step, as_steps
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.metric import Requirement
from pneuopt.evaluation.requirements import METRICS, larger_is_better, metric_name, user_limit
from pneuopt.evaluation.scenarios import Scenarios
from pneuopt.evaluation.specification import Objective, Specification, specify
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space

if TYPE_CHECKING:
    import pandas as pd

# Percentile of the plants that the summary shows [%]. A lower one says little of bad plants; near 100 a few plants
# decide it, as they decide the worst.
SUMMARY_PERCENTILE = 95.0


@dataclass(frozen=True, eq=False)
class DesignValidation:
    """The metrics of a design on new plants.

    Attributes
    ----------
    summary : DataFrame
        A row a requirement, in the units of `TuningResult.certified`: "median", "p95" (95 of 100 plants do better) and
        "worst" by the compiled simulation; "worst_plant", and "certified", that plant's figure by the independent
        simulation; "limit", NaN without; "violations", the number of plants that break it, or that never settle. A
        figure is NaN where the response never settles.
    plants : DataFrame
        A row a plant, a column a metric, the worst over the references; by the compiled simulation.
    certified : DataFrame
        A row a metric, a column a reference and one of the worst plants; by the independent simulation.
    """

    summary: "pd.DataFrame"
    plants: "pd.DataFrame"
    certified: "pd.DataFrame"

    def __repr__(self) -> str:
        return f"DesignValidation on {len(self.plants)} new plants\n{self.summary.to_string()}"


def validate_design(
    loop: ClosedLoop,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    minimise: Objective,
    subject_to: Sequence[Requirement] = (),
    scenarios: Scenarios,
) -> DesignValidation:
    """Simulate a design on new plants: all compiled, the worst one of each requirement by the independent simulation.

    Parameters
    ----------
    loop, references, minimise, subject_to
        As for `tune`.
    parameters : ParameterSet
        The design's, a `TuningResult.parameters` for example.
    scenarios : mapping of str to mapping
        The plants, or tolerances of the gains: of `samples` or `draws` with another seed than the search had, or
        `tolerances` with a count.

    Returns
    -------
    DesignValidation

    Raises
    ------
    InputError
        If there is no scenario, or parameters, scenarios and requirements do not fit together.
    ConvergenceError
        If the loop has no rest on one of the plants, or the independent simulation stops.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.evaluation.requirements import Overshoot, SettlingTime
    >>> from pneuopt.evaluation.scenarios import samples
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> design = loop.parameters.with_values({"pid.Kp": 5.0, "pid.Ki": 50.0})
    >>> plants = samples(design, {"plant.gain": 0.2}, 50, seed=1)
    >>> found = validate_design(
    ...     loop, Step(1.0), design, minimise=SettlingTime(), subject_to=[Overshoot(0.01)], scenarios=plants
    ... )
    >>> int(found.summary.loc["Overshoot", "violations"])
    0
    """
    require(len(scenarios) > 0, "no new plants; draw some: scenarios=samples(parameters, {'load.mass': 0.3}, 100)")
    spec = specify(minimise, subject_to)
    check_closed_loop(loop)
    check_parameters(parameters)
    steps = as_steps(references)
    loop = add_disturbances(loop, steps)
    full = loop.complete(parameters).select(loop.parameters)
    values = _simulate_plants(loop, steps, full, spec, scenarios)
    plants = [str(n) for n in values]
    worst = {str(n): plants[_rank_order(row.to_numpy(dtype=float), str(n))[-1]] for n, row in values.iterrows()}
    named = list(dict.fromkeys(worst.values()))
    certified = evaluate(
        loop, steps, full, scenarios={n: scenarios[n] for n in named}, band=spec.band, envelope=spec.envelope
    )
    certified = certified.loc[list(values.index), certified.columns[len(steps) :]]
    return DesignValidation(
        _summary(values, worst, _worst_by_plant(certified, named, len(steps)), spec), values.T, certified
    )


def _simulate_plants(
    loop: ClosedLoop, steps: Sequence[Step], parameters: ParameterSet, spec: Specification, scenarios: Scenarios
) -> "pd.DataFrame":
    """The metrics of each plant by compiled simulation, the worst over the references."""
    import pandas as pd

    simulator = Simulator(loop, steps, Space(parameters, ()), scenarios, spec)
    rows = simulator.table(np.zeros(0), spec)
    found = pd.DataFrame({case.label: row for case, row in zip(simulator.cases, rows, strict=True)})
    shown = [name for name in METRICS if name in spec.kinds]
    return _worst_by_plant(found.loc[shown, found.columns[len(steps) :]], list(scenarios), len(steps))


def _worst_by_plant(metrics: "pd.DataFrame", plants: Sequence[str], references: int) -> "pd.DataFrame":
    """The worst of each plant's metrics over its references, from columns plant by plant; NaN is the worst."""
    import pandas as pd

    found = {}
    for number, plant in enumerate(plants):
        own = metrics.iloc[:, number * references : (number + 1) * references]
        found[plant] = {n: _worst_value(row.to_numpy(dtype=float), str(n)) for n, row in own.iterrows()}
    return pd.DataFrame(found, index=metrics.index)


def _worst_value(values: Array, metric: str) -> float:
    """The worst value of a metric."""
    return float(values[_rank_order(values, metric)[-1]])


def _rank_order(values: Array, metric: str) -> NDArray[np.intp]:
    """Indices from the best to the worst value of a metric; NaN is the worst."""
    cost = -values if larger_is_better(metric) else values
    return np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")


def _summary(
    values: "pd.DataFrame", worst: Mapping[str, str], certified: "pd.DataFrame", spec: Specification
) -> "pd.DataFrame":
    """The table `DesignValidation.summary`."""
    import pandas as pd

    limits, proven = {metric_name(q): _metric_limit(q) for q in spec.limits}, certified.to_dict()
    rows = {}
    for metric, plant in worst.items():
        given, limit = values.loc[metric].to_numpy(dtype=float), limits.get(metric, math.nan)
        rows[metric] = {
            "median": _quantile(given, metric, 50.0),
            "p95": _quantile(given, metric, SUMMARY_PERCENTILE),
            "worst": _worst_value(given, metric),
            "worst_plant": plant,
            "certified": float(proven[plant][metric]),
            "limit": limit,
            "violations": int(np.sum(~_keeps_limit(given, limit, metric))),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def _quantile(values: Array, metric: str, percent: float) -> float:
    """The value of a metric that so many percent of the plants are as good as or better than."""
    return float(values[_rank_order(values, metric)[math.ceil(len(values) * percent / 100) - 1]])


def _metric_limit(requirement: Requirement) -> float:
    """The limit in the metric's unit, percent where it has percent; NaN without a limit."""
    limit = user_limit(requirement)
    return math.nan if limit is None else requirement.metric.factor * limit


def _keeps_limit(values: Array, limit: float, metric: str) -> NDArray[np.bool_]:
    """Which values keep a limit; without one, which are finite."""
    if math.isnan(limit):
        return np.isfinite(values)
    return np.asarray(values >= limit if larger_is_better(metric) else values <= limit)
