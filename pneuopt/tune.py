"""`tune`: PID gains and dither found together, and proven by a simulation that shares nothing with the search.

A linear loop is tuned exactly (`TwoPhase`); any other, with friction, clip or sampling, by compiled screening
(`Screening`). Gains are handed out as printed: rounded first, then certified.
"""

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.certify import check_labels, evaluate
from pneuopt.checks import check_smooth
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.errors import ConvergenceError, PhysicsWarning, require
from pneuopt.nlp.status import Code, Status
from pneuopt.parameters import ParameterSet
from pneuopt.provenance import provenance
from pneuopt.requirements import PeakControl, Requirement, Specification, name, read, specify
from pneuopt.tuning.candidates import Space, Tell, span
from pneuopt.tuning.screening import Screening, merit, screen
from pneuopt.tuning.simulator import Simulator, each, worst
from pneuopt.tuning.two_phase import TwoPhase, is_linear, solve_two_phase

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Method = TwoPhase | Screening
ATTEMPTS = 3  # margins tried, each twice the one before
TRIED = 5  # printed gains certified at each margin, at most
ROUNDS = 3  # of looking around for printed gains that lose next to nothing
GRAZING = 0.01  # relative excess of the certified over the claimed settling time
PEAKS_EXACT, PEAKS_SCREENED = 1 / 300, 1 / 5  # of the margin, for peak control and sensitivity
UNFELT = ("dither.amplitude", "dither.frequency", "pid.Tt", "pid.lower", "pid.upper")  # by a linear loop's average
SHOWN = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl", "MaxSensitivity")


@dataclass(frozen=True, eq=False)
class TuningResult:
    """What `tune` found.

    Attributes
    ----------
    parameters : ParameterSet
        The given ones with the tuned values, as printed; the given ones unchanged where the status is not "converged".
    claimed, certified : DataFrame
        A row a metric, a column a reference: SettlingTime [s], Overshoot and SteadyStateError [% of the step],
        PeakControl [the command's unit], MaxSensitivity, with dither Ripple [the measured signal's unit]; by the
        search's own simulation, and by the independent one.
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


def tune(
    loop: ClosedLoop,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    minimise: Requirement | Mapping[Requirement, float],
    subject_to: Sequence[Requirement] = (),
    method: Method | None = None,
    throw: bool = True,
    progress: Tell | None = None,
) -> TuningResult:
    """Find the free gains, and dither, that do best on the references within the limits.

    Parameters
    ----------
    loop : ClosedLoop
        The requirements are read on its true measured signal; the controller acts on what the loop's sensor shows.
    references : Step or sequence of Step
        Each from rest, or from steady motion, and with a label of its own; the worst counts.
    parameters : ParameterSet
        Of plant, controller and dither. The free ones ("pid.*", "dither.*") are tuned and need two finite bounds each.
    minimise : Requirement, or mapping of Requirement to weight
    subject_to : sequence of Requirement
        Each with its `max`.
    method : TwoPhase or Screening, optional
        By default the first for a linear loop with a continuous controller, the second for any other.
    throw : bool
        Raise if nothing could be certified; otherwise the result says so in its status.
    progress : callable, optional
        Receives a line of text a generation or start.

    Returns
    -------
    TuningResult

    Raises
    ------
    InputError
        If parameters, bounds and requirements do not fit together; the message names the one.
    ConvergenceError
        If the limits cannot be kept, the independent simulation does not confirm them, or Ctrl-C cuts the screening
        short; the error's `solution` is the result, with the given gains unchanged: `claimed` and `certified` are
        those of the best point found, which is in its `stats`.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.requirements import Overshoot, PeakControl, SettlingTime
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> given = loop.parameters.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    >>> limits = [Overshoot(0.05), PeakControl(4.0)]
    >>> best = tune(loop, Step(1.0), given, minimise=SettlingTime(), subject_to=limits)
    >>> best.status.converged, bool(best.certified.loc["PeakControl", "0 to 1"] <= 4.0)
    (True, True)
    """
    begun = time.perf_counter()
    check_smooth(loop.plant)
    spec, steps = specify(minimise, subject_to), [references] if isinstance(references, Step) else list(references)
    spec = spec.without(PeakControl) if _clip(loop, parameters) <= spec.limit(PeakControl) else spec
    require(len(steps) > 0, "no reference to tune for; give a Step")
    check_labels(steps)
    space = span(loop, parameters)
    linear = is_linear(loop)
    method = method or (TwoPhase() if linear else Screening())
    require(
        linear or isinstance(method, Screening),
        "TwoPhase needs a linear loop with a continuous controller, and this one is not; use method=Screening()",
    )
    unfelt = tuple(n for n in space.names if n in UNFELT) if isinstance(method, TwoPhase) else ()
    felt = Space(space.parameters, tuple(n for n in space.names if n not in unfelt))
    require(len(felt.names) > 0, f"{', '.join(unfelt)}: without effect on a linear loop; free a gain as well")
    search = _Search(loop, tuple(steps), felt, spec, method, progress or (lambda _: None))
    result = search.run()
    note = f"; {', '.join(unfelt)} left as given: without effect on a linear loop's average" if unfelt else ""
    result = replace(
        result,
        parameters=parameters | result.parameters.select(felt.names if result.status.converged else ()),
        status=replace(result.status, message=result.status.message + note),
        stats={**result.stats, "seconds": time.perf_counter() - begun},
    )
    if throw and not result.status.converged:
        raise ConvergenceError(f"tuning {result.status}; the given gains stand", result)
    return result


def _clip(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """The largest command that the controller's own limits let through."""
    full = loop.parameters | parameters
    return max(abs(full.value("pid.lower")), abs(full.value("pid.upper"))) if loop.pid.limits else np.inf


@dataclass(frozen=True, eq=False)
class _Found:
    """What a search hands over: a point before rounding, what is active there, figures; whether it came to its end."""

    point: Array
    status: Status
    active: tuple[str, ...]
    stats: Mapping[str, float]
    is_complete: bool = True


@dataclass(frozen=True, eq=False)
class _Search:
    """One tuning: search, print, certify, and again with a wider margin where the certificate fails."""

    loop: ClosedLoop
    references: tuple[Step, ...]
    space: Space
    spec: Specification
    method: Method
    tell: Tell

    def run(self) -> TuningResult:
        simulator = Simulator(self.loop, self.references, self.space)
        result, start, counts = None, self.space.start, dict[str, float]()
        for attempt in range(ATTEMPTS):
            margin = min(self.method.margin * 2**attempt, 0.5)
            found = self._search(simulator, attempt, margin, start)
            counts = {k: v for k, v in found.stats.items() if k.startswith("starts")} | counts
            found = replace(found, stats={**found.stats, **counts, "margin": margin})
            if not found.is_complete:
                return self._cut_short(simulator, found)
            if not found.status.converged:
                return result or self._result(simulator, found, found.point)
            for point in self._printed(simulator, found, margin):
                result = self._result(simulator, found, point)
                if result.status.converged or "contacts" in result.stats:
                    return result
            start = found.point
        assert result is not None
        return result

    def _cut_short(self, simulator: Simulator, found: _Found) -> TuningResult:
        """The best so far, as printed, with its certificate; not handed out, for nobody has chosen it."""
        digits = self.method.digits
        best = self._result(simulator, found, self.space.printed(found.point, digits) if digits else found.point)
        verdict = f"{'holds' if best.status.converged else 'does not hold'}: {best.status.message}"
        count = f"{found.stats['simulations']:.0f} simulations"
        status = Status(Code.INTERRUPTED, f"the best of {count} so far {verdict}; run again for an answer")
        values = {f"rejected.{n}": best.parameters.value(n) for n in self.space.names if best.status.converged}
        return replace(best, parameters=self.space.parameters, status=status, stats={**values, **best.stats})

    def _search(self, simulator: Simulator, attempt: int, margin: float, start: Array) -> _Found:
        if isinstance(self.method, TwoPhase):
            return self._two_phase(attempt, margin, start)
        return self._screen(simulator, margin, start)

    def _two_phase(self, attempt: int, margin: float, start: Array) -> _Found:
        assert isinstance(self.method, TwoPhase)
        method = self.method if attempt == 0 else replace(self.method, starts=1)
        space = Space(self.space.filled(start), self.space.names)
        optima = solve_two_phase(self.loop, self.references, space, self._tightened(margin), method, self.tell)
        best, values = optima.best, optima.best.parameters
        stats = {
            "starts": float(optima.starts),
            "starts_converged": float(optima.converged),
            "starts_agreeing": float(optima.agreeing),
            "optimum": best.stats.get("cost", np.nan),
            "iterations": best.stats.get("iterations", 0.0),
        }
        point = np.array([values.value(n) for n in self.space.names])
        return _Found(point, best.status, tuple(best.multipliers), stats)

    def _tightened(self, margin: float) -> Specification:
        """An exact problem needs next to no room on peaks; a screening's coarser simulation needs some."""
        return self.spec.tightened(
            margin, margin * (PEAKS_EXACT if isinstance(self.method, TwoPhase) else PEAKS_SCREENED)
        )

    def _screen(self, simulator: Simulator, margin: float, start: Array) -> _Found:
        assert isinstance(self.method, Screening)
        spec = self._tightened(margin)
        found = screen(simulator, self.references, self.space, spec, self.method, start, self.tell)
        values = each(simulator.values(found.point[None], spec))[0]
        stats = {"simulations": float(found.count), "optimum": spec.objective(values)}
        status, active = _screened(self.spec, values), _active(self.space, spec, found.point, values)
        return _Found(found.point, status, active, stats, found.is_complete)

    def _printed(self, simulator: Simulator, found: _Found, margin: float) -> Iterator[Array]:
        """The gains as printed; where those break a limit or lose too much, what a last place more or less mends."""
        digits, spec, tried = self.method.digits, self._tightened(margin / 2), list[list[float]]()
        if digits is None:
            yield found.point
            return
        scale = min(r.horizon - r.at for r in self.references)
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
            yield nearest

    def _result(self, simulator: Simulator, found: _Found, point: Array) -> TuningResult:
        import pandas as pd

        parameters = self.space.filled(point)
        shown = [*SHOWN, "Ripple"] if self.loop.dither_period(parameters) else list(SHOWN)
        rows = zip(self.references, simulator.table(point, self.spec), strict=True)
        claimed = pd.DataFrame({r.label: metrics for r, metrics in rows}).loc[shown]
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
            provenance(self.method, *self.spec.weights, *self.spec.limits, *self.references),
        )

    def _certified(self, parameters: ParameterSet) -> tuple["pd.DataFrame", list[str]]:
        """The certificate, and what the responses ran into."""
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", PhysicsWarning)
            certified = evaluate(self.loop, self.references, parameters, band=self.spec.band)
        return certified, [str(w.message) for w in told if issubclass(w.category, PhysicsWarning)]

    def _verdict(self, found: _Found, claimed: "pd.DataFrame", certified: "pd.DataFrame") -> Status:
        """Whether the independent simulation confirms the search."""
        if not found.status.converged:
            return found.status
        claim, proof = (worst([read(dict(f[r])) for r in f]) for f in (claimed, certified))
        for q in self.spec.violated(proof):
            n, limit = name(q), q.max or 0.0
            return Status(
                Code.NOT_CERTIFIED,
                f"{n} is {proof[n]:.6g}, allowed {limit:.6g}, claimed {claim[n]:.6g}; give {n} more room",
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
        return Status(
            Code.CONVERGED, f"certified objective {ours:.6g}, claimed {self.spec.objective(claim):.6g}{agreeing}"
        )


def _outside(met: Sequence[str]) -> Status:
    """Of a response that ran into an end stop or emptied a chamber: whatever it shows, the drive does not."""
    remedy = "shorten the horizon, take a smaller step, or start elsewhere, Step(..., start={'position': ...})"
    return Status(Code.NOT_CERTIFIED, f"{'; '.join(dict.fromkeys(met))}; {remedy}")


def _screened(spec: Specification, values: Mapping[str, float]) -> Status:
    """What a screening achieved: it keeps the limits, or the closest it came."""
    broken = [f"{name(q)} {values[name(q)]:.6g}, allowed {q.max:.6g}" for q in spec.violated(values)]
    if broken:
        return Status(Code.INFEASIBLE, f"the closest found has {'; '.join(broken)}; relax a limit or widen the bounds")
    if not np.isfinite(spec.objective(values)):
        return Status(
            Code.NOT_CONVERGED, "nothing found settles; widen the band or the bounds, or lengthen the horizon"
        )
    return Status(Code.CONVERGED)


def _active(space: Space, spec: Specification, point: Array, values: Mapping[str, float]) -> tuple[str, ...]:
    """Limits within 2 % of being reached, gains within 0.1 % of their range of a bound."""
    limits = [name(q) for q in spec.limits if values[name(q)] >= 0.98 * (q.max or 0.0)]
    low, up = space.bounds.T
    near = np.minimum(point - low, up - point) <= 1e-3 * (up - low)
    return (*limits, *(n for n, held in zip(space.names, near, strict=True) if held))
