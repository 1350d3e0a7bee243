"""`AccelerationFeedback`: feedback of the acceleration, as filtered differences of the measured signal show it."""

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import Instant
from pneuopt.control.sensor import SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.unit_algebra import unit_ratio

DERIVATIVE_FILTER_TIME = 5e-3  # [s] default: a short one passes an encoder's counts, a long one delays what shall damp
MIN_FILTER_TIME = 1e-4  # [s]; below, the loop is too stiff to integrate, and a difference over a sample is all counts


@dataclass(frozen=True)
class AccelerationFeedback:
    """Feedback ``u_a = -gain a`` of the signal's filtered derivative a: of a speed the first, of a position the second.

    Each derivative is ``(s - f)/filter`` with ``df/dt = (s - f)/filter``; with a sampled PID, h its sample time,
    ``f = (filter f_ + h s)/(filter + h)``, the suffix _ the sample before (backward Euler). It damps a piston on its
    air where no pressures are measured; counts of an encoder of the position are divided by filter squared.

    J. Wang, J. Pu & P. Moore, A practical control strategy for servo-pneumatic actuator systems, Control Eng. Practice
    7 (1999) 1483-1488.
    """

    section: ClassVar[str] = "acceleration_feedback"
    size: ClassVar[str] = "gain"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a PID of neither position nor speed."""
        told = f"AccelerationFeedback differentiates a motion, and {on.measured.name!r} is neither position nor speed"
        require(on.order is not None, f"{told}; leave it out", ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The gain, zero by default, and the filter's time constant [s].

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, None)
        >>> [(n, p.unit) for n, p in AccelerationFeedback().parameters(on, "V").items()]
        [('gain', 'V*s^2/m'), ('filter', 's')]
        """
        return ParameterSet(
            {
                "gain": Parameter(
                    0.0, unit_ratio(f"{unit}*s", on.speed_unit), meaning="command taken back per acceleration"
                ),
                "filter": Parameter(
                    DERIVATIVE_FILTER_TIME,
                    "s",
                    lower=MIN_FILTER_TIME,
                    meaning="time constant of each derivative's filter",
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing beside the loop's own signal."""
        return ()

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """What each derivative subtracts: the filtered speed, and before it, of a position, the filtered position."""
        speed = Quantity("speed", on.speed_unit)
        return (Quantity("position", on.measured.unit, on.measured.nominal), speed) if on.order == 0 else (speed,)

    def start(self, on: SensedSignal, seen: Instant) -> list[Any]:
        """The measured signal so far; a position has stood still."""
        return [seen.measured, 0.0] if on.order == 0 else [seen.measured]

    def act(self, seen: Instant, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states' rates or next values, and u_a [the command's unit]."""
        moved, signal, h, time = Signals(), seen.measured, seen.elapsed, p["filter"]
        fed_back = ca.SX(0)
        for name, before in x.items():
            now = before if h is None else (time * before + h * signal) / (time + h)
            fed_back = (now - signal) / time
            signal = (signal - now) / time
            moved[name] = signal if h is None else now
        return moved, p["gain"] * fed_back
