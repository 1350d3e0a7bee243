"""`add_disturbances`: a loop with inputs that disturb parameters and inputs of its plant."""

from collections.abc import Iterable
from dataclasses import replace

import casadi as ca

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.dynamics.system import System, names
from pneuopt.quantities.errors import check_names
from pneuopt.quantities.parameters import Quantity


def add_disturbances(loop: ClosedLoop, references: Iterable[Reference]) -> ClosedLoop:
    """Give the plant an input for each disturbance of the references, named by `disturbance_input`.

    A parameter becomes its value plus that input, an input of the plant likewise; so 0 is the plant as it was.

    Raises
    ------
    UnknownNameError
        If a disturbance is neither a parameter nor an input of the plant.
    """
    wanted = dict.fromkeys(n for reference in references for n in reference.disturbance)
    new = [n for n in wanted if disturbance_input(n) not in names(loop.plant.inputs)]
    known = [*names(loop.plant.inputs), *loop.plant.parameters]
    check_names("parameter or input of the plant", new, known, "disturbance")
    if not new:
        return loop
    plant = _add_plant_disturbances(loop.plant, new)
    return replace(loop, plant=plant, actuated=loop.command.name, measured=loop.feedback.name)


def _add_plant_disturbances(plant: System, wanted: list[str]) -> System:
    u, p = (ca.SX.sym(n, plant.ode.size1_in(i)) for i, n in ((2, "u"), (3, "p")))
    t, x, d = ca.SX.sym("t"), ca.SX.sym("x", plant.ode.size1_in(1)), ca.SX.sym("d", len(wanted))
    inputs, parameters = list(names(plant.inputs)), list(plant.parameters)
    us, ps = ca.SX(u), ca.SX(p)
    for k, n in enumerate(wanted):
        if n in inputs:
            us[inputs.index(n)] += d[k]
        else:
            ps[parameters.index(n)] += d[k]

    def wrap(function: ca.Function) -> ca.Function:
        arguments, given = [t, x, ca.vertcat(u, d), p], ["t", "x", "u", "p"]
        found = function.call([t, x, us, ps])  # a list, whatever the number of outputs
        return ca.Function(function.name(), arguments, found, given, list(function.name_out()))

    units = {q.name: q.unit for q in plant.inputs} | {n: q.unit for n, q in plant.parameters.items()}
    more = tuple(Quantity(disturbance_input(n), units[n]) for n in wanted)
    meter = None if plant.meter is None else wrap(plant.meter)
    return replace(plant, inputs=(*plant.inputs, *more), ode=wrap(plant.ode), meter=meter)
