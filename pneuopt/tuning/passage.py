"""`ResponsePoints`: where lanes begin, move fastest and end; `PointFinder` makes their operating points of it.

The points are those of `operating_points` in evaluation/operating_points.py. A search keeps few states
along a response: the fastest sample is read off the outputs, and the states there come from a second run, from the last
kept ones up to it. Under dither further runs go through the period around it, and through the one after the end, off
which the ripple is read.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pneuopt.control.averaging import is_affine
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.system import names
from pneuopt.evaluation.dither_ripple import RIPPLE_ALLOWANCE, move_towards
from pneuopt.evaluation.operating_points import first_largest, without_ripple
from pneuopt.evaluation.response import SAMPLES_A_DITHER_PERIOD
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.tuning.readings import CONTROL_OUTPUT, ReferenceGrid
from pneuopt.tuning.space import rk4_substeps

# Samples between two states that a run keeps, from which a second one sets out for the fastest sample. Fewer take
# memory and time to write; more lengthen that second run.
KEPT_STATES = 64


class ResponsePoints(NamedTuple):
    """Where m lanes begin, move fastest and end.

    Attributes
    ----------
    states : ndarray, shape (m, k, n_states)
        At every `KEPT_STATES`-th sample.
    ends : ndarray, shape (m, n_states)
    fastest : ndarray of int, shape (m,)
        Sample of the largest speed, under dither of the speed without its ripple.
    command : ndarray, shape (m,)
        The commands in which they end.
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
        """The passage of some lanes."""
        return ResponsePoints(self.states[rows], self.ends[rows], self.fastest[rows], self.command[rows])


def fastest_samples(grid: ReferenceGrid, speed: Array, period: float) -> Indices:
    """Samples of the largest speed after the step, shape (m,), as `ResponsePoints` has them.

    Parameters
    ----------
    grid : ReferenceGrid
    speed : ndarray, shape (m, n)
    period : float
        Of the dither [s]; 0 for none.
    """
    first = grid.step_index
    return np.asarray(first + first_largest(without_ripple(grid.t, speed, period)[:, first:]))


@dataclass(frozen=True, eq=False)
class PointFinder:
    """Function that gives the operating points of simulated lanes, by a second run up to the fastest sample.

    Parameters
    ----------
    loop : ClosedLoop
    rollout : Rollout
        Of `loop_pieces`.
    rate : float
        The fastest eigenvalue that RK4 has to resolve [1/s].
    """

    loop: ClosedLoop
    rollout: Rollout
    rate: float

    def __call__(
        self, grids: Sequence[tuple[ReferenceGrid, Indices]], p: Array, periods: Array, passage: ResponsePoints
    ) -> tuple[Array, Array]:
        """Find the points.

        Parameters
        ----------
        grids : sequence of (ReferenceGrid, ndarray of int)
            Each grid and the lanes that run on it.
        p : ndarray, shape (m, n_parameters)
        periods : ndarray, shape (m,)
            Periods over which lanes are averaged [s]; 0: they are not.
        passage : ResponsePoints

        Returns
        -------
        x : ndarray, shape (k, m, n_plant_states)
        u : ndarray, shape (k, m, n_plant_inputs)
            Of k points: at rest, sliding, at the end; of an affine plant the end alone.
        """
        found = [self._points(grid, rows, p, periods, passage) for grid, rows in grids]
        x, u = (np.empty((len(a), len(p), a.shape[2])) for a in found[0])
        for (_, rows), (own_x, own_u) in zip(grids, found, strict=True):
            x[:, rows], u[:, rows] = own_x, own_u
        return x, u

    def _points(
        self, grid: ReferenceGrid, rows: Indices, p: Array, periods: Array, passage: ResponsePoints
    ) -> tuple[Array, Array]:
        """Points of lanes on one grid, states and inputs, shapes (k, m, n)."""
        own, p = passage.select(rows), p[rows]
        states, (end, reach) = list[Array](), self._at_end(grid, p, periods[rows], own)
        if not is_affine(self.loop.plant):
            states.append(self._at_start(grid, p, own))
            if self.loop.plant.axis is not None:
                states.append(self._sliding(grid, p, periods[rows], own, reach))
        states.append(end)
        along, plant = np.array(states), self.loop.plant
        u = np.zeros((len(along), len(p), len(plant.inputs)))
        disturbances = dict(zip(names(self.loop.inputs), grid.u[-1].tolist(), strict=True))
        for k, name in enumerate(names(plant.inputs)):
            u[:, :, k] = along[:, :, -1] if name == self.loop.command.name else disturbances[name]
            if name != self.loop.command.name and len(along) > 1:
                u[0, :, k] = 0.0  # the disturbance has not begun
        return along[:, :, :-1], u

    def _at_start(self, grid: ReferenceGrid, p: Array, own: ResponsePoints) -> Array:
        """The plant's state and the command before the step, shape (m, n_plant_states + 1), dither switched off."""
        order, quiet = list(self.loop.parameters), p.copy()
        quiet[:, [order.index(n) for n in (DITHER_AMPLITUDE, DITHER_OFFSET) if n in order]] = 0.0
        u = np.zeros((len(p), 1, grid.u.shape[1]))
        u[:, 0, 0] = grid.reference.origin
        none = np.zeros((len(p), 1))
        control = self.rollout.run(own.states[:, 0], u, quiet, none, none).y[:, 0, CONTROL_OUTPUT]
        return np.column_stack([own.states[:, 0, : len(self.loop.plant.states)], control])

    def _sliding(self, grid: ReferenceGrid, p: Array, periods: Array, own: ResponsePoints, reach: Array) -> Array:
        """The plant's state and the command at the fastest sample, without ripple."""
        begin = np.maximum(own.fastest - np.round(periods / 2 / grid.spacing).astype(np.intp), 0)
        out, ends = self._run_up_to(grid, p, begin, own, periods > 0)
        for period, rows in _by_period(periods):
            along = self._period(grid, ends[rows], p[rows], grid.t[begin[rows]], period)
            share = (grid.t[own.fastest[rows]] - grid.t[begin[rows]]) / period
            _put_finite(out, rows, move_towards(_at(along, share), _mean(along), reach[rows]))
        return out

    def _run_up_to(
        self, grid: ReferenceGrid, p: Array, last: Indices, own: ResponsePoints, goes_on: Mask
    ) -> tuple[Array, Array]:
        """The plant's state and the command at a sample of each lane, and the loop's state there.

        Lanes wait there for the latest of them, between two samples of a held controller: at a sample it would act
        again and again. That of lanes that go on from there has not acted yet.
        """
        kept, rows = last // KEPT_STATES, np.arange(len(p))
        left = (last - kept * KEPT_STATES)[:, None]
        k, (u, t, h) = np.arange(left.max() + 1), grid.pad(len(grid.t))
        at = kept[:, None] * KEPT_STATES + np.minimum(k, left)
        waits = k + goes_on[:, None] > left
        instants = t[at] + (0.5 * grid.spacing * waits if self.loop.pid.sample_time is not None else 0.0)
        with np.errstate(all="ignore"):
            substeps = rk4_substeps(self.rate, grid.spacing)
            steps = np.where(k < left, h[at], 0.0)
            run = self.rollout.run(own.states[rows, kept], u[at], p, instants, steps, substeps=substeps)
        plant = run.x_end[:, : len(self.loop.plant.states)]
        return np.column_stack([plant, run.y[:, -1, CONTROL_OUTPUT]]), run.x_end

    def _at_end(self, grid: ReferenceGrid, p: Array, periods: Array, own: ResponsePoints) -> tuple[Array, Array]:
        """The plant's state and the command at the end, without ripple, and how far ripple lets them be moved.

        Under dither one more period is run after the end. Half the change from its start to its end is subtracted from
        its mean, which puts the mean back to the end.
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


def _at(along: Array, share: Array) -> Array:
    """Each lane's values a share of its period after the first, linear between instants, shape (m, n_values)."""
    at, lane = share * (along.shape[1] - 1), np.arange(len(along))
    k = np.minimum(at.astype(np.intp), along.shape[1] - 2)
    return np.asarray(along[lane, k] + (at - k)[:, None] * (along[lane, k + 1] - along[lane, k]))


def _put_finite(out: Array, rows: Indices, values: Array) -> None:
    """Put values into their rows, but those of lanes that run away."""
    tame = np.isfinite(values).all(axis=1)
    out[rows[tame]] = values[tame]
