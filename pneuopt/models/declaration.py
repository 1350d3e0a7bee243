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


@dataclass(frozen=True)
class Alias:
    """A key that gives a parameter in another form, such as a catalogue's nominal flow for a conductance."""

    section: str
    key: str
    parameter: str  # that it gives; a file has either this parameter or the alias
    uses: tuple[str, ...]  # parameters whose values the conversion needs, where the drive has them
    convert: Callable[[Any, Mapping[str, float], str], float]  # (entry, values of `uses` [SI], place) -> value [SI]
    meaning: str
    unit: str  # in which a file writes it
    example: str

    def as_key(self) -> Key:
        """The declaration of the key."""
        condition = f"in place of {self.parameter.partition('.')[2]}"
        return Key(self.meaning, Takes.PARAMETER, self.unit, example=self.example, condition=condition)


@dataclass(frozen=True)
class DriveSections:
    """Sections of a drive's file, read key by key against their declaration."""

    written: Sections
    declared: Mapping[str, Mapping[str, Key]]  # of the drive's kind, by section and key
    location: Callable[[str, str], str]  # (section, key) -> file and line for messages

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
    """What a new user's files begin with: a drive of that kind, and a loop that controls its usual values."""

    options: Sections  # of the drive's file, with the keys that choose how it is built
    unknowns: tuple[str, ...]  # parameters that logs usually give
    gains: Mapping[str, tuple[float, float, float]]  # of a parallel PID: value, lower and upper bound [SI]
    limit: float  # largest command [its unit]
    dither: tuple[float, float] | None  # frequency [Hz] and largest amplitude [the command's unit]
    steps: tuple[float, ...]  # heights of the references [unit of the measured signal]
    horizon: float  # of each step [s]
    swept: str  # parameter over which a study goes
    values: Mapping[str, float] = field(default_factory=dict)  # parameters that are not as the model has them [SI]


@dataclass(frozen=True)
class DriveKind:
    """A row of the registry of drives: how a file describes such a drive; log channels are those of its `System`."""

    name: str  # value of kind in [drive]
    sections: Mapping[str, Mapping[str, Key]]  # that such a file may have; one of parameters alone has no keys
    build: Callable[[DriveSections], Drive]
    aliases: tuple[Alias, ...] = ()
    any_friction: bool = True  # whether ``replace(drive, friction=...)`` works with every friction law
    first: FirstFiles | None = None  # what `pneuopt init` writes; None: nothing
