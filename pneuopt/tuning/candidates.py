"""Candidates of a tuning: where they lie, what they are as printed, and how they respond, many at once and compiled."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.codegen import Rollout
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.margins import sensitivities
from pneuopt.control.metrics import About, step_metrics
from pneuopt.control.reference import Step
from pneuopt.errors import require
from pneuopt.parameters import Parameter, ParameterSet
from pneuopt.requirements import MaxSensitivity, Specification, read
from pneuopt.system import Linearisation, names
from pneuopt.trajectories import Trajectory

Array = NDArray[np.float64]
Tell = Callable[[str], None]
STABLE = 2.0  # |lambda h| of an RK4 step, with a margin to 2.78
MOST_SUBSTEPS = 100
MOST_NEIGHBOURS = 1000
RUNAWAY = 1e12
LOST = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl", "MaxSensitivity", "Ripple", "Excess")
POINTS = 1000  # samples of a response where the loop has no sample time


@dataclass(frozen=True, eq=False)
class Space:
    """The free parameters of a tuning, as a box.

    Parameters
    ----------
    parameters : ParameterSet
        Every parameter of the loop; the free ones span the box.
    names : tuple of str
        The free ones that have an effect.
    """

    parameters: ParameterSet
    names: tuple[str, ...]

    @cached_property
    def bounds(self) -> Array:
        """Lower and upper bounds, shape (n, 2)."""
        return np.array([[self.parameters[n].lower, self.parameters[n].upper] for n in self.names]).reshape(-1, 2)

    @cached_property
    def start(self) -> Array:
        """The given values, shape (n,)."""
        return np.array([self.parameters.value(n) for n in self.names])

    def filled(self, point: Array) -> ParameterSet:
        """The loop's parameters with the free ones at `point`."""
        return self.parameters.with_values(dict(zip(self.names, np.clip(point, *self.bounds.T).tolist(), strict=True)))

    def draw(self, unit: Array) -> Array:
        """Points for numbers between 0 and 1, shape (..., n): along the range, or its logarithm where so flagged."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        tiny = np.where(log, low, 1.0)
        drawn: Array = np.where(log, tiny * (np.where(log, up, 1.0) / tiny) ** unit, low + (up - low) * unit)
        return np.clip(drawn, low, up)

    def unit(self, point: Array) -> Array:
        """The inverse of `draw`."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        safe = np.where(log, [low, up, point], 1.0)
        share: Array = np.where(
            log, np.log(safe[2] / safe[0]) / np.log(safe[1] / safe[0] + ~log), (point - low) / (up - low)
        )
        return share

    def corners(self) -> Array:
        """Every corner of the box and the start, shape (2**n + 1, n)."""
        return np.array([*itertools.product(*self.bounds), self.start])

    def printed(self, point: Array, digits: int, around: int = 0) -> Array:
        """The point with so many significant digits, and its neighbours up to `around` last places away.

        Examples
        --------
        >>> gains = ParameterSet({"pid.Kp": Parameter(0.39661, "1", 0.0, 1.0, free=True)})
        >>> Space(gains, ("pid.Kp",)).printed(np.array([0.39661]), 4, 1).ravel().tolist()
        [0.3965, 0.3966, 0.3967]
        """
        around = around if (2 * around + 1) ** len(point) <= MOST_NEIGHBOURS else 0
        choices = []
        for value, (low, up) in zip(point, self.bounds, strict=True):
            place = 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1) if value else 1.0
            steps = range(-around, around + 1) if value else (0,)
            near = [float(f"{value + k * place:.{digits}g}") for k in steps]
            choices.append([v for v in dict.fromkeys(near) if low <= v <= up] or [value])
        return np.array(list(itertools.product(*choices)))


def span(loop: ClosedLoop, parameters: ParameterSet) -> Space:
    """The box that the free parameters span, checked.

    Raises
    ------
    InputError
        If nothing is free, something is free that is neither the controller's nor the dither's, or a bound is missing.
    """
    full = loop.parameters | parameters.select(n for n in parameters if n in loop.parameters)
    free = tuple(n for n in parameters.free_names if n in loop.parameters)
    require(len(free) > 0, 'nothing is free; mark what may be tuned: parameters.freed("pid.K*", "dither.offset")')
    for n in free:
        require(
            n.startswith(("pid.", "dither.")),
            f"{n} is free, but tune changes the controller and the dither only; use parameters.fixed({n!r})",
        )
        p = full[n]
        require(
            bool(np.isfinite([p.lower, p.upper]).all()) and p.lower < p.upper,
            f"{n} is free within [{p.lower:g}, {p.upper:g}] {p.unit}: it needs two finite bounds, "
            f"parameters.with_bounds({{{n!r}: (lower, upper)}}), or fix it",
        )
        require(
            not p.log or p.lower > 0, f"{n}: a log parameter needs a positive lower bound, got {p.lower:g} {p.unit}"
        )
    return Space(full, free)


def measure(
    loop: ClosedLoop, parameters: ParameterSet, reference: Step, response: Trajectory, band: float
) -> dict[str, float]:
    """The metrics of a simulated response, the settling band around the reference.

    Parameters
    ----------
    response : Trajectory
        The loop's outputs.
    """
    return step_metrics(
        response.t,
        response[loop.feedback.name],
        reference.final,
        reference.initial,
        start=reference.at,
        band=band,
        about=About.REFERENCE,
        dither_period=loop.dither_period(parameters),
        control=response["control"],
    )


def cut(loop: ClosedLoop, parameters: ParameterSet, x: Array, command: float) -> Linearisation:
    """The open loop for margins, about a plant state x under a command.

    A sampled derivative without a filter is one over a sample, which lags by half of it: that counts as its filter.
    """
    h = loop.pid.sample_time
    unfiltered = h is not None and "pid.Tf" in parameters and parameters.value("pid.Tf") == 0
    filtered = parameters | ParameterSet({"pid.Tf": Parameter(0.5 * (h or 0.0), "s")}) if unfiltered else parameters
    return loop.open_loop(filtered, x, {loop.command.name: command})


def inputs(loop: ClosedLoop, reference: Step, step: float) -> Trajectory:
    """The loop's inputs under a reference; those that the reference does not name are zero."""
    run = reference.trajectory(step)
    others = [q.name for q in loop.inputs if q.name not in run]
    return run.with_columns({n: np.zeros(len(run)) for n in others})


def spacing(loop: ClosedLoop, reference: Step) -> float:
    """Samples' distance [s]: the controller's, or a fine one on which the step's instant lies."""
    if loop.pid.sample_time is not None:
        return loop.pid.sample_time
    if reference.at == 0:
        return reference.horizon / POINTS
    return reference.at / max(1, round(reference.at * POINTS / reference.horizon))


def fastest(loop: ClosedLoop, space: Space, states: Sequence[Array]) -> float:
    """The largest eigenvalue's size [1/s] of the loop, over the box's corners and the given states."""
    system = loop.system() if loop.pid.sample_time is None else loop.held()
    found = 0.0
    for corner in space.corners():
        parameters = space.filled(corner)
        for x in states:
            found = max(
                found, float(np.max(np.abs(np.linalg.eigvals(system.linearise(x, {}, parameters).A)), initial=0.0))
            )
    return found


def substeps(rate: float, h: float) -> int:
    """RK4 steps in a sample of length h so that the rate stays stable.

    Raises
    ------
    InputError
        If that takes too many; the message names the remedy.
    """
    k = int(np.ceil(rate * h / STABLE))
    require(
        k <= MOST_SUBSTEPS,
        f"within the bounds the loop has a mode as fast as {rate:.3g} 1/s, which takes {k} steps in {h:.3g} s, at most "
        f"{MOST_SUBSTEPS}; narrow the gains' bounds (raise the lower one of pid.Tf), smooth the friction, or shorten h",
    )
    return max(1, k)


class Simulator:
    """Compiled responses of many candidates to the references, and what the requirements read off them.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Step
    space : Space
    """

    def __init__(self, loop: ClosedLoop, references: Sequence[Step], space: Space) -> None:
        self._loop, self._references, self._space = loop, tuple(references), space
        self._rest = [_rest(loop, space, r) for r in references]
        self._system = loop.discrete()
        self._rollout = Rollout(self._system.pieces)
        moving = [x for r, rest in zip(references, self._rest, strict=True) for x in self._visited(r, rest)]
        rate = fastest(loop, space, moving)
        self._substeps = [substeps(rate, spacing(loop, r)) for r in references]
        slowest = 1 / max(r.horizon for r in references)
        self._omega = np.geomspace(0.3 * slowest, max(rate, 1e3 * slowest), 150)
        self._sensitivities = sensitivities(loop, self._omega)

    def values(self, points: Array, spec: Specification) -> list[dict[str, float]]:
        """What the requirements read, the worst over the references, of each candidate.

        Parameters
        ----------
        points : ndarray, shape (m, n)
        spec : Specification
            Its band counts, and whether the sensitivity does; "Excess" is the mean error near the end, for what never
            settles.
        """
        robust = spec.concerns(MaxSensitivity)
        found = [self._respond(k, points, spec.band, robust) for k in range(len(self._references))]
        return [worst([{**read(m), "Excess": m["Excess"]} for m in metrics]) for metrics in zip(*found, strict=True)]

    def table(self, point: Array, spec: Specification) -> list[dict[str, float]]:
        """The metrics of one candidate, a row a reference."""
        return [self._respond(k, point[None], spec.band, True)[0] for k in range(len(self._references))]

    def _respond(self, k: int, points: Array, band: float, robust: bool) -> list[dict[str, float]]:
        reference, m = self._references[k], len(points)
        sets = [self._space.filled(point) for point in points]
        h = spacing(self._loop, reference)
        run = inputs(self._loop, reference, h)
        u = np.tile(run.matrix(names(self._loop.inputs)), (m, 1, 1))
        p, t = np.array([self._loop.numbers(s) for s in sets]), np.tile(run.t, (m, 1))
        starts, steps = self._starts(k, reference, sets), np.full((m, len(run)), h)
        with np.errstate(all="ignore"):
            found = self._rollout.run(starts, u, p, t, steps, substeps=self._substeps[k])
            sound = (np.abs(found.y) < RUNAWAY).all(axis=(1, 2)) & np.isfinite(found.x_end).all(axis=1)
        outputs = names(self._loop.outputs)
        command = outputs.index("control")
        metrics = [dict.fromkeys(LOST, np.inf) for _ in points]
        for i in np.flatnonzero(sound).tolist():
            response = Trajectory(run.t, dict(zip(outputs, found.y[i].T, strict=True)))
            metrics[i] = self._read(sets[i], reference, response, band)
        if robust and sound.any():
            peaks = self._peaks(p[sound], found.x_end[sound], found.y[sound, -1, command])
            for i, peak in zip(np.flatnonzero(sound).tolist(), peaks.tolist(), strict=True):
                metrics[i]["MaxSensitivity"] = peak
        return metrics

    def _read(self, parameters: ParameterSet, reference: Step, response: Trajectory, band: float) -> dict[str, float]:
        metrics = measure(self._loop, parameters, reference, response, band)
        late = response.t >= 0.8 * reference.horizon + 0.2 * reference.at
        error = np.abs(response[self._loop.feedback.name][late] - reference.final)
        metrics["Excess"] = float(np.mean(error)) / abs(reference.size)
        return metrics

    def _peaks(self, p: Array, x_end: Array, commands: Array) -> Array:
        """Ms on a grid, about the states in which the responses end; an absent filter counts as in `cut`."""
        p, filtered = p.copy(), list(self._loop.parameters).index("pid.Tf")
        p[:, filtered] = np.where(p[:, filtered] == 0, 0.5 * (self._loop.pid.sample_time or 0.0), p[:, filtered])
        return self._sensitivities(p, x_end[:, : len(self._loop.plant.states)], commands)

    def _starts(self, k: int, reference: Step, sets: Sequence[ParameterSet]) -> Array:
        rest = self._rest[k]
        if rest is not None:
            return np.tile(rest, (len(sets), 1))
        return np.array([self._loop.initial(s, reference=reference.initial, start=reference.start) for s in sets])

    def _visited(self, reference: Step, rest: Array | None) -> list[Array]:
        """Some states along the response of the given gains, and the rest."""
        h = spacing(self._loop, reference)
        run = inputs(self._loop, reference, h)
        start = rest
        if start is None:
            start = self._loop.initial(self._space.parameters, reference=reference.initial, start=reference.start)
        p, u = self._loop.numbers(self._space.parameters), run.matrix(names(self._loop.inputs))
        found = self._rollout.run(
            start[None], u[None], p, run.t[None], np.full((1, len(run)), h), substeps=MOST_SUBSTEPS, states=True
        ).x
        states = (
            [] if found is None else [x for x in found[0][:: max(1, len(run) // 10)] if bool(np.all(np.isfinite(x)))]
        )
        return [start, *states]


def worst(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """The largest of each value over the references; NaN wins."""
    return {n: float(np.max([values[n] for values in found])) for n in found[0]}


def _rest(loop: ClosedLoop, space: Space, reference: Step) -> Array | None:
    """The loop's rest before the step where it does not depend on the gains."""
    first = loop.initial(space.parameters, reference=reference.initial, start=reference.start)
    other = space.filled(space.draw(np.full(len(space.names), 0.7)))
    second = loop.initial(other, reference=reference.initial, start=reference.start)
    scale = np.array([q.nominal for q in loop.states])
    return first if bool(np.all(np.abs(first - second) <= 1e-9 * scale)) else None
