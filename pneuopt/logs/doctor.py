"""`examine`: faults that a log shows without a model: units, signs, zero points, sampling, missing motion."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from pneuopt.logs.checks.balance import check_mass, check_offset
from pneuopt.logs.checks.dwells import check_dwells
from pneuopt.logs.checks.end_stops import check_end_stops
from pneuopt.logs.checks.findings import PISTON, LogFinding, StatedAxis
from pneuopt.logs.checks.jumps import check_jumps
from pneuopt.logs.checks.sensors import check_pressures, check_sampling
from pneuopt.logs.checks.signs import check_command, check_position_speed, check_work_sign
from pneuopt.logs.checks.standstill import check_has_motion, check_scale
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array, Mask

MIN_SPLINE = 4
"""Samples of a channel through which a cubic spline runs."""
MAX_STEPS_BETWEEN = 5.0
"""Time between two samples of a channel over its usual one [1] from which it is a hole: nobody knows what was there."""


def examine(experiment: Experiment, axis: StatedAxis = PISTON) -> tuple[LogFinding, ...]:
    """Find faults of a log before any model is fitted to it.

    Parameters
    ----------
    experiment : Experiment
        Its noise, where given, separates motion from noise.
    axis : StatedAxis
        What the log calls its motion and what drives it.

    Returns
    -------
    tuple of LogFinding
        Faults first: nothing moves; a channel is constant; position and speed disagree in sign or unit; the force, or
        the pressures, brake the motion on balance, which no drive does; the piston runs against the valve's command, or
        to and fro without one; it jumps, or rests at a stop that the model lacks; force and acceleration are those of
        another mass than is stated; a pressure is a vacuum, or above the supply.
        Then notes: a constant force that is not stated; jitter, a clipped sensor, a coarse resolution; of an axis that
        stands still most of the time, which share is motion.

    Examples
    --------
    >>> import numpy as np
    >>> from pneuopt.quantities.trajectories import Trajectory
    >>> t = np.arange(2000) * 1e-3
    >>> swing = {"position": 0.1 * np.sin(6 * t), "force": 5.0 * np.cos(6 * t)}
    >>> examine(Experiment(Trajectory(t, swing)))
    ()
    >>> finding = examine(Experiment(Trajectory(t, {**swing, "force": -swing["force"]})))[0]
    >>> print(finding.check, finding.message.partition("(")[0], finding.message.partition(": ")[2], sep="; ")
    work; the force brakes the motion on balance ; change the sign of 'force'
    """
    experiment = _with_noise(experiment, axis)
    whole = _fill_between(experiment)
    logs = {name: experiment if name in SINGLE_SAMPLE_CHECKS else whole for name in CHECKS}
    named = ((name, finding) for name, check in CHECKS.items() for finding in check(logs[name], axis))
    found = [replace(finding, check=name, log=experiment.name) for name, finding in named]
    return tuple(sorted(found, key=lambda f: not f.fault))


def _with_noise(experiment: Experiment, axis: StatedAxis) -> Experiment:
    """The log with the noise of its motion, which several checks need."""
    log, found = experiment.trajectory, dict[str, float]()
    for name in (axis.position, axis.speed):
        if name in log and name not in experiment.noise:
            found[name] = noise_level(log[name], log.t)
    return experiment.with_noise({name: level for name, level in found.items() if level > 0})


def _fill_between(experiment: Experiment) -> Experiment:
    """The log with each channel at every instant, as recorders that give each its own rate do not write it.

    A spline runs through the samples, but not across a hole.
    """
    log = experiment.trajectory
    known = {n: np.isfinite(log[n]) for n in log}
    lacking = [n for n, there in known.items() if MIN_SPLINE <= there.sum() < there.size]
    return replace(experiment, trajectory=log.with_columns({n: _spline(log.t, log[n], known[n]) for n in lacking}))


def _spline(t: Array, column: Array, known: Mask) -> Array:
    from scipy.interpolate import CubicSpline

    at, steps = t[known], np.diff(t[known])
    out = np.asarray(CubicSpline(at, column[known], extrapolate=False)(t))
    before = np.clip(np.searchsorted(at, t, side="right") - 1, 0, steps.size - 1)
    out[steps[before] > MAX_STEPS_BETWEEN * float(np.median(steps))] = np.nan
    out[known] = column[known]
    return out


CHECKS: dict[str, Callable[[Experiment, StatedAxis], Iterator[LogFinding]]] = {
    "motion": check_has_motion,
    "speed": check_position_speed,
    "work": check_work_sign,
    "command": check_command,
    "scale": check_scale,
    "jumps": check_jumps,
    "stops": check_end_stops,
    "mass": check_mass,
    "offset": check_offset,
    "pressures": check_pressures,
    "sampling": check_sampling,
    "dwells": check_dwells,
}
"""The checks by the names under which a user accepts what they find: a log that is right all the same."""
SINGLE_SAMPLE_CHECKS = ("motion", "jumps", "sampling")
"""Checks of single samples, to which nothing is to be added."""
