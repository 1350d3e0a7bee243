"""`check_end_stops`: a body that rests at an end of its way while the drive pushes it on."""

from collections.abc import Iterator

import numpy as np

from pneuopt.logs.checks.findings import LARGE_SHARE, LogFinding, Panel, StatedAxis, evidence
from pneuopt.logs.checks.motion import motion_speed
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.units import write_value

MIN_STOP_FORCE_RATIO = 2.5
"""Push at rest at an end over what holds or moves the body elsewhere [1]: lower takes static friction for a stop,
higher misses stops under a weak push."""
MIN_STOP_TIME = 0.05
"""Time [s] of pushing against a stop: shorter takes a reversal for one, longer misses a bounce."""
MIN_STOP_SAMPLES = 10
"""Samples of the same: fewer take noise for a stop, more miss stops in logs of 100 Hz."""
STOP_WIDTH = 6.0
"""Noise [1] within which positions at a stop lie: lower cuts a stop in pieces, higher takes slow reversals for one."""
STOP_SHARE = 2e-3
"""Share of the way [1] by which a stop gives in: lower misses soft stops, higher takes slow reversals for them."""
STATED_STOP_SHARE = 0.05
"""Share of the way [1] by which a stated stop may be off: lower blames a sensor's zero, higher a wrong stroke."""


def check_end_stops(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find rests at an extreme position under a push that moves the body everywhere else."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
    if motion is None or axis.position not in log or not axis.forces or any(n not in log for n in axis.forces):
        return
    x, push, unit = log[axis.position], axis.net_force({n: log[n] for n in axis.forces}), experiment.unit(axis.position)
    way = float(np.nanmax(x) - np.nanmin(x))
    noise = experiment.noise[axis.position] if axis.position in experiment.noise else noise_level(x, log.t)
    width = max(STOP_WIDTH * noise, STOP_SHARE * way)
    inside = (x > np.nanmin(x) + width) & (x < np.nanmax(x) - width)
    middle, level = _usual_push(inside, motion, push)
    for side, end in ((1, float(np.nanmax(x))), (-1, float(np.nanmin(x)))):
        held = (np.abs(x - end) < width) & (side * (push - middle) > MIN_STOP_FORCE_RATIO * level)
        begin, last = _longest_run(held)
        is_long = last - begin >= MIN_STOP_SAMPLES and log.t[last] - log.t[begin] >= MIN_STOP_TIME
        if not is_long or _is_stated(end, axis):
            continue
        force = float(np.median(push[begin : last + 1]))
        times = f"from {log.t[begin]:.4g} s to {log.t[last]:.4g} s"
        ratio = abs(force - middle) / level
        pushed = f"{force:.3g} {axis.force_unit} push it on, {ratio:.2g} times what moves it elsewhere"
        message = f"{axis.position!r} stays at {write_value(end, unit, 4)} {times} while {pushed}, as at an end stop"
        message += " that the model has not: leave these rows out, the log is cut there"
        panel, at = Panel(axis.force_unit, {"force of the drive": push}), (begin + last) // 2
        shown = evidence(experiment, axis.position, panel, where=held, at=at, motion=motion, label="stop")
        yield LogFinding(axis.position, message, True, evidence=shown)


def _usual_push(inside: Mask, motion: Array, push: Array) -> tuple[float, float]:
    """The middle of the pushes that move the body each way, and how far from it a push moves or holds it."""
    fast = LARGE_SHARE * float(np.nanquantile(np.abs(motion), 0.99))
    moving = [side * motion > fast for side in (1, -1)]
    ways = [push[each] for each in moving]
    known = [float(np.nanmedian(way)) for way in ways if way.size >= MIN_STOP_SAMPLES]
    travels = [float(np.sum(np.abs(motion[each]))) for each in moving]
    # noise in rest goes either way: a body that only advances has no middle
    goes_back = min(travels) > LARGE_SHARE * max(travels)
    middle = sum(known) / 2 if len(known) == 2 and goes_back else 0.0
    pushes = np.abs(np.concatenate(ways) - middle)
    held = np.abs(push[(np.abs(motion) < fast) & inside] - middle)
    holding = float(np.nanquantile(held, 0.99)) if held.size >= MIN_STOP_SAMPLES else 0.0
    return middle, max(float(np.nanmedian(pushes)), holding)


def _is_stated(end: float, axis: StatedAxis) -> bool:
    """Whether the model has a stop near this position."""
    return any(abs(end - stop) < STATED_STOP_SHARE * float(np.ptp(axis.stops)) for stop in axis.stops)


def _longest_run(mask: Mask) -> tuple[int, int]:
    """First and last sample of the longest run; (0, 0) without one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    if not edges.size:
        return 0, 0
    longest = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * longest]), int(edges[2 * longest + 1]) - 1
