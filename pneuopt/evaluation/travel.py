"""`check_travel`: refuse a reference that leads a piston into its end stops, before anything is simulated."""

from math import inf

import numpy as np
from scipy.integrate import cumulative_trapezoid

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, Step
from pneuopt.evaluation.cases import TuningCase
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value

# Instants over a horizon at which a reference is read: fewer miss a turn by more of its way, more take longer.
TRAVEL_SAMPLES = 2001


def check_travel(loop: ClosedLoop, case: TuningCase, parameters: ParameterSet) -> None:
    """Refuse a reference that a piston cannot follow over its horizon without reaching an end stop.

    Parameters
    ----------
    loop : ClosedLoop
    case : TuningCase
    parameters : ParameterSet
        Every parameter of the loop, without this case's values.

    Raises
    ------
    InputError
        With the way that the reference leads, the way that there is, and what to change.
    """
    stops = [g for g in loop.plant.validity_limits if g.state == "position"]
    states = [q.name for q in loop.plant.states]
    if not stops or "position" not in states or loop.feedback.name not in ("position", "speed"):
        return
    reference, own = case.reference, case.case_parameters(parameters)
    begin = float(case.initial(loop, parameters)[states.index("position")])
    for stop in stops:
        room = stop.side * (stop.limit(own) - begin)
        if loop.feedback.name == "position":
            far = float((stop.side * (_values(reference)[1] - begin)).max())
            remedy = "take a smaller step" if isinstance(reference, Step) else "take a shorter way"
        elif isinstance(reference, Step):
            far, remedy = _step_of_speed(reference, stop.side, room)
        else:
            far = float((stop.side * cumulative_trapezoid(*_values(reference)[::-1])).max())
            remedy = "take less speed, or start elsewhere"
        where = "front" if stop.side > 0 else "rear"
        require(
            far <= room,
            f"reference {case.label}: it leads the piston over {write_value(far, 'm', 4)}, but from position "
            f"{write_value(begin, 'm', 4)} to the {where} end stop there are {write_value(max(room, 0.0), 'm', 4)}; "
            f"{remedy}",
        )


def _values(reference: Reference) -> tuple[Array, Array]:
    """Instants over the horizon, and the reference there."""
    t = np.linspace(0.0, reference.horizon, TRAVEL_SAMPLES)
    return t, reference.values(t)


def _step_of_speed(reference: Step, side: int, room: float) -> tuple[float, str]:
    """How far a step of the speed leads to a side [m], and what to change where that is too far."""
    lead, rest = side * reference.initial * reference.at, reference.horizon - reference.at
    far = max(lead, lead + side * reference.final * rest)
    fits = (room - lead) / (side * reference.final) if reference.final else inf
    early = f"end it by horizon = {reference.at + fits:.3g} s"
    return far, f"{early}, or start elsewhere, start={{'position': ...}}" if fits > 0 else "start elsewhere"
