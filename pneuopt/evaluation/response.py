"""A response: the loop's inputs and samples under a reference, and what is read off its outputs and its end."""

import math

import numpy as np

from pneuopt.control.disturbance import add_disturbances
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step, disturbance_input
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.metrics import BandCentre, Envelope, step_metrics
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

# Samples of a response where the loop has no sample time: fewer blur a settling time, more cost time.
RESPONSE_SAMPLES = 1000
# Readings of a sampled loop: so many a horizon, and between the least and the most a sample.
READINGS_A_HORIZON, MIN_READINGS_A_SAMPLE, MAX_READINGS_A_SAMPLE = 1000, 2, 16
# Samples a period of a continuous dither: at six, its average claimed 47 ms on a drive with friction where 63 ms are
# certified; more cost time in proportion.
SAMPLES_A_DITHER_PERIOD = 20


def measure(
    loop: ClosedLoop,
    parameters: ParameterSet,
    reference: Step,
    response: Trajectory,
    band: float,
    envelope: Envelope = (),
) -> dict[str, float]:
    """The metrics of a simulated response, the settling band around the reference.

    What counts is the plant's own signal, whatever a sensor shows the controller of it.

    Parameters
    ----------
    response : Trajectory
        The loop's outputs.
    """
    return step_metrics(
        response.t,
        response[loop.feedback.name],
        reference.final,
        reference.initial,
        start=reference.at,
        band=band,
        band_centre=BandCentre.REFERENCE,
        dither_period=loop.dither_period(parameters),
        control=response["control"],
        sample_time=loop.pid.sample_time,
        envelope=envelope,
        scale=None if reference.is_step else reference.nominal_size,
    )


def linearise_open_loop(
    loop: ClosedLoop, parameters: ParameterSet, x: Array, command: float, reference: Step | None = None
) -> Linearisation:
    """The open loop for margins, about a plant state x under a command, and under what disturbs it in the end."""
    others = {} if reference is None else {disturbance_input(n): v for n, v in reference.disturbance.items()}
    return open_loop(
        add_disturbances(loop, [reference] if reference else []), parameters, x, {loop.command.name: command, **others}
    )


def loop_inputs(loop: ClosedLoop, reference: Step, step: float) -> Trajectory:
    """The loop's inputs under a reference; those that the reference does not name are zero."""
    run = reference.trajectory(step)
    others = [q.name for q in loop.inputs if q.name not in run]
    return run.with_columns({n: np.zeros(len(run)) for n in others})


def sample_spacing(
    loop: ClosedLoop, reference: Step, parameters: ParameterSet, samples_a_period: int = SAMPLES_A_DITHER_PERIOD
) -> float:
    """Samples' distance [s]: the controller's, or a fine one on which the step's instant lies."""
    if loop.pid.sample_time is not None:
        return loop.pid.sample_time
    rate = highest_dither_frequency(loop, parameters)
    longest = min(reference.horizon / RESPONSE_SAMPLES, 1 / (samples_a_period * rate) if rate else np.inf)
    whole = reference.at if reference.at > 0 else reference.horizon
    return float(whole / math.ceil(whole / longest - 1e-9))


def readings_a_sample(loop: ClosedLoop, reference: Step) -> int:
    """How often a response is read in a sample: between two of them it may leave the band."""
    h = loop.pid.sample_time
    if h is None:
        return 1
    return min(
        MAX_READINGS_A_SAMPLE, max(MIN_READINGS_A_SAMPLE, math.ceil(h * READINGS_A_HORIZON / reference.horizon - 1e-9))
    )


def highest_dither_frequency(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """The highest frequency that the dither may get [Hz]; 0 without dither."""
    if loop.dither is None:
        return 0.0
    frequency = (loop.parameters | parameters)["dither.frequency"]
    return frequency.upper if frequency.free else frequency.value


def command_range(p: ParameterSet) -> tuple[float, float, str]:
    """Between which values the command acts, and what ends it: the controller's limits, or the valve's span."""
    low, high, whose = -math.inf, math.inf, "the command"
    if "pid.lower" in p:
        low, high = p.value("pid.lower"), p.value("pid.upper")
    if "valve.span" in p and p.value("valve.span") < min(-low, high):
        low, high, whose = -p.value("valve.span"), p.value("valve.span"), "the valve"
    return low, high, whose
