"""How a linear plant starts from logs without a user's guess: separable output error over a grid, then refined.

Gain, start states and Coulomb friction enter the response linearly, so each point of a grid over the few other values
(time constants, damping, dead time) costs one small linear least squares; the best of them are refined.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from pneuopt.dynamics.hooks import Log, Start
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

Array = NDArray[np.float64]
Polynomials = tuple[list[float], list[float]]
GRID_SAMPLES, REFINED_SAMPLES, FEWEST_SAMPLES = 600, 4000, 20
CANDIDATES = 4
DAMPINGS = (0.1, 0.3, 0.7, 1.5, 4.0)
DAMPING, DEAD_TIME, GAIN, COULOMB = "plant.damping", "plant.dead_time", "plant.gain", "friction.coulomb"


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
        When called with a log that is too short, or logs whose input never changes.
    """

    shape: Shape
    source: str
    output: str
    delay_line: tuple[str, ...] = ()
    others: tuple[str, ...] = ()

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return up to four distinct candidates, the best fit first."""
        names = (*self.shape.names, *((DEAD_TIME,) if self.delay_line else ()))
        parameters = next(iter(logs.values())).parameters
        records = [_record(name, log, self.source, self.output) for name, log in logs.items()]
        moves = any(np.ptp(r.u) > 0 for r in records)
        require(moves, f"{self.source} never changes, which tells nothing of the plant; log a step of it", LogError)
        coarse, fine = ([_thinned(r, n // len(records)) for r in records] for n in (GRID_SAMPLES, REFINED_SAMPLES))
        fits = _searched(self.shape, coarse, [_grid(n, records, parameters) for n in names])
        refined = [_refined(self.shape, fine, fit, names, parameters) for fit in _distinct(fits)]
        best = _distinct(sorted(refined, key=lambda fit: fit.misfit))
        return [self._start(fit, fine, logs, names) for fit in best]

    def _start(self, fit: "_Fit", records: Sequence["_Record"], logs: Mapping[str, Log], names: Sequence[str]) -> Start:
        found = dict(zip(names, fit.values, strict=True)) | {GAIN: fit.gain, COULOMB: max(fit.coulomb, 0.0)}
        known = next(iter(logs.values())).parameters
        values: dict[str, float] = {}
        for n in (n for n in found if n in known and known[n].free):
            value = float(np.clip(found[n], known[n].lower, known[n].upper))
            values |= {f"{n}[{log}]": value for log in logs} if known[n].per_log else {n: value}
        states = {
            name: self._states(fit, record, error).at(log.measured.t)
            for (name, log), record, error in zip(logs.items(), records, fit.errors, strict=True)
        }
        return Start(states, values, ", ".join(f"{n.removeprefix('plant.')} {v:.3g}" for n, v in found.items()))

    def _states(self, fit: "_Fit", record: "_Record", error: Array) -> Trajectory:
        response = record.y - error
        drive = np.gradient(response, record.t)
        if self.shape.resisting is not None:
            lead = self.shape.resisting(*fit.values[: len(self.shape.names)])[0][0]
            drive = drive + lead * fit.gain * fit.coulomb * record.sign
        columns = {n: np.zeros(len(record.t)) for n in (*self.others, *self.delay_line)}
        if self.delay_line:
            columns[self.delay_line[0]] = 2 * record.u
        return Trajectory(record.t + record.began, columns | {self.output: response, "drive": drive})


@dataclass(frozen=True, eq=False)
class _Record:
    """A log on an even grid from zero: held input, output, sign of the output; its gain if that is known."""

    t: Array
    u: Array
    y: Array
    sign: Array
    gain: float | None
    began: float


@dataclass(frozen=True, eq=False)
class _Responses:
    """One log's responses of unit gain: to the input as it was before, to its moves since, to friction; free ones."""

    before: Array
    moved: Array
    rubbing: tuple[Array, ...]
    free: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """A point of the search: its shaping values (dead time last), what is linear in the response, its errors by log."""

    values: tuple[float, ...]
    misfit: float
    gain: float
    coulomb: float
    errors: tuple[Array, ...]


def _record(name: str, log: Log, source: str, output: str) -> _Record:
    measured, gain = log.measured, log.parameters[GAIN]
    known = np.isfinite(measured[source]) & np.isfinite(measured[output])
    t, u, y = (a[known] for a in (measured.t, measured[source], measured[output]))
    few = f"{name}: {len(t)} samples of {source} and {output} are too few to start from; give {FEWEST_SAMPLES} or more"
    require(len(t) >= FEWEST_SAMPLES, few, LogError)
    step = float(np.median(np.diff(t)))
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    held = u[np.searchsorted(t, grid + 1e-3 * step, side="right") - 1]
    even = np.interp(grid, t, y)
    noise = 1.4826 * np.median(np.abs(np.diff(even))) + 1e-3 * np.ptp(even) + 1e-300
    known_gain = None if gain.free else gain.value
    return _Record(grid - grid[0], held, even, np.tanh(even / (3 * noise)), known_gain, float(grid[0]))


def _thinned(record: _Record, most: int) -> _Record:
    every = max(1, len(record.t) // max(most, 5 * FEWEST_SAMPLES))
    starts = np.arange(0, len(record.u), every)
    u = np.add.reduceat(record.u, starts) / np.diff(starts, append=len(record.u))
    return _Record(record.t[::every], u, record.y[::every], record.sign[::every], record.gain, record.began)


def _grid(name: str, records: Sequence[_Record], parameters: ParameterSet) -> Array:
    """Values to try: one if the parameter is fixed; else across what the logs can show, within the bounds."""
    known = parameters[name]
    if not known.free:
        return np.array([known.value])
    fast, slow = 2 * min(float(r.t[1]) for r in records), max(float(r.t[-1]) for r in records)
    if name == DAMPING:
        values = np.array(DAMPINGS)
    elif name == DEAD_TIME:
        values = np.append(known.lower, np.geomspace(fast / 2, slow / 4, 12))
    else:
        values = np.geomspace(fast, slow, 24) if name.endswith("constant") else np.geomspace(1 / slow, 1 / fast, 24)
    return np.unique(np.clip(values, known.lower, known.upper))


def _searched(shape: Shape, records: Sequence[_Record], grids: Sequence[Array]) -> list[_Fit]:
    """Every point of the grid, the best first."""
    own_grids, dead_grids = grids[: len(shape.names)], grids[len(shape.names) :]
    fits = []
    for own in itertools.product(*own_grids):
        responses = [_responses(shape, r, own) for r in records]
        fits += [_solved(responses, records, own, dead) for dead in itertools.product(*dead_grids)]
    return sorted(fits, key=lambda fit: fit.misfit)


def _refined(
    shape: Shape, records: Sequence[_Record], fit: _Fit, names: Sequence[str], parameters: ParameterSet
) -> _Fit:
    """Follow the misfit downhill over the logarithms of the free shaping values."""

    def at(logs: Array) -> _Fit:
        values = list(fit.values)
        for i, value in zip(free, np.exp(logs), strict=True):
            values[i] = float(value)
        own, dead = values[: len(shape.names)], values[len(shape.names) :]
        return _solved([_responses(shape, r, own) for r in records], records, own, dead)

    def error(logs: Array) -> Array:
        return np.concatenate(at(logs).errors)

    free = [i for i, n in enumerate(names) if parameters[n].free]
    if not free:
        return at(np.empty(0))
    bounds = [(max(parameters[names[i]].lower, 1e-9), min(parameters[names[i]].upper, 1e9)) for i in free]
    low, high = np.log(np.array(bounds)).T
    start = np.clip(np.log([fit.values[i] for i in free]), low + 1e-6, high - 1e-6)
    return at(optimize.least_squares(error, start, bounds=(low, high), max_nfev=40).x)


def _distinct(fits: Sequence[_Fit]) -> list[_Fit]:
    """The best few that differ by more than a fifth in one of their values."""
    kept: list[_Fit] = []
    for fit in fits:
        apart = all(np.max(np.abs(np.log(np.divide(fit.values, k.values))), initial=0.0) > 0.2 for k in kept)
        if len(kept) < CANDIDATES and apart:
            kept.append(fit)
    return kept


def _responses(shape: Shape, record: _Record, own: Sequence[float]) -> _Responses:
    t, u = record.t, record.u
    numerator, denominator = shape.polynomials(*own)
    b, a = _sampled((numerator, denominator), float(t[1]))
    before: Array = u[0] * (np.full(len(t), numerator[-1] / denominator[-1]) if denominator[-1] else t)
    decays = np.column_stack([_filtered(np.ones(1), a, pulse) for pulse in np.eye(len(a) - 1, len(t))])
    free = np.linalg.qr(decays / np.abs(decays).max(axis=0))[0]
    rubbing = (
        () if shape.resisting is None else (_filtered(*_sampled(shape.resisting(*own), float(t[1])), record.sign),)
    )
    return _Responses(before, _filtered(b, a, u - u[0]), rubbing, free)


def _solved(
    responses: Sequence[_Responses], records: Sequence[_Record], own: Sequence[float], dead: Sequence[float]
) -> _Fit:
    """Least squares for what is linear: gain, gain times Coulomb voltage, and each log's free response."""
    blocks, targets = [], []
    for q, r in zip(responses, records, strict=True):
        forced = q.before + np.interp(r.t - sum(dead), r.t, q.moved, left=0.0)
        columns = np.column_stack([*([forced] if r.gain is None else []), *(-f for f in q.rubbing), np.zeros(len(r.t))])
        target = r.y if r.gain is None else r.y - r.gain * forced
        blocks.append(columns - q.free @ (q.free.T @ columns))
        targets.append(target - q.free @ (q.free.T @ target))
    matrix, target = np.vstack(blocks), np.concatenate(targets)
    size = np.abs(matrix).max(axis=0) + 1e-300
    weights = np.linalg.lstsq(matrix / size, target, rcond=1e-9)[0] / size
    errors = target - matrix @ weights
    known, misfit = records[0].gain, float(np.mean(errors**2))
    gain = float(weights[0]) if known is None else known
    coulomb = float(weights[0 if known is not None else 1]) / gain if responses[0].rubbing and gain else 0.0
    ends = np.cumsum([len(r.t) for r in records])[:-1]
    split = tuple(np.split(errors, ends))
    return _Fit((*own, *dead), misfit if np.isfinite(misfit) else np.inf, gain, coulomb, split)


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
