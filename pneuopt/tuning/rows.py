"""`Lanes`: simulated responses with their derivatives to the gains, as step records from which metrics are read.

The signal is read at nodes, without its dither's ripple. Where a metric is the largest value over time, or the integral
of an absolute value, its derivative is taken at the present instant of the maximum, or with the present sign.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.dither_mean import DitherPeriodMean, end_mean
from pneuopt.evaluation.dither_ripple import RIPPLE_ALLOWANCE, extend_means, ripple_and_slopes, wave_instants
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.motion_requirements import PUSH
from pneuopt.evaluation.step_record import StepRecord, ValuesAndSlopes
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.readings import CONTROL_OUTPUT, INTEGRAL_OUTPUT, SIGNAL_OUTPUT, ReferenceGrid, meter_values


@dataclass(frozen=True, eq=False)
class Lanes:
    """Simulated lanes of one reference, with sensitivities.

    Parameters
    ----------
    grid : ReferenceGrid
    y : ndarray, shape (m, n, n_outputs)
    dy : ndarray, shape (m, n, n_outputs, n_columns)
        Derivatives of y to start states and parameters, finite everywhere.
    chain : ndarray, shape (m, n_columns, n_gains)
        Derivatives of those start states and parameters to the unknowns of the search.
    periods : sequence of float
        The time over which each lane is averaged [s]; 0 without dither.
    stride : int
        Samples from node to node.
    envelope : sequence of (float, float, float)
        The bounds of a `StepEnvelope`.
    channels : sequence of str
        The meter's channels that were run.
    """

    grid: ReferenceGrid
    y: Array
    dy: Array
    chain: Array
    periods: Sequence[float]
    stride: int
    envelope: Envelope = ()
    channels: Sequence[str] = ()

    @cached_property
    def t(self) -> Array:
        """The samples' time after the step, shape (n,) [s]."""
        return self.grid.t[self.grid.step_index :] - self.grid.reference.at

    @cached_property
    def nodes(self) -> Array:
        """The nodes' time after the step, shape (K,) [s]."""
        return reading_times(self.grid, self.stride)

    @cached_property
    def record(self) -> StepRecord:
        """The step record of the lanes, the signal without ripple at the nodes, with derivatives to the unknowns."""
        reference, columns, K = self.grid.reference, self.dy.shape[-1], len(self.nodes)
        error, by_column = np.empty((len(self.y), K)), np.empty((len(self.y), columns, K))
        last, last_by_column = np.empty((len(self.y), 1)), np.empty((len(self.y), 1, columns))
        for period, own in self._lanes_by_averaging_time():
            signal = self._output(own, SIGNAL_OUTPUT), self._slopes(own, SIGNAL_OUTPUT)
            along, end = self._at_nodes(signal), (signal[0][:, -1:], signal[1][..., -1:])
            if period:
                along, end = self._remove_ripple(own, period, signal)
            error[own], by_column[own] = along
            last[own], last_by_column[own] = end[0], np.swapaxes(end[1], 1, 2)
        size, since = reference.nominal_size, slice(self.grid.step_index, None)
        y, dy = self.y[:, since], self.dy[:, since]
        shown = meter_values(y, self.channels), meter_values(np.moveaxis(dy, 2, -1), self.channels)
        return StepRecord(
            self.t,
            ((error - reference.final) / size, self._to_gains(np.swapaxes(by_column, 1, 2)) / size),
            ((last - reference.final) / size, self._to_gains(last_by_column) / size),
            self.chain,
            (y[..., CONTROL_OUTPUT], dy[:, :, CONTROL_OUTPUT]),
            {n: (shown[0][n], shown[1][n]) for n in self.channels},
            self.stride,
            self.grid.sample_time,
            self.envelope,
            reference.changes,
            size,
            (reference.values(self.nodes + reference.at) - reference.final) / size,
            reference.disturbance.get(PUSH, 0.0),
        )

    def _to_gains(self, by_column: Array) -> Array:
        """Derivatives to the unknowns from those to the columns, by the chain rule."""
        return np.asarray(by_column @ self.chain)

    def _output(self, own: NDArray[np.bool_], which: int) -> Array:
        """One output of some lanes from the step on, shape (m, n)."""
        return np.ascontiguousarray(self.y[own, self.grid.step_index :, which])

    def _slopes(self, own: NDArray[np.bool_], which: int) -> Array:
        """The derivatives of one output of some lanes from the step on, shape (m, n_columns, n)."""
        return np.ascontiguousarray(np.moveaxis(self.dy[own, self.grid.step_index :, which], 2, 1))

    def _remove_ripple(
        self, own: NDArray[np.bool_], period: float, signal: ValuesAndSlopes
    ) -> tuple[ValuesAndSlopes, ValuesAndSlopes]:
        """The signal without ripple at the nodes, and its final value, with derivatives; as `remove_ripple`."""
        t, count = self.t, DitherPeriodMean(period, self.grid.spacing).mean_count(len(self.t))
        at, weights = wave_instants(t[:count], period)
        first = max(0, int(np.searchsorted(t, at[0])) - 1)
        tail = self._means(own, period, first, 1)
        rest = signal[0][:, first:count] - tail[0], signal[1][..., first:count] - tail[1]
        ripple = ripple_and_slopes(t[first:count], rest, at, weights)
        reach = RIPPLE_ALLOWANCE / 2 * ripple[0][:, None], RIPPLE_ALLOWANCE / 2 * ripple[1][..., None]
        late = [extend_means(t, a, b[..., -1], count, period) for a, b in zip(signal, tail, strict=True)]
        past = -count % self.stride
        early = self._means(own, period, 0, self.stride)
        means = [np.concatenate([a, b[..., past :: self.stride]], axis=-1) for a, b in zip(early, late, strict=True)]
        level = [end_mean(t, a, period)[..., None] for a in signal]
        ends = signal[0][:, -1:], signal[1][..., -1:]
        return _move(self._at_nodes(signal), (means[0], means[1]), reach), _move(ends, (level[0], level[1]), reach)

    def _means(self, own: NDArray[np.bool_], period: float, first: int, stride: int) -> ValuesAndSlopes:
        """Means over the period, from sample `first` to the last that has one, and their derivatives."""
        window = DitherPeriodMean(period, self.grid.spacing)
        before = min(first, window.half_period_samples + 1)  # their means would need the signal further back
        found = []
        for read, initial in ((self._output, self.grid.reference.initial), (self._slopes, 0.0)):
            signal, integral = (read(own, k)[..., first - before :] for k in (SIGNAL_OUTPUT, INTEGRAL_OUTPUT))
            rows, grown = (a.reshape(-1, a.shape[-1]) for a in (signal, integral))
            means = window.means(rows, grown, initial, stride)[:, before:]
            found.append(means.reshape(*signal.shape[:-1], means.shape[-1]))
        return found[0], found[1]

    def _at_nodes(self, signal: ValuesAndSlopes) -> ValuesAndSlopes:
        return signal[0][:, :: self.stride], signal[1][..., :: self.stride]

    def _lanes_by_averaging_time(self) -> Iterator[tuple[float, NDArray[np.bool_]]]:
        """Each averaging time and a mask of the lanes that have it."""
        for period in sorted(set(self.periods)):
            yield period, np.array([other == period for other in self.periods])


def reading_times(grid: ReferenceGrid, stride: int) -> Array:
    """The times after the step at which a response is read [s]."""
    return (grid.t[grid.step_index :] - grid.reference.at)[::stride]


def _move(signal: ValuesAndSlopes, mean: ValuesAndSlopes, reach: ValuesAndSlopes) -> ValuesAndSlopes:
    """The mean where it is within reach of the signal, elsewhere the signal moved towards it by the reach."""
    rest = signal[0] - mean[0]
    side, inside = np.sign(rest), np.abs(rest) <= reach[0]
    slopes = np.where(inside[:, None], mean[1], signal[1] - side[:, None] * reach[1])
    return np.where(inside, mean[0], signal[0] - side * reach[0]), slopes
