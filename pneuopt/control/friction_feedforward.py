"""`FrictionFeedforward`: the command that overcomes Coulomb friction, in the direction of the motion."""

from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import LEAST_SMOOTHING, Instant
from pneuopt.control.sensor import REFERENCE_SPEED, SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

DIRECTION_SMOOTHING = 1e-3  # [measured unit] default: m/s or rad/s; a small one chatters about rest, a large one gives
# slow motions too little


class Direction(Enum):
    """Whose direction counts: the reference's, which adds no feedback, or the measured speed's, which is feedback."""

    REFERENCE = "reference"
    MEASURED = "measured"


@dataclass(frozen=True)
class FrictionFeedforward:
    """``u_f = level tanh(v/smoothing)``: what Coulomb friction takes, v the speed wanted or the speed measured.

    The level is a command: of a force the Coulomb friction itself, of a valve the voltage that moves the drive just so
    far as to slip. The reference's direction is known without noise and leaves the loop as it was, but pushes a
    reference of zero nowhere; the measured one follows every reversal, and is positive feedback with the gain
    level/smoothing at rest, which the margins count: more than the friction's own slope there, and the loop hunts.
    In a loop of the position the reference's direction is that of the input "reference_speed".
    H. Olsson, K. J. Åström, C. Canudas de Wit, M. Gäfvert & P. Lischinsky, Friction models and friction compensation,
    Eur. J. Control 4 (1998) 176-195, section 5.

    Parameters
    ----------
    direction : Direction
    """

    direction: Direction = Direction.REFERENCE
    section: ClassVar[str] = "friction_feedforward"
    size: ClassVar[str] = "level"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        known = ", ".join(str(d) for d in Direction)
        require(
            isinstance(self.direction, Direction),
            f"FrictionFeedforward: direction is one of {known}, got {self.direction!r}",
        )

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse the measured direction in a loop whose PID sees a position, which has no direction of motion."""
        told = "FrictionFeedforward: a PID of the position measures no direction of motion; take Direction.REFERENCE"
        require(self.direction is Direction.REFERENCE or on.order != 0, told, ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The level [unit], zero by default, and the speed within which the sign turns over [measured unit].

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, None)
        >>> [(n, p.unit) for n, p in FrictionFeedforward().parameters(on, "V").items()]
        [('level', 'V'), ('smoothing', 'm/s')]
        """
        within = Parameter(
            DIRECTION_SMOOTHING,
            on.speed_unit,
            lower=LEAST_SMOOTHING,
            meaning="speed within which the added command turns its sign",
        )
        return ParameterSet(
            {
                "level": Parameter(0.0, unit, lower=0.0, meaning="command that Coulomb friction takes"),
                "smoothing": within,
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """The reference's speed where it is a position and its direction counts."""
        return on.speed_input if self.direction is Direction.REFERENCE else ()

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """None."""
        return ()

    def start(self, _on: SensedSignal, _seen: Instant) -> list[Any]:
        """No states."""
        return []

    def act(self, seen: Instant, _x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """No states, and u_f [the command's unit]."""
        wanted = seen.rates.get(REFERENCE_SPEED, seen.reference)
        speed = seen.measured if self.direction is Direction.MEASURED else wanted
        return {}, p["level"] * ca.tanh(speed / p["smoothing"])
