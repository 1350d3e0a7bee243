"""What a response costs beside time: air drawn from the supply, and the way that the valve's spool travels."""

from collections.abc import Mapping

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import names
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

ANR_DENSITY = 1.185  # [kg/m^3] of air as normal litres count it: ISO 8778 (ANR), 100 kPa, 20 degC, 65 %
LITRES_PER_CUBIC_METRE = 1e3  # in a cubic metre


def meter_outputs(loop: ClosedLoop, x: ca.SX, u: ca.SX, p: ca.SX, control: ca.SX) -> ca.SX:
    """The mass flow from the supply [kg/s] and the spool's position [half travels], of a loop's vectors.

    Raises
    ------
    InputError
        If the plant has no meter.
    """
    plant = loop.plant
    if plant.meter is None:
        raise InputError("AirUse counts the supply's air, and this plant has none; leave it out")
    order, signals = list(loop.parameters), names(loop.inputs)
    inputs = [control if q.name == loop.command.name else u[signals.index(q.name)] for q in plant.inputs]
    own = ca.vertcat(*(p[order.index(n)] for n in plant.parameters))
    flow, spool = plant.meter(0, x[: len(plant.states)], ca.vertcat(*inputs), own)
    return ca.vertcat(ca.SX(flow), ca.SX(spool))


def air_consumption(t: Array, flow: Array, spool: Array, start: float) -> dict[str, Array]:
    """Air and travel of many responses on one grid.

    Parameters
    ----------
    t : ndarray, shape (n,)
        [s]
    flow : ndarray, shape (m, n)
        Drawn from the supply [kg/s].
    spool : ndarray, shape (m, n)
        Its position [half travels].
    start : float
        From when on is counted [s].

    Returns
    -------
    dict of str to ndarray, shape (m,)
        AirUse, what the supply gives from `start` to the end [l(ANR)], and ValveTravel, the spool's way meanwhile, to
        and fro [half travels].

    Examples
    --------
    A gram a second for two seconds, and a spool that opens and closes:

    >>> t = np.array([0.0, 1.0, 2.0])
    >>> found = air_consumption(t, np.full((1, 3), 1e-3), np.array([[0.0, 0.5, 0.0]]), 0.0)
    >>> round(found["AirUse"].item(), 4), found["ValveTravel"].item()
    (1.6878, 1.0)
    """
    kept = t >= start
    mass = np.trapezoid(flow[:, kept], t[kept], axis=1)
    travel = np.abs(np.diff(spool[:, kept], axis=1)).sum(axis=1)
    return {"AirUse": LITRES_PER_CUBIC_METRE / ANR_DENSITY * mass, "ValveTravel": travel}


def response_air_consumption(
    loop: ClosedLoop, parameters: ParameterSet, response: Trajectory, start: float
) -> Mapping[str, float]:
    """AirUse [l(ANR)] and ValveTravel [half travels] of one response; nothing of a plant without a meter.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
    response : Trajectory
        The plant's states, "control", and the loop's inputs where the plant has more than the command.
    start : float
        From when on is counted [s].
    """
    plant = loop.plant
    if plant.meter is None:
        return {}
    p = loop.parameter_vector(parameters)[[list(loop.parameters).index(n) for n in plant.parameters]]
    given = {q.name: response[q.name] if q.name in response else np.zeros(len(response)) for q in plant.inputs}
    inputs = np.array([*(given | {loop.command.name: response["control"]}).values()])
    states = response.matrix(names(plant.states)).T
    flow, spool = (np.asarray(row) for row in plant.meter.map(len(response))(0, states, inputs, p))
    return {n: float(value[0]) for n, value in air_consumption(response.t, flow, spool, start).items()}
