"""`Runnable` and `Fittable`: what a model offers so that it can be simulated, and fitted to logs.

`System`, `ClosedLoop` and `LoggedLoop` are runnable; a new kind of model becomes so by these members, and is then taken
by `simulate` and, where it is fittable, by `identify`. Nobody asks a model for its type. A drive is none: `as_system`
and `as_runnable` take its system, and every verb that is given a model begins with one of them.

`count_from_centre` makes a plant whose command counts from the centre of its valve, as a controller's does: one for 0
to 10 V is closed near 5 V, and its wire and its logs count from 0 V.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Protocol, TypeVar

import casadi as ca

from pneuopt.dynamics.hooks import Log, Rest, RestHook, Start
from pneuopt.dynamics.system import FRICTION_DIRECTION, DiscreteSystem, Motion, System
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, wrong_argument
from pneuopt.quantities.trajectories import Trajectory


class Runnable(Protocol):
    """A model that can be simulated; the plant's states come first among its own."""

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Those of a state vector, in its order."""
        ...

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """What a simulation has to be given."""
        ...

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """What a simulation reports beside the states."""
        ...

    @property
    def parameters(self) -> ParameterSet:
        """Every parameter with its default."""
        ...

    @property
    def plant(self) -> System:
        """The plant without a controller."""
        ...

    def motion(self) -> Motion:
        """The equations between two samples, and what happens at a sample."""
        ...

    def discrete(self, substeps: int = 1) -> DiscreteSystem:
        """The sampled step, by `substeps` steps of RK4 a sample."""
        ...

    def rest_state(self, parameters: ParameterSet, outputs: Mapping[str, float] | None = None) -> Array:
        """The state at rest, shape (n_states,), where the named outputs of the plant have these values."""
        ...


class Fittable(Runnable, Protocol):
    """A model that can be fitted to logs; its inputs and outputs are named as a log's channels are."""

    def check(self, parameters: ParameterSet) -> None:
        """Raise `InputError` for values with which it cannot run."""
        ...

    def check_log(self, measured: Trajectory, name: str) -> None:
        """Raise `LogError` for a log that does not fit this model, beyond its inputs and outputs."""
        ...

    def input_matrix(self, measured: Trajectory, name: str) -> Array:
        """The inputs of `discrete` along a log, shape (n, n_inputs)."""
        ...

    def unobservable_start(self, measured: Trajectory, states: Trajectory, parameters: ParameterSet) -> Array | None:
        """The initial states that no output depends on, from a candidate; NaN, or None for all, where one is sought."""
        ...

    def starts(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Candidates from which an identification can start, the most plausible first."""
        ...

    def log_warnings(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """What speaks against the logs, a sentence each."""
        ...


class HasSystem(Protocol):
    """Anything that can be written as a `System`: a drive, a continuous loop, the system itself."""

    def system(self) -> System:
        """Its equations, with every parameter's default."""
        ...


M = TypeVar("M", bound=Runnable)
R = TypeVar("R")
DRIVE_OR_SYSTEM = "a drive (read_drive gives one beside its parameters) or its system"


def as_system(model: HasSystem, argument: str = "system", meant: str = DRIVE_OR_SYSTEM) -> System:
    """The system of a drive; a system stays what it is; what has none is an `InputError` on that `argument`."""
    if isinstance(model, type) or not callable(getattr(model, "system", None)):
        raise wrong_argument(argument, model, meant)
    return model.system()


def as_runnable(model: M | HasSystem, argument: str = "system") -> M | System:
    """The system of a drive; what can be simulated, a loop or a system, stays what it is. Errors as for `as_system`."""
    if hasattr(model, "motion") and not isinstance(model, type):
        return model  # type: ignore[return-value]
    return as_system(model, argument, f"{DRIVE_OR_SYSTEM}, or a ClosedLoop")


class PlantField:
    """A field of a dataclass that takes a drive as well as its system, and holds the system.

    A controller counts its command from the valve's centre, so the system that is held does (`count_from_centre`).
    """

    def __set_name__(self, owner: type, name: str) -> None:
        """Remember the field's name."""
        self._name = name

    def __get__(self, instance: object, owner: type) -> System:
        """The system; the class itself has none, by which a dataclass sees a field without a default."""
        if instance is None:
            raise AttributeError(self._name)
        system: System = instance.__dict__[self._name]
        return system

    def __set__(self, instance: object, model: HasSystem) -> None:
        """Hold the system of `model`; errors as for `as_system`."""
        instance.__dict__[self._name] = count_from_centre(as_system(model, self._name))


def check_smooth(model: Runnable) -> None:
    """Refuse Karnopp's friction where derivatives are taken: without its events a search sees no dry friction."""
    message = (
        "the plant has Karnopp's friction (friction.direction), which only a simulation switches; search on the smooth "
        "model, Coulomb() or Stribeck(), and prove the result on this one with simulate, evaluate or record"
    )
    require(FRICTION_DIRECTION not in model.parameters, message, ModelError)


@lru_cache(maxsize=64)
def count_from_centre(system: System) -> System:
    """A system whose command is the deviation from the centre of its final element; the same one where it has none.

    Its parameter of the centre remains, without an effect.
    """
    axis, centre = system.axis, centre_name(system)
    if centre is None:
        return system
    if axis is not None and axis.final_element is not None:
        axis = axis._replace(final_element=axis.final_element._replace(centre=None))
    rest, start, warn = system.rest_hook, system.start_hook, system.log_warning_hook
    return replace(
        system,
        ode=_without_centre(system, centre, system.ode),
        meter=None if system.meter is None else _without_centre(system, centre, system.meter),
        rest_hook=None if rest is None else partial(_rest, rest, centre),
        start_hook=None if start is None else partial(_read_at_zero, start, centre),
        log_warning_hook=None if warn is None else partial(_read_at_zero, warn, centre),
        axis=axis,
        centre=None,
    )


def centre_name(system: System) -> str | None:
    """The parameter from which the command of a plant, or of its final element, counts; None where that is 0."""
    element = None if system.axis is None else system.axis.final_element
    return system.centre if element is None else element.centre


def command_centre(system: System, parameters: ParameterSet) -> float:
    """The command on the wire at which the final element of a plant is centred [the command's unit]."""
    name = centre_name(system)
    return 0.0 if name is None else (system.parameters | parameters).value(name)


def _without_centre(system: System, centre: str, function: ca.Function) -> ca.Function:
    """The same function ``(t, x, u, p)`` at a centre of zero."""
    t, x, u, p = (ca.SX.sym(function.name_in(i), function.size1_in(i)) for i in range(function.n_in()))
    entries = [ca.SX(0) if n == centre else p[k] for k, n in enumerate(system.parameters)]
    outputs = [function.name_out(i) for i in range(function.n_out())]
    found = function(t, x, u, ca.vertcat(*entries))
    results = [found] if len(outputs) == 1 else list(found)
    return ca.Function(function.name(), [t, x, u, p], results, ["t", "x", "u", "p"], outputs)


def _at_zero(parameters: ParameterSet, centre: str) -> ParameterSet:
    return parameters | ParameterSet({centre: Parameter(0.0, parameters[centre].unit)} if centre in parameters else {})


def _rest(hook: RestHook, centre: str, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
    return hook(_at_zero(parameters, centre), outputs)


def _read_at_zero(hook: Callable[[Mapping[str, Log]], R], centre: str, logs: Mapping[str, Log]) -> R:
    return hook({n: log._replace(parameters=_at_zero(log.parameters, centre)) for n, log in logs.items()})
