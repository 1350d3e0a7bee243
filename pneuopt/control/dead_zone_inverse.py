"""`DeadZoneInverse`: a valve's dead zone added back to the command."""

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import LEAST_SMOOTHING, Instant
from pneuopt.control.sensor import SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

COMMAND_SMOOTHING = (
    0.02  # [command's unit] default: a small one jumps about zero, a large one leaves a part of the zone
)


@dataclass(frozen=True)
class DeadZoneInverse:
    """``u = v + width tanh(v/smoothing)``: beyond its edge a valve with that dead zone answers v as if it had none.

    Its slope ``1 + width/smoothing (1 - tanh^2(v/smoothing))`` multiplies the loop's gain: 1 outside, 1 +
    width/smoothing at v = 0, where the dead zone's own slope is next to nothing. Margins count it at their operating
    point. A width beyond the true one makes the loop swing about zero; a smoothing well below the noise in v makes the
    spool chatter. G. Tao & P. V. Kokotović, Adaptive control of systems with actuator and sensor nonlinearities
    (Wiley 1996), have the inverse without the smoothing, and how to adapt its width.
    """

    section: ClassVar[str] = "dead_zone_inverse"
    size: ClassVar[str] = "width"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, _on: SensedSignal, _axis: Axis | None) -> None:
        """It fits any loop."""

    def parameters(self, _on: SensedSignal, unit: str) -> ParameterSet:
        """Half the dead zone's width, zero by default, and the command within which the sign turns over [unit]."""
        within = Parameter(
            COMMAND_SMOOTHING, unit, lower=LEAST_SMOOTHING, meaning="command within which what is added turns its sign"
        )
        return ParameterSet(
            {
                "width": Parameter(0.0, unit, lower=0.0, meaning="half the valve's dead zone, added to the command"),
                "smoothing": within,
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """None."""
        return ()

    def start(self, _on: SensedSignal, _seen: Instant) -> list[Any]:
        """No states."""
        return []

    def act(self, seen: Instant, _x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """No states, and what it adds [the command's unit]."""
        return {}, p["width"] * ca.tanh(seen.command / p["smoothing"])
