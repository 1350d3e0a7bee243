"""What the requirements read off simulated lanes, and its derivatives to the gains: the rows of a max-type problem.

A value is read as `control.metrics` reads it, at the nodes. Where it is the largest or an integral of sizes its
derivative is that of the instant, or sign, that holds now.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.air import ANR_DENSITY, LITRES_PER_CUBIC_METRE
from pneuopt.evaluation.dither_mean import DitherPeriodMean, end_mean
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    AirUse,
    ControlRate,
    Overshoot,
    PeakControl,
    SteadyStateError,
    StepEnvelope,
)
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.readings import CONTROL_OUTPUT, FLOW_OUTPUT, INTEGRAL_OUTPUT, SIGNAL_OUTPUT, ReferenceGrid

ValuesAndSlopes = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Lanes:
    """Simulated lanes of one reference.

    Parameters
    ----------
    grid : Grid
    y : ndarray, shape (m, n, n_watched)
    dy : ndarray, shape (m, n, n_watched, n_columns)
        Numbers, all of them.
    chain : ndarray, shape (m, n_columns, n_gains)
        How the columns move with the unknowns.
    periods : sequence of float
        Over which each lane is averaged [s]; 0: not at all.
    stride : int
        Samples from node to node.
    envelope : sequence of (float, float, float)
    """

    grid: ReferenceGrid
    y: Array
    dy: Array
    chain: Array
    periods: Sequence[float]
    stride: int
    envelope: Envelope = ()

    @cached_property
    def t(self) -> Array:
        """From the step on, shape (n,) [s]."""
        return self.grid.t[self.grid.step_index :] - self.grid.reference.at

    @cached_property
    def nodes(self) -> Array:
        """Shape (K,) [s]."""
        return reading_times(self.grid, self.stride, max(self.periods))

    @cached_property
    def error(self) -> ValuesAndSlopes:
        """The averaged distance from the reference at the nodes, a fraction of the step: shapes (m, K), (m, K, n)."""
        reference, columns, K = self.grid.reference, self.dy.shape[-1], len(self.nodes)
        error, by_column = np.empty((len(self.y), K)), np.empty((len(self.y), columns, K))
        for period, own in self._lanes_by_period():
            signal, slopes = self._output(own, SIGNAL_OUTPUT), self._slopes(own, SIGNAL_OUTPUT)
            if period:
                window = DitherPeriodMean(period, self.grid.spacing)
                integral, grown = self._output(own, INTEGRAL_OUTPUT), self._slopes(own, INTEGRAL_OUTPUT)
                error[own] = window.means(signal, integral, reference.initial, self.stride)[:, :K]
                found = window.means(slopes, grown, 0.0, self.stride)[:, :K]
            else:
                error[own], found = signal[:, :: self.stride][:, :K], slopes[:, :: self.stride][:, :K]
            by_column[own] = found.reshape(-1, columns, K)
        by_gain = self._to_gains(np.swapaxes(by_column, 1, 2))
        return (error - reference.final) / reference.nominal_size, by_gain / reference.nominal_size

    def final_error(self) -> ValuesAndSlopes:
        """The final distance from the reference, a fraction of the step, a row a lane."""
        reference, columns = self.grid.reference, self.dy.shape[-1]
        error, by_column = np.empty((len(self.y), 1)), np.empty((len(self.y), 1, columns))
        for period, own in self._lanes_by_period():
            signal, slopes = self._output(own, SIGNAL_OUTPUT), self._slopes(own, SIGNAL_OUTPUT)
            error[own, 0] = end_mean(self.t, signal, period or None) - reference.final
            by_column[own, 0] = end_mean(self.t, slopes, period or None).reshape(-1, columns)
        return error / reference.nominal_size, self._to_gains(by_column) / reference.nominal_size

    def largest(self, values: Array, slopes: Array) -> ValuesAndSlopes:
        """The largest size of each stretch of time as long as that between nodes, either side."""
        edges = np.arange(0, values.shape[1], max(1, self.stride))
        parts = np.split(np.abs(values), edges[1:], axis=1)
        k = np.array([edge + part.argmax(axis=1) for edge, part in zip(edges, parts, strict=True)]).T
        rows = np.arange(len(values))[:, None]
        return np.abs(values[rows, k]), np.sign(values[rows, k])[..., None] * self._to_gains(slopes[rows, k])

    def sum_error(
        self, weights: Array, of: Callable[[Array], Array], slope: Callable[[Array], Array]
    ) -> ValuesAndSlopes:
        """A weighted sum over the nodes of a function of the error, a row a lane."""
        error, by_gain = self.error
        return (of(error) @ weights)[:, None], np.einsum("mk,mkn->mn", slope(error) * weights, by_gain)[:, None]

    @cached_property
    def weights(self) -> Array:
        """Of the nodes, by the trapezoidal rule [s]."""
        h = np.diff(self.nodes)
        return np.asarray(0.5 * (np.append(h, 0.0) + np.append(0.0, h)))

    def error_between(self, begin: float, end: float) -> ValuesAndSlopes:
        """The error at the nodes of a span and at its ends, linear between nodes."""
        (error, by_gain), t = self.error, self.nodes
        at = np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k]) / (t[k + 1] - t[k])
        slopes = by_gain[:, k] * (1 - share)[:, None] + by_gain[:, k + 1] * share[:, None]
        return error[:, k] * (1 - share) + error[:, k + 1] * share, slopes

    def _to_gains(self, by_column: Array) -> Array:
        return np.asarray(by_column @ self.chain)

    def _output(self, own: NDArray[np.bool_], which: int) -> Array:
        return np.ascontiguousarray(self.y[own, self.grid.step_index :, which])

    def _slopes(self, own: NDArray[np.bool_], which: int) -> Array:
        """A row a lane and column."""
        found = np.ascontiguousarray(np.moveaxis(self.dy[own, self.grid.step_index :, which], 2, 1))
        return found.reshape(-1, found.shape[-1])

    def _lanes_by_period(self) -> Iterator[tuple[float, NDArray[np.bool_]]]:
        """Lanes with one period."""
        for period in sorted(set(self.periods)):
            yield period, np.array([other == period for other in self.periods])


def reading_times(grid: ReferenceGrid, stride: int, period: float) -> Array:
    """Instants after the step at which a response averaged over a period is read [s]."""
    t = grid.t[grid.step_index :] - grid.reference.at
    return t[: DitherPeriodMean(period, grid.spacing).mean_count(len(t)) if period else len(t)][::stride]


def _overshoot_rows(lanes: Lanes) -> ValuesAndSlopes:
    """The error, of what should not move either side."""
    error, slopes = lanes.error
    if lanes.grid.reference.is_step:
        return error, slopes
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def _steady_state_rows(lanes: Lanes) -> ValuesAndSlopes:
    error, slopes = lanes.final_error()
    return np.abs(error), np.sign(error)[..., None] * slopes


def _peak_control_rows(lanes: Lanes) -> ValuesAndSlopes:
    since = slice(lanes.grid.step_index, None)
    return lanes.largest(lanes.y[:, since, CONTROL_OUTPUT], lanes.dy[:, since, CONTROL_OUTPUT])


def _control_rate_rows(lanes: Lanes) -> ValuesAndSlopes:
    """From sample to sample, of a sampled controller over its own sample."""
    h, since = lanes.grid.sample_time or lanes.grid.spacing, slice(lanes.grid.step_index, None)
    k = max(1, round(h / lanes.grid.spacing))
    u, slopes = lanes.y[:, since, CONTROL_OUTPUT], lanes.dy[:, since, CONTROL_OUTPUT]
    return lanes.largest((u[:, k:] - u[:, :-k]) / h, (slopes[:, k:] - slopes[:, :-k]) / h)


def _envelope_rows(lanes: Lanes) -> ValuesAndSlopes:
    """Both sides of the envelope, over its half width."""
    last, values, slopes = lanes.nodes[-1], [], []
    ends = [*(begin for begin, _, _ in lanes.envelope[1:]), np.inf]
    for (begin, lower, upper), end in zip(lanes.envelope, ends, strict=True):
        if begin < last:
            error, by_gain = lanes.error_between(begin, min(end, last))
            used, half = error + 1 - (lower + upper) / 2, (upper - lower) / 2
            values += [used / half, -used / half]
            slopes += [by_gain / half, -by_gain / half]
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def _air_use_rows(lanes: Lanes) -> ValuesAndSlopes:
    h, since = np.diff(lanes.t), slice(lanes.grid.step_index, None)
    weights = LITRES_PER_CUBIC_METRE / ANR_DENSITY * 0.5 * (np.append(h, 0.0) + np.append(0.0, h))
    slopes = np.einsum("k,mkc->mc", weights, lanes.dy[:, since, FLOW_OUTPUT])[:, None]
    return (lanes.y[:, since, FLOW_OUTPUT] @ weights)[:, None], np.asarray(slopes @ lanes.chain)


ROW_READERS: dict[type, Callable[[Lanes], ValuesAndSlopes]] = {
    Overshoot: _overshoot_rows,
    SteadyStateError: _steady_state_rows,
    PeakControl: _peak_control_rows,
    ControlRate: _control_rate_rows,
    IAE: lambda lanes: lanes.sum_error(lanes.weights, np.abs, np.sign),
    ISE: lambda lanes: lanes.sum_error(lanes.weights, np.square, lambda e: 2 * e),
    ITAE: lambda lanes: lanes.sum_error(lanes.weights * lanes.nodes, np.abs, np.sign),
    StepEnvelope: _envelope_rows,
    AirUse: _air_use_rows,
}
"""The requirements that are read off responses here, and how."""
