"""`TuningResult`, and the certificate that it stands on: a claim beside the simulation that shares nothing with it."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.certify import evaluate
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.errors import ConvergenceError, PhysicsWarning
from pneuopt.nlp.status import Code, Status
from pneuopt.parameters import ParameterSet
from pneuopt.provenance import provenance
from pneuopt.requirements import name, read, told
from pneuopt.scenarios import Scenarios
from pneuopt.specification import Specification
from pneuopt.tuning.candidates import Space
from pneuopt.tuning.simulator import Simulator, worst

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
GRAZING = 0.01  # relative excess of the certified over the claimed settling time
SHOWN = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl", "MaxSensitivity")


@dataclass(frozen=True, eq=False)
class TuningResult:
    """What `tune` found.

    Attributes
    ----------
    parameters : ParameterSet
        The given ones with the tuned values, as printed; the given ones unchanged where the status is not "converged".
    claimed, certified : DataFrame
        A row a metric, a column a reference, then one a reference and scenario: SettlingTime [s], Overshoot and
        SteadyStateError [% of the step], PeakControl [the command's unit], MaxSensitivity, with dither Ripple [the
        measured signal's unit], and what else was asked for, as `evaluate` has it; by the search's own simulation, and
        by the independent one.
    active : tuple of str
        Requirements and bounds that hold the objective back.
    status : Status
    stats : mapping of str to float
        "seconds", "deviation.SettlingTime" and so on (the largest |claimed - certified|), and the search's own:
        "margin", "starts", "starts_converged", "starts_agreeing", "optimum" (before rounding), "simulations"; where
        the given gains stand "rejected.pid.Kp" and so on, and "contacts" where a response ran into an end stop.
    provenance : mapping of str to str
    """

    parameters: ParameterSet
    claimed: "pd.DataFrame"
    certified: "pd.DataFrame"
    active: tuple[str, ...]
    status: Status
    stats: Mapping[str, float]
    provenance: Mapping[str, str]

    def __repr__(self) -> str:
        free = self.parameters.select(self.parameters.free_names)
        return f"TuningResult {self.status}\n{free!r}\n{self.certified.to_string()}"


@dataclass(frozen=True, eq=False)
class Found:
    """What a search hands over: a point before rounding, what is active there, figures; whether it came to its end."""

    point: Array
    status: Status
    active: tuple[str, ...]
    stats: Mapping[str, float]
    is_complete: bool = True


@dataclass(frozen=True, eq=False)
class Notary:
    """Certifies what a search found.

    Parameters
    ----------
    loop : ClosedLoop
    references : tuple of Step
    scenarios : mapping of str to mapping
    space : Space
    spec : Specification
        As asked for.
    method : object
        For the provenance.
    """

    loop: ClosedLoop
    references: tuple[Step, ...]
    scenarios: Scenarios
    space: Space
    spec: Specification
    method: object

    def result(self, simulator: Simulator, found: Found, point: Array) -> TuningResult:
        """Claim and certificate of a point; its values are handed out where the certificate holds."""
        import pandas as pd

        parameters = self.space.filled(point)
        ripple = ("Ripple",) if self.loop.dither_period(parameters) else ()
        shown = list(dict.fromkeys((*SHOWN, *ripple, *self.spec.kinds)))
        rows = zip(simulator.cases, simulator.table(point, self.spec), strict=True)
        claimed = pd.DataFrame({case.label: metrics for case, metrics in rows}).loc[shown]
        try:
            certified, met = self._certified(parameters)
            certified = certified.loc[shown]
            status = _outside(met) if met else self._verdict(found, claimed, certified)
        except ConvergenceError as error:
            certified, met = claimed * np.nan, []
            status = Status(Code.NOT_CERTIFIED, str(error))
        deviation = {f"deviation.{n}": float(v) for n, v in (claimed - certified).abs().max(axis=1).items()}
        values = dict(zip(self.space.names, point.tolist(), strict=True))
        contacts = {"contacts": float(len(met))} if met else {}
        rejected = {} if status.converged else {f"rejected.{n}": v for n, v in values.items()}
        return TuningResult(
            self.space.parameters.with_values(values) if status.converged else self.space.parameters,
            claimed,
            certified,
            found.active,
            status,
            {**found.stats, **deviation, **contacts, **rejected},
            provenance(self.method, *self.spec.weights, *self.spec.limits, *self.references, *self.scenarios.items()),
        )

    def _certified(self, parameters: ParameterSet) -> tuple["pd.DataFrame", list[str]]:
        """The certificate, and what the responses ran into."""
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", PhysicsWarning)
            certified = evaluate(
                self.loop,
                self.references,
                parameters,
                scenarios=self.scenarios,
                band=self.spec.band,
                envelope=self.spec.envelope,
            )
        return certified, [str(w.message) for w in told if issubclass(w.category, PhysicsWarning)]

    def _verdict(self, found: Found, claimed: "pd.DataFrame", certified: "pd.DataFrame") -> Status:
        """Whether the independent simulation confirms the search."""
        if not found.status.converged:
            return found.status
        claim, proof = (worst([read(dict(f[r])) for r in f]) for f in (claimed, certified))
        for q in self.spec.violated(proof):
            n, (value, allowed) = name(q), told(q, proof[name(q)])
            return Status(
                Code.NOT_CERTIFIED,
                f"{n} is {value}{self._where(certified, n)}, {allowed}, claimed {told(q, claim[n])[0]}; "
                f"give {n} more room",
            )
        ours, theirs = self.spec.objective(proof), min(self.spec.objective(claim), found.stats["optimum"])
        if not ours <= theirs * (1 + GRAZING):
            return Status(
                Code.NOT_CERTIFIED,
                f"the objective is {ours:.6g}, claimed {theirs:.6g}: the optimum grazes the band, or does not survive "
                "rounding; ask for more digits or a wider band",
            )
        agreeing = (
            f", {found.stats['starts_agreeing']:.0f} of {found.stats['starts']:.0f} starts agree"
            if "starts" in found.stats
            else ""
        )
        message = f"certified objective {ours:.6g}, claimed {self.spec.objective(claim):.6g}{agreeing}"
        return Status(Code.CONVERGED, message)

    def _where(self, certified: "pd.DataFrame", metric: str) -> str:
        """The worst case, where there are several."""
        values = read({metric: certified.loc[metric].to_numpy(dtype=float)})[metric]
        k = int(np.argmax(np.where(np.isnan(values), np.inf, values)))
        return f" at {certified.columns[k]}" if len(values) > 1 else ""


def _outside(met: Sequence[str]) -> Status:
    """Of a response that ran into an end stop or emptied a chamber: whatever it shows, the drive does not."""
    remedy = "shorten the horizon, take a smaller step, or start elsewhere, Step(..., start={'position': ...})"
    return Status(Code.NOT_CERTIFIED, f"{'; '.join(dict.fromkeys(met))}; {remedy}")
