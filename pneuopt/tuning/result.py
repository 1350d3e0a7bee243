"""`TuningResult`: a design, the search's figures beside those of an independent simulation, and what limits cost."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite, nan
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from pneuopt.evaluation.certificate import Certificate
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import (
    metric_name,
    requirement_values,
    upper_limit,
    user_limit,
    user_value,
)
from pneuopt.evaluation.rest_check import RestCheck
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report
from pneuopt.quantities.shown import Result
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.relaxation import describe_relaxations
from pneuopt.tuning.report import report_tuning
from pneuopt.tuning.validation import DesignValidation

if TYPE_CHECKING:
    import pandas as pd

# Room left of a limit, a fraction of it, within which it counts as active. A smaller one misses limits that the
# search's margin keeps a design away from; a larger one names limits that hold nothing back.
ACTIVE_ROOM = 0.02
RELAXATION_COLUMNS = ("asked", "needed", "share")


class RequirementRow(TypedDict):
    """A row of `TuningResult.requirements`, an objective or a limit at its worst over the cases.

    Attributes
    ----------
    claimed : float
        Value by the search, as the user writes it: a fraction where `Overshoot.max` is one.
    certified : float
        Value by the independent simulation.
    allowed : float
        Limit; NaN where there is none.
    room : float
        What is left of the limit as a fraction of it; negative where it is broken [1].
    case : str
        Where it is worst.
    active : bool
        Whether it holds the objective back.
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

    def summary(self) -> Report:
        """How the tuning ended, gains, certified metrics beside their limits, margins, and how other plants behave."""
        return report_tuning(self)


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
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=None if rows else [*REQUIREMENT_COLUMNS])
    frame["active"] = [n in active or room <= ACTIVE_ROOM for n, room in frame["room"].items()]
    return frame


def with_relaxations(result: TuningResult, rows: dict[str, dict[str, float]], confirmation: str) -> TuningResult:
    """The result of the design that comes closest to the limits, with the relaxations that would make them feasible."""
    import pandas as pd

    broken = result.requirements[~(result.requirements["room"] >= 0) & result.requirements["allowed"].notna()]
    closest = [f"{n} {row.certified:.6g} ({row.allowed:.6g} asked)" for n, row in broken.iterrows()]
    unknown = [str(n) for n, row in result.requirements.iterrows() if np.isnan(row.certified) and np.isnan(row.allowed)]
    shortfall = ", ".join([*closest, *(f"no {n}" for n in unknown)])
    lead = f"no design found keeps all limits, nor does {confirmation} find one; the closest has {shortfall}"
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
