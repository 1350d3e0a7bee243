"""Model hooks: what a model hands its `System` beside the equations.

How an identification starts from logs, what is wrong with logs, where the plant rests, which hardware cannot exist, and
the limits beyond which the equations no longer hold (end stops, a vacuum).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value


class Log(NamedTuple):
    """One log as a start finder sees it: its channels, and the parameters as they are in it (conditions included)."""

    measured: Trajectory
    parameters: ParameterSet


@dataclass(frozen=True, eq=False)
class Start:
    """A candidate to start an identification from.

    Attributes
    ----------
    states : mapping of str to Trajectory
        States along each log, by the log's name.
    parameters : mapping of str to float
        By name; a `per_log` one as "name[log]".
    label : str
    trial_parameters : tuple of str
        Those of the parameters that the log does not tell, and the candidates try: one value each.
    """

    states: Mapping[str, Trajectory]
    parameters: Mapping[str, float]
    label: str = ""
    trial_parameters: tuple[str, ...] = ()


class StartHook(Protocol):
    """What a model knows about starting from logs (equation error); see `System.starts`."""

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return candidates, the most plausible first."""
        ...


class Rest(NamedTuple):
    """A plant at rest: its states, and the inputs that keep it there; absent ones are zero."""

    states: Mapping[str, float]
    inputs: Mapping[str, float]


class RestHook(Protocol):
    """What a model knows about resting where an equilibrium from zeros would not be found (a drive under pressure)."""

    def __call__(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        """Return a rest at which the named outputs have these values, or raise `InputError`."""
        ...


class LogWarningHook(Protocol):
    """What a model can tell against the logs themselves, as a sensor's zero point; see `System.doubts`."""

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each doubt, with figures and the remedy."""
        ...


class HardwareCheckHook(Protocol):
    """What a model knows about hardware that cannot exist."""

    def __call__(self, parameters: ParameterSet, start: Mapping[str, float] | None = None) -> None:
        """Raise `InputError` for an impossible number, or for a start (by state) where the plant cannot be."""
        ...


@dataclass(frozen=True)
class ValidityLimit:
    """A value of a state beyond which a response is no longer what the model is meant for: an end stop, a vacuum.

    Attributes
    ----------
    state : str
    limit : callable
        From the plant's parameters, all of them, to the value [the state's unit].
    side : int
        1 where the state normally lies below the limit, -1 above.
    event : str
        What happens there, "the piston reached the front end stop".
    meaning : str
        What the response is from there on, "the response is the stop's".
    """

    state: str
    limit: Callable[[ParameterSet], float]
    side: int
    event: str
    meaning: str


@dataclass(frozen=True)
class Contact:
    """A guard that a response has run into; printed, it is the sentence that a user reads.

    Attributes
    ----------
    t : float
        When, for the first time [s].
    value, rate : float
        The state there and its rate [its unit, and that over s].
    state : Quantity
    validity_limit : Guard
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
