"""`identifiability`: what a set of logs can tell of a model's parameters, before and after a fit, in words."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.dynamics.system import System
from pneuopt.identification.checks import check_content, check_free, check_logs
from pneuopt.identification.problem import EstimationProblem, as_estimation_model
from pneuopt.identification.result import Verdict
from pneuopt.identification.unidentifiable import make_verdict
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.least_squares import MAX_SEARCH_SUBSTEPS, LeastSquares
from pneuopt.shooting.segments import Segments, segment, stable_substeps, start_nodes

if TYPE_CHECKING:
    import pandas as pd

MAX_REDUCTION_SEGMENTS = 2000  # segments whose sensitivities are reduced together


def identifiability(
    system: System | ClosedLoop,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
) -> Verdict:
    """What the logs can tell of the free parameters, before anything is fitted.

    Parameters
    ----------
    system : System or ClosedLoop
    experiments : sequence of Experiment
    parameters : ParameterSet
        As for `identify`.
    method : LeastSquares, optional

    Returns
    -------
    Verdict
        From the sensitivities of the measured outputs along the model's own first start, at the noise that the logs
        declare or show (Cramer-Rao: no estimate is better), and from what the motion lacks. A model that is wrong
        does worse.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    model = as_estimation_model(system)
    check_smooth(model)
    logs = check_logs(model, experiments, parameters)
    check_free(logs, parameters)
    check_content(logs)
    problem = EstimationProblem(model, tuple(logs), model.parameters | parameters, method or LeastSquares())
    return verdict_from_sensitivities(problem, problem.candidates()[0])


def verdict_from_sensitivities(problem: EstimationProblem, start: Start, variance: float = 1.0) -> Verdict:
    """The verdict at a start, or at a fit.

    Parameters
    ----------
    problem : Problem
    start : Start
    variance : float
        Of the residuals, in units of the noise's.
    """
    return make_verdict(problem, start, _root_information(problem, start) / math.sqrt(variance))


def verdict_from_covariance(
    problem: EstimationProblem, fit: Start, covariance: "pd.DataFrame", *, trusted: bool
) -> Verdict:
    """The verdict after a fit.

    Parameters
    ----------
    problem : Problem
    fit : Start
    covariance : DataFrame
        Of the estimates in their own units; NaN at a bound.
    trusted : bool
        The model explains the logs to their noise, so that its figures stand whatever the motion lacks.
    """
    unknowns = problem.unknowns().with_values(fit.parameters)
    chain = np.array([unknowns[str(n)].value if unknowns[str(n)].log else 1.0 for n in covariance.index])
    searched = covariance.to_numpy() / np.outer(chain, chain)
    keep = np.isfinite(np.diag(searched))
    root = np.zeros_like(searched)
    if keep.any():
        root[np.ix_(keep, keep)] = _root_of_inverse(searched[np.ix_(keep, keep)])
    return make_verdict(problem, fit, root, inside_bounds=keep, trusted=trusted)


def _root_information(problem: EstimationProblem, start: Start) -> Array:
    """A square root of the information about the free parameters, as searched, once the start states are solved for.

    Along the start's states, with no gaps: what a segment begins with is what all before it hand on. NaN where that is
    not finite, or the start so stiff that integrating it would take hours.
    """
    segments = segment(problem.transcription(start))
    parameters = segments.transcription.parameters
    q = np.array([p.value for p in parameters.values()])
    chain = np.array([p.value if p.log else 1.0 for p in parameters.values() if p.free])
    nodes = start_nodes(segments)
    substeps = problem.method.substeps or stable_substeps(segments, nodes, q)
    if substeps > MAX_SEARCH_SUBSTEPS:
        return np.full((len(chain), len(chain)), np.nan)
    run = segments.run(nodes, q, substeps, sensitivities=True)
    assert run.dy is not None
    assert run.dx_end is not None
    seen = np.where(np.isfinite(segments.measured)[..., None], run.dy / segments.noise[..., None], 0.0)
    roots = [np.zeros((0, len(chain)))]
    for first, last in _log_chains(segments):
        roots.append(_log_root_information(segments, seen[first:last], run.dx_end[first:last], first, chain))
    return _triangularise(np.concatenate(roots))


def _log_chains(segments: Segments) -> list[tuple[int, int]]:
    """First and last segment (exclusive) of each chain of linked ones."""
    ends = np.flatnonzero(~segments.linked) + 1
    return list(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True))


def _log_root_information(segments: Segments, seen: Array, handed_on: Array, first: int, chain: Array) -> Array:
    """One log's root of information about the parameters: a QR with its start state in front, which is then cut off."""
    n, k = handed_on.shape[1], len(chain)
    carried = np.concatenate([np.eye(n), np.zeros((n, k))], axis=1)
    carried[np.isfinite(segments.fixed_start[first])] = 0.0
    root, rows = np.zeros((0, n + k)), []
    chosen = np.concatenate([np.zeros((len(segments.columns), n)), _column_derivatives(segments, first, chain)], axis=1)
    for i, (y, x) in enumerate(zip(seen, handed_on, strict=True)):
        moved = np.concatenate([carried, chosen])
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append(y.reshape(-1, y.shape[-1]) @ moved)
            carried = x @ moved
        if len(rows) == MAX_REDUCTION_SEGMENTS or i == len(seen) - 1:
            root, rows = _triangularise(np.concatenate([root, *rows])), []
    return np.asarray(root[n:, n:])


def _column_derivatives(segments: Segments, first: int, chain: Array) -> Array:
    """d(sensitivity column)/d(free parameter, as searched), the same in all segments of a log."""
    index = np.full(len(segments.transcription.parameters), -1, dtype=np.intp)
    index[segments.transcription.free] = np.arange(len(chain))
    unknown = index[segments.parameter_positions[first, segments.columns]]
    return np.where(unknown[:, None] == np.arange(len(chain)), chain, 0.0)


def _triangularise(rows: Array) -> Array:
    """A square upper triangle with the same Gram matrix."""
    width = rows.shape[1]
    padded = np.concatenate([rows, np.zeros((max(0, width - len(rows)), width))])
    finite = bool(np.isfinite(padded).all())
    return np.asarray(np.linalg.qr(padded, mode="r")) if finite else np.full((width, width), np.nan)


def _root_of_inverse(covariance: Array) -> Array:
    """R with R'R the inverse of a covariance, whatever its units."""
    deviation = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    return np.asarray((vectors / np.sqrt(np.maximum(values, 1e-14))).T / deviation)
