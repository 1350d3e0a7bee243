"""`Simulator`: how many candidates respond to the references, at once and compiled, and what is read off them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pneuopt.codegen import Rollout
from pneuopt.codegen import Run as Rolled
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.margins import sensitivities
from pneuopt.control.metrics import About, batch_metrics
from pneuopt.control.reference import Step
from pneuopt.requirements import MaxSensitivity, Specification, read
from pneuopt.system import names
from pneuopt.tuning.candidates import MOST_SUBSTEPS, Space, fastest, inputs, spacing, substeps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
RUNAWAY = 1e12
READ = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl", "Ripple", "Excess")
FEW = 4  # candidates: their references then share the lanes of a processor, the shorter ones padded


class Simulator:
    """Compiled responses of many candidates to the references, and what the requirements read off them.

    What is measured is the plant's true signal, whatever the controller sees of it.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Step
    space : Space
    """

    def __init__(self, loop: ClosedLoop, references: Sequence[Step], space: Space) -> None:
        self._loop, self._references, self._space = loop, tuple(references), space
        self._rest = [_rest(loop, space, r) for r in references]
        self._rollout = Rollout(loop.discrete().pieces)
        self._spacing = [spacing(loop, r) for r in references]
        self._inputs = [inputs(loop, r, h) for r, h in zip(references, self._spacing, strict=True)]
        rate = fastest(loop, space, [x for k in range(len(self._references)) for x in self._visited(k)])
        self._substeps = [substeps(rate, h) for h in self._spacing]
        slowest = 1 / max(r.horizon for r in references)
        omega = np.geomspace(0.3 * slowest, max(rate, 1e3 * slowest), 150)
        self._sensitivities = sensitivities(loop, omega)

    def respond(self, points: Array, band: float) -> "Responses":
        """Simulate candidates.

        Parameters
        ----------
        points : ndarray, shape (m, n)
        band : float
            Half width of the settling band, a fraction of the step.
        """
        p, found = self._space.vectors(points), dict[int, Rolled]()
        for group in self._groups(len(points)):
            found |= self._run(group, points, p)
        return Responses(self, p, [self._measured(k, p, found[k], band) for k in range(len(self._references))])

    def values(self, points: Array, spec: Specification) -> dict[str, Array]:
        """What the requirements read, the worst over the references, shape (m,) each.

        Parameters
        ----------
        points : ndarray, shape (m, n)
        spec : Specification
            Its band counts, and whether the sensitivity does.
        """
        responses = self.respond(points, spec.band)
        every = np.ones(len(points), dtype=bool)
        return responses.robust(every) if spec.concerns(MaxSensitivity) else responses.values

    def table(self, point: Array, spec: Specification) -> list[dict[str, float]]:
        """The metrics of one candidate, a row a reference."""
        responses = self.respond(point[None], spec.band)
        peaks = responses.sensitivities(np.ones(1, dtype=bool))
        return [
            each(r.metrics | {"MaxSensitivity": peak})[0] for r, peak in zip(responses.references, peaks, strict=True)
        ]

    def sensitivities(self, p: Array, x_end: Array, commands: Array) -> Array:
        """Ms on a grid, about the states in which the responses end; an absent filter counts as in `cut`."""
        p, filtered = p.copy(), list(self._loop.parameters).index("pid.Tf")
        p[:, filtered] = np.where(p[:, filtered] == 0, 0.5 * (self._loop.pid.sample_time or 0.0), p[:, filtered])
        return self._sensitivities(p, x_end[:, : len(self._loop.plant.states)], commands)

    def _groups(self, m: int) -> list[list[int]]:
        """The references that run together: few candidates fill the lanes with all of them, many with those alike."""
        alike: dict[tuple[int, int], list[int]] = {}
        for k, (run, steps) in enumerate(zip(self._inputs, self._substeps, strict=True)):
            alike.setdefault((0, 0) if m < FEW else (len(run), steps), []).append(k)
        return list(alike.values())

    def _run(self, group: Sequence[int], points: Array, p: Array) -> dict[int, Rolled]:
        m, n = len(points), max(len(self._inputs[k]) for k in group)
        padded = [np.minimum(np.arange(n), len(self._inputs[k]) - 1) for k in group]
        steps = [np.where(np.arange(n) < len(self._inputs[k]), self._spacing[k], 0.0) for k in group]
        us = [self._inputs[k].matrix(names(self._loop.inputs))[rows] for k, rows in zip(group, padded, strict=True)]
        ts = [self._inputs[k].t[rows] for k, rows in zip(group, padded, strict=True)]
        u, t, h = (np.repeat(np.array(each), m, axis=0) for each in (us, ts, steps))
        starts, rows = np.concatenate([self._starts(k, points) for k in group]), np.tile(p, (len(group), 1))
        with np.errstate(all="ignore"):
            found = self._rollout.run(starts, u, rows, t, h, substeps=max(self._substeps[k] for k in group))
        parts = zip(group, np.split(found.y, len(group)), np.split(found.x_end, len(group)), strict=True)
        return {k: Rolled(y[:, : len(self._inputs[k])], x_end) for k, y, x_end in parts}

    def _measured(self, k: int, p: Array, found: Rolled, band: float) -> "Measured":
        """The figures of one reference; infinite where a response runs away."""
        reference, t, outputs = self._references[k], self._inputs[k].t, names(self._loop.outputs)
        with np.errstate(all="ignore"):
            tame: Mask = np.all(np.abs(found.y) < RUNAWAY, axis=(1, 2))
            sound: Mask = tame & np.isfinite(found.x_end).all(axis=1)
        signal, control = (found.y[:, :, outputs.index(n)] for n in (self._loop.feedback.name, "control"))
        metrics = {n: np.full(len(p), np.inf) for n in READ}
        late = t >= 0.8 * reference.horizon + 0.2 * reference.at
        for period, rows in self._periods(p, sound):
            measured = batch_metrics(
                t,
                signal[rows],
                reference.final,
                reference.initial,
                start=reference.at,
                band=band,
                about=About.REFERENCE,
                dither_period=period,
                control=control[rows],
            )
            error = np.abs(signal[rows][:, late] - reference.final).mean(axis=1)
            measured["Excess"] = error / abs(reference.size)
            for n in READ:
                metrics[n][rows] = measured[n]
        return Measured(metrics, sound, found.x_end, control[:, -1])

    def _periods(self, p: Array, sound: Mask) -> list[tuple[float | None, Mask]]:
        """Which of the sound candidates are averaged over which time."""
        if self._loop.dither is None:
            return [(None, sound)] if sound.any() else []
        order = list(self._loop.parameters)
        amplitude, frequency = (p[:, order.index(f"dither.{n}")] for n in ("amplitude", "frequency"))
        rates = np.where(amplitude == 0, 0.0, frequency)
        h = self._loop.pid.sample_time
        return [
            (self._loop.dither.period(rate, h) if rate else None, sound & (rates == rate))
            for rate in np.unique(rates[sound]).tolist()
        ]

    def _starts(self, k: int, points: Array) -> Array:
        rest, reference = self._rest[k], self._references[k]
        if rest is not None:
            return np.tile(rest, (len(points), 1))
        return np.array([_initial(self._loop, self._space, point, reference) for point in points])

    def _visited(self, k: int) -> list[Array]:
        """Some states along the response of the given gains, and the rest."""
        run, start = self._inputs[k], self._starts(k, self._space.start[None])
        h, u = np.full((1, len(run)), self._spacing[k]), run.matrix(names(self._loop.inputs))[None]
        p = self._space.vectors(self._space.start[None])
        found = self._rollout.run(start, u, p, run.t[None], h, substeps=MOST_SUBSTEPS, states=True).x
        assert found is not None
        along = found[0][:: max(1, len(run) // 10)]
        return [start[0], *along[np.isfinite(along).all(axis=1)]]


@dataclass(frozen=True, eq=False)
class Measured:
    """What one reference showed of m candidates.

    Attributes
    ----------
    metrics : dict of str to ndarray, shape (m,)
        Of `step_metrics`, and "Excess", the mean error near the end, for what never settles.
    sound : ndarray of bool, shape (m,)
        False where the response runs away.
    x_end : ndarray, shape (m, n_states)
    command : ndarray, shape (m,)
        Where the responses end.
    """

    metrics: dict[str, Array]
    sound: Mask
    x_end: Array
    command: Array


class Responses:
    """Simulated candidates; their sensitivities, a frequency response each, are computed only where asked for.

    Attributes
    ----------
    references : sequence of Measured
    values : dict of str to ndarray, shape (m,)
        What the requirements read but for the sensitivity, the worst over the references.
    """

    def __init__(self, simulator: Simulator, p: Array, references: Sequence[Measured]) -> None:
        self._simulator, self._p, self.references = simulator, p, references
        metrics = {n: np.max([r.metrics[n] for r in references], axis=0) for n in READ}
        self.values = {**read(metrics), "Excess": metrics["Excess"]}

    def robust(self, rows: Mask) -> dict[str, Array]:
        """The values of some candidates, with the sensitivity."""
        chosen = {n: value[rows] for n, value in self.values.items()}
        return chosen | {"MaxSensitivity": np.max(self.sensitivities(rows), axis=0)}

    def sensitivities(self, rows: Mask) -> Array:
        """Ms of some candidates, a row a reference; infinite where the response runs away."""
        found = np.full((len(self.references), len(rows)), np.inf)
        for peaks, measured in zip(found, self.references, strict=True):
            wanted = rows & measured.sound
            if wanted.any():
                ends = measured.x_end[wanted], measured.command[wanted]
                peaks[wanted] = self._simulator.sensitivities(self._p[wanted], *ends)
        return found[:, rows]


def each(values: Mapping[str, Array]) -> list[dict[str, float]]:
    """The values of one candidate after another."""
    rows = zip(*(value.tolist() for value in values.values()), strict=True)
    return [dict(zip(values, row, strict=True)) for row in rows]


def worst(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """The largest of each value over the references; NaN wins."""
    return {n: float(np.max([values[n] for values in found])) for n in found[0]}


def _rest(loop: ClosedLoop, space: Space, reference: Step) -> Array | None:
    """The loop's rest before the step where it does not depend on the gains."""
    other = space.draw(np.full(len(space.names), 0.7))
    first, second = (_initial(loop, space, point, reference) for point in (space.start, other))
    scale = np.array([q.nominal for q in loop.states])
    return first if bool(np.all(np.abs(first - second) <= 1e-9 * scale)) else None


def _initial(loop: ClosedLoop, space: Space, point: Array, reference: Step) -> Array:
    return loop.initial(space.filled(point), reference=reference.initial, start=reference.start)
