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
    """The cases of a race and the grids on which they run.

    Parameters
    ----------
    u : ndarray, shape (n_grids, n, n_inputs)
    t, h : ndarray, shape (n_grids, n)
        Instants and steps [s].
    grid, length, first : ndarray of int, shape (n_cases,)
        Each case's grid, the number of its samples, and the first one from the step on.
    settings : ndarray, shape (n_cases, 7)
        The reference after the step, the step's size, the signal before it, the spacing of the samples [s], the time of
        `first` after the step [s], 1 for a step or 0 for a disturbance, and what fraction of the step a band of 1 is.
    substeps : int
        RK4 steps a sample.
    every : int
        Samples between two states that are kept.
    """

    u: Array
    t: Array
    h: Array
    grid: Indices
    length: Indices
    first: Indices
    settings: Array
    substeps: int
    every: int


@dataclass(frozen=True, eq=False)
class RaceMerit:
    """What a bound of the merit is made of.

    Parameters
    ----------
    bands : ndarray
        Half widths of settling bands, in what the settings say, over which the settling time is averaged.
    weights, limits : ndarray, shape (6,)
        Of `RACE_VALUES`: weights in the objective, 0 for none, and limits, inf for none.
    worst, penalty : float
        A merit beyond any objective, and the weight of a limit's relative excess in multiples of it.
    runaway : float
        Size of signal and command from which a candidate has lost.
    """

    bands: Array
    weights: Array
    limits: Array
    worst: float
    penalty: float
    runaway: float


@dataclass(frozen=True, eq=False)
class RaceOutcome:
    """How a race ended.

    Attributes
    ----------
    loser : ndarray of int, shape (m,)
        The case by which each candidate lost; -1: it came through.
    y : ndarray, shape (m, n_cases, n, n_outputs)
        The outputs of those that came through.
    x : ndarray, shape (m, n_cases, k, n_states)
        Their states at every `RaceCourse.every`-th sample.
    x_end : ndarray, shape (m, n_cases, n_states)
    """

    loser: Indices
    y: Array
    x: Array
    x_end: Array


class _Race(ctypes.Structure):
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
    """The candidates of a race.

    Parameters
    ----------
    p : ndarray, shape (m, n_cases, n_parameters)
    x0 : ndarray, shape (m, n_cases, n_states)
    period : ndarray, shape (m, n_cases)
        The time over which a response is averaged [s]; 0: it is not.
    order : ndarray of int, shape (m, n_cases)
        Each candidate's cases in the order in which they run.
    rivals : ndarray, shape (m,)
        The merits to beat.
    """

    p: Array
    x0: Array
    period: Array
    order: Indices
    rivals: Array


def race(rollout: Rollout, course: RaceCourse, merit: RaceMerit, candidates: RaceField, y: Array) -> RaceOutcome:
    """Run a race.

    Parameters
    ----------
    rollout : Rollout
        With machine code, and without sensitivities.
    y : ndarray, shape (m, n_cases, n, n_outputs)
        Where the outputs are put.
    """
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
    kept |= {
        "y": y,
        "x": kept_states,
        "x_end": outcome.x_end,
        "loser": outcome.loser,
        "worst": np.zeros((m, len(RACE_VALUES))),
    }
    sizes = (
        cases,
        course.t.shape[1],
        len(merit.bands),
        course.every,
        course.substeps,
        merit.worst,
        merit.penalty,
        merit.runaway,
    )
    work = m * cases * course.t.shape[1] * course.substeps
    rollout.race(_Race(*sizes, **{n: a.ctypes.data for n, a in kept.items()}), m, work, list(kept.values()))
    return outcome
