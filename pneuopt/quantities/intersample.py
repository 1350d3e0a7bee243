"""`Intersample`: how a signal runs between two samples of a log, held or linearly, and which of both is usual."""

from enum import Enum

# What sensors show: a signal in one of these units varies between samples. With a command's unit here, its steps are
# smeared over a sample; without a sensor's, it comes half a sample late.
MEASURED_UNITS = frozenset(["N", "N*m", "Pa", "Pa(a)", "Pa(g)", "m", "m/s", "m/s^2", "rad", "rad/s", "rad/s^2", "K"])
COMMAND_SUFFIX = "_reference"  # of the name of a set-point, which a controller holds whatever its unit


class Intersample(Enum):
    """How a signal runs between two samples."""

    HELD = "held"
    LINEAR = "linear"


def usual_intersample(name: str, unit: str) -> Intersample:
    """How a signal of this name and SI unit usually runs between two samples.

    A measured force, torque, pressure, motion or temperature is linear, and so is what has no unit; a set-point, and a
    command in any other unit, is held by the controller that gives it.

    Examples
    --------
    >>> usual_intersample("force", "N"), usual_intersample("valve_voltage", "V")
    (<Intersample.LINEAR: 'linear'>, <Intersample.HELD: 'held'>)
    """
    measured = (not unit or unit in MEASURED_UNITS) and not name.endswith(COMMAND_SUFFIX)
    return Intersample.LINEAR if measured else Intersample.HELD
