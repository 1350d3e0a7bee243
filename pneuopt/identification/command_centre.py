"""`centre_command`: a command that was logged from 0 to 10 V, with the valve closed at 5 V, as one of -5 to 5 V.

A plant counts its command from the middle of the valve. Taken as it stands, such a log would show a valve that is fully
open while the drive rests.
"""

import warnings
from dataclasses import replace

import numpy as np

from pneuopt.dynamics.runnable import Fittable
from pneuopt.identification.excitation import MOVING_SPEED_SHARE
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet

# distance of the resting command from the middle of its range, over half the range [1]: higher takes a valve that holds
# a load for one with another centre, lower misses a wide dead zone
MAX_REST_DISTANCE = 0.2
RANGE_TOLERANCE = 0.02  # by which noise may leave the range, over half the range [1]; higher takes other ranges for it
MIN_EXCURSION = 0.02  # to both sides of the middle, over half the range [1]; lower takes one-way logs for two-way ones


def centre_command(system: Fittable, experiment: Experiment, parameters: ParameterSet) -> Experiment:
    """Count a valve's command from the middle of its range, with a warning, where a log counts it from 0.

    Parameters
    ----------
    system : Fittable
    experiment : Experiment
    parameters : ParameterSet

    Returns
    -------
    Experiment
        The same where the command is counted from the middle already, or the plant has no valve.
    """
    element = None if system.plant.axis is None else system.plant.axis.final_element
    if element is None:
        return experiment
    limit = (system.parameters | parameters)[element.limit]
    half, unit = experiment.conditions.get(element.limit, limit.value), limit.unit
    channel = next((q.name for q in system.plant.inputs if q.unit == unit and q.name in experiment.trajectory), "")
    if not channel:
        return experiment
    command, rest = experiment.trajectory[channel], _resting_command(experiment, channel)
    if not _is_counted_from_zero(command / half, rest / half):
        return experiment
    warnings.warn(
        f"{experiment.name}: {channel} rests at {rest:.3g} {unit} and stays between 0 and {2 * half:g} {unit}, so the "
        f"{element.name} is closed at {half:g} {unit}, from where it is counted now; say so in the log's sidecar: "
        f'centre = "{half:g} {unit}"',
        PhysicsWarning,
        stacklevel=4,
    )
    return replace(experiment, trajectory=experiment.trajectory.with_columns({channel: command - half}))


def _is_counted_from_zero(command: Array, rest: float) -> bool:
    """Whether a command [half ranges] lies between 0 and 2, on both sides of 1, and rests near 1."""
    low, high = float(np.nanmin(command)), float(np.nanmax(command))
    is_within = low >= -RANGE_TOLERANCE and high <= 2 + RANGE_TOLERANCE
    is_two_way = low < 1 - MIN_EXCURSION and high > 1 + MIN_EXCURSION
    return is_within and is_two_way and abs(rest - 1) < MAX_REST_DISTANCE


def _resting_command(experiment: Experiment, channel: str) -> float:
    """Median of the command where the drive stands; over the whole log where that is not to be seen."""
    log = experiment.trajectory
    if "speed" in log:
        speed = np.abs(log["speed"])
    elif "position" in log:
        speed = np.abs(np.gradient(log["position"], log.t))
    else:
        return float(np.nanmedian(log[channel]))
    known = speed[np.isfinite(speed)]
    still = speed <= MOVING_SPEED_SHARE * float(np.quantile(known, 0.99)) if known.size else np.zeros(len(log), bool)
    return float(np.nanmedian(log[channel][still] if still.any() else log[channel]))
