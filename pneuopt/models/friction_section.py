"""Section [friction] of a drive's file: the law and its wrappers."""

from collections.abc import Mapping
from dataclasses import replace

from pneuopt.models.declaration import DriveSections
from pneuopt.models.friction import FrictionModel, Stribeck
from pneuopt.models.friction_laws import FRICTION_LAWS, FRICTION_WRAPPERS
from pneuopt.quantities.errors import check_names
from pneuopt.quantities.keys import Key, Takes, choice, flag

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
