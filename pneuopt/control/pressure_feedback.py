"""`PressureFeedback`: feedback of the differential pressure, which damps what the air's compressibility lets swing."""

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import Instant
from pneuopt.control.sensor import SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.unit_algebra import difference_unit, unit_ratio

PRESSURES = ("pressure_a", "pressure_b")
PASSED_TIME = 0.1  # [s] default: a short one passes nothing of a slow drive's swing, a long one shifts a loaded rest
MIN_PASSED_TIME = 1e-6  # [s]; below, the loop is too stiff to integrate
PRESSURE_NOMINAL = 1e5  # [Pa] a usual differential pressure, which scales the state


@dataclass(frozen=True)
class PressureFeedback:
    """High-passed feedback of ``d = p_a - p_b``: ``u_p = -gain (d - slow)`` with ``d(slow)/dt = (d - slow)/time``.

    The differential pressure is the piston's acceleration but for friction and load, and comes without differentiating
    an encoder: the usual third state of a servo-pneumatic axis beside position and speed. The high-pass takes away what
    holds a load, so that the rest stays where it was; time is long against the piston's swing, and a very long one is
    the plain state feedback about the pressures of the start.

    With a sampled PID, h its sample time: ``slow = (time slow_ + h d)/(time + h)``, the suffix _ the sample before.

    J. Wang, J. Pu & P. Moore, A practical control strategy for servo-pneumatic actuator systems, Control Eng. Practice
    7 (1999) 1483-1488, have acceleration feedback for the same purpose.
    """

    section: ClassVar[str] = "pressure_feedback"
    size: ClassVar[str] = "gain"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, _on: SensedSignal, _axis: Axis | None) -> None:
        """It fits any loop whose plant has the pressures."""

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The gain, zero by default, and the high-pass's time constant [s].

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, None)
        >>> [(n, p.unit) for n, p in PressureFeedback().parameters(on, "V").items()]
        [('gain', 'V/Pa'), ('time', 's')]
        """
        gain = unit_ratio(unit, difference_unit(_pressure(on).unit))
        return ParameterSet(
            {
                "gain": Parameter(0.0, gain, meaning="command taken back per differential pressure"),
                "time": Parameter(
                    PASSED_TIME, "s", lower=MIN_PASSED_TIME, meaning="time in which a steady pressure is forgotten"
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Both chambers' pressures."""
        return PRESSURES

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """The slow part of the differential pressure."""
        return (Quantity("slow", difference_unit(_pressure(on).unit), PRESSURE_NOMINAL),)

    def start(self, _on: SensedSignal, seen: Instant) -> list[Any]:
        """The pressures so far are the slow part."""
        return [_difference(seen)]

    def act(self, seen: Instant, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The slow part's rate or next value, and u_p [the command's unit]."""
        d, h, time = _difference(seen), seen.elapsed, p["time"]
        if h is None:
            return {"slow": (d - x["slow"]) / time}, p["gain"] * (x["slow"] - d)
        slow = (time * x["slow"] + h * d) / (time + h)
        return {"slow": slow}, p["gain"] * (slow - d)


def _difference(seen: Instant) -> Any:
    a, b = (seen.readings[n] for n in PRESSURES)
    return a - b


def _pressure(on: SensedSignal) -> Quantity:
    """The pressure's signal; a list of keys knows no plant."""
    return on.outputs.get(PRESSURES[0], Quantity(PRESSURES[0], "Pa(a)"))
