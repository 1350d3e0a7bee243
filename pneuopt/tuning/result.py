"""`TuningResult`, and the `Certifier` that makes it: the search's figures beside those of an independent simulation."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.evaluation.certificate import Certificate, certificate
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import (
    METRICS,
    REQUIREMENT_KINDS,
    describe_value,
    metric_name,
    requirement_values,
    upper_limit,
    user_limit,
    user_value,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.provenance import provenance
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.method import Method, SearchResult, TuningTask
from pneuopt.tuning.relaxation import describe_relaxations
from pneuopt.tuning.responses import worst_values
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.validation import DesignValidation

if TYPE_CHECKING:
    import pandas as pd

# Relative excess of the certified over the claimed objective that a certificate allows. A smaller one refuses designs
# for the search's coarser samples; a larger one certifies designs whose response grazes the band.
MAX_CERTIFIED_EXCESS = 0.01
# Room left of a limit, a fraction of it, within which it counts as active. A smaller one misses limits that the
# search's margin keeps a design away from; a larger one names limits that hold nothing back.
ACTIVE_ROOM = 0.02
# Defects that a status tells: fewer hide that there are several; more bury the remedy.
MAX_DEFECTS_TOLD = 3
RELAXATION_COLUMNS = ("asked", "needed", "share")
TABLE_METRICS = tuple(kind.metric.name for kind in REQUIREMENT_KINDS if kind.metric.headline)


@dataclass(frozen=True, eq=False)
class TuningResult:
    """The design that `tune` found, with its claim, its certificate and what each requirement comes to.

    Attributes
    ----------
    parameters : ParameterSet
        The given ones with the tuned values, rounded; the given ones unchanged where the status is not "converged".
    claimed, certified : DataFrame
        A row a metric, a column a reference, then one a reference and scenario: SettlingTime [s], Overshoot and
        SteadyStateError [% of the step], PeakControl [the command's unit], MaxSensitivity, with dither Ripple [the
        measured signal's unit], and what else was asked for, as `evaluate` has it; by the search's own simulation, and
        by the independent one.
    requirements : DataFrame
        A row a requirement, objective or limit, at its worst over the cases: "claimed", "certified" and "allowed" as
        the user writes them (a fraction where `Overshoot.max` is one; NaN where there is no limit), "room", what is
        left of the limit as a fraction of it, negative where it is broken, "active", whether it holds the objective
        back, and "case", where it is worst.
    relaxations : DataFrame
        Where the limits contradict each other: a row a limit with what is "asked", and what alone is "needed" for a
        design that keeps the others (NaN where none was found), "share", how far that is from what is asked as a
        fraction of it, and that design's gains; in a last row, "all", the share by which all limits together have to
        give way. The independent simulation has confirmed each. Empty where the limits do not contradict each other.
    active : tuple of str
        Requirements and bounds that keep the objective from being smaller.
    status : Status
    stats : mapping of str to float
        "seconds", "deviation.SettlingTime" and so on (the largest |claimed - certified|), and the search's own:
        "margin", "starts", "starts_converged", "starts_agreeing", "optimum" (before rounding), "simulations";
        "friction_slope[0 to 0.2]" and so on, the slope of friction with which that case's margins are read [N s/m];
        where the given gains stand "rejected.pid.Kp" and so on, and "contacts" where a response ran into an end stop.
    provenance : mapping of str to str
    certificate : Certificate, optional
        All that the independent evaluation found; None where its simulation stopped.
    validation : DesignValidation, optional
        On how many plants like the model the design holds, and what would help; `tune` tries what it has certified.
    on_rig : DataFrame, optional
        Metrics on the rig's model, where one was given: a row a metric, a column a reference.
    """

    parameters: ParameterSet
    claimed: "pd.DataFrame"
    certified: "pd.DataFrame"
    requirements: "pd.DataFrame"
    relaxations: "pd.DataFrame"
    active: tuple[str, ...]
    status: Status
    stats: Mapping[str, float]
    provenance: Mapping[str, str]
    certificate: Certificate | None = None
    validation: DesignValidation | None = None
    on_rig: "pd.DataFrame | None" = None

    def __repr__(self) -> str:
        free = self.parameters.select(self.parameters.free_names)
        tried = f"\n{self.validation.verdict}" if self.validation else ""
        return f"TuningResult {self.status}{tried}\n{free!r}\n{self.certified.to_string()}"


@dataclass(frozen=True, eq=False)
class Certifier:
    """Make the certificate of a point: its independent simulation, beside the claim of the search.

    Parameters
    ----------
    task : TuningTask
    method : Method
        Named in the provenance.
    """

    task: TuningTask
    method: Method

    def certify(self, simulator: Simulator, found: SearchResult, point: Array) -> TuningResult:
        """Simulate a point by both simulations; the result has its gains where the certificate holds."""
        import pandas as pd

        parameters = self.task.space.parameters_at(point)
        ripple = ("SettlingTimeRaw", "Ripple") if self.task.loop.dither_period(parameters) else ()
        shown = [n for n in METRICS if n in (*TABLE_METRICS, *ripple, *self.task.spec.kinds)]
        rows = zip(simulator.cases, simulator.table(point, self.task.spec), strict=True)
        claimed = pd.DataFrame({case.label: metrics for case, metrics in rows}).loc[shown]
        try:
            proof, contacts = self._evaluate(parameters)
            slopes, certified = _friction_slopes(proof.metrics), proof.metrics.loc[shown]
            status = _contact_status(contacts) if contacts else self._certificate_status(found, claimed, proof)
        except ConvergenceError as error:
            proof, certified, contacts, slopes = None, claimed * np.nan, [], {}
            status = Status(Code.NOT_CERTIFIED, (str(error),))
        deviation = {f"deviation.{n}": float(v) for n, v in (claimed - certified).abs().max(axis=1).items()}
        values = dict(zip(self.task.space.names, point.tolist(), strict=True))
        contact_count = {"contacts": float(len(contacts))} if contacts else {}
        rejected = {} if status.converged else {f"rejected.{n}": v for n, v in values.items()}
        return TuningResult(
            self.task.space.parameters.with_values(values) if status.converged else self.task.space.parameters,
            claimed,
            certified,
            requirement_table(self.task.spec, claimed, certified, found.active),
            pd.DataFrame(columns=[*RELAXATION_COLUMNS, *self.task.space.names], dtype=float),
            found.active,
            status,
            {**found.stats, **deviation, **contact_count, **rejected, **slopes},
            provenance(
                self.method,
                *self.task.spec.weights,
                *self.task.spec.limits,
                *self.task.references,
                *self.task.scenarios.items(),
            ),
            proof,
        )

    def _evaluate(self, parameters: ParameterSet) -> tuple[Certificate, list[str]]:
        """The certificate, and the warnings of end stops and emptied chambers that the responses met."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PhysicsWarning)
            found = certificate(
                self.task.loop,
                self.task.references,
                parameters,
                scenarios=self.task.scenarios,
                band=self.task.spec.band,
                envelope=self.task.spec.envelope,
            )
        return found, [str(w.message) for w in caught if issubclass(w.category, PhysicsWarning)]

    def _certificate_status(self, found: SearchResult, claimed: "pd.DataFrame", proof: Certificate) -> Status:
        """Whether the independent evaluation confirms the search, and finds no defect that is not accepted."""
        if not found.status.converged:
            return found.status
        status = self._comparison_status(found, claimed, proof.metrics.loc[claimed.index])
        defects = [f.sentence for f in proof.findings if f.defect not in self.task.accept]
        if not defects:
            return status
        sentences = tuple(dict.fromkeys(defects)), () if status.converged else status.sentences
        return Status(Code.NOT_CERTIFIED, (*sentences[0][:MAX_DEFECTS_TOLD], *sentences[1]))

    def _comparison_status(self, found: SearchResult, claimed: "pd.DataFrame", certified: "pd.DataFrame") -> Status:
        """Whether the certified metrics keep the limits and agree with the claimed objective."""
        claim, proof = (worst_values([requirement_values(dict(f[r])) for r in f]) for f in (claimed, certified))
        for q in self.task.spec.violations(proof):
            n, (value, allowed) = metric_name(q), describe_value(q, proof[metric_name(q)])
            claim_text = f"claimed {describe_value(q, claim[n])[0]}"
            return Status(
                Code.NOT_CERTIFIED,
                (f"{n} is {value}{self._worst_case(certified, n)}, {allowed}, {claim_text}", f"give {n} more room"),
            )
        ours, theirs = self.task.spec.objective(proof), min(self.task.spec.objective(claim), found.stats["optimum"])
        if not ours <= theirs * (1 + MAX_CERTIFIED_EXCESS):
            return Status(
                Code.NOT_CERTIFIED,
                (
                    f"the objective is {ours:.6g}, claimed {theirs:.6g}",
                    "the optimum grazes the band, or does not survive rounding",
                    "ask for more digits or a wider band",
                ),
            )
        agreeing = (
            f", {found.stats['starts_agreeing']:.0f} of {found.stats['starts']:.0f} starts agree"
            if "starts" in found.stats
            else ""
        )
        message = f"certified objective {ours:.6g}, claimed {self.task.spec.objective(claim):.6g}{agreeing}"
        return Status(Code.CONVERGED, (message,))

    def _worst_case(self, certified: "pd.DataFrame", metric: str) -> str:
        """The words " at" and the worst case of a metric, where there are several cases."""
        values = requirement_values({metric: certified.loc[metric].to_numpy(dtype=float)})[metric]
        k = int(np.argmax(np.where(np.isnan(values), np.inf, values)))
        return f" at {certified.columns[k]}" if len(values) > 1 else ""


def _friction_slopes(certified: "pd.DataFrame") -> dict[str, float]:
    """The slope of friction with which each case's margins are read [N s/m, or N m s/rad]."""
    rows = certified.loc[[n for n in certified.index if n == "FrictionSlope"]]
    return {f"friction_slope[{case}]": float(v) for case, column in rows.items() for v in column}


def requirement_table(
    spec: Specification, claimed: "pd.DataFrame", certified: "pd.DataFrame", active: Sequence[str] = ()
) -> "pd.DataFrame":
    """A table of each requirement's claimed and certified figure beside its limit; see `TuningResult.requirements`."""
    import pandas as pd

    limits = {metric_name(q): q for q in spec.limits}
    rows = {
        metric_name(q): _requirement_row(limits.get(metric_name(q), q), claimed, certified)
        for q in (*spec.weights, *spec.limits)
    }
    frame = pd.DataFrame.from_dict(rows, orient="index")
    frame["active"] = [n in active or room <= ACTIVE_ROOM for n, room in frame["room"].items()]
    return frame


def with_relaxations(result: TuningResult, rows: dict[str, dict[str, float]]) -> TuningResult:
    """The result of the design that comes closest to the limits, with the relaxations that would make them feasible."""
    import pandas as pd

    broken = result.requirements[~(result.requirements["room"] >= 0) & result.requirements["allowed"].notna()]
    closest = [f"{n} {row.certified:.6g} ({row.allowed:.6g} asked)" for n, row in broken.iterrows()]
    unknown = [str(n) for n, row in result.requirements.iterrows() if np.isnan(row.certified) and np.isnan(row.allowed)]
    lead = f"no design found keeps all limits, the closest has {', '.join([*closest, *(f'no {n}' for n in unknown)])}"
    sentences = (lead, describe_relaxations(rows), "or widen the gains' bounds")
    relaxations = pd.DataFrame.from_dict(rows, orient="index")
    return replace(result, status=Status(Code.INFEASIBLE, sentences), relaxations=relaxations)


def relaxation_share(result: TuningResult) -> float:
    """The share by which every limit has to widen for a design to keep them; inf where a requirement has no value."""
    known = result.requirements
    rooms = known["room"][known["allowed"].notna()]
    unreached = known["certified"].isna().any() or rooms.isna().any()
    return float("inf") if unreached else float(-rooms.min())


def _requirement_row(requirement: Requirement, claimed: "pd.DataFrame", certified: "pd.DataFrame") -> dict[str, Any]:
    """A row of `TuningResult.requirements`, but for "active"."""
    n = metric_name(requirement)
    values = [requirement_values({n: frame.loc[n].to_numpy(dtype=float)})[n] for frame in (claimed, certified)]
    k = [int(np.argmax(np.where(np.isnan(v), np.inf, v))) for v in values]
    claim, proof = (float(v[i]) for v, i in zip(values, k, strict=True))
    limit, allowed = user_limit(requirement), upper_limit(requirement)
    least = requirement.metric.sense is Sense.AT_LEAST
    room = nan if limit is None else (user_value(requirement, proof) * allowed - 1 if least else 1 - proof / allowed)
    return {
        "claimed": user_value(requirement, claim),
        "certified": user_value(requirement, proof),
        "allowed": nan if limit is None else limit,
        "room": room,
        "case": str(certified.columns[k[1]]),
    }


def _contact_status(contacts: Sequence[str]) -> Status:
    """The status of a design whose response meets an end stop or empties a chamber, where the model no longer holds."""
    remedy = "shorten the horizon, take a smaller step, or start elsewhere, Step(..., start={'position': ...})"
    return Status(Code.NOT_CERTIFIED, (*dict.fromkeys(contacts), remedy))
