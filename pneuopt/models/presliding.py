"""Presliding friction as a map of the speed: friction that yields a little before it slides."""

from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca

from pneuopt.dynamics.excitation import Excitation, SeparatingRun
from pneuopt.dynamics.system import Symbols
from pneuopt.models.friction import Coulomb, Force
from pneuopt.models.friction_start import FrictionStart
from pneuopt.models.needs import COULOMB_EXCITATION
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

# least presliding speed [m/s]: below it friction is as sharp as that of `Coulomb`, and takes many integration steps;
# above it the yielding of stiff drives is missed
MIN_PRESLIDING_SPEED = 3e-4
SLOW_REVERSALS = SeparatingRun(
    frozenset({"presliding_speed"}),
    frozenset({"static", "stribeck_velocity", "bristle_stiffness", "bristle_damping", "coulomb", "viscous"}),
    "log slow reversals, with many samples while the speed changes its sign",
)
PRESLIDING_EXCITATION = replace(COULOMB_EXCITATION, runs=(SLOW_REVERSALS, *COULOMB_EXCITATION.runs), widths=())


@dataclass(frozen=True)
class Presliding:
    """F = coulomb * tanh(v / presliding_speed) + viscous * v.

    The speed over which friction builds up is a property of the drive, and estimated: bristles that yield, a belt, a
    sensor beside the contact. In `Coulomb` it is a means of integration, and as small as that allows.
    """

    excitation: ClassVar[Excitation] = PRESLIDING_EXCITATION
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: coulomb [N], viscous [N*s/m], presliding_speed [m/s]."""
        base = Coulomb().parameters
        speed = Parameter(
            3e-3, "m/s", lower=MIN_PRESLIDING_SPEED, upper=0.1, log=True, meaning="speed over which friction builds up"
        )
        return base.select(n for n in base if n != "smoothing") | ParameterSet({"presliding_speed": speed})

    @property
    def start(self) -> FrictionStart:
        """Regression of `Coulomb`; the presliding speed begins at its given value."""
        base = Coulomb().start
        return FrictionStart(base.columns, (*base.unknowns, "presliding_speed"), base.floors)

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force and the rates of the states; see the class."""
        return Coulomb().force(v, z, u, {**p, "smoothing": p["presliding_speed"]})
