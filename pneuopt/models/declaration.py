"""Declaration of a kind of drive: its name in files, its sections and their keys; no code asks a drive for its type.

A key of a section either chooses how the drive is built (a `Key`, declared here), or is one of the drive's parameters
("load.mass" is the key mass of [load]), or gives a parameter in another form (an `Alias`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

from pneuopt.dynamics.system import System
from pneuopt.quantities.keys import Key, Takes, read_table

Sections = Mapping[str, Mapping[str, Any]]
"""Contents of a drive's file as written, by section and key."""


class Drive(Protocol):
    """A drive that a drive.toml can describe."""

    kind: ClassVar[str]
    """Name in the registry of drives and in files."""

    def system(self) -> System:
        """Equations of the drive, with every parameter's default."""
        ...


@dataclass(frozen=True)
class Alias:
    """A key that gives a parameter in another form, such as a catalogue's nominal flow for a conductance.

    Parameters
    ----------
    parameter : str
        The parameter that it gives; a file has either this parameter or the alias.
    uses : tuple of str
        Parameters whose values the conversion needs; those that the drive lacks are left out.
    convert : callable
        ``convert(entry, values, where)`` returns the parameter's value [SI] from the written entry, the values [SI] of
        `uses`, and the place with which the message of an error begins.
    meaning, unit, example : str
        What it is, the unit in which a file writes it, and how a file may write it.
    """

    section: str
    key: str
    parameter: str
    uses: tuple[str, ...]
    convert: Callable[[Any, Mapping[str, float], str], float]
    meaning: str
    unit: str
    example: str

    def as_key(self) -> Key:
        """The declaration of the key."""
        condition = f"in place of {self.parameter.partition('.')[2]}"
        return Key(self.meaning, Takes.PARAMETER, self.unit, example=self.example, condition=condition)


@dataclass(frozen=True)
class DriveSections:
    """Sections of a drive's file, read key by key against their declaration.

    Parameters
    ----------
    written : mapping
        Sections of the file.
    declared : mapping
        Declared sections of the drive's kind.
    location : callable
        ``location(section, key)`` returns file and line for messages.
    """

    written: Sections
    declared: Mapping[str, Mapping[str, Key]]
    location: Callable[[str, str], str]

    def has(self, section: str, key: str = "") -> bool:
        """Whether the file has the section, or the key in it."""
        return section in self.written and (not key or key in self.written[section])

    def place(self, section: str, key: str) -> str:
        """File, line, section and key, with which the message of an error begins."""
        return f"{self.location(section, key)}: [{section}] {key}"

    def options(self, section: str) -> dict[str, Any]:
        """Values of a section's declared keys by `read_table`; the parameters beside them are passed over."""

        def where(key: str) -> str:
            return self.place(section, key) if key else f"{self.location(section, '')}: [{section}]"

        return read_table(self.declared[section], self.written.get(section, {}), where, partial=True)


@dataclass(frozen=True)
class FirstFiles:
    """What a new user's files begin with: a drive of that kind, and a loop that controls its usual values.

    Parameters
    ----------
    options : mapping
        Sections of the drive's file with the keys that choose how it is built.
    unknowns : tuple of str
        Parameters that logs usually give.
    gains : mapping of str to (float, float, float)
        Of a parallel PID: value, lower and upper bound [SI].
    limit : float
        Largest command [its unit].
    dither : (float, float), optional
        Frequency [Hz] and largest amplitude [the command's unit].
    steps : tuple of float
        Heights of the references [unit of the measured signal].
    horizon : float
        Of each step [s].
    swept : str
        Parameter over which a study goes.
    values : mapping of str to float
        Parameters that are not as the model has them [SI].
    """

    options: Sections
    unknowns: tuple[str, ...]
    gains: Mapping[str, tuple[float, float, float]]
    limit: float
    dither: tuple[float, float] | None
    steps: tuple[float, ...]
    horizon: float
    swept: str
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class DriveKind:
    """A row of the registry of drives: how a file describes such a drive.

    Its log channels are the inputs and outputs of its `System`, by name and unit. The `System` also declares whether
    the drive has an axis, and so a friction map, and a meter (`axis`, `meter`).

    Parameters
    ----------
    name : str
        Value of kind in [drive].
    sections : mapping
        Sections that such a file may have, with their keys; a section of parameters alone has no keys.
    build : callable
        Builds the drive from a `DriveSections`.
    any_friction : bool
        Whether ``replace(drive, friction=...)`` works with every friction law.
    first : FirstFiles, optional
        What `pneuopt init` writes for it; None: it writes nothing.
    """

    name: str
    sections: Mapping[str, Mapping[str, Key]]
    build: Callable[[DriveSections], Drive]
    aliases: tuple[Alias, ...] = ()
    any_friction: bool = True
    first: FirstFiles | None = None
