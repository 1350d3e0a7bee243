"""Section [friction] of a drive's file: the law and its wrappers."""

from collections.abc import Mapping

from pneuopt.models.declaration import Key, Structure, choice, flag
from pneuopt.models.friction import FrictionModel
from pneuopt.models.friction_laws import FRICTION_LAWS, FRICTION_WRAPPERS
from pneuopt.quantities.errors import check_names

_CHOICE = Key("true, false or a list", (bool, list), False)
FRICTION_KEYS: Mapping[str, Key] = {
    "model": choice(FRICTION_LAWS),
    **{name: _CHOICE if wrapper.options else flag(False) for name, wrapper in FRICTION_WRAPPERS.items()},
}


def read_friction(structure: Structure) -> FrictionModel:
    """Build the friction law that [friction] describes."""
    options = structure.options("friction")
    law: FrictionModel = options["model"]()
    for name, wrapper in FRICTION_WRAPPERS.items():
        if isinstance(options[name], list) and options[name]:
            check_names(wrapper.option, options[name], wrapper.options, structure.place("friction", name))
            law = wrapper.wrap(law, tuple(options[name]))
        elif options[name]:
            law = wrapper.wrap(law)
    return law
