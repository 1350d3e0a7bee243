"""`Certifier`: the certificate of a search's point beside the search's claim, and of gains that no search has found."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.evaluation.cases import cases
from pneuopt.evaluation.certificate import Certificate, Defect, judge_evaluations
from pneuopt.evaluation.evaluate import CaseEvaluation, evaluate_cases, tabulate_metrics
from pneuopt.evaluation.requirements import (
    METRICS,
    REQUIREMENT_KINDS,
    RiseTime,
    SettlingTime,
    SteadyStateError,
    describe_value,
    metric_name,
    requirement_values,
    upper_limit,
    user_value,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.provenance import provenance
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.agreement import describe_agreement
from pneuopt.tuning.method import Method, SearchResult, TuningTask
from pneuopt.tuning.responses import worst_values
from pneuopt.tuning.result import RELAXATION_COLUMNS, Refusal, TuningResult, requirement_table
from pneuopt.tuning.simulator import Simulator

if TYPE_CHECKING:
    import pandas as pd

# Relative difference of the certified from the claimed objective that a certificate allows, up or down. A smaller one
# refuses designs for the search's coarser samples; a larger one certifies designs whose response grazes the band, and
# claims that the search has misread.
MAX_CERTIFIED_EXCESS = 0.01
# Defects that a status tells: fewer hide that there are several; more bury the remedy.
MAX_DEFECTS_TOLD = 3
# What is said of a design that has no value of a metric; where nothing stands here, it "has no" that metric.
WORDS_WITHOUT_VALUE = {
    SettlingTime.metric.name: "does not settle within its horizon",
    RiseTime.metric.name: "does not reach 90 % of its step within its horizon",
}
TABLE_METRICS = tuple(kind.metric.name for kind in REQUIREMENT_KINDS if kind.metric.headline)


@dataclass(frozen=True, eq=False)
class Certifier:
    """Make the certificate of gains: their independent simulation, beside the claim of the search where there is one.

    Parameters
    ----------
    task : TuningTask
    method : Method, optional
        Named in the provenance; None where nothing was sought.
    """

    task: TuningTask
    method: Method | None = None

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

        ripple = ("SettlingTimeRaw", "Ripple") if self.task.loop.dither_period(parameters) else ()
        shown = [n for n in METRICS if n in (*TABLE_METRICS, *ripple, *self.task.spec.metric_names)]
        claimed = claimed.loc[shown]
        try:
            evaluations, contacts = self._evaluate(parameters)
            within = self._compare(found, claimed, tabulate_metrics(evaluations).loc[shown]).converged
            proof = self._judge(evaluations, continues=(within or found is None) and not contacts)
            slopes, certified = _friction_slopes(proof.metrics), proof.metrics.loc[shown]
            status = _contact_status(contacts) if contacts else self._certificate_status(found, claimed, proof)
        except ConvergenceError as error:
            proof, certified, contacts, slopes, within = None, claimed * np.nan, [], {}, False
            status = Status(Code.NOT_CERTIFIED, (str(error),))
        deviation = (claimed - certified).abs().max(axis=1).items() if found is not None else ()
        marks = {"contacts": float(len(contacts))} if contacts else {}
        fails_late = within and not contacts and not status.converged
        marks |= {"fails_late": 1.0} if fails_late else {}
        active, stats = (found.active, found.stats) if found is not None else ((), {})
        return TuningResult(
            self.task.space.parameters,
            claimed,
            certified,
            requirement_table(self.task.spec, claimed, certified, active),
            pd.DataFrame(columns=[*RELAXATION_COLUMNS, *self.task.space.names], dtype=float),
            active,
            status,
            {**stats, **{f"deviation.{n}": float(v) for n, v in deviation}, **marks, **slopes},
            self._provenance(),
            proof,
            refusal=Refusal.END_STOP if contacts else Refusal.LATE if fails_late else None,
        )

    def _provenance(self) -> dict[str, str]:
        method, spec = (self.method,) if self.method is not None else (), self.task.spec
        return provenance(*method, *spec.weights, *spec.limits, *self.task.references, *self.task.scenarios.items())

    def _evaluate(self, parameters: ParameterSet) -> tuple[tuple[CaseEvaluation, ...], list[str]]:
        """Every case over its horizon, and the warnings of end stops and emptied chambers that the responses met."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PhysicsWarning)
            found = evaluate_cases(
                self.task.loop,
                self.task.references,
                parameters,
                scenarios=self.task.scenarios,
                band=self.task.spec.band,
                envelope=self.task.spec.envelope,
            )
            return tuple(found), [str(w.message) for w in caught if issubclass(w.category, PhysicsWarning)]

    def _judge(self, evaluations: Sequence[CaseEvaluation], *, continues: bool) -> Certificate:
        """The certificate; a rest off the reference is allowed as far as a limit on SteadyStateError says."""
        allowed = self.task.spec.limit(SteadyStateError)
        rest_error = allowed if np.isfinite(allowed) else 0.0
        return judge_evaluations(evaluations, self.task.spec.band, rest_error, continues=continues)

    def _certificate_status(self, found: SearchResult | None, claimed: "pd.DataFrame", proof: Certificate) -> Status:
        """Whether the independent evaluation confirms the search, and finds no defect that is not accepted."""
        status = self._compare(found, claimed, proof.metrics.loc[claimed.index])
        defects = dict.fromkeys(f.sentence for f in proof.findings if f.defect not in self.task.accept)
        if (found is not None and not found.status.converged) or not defects:
            details = [f"accepted: {f.sentence}" for f in proof.findings] if status.converged else proof.notes
            return status.with_details(*details[:MAX_DEFECTS_TOLD])
        words = dict.fromkeys(f.defect.value for f in proof.findings if f.defect not in self.task.accept)
        if found is None:
            broken = () if status.converged else status.sentences
            return Status(Code.NOT_CERTIFIED, (*list(defects)[:MAX_DEFECTS_TOLD], *broken))
        remedy = f"limit SettlingTime or MaxSensitivity, or accept it by name: {', '.join(map(repr, words))}"
        if Defect.STANDS_STILL.value in words and self.task.spec.limits:
            limits = " and ".join(metric_name(q) for q in self.task.spec.limits)
            remedy = f"the search found only designs that stand still: {limits} may leave no room to move; relax them"
        broken = () if status.converged else status.sentences[:1]
        return Status(Code.NOT_CERTIFIED, (*list(defects)[:MAX_DEFECTS_TOLD], *broken, remedy))

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
        if not objectives_agree(ours, theirs, found.stats["optimum"], spec.resolution):
            verdict = f"the objective is {ours:.6g}, claimed {min(theirs, found.stats['optimum']):.6g}"
            cause = "the optimum grazes the band, or does not survive rounding, or the search misread it"
            return Status(Code.NOT_CERTIFIED, (verdict, cause, "ask for more digits or a wider band"))
        agreeing, warning = describe_agreement(found.stats)
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

    Examples
    --------
    >>> objectives_agree(4e-16, 0.0, 0.0, 1e-6)
    True
    >>> objectives_agree(0.3, 0.4, 0.4, 1e-6), objectives_agree(0.4, 0.3, 0.3, 1e-6)
    (False, False)
    """
    lowest, highest = claimed, min(claimed, optimum)
    above = lowest - MAX_CERTIFIED_EXCESS * abs(lowest) - resolution
    below = highest + MAX_CERTIFIED_EXCESS * abs(highest) + resolution
    return above <= certified <= below


def _friction_slopes(certified: "pd.DataFrame") -> dict[str, float]:
    """The slope of friction with which each case's margins are read [N s/m, or N m s/rad]."""
    rows = certified.loc[[n for n in certified.index if n == "FrictionSlope"]]
    return {f"friction_slope[{case}]": float(v) for case, column in rows.items() for v in column}


def _contact_status(contacts: Sequence[str]) -> Status:
    """The status of a design whose response meets an end stop or empties a chamber, where the model no longer holds."""
    remedy = "shorten the horizon, take a smaller step, or start elsewhere, Step(..., start={'position': ...})"
    return Status(Code.NOT_CERTIFIED, (*dict.fromkeys(contacts), remedy))
