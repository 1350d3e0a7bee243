"""How a linear plant starts from a log without a user's guess: separable output error over a grid, then refined.

Gain, start state and Coulomb friction enter the response linearly, so each point of a grid over the few other values
(time constants, damping, dead time) costs one small linear least squares; the best of them are refined.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from pneuopt.errors import LogError, require
from pneuopt.parameters import ParameterSet
from pneuopt.system import Start
from pneuopt.trajectories import Trajectory

Array = NDArray[np.float64]
Polynomials = tuple[list[float], list[float]]
GRID_SAMPLES, REFINED_SAMPLES = 600, 4000
CANDIDATES = 4
RATIOS = {"plant.damping": (0.1, 0.3, 0.7, 1.5, 4.0)}
DEAD_TIME, GAIN, COULOMB = "plant.dead_time", "plant.gain", "friction.coulomb"


@dataclass(frozen=True)
class Shape:
    """A plant's response at unit gain, apart from its dead time.

    Parameters
    ----------
    names : tuple of str
        The parameters that shape it.
    polynomials : callable
        Their values to numerator and denominator, highest power first.
    resisting : callable, optional
        The same for the response to friction.
    """

    names: tuple[str, ...]
    polynomials: Callable[..., Polynomials]
    resisting: Callable[..., Polynomials] | None = None


@dataclass(frozen=True)
class _Fit:
    """A point of the search: its shaping values (dead time last), its misfit, what is linear in the response."""

    values: tuple[float, ...]
    misfit: float
    gain: float
    coulomb: float
    response: Array


@dataclass(frozen=True)
class _Record:
    """A log on an even grid from zero, and what is known beforehand."""

    t: Array
    u: Array
    y: Array
    sign: Array
    gain: float | None


@dataclass(frozen=True)
class LinearStarts:
    """The start finder of a linear plant.

    Parameters
    ----------
    shape : Shape
    source, output : str
        The plant's input and output.
    delay_line : tuple of str
        The states of its dead time.
    others : tuple of str
        States of which a log tells nothing; they start at zero.

    Raises
    ------
    LogError
        When called with a log that is too short, or whose input never changes.
    """

    shape: Shape
    source: str
    output: str
    delay_line: tuple[str, ...] = ()
    others: tuple[str, ...] = ()

    def __call__(self, measured: Trajectory, parameters: ParameterSet) -> Sequence[Start]:
        """Return up to four distinct candidates, the best fit first."""
        names = (*self.shape.names, *((DEAD_TIME,) if self.delay_line else ()))
        record = _record(measured, self.source, self.output, parameters)
        coarse = _thinned(record, GRID_SAMPLES)
        fits = _searched(self.shape, coarse, [_grid(n, record, parameters) for n in names])
        finer = _thinned(record, REFINED_SAMPLES)
        refined = [_refined(self.shape, finer, fit, names, parameters) for fit in _distinct(fits)]
        best = _distinct(sorted(refined, key=lambda f: f.misfit))
        return [self._start(fit, measured, finer, names, parameters) for fit in best]

    def _start(
        self, fit: _Fit, measured: Trajectory, record: _Record, names: Sequence[str], parameters: ParameterSet
    ) -> Start:
        found = dict(zip(names, fit.values, strict=True)) | {GAIN: fit.gain, COULOMB: max(fit.coulomb, 0.0)}
        chosen = {n: _within(parameters, n, v) for n, v in found.items() if n in parameters and parameters[n].free}
        columns = {n: np.zeros(len(record.t)) for n in (*self.others, *self.delay_line)}
        columns |= {self.output: fit.response, "drive": np.gradient(fit.response, record.t)}
        if self.shape.resisting is not None:
            lead = self.shape.resisting(*fit.values[: len(self.shape.names)])[0][0]
            columns["drive"] += lead * fit.gain * fit.coulomb * record.sign
        if self.delay_line:
            columns[self.delay_line[0]] = 2 * record.u
        label = ", ".join(f"{n.removeprefix('plant.')} {v:.3g}" for n, v in chosen.items())
        return Start(Trajectory(record.t + measured.t[0], columns).at(measured.t), chosen, label)


def _record(measured: Trajectory, source: str, output: str, parameters: ParameterSet) -> _Record:
    known = np.isfinite(measured[source]) & np.isfinite(measured[output])
    t, u, y = (a[known] for a in (measured.t, measured[source], measured[output]))
    require(
        len(t) >= 20, f"{len(t)} samples of {source} and {output} are too few to start from; give 20 or more", LogError
    )
    require(
        bool(np.ptp(u) > 0),
        f"{source} never changes in this log, so it tells nothing of the plant; log a step",
        LogError,
    )
    grid = np.arange(0.0, t[-1] - t[0], float(np.median(np.diff(t)))) + t[0]
    held = u[np.searchsorted(t, grid + 1e-9, side="right") - 1]
    even = np.interp(grid, t, y)
    noise = 1.4826 * np.median(np.abs(np.diff(even))) + 1e-3 * np.ptp(even)
    gain = parameters[GAIN]
    return _Record(grid - grid[0], held, even, np.tanh(even / (3 * noise)), None if gain.free else gain.value)


def _thinned(record: _Record, most: int) -> _Record:
    every = max(1, len(record.t) // most)
    starts = np.arange(0, len(record.u), every)
    u = np.add.reduceat(record.u, starts) / np.diff(starts, append=len(record.u))
    return _Record(record.t[::every], u, record.y[::every], record.sign[::every], record.gain)


def _grid(name: str, record: _Record, parameters: ParameterSet) -> Array:
    """Values to try: one if the parameter is fixed; else across what the log can show, within the bounds."""
    known, step, length = parameters[name], record.t[1], record.t[-1]
    if not known.free:
        return np.array([known.value])
    if name in RATIOS:
        values = np.array(RATIOS[name])
    elif name == DEAD_TIME:
        values = np.append(known.lower, np.geomspace(step, length / 4, 12))
    else:
        fast, slow = 2 * step, length
        values = np.geomspace(fast, slow, 24) if name.endswith("constant") else np.geomspace(1 / slow, 1 / fast, 24)
    return np.unique(np.clip(values, known.lower, known.upper))


@dataclass(frozen=True)
class _Responses:
    """Responses of unit gain: to the input (what it was before the log, and what moved since), to friction, free."""

    before: Array
    moved: Array
    others: list[Array]


def _responses(shape: Shape, record: _Record, own: Sequence[float]) -> _Responses:
    t, u = record.t, record.u
    numerator, denominator = shape.polynomials(*own)
    b, a = _sampled((numerator, denominator), t[1])
    before: Array = u[0] * (np.full(len(t), numerator[-1] / denominator[-1]) if denominator[-1] else t)
    free = [_filtered(np.ones(1), a, pulse) for pulse in np.eye(len(a) - 1, len(t))]
    rubbing = [] if shape.resisting is None else [-_filtered(*_sampled(shape.resisting(*own), t[1]), record.sign)]
    return _Responses(before, _filtered(b, a, u - u[0]), rubbing + free)


def _solved(responses: _Responses, record: _Record, own: Sequence[float], dead: Sequence[float]) -> _Fit:
    """Least squares for what is linear: gain, gain times Coulomb voltage, free response."""
    forced = responses.before + np.interp(record.t - sum(dead), record.t, responses.moved, left=0.0)
    known = np.zeros(len(record.t)) if record.gain is None else record.gain * forced
    columns = ([forced] if record.gain is None else []) + responses.others
    matrix = np.column_stack(columns)
    size = np.abs(matrix).max(axis=0) + 1e-300
    weights = np.linalg.lstsq(matrix / size, record.y - known, rcond=1e-12)[0] / size
    response = known + matrix @ weights
    gain = float(weights[0]) if record.gain is None else record.gain
    coulomb = float(weights[len(columns) - len(responses.others)]) / gain if gain else 0.0
    misfit = float(np.mean((record.y - response) ** 2))
    return _Fit((*own, *dead), misfit if np.isfinite(misfit) else np.inf, gain, coulomb, response)


def _sampled(polynomials: Polynomials, step: float) -> tuple[Array, Array]:
    """The filter that gives the exact response at samples to an input that is held between them."""
    numerator, denominator = polynomials
    n = len(denominator) - 1
    joint = np.eye(n + 1, k=-1)
    joint[0, :n], joint[0, n], joint[n] = -np.array(denominator[1:]) / denominator[0], 1 / denominator[0], 0.0
    moved = _exponential(step * joint)
    A, B, C = moved[:n, :n], moved[:n, n], np.pad(numerator, (n - len(numerator), 0))
    a = np.asarray(np.poly(A), dtype=np.float64)
    markov = [0.0, *(float(C @ np.linalg.matrix_power(A, k) @ B) for k in range(n))]
    return np.asarray(np.convolve(a, markov)[: n + 1], dtype=np.float64), a


def _exponential(matrix: Array) -> Array:
    """exp(matrix) by scaling, Taylor series and squaring; for matrices this small far faster than scipy's."""
    halvings = max(0, int(np.ceil(np.log2(np.abs(matrix).sum(axis=1).max() + 1e-300))) + 2)
    term = total = np.eye(len(matrix))
    for k in range(1, 14):
        term = term @ matrix / (k * 2.0**halvings)
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def _filtered(b: Array, a: Array, u: Array) -> Array:
    return np.asarray(signal.lfilter(b, a, u), dtype=np.float64)


def _searched(shape: Shape, record: _Record, grids: Sequence[Array]) -> list[_Fit]:
    """Every point of the grid, the best first."""
    own_grids, dead_grids = grids[: len(shape.names)], grids[len(shape.names) :]
    fits = []
    for own in itertools.product(*own_grids):
        responses = _responses(shape, record, own)
        fits += [_solved(responses, record, own, dead) for dead in itertools.product(*dead_grids)]
    return sorted(fits, key=lambda fit: fit.misfit)


def _fit(shape: Shape, record: _Record, values: Sequence[float]) -> _Fit:
    own, dead = values[: len(shape.names)], values[len(shape.names) :]
    return _solved(_responses(shape, record, own), record, own, dead)


def _refined(shape: Shape, record: _Record, fit: _Fit, names: Sequence[str], parameters: ParameterSet) -> _Fit:
    """Follow the misfit downhill over the logarithms of the free shaping values."""
    free = [i for i, n in enumerate(names) if parameters[n].free]
    if not free:
        return _fit(shape, record, fit.values)
    bounds = [(max(parameters[names[i]].lower, 1e-9), min(parameters[names[i]].upper, 1e9)) for i in free]

    def values(logs: Array) -> list[float]:
        full = list(fit.values)
        for i, value in zip(free, np.exp(logs), strict=True):
            full[i] = float(value)
        return full

    def error(logs: Array) -> Array:
        return _fit(shape, record, values(logs)).response - record.y

    low, high = np.log(np.array(bounds)).T
    start = np.clip(np.log([fit.values[i] for i in free]), low + 1e-6, high - 1e-6)
    found = optimize.least_squares(error, start, bounds=(low, high), max_nfev=40)
    return _fit(shape, record, values(found.x))


def _distinct(fits: Sequence[_Fit]) -> list[_Fit]:
    """The best few that differ by more than a fifth in one of their values, those of a hopeless misfit left out."""
    kept: list[_Fit] = []
    for fit in fits:
        apart = all(np.max(np.abs(np.log(np.divide(fit.values, k.values))), initial=0.0) > 0.2 for k in kept)
        if not kept or (apart and len(kept) < CANDIDATES and np.isfinite(fit.misfit)):
            kept.append(fit)
    return kept


def _within(parameters: ParameterSet, name: str, value: float) -> float:
    known = parameters[name]
    return float(np.clip(value, known.lower, known.upper))
