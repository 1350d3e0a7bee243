"""Soft-continuity multiple shooting: the gaps between segments are weighted residuals, solved by Levenberg-Marquardt.

One nonlinear least squares in all nodes and parameters; each step is a banded Cholesky with an arrow, linear in the
record's length. The gaps are tightened in stages, so that a bad start is never integrated through (NUMERICS section 3).
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pneuopt.nlp.arrow import Step
from pneuopt.nlp.equations import Equations, normal_equations, reconnected
from pneuopt.nlp.segments import Segments, segment, start_nodes, substeps_for, tightness
from pneuopt.nlp.status import Code, Solution, Status
from pneuopt.nlp.transcription import Transcription

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[str], None]
UNFELT = 1e-6  # squared residuals that an e-fold change of a log parameter has to move, or it stays where it is


@dataclass(frozen=True)
class Stage:
    """One tightness of the gaps.

    Parameters
    ----------
    gap : float
        Standard deviation of a gap, as a fraction of the state's nominal size.
    iterations : int
        At most.
    refine : int
        Integration steps, as a multiple of the search's.
    """

    gap: float
    iterations: int
    refine: int = 1


@dataclass(frozen=True)
class LeastSquares:
    """How to solve by lifted least squares.

    Parameters
    ----------
    stages : tuple of Stage
        Continuation in the gaps' weight; the last stage decides on convergence.
    segment_time : float
        Time between two shooting nodes [s]; math.inf for one segment a log.
    substeps : int, optional
        Integration steps a sample; default: from the stiffness along the start, h |lambda| <= 1.4 a step, and half that
        in the last stage.
    tolerance : float
        Of the last undamped parameter step, in standard deviations.
    kinematic : float
        States whose rate holds no free parameter keep their gaps this much smaller.
    progress : callable, optional
        Receives one line of text an iteration.
    """

    stages: tuple[Stage, ...] = (
        Stage(1e-2, 12),
        Stage(3e-3, 8),
        Stage(1e-3, 8),
        Stage(3e-4, 8),
        Stage(1e-4, 8),
        Stage(1e-5, 30, refine=2),
    )
    segment_time: float = 0.01
    substeps: int | None = None
    tolerance: float = 0.1
    kinematic: float = 0.01
    progress: Progress | None = None


@dataclass(frozen=True, eq=False)
class Fit:
    """A solution with what its last factor says about the parameters.

    Attributes
    ----------
    solution : Solution
    covariance : ndarray, shape (k, k), or None
        Of the free parameters in their own units, at unit noise scale; None where the data do not determine them.
    chi_square : float
        Sum of squared data residuals, in noise standard deviations.
    count : int
        Number of data residuals.
    at_bound : ndarray of bool, shape (k,)
    """

    solution: Solution
    covariance: Array | None
    chi_square: float
    count: int
    at_bound: Mask


def solve_least_squares(transcription: Transcription, method: LeastSquares | None = None) -> Fit:
    """Solve a transcription that has residuals and bounds, but neither costs nor limits.

    Parameters
    ----------
    transcription : Transcription
        Its phases' guesses and its parameters' values are the start.
    method : LeastSquares, optional

    Returns
    -------
    Fit
        Whatever its status; an interruption (Ctrl-C) returns the best iterate so far, marked.
    """
    return _Search(segment(transcription), method or LeastSquares()).solve()


@dataclass(frozen=True, eq=False)
class _Iterate:
    """The unknowns (nodes in SI, z as searched), and what the equations say there."""

    nodes: Array
    z: Array
    equations: Equations

    @property
    def cost(self) -> float:
        return self.equations.cost


class _Search:
    """Levenberg-Marquardt on the nodes and the free parameters of one transcription."""

    def __init__(self, segments: Segments, method: LeastSquares) -> None:
        self.segments, self.method = segments, method
        parameters = segments.transcription.parameters
        free = [p for p in parameters.values() if p.free]
        self.q = np.array([p.value for p in parameters.values()])
        self.log = np.array([p.log for p in free], dtype=bool)
        self.lower, self.upper = (self._searched(np.array([getattr(p, b) for p in free])) for b in ("lower", "upper"))
        self.iterations = 0
        self.start = start_nodes(segments)
        self.substeps = method.substeps or substeps_for(segments, self.start, self.q)
        self.tightness = tightness(segments, method.kinematic)

    def solve(self) -> Fit:
        began = time.perf_counter()
        z = np.clip(self._searched(self.q[self.segments.transcription.free]), self.lower, self.upper)
        current = self._evaluate(self.start, z, self.method.stages[0])
        status = Status(Code.DIVERGED, "the model is not finite at the start; check values and units")
        stage = self.method.stages[0]
        try:
            for stage in self.method.stages:
                current = self._evaluate(current.nodes, current.z, stage)
                if not math.isfinite(current.cost):
                    break
                current = self._run_stage(current, stage)
                status = self._judge(current)
        except KeyboardInterrupt:
            status = Status(Code.INTERRUPTED, "the best iterate so far; run again for an answer")
        return self._fit(current, stage, status, time.perf_counter() - began)

    def _run_stage(self, current: _Iterate, stage: Stage) -> _Iterate:
        is_last = stage is self.method.stages[-1]
        damping = 1e-3
        for _ in range(stage.iterations):
            self.iterations += 1
            trial, damping = self._step(current, damping, stage)
            if trial is None:
                break
            drop = (current.cost - trial.cost) / max(current.cost, 1e-300)
            moved = float(np.max(np.abs(trial.z - current.z) / (1e-3 + np.abs(current.z)), initial=0.0))
            current = trial
            self._report(current, stage)
            if drop < (1e-6 if is_last else 1e-3) and (not is_last or moved < 1e-4):
                break
        return current

    def _step(self, current: _Iterate, damping: float, stage: Stage) -> tuple[_Iterate | None, float]:
        """Shorten the step until the cost falls; None where ten tries do not help."""
        keep = self._movable(current)
        for _ in range(10):
            solved = current.equations.arrow.solve(damping, keep)
            if solved is not None and np.max(np.abs(solved.parameters[self.log]), initial=0.0) <= 2:
                for trial in self._trials(current, solved, stage):
                    if trial.cost < current.cost:
                        return trial, damping * 0.1 if damping > 1e-9 else 0.0
            damping = max(damping * 10, 1e-9)
        return None, damping

    def _trials(self, current: _Iterate, step: Step, stage: Stage) -> Iterator[_Iterate]:
        """The step with its gaps corrected to second order (curved valleys of tight gaps), then the step as it is."""
        z = np.clip(current.z + step.parameters, self.lower, self.upper)
        nodes = current.nodes + step.nodes * self.segments.nominal
        if self.segments.linked.any():
            end = self.segments.run(nodes, self._values(z), self.substeps * stage.refine, sensitivities=False).x_end
            shifted = reconnected(self.segments, current.equations, step.nodes, z - current.z, nodes, end)
            if np.isfinite(shifted).all():
                yield self._evaluate(shifted, z, stage)
        yield self._evaluate(nodes, z, stage)

    def _evaluate(self, nodes: Array, z: Array, stage: Stage) -> _Iterate:
        sigma = stage.gap * self.tightness
        chain = np.where(self.log, np.exp(np.where(self.log, z, 0.0)), 1.0)
        equations = normal_equations(self.segments, nodes, self._values(z), chain, sigma, self.substeps * stage.refine)
        return _Iterate(nodes, z, equations)

    def _movable(self, current: _Iterate) -> Mask:
        """Parameters that are neither pressed against a bound nor without any effect on the residuals here."""
        gradient, felt = current.equations.arrow.gradient, np.diag(current.equations.arrow.corner)
        return (felt > np.where(self.log, UNFELT, 0.0)) & ~(
            ((current.z <= self.lower) & (gradient > 0)) | ((current.z >= self.upper) & (gradient < 0))
        )

    def _judge(self, current: _Iterate) -> Status:
        """Converged means that a full undamped step would move nothing that the data can tell apart."""
        keep = self._movable(current)
        solved = current.equations.arrow.solve(0.0, keep)
        if solved is None:
            return Status(Code.NOT_CONVERGED, "the data do not determine all free parameters; fix some or log more")
        names = self.segments.transcription.parameters.free_names
        deviation = 1 / np.sqrt(np.maximum(np.diag(solved.schur), 1e-300))
        step = np.where(keep, np.abs(solved.parameters) / deviation, 0.0)
        worst = int(np.argmax(step)) if len(step) else 0
        noise = max(1.0, math.sqrt(current.equations.chi_square / max(1, current.equations.count)))
        if len(step) and step[worst] > self.method.tolerance * noise:
            return Status(
                Code.NOT_CONVERGED,
                f"{names[worst]} would still move by {step[worst]:.2g} standard deviations; "
                "try more iterations, other start values, or fix a parameter",
            )
        gap = current.equations.largest_gap
        return Status(Code.CONVERGED, f"{self.iterations} iterations, largest gap {gap:.1g} of a state's nominal size")

    def _fit(self, current: _Iterate, stage: Stage, status: Status, seconds: float) -> Fit:
        transcription, equations = self.segments.transcription, current.equations
        q = self._values(current.z)
        free = transcription.parameters.free_names
        values = dict(zip(free, q[transcription.free].tolist(), strict=True))
        substeps = self.substeps * stage.refine
        trajectories = self.segments.trajectories(current.nodes, q, substeps)
        stats = {
            "iterations": float(self.iterations),
            "seconds": seconds,
            "cost": equations.cost,
            "substeps": float(substeps),
            "largest_gap": equations.largest_gap,
            "integration_error": self._integration_error(current.nodes, q, substeps),
        }
        at_bound = (current.z <= self.lower) | (current.z >= self.upper)
        covariance = equations.covariance(~at_bound) if math.isfinite(equations.cost) else None
        solution = Solution(trajectories, transcription.parameters.with_values(values), status, stats)
        return Fit(solution, covariance, equations.chi_square, equations.count, at_bound)

    def _integration_error(self, nodes: Array, q: Array, substeps: int) -> float:
        """Largest change of an output when the steps are halved [noise standard deviations]."""
        coarse, fine = (self.segments.run(nodes, q, k, sensitivities=False).y for k in (substeps, 2 * substeps))
        error = np.abs(coarse - fine) / self.segments.noise
        return float(np.max(error, where=np.isfinite(self.segments.measured), initial=0.0))

    def _report(self, current: _Iterate, stage: Stage) -> None:
        if self.method.progress is not None:
            gap = current.equations.largest_gap
            number = self.method.stages.index(stage) + 1
            self.method.progress(
                f"stage {number}/{len(self.method.stages)}  iteration {self.iterations}  "
                f"cost {current.cost:.6g}  largest gap {gap:.1e}"
            )

    def _searched(self, values: Array) -> Array:
        """Logarithms where the parameter asks for it; a bound that is not positive is no bound there."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.where(values > 0, np.log(values), -np.inf), values)

    def _values(self, z: Array) -> Array:
        """All the problem's parameter values at the searched ones."""
        q = self.q.copy()
        own = np.where(self.log, np.exp(np.where(self.log, z, 0.0)), z)
        free = [p for p in self.segments.transcription.parameters.values() if p.free]
        q[self.segments.transcription.free] = [min(max(v, p.lower), p.upper) for v, p in zip(own, free, strict=True)]
        return q
