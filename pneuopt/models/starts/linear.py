"""Starts of a linear plant from logs without a user's guess: separable output error over a grid, then refined.

Gain, start states and Coulomb friction enter the response linearly, so each point of a grid over the few other values
(time constants, damping, dead time) costs one small linear least squares; the best of them are refined.

`delay_line`, `pade_delay`: a plant's dead time as states, a Padé approximant of order 1 to 5.

The states form a lossless ladder and keep the input's unit and size at every dead time, so that the dead time is an
ordinary, differentiable parameter. Its fastest pole is at 2, 3.5, 5.1, 6.8, 8.5 over the dead time (orders 1 to 5), and
RK4 steps of h are stable for dead times above 0.72, 1.22, 1.87, 2.57, 3.26 h, the lower limit. At zero the approximant
is singular; order 0 leaves it out.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy import optimize, signal

from pneuopt.dynamics.hooks import Log, Start
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, ModelError, require
from pneuopt.quantities.parameters import Intersample, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

MAX_PADE_ORDER = 5  # the greatest order whose stability limit is known (see above)


def delay_line(source: Quantity, order: int) -> tuple[Quantity, ...]:
    """The states of an input's dead time; none of order 0."""
    valid = isinstance(order, int) and 0 <= order <= MAX_PADE_ORDER
    require(valid, f"pade_order must be 0 to {MAX_PADE_ORDER}, got {order}", ModelError)
    return tuple(Quantity(f"{source.name}_delay_{k}", source.unit, 2 * source.nominal) for k in range(1, order + 1))


def pade_delay(u: ca.SX, x: list[ca.SX], dead_time: ca.SX) -> tuple[ca.SX, list[ca.SX]]:
    """Padé approximant [n/n] of a delay as an LC ladder, by Lambert's continued fraction of tanh(s/2).

    ``exp(-s) = (1 - tanh(s/2)) / (1 + tanh(s/2))`` is, but for its sign, the reflection of a wave u from inductors and
    capacitors of 1 / (2 (2k - 1)) in turn; with v the voltage at the port, the delayed wave is u - v.
    """
    if not x:
        return u, []
    along, across = sum(x[0::2], ca.SX(0)), sum(x[1::2], ca.SX(0))
    voltage, current = (across, 2 * u - across) if len(x) % 2 == 0 else (2 * u - along, along)
    rates = []
    for k in range(1, len(x) + 1):
        passed = sum(x[k % 2 : k - 1 : 2], ca.SX(0))
        rates.append(2 * (2 * k - 1) / dead_time * ((current if k % 2 == 0 else voltage) - passed))
    return u - voltage, rates


def delay_states(u: Array, step: float, order: int, dead_time: float) -> Array:
    """The states along an input that is held over each step, from rest at its first value.

    Parameters
    ----------
    u : ndarray, shape (n,)
    step : float
        [s]
    order : int
        At least 1.
    dead_time : float
        [s]

    Returns
    -------
    ndarray, shape (n, order)
        In the input's unit.
    """
    x, source = ca.SX.sym("x", order), ca.SX.sym("u")
    _, rates = pade_delay(source, ca.vertsplit(x), ca.SX(dead_time))
    slopes = [np.array(ca.DM(ca.jacobian(ca.vertcat(*rates), symbol))) for symbol in (x, source)]
    A, B, *_ = signal.cont2discrete((slopes[0], slopes[1], np.eye(order), np.zeros((order, 1))), step)
    rest = np.linalg.solve(np.eye(order) - A, B[:, 0]) * u[0]
    states = np.empty((len(u), order))
    states[0] = rest
    for k in range(1, len(u)):
        states[k] = A @ states[k - 1] + B[:, 0] * u[k - 1]
    return states


Polynomials = tuple[list[float], list[float]]
# Samples of all logs together in the grid search and in the refinement: fewer hide fast plants, more cost time.
MAX_GRID_SAMPLES, MAX_REFINEMENT_SAMPLES = 600, 4000
MIN_START_SAMPLES = 20  # samples that a log needs: fewer than a few for each parameter fit anything
# Least dead time that is tried where its bound is 0, over two samples [1]: at 0 the model of a delay divides by
# it, and further below the delay line is needlessly stiff.
MIN_DEAD_TIME = 0.05
MAX_CANDIDATES = 4  # candidates that are refined and returned: fewer miss the right one, each costs a refinement
DAMPING_GRID = (0.1, 0.3, 0.7, 1.5, 4.0)  # damping ratios of the grid [1], from ringing to two separate lags
PLANT_DAMPING, PLANT_DEAD_TIME, PLANT_GAIN, COULOMB_LEVEL = (
    "plant.damping",
    "plant.dead_time",
    "plant.gain",
    "friction.coulomb",
)


@dataclass(frozen=True)
class ResponseShape:
    """Transfer function of a plant at unit gain, without its dead time.

    Parameters
    ----------
    names : tuple of str
        Names of its parameters.
    polynomials : callable
        Maps their values to numerator and denominator, highest power first.
    friction_polynomials : callable, optional
        The same for the response to friction.
    """

    names: tuple[str, ...]
    polynomials: Callable[..., Polynomials]
    friction_polynomials: Callable[..., Polynomials] | None = None


@dataclass(frozen=True)
class LinearStarts:
    """Start hook of a linear plant.

    Parameters
    ----------
    source, output : str
        Names of the plant's input and output.
    delay_line : tuple of str
        Names of the states of its dead time.
    zero_states : tuple of str
        Names of states that no log shows; they start at zero.

    Raises
    ------
    LogError
        When called with a log that is too short, or logs whose input never changes.
    """

    shape: ResponseShape
    source: str
    output: str
    delay_line: tuple[str, ...] = ()
    zero_states: tuple[str, ...] = ()

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return up to four distinct candidates, the best fit first."""
        names = (*self.shape.names, *((PLANT_DEAD_TIME,) if self.delay_line else ()))
        parameters = next(iter(logs.values())).parameters
        records = [_resample_log(name, log, self.source, self.output) for name, log in logs.items()]
        moves = any(np.ptp(r.u) > 0 for r in records)
        require(moves, f"{self.source} never changes, so the plant is unidentifiable; log a step of it", LogError)
        coarse, fine = (
            [_thin_log(r, n // len(records)) for r in records] for n in (MAX_GRID_SAMPLES, MAX_REFINEMENT_SAMPLES)
        )
        fits = _search_grid(self.shape, coarse, [_trial_values(n, records, parameters) for n in names])
        refined = [_refine_fit(self.shape, fine, fit, names, parameters) for fit in _distinct_fits(fits)]
        best = _distinct_fits(sorted(refined, key=lambda fit: fit.misfit))
        return [self._build_start(fit, fine, logs, names) for fit in best]

    def _build_start(
        self, fit: "_Fit", records: Sequence["_EvenLog"], logs: Mapping[str, Log], names: Sequence[str]
    ) -> Start:
        found = dict(zip(names, fit.values, strict=True)) | {PLANT_GAIN: fit.gain, COULOMB_LEVEL: max(fit.coulomb, 0.0)}
        known = next(iter(logs.values())).parameters
        values: dict[str, float] = {}
        for n in (n for n in found if n in known and known[n].free):
            value = float(np.clip(found[n], known[n].lower, known[n].upper))
            values |= {f"{n}[{log}]": value for log in logs} if known[n].per_log else {n: value}
        states = {
            name: self._state_trajectory(fit, record, error).interpolate(log.measured.t)
            for (name, log), record, error in zip(logs.items(), records, fit.errors, strict=True)
        }
        return Start(states, values, ", ".join(f"{n.removeprefix('plant.')} {v:.3g}" for n, v in found.items()))

    def _state_trajectory(self, fit: "_Fit", record: "_EvenLog", error: Array) -> Trajectory:
        response = record.y - error
        drive = np.gradient(response, record.t)
        if self.shape.friction_polynomials is not None:
            lead = self.shape.friction_polynomials(*fit.values[: len(self.shape.names)])[0][0]
            drive = drive + lead * fit.gain * fit.coulomb * record.sign
        columns = {n: np.zeros(len(record.t)) for n in (*self.zero_states, *self.delay_line)}
        if self.delay_line:
            dead_time = fit.values[len(self.shape.names)]
            line = delay_states(record.u, float(record.t[1] - record.t[0]), len(self.delay_line), dead_time)
            columns |= dict(zip(self.delay_line, line.T, strict=True))
        return Trajectory(record.t + record.start_time, columns | {self.output: response, "drive": drive})


@dataclass(frozen=True, eq=False)
class _EvenLog:
    """A log on an even grid from zero: held input, output, smooth sign of the output, and the gain if it is fixed."""

    t: Array
    u: Array
    y: Array
    sign: Array
    gain: float | None
    start_time: float


@dataclass(frozen=True, eq=False)
class _UnitResponses:
    """Responses of unit gain on one log: to the initial input, to its changes, to friction, and free responses."""

    initial_input: Array
    input_changes: Array
    friction_responses: tuple[Array, ...]
    free: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """A point of the search: shaping values (dead time last), linear parameters, and errors by log."""

    values: tuple[float, ...]
    misfit: float
    gain: float
    coulomb: float
    errors: tuple[Array, ...]


def _resample_log(name: str, log: Log, source: str, output: str) -> _EvenLog:
    measured, gain = log.measured, log.parameters[PLANT_GAIN]
    known = np.isfinite(measured[source]) & np.isfinite(measured[output])
    t, u, y = (a[known] for a in (measured.t, measured[source], measured[output]))
    few = (
        f"{name}: {len(t)} samples of {source} and {output} are too few to start from; give {MIN_START_SAMPLES} or more"
    )
    require(len(t) >= MIN_START_SAMPLES, few, LogError)
    step = float(np.median(np.diff(t)))
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    linear = log.intersample.get(source) is Intersample.LINEAR
    # the mean over a sample stands for a line, to the second order
    held = np.interp(grid + step / 2, t, u) if linear else u[np.searchsorted(t, grid + 1e-3 * step, side="right") - 1]
    even = np.interp(grid, t, y)
    noise = 1.4826 * np.median(np.abs(np.diff(even))) + 1e-3 * np.ptp(even) + 1e-300
    known_gain = None if gain.free else gain.value
    return _EvenLog(grid - grid[0], held, even, np.tanh(even / (3 * noise)), known_gain, float(grid[0]))


def _thin_log(record: _EvenLog, most: int) -> _EvenLog:
    every = max(1, len(record.t) // max(most, 5 * MIN_START_SAMPLES))
    starts = np.arange(0, len(record.u), every)
    u = np.add.reduceat(record.u, starts) / np.diff(starts, append=len(record.u))
    return _EvenLog(record.t[::every], u, record.y[::every], record.sign[::every], record.gain, record.start_time)


def _trial_values(name: str, records: Sequence[_EvenLog], parameters: ParameterSet) -> Array:
    """Values to try: one if the parameter is fixed, else the range that the logs can show, within the bounds."""
    known = parameters[name]
    if not known.free:
        return np.array([known.value])
    fast, slow = 2 * min(float(r.t[1]) for r in records), max(float(r.t[-1]) for r in records)
    if name == PLANT_DAMPING:
        values = np.array(DAMPING_GRID)
    elif name == PLANT_DEAD_TIME:
        least = _least_value(name, records, parameters)
        values = np.append(least, np.geomspace(max(fast / 2, least), max(slow / 4, least), 12))
    else:
        values = np.geomspace(fast, slow, 24) if name.endswith("constant") else np.geomspace(1 / slow, 1 / fast, 24)
    return np.unique(np.clip(values, known.lower, known.upper))


def _least_value(name: str, records: Sequence[_EvenLog], parameters: ParameterSet) -> float:
    """The least value of a parameter that is tried: its lower bound, but never 0."""
    fast = 2 * min(float(r.t[1]) for r in records)
    return max(parameters[name].lower, MIN_DEAD_TIME * fast if name == PLANT_DEAD_TIME else 1e-9)


def _search_grid(shape: ResponseShape, records: Sequence[_EvenLog], grids: Sequence[Array]) -> list[_Fit]:
    """Fits at every point of the grid, the best first."""
    shape_grids, dead_grids = grids[: len(shape.names)], grids[len(shape.names) :]
    fits = []
    for shaping in itertools.product(*shape_grids):
        responses = [_unit_responses(shape, r, shaping) for r in records]
        fits += [_solve_linear_part(responses, records, shaping, dead) for dead in itertools.product(*dead_grids)]
    return sorted(fits, key=lambda fit: fit.misfit)


def _refine_fit(
    shape: ResponseShape, records: Sequence[_EvenLog], fit: _Fit, names: Sequence[str], parameters: ParameterSet
) -> _Fit:
    """Minimise the misfit over the logarithms of the free shaping values."""

    def fit_at(logs: Array) -> _Fit:
        values = list(fit.values)
        for i, value in zip(free, np.exp(logs), strict=True):
            values[i] = float(value)
        shaping, dead = values[: len(shape.names)], values[len(shape.names) :]
        return _solve_linear_part([_unit_responses(shape, r, shaping) for r in records], records, shaping, dead)

    def residuals(logs: Array) -> Array:
        return np.concatenate(fit_at(logs).errors)

    free = [i for i, n in enumerate(names) if parameters[n].free]
    if not free:
        return fit_at(np.empty(0))
    bounds = [(_least_value(names[i], records, parameters), min(parameters[names[i]].upper, 1e9)) for i in free]
    low, high = np.log(np.array(bounds)).T
    start = np.clip(np.log([fit.values[i] for i in free]), low + 1e-6, high - 1e-6)
    return fit_at(optimize.least_squares(residuals, start, bounds=(low, high), max_nfev=40).x)


def _distinct_fits(fits: Sequence[_Fit]) -> list[_Fit]:
    """Best few fits that differ by more than a fifth in one of their values."""
    kept: list[_Fit] = []
    for fit in fits:
        apart = all(np.max(np.abs(np.log(np.divide(fit.values, k.values))), initial=0.0) > 0.2 for k in kept)
        if len(kept) < MAX_CANDIDATES and apart:
            kept.append(fit)
    return kept


def _unit_responses(shape: ResponseShape, record: _EvenLog, shaping: Sequence[float]) -> _UnitResponses:
    t, u = record.t, record.u
    numerator, denominator = shape.polynomials(*shaping)
    b, a = _zero_order_hold_filter((numerator, denominator), float(t[1]))
    before: Array = u[0] * (np.full(len(t), numerator[-1] / denominator[-1]) if denominator[-1] else t)
    decays = np.column_stack([_apply_filter(np.ones(1), a, pulse) for pulse in np.eye(len(a) - 1, len(t))])
    free = np.linalg.qr(decays / np.abs(decays).max(axis=0))[0]
    friction = (
        ()
        if shape.friction_polynomials is None
        else (_apply_filter(*_zero_order_hold_filter(shape.friction_polynomials(*shaping), float(t[1])), record.sign),)
    )
    return _UnitResponses(before, _apply_filter(b, a, u - u[0]), friction, free)


def _solve_linear_part(
    responses: Sequence[_UnitResponses], records: Sequence[_EvenLog], shaping: Sequence[float], dead: Sequence[float]
) -> _Fit:
    """Least squares for the linear parameters: gain, gain times Coulomb voltage, and each log's free response."""
    blocks, targets = [], []
    for q, r in zip(responses, records, strict=True):
        forced = q.initial_input + np.interp(r.t - sum(dead), r.t, q.input_changes, left=0.0)
        columns = np.column_stack(
            [*([forced] if r.gain is None else []), *(-f for f in q.friction_responses), np.zeros(len(r.t))]
        )
        target = r.y if r.gain is None else r.y - r.gain * forced
        blocks.append(columns - q.free @ (q.free.T @ columns))
        targets.append(target - q.free @ (q.free.T @ target))
    matrix, target = np.vstack(blocks), np.concatenate(targets)
    size = np.abs(matrix).max(axis=0) + 1e-300
    weights = np.linalg.lstsq(matrix / size, target, rcond=1e-9)[0] / size
    errors = target - matrix @ weights
    known, misfit = records[0].gain, float(np.mean(errors**2))
    gain = float(weights[0]) if known is None else known
    coulomb = float(weights[0 if known is not None else 1]) / gain if responses[0].friction_responses and gain else 0.0
    ends = np.cumsum([len(r.t) for r in records])[:-1]
    split = tuple(np.split(errors, ends))
    return _Fit((*shaping, *dead), misfit if np.isfinite(misfit) else np.inf, gain, coulomb, split)


def _zero_order_hold_filter(polynomials: Polynomials, step: float) -> tuple[Array, Array]:
    """Digital filter with the exact response at samples to an input that is held between them."""
    numerator, denominator = polynomials
    n = len(denominator) - 1
    joint = np.eye(n + 1, k=-1)
    joint[0, :n], joint[0, n], joint[n] = -np.array(denominator[1:]) / denominator[0], 1 / denominator[0], 0.0
    moved = _matrix_exponential(step * joint)
    A, B, C = moved[:n, :n], moved[:n, n], np.pad(numerator, (n - len(numerator), 0))
    a = np.asarray(np.poly(A), dtype=np.float64)
    markov = [0.0, *(float(C @ np.linalg.matrix_power(A, k) @ B) for k in range(n))]
    return np.asarray(np.convolve(a, markov)[: n + 1], dtype=np.float64), a


def _matrix_exponential(matrix: Array) -> Array:
    """Exponential of a small matrix by scaling, Taylor series and squaring, far faster than scipy's."""
    halvings = max(0, int(np.ceil(np.log2(np.abs(matrix).sum(axis=1).max() + 1e-300))) + 2)
    term = total = np.eye(len(matrix))
    for k in range(1, 14):
        term = term @ matrix / (k * 2.0**halvings)
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def _apply_filter(b: Array, a: Array, u: Array) -> Array:
    return np.asarray(signal.lfilter(b, a, u), dtype=np.float64)
