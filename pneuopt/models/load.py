"""The load that a drive moves: mass, a constant force, a spring."""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from pneuopt.parameters import Parameter, ParameterSet

Symbols = Mapping[str, ca.SX]


@dataclass(frozen=True)
class Load:
    """Mass, a constant force against positive motion, perhaps a spring: M dv/dt = F - friction - force - k (y - y_0).

    Parameters
    ----------
    spring : bool
        Whether a spring acts; its stiffness and rest position are parameters then.
    """

    spring: bool = False

    @property
    def parameters(self) -> ParameterSet:
        """Numbers: mass [kg], force [N]; with a spring: stiffness [N/m], rest_position [m]."""
        own = {
            "mass": Parameter(5.0, "kg", lower=1e-3, upper=1e5, log=True),
            "force": Parameter(0.0, "N", lower=-1e5, upper=1e5),
        }
        spring = {
            "stiffness": Parameter(0.0, "N/m", lower=0.0, upper=1e8),
            "rest_position": Parameter(0.0, "m"),
        }
        return ParameterSet({**own, **(spring if self.spring else {})})

    def acceleration(self, driving: ca.SX, position: ca.SX, p: Symbols) -> ca.SX:
        """Acceleration [m/s^2] under a driving force net of friction [N] at a position [m]."""
        pull = p["stiffness"] * (position - p["rest_position"]) if self.spring else 0
        return (driving - p["force"] - pull) / p["mass"]
