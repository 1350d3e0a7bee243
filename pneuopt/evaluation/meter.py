"""Metrics that are read off a plant's meter: air consumption, valve travel, energy."""

from collections.abc import Collection, Mapping

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.functions import compile_rows
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.step_record import StepRecord, without_slopes
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory


def meter_channels(plant: System) -> tuple[str, ...]:
    """Channels of a plant's meter: "air" [kg/s], "spool" [half travels], "power" [W]; none without a meter."""
    return () if plant.meter is None else tuple(plant.meter.name_out())


def needed_channels(metrics: Collection[str]) -> tuple[str, ...]:
    """Channels of a meter that these metrics need."""
    return tuple(dict.fromkeys(c for name in metrics if name in METRICS for c in METRICS[name].channels))


def check_channels(plant: System, metrics: Collection[str]) -> None:
    """Refuse a metric whose channel the plant's meter lacks.

    Raises
    ------
    InputError
        It names the metric and the channel.
    """
    shown = meter_channels(plant)
    for name in metrics:
        for channel in needed_channels([name]):
            if channel not in shown:
                reason = f"its meter shows only {', '.join(shown)}" if shown else "it has no meter"
                raise InputError(f"this plant does not show {name}: {reason}, not {channel!r}; leave {name} out")


def meter_outputs(
    loop: ClosedLoop, channels: Collection[str], x: ca.SX, u: ca.SX, p: ca.SX, control: ca.SX
) -> list[ca.SX]:
    """Symbolic outputs of the plant's meter in terms of the loop's states, inputs, parameters and command."""
    plant = loop.plant
    if plant.meter is None:
        return []
    order, signals = list(loop.parameters), names(loop.inputs)
    inputs = [control if q.name == loop.command.name else u[signals.index(q.name)] for q in plant.inputs]
    plant_parameters = ca.vertcat(*(p[order.index(n)] for n in plant.parameters))
    found = plant.meter.call([0, x[: len(plant.states)], ca.vertcat(*inputs), plant_parameters])
    shown = dict(zip(meter_channels(plant), found, strict=True))
    return [ca.SX(shown[channel]) for channel in channels]


def meter_record(t: Array, channels: Mapping[str, Array], start: float) -> StepRecord:
    """Record of the meter's channels alone, for many responses on one grid, from `start` on.

    Parameters
    ----------
    t : ndarray, shape (n,)
        [s]
    channels : mapping of str to ndarray, shape (m, n)
    start : float
        [s]
    """
    kept = t >= start
    shown = {n: without_slopes(np.asarray(values)[:, kept]) for n, values in channels.items()}
    m = len(next(iter(channels.values())))
    none = without_slopes(np.zeros((m, 0)))
    return StepRecord(t[kept], none, none, np.zeros((m, 0, 0)), meter=shown)


def meter_metrics(loop: ClosedLoop, parameters: ParameterSet, response: Trajectory, start: float) -> dict[str, float]:
    """Metrics of one response that the plant's meter shows, AirUse [l(ANR)] for example; none without a meter.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
    response : Trajectory
        The plant's states, "control", and the loop's inputs where the plant has more than the command.
    start : float
        The instant from which the metrics count [s].
    """
    plant, shown = loop.plant, meter_channels(loop.plant)
    if plant.meter is None:
        return {}
    p = loop.parameter_vector(parameters)[[list(loop.parameters).index(n) for n in plant.parameters]]
    given = {q.name: response[q.name] if q.name in response else np.zeros(len(response)) for q in plant.inputs}
    inputs = np.column_stack([*(given | {loop.command.name: response["control"]}).values()])
    rows = compile_rows(plant.meter)([0.0], response.matrix(names(plant.states)), inputs, p)
    record = meter_record(response.t, {n: row.T for n, row in zip(shown, rows, strict=True)}, start)
    readable = (m for m in METRICS.values() if m.channels and set(m.channels) <= set(shown))
    return {metric.name: float(metric.largest(record)[0]) for metric in readable}
