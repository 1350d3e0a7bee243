"""`StepRecord`: responses to a step with their derivatives, and how metrics are read off them, a row an instant.

A metric is the largest of its rows. What certifies a design reads that largest value; a search by gradients reads every
row with its derivative, for the largest of several is not smooth where another one takes over.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require

ValuesAndSlopes = tuple[Array, Array]
RowReader = Callable[["StepRecord"], ValuesAndSlopes]
SAMPLE_SHARE = (
    0.999  # of a controller's sample, by which an instant counts as one sample later: above it rounding counts
)


def without_slopes(values: Array) -> ValuesAndSlopes:
    """Values that nobody differentiates: by no unknown."""
    return values, np.zeros((*values.shape, 0))


@dataclass(frozen=True, eq=False)
class StepRecord:
    """m responses to one step on one grid, and how they move with N unknowns; N is 0 where nobody asks.

    Parameters
    ----------
    t : ndarray, shape (n,)
        From the step on, counted from there [s].
    error : tuple of ndarray, shapes (m, K) and (m, K, N)
        Distance of the averaged signal from the reference at the first K of every `stride`-th sample, a fraction of the
        step, and its derivatives to the unknowns.
    final_error : tuple of ndarray, shapes (m, 1) and (m, 1, N)
        Likewise at the end.
    command : tuple of ndarray, shapes (m, n) and (m, n, C), optional
        [the command's unit], and its derivatives to the C columns that were simulated.
    meter : mapping of str to tuple of ndarray
        Likewise what the plant's meter shows, by channel.
    chain : ndarray, shape (m, C, N)
        How the columns move with the unknowns.
    stride : int
        Samples from node to node.
    sample_time : float, optional
        Of the controller that holds the command [s].
    envelope : sequence of (float, float, float)
        Instants after the step [s], each with the bounds from then on, as fractions of the step.
    is_step : bool
        False: the reference stays, and what moves the signal is a disturbance.
    """

    t: Array
    error: ValuesAndSlopes
    final_error: ValuesAndSlopes
    chain: Array
    command: ValuesAndSlopes | None = None
    meter: Mapping[str, ValuesAndSlopes] = field(default_factory=dict)
    stride: int = 1
    sample_time: float | None = None
    envelope: Sequence[tuple[float, float, float]] = ()
    is_step: bool = True

    @cached_property
    def nodes(self) -> Array:
        """Instants of the error, shape (K,) [s]."""
        return self.t[:: self.stride][: self.error[0].shape[1]]

    def largest(self, values: Array, slopes: Array) -> ValuesAndSlopes:
        """The largest size of each stretch as long as that between nodes; of all where nobody differentiates."""
        edges = np.arange(0, values.shape[1], max(1, self.stride)) if self.chain.shape[-1] else np.zeros(1, dtype=int)
        parts = np.split(np.abs(values), edges[1:], axis=1)
        k = np.array([edge + part.argmax(axis=1) for edge, part in zip(edges, parts, strict=True)]).T
        rows = np.arange(len(values))[:, None]
        return np.abs(values[rows, k]), np.sign(values[rows, k])[..., None] * self._to_unknowns(slopes[rows, k])

    def metered_integral(self, channel: str) -> ValuesAndSlopes:
        """The integral of a channel of the meter over time, a row a response."""
        (values, slopes), weights = self.meter[channel], trapezoidal_weights(self.t)
        by_column = np.einsum("k,mkc->mc", weights, slopes)[:, None]
        return (values @ weights)[:, None], self._to_unknowns(by_column)

    def error_integral(
        self, weights: Array, of: Callable[[Array], Array], slope: Callable[[Array], Array]
    ) -> ValuesAndSlopes:
        """A weighted sum over the nodes of a function of the error, a row a response."""
        error, slopes = self.error
        return (of(error) @ weights)[:, None], np.einsum("mk,mkn->mn", slope(error) * weights, slopes)[:, None]

    def error_between(self, begin: float, end: float) -> ValuesAndSlopes:
        """The error at the nodes of a span and at its ends, linear between nodes."""
        (error, by_unknown), t = self.error, self.nodes
        at = np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k]) / (t[k + 1] - t[k])
        slopes = by_unknown[:, k] * (1 - share)[:, None] + by_unknown[:, k + 1] * share[:, None]
        return error[:, k] * (1 - share) + error[:, k + 1] * share, slopes

    def _to_unknowns(self, by_column: Array) -> Array:
        return np.asarray(by_column @ self.chain)


def trapezoidal_weights(t: Array) -> Array:
    """Of samples, so that a weighted sum is the integral by the trapezoidal rule [s]."""
    h = np.diff(t)
    return np.asarray(0.5 * (np.append(h, 0.0) + np.append(0.0, h)))


def overshoot_rows(record: StepRecord) -> ValuesAndSlopes:
    """The error; of what should not move, on either side."""
    error, slopes = record.error
    if record.is_step:
        return error, slopes
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def steady_state_rows(record: StepRecord) -> ValuesAndSlopes:
    """The size of the error at the end."""
    error, slopes = record.final_error
    return np.abs(error), np.sign(error)[..., None] * slopes


def iae_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the error's size."""
    return record.error_integral(trapezoidal_weights(record.nodes), np.abs, np.sign)


def ise_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the error's square."""
    return record.error_integral(trapezoidal_weights(record.nodes), np.square, lambda error: 2 * error)


def itae_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the error's size times the time since the step."""
    return record.error_integral(trapezoidal_weights(record.nodes) * record.nodes, np.abs, np.sign)


def envelope_rows(record: StepRecord) -> ValuesAndSlopes:
    """Distance from the middle of the envelope over its half width, on both sides."""
    last, first = record.nodes[-1], record.error
    values, slopes = [np.zeros((len(first[0]), 1))], [np.zeros((len(first[0]), 1, first[1].shape[-1]))]
    ends = [*(begin for begin, _, _ in record.envelope[1:]), np.inf]
    for (begin, lower, upper), end in zip(record.envelope, ends, strict=True):
        if begin < last:
            error, by_unknown = record.error_between(begin, min(end, last))
            used, half = error + 1 - (lower + upper) / 2, (upper - lower) / 2
            values += [used / half, -used / half]
            slopes += [by_unknown / half, -by_unknown / half]
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def peak_control_rows(record: StepRecord) -> ValuesAndSlopes:
    """The command's size."""
    assert record.command is not None
    return record.largest(*record.command)


def control_rate_rows(record: StepRecord) -> ValuesAndSlopes:
    """The command's change from sample to sample; of a held one, which jumps, over the controller's own sample."""
    assert record.command is not None
    (u, slopes), t, h = record.command, record.t, record.sample_time
    if h is None:
        step = np.diff(t)
        return record.largest(np.diff(u, axis=1) / step, np.diff(slopes, axis=1) / step[:, None])
    begin = np.flatnonzero(t <= t[-1] - SAMPLE_SHARE * h)
    require(len(begin) > 0, f"the record of {t[-1] - t[0]:g} s is shorter than the controller's sample time")
    end = np.searchsorted(t, t[begin] + SAMPLE_SHARE * h)
    return record.largest((u[:, end] - u[:, begin]) / h, (slopes[:, end] - slopes[:, begin]) / h)
