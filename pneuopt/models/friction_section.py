"""[friction] of a drive's file: which law, and what is wrapped around it."""

from collections.abc import Mapping

from pneuopt.models.declaration import Key, Structure, choice, flag
from pneuopt.models.friction import Asymmetric, Coulomb, FrictionModel, LuGre, PressureDependent, Stribeck, Viscous
from pneuopt.quantities.errors import check_names

FRICTION_KEYS: Mapping[str, Key] = {
    "model": choice({"viscous": Viscous, "coulomb": Coulomb, "stribeck": Stribeck, "lugre": LuGre}),
    "asymmetric": flag(False),
    "pressure_dependent": Key("true, false or a list", (bool, list), False),
}
CHAMBER_PRESSURES = ("pressure_a", "pressure_b")


def read_friction(said: Structure) -> FrictionModel:
    """The friction that [friction] describes."""
    options = said.options("friction")
    law: FrictionModel = options["model"]()
    if options["asymmetric"]:
        law = Asymmetric(law)
    dependent = options["pressure_dependent"]
    if not dependent:
        return law
    chambers = CHAMBER_PRESSURES if dependent is True else tuple(dependent)
    check_names("chamber", chambers, CHAMBER_PRESSURES, said.place("friction", "pressure_dependent"))
    return PressureDependent(law, chambers)
