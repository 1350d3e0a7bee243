"""The controllers that compete on P32: their loops, what of them is free, and the reference that each follows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array
from problems.shared.exact_linearisation import ExactLinearisation
from problems.shared.p32 import COUNT, LIMIT, SAMPLE_TIME, TOLERANCE, drive
from problems.shared.p32_moves import Profile

Range = tuple[float, float]
COMMAND = {"pid.lower": -LIMIT, "pid.upper": LIMIT}
# Of the reference: [m/s], [m/s^2], [m/s], [m].
MOVE: dict[str, Range] = {"move.speed": (0.2, 1.5), "move.acceleration": (0.5, 8.0)}
MOVE |= {"move.creep_speed": (0.01, 0.1), "move.creep_distance": (1e-4, 0.01), "move.exponent": (0.03, 1.0)}


@dataclass(frozen=True)
class Structure:
    """A controller with its free gains.

    Parameters
    ----------
    loop : callable
        Makes the loop.
    ranges : mapping of str to pair
        Least and greatest value of what is free; searched in its logarithm.
    fixed : mapping of str to float
        Further values.
    step : bool
        Whether it gets the end of the move at once, instead of a move within limits.
    """

    loop: Callable[[], po.ClosedLoop]
    ranges: Mapping[str, Range]
    fixed: Mapping[str, float] = field(default_factory=dict)
    step: bool = False

    def parameters(self) -> po.ParameterSet:
        """Of the loop on the nominal plant, with the fixed values."""
        return self.loop().complete(drive()[1]).with_values({**COMMAND, **gains(self.fixed)})

    def changed(self, change: Callable[[po.ClosedLoop], po.ClosedLoop]) -> "Structure":
        """The same with a loop that a function changes."""
        return replace(self, loop=lambda: change(self.loop()))

    def values(self, point: Array) -> dict[str, float]:
        """What a point of the unit cube stands for."""
        low, high = np.log(np.array(list(self.ranges.values()))).T
        return dict(zip(self.ranges, np.exp(low + np.asarray(point) * (high - low)).tolist(), strict=True))

    def point(self, values: Mapping[str, float]) -> Array:
        """The point of the unit cube that stands for values, moved into it."""
        low, high = np.log(np.array(list(self.ranges.values()))).T
        wanted = np.log(np.array([values[n] for n in self.ranges]))
        return np.asarray(np.clip((wanted - low) / (high - low), 0.0, 1.0))

    def profile(self, values: Mapping[str, float]) -> Profile | None:
        """Of its reference."""
        if self.step:
            return None
        own = {**self.fixed, **values}
        return Profile(**{n.removeprefix("move."): v for n, v in own.items() if n.startswith("move.")})


def gains(values: Mapping[str, float]) -> dict[str, float]:
    """The values that are parameters of the loop."""
    return {n: v for n, v in values.items() if not n.startswith("move.")}


def _cascade(*parts: Any) -> po.ClosedLoop:
    pid, encoder = po.PID(SAMPLE_TIME, delay=1), po.Encoder(COUNT, 1e-3)
    return po.ClosedLoop(
        drive()[0].system(), pid, measured="position", outer=po.PositionLoop(), sensor=encoder, compensators=parts
    )


def state_feedback() -> po.ClosedLoop:
    """Position and speed in a cascade, differential pressure, feedforward of motion and friction, dead-zone inverse."""
    parts = (po.MotionFeedforward(), po.FrictionFeedforward(), po.PressureFeedback(), po.DeadZoneInverse())
    return _cascade(*parts)


def cascade() -> po.ClosedLoop:
    """Position P around speed PI, with the feedforward of the speed: an axis controller's usual cascade."""
    return _cascade(po.MotionFeedforward(), po.DeadZoneInverse())


def linearisation() -> po.ClosedLoop:
    """The exact linearisation of the nominal drive, with feedback of the pressures' force."""
    return _cascade(ExactLinearisation(drive()[1]), po.DeadZoneInverse())


def impulsive() -> po.ClosedLoop:
    """The same, with friction and mass that are learned on the way, and pulses where it stops outside the tolerance."""
    return _cascade(ExactLinearisation(drive()[1], adapts=True), po.ImpulsiveControl(), po.DeadZoneInverse())


def impulsive_feedback() -> po.ClosedLoop:
    """The state feedback, with such pulses."""
    parts = (po.MotionFeedforward(), po.FrictionFeedforward(), po.PressureFeedback())
    return _cascade(*parts, po.ImpulsiveControl(), po.DeadZoneInverse())


def pid() -> po.ClosedLoop:
    """A PID on the position."""
    loop = po.PID(SAMPLE_TIME, delay=1)
    return po.ClosedLoop(drive()[0].system(), loop, measured="position", sensor=po.Encoder(COUNT))


INVERSE: dict[str, Range] = {"dead_zone_inverse.width": (0.05, 0.3), "dead_zone_inverse.smoothing": (2e-3, 0.2)}
OUTER: dict[str, Range] = {"position_loop.Kp": (3.0, 80.0), "sensor.filter": (3e-4, 5e-3)}
PRESSURE: dict[str, Range] = {"pressure_feedback.gain": (1e-6, 4e-5), "pressure_feedback.time": (0.01, 2.0)}
AHEAD: dict[str, Range] = {"motion_feedforward.speed": (0.8, 4.0), "motion_feedforward.acceleration": (1e-3, 0.3)}
FRICTION: dict[str, Range] = {"friction_feedforward.level": (1e-3, 1.0), "friction_feedforward.smoothing": (1e-3, 0.1)}
STATES = MOVE | {"pid.Kp": (0.5, 8.0)} | OUTER | AHEAD | FRICTION | PRESSURE | INVERSE
EXACT = MOVE | {
    "exact_linearisation.speed_gain": (10.0, 200.0),
    "exact_linearisation.force_gain": (20.0, 400.0),
    "exact_linearisation.friction": (1.0, 80.0),
    "exact_linearisation.smoothing": (1e-4, 0.05),
    "exact_linearisation.rise": (0.1, 1.5),
} | OUTER | INVERSE  # fmt: skip
LEARNS = {"exact_linearisation.adaptation": (100.0, 2e4), "exact_linearisation.mass_adaptation": (10.0, 2e4)}
PULSES: dict[str, Range] = {"impulsive_control.amplitude": (0.5, 3.5), "impulsive_control.growth": (1.04, 1.2)}
# No pulse comes within what the encoder can tell of the tolerance; a motion that ends short by three tolerances does
# not pass the end where the piston is slow to brake, and leaves the rest to pulses.
WITHIN = {"impulsive_control.tolerance": TOLERANCE - 2 * COUNT, "impulsive_control.limit": LIMIT}
WITHIN |= {"move.short": 3 * TOLERANCE}
BARE = {"pid.Kp": 0.0}  # what the exact linearisation commands is no part of a PID
STRUCTURES: Mapping[str, Structure] = {
    "impulsive": Structure(impulsive, EXACT | LEARNS | PULSES, BARE | WITHIN),
    "impulsive_feedback": Structure(impulsive_feedback, STATES | PULSES, WITHIN),
    "state_feedback": Structure(state_feedback, STATES),
    "cascade": Structure(
        cascade,
        MOVE | {"pid.Kp": (0.5, 8.0), "pid.Ki": (0.1, 100.0), "motion_feedforward.speed": (0.8, 4.0)} | OUTER | INVERSE,
    ),
    "linearisation": Structure(linearisation, EXACT, BARE),
    "pid": Structure(
        pid,
        {"pid.Kp": (1.0, 300.0), "pid.Ki": (0.1, 1000.0), "pid.Kd": (0.05, 20.0), "pid.Tf": (5e-4, 0.02)}
        | {"pid.b": (0.05, 1.0), "pid.c": (0.01, 1.0)},
        step=True,
    ),
}
