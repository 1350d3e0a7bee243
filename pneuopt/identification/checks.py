"""Checks that logs, a system and parameters fit together, before anything is solved; each refusal names the remedy."""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.runnable import Fittable
from pneuopt.dynamics.system import names
from pneuopt.identification.repairs import repair_log
from pneuopt.logs.doctor import CHECKS
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import estimate_noise, noise_level
from pneuopt.quantities.arguments import as_tuple, check_parameters
from pneuopt.quantities.errors import InputError, LogError, ModelError, PhysicsWarning, check_names, require
from pneuopt.quantities.parameters import ParameterSet

# Factor [1] between a stated noise level and the one that the log shows: a smaller one doubts good estimates of short
# logs and of noise that is not white, a larger one lets intervals through that are too narrow.
MAX_NOISE_FACTOR = 3.0
FOREIGN_CHANNELS = "channels"  # the name by which channels that no plant reads are accepted, and left out
# What a fit cannot do without, by the names of the checks, and why no user can accept it.
NEEDED = {
    "length": "fewer hold no start state beside a parameter",
    "inputs": "without it the equations cannot be computed",
    "outputs": "without one there is nothing to compare",
    "noise": "a constant channel shows none; state its [noise] in the sidecar",
}
SETPOINT_CHANNELS = (
    "speed_reference",
    "position_reference",
)  # a loop's set-points may stay in a log; no plant reads them


def as_experiments(experiments: Experiment | Iterable[Experiment]) -> tuple[Experiment, ...]:
    """One log as well as several, as a tuple; an `InputError` where something else came."""
    return as_tuple("experiments", experiments, Experiment, "an Experiment or several, as read_log(path) gives them")


def check_logs(
    system: Fittable, experiments: Experiment | Iterable[Experiment], parameters: ParameterSet
) -> list[Experiment]:
    """Check that logs, system and parameters fit together; give every log a name of its own and noise levels."""
    experiments = as_experiments(experiments)
    check_parameters(parameters)
    require(len(experiments) > 0, "no experiments: give at least one log", LogError)
    check_names("parameter", parameters, system.parameters)
    system.check(parameters)
    signals = {*names(system.inputs), *names(system.outputs)}
    known = {*signals, *SETPOINT_CHANNELS, *(f"{n}_reference" for n in names(system.outputs))}
    taken: set[str] = set()
    out = []
    for number, experiment in enumerate(experiments, 1):
        name = experiment.name or f"log {number}"
        name = name if name not in taken else f"{name} ({number})"
        taken.add(name)
        check_accept(experiment, name)
        system.check_log(experiment.trajectory, name)
        read = experiment.trajectory.names
        if FOREIGN_CHANNELS in experiment.accept:
            read = tuple(n for n in read if n in known)
        own = replace(experiment.select(read), name=name)
        _check_channels(system, own, name, known)
        _check_conditions(system, own, parameters, name)
        out.append(repair_log(system, own)[0])
    return _fill_noise(system, out)


def check_accept(experiment: Experiment, name: str) -> None:
    """Check the names of what a log need not pass: each is a check, and one without which a fit is possible."""
    for check in experiment.accept:
        if check in NEEDED:
            raise LogError(f"{name}: accept: {check!r} cannot be accepted: {NEEDED[check]}")
    check_names("check", experiment.accept, (*CHECKS, FOREIGN_CHANNELS), f"{name}: accept")


def check_free(experiments: Sequence[Experiment], parameters: ParameterSet) -> None:
    """Check that a parameter is free, and that no free parameter is known in every log."""
    free = parameters.free_names
    require(len(free) > 0, "no parameter is free; mark what to estimate, as parameters.freed('friction.*')", ModelError)
    for name in free:
        known = all(name in e.conditions for e in experiments)
        message = f"{name} is free, but every log's conditions give its value; fix it, or drop the condition"
        require(not known, message, ModelError)


def emit_log_warnings(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """Warn of faults that only the model can find in logs, as a gauge pressure read as absolute.

    The warnings are returned, too.
    """
    found = find_log_warnings(system, experiments, parameters)
    for sentence in found:
        warnings.warn(sentence, PhysicsWarning, stacklevel=3)
    return found


def find_log_warnings(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """What the model finds in logs; see `emit_log_warnings`."""
    every = system.parameters | parameters
    known = {e.name: every.with_values(e.conditions).fixed(*e.conditions) for e in experiments}
    return tuple(system.log_warnings({e.name: Log(e.trajectory, known[e.name]) for e in experiments}))


def log_remarks(system: Fittable, given: Sequence[Experiment], checked: Sequence[Experiment]) -> tuple[str, ...]:
    """What was mended in logs, and stated noise levels that the logs themselves do not show; a sentence each."""
    out: list[str] = []
    for log, named in zip(given, checked, strict=True):
        if ignored := [n for n in log.trajectory if n not in named.trajectory]:
            out.append(f"{named.name}: accepted: {', '.join(ignored)}, which the model does not read")
        out += repair_log(system, replace(log.select(named.trajectory), name=named.name))[1]
        for channel in (n for n in outputs_in_log(system, named) if n in log.noise):
            stated, found = log.noise[channel], estimate_noise(named.trajectory[channel], named.trajectory.t)
            shown, least = found.level, found.level / MAX_NOISE_FACTOR if found.is_white else 0.0
            if not least <= stated <= shown * MAX_NOISE_FACTOR:
                unit = next(q.unit for q in system.outputs if q.name == channel)
                levels = f"stated as {stated:.2g} {unit}, the log itself shows {shown:.2g} {unit}"
                out.append(f"{named.name}: the noise of {channel} is {levels}; leave it out to have it estimated")
    return tuple(out)


def _check_conditions(system: Fittable, experiment: Experiment, parameters: ParameterSet, name: str) -> None:
    """Check the parameters under the conditions of a log."""
    check_names("parameter", experiment.conditions, system.parameters, f"{name}: condition")
    try:
        system.check((system.parameters | parameters).with_values(experiment.conditions))
    except InputError as error:
        raise InputError(f"{name}: condition {error}") from None


def _check_channels(system: Fittable, experiment: Experiment, name: str, known: set[str]) -> None:
    trajectory = experiment.trajectory
    short = f"{name}: {len(trajectory)} samples are too short a log; at least 10, for {NEEDED['length']}"
    require(len(trajectory) >= 10, short, LogError)
    for q in system.inputs:
        needed = f"{name}: the model needs the channel {q.name!r} [{q.unit}] as input; the log has "
        require(q.name in trajectory, f"{needed}{', '.join(trajectory.names)}; {NEEDED['inputs']}", LogError)
    for channel in trajectory:
        out = f"{channel} = false under [columns] of the log's sidecar, or Experiment.select"
        remedy = f"leave it out ({out}), or accept = ['channels']"
        reads = ", ".join(sorted(n for n in known if not n.endswith("_reference")))
        message = f"{name}: the model cannot use channel {channel!r}, it reads {reads}; {remedy}"
        require(channel in known, message, LogError)
    outputs = ", ".join(names(system.outputs))
    missing = f"{name}: none of the outputs is logged: {outputs}; {NEEDED['outputs']}"
    require(bool(outputs_in_log(system, experiment)), missing, LogError)
    for channel in outputs_in_log(system, experiment):
        empty = f"{name}: channel {channel!r} holds no sample; leave it out"
        require(bool(np.isfinite(trajectory[channel]).any()), empty, LogError)


def _fill_noise(system: Fittable, experiments: Sequence[Experiment]) -> list[Experiment]:
    """Add noise levels where a log declares none: each channel's median over all logs, for they share their sensors."""
    found: dict[str, dict[str, float]] = {}
    for experiment in experiments:
        for channel in outputs_in_log(system, experiment):
            if channel not in experiment.noise:
                found.setdefault(channel, {})[experiment.name] = noise_level(
                    experiment.trajectory[channel], experiment.trajectory.t
                )
    pooled = {}
    for channel, levels in found.items():
        shown = [level for level in levels.values() if not math.isnan(level)]
        constant = f"{next(iter(levels))}: channel {channel!r} is constant; leave it out, or state its [noise]"
        require(len(shown) > 0, constant, LogError)
        pooled[channel] = float(np.median(shown))
        silent = f"{next(iter(levels))}: channel {channel!r} shows no noise, not even rounding; state its [noise]"
        require(pooled[channel] > 0, silent, LogError)
    return [
        e.with_noise({n: s for n, s in pooled.items() if n in e.trajectory and n not in e.noise}) for e in experiments
    ]


def outputs_in_log(system: Fittable, experiment: Experiment) -> tuple[str, ...]:
    """The names of the system's outputs that a log holds; an output that is an input, too, is left out."""
    inputs = names(system.inputs)
    return tuple(n for n in names(system.outputs) if n in experiment.trajectory and n not in inputs)
