"""A generated log of a first-order plant, whose Kalman filter is a line by hand."""

from typing import NamedTuple

import numpy as np

from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.arrays import Array
from pneuopt.shooting.segments import Segments, segment
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

SAMPLES, SAMPLE, TIME_CONSTANT, NOISE, GAIN = 3, 0.01, 0.05, 0.02, 1.0  # samples a segment, [s], [s], [m/s], [1]
ROUGH = 0.1  # of each node [m/s]


class FirstOrderLog(NamedTuple):
    """The segments with a free gain, the input and the output, and the state's nominal size."""

    segments: Segments
    u: Array
    y: Array
    scale: float


def first_order_log(count: int) -> FirstOrderLog:
    """So many samples under a random input."""
    system, given = FirstOrder().system().discrete(), FirstOrder().system().parameters
    given = given.with_values({"plant.time_constant": TIME_CONSTANT, "plant.gain": GAIN}).freed("plant.gain")
    rng = np.random.default_rng(1)
    t, u, a = np.arange(count) * SAMPLE, rng.standard_normal(count), np.exp(-SAMPLE / TIME_CONSTANT)
    x = [0.3]
    for k in range(count - 1):
        x.append(a * x[-1] + GAIN * (1 - a) * u[k])
    y, rough, h = np.array(x) + NOISE * rng.standard_normal(count), np.full((count, 1), ROUGH), np.full(count, SAMPLE)
    phase = Phase("run", t.astype(np.float64), h, u[:, None], regular_nodes(count, SAMPLES), guess=rough)
    residuals = Residuals(0, (system.outputs[0].name,), y[:, None], np.array([NOISE]))
    segments = segment(Transcription(system, given, (phase,), (residuals,)))
    return FirstOrderLog(segments, u, y, system.states[0].nominal)


def forced(u: Array, gain: float, samples: int = SAMPLES) -> float:
    """The state that some samples of the input leave, from zero."""
    a = np.exp(-SAMPLE / TIME_CONSTANT)
    return float(gain * (1 - a) * sum(a ** (samples - 1 - i) * u[i] for i in range(samples)))
