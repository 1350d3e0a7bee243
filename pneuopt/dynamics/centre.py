"""`count_from_centre`: a plant whose command is counted from the centre of its valve, as a controller counts it.

A valve for 0 to 10 V is closed near 5 V. Its wire and its logs count from 0 V; a controller's command, its limits and
its dither count from the centre, whatever that is. What a loop puts on the wire is the centre plus its command.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca

from pneuopt.dynamics.hooks import Log, LogWarningHook, Rest, RestHook, Start, StartHook
from pneuopt.dynamics.system import System
from pneuopt.quantities.parameters import Parameter, ParameterSet


def count_from_centre(system: System) -> System:
    """A system whose command is the deviation from the centre of its final element.

    Returns
    -------
    System
        Its parameter of the centre remains, without an effect. The same system where it has none.
    """
    axis, centre = system.axis, centre_name(system)
    if axis is None or axis.final_element is None or centre is None:
        return system
    rest, start, warn = system.rest_hook, system.start_hook, system.log_warning_hook
    return replace(
        system,
        ode=_without_centre(system, centre, system.ode),
        meter=None if system.meter is None else _without_centre(system, centre, system.meter),
        rest_hook=None if rest is None else partial(_rest, rest, centre),
        start_hook=None if start is None else partial(_starts, start, centre),
        log_warning_hook=None if warn is None else partial(_warnings, warn, centre),
        axis=axis._replace(final_element=axis.final_element._replace(centre=None)),
    )


def centre_name(system: System) -> str | None:
    """The parameter at which the final element of a plant is centred; None where its command counts from there."""
    element = None if system.axis is None else system.axis.final_element
    return None if element is None else element.centre


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


def _starts(hook: StartHook, centre: str, logs: Mapping[str, Log]) -> Sequence[Start]:
    return hook({n: log._replace(parameters=_at_zero(log.parameters, centre)) for n, log in logs.items()})


def _warnings(hook: LogWarningHook, centre: str, logs: Mapping[str, Log]) -> Sequence[str]:
    return hook({n: log._replace(parameters=_at_zero(log.parameters, centre)) for n, log in logs.items()})
