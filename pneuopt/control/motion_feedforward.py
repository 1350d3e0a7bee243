"""`MotionFeedforward`: the command that the reference's speed and acceleration take."""

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import Instant
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.unit_algebra import unit_ratio


@dataclass(frozen=True)
class MotionFeedforward:
    """``u_m = speed v_r + acceleration a_r``: what an axis takes to follow a reference of speed v_r, acceleration a_r.

    A valve that lets a piston move with the speed G u [m/s] at the command u takes ``speed = 1/G``; the acceleration's
    gain makes up for the lag until the chambers have filled. Both see the reference alone, so margins do not change.
    A loop of the position has the inputs "reference_speed" and "reference_acceleration" for them, one of the speed the
    latter, its reference being the speed. A step has neither rate: there the part adds nothing.

    The usual feedforward of a servo axis: K. J. Åström and T. Hägglund, Advanced PID Control, ISA 2006, chapter 5.
    """

    section: ClassVar[str] = "motion_feedforward"
    size: ClassVar[str] = "speed"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a loop of neither position nor speed."""
        told = f"MotionFeedforward follows a motion, and {on.measured.name!r} is neither a position nor a speed"
        require(on.order is not None, f"{told}; leave it out", ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The gains on speed and acceleration, zero by default.

        Examples
        --------
        >>> on = SensedSignal(Quantity("position", "m"), {}, None, order=0)
        >>> [(n, p.unit) for n, p in MotionFeedforward().parameters(on, "V").items()]
        [('speed', 'V*s/m'), ('acceleration', 'V*s^2/m')]
        """
        speed = on.speed_unit
        return ParameterSet(
            {
                "speed": Parameter(0.0, unit_ratio(unit, speed), meaning="command per speed of the reference"),
                "acceleration": Parameter(
                    0.0,
                    unit_ratio(f"{unit}*s", speed),
                    meaning="command per acceleration of the reference",
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """The reference's acceleration, and where it is a position its speed."""
        return (*on.speed_input, REFERENCE_ACCELERATION)

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """None."""
        return ()

    def start(self, _on: SensedSignal, _seen: Instant) -> list[Any]:
        """No states."""
        return []

    def act(self, seen: Instant, _x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """No states, and u_m [the command's unit]."""
        speed = seen.rates.get(REFERENCE_SPEED, seen.reference)
        return {}, p["speed"] * speed + p["acceleration"] * seen.rates[REFERENCE_ACCELERATION]
