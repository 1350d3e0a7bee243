"""`check_travel`: refuse a reference that leads a piston into its end stops, before anything is simulated."""

from math import inf

from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.cases import TuningCase
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value


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
            far, remedy = stop.side * (reference.final - begin), "take a smaller step"
        else:
            lead, rest = stop.side * reference.initial * reference.at, reference.horizon - reference.at
            far = max(lead, lead + stop.side * reference.final * rest)
            fits = (room - lead) / (stop.side * reference.final) if reference.final else inf
            early = f"end it by horizon = {reference.at + fits:.3g} s"
            remedy = f"{early}, or start elsewhere, start={{'position': ...}}" if fits > 0 else "start elsewhere"
        where = "front" if stop.side > 0 else "rear"
        require(
            far <= room,
            f"reference {case.label}: it leads the piston over {write_value(far, 'm', 4)}, but from position "
            f"{write_value(begin, 'm', 4)} to the {where} end stop there are {write_value(max(room, 0.0), 'm', 4)}; "
            f"{remedy}",
        )
