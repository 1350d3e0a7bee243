"""`Finding`: one thing about a log; `AxisChannels`: what the log calls its motion and what drives it."""

from dataclasses import dataclass
from typing import NamedTuple


class AxisChannels(NamedTuple):
    """The channels of the axis that a log is of: a piston's unless a plant names its own (angle, torque).

    Attributes
    ----------
    position, speed : str
    push : str
        The force or torque that drives the axis, positive in the direction of positive speed.
    """

    position: str = "position"
    speed: str = "speed"
    push: str = "force"


PISTON_CHANNELS = AxisChannels()


@dataclass(frozen=True)
class Finding:
    """One thing about a log.

    Attributes
    ----------
    channel : str
    message : str
        What is found, with figures, and the remedy.
    fault : bool
        The log cannot be used so; otherwise it is worth knowing.
    check : str
        The name of the check that found it, by which a user accepts it.
    """

    channel: str
    message: str
    fault: bool
    check: str = ""
