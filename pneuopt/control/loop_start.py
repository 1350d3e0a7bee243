"""`start_state`: the state of a loop at rest, or in steady motion, from which a simulation begins."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.command import pid_reference
from pneuopt.control.compensation import Instant, uncompensated_command
from pneuopt.control.gain_schedule import schedule_gains
from pneuopt.control.rest import find_rest, set_sliding_direction
from pneuopt.control.wiring import check_initial_command
from pneuopt.dynamics.system import names
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet, without_prefix

if TYPE_CHECKING:
    from pneuopt.control.loop import ClosedLoop


def start_state(
    loop: "ClosedLoop",
    parameters: ParameterSet,
    x_plant: Sequence[float] | Array | None,
    reference: float,
    command: float,
    start: Mapping[str, float],
) -> Array:
    """The state of `ClosedLoop.initial`, which tells of the arguments; shape (n_states,)."""
    parameters = set_sliding_direction(loop, loop.complete(parameters), reference)
    p = loop.parameter_vector(parameters)
    value = dict(zip(loop.parameters, p, strict=True))
    if x_plant is None:
        x, command = find_rest(loop, parameters, reference, start)
    else:
        x, shape = np.asarray(x_plant, dtype=float), (len(loop.plant.states),)
        require(x.shape == shape, f"x_plant has shape {x.shape}, the plant's state has {shape}")
    check_initial_command(command, value, loop.command.unit)
    shown = loop.plant.ode(0, x, np.zeros(len(loop.plant.inputs)), [value[n] for n in loop.plant.parameters])[1]
    y = dict(zip(names(loop.plant.outputs), shown.full().ravel().tolist(), strict=True))
    sensor = loop.sensor.start(y, loop.sensed_signal, without_prefix(value, "sensor")) if loop.sensor else []
    seen = sensor[0] if sensor else y[loop.pid_signal.name]
    value = dict(schedule_gains(loop, value, seen, {}, y))
    p = np.array([float(v) for v in value.values()])
    wanted = float(pid_reference(loop, {"reference": reference}, y[loop.feedback.name], value)["reference"])
    v = float(uncompensated_command(loop, p, wanted, seen, command, [y[n] for n in loop.readings])[0])
    own = [float(state) for state in loop.pid.start(wanted, seen, v, without_prefix(value, "pid"))]
    known = Instant(0.0, wanted, seen, v, loop.pid.sample_time, {}, y)
    others = [float(remembered) for part in loop.compensators for remembered in part.start(loop.sensed_signal, known)]
    return np.concatenate([x, sensor, own, [reference] if loop.feedforward else [], others])
