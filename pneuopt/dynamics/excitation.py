"""Which motion a log must show for a model's parameters to be identifiable: models declare it (`System.excitation`).

Names are those of parameters. A part of a plant uses its own ("viscous") for its own parameters and whole ones
("load.force") for those of other parts; `Excitation.with_prefix` turns the first into the second.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from pneuopt.quantities.archive import NOT_SAVED
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet

DEFAULT_WIDTH = "default; identify chooses it by the logs"
"""Source of a width that nobody has stated; one that a user states has another source, whatever its value."""


@dataclass(frozen=True, eq=False)
class LoggedMotion:
    """Statistics of the speed over all logs, and the parameters as far as they are known.

    Attributes
    ----------
    slow, fast : float
        The speed [m/s] that a tenth of the moving samples stay below, and a tenth exceed.
    forward : float
        Share of the moving samples, 0 to 1.
    acceleration : float
        Root mean square [m/s^2] of slopes over a hundredth of a log.
    speed : ndarray
        Every known sample [m/s].
    values, given : ParameterSet
        As estimated so far, and as the user gave them.
    """

    slow: float
    fast: float
    forward: float
    reversals: int
    acceleration: float
    speed: Array
    values: ParameterSet
    given: ParameterSet


class Lack(NamedTuple):
    """Why a parameter is not identifiable from the motion in the logs, and the run that would show it, in words."""

    reason: str
    remedy: str


@dataclass(frozen=True)
class Need:
    """The motion that a parameter needs in the logs to be identifiable.

    Parameters
    ----------
    lack : callable
        From the motion to what is lacking; None where nothing is.
    confused_with : frozenset of str
        The need counts only where one of these parameters is free, too; empty: always.
    """

    lack: Callable[[LoggedMotion], Lack | None]
    confused_with: frozenset[str] = frozenset()


@dataclass(frozen=True)
class SeparatingRun:
    """The run that separates some parameters from others, in words.

    Parameters
    ----------
    some, others : frozenset of str
        It suits a group that holds one of each, or one of `some` alone.
    """

    some: frozenset[str]
    others: frozenset[str]
    words: str


@dataclass(frozen=True)
class Width:
    """A width over which a model rounds a kink so that it can be integrated: a means, and no property of the plant.

    An identification chooses it by the logs, unless the user states it (`IdentificationResult.widths`).

    Parameters
    ----------
    name : str
        The parameter; it is on a logarithmic scale.
    factor : float
        By which a search narrows or widens it.
    follows : tuple of str
        Parameters that are narrowed or widened with it.
    hides : str
        The parameter that a width of its size hides, as a rounded edge does a dead zone; empty if there is none.
    """

    name: str
    factor: float
    follows: tuple[str, ...] = ()
    hides: str = ""


@dataclass(frozen=True)
class Excitation:
    """Which motion a model's parameters need in a log, and the runs that separate its parameters.

    Parameters
    ----------
    needs : mapping of str to Need
        By parameter.
    runs : tuple of SeparatingRun
        The first that suits a group counts.
    at_least : mapping of str to str
        Parameters that no plant has below another one: static friction below Coulomb friction.
    """

    needs: Mapping[str, Need] = field(default_factory=dict, metadata=NOT_SAVED)
    runs: tuple[SeparatingRun, ...] = ()
    widths: tuple[Width, ...] = ()
    at_least: Mapping[str, str] = field(default_factory=dict)

    def __or__(self, other: "Excitation") -> "Excitation":
        known = {w.name for w in self.widths}
        widths = self.widths + tuple(w for w in other.widths if w.name not in known)
        at_least = {**self.at_least, **other.at_least}
        return Excitation({**self.needs, **other.needs}, self.runs + other.runs, widths, at_least)

    def with_prefix(self, prefix: str) -> "Excitation":
        """Put `prefix.` before the names of a part's own parameters: "viscous" becomes "friction.viscous"."""

        def own(name: str) -> str:
            return name if "." in name or not name else f"{prefix}.{name}"

        def whole(names: frozenset[str]) -> frozenset[str]:
            return frozenset(map(own, names))

        needs = {f"{prefix}.{n}": replace(e, confused_with=whole(e.confused_with)) for n, e in self.needs.items()}
        runs = tuple(replace(r, some=whole(r.some), others=whole(r.others)) for r in self.runs)
        widths = tuple(Width(own(w.name), w.factor, tuple(map(own, w.follows)), own(w.hides)) for w in self.widths)
        return Excitation(needs, runs, widths, {own(n): own(m) for n, m in self.at_least.items()})
