"""`Search`: one tuning from its start to a certified answer; `relax`: by how much limits would have to give way."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pneuopt.evaluation.cases import cases
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.requirements import metric_name, upper_limit
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.tuning.certifier import MAX_CERTIFIED_EXCESS, Certifier
from pneuopt.tuning.confirmation import confirm_infeasible, describe_confirmation
from pneuopt.tuning.feasibility import check_feasibility
from pneuopt.tuning.merit import compute_merits
from pneuopt.tuning.method import Method, SearchResult, TuningTask
from pneuopt.tuning.relaxation import (
    limit_excess,
    limits_with_settling,
    relax_all,
    relaxation_row,
    relaxation_specification,
)
from pneuopt.tuning.responses import to_records
from pneuopt.tuning.result import Refusal, TuningResult, relaxation_share, with_relaxations
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space

# Margins tried, each twice the one before. Fewer give up on designs that need more room to survive the certificate;
# each more costs another search where no design exists.
MARGINS_TO_TRY = 3
# Defects of designs that no requirement makes move to the reference and stay there.
ENDS_ELSEWHERE = (Defect.STANDS_STILL, Defect.MISSES_REFERENCE, Defect.CREEPS, Defect.NEVER_SETTLES)
# Rounded designs certified at each margin, at most. Fewer miss the one that survives; each more costs an independent
# simulation of every case.
MAX_CERTIFIED_POINTS = 5
# Rounds in which the neighbours of the best rounded design are simulated. Fewer miss a rounding that loses next to
# nothing; more move the design away from the one that was found.
ROUNDING_ROUNDS = 3
# Horizons over which a design is sought whose rival hunted or crept after one, the first that the stroke allows: fewer
# do not show it; more cost time in proportion.
HORIZON_FACTORS = (4.0, 2.8, 2.0, 1.4)
# Defects of responses that a longer horizon, over which they have to settle, shows to a search.
LATE_DEFECTS = (Defect.GROWS, Defect.HUNTS, Defect.CREEPS, Defect.NEVER_SETTLES, Defect.UNDECIDED)
# Searches on closer samples or with shorter steps, at most: fewer claim figures of responses that are not resolved;
# more cost a search each.
MAX_REFINED_SEARCHES = 3
# Change of a requirement on closer samples, relative to its value and its limit, above which a search is repeated on
# them. A smaller one repeats searches for digits that no ranking needs; a larger one claims figures that the
# certificate refuses.
SAMPLING_TOLERANCE = 5e-3
# Margin of the search for the least relaxation of a limit, a fraction. A larger one reports more than is needed; at
# zero the design found does not survive its certificate.
RELAXATION_MARGIN = 0.002
UNTRIED = "it was not tried on other plants"


@dataclass(eq=False)
class Search:
    """Search, round the gains and certify them; search again with a wider margin where the certificate fails.

    Parameters
    ----------
    task : TuningTask
    method : Method
    progress : callable
        Receives a line of text a step.
    rests : bool
        Whether to search only among responses that settle within the horizon.
    """

    task: TuningTask
    method: Method
    progress: ProgressCallback
    rests: bool = False

    @property
    def space(self) -> Space:
        """The free gains."""
        return self.task.space

    @property
    def spec(self) -> Specification:
        """The objective and limits as asked for."""
        return self.task.spec

    @property
    def certifier(self) -> Certifier:
        """The certifier of this task's designs."""
        return Certifier(self.task, self.method)

    def run(self, start: Array | None = None) -> TuningResult:
        """Search from a point, by default the given gains, until a rounded design is certified."""
        simulator = self.simulator
        try:
            if start is None:
                self._report_start(simulator)
        except KeyboardInterrupt:
            return self._result_so_far(simulator, _interruption_result(self.space.start))
        result, start, counts = None, self.space.start if start is None else start, dict[str, float]()
        finder = self
        for attempt in range(MARGINS_TO_TRY):
            margin = min(self.method.margin * 2**attempt, 0.5)
            found = self._find_with(finder, margin, start, attempt)
            simulator = self.simulator
            counts = {k: v for k, v in found.stats.items() if k.startswith("starts")} | counts
            found = replace(found, stats={**found.stats, **counts, "margin": margin})
            if not found.is_complete:
                return self._result_so_far(simulator, found)
            if found.status.converged:
                result, start = self.certify_roundings(found, margin), found.point
                if result.status.converged or (self.rests and result.refusal is Refusal.END_STOP):
                    return result
                if not self.rests and _ends_elsewhere(result):
                    return self._run_with_rest(result)
            elif finder is self:
                return result or self.certifier.certify(simulator, found, self._round(found.point))
            finder = self._next_finder(finder, found, result, attempt)
        assert result is not None
        return result

    def _find_with(self, finder: "Search", margin: float, start: Array, attempt: int) -> SearchResult:
        """What a search for this one's task finds, over a longer horizon perhaps; its objective is this one's."""
        try:
            found = finder.find(margin, start, attempt)
        except KeyboardInterrupt:  # in a method that holds no best point yet
            return _interruption_result(start)
        return found if finder is self or not found.is_complete else self.restate(found)

    def _next_finder(
        self, finder: "Search", found: SearchResult, refused: TuningResult | None, attempt: int
    ) -> "Search":
        """The search for the next attempt: over a longer horizon once a design was refused for what came after it."""
        late = finder is not self or (refused is not None and _fails_late(refused))
        return self.lengthen(rests=found.status.converged) if late and attempt + 1 < MARGINS_TO_TRY else finder

    def _run_with_rest(self, refused: TuningResult) -> TuningResult:
        """Search again for designs that end in the band; the refused one's result where there is none."""
        self.progress("the design found does not end at the reference; searching for one that does")
        result = self.among_resting().run(self.space.start)
        return result if result.status.converged or result.status.code is Code.INTERRUPTED else refused

    def among_resting(self) -> "Search":
        """The search among responses that settle within the horizon, on the same compiled simulator."""
        other = replace(self, rests=True)
        other.simulator = self.simulator
        return other

    def lengthen(self, *, rests: bool) -> "Search":
        """A search over a longer horizon, in which a response that hunts or creeps later never settles.

        With `rests` it has to settle within the horizon asked for, otherwise within the longer one. It is the longest
        of `HORIZON_FACTORS` for which the piston has room; where there is none it is this search.
        """
        for factor in HORIZON_FACTORS:
            task = self._stretch_task(factor, rests)
            every = cases(task.references, task.scenarios, self.space.parameters, self.space.names)
            try:
                check_feasibility(task.loop, every, self.space, task.spec)
            except InputError:
                continue
            self.progress(f"what it does after its horizon forbids the design; searching over {factor:g} horizons")
            return replace(self, task=task)
        return self

    def _stretch_task(self, factor: float, rests: bool) -> TuningTask:
        """The task over so many horizons, with a limit that every response settles."""
        steps = tuple(r.with_horizon(r.at + factor * (r.horizon - r.at)) for r in self.task.references)
        spec = self.spec.with_rest(self.task.horizon) if rests else self.spec
        spec = replace(spec, limits=limits_with_settling(spec, steps, always=True))
        return replace(self.task, references=steps, spec=spec)

    def restate(self, found: SearchResult) -> SearchResult:
        """A point that was found over another horizon, or by no search, with its objective over the one asked for."""
        values = to_records(self.simulator.values(found.point[None], self.spec))[0]
        return replace(found, stats={**found.stats, "optimum": self.spec.objective(values)})

    @cached_property
    def simulator(self) -> Simulator:
        """The compiled simulation of all cases, which reads the requirements asked for."""
        task = self.task
        return Simulator(task.loop, task.references, task.space, task.scenarios, task.spec)

    def find(self, margin: float, start: Array, attempt: int) -> SearchResult:
        """Search, and search again where the response found is too fast for the samples, or the steps, of the search.

        Shorter steps leave an optimum near the one that longer steps found, so that search is as one after a refusal.
        """
        spec = self.tighten(margin)
        found = self.method.find(self.task, self.simulator, spec, start, attempt, self.progress)
        for _ in range(MAX_REFINED_SEARCHES):
            coarser = self.simulator
            finer = self._resolve(found.point) if found.is_complete else coarser
            if finer is coarser:
                break
            self.simulator = finer
            if found.uses_simulator:  # otherwise the method has samples of its own
                self.progress("the response is too fast for the samples of the search; searching again on closer ones")
                attempt = attempt if finer.grids is not coarser.grids else max(1, attempt)
                found = self.method.find(self.task, finer, spec, found.point, attempt, self.progress)
        return found

    def _resolve(self, point: Array) -> Simulator:
        """The simulator, or one with closer samples or shorter steps where a point's requirements need them."""
        for finer in (self.simulator.refine(point), self.simulator.shorten_steps()):
            if finer is not self.simulator and not self._agree(finer, point):
                return finer
        return self.simulator

    def _agree(self, finer: Simulator, point: Array) -> bool:
        """Whether the requirements have the same values on closer samples, or with shorter steps."""
        coarse, fine = (to_records(s.respond(point[None], self.spec.band).values)[0] for s in (self.simulator, finer))
        for q in (*self.spec.weights, *self.spec.limits):
            n, least, most = metric_name(q), q.metric.resolution, upper_limit(q)
            least += SAMPLING_TOLERANCE * most if most < np.inf else 0.0
            if n in fine and not np.isclose(coarse[n], fine[n], rtol=SAMPLING_TOLERANCE, atol=least, equal_nan=True):
                return False
        return True

    def _report_start(self, simulator: Simulator) -> None:
        """Report cases in which the loop never settles with the given gains: one of them may be mistyped."""
        times = [row["SettlingTime"] for row in simulator.table(self.space.start, self.spec)]
        bad = [k for k, t in enumerate(times) if not np.isfinite(t)]
        if bad:
            word = "runs away" if np.isinf(times[bad[0]]) else "never settles"
            where = f"{simulator.cases[bad[0]].label}, {len(bad)} of {len(times)} cases"
            self.progress(f"with the given gains the loop {word} at {where}; searching on")

    def certify_roundings(self, found: SearchResult, margin: float) -> TuningResult:
        """Certify roundings of the gains found, until one holds; otherwise the last one's result."""
        result = None
        for point in self._round_gains(self.simulator, found, margin):
            result = self.certifier.certify(self.simulator, found, point)
            if result.status.converged or result.refusal is Refusal.END_STOP or _fails_late(result):
                break
        assert result is not None
        return result

    def certify_point(self, point: Array) -> TuningResult:
        """Round a point and certify it."""
        rounded = self._round(point)
        found = self.restate(SearchResult(rounded, Status(Code.CONVERGED), (), {}))
        return self.certifier.certify(self.simulator, found, rounded)

    def _round(self, point: Array) -> Array:
        """The nearest point with as many digits as the method prints."""
        digits = self.method.digits
        return self.space.round_point(point, digits) if digits and np.isfinite(point).all() else point

    def with_specification(self, spec: Specification, method: Method) -> "Search":
        """A search for another specification of the same kinds of requirements, on the same compiled simulator."""
        other = replace(self, task=replace(self.task, spec=spec), method=method)
        other.simulator = self.simulator
        return other

    def _result_so_far(self, simulator: Simulator, found: SearchResult) -> TuningResult:
        """Round and certify the best point of an interrupted search; the result keeps the given gains."""
        best = self.certifier.certify(simulator, found, self._round(found.point))
        keeps = "keeps every limit on the model" if best.status.converged else "is not certified"
        lead = f"the best of {found.stats['simulations']:.0f} simulations so far {keeps}"
        is_candidate = not np.allclose(found.point, self.space.start, rtol=1e-9, atol=0.0)
        if not is_candidate:
            lead = "interrupted before anything better than the given gains was found; their evaluation"
        details = (*best.status.sentences[1:], UNTRIED if best.status.converged else "", "run again for an answer")
        status = Status(Code.INTERRUPTED, (f"{lead}: {best.status.verdict}", *filter(None, details)))
        result = best.refuse(status, self.space.parameters, self.space.names)
        return result if is_candidate else replace(result, best={})

    def tighten(self, margin: float) -> Specification:
        """The specification with limits tighter by a margin, as much as rounding and certificate may cost.

        It asks for a stable loop, too, whatever was asked for.
        """
        spec = self.spec.with_rest(self.task.horizon) if self.rests else self.spec
        return spec.tighten(margin, margin * self.method.peak_margin).with_stability()

    def _round_gains(self, simulator: Simulator, found: SearchResult, margin: float) -> Iterator[Array]:
        """Roundings of the gains found: the nearest one, then neighbours that keep the limits and lose little."""
        digits, spec, tried = self.method.digits, self.tighten(margin / 2), list[list[float]]()
        if digits is None:
            yield found.point
            return
        nearest = self.space.round_point(found.point, digits)
        points, most = nearest[None], found.stats["optimum"] * (1 + MAX_CERTIFIED_EXCESS)
        for _ in range(ROUNDING_ROUNDS):
            values = simulator.values(points, spec)
            order, rows = np.argsort(compute_merits(values, spec, self.task.horizon)), to_records(values)
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
        """Roundings further away, the best first, for gains of which no single last place keeps the limits."""
        points = np.vstack([nearest, self.space.neighbourhood(nearest, digits)])
        rows = to_records(self.simulator.values(points, spec))
        costs = [np.inf if spec.violations(row) else spec.objective(row) for row in rows]
        order = [k for k in np.argsort(costs).tolist() if costs[k] <= most][:MAX_CERTIFIED_POINTS]
        yield from points[order or [0]]


def _ends_elsewhere(result: TuningResult) -> bool:
    """Whether a design was refused because its response does not end at the reference, or runs into an end stop."""
    findings = result.certificate.findings if result.certificate is not None else ()
    elsewhere = any(f.defect in ENDS_ELSEWHERE and f.sentence in result.status.sentences for f in findings)
    return elsewhere or result.refusal is Refusal.END_STOP


def _fails_late(result: TuningResult) -> bool:
    """Whether it was refused for what it does after its horizon, which no rounding mends and a longer one shows."""
    findings = result.certificate.findings if result.certificate is not None else ()
    return result.refusal is Refusal.LATE or any(f.defect in LATE_DEFECTS for f in findings)


def _interruption_result(point: Array) -> SearchResult:
    """The result of a search that was interrupted before it had found anything better than its start."""
    return SearchResult(point, Status(Code.INTERRUPTED), (), {"simulations": 1.0}, is_complete=False)


def relax(search: Search, result: TuningResult) -> TuningResult:
    """Confirm that no design keeps all limits, and find by how much they have to give way, each alone and together.

    A search can miss a design that keeps all limits; where one turns up here, it is the answer.
    """
    spec, rows = search.spec, dict[str, dict[str, float]]()
    try:
        second = confirm_infeasible(search.simulator, spec, search.method.margin, search.progress)
    except KeyboardInterrupt:
        return _interrupt(result)
    if second.share <= 0:
        found = _continue_from_feasible(search, second.point)
        if found.status.converged or found.status.code is Code.INTERRUPTED:
            return found
    method, points = (
        search.method.shorten(RELAXATION_MARGIN),
        _rank_points(search, end_point(result, search.space), second.point),
    )
    for q in spec.limits:
        search.progress(f"finding how far {metric_name(q)} alone has to give way")
        found = search.with_specification(relaxation_specification(spec, q, search.task.references), method).run(
            points[0]
        )
        if found.status.code is Code.INTERRUPTED:
            return _interrupt(result)
        points.append(end_point(found, search.space))
        value = float(found.requirements["certified"][metric_name(q)]) if found.status.converged else np.nan
        rows[metric_name(q)] = relaxation_row(q, value, points[-1], search.space.names)
        if rows[metric_name(q)]["share"] <= 0:
            return _continue_from_feasible(search, points[-1])
    search.progress("finding how far all limits together have to give way")
    inside = spec.with_band(spec.band * (1 - search.method.margin)).with_stability()
    shared = relax_all(search.simulator, search.space, inside, points)
    closest = min((search.certify_point(point) for point in (shared, *points)), key=relaxation_share)
    if closest.status.converged:
        return _continue_from_feasible(search, end_point(closest, search.space))
    if len(rows) > 1:
        rows["all"] = relaxation_row(
            None, relaxation_share(closest), end_point(closest, search.space), search.space.names
        )
    counts = {"confirmation.simulations": float(second.simulations), "confirmation.share": second.share}
    closest = replace(closest, stats={**result.stats, **closest.stats, **counts})
    return with_relaxations(closest, rows, describe_confirmation(second.simulations))


def _rank_points(search: Search, *points: Array) -> list[Array]:
    """Points, the one closest to the limits first."""
    stable = search.spec.with_stability()
    excess = limit_excess(search.simulator.values(np.array(points), stable), stable)
    return [points[k] for k in np.argsort(excess, kind="stable").tolist()]


def _interrupt(result: TuningResult) -> TuningResult:
    """The result of a search that found nothing, where Ctrl-C came before that was confirmed."""
    sentences = (f"nothing found so far: {result.status.verdict}", "run again for an answer")
    return replace(result, status=Status(Code.INTERRUPTED, sentences))


def _continue_from_feasible(search: Search, point: Array) -> TuningResult:
    """Search from a design that keeps all limits; where the margins leave no room for that, certify that design."""
    found = search.run(point)
    return found if found.status.converged else search.certify_point(point)


def end_point(result: TuningResult, space: Space) -> Array:
    """The gains in which a search ended, certified or rejected, shape (n,)."""
    return np.array([result.best.get(n, result.parameters.value(n)) for n in space.names])
