"""A linear loop by the matrix exponential, which shares no line with pneuopt: plant, dead time and PID written out.

The plant is a transfer function, with its dead time under a continuous PID: its input is the remembered command, on a
line between two steps. The PID is continuous, or sampled with a computing delay of whole samples, and has no clip.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.signal import tf2ss

from problems.shared.arrays import Array

STEPS_A_HORIZON = 4000  # of the response; half as many change settling times by 1e-4 of the horizon


@dataclass(frozen=True, eq=False)
class PlainPlant:
    """A transfer function: its polynomials in s, highest power first, and its dead time [s]."""

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    dead_time: float = 0.0

    def matrices(self) -> tuple[Array, Array, Array]:
        """State space without the dead time: A, B, C."""
        A, B, C, _ = tf2ss(self.numerator, self.denominator)
        return A, B, C


def respond_plainly(
    plant: PlainPlant,
    gains: Mapping[str, float],
    reference: float,
    load: float,
    times: tuple[float, int],
    sampled: tuple[float, int] = (0.0, 0),
) -> tuple[Array, Array]:
    """The response to a reference and a load at the plant's input, both from time 0, at rest before.

    Parameters
    ----------
    gains : mapping of str to float
        Kp, Ki, Kd, Tf, b, c.
    times : tuple of float and int
        The horizon [s], and how many of them to follow.
    sampled : tuple of float and int
        The sample time [s], 0: continuous; and the delay in samples.

    Returns
    -------
    tuple of ndarray
        Times [s] and the measured signal.
    """
    A, B, C = plant.matrices()
    horizon, count = times
    if not sampled[0] and plant.dead_time:
        longest = min(horizon / STEPS_A_HORIZON, gains["Tf"] / 10)
        steps_late = int(np.ceil(plant.dead_time / longest))  # a whole number, so that a kick arrives at a step's end
        h = plant.dead_time / steps_late
        return _late(plant, gains, (reference, load), h, int(np.ceil(horizon * count / h)), steps_late)
    assert not plant.dead_time
    if not sampled[0]:
        return _continuous(A, B, C, gains, (reference, load), horizon / STEPS_A_HORIZON, STEPS_A_HORIZON * count)
    per_sample = max(1, int(np.ceil(sampled[0] * STEPS_A_HORIZON / horizon)))
    samples = int(horizon * count / sampled[0])
    return _sampled(A, B, C, gains, (reference, load), sampled, samples, per_sample)


def _continuous(
    A: Array, B: Array, C: Array, k: Mapping[str, float], given: tuple[float, float], h: float, steps: int
) -> tuple[Array, Array]:
    n, (r, d), Kf = len(A), given, k["Kd"] / k["Tf"]
    M = np.zeros((n + 3, n + 3))  # plant, integral, filter, one
    u = np.concatenate([-(k["Kp"] + Kf) * C[0], [1.0, -Kf, (k["Kp"] * k["b"] + Kf * k["c"]) * r]])
    M[:n] = B @ u[None]
    M[:n, :n] += A
    M[:n, -1] += B[:, 0] * d
    M[n, :n], M[n, -1] = -k["Ki"] * C[0], k["Ki"] * r
    M[n + 1, :n], M[n + 1, n + 1], M[n + 1, -1] = -C[0] / k["Tf"], -1 / k["Tf"], k["c"] * r / k["Tf"]
    step, x, y = expm(M * h), np.append(np.zeros(n + 2), 1.0), np.zeros(steps + 1)
    for i in range(steps):
        x = step @ x
        y[i + 1] = C[0] @ x[:n]
    return np.linspace(0.0, h * steps, steps + 1), y


def _late(
    plant: PlainPlant, k: Mapping[str, float], given: tuple[float, float], h: float, steps: int, back: int
) -> tuple[Array, Array]:
    (A, B, C), (r, d), n = plant.matrices(), given, len(plant.denominator) - 1
    M = np.zeros((n + 2, n + 2))  # plant, its input and that one's slope
    M[:n, :n], M[:n, n], M[n, n + 1] = A, B[:, 0], 1.0
    step, decay = expm(M * h), np.exp(-h / k["Tf"])
    x, integral, seen = np.zeros(n), 0.0, 0.0
    y, u = np.zeros(steps + 1), np.zeros(steps + 1)

    for i in range(steps + 1):
        error = k["c"] * r - y[i]
        u[i] = k["Kp"] * (k["b"] * r - y[i]) + integral + k["Kd"] / k["Tf"] * (error - seen) + d
        if i == steps:
            break
        first, last = (u[i - back], u[i + 1 - back]) if i >= back else (0.0, 0.0)
        x = step[:n, :n] @ x + step[:n, n] * first + step[:n, n + 1] * (last - first) / h
        y[i + 1] = C[0] @ x
        integral += k["Ki"] * h * (r - (y[i] + y[i + 1]) / 2)
        after = k["c"] * r - y[i + 1]
        slope = (after - error) / h  # of a line, of which the filter's answer is exact
        seen = after - slope * k["Tf"] + (seen - error + slope * k["Tf"]) * decay
    return np.linspace(0.0, h * steps, steps + 1), y


def _sampled(
    A: Array,
    B: Array,
    C: Array,
    k: Mapping[str, float],
    given: tuple[float, float],
    sampled: tuple[float, int],
    samples: int,
    per_sample: int,
) -> tuple[Array, Array]:
    (h, delay), (r, d), n = sampled, given, len(A)
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n] = A, B[:, 0]
    fine = expm(M * h / per_sample)
    x, integral, derivative, previous, sent = np.zeros(n), 0.0, 0.0, 0.0, [0.0] * delay
    y = np.zeros(samples * per_sample + 1)
    for i in range(samples):
        value = y[i * per_sample]
        error = k["c"] * r - value
        derivative = (k["Tf"] * derivative + k["Kd"] * (error - previous)) / (k["Tf"] + h)
        integral += k["Ki"] * h * (r - value)
        sent.append(k["Kp"] * (k["b"] * r - value) + integral + derivative)
        previous, held = error, sent.pop(0) + d
        for j in range(per_sample):
            x = fine[:n, :n] @ x + fine[:n, n] * held
            y[i * per_sample + j + 1] = C[0] @ x
    return np.linspace(0.0, h * samples, len(y)), y
