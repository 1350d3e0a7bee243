"""Holes of a log's inputs: a short one is bridged, at a long one the log is cut; `repair_log` says which and where."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pneuopt.dynamics.runnable import Fittable
from pneuopt.dynamics.system import names
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.intersample import Intersample, usual_intersample
from pneuopt.quantities.trajectories import Trajectory

# Missing samples in a row that are bridged: with more an input that swings is wrong between its ends; with fewer a log
# that loses a block now and then falls apart, and each part has a start state to be found.
MAX_BRIDGE = 10
MIN_RUN = 10  # samples with an output between two holes: fewer hardly find the start state of a part, more lose data


def input_behaviour(system: Fittable, experiment: Experiment) -> dict[str, Intersample]:
    """How each of the system's inputs runs between two samples of a log: as the log says, or as is usual."""
    said = experiment.intersample
    return {q.name: said.get(q.name) or usual_intersample(q.name, q.unit) for q in system.inputs}


def repair_log(system: Fittable, experiment: Experiment) -> tuple[Experiment, tuple[str, ...]]:
    """Bridge the short holes of a log's inputs and cut it at the long ones, for want of rows or of single samples.

    Parameters
    ----------
    system : Fittable
    experiment : Experiment
        With a name, and with every input of the system.

    Returns
    -------
    experiment : Experiment
        With every sample of every input. Where it is cut, `holes` names the samples whose inputs nobody knows; what was
        measured there is left out.
    sentences : tuple of str
        What was done, with figures.

    Raises
    ------
    LogError
        If a long hole cuts the log of a sampled loop, whose controller goes on meanwhile, or leaves nothing of a log.
    """
    log, inputs = experiment.trajectory, names(system.inputs)
    known: Mask = np.asarray(np.isfinite(log.matrix(inputs)).all(axis=1))
    holes = _find_holes(log, known, system) if system.states else []
    lost = ~known if not system.states else _inside(holes, len(log))
    everything = (
        f"{experiment.name}: no part holds {', '.join(inputs)} and {MIN_RUN} samples of an output; log them together"
    )
    require(not lost.all(), everything, LogError)
    where = ", ".join(f"from {log.t[max(a - 1, 0)]:g} s to {log.t[min(b, len(log) - 1)]:g} s" for a, b in holes[:3])
    where += ", ..." if len(holes) > 3 else ""
    if holes and system.motion().sample_time is not None:
        message = f"{experiment.name}: inputs are unknown {where}, and a sampled controller goes on meanwhile"
        raise LogError(f"{message}; cut the log in two there")
    short = ~known & ~lost
    sentences = [f"{experiment.name}: inputs are unknown {where}; the log is cut there"] if holes else []
    if short.any():
        gaps = f"{experiment.name}: {int(short.sum())} samples lack an input, {_longest_run(short)} in a row at most"
        sentences.append(f"{gaps}; they are bridged")
    if not (sentences or lost.any()):
        return experiment, ()
    values = _bridge(log, input_behaviour(system, experiment), lost)
    return replace(experiment, trajectory=log.with_columns(values), holes=tuple(holes)), tuple(sentences)


def known_runs(experiment: Experiment) -> list[tuple[int, int]]:
    """Begin and end of each part of a repaired log, as a range of samples, that no hole interrupts."""
    edges = [0, *(edge for hole in experiment.holes for edge in hole), len(experiment.trajectory)]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]


def window_runs(experiment: Experiment, window: float) -> list[tuple[int, int]]:
    """Begin and end of each window of a repaired log; what is left of a part joins its last one if below half of one.

    Examples
    --------
    >>> log = Experiment(Trajectory(np.arange(11) * 0.1, {"speed": np.zeros(11)}))
    >>> window_runs(log, 0.4), window_runs(log, 0.3)
    ([(0, 4), (4, 8), (8, 11)], [(0, 3), (3, 6), (6, 9), (9, 11)])
    """
    n = max(1, round(window / float(np.median(np.diff(experiment.trajectory.t)))))
    out: list[tuple[int, int]] = []
    for begin, end in known_runs(experiment):
        edges = [begin, *range(begin + n, end - (n + 1) // 2 + 1, n), end]
        out += itertools.pairwise(edges)
    return out


def _find_holes(log: Trajectory, known: Mask, system: Fittable) -> list[tuple[int, int]]:
    """Begin and end of each long hole, as a range of samples: an empty one where only rows are missing."""
    at = np.flatnonzero(known)
    far = np.flatnonzero(np.diff(log.t[at]) > (MAX_BRIDGE + 1.5) * float(np.median(np.diff(log.t))))
    begins, ends = [*at[:1], *at[far + 1]], [*(at[far] + 1), *(at[-1:] + 1)]
    outputs = log.matrix(n for n in names(system.outputs) if n in log)
    measured: Mask = np.asarray(np.isfinite(outputs).any(axis=1))
    runs = [(int(a), int(b)) for a, b in zip(begins, ends, strict=True) if measured[a:b].sum() >= MIN_RUN]
    edges = [0, *(edge for run in runs for edge in run), len(log)]
    inner = range(2, len(edges) - 2, 2)
    outer = [(edges[k], edges[k + 1]) for k in (0, len(edges) - 2) if edges[k + 1] > edges[k]]
    return sorted({*outer, *((edges[k], edges[k + 1]) for k in inner)})


def _inside(holes: Sequence[tuple[int, int]], n: int) -> Mask:
    inside = np.zeros(n, dtype=bool)
    for begin, end in holes:
        inside[begin:end] = True
    return inside


def _bridge(log: Trajectory, behaviour: dict[str, Intersample], lost: Mask) -> dict[str, Array]:
    """The columns of a log without holes in its inputs, and without outputs where the inputs are lost."""
    out = {}
    for name in log:
        column, kind = log[name], behaviour.get(name)
        known = np.isfinite(column)
        if kind is None:
            out[name] = np.where(lost, np.nan, column)
        elif kind is Intersample.LINEAR:
            out[name] = np.interp(log.t, log.t[known], column[known])
        else:
            last = np.maximum.accumulate(np.where(known, np.arange(len(log)), 0))
            out[name] = np.where(known[last], column[last], column[np.argmax(known)])
    return out


def _longest_run(mask: Mask) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return int(np.max(edges[1::2] - edges[::2]))
