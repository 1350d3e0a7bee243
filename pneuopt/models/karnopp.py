"""Karnopp's dry friction for simulation: the piston sticks, or slides one way or the other.

`ForceDrive(Karnopp(Stribeck())).system()` is a plant like any other. `simulate` switches its "friction.direction" and
locates each break-away and standstill; a solver that leaves the direction at zero simulates no dry friction at all.
"""

from dataclasses import dataclass

import casadi as ca

from pneuopt.dynamics.hooks import IdentificationHints
from pneuopt.dynamics.system import Symbols
from pneuopt.models.friction import Force, FrictionModel, FrictionStart
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity


@dataclass(frozen=True)
class Karnopp:
    r"""A static friction map without smoothing: the parameter `direction` is sgn(v), and 0 where the piston sticks.

    .. math:: F = g(v) \, d + \sigma_2 v, \quad d = \pm 1; \qquad |F| \le F_s \text{ at rest}

    Asymmetry and pressure dependence use the direction likewise. Source: Karnopp, J. Dyn. Sys. Meas. Control 107(1),
    1985, but with events in place of his zone of small speeds.

    Parameters
    ----------
    base : FrictionModel
        Coulomb() or Stribeck(), wrapped or not; its parameters, except the smoothing widths, are those of this model.

    Raises
    ------
    ModelError
        If the base has internal states (LuGre has no standstill to locate) or no Coulomb level.
    """

    base: FrictionModel

    def __post_init__(self) -> None:
        suited = not self.base.states and "smoothing" in self.base.parameters
        message = f"Karnopp needs a static map with a Coulomb level, Coulomb() or Stribeck(); {self.base} is not one"
        require(suited, message, ModelError)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """No states."""
        return ()

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Inputs of the base model."""
        return self.base.inputs

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the base without smoothing widths, and direction [1], which only a simulation sets."""
        kept = {n: p for n, p in self.base.parameters.items() if n not in ("smoothing", "asymmetry_width")}
        return ParameterSet({**kept, "direction": Parameter(0.0, "1", -1.0, 1.0, source="switched by simulate")})

    @property
    def identification_hints(self) -> IdentificationHints:
        """Those of the base model."""
        return self.base.identification_hints

    @property
    def start(self) -> FrictionStart:
        """Start of the base model."""
        return self.base.start

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force of the base model with this direction; see the class."""
        return self.base.force(v, z, u, p)
