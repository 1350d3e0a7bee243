"""`check_jumps`: a position that jumps from one sample to the next, as where a counter loses steps."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pneuopt.logs.checks.findings import MIN_VIEW_SAMPLES, PISTON, Evidence, LogFinding, Panel, StatedAxis, evidence
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array, Mask

MIN_JUMP_NOISE = 30.0
"""Jump over the noise [1]: lower takes outliers and steps of an encoder for jumps, higher misses small ones."""
MIN_JUMP_SPEED_RATIO = 5.0
"""Speed of a jump over that of the motion around it, and of most of the log [1]: lower takes short strokes in coarse
logs for jumps, higher misses jumps of fast motion."""
MIN_JUMP_ACCELERATION = 500.0
"""Acceleration [m/s^2] that a jump needs at least, to start and to stop within a sample: short-stroke cylinders reach
less, higher misses jumps in logs of 100 Hz."""
NEIGHBOURS = 3
"""Samples beside a jump that show the motion around it: with fewer an outlier is one, more miss short ones."""
USUAL_SPEED_QUANTILE = 0.98
"""Share of a log's samples [1] that move no faster than its usual speed: higher counts the jumps among them."""


Indices = NDArray[np.intp]


def check_jumps(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find jumps of the position that no motion explains."""
    log = experiment.trajectory
    if axis.position not in log or axis.position != PISTON.position:
        return
    known = np.flatnonzero(np.isfinite(log[axis.position]))
    t, x = log.t[known], log[axis.position][known]
    if known.size < 4 * NEIGHBOURS:
        return
    jumps = np.flatnonzero(_is_abrupt(t, x))
    if jumps.size:  # few logs have abrupt steps, and only theirs need a level of the noise
        noise = max(experiment.noise.get(axis.position, 0.0), noise_level(x, t))
        jumps = jumps[np.abs(np.diff(x))[jumps] > MIN_JUMP_NOISE * noise]
    if jumps.size:
        shown = _evidence(experiment, axis, known, jumps)
        yield LogFinding(axis.position, _sentence(t, x, jumps, axis.position), True, evidence=shown)


def _is_abrupt(t: Array, x: Array) -> Mask:
    """Which steps are far larger than those around them, and than those of most of the log."""
    time = np.diff(t)
    speed = np.abs(np.diff(x)) / time
    padded = np.pad(speed, NEIGHBOURS)
    shifts = [k for k in range(2 * NEIGHBOURS + 1) if k != NEIGHBOURS]
    around = np.max([padded[k : k + speed.size] for k in shifts], axis=0)
    is_fast = speed > MIN_JUMP_SPEED_RATIO * np.maximum(around, _usual_speed(t, x))
    return np.asarray(is_fast & (4 * speed / time > MIN_JUMP_ACCELERATION))


def _usual_speed(t: Array, x: Array) -> float:
    return float(np.quantile(np.abs(np.diff(x) / np.diff(t)), USUAL_SPEED_QUANTILE))


def _sentence(t: Array, x: Array, jumps: Indices, name: str) -> str:
    first = int(jumps[0])
    size, speed = 1e3 * (x[first + 1] - x[first]), abs(x[first + 1] - x[first]) / (t[first + 1] - t[first])
    usual = f"the log usually moves below {_usual_speed(t, x):.2g} m/s"
    found = f"{name!r} jumps by {size:.3g} mm within a sample at {t[first + 1]:.4g} s ({speed:.3g} m/s; {usual})"
    if jumps.size == 1:
        return f"{found}: cut the log in two there"
    more = "and again" if jumps.size == 2 else f"and {jumps.size - 1} times more, next"
    return f"{found}, {more} at {t[jumps[1] + 1]:.4g} s: leave the cells of {name!r} in between empty"


def _evidence(experiment: Experiment, axis: StatedAxis, known: Indices, jumps: Indices) -> Evidence:
    """The position, and the speed that it would need."""
    log = experiment.trajectory
    t, speed = log.t, np.full(len(log), np.nan)
    speed[known[1:]] = np.diff(log[axis.position][known]) / np.diff(t[known])
    begin, end = t[known[jumps[0]]], t[known[jumps[min(1, jumps.size - 1)] + 1]]
    margin = max(end - begin, MIN_VIEW_SAMPLES * float(np.median(np.diff(t))))
    where = np.zeros(len(log), dtype=bool)
    for jump in jumps:
        where[known[jump] : known[jump + 1] + 1] = True
    needed = Panel("m/s", {f"slope of the {axis.position}": speed})
    shown = evidence(experiment, axis.position, needed, where=where, label="jump")
    return replace(shown, view=(max(float(t[0]), begin - margin), min(float(t[-1]), end + margin)))
