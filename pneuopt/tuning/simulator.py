"""`Simulator`: compiled simulation of many candidates at once, on every reference and scenario.

`Responses`: the metrics of simulated candidates, a lane each candidate and case, and their worst over the cases.

`PointFinder`: the operating points of lanes (`operating_points` in evaluation/margins.py). A search keeps few states
along a response: the fastest sample is read off the outputs, and the states there come from a second run, from the last
kept ones up to it. Under dither further runs go through the period around it, and through the one after the end, off
which the ripple is read.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pneuopt.control.averaging import is_affine
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.system import names
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.margins import (
    batch_margin_function,
    first_largest,
    lowest_noise_frequency,
    without_ripple,
)
from pneuopt.evaluation.metric import Band, Source, move_towards
from pneuopt.evaluation.metrics import check_channels
from pneuopt.evaluation.requirements import METRICS, ROBUSTNESS_REQUIREMENTS, larger_is_better, requirement_values
from pneuopt.evaluation.response import cases
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import RIPPLE_ALLOWANCE, SAMPLES_A_DITHER_PERIOD
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.tuning.space import (
    CONTROL_OUTPUT,
    SIGNAL_OUTPUT,
    LoopLanes,
    ReferenceGrid,
    Space,
    dither_resolution_rate,
    fastest_eigenvalue,
    is_sound,
    reference_grids,
    refine_grids,
    rk4_substeps,
    speed_output,
    starts_before_step,
)
from pneuopt.tuning.tolerances import (
    KEPT_STATES,
    MAX_LOOP_SUBSTEPS,
    MAX_SAMPLE_ANGLE,
    STIFFEST_CORNERS,
)


class ResponsePoints(NamedTuple):
    """Where m lanes begin, move fastest and end.

    States (m, k, n_states) are those of every `KEPT_STATES`-th sample, `fastest` (m,) is the one of the largest speed.
    """

    states: Array
    ends: Array
    fastest: Indices
    command: Array

    @staticmethod
    def empty(m: int, n: int, n_states: int) -> "ResponsePoints":
        """Arrays for m lanes of n samples to be filled in."""
        states = np.zeros((m, -(-n // KEPT_STATES), n_states)), np.zeros((m, n_states))
        return ResponsePoints(*states, np.zeros(m, dtype=np.intp), np.zeros(m))

    def select(self, rows: Indices | Mask) -> "ResponsePoints":
        """The points of some lanes."""
        return ResponsePoints(self.states[rows], self.ends[rows], self.fastest[rows], self.command[rows])


@dataclass(frozen=True, eq=False)
class PointFinder:
    """Function that gives the operating points of simulated lanes, by a second run up to the fastest sample.

    `rate` [1/s] is the fastest eigenvalue that RK4 has to resolve.
    """

    loop: ClosedLoop
    rollout: Rollout
    rate: float

    def __call__(
        self, grids: Sequence[tuple[ReferenceGrid, Indices]], p: Array, periods: Array, response_points: ResponsePoints
    ) -> tuple[Array, Array]:
        """The plant's states (k, m, n_states) and inputs at rest, sliding, and at the end; if affine at the end.

        Each grid comes with its lanes; p (m, n_parameters) and averaging times (m,) [s], 0 without, are the lanes'.
        """
        plant, is_curved = self.loop.plant, not is_affine(self.loop.plant)
        slides, order = is_curved and plant.axis is not None, list(self.loop.parameters)
        count = 1 + is_curved + slides
        x, u = (np.zeros((count, len(p), len(signals))) for signals in (plant.states, plant.inputs))
        for grid, rows in grids:
            own = response_points.select(rows)
            end, reach = self._at_end(grid, p[rows], periods[rows], own)
            states = list[Array]()
            if is_curved:  # before the step, with the dither switched off
                quiet, held, none = p[rows], np.zeros((len(rows), 1, grid.u.shape[1])), np.zeros((len(rows), 1))
                quiet[:, [order.index(n) for n in (DITHER_AMPLITUDE, DITHER_OFFSET) if n in order]] = 0.0
                held[:, 0, 0] = grid.reference.origin
                start = own.states[:, 0]
                control = self.rollout.run(start, held, quiet, none, none).y[:, 0, CONTROL_OUTPUT]
                states.append(np.column_stack([start[:, : len(plant.states)], control]))
            if slides:
                states.append(self._sliding(grid, p[rows], periods[rows], own, reach))
            along = np.array([*states, end])
            x[:, rows] = along[:, :, :-1]
            disturbances = dict(zip(names(self.loop.inputs), grid.u[-1].tolist(), strict=True))
            for k, name in enumerate(names(plant.inputs)):
                u[:, rows, k] = along[:, :, -1] if name == self.loop.command.name else disturbances[name]
                if name != self.loop.command.name and is_curved:
                    u[0, rows, k] = 0.0  # the disturbance has not begun
        return x, u

    def _sliding(self, grid: ReferenceGrid, p: Array, periods: Array, own: ResponsePoints, reach: Array) -> Array:
        """The plant's state and the command at the fastest sample, without ripple.

        Lanes are run up to it, or to half a period before it, and wait there for the latest between two samples of a
        held controller, which would act again at a sample; it has not acted yet in lanes that go on from there.
        """
        begin = np.maximum(own.fastest - np.round(periods / 2 / grid.spacing).astype(np.intp), 0)
        kept, lanes = begin // KEPT_STATES, np.arange(len(p))
        left = (begin - kept * KEPT_STATES)[:, None]
        number, (u, t, h) = np.arange(left.max() + 1), grid.pad(len(grid.t))
        at = kept[:, None] * KEPT_STATES + np.minimum(number, left)
        waits = number + (periods > 0)[:, None] > left
        instants = t[at] + (0.5 * grid.spacing * waits if self.loop.pid.sample_time is not None else 0.0)
        with np.errstate(all="ignore"):
            substeps = rk4_substeps(self.rate, grid.spacing)
            steps = np.where(number < left, h[at], 0.0)
            run = self.rollout.run(own.states[lanes, kept], u[at], p, instants, steps, substeps=substeps)
        ends = run.x_end
        out = np.column_stack([ends[:, : len(self.loop.plant.states)], run.y[:, -1, CONTROL_OUTPUT]])
        for period, rows in _by_period(periods):
            along = self._period(grid, ends[rows], p[rows], grid.t[begin[rows]], period)
            share = (grid.t[own.fastest[rows]] - grid.t[begin[rows]]) / period
            place, lane = share * (along.shape[1] - 1), np.arange(len(along))
            k = np.minimum(place.astype(np.intp), along.shape[1] - 2)
            there = along[lane, k] + (place - k)[:, None] * (along[lane, k + 1] - along[lane, k])
            _put_finite(out, rows, move_towards(there, _mean(along), reach[rows]))
        return out

    def _at_end(self, grid: ReferenceGrid, p: Array, periods: Array, own: ResponsePoints) -> tuple[Array, Array]:
        """The plant's state and the command at the end, without ripple, and how far ripple lets them be moved.

        Under dither one period more is run; half the change over it is subtracted from its mean, to belong to the end.
        """
        out = np.column_stack([own.ends[:, : len(self.loop.plant.states)], own.command])
        reach = np.zeros_like(out)
        for period, rows in _by_period(periods):
            along = self._period(grid, own.ends[rows], p[rows], np.full(len(rows), grid.t[-1]), period)
            change = along[:, -1] - along[:, 0]
            drift = change[:, None] * np.linspace(-0.5, 0.5, along.shape[1])[:, None]
            _put_finite(reach, rows, RIPPLE_ALLOWANCE / 2 * np.ptp(along - drift, axis=1))
            _put_finite(out, rows, move_towards(out[rows], _mean(along) - change / 2, reach[rows]))
        return out, reach

    def _period(self, grid: ReferenceGrid, x: Array, p: Array, t: Array, period: float) -> Array:
        """The plant's states and the command along one period from t on, shape (m, n, n_plant_states + 1)."""
        held = self.loop.pid.sample_time is not None
        n = max(1, round(period / grid.spacing)) if held else SAMPLES_A_DITHER_PERIOD
        h = grid.spacing if held else period / n
        u, steps = np.tile(grid.u[-1], (len(p), n + 1, 1)), np.tile([h] * n + [0.0], (len(p), 1))
        with np.errstate(all="ignore"):
            run = self.rollout.run(
                x, u, p, t[:, None] + h * np.arange(n + 1), steps, substeps=rk4_substeps(self.rate, h), states=True
            )
        assert run.x is not None
        plant = run.x[:, :, : len(self.loop.plant.states)]
        return np.concatenate([plant, run.y[:, :, CONTROL_OUTPUT, None]], axis=2)


def _by_period(periods: Array) -> Iterator[tuple[float, Indices]]:
    """Each period that is averaged over, and its lanes."""
    for period in np.unique(periods[periods > 0]).tolist():
        yield period, np.flatnonzero(periods == period)


def _mean(along: Array) -> Array:
    return np.asarray(np.trapezoid(along, axis=1) / (along.shape[1] - 1))


def _put_finite(out: Array, rows: Indices, values: Array) -> None:
    """Put values into their rows, but those of lanes that run away."""
    tame = np.isfinite(values).all(axis=1)
    out[rows[tame]] = values[tame]


class Responses:
    """The metrics of candidates on the cases that were run, `lanes` (m, n_cases); margins come only on request.

    `values` are the requirements' values (m,) without margins, the worst over those cases.
    """

    def __init__(self, lanes: Mask, p: Array, measured: "LaneMetrics", margins: "MarginReader") -> None:
        self._lanes, self._p, self._measured, self._margins = lanes, p, measured, margins
        metrics = {n: self.table(n).max(axis=1) for n in measured.metrics}
        self.values = {**requirement_values(metrics), "Excess": metrics["Excess"]}

    def table(self, metric: str) -> Array:
        """One metric, shape (m, n_cases); minus infinity where a case was not run."""
        return self.to_table(self._measured.metrics[metric])

    def by_case(self) -> dict[str, Array]:
        """The requirements' values in each lane, shape (n_lanes,), candidate by candidate, margins left out."""
        metrics = self._measured.metrics
        return {**requirement_values(metrics), "Excess": metrics["Excess"]}

    def with_margins(self, rows: Mask) -> dict[str, Array]:
        """The requirements' values of some candidates with their margins, the worst over the cases that were run."""
        chosen = {n: value[rows] for n, value in self.values.items()}
        margins = requirement_values(self.margin_metrics(rows))
        ran = self._lanes[rows]
        return chosen | {n: np.max(np.where(ran, table, -np.inf), axis=1) for n, table in margins.items()}

    def margin_metrics(self, rows: Mask) -> dict[str, Array]:
        """Margins and peaks of some candidates, shape (m, n_cases); NaN and infinite where the response runs away."""
        measured, names = self._measured, self._margins.names
        found = {n: np.full(len(measured.sound), np.nan if larger_is_better(n) else np.inf) for n in names}
        row, case = np.nonzero(self._lanes)
        wanted = measured.sound & rows[row]
        if wanted.any():
            for n, value in self._margins.read(
                self._p[wanted], case[wanted], measured.response_points.select(wanted)
            ).items():
                found[n][wanted] = value
        return {n: self.to_table(value)[rows] for n, value in found.items()}

    def to_table(self, lanes: Array) -> Array:
        """Arrange numbers of the lanes as a table, shape (m, n_cases); minus infinity where a case was not run."""
        table = np.full(self._lanes.shape, -np.inf)
        table[self._lanes] = lanes
        return table


@dataclass(frozen=True, eq=False)
class LaneMetrics:
    """The metrics (m,) of lanes, which of them do not run away, and the points of their responses.

    "Excess" is the mean error near the end, by which responses that never settle are graded.
    """

    metrics: dict[str, Array]
    sound: Mask
    response_points: ResponsePoints

    @staticmethod
    def empty(m: int, n: int, n_states: int, read: Sequence[str]) -> "LaneMetrics":
        """Metrics of m lanes of n samples to be filled in; until then they read as running away."""
        response_points = ResponsePoints.empty(m, n, n_states)
        return LaneMetrics({name: np.full(m, np.inf) for name in read}, np.zeros(m, dtype=bool), response_points)


def to_records(values: Mapping[str, Array]) -> list[dict[str, float]]:
    """Turn a dict of arrays into a dict of numbers for each candidate."""
    rows = zip(*(value.tolist() for value in values.values()), strict=True)
    return [dict(zip(values, row, strict=True)) for row in rows]


def worst_values(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """The largest of each value over the cases; NaN where one of them is NaN."""
    return {n: float(np.max([values[n] for values in found])) for n in found[0]}


@dataclass(frozen=True, eq=False)
class MarginReader:
    """Function of lanes' parameters, cases (m,) and points that gives margins and peaks, the worst over the points."""

    names: tuple[str, ...]
    read: Callable[[Array, Indices, ResponsePoints], Mapping[str, Array]]


HEADLINES = {name: metric.source is Source.LINEAR_LOOP for name, metric in METRICS.items() if metric.headline}
BASE_METRICS = (*(name for name, linear in HEADLINES.items() if not linear), "SettlingTimeRaw", "Ripple", "Excess")
BASE_MARGINS = tuple(name for name, linear in HEADLINES.items() if linear)
LaneRun = tuple[Array, Array, Array]  # states at every `KEPT_STATES`-th sample, outputs and end states of lanes


class Simulator:
    """Simulate many candidates, compiled, on every reference and every scenario's plant, and read their metrics.

    The plant's true signal counts, whatever a sensor shows the controller of it; margins stand apart, for their cost.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        references: Sequence[Reference],
        space: Space,
        scenarios: Scenarios = NO_SCENARIOS,
        spec: Specification | None = None,
    ) -> None:
        linearised, kinds = [k.metric.name for k in ROBUSTNESS_REQUIREMENTS], spec.metric_names if spec else ()
        self.response_metrics = tuple(dict.fromkeys((*BASE_METRICS, *(k for k in kinds if k not in linearised))))
        self.margin_metrics = tuple(dict.fromkeys((*BASE_MARGINS, *(k for k in kinds if k in linearised))))
        self._envelope = spec.envelope if spec else ()
        self._wider: tuple[Band, ...] = ()
        self._is_refined = False
        self.cases = cases(references, scenarios, space.parameters, space.names)
        self.loop, self.space = loop, space
        self._rest = starts_before_step(self.cases, loop, space)
        check_channels(loop.plant, self.response_metrics)
        self.sampled = LoopLanes(loop, self.response_metrics)
        self.rollout = self.sampled.rollout
        self.grids = reference_grids(loop, references, space.parameters)
        self._grid_index = np.tile(np.arange(len(references)), len(self.cases) // max(1, len(references)))
        self._rate = max(self._fastest_eigenvalue(references), dither_resolution_rate(loop, space.parameters))
        self.substeps = [rk4_substeps(self._rate, grid.spacing) for grid in self.grids]
        horizon, h = max(r.horizon for r in references), loop.pid.sample_time
        slowest, lowest = 1 / horizon, lowest_noise_frequency(horizon)
        fastest = max(self._rate, 1e3 * slowest, MAX_SAMPLE_ANGLE / h if h else 0.0)
        # from the frequency on at which a slow integral swings against a resting drive
        slow, fast = np.geomspace(3e-5 * slowest, 0.97 * lowest, 60), np.geomspace(lowest, fastest, 150)
        self.robustness = batch_margin_function(loop, np.concatenate([slow, fast]), lowest)  # about `operating_points`
        self._find_points = PointFinder(loop, self.rollout, self._rate)

    def coarse(self, spec: Specification, bands: Sequence[Band] = ()) -> "Simulator":
        """A copy for use during a search, with half as many samples, which reads only what `spec` asks for.

        With `bands` SettlingTime is the mean over these and the band asked for (`penalty_settling_time`).
        """
        part = copy.copy(self)
        part._wider = tuple(bands)
        part.response_metrics = tuple(
            dict.fromkeys(("SettlingTime", "Excess", *(n for n in spec.metric_names if n in self.response_metrics)))
        )
        if not self._is_refined:
            part.grids = reference_grids(
                self.loop, [g.reference for g in self.grids], self.space.parameters, SAMPLES_A_DITHER_PERIOD // 2
            )
        part.substeps = [rk4_substeps(self._rate, grid.spacing) for grid in part.grids]
        return part

    def bands(self, band: Band) -> tuple[Band, ...]:
        """The settling bands over which SettlingTime is averaged."""
        return (band, *self._wider)

    def cut(self, duration: float) -> "Simulator":
        """A copy that runs and reads so much of each response after the step [s], at most."""
        part = copy.copy(self)
        part.grids = [grid.cut(duration) for grid in self.grids]
        return part

    def refine(self, point: Array) -> "Simulator":
        """A copy whose samples are close enough for responses as fast as those of a point; itself where they are.

        A dither's samples are close anyway, and a sampled loop is no faster than its samples.
        """
        if self.loop.pid.sample_time is not None or any(self.dither_periods()):
            return self

        def read_signal(case: int, grid: ReferenceGrid) -> Array | None:
            p, start = self.lanes(point[None], np.zeros(1, dtype=np.intp), np.full(1, case))
            found, sound = self.sampled.run(grid, start, p, rk4_substeps(self._rate, grid.spacing))
            return found.y[0, :, SIGNAL_OUTPUT] if sound[0] else None

        part = copy.copy(self)
        part.grids = refine_grids(self.grids, self.cases_by_grid(), read_signal)
        part._is_refined = part.grids is not self.grids
        return part if part._is_refined else self

    def shorten_steps(self) -> "Simulator":
        """A copy whose longest RK4 steps are half as long; itself where that takes too many."""
        if 2 * max(self.substeps) > MAX_LOOP_SUBSTEPS:
            return self
        part = copy.copy(self)
        part._rate = max(2 * self._rate, 1.5 * RK4_MAX_H_LAMBDA / max(grid.spacing for grid in self.grids))
        part.substeps = [rk4_substeps(part._rate, grid.spacing) for grid in part.grids]
        part._find_points = PointFinder(self.loop, self.rollout, part._rate)
        return part

    def cases_by_grid(self) -> list[Mask]:
        """Which cases run on each grid, that is on each reference: a mask of shape (n_cases,) a grid."""
        return [self._grid_index == g for g in range(len(self.grids))]

    def dither_periods(self) -> list[float]:
        """The time over which each case is averaged [s]; 0 without dither, or where its amplitude is fixed at 0."""
        order, dither = list(self.space.parameters), self.loop.dither
        amplitude = self.space.parameters["dither.amplitude"] if dither else None
        if dither is None or amplitude is None or not (amplitude.free or amplitude.value):
            return [0.0] * len(self.cases)
        given = self.space.vectors(self.space.start[None])
        rates = [float(case.case_vectors(given, order)[0, order.index("dither.frequency")]) for case in self.cases]
        return [dither.period(rate, self.loop.pid.sample_time) for rate in rates]

    def respond(self, points: Array, band: Band, lanes: Mask | None = None) -> Responses:
        """Simulate candidates, shape (m, n), on all cases, or on those that `lanes`, shape (m, n_cases), says."""
        wanted = np.ones((len(points), len(self.cases)), dtype=bool) if lanes is None else lanes
        rows, case = np.nonzero(wanted)
        p, starts = self.lanes(points, rows, case)
        measured = LaneMetrics.empty(
            len(rows), max(len(grid.t) for grid in self.grids), starts.shape[1], self.response_metrics
        )
        for chunk in self._chunks(case):
            u, t, h, steps = self.pad(case[chunk])
            with np.errstate(all="ignore"):
                found = self.rollout.run(starts[chunk], u, p[chunk], t, h, substeps=steps, states=KEPT_STATES)
            assert found.x is not None
            self._read(measured, chunk, case[chunk], p[chunk], (found.x, found.y, found.x_end), band)
        return Responses(wanted, p, measured, MarginReader(self.margin_metrics, self._read_margins))

    def values(self, points: Array, spec: Specification) -> dict[str, Array]:
        """The values of the requirements for each candidate, shape (m, n), the worst over the cases, shape (m,) each.

        The specification gives the band, and says whether margins are needed.
        """
        responses = self.respond(points, spec.band)
        every = np.ones(len(points), dtype=bool)
        return responses.with_margins(every) if spec.concerns(ROBUSTNESS_REQUIREMENTS) else responses.values

    def table(self, point: Array, spec: Specification) -> list[dict[str, float]]:
        """The metrics of one candidate, by name, a dict a case."""
        responses = self.respond(point[None], spec.band)
        margins = {n: table[0] for n, table in responses.margin_metrics(np.ones(1, dtype=bool)).items()}
        return to_records({n: responses.table(n)[0] for n in self.response_metrics} | margins)

    def _read_margins(self, p: Array, case: Indices, response_points: ResponsePoints) -> dict[str, Array]:
        """Margins and peaks of loops, the worst over their lanes' operating points."""
        return self.robustness(p, *self.operating_points(p, case, response_points), self.margin_metrics)

    def operating_points(self, p: Array, case: Indices, response_points: ResponsePoints) -> tuple[Array, Array]:
        """The plant's states and inputs at the lanes' operating points; see `PointFinder`."""
        own = self._grid_index[case]
        lanes = [(self.grids[g], np.flatnonzero(own == g)) for g in np.unique(own)]
        return self._find_points(lanes, p, self.sampled.periods(p), response_points)

    def lanes(self, points: Array, rows: Indices, case: Indices) -> tuple[Array, Array]:
        """Parameters, shape (m, n_parameters), and start states, shape (m, n_states), of lanes.

        Each lane has its candidate, a row of `points`, and its case; shape (m,).
        """
        base, order = self.space.vectors(points)[rows], list(self.space.parameters)
        p, starts = np.empty_like(base), np.empty((len(rows), self.rollout.n_states))
        for k in np.unique(case).tolist():
            own = case == k
            p[own] = self.cases[k].case_vectors(base[own], order)
            starts[own] = self.starts(k, points[rows[own]])
        return p, starts

    def starts(self, case: int, points: Array) -> Array:
        """The states before the step, shape (m, n_states); under dither the last one is the signal's integral, zero."""
        rest = self._rest[case]
        if rest is not None:
            found = np.tile(rest, (len(points), 1))
        else:
            found = np.array([self.cases[case].initial(self.loop, self.space.parameters_at(point)) for point in points])
        return self.sampled.with_integral(found)

    def starts_vary(self, case: int) -> bool:
        """Whether the state before the step depends on the gains in a case."""
        return self._rest[case] is None

    def grid_index(self, case: int) -> int:
        """The number of the grid on which a case runs."""
        return int(self._grid_index[case])

    def pad(self, case: Indices) -> tuple[Array, Array, Array, int]:
        """Inputs, instants and steps of lanes, padded to one length, and their RK4 steps a sample.

        Their shapes are (m, n, n_inputs), (m, n) and (m, n); (n, n_inputs), (n,) and (n,) where all are on one grid.
        """
        used, place = np.unique(self._grid_index[case], return_inverse=True)
        n = max(len(self.grids[g].t) for g in used)
        padded = zip(*(self.grids[g].pad(n) for g in used), strict=True)
        u, t, h = (np.array(arrays)[place] if len(used) > 1 else arrays[0] for arrays in padded)
        return u, t, h, max(self.substeps[g] for g in used)

    def _chunks(self, case: Indices, few: int = 32, most: int = 128) -> Iterator[Indices]:
        """Indices of lanes that run together: all at once if they are few, otherwise those on the same grid.

        So few are padded to the longest record; more than `most` do not fit a processor's cache.
        """
        if 0 < len(case) <= few:
            yield np.arange(len(case))
            return
        for g in np.unique(self._grid_index[case]).tolist():
            own = np.flatnonzero(self._grid_index[case] == g)
            yield from np.split(own, np.arange(most, len(own), most))

    def read(self, p: Array, case: Indices, run: LaneRun, shape: tuple[int, int], band: Band) -> Responses:
        """The responses of candidates on every case that ran elsewhere; `shape` is (m, n_cases).

        Parameters and cases of the lanes have the shapes (m n_cases, n_parameters) and (m n_cases,).
        """
        measured = LaneMetrics.empty(
            len(p), max(len(grid.t) for grid in self.grids), run[0].shape[2], self.response_metrics
        )
        for chunk in self._chunks(case):
            self._read(measured, chunk, case[chunk], p[chunk], (run[0][chunk], run[1][chunk], run[2][chunk]), band)
        return Responses(np.ones(shape, dtype=bool), p, measured, MarginReader(self.margin_metrics, self._read_margins))

    def _read(self, out: LaneMetrics, chunk: Indices, case: Indices, p: Array, run: LaneRun, band: Band) -> None:
        """Fill the rows `chunk` of `out` from states, outputs and end states."""
        states, outputs, ends = run
        out.response_points.states[chunk, : states.shape[1]], out.response_points.ends[chunk] = states, ends
        for g in np.unique(self._grid_index[case]).tolist():
            own, grid, asked = self._grid_index[case] == g, self.grids[g], self.response_metrics
            y = outputs[own, : len(grid.t)]
            sound = is_sound(y, ends[own])
            out.sound[chunk[own]], out.response_points.command[chunk[own]] = sound, y[:, -1, CONTROL_OUTPUT]
            found = self.sampled.read(grid, y, p[own], sound, self.bands(band), asked, self._envelope)
            for period, rows, metrics in found:
                for n, value in metrics.items():
                    out.metrics[n][chunk[own][rows]] = value
                out.response_points.fastest[chunk[own][rows]] = self.fastest_samples(grid, y[rows], period)

    def fastest_samples(self, grid: ReferenceGrid, y: Array, period: float) -> Indices:
        """Samples (m,) of the largest speed after the step, without a dither's ripple; zeros without an axis."""
        k, first = speed_output(self.loop, self.sampled.channels), grid.step_index
        if k is None:
            return np.zeros(len(y), dtype=np.intp)
        return np.asarray(first + first_largest(without_ripple(grid.t, y[:, :, k], period)[:, first:]))

    def _fastest_eigenvalue(self, references: Sequence[Reference]) -> float:
        """The rate of the fastest mode over the gains' box and all plants [1/s].

        On the scenarios' plants only the corners that are fastest on the nominal one are examined.
        """
        given = self.space.start[None]
        p, starts = self.space.vectors(given)[0], [self.starts(k, given)[0] for k in range(len(references))]
        along = [self.sampled.states_along(g, x, p, MAX_LOOP_SUBSTEPS) for g, x in zip(self.grids, starts, strict=True)]
        states = [x for rows in along for x in rows]
        corners, order = self.space.vectors(self.space.corners()), list(self.space.parameters)
        rates = fastest_eigenvalue(self.loop, corners, states)
        worst = corners[np.argsort(rates)[-STIFFEST_CORNERS:]]
        others = [case.case_vectors(worst, order) for case in self.cases[len(references) :: len(references)]]
        fastest = fastest_eigenvalue(self.loop, np.vstack(others), states).max() if others else 0.0
        return float(max(rates.max(), fastest))
