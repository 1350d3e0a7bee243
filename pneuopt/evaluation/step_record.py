"""`StepRecord`: responses to a step with their derivatives, and the rows of each metric, one for each instant.

A metric is the largest of its rows. `evaluate` reads that largest value. A gradient search reads every row with its
derivative, because the maximum of several rows is not smooth where another row becomes the largest.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require

ValuesAndSlopes = tuple[Array, Array]
RowReader = Callable[["StepRecord"], ValuesAndSlopes]
# Share of a controller's sample time after which an instant counts as one sample later: nearer 1, rounding of the
# instants decides; well below 1, the command's change within a sample would count.
SAMPLE_SHARE = 0.999


def without_slopes(values: Array) -> ValuesAndSlopes:
    """Values with derivatives to no unknowns, shape (..., 0)."""
    return values, np.zeros((*values.shape, 0))


@dataclass(frozen=True, eq=False)
class StepRecord:
    """Responses of m loops to one step on one grid, and derivatives to N unknowns; N is 0 without a gradient search.

    Parameters
    ----------
    t : ndarray, shape (n,)
        Time since the step [s].
    error : tuple of ndarray, shapes (m, K) and (m, K, N)
        Distance of the signal without ripple from the reference at the K nodes, which are every `stride`-th sample, as
        a fraction of the step; and its derivatives to the unknowns.
    final_error : tuple of ndarray, shapes (m, 1) and (m, 1, N)
        The same at the end of the record.
    command : tuple of ndarray, shapes (m, n) and (m, n, C), optional
        The command [its unit] and its derivatives to the C simulated columns, which `chain` maps to the unknowns.
    meter : mapping of str to tuple of ndarray
        The meter's channels by name, with derivatives as for the command.
    chain : ndarray, shape (m, C, N)
        Derivatives of the columns to the unknowns.
    stride : int
        Samples between two nodes.
    sample_time : float, optional
        Sample time of the controller that holds the command [s].
    envelope : sequence of (float, float, float)
        Instants after the step [s], each with the lower and upper bound from then on, as fractions of the step.
    is_step : bool
        False where the reference stays and a disturbance moves the signal.
    size : float
        What the errors are fractions of, with the sign of the reference's change [measured unit].
    wanted : ndarray, shape (K,), optional
        Distance of the reference from its end at the nodes, as a fraction of the size; without it there is none.
    push : float
        By how much the load's force steps [N].
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
    size: float = 1.0
    wanted: Array | None = None
    push: float = 0.0

    @cached_property
    def nodes(self) -> Array:
        """Instants at which the error is known, shape (K,) [s]."""
        return self.t[:: self.stride][: self.error[0].shape[1]]

    def largest(self, values: Array, slopes: Array) -> ValuesAndSlopes:
        """Largest absolute value between each two nodes; without derivatives, of the whole record."""
        edges = np.arange(0, values.shape[1], max(1, self.stride)) if self.chain.shape[-1] else np.zeros(1, dtype=int)
        parts = np.split(np.abs(values), edges[1:], axis=1)
        k = np.array([edge + part.argmax(axis=1) for edge, part in zip(edges, parts, strict=True)]).T
        rows = np.arange(len(values))[:, None]
        return np.abs(values[rows, k]), np.sign(values[rows, k])[..., None] * self._to_unknowns(slopes[rows, k])

    def integrate_meter(self, channel: str) -> ValuesAndSlopes:
        """Integral of a channel of the meter over time, a row a response."""
        (values, slopes), weights = self.meter[channel], trapezoidal_weights(self.t)
        by_column = _sum_rows(np.broadcast_to(weights, values.shape), slopes)
        return _integrate(weights, values), self._to_unknowns(by_column)

    def error_integral(
        self, weights: Array, of: Callable[[Array], Array], slope: Callable[[Array], Array]
    ) -> ValuesAndSlopes:
        """Weighted sum over the nodes of a function of the error, a row a response."""
        error, slopes = self.error
        return _integrate(weights, of(error)), _sum_rows(slope(error) * weights, slopes)

    def error_between(self, begin: float, end: float) -> ValuesAndSlopes:
        """Error at the nodes of a time span and at its ends, linear between nodes."""
        (error, by_unknown), t = self.error, self.nodes
        at = np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k]) / (t[k + 1] - t[k])
        slopes = by_unknown[:, k] * (1 - share)[:, None] + by_unknown[:, k + 1] * share[:, None]
        return error[:, k] * (1 - share) + error[:, k + 1] * share, slopes

    def _to_unknowns(self, by_column: Array) -> Array:
        return np.asarray(by_column @ self.chain)


def _integrate(weights: Array, values: Array) -> Array:
    """Weighted sums, shape (m, 1), of values of shape (m, K), on one core.

    BLAS would start a thread for a fine record, which then waits for more work for 20 ms of CPU time.
    """
    return np.asarray(np.einsum("k,mk->m", weights, values))[:, None]


def _sum_rows(weights: Array, slopes: Array) -> Array:
    """Weighted sums of slopes, shape (m, 1, N), of shapes (m, K) and (m, K, N).

    Without unknowns, N = 0, they are not walked through: of a fine record that took a tenth of an evaluation.
    """
    m, _, count = slopes.shape
    return np.asarray(np.einsum("mk,mkn->mn", weights, slopes))[:, None] if count else np.zeros((m, 1, 0))


def trapezoidal_weights(t: Array) -> Array:
    """Weights of samples with which a sum is the integral by the trapezoidal rule [s]."""
    h = np.diff(t)
    return np.asarray(0.5 * (np.append(h, 0.0) + np.append(0.0, h)))


def overshoot_rows(record: StepRecord) -> ValuesAndSlopes:
    """The error beyond the reference; under a disturbance, where the signal should not move, on either side."""
    error, slopes = record.error
    if record.is_step:
        return error, slopes
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def steady_state_rows(record: StepRecord) -> ValuesAndSlopes:
    """The absolute error at the end."""
    error, slopes = record.final_error
    return np.abs(error), np.sign(error)[..., None] * slopes


def iae_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the absolute error."""
    return record.error_integral(trapezoidal_weights(record.nodes), np.abs, np.sign)


def ise_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the squared error."""
    return record.error_integral(trapezoidal_weights(record.nodes), np.square, lambda error: 2 * error)


def itae_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the absolute error times the time since the step."""
    return record.error_integral(trapezoidal_weights(record.nodes) * record.nodes, np.abs, np.sign)


def envelope_rows(record: StepRecord) -> ValuesAndSlopes:
    """Distance from the middle of the envelope over its half width, a row each side."""
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
    """The absolute command."""
    assert record.command is not None
    return record.largest(*record.command)


def control_rate_rows(record: StepRecord) -> ValuesAndSlopes:
    """Rate of change of the command from sample to sample; of a held command over the controller's sample time."""
    assert record.command is not None
    (u, slopes), t, h = record.command, record.t, record.sample_time
    if h is None:
        step = np.diff(t)
        return record.largest(np.diff(u, axis=1) / step, np.diff(slopes, axis=1) / step[:, None])
    begin = np.flatnonzero(t <= t[-1] - SAMPLE_SHARE * h)
    require(len(begin) > 0, f"the record of {t[-1] - t[0]:g} s is shorter than the controller's sample time")
    end = np.searchsorted(t, t[begin] + SAMPLE_SHARE * h)
    return record.largest((u[:, end] - u[:, begin]) / h, (slopes[:, end] - slopes[:, begin]) / h)
