"""`PlantBatch`: the plants of a batch as rows of numbers, run in SIMD lanes, and their metrics."""

from collections.abc import Mapping, Sequence
from math import nan

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.cases import TuningCase
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import PneuoptError, check_names
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.grids import reference_grids
from pneuopt.tuning.readings import LoopLanes, ReferenceGrid
from pneuopt.tuning.space import MAX_LOOP_SUBSTEPS, dither_resolution_rate, fastest_eigenvalue, rk4_substeps

MAX_PROBED = 64
"""Plants, beside those with an extreme value, whose fastest mode is sought: fewer may miss a stiff one, on which RK4
is then unstable; each more costs an eigenvalue problem a plant and state."""
RATE_MARGIN = 1.2
"""Factor on the fastest mode found [1]: the plants that are not probed may be faster by that much."""
SAME_START = 1e-9
"""Share of the states' nominal sizes [1] by which starts differ by rounding: at 0 each plant's is computed anew."""
RAN_AWAY = "the response runs away"


class PlantBatch:
    """The plants of a batch as rows of numbers, and the grids on which they run."""

    def __init__(
        self,
        loop: ClosedLoop,
        steps: Sequence[Reference],
        parameters: ParameterSet,
        cases: Mapping[str, Mapping[str, float]],
        metrics: Sequence[str],
        band: Band,
    ) -> None:
        self.loop, self.metrics, self.band = loop, tuple(metrics), band
        self._full = loop.complete(parameters).select(loop.parameters)
        self._order = {n: k for k, n in enumerate(self._full)}
        self._cases, self.errors = list(cases.values()), [""] * len(cases)
        self.varied = list(dict.fromkeys(n for values in self._cases for n in values))
        check_names("parameter", self.varied, self._order, "cases")
        self._places = [self._order[n] for n in self.varied]
        self.nominal = np.array([p.value for p in self._full.values()])
        self._values = np.array(
            [[v.get(n, self._full.value(n)) for n in self.varied] for v in self._cases], dtype=float
        )
        self._check_values()
        self.lanes = LoopLanes(loop, metrics, _make_rollout)
        fastest = {"dither.frequency": self._most("dither.frequency")} if "dither.frequency" in self.varied else {}
        self.grids = reference_grids(loop, steps, self._full.with_values(fastest))
        self._starts = [self._shared_start(grid.reference) for grid in self.grids]
        rate = max(RATE_MARGIN * self._fastest_mode(), dither_resolution_rate(loop, self._full))
        self.substeps = [rk4_substeps(rate, grid.spacing) for grid in self.grids]

    def nominal_value(self, name: str) -> float:
        """Of a parameter."""
        return float(self._full.value(name))

    def column(self, metric: str, grid: ReferenceGrid) -> str:
        """Heading of a metric's column."""
        return metric if len(self.grids) == 1 else f"{metric}[{grid.reference.label}]"

    def empty_columns(self) -> dict[str, Array]:
        """The metrics' columns, NaN."""
        return {self.column(n, g): np.full(len(self._cases), nan) for g in self.grids for n in self.metrics}

    def varied_columns(self) -> dict[str, Array]:
        """The parameters in which the plants differ."""
        return {n: self._values[:, k] for k, n in enumerate(self.varied)}

    def measure(self, rows: Indices, columns: Mapping[str, Array]) -> None:
        """Run some plants on every reference and fill their rows of the columns."""
        for grid, start, substeps in zip(self.grids, self._starts, self.substeps, strict=True):
            own, x0 = self._start_states(rows, grid.reference, start)
            if not len(own):
                continue
            p = np.tile(self.nominal, (len(own), 1))
            p[:, self._places] = self._values[own]
            run, sound = self.lanes.run(grid, x0, p, substeps)
            if not sound.all() and 2 * substeps <= MAX_LOOP_SUBSTEPS:  # RK4 may be what runs away
                again = ~sound
                finer, sound[again] = self.lanes.run(grid, x0[again], p[again], 2 * substeps)
                run.y[again] = finer.y
            for k in own[~sound].tolist():
                self.errors[k] = self.errors[k] or f"{RAN_AWAY} in the lanes"
            for _, some, metrics in self.lanes.read(grid, run.y, p, sound, (self.band,), self.metrics):
                for n, value in metrics.items():
                    columns[self.column(n, grid)][own[some]] = value

    def _start_states(self, rows: Indices, step: Reference, shared: Array | None) -> tuple[Indices, Array]:
        """The plants that can begin, and their states before the step; the others get their reason."""
        good, states = list[int](), list[Array]()
        for k in rows.tolist():
            if self.errors[k]:
                continue
            try:
                states.append(shared if shared is not None else self.start(self._cases[k], step))
                good.append(k)
            except PneuoptError as error:
                self.errors[k] = str(error)
        found = np.reshape(states, (len(good), len(self.loop.states)))
        return np.array(good, dtype=np.intp), self.lanes.with_integral(found)

    def start(self, values: Mapping[str, float], step: Reference) -> Array:
        """The state before a step of the plant with these values."""
        return TuningCase(step, "", values).initial(self.loop, self._full)

    def _shared_start(self, step: Reference) -> Array | None:
        """The state before the step, if it is the same on every plant, as far as probes tell; None: each has its own.

        It takes a millisecond, which is longer than a plant's response in the lanes. The probes are the plants with the
        least and the greatest value of each parameter, and the first.
        """
        try:
            states = [self.start(self._cases[k], step) for k in self._extremes()]
        except PneuoptError:
            return None
        room = SAME_START * np.array([q.nominal for q in self.loop.states])
        return states[0] if states and all(np.all(np.abs(states[0] - x) <= room) for x in states) else None

    def _extremes(self) -> list[int]:
        """Plants with the least and the greatest value of each parameter, and the first sound one."""
        good = np.flatnonzero([not e for e in self.errors])
        values = self._values[good]
        ends = [*values.argmin(axis=0).tolist(), *values.argmax(axis=0).tolist()] if len(good) else []
        return [int(good[k]) for k in sorted({0, *ends})] if len(good) else []

    def _fastest_mode(self) -> float:
        """The rate of the fastest mode of the probed plants along the nominal plant's responses [1/s]."""
        good = np.flatnonzero([not e for e in self.errors])
        spread = good[np.unique(np.linspace(0, len(good) - 1, MAX_PROBED).astype(int))] if len(good) else good
        probed = np.unique([*self._extremes(), *spread.tolist()]).astype(int)
        p = np.tile(self.nominal, (len(probed) + 1, 1))
        p[1:, self._places] = self._values[probed]
        starts = [self.lanes.with_integral(self.start({}, grid.reference)[None])[0] for grid in self.grids]
        few = MAX_LOOP_SUBSTEPS // 4
        along = [self.lanes.states_along(g, x, self.nominal, few) for g, x in zip(self.grids, starts, strict=True)]
        return float(fastest_eigenvalue(self.loop, p, [x for rows in along for x in rows]).max())

    def _check_values(self) -> None:
        """Give each plant with a value that is no number, or out of bounds, its reason."""
        for k, n in enumerate(self.varied):
            p, column = self._full[n], self._values[:, k]
            bad = ~((column >= p.lower) & (column <= p.upper) & np.isfinite(column))
            for row in np.flatnonzero(bad).tolist():
                said = f"{n} is {column[row]:g} {p.unit}, outside [{p.lower:g}, {p.upper:g}]"
                self.errors[row] = self.errors[row] or said

    def _most(self, name: str) -> float:
        values = self._values[:, self.varied.index(name)]
        return float(np.max(values, where=np.isfinite(values), initial=self._full.value(name)))


def _make_rollout(pieces: Pieces) -> Rollout:
    """A rollout with twice the usual lanes, where there are lanes.

    Two vectors' chains of operations run at a time where one waits for its results: four fifths of the time for many
    plants. A search has too few for it.
    """
    usual = Rollout(pieces)
    twice = Rollout(pieces, lanes=2 * usual.lanes) if usual.lanes > 1 else usual
    return twice if twice.lanes else usual
