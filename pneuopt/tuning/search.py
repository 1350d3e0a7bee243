"""`Search`: one tuning from its start to a certified answer, or to how far its limits would have to give way."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.requirements import most, name, told
from pneuopt.evaluation.specification import Specification
from pneuopt.shooting.solution import Code, Status
from pneuopt.tuning.condensed import Condensed, condense
from pneuopt.tuning.confirmed import Confirmed, reconsidered
from pneuopt.tuning.relaxation import alone, row, together
from pneuopt.tuning.result import GRAZING, Found, Notary, TuningResult, missing, with_relaxations
from pneuopt.tuning.screening import Screening, merit, screen
from pneuopt.tuning.simulator import Simulator, each
from pneuopt.tuning.space import Space, Tell
from pneuopt.tuning.two_phase import TwoPhase, solve_two_phase

Array = NDArray[np.float64]
Method = TwoPhase | Screening | Condensed | Confirmed
ATTEMPTS = 3  # margins tried, each twice the one before
TRIED = 5  # printed gains certified at each margin, at most
ROUNDS = 3  # of looking around for printed gains that lose next to nothing
SLACK = 1e-4  # by which a search may end on the wrong side of a limit; the certificate decides
PEAKS_EXACT, PEAKS_SCREENED = 1 / 300, 1 / 5  # of the margin, for peak control and sensitivity
CLOSE = 0.002  # margin of the search for how far a limit has to give way: what it finds shall be the least


@dataclass(frozen=True, eq=False)
class Search:
    """One tuning: search, print, certify, and again with a wider margin where the certificate fails."""

    notary: Notary
    space: Space
    spec: Specification
    method: Method
    tell: Tell

    def run(self, start: Array | None = None) -> TuningResult:
        """The result, from a point other than the given gains where there is one."""
        simulator = self.simulator
        try:
            if start is None:
                self._tell_start(simulator)
        except KeyboardInterrupt:
            nothing = Found(self.space.start, Status(Code.INTERRUPTED), (), {"simulations": 1.0})
            return self._cut_short(simulator, nothing)
        result, start, counts = None, self.space.start if start is None else start, dict[str, float]()
        for attempt in range(ATTEMPTS):
            margin = min(self.method.margin * 2**attempt, 0.5)
            found = self._search(simulator, attempt, margin, start)
            counts = {k: v for k, v in found.stats.items() if k.startswith("starts")} | counts
            found = replace(found, stats={**found.stats, **counts, "margin": margin})
            if not found.is_complete:
                return self._cut_short(simulator, found)
            if not found.status.converged:
                return result or self.notary.result(simulator, found, found.point)
            result = self.certified(found, margin)
            if result.status.converged or "contacts" in result.stats:
                return result
            start = found.point
        assert result is not None
        return result

    @cached_property
    def simulator(self) -> Simulator:
        """Of all cases, that reads what is asked for."""
        notary = self.notary
        return Simulator(notary.loop, notary.references, self.space, notary.scenarios, self.spec)

    def _tell_start(self, simulator: Simulator) -> None:
        """Say where the given gains are no good: a search copes with that, but one may be mistyped."""
        times = [row["SettlingTime"] for row in simulator.table(self.space.start, self.spec)]
        bad = [k for k, t in enumerate(times) if not np.isfinite(t)]
        if bad:
            word = "runs away" if np.isinf(times[bad[0]]) else "never settles"
            where = f"{simulator.cases[bad[0]].label}, {len(bad)} of {len(times)} cases"
            self.tell(f"with the given gains the loop {word} at {where}; searching on")

    def certified(self, found: Found, margin: float) -> TuningResult:
        """What was found, as printed: the first of several roundings whose certificate holds, or the last."""
        result = None
        for point in self._printed(self.simulator, found, margin):
            result = self.notary.result(self.simulator, found, point)
            if result.status.converged or "contacts" in result.stats:
                break
        assert result is not None
        return result

    def judged(self, point: Array) -> TuningResult:
        """A point as printed, with its certificate."""
        printed = self.space.printed(point, self.method.digits) if self.method.digits else point
        found = Found(printed, Status(Code.CONVERGED), (), {"optimum": np.inf})
        return self.notary.result(self.simulator, found, printed)

    def asking(self, spec: Specification, method: Method) -> "Search":
        """The same for another specification, of the same kinds, on the same simulator."""
        other = replace(self, notary=replace(self.notary, spec=spec, method=method), spec=spec, method=method)
        vars(other)["simulator"] = self.simulator
        return other

    def _cut_short(self, simulator: Simulator, found: Found) -> TuningResult:
        """The best so far, as printed, with its certificate; not handed out, for nobody has chosen it."""
        digits = self.method.digits
        best = self.notary.result(simulator, found, self.space.printed(found.point, digits) if digits else found.point)
        verdict = f"{'holds' if best.status.converged else 'does not hold'}: {best.status.message}"
        count = f"{found.stats['simulations']:.0f} simulations"
        status = Status(Code.INTERRUPTED, f"the best of {count} so far {verdict}; run again for an answer")
        values = {f"rejected.{n}": best.parameters.value(n) for n in self.space.names if best.status.converged}
        return replace(best, parameters=self.space.parameters, status=status, stats={**values, **best.stats})

    def _search(self, simulator: Simulator, attempt: int, margin: float, start: Array) -> Found:
        if isinstance(self.method, TwoPhase):
            return self._two_phase(attempt, margin, start)
        return self._screen(simulator, margin, start)

    def _two_phase(self, attempt: int, margin: float, start: Array) -> Found:
        assert isinstance(self.method, TwoPhase)
        method = self.method if attempt == 0 else replace(self.method, starts=1)
        space = Space(self.space.filled(start), self.space.names)
        optima = solve_two_phase(
            self.notary.loop, self.notary.references, space, self.tightened(margin), method, self.tell
        )
        best, values = optima.best, optima.best.parameters
        stats = {
            "starts": float(optima.starts),
            "starts_converged": float(optima.converged),
            "starts_agreeing": float(optima.agreeing),
            "optimum": best.stats.get("cost", np.nan),
            "iterations": best.stats.get("iterations", 0.0),
        }
        point = np.array([values.value(n) for n in self.space.names])
        return Found(point, best.status, tuple(best.multipliers), stats)

    def tightened(self, margin: float) -> Specification:
        """An exact problem needs next to no room on peaks; a screening's coarser simulation needs some."""
        return self.spec.tightened(
            margin, margin * (PEAKS_EXACT if isinstance(self.method, TwoPhase) else PEAKS_SCREENED)
        )

    def _screen(self, simulator: Simulator, margin: float, start: Array) -> Found:
        assert not isinstance(self.method, TwoPhase)
        spec = self.tightened(margin)
        arguments = (simulator, self.notary.references, self.space, spec)
        method = self.method.first if isinstance(self.method, Confirmed) else self.method
        if isinstance(method, Condensed):
            found = condense(*arguments, method, start, self.tell)
        else:
            found = screen(*arguments, method, start, self.tell)
        values = each(simulator.values(found.point[None], spec))[0]
        stats, status = {"simulations": float(found.count)}, _screened(self.spec, values)
        point, text = found.point, ""
        if isinstance(self.method, Confirmed) and status.converged and found.is_complete:
            self.tell("full-space multiple shooting from the search's answer")
            point, text = reconsidered(simulator, self.notary.references, spec, self.method, point, values)
            values = each(simulator.values(point[None], spec))[0]
        stats["optimum"] = spec.objective(values)
        active = _active(self.space, spec, point, values)
        return Found(point, status, active, stats, found.is_complete, text)

    def _printed(self, simulator: Simulator, found: Found, margin: float) -> Iterator[Array]:
        """The gains as printed; where those break a limit or lose too much, what a last place more or less mends."""
        digits, spec, tried = self.method.digits, self.tightened(margin / 2), list[list[float]]()
        if digits is None:
            yield found.point
            return
        scale = min(r.horizon - r.at for r in self.notary.references)
        nearest = self.space.printed(found.point, digits)
        points, most = nearest[None], found.stats["optimum"] * (1 + GRAZING)
        for _ in range(ROUNDS):
            values = simulator.values(points, spec)
            order, rows = np.argsort(merit(values, spec, scale)), each(values)
            for k in order.tolist():
                good = not spec.violated(rows[k]) and spec.objective(rows[k]) <= most
                if good and len(tried) < TRIED and points[k].tolist() not in tried:
                    tried.append(points[k].tolist())
                    yield points[k]
            points = self.space.neighbours(points[order[0]], digits)
            if not len(points):
                break
        if not tried:
            yield from self._mended(nearest, digits, spec, most)

    def _mended(self, nearest: Array, digits: int, spec: Specification, most: float) -> Iterator[Array]:
        """Where no single last place mends it: of all printed gains close by those that do, the best first."""
        points = np.vstack([nearest, self.space.around(nearest, digits)])
        rows = each(self.simulator.values(points, spec))
        costs = [np.inf if spec.violated(row) else spec.objective(row) for row in rows]
        order = [k for k in np.argsort(costs).tolist() if costs[k] <= most][:TRIED]
        yield from points[order or [0]]


def relax(search: Search, result: TuningResult) -> TuningResult:
    """Say how far the limits have to give way, each alone and all together.

    Where it turns out that a design keeps them all, which a search with its margins can miss, that is the answer.
    """
    spec, points, rows = search.spec, [ended_in(result, search.space)], dict[str, dict[str, float]]()
    method = brief(search.method, CLOSE)
    for q in spec.limits:
        search.tell(f"how far {name(q)} would have to give way alone")
        found = search.asking(alone(spec, q, search.notary.references), method).run(points[0])
        if found.status.code is Code.INTERRUPTED:
            return result
        points.append(ended_in(found, search.space))
        value = float(found.requirements["certified"][name(q)]) if found.status.converged else np.nan
        rows[name(q)] = row(q, value, points[-1], search.space.names)
        if rows[name(q)]["share"] <= 0:
            return _kept(search, points[-1])
    search.tell("how far all limits would have to give way together")
    inside = spec.with_band(spec.band * (1 - search.method.margin))
    shared = together(search.simulator, search.space, inside, points)
    judged = min((search.judged(point) for point in (shared, *points)), key=missing)
    if judged.status.converged:
        return _kept(search, ended_in(judged, search.space))
    if len(rows) > 1:
        rows["all"] = row(None, missing(judged), ended_in(judged, search.space), search.space.names)
    return with_relaxations(replace(judged, stats={**result.stats, **judged.stats}), rows)


def brief(method: Method, margin: float) -> TwoPhase | Screening:
    """A short search from a point that is close."""
    if isinstance(method, TwoPhase):
        return replace(method, starts=2, margin=margin, solver=replace(method.solver, max_iterations=150))
    return Screening(24, 8, (), 200, margin, digits=method.digits)


def _kept(search: Search, point: Array) -> TuningResult:
    """The best from a design that keeps all limits; or that design, where the margins leave no room for a search."""
    found = search.run(point)
    return found if found.status.converged else search.judged(point)


def ended_in(result: TuningResult, space: Space) -> Array:
    """The point that a search ended in, whether it was handed out or not."""
    return np.array([result.stats.get(f"rejected.{n}", result.parameters.value(n)) for n in space.names])


def _screened(spec: Specification, values: Mapping[str, float]) -> Status:
    """What a screening achieved: it keeps the limits, or the closest it came."""
    broken = [f"{name(q)} {', '.join(told(q, values[name(q)]))}" for q in spec.violated(values, SLACK)]
    if broken:
        return Status(Code.INFEASIBLE, f"the closest found has {'; '.join(broken)}; relax a limit or widen the bounds")
    if not np.isfinite(spec.objective(values)):
        return Status(
            Code.NOT_CONVERGED, "nothing found settles; widen the band or the bounds, or lengthen the horizon"
        )
    return Status(Code.CONVERGED)


def _active(space: Space, spec: Specification, point: Array, values: Mapping[str, float]) -> tuple[str, ...]:
    """Limits within 2 % of being reached, gains within 0.1 % of their range of a bound."""
    limits = [name(q) for q in spec.limits if values[name(q)] >= 0.98 * most(q)]
    low, up = space.bounds.T
    near = np.minimum(point - low, up - point) <= 1e-3 * (up - low)
    return (*limits, *(n for n, held in zip(space.names, near, strict=True) if held))
