"""`harden`: a design that holds on other plants, in place of the one that is best on the model alone.

A row of `ROBUST_WAYS` is a way to find designs. Each of them is tried on plants that were drawn for it (`PlantTrial`);
the best that is certified on the model stands, and the first that holds on enough plants ends the search.

The worst plants: those on which the last design breaks a limit most, or has the largest objective, become cases of a
short search, and so do those on which its answer is the worst. This exchange solves a problem with a limit for each
plant by few of them: J. W. Blankenship, J. E. Falk, Infinitely constrained optimization problems, J. Optim. Theory
Appl. 19 (1976) 261-281.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.requirements import METRICS, RiseTime, SettlingTime, requirement_values
from pneuopt.evaluation.scenarios import Scenarios
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.search import Search, certified_objective, end_point
from pneuopt.tuning.tolerances import ENOUGH_HELD, EXCHANGE_SHARE, HIGH_SHARE, MAX_CERTIFIED_POINTS
from pneuopt.tuning.validation import LANE_DEFECTS, PlantTrial, worst_figures

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class PlantRecord:
    """A design (n,) on plants: on how many it holds, and the objective that is reached on 95 of 100 of them.

    `metrics` has a row a metric, a column a plant; `broken` says by plant what breaks.
    """

    point: Array
    held: int
    high: float
    metrics: "pd.DataFrame"
    broken: Mapping[str, tuple[str, ...]]

    @property
    def rank(self) -> tuple[int, float]:
        """Smaller is better: more plants on which it holds, then a smaller objective on nearly all."""
        return -self.held, self.high


class Hardening:
    """The best design so far and its certificate, and the last one that was tried, by which plants are exchanged."""

    def __init__(self, search: Search, nominal: TuningResult, plants: Scenarios) -> None:
        task = search.task
        self.search, self.nominal, self.plants = search, nominal, plants
        self._trial = PlantTrial(task.loop, task.references, search.space, plants, task.spec, task.accept)
        self._cases: Scenarios = MappingProxyType({})
        self.simulations = 0
        self.best = self.last = self.judge(end_point(nominal, search.space))
        self.result = nominal

    @property
    def is_enough(self) -> bool:
        """Whether the best design holds on so many plants that others like them will show the same."""
        return self.best.held >= ENOUGH_HELD * len(self.plants)

    def judge(self, point: Array) -> PlantRecord:
        """Simulate a design on all plants."""
        trial, spec = self._trial, self.search.spec
        shown = [name for name in METRICS if name in spec.metric_names]
        metrics, _ = worst_figures(trial.by_case(point), trial.plants, trial.steps, shown)
        broken = {n: words for n, words in trial.find_breaks(metrics).items() if words}
        objective = np.sort(np.append(self._objective(metrics), np.full(len(trial.restless), np.inf)))
        high = float(objective[math.ceil(HIGH_SHARE * len(objective)) - 1])
        return PlantRecord(point, len(self.plants) - len(broken), high, metrics, broken)

    def _objective(self, metrics: "pd.DataFrame") -> Array:
        values = self.search.spec.objective(requirement_values(_by_metric(metrics)))
        return np.where(np.isfinite(values), values, np.inf)

    def improve(self, points: Sequence[Array]) -> None:
        """Try designs on the plants, and certify those that are better than the best so far, until one is certified."""
        records = sorted(map(self.judge, points), key=lambda record: record.rank)
        self.last = records[0]
        for record in records[:MAX_CERTIFIED_POINTS]:
            if record.rank >= self.best.rank:
                return
            result = self.search.certify_point(record.point, agreement=self.nominal.agreement)
            if result.status.converged:
                self.best, self.result = record, result
                return

    def worst_plants(self) -> set[str]:
        """The plants on which the last design has the largest objective, fails, or breaks one of the limits most."""
        metrics, names = self.last.metrics, list(self.last.metrics.columns)
        values = _by_metric(metrics)
        refused = [n for n, defect in LANE_DEFECTS.items() if defect not in self.search.task.accept]
        failures = [np.where(np.isfinite(values[n]), 0.0, np.inf) for n in refused]
        shares = self.search.spec.excess(requirement_values(values)).values()
        excess = [np.where(np.isnan(share), np.inf, share) for share in shares]
        broken = [share for share in (*failures, *excess) if share.max() > 0]
        return {str(names[int(np.argmax(share))]) for share in (self._objective(metrics), *broken)}

    def exchange(self) -> Sequence[Array]:
        """Points of a short search that has the worst plants as cases; none where it had all of them before."""
        worst = {n: self.plants[n] for n in sorted(self.worst_plants())}
        if worst.keys() <= self._cases.keys():
            return ()
        self._cases = {**self._cases, **worst}
        search = self.search
        method = search.method.successor or search.method  # the first may know one plant only
        method = method.shorten(method.margin, EXCHANGE_SHARE)
        task = replace(search.task, scenarios={**search.task.scenarios, **self._cases})
        rests = any(Defect.NEVER_SETTLES.value in words for words in self.last.broken.values())
        found = Search(task, method, search.progress, search.rests or rests).find(method.margin, self.last.point, 0)
        self.simulations += found.simulations
        if not found.is_complete:
            raise KeyboardInterrupt
        return [found.point, *found.finalists]


def _by_metric(metrics: "pd.DataFrame") -> dict[str, Any]:
    return {str(n): row.to_numpy(dtype=float) for n, row in metrics.iterrows()}


@dataclass(frozen=True)
class Way:
    """A way to find designs, what is said while it is tried, and whether a design that holds makes it needless."""

    name: str
    doing: str
    propose: Callable[[Hardening], Sequence[Array]]
    is_rescue: bool = True


_EXCHANGE = "searching with the worst of them as cases"
ROBUST_WAYS = (
    Way("finalists", "trying the designs that are hardly worse", lambda state: list(state.nominal.finalists), False),
    Way("worst plants", _EXCHANGE, Hardening.exchange),
    Way("worst plants, again", _EXCHANGE, Hardening.exchange),
)


def harden(search: Search, nominal: TuningResult, plants: Scenarios) -> TuningResult:
    """The certified design that holds on most of the plants, with its price and the trail; perhaps the nominal one.

    `search` is the one that found the nominal design. Ctrl-C raises.
    """
    import pandas as pd

    begun = time.process_time()
    state, rows = Hardening(search, nominal, plants), list[dict[str, object]]()
    first = state.best

    def note(way: str) -> None:
        last, spent = state.last, time.process_time() - begun
        rows.append({"way": way, "held": last.held, "high": last.high, "best": state.best.held, "seconds": spent})

    note("nominal")
    for way in ROBUST_WAYS:
        if state.is_enough and way.is_rescue:
            break
        search.progress(f"a design holds on {state.best.held} of {len(plants)} plants; {way.doing}")
        points = way.propose(state)
        if len(points):
            state.improve(points)
            note(way.name)
        elif way.is_rescue:
            break
    stats, trail, names = (
        {**nominal.stats, **state.result.stats},
        pd.DataFrame(rows).set_index("way"),
        search.space.names,
    )
    if state.simulations:
        stats["simulations"] = stats.get("simulations", 0.0) + state.simulations
    result = replace(state.result, stats=stats, trail=trail)
    parameters = result.parameters
    if all(parameters.value(n) == nominal.parameters.value(n) for n in names):
        return replace(nominal, stats=stats, trail=trail)
    bounds = [n for n in names if parameters.value(n) in (parameters[n].lower, parameters[n].upper)]
    active = (*(str(n) for n, row in result.requirements.iterrows() if row["active"]), *bounds)
    price = describe_price(search.spec, nominal, result)
    words = f"{price}, which holds on {first.held} of {len(plants)} plants"
    return replace(result, active=active, status=result.status.with_details(words))


def describe_price(spec: Specification, nominal: TuningResult, found: TuningResult) -> str:
    """By how much a design's certified objective is worse than that of the nominal one, in words."""
    before, after = (certified_objective(spec, result) for result in (nominal, found))
    share = (after - before) / abs(before) if before else math.inf
    is_time = all(isinstance(q, SettlingTime | RiseTime) for q in spec.weights)
    worse, best = ("slower", "fastest") if is_time else ("worse", "best")
    if not math.isfinite(share):
        return f"{worse} than the {best} nominal design"
    return f"{100 * max(share, 0.0):.2g} % {worse} than the {best} nominal design"
