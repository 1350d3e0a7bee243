"""Karnopp's dry friction: the piston sticks, or slides one way; for simulation, which switches between the three.

`ForceDrive(Karnopp(Stribeck())).system()` goes wherever a plant goes; `simulate` sees its "friction.direction" and
locates each break-away and standstill. A solver that does not switch it sees no dry friction at all.
"""

from dataclasses import dataclass

import casadi as ca

from pneuopt.dynamics.excitation import Excitation
from pneuopt.dynamics.system import Symbols
from pneuopt.models.friction import Force, FrictionModel
from pneuopt.models.friction_start import FrictionStart
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

SMOOTHING_WIDTHS = ("smoothing", "asymmetry_width")


@dataclass(frozen=True)
class Karnopp:
    r"""The limit of a smooth map without smoothing: sgn(v) is the parameter `direction`, and 0 where the piston sticks.

    .. math:: F = g(v) \, d + \sigma_2 v, \quad d = \pm 1; \qquad |F| \le F_s \text{ at rest}

    Asymmetry and pressure dependence follow the direction likewise. Source: Karnopp, J. Dyn. Sys. Meas. Control 107(1),
    1985, but with events in place of his zone of small speeds.

    Parameters
    ----------
    base : FrictionModel
        Coulomb() or Stribeck(), wrapped or not; its parameters but the smoothing widths are those of this model.

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
        """None."""
        return ()

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Those of the base model."""
        return self.base.inputs

    @property
    def parameters(self) -> ParameterSet:
        """Those of the base but the smoothing widths, and direction [1], which only a simulation sets."""
        kept = {n: p for n, p in self.base.parameters.items() if n not in SMOOTHING_WIDTHS}
        return ParameterSet({**kept, "direction": Parameter(0.0, "1", -1.0, 1.0, source="switched by simulate")})

    @property
    def excitation(self) -> Excitation:
        """What the base needs."""
        return self.base.excitation

    @property
    def start(self) -> FrictionStart:
        """That of the base."""
        return self.base.start

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """See the class."""
        return self.base.force(v, z, u, p)
