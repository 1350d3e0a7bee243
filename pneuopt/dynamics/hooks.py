"""Model hooks: what a model hands its `System` beside the equations.

How an identification starts from logs, what is wrong with logs, where the plant rests, which hardware cannot exist, and
the limits beyond which the equations no longer hold (end stops, a vacuum).

Which motion a log must show for a model's parameters to be identifiable (`System.identification_hints`).

Names are those of parameters. A part of a plant uses its own ("viscous") for its own parameters and whole ones
("load.force") for those of other parts; `IdentificationHints.with_prefix` turns the first into the second.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, overload

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Intersample, ParameterSet, Quantity
from pneuopt.quantities.results import NOT_SAVED
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value


class Log(NamedTuple):
    """One log as a start hook reads it: its channels, and the parameters that hold in it, its conditions included.

    `intersample` says of inputs how they run between two samples; an absent one is held.
    """

    measured: Trajectory
    parameters: ParameterSet
    intersample: Mapping[str, Intersample] = {}


@dataclass(frozen=True, eq=False)
class Start:
    """A candidate from which an identification can start.

    Attributes
    ----------
    states : mapping of str to Trajectory
        States along each log, by the log's name.
    parameters : mapping of str to float
        By name; a `per_log` one as "name[log]".
    trial_parameters : tuple of str
        Those of the parameters that the logs do not determine: each candidate tries one value of them.
    """

    states: Mapping[str, Trajectory]
    parameters: Mapping[str, float]
    label: str = ""
    trial_parameters: tuple[str, ...] = ()


class Starts(Sequence[Start]):
    """Starts of which each is computed when it is first asked for: most searches end at the first one.

    Parameters
    ----------
    makers : sequence of callable
        Each returns a start.
    """

    def __init__(self, makers: Sequence[Callable[[], Start]]) -> None:
        self._makers, self._made = tuple(makers), dict[int, Start]()

    def __len__(self) -> int:
        return len(self._makers)

    @overload
    def __getitem__(self, index: int) -> Start: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Start]: ...

    def __getitem__(self, index: int | slice) -> Start | Sequence[Start]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        i = range(len(self))[index]
        if i not in self._made:
            self._made[i] = self._makers[i]()
        return self._made[i]


class StartHook(Protocol):
    """Finds starts of an identification from logs, by equation error for instance; see `System.starts`."""

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return candidates, the most plausible first."""
        ...


class Rest(NamedTuple):
    """A plant at rest: its states, and the inputs that hold it there; absent ones are zero."""

    states: Mapping[str, float]
    inputs: Mapping[str, float]


class RestHook(Protocol):
    """Gives the state at rest where Newton's method from zeros finds no equilibrium (a drive under pressure)."""

    def __call__(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        """Return a rest at which the named outputs have these values, or raise `InputError`."""
        ...


class LogWarningHook(Protocol):
    """Finds faults in the logs that only the model can see, a sensor's zero shift say; see `System.log_warnings`."""

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each fault, with figures and the remedy."""
        ...


class HardwareCheckHook(Protocol):
    """Refuses parameters of hardware that cannot exist."""

    def __call__(self, parameters: ParameterSet, start: Mapping[str, float] | None = None) -> None:
        """Raise `InputError` for an impossible number, or for a start (by state) where the plant cannot be."""
        ...


@dataclass(frozen=True)
class ValidityLimit:
    """A value of a state beyond which the model's equations no longer describe the plant: an end stop, a vacuum.

    Attributes
    ----------
    limit : callable
        From the plant's parameters, all of them, to the value [the state's unit].
    side : int
        1 where the state normally lies below the limit, -1 above.
    event : str
        The event as a clause, "the load reached the front end stop".
    meaning : str
        What holds from there on, as a clause, "the response is the stop's".
    """

    state: str
    limit: Callable[[ParameterSet], float]
    side: int
    event: str
    meaning: str


@dataclass(frozen=True)
class Contact:
    """A validity limit that a response has reached; printed, it is the sentence that a user reads.

    Attributes
    ----------
    t : float
        When, for the first time [s].
    value, rate : float
        The state there and its rate [its unit, and that over s].
    """

    t: float
    value: float
    rate: float
    state: Quantity
    validity_limit: ValidityLimit

    def __str__(self) -> str:
        where = f"{self.state.name} {write_value(self.value, self.state.unit, 4)}"
        speed = f" with {self.rate:.3g} m/s" if self.state.unit == "m" else ""
        limit = self.validity_limit
        return f"{limit.event} ({where}) at t = {self.t:.4g} s{speed}; from there {limit.meaning}"


class FinalElement(NamedTuple):
    """The final control element between the command and the body, a valve say: its signals, and words for it.

    Attributes
    ----------
    name, moving_part, medium : str
        Nouns for a sentence: the element, its part that the command moves, the spring through which it pushes the body.
    limit, dead_zone, bandwidth, centre : str
        Parameters: the size of the command that moves the part by its half travel; its dead zone [half travels] and,
        where it lags, its bandwidth [Hz]; the command at which the part stands in its middle, None where that is 0.
    stroke : str
        The state of the part [half travels], where it lags.
    pushing : tuple of str
        The states whose forces move the body.
    """

    name: str
    moving_part: str
    medium: str
    limit: str
    dead_zone: str
    bandwidth: str
    stroke: str
    pushing: tuple[str, ...]
    centre: str | None = None


class Axis(NamedTuple):
    """The body that a plant moves against friction: the names of its states and of its mass.

    Attributes
    ----------
    position, speed : str
        States.
    inertia : str
        The parameter that multiplies the speed's rate: a mass, or a moment of inertia.
    force : str
        The unit of what pushes the body.
    noun : str
        The body in a sentence.
    final_element : FinalElement, optional
        What the command moves first; None where the command is the force itself.
    """

    position: str = "position"
    speed: str = "speed"
    inertia: str = "load.mass"
    force: str = "N"
    noun: str = "mass"
    final_element: FinalElement | None = None


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
class IdentificationHints:
    """What a model tells an identification: the motion its parameters need in a log, and the runs that separate them.

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

    def __or__(self, other: "IdentificationHints") -> "IdentificationHints":
        known = {w.name for w in self.widths}
        widths = self.widths + tuple(w for w in other.widths if w.name not in known)
        at_least = {**self.at_least, **other.at_least}
        return IdentificationHints({**self.needs, **other.needs}, self.runs + other.runs, widths, at_least)

    def with_prefix(self, prefix: str) -> "IdentificationHints":
        """Put `prefix.` before the names of a part's own parameters: "viscous" becomes "friction.viscous"."""

        def own(name: str) -> str:
            return name if "." in name or not name else f"{prefix}.{name}"

        def whole(names: frozenset[str]) -> frozenset[str]:
            return frozenset(map(own, names))

        needs = {f"{prefix}.{n}": replace(e, confused_with=whole(e.confused_with)) for n, e in self.needs.items()}
        runs = tuple(replace(r, some=whole(r.some), others=whole(r.others)) for r in self.runs)
        widths = tuple(Width(own(w.name), w.factor, tuple(map(own, w.follows)), own(w.hides)) for w in self.widths)
        return IdentificationHints(needs, runs, widths, {own(n): own(m) for n, m in self.at_least.items()})
