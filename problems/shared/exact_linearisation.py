"""`ExactLinearisation`: the rival of P32 that knows the nominal drive and cancels its nonlinearities.

After J. Wang, Ü. Kotta & J. Ke, Tracking control of nonlinear pneumatic actuator systems using static state feedback
linearization of the input-output map, Proc. Estonian Acad. Sci. Phys. Math. 56 (2007) 47-66,
doi:10.3176/phys.math.2007.1.04: the valve of five ports is commanded so that position, speed and the force of both
pressures follow a linear third-order system. Its poles are placed here by three gains in series, of the position, of
the speed and of the force, and static friction, which they leave out at first, is added as a feedforward.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

import pneuopt as po
from pneuopt.control.compensators import ControllerSnapshot
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, SensedSignal, Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.models.pneumatic.cylinder import areas, volumes
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.units import ANR_DENSITY

MOST_LEARNED = 200.0  # [N] beyond the nominal friction: a collision would teach more
LEAST_FALL = (
    1e-3  # of the flow's factor [1]: at equal pressures no opening gives a flow, and its root has no derivative
)


@dataclass(frozen=True, eq=False)
class ExactLinearisation:
    """The voltage that lets the pressures' force F follow ``F' = force_gain (F_r - F)`` on the nominal drive.

    ``F_r = M (a_r + speed_gain (w - v)) + viscous v_r + friction (1 + rise exp(-(v_r/v_s)^2)) tanh(v_r/smoothing)``,
    w being the cascade's speed, ``position_loop.Kp (r - y) + v_r``. The force's rate is ``n (A_a R T m_a/V_a - A_b R T
    m_b/V_b) - stiffness v`` with the mass flows m of edges of the opening u, from which u follows. Dead zone and spool
    are left out.

    With adaptation friction and mass begin there and follow ``d(friction)/dt = adaptation (w - v) sign(v_r)`` and
    ``dM/dt = mass_adaptation (w - v) a_r``: the gradient law of J.-J. E. Slotine & W. Li, Applied Nonlinear Control,
    Prentice Hall 1991, section 9.2. It is an integral for the sliding piston that knows which way friction acts, keeps
    what it has learned for the way back, and stands still where the reference does, so that it cannot hunt.

    Parameters
    ----------
    drive : ParameterSet
        The nominal one.
    """

    drive: po.ParameterSet
    adapts: bool = False
    section: ClassVar[str] = "exact_linearisation"
    size: ClassVar[str] = "force_gain"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """It needs a cascade."""
        assert on.cascade

    def parameters(self, _on: SensedSignal, _unit: str) -> ParameterSet:
        """The gains [1/s], the friction [N], the speed within which its sign turns [m/s], its rise towards rest [1].

        The adaptation [N/m],
        And the speed of the reference about which margins linearise [m/s], zero where the loop runs.
        """
        units = {"speed_gain": "1/s", "force_gain": "1/s", "friction": "N", "smoothing": "m/s", "rise": "1"}
        units |= {"adaptation": "N/m", "mass_adaptation": "kg*s^2/m^2", "sliding": "m/s"} if self.adapts else {}
        return ParameterSet({n: Parameter(1e-3 if n == "smoothing" else 0.0, u, lower=0.0) for n, u in units.items()})

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """The position and both pressures."""
        return "position", "pressure_a", "pressure_b"

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """Speed and acceleration of the reference."""
        return REFERENCE_SPEED, REFERENCE_ACCELERATION

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """What has been learned of the friction, and of the mass."""
        return (Quantity("friction", "N", 10.0), Quantity("mass", "kg")) if self.adapts else ()

    def start(self, _on: SensedSignal, _seen: ControllerSnapshot) -> list[Any]:
        """Nothing so far."""
        return [0.0, 0.0] if self.adapts else []

    def act(self, seen: ControllerSnapshot, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """What is learned after the sample, and the voltage."""
        known: dict[str, Any] = {n: self.drive.value(n) for n in self.drive}
        y, a, b = (seen.readings[n] for n in ("position", "pressure_a", "pressure_b"))
        v, wanted = seen.measured, seen.rates[REFERENCE_SPEED]
        area_a, area_b = areas(known["cylinder.bore"], known["cylinder.rod"])
        ambient, supply, n = known["ambient.pressure"], known["supply.pressure"], known["chamber.exponent"]
        force = area_a * (a - ambient) - area_b * (b - ambient)
        acceleration = seen.rates[REFERENCE_ACCELERATION] + p["speed_gain"] * (seen.reference - v)
        moved, level, inertia = Signals(), p["friction"], 0.0
        about = wanted + (p["sliding"] if self.adapts else 0.0)
        way = ca.tanh(about / p["smoothing"])
        if self.adapts:
            seconds, lag = seen.sample_time or 0.0, seen.reference - v
            learned = x["friction"] + seconds * p["adaptation"] * lag * way
            moved["friction"] = ca.fmin(ca.fmax(learned, -p["friction"]), MOST_LEARNED)
            mass = x["mass"] + seconds * p["mass_adaptation"] * lag * seen.rates[REFERENCE_ACCELERATION]
            moved["mass"] = ca.fmin(ca.fmax(mass, -0.6 * known["load.mass"]), 2 * known["load.mass"])
            level, inertia = level + learned, mass * seen.rates[REFERENCE_ACCELERATION]
        rise = 1 + p["rise"] * ca.exp(-((about / known["friction.stribeck_velocity"]) ** 2))
        friction = known["friction.viscous"] * wanted + level * rise * way
        rate = p["force_gain"] * (known["load.mass"] * acceleration + inertia + friction - force)
        volume_a, volume_b = volumes(y, without_prefix(known, "cylinder"))
        needed = rate + n * (area_a**2 * a / volume_a + area_b**2 * b / volume_b) * v

        def flow(upstream: Any, downstream: Any) -> Any:
            fall = (downstream / upstream - known["valve.critical_ratio"]) / (1 - known["valve.critical_ratio"])
            choked = known["valve.conductance"] * ANR_DENSITY * upstream
            return choked * ca.sqrt(ca.fmax(1 - ca.fmax(fall, 0) ** 2, LEAST_FALL))

        heat = n * known["gas.constant"] * known["ambient.temperature"]
        into, out_of = area_a * heat / volume_a, area_b * heat / volume_b
        forwards = into * flow(supply, a) + out_of * flow(b, ambient)
        backwards = into * flow(a, ambient) + out_of * flow(supply, b)
        opening = needed / ca.if_else(needed > 0, forwards, backwards)
        return moved, known["valve.span"] * opening
