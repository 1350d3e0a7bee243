"""`Search`: one tuning from its start to a certified answer, or to how far its limits would have to give way."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pneuopt.evaluation.requirements import describe_value, metric_name, upper_limit
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.tuning.condensed import Condensed, run_gradient_search
from pneuopt.tuning.confirmed import Confirmed, confirm
from pneuopt.tuning.relaxation import relax_all, relaxation_row, relaxation_specification
from pneuopt.tuning.result import (
    MAX_CERTIFIED_EXCESS,
    Certifier,
    SearchResult,
    TuningResult,
    relaxation_share,
    with_relaxations,
)
from pneuopt.tuning.screening import Screening, merit, run_screening
from pneuopt.tuning.simulator import Simulator, to_records
from pneuopt.tuning.space import Space
from pneuopt.tuning.two_phase import TwoPhase, solve_two_phase

Method = TwoPhase | Screening | Condensed | Confirmed
MARGINS_TO_TRY = 3  # margins tried, each twice the one before
MAX_CERTIFIED_POINTS = 5  # printed gains certified at each margin, at most
ROUNDING_ROUNDS = 3  # of looking around for printed gains that lose next to nothing
LIMIT_TOLERANCE = 1e-4  # by which a search may end on the wrong side of a limit; the certificate decides
EXACT_PEAK_MARGIN, SCREENING_PEAK_MARGIN = 1 / 300, 1 / 5  # of the margin, for peak control and sensitivity
RELAXATION_MARGIN = 0.002  # margin of the search for how far a limit has to give way: what it finds shall be the least


@dataclass(frozen=True, eq=False)
class Search:
    """One tuning: search, print, certify, and again with a wider margin where the certificate fails."""

    certifier: Certifier
    space: Space
    spec: Specification
    method: Method
    progress: ProgressCallback

    def run(self, start: Array | None = None) -> TuningResult:
        """The result, from a point other than the given gains where there is one."""
        simulator = self.simulator
        try:
            if start is None:
                self._report_start(simulator)
        except KeyboardInterrupt:
            nothing = SearchResult(self.space.start, Status(Code.INTERRUPTED), (), {"simulations": 1.0})
            return self._result_so_far(simulator, nothing)
        result, start, counts = None, self.space.start if start is None else start, dict[str, float]()
        for attempt in range(MARGINS_TO_TRY):
            margin = min(self.method.margin * 2**attempt, 0.5)
            found = self._search(simulator, attempt, margin, start)
            counts = {k: v for k, v in found.stats.items() if k.startswith("starts")} | counts
            found = replace(found, stats={**found.stats, **counts, "margin": margin})
            if not found.is_complete:
                return self._result_so_far(simulator, found)
            if not found.status.converged:
                return result or self.certifier.certify(simulator, found, found.point)
            result = self.certify_roundings(found, margin)
            if result.status.converged or "contacts" in result.stats:
                return result
            start = found.point
        assert result is not None
        return result

    @cached_property
    def simulator(self) -> Simulator:
        """Of all cases, that reads what is asked for."""
        notary = self.certifier
        return Simulator(notary.loop, notary.references, self.space, notary.scenarios, self.spec)

    def _report_start(self, simulator: Simulator) -> None:
        """Say where the given gains are no good: a search copes with that, but one may be mistyped."""
        times = [row["SettlingTime"] for row in simulator.table(self.space.start, self.spec)]
        bad = [k for k, t in enumerate(times) if not np.isfinite(t)]
        if bad:
            word = "runs away" if np.isinf(times[bad[0]]) else "never settles"
            where = f"{simulator.cases[bad[0]].label}, {len(bad)} of {len(times)} cases"
            self.progress(f"with the given gains the loop {word} at {where}; searching on")

    def certify_roundings(self, found: SearchResult, margin: float) -> TuningResult:
        """What was found, as printed: the first of several roundings whose certificate holds, or the last."""
        result = None
        for point in self._round_gains(self.simulator, found, margin):
            result = self.certifier.certify(self.simulator, found, point)
            if result.status.converged or "contacts" in result.stats:
                break
        assert result is not None
        return result

    def certify_point(self, point: Array) -> TuningResult:
        """A point as printed, with its certificate."""
        printed = self.space.round_point(point, self.method.digits) if self.method.digits else point
        found = SearchResult(printed, Status(Code.CONVERGED), (), {"optimum": np.inf})
        return self.certifier.certify(self.simulator, found, printed)

    def with_specification(self, spec: Specification, method: Method) -> "Search":
        """The same for another specification, of the same kinds, on the same simulator."""
        other = replace(self, certifier=replace(self.certifier, spec=spec, method=method), spec=spec, method=method)
        vars(other)["simulator"] = self.simulator
        return other

    def _result_so_far(self, simulator: Simulator, found: SearchResult) -> TuningResult:
        """The best so far, as printed, with its certificate; not handed out, for nobody has chosen it."""
        digits = self.method.digits
        best = self.certifier.certify(
            simulator, found, self.space.round_point(found.point, digits) if digits else found.point
        )
        verdict = f"{'holds' if best.status.converged else 'does not hold'}: {best.status.message}"
        count = f"{found.stats['simulations']:.0f} simulations"
        status = Status(Code.INTERRUPTED, f"the best of {count} so far {verdict}; run again for an answer")
        values = {f"rejected.{n}": best.parameters.value(n) for n in self.space.names if best.status.converged}
        return replace(best, parameters=self.space.parameters, status=status, stats={**values, **best.stats})

    def _search(self, simulator: Simulator, attempt: int, margin: float, start: Array) -> SearchResult:
        if isinstance(self.method, TwoPhase):
            return self._solve_two_phase(attempt, margin, start)
        return self._search_by_simulation(simulator, margin, start)

    def _solve_two_phase(self, attempt: int, margin: float, start: Array) -> SearchResult:
        assert isinstance(self.method, TwoPhase)
        method = self.method if attempt == 0 else replace(self.method, starts=1)
        space = Space(self.space.parameters_at(start), self.space.names)
        optima = solve_two_phase(
            self.certifier.loop, self.certifier.references, space, self.tighten(margin), method, self.progress
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
        return SearchResult(point, best.status, tuple(best.multipliers), stats)

    def tighten(self, margin: float) -> Specification:
        """An exact problem needs next to no room on peaks; a screening's coarser simulation needs some."""
        return self.spec.tighten(
            margin, margin * (EXACT_PEAK_MARGIN if isinstance(self.method, TwoPhase) else SCREENING_PEAK_MARGIN)
        )

    def _search_by_simulation(self, simulator: Simulator, margin: float, start: Array) -> SearchResult:
        assert not isinstance(self.method, TwoPhase)
        spec = self.tighten(margin)
        arguments = (simulator, self.certifier.references, self.space, spec)
        method = self.method.first if isinstance(self.method, Confirmed) else self.method
        if isinstance(method, Condensed):
            found = run_gradient_search(*arguments, method, start, self.progress)
        else:
            found = run_screening(*arguments, method, start, self.progress)
        values = to_records(simulator.values(found.point[None], spec))[0]
        stats, status = {"simulations": float(found.count)}, _screening_status(self.spec, values)
        point, text = found.point, ""
        if isinstance(self.method, Confirmed) and status.converged and found.is_complete:
            self.progress("full-space multiple shooting from the search's answer")
            point, text = confirm(simulator, self.certifier.references, spec, self.method, point, values)
            values = to_records(simulator.values(point[None], spec))[0]
        stats["optimum"] = spec.objective(values)
        active = _active_limits(self.space, spec, point, values)
        return SearchResult(point, status, active, stats, found.is_complete, text)

    def _round_gains(self, simulator: Simulator, found: SearchResult, margin: float) -> Iterator[Array]:
        """The gains as printed; where those break a limit or lose too much, what a last place more or less mends."""
        digits, spec, tried = self.method.digits, self.tighten(margin / 2), list[list[float]]()
        if digits is None:
            yield found.point
            return
        scale = min(r.horizon - r.at for r in self.certifier.references)
        nearest = self.space.round_point(found.point, digits)
        points, most = nearest[None], found.stats["optimum"] * (1 + MAX_CERTIFIED_EXCESS)
        for _ in range(ROUNDING_ROUNDS):
            values = simulator.values(points, spec)
            order, rows = np.argsort(merit(values, spec, scale)), to_records(values)
            for k in order.tolist():
                good = not spec.violations(rows[k]) and spec.objective(rows[k]) <= most
                if good and len(tried) < MAX_CERTIFIED_POINTS and points[k].tolist() not in tried:
                    tried.append(points[k].tolist())
                    yield points[k]
            points = self.space.neighbours(points[order[0]], digits)
            if not len(points):
                break
        if not tried:
            yield from self._mend_rounding(nearest, digits, spec, most)

    def _mend_rounding(self, nearest: Array, digits: int, spec: Specification, most: float) -> Iterator[Array]:
        """Where no single last place mends it: of all printed gains close by those that do, the best first."""
        points = np.vstack([nearest, self.space.neighbourhood(nearest, digits)])
        rows = to_records(self.simulator.values(points, spec))
        costs = [np.inf if spec.violations(row) else spec.objective(row) for row in rows]
        order = [k for k in np.argsort(costs).tolist() if costs[k] <= most][:MAX_CERTIFIED_POINTS]
        yield from points[order or [0]]


def relax(search: Search, result: TuningResult) -> TuningResult:
    """Say how far the limits have to give way, each alone and all together.

    Where it turns out that a design keeps them all, which a search with its margins can miss, that is the answer.
    """
    spec, points, rows = search.spec, [end_point(result, search.space)], dict[str, dict[str, float]]()
    method = short_method(search.method, RELAXATION_MARGIN)
    for q in spec.limits:
        search.progress(f"how far {metric_name(q)} would have to give way alone")
        found = search.with_specification(relaxation_specification(spec, q, search.certifier.references), method).run(
            points[0]
        )
        if found.status.code is Code.INTERRUPTED:
            return result
        points.append(end_point(found, search.space))
        value = float(found.requirements["certified"][metric_name(q)]) if found.status.converged else np.nan
        rows[metric_name(q)] = relaxation_row(q, value, points[-1], search.space.names)
        if rows[metric_name(q)]["share"] <= 0:
            return _continue_from_feasible(search, points[-1])
    search.progress("how far all limits would have to give way together")
    inside = spec.with_band(spec.band * (1 - search.method.margin))
    shared = relax_all(search.simulator, search.space, inside, points)
    judged = min((search.certify_point(point) for point in (shared, *points)), key=relaxation_share)
    if judged.status.converged:
        return _continue_from_feasible(search, end_point(judged, search.space))
    if len(rows) > 1:
        rows["all"] = relaxation_row(
            None, relaxation_share(judged), end_point(judged, search.space), search.space.names
        )
    return with_relaxations(replace(judged, stats={**result.stats, **judged.stats}), rows)


def short_method(method: Method, margin: float) -> TwoPhase | Screening:
    """A short search from a point that is close."""
    if isinstance(method, TwoPhase):
        return replace(method, starts=2, margin=margin, solver=replace(method.solver, max_iterations=150))
    return Screening(24, 8, (), 200, margin, digits=method.digits)


def _continue_from_feasible(search: Search, point: Array) -> TuningResult:
    """The best from a design that keeps all limits; or that design, where the margins leave no room for a search."""
    found = search.run(point)
    return found if found.status.converged else search.certify_point(point)


def end_point(result: TuningResult, space: Space) -> Array:
    """The point that a search ended in, whether it was handed out or not."""
    return np.array([result.stats.get(f"rejected.{n}", result.parameters.value(n)) for n in space.names])


def _screening_status(spec: Specification, values: Mapping[str, float]) -> Status:
    """What a screening achieved: it keeps the limits, or the closest it came."""
    broken = [
        f"{metric_name(q)} {', '.join(describe_value(q, values[metric_name(q)]))}"
        for q in spec.violations(values, LIMIT_TOLERANCE)
    ]
    if broken:
        return Status(Code.INFEASIBLE, f"the closest found has {'; '.join(broken)}; relax a limit or widen the bounds")
    if not np.isfinite(spec.objective(values)):
        return Status(
            Code.NOT_CONVERGED, "nothing found settles; widen the band or the bounds, or lengthen the horizon"
        )
    return Status(Code.CONVERGED)


def _active_limits(space: Space, spec: Specification, point: Array, values: Mapping[str, float]) -> tuple[str, ...]:
    """Limits within 2 % of being reached, gains within 0.1 % of their range of a bound."""
    limits = [metric_name(q) for q in spec.limits if values[metric_name(q)] >= 0.98 * upper_limit(q)]
    low, up = space.bounds.T
    near = np.minimum(point - low, up - point) <= 1e-3 * (up - low)
    return (*limits, *(n for n, held in zip(space.names, near, strict=True) if held))
