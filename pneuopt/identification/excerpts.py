"""`cut_excerpts`: the same problem on the liveliest part of each long log, from whose answer the whole one begins.

A search costs as much as its logs are long, and most of its iterations find the way from a rough start; a part of a
minute's log shows that way as well (`problems/identify/random_plants.py --kind other`).
"""

import math
from dataclasses import replace

import numpy as np

from pneuopt.dynamics.compiled.rollout import check_during_runs
from pneuopt.dynamics.hooks import Start
from pneuopt.identification.checks import outputs_in_log
from pneuopt.identification.problem import EstimationProblem
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.shooting.filters import GATHERED_DEVIATION, filter_nodes
from pneuopt.shooting.least_squares import BudgetSpentError
from pneuopt.shooting.segments import choose_integration, segment, start_nodes

# segments of an excerpt: fewer may lack motion that a parameter needs, more cost time
EXCERPT_SEGMENTS = 1000
# length of a log, over that of an excerpt, from which on it has one: lower spends more on excerpts than they save,
# higher searches long logs from a rough start
MIN_LENGTH_RATIO = 2.5
MAX_SEGMENTS = 20_000  # of logs whose states are filtered one node after the other: more take longer than they save


def cut_excerpts(problem: EstimationProblem) -> EstimationProblem | None:
    """The problem with an excerpt in place of each long log.

    Parameters
    ----------
    problem : EstimationProblem

    Returns
    -------
    EstimationProblem or None
        None where there is nothing to gain: no long log, one with holes, windows, or a model without guesses to try.
    """
    if math.isfinite(problem.window) or not problem.has_gaps or len(problem.candidates()) < 2:
        return None
    if not problem.system.states or any(e.holes for e in problem.experiments) or problem.weights:
        return None
    parts = tuple(_cut(problem, e) for e in problem.experiments)
    whole, kept = (sum(len(e.trajectory) for e in each) for each in (problem.experiments, parts))
    is_huge = sum(e.trajectory.duration for e in problem.experiments) > MAX_SEGMENTS * problem.method.segment_time
    return replace(problem, experiments=parts) if whole >= MIN_LENGTH_RATIO * kept and not is_huge else None


def filter_states(problem: EstimationProblem, start: Start, gathered: float = GATHERED_DEVIATION) -> Start:
    """The start with states along the logs that fit its parameters (`shooting.state_filter`).

    Parameters
    ----------
    problem : EstimationProblem
    start : Start
    gathered : float
        As of `filter_nodes`; the better the parameters are known, the less.

    Returns
    -------
    Start
        As it was, where the CPU budget ends before.
    """
    segments = segment(problem.transcription(start))
    q = np.array([p.value for p in segments.transcription.parameters.values()])
    try:
        with check_during_runs(problem.method.budget.check):
            nodes = filter_nodes(segments, start_nodes(segments), q, gathered)
            segments, substeps = choose_integration(segments, nodes, q)
            run = segments.run(nodes, q, substeps, states=True)
    except BudgetSpentError:
        return start
    names = (e.name for e in problem.experiments)
    return replace(start, states=dict(zip(names, segments.trajectories(run), strict=True)))


def liveliest_part(columns: Array, count: int) -> int:
    """The first row of the part of so many rows with the largest product of the columns' variances.

    A product, for a part in which one output hardly moves shows no friction, however much the others do.

    Parameters
    ----------
    columns : ndarray, shape (m, ..., k)
        NaN where nothing was measured.
    count : int

    Returns
    -------
    int
    """
    flat = columns.reshape(len(columns), -1, columns.shape[-1])
    known = np.isfinite(flat)
    # about the mean of all rows and over their spread, sums of squares lose no digits that count
    middle = np.where(known, flat, 0.0).sum(axis=(0, 1)) / np.maximum(known.sum(axis=(0, 1)), 1)
    centred = np.where(known, flat - middle, 0.0)
    scaled = centred / np.maximum(np.abs(centred).max(axis=(0, 1)), np.finfo(float).tiny)
    first = np.arange(0, max(1, len(columns) - count + 1), max(1, count // 10))
    last = np.minimum(first + count, len(columns))
    sums = [np.cumsum(np.insert(part.sum(axis=1), 0, 0.0, axis=0), axis=0) for part in (known, scaled, scaled**2)]
    counts, totals, squares = (each[last] - each[first] for each in sums)
    counts = np.maximum(counts, 1)
    variances = np.maximum(squares / counts - (totals / counts) ** 2, np.finfo(float).eps)
    return int(first[np.argmax(np.log(variances).sum(axis=1))])


def _cut(problem: EstimationProblem, experiment: Experiment) -> Experiment:
    """The liveliest part of a log; the log itself where it is short."""
    run = experiment.trajectory
    step = float(np.median(np.diff(run.t)))
    count = math.ceil(EXCERPT_SEGMENTS * max(problem.method.segment_time, step) / step)
    if len(run) < MIN_LENGTH_RATIO * count:
        return experiment
    columns = [run.fill_gaps(name) for name in outputs_in_log(problem.system, experiment)]
    begin = liveliest_part(np.column_stack(columns), count)
    return replace(experiment, trajectory=run.rows(begin, begin + count), source=None)
