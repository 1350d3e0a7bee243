"""`TuningResult`: a design, the search's figures beside those of an independent simulation, and what limits cost."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from math import ceil, isfinite, isnan, nan
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import Form, ParallelForm, SeriesForm, StandardForm, to_parallel, to_standard
from pneuopt.evaluation.certificate import Certificate, report_margins, report_notes
from pneuopt.evaluation.dither import DitherVerdict
from pneuopt.evaluation.evaluate import report_metrics
from pneuopt.evaluation.limit_cycle import RestCheck
from pneuopt.evaluation.metric import Sense
from pneuopt.evaluation.requirements import (
    SettlingTime,
    larger_is_better,
    metric_name,
    percent_factor,
    requirement_values,
    upper_limit,
    user_limit,
    user_value,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import (
    Line,
    Report,
    Table,
    Tone,
    format_number,
    number_columns,
    report_verdict,
    text_columns,
)
from pneuopt.quantities.results import NOT_SAVED, Result
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import write_value
from pneuopt.tuning.method import Agreement
from pneuopt.tuning.relaxation import describe_relaxations
from pneuopt.tuning.tolerances import ACTIVE_ROOM, HIGH_SHARE, MIN_DERIVATIVE_RATIO
from pneuopt.tuning.validation import DesignValidation, report_validation

if TYPE_CHECKING:
    import pandas as pd

RELAXATION_COLUMNS = ("asked", "needed", "share")


class Refusal(Enum):
    """What a certificate has refused a design for, where another rounding of it would not help."""

    END_STOP = "a response ran into an end stop"
    LATE = "only what comes after a horizon"


class RequirementRow(TypedDict):
    """A row of `TuningResult.requirements`, an objective or a limit at its worst over the cases.

    Figures are as the user writes them, a fraction where `Overshoot.max` is one; `allowed` is NaN without a limit,
    `room` what is left of it as a fraction [1], negative where it is broken.
    """

    claimed: float
    certified: float
    allowed: float
    room: float
    case: str
    active: bool


REQUIREMENT_COLUMNS = tuple(n for n in RequirementRow.__annotations__ if n != "active")


@dataclass(frozen=True, eq=False, repr=False)
class TuningResult(Result):
    """The design that `tune` found, its claim, its certificate, what each requirement comes to; prints its `summary()`.

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
        A row a requirement, objective or limit, a `RequirementRow`.
    relaxations : DataFrame
        Where no design found keeps all limits: a row a limit with what is "asked", and what alone is "needed" for a
        design that keeps the others (NaN where none was found), "share", how far that is from what is asked as a
        fraction of it, and that design's gains; in a last row, "all", the share by which all limits together have to
        give way. The independent simulation has confirmed each. Empty where a design keeps all limits.
    active : tuple of str
        Requirements and bounds that keep the objective from being smaller.
    status : Status
    stats : mapping of str to float
        "seconds", "deviation.SettlingTime" and so on (the largest |claimed - certified|), and the search's own:
        "margin", "optimum" (before rounding, where a search found it), "simulations", and of several starts "starts",
        "starts_converged", "starts_agreeing", those that end in the best optimum, "starts_optima", the optima that they
        found, "starts_spread", the relative excess of the worst of them, and "starts_unseen", the chance that one start
        more finds another optimum (Boender and Rinnooy Kan);
        "friction_slope[0 to 0.2]" and so on, the slope of friction with which that case's margins are read [N s/m];
        where the given gains stand "contacts" where a response ran into an end stop, and "fails_late" where only what
        comes after a horizon refuses the design.
    provenance : mapping of str to str
    certificate : Certificate, optional
        All that the independent evaluation found; None where its simulation stopped.
    validation : DesignValidation, optional
        On how many plants like the model the design holds, and what would help; `tune` tries what it has certified.
    on_rig : DataFrame, optional
        Metrics on the rig's model, where one was given: a row a metric, a column a reference.
    given : mapping of str to float
        The free parameters' values before.
    units : mapping of str to str
        The metrics that a table shows, in that order, with their units; the reference's has the key "".
    limits : mapping of str to float
        What was asked for, by metric, in the metric's unit.
    rest : RestCheck, optional
        How the loop ends on the rig's model, where `NoHunting` was asked for.
    best : mapping of str to float
        Where the given gains stand, the tuned parameters' values in the best candidate that was found, rounded [SI],
        of which `claimed` and `certified` tell; empty where the design is certified, or none was found.
    dither : DitherVerdict, optional
        Whether a dither that was tuned is worth it, against the same loop tuned without; of one that is left out for
        it, why.
    rival : mapping of str to float
        With that verdict the other design's tuned parameters: without dither, or with the one that is left out.
    agreement : Agreement, optional
        How far the starts of the search agree.
    trail : DataFrame, optional
        How a design was sought that holds on other plants, a row a way: on how many plants its best design has
        "held", what 95 of 100 of them reach of the objective, "high", the number for the "best" so far, which stands in
        the end, and CPU "seconds" since the nominal design.
    structures : DataFrame, optional
        Where other structures of the controller were tried, a row each: its "status", the certified "objective" (NaN
        where none is certified), the CPU "seconds" that it took, and the gains.
    structure : tuple of str
        Parameters that an adopted structure has brought or settled; `loop` is the loop with it.
    loop : ClosedLoop, optional
        None where the given loop was kept.
    refusal : Refusal, optional
        What the search goes on by where the certificate has refused the design.
    finalists : array
        Points (k, n) apart from each other that the search found hardly worse than the best.
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
    given: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    rest: RestCheck | None = None
    best: Mapping[str, float] = field(default_factory=dict)
    dither: DitherVerdict | None = None
    rival: Mapping[str, float] = field(default_factory=dict)
    trail: "pd.DataFrame | None" = None
    structures: "pd.DataFrame | None" = None
    structure: tuple[str, ...] = ()
    loop: ClosedLoop | None = field(default=None, metadata=NOT_SAVED)
    agreement: Agreement | None = field(default=None, metadata=NOT_SAVED)
    refusal: Refusal | None = field(default=None, metadata=NOT_SAVED)
    finalists: Array = field(default_factory=lambda: np.empty((0, 0)), metadata=NOT_SAVED)

    @property
    def candidate(self) -> ParameterSet | None:
        """The certified design, or the best candidate that was not; None where there is neither."""
        if self.status.converged:
            return self.parameters
        return self.parameters.with_values(self.best) if self.best else None

    def refuse(self, status: Status, given: ParameterSet, names: Sequence[str]) -> "TuningResult":
        """The result with another status, by which its design is no longer certified: the given gains stand.

        Parameters
        ----------
        status : Status
        given : ParameterSet
            With the values before.
        names : sequence of str
            The tuned parameters.
        """
        own = [n for n in names if n in self.parameters]
        best = {n: self.parameters.value(n) for n in own} if self.status.converged else self.best
        stands = self.parameters.with_values({n: given.value(n) for n in own})
        return replace(self, parameters=stands, status=status, best=best)

    def row(self) -> dict[str, float | str]:
        """A study's row (`sweep`): how the tuning ended, the gains, and the certified metrics, the worst of each."""
        rows = ((str(n), values.to_numpy(dtype=float)) for n, values in self.certified.iterrows())
        worst = {n: float((np.min if larger_is_better(n) else np.max)(values)) for n, values in rows}
        gains = self.candidate
        tuned = {} if gains is None else {n: gains.value(n) for n in self.given}
        return {"status": self.status.code.value, **tuned, **worst}

    def summary(self) -> Report:
        """How the tuning ended, gains, certified metrics beside their limits, margins, and how other plants behave."""
        return report_tuning(self)


def requirement_table(
    spec: Specification, claimed: "pd.DataFrame", certified: "pd.DataFrame", active: Sequence[str] = ()
) -> "pd.DataFrame":
    """A table of each requirement's claimed and certified figure beside its limit; see `TuningResult.requirements`."""
    import pandas as pd

    rows = dict[str, dict[str, Any]]()
    for n, requirement in {metric_name(q): q for q in (*spec.weights, *spec.limits)}.items():
        values = [requirement_values({n: frame.loc[n].to_numpy(dtype=float)})[n] for frame in (claimed, certified)]
        k = [int(np.argmax(np.where(np.isnan(v), np.inf, v))) for v in values]
        claim, proof = (float(v[i]) for v, i in zip(values, k, strict=True))
        limit, allowed, room = user_limit(requirement), upper_limit(requirement), nan
        if limit is not None:
            least = requirement.metric.sense is Sense.AT_LEAST
            room = user_value(requirement, proof) * allowed - 1 if least else 1 - proof / allowed
        rows[n] = {
            "claimed": user_value(requirement, claim),
            "certified": user_value(requirement, proof),
            "allowed": nan if limit is None else limit,
            "room": room,
            "case": str(certified.columns[k[1]]),
        }
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=None if rows else [*REQUIREMENT_COLUMNS])
    frame["active"] = [n in active or room <= ACTIVE_ROOM for n, room in frame["room"].items()]
    return frame


def with_relaxations(result: TuningResult, rows: dict[str, dict[str, float]], simulations: int) -> TuningResult:
    """The result of the design that comes closest to the limits, with the relaxations that would make them feasible."""
    import pandas as pd

    broken = result.requirements[~(result.requirements["room"] >= 0) & result.requirements["allowed"].notna()]
    closest = [f"{n} {row.certified:.4g} of {row.allowed:.6g}" for n, row in broken.iterrows()]
    unknown = [str(n) for n, row in result.requirements.iterrows() if np.isnan(row.certified) and np.isnan(row.allowed)]
    shortfall = ", ".join([*closest, *(f"no {n}" for n in unknown)])
    lead = f"not found in {simulations} simulations; closest: {shortfall}"
    would_do = any(isfinite(value) for row in rows.values() for value in (row["needed"], row["share"]))
    sentences = (lead, describe_relaxations(rows), f"{'or ' if would_do else ''}widen the gains' bounds")
    relaxations = pd.DataFrame.from_dict(rows, orient="index")
    return replace(result, status=Status(Code.INFEASIBLE, sentences), relaxations=relaxations)


def relaxation_share(result: TuningResult) -> float:
    """The share by which every limit has to widen for a design to keep them; inf where a requirement has no value."""
    known = result.requirements
    rooms = known["room"][known["allowed"].notna()]
    unreached = known["certified"].isna().any() or rooms.isna().any()
    return float("inf") if unreached else float(-rooms.min())


def report_tuning(
    result: TuningResult, *, was: "pd.DataFrame | None" = None, source: str = "the given gains"
) -> Report:
    """How a tuning ended, and its design; of one that failed what was refused, and how far limits have to give way.

    `was` are the metrics with the gains before, `source` names the gains that stand; empty where nothing was sought.
    """
    found = report_outcome(result, is_sought=bool(source))
    if not result.status.converged:
        return found + report_refusal(result, source)
    tried, certificate = result.validation, result.certificate
    beside = ("was", was) if result.on_rig is None else ("on rig", result.on_rig)
    found += report_gains(result.given, result.parameters)
    found += report_metrics(result.certified, result.units, beside=beside, limits=result.limits)
    found += report_active(result.requirements, result.active, result.parameters)
    if certificate is not None:
        found += report_margins(certificate.margins) + report_notes(certificate.notes)
    return found + report_validation(tried) if tried else found


def report_outcome(result: TuningResult, *, is_sought: bool) -> Report:
    """How a tuning ended, or whether gains are certified that nobody has sought; then details, a line each."""
    status, tried = result.status, result.validation
    word = "certified" if status.converged else "NOT CERTIFIED"
    text = str(status) if is_sought else "\n".join((f"{word}: {status.verdict}", *status.sentences[1:]))
    good = Tone.DOUBTFUL if tried is not None and not tried.is_robust else Tone.GOOD
    return report_verdict(text, good if status.converged else Tone.BAD)


def state_promise(result: TuningResult, spec: Specification, loop: ClosedLoop) -> TuningResult:
    """The certified result whose verdict begins with its promise: the objective's figures, here and on other plants.

    Where the design does not hold on nearly all of them, the verdict begins with that.
    """
    tried, terms, doubt = result.validation, describe_objective(result, spec, loop), ""
    if terms and (tried is not None or spec.limits):
        limits = "keeps all limits" if spec.limits else "holds"
        terms.append(limits if tried is None else f"{limits} on {tried.held}")
    if tried is not None and not tried.is_robust:
        least = ceil(HIGH_SHARE * tried.count)
        sought = result.trail is not None and result.trail["best"].max() < least
        doubt = f"{tried.sentence}; no design found holds on {least}" if sought else tried.sentence
    sentences = (doubt, "; ".join(terms), *result.status.sentences)
    return replace(result, status=replace(result.status, sentences=tuple(filter(None, sentences))))


def describe_objective(result: TuningResult, spec: Specification, loop: ClosedLoop) -> list[str]:
    """What a certified result reaches of each term of its objective, here and on the plants that it was tried on."""
    tried, terms = result.validation, list[str]()
    nearly_all = "" if tried is None else f"on {ceil(HIGH_SHARE * tried.count)} of {tried.count} plants"
    for q in spec.weights:
        n, unit = metric_name(q), q.metric.shown_unit(loop.command.unit, loop.feedback.unit)
        value = f"{q.metric.factor * result.requirements['certified'][n]:.3g} {unit}".strip()
        text = f"settles in {value}" if isinstance(q, SettlingTime) else f"{n} {value}"
        if tried is not None:
            high, known = tried.figures["p95"][n], int(tried.plants[n].notna().sum())
            some = f", on {known} of {tried.count} plants at all"
            text += some if isnan(high) else f", {f'{high:.3g} {unit}'.strip()} {nearly_all}"
        terms.append(text)
    return terms


def report_refusal(result: TuningResult, source: str) -> Report:
    """The gains that stand, named by `source`, and what was refused, or is the best so far, with its figures."""
    word = "best so far" if result.status.code is Code.INTERRUPTED else "rejected" if source else "simulated"
    tried = ", ".join(f"{n} {write_value(v, result.parameters[n].unit)}" for n, v in result.best.items())
    lead = Report((Line(f"{source} stand; {word}: {tried or 'none was found'}"),)) if source else Report()
    beside = "on rig", result.on_rig
    figures = report_metrics(result.certified, result.units, title=word, beside=beside, limits=result.limits)
    return lead + figures + report_relaxations(result.relaxations)


def report_gains(given: Mapping[str, float], tuned: ParameterSet) -> Report:
    """Each free parameter within its bounds before, where known, and after tuning, and the gains in another form."""
    rows = []
    for n in tuned.free_names:
        p, before = tuned[n], [write_value(given[n], tuned[n].unit)] if n in given else [""] * bool(given)
        bounds = f"{format_number(p.lower, 4)} to {format_number(p.upper, 4)}"
        mark = "at its bound" if p.value in (p.lower, p.upper) else ""
        rows.append((n, *before, write_value(p.value, p.unit), bounds, mark))
    figures = number_columns(*(["before", "tuned"] if given else ["value"]), "bounds")
    table = Table((*text_columns("parameter"), *figures, *text_columns("")), tuple(rows))
    form = _other_form(tuned)
    return Report((*([table] if rows else []), *([Line(form)] if form else [])))


def _other_form(parameters: ParameterSet) -> str:
    """The gains in another form in a sentence; empty where there are none."""
    given = next((f for f in Form if all(f"pid.{n}" in parameters for n in f.gains)), None)
    if given is None:
        return ""
    own = [parameters.value(f"pid.{n}") for n in given.gains]
    if given is not Form.PARALLEL:
        same = to_parallel(StandardForm(*own) if given is Form.STANDARD else SeriesForm(*own))
        derivative = f"Kd {same.Kd:.4g}, Tf {same.Tf:.4g} s" if same.Kd else "no derivative"
        return f"parallel form: Kp {same.Kp:.4g}, Ki {same.Ki:.4g}, {derivative}"
    gains = ParallelForm(*own)
    if not gains.Kp:
        return "no standard form: Kp is zero"
    form = to_standard(gains)
    integral = f", Ti {form.Ti:.4g} s" if gains.Ki else ", no integral"
    derivative = f", Td {form.Td:.4g} s, N {form.N:.4g} (ISA's ratio Td/Tf)" if gains.Kd else ", no derivative"
    if 0 < abs(form.N) < MIN_DERIVATIVE_RATIO:
        derivative = f", next to no derivative (Kd/Tf is {100 * abs(form.N):.2g} % of Kp)"
    return f"standard form: Kp {form.Kp:.4g}{integral}{derivative}"


def report_active(requirements: "pd.DataFrame", active: Sequence[str], parameters: ParameterSet) -> Report:
    """What keeps the objective from being smaller: limits with the room that is left, and bounds of the gains."""
    limits = [f"{n} ({100 * row['room']:.2g} % of room left)" for n, row in requirements.iterrows() if row["active"]]
    at_bounds = [n for n in parameters.free_names if parameters.value(n) in (parameters[n].lower, parameters[n].upper)]
    others = (*at_bounds, *(a for a in active if a not in requirements.index))
    bounds = [f"{n} (at its bound)" for n in dict.fromkeys(others)]
    return Report((Line(f"held back by: {', '.join((*limits, *bounds))}"),) if limits or bounds else ())


def report_relaxations(table: "pd.DataFrame") -> Report:
    """How far limits that no design found keeps must be relaxed; nothing where there is no such table."""
    if table.empty:
        return Report()
    rows = []
    for row in table.reset_index(names="limit").to_dict(orient="records"):
        share = "-" if isnan(row["share"]) else f"{100 * row['share']:.3g} %"
        factor = percent_factor(row["limit"])
        unit = " %" if factor == 100 else ""
        asked, needed = (format_number(factor * row[n], 4) + unit for n in ("asked", "needed"))
        would_do = "none found" if isnan(row["needed"]) else needed
        rows.append(
            ("all together", "", "", share) if row["limit"] == "all" else (row["limit"], asked, would_do, share)
        )
    columns = *text_columns("relaxed alone"), *number_columns("asked", "would do", "by")
    return Report((Table(columns, tuple(rows)),))
