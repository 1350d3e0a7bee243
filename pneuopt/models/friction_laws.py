"""The registry of friction laws, one row each: what files read, the ladder climbs and the table test runs.

A row is a law's name in files and its class, which declares all else that is known of it (see `FrictionModel`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pneuopt.models.friction import (
    CHAMBER_PRESSURES,
    Asymmetric,
    Coulomb,
    FrictionModel,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
)
from pneuopt.models.load_dependent import LoadDependent


@dataclass(frozen=True)
class Wrapper:
    """A law around another law.

    Parameters
    ----------
    wrap : callable
        From the law inside, and perhaps a tuple of words, to the law.
    option : str
        What the words are, "chamber"; empty where it takes none.
    options : tuple of str
        The words that it takes; without any given, all of them.
    """

    wrap: Callable[..., FrictionModel]
    option: str = ""
    options: tuple[str, ...] = ()


FRICTION_LAWS: Mapping[str, Callable[[], FrictionModel]] = {
    "viscous": Viscous,
    "coulomb": Coulomb,
    "stribeck": Stribeck,
    "lugre": LuGre,
}
"""Laws of their own, from the simplest to the richest: `model = "coulomb"` in a file."""

FRICTION_WRAPPERS: Mapping[str, Wrapper] = {
    "asymmetric": Wrapper(Asymmetric),
    "load_dependent": Wrapper(LoadDependent),
    "pressure_dependent": Wrapper(PressureDependent, "chamber", CHAMBER_PRESSURES),
}
"""Laws around another law, the innermost first: `asymmetric = true` in a file."""


def friction_ladder() -> dict[str, FrictionModel]:
    """From the simplest to the richest, by name: candidates for `select_model`.

    Static laws with a Coulomb level stand there with each wrapper, too, that asks for no signal of its own.
    """
    ladder: dict[str, FrictionModel] = {}
    for name, law in FRICTION_LAWS.items():
        ladder[name] = law()
        if "coulomb" in law().parameters and not law().states:
            wrapped = {f"{how} {name}": wrapper.wrap(law()) for how, wrapper in FRICTION_WRAPPERS.items()}
            ladder |= {n: model for n, model in wrapped.items() if not model.inputs}
    return ladder


def usual_unknowns() -> tuple[str, ...]:
    """The parameters that a comparison of the ladder's laws asks logs for, as a drive names them."""
    unknowns = (f"friction.{n}" for law in friction_ladder().values() for n in law.start.unknowns)
    return tuple(dict.fromkeys(unknowns))
