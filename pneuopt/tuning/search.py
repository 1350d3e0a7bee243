"""`Search`: one tuning from its start to a certified answer, its gains rounded before they are certified.

`Certifier` holds a search's claim against the certificate. `relax` finds by how much limits would have to give way, and
`confirm_refusal` looks for another design where the certificate refuses the first, both by a `LimitSearch`, which does
not share the first search's merit: designs that are worse by the objective may hold where the best one hunts, creeps,
or breaks a limit after its horizon.
"""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite, nan
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.averaging import is_affine
from pneuopt.evaluation.certificate import Certificate, Defect, judge_evaluations
from pneuopt.evaluation.evaluate import CaseEvaluation, evaluate_cases, tabulate_metrics
from pneuopt.evaluation.metric import Requirement
from pneuopt.evaluation.requirements import (
    METRICS,
    REQUIREMENT_KINDS,
    RiseTime,
    SettlingTime,
    SettlingTimeRaw,
    SteadyStateError,
    describe_value,
    metric_name,
    requirement_values,
    upper_limit,
    user_value,
    with_user_limit,
)
from pneuopt.evaluation.response import cases
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, ProgressCallback, Status, provenance
from pneuopt.tuning.feasibility import check_feasibility
from pneuopt.tuning.method import Agreement, Method, SearchResult, TuningTask, describe_agreement
from pneuopt.tuning.racing import compute_merits
from pneuopt.tuning.relaxation import (
    LimitSearch,
    limit_excesses,
    limits_with_settling,
    relaxation_row,
)
from pneuopt.tuning.result import (
    RELAXATION_COLUMNS,
    Refusal,
    TuningResult,
    relaxation_share,
    requirement_table,
    with_relaxations,
)
from pneuopt.tuning.simulator import Simulator, to_records, worst_values
from pneuopt.tuning.space import Space
from pneuopt.tuning.tolerances import (
    HORIZON_FACTORS,
    MARGINS_TO_TRY,
    MAX_CERTIFIED_POINTS,
    MAX_REFINED_SEARCHES,
    MAX_ROUNDINGS,
    RELAXATION_MARGIN,
    SAME_OBJECTIVE,
    SAMPLING_TOLERANCE,
    UNSETTLED_EXCESS,
    WORST_MERIT,
)

if TYPE_CHECKING:
    import pandas as pd


CONTACT_REMEDY = "shorten the horizon, take a smaller step, or start elsewhere, Step(..., start={'position': ...})"
# What is said of a design that has no value of a metric; where nothing stands here, it "has no" that metric.
WORDS_WITHOUT_VALUE = {
    SettlingTime.metric.name: "does not settle within its horizon",
    SettlingTimeRaw.metric.name: "leaves its settling band with its ripple",
    RiseTime.metric.name: "does not reach 90 % of its step within its horizon",
}
TABLE_METRICS = tuple(kind.metric.name for kind in REQUIREMENT_KINDS if kind.metric.headline)


@dataclass(frozen=True, eq=False)
class Certifier:
    """Make the certificate of gains: their independent simulation, beside the claim of the method's search, if any.

    Messages name `most_told` defects.
    """

    task: TuningTask
    method: Method | None = None
    most_told: int = 3

    def certify(self, simulator: Simulator, found: SearchResult, point: Array) -> TuningResult:
        """Simulate a point by both simulations; the result has its gains where the certificate holds."""
        import pandas as pd

        rows = zip(simulator.cases, simulator.table(point, self.task.spec), strict=True)
        claimed = pd.DataFrame({case.label: metrics for case, metrics in rows})
        result = self._prove(found, self.task.space.parameters_at(point), claimed)
        values = dict(zip(self.task.space.names, point.tolist(), strict=True))
        if result.status.converged:
            return replace(result, parameters=self.task.space.parameters.with_values(values))
        return replace(result, best=values if np.isfinite(point).all() else {})

    def certify_given(self) -> TuningResult:
        """The certificate of the task's gains as they stand, of which no search claims anything."""
        import pandas as pd

        task = self.task
        every = cases(task.references, task.scenarios, task.space.parameters)
        unclaimed = pd.DataFrame(np.nan, index=[*METRICS], columns=[case.label for case in every])
        return self._prove(None, task.space.parameters, unclaimed)

    def _prove(self, found: SearchResult | None, parameters: ParameterSet, claimed: "pd.DataFrame") -> TuningResult:
        """The result of parameters, with the given ones; `found` is None where nobody has claimed the figures."""
        import pandas as pd

        method, spec = (self.method,) if self.method is not None else (), self.task.spec
        ripple = ("SettlingTimeRaw", "Ripple") if self.task.loop.dither_period(parameters) else ()
        shown = [n for n in METRICS if n in (*TABLE_METRICS, *ripple, *spec.metric_names)]
        claimed = claimed.loc[shown]
        try:
            evaluations, contacts = self._evaluate(parameters)
            within = self._compare(found, claimed, tabulate_metrics(evaluations).loc[shown]).converged
            allowed = spec.limit(SteadyStateError)
            rest_error = allowed if np.isfinite(allowed) else 0.0  # how far it may rest off the reference
            goes_on = (within or found is None) and not contacts
            proof = judge_evaluations(evaluations, spec.band, rest_error, continues=goes_on)
            certified, known = proof.metrics.loc[shown], proof.metrics.to_dict()
            slopes = {f"friction_slope[{n}]": v["FrictionSlope"] for n, v in known.items() if "FrictionSlope" in v}
            stops = (*dict.fromkeys(contacts), CONTACT_REMEDY) if contacts else ()  # there the model no longer holds
            status = Status(Code.NOT_CERTIFIED, stops) if stops else self._certificate_status(found, claimed, proof)
        except ConvergenceError as error:
            proof, certified, contacts, slopes, within = None, claimed * np.nan, [], {}, False
            status = Status(Code.NOT_CERTIFIED, (str(error),))
        deviation = (claimed - certified).abs().max(axis=1).items() if found is not None else ()
        fails_late = within and not contacts and not status.converged
        marks = {"contacts": float(len(contacts))} if contacts else {"fails_late": 1.0} if fails_late else {}
        active, stats, agreement = ((), {}, None) if found is None else (found.active, found.figures, found.agreement)
        return TuningResult(
            self.task.space.parameters,
            claimed,
            certified,
            requirement_table(spec, claimed, certified, active),
            pd.DataFrame(columns=[*RELAXATION_COLUMNS, *self.task.space.names], dtype=float),
            active,
            status,
            {**stats, **{f"deviation.{n}": float(v) for n, v in deviation}, **marks, **slopes},
            provenance(*method, *spec.weights, *spec.limits, *self.task.references, *self.task.scenarios.items()),
            proof,
            agreement=agreement,
            refusal=Refusal.END_STOP if contacts else Refusal.LATE if fails_late else None,
            finalists=np.empty((0, 0)) if found is None else found.finalists,
        )

    def _evaluate(self, parameters: ParameterSet) -> tuple[tuple[CaseEvaluation, ...], list[str]]:
        """Every case over its horizon, and the warnings of end stops and emptied chambers that the responses met."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PhysicsWarning)
            task, spec = self.task, self.task.spec
            found = evaluate_cases(
                task.loop, task.references, parameters, scenarios=task.scenarios, band=spec.band, envelope=spec.envelope
            )
            return tuple(found), [str(w.message) for w in caught if issubclass(w.category, PhysicsWarning)]

    def _certificate_status(self, found: SearchResult | None, claimed: "pd.DataFrame", proof: Certificate) -> Status:
        """Whether the independent evaluation confirms the search, and finds no defect that is not accepted."""
        status = self._compare(found, claimed, proof.metrics.loc[claimed.index])
        defects = dict.fromkeys(f.sentence for f in proof.findings if f.defect not in self.task.accept)
        if (found is not None and not found.status.converged) or not defects:
            details = [f"accepted: {f.sentence}" for f in proof.findings] if status.converged else proof.notes
            return status.with_details(*details[: self.most_told])
        words = dict.fromkeys(f.defect.value for f in proof.findings if f.defect not in self.task.accept)
        if found is None:
            broken = () if status.converged else status.sentences
            return Status(Code.NOT_CERTIFIED, (*list(defects)[: self.most_told], *broken))
        remedy = f"limit SettlingTime or MaxSensitivity, or accept it by name: {', '.join(map(repr, words))}"
        if Defect.STANDS_STILL.value in words and self.task.spec.limits:
            limits = " and ".join(metric_name(q) for q in self.task.spec.limits)
            remedy = f"the search found only designs that stand still: {limits} may leave no room to move; relax them"
        broken = () if status.converged else status.sentences[:1]
        return Status(Code.NOT_CERTIFIED, (*list(defects)[: self.most_told], *broken, remedy))

    def _compare(self, found: SearchResult | None, claimed: "pd.DataFrame", certified: "pd.DataFrame") -> Status:
        """Whether the certified metrics keep the limits and agree with the claimed objective, where there is one."""
        if found is None:
            return self._check_limits(certified)
        if not found.status.converged:
            return found.status
        spec = self.task.spec
        claim, proof = (worst_values([requirement_values(dict(f[r])) for r in f]) for f in (claimed, certified))
        for q in spec.violations(proof):
            n, (value, allowed) = metric_name(q), describe_value(q, proof[metric_name(q)])
            claim_text = f"claimed {describe_value(q, claim[n])[0]}"
            verdict = f"{n} is {value}{self._worst_case(certified, n)}, {allowed}, {claim_text}"
            return Status(Code.NOT_CERTIFIED, (verdict, f"give {n} more room"))
        for n in (metric_name(q) for q in spec.weights if np.isnan(proof[metric_name(q)])):
            claim_text = "" if np.isnan(claim[n]) else f", claimed {claim[n]:.6g}"
            lack = WORDS_WITHOUT_VALUE.get(n, f"has no {n}")
            verdict = f"the design found {lack}{self._worst_case(certified, n)}{claim_text}"
            return Status(Code.NOT_CERTIFIED, (verdict, "give the limits more room, or lengthen the horizon"))
        ours, theirs = spec.objective(proof), spec.objective(claim)
        if not objectives_agree(ours, theirs, found.optimum, spec.resolution):
            verdict = f"the objective is {ours:.6g}, claimed {min(theirs, found.optimum):.6g}"
            cause = "the optimum grazes the band, or does not survive rounding, or the search misread it"
            return Status(Code.NOT_CERTIFIED, (verdict, cause, "ask for more digits or a wider band"))
        agreeing, warning = describe_agreement(found.agreement)
        verdict = f"certified objective {ours:.6g}, claimed {theirs:.6g}"
        return Status(Code.CONVERGED, (f"{verdict}, {agreeing}" if agreeing else verdict,)).with_details(warning)

    def _check_limits(self, certified: "pd.DataFrame") -> Status:
        """Whether the certified metrics keep the limits; if not, by how much each of them is broken."""
        spec, count = self.task.spec, len(certified.columns)
        proof = worst_values([requirement_values(dict(certified[r])) for r in certified])
        broken = list[str]()
        for q in spec.violations(proof):
            n, value = metric_name(q), proof[metric_name(q)]
            (shown, allowed), worst = describe_value(q, value), self._worst_case(certified, n)
            if np.isnan(value):
                broken.append(f"the loop {WORDS_WITHOUT_VALUE.get(n, f'has no {n}')}{worst}, {allowed}")
                continue
            excess = 100 * abs(user_value(q, value) / user_value(q, upper_limit(q)) - 1)
            broken.append(f"{n} is {shown}{worst}, {allowed}" + (f": off by {excess:.3g} %" if excess < inf else ""))
        if broken:
            return Status(Code.NOT_CERTIFIED, tuple(broken))
        missing = [n for n in (metric_name(q) for q in spec.weights) if np.isnan(proof[n])]
        if missing:
            lack = WORDS_WITHOUT_VALUE.get(missing[0], f"has no {missing[0]}")
            return Status(Code.NOT_CERTIFIED, (f"the loop {lack}{self._worst_case(certified, missing[0])}",))
        kept = (
            f"keep {len(spec.limits)} limit{'s' * (len(spec.limits) > 1)}" if spec.limits else "have no limit to keep"
        )
        return Status(Code.CONVERGED, (f"the gains as they stand {kept} in {count} case{'s' * (count > 1)}",))

    def _worst_case(self, certified: "pd.DataFrame", metric: str) -> str:
        """The words " at" and the worst case of a metric, where there are several cases."""
        values = requirement_values({metric: certified.loc[metric].to_numpy(dtype=float)})[metric]
        k = int(np.argmax(np.where(np.isnan(values), np.inf, values)))
        return f" at {certified.columns[k]}" if len(values) > 1 else ""


def certified_objective(spec: Specification, result: TuningResult) -> float:
    """The objective by a result's certificate, the worst over the cases."""
    values = [requirement_values(dict(column)) for _, column in result.certified.items()]
    return spec.objective(worst_values(values))


def objectives_agree(certified: float, claimed: float, optimum: float, resolution: float) -> bool:
    """Whether a certified objective is no worse than the claim and the optimum before rounding, and not far better.

    A claim far above the certificate is as wrong as one far below: the search has then compared other figures than
    those of the response. Near zero, where no relative difference counts, `resolution` decides.
    """
    lowest, highest = claimed, min(claimed, optimum)
    above = lowest - SAME_OBJECTIVE * abs(lowest) - resolution
    below = highest + SAME_OBJECTIVE * abs(highest) + resolution
    return above <= certified <= below


# Defects of designs that no requirement makes move to the reference and stay there.
ENDS_ELSEWHERE = (Defect.STANDS_STILL, Defect.MISSES_REFERENCE, Defect.CREEPS, Defect.NEVER_SETTLES)
# Defects of responses that a longer horizon, over which they have to settle, shows to a search.
LATE_DEFECTS = (Defect.GROWS, Defect.HUNTS, Defect.CREEPS, Defect.NEVER_SETTLES, Defect.UNDECIDED)
UNTRIED = "it was not tried on other plants"


@dataclass(eq=False)
class Search:
    """Search, round the gains and certify them; search again with a wider margin where the certificate fails.

    With `rests` only responses that settle within the horizon count; it makes `attempts` at most.
    """

    task: TuningTask
    method: Method
    progress: ProgressCallback
    rests: bool = False
    attempts: int = MARGINS_TO_TRY

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
        try:  # one of the cases in which the given gains never settle may be mistyped
            rows = simulator.table(self.space.start, self.spec) if start is None else []
            bad = [k for k, row in enumerate(rows) if not np.isfinite(row["SettlingTime"])]
            if bad:
                word = "runs away" if np.isinf(rows[bad[0]]["SettlingTime"]) else "never settles"
                where = f"{simulator.cases[bad[0]].label}, {len(bad)} of {len(rows)} cases"
                self.progress(f"with the given gains the loop {word} at {where}; searching on")
        except KeyboardInterrupt:
            return self._result_so_far(simulator, _interruption_result(self.space.start))
        result, start, agreement = None, self.space.start if start is None else start, None
        finder = self
        for attempt in range(self.attempts):
            margin = min(self.method.margin * 2**attempt, 0.5)
            found = finder.find(margin, start, attempt)
            if finder is not self and found.is_complete:
                found = self.restate(found)
            simulator = self.simulator
            agreement = agreement or found.agreement  # later searches begin near the first one's point
            found = replace(found, stats={**found.stats, "margin": margin}, agreement=agreement)
            if not found.is_complete:
                return self._result_so_far(simulator, found)
            if found.status.converged:
                result, start = self._certify_ends(found, margin), found.point
                if result.status.converged or (self.rests and result.refusal is Refusal.END_STOP):
                    return result
                if not self.rests and _ends_elsewhere(result):
                    self.progress("the design found does not end at the reference; searching for one that does")
                    other = self.among_resting().run(self.space.start)
                    return other if other.status.converged or other.status.code is Code.INTERRUPTED else result
            elif finder is self:
                return result or self.certifier.certify(simulator, found, self._round(found.point))
            # over a longer horizon once a design was refused for what came after its own
            late = finder is not self or (result is not None and _fails_late(result))
            finder = self.lengthen(rests=found.status.converged) if late and attempt + 1 < self.attempts else finder
        assert result is not None
        return result

    def among_resting(self) -> "Search":
        """The search among responses that settle within the horizon, on the same compiled simulator."""
        other = replace(self, rests=True)
        other.simulator = self.simulator
        return other

    def lengthen(self, *, rests: bool) -> "Search":
        """A search over the longest of `HORIZON_FACTORS` horizons with room for the piston; without any, this one.

        With `rests` a response has to settle within the horizon asked for, otherwise within the longer one.
        """
        for factor in HORIZON_FACTORS:
            steps = tuple(r.with_horizon(r.at + factor * (r.horizon - r.at)) for r in self.task.references)
            spec = self.spec.with_rest(self.task.horizon) if rests else self.spec
            spec = replace(spec, limits=limits_with_settling(spec, steps, always=True))
            task = replace(self.task, references=steps, spec=spec)
            every = cases(task.references, task.scenarios, self.space.parameters, self.space.names)
            try:
                check_feasibility(task.loop, every, self.space, task.spec)
            except InputError:
                continue
            self.progress(f"what it does after its horizon forbids the design; searching over {factor:g} horizons")
            return replace(self, task=task)
        return self

    def restate(self, found: SearchResult) -> SearchResult:
        """A point that was found over another horizon, or by no search, with its objective over the one asked for."""
        values = to_records(self.simulator.values(found.point[None], self.spec))[0]
        return replace(found, optimum=self.spec.objective(values))

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
        try:
            found = self.method.find(self.task, self.simulator, spec, start, attempt, self.progress)
            for _ in range(MAX_REFINED_SEARCHES):
                coarser = self.simulator
                others = (coarser.refine(found.point), coarser.shorten_steps()) if found.is_complete else ()
                needed = (s for s in others if s is not coarser and not self._agree(s, found.point))
                self.simulator = next(needed, coarser)
                if self.simulator is coarser:
                    break
                if found.uses_simulator:  # otherwise the method has samples of its own
                    reason = "the response is too fast for the samples of the search"
                    self.progress(f"{reason}; searching again on closer ones")
                    attempt = attempt if self.simulator.grids is not coarser.grids else max(1, attempt)
                    found = self.method.find(self.task, self.simulator, spec, found.point, attempt, self.progress)
        except KeyboardInterrupt:  # in a method that holds no best point yet
            return _interruption_result(start)
        return found

    def _agree(self, finer: Simulator, point: Array) -> bool:
        """Whether the requirements have the same values on closer samples, or with shorter steps."""
        coarse, fine = (to_records(s.respond(point[None], self.spec.band).values)[0] for s in (self.simulator, finer))
        for q in (*self.spec.weights, *self.spec.limits):
            n, least, most = metric_name(q), q.metric.resolution, upper_limit(q)
            least += SAMPLING_TOLERANCE * most if most < np.inf else 0.0
            if n in fine and not np.isclose(coarse[n], fine[n], rtol=SAMPLING_TOLERANCE, atol=least, equal_nan=True):
                return False
        return True

    def certify_roundings(self, found: SearchResult, margin: float) -> TuningResult:
        """Certify roundings of the gains found, until one holds; otherwise the last one's result."""
        result = None
        for point in self._round_gains(self.simulator, found, margin):
            result = self.certifier.certify(self.simulator, found, point)
            if result.status.converged or result.refusal is Refusal.END_STOP or _fails_late(result):
                break
        assert result is not None
        return result

    def _certify_ends(self, found: SearchResult, margin: float) -> TuningResult:
        """Certify the point found; where it ends elsewhere or late, the search's other ends as well."""
        result = self.certify_roundings(found, margin)
        others = found.others if _ends_elsewhere(result) or _fails_late(result) else ()
        tried = (self.certify_roundings(self.restate(replace(found, point=point)), margin) for point in others)
        return next((other for other in tried if other.status.converged), result)

    def certify_point(self, point: Array, margin: float = nan, agreement: Agreement | None = None) -> TuningResult:
        """Round a point and certify it; with the margin of a search its neighbours as well, until one holds.

        `agreement` is that of the search that led to it.
        """
        found = SearchResult(point, Status(Code.CONVERGED), (), agreement=agreement)
        if isfinite(margin):
            return self.certify_roundings(self.restate(found), margin)
        rounded = self._round(point)
        return self.certifier.certify(self.simulator, self.restate(replace(found, point=rounded)), rounded)

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
        lead = f"the best of {found.simulations} simulations so far {keeps}"
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
        linear = margin * self.method.linear_margin if is_affine(self.task.loop.plant) else None
        return spec.tighten(margin, margin * self.method.peak_margin, linear).with_stability()

    def _round_gains(self, simulator: Simulator, found: SearchResult, margin: float) -> Iterator[Array]:
        """Roundings of the gains found that keep the limits, those first that lose least; at least one rounding.

        The rounded gains about the point form a lattice, of which a line through any of them and its two neighbours
        says along each gain what is worth simulating: an active limit is then missed by a hundredth of a last place.
        """
        digits, tried = self.method.digits, list[list[float]]()
        if digits is None:
            yield found.point
            return
        nearest, most = self.space.round_point(found.point, digits), found.optimum * (1 + SAME_OBJECTIVE)
        around, lattice = self.space.neighbours(nearest, digits), self.space.lattice(nearest, digits)
        for spec in (self.tighten(margin), self.tighten(margin / 2)):  # half of the room is for rounding, where it must
            points = np.vstack([nearest, around])
            near = simulator.values(points, spec)
            merits = compute_merits(extrapolate(points, near, lattice), spec, self.task.horizon)
            likely = lattice[np.argsort(merits, kind="stable")[:MAX_ROUNDINGS]]
            points = np.vstack([points, *(self.space.round_point(point, digits) for point in likely)])
            far = simulator.values(points[-len(likely) :], spec)
            rows = to_records({n: np.append(near[n], far[n]) for n in near})
            costs = [np.inf if spec.violations(row) else spec.objective(row) for row in rows]
            for k in np.argsort(costs, kind="stable").tolist():
                point = points[k].tolist()
                if costs[k] <= most and len(tried) < MAX_CERTIFIED_POINTS and point not in tried:
                    tried.append(point)
                    yield points[k]
        if not tried:
            yield nearest


def extrapolate(points: Array, values: Mapping[str, Array], others: Array) -> dict[str, Array]:
    """Values at other points (m, n) by parabolas along each gain, from the first of the points and from its neighbours.

    A neighbour differs from the first point in one gain; a gain with one neighbour has a line, one without has none.
    """
    found = {n: np.full(len(others), value[0]) for n, value in values.items()}
    for k, (at, moved) in enumerate(zip(points[0], (others - points[0]).T, strict=True)):
        beside = np.flatnonzero(points[:, k] != at)
        steps = points[beside, k] - at
        for n, value in values.items():
            with np.errstate(invalid="ignore"):
                slopes = (value[beside] - value[0]) / steps
            if len(beside) and np.isfinite(slopes).all():
                bend = np.diff(slopes) / np.diff(steps) if len(beside) == 2 else np.zeros(1)
                found[n] += moved * (slopes[0] + bend[0] * (moved - steps[0]))
    return found


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
    return SearchResult(point, Status(Code.INTERRUPTED), (), simulations=1, is_complete=False)


def relax(search: Search, result: TuningResult) -> TuningResult:
    """Search once more for a design that keeps all limits, and for how far they have to give way, alone and together.

    A search can miss a design that keeps all limits; where one turns up here, it is the answer.
    """
    spec, rows, points = search.spec, dict[str, dict[str, float]](), list[Array]()
    lasting = replace(spec, limits=limits_with_settling(spec, search.task.references)).with_stability()
    lasting = lasting.with_band(spec.band * (1 - RELAXATION_MARGIN))  # what grazes the band survives no rounding
    quick = search.simulator.coarse(lasting)
    limits = LimitSearch(
        search.simulator,
        lambda points: limit_excesses(quick.values(points, lasting), lasting),
        [search.space.start, end_point(result, search.space)],
        lambda excess: search.progress(f"{doing}: {_describe_closest(excess)}"),
    )
    try:
        doing = "searching for any design that keeps all limits"
        share = limits.minimise(search.method.margin)
        if share <= 0:
            found = _continue_from_feasible(search, limits.candidates()[0])
            if found.status.converged or found.status.code is Code.INTERRUPTED:
                return found
        for k, q in enumerate(spec.limits):
            doing = f"finding how far {metric_name(q)} alone has to give way"
            row, point = _relax_alone(search, limits, k, q)
            rows[metric_name(q)], points = row, [*points, point]
            if row["share"] <= 0:
                return _continue_from_feasible(search, point)
        points += limits.candidates(most=inf)[:MARGINS_TO_TRY]
        closest = min((search.certify_point(point) for point in points), key=relaxation_share)
    except KeyboardInterrupt:
        return _interrupt(result)
    if closest.status.converged:
        return _continue_from_feasible(search, end_point(closest, search.space))
    if len(rows) > 1:
        point = end_point(closest, search.space)
        rows["all"] = relaxation_row(None, relaxation_share(closest), point, search.space.names)
    counts = {"confirmation.simulations": float(limits.count), "confirmation.share": share}
    total = result.stats.get("simulations", 0.0) + limits.count
    return with_relaxations(replace(closest, stats={**result.stats, **closest.stats, **counts}), rows, round(total))


def _relax_alone(
    search: Search, limits: LimitSearch, k: int, requirement: Requirement
) -> tuple[dict[str, float], Array]:
    """The row of one limit alone, of the first of the best designs for it that the certificate confirms, and that."""
    asked, margin = search.spec, RELAXATION_MARGIN if len(search.spec.limits) > 1 else 0.0
    if margin:
        limits.relax(k, margin)
    weights, others = {with_user_limit(requirement, None): 1.0}, tuple(q for q in asked.limits if q is not requirement)
    alone = search.with_specification(replace(asked, weights=weights, limits=others), search.method)
    for point in limits.candidates(k, margin, WORST_MERIT)[:MARGINS_TO_TRY]:
        held = alone.certify_point(point, RELAXATION_MARGIN)
        if held.status.converged:
            value, gains = held.requirements["certified"][metric_name(requirement)], end_point(held, search.space)
            return relaxation_row(requirement, float(value), gains, search.space.names), gains
    return relaxation_row(requirement, nan, search.space.start, search.space.names), search.space.start


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


def confirm_refusal(search: Search, refused: TuningResult) -> tuple[TuningResult, bool]:
    """A design that the certificate lets through in place of the refused one, or the refused one's result.

    The second tells whether a design stands whose improvement was interrupted.
    """
    resting = search.among_resting()
    longer = resting.lengthen(rests=True)
    limits = LimitSearch(
        search.simulator,
        lambda points: _excess(resting, longer, points)[:, None],
        [search.space.start, end_point(refused, search.space)],
        lambda excess: search.progress(f"searching for other designs: {_describe_closest(excess)}"),
    )
    try:
        limits.minimise()
        points = limits.candidates()
        for k, point in enumerate(points):
            search.progress(f"certifying candidate {k + 1} of {len(points)} of the second search")
            held = search.certify_point(point)
            if held.status.converged:
                words = f"the first search's design was refused ({refused.status.verdict}); better ones may exist"
                best, is_stopped = _improve(search, longer, held)
                return replace(best, status=best.status.with_details(words)), is_stopped
    except KeyboardInterrupt:
        return _interrupt(refused), False
    failed = f"of {len(points)} designs that it finds none is certified" if points else "finds none that comes to rest"
    words = f"a second search over {limits.count} simulations, {failed}, either"
    stats = {**refused.stats, "confirmation.simulations": float(limits.count)}
    return replace(refused, status=refused.status.with_details(words), stats=stats), False


def _excess(resting: Search, longer: Search, points: Array) -> Array:
    """The largest relative excess over a limit; of points that keep all of them, over the longer horizon as well."""
    found = _excess_within(resting, points)
    kept = found <= 0
    if kept.any() and longer is not resting:
        found[kept] = np.maximum(found[kept], _excess_within(longer, points[kept]))
    return found


def _excess_within(search: Search, points: Array) -> Array:
    """The largest relative excess over a limit within a search's horizon, in which the response has to settle."""
    spec = search.tighten(0.0)
    return np.asarray(limit_excesses(search.simulator.coarse(spec).values(points, spec), spec).max(axis=1))


def _improve(search: Search, longer: Search, held: TuningResult) -> tuple[TuningResult, bool]:
    """A design that is certified, or a better one that a short search about it finds; whether that was interrupted."""
    margin = search.method.margin
    try:
        found = longer.find(margin, end_point(held, search.space), 1)
        if not (found.is_complete and found.status.converged):
            return held, found.status.code is Code.INTERRUPTED
        better = search.certify_roundings(search.restate(found), margin)
    except KeyboardInterrupt:
        return held, True
    before, after = (certified_objective(search.spec, result) for result in (held, better))
    return (better if better.status.converged and after < before else held), False


def _describe_closest(excess: float) -> str:
    """How far the best candidate so far lies beyond its limits, or within them, in words.

    Examples
    --------
    >>> _describe_closest(0.123), _describe_closest(-0.61), _describe_closest(10.2)
    ('the closest is 12.3 % beyond them', 'the best stays 61 % below them', 'none is stable and settles yet')
    """
    share = f"{100 * abs(excess):.3g} %"
    if excess >= UNSETTLED_EXCESS:
        return "none is stable and settles yet"
    return f"the closest is {share} beyond them" if excess > 0 else f"the best stays {share} below them"
