"""`pareto_front`: what one requirement costs in terms of another, as a table of certified designs.

By epsilon constraint: the first requirement is minimised for a row of limits on the second, from the design that is
best by the first to the one that is best by the second, which two full tunings find. Each design is the start of its
neighbours', in both directions, so that a branch of local minima that one end leads into is left for the other's; a
design that another beats, or one of many points spread over the gains' box, is searched for again from there.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import Requirement, bound, bounded, most, name, shown
from pneuopt.evaluation.scenarios import NOMINAL, Scenarios
from pneuopt.evaluation.specification import Specification, allowing
from pneuopt.quantities.errors import ConvergenceError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.solution import Code, Solution, Status
from pneuopt.tuning.relaxation import settling
from pneuopt.tuning.result import Found, TuningResult
from pneuopt.tuning.screening import first_population
from pneuopt.tuning.search import Method, Search, brief, ended_in
from pneuopt.tuning.simulator import each
from pneuopt.tuning.space import Tell
from pneuopt.tuning.tune import pose
from pneuopt.tuning.two_phase import TwoPhase, TwoPhasePath, two_phase_path

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
WIDE = 8.0  # ratio of the ends from which on the limits lie evenly in the logarithm
ROUNDS = 2  # of searching again for designs that others beat
SAMPLES = 2000  # points at which all requirements are read: branches that neither end leads to
BEATEN = 1e-3  # relative, by which another design has to be better
BESIDE = 1e-3  # weight of the other requirement at an end: of designs that are equally good, the best by the other


def pareto_front(
    loop: ClosedLoop,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    minimise: tuple[Requirement, Requirement],
    subject_to: Sequence[Requirement] = (),
    scenarios: Scenarios = NOMINAL,
    points: int = 15,
    until: float | None = None,
    method: Method | None = None,
    progress: Tell | None = None,
) -> "pd.DataFrame":
    """Designs that are best by one requirement for what they are by another.

    Parameters
    ----------
    loop, references, parameters, subject_to, scenarios, method, progress
        As for `tune`.
    minimise : (Requirement, Requirement)
        Two kinds; a bound of theirs is a limit as well, that of the second where the front begins.
    points : int
        Designs, the two ends included; at least 2.
    until : float, optional
        The bound of the second with which the front ends; by default the best that it can be.

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
    require(name(first) != name(second), f"both requirements are {name(first)}; a front needs two kinds")
    require(points >= 2, f"a front needs at least 2 points, got {points}")
    last = None if until is None else most(bounded(second, until))
    told = f"a front from {name(second)} {bound(second)} until {until} ends before it begins"
    require(last is None or last < most(second), told)
    both = pose(loop, references, parameters, {first: 1.0, second: 1.0}, subject_to, scenarios, method, progress)
    front = _Front(both, first, second, last)
    with suppress(KeyboardInterrupt):
        front.find(points)
    return front.frame()


@dataclass(frozen=True, eq=False)
class Design:
    """One point of a front.

    Attributes
    ----------
    limit : float
        On the second requirement, as `read` gives it.
    result : TuningResult or None
        None: not reached.
    seconds, solver_seconds : float
    """

    limit: float
    result: TuningResult | None = None
    seconds: float = 0.0
    solver_seconds: float = 0.0


@dataclass(eq=False)
class _Front:
    """A front in the making."""

    both: Search
    first: Requirement
    second: Requirement
    last: float | None
    designs: list[Design] = field(default_factory=list)

    def find(self, points: int) -> None:
        """All designs; again where one between the ends shows that an end was none."""
        self.designs = [Design(nan)] * points
        for k, q in ((0, self.first), (-1, self.second)):
            self.designs[k] = self._end(q)
        ends = [self.designs[0], self.designs[-1]]
        for _ in range(ROUNDS):
            done = self.designs
            try:
                self._between(ends, points)
            except KeyboardInterrupt:
                self.designs = max((self.designs, done), key=_count)
                raise
            better = [self._best(self.first), self._best(self.second)]
            if better == ends or len(self.designs) == 1:
                break
            pairs = zip((self.first, self.second), ends, better, strict=True)
            ends = [old if old is new else self._end(q, new.result) for q, old, new in pairs]

    def _best(self, requirement: Requirement) -> Design:
        """The best design by one requirement; an end unless another is clearly better."""
        end = self.designs[0 if requirement is self.first else -1]
        if requirement is self.second and self.last is not None:
            return end
        good = [d for d in self.designs if d.result is not None and d.result.status.converged]
        best = min(good, key=lambda d: _value(_found(d), requirement))
        return best if _value(_found(best), requirement) < _value(_found(end), requirement) * (1 - BEATEN) else end

    def _between(self, ends: list[Design], points: int) -> None:
        """What lies between the ends."""
        high, low = ends[0].limit, ends[1].limit
        if high <= low * (1 + BEATEN):
            self.designs = ends[:1]
            return
        self.designs = [ends[0], *(Design(limit) for limit in _spread(high, low, points)[1:-1]), ends[1]]
        if isinstance(self.both.method, TwoPhase):
            self._follow()
        else:
            for k, start in [(k, k - 1) for k in range(1, points - 1)] + [(k, k + 1) for k in range(points - 2, 0, -1)]:
                self._improve(k, self._gains(start))
        for _ in range(ROUNDS):
            for k in range(1, points - 1):
                better = self._rival(k)
                if better is not None:
                    self._improve(k, better)

    def frame(self) -> "pd.DataFrame":
        """What there is so far."""
        import pandas as pd

        return pd.DataFrame([self._row(design) for design in self.designs])

    def _end(self, requirement: Requirement, start: TuningResult | None = None) -> Design:
        """The best by one requirement, and of many such by the other."""
        begun, pair = time.perf_counter(), (self.first, self.second)
        weights = {q: self._weight(q) * (1.0 if q is requirement else BESIDE) for q in pair}
        spec = replace(self.both.spec, weights=weights, limits=settling(self.both.spec, self.both.notary.references))
        held = requirement is self.second and self.last is not None
        if self.last is not None and held:
            spec = self._limited(self.last)
        method, point = self.both.method, None
        if start is not None:  # a search over wide bands would lose it
            method, point = brief(method, method.margin), ended_in(start, self.both.space)
        result = _uninterrupted(self.both.asking(spec, method).run(point))
        if not result.status.converged:
            which = "at its last limit" if held else "as good as the limits allow"
            raise ConvergenceError(f"no front: its end, {name(requirement)} {which}, is {result.status}", result)
        limit = self.last if self.last is not None and held else _value(result, self.second)
        return Design(limit, result, time.perf_counter() - begun)

    def _weight(self, requirement: Requirement) -> float:
        """That makes a requirement of the order of the horizon, as the searches' penalties are."""
        horizon = min(r.horizon - r.at for r in self.both.notary.references)
        return horizon / self._sizes[name(requirement)] if self._sizes[name(requirement)] else 1.0

    @cached_property
    def _sizes(self) -> dict[str, float]:
        """What the requirements come to with the given gains; 0 where that is unknown."""
        space = self.both.space
        found = each(self.both.simulator.values(space.start[None], self.both.spec))[0]
        return {n: v if np.isfinite(v) and v > 0 else 0.0 for n, v in found.items()}

    def _limited(self, limit: float) -> Specification:
        """The first requirement to be minimised, the second held."""
        others = tuple(q for q in self.both.spec.limits if name(q) != name(self.second))
        weights = {self.first: self._weight(self.first)}
        return replace(self.both.spec, weights=weights, limits=(*others, allowing(self.second, limit)))

    def _follow(self) -> None:
        """With a solver along the limits; where what is found does not survive printing, again with more margin."""
        todo = list(range(1, len(self.designs) - 1))
        for margin in self._margins:
            asked = [self._search(k, self.both.method) for k in todo]
            found = self._tracked([own.tightened(margin) for own in asked]) if todo else []
            for k, own, solution in zip(todo, asked, found, strict=True):
                self._certify(k, own, solution, margin)
                self.both.tell(f"design {k + 1} of {len(self.designs)}: {_status(self.designs[k])}")
            todo = [k for k in todo if not _status(self.designs[k]).converged]

    @property
    def _margins(self) -> tuple[float, ...]:
        """Of the limits, one after the other where a design does not survive printing."""
        return tuple(self.both.method.margin * factor for factor in (1, 2, 4))

    @cached_property
    def _path(self) -> TwoPhasePath:
        """The problem, differentiated once, of which all designs are solutions."""
        method, search = self.both.method, self._search(1, self.both.method)
        assert isinstance(method, TwoPhase)
        spec, notary = search.tightened(method.margin), search.notary
        return two_phase_path(notary.loop, notary.references, search.space, spec, method)

    def _tracked(self, specs: Sequence[Specification]) -> list[Solution]:
        """From the first end; where the other end is on another branch, from there, too, and the better.

        Two tracks that agree next to the second end are one.
        """
        space, ends = self.both.space, [d.result for d in (self.designs[0], self.designs[-1]) if d.result]
        starts = [ended_in(result, space) for result in ends]
        found = self._path.follow(starts[0], specs)
        other = self._path.follow(starts[1], specs[-1:])
        if _cost(other[0]) < _cost(found[-1]) * (1 - BEATEN):
            other = self._path.follow(starts[1], specs[::-1])
        for k, back in zip(range(len(specs) - 1, -1, -1), other, strict=False):
            spent = found[k].stats["seconds"] + back.stats["seconds"]
            better = back if _cost(back) < _cost(found[k]) else found[k]
            found[k] = replace(better, stats={**better.stats, "seconds": spent})
        return found

    def _certify(self, k: int, search: Search, solution: Solution, margin: float) -> None:
        begun, old, spent = time.perf_counter(), self.designs[k], solution.stats["seconds"]
        result = self._printed(search, solution, margin)
        seconds = old.seconds + spent + time.perf_counter() - begun
        self.designs[k] = replace(old, result=result, seconds=seconds, solver_seconds=old.solver_seconds + spent)

    def _printed(self, search: Search, solution: Solution, margin: float) -> TuningResult:
        """A solution as printed, with its certificate."""
        if solution.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        point = np.array([solution.parameters.value(n) for n in search.space.names])
        found = Found(point, solution.status, tuple(solution.multipliers), {"optimum": solution.stats["cost"]})
        good = solution.status.converged
        return search.certified(found, margin) if good else search.notary.result(search.simulator, found, point)

    def _search(self, k: int, method: Method) -> Search:
        return self.both.asking(self._limited(self.designs[k].limit), method)

    def _improve(self, k: int, start: Array | None) -> None:
        """Search for a design from given gains; the better stays."""
        begun, old, follows = time.perf_counter(), self.designs[k], isinstance(self.both.method, TwoPhase)
        if follows and start is not None:
            result, spent = self._resolved(k, start)
        else:
            search, spent = self._search(k, brief(self.both.method, self.both.method.margin)), 0.0
            result = _uninterrupted(search.run(start))
        kept = old.result if old.result is not None and not self._is_better(result, old.result) else result
        seconds, solver_seconds = old.seconds + time.perf_counter() - begun, old.solver_seconds + spent
        self.designs[k] = replace(old, result=kept, seconds=seconds, solver_seconds=solver_seconds)
        self.both.tell(f"{name(self.second)} {shown(self.second, old.limit):.4g}: {result.status}")

    def _resolved(self, k: int, start: Array) -> tuple[TuningResult, float]:
        """The solver's answer from given gains, with more margin where it does not survive printing; its seconds."""
        search, spent, result = self._search(k, self.both.method), 0.0, None
        for margin in self._margins:
            (solution,) = self._path.follow(start, [search.tightened(margin)])
            result, spent = self._printed(search, solution, margin), spent + solution.stats["seconds"]
            if result.status.converged:
                break
        assert result is not None
        return result, spent

    def _is_better(self, one: TuningResult, other: TuningResult) -> bool:
        if not one.status.converged or not other.status.converged:
            return one.status.converged
        return _value(one, self.first) < _value(other, self.first)

    def _gains(self, k: int) -> Array | None:
        result = self.designs[k].result
        return None if result is None else ended_in(result, self.both.space)

    def _rival(self, k: int) -> Array | None:
        """The gains of what beats a design within its limit, another design or a sampled point; None without."""
        design, space = self.designs[k], self.both.space
        spec, own = self._limited(design.limit), np.inf
        if design.result is not None and design.result.status.converged:
            own = _value(design.result, self.first)
        found = [d.result for d in self.designs if d is not design and _status(d).converged and d.result is not None]
        rivals = {_value(r, self.first): ended_in(r, space) for r in found if _value(r, self.second) <= design.limit}
        points, rows = self._sampled
        rivals |= {v[name(self.first)]: x for x, v in zip(points, rows, strict=True) if not spec.violated(v)}
        least = min((v for v in rivals if np.isfinite(v)), default=np.inf)
        return rivals[least] if least < own * (1 - BEATEN) else None

    @cached_property
    def _sampled(self) -> tuple[Array, list[dict[str, float]]]:
        """Points spread over the gains' box, and what the requirements read there."""
        space, rng = self.both.space, np.random.default_rng(0)
        points = space.draw(first_population(SAMPLES, space.unit(space.start), rng))
        return points, each(self.both.simulator.values(points, self.both.spec))

    def _row(self, design: Design) -> dict[str, Any]:
        result, pair, space = design.result, (self.first, self.second), self.both.space
        good = result is not None and result.status.converged
        columns = {"": "certified", "claimed ": "claimed"}
        known = result.requirements if result is not None and good else None
        figures = {
            f"{lead}{name(q)}": nan if known is None else float(known[column][name(q)])
            for lead, column in columns.items()
            for q in pair
        }
        gains = {n: nan if result is None or not good else result.parameters.value(n) for n in space.names}
        costs = {"solver_seconds": design.solver_seconds, "seconds": design.seconds}
        error = "" if good else Code.INTERRUPTED.value if result is None else str(result.status)
        return {**figures, "limit": shown(self.second, design.limit), **gains, **costs, "error": error}


def _found(design: Design) -> TuningResult:
    assert design.result is not None
    return design.result


def _uninterrupted(result: TuningResult) -> TuningResult:
    """The same; Ctrl-C, which a search turns into its best so far, ends a front."""
    if result.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def _count(designs: Sequence[Design]) -> int:
    """How many of them are certified."""
    return sum(_status(design).converged for design in designs)


def _status(design: Design) -> Status:
    return Status(Code.INTERRUPTED) if design.result is None else design.result.status


def _cost(solution: Solution) -> float:
    """The objective; inf where it is no solution."""
    return solution.stats["cost"] if solution.status.converged else np.inf


def _value(result: TuningResult, requirement: Requirement) -> float:
    """The certified figure as `read` gives it, so that smaller is better."""
    return shown(requirement, float(result.requirements["certified"][name(requirement)]))  # its own inverse


def _spread(high: float, low: float, points: int) -> list[float]:
    """Limits from high to low, evenly or, where the ends are far apart, evenly in the logarithm."""
    even = np.geomspace if low > 0 and high / low > WIDE else np.linspace
    return [float(v) for v in even(high, low, points)]
