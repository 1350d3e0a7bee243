"""`check_machine_code`: compiled models against the VM, their derivatives against differences, and their speed."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pneuopt.dynamics.compiled.rollout import Pieces, Rollout, RolloutResult
from pneuopt.dynamics.tolerances import LARGEST_DERIVATIVE_ERROR, LARGEST_DISTANCE
from pneuopt.quantities.arrays import Array

WAYS = {"vm": 0, "scalar": 1, "lanes": None}  # the lanes of a Rollout


@dataclass(frozen=True)
class SelfCheck:
    """What was found."""

    nanoseconds: dict[str, float]  # CPU time of a step, by "vm", "scalar" and "lanes"; without a compiler by "vm" alone
    # the largest of machine code from the VM, of states and sensitivities, relative to their largest value; 0 without
    # a compiler
    distance: float
    derivative_error: float  # the largest distance of sensitivities from central differences, likewise
    lanes: int  # segments that run at once; 0 without a compiler

    @property
    def is_good(self) -> bool:
        """Whether both agree."""
        return self.distance <= LARGEST_DISTANCE and self.derivative_error <= LARGEST_DERIVATIVE_ERROR


def check_machine_code(
    pieces: Pieces,
    x0: Array,
    u: Array,
    p: Array,
    step: float,
    *,
    segments: int = 40,
    samples: int = 25,
    substeps: int = 10,
    difference: float = 1e-6,
) -> SelfCheck:
    """Run a system each way, with sensitivities to all parameters that are not zero, and without, by steps [s].

    Segments get the largest inputs `u` (n_inputs,) from -1 to 1 times; a central difference is relative.
    """
    shares = np.linspace(-1, 1, segments * samples).reshape(segments, samples, 1)
    t, h = np.tile(np.arange(samples) * step, (segments, 1)), np.full((segments, samples), step)
    wrt = tuple(np.flatnonzero(p).tolist())

    def run(rollout: Rollout, values: Array = p) -> RolloutResult:
        return rollout.run(np.tile(x0, (segments, 1)), shares * u, values, t, h, substeps=substeps)

    found, nanoseconds, lanes = dict[str, Array](), dict[str, float](), 0
    for way, number in WAYS.items():
        plain = Rollout(pieces, threads=1, lanes=number)
        if number != 0 and not plain.uses_machine_code:
            break
        nanoseconds[way] = 1e9 * _fastest(lambda plain=plain: run(plain)) / (segments * samples * substeps)  # type: ignore[misc]
        slope = run(Rollout(pieces, wrt, threads=1, lanes=number)).dx_end
        assert slope is not None
        found[way], lanes = slope, max(lanes, plain.lanes)
    plain = Rollout(pieces, threads=1, lanes=0)
    differences = np.empty_like(found["vm"])
    for column, k in enumerate(wrt):
        ends = [run(plain, np.where(np.arange(len(p)) == k, p * (1 + sign * difference), p)).x_end for sign in (1, -1)]
        differences[..., column] = (ends[0] - ends[1]) / (2 * difference * p[k])
    distance = max(_distance(slope, found["vm"]) for slope in found.values())
    return SelfCheck(nanoseconds, distance, _distance(differences, found["vm"]), lanes)


def _distance(a: Array, b: Array) -> float:
    """The largest, each column relative to its largest value."""
    size = np.abs(b).max(axis=(0, 1))
    size[size == 0] = 1.0
    return float(np.max(np.abs(a - b) / size))


def _fastest(run: Callable[[], object]) -> float:
    """CPU seconds of the faster of two runs."""
    found = []
    for _ in range(2):
        began = time.process_time()
        run()
        found.append(time.process_time() - began)
    return min(found)
