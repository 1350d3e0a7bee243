"""Frequency response and robustness margins of a loop, at each operating point of a step response; the worst counts.

`margins` gives those of one linear loop, to machine precision: crossings and peaks are bracketed on a grid that
resolves the loop's features, and refined. `are_stable` judges each pole by how far rounding may have moved it.

A nonlinear loop has as many margins as it has operating points. Three count here (`operating_points`), since a loop
stays near each of them for long enough to oscillate there:

* where it waits for the step, "at rest", or "at the start" where it moves: bristles or a steep Coulomb curve stiffen a
  resting drive, a dead zone or an overlap opens its loop;
* "sliding", at the response's largest speed: the friction's slope is small there, a hundredth of that at rest, and with
  it the damping of a position loop. The body neither accelerates nor brakes there, so the point is as good as steady;
* "at the end" of the response.

A passage through the friction's falling branch on the way is no such point: it lasts for milliseconds, in which nothing
can grow. Under dither the points are those of the response without its ripple, and the loop is averaged over the ripple
there. A mean over the dither's period alone would smooth a fast command, even under a dither of a picovolt. A plant
whose Jacobian is the same everywhere has one point, its end.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import inf, isnan, nan
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig, eigvals, matrix_balance
from scipy.optimize import brentq, minimize_scalar
from scipy.sparse.csgraph import connected_components

from pneuopt.control.averaging import is_affine
from pneuopt.control.linear_controller import linear_gains, operating_gains, pade_delay_response
from pneuopt.control.linear_loop import linear_plant, noise_path, open_loop
from pneuopt.control.loop import ClosedLoop, find_rest, set_sliding_direction
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.dynamics.system import Linearisation, names
from pneuopt.evaluation.metric import Source, period_mean, remove_ripple
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.tolerances import (
    FLAT,
    MOST_POLE_ROUNDING,
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
        """Of an open loop with one input and one output."""
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
    return Margins(gain_margin, phase_margin, gain_crossover, phase_crossover, Ms, at, Mt, stable)


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

    Examples
    --------
    A gain of 3 before ``1/(s + 1)`` follows noise at high frequencies with that gain, at rest with 3/4:

    >>> L = Linearisation(*(np.array([[v]]) for v in (-1.0, 1.0, 3.0, 0.0)), ("x",), ("u",), ("y",))
    >>> noise_gain(L, (3.0, 0.0, 0.0, 0.01))
    3.0
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
        [rad/s], positive.

    Returns
    -------
    ndarray of complex, shape (n,)

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
    return np.asarray(
        batch_frequency_response(linearisation.A[None], linearisation.B.T, linearisation.C, w)[0]
        + linearisation.D[0, 0]
    )


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
    return np.unique(np.concatenate([grid, *around]))


def _closed_loop(open_loop: Linearisation) -> Array:
    return np.asarray(open_loop.A - open_loop.B @ open_loop.C / (1 + open_loop.D[0, 0]))


def are_stable(closed: Array, poles: ComplexArray | None = None) -> NDArray[np.bool_]:
    """Which closed loops are stable, by their state matrices, shape (m, n, n), and their poles where they are known.

    Poles at zero are allowed, a position in a speed loop or an unused integral: a pole counts as zero where rounding
    may have moved it that far, whatever the fastest pole (`_has_stable_poles`).
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
    """Whether no pole of a matrix, none of whose parts stands alone, lies further right of zero than rounding moves it.

    That is `POLE_ROUNDING` times the size of the balanced matrix times the pole's condition number: G. H. Golub & C. F.
    Van Loan, Matrix Computations, 4th ed., Johns Hopkins 2013, section 7.2.2.
    """
    balanced = matrix_balance(A)[0]
    parts: Any = eig(balanced, left=True, right=True)
    poles, left, right = parts
    with np.errstate(divide="ignore"):
        condition = 1 / np.abs((left.conj() * right).sum(axis=0))
    return bool((poles.real <= POLE_ROUNDING * np.linalg.norm(balanced) * condition).all())


def sensitivity_terms(
    loop: ClosedLoop, omega: ArrayLike, parameters: ParameterSet, x: Array | None = None
) -> ca.Function:
    """``|1 + L(jw)|^2`` as a smooth function of the PID's gains; ``1/Ms^2`` is its lower bound where Ms is kept.

    A search limits the maximum sensitivity Ms by ``terms(p) >= 1 / Ms**2``, p in the order of ``loop.parameters``:
    numbers, SX or MX. The plant enters as numbers, its response at `parameters` and, where it is nonlinear, at the
    state x, so each scenario needs its own terms, and none of its parameters may be free. A loop with a compensator
    that counts, a cascade or scheduled gains is refused: its sensitivity is no such function of the gains.
    """
    shaping = ", ".join(type(c).__name__ for c in loop.controller.acting_always)
    for fits, reason in (
        (loop.outer is None, "a cascade's speed loop has a response of its own"),
        (loop.schedule is None, "scheduled gains change with the operating point"),
        (not shaping, f"{shaping}: its slope at the operating point counts in the sensitivity"),
    ):
        require(fits, f"{reason}; use margins(open_loop(...))", ModelError)
    free = ", ".join(n for n in parameters.free_names if n in loop.plant.parameters)
    require(not free, f"{free}: free, but the sensitivity needs a fixed plant; fix it", ModelError)
    w = np.asarray(omega, dtype=float)
    P = frequency_response(linear_plant(loop, parameters, x), w) * pade_delay_response(w, loop.dead_time)
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
        robust, controller = margins(linear, on_grid), noise_path(*at) if loop.is_composed else operating_gains(*at)
        found = {
            "MaxSensitivity": robust.max_sensitivity,
            "MaxComplementarySensitivity": robust.max_complementary_sensitivity,
            "GainMargin": robust.gain_margin,
            "PhaseMargin": robust.phase_margin,
            NOISE_GAIN: noise_gain(linear, controller, lowest, on_grid),
        }
        if not robust.stable:
            found = {n: nan if n.endswith("Margin") else inf for n in found}
        slope = friction_slope(loop, parameters, linear)
        rows.append({"point": point.name, "t": point.t, **found, **slope, "stable": robust.stable})
    return tuple(rows)


def worst_margins(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """The worst of each metric over operating points: NaN and infinite where the loop is unstable at one of them.

    Of a gain margin that is the closest to one, of a phase margin the smallest magnitude, of a friction's slope the
    smallest value.
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
    """How many of the last of so many operating points count for a metric.

    A noise gain does not count before the step: a body that sticks answers a constant error of its speed's measurement
    by a command that grows without bound.
    """
    return max(1, count - 1) if metric == NOISE_GAIN else count


def friction_slope(loop: ClosedLoop, parameters: ParameterSet, linear: Linearisation) -> dict[str, float]:
    """FrictionSlope: derivative of the steady friction force to speed [N s/m]; for drives with a load.

    This is the viscous friction of the linearised plant, or open loop, at low frequencies, where the bristles follow
    the speed. A negative slope makes crawl likely.
    """
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
