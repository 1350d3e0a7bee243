"""Model hooks: what a model hands its `System` beside the equations.

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
    """A candidate from which an identification can start."""

    states: Mapping[str, Trajectory]  # states along each log, by the log's name
    parameters: Mapping[str, float]  # by name; a `per_log` one as "name[log]"
    label: str = ""
    # those of the parameters that the logs do not determine: each candidate tries one value of them
    trial_parameters: tuple[str, ...] = ()


class Starts(Sequence[Start]):
    """Starts of which each is computed when it is first asked for: most searches end at the first one."""

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
    """A value of a state beyond which the model's equations no longer describe the plant: an end stop, a vacuum."""

    state: str
    limit: Callable[[ParameterSet], float]  # from the plant's parameters, all of them, to the value [the state's unit]
    side: int  # 1 where the state normally lies below the limit, -1 above
    event: str  # the event as a clause, "the load reached the front end stop"
    meaning: str  # what holds from there on, as a clause, "the response is the stop's"


@dataclass(frozen=True)
class Contact:
    """A validity limit that a response has reached; printed, it is the sentence that a user reads."""

    t: float  # when, for the first time [s]
    value: float  # of the state there [its unit]
    rate: float  # [that unit over s]
    state: Quantity
    validity_limit: ValidityLimit

    def __str__(self) -> str:
        where = f"{self.state.name} {write_value(self.value, self.state.unit, 4)}"
        speed = f" with {self.rate:.3g} m/s" if self.state.unit == "m" else ""
        limit = self.validity_limit
        return f"{limit.event} ({where}) at t = {self.t:.4g} s{speed}; from there {limit.meaning}"


class FinalElement(NamedTuple):
    """The final control element between the command and the body, a valve say: its signals, and words for it."""

    name: str  # a noun for a sentence, as the next two
    moving_part: str  # which the command moves
    medium: str  # the spring through which it pushes the body
    limit: str  # the parameter: size of the command that moves the part by its half travel
    dead_zone: str  # the parameter: its dead zone [half travels]
    bandwidth: str  # the parameter, where it lags [Hz]
    stroke: str  # the state of the part [half travels], where it lags
    pushing: tuple[str, ...]  # the states whose forces move the body
    centre: str | None = None  # the parameter: the command at which the part stands in its middle; None where that is 0


class Axis(NamedTuple):
    """The body that a plant moves against friction: the names of its states and of its mass."""

    position: str = "position"  # a state, as the next one
    speed: str = "speed"
    inertia: str = "load.mass"  # the parameter that multiplies the speed's rate: a mass, or a moment of inertia
    force: str = "N"  # the unit of what pushes the body
    noun: str = "mass"  # the body in a sentence
    # what the command moves first; None where the command is the force itself
    final_element: FinalElement | None = None


DEFAULT_WIDTH = "default; identify estimates it with the rest"
"""Source of a width that nobody has stated; one that a user states has another source, whatever its value."""


@dataclass(frozen=True, eq=False)
class LoggedMotion:
    """Statistics of the speed over all logs, and the parameters as far as they are known."""

    slow: float  # the speed [m/s] that a tenth of the moving samples stay below
    fast: float  # the one that a tenth exceed
    forward: float  # share of the moving samples, 0 to 1
    reversals: int
    acceleration: float  # root mean square [m/s^2] of slopes over a hundredth of a log
    speed: Array  # every known sample [m/s]
    values: ParameterSet  # as estimated so far
    given: ParameterSet  # as the user gave them


class Lack(NamedTuple):
    """Why a parameter is not identifiable from the motion in the logs, and the run that would show it, in words."""

    reason: str
    remedy: str
    # whether it counts whatever figures say: at rest a model that rounds stiction creeps, and shows what no drive does
    is_strict: bool = False


@dataclass(frozen=True)
class Need:
    """The motion that a parameter needs in the logs to be identifiable."""

    lack: Callable[[LoggedMotion], Lack | None]  # from the motion to what is lacking; None where nothing is
    # the need counts only where one of these parameters is free, too; empty: always
    confused_with: frozenset[str] = frozenset()


@dataclass(frozen=True)
class SeparatingRun:
    """The run that separates some parameters from others, in words."""

    # some, others: it suits a group that holds one of each, or one of `some` alone
    some: frozenset[str]
    others: frozenset[str]
    words: str


@dataclass(frozen=True)
class Width:
    """A width over which a model rounds a kink: an identification estimates it, unless the user states it."""

    name: str  # the parameter
    start: float = 0.0  # where a search begins [the parameter's unit]; 0: at the parameter's own value


@dataclass(frozen=True)
class IdentificationHints:
    """What a model tells an identification: the motion that parameters need in a log, the runs that separate them."""

    needs: Mapping[str, Need] = field(default_factory=dict, metadata=NOT_SAVED)  # by parameter
    runs: tuple[SeparatingRun, ...] = ()  # the first that suits a group counts
    widths: tuple[Width, ...] = ()
    # parameters that no plant has below another one: static friction below Coulomb friction
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
        widths = tuple(Width(own(w.name), w.start) for w in self.widths)
        return IdentificationHints(needs, runs, widths, {own(n): own(m) for n, m in self.at_least.items()})
