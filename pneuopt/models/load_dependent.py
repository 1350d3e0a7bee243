"""Friction that grows with the force that a gear or a guide transmits."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from pneuopt.dynamics.excitation import Excitation, SeparatingRun
from pneuopt.dynamics.system import Symbols
from pneuopt.models.friction import Force, FrictionModel, check_coulomb_level, raise_levels
from pneuopt.models.friction_start import FrictionSamples, FrictionStart
from pneuopt.models.needs import FRICTION_LEVELS
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity


@dataclass(frozen=True)
class LoadDependent:
    """A base model whose Coulomb and static levels rise with the transmitted force F: + coulomb_load |F|, |F| smooth.

    ``|F| = sqrt(F^2 + load_rounding^2) - load_rounding``: zero without load, and never more than the exact value. F
    drives the load: the input of a `ForceDrive`, the torque of a `RotaryDrive`. For gears of servos coulomb_load is
    0.01 to 0.2.

    Source: Hamon, Gautier, Garrec, Dynamic identification of robots with a dry friction model depending on load and
    velocity, IROS 2010.
    """

    base: FrictionModel

    def __post_init__(self) -> None:
        check_coulomb_level(self.base, "load")

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of the base model."""
        return self.base.states

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Inputs of the base model, and the transmitted force [N]."""
        return (*self.base.inputs, Quantity("force", "N", nominal=100.0))

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the base model, coulomb_load [1] and load_rounding [N]."""
        added = {
            "coulomb_load": Parameter(0.0, "1", lower=0.0, upper=0.9, meaning="Coulomb friction per transmitted force"),
            "load_rounding": Parameter(
                1.0,
                "N",
                lower=1e-3,
                upper=1e3,
                log=True,
                meaning="force over which the transmitted force's size is rounded",
            ),
        }
        return self.base.parameters | ParameterSet(added)

    @property
    def excitation(self) -> Excitation:
        """Excitation of the base model, and loads that differ."""
        words = "log sliding under a load that is known and large: a weight lifted and lowered, or a spring"
        others = FRICTION_LEVELS | {"viscous", "load.mass", "load.inertia"}
        return Excitation(runs=(SeparatingRun(frozenset({"coulomb_load"}), others, words),)) | self.base.excitation

    @property
    def start(self) -> FrictionStart:
        """Start of the base model, with levels that are linear in the absolute force."""
        base = self.base.start

        def columns(s: FrictionSamples) -> dict[str, Array]:
            rounding = s.values["load_rounding"]
            size = np.sqrt(s.inputs["force"] ** 2 + rounding**2) - rounding
            return base.columns(s) | {"coulomb_load": s.side * size}

        return replace(base, columns=columns, unknowns=(*base.unknowns, "coulomb_load"))

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force of the base model with raised levels; see the class."""
        size = ca.sqrt(u["force"] ** 2 + p["load_rounding"] ** 2) - p["load_rounding"]
        return self.base.force(v, z, u, raise_levels(p, p["coulomb_load"] * size))
