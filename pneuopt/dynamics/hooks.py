"""Hooks by which a model hands a `System` what it knows: how logs start it, what speaks against them, its rests."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory


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
