"""`Race`: the merit of points that beat their rivals; the others are dropped as soon as it is certain that they do not.

A point runs first on the case that its parent finds worst, then on those that lately beat the most others. Machine
code drops it within a response, where the bounds of `RACE_VALUES` pass the rival's merit; the CasADi VM after its first
case. Neither changes an answer: what comes through is read as the `Simulator` reads it.
"""

from collections.abc import Sequence

import numpy as np

from pneuopt.dynamics.compiled.race import RACE_VALUES, RaceCourse, RaceField, RaceMerit, race
from pneuopt.evaluation.band import EDGE_ROUNDING, Band, band_number, band_unit
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    ROBUSTNESS_REQUIREMENTS,
    ControlRate,
    Overshoot,
    PeakControl,
    SettlingTime,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.tuning.merit import VIOLATION_PENALTY, compute_merits
from pneuopt.tuning.passage import KEPT_STATES
from pneuopt.tuning.readings import RUNAWAY_LEVEL, WORST_MERIT
from pneuopt.tuning.responses import Responses
from pneuopt.tuning.simulator import Simulator

# Share of its weight that a case's victory keeps from race to race. Below, the order of the cases follows chance; near
# 1, it lags behind the search.
MEMORY_OF_KILLS = 0.95
# Numbers that a race records, at most. Fewer split a generation into several races, whose lanes idle at each end; more
# take memory (8 bytes each).
MAX_RECORDED_NUMBERS = 2**25
# What may be asked for where responses are cut short: nothing of it grows after the response has settled.
CUT_REQUIREMENTS = (SettlingTime, Overshoot, PeakControl, ControlRate, *ROBUSTNESS_REQUIREMENTS)


class Race:
    """Races on one simulator for one specification.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
    scale : float
        The horizon, which stands for the settling time of what never settles [s].

    Attributes
    ----------
    count : int
        Points that were simulated, on one case or more.
    is_cut : bool
        Whether races see less than the whole of a response.
    """

    def __init__(self, simulator: Simulator, spec: Specification, scale: float) -> None:
        self._whole, self._spec, self._scale, self.count = simulator, spec, scale, 0
        self._plain = spec.without(ROBUSTNESS_REQUIREMENTS)
        self._kills, self._records = np.zeros(len(simulator.cases)), np.empty(0)
        self._uses_bounds = simulator.rollout.uses_machine_code and not spec.weight(ROBUSTNESS_REQUIREMENTS)
        self.cut(np.inf)

    def cut(self, duration: float) -> None:
        """Let races see so much of each response after the step only [s]."""
        self._simulator = self._whole if duration == np.inf else self._whole.cut(duration)
        self.is_cut = any(len(a.t) < len(b.t) for a, b in zip(self._simulator.grids, self._whole.grids, strict=True))
        self._course = _course(self._simulator, self._spec.band)

    def merits(self, points: Array, rivals: Array | None = None) -> tuple[Array, Indices]:
        """The merit of each point on every case and on the whole response, and its worst case, shapes (m,).

        Where `rivals`, shape (m,), are given, a point that is certain to be worse gets a bound above its rival's merit.
        """
        self.count += len(points)
        responses = self._whole.respond(points, self._spec.band)
        return self._complete_merits(responses, np.full(len(points), np.inf) if rivals is None else rivals)

    def race(self, points: Array, rivals: Array, first: Indices) -> tuple[Array, Indices]:
        """The merit of points that are no worse than their rivals; for the others a number above their rival's merit.

        Parameters
        ----------
        points : ndarray, shape (m, n)
        rivals : ndarray, shape (m,)
            The merits to beat.
        first : ndarray of int, shape (m,)
            The case on which each point is simulated first, its rival's worst.

        Returns
        -------
        merits : ndarray, shape (m,)
        worst : ndarray of int, shape (m,)
            Each point's worst case, or the one by which it lost.
        """
        self.count += len(points)
        compete, most = self._race_cases, len(points)
        if self._uses_bounds:
            numbers = len(self._course.length) * self._course.t.shape[1] * self._simulator.rollout.n_outputs
            compete, most = self._race_lanes, max(1, MAX_RECORDED_NUMBERS // numbers)
        merits, worst = np.full(len(points), np.inf), first.copy()
        for k in range(0, len(points), most):
            part = slice(k, k + most)
            merits[part], worst[part] = compete(points[part], rivals[part], first[part])
        lost = np.bincount(worst[merits > rivals], minlength=len(self._kills))
        self._kills = MEMORY_OF_KILLS * self._kills + lost
        return merits, worst

    def _race_lanes(self, points: Array, rivals: Array, first: Indices) -> tuple[Array, Indices]:
        """Race in machine code, and read the responses of what comes through."""
        simulator, (m, C) = self._simulator, (len(points), len(self._kills))
        row, case = np.divmod(np.arange(m * C), C)
        p, starts = simulator.lanes(points, row, case)
        n, outputs = self._course.t.shape[1], simulator.rollout.n_outputs
        if self._records.size < m * C * n * outputs:
            self._records = np.empty(m * C * n * outputs)
        y = self._records[: m * C * n * outputs].reshape(m, C, n, outputs)
        field = RaceField(p, starts, simulator.sampled.periods(p), self._order(first), rivals)
        merit = _merit_bounds(self._plain, simulator.bands(self._spec.band))
        outcome = race(simulator.rollout, self._course, merit, field, y)
        merits, worst, through = np.full(m, np.inf), outcome.loser.copy(), outcome.loser < 0
        if through.any():
            lanes = through[row]
            states, ends = (a[through].reshape(-1, *a.shape[2:]) for a in (outcome.x, outcome.x_end))
            run = states, y[through].reshape(-1, n, outputs), ends
            responses = simulator.read(p[lanes], case[lanes], run, (int(through.sum()), C), self._spec.band)
            merits[through], worst[through] = self._complete_merits(responses, rivals[through])
        return merits, worst

    def _race_cases(self, points: Array, rivals: Array, first: Indices) -> tuple[Array, Indices]:
        """Race case by case: the first one of every point, then all cases of those that are not beaten by it."""
        merits, worst, C = np.full(len(points), np.inf), first.copy(), len(self._kills)
        ahead = np.ones(len(points), dtype=bool)
        if C > 1 and not self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            opening = self._simulator.respond(points, self._spec.band, np.arange(C) == first[:, None])
            ahead = compute_merits(opening.values, self._plain, self._scale) <= rivals
        if ahead.any():
            responses = self._simulator.respond(points[ahead], self._spec.band)
            merits[ahead], worst[ahead] = self._complete_merits(responses, rivals[ahead])
        return merits, worst

    def _complete_merits(self, responses: Responses, rivals: Array) -> tuple[Array, Indices]:
        """Merits and worst cases of points that ran on every case.

        Margins, a frequency response each, cost as much as a simulation. A limit on them can only raise a merit, so
        they are computed for points that can still beat their rival.
        """
        merits = np.full(len(rivals), -np.inf)
        if not self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            merits = compute_merits(responses.values, self._plain, self._scale)
        if self._spec.concerns(ROBUSTNESS_REQUIREMENTS):
            ahead = merits <= rivals
            if ahead.any():
                merits[ahead] = compute_merits(responses.with_margins(ahead), self._spec, self._scale)
        return merits, self._worst_cases(responses)

    def _worst_cases(self, responses: Responses) -> Indices:
        """Each point's case with the largest merit, margins left out, shape (m,)."""
        if len(self._kills) == 1 or self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            return np.zeros(len(responses.values["Excess"]), dtype=np.intp)
        table = responses.to_table(compute_merits(responses.by_case(), self._plain, self._scale))
        return np.asarray(np.argmax(table, axis=1))

    def _order(self, first: Indices) -> Indices:
        """Each point's cases in the order in which they run, shape (m, n_cases)."""
        rank = np.tile(-self._kills, (len(first), 1))
        rank[np.arange(len(first)), first] = -np.inf
        return np.asarray(np.argsort(rank, axis=1, kind="stable"))


def may_be_cut(spec: Specification) -> bool:
    """Whether nothing is asked for that happens after a response has settled."""
    kinds = (*spec.weights, *spec.limits)
    return all(isinstance(q, SettlingTime) for q in spec.weights) and all(
        isinstance(q, CUT_REQUIREMENTS) for q in kinds
    )


def _course(simulator: Simulator, band: Band) -> RaceCourse:
    """The cases of a simulator, as a race in machine code takes them."""
    grids = simulator.grids
    n, grid = max(len(g.t) for g in grids), np.array([simulator.grid_index(k) for k in range(len(simulator.cases))])
    u, t, h = (np.array(arrays) for arrays in zip(*(g.pad(n) for g in grids), strict=True))
    settings = [
        (r.final, r.nominal_size, r.initial, g.spacing, g.t[g.step_index] - r.at, float(r.changes), band_unit(band, r))
        for g, r in ((g, g.reference) for g in grids)
    ]
    length, first = np.array([[len(g.t), g.step_index] for g in grids]).T
    return RaceCourse(
        u, t, h, grid, length[grid], first[grid], np.array(settings)[grid], max(simulator.substeps), KEPT_STATES
    )


def _merit_bounds(spec: Specification, bands: Sequence[Band]) -> RaceMerit:
    kinds = [next(kind for kind in REQUIREMENT_KINDS if kind.metric.name == n) for n in RACE_VALUES]
    weights, limits = np.array([[spec.weight(kind), spec.limit(kind)] for kind in kinds]).T
    edges = (1 + EDGE_ROUNDING) * np.array([band_number(band) for band in bands])
    return RaceMerit(edges, weights, limits, WORST_MERIT, VIOLATION_PENALTY, RUNAWAY_LEVEL)
