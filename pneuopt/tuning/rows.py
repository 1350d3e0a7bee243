"""What the requirements read off simulated lanes, and its derivatives to the gains: the rows of a max-type problem.

A value is read as `control.metrics` reads it, at the nodes. Where it is the largest or an integral of sizes its
derivative is that of the instant, or sign, that holds now.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.air import LITRES, NORMAL_DENSITY
from pneuopt.evaluation.means import end_mean
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
from pneuopt.evaluation.window import Window
from pneuopt.tuning.readings import CONTROL, FLOW, INTEGRAL, SIGNAL, Grid

Array = NDArray[np.float64]
Rows = tuple[Array, Array]


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

    grid: Grid
    y: Array
    dy: Array
    chain: Array
    periods: Sequence[float]
    stride: int
    envelope: Envelope = ()

    @cached_property
    def t(self) -> Array:
        """From the step on, shape (n,) [s]."""
        return self.grid.t[self.grid.after :] - self.grid.reference.at

    @cached_property
    def nodes(self) -> Array:
        """Shape (K,) [s]."""
        return nodes(self.grid, self.stride, max(self.periods))

    @cached_property
    def error(self) -> Rows:
        """The averaged distance from the reference at the nodes, a fraction of the step: shapes (m, K), (m, K, n)."""
        reference, columns, K = self.grid.reference, self.dy.shape[-1], len(self.nodes)
        error, by_column = np.empty((len(self.y), K)), np.empty((len(self.y), columns, K))
        for period, own in self._alike():
            signal, slopes = self._watched(own, SIGNAL), self._slopes(own, SIGNAL)
            if period:
                window = Window(period, self.grid.spacing)
                integral, grown = self._watched(own, INTEGRAL), self._slopes(own, INTEGRAL)
                error[own] = window.means(signal, integral, reference.initial, self.stride)[:, :K]
                found = window.means(slopes, grown, 0.0, self.stride)[:, :K]
            else:
                error[own], found = signal[:, :: self.stride][:, :K], slopes[:, :: self.stride][:, :K]
            by_column[own] = found.reshape(-1, columns, K)
        by_gain = self._by_gain(np.swapaxes(by_column, 1, 2))
        return (error - reference.final) / reference.whole, by_gain / reference.whole

    def at_end(self) -> Rows:
        """The final distance from the reference, a fraction of the step, a row a lane."""
        reference, columns = self.grid.reference, self.dy.shape[-1]
        error, by_column = np.empty((len(self.y), 1)), np.empty((len(self.y), 1, columns))
        for period, own in self._alike():
            signal, slopes = self._watched(own, SIGNAL), self._slopes(own, SIGNAL)
            error[own, 0] = end_mean(self.t, signal, period or None) - reference.final
            by_column[own, 0] = end_mean(self.t, slopes, period or None).reshape(-1, columns)
        return error / reference.whole, self._by_gain(by_column) / reference.whole

    def largest(self, values: Array, slopes: Array) -> Rows:
        """The largest size of each stretch of time as long as that between nodes, either side."""
        edges = np.arange(0, values.shape[1], max(1, self.stride))
        parts = np.split(np.abs(values), edges[1:], axis=1)
        k = np.array([edge + part.argmax(axis=1) for edge, part in zip(edges, parts, strict=True)]).T
        rows = np.arange(len(values))[:, None]
        return np.abs(values[rows, k]), np.sign(values[rows, k])[..., None] * self._by_gain(slopes[rows, k])

    def summed(self, weights: Array, of: Callable[[Array], Array], slope: Callable[[Array], Array]) -> Rows:
        """A weighted sum over the nodes of a function of the error, a row a lane."""
        error, by_gain = self.error
        return (of(error) @ weights)[:, None], np.einsum("mk,mkn->mn", slope(error) * weights, by_gain)[:, None]

    @cached_property
    def weights(self) -> Array:
        """Of the nodes, by the trapezoidal rule [s]."""
        h = np.diff(self.nodes)
        return np.asarray(0.5 * (np.append(h, 0.0) + np.append(0.0, h)))

    def between(self, begin: float, end: float) -> Rows:
        """The error at the nodes of a span and at its ends, linear between nodes."""
        (error, by_gain), t = self.error, self.nodes
        at = np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k]) / (t[k + 1] - t[k])
        slopes = by_gain[:, k] * (1 - share)[:, None] + by_gain[:, k + 1] * share[:, None]
        return error[:, k] * (1 - share) + error[:, k + 1] * share, slopes

    def _by_gain(self, by_column: Array) -> Array:
        return np.asarray(by_column @ self.chain)

    def _watched(self, own: NDArray[np.bool_], which: int) -> Array:
        return np.ascontiguousarray(self.y[own, self.grid.after :, which])

    def _slopes(self, own: NDArray[np.bool_], which: int) -> Array:
        """A row a lane and column."""
        found = np.ascontiguousarray(np.moveaxis(self.dy[own, self.grid.after :, which], 2, 1))
        return found.reshape(-1, found.shape[-1])

    def _alike(self) -> Iterator[tuple[float, NDArray[np.bool_]]]:
        """Lanes with one period."""
        for period in sorted(set(self.periods)):
            yield period, np.array([other == period for other in self.periods])


def nodes(grid: Grid, stride: int, period: float) -> Array:
    """Instants after the step at which a response averaged over a period is read [s]."""
    t = grid.t[grid.after :] - grid.reference.at
    return t[: Window(period, grid.spacing).reach(len(t)) if period else len(t)][::stride]


def _beyond(lanes: Lanes) -> Rows:
    """The error, of what should not move either side."""
    error, slopes = lanes.error
    if lanes.grid.reference.is_step:
        return error, slopes
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def _steady(lanes: Lanes) -> Rows:
    error, slopes = lanes.at_end()
    return np.abs(error), np.sign(error)[..., None] * slopes


def _peak(lanes: Lanes) -> Rows:
    since = slice(lanes.grid.after, None)
    return lanes.largest(lanes.y[:, since, CONTROL], lanes.dy[:, since, CONTROL])


def _rate(lanes: Lanes) -> Rows:
    """From sample to sample, of a sampled controller over its own sample."""
    h, since = lanes.grid.sample_time or lanes.grid.spacing, slice(lanes.grid.after, None)
    k = max(1, round(h / lanes.grid.spacing))
    u, slopes = lanes.y[:, since, CONTROL], lanes.dy[:, since, CONTROL]
    return lanes.largest((u[:, k:] - u[:, :-k]) / h, (slopes[:, k:] - slopes[:, :-k]) / h)


def _enveloped(lanes: Lanes) -> Rows:
    """Both sides of the envelope, over its half width."""
    last, values, slopes = lanes.nodes[-1], [], []
    ends = [*(begin for begin, _, _ in lanes.envelope[1:]), np.inf]
    for (begin, lower, upper), end in zip(lanes.envelope, ends, strict=True):
        if begin < last:
            error, by_gain = lanes.between(begin, min(end, last))
            used, half = error + 1 - (lower + upper) / 2, (upper - lower) / 2
            values += [used / half, -used / half]
            slopes += [by_gain / half, -by_gain / half]
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def _air(lanes: Lanes) -> Rows:
    h, since = np.diff(lanes.t), slice(lanes.grid.after, None)
    weights = LITRES / NORMAL_DENSITY * 0.5 * (np.append(h, 0.0) + np.append(0.0, h))
    slopes = np.einsum("k,mkc->mc", weights, lanes.dy[:, since, FLOW])[:, None]
    return (lanes.y[:, since, FLOW] @ weights)[:, None], np.asarray(slopes @ lanes.chain)


READ: dict[type, Callable[[Lanes], Rows]] = {
    Overshoot: _beyond,
    SteadyStateError: _steady,
    PeakControl: _peak,
    ControlRate: _rate,
    IAE: lambda lanes: lanes.summed(lanes.weights, np.abs, np.sign),
    ISE: lambda lanes: lanes.summed(lanes.weights, np.square, lambda e: 2 * e),
    ITAE: lambda lanes: lanes.summed(lanes.weights * lanes.nodes, np.abs, np.sign),
    StepEnvelope: _enveloped,
    AirUse: _air,
}
"""The requirements that are read off responses here, and how."""
