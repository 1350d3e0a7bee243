"""`check_dwells`: a log of a positioning axis, which stands still most of the time; what its moves and dwells show."""

from collections.abc import Iterator

import numpy as np

from pneuopt.logs.checks.findings import LogFinding, StatedAxis, evidence
from pneuopt.logs.checks.motion import motion_speed
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array

MOST_MOTION = 0.5
"""Share of a log in motion [1] below which it is one of moves and dwells: higher notes every log that pauses."""
LEAST_SPEED, LEAST_WAY = 0.01, 0.002
"""Speed and way over the log's largest [1] of a move: lower counts flicker, higher loses slow, short ones."""
NOISE_WIDTHS, LOWER_QUARTILE = 4.0, 0.3186
"""Standard deviations of noise beyond which a speed is motion [1], fewer find moves in noise; and how many of them the
lower quartile of noise alone is."""
FAST_PERCENTILE, LARGEST_NOISE = 98, 0.1
"""Percentile of the speeds that is fast motion, and share of it [1] that noise may have: a higher percentile takes two
jumps of a sensor for moves, a larger share motion of all speeds for noise."""
SHORTEST_DWELL = 0.05
"""Rest [s] during which a move goes on: a shorter one counts a move that sticks on its way as two."""


def check_dwells(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Note a log that stands still most of the time: which share is motion, and what is identified from it."""
    t, motion = experiment.trajectory.t, motion_speed(experiment, axis)
    if motion is None or not np.isfinite(motion).any():
        return
    known = np.isfinite(motion)
    moves = _find_moves(t[known], np.abs(motion[known]))
    moving = np.zeros(int(known.sum()), dtype=bool)
    for first, last in moves:
        moving[first:last] = True
    share = float(moving.mean())
    if len(moves) < 2 or share > MOST_MOTION:
        return
    signal, whole = axis.position if axis.position in experiment.trajectory else axis.speed, float(t[-1] - t[0])
    told = f"{signal!r} moves in {share:.0%} of the log, {share * whole:.3g} of {whole:.3g} s, in {len(moves)} moves"
    these = "mass, Coulomb and viscous friction are identified from these moves, static friction from how each begins"
    still = np.zeros(len(t), dtype=bool)
    still[known] = ~moving
    shown = evidence(experiment, signal, where=still, label="it stands still")
    yield LogFinding(signal, f"{told}, and stands still between them: {these}", False, evidence=shown)


def _find_moves(t: Array, size: Array) -> list[tuple[int, int]]:
    """First sample of each move and that after its last, from the speed's size."""
    noise, fast = float(np.percentile(size, 25)) / LOWER_QUARTILE, float(np.percentile(size, FAST_PERCENTILE))
    moving = np.flatnonzero(size > max(LEAST_SPEED * fast, NOISE_WIDTHS * noise))
    if noise > LARGEST_NOISE * fast or not moving.size:
        return []
    breaks = np.flatnonzero(np.diff(t[moving]) > SHORTEST_DWELL)
    spans = list(zip(moving[np.r_[0, breaks + 1]], moving[np.r_[breaks, moving.size - 1]] + 1, strict=True))
    travelled = size * np.gradient(t)  # in the time of each sample
    ways = [float(travelled[first:last].sum()) for first, last in spans]
    return [(int(a), int(b)) for (a, b), way in zip(spans, ways, strict=True) if way > LEAST_WAY * max(ways)]
