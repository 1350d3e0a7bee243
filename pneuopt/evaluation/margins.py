"""Frequency response and robustness margins of a loop, at each operating point of a step response; the worst counts.

A nonlinear loop has as many margins as it has operating points. Three count here (`operating_points`), since a loop
stays near each of them for long enough to oscillate there:

* where it waits for the step, "at rest", or "at the start" where it moves: bristles or a steep Coulomb curve stiffen a
  resting drive, a dead zone or an overlap opens its loop;
* "sliding", at the response's largest speed: the friction's slope is small there, a hundredth of that at rest, and with
  it the damping of a position loop. The body neither accelerates nor brakes there, so the point is as good as steady;
* "at the end" of the response.

A passage through the friction's falling branch on the way is no such point: it lasts for milliseconds, in which nothing
can grow. Under dither the points are those of the response without its ripple, and the loop is averaged over the ripple
there. A mean over the dither's period alone would smooth a fast command, even under a dither of a picovolt.

Searches read the margins and sensitivity peaks of many loops at once (`SensitivityReader`). The sensitivity is
``S(s) = S(oo) prod (s - p)/prod (s - q)`` over the poles p of the open and q of the closed loop, so it takes no
frequency response of the plant, and the resonances lie near the closed loop's poles.

A plant's dead time is the delay itself in every response. Whether the closed loop is stable follows from its Padé
approximant, which has poles, and from how often the two curves of 1 + L run round each other (`turns`).
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import inf, isnan, nan
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig, eigvals, matrix_balance
from scipy.optimize import brentq, minimize_scalar
from scipy.sparse.csgraph import connected_components

from pneuopt.control.averaging import AveragedPlant, controller_matrices, is_affine, linear_gains, operating_gains
from pneuopt.control.linear_loop import (
    ComposedLoops,
    dead_times,
    is_cut_at_command,
    linear_plant,
    noise_path,
    open_loop,
)
from pneuopt.control.loop import ClosedLoop, find_rest, set_sliding_direction
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.dynamics.dead_time import delay_over_pade
from pneuopt.dynamics.system import Linearisation, names
from pneuopt.evaluation.metric import Source, period_mean, remove_ripple
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.tolerances import (
    DELAY_ANGLE,
    FLAT,
    MOST_POLE_ROUNDING,
    MOST_TANGENT,
    NOISE_ANGLE,
    POLE_ROUNDING,
    RESTING_SPEED,
    SPEED_TOLERANCE,
)
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

AT_REST, AT_THE_START, SLIDING, AT_THE_END = "at rest", "at the start", "sliding", "at the end"
FRICTION_SLOPE, NOISE_GAIN = "FrictionSlope", "NoiseGain"
MARGIN_METRICS = tuple(metric.name for metric in METRICS.values() if metric.source is Source.LINEAR_LOOP)
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Margins:
    """Robustness margins of a loop, with the conventions of python-control.

    Attributes
    ----------
    gain_margin : float
        Factor on the gain, up or down, beyond which the loop is unstable, the closest to one of several; inf where
        there is none.
    phase_margin : float
        Phase margin [deg], the smallest magnitude of several; inf where the gain never crosses one.
    gain_crossover, phase_crossover : float
        Frequencies of the phase margin and of the gain margin [rad/s]; NaN where there is none. At a gain margin at 0
        the loop does not swing, but runs away: that of an unstable plant under a P controller.
    max_sensitivity : float
        ``Ms = max |1/(1 + L(jw))|``; its reciprocal is the Nyquist curve's distance from -1.
    max_sensitivity_frequency : float
        [rad/s]; inf if the sensitivity only approaches its maximum.
    max_complementary_sensitivity : float
        ``Mt = max |L(jw)/(1 + L(jw))|``, the resonance peak from reference to signal where the PID weights both alike.
    stable : bool
        Whether the closed loop is stable; if not, the margins mean nothing.
    """

    gain_margin: float
    phase_margin: float
    gain_crossover: float
    phase_crossover: float
    max_sensitivity: float
    max_sensitivity_frequency: float
    max_complementary_sensitivity: float
    stable: bool


@dataclass(frozen=True, eq=False)
class GridResponse:
    """The response of an open loop on its `frequency_grid`, which margins and noise gain share: most of their time."""

    omega: Array  # [rad/s], shape (n,)
    L: ComplexArray  # shape (n,)

    @classmethod
    def of(cls, open_loop: Linearisation) -> "GridResponse":
        """Response of an open loop with one input and one output."""
        omega = frequency_grid(open_loop)
        return cls(omega, frequency_response(open_loop, omega))


def margins(open_loop: Linearisation, on_grid: GridResponse | None = None) -> Margins:
    """Robustness margins of ``L(s)`` under negative feedback (`open_loop`).

    Crossings are bracketed on `frequency_grid` and refined to machine precision.

    Parameters
    ----------
    open_loop : Linearisation
        One input, one output.
    on_grid : GridResponse, optional
        The loop's, where it is known.

    Returns
    -------
    Margins

    Examples
    --------
    An integrator with two lags, ``L = 1/(s (s + 1)^2)``, crosses -180 deg at 1 rad/s with gain 1/2:

    >>> A = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])
    >>> B, C, D = np.array([[0.0], [0.0], [1.0]]), np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 1))
    >>> m = margins(Linearisation(A, B, C, D, ("x", "v", "a"), ("u",), ("x",)))
    >>> round(m.gain_margin, 6), round(m.phase_crossover, 6), round(m.phase_margin, 2), m.stable
    (2.0, 1.0, 21.39, True)
    """

    def response(omega: float) -> complex:
        return complex(frequency_response(open_loop, [omega])[0])

    on_grid = on_grid or GridResponse.of(open_loop)
    omega, L = on_grid.omega, on_grid.L
    with np.errstate(divide="ignore"):  # a controller without gains
        sizes = np.log(np.abs(L))
    gain = _crossing_frequencies(lambda w: float(np.log(abs(response(w)))), omega, sizes)
    real = _crossing_frequencies(lambda w: response(w).imag, omega, L.imag)
    phases = [((float(np.angle(response(w), deg=True)) % 360) - 180, w) for w in gain]
    gains = [(1 / abs(z), w) for w in real if (z := response(w)).real < 0]
    gains += [(float(1 / abs(L[0])), 0.0)] if rests_below_zero(L[None, :2])[0] else []
    gain_margin, phase_crossover = min(gains, key=lambda g: abs(np.log(g[0])), default=(inf, nan))
    phase_margin, gain_crossover = min(phases, key=lambda m: abs(m[0]), default=(inf, nan))
    D = float(open_loop.D[0, 0])
    Ms, at = _response_peak(lambda _, L: 1 / (1 + L), open_loop, on_grid, 1 / (1 + D))
    Mt, _ = _response_peak(lambda _, L: 1 - 1 / (1 + L), open_loop, on_grid, D / (1 + D))
    stable = bool(are_stable(_closed_loop(open_loop)[None])[0])
    if open_loop.dead_time:
        approximate = replace(open_loop, dead_time=0.0)
        stable &= bool(turns(1 + L[None], 1 + frequency_response(approximate, omega)[None])[0] == 0)
    return Margins(gain_margin, phase_margin, gain_crossover, phase_crossover, Ms, at, Mt, stable)


def turns(curves: ComplexArray, others: ComplexArray) -> Array:
    """How often curves (m, n) run round zero more than others do, from frequency 0 to infinity, in half turns (m,).

    So many pairs of poles more lie on the right (H. Nyquist, Regeneration theory, Bell Syst. Tech. J. 11 (1932) 126).
    """
    with np.errstate(all="ignore"):
        angles = np.unwrap(np.angle(curves / others), axis=1)
    return np.asarray(np.round((angles[:, -1] - angles[:, 0]) / np.pi))


def _crossing_frequencies(function: Callable[[float], float], omega: Array, values: Array) -> list[float]:
    """Frequencies at which a function is zero, bracketed by sign changes on the grid."""
    brackets = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    exact = [float(w) for w in omega[values == 0]]
    return sorted(exact + [float(brentq(function, omega[k], omega[k + 1], xtol=1e-14 * omega[k])) for k in brackets])


def rests_below_zero(first: ComplexArray) -> NDArray[np.bool_]:
    """Whether L(0) is finite and negative, by L at the two lowest frequencies of a grid, shape (m, 2)."""
    is_flat = np.abs(first[:, 0] - first[:, 1]) < FLAT * np.abs(first[:, 0])
    return np.asarray(is_flat & (first[:, 0].real < -(1 - FLAT) * np.abs(first[:, 0])))


def _response_peak(
    response: Callable[[Array, ComplexArray], ComplexArray],
    open_loop: Linearisation,
    on_grid: GridResponse,
    limit: float,
) -> tuple[float, float]:
    """Largest magnitude of a response and its frequency, refined from the grid; `limit` is its value at infinity.

    The response is a function of frequencies and of the open loop's response there.
    """

    def negative_magnitude(log_w: float) -> float:
        w = np.array([np.exp(log_w)])
        return -float(abs(response(w, frequency_response(open_loop, w))[0]))

    omega, sizes = on_grid.omega, np.abs(response(on_grid.omega, on_grid.L))
    k = int(np.argmax(sizes))
    ends = np.log(omega[[max(k - 1, 0), min(k + 1, len(omega) - 1)]])
    best = minimize_scalar(negative_magnitude, bounds=tuple(ends), method="bounded", options={"xatol": 1e-12})
    largest, at = max((-float(best.fun), float(np.exp(best.x))), (float(sizes[k]), float(omega[k])))
    return (largest, at) if largest > abs(limit) else (abs(limit), inf)


def noise_gain(
    open_loop: Linearisation,
    controller: tuple[float, float, float, float] | Linearisation,
    lowest_frequency: float = 0.0,
    on_grid: GridResponse | None = None,
) -> float:
    """``max |C(jw)/(1 + L(jw))|``: the largest gain from measurement noise to the command.

    The maximum control sensitivity of B. Kristiansson and B. Lennartson, Robust and optimal tuning of PI and PID
    controllers, IEE Proc. Control Theory Appl. 149 (2002) 17-25; with a fast filter it is Kp + Kd/Tf.

    The controller is Kp, Ki, Kd, Tf of a PID with Tf > 0, or a linear system (`noise_path`). Lower frequencies than
    `lowest_frequency` [rad/s] do not count: an integral answers a constant error of a measured speed without bound
    where the plant cannot go on moving so, a piston whose chambers fill for example.
    """
    if isinstance(controller, Linearisation):
        at_infinity = float(controller.D[0, 0] / (1 + open_loop.D[0, 0]))
    else:
        Kp, _, Kd, Tf = controller
        at_infinity = Kp + Kd / Tf

    def control_response(w: Array, L: ComplexArray) -> ComplexArray:
        if isinstance(controller, Linearisation):
            return np.asarray(frequency_response(controller, w) / (1 + L))
        a, b = controller_parts(controller, w)
        return np.asarray((a + 1j * b) / (1 + L))

    on_grid = on_grid or GridResponse.of(open_loop)
    if lowest_frequency > on_grid.omega[0]:
        counts, first = on_grid.omega > lowest_frequency, [lowest_frequency]
        L = np.append(frequency_response(open_loop, first), on_grid.L[counts])
        on_grid = GridResponse(np.append(first, on_grid.omega[counts]), L)
    return _response_peak(control_response, open_loop, on_grid, at_infinity)[0]


def lowest_noise_frequency(horizon: float) -> float:
    """Frequency from which on a noise gain counts over a horizon [s]: slower noise is a drift that it does not show.

    Examples
    --------
    >>> lowest_noise_frequency(0.5)
    0.6
    """
    return NOISE_ANGLE / horizon


def frequency_response(linearisation: Linearisation, omega: ArrayLike) -> ComplexArray:
    """``C (jw I - A)^-1 B + D`` of a system with one input and one output.

    Parameters
    ----------
    linearisation : Linearisation
    omega : array_like, shape (n,)
        [rad/s], positive, of a sampled system below half its sampling frequency.

    Returns
    -------
    ndarray of complex, shape (n,)
        With its dead time, if it has one, as the delay itself; of a sampled system that of its samples.

    Examples
    --------
    >>> lag = Linearisation(*(np.array([[v]]) for v in (-1.0, 1.0, 1.0, 0.0)), ("x",), ("u",), ("y",))
    >>> complex(frequency_response(lag, [1.0])[0])
    (0.5-0.5j)
    """
    single = linearisation.D.shape == (1, 1)
    require(single, f"one input and one output expected, got D of shape {linearisation.D.shape}", ModelError)
    w = np.asarray(omega, dtype=float)
    require(bool(np.all(w > 0)), "frequencies must be positive [rad/s]")
    h, delay = linearisation.sample_time, (linearisation.dead_time, linearisation.pade_order)
    if h is not None:
        message = f"sampled every {h:g} s, the system has responses below {np.pi / h:.4g} rad/s only"
        require(bool(np.all(w * h < np.pi)), message)
        w = 2 / h * np.tan(w * h / 2)
    found = batch_frequency_response(linearisation.A[None], linearisation.B.T, linearisation.C, w)[0]
    return np.asarray((found + linearisation.D[0, 0]) * delay_over_pade(w, *delay, h))


def batch_frequency_response(A: Array, B: Array, C: Array, w: Array) -> ComplexArray:
    """``C (jw I - A)^-1 B`` of m systems, shape (m, n), at frequencies of shape (n,), the same for all, or (m, n).

    At a frequency at which a system has no response, an undamped pole, it is NaN.
    """
    resolvent = np.broadcast_to(-A[:, None], (len(A), w.shape[-1], *A.shape[1:])).astype(complex)
    each = np.arange(A.shape[-1])
    resolvent[..., each, each] += 1j * w[..., None]
    x = _solve_regular(resolvent, np.broadcast_to(B[:, None, :, None], (*resolvent.shape[:3], 1)).astype(complex))
    return np.asarray((C[:, None, None] @ x)[..., 0, 0])


def _solve_regular(matrices: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Solutions of linear equations, shape (m, n, k, 1); NaN of a singular matrix, for which NumPy refuses all."""
    try:
        return np.asarray(np.linalg.solve(matrices, right))
    except np.linalg.LinAlgError:
        if len(matrices) == 1 and matrices.shape[1] == 1:
            return np.full_like(right, nan)
    axis = 0 if len(matrices) > 1 else 1
    halves = zip(*(np.array_split(a, 2, axis=axis) for a in (matrices, right)), strict=True)
    return np.concatenate([_solve_regular(*half) for half in halves], axis=axis)


def frequency_grid(open_loop: Linearisation, per_decade: int = 200) -> Array:
    """Frequency grid that resolves the features of a loop, open and closed [rad/s].

    Logarithmic from three decades below the slowest pole or zero to three above the fastest, denser at resonances.
    """
    poles, pencil = eigvals(open_loop.A), np.block([[open_loop.A, open_loop.B], [open_loop.C, open_loop.D]])
    zeros = np.asarray(eigvals(pencil, np.diag([1.0] * len(poles) + [0.0])), dtype=complex)
    zeros = zeros[np.abs(zeros) < 1e3 * np.max(np.abs(poles), initial=1.0)]
    roots = np.concatenate([poles, eigvals(_closed_loop(open_loop)), zeros])
    size = [s for s in np.abs(roots) if s > 1e-10 * np.max(np.abs(roots))]
    low, high = min(size, default=1.0), max(size, default=1.0)
    decades = np.log10(high / low) + 6
    grid = np.geomspace(1e-3 * low, 1e3 * high, int(np.ceil(decades * per_decade)) + 1)
    ringing = roots[(roots.imag > 0) & (np.abs(roots.real) < 0.2 * roots.imag) & (roots.real != 0)]
    around = [r.imag + abs(r.real) * np.linspace(-4, 4, 41) for r in ringing]
    found = np.unique(np.concatenate([grid, *around]))
    if open_loop.dead_time:  # beyond the approximant's poles the delay turns on
        even = np.linspace(0.0, DELAY_ANGLE / open_loop.dead_time, per_decade + 1)[1:]
        found = np.unique(np.concatenate([found, even]))
    h = open_loop.sample_time
    return found if h is None else np.unique(2 / h * np.arctan(np.minimum(found * h / 2, MOST_TANGENT)))


def _closed_loop(open_loop: Linearisation) -> Array:
    return np.asarray(open_loop.A - open_loop.B @ open_loop.C / (1 + open_loop.D[0, 0]))


def are_stable(closed: Array, poles: ComplexArray | None = None) -> NDArray[np.bool_]:
    """Which closed loops are stable, by their state matrices (m, n, n), and their poles where they are known.

    A pole counts as zero, which is allowed, where rounding may have moved it that far (`_has_stable_poles`).
    """
    found = np.linalg.eigvals(closed).astype(complex) if poles is None else poles
    growth, size = found.real.max(axis=-1, initial=-1.0), np.abs(found).max(axis=-1, initial=1.0)
    stable = np.asarray(growth <= 0)
    for k in np.flatnonzero(~stable & (growth <= MOST_POLE_ROUNDING * size)):
        label = connected_components(closed[k] != 0, connection="strong")[1]
        parts = (np.flatnonzero(label == part) for part in range(label.max() + 1))
        stable[k] = all(_has_stable_poles(closed[k][np.ix_(part, part)]) for part in parts)
    return stable


def _has_stable_poles(A: Array) -> bool:
    """Whether no pole of a matrix in one part lies further right of zero than `POLE_ROUNDING` in its condition allows.

    G. H. Golub & C. F. Van Loan, Matrix Computations, 4th ed., Johns Hopkins 2013, section 7.2.2.
    """
    balanced = matrix_balance(A)[0]
    parts: Any = eig(balanced, left=True, right=True)
    poles, left, right = parts
    with np.errstate(divide="ignore"):
        condition = 1 / np.abs((left.conj() * right).sum(axis=0))
    return bool((poles.real <= POLE_ROUNDING * np.linalg.norm(balanced) * condition).all())


def sensitivity_terms(loop: ClosedLoop, omega: ArrayLike, parameters: ParameterSet) -> ca.Function:
    """``|1 + L(jw)|^2`` as a smooth function of the PID's gains, which limits Ms by ``terms(p) >= 1 / Ms**2``.

    The plant enters as numbers, its response at `parameters`: each scenario needs its own terms. A loop whose
    sensitivity is no such function of the gains is refused.
    """
    shaping = ", ".join(type(c).__name__ for c in loop.controller.acting_always)
    for fits, reason in (
        (loop.outer is None, "a cascade's speed loop has a response of its own"),
        (loop.schedule is None, "scheduled gains change with the operating point"),
        (loop.pid.sample_time is None, "a sampled PID's delay is no such function"),
        (not shaping, f"{shaping}: its slope at the operating point counts in the sensitivity"),
    ):
        require(fits, f"{reason}; use margins(open_loop(...))", ModelError)
    free = ", ".join(n for n in parameters.free_names if n in loop.plant.parameters)
    require(not free, f"{free}: free, but the sensitivity needs a fixed plant; fix it", ModelError)
    w = np.asarray(omega, dtype=float)
    P = frequency_response(linear_plant(loop, parameters), w)
    p = ca.SX.sym("p", len(loop.parameters))
    Kp, Ki, Kd, Tf = ca.vertsplit(linear_gains(loop, p))
    ws, re, im = ca.DM(w), ca.DM(P.real.copy()), ca.DM(P.imag.copy())
    a, b = controller_parts((Kp, Ki, Kd, Tf), ws)
    terms = (1 + a * re - b * im) ** 2 + (a * im + b * re) ** 2
    return ca.Function("sensitivity_terms", [p], [terms], ["p"], ["terms"])


def controller_parts(gains: Iterable[Any], w: Any) -> tuple[Any, Any]:
    """Real and imaginary part of the PID's frequency response, for gains Kp, Ki, Kd, Tf in numbers or symbols."""
    Kp, Ki, Kd, Tf = gains
    lag = 1 / (1 + (Tf * w) ** 2)
    return Kp + Kd * Tf * w**2 * lag, Kd * w * lag - Ki / w


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A point at which a loop is linearised."""

    name: str  # "at rest", "at the start", "sliding" or "at the end"
    t: float  # when the response passes it [s]
    x: Array  # the plant's states, shape (n_plant_states,)
    inputs: Mapping[str, float]  # of the plant, the command and the disturbances; absent ones are zero


def operating_points(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> tuple[OperatingPoint, ...]:
    """The operating points that a step response passes, of a loop with inputs for the reference's disturbances."""
    disturbed = {disturbance_input(n): v for n, v in reference.disturbance.items()}
    t, signals = response.t, response.matrix([*names(loop.plant.states), "control"]).T
    signals = without_ripple(t, signals, loop.dither_period(parameters) or 0.0)

    def point(name: str, k: int) -> OperatingPoint:
        inputs = {loop.command.name: float(signals[-1, k]), **disturbed}
        return OperatingPoint(name, float(t[k]), signals[:-1, k], inputs)

    if is_affine(loop.plant):
        return (point(AT_THE_END, -1),)
    axis = loop.plant.axis
    at_rest = set_sliding_direction(loop, parameters, reference.origin)
    x, command = find_rest(loop, at_rest, reference.origin, reference.start)
    v = None if axis is None else names(loop.plant.states).index(axis.speed)
    moves = v is not None and abs(x[v]) > RESTING_SPEED * loop.plant.states[v].nominal
    start = OperatingPoint(AT_THE_START if moves else AT_REST, float(t[0]), x, {loop.command.name: command})
    if v is None:
        return start, point(AT_THE_END, -1)
    first = int(np.searchsorted(t, reference.at))
    return start, point(SLIDING, first + int(first_largest(signals[v, None, first:])[0])), point(AT_THE_END, -1)


def without_ripple(t: Array, y: Array, period: float) -> Array:
    """Signals (m, n) without their dither's ripple; as they are where the record is shorter than a period."""
    if not 0 < period <= t[-1] - t[0]:
        return y
    first, averaged = y[:, :1], t[t <= t[-1] - period / 2]
    return remove_ripple(t, y, first + period_mean(t, y - first, 0.0, period, averaged), period).signal


def first_largest(speeds: Array) -> Indices:
    """Index of the first entry of each row that is as large as its largest magnitude, but for `SPEED_TOLERANCE`."""
    sizes = np.abs(speeds)
    return np.asarray(np.argmax(sizes >= (1 - SPEED_TOLERANCE) * sizes.max(axis=1, keepdims=True), axis=1))


def margin_rows(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> tuple[dict[str, Any], ...]:
    """A row for each of the `operating_points`: "point", "t" [s], the linear loop's metrics of `evaluate`, "stable"."""
    rows, lowest = list[dict[str, Any]](), lowest_noise_frequency(reference.horizon)
    for point in operating_points(loop, parameters, reference, response):
        at = (loop, parameters, point.x, point.inputs)
        linear = open_loop(*at)
        on_grid = GridResponse.of(linear)
        cut = is_cut_at_command(loop)
        robust, controller = margins(linear, on_grid), noise_path(*at) if cut else operating_gains(*at)
        found = {
            "MaxSensitivity": robust.max_sensitivity,
            "MaxComplementarySensitivity": robust.max_complementary_sensitivity,
            "GainMargin": robust.gain_margin,
            "PhaseMargin": robust.phase_margin,
            NOISE_GAIN: noise_gain(linear, controller, lowest, on_grid),
        }
        if not robust.stable:
            found = {n: nan if n.endswith("Margin") else inf for n in found}
        slope = friction_slope(loop, parameters, linear_plant(*at) if linear.sample_time else linear)
        rows.append({"point": point.name, "t": point.t, **found, **slope, "stable": robust.stable})
    return tuple(rows)


def worst_margins(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """The worst of each metric over operating points: NaN and infinite where the loop is unstable at one of them.

    Of a friction's slope that is the smallest value.
    """
    given, worst = list(rows), dict[str, float]()
    for metric in (n for n in MARGIN_METRICS if given and n in given[0]):
        values = [row[metric] for row in given[-counted_points(metric, len(given)) :]]
        if any(isnan(v) for v in values):
            worst[metric] = nan
        elif metric == FRICTION_SLOPE:
            worst[metric] = min(values)
        else:
            worst[metric] = max(values, key=lambda v: float(METRICS[metric].requirement_value(v)))
    return worst


def counted_points(metric: str, count: int) -> int:
    """Number of the last of so many operating points that count for a metric.

    A noise gain does not count before the step: a body that sticks answers a constant error of its speed's measurement
    by a command that grows without bound.
    """
    return max(1, count - 1) if metric == NOISE_GAIN else count


def friction_slope(loop: ClosedLoop, parameters: ParameterSet, linear: Linearisation) -> dict[str, float]:
    """FrictionSlope: viscous friction [N s/m] of a linearised drive with a load, whose bristles follow the speed."""
    states, axis = names(loop.plant.states), loop.plant.axis
    if axis is None or not any(n.startswith("friction.") for n in loop.plant.parameters):
        return {}
    A = linear.A
    v, z = states.index(axis.speed), [k for k, n in enumerate(states) if n.startswith("friction.")]
    bristles = A[v, z] @ np.linalg.solve(A[np.ix_(z, z)], A[z, v]) if z else 0.0
    return {FRICTION_SLOPE: float(-parameters.value(axis.inertia) * (A[v, v] - bristles))}


def worst_open_loop(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> tuple[str, Linearisation]:
    """The open loop at the operating point where its sensitivity peak is the largest, and the point's name."""
    points = operating_points(loop, parameters, reference, response)
    loops = [(point.name, open_loop(loop, parameters, point.x, point.inputs)) for point in points]
    peaks = [m.max_sensitivity if m.stable else inf for m in (margins(linear) for _, linear in loops)]
    return loops[int(np.argmax(peaks))]


MAX_SENSITIVITY, MAX_COMPLEMENTARY = "MaxSensitivity", "MaxComplementarySensitivity"
Matrices = tuple[Array, Array, Array]  # A, B, C of m plants, shapes (m, n, n), (m, n, 1), (m, 1, n)
Matrices4 = tuple[Array, Array, Array, Array]  # and D, shape (m, 1, 1)


MarginFunction = Callable[[Array, Array, Array, Collection[str]], dict[str, Array]]
"""``(p, x, u, only) -> found``; see `batch_margin_function`."""
Responses = Callable[[Array], tuple[ComplexArray, ComplexArray]]
"""``w -> (L, C)``: responses of m loops and of their controllers from measurement to command."""


def batch_margin_function(loop: ClosedLoop, omega: ArrayLike, lowest_noise: float = 0.0) -> MarginFunction:
    """Function that gives margins, sensitivities and noise gains for many gains and operating points at once.

    The frequencies `omega` [rad/s], shape (n,), are positive, increasing; from `lowest_noise` on a noise gain counts.
    Of a sampled loop they are those of s in ``z = (1 + s h/2)/(1 - s h/2)``.
    The function ``(p, x, u, only) -> found`` takes parameters, shape (m, n_parameters), in the order of
    ``loop.parameters``, and the plant's states and inputs at k operating points of each, shapes (k, m, n_plant_states)
    and (k, m, n_plant_inputs), means under dither. It gives the worst over the points, shape (m,), for each name in
    `only`, as `Margins` and `noise_gain` have them, NaN and infinite where a closed loop is unstable.
    """
    w = np.asarray(omega, dtype=float)
    read_loops = partial(_read_loops, w=w, lowest_noise=lowest_noise)
    if is_cut_at_command(loop):
        return _read_worst(_composed_reader(loop, w, read_loops))
    average, command = AveragedPlant(loop, compiled=True), names(loop.plant.inputs).index(loop.command.name)
    scale = np.array([s.nominal for s in loop.plant.states])

    def read_points(p: Array, x: Array, u: Array, only: Collection[str]) -> dict[str, Array]:
        A, B, C, D, measured = average(p, x, u)
        A, B, C = A * scale / scale[:, None], B / scale, C * scale  # so the matrix of eigenvectors is well conditioned
        plants = _Plants(A, B, C, D, measured, np.reshape(loop.sensor_lag(p.T), (-1, 1)))
        gains = linear_gains(loop, p.T, plants.measured, u[:, command]).full()
        controllers, (A, B, C) = controller_matrices(gains), plants.with_sensor()
        Ac, Bc, Cc, Dc = controllers
        closed = np.block([[A - B @ Dc @ C, B @ Cc], [-Bc @ C, Ac]])
        if not D.any():
            opened = np.concatenate([_poles(A), _poles(Ac)], axis=1)
            sensitivity = SensitivityReader(opened, _poles(closed), np.zeros(len(p)), *dead_times(loop, p))
            return read_loops(closed, sensitivity, lambda: _pid_responses(gains, plants.response(w)), only=only)
        responses, at_infinity = _pid_responses(gains, plants.response(w))
        found = _read_responses(responses, at_infinity, w, lowest_noise, only)
        return _mark_unstable(found, are_stable(closed))

    return _read_worst(read_points)


def _read_loops(
    closed: Array,
    sensitivity: "SensitivityReader",
    respond: Callable[[], tuple[Responses, Array]],
    only: Collection[str],
    w: Array,
    lowest_noise: float,
) -> dict[str, Array]:
    """Margins and peaks of loops by their closed loops' matrices and their poles, by responses where these are asked.

    `respond` gives the approximate loops' responses and noise gains at infinity.
    """
    found, turned = sensitivity.peaks(only, w[0], w[-1])
    if not set(only) <= set(found):
        approximate, at_infinity = respond()

        def responses(w: Array) -> tuple[ComplexArray, ComplexArray]:
            L, C = approximate(w)
            return L * sensitivity.delay_factor(w), C

        found |= _read_responses(responses, at_infinity, w, lowest_noise, [n for n in only if n not in found])
    return _mark_unstable(found, are_stable(closed, sensitivity.closed) & (turned == 0))


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


def _composed_reader(loop: ClosedLoop, w: Array, read_loops: Callable[..., dict[str, Array]]) -> MarginFunction:
    """Function that reads the margins of loops cut at the command, for parameters and points of shape (m, n)."""
    linearise = ComposedLoops(loop, compiled=True)

    def read_points(p: Array, x: Array, u: Array, only: Collection[str]) -> dict[str, Array]:
        loops = linearise(p, x, u)
        (A, B, C, D), ends = loops.loop, (loops.loop[3][:, 0, 0], loops.noise[3][:, 0, 0])

        def respond() -> tuple[Responses, Array]:
            each = loops.loop, loops.noise
            parts = [_partial_fraction_response(A, B[..., 0], C[:, 0], w) for A, B, C, _ in each]

            def responses(w: Array) -> tuple[ComplexArray, ComplexArray]:
                L, control = (part(w) + end[:, None] for part, end in zip(parts, ends, strict=True))
                return L, control

            return responses, np.abs(ends[1] / (1 + ends[0]))

        closed, delay = A - B @ C / (1 + D), (loops.dead_time, loops.pade_order, loop.pid.sample_time)
        return read_loops(closed, SensitivityReader(_poles(A), _poles(closed), ends[0], *delay), respond, only=only)

    return read_points


def _mark_unstable(found: dict[str, Array], stable: NDArray[np.bool_]) -> dict[str, Array]:
    """Metrics with those of unstable loops NaN or infinite."""
    return {n: np.where(stable, value, nan if n in _MARGIN_FUNCTIONS else inf) for n, value in found.items()}


def _pid_responses(gains: Array, plant: Callable[[Array], ComplexArray]) -> tuple[Responses, Array]:
    """Responses of loops with a PID alone, and their noise gain at infinity, shape (m,)."""
    Kp, Ki, Kd, Tf = gains[..., None]

    def responses(w: Array) -> tuple[ComplexArray, ComplexArray]:
        a, b = controller_parts((Kp, Ki, Kd, Tf), w)
        return plant(w) * (a + 1j * b), a + 1j * b

    return responses, np.abs(Kp + Kd / Tf)[:, 0]


def _read_responses(
    responses: Responses, noise_at_infinity: Array, w: Array, lowest_noise: float, only: Collection[str]
) -> dict[str, Array]:
    """Margins and peaks of loops on frequencies of shape (n,), crossings interpolated and peaks refined."""

    def magnitudes(size: Callable[[ComplexArray, ComplexArray], Array], w: Array) -> Array:
        return size(*responses(w))

    (L, C), noisy = responses(w), int(np.searchsorted(w, (1 - 1e-9) * lowest_noise))
    with np.errstate(all="ignore"):
        found = {n: crossing(L) for n, crossing in _MARGIN_FUNCTIONS.items() if n in only}
        for n, size in ((n, size) for n, size in _PEAK_FUNCTIONS.items() if n in only):
            k = noisy if n == NOISE_GAIN else 0
            found[n] = _refine_peaks(partial(magnitudes, size), w[k:], size(L[:, k:], C[:, k:]))
    if NOISE_GAIN in only:
        found[NOISE_GAIN] = np.maximum(found[NOISE_GAIN], noise_at_infinity)
    return found


def _refine_peaks(size: Callable[[Array], Array], omega: Array, on_grid: Array) -> Array:
    """Largest value of functions of frequency, shape (m,), from a grid (n,) or (m, n), about its two highest peaks.

    The function takes frequencies (m, k) and gives values (m, k), `on_grid` those of the grid. At last a grid is so
    fine that its peak is a parabola's, about whose vertex the next one lies: to 1e-8 of a peak that is not sharper than
    the first grid.
    """
    rows, last = np.arange(len(on_grid))[:, None], on_grid.shape[1] - 1
    edged = np.pad(on_grid, ((0, 0), (1, 1)), constant_values=-inf)
    is_peak = (on_grid >= edged[:, :-2]) & (on_grid >= edged[:, 2:])
    k = np.argpartition(np.where(is_peak, -on_grid, 0.0), 1, axis=1)[:, :2]  # the two highest
    grid = np.broadcast_to(np.log(omega), on_grid.shape)
    low, high = grid[rows, np.maximum(k - 1, 0)], grid[rows, np.minimum(k + 1, last)]
    largest = on_grid.max(axis=1)
    for points, reach in ((9, 1.0), (9, 0.5), (9, 0.5), (5, 0.0)):  # reach in cells about the next grid's middle
        grids = low[..., None] + (high - low)[..., None] * np.linspace(0.0, 1.0, points)
        sizes = size(np.exp(grids.reshape(len(rows), -1))).reshape(grids.shape)
        largest, at = np.fmax(largest, sizes.max(axis=(1, 2))), sizes.argmax(axis=2)
        near = np.clip(at, 1, points - 2)[..., None] + np.arange(-1, 2)
        below, mid, above = np.moveaxis(np.take_along_axis(sizes, near, axis=2), 2, 0)
        with np.errstate(all="ignore"):
            vertex = 0.5 * (below - above) / (below - 2 * mid + above)
        inside = (at == near[..., 1]) & (np.abs(vertex) <= 0.5) & (reach < 1)
        cell = (high - low) / (points - 1)
        middle = low + cell * (at + np.where(inside, vertex, 0.0))
        low, high = np.maximum(middle - reach * cell, low), np.minimum(middle + reach * cell, high)
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

    def response(self, typical: Array) -> Callable[[Array], ComplexArray]:
        """Responses with sensor, a function of frequencies (n,) or (m, n); checked on typical ones."""
        plant = _partial_fraction_response(self.A, self.B, self.C, typical)

        def response(w: Array) -> ComplexArray:
            return np.asarray((plant(w) + self.D[:, None]) / (1 + 1j * w * self.lag))

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
    MAX_COMPLEMENTARY: lambda L, _: np.abs(L / (1 + L)),
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


@dataclass(frozen=True, eq=False)
class SensitivityReader:
    """Sensitivities of m loops by the poles of the open and of the closed loop (m, n) [rad/s], and by L(oo) (m,).

    Dead times (m,) [s] count as delays; in the poles they are Padé approximants of that order. Frequencies are those of
    `delay_over_pade`.
    """

    opened: ComplexArray
    closed: ComplexArray
    direct: Array
    dead_time: Array
    pade_order: int = 0
    sample_time: float | None = None

    def delay_factor(self, w: Array) -> ComplexArray | float:
        """What the approximants lack of the delays at frequencies of shape (n,) or (m, n)."""
        if not self.pade_order:
            return 1.0
        return delay_over_pade(w, self.dead_time[:, None], self.pade_order, self.sample_time)

    def peaks(
        self, only: Collection[str], low: float, high: float, spread: int = 48, at_a_time: int = 128
    ) -> tuple[dict[str, Array], Array]:
        """Those of Ms and Mt that are asked for, for low <= w <= high [rad/s] and at infinity; and `turns`, (m,).

        The first grid has the frequencies about the closed loop's poles, and so many that are spread evenly: with fewer
        a broad maximum is missed. More loops at a time do not fit the processor's cache.
        """
        named = [n for n in (MAX_SENSITIVITY, MAX_COMPLEMENTARY) if n in only]
        found, turned = {n: np.empty(len(self.opened)) for n in named}, np.zeros(len(self.opened))
        if not named and not self.pade_order:
            return found, turned
        for first in range(0, len(self.opened), at_a_time):
            rows = slice(first, first + at_a_time)
            part = replace(self, **{n: getattr(self, n)[rows] for n in ("opened", "closed", "direct", "dead_time")})
            omega = part._grid(low, high, spread)
            S, L = part._responses(omega)
            if self.pade_order:
                turned[rows] = turns(1 + L, 1 / S)
            for n in named:
                size = partial(part._size, n)
                found[n][rows] = _refine_peaks(size, omega, size(omega))
        with np.errstate(all="ignore"):
            ends = {MAX_SENSITIVITY: 1 / np.abs(1 + self.direct)}
            ends[MAX_COMPLEMENTARY] = np.abs(self.direct) * ends[MAX_SENSITIVITY]
        return {n: np.fmax(value, ends[n]) for n, value in found.items()}, turned

    def _grid(self, low: float, high: float, spread: int) -> Array:
        q, m = self.closed, len(self.closed)
        even = [np.broadcast_to(np.geomspace(low, high, spread), (m, spread))]
        if self.pade_order:  # beyond the approximant's poles the delay turns on
            even.append(DELAY_ANGLE / self.dead_time[:, None] * np.linspace(0.0, 1.0, 2 * spread + 1)[1:])
        # a resonance and its flanks, by either of a pair of poles others, for equal ones would hide a second peak
        shares = zip((-1.0, 0.0, 1.0), (-0.5, 0.5, 2.0), strict=True)
        around = (np.abs(q) + np.where(q.imag < 0, theirs, ours) * np.abs(q.real) for ours, theirs in shares)
        return np.sort(np.clip(np.concatenate([*even, *around], axis=1), low, high), axis=1)

    def _responses(self, omega: Array) -> tuple[ComplexArray, ComplexArray]:
        """The approximate loops' S, and the L with its delay, shape (m, k); pole by pole, so that no product is inf."""
        s = 1j * omega
        with np.errstate(all="ignore"):
            S = np.broadcast_to(1 / (1 + self.direct[:, None]), omega.shape).astype(complex)
            for p, q in zip(self.opened.T[..., None], self.closed.T[..., None], strict=True):
                S *= (s - p) / (s - q)
            return S, np.asarray((1 / S - 1) * self.delay_factor(omega))

    def _size(self, metric: str, omega: Array) -> Array:
        S, L = self._responses(omega)
        with np.errstate(all="ignore"):
            S = 1 / (1 + L) if self.pade_order else S
            return np.abs(S if metric == MAX_SENSITIVITY else 1 - S)
