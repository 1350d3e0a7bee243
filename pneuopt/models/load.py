"""The load that a drive moves: mass, a constant force, its weight on an incline, a spring."""

from dataclasses import dataclass
from math import pi

import casadi as ca

from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.keys import flag
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

GRAVITY = 9.80665  # standard acceleration of gravity, 3rd CGPM, 1901 [m/s^2]
LOAD_FORCE = Quantity("load_force", "N", nominal=100.0)
LOAD_KEYS = {
    "spring": flag("whether a spring acts on the load"),
    "inclined": flag("whether positive motion goes up an incline"),
}
"""Keys of section [load] of a drive's file: the arguments of `Load`."""


@dataclass(frozen=True)
class Load:
    """Mass, a constant force against positive motion, perhaps a spring and an incline.

    M dv/dt = F - friction - force - k (y - y_0) - M g sin(inclination).

    Parameters
    ----------
    spring : bool
        Whether a spring acts; its stiffness and rest position are parameters then.
    inclined : bool
        Whether positive motion goes up an incline; its angle is a parameter then.
    """

    spring: bool = False
    inclined: bool = False

    @property
    def parameters(self) -> ParameterSet:
        """Mass [kg], force [N]; with a spring stiffness [N/m], rest_position [m]; inclined: inclination [rad]."""
        always = {
            "mass": Parameter(
                5.0, "kg", lower=1e-3, upper=1e5, log=True, meaning="mass that moves, piston and rod included"
            ),
            "force": Parameter(0.0, "N", lower=-1e5, upper=1e5, meaning="constant force against positive motion"),
        }
        spring = {
            "stiffness": Parameter(0.0, "N/m", lower=0.0, upper=1e8, meaning="stiffness of the spring on the load"),
            "rest_position": Parameter(0.0, "m", meaning="position at which the spring is relaxed"),
        }
        incline = {
            "inclination": Parameter(
                pi / 2, "rad", lower=-pi / 2, upper=pi / 2, meaning="angle by which positive motion goes up"
            )
        }
        return ParameterSet({**always, **(spring if self.spring else {}), **(incline if self.inclined else {})})

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """With a spring "load_force" [N], with which the piston presses on it: what a load cell there reads."""
        return (LOAD_FORCE,) if self.spring else ()

    def spring_force(self, position: ca.SX, p: Symbols) -> ca.SX:
        """Force [N] on the spring at a position [m]; 0 without one."""
        return p["stiffness"] * (position - p["rest_position"]) if self.spring else ca.SX(0)

    def acceleration(self, driving: ca.SX, position: ca.SX, p: Symbols) -> ca.SX:
        """Acceleration [m/s^2] at a position [m] under a driving force less friction [N]."""
        weight = GRAVITY * ca.sin(p["inclination"]) if self.inclined else 0
        return (driving - p["force"] - self.spring_force(position, p)) / p["mass"] - weight
