"""`pareto_front`: what one requirement costs in terms of another, as a table of certified designs.

The first requirement is minimised under a row of limits on the second, between the design that is best by the first and
the one that is best by the second (epsilon constraint); two full tunings find these ends. Each design is a start for
both of its neighbours, so that the better of the two branches of local minima, one from either end, is kept. Where
another design, or one of many points spread over the gains' box, is better within a design's limit, that design is
searched for again from there.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.tolerances import MAX_STEPS
from pneuopt.evaluation.requirements import (
    Requirement,
    metric_name,
    upper_limit,
    user_limit,
    user_value,
    with_upper_limit,
    with_user_limit,
)
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Progress, ProgressReporter, Status
from pneuopt.shooting.full_space import Solution
from pneuopt.tuning.method import LimitPath, Method, SearchResult
from pneuopt.tuning.racing import first_population
from pneuopt.tuning.relaxation import limits_with_settling
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.search import Search, end_point
from pneuopt.tuning.simulator import to_records
from pneuopt.tuning.tolerances import (
    LEAST_IMPROVEMENT,
    LOG_SPACING_RATIO,
    MAX_IMPROVEMENT_ROUNDS,
    RIVAL_SAMPLES,
    SECONDARY_WEIGHT,
)
from pneuopt.tuning.tune import prepare_search, prepare_task

if TYPE_CHECKING:
    import pandas as pd


def pareto_front(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: tuple[Requirement, Requirement],
    subject_to: Sequence[Requirement] = (),
    scenarios: Scenarios = NO_SCENARIOS,
    points: int = 15,
    until: float | None = None,
    max_steps: float = MAX_STEPS,
    method: Method | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> "pd.DataFrame":
    """Tune for every compromise between two requirements: designs none of which is better than another by both.

    Parameters
    ----------
    loop, references, parameters, subject_to, scenarios, max_steps, method, progress
        As for `tune`.
    minimise : (Requirement, Requirement)
        Two kinds; a bound of theirs is a limit as well, and with that of the second the front begins.
    points : int
        Number of designs, the two ends included; at least 2.
    until : float, optional
        The bound of the second with which the front ends; by default the best value that it can have.

    Returns
    -------
    DataFrame
        A row a design, from the best by the first requirement to the best by the second. Columns: both requirements'
        names, certified, the worst over references and scenarios, as the user writes them (a fraction where
        `Overshoot.max` is one); "claimed" and a name, by the search; "limit", what the second was held to; the gains;
        "solver_seconds", where a solver follows the front of a linear loop; "seconds"; "error", empty where the
        design is certified, else the reason, and the figures are missing. One row where one design is best by both.
        Ctrl-C leaves the designs found so far, the others as rows with the reason "interrupted".

    Raises
    ------
    InputError
        As `tune`; if both requirements are of one kind, or the front would end before it begins.
    ConvergenceError
        If an end of the front cannot be found; `solution` is its `TuningResult`.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.evaluation.requirements import PeakControl, SettlingTime
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> given = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 50.0})
    >>> given = given.with_bounds({"pid.Kp": (1.0, 20.0), "pid.Ki": (10.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    >>> front = pareto_front(loop, Step(1.0), given, minimise=(SettlingTime(), PeakControl()), points=4)
    >>> bool(front["SettlingTime"].is_monotonic_increasing), bool(front["PeakControl"].is_monotonic_decreasing)
    (True, True)
    """
    first, second = minimise
    require(
        metric_name(first) != metric_name(second),
        f"both requirements are {metric_name(first)}; a front needs two kinds",
    )
    require(points >= 2, f"a front needs at least 2 points, got {points}")
    last = None if until is None else upper_limit(with_user_limit(second, until))
    message = f"a front from {metric_name(second)} {user_limit(second)} until {until} ends before it begins"
    require(last is None or last < upper_limit(second), message)
    spec = specify({first: 1.0, second: 1.0}, subject_to)
    task = prepare_task(loop, references, parameters, spec, scenarios, max_steps=max_steps)
    both = prepare_search(task, method, ProgressReporter(progress, "pareto_front"))
    front = Front(both, first, second, last)
    with suppress(KeyboardInterrupt):
        front.find_designs(points)
    return front.to_frame()


@dataclass(frozen=True, eq=False)
class Design:
    """One point of a front: its limit on the second requirement, as `Specification.limit` counts, and its cost [s]."""

    limit: float
    result: TuningResult | None = None
    seconds: float = 0.0
    solver_seconds: float = 0.0


@dataclass(eq=False)
class Front:
    """The designs of a front while they are searched for, from the best by the first requirement on.

    `last` is the limit on the second with which the front ends, as `upper_limit` counts; None: the best possible.
    """

    base_search: Search
    first: Requirement
    second: Requirement
    last: float | None
    designs: list[Design] = field(default_factory=list)

    def find_designs(self, points: int) -> None:
        """Find all designs; repeat with new ends where a design between them is better than an end."""
        self.designs = [Design(nan)] * points
        for k, q in ((0, self.first), (-1, self.second)):
            self.designs[k] = self._find_end(q)
        ends = [self.designs[0], self.designs[-1]]
        for _ in range(MAX_IMPROVEMENT_ROUNDS):
            done = self.designs
            try:
                self._fill_between(ends, points)
            except KeyboardInterrupt:
                self.designs = max((self.designs, done), key=lambda designs: sum(map(_is_certified, designs)))
                raise
            better = [self._best(self.first), self._best(self.second)]
            if better == ends or len(self.designs) == 1:
                break
            pairs = zip((self.first, self.second), ends, better, strict=True)
            ends = [old if old is new else self._find_end(q, new.result) for q, old, new in pairs]

    def _best(self, requirement: Requirement) -> Design:
        """The best design by one requirement; an end unless another is clearly better."""
        end = self.designs[0 if requirement is self.first else -1]
        if requirement is self.second and self.last is not None:
            return end
        good = [d for d in self.designs if d.result is not None and d.result.status.converged]
        best = min(good, key=lambda d: _result_value(_result_of(d), requirement))
        return (
            best
            if _result_value(_result_of(best), requirement)
            < _result_value(_result_of(end), requirement) * (1 - LEAST_IMPROVEMENT)
            else end
        )

    def _fill_between(self, ends: list[Design], points: int) -> None:
        """Find the designs between two ends."""
        high, low = ends[0].limit, ends[1].limit
        if high <= low * (1 + LEAST_IMPROVEMENT):
            self.designs = ends[:1]
            return
        even = np.geomspace if low > 0 and high / low > LOG_SPACING_RATIO else np.linspace
        self.designs = [ends[0], *(Design(limit) for limit in even(high, low, points)[1:-1].tolist()), ends[1]]
        if points > 2 and self._path is not None:
            self._follow(self._path)
        else:
            for k, start in [(k, k - 1) for k in range(1, points - 1)] + [(k, k + 1) for k in range(points - 2, 0, -1)]:
                result = self.designs[start].result
                self._improve(k, None if result is None else end_point(result, self.base_search.space))
        for _ in range(MAX_IMPROVEMENT_ROUNDS):
            for k in range(1, points - 1):
                better = self._rival(k)
                if better is not None:
                    self._improve(k, better)

    def to_frame(self) -> "pd.DataFrame":
        """The table of the designs found so far; see `pareto_front`."""
        import pandas as pd

        pair, rows = (self.first, self.second), list[dict[str, Any]]()
        for design in self.designs:
            result = design.result
            known = result if result is not None and result.status.converged else None
            figures = {
                f"{lead}{metric_name(q)}": nan if known is None else float(known.requirements[column][metric_name(q)])
                for lead, column in (("", "certified"), ("claimed ", "claimed"))
                for q in pair
            }
            gains = {n: nan if known is None else known.parameters.value(n) for n in self.base_search.space.names}
            costs = {"solver_seconds": design.solver_seconds, "seconds": design.seconds}
            error = "" if known else Code.INTERRUPTED.value if result is None else str(result.status)
            limit = user_value(self.second, design.limit)
            rows.append({**figures, "limit": limit, **gains, **costs, "error": error})
        return pd.DataFrame(rows)

    def _find_end(self, requirement: Requirement, start: TuningResult | None = None) -> Design:
        """Find the design that is best by one requirement; among equals the one that is best by the other."""
        begun, pair = time.perf_counter(), (self.first, self.second)
        weights = {q: self._weight(q) * (1.0 if q is requirement else SECONDARY_WEIGHT) for q in pair}
        spec = replace(
            self.base_search.spec,
            weights=weights,
            limits=limits_with_settling(self.base_search.spec, self.base_search.task.references),
        )
        held = requirement is self.second and self.last is not None
        if self.last is not None and held:
            spec = self._constrain_second(self.last)
        method, point = self.base_search.method, None
        if start is not None:  # a search over wide bands would lose it
            method, point = method.shorten(method.margin), end_point(start, self.base_search.space)
        result = _check_interruption(self.base_search.with_specification(spec, method).run(point))
        if not result.status.converged:
            which = "at its last limit" if held else "as good as the limits allow"
            raise ConvergenceError(f"no front: its end, {metric_name(requirement)} {which}, is {result.status}", result)
        limit = self.last if self.last is not None and held else _result_value(result, self.second)
        return Design(limit, result, time.perf_counter() - begun)

    def _weight(self, requirement: Requirement) -> float:
        """The weight that scales a requirement to the size of the horizon, as the searches' penalties are."""
        horizon = min(r.horizon - r.at for r in self.base_search.task.references)
        return (
            horizon / self._requirement_scales[metric_name(requirement)]
            if self._requirement_scales[metric_name(requirement)]
            else 1.0
        )

    @cached_property
    def _requirement_scales(self) -> dict[str, float]:
        """The requirements' values with the given gains; 0 where they are infinite or not positive."""
        space = self.base_search.space
        found = to_records(self.base_search.simulator.values(space.start[None], self.base_search.spec))[0]
        return {n: v if np.isfinite(v) and v > 0 else 0.0 for n, v in found.items()}

    def _constrain_second(self, limit: float) -> Specification:
        """The specification that minimises the first requirement under a limit on the second."""
        others = tuple(q for q in self.base_search.spec.limits if metric_name(q) != metric_name(self.second))
        weights = {self.first: self._weight(self.first)}
        return replace(self.base_search.spec, weights=weights, limits=(*others, with_upper_limit(self.second, limit)))

    def _follow(self, path: LimitPath) -> None:
        """Solve for all designs along the limits; those that rounding makes infeasible again with more margin."""
        todo = list(range(1, len(self.designs) - 1))
        for margin in self._margins:
            asked = [self._search_for(k, self.base_search.method) for k in todo]
            found = self._track(path, [own.tighten(margin) for own in asked]) if todo else []
            for k, own, solution in zip(todo, asked, found, strict=True):
                begun, old, spent = time.perf_counter(), self.designs[k], solution.seconds
                result = self._round_and_certify(own, solution, margin)
                seconds, spent = old.seconds + spent + time.perf_counter() - begun, old.solver_seconds + spent
                self.designs[k] = replace(old, result=result, seconds=seconds, solver_seconds=spent)
                self.base_search.progress(f"design {k + 1} of {len(self.designs)}: {_design_status(self.designs[k])}")
            todo = [k for k in todo if not _is_certified(self.designs[k])]

    @property
    def _margins(self) -> tuple[float, ...]:
        """Margins of the limits, the next one for designs that rounding makes infeasible."""
        return tuple(self.base_search.method.margin * factor for factor in (1, 2, 4))

    @cached_property
    def _path(self) -> LimitPath | None:
        """The problem, prepared once, whose solutions are the designs; None where each design needs a search."""
        search = self._search_for(1, self.base_search.method)
        return search.method.limit_path(search.task, search.tighten(search.method.margin))

    def _track(self, path: LimitPath, specs: Sequence[Specification]) -> list[Solution]:
        """Follow the solutions from the first end, and from the second where that one lies on a better branch.

        Next to the second end the two are compared; if they agree, there is one branch, and the first track stands.
        """
        space, ends = self.base_search.space, [d.result for d in (self.designs[0], self.designs[-1]) if d.result]
        starts = [end_point(result, space) for result in ends]
        found = path.follow(starts[0], specs)
        other = path.follow(starts[1], specs[-1:])
        if _solution_cost(other[0]) < _solution_cost(found[-1]) * (1 - LEAST_IMPROVEMENT):
            other = path.follow(starts[1], specs[::-1])
        for k, back in zip(range(len(specs) - 1, -1, -1), other, strict=False):
            spent = found[k].seconds + back.seconds
            better = back if _solution_cost(back) < _solution_cost(found[k]) else found[k]
            found[k] = replace(better, seconds=spent)
        return found

    def _round_and_certify(self, search: Search, solution: Solution, margin: float) -> TuningResult:
        """Round a solution's gains and certify them."""
        if solution.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        point = np.array([solution.parameters.value(n) for n in search.space.names])
        found = SearchResult(point, solution.status, tuple(solution.multipliers), optimum=solution.cost)
        good = solution.status.converged
        return (
            search.certify_roundings(found, margin)
            if good
            else search.certifier.certify(search.simulator, found, point)
        )

    def _search_for(self, k: int, method: Method) -> Search:
        """The search for design k."""
        return self.base_search.with_specification(self._constrain_second(self.designs[k].limit), method)

    def _improve(self, k: int, start: Array | None) -> None:
        """Search for design k from given gains; it replaces the present one if it is better."""
        begun, old, path, spent = time.perf_counter(), self.designs[k], self._path, 0.0
        method = self.base_search.method
        if path is None or start is None:
            result = _check_interruption(self._search_for(k, method.shorten(method.margin)).run(start))
        else:
            search = self._search_for(k, method)
            for margin in self._margins:  # more of it where rounding makes the solution infeasible
                (solution,) = path.follow(start, [search.tighten(margin)])
                result, spent = self._round_and_certify(search, solution, margin), spent + solution.seconds
                if result.status.converged:
                    break
        before, kept = old.result, result
        if before is not None and not result.status.converged:
            kept = before
        elif before is not None and before.status.converged:
            kept = min((before, result), key=lambda each: _result_value(each, self.first))
        seconds, solver_seconds = old.seconds + time.perf_counter() - begun, old.solver_seconds + spent
        self.designs[k] = replace(old, result=kept, seconds=seconds, solver_seconds=solver_seconds)
        self.base_search.progress(
            f"{metric_name(self.second)} {user_value(self.second, old.limit):.4g}: {result.status}"
        )

    def _rival(self, k: int) -> Array | None:
        """The gains of another design or sampled point that beats design k within its limit; None if there is none."""
        design, space = self.designs[k], self.base_search.space
        spec, own = self._constrain_second(design.limit), np.inf
        if design.result is not None and design.result.status.converged:
            own = _result_value(design.result, self.first)
        found = [d.result for d in self.designs if d is not design and _is_certified(d) and d.result is not None]
        rivals = {
            _result_value(r, self.first): end_point(r, space)
            for r in found
            if _result_value(r, self.second) <= design.limit
        }
        points, rows = self._samples
        rivals |= {v[metric_name(self.first)]: x for x, v in zip(points, rows, strict=True) if not spec.violations(v)}
        least = min((v for v in rivals if np.isfinite(v)), default=np.inf)
        return rivals[least] if least < own * (1 - LEAST_IMPROVEMENT) else None

    @cached_property
    def _samples(self) -> tuple[Array, list[dict[str, float]]]:
        """Points spread over the gains' box, and the requirements' values there."""
        space, rng = self.base_search.space, np.random.default_rng(0)
        points = space.from_unit(first_population(RIVAL_SAMPLES, space.to_unit(space.start), rng))
        return points, to_records(self.base_search.simulator.values(points, self.base_search.spec))


def _result_of(design: Design) -> TuningResult:
    """The result of a design that has one."""
    assert design.result is not None
    return design.result


def _check_interruption(result: TuningResult) -> TuningResult:
    """Raise KeyboardInterrupt for a search that Ctrl-C ended with its best so far, so that the front ends, too."""
    if result.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def _is_certified(design: Design) -> bool:
    return _design_status(design).converged


def _design_status(design: Design) -> Status:
    """The status of a design's result; interrupted where there is none yet."""
    return Status(Code.INTERRUPTED) if design.result is None else design.result.status


def _solution_cost(solution: Solution) -> float:
    """The objective of a solution; infinite where the solver did not converge."""
    return solution.cost if solution.status.converged else np.inf


def _result_value(result: TuningResult, requirement: Requirement) -> float:
    """The certified figure as a search counts it: smaller is better, a margin as its reciprocal."""
    figure = float(result.requirements["certified"][metric_name(requirement)])
    return user_value(requirement, figure)  # the conversion is the same in both directions
