"""What a kind of drive declares, so that nobody asks a drive for its type: its TOML kind, its sections and their keys.

A key of a section either says how the drive is built (a `Key`, declared here), or is one of the drive's parameters
("load.mass" is the key mass of [load]), or says a parameter in another way (an `Alias`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from pneuopt.dynamics.system import System
from pneuopt.quantities.errors import InputError, check_names, require

Sections = Mapping[str, Mapping[str, Any]]
"""A drive's file, as written: by section and key."""


class Drive(Protocol):
    """What a drive.toml describes."""

    kind: ClassVar[str]
    """Its name in the registry of drives, and in files."""

    def system(self) -> System:
        """Its equations, with every parameter's default."""
        ...


@dataclass(frozen=True)
class Key:
    """A key that says how a drive is built.

    Parameters
    ----------
    form : str
        What may stand there, as a message says it: "true or false".
    types : tuple of type
    usual : object
        What counts where the file leaves the key out.
    choices : mapping of str to object, optional
        The words that may stand there, and what each means.
    required : bool
        Whether the file has to say it.
    """

    form: str
    types: tuple[type, ...]
    usual: Any = None
    choices: Mapping[str, Any] | None = None
    required: bool = False


def flag(usual: bool) -> Key:
    """A key that is true or false."""
    return Key("true or false", (bool,), usual)


def choice(choices: Mapping[str, Any], usual: str | None = None) -> Key:
    """A key that is one of some words; without a usual one, the file has to say it."""
    return Key("text", (str,), usual, choices, required=usual is None)


@dataclass(frozen=True)
class Alias:
    """A key that says a parameter in another way, as a catalogue's flow says a conductance.

    Parameters
    ----------
    section, key : str
    parameter : str
        What it says; a file holds one of the two.
    uses : tuple of str
        Parameters whose values the conversion needs; one that the drive has not is left out.
    convert : callable
        ``convert(entry, values, where)``: what is written, the values [SI] of `uses`, what the message of an error
        begins with; returns the parameter's value [SI].
    """

    section: str
    key: str
    parameter: str
    uses: tuple[str, ...]
    convert: Callable[[Any, Mapping[str, float], str], float]


@dataclass(frozen=True)
class Structure:
    """How a file says that a drive is built, read key by key against the declared sections.

    Parameters
    ----------
    written : mapping
        The file's sections.
    declared : mapping
        Those of the drive's kind.
    location : callable
        ``location(section, key)``: file and line, for messages.
    """

    written: Sections
    declared: Mapping[str, Mapping[str, Key]]
    location: Callable[[str, str], str]

    def says(self, section: str, key: str = "") -> bool:
        """Whether the file has the section, or the key in it."""
        return section in self.written and (not key or key in self.written[section])

    def place(self, section: str, key: str) -> str:
        """What the message of an error begins with."""
        return f"{self.location(section, key)}: [{section}] {key}"

    def options(self, section: str) -> dict[str, Any]:
        """What each declared key of a section means, the usual value where the file does not say.

        Raises
        ------
        InputError
            If a required key is missing, or a key holds what may not stand there.
        """
        return {key: self.option(section, key) for key in self.declared[section]}

    def option(self, section: str, key: str) -> Any:
        """What one key means; see `options`."""
        known = self.declared[section][key]
        if not self.says(section, key):
            if known.required:
                words = ", ".join(known.choices or ())
                where = self.location(section, "")
                raise InputError(f'{where}: [{section}] says no {key}; write {key} = "...", one of: {words}')
            return known.usual if known.choices is None else known.choices[known.usual]
        entry = self.written[section][key]
        require(type(entry) in known.types, f"{self.place(section, key)} must be {known.form}, got {entry!r}")
        if known.choices is None:
            return entry
        check_names(key, [entry], known.choices, f"{self.location(section, key)}: [{section}]")
        return known.choices[entry]


@dataclass(frozen=True)
class DriveKind:
    """One row of the registry of drives: how a file describes such a drive, and what can be done with it.

    Its log channels are the inputs and outputs of its `System`, by name and unit. Whether it has a friction map, a
    meter of air or a position is said by its `System`, too (`axis`, `meter`).

    Parameters
    ----------
    name : str
        [drive] kind.
    sections : mapping
        Each section that such a file may hold, and its keys; a section of parameters alone has none.
    build : callable
        Makes the drive.
    aliases : tuple of Alias
    any_friction : bool
        Whether every friction law fits: ``replace(drive, friction=...)``.
    """

    name: str
    sections: Mapping[str, Mapping[str, Key]]
    build: Callable[[Structure], Drive]
    aliases: tuple[Alias, ...] = ()
    any_friction: bool = True
