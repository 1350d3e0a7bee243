"""`find_exchange`: two channels of a log whose columns are exchanged, by trying."""

from dataclasses import replace
from itertools import combinations

from pneuopt.dynamics.runnable import Fittable
from pneuopt.identification.checks import check_logs
from pneuopt.identification.stated_axis import stated_axis
from pneuopt.logs.doctor import examine
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet


def find_exchange(model: Fittable, log: Experiment, parameters: ParameterSet) -> tuple[str, str] | None:
    """Two channels with which exchanged the log doctor finds no fault; None where there is no such pair, or several.

    Parameters
    ----------
    model : Fittable
    log : Experiment
    parameters : ParameterSet
        As for `identify`.
    """
    pairs = [pair for pair in combinations(log.trajectory, 2) if _is_right(model, exchange(log, *pair), parameters)]
    return pairs[0] if len(pairs) == 1 else None


def exchange(log: Experiment, a: str, b: str) -> Experiment:
    """The log with two columns exchanged; each is converted as the channel's own was. Noise levels of both are lost."""
    values, columns = {a: log.trajectory[b], b: log.trajectory[a]}, log.source.columns if log.source else {}
    if a in columns and b in columns:
        for name, other in ((a, b), (b, a)):
            raw = (log.trajectory[other] - columns[other].offset) / columns[other].factor
            values[name] = columns[name].factor * raw + columns[name].offset
    noise = {n: sigma for n, sigma in log.noise.items() if n not in (a, b)}
    return replace(log, trajectory=log.trajectory.with_columns(values), noise=noise, holes=())


def _is_right(model: Fittable, log: Experiment, parameters: ParameterSet) -> bool:
    try:
        (full,) = check_logs(model, log, parameters)
    except InputError:
        return False
    return not any(f.fault for f in examine(full, stated_axis(model.plant, full, parameters)))
