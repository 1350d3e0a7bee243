"""`tune`: PID gains and dither found together, and proven by a simulation that shares nothing with the search.

A linear loop is tuned exactly (`TwoPhase`); any other, with friction, clip or sampling, by compiled screening
(`Screening`). Gains are handed out as printed: rounded first, then certified.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pneuopt.certificate import GRAZING, Found, Notary, TuningResult
from pneuopt.checks import check_smooth
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.errors import ConvergenceError, require
from pneuopt.nlp.status import Code, Status
from pneuopt.parameters import ParameterSet
from pneuopt.requirements import PeakControl, Requirement, most, name, told
from pneuopt.scenarios import NOMINAL, Scenarios
from pneuopt.specification import Specification, specify
from pneuopt.tuning.candidates import Space, Tell, span
from pneuopt.tuning.cases import cases
from pneuopt.tuning.condensed import Condensed, check_differentiable, condense, is_differentiable
from pneuopt.tuning.screening import Screening, merit, screen
from pneuopt.tuning.simulator import Simulator, each
from pneuopt.tuning.two_phase import TwoPhase, check_exact, is_exact, is_linear, solve_two_phase

__all__ = ["TuningResult", "tune"]
Array = NDArray[np.float64]
Method = TwoPhase | Screening | Condensed
ATTEMPTS = 3  # margins tried, each twice the one before
TRIED = 5  # printed gains certified at each margin, at most
ROUNDS = 3  # of looking around for printed gains that lose next to nothing
SLACK = 1e-4  # by which a search may end on the wrong side of a limit; the certificate decides
PEAKS_EXACT, PEAKS_SCREENED = 1 / 300, 1 / 5  # of the margin, for peak control and sensitivity
FEW_GAINS = 6  # up to which one plant is tuned as well without gradients; with 8 on T32 it takes twice the time
UNFELT = ("dither.amplitude", "dither.frequency", "pid.Tt", "pid.lower", "pid.upper")  # by a linear loop's average


def tune(
    loop: ClosedLoop,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    minimise: Requirement | Mapping[Requirement, float],
    subject_to: Sequence[Requirement] = (),
    scenarios: Scenarios = NOMINAL,
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
        Each with its bound, `max` or `min`.
    scenarios : mapping of str to mapping, optional
        Plants beside the nominal one, or tolerances of the gains: of `corners`, `samples`, `draws`, `tolerances`, or
        several of them joined with ``|``. The worst over references and scenarios counts.
    method : TwoPhase, Screening or Condensed, optional
        By default the first for one linear plant with a continuous controller, if it has equations for all that is
        asked for; else the last for scenarios or many gains where all is differentiable, and the second.
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
    space = span(loop, parameters)
    cases(steps, scenarios, space.parameters, space.names)
    method = _checked(method, loop, scenarios, space, spec)
    unfelt = tuple(n for n in space.names if n in UNFELT) if isinstance(method, TwoPhase) else ()
    felt = Space(space.parameters, tuple(n for n in space.names if n not in unfelt))
    require(len(felt.names) > 0, f"{', '.join(unfelt)}: without effect on a linear loop; free a gain as well")
    notary = Notary(loop, tuple(steps), scenarios, felt, spec, method)
    result = _Search(notary, felt, spec, method, progress or (lambda _: None)).run()
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


def _checked(
    method: Method | None, loop: ClosedLoop, scenarios: Scenarios, space: Space, spec: Specification
) -> Method:
    """The method, by default what suits the loop."""
    linear = is_linear(loop)
    if isinstance(method, TwoPhase):
        told = "TwoPhase needs a linear loop with a continuous controller, and this one is not; use method=Screening()"
        require(linear, told)
        require(not scenarios, "TwoPhase tunes for one plant, not for scenarios; leave method= out")
        check_exact(spec)
    if isinstance(method, Condensed):
        check_differentiable(space, spec)
    if method is not None:
        return method
    if linear and not scenarios and is_exact(spec):
        return TwoPhase()
    many = bool(scenarios) or len(space.names) > FEW_GAINS
    return Condensed() if many and is_differentiable(space, spec) else Screening()


def _clip(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """The largest command that the controller's own limits let through."""
    full = loop.parameters | parameters
    return max(abs(full.value("pid.lower")), abs(full.value("pid.upper"))) if loop.pid.limits else np.inf


@dataclass(frozen=True, eq=False)
class _Search:
    """One tuning: search, print, certify, and again with a wider margin where the certificate fails."""

    notary: Notary
    space: Space
    spec: Specification
    method: Method
    tell: Tell

    def run(self) -> TuningResult:
        loop, references = self.notary.loop, self.notary.references
        simulator = Simulator(loop, references, self.space, self.notary.scenarios, self.spec)
        result, start, counts = None, self.space.start, dict[str, float]()
        for attempt in range(ATTEMPTS):
            margin = min(self.method.margin * 2**attempt, 0.5)
            found = self._search(simulator, attempt, margin, start)
            counts = {k: v for k, v in found.stats.items() if k.startswith("starts")} | counts
            found = replace(found, stats={**found.stats, **counts, "margin": margin})
            if not found.is_complete:
                return self._cut_short(simulator, found)
            if not found.status.converged:
                return result or self.notary.result(simulator, found, found.point)
            for point in self._printed(simulator, found, margin):
                result = self.notary.result(simulator, found, point)
                if result.status.converged or "contacts" in result.stats:
                    return result
            start = found.point
        assert result is not None
        return result

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
            self.notary.loop, self.notary.references, space, self._tightened(margin), method, self.tell
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

    def _tightened(self, margin: float) -> Specification:
        """An exact problem needs next to no room on peaks; a screening's coarser simulation needs some."""
        return self.spec.tightened(
            margin, margin * (PEAKS_EXACT if isinstance(self.method, TwoPhase) else PEAKS_SCREENED)
        )

    def _screen(self, simulator: Simulator, margin: float, start: Array) -> Found:
        assert not isinstance(self.method, TwoPhase)
        spec = self._tightened(margin)
        arguments = (simulator, self.notary.references, self.space, spec)
        if isinstance(self.method, Condensed):
            found = condense(*arguments, self.method, start, self.tell)
        else:
            found = screen(*arguments, self.method, start, self.tell)
        values = each(simulator.values(found.point[None], spec))[0]
        stats = {"simulations": float(found.count), "optimum": spec.objective(values)}
        status, active = _screened(self.spec, values), _active(self.space, spec, found.point, values)
        return Found(found.point, status, active, stats, found.is_complete)

    def _printed(self, simulator: Simulator, found: Found, margin: float) -> Iterator[Array]:
        """The gains as printed; where those break a limit or lose too much, what a last place more or less mends."""
        digits, spec, tried = self.method.digits, self._tightened(margin / 2), list[list[float]]()
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
            yield nearest


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
