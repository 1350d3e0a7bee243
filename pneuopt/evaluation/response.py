"""A loop's response to a reference: its inputs, its sampling and its metrics."""

import math

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.metrics import BandCentre, Envelope, step_metrics
from pneuopt.evaluation.motion_requirements import PUSH
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

# Samples of a response of a loop without sample time: fewer blur a settling time, more cost time in proportion.
RESPONSE_SAMPLES = 1000
# Readings of a sampled loop over a horizon, and the least and most of them a sample: with fewer, the signal leaves the
# settling band between two readings unseen; more cost time in proportion.
READINGS_A_HORIZON, MIN_READINGS_A_SAMPLE, MAX_READINGS_A_SAMPLE = 1000, 2, 16
# Samples a period of a continuous dither: with six, the averaged response of a drive with friction seems to settle in
# 47 ms where it takes 63 ms; more cost time in proportion.
SAMPLES_A_DITHER_PERIOD = 20


def measure(
    loop: ClosedLoop,
    parameters: ParameterSet,
    reference: Reference,
    response: Trajectory,
    band: Band,
    envelope: Envelope = (),
) -> dict[str, float]:
    """Metrics of a simulated response, with the settling band around the reference.

    They are read off the plant's true signal, not off a sensor's reading of it.

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
        band=band_share(band, reference),
        band_centre=BandCentre.REFERENCE,
        dither_period=loop.dither_period(parameters),
        control=response["control"],
        sample_time=loop.pid.sample_time,
        envelope=envelope,
        scale=None if reference.changes else reference.nominal_size,
        target=reference.values(response.t),
        push=reference.disturbance.get(PUSH, 0.0),
    )


def loop_inputs(loop: ClosedLoop, reference: Reference, step: float) -> Trajectory:
    """Inputs of the loop under a reference; those that the reference has no column for are zero."""
    run = reference.trajectory(step)
    columns, none = dict(run.values), np.zeros(len(run))
    if loop.sensed_signal.order == 1 and REFERENCE_SPEED in columns:  # the reference is a speed, and this is its rate
        columns[REFERENCE_ACCELERATION] = columns[REFERENCE_SPEED]
    return Trajectory(run.t, {q.name: columns.get(q.name, none) for q in loop.inputs})


def sample_spacing(
    loop: ClosedLoop, reference: Reference, parameters: ParameterSet, samples_a_period: int = SAMPLES_A_DITHER_PERIOD
) -> float:
    """Spacing of the samples [s]: the controller's sample time, or a fine one that divides the step's instant."""
    if loop.pid.sample_time is not None:
        return loop.pid.sample_time
    rate = highest_dither_frequency(loop, parameters)
    longest = min(reference.horizon / RESPONSE_SAMPLES, 1 / (samples_a_period * rate) if rate else np.inf)
    whole = reference.at if reference.at > 0 else reference.horizon
    return float(whole / math.ceil(whole / longest - 1e-9))


def readings_a_sample(loop: ClosedLoop, reference: Reference) -> int:
    """Readings of a response per sample of the controller."""
    h = loop.pid.sample_time
    if h is None:
        return 1
    return min(
        MAX_READINGS_A_SAMPLE, max(MIN_READINGS_A_SAMPLE, math.ceil(h * READINGS_A_HORIZON / reference.horizon - 1e-9))
    )


def highest_dither_frequency(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """Highest frequency that the dither may take in a tuning [Hz]; 0 without dither; `parameters` are complete."""
    if loop.dither is None:
        return 0.0
    frequency = parameters["dither.frequency"]
    return frequency.upper if frequency.free else frequency.value


def command_range(loop: ClosedLoop, p: ParameterSet) -> tuple[float, float, str]:
    """Lowest and highest command that still acts, and what saturates there: the controller or the final element."""
    low, high, whose = -math.inf, math.inf, "the command"
    if "pid.lower" in p:
        low, high = p.value("pid.lower"), p.value("pid.upper")
    element = loop.plant.axis.final_element if loop.plant.axis else None
    if element is not None and (limit := p.value(element.limit)) < min(-low, high):
        low, high, whose = -limit, limit, f"the {element.name}"
    return low, high, whose
