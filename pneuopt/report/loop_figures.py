"""Responses of a closed loop, and the figures that show it: steps before and after, the Bode plot, the diagram."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Reference
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.evaluate import respond
from pneuopt.evaluation.operating_points import worst_open_loop
from pneuopt.plotting import Response, friction_force, has_friction_map, plot_bode, plot_loop, plot_steps
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.report.page import Picture

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure


def simulate_responses(
    loop: ClosedLoop, references: Sequence[Reference], parameters: ParameterSet, before: ParameterSet | None = None
) -> list[Response]:
    """The response to each reference, with that of the gains before where they can be simulated."""
    units = (loop.feedback.unit, loop.command.unit)
    found = []
    for reference in references:
        run = _simulate_response(loop, reference, parameters)
        earlier = None if before is None else _simulate_initial_response(loop, reference, before)
        period, push = loop.dither_period(parameters), loop.plant.axis.force if loop.plant.axis else "N"
        found.append(Response(run, reference, loop.feedback.name, units, earlier, period, push))
    return found


def loop_figures(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    before: ParameterSet | None = None,
    *,
    band: Band = 0.02,
) -> dict[str, "Figure"]:
    """The steps, "", and the Bode plot, "bode", at the first one's operating point with the largest sensitivity.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Reference
    parameters : ParameterSet
    before : ParameterSet, optional
        With the gains before tuning, which are drawn beside.
    band : float
        Half width of the settling band, a fraction of the step.
    """
    responses = simulate_responses(loop, references, parameters, before)
    first, earlier = responses[0], None
    if first.before is not None and before is not None:
        earlier = _open_loop(loop, before, first.reference, first.before)
    bode = plot_bode(_open_loop(loop, parameters, first.reference, first.run), earlier)
    return {"": plot_steps(responses, band=band), "bode": bode}


def loop_pictures(draw: Callable[[], Mapping[str, "Figure"]], *, compared: bool) -> tuple[Picture, Picture]:
    """The steps and the Bode plot for a page; both are simulated when the first one is drawn.

    Parameters
    ----------
    draw : callable
        As `loop_figures`.
    compared : bool
        Whether gains before are drawn beside.
    """
    drawn: dict[str, Figure] = {}

    def figure(name: str) -> "Figure":
        if not drawn:
            try:
                drawn.update(draw())
            except ConvergenceError as error:
                raise InputError(str(error)) from None
        return drawn[name]

    beside = ", before and after the tuning" if compared else ""
    steps = Picture(
        partial(figure, ""),
        f"Step responses{beside}: the signal with its reference and band, the command, valve and friction over time.",
        f"Steps{beside}: signal, reference and settling band, command, and what goes on inside the drive.",
    )
    bode = Picture(
        partial(figure, "bode"),
        f"Bode plot of the open loop{beside}: gain and phase with margins marked, and the two sensitivities.",
        f"The open loop where its sensitivity is largest in the first step{beside}; below, what feedback leaves of a "
        "disturbance (S) and what of the reference arrives (T).",
    )
    return steps, bode


def diagram_picture(loop: ClosedLoop) -> Picture:
    """The block diagram for a page."""
    alt = (
        f"Block diagram: reference, {loop.pid.form.value} PID{', dither' if loop.dither else ''}, the plant driven by "
        f"{loop.command.name} and feedback of {loop.feedback.name}."
    )
    return Picture(partial(plot_loop, loop), alt, "The loop as it was simulated.")


def _simulate_response(loop: ClosedLoop, reference: Reference, parameters: ParameterSet) -> Trajectory:
    """The response, with the friction force where the plant has one."""
    run, plant = respond(loop, reference, parameters), loop.plant
    if not plant.states or not has_friction_map(plant):
        return run
    others = {q.name: np.zeros(len(run)) for q in plant.inputs if q.name not in run}
    whole = run.with_columns({**others, loop.command.name: run["control"]})
    return run.with_columns({"friction.force": friction_force(plant, whole, parameters)})


def _simulate_initial_response(loop: ClosedLoop, reference: Reference, parameters: ParameterSet) -> Trajectory | None:
    try:
        return _simulate_response(loop, reference, parameters)
    except (ConvergenceError, InputError):
        return None


def _open_loop(loop: ClosedLoop, parameters: ParameterSet, reference: Reference, run: Trajectory) -> Linearisation:
    disturbed = add_disturbances(loop, [reference])
    return worst_open_loop(disturbed, loop.complete(parameters), reference, run)[1]
