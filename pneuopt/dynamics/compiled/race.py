"""`race`: candidates that run on several cases, each pair a SIMD lane, until they are certain to lose to their rivals.

A bound of a candidate's merit is read while its responses run; it can only grow. When it passes the rival's merit, the
candidate's lanes are dropped and the next pairs take their places. The first two outputs of the system are the measured
signal and the command; where a period is given, the last one is the signal's integral.
"""

import ctypes
from dataclasses import dataclass

import numpy as np

from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.quantities.arrays import Array, Indices

RACE_VALUES = ("SettlingTime", "Overshoot", "PeakControl", "IAE", "ISE", "ITAE")  # as race.c numbers them


@dataclass(frozen=True, eq=False)
class RaceCourse:
    """The cases of a race and the grids on which they run."""

    u: Array  # (n_grids, n, n_inputs)
    # t, h (n_grids, n): instants and steps [s]
    t: Array
    h: Array
    # grid, length, first (n_cases,): each case's grid, the number of its samples, and the first one from the step on
    grid: Indices
    length: Indices
    first: Indices
    # (n_cases, 7): the reference after the step, the step's size, the signal before it, the spacing of the samples
    # [s], the time of `first` after the step [s], 1 for a step or 0 for a disturbance, and what fraction of the step
    # a band of 1 is
    settings: Array
    substeps: int  # RK4 steps a sample
    every: int  # samples between two states that are kept


@dataclass(frozen=True, eq=False)
class RaceMerit:
    """What a bound of the merit is made of."""

    bands: Array  # half widths of settling bands, in what the settings say, over which the settling time is averaged
    # weights, limits (6,): of `RACE_VALUES`: weights in the objective, 0 for none, and limits, inf for none
    weights: Array
    limits: Array
    # worst, penalty: a merit beyond any objective, and the weight of a limit's relative excess in multiples of it
    worst: float
    penalty: float
    runaway: float  # size of signal and command from which a candidate has lost


@dataclass(frozen=True, eq=False)
class RaceOutcome:
    """How a race ended."""

    loser: Indices  # (m,): the case by which each candidate lost; -1: it came through
    y: Array  # (m, n_cases, n, n_outputs): the outputs of those that came through
    x: Array  # (m, n_cases, k, n_states): their states at every `RaceCourse.every`-th sample
    x_end: Array  # (m, n_cases, n_states)


class _RaceStruct(ctypes.Structure):
    """The struct Race of race.c."""

    _fields_ = (
        *((n, ctypes.c_longlong) for n in ("cases", "samples", "bands", "every")),
        ("substeps", ctypes.c_int),
        *((n, ctypes.c_double) for n in ("worst_merit", "penalty", "runaway")),
        *((n, ctypes.c_void_p) for n in ("u", "t", "h", "grid", "length", "first", "settings")),
        *((n, ctypes.c_void_p) for n in ("p", "x0", "period", "order", "rival", "band", "weight", "limit")),
        *((n, ctypes.c_void_p) for n in ("y", "x", "x_end", "loser", "worst", "stop")),
    )


@dataclass(frozen=True, eq=False)
class RaceField:
    """The candidates of a race."""

    p: Array  # (m, n_cases, n_parameters)
    x0: Array  # (m, n_cases, n_states)
    period: Array  # (m, n_cases): the time over which a response is averaged [s]; 0: it is not
    order: Indices  # (m, n_cases): each candidate's cases in the order in which they run
    rivals: Array  # (m,): the merits to beat


def race(rollout: Rollout, course: RaceCourse, merit: RaceMerit, candidates: RaceField, y: Array) -> RaceOutcome:
    """Run a race on machine code without sensitivities; the outputs are put into `y` (m, n_cases, n, n_outputs)."""
    m, cases = candidates.order.shape
    kept_states = np.empty((m, cases, -(-course.t.shape[1] // course.every), rollout.n_states))
    outcome = RaceOutcome(np.full(m, -1, dtype=np.int64), y, kept_states, np.empty((m, cases, rollout.n_states)))
    given = vars(course) | vars(candidates) | {"band": merit.bands, "weight": merit.weights, "limit": merit.limits}
    given["rival"] = given.pop("rivals")
    whole = ("grid", "length", "first", "order")
    kept = {
        n: np.ascontiguousarray(a, dtype=np.int64 if n in whole else np.float64)
        for n, a in given.items()
        if n not in ("substeps", "every")
    }
    kept |= {"y": y, "x": kept_states, "x_end": outcome.x_end, "loser": outcome.loser}
    kept["worst"] = np.zeros((m, len(RACE_VALUES)))
    counts = cases, course.t.shape[1], len(merit.bands), course.every, course.substeps
    sizes = *counts, merit.worst, merit.penalty, merit.runaway
    work = m * cases * course.t.shape[1] * course.substeps
    rollout.race(_RaceStruct(*sizes, **{n: a.ctypes.data for n, a in kept.items()}), m, work, list(kept.values()))
    return outcome
