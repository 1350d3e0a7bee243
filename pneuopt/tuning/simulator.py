"""`Simulator`: compiled simulation of many candidates at once, on every reference and scenario."""

import copy
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.batch_margins import MarginFunction, batch_margin_function
from pneuopt.evaluation.cases import cases
from pneuopt.evaluation.margins import lowest_noise_frequency
from pneuopt.evaluation.meter import check_channels
from pneuopt.evaluation.metric import Source
from pneuopt.evaluation.requirements import METRICS, ROBUSTNESS_REQUIREMENTS
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.tuning.grids import reference_grids, refine_grids
from pneuopt.tuning.passage import KEPT_STATES, PointFinder, ResponsePoints, fastest_samples
from pneuopt.tuning.readings import CONTROL_OUTPUT, SIGNAL_OUTPUT, LoopLanes, ReferenceGrid, is_sound, speed_output
from pneuopt.tuning.responses import LaneMetrics, MarginReader, Responses, to_records
from pneuopt.tuning.rests import starts_before_step
from pneuopt.tuning.space import MAX_LOOP_SUBSTEPS, Space, dither_resolution_rate, fastest_eigenvalue, rk4_substeps

HEADLINES = {name: metric.source is Source.LINEAR_LOOP for name, metric in METRICS.items() if metric.headline}
BASE_METRICS = (*(name for name, linear in HEADLINES.items() if not linear), "SettlingTimeRaw", "Ripple", "Excess")
BASE_MARGINS = tuple(name for name, linear in HEADLINES.items() if linear)
# Lanes up to which different references run together, the shorter ones padded. Fewer leave a processor's lanes empty;
# more waste time on the padding.
MAX_MIXED_LANES = 32
# Lanes that are run and read at a time. Fewer leave cores idle; the responses of more do not fit a processor's cache.
MAX_CHUNK_LANES = 128
# Samples of a dither period during a search. Fewer shift settling times by more: at ten by 0.1 ms on the drive of
# problems/speed/t32.py, 3 ms at worst; more cost time in proportion.
COARSE_SAMPLES_A_PERIOD = 10
# Corners of the gains' box, the fastest on the nominal plant, at which the fastest mode is sought on the scenarios'
# plants. Fewer may miss a stiff one, on which RK4 is then unstable; each more costs an eigenvalue problem a plant.
STIFFEST_CORNERS = 8
# Highest frequency at which a sampled loop is read, times its sample time [rad]: below ten, its last crossings are
# missed; more thin out the grid.
MAX_SAMPLE_ANGLE = 20.0
LaneRun = tuple[Array, Array, Array]  # states at every `KEPT_STATES`-th sample, outputs and end states of lanes


class Simulator:
    """Simulate many candidates, compiled, on every reference and every scenario's plant, and read their metrics.

    The plant's true signal counts, whatever a sensor shows the controller of it.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Reference
    space : Space
    scenarios : mapping of str to mapping, optional
        The plants beside the nominal one.
    spec : Specification, optional
        Its kinds of requirements are read beside the common ones.

    Attributes
    ----------
    cases : tuple of TuningCase
    response_metrics, margin_metrics : tuple of str
        The metrics read off the responses, and off the loop linearised at their operating points.
    sampled : LoopLanes
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
        self.robustness = self._margin_function(references)  # about `operating_points`
        self._find_points = PointFinder(loop, self.rollout, self._rate)

    def coarse(self, spec: Specification, bands: Sequence[Band] = ()) -> "Simulator":
        """A copy for use during a search, with half as many samples, which reads only what `spec` asks for.

        With `bands` SettlingTime is the mean over those and the band asked for; a response that does not settle counts
        as `penalty_settling_time`.
        """
        part = copy.copy(self)
        part._wider = tuple(bands)
        part.response_metrics = tuple(
            dict.fromkeys(("SettlingTime", "Excess", *(n for n in spec.metric_names if n in self.response_metrics)))
        )
        if not self._is_refined:
            part.grids = reference_grids(
                self.loop, [g.reference for g in self.grids], self.space.parameters, COARSE_SAMPLES_A_PERIOD
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
        part = copy.copy(self)
        part.grids = refine_grids(self.grids, self.cases_by_grid(), partial(self._signal, point))
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

    def _signal(self, point: Array, case: int, grid: ReferenceGrid) -> Array | None:
        """The measured signal of a case at the samples of a grid; None where it runs away."""
        p, start = self.lanes(point[None], np.zeros(1, dtype=np.intp), np.full(1, case))
        found, sound = self.sampled.run(grid, start, p, rk4_substeps(self._rate, grid.spacing))
        return found.y[0, :, SIGNAL_OUTPUT] if sound[0] else None

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
            self._measure(measured, chunk, case[chunk], starts[chunk], p[chunk], band)
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

    def _read_margins(self, p: Array, case: Indices, passage: ResponsePoints) -> dict[str, Array]:
        """Margins and peaks of loops, the worst over their lanes' operating points."""
        return self.robustness(p, *self.operating_points(p, case, passage), self.margin_metrics)

    def operating_points(self, p: Array, case: Indices, passage: ResponsePoints) -> tuple[Array, Array]:
        """The plant's states and inputs at the lanes' operating points; see `PointFinder`."""
        own = self._grid_index[case]
        lanes = [(self.grids[g], np.flatnonzero(own == g)) for g in np.unique(own)]
        return self._find_points(lanes, p, self.sampled.periods(p), passage)

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

    def _chunks(self, case: Indices) -> Iterator[Indices]:
        """Indices of lanes that run together: all at once if they are few, otherwise those on the same grid."""
        if len(case) <= MAX_MIXED_LANES:
            yield np.arange(len(case))
            return
        for g in range(len(self.grids)):
            own = np.flatnonzero(self._grid_index[case] == g)
            yield from np.split(own, np.arange(MAX_CHUNK_LANES, len(own), MAX_CHUNK_LANES))

    def _measure(self, out: LaneMetrics, chunk: Indices, case: Indices, starts: Array, p: Array, band: Band) -> None:
        """Simulate the lanes `chunk` and fill their rows of `out`."""
        if not len(chunk):
            return
        u, t, h, steps = self.pad(case)
        with np.errstate(all="ignore"):
            found = self.rollout.run(starts, u, p, t, h, substeps=steps, states=KEPT_STATES)
        assert found.x is not None
        self._read(out, chunk, case, p, (found.x, found.y, found.x_end), band)

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
        out.passage.states[chunk, : states.shape[1]], out.passage.ends[chunk] = states, ends
        for g in np.unique(self._grid_index[case]).tolist():
            own, grid, asked = self._grid_index[case] == g, self.grids[g], self.response_metrics
            y = outputs[own, : len(grid.t)]
            sound = is_sound(y, ends[own])
            out.sound[chunk[own]], out.passage.command[chunk[own]] = sound, y[:, -1, CONTROL_OUTPUT]
            found = self.sampled.read(grid, y, p[own], sound, self.bands(band), asked, self._envelope)
            for period, rows, metrics in found:
                for n, value in metrics.items():
                    out.metrics[n][chunk[own][rows]] = value
                out.passage.fastest[chunk[own][rows]] = self.fastest_samples(grid, y[rows], period)

    def fastest_samples(self, grid: ReferenceGrid, y: Array, period: float) -> Indices:
        """Samples of the largest speed, as `ResponsePoints` has them; zeros for a plant without an axis."""
        k = speed_output(self.loop, self.sampled.channels)
        return np.zeros(len(y), dtype=np.intp) if k is None else fastest_samples(grid, y[:, :, k], period)

    def _margin_function(self, references: Sequence[Reference]) -> MarginFunction:
        """Margins of many loops, read from the frequency on at which a slow integral swings against a resting drive."""
        horizon, h = max(r.horizon for r in references), self.loop.pid.sample_time
        slowest, lowest = 1 / horizon, lowest_noise_frequency(horizon)
        fastest = max(self._rate, 1e3 * slowest, MAX_SAMPLE_ANGLE / h if h else 0.0)
        slow, fast = np.geomspace(3e-5 * slowest, 0.97 * lowest, 60), np.geomspace(lowest, fastest, 150)
        return batch_margin_function(self.loop, np.concatenate([slow, fast]), lowest)

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
