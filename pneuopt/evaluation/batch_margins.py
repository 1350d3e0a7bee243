"""Margins and sensitivity peaks of many loops at once, for searches; `margins` gives one loop's exactly.

The sensitivity of a loop whose open loop rolls off is ``S(s) = prod (s - p)/prod (s - q)`` over the poles p of the open
and q of the closed loop. So `sensitivity_peaks` takes no frequency response of the plant, and the resonances are known
beforehand: they lie near the closed loop's poles.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import inf, nan
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.control.averaging import AveragedPlant
from pneuopt.control.linear_controller import controller_matrices, linear_gains, pade_delay_response
from pneuopt.control.linear_loop import ComposedLoops
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import names
from pneuopt.evaluation.margins import (
    NOISE_GAIN,
    ComplexArray,
    are_stable,
    batch_frequency_response,
    controller_parts,
    counted_points,
    rests_below_zero,
)
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.tolerances import LOOPS_AT_A_TIME, PEAK_GRID_POINTS, PEAK_REFINEMENTS, SPREAD_FREQUENCIES
from pneuopt.quantities.arrays import Array

MAX_SENSITIVITY = "MaxSensitivity"
Matrices = tuple[Array, Array, Array]  # A, B, C of m plants, shapes (m, n, n), (m, n, 1), (m, 1, n)
Matrices4 = tuple[Array, Array, Array, Array]  # and D, shape (m, 1, 1)


MarginFunction = Callable[[Array, Array, Array, Collection[str]], dict[str, Array]]
"""``(p, x, u, only) -> found``; see `batch_margin_function`."""
Responses = Callable[[Array], tuple[ComplexArray, ComplexArray]]
"""``w -> (L, C)``: responses of m loops and of their controllers from measurement to command."""


def batch_margin_function(loop: ClosedLoop, omega: ArrayLike, lowest_noise: float = 0.0) -> MarginFunction:
    """Function that gives margins, sensitivities and noise gains for many gains and operating points at once.

    The frequencies `omega` [rad/s], shape (n,), are positive, increasing; from `lowest_noise` on a noise gain counts.
    The function ``(p, x, u, only) -> found`` takes parameters, shape (m, n_parameters), in the order of
    ``loop.parameters``, and the plant's states and inputs at k operating points of each, shapes (k, m, n_plant_states)
    and (k, m, n_plant_inputs), means under dither; its arguments are not checked. It gives an array of shape (m,) for
    each name in `only`, the worst over the points: "MaxSensitivity", "MaxComplementarySensitivity", "GainMargin",
    "PhaseMargin" [deg] as in `Margins`, and "NoiseGain". Crossings are interpolated, peaks refined between the grid's
    frequencies. Where a closed loop is unstable, its margins are NaN, its sensitivities and noise gain infinite.
    """
    w = np.asarray(omega, dtype=float)
    if loop.is_composed:
        return _read_worst(_composed_reader(loop, w, lowest_noise))
    linearise, command = _plants(loop), names(loop.plant.inputs).index(loop.command.name)

    def read_points(p: Array, x: Array, u: Array, only: Collection[str]) -> dict[str, Array]:
        plants = linearise(p, x, u)
        gains = linear_gains(loop, p.T, plants.measured, u[:, command]).full()
        controllers, matrices = controller_matrices(gains, loop.dead_time), plants.with_sensor()
        (A, B, C), (Ac, Bc, Cc, Dc) = matrices, controllers
        closed = np.block([[A - B @ Dc @ C, B @ Cc], [-Bc @ C, Ac]])
        poles = _poles(closed)
        if set(only) == {MAX_SENSITIVITY} and not plants.D.any():
            opened = np.concatenate([_poles(matrices[0]), _poles(controllers[0])], axis=1)
            found = {MAX_SENSITIVITY: sensitivity_peaks(opened, poles, w[0], w[-1])}
        else:
            respond, at_infinity = _pid_responses(gains, plants.response(loop.dead_time, w))
            found = _read_responses(respond, at_infinity, w, lowest_noise, only)
        if MAX_SENSITIVITY in only:  # at infinity the loop is open
            found[MAX_SENSITIVITY] = np.maximum(found[MAX_SENSITIVITY], 1.0)
        return _mark_unstable(found, closed, poles)

    return _read_worst(read_points)


def _read_worst(read_points: MarginFunction) -> MarginFunction:
    """The function that reads the worst over operating points, from one that reads single points."""

    def read_margins(p: Array, x: Array, u: Array, only: Collection[str]) -> dict[str, Array]:
        k, m = x.shape[:2]
        found = read_points(np.tile(p, (k, 1)), x.reshape(k * m, -1), u.reshape(k * m, -1), only)
        worst = {}
        for n, each in found.items():
            values = each.reshape(k, m)[-counted_points(n, k) :]
            cost = np.where(np.isnan(values), inf, METRICS[n].requirement_value(values))  # NaN is an unstable loop's
            worst[n] = np.asarray(values[np.argmax(cost, axis=0), np.arange(m)])
        return worst

    return read_margins


def _composed_reader(loop: ClosedLoop, w: Array, lowest_noise: float) -> MarginFunction:
    """Function that reads the margins of loops with further feedback, for parameters and points of shape (m, n)."""
    linearise = ComposedLoops(loop, compiled=True)

    def read_points(p: Array, x: Array, u: Array, only: Collection[str]) -> dict[str, Array]:
        opened, noise = linearise(p, x, u)
        parts = [_partial_fraction_response(A, B[..., 0], C[:, 0], w) for A, B, C, _ in (opened, noise)]
        (A, B, C, D), ends = opened, (opened[3][:, 0, 0], noise[3][:, 0, 0])

        def responses(w: Array) -> tuple[ComplexArray, ComplexArray]:
            L, control = (part(w) + end[:, None] for part, end in zip(parts, ends, strict=True))
            return L, control

        found = _read_responses(responses, np.abs(ends[1] / (1 + ends[0])), w, lowest_noise, only)
        if MAX_SENSITIVITY in only:
            found[MAX_SENSITIVITY] = np.maximum(found[MAX_SENSITIVITY], np.abs(1 / (1 + ends[0])))
        closed = A - B @ C / (1 + D)
        return _mark_unstable(found, closed, _poles(closed))

    return read_points


def _mark_unstable(found: dict[str, Array], closed: Array, poles: ComplexArray) -> dict[str, Array]:
    """Metrics with those of unstable loops NaN or infinite, by the closed loops' matrices and poles."""
    stable = are_stable(closed, poles)
    return {n: np.where(stable, value, nan if n in _MARGIN_FUNCTIONS else inf) for n, value in found.items()}


def _pid_responses(gains: Array, plant: Callable[[Array], ComplexArray]) -> tuple[Responses, Array]:
    """Of loops with a PID alone, and what a noise gain is at infinity, shape (m,)."""
    Kp, Ki, Kd, Tf = gains[..., None]

    def responses(w: Array) -> tuple[ComplexArray, ComplexArray]:
        a, b = controller_parts((Kp, Ki, Kd, Tf), w)
        return plant(w) * (a + 1j * b), a + 1j * b

    return responses, np.abs(Kp + Kd / Tf)[:, 0]


def _read_responses(
    responses: Responses, noise_at_infinity: Array, w: Array, lowest_noise: float, only: Collection[str]
) -> dict[str, Array]:
    """Margins and peaks of loops on frequencies of shape (n,), crossings interpolated and peaks refined."""
    (L, C), noisy = responses(w), int(np.searchsorted(w, (1 - 1e-9) * lowest_noise))
    with np.errstate(all="ignore"):
        found = {n: crossing(L) for n, crossing in _MARGIN_FUNCTIONS.items() if n in only}
        for n, size in ((n, size) for n, size in _PEAK_FUNCTIONS.items() if n in only):
            k = noisy if n == NOISE_GAIN else 0
            found[n] = _refine_peaks(size, responses, w[k:], size(L[:, k:], C[:, k:]))
    if NOISE_GAIN in only:
        found[NOISE_GAIN] = np.maximum(found[NOISE_GAIN], noise_at_infinity)
    return found


def _refine_peaks(
    size: Callable[[ComplexArray, ComplexArray], Array],
    responses: Callable[[Array], tuple[ComplexArray, ComplexArray]],
    omega: Array,
    on_grid: Array,
) -> Array:
    """Largest magnitude of a response, shape (m,), on a grid and on finer grids about its two highest peaks."""
    m, last = len(on_grid), len(omega) - 1
    edged = np.pad(on_grid, ((0, 0), (1, 1)), constant_values=-inf)
    is_peak = (on_grid >= edged[:, :-2]) & (on_grid >= edged[:, 2:])
    k = np.argpartition(np.where(is_peak, -on_grid, 0.0), 1, axis=1)[:, :2]
    low, high = np.log(omega[np.maximum(k - 1, 0)]), np.log(omega[np.minimum(k + 1, last)])
    largest, rows = on_grid.max(axis=1), np.arange(m)
    for _ in range(PEAK_REFINEMENTS):
        grids = low[..., None] + (high - low)[..., None] * np.linspace(0.0, 1.0, PEAK_GRID_POINTS)
        sizes = size(*responses(np.exp(grids.reshape(m, -1)))).reshape(grids.shape)
        peak, at = sizes.max(axis=2).argmax(axis=1), sizes.argmax(axis=2)
        largest = np.fmax(largest, sizes.max(axis=(1, 2)))
        chosen, at = grids[rows, peak], at[rows, peak]
        low, high = (
            chosen[rows, np.maximum(at - 1, 0), None],
            chosen[rows, np.minimum(at + 1, PEAK_GRID_POINTS - 1), None],
        )
    return np.asarray(largest)


@dataclass(frozen=True, eq=False)
class _Plants:
    """m plants in states scaled by their nominal values, shapes as `PlantMatrices`, and sensors' lags, shape (m, 1)."""

    A: Array
    B: Array
    C: Array
    D: Array
    measured: Array
    lag: Array

    def response(self, dead_time: float, typical: Array) -> Callable[[Array], ComplexArray]:
        """Responses with sensor and hold, a function of frequencies (n,) or (m, n); checked on typical ones."""
        plant = _partial_fraction_response(self.A, self.B, self.C, typical)

        def response(w: Array) -> ComplexArray:
            delay = pade_delay_response(w, dead_time)
            return np.asarray((plant(w) + self.D[:, None]) * delay / (1 + 1j * w * self.lag))

        return response

    def with_sensor(self) -> Matrices:
        """A, B and C of the plants with their first-order sensors, where any of them has one."""
        (A, B, C), m = (self.A, self.B[..., None], self.C[:, None]), len(self.lag)
        if not self.lag.any():
            return A, B, C
        n, has_lag = A.shape[-1], self.lag > 0
        rate = 1 / np.where(has_lag, self.lag, 1.0)[..., None]
        sensed = np.block([[A, np.zeros((m, n, 1))], [C * rate, -rate]])
        reading = np.where(has_lag[..., None], np.eye(1, n + 1, n), np.concatenate([C, np.zeros((m, 1, 1))], axis=2))
        return sensed, np.concatenate([B, np.zeros((m, 1, 1))], axis=1), reading


def _plants(loop: ClosedLoop) -> Callable[[Array, Array, Array], _Plants]:
    """Function that linearises the plants of many loops, as `AveragedPlant` does."""
    average, scale = AveragedPlant(loop, compiled=True), np.array([s.nominal for s in loop.plant.states])

    def linearise(p: Array, x: Array, u: Array) -> _Plants:
        A, B, C, D, measured = average(p, x, u)
        A, B, C = A * scale / scale[:, None], B / scale, C * scale  # so the matrix of eigenvectors is well conditioned
        return _Plants(A, B, C, D, measured, np.reshape(loop.sensor_lag(p.T), (-1, 1)))

    return linearise


def _poles(A: Array) -> ComplexArray:
    """Eigenvalues of m matrices, shape (m, n); those of NaN matrices are 1, so that they count as unstable."""
    sound = np.asarray(np.isfinite(A).all(axis=(1, 2)))
    tame = A if sound.all() else np.where(sound[:, None, None], A, np.eye(A.shape[-1]))
    return np.asarray(np.linalg.eigvals(tame), dtype=complex)


def _gain_margins(L: ComplexArray) -> Array:
    """Gain margins (m,), crossings of -180 deg interpolated in phase and log gain; a negative L(0) counts as well."""
    phase, gain = np.angle(-L), np.log(np.abs(L))
    at, crossing = _interpolate_crossings(phase, gain, np.abs(np.diff(phase, axis=1)) < np.pi)
    at_rest = np.where(rests_below_zero(L[:, :2]), -gain[:, 0], inf)
    return np.asarray(np.exp(_smallest_in_rows(np.column_stack([np.where(crossing, -at, inf), at_rest]))))


def _phase_margins(L: ComplexArray) -> Array:
    """Phase margins, shape (m,) [deg]; crossings of gain one are interpolated likewise."""
    phase, gain = np.unwrap(np.angle(-L), axis=1), np.log(np.abs(L))
    at, crossing = _interpolate_crossings(gain, phase)
    return np.degrees(_smallest_in_rows(np.where(crossing, (at + np.pi) % (2 * np.pi) - np.pi, inf)))


def _interpolate_crossings(values: Array, others: Array, allowed: Any = True) -> tuple[Array, NDArray[np.bool_]]:
    """Others at the zero crossings of the values, linear between neighbours, and a mask of the crossings."""
    step = np.diff(values, axis=1)
    crossing = (values[:, :-1] * values[:, 1:] <= 0) & (step != 0) & allowed
    share = -values[:, :-1] / np.where(crossing, step, 1.0)
    return others[:, :-1] + share * np.diff(others, axis=1), crossing


def _smallest_in_rows(rows: Array) -> Array:
    """Entry of each row with the smallest magnitude."""
    return np.asarray(rows[np.arange(len(rows)), np.argmin(np.abs(rows), axis=1)])


_MARGIN_FUNCTIONS: dict[str, Callable[[ComplexArray], Array]] = {
    "GainMargin": _gain_margins,
    "PhaseMargin": _phase_margins,
}
_PEAK_FUNCTIONS: dict[str, Callable[[ComplexArray, ComplexArray], Array]] = {
    MAX_SENSITIVITY: lambda L, _: 1 / np.abs(1 + L),
    "MaxComplementarySensitivity": lambda L, _: np.abs(L / (1 + L)),
    NOISE_GAIN: lambda L, C: np.abs(C / (1 + L)),
}


def _partial_fraction_response(A: Array, B: Array, C: Array, typical: Array) -> Callable[[Array], ComplexArray]:
    """Function of frequencies (n,) or (m, n) for ``C (jw I - A)^-1 B`` of m systems by partial fractions, if exact."""
    try:
        poles, V = np.linalg.eig(A)
        parts = (C[:, None] @ V)[:, 0] * np.linalg.solve(V, B[..., None].astype(complex))[..., 0]
    except np.linalg.LinAlgError:
        return lambda w: batch_frequency_response(A, B, C, w)

    def sum_fractions(w: Array) -> ComplexArray:
        return np.asarray((parts[:, None] / (1j * w[..., None] - poles[:, None])).sum(axis=-1))

    probe = typical[[0, len(typical) // 2, len(typical) - 1]]
    with np.errstate(all="ignore"):  # a response of zero, a closed valve's, counts as inexact
        bad = ~(np.abs(sum_fractions(probe) / batch_frequency_response(A, B, C, probe) - 1) < 1e-6).all(axis=1)

    def response(w: Array) -> ComplexArray:
        sums = sum_fractions(w)
        if bad.any():
            sums[bad] = batch_frequency_response(A[bad], B[bad], C[bad], np.broadcast_to(w, sums.shape)[bad])
        return sums

    return response


def sensitivity_peaks(opened: ComplexArray, closed: ComplexArray, low: float, high: float) -> Array:
    """The largest ``|S(jw)|`` of m loops (m,) by their poles (m, n) [rad/s], for low <= w <= high [rad/s].

    Examples
    --------
    ``L = 25/(s (s + 3))`` closes to poles at ``-1.5 +- 4.77j``:

    >>> peak = sensitivity_peaks(np.array([[0.0, -3.0]]), np.roots([1.0, 3.0, 25.0])[None], 0.01, 1e3)
    >>> round(float(peak[0]), 4)
    1.9946
    """
    parts = np.arange(0, len(opened), LOOPS_AT_A_TIME)[1:]
    pairs = zip(np.split(opened, parts), np.split(closed, parts), strict=True)
    return np.concatenate([_peaks(p, q, low, high) for p, q in pairs])


def _peaks(opened: ComplexArray, closed: ComplexArray, low: float, high: float) -> Array:
    spread = np.broadcast_to(np.geomspace(low, high, SPREAD_FREQUENCIES), (len(opened), SPREAD_FREQUENCIES))
    around = (np.abs(closed) + share * np.abs(closed.real) for share in (-1, 0, 1))  # a resonance and its flanks
    omega = np.sort(np.concatenate([spread, *(np.clip(w, low, high) for w in around)], axis=1), axis=1)
    sizes, rows = _squares(opened, closed, omega), np.arange(len(omega))
    edged = np.pad(sizes, ((0, 0), (1, 1)), constant_values=-inf)
    is_peak = (sizes >= edged[:, :-2]) & (sizes >= edged[:, 2:])
    k = np.argpartition(np.where(is_peak, -sizes, 0.0), 1, axis=1)[:, :2]
    low_end, high_end = (np.log(omega[rows[:, None], np.clip(k + d, 0, omega.shape[1] - 1)]) for d in (-1, 1))
    largest, shares = sizes.max(axis=1), np.linspace(0.0, 1.0, PEAK_GRID_POINTS)
    for _ in range(PEAK_REFINEMENTS):
        grids = low_end[..., None] + (high_end - low_end)[..., None] * shares
        found = _squares(opened, closed, np.exp(grids.reshape(len(rows), -1))).reshape(grids.shape)
        largest, at = np.fmax(largest, found.max(axis=(1, 2))), found.argmax(axis=2)[..., None]
        low_end, high_end = (
            np.take_along_axis(grids, np.clip(at + d, 0, PEAK_GRID_POINTS - 1), axis=2)[..., 0] for d in (-1, 1)
        )
    return np.asarray(np.sqrt(largest))


def _squares(opened: ComplexArray, closed: ComplexArray, omega: Array) -> Array:
    """``|S(jw)|^2``, shape (m, k); pole by pole, so that no product leaves the range of a double."""
    with np.errstate(all="ignore"):
        found = np.ones_like(omega)
        for p, q in zip(opened.T[..., None], closed.T[..., None], strict=True):
            found *= (np.square(omega - p.imag) + np.square(p.real)) / (np.square(omega - q.imag) + np.square(q.real))
    return found
