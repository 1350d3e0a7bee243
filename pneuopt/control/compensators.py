"""`COMPENSATORS`: the compensators by their section of a tuning's file, where a new one is registered."""

from collections.abc import Mapping
from types import MappingProxyType

from pneuopt.control.acceleration_feedback import AccelerationFeedback
from pneuopt.control.dead_zone_inverse import DeadZoneInverse
from pneuopt.control.friction_feedforward import FrictionFeedforward
from pneuopt.control.impulsive_control import ImpulsiveControl
from pneuopt.control.knocker import Knocker
from pneuopt.control.motion_feedforward import MotionFeedforward
from pneuopt.control.pressure_feedback import PressureFeedback

Kind = (
    type[MotionFeedforward]
    | type[PressureFeedback]
    | type[AccelerationFeedback]
    | type[FrictionFeedforward]
    | type[Knocker]
    | type[ImpulsiveControl]
    | type[DeadZoneInverse]
)
_KINDS: tuple[Kind, ...] = (
    *(MotionFeedforward, PressureFeedback, AccelerationFeedback),
    *(FrictionFeedforward, Knocker, ImpulsiveControl, DeadZoneInverse),
)

# A file's compensators act in this order: the one that inverts the valve comes last, where it sees all but the dither.
COMPENSATORS: Mapping[str, Kind] = MappingProxyType({part.section: part for part in _KINDS})
