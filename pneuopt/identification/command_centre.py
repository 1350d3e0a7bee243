"""`find_centre`: the centre of a valve whose command was logged from 0 to 10 V, to be estimated with the rest.

A command that stays between 0 and twice the valve's span, and rests near the span, is that of a valve which is closed
there. Taken as a command about 0 V, it would show a valve that is fully open while the drive rests.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pneuopt.dynamics.centre import centre_name
from pneuopt.dynamics.hooks import FinalElement
from pneuopt.dynamics.runnable import Fittable
from pneuopt.identification.excitation import MOVING_SPEED_SHARE
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import LogError, PhysicsWarning, require
from pneuopt.quantities.parameters import ParameterSet

# distance of the resting command from the middle of its range, over half the range [1]: higher takes a valve that holds
# a load for one with another centre, lower misses a wide dead zone
MAX_REST_DISTANCE = 0.2
RANGE_TOLERANCE = 0.02  # by which noise may leave the range, over half the range [1]; higher takes other ranges for it
MIN_EXCURSION = 0.02  # to both sides of the middle, over half the range [1]; lower takes one-way logs for two-way ones


def find_centre(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> ParameterSet:
    """Free the centre of a plant's valve, with a warning, where logs count its command from 0 and nobody has stated it.

    Parameters
    ----------
    system : Fittable
    experiments : sequence of Experiment
        Each with a name.
    parameters : ParameterSet

    Returns
    -------
    ParameterSet
        The same where a centre is stated, where no log shows one, or where the plant has none.

    Raises
    ------
    LogError
        If the logs, or a log and a stated centre, count the command from different voltages.
    """
    name, element = centre_name(system.plant), system.plant.axis.final_element if system.plant.axis else None
    if name is None or element is None:
        return parameters
    every = system.parameters | parameters
    stated = every[name]
    commands = [c for e in experiments if name not in e.conditions for c in _commands(system, element, e, every)]
    shown = [c for c in commands if c.is_counted_from(0.0)]
    about = [c for c in commands if c.is_counted_from(-c.half)]
    if stated.value:
        _check_stated(name, stated.value, about)
        return parameters
    if not shown:
        return parameters
    if about:
        message = f"{shown[0]}, but {about[0]}; subtract the valve's centre in the sidecars of all logs, or of none"
        raise LogError(message)
    rest, most = float(np.median([c.rest for c in shown])), MAX_REST_DISTANCE * shown[0].half
    found = replace(stated, value=rest, lower=rest - most, upper=rest + most, free=True, source="where the log rests")
    warnings.warn(
        f"{shown[0]}: the {element.name} is closed near {shown[0].half:g} {stated.unit}; {name} is estimated with the "
        f'rest, or state it, centre = "{shown[0].half:g} {stated.unit}", under [{name.partition(".")[0]}]',
        PhysicsWarning,
        stacklevel=3,
    )
    return parameters | ParameterSet({name: found})


class _Command(NamedTuple):
    """A valve's command in a log: its range and where it rests, and the size of the valve's own half range."""

    log: str
    channel: str
    unit: str
    low: float
    high: float
    rest: float
    half: float

    def is_counted_from(self, zero: float) -> bool:
        """Whether the command runs from a voltage to both sides of half the range above it, and rests near there."""
        low, high, rest = ((v - zero) / self.half for v in (self.low, self.high, self.rest))
        is_within = low >= -RANGE_TOLERANCE and high <= 2 + RANGE_TOLERANCE
        is_two_way = low < 1 - MIN_EXCURSION and high > 1 + MIN_EXCURSION
        return is_within and is_two_way and abs(rest - 1) < MAX_REST_DISTANCE

    def __str__(self) -> str:
        run = f"runs from {self.low:.3g} to {self.high:.3g} {self.unit}"
        return f"{self.log}: {self.channel} {run} and rests at {self.rest:.3g} {self.unit}"


def _check_stated(name: str, value: float, about: Sequence[_Command]) -> None:
    """Refuse a centre where a log's command has been counted from it already."""
    for command in about:
        message = f"{command}, which is no command of a valve with {name} = {value:g} {command.unit}; leave that out"
        remedy = "of the drive, or of the log's sidecar (or Python) what has subtracted it"
        require(abs(value) < MAX_REST_DISTANCE * command.half, f"{message} {remedy}", LogError)


def _commands(
    system: Fittable, element: FinalElement, experiment: Experiment, parameters: ParameterSet
) -> list[_Command]:
    """The command of a log; none where its channel is missing or empty."""
    limit = parameters[element.limit]
    half, log = experiment.conditions.get(element.limit, limit.value), experiment.trajectory
    channels = [q.name for q in system.plant.inputs if q.unit == limit.unit and q.name in log]
    if not channels or not np.isfinite(log[channels[0]]).any():
        return []
    ends = float(np.nanmin(log[channels[0]])), float(np.nanmax(log[channels[0]]))
    rest = _resting_command(experiment, channels[0])
    return [_Command(experiment.name, channels[0], limit.unit, *ends, rest, half)]


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
