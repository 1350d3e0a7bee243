"""`Lanes`: simulated responses with their derivatives to the gains, as step records from which metrics are read.

The signal is averaged and read at nodes. Where a metric is the largest value over time, or the integral of an absolute
value, its derivative is taken at the present instant of the maximum, or with the present sign.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.dither_mean import DitherPeriodMean, end_mean
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.step_record import StepRecord
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
        The time over which each lane is averaged [s]; 0: it is not averaged.
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
        return reading_times(self.grid, self.stride, max(self.periods))

    @cached_property
    def record(self) -> StepRecord:
        """The step record of the lanes, the averaged signal at the nodes, with derivatives to the unknowns."""
        reference, columns, K = self.grid.reference, self.dy.shape[-1], len(self.nodes)
        error, by_column = np.empty((len(self.y), K)), np.empty((len(self.y), columns, K))
        last, last_by_column = np.empty((len(self.y), 1)), np.empty((len(self.y), 1, columns))
        for period, own in self._lanes_by_averaging_time():
            signal, slopes = self._output(own, SIGNAL_OUTPUT), self._slopes(own, SIGNAL_OUTPUT)
            if period:
                window = DitherPeriodMean(period, self.grid.spacing)
                integral, grown = self._output(own, INTEGRAL_OUTPUT), self._slopes(own, INTEGRAL_OUTPUT)
                error[own] = window.means(signal, integral, reference.initial, self.stride)[:, :K]
                found = window.means(slopes, grown, 0.0, self.stride)[:, :K]
            else:
                error[own], found = signal[:, :: self.stride][:, :K], slopes[:, :: self.stride][:, :K]
            by_column[own] = found.reshape(-1, columns, K)
            last[own, 0] = end_mean(self.t, signal, period or None)
            last_by_column[own, 0] = end_mean(self.t, slopes, period or None).reshape(-1, columns)
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
            reference.is_step,
        )

    def _to_gains(self, by_column: Array) -> Array:
        """Derivatives to the unknowns from those to the columns, by the chain rule."""
        return np.asarray(by_column @ self.chain)

    def _output(self, own: NDArray[np.bool_], which: int) -> Array:
        """One output of some lanes from the step on, shape (m, n)."""
        return np.ascontiguousarray(self.y[own, self.grid.step_index :, which])

    def _slopes(self, own: NDArray[np.bool_], which: int) -> Array:
        """The derivatives of one output, a row for each lane and column."""
        found = np.ascontiguousarray(np.moveaxis(self.dy[own, self.grid.step_index :, which], 2, 1))
        return found.reshape(-1, found.shape[-1])

    def _lanes_by_averaging_time(self) -> Iterator[tuple[float, NDArray[np.bool_]]]:
        """Each averaging time and a mask of the lanes that have it."""
        for period in sorted(set(self.periods)):
            yield period, np.array([other == period for other in self.periods])


def reading_times(grid: ReferenceGrid, stride: int, period: float) -> Array:
    """The times after the step at which a response that is averaged over a period is read [s]."""
    t = grid.t[grid.step_index :] - grid.reference.at
    return t[: DitherPeriodMean(period, grid.spacing).mean_count(len(t)) if period else len(t)][::stride]
