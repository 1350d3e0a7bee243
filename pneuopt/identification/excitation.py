"""The motion that a set of logs shows, what it lacks to identify a parameter, and the run that would identify it.

Which motion a parameter needs is declared by the model (`System.excitation`).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pneuopt.dynamics.excitation import Excitation, Lack, LoggedMotion
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value

_VALUE_IN_WORDS = re.compile(r"<(?:([\d.]+) )?(\w+)>")
# share of the largest speed [1] below which a sample counts as standing still: lower takes noise for motion, higher
# leaves slow motion out
MOVING_SPEED_SHARE = 0.05


def summarise_motion(
    experiments: Sequence[Experiment], states: Mapping[str, Trajectory], values: ParameterSet, given: ParameterSet
) -> LoggedMotion | None:
    """Summarise the speeds and accelerations of all logs.

    Parameters
    ----------
    experiments : sequence of Experiment
    states : mapping of str to Trajectory
        Estimated states of each log, whose speed counts where none is logged.
    values, given : ParameterSet
        As estimated from the logs, and as the user gives them.

    Returns
    -------
    LoggedMotion or None
        None where no log has a speed, or nothing moves.
    """
    runs = [r for e in experiments if (r := _speed(e, states.get(e.name))) is not None]
    v = np.concatenate([speed for _, speed in runs]) if runs else np.zeros(0)
    if not np.any(v):
        return None
    moving = v[np.abs(v) > MOVING_SPEED_SHARE * float(np.quantile(np.abs(v), 0.99))]
    low, high = np.quantile(np.abs(moving), [0.1, 0.9])
    rates = np.concatenate([_acceleration(t, speed) for t, speed in runs])
    return LoggedMotion(
        float(low),
        float(high),
        float(np.mean(moving > 0)),
        sum(_count_reversals(speed, MOVING_SPEED_SHARE * float(high)) for _, speed in runs),
        float(np.sqrt(np.mean(rates**2))),
        v,
        values,
        given,
    )


def missing_excitation(
    excitation: Excitation, name: str, free: Sequence[str], seen: LoggedMotion | None
) -> Lack | None:
    """The motion that the logs lack to identify a parameter, and the run to log; None if nothing known is lacking.

    Parameters
    ----------
    excitation : Excitation
        The model's.
    name : str
        Of the parameter, "name[log]" for one of a log.
    free : sequence of str
        All parameters that are to be identified at once.
    seen : LoggedMotion or None
    """
    need = excitation.needs.get(_base_name(name))
    if need is None or seen is None:
        return None
    others = {_base_name(n) for n in free} - {_base_name(name)}
    return need.lack(seen) if need.confused_with & others or not need.confused_with else None


def remedy(excitation: Excitation, names: Sequence[str]) -> str:
    """The run that would separate these parameters, in words."""
    bases = {_base_name(n) for n in names}
    for run in excitation.runs:
        if bases & run.some and (len(bases) == 1 or bases & run.others):
            return _write_values(run.words, ParameterSet())
    return f"fix {'it' if len(bases) == 1 else 'one of them'}, or log a run that moves differently"


def with_values_in_words(excitation: Excitation, values: ParameterSet) -> Excitation:
    """The excitation, with the values in use in the words of its runs.

    Parameters
    ----------
    excitation : Excitation
        In whose words "<stribeck_velocity>" stands for the value of the parameter that ends so, "<5 stribeck_velocity>"
        for five times it.
    values : ParameterSet
    """
    runs = tuple(replace(run, words=_write_values(run.words, values)) for run in excitation.runs)
    return replace(excitation, runs=runs)


def _write_values(words: str, values: ParameterSet) -> str:
    """The words with values in place of "<5 stribeck_velocity>"; its name where there is no such parameter."""

    def write(found: re.Match[str]) -> str:
        name = next((n for n in values if n.rpartition(".")[2] == found[2]), None)
        factor = float(found[1] or 1)
        if name is not None:
            return write_value(factor * values.value(name), values[name].unit, 2)
        times = "" if factor == 1 else f"{factor:g} times "
        return f"{times}the {found[2].replace('_', ' ')}"

    return _VALUE_IN_WORDS.sub(write, words)


def _base_name(name: str) -> str:
    return name.partition("[")[0]


def _speed(experiment: Experiment, states: Trajectory | None) -> tuple[Array, Array] | None:
    log = experiment.trajectory
    source = log if "speed" in log else states
    if source is None or "speed" not in source:
        return None
    known = np.isfinite(source["speed"])
    return source.t[known], source["speed"][known]


def _acceleration(t: Array, v: Array) -> Array:
    every = max(1, len(t) // 200)
    return np.asarray(np.diff(v[::every]) / np.diff(t[::every]))


def _count_reversals(v: Array, level: float) -> int:
    """Changes of direction, from beyond a level to beyond it on the other side."""
    side = np.sign(v[np.abs(v) > level])
    return int(np.count_nonzero(np.diff(side)))
