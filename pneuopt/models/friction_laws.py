"""The registry of friction laws, a row each, for files, model selection (`friction_ladder`) and the table test.

A row is a law's name in files and its class, which declares everything else (see `FrictionModel`). Below the rows stand
the keys of section [friction] of a drive's file.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from pneuopt.models.declaration import DriveSections
from pneuopt.models.friction import (
    CHAMBER_PRESSURES,
    Asymmetric,
    Coulomb,
    FrictionModel,
    LoadDependent,
    LuGre,
    Presliding,
    PressureDependent,
    Stribeck,
    Viscous,
)
from pneuopt.quantities.errors import check_names
from pneuopt.quantities.keys import Key, Takes, choice, flag


@dataclass(frozen=True)
class Wrapper:
    """A law that wraps another law."""

    wrap: Callable[..., FrictionModel]  # (inner law) or, with options, (inner law, tuple of options) -> law
    meaning: str
    option: str = ""  # an option's name in messages, "chamber"
    options: tuple[str, ...] = ()  # those it takes; all of them where none is given


FRICTION_LAWS: Mapping[str, Callable[[], FrictionModel]] = {
    "viscous": Viscous,
    "coulomb": Coulomb,
    "presliding": Presliding,
    "stribeck": Stribeck,
    "lugre": LuGre,
}
"""Basic laws from the simplest to the richest: `model = "coulomb"` in a file."""

FRICTION_WRAPPERS: Mapping[str, Wrapper] = {
    "asymmetric": Wrapper(Asymmetric, "whether friction differs between the directions"),
    "load_dependent": Wrapper(LoadDependent, "whether friction rises with the transmitted force, as a gear's does"),
    "pressure_dependent": Wrapper(
        PressureDependent, "whether friction rises with both pressures, or a list of them", "chamber", CHAMBER_PRESSURES
    ),
}
"""Laws that wrap another law, the innermost first: `asymmetric = true` in a file."""


def friction_ladder() -> dict[str, FrictionModel]:
    """Friction laws by name, from the simplest to the richest: candidates for `select_model`.

    Static laws with a Coulomb level are there also with each wrapper that needs no further signal.
    """
    ladder: dict[str, FrictionModel] = {}
    for name, law in FRICTION_LAWS.items():
        ladder[name] = law()
        if "coulomb" in law().parameters and not law().states:
            wrapped = {f"{how} {name}": wrapper.wrap(law()) for how, wrapper in FRICTION_WRAPPERS.items()}
            ladder |= {n: model for n, model in wrapped.items() if not model.inputs}
    return ladder


def usual_unknowns() -> tuple[str, ...]:
    """Parameters that a comparison of these laws estimates, as a drive names them."""
    unknowns = (f"friction.{n}" for law in friction_ladder().values() for n in law.start.unknowns)
    return tuple(dict.fromkeys(unknowns))


FRICTION_KEYS: Mapping[str, Key] = {
    "model": choice("friction law", FRICTION_LAWS),
    **{
        name: replace(flag(wrapper.meaning), takes=Takes.FLAG_OR_LIST if wrapper.options else Takes.FLAG)
        for name, wrapper in FRICTION_WRAPPERS.items()
    },
}
STRIBECK_UNKNOWNS = tuple(f"friction.{n}" for n in Stribeck().start.unknowns)
"""Parameters of the usual law that logs give, as a drive names them."""


def read_friction(sections: DriveSections) -> FrictionModel:
    """Build the friction law that [friction] describes."""
    options = sections.options("friction")
    law: FrictionModel = options["model"]()
    for name, wrapper in FRICTION_WRAPPERS.items():
        if isinstance(options[name], list) and options[name]:
            check_names(wrapper.option, options[name], wrapper.options, sections.place("friction", name))
            law = wrapper.wrap(law, tuple(options[name]))
        elif options[name]:
            law = wrapper.wrap(law)
    return law
