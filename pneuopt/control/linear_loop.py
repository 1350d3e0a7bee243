"""The loop linearised: `linear_plant`, the plant as the controller sees it; `open_loop`, whose margins count."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from pneuopt.control.averaged_plant import AveragedPlant
from pneuopt.control.composed_loops import ComposedLoops
from pneuopt.control.linear_controller import linear_controller, operating_point
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import Linearisation, names
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet


def linear_plant(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> Linearisation:
    """The plant from command to measured output, or to the reading of a sensor with a lag, linearised.

    Under dither it is the mean over the ripple (`AveragedPlant`), which is what a signal slower than the dither meets.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
    x : ndarray, shape (n_plant_states,), optional
        The plant's operating point, an equilibrium or not, under dither its means; by default the closed loop's rest.
        Dry friction makes a resting plant look stiff: linearise such a plant in motion.
    u : mapping of str to float, optional
        The plant's inputs there, zero where absent; at rest the command is solved for.

    Returns
    -------
    Linearisation
    """
    loop.check(parameters)
    x, u = operating_point(loop, parameters, x, u)
    plant = loop.plant.linearise(x, u, parameters)
    j, i = plant.inputs.index(loop.command.name), plant.outputs.index(loop.feedback.name)
    A, B, C, D = plant.A, plant.B[:, j : j + 1], plant.C[i : i + 1], plant.D[i : i + 1, j : j + 1]
    p = loop.parameter_vector(parameters)
    if loop.dither_period(parameters):
        at = np.array([[u.get(n, 0.0) for n in plant.inputs]])
        A, B, C, D, _ = (M[0] for M in _averaged_plant(loop)(p[None], np.asarray(x, dtype=float)[None], at))
        B, C, D = B[:, None], C[None], np.array([[D]])
    states, lag = plant.states, loop.sensor_lag(p)
    if lag:
        n = len(A)
        A = np.block([[A, np.zeros((n, 1))], [C / lag, np.array([[-1 / lag]])]])
        B, C, D = np.vstack([B, D / lag]), np.eye(1, n + 1, n), np.zeros((1, 1))
        states = (*states, "sensor.reading")
    return Linearisation(A, B, C, D, states, (loop.command.name,), (loop.feedback.name,))


def open_loop(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> Linearisation:
    """``L(s) = C(s) P(s)`` under negative feedback, cut at the measured output, without saturation.

    P is the `linear_plant`, averaged under dither.
    A sampled PID counts as its continuous equivalent (`linear_gains`) with the `dead_time` in second-order Padé form,
    its integral as one without dead band and resets. Compensators that act always count by their slopes at the
    operating point; a knocker's pulses do not. A loop with further feedback (`ClosedLoop.is_composed`) is cut at the
    command, and a sampled one of these is exact, see `composed_loops`. Parameters as for `linear_plant`.

    Returns
    -------
    Linearisation
        From the control error, input "error", to the measured output; the plant's states come first.
    """
    x, u = operating_point(loop, parameters, x, u)
    if loop.is_composed:
        return _composed_loops(loop, parameters, x, u)[0]
    plant, controller = linear_plant(loop, parameters, x, u), linear_controller(loop, parameters, x, u)
    m, n = len(controller.A), len(plant.A)
    return Linearisation(
        np.block([[plant.A, plant.B @ controller.C], [np.zeros((m, n)), controller.A]]),
        np.vstack([plant.B @ controller.D, controller.B]),
        np.hstack([plant.C, np.zeros((1, m))]),
        np.zeros((1, 1)),
        plant.states + controller.states,
        ("error",),
        (loop.feedback.name,),
    )


def noise_path(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> Linearisation:
    """The controller of a loop with further feedback, from noise on what the PID sees to the command.

    In a cascade the noise is the position's, which an `Encoder` differentiates, too.
    Parameters as for `linear_plant`; frequencies as in `open_loop`.
    """
    return _composed_loops(loop, parameters, *operating_point(loop, parameters, x, u))[1]


def _composed_loops(
    loop: ClosedLoop, parameters: ParameterSet, x: Array, u: Mapping[str, float]
) -> tuple[Linearisation, Linearisation]:
    """The open loop and the noise path at an operating point."""
    loop.check(parameters)
    at = np.array([[u.get(n, 0.0) for n in names(loop.plant.inputs)]])
    found = _composed_function(loop)(loop.parameter_vector(parameters)[None], np.asarray(x, dtype=float)[None], at)
    plant = names(loop.plant.states)
    own = [f"controller.{k}" for k in range(found.loop[0].shape[-1] - len(plant))]
    A, B, C, D = (M[0] for M in found.loop)
    opened = Linearisation(A, B, C, D, (*plant, *own), ("error",), (loop.command.name,))
    A, B, C, D = (M[0] for M in found.noise)
    states = tuple(f"controller.{k}" for k in range(found.noise[0].shape[-1]))
    return opened, Linearisation(A, B, C, D, states, ("noise",), (loop.command.name,))


@lru_cache(maxsize=8)
def _composed_function(loop: ClosedLoop) -> ComposedLoops:
    """The function of a loop, kept likewise."""
    return ComposedLoops(loop)


@lru_cache(maxsize=8)
def _averaged_plant(loop: ClosedLoop) -> AveragedPlant:
    """The function of a loop, kept for the cases and operating points of one evaluation."""
    return AveragedPlant(loop)
