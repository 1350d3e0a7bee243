"""Soft-continuity multiple shooting: the gaps between segments are weighted residuals, solved by Levenberg-Marquardt.

One nonlinear least squares in all nodes and parameters; each step is a banded Cholesky with an arrow, linear in the
record's length. The gaps are tightened in stages, so that a bad start is never integrated through (NUMERICS section 3).
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pneuopt.nlp.arrow import Reduced, Step, scaled_inverse
from pneuopt.nlp.equations import Equations, normal_equations, reconnected
from pneuopt.nlp.segments import Segments, segment, start_nodes, substeps_for, tightness
from pneuopt.nlp.status import Code, Solution, Status
from pneuopt.nlp.transcription import Transcription

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[str], None]
LEAST_DAMPING = 1e-15  # relative to the diagonal, in which the gaps weigh up to 1e14
REFINEMENTS = 3  # halvings of the integration steps, at most, in search of an answer that does not depend on them
STIFFEST = 200  # integration steps a sample beyond which a search would take hours
MOST_REFINED = 8  # how far a stage may refine the start's integration steps
MOST_GAP_SHARE = 0.05  # of the cost: the gaps' residuals above it mean that they take up what the model cannot
NOISE_LEVEL = 1.2  # squared residuals a sample, in noise variances, up to which a fit is as good as the noise allows
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
        Integration steps a sample; default: from the stiffness at the start of each stage, h |lambda| <= 1.4 a step,
        half that in the last stage, and finer until halving the steps moves no estimate.
    tolerance : float
        Of the last undamped parameter step, in the parameter's standard deviations.
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
    progress: Progress | None = field(default=None, repr=False, compare=False)


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
    jumps : ndarray, shape (m, n_states), or None
        Where the gaps had to stand for noise of the states: the gap behind each linked segment, in nominal sizes.
    """

    solution: Solution
    covariance: Array | None
    chi_square: float
    count: int
    at_bound: Mask
    jumps: Array | None = None


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
        self.tightness = tightness(segments, method.kinematic)
        self.iterations, self.stage = 0, method.stages[0]
        self.is_loose, self.ends = False, list[_Iterate]()
        nodes = start_nodes(segments)
        self.needed = method.substeps or substeps_for(segments, nodes, self.q)
        self.substeps = self.coarsest = method.substeps or min(self.needed, STIFFEST)
        z = np.clip(self._searched(self.q[segments.transcription.free]), self.lower, self.upper)
        self.current = self._evaluate(nodes, z)

    def solve(self) -> Fit:
        began = time.perf_counter()
        try:
            status = self._run_stages()
        except KeyboardInterrupt:
            status = Status(Code.INTERRUPTED, "the best iterate so far; run again for an answer")
        return self._fit(status, time.perf_counter() - began)

    def _run_stages(self) -> Status:
        if self.needed > self.coarsest:
            told = (
                f"the model is so stiff that a sample takes {self.needed} integration steps; smooth its sharpest term "
            )
            return Status(
                Code.NOT_CONVERGED, told + "(friction.smoothing to 1e-4 m/s), or give LeastSquares(substeps=)"
            )
        for stage in self.method.stages:
            self.stage, self.substeps = stage, self._steps_of(stage)
            self.current = self._evaluate(self.current.nodes, self.current.z)
            if not math.isfinite(self.current.cost):
                return Status(Code.DIVERGED, "the model is not finite at the start; check values and units")
            self._run_stage()
            self.ends.append(self.current)
        status = self._judge(self.current)
        return self._refine(self._loosened(status) if self._is_torn() else status)

    def _is_torn(self) -> bool:
        """Whether the gaps take up what the model cannot; then the answer hangs on their weight."""
        return self.current.equations.gap_share > MOST_GAP_SHARE

    def _loosened(self, status: Status) -> Status:
        """Allow what a wrong model leaves as noise of its states: the tightest gaps with which all residuals agree."""
        last = self.method.stages[-1]
        for stage, end in zip(self.method.stages[-2::-1], self.ends[-2::-1], strict=True):
            if 2 * end.cost <= NOISE_LEVEL * end.equations.count:
                tight = self.current
                self.stage, self.is_loose = replace(stage, iterations=last.iterations, refine=last.refine), True
                self.substeps = self._steps_of(self.stage)
                self.current = self._evaluate(end.nodes, end.z)
                self._run_stage()
                found = self._judge(self.current)
                if found.converged:
                    return found
                self.stage, self.is_loose, self.current = last, False, tight
                break
        return status

    def _steps_of(self, stage: Stage) -> int:
        """Integration steps a sample of a stage: from the stiffness where it begins, for the start may mislead."""
        if self.method.substeps:
            return self.method.substeps * stage.refine
        needed = substeps_for(self.segments, self.current.nodes, self._values(self.current.z))
        return min(needed, MOST_REFINED * self.coarsest) * stage.refine

    def _refine(self, status: Status) -> Status:
        """Halve the integration steps until that moves no estimate, unless they were given."""
        for _ in range(0 if self.method.substeps else REFINEMENTS):
            if not status.converged:
                break
            self.substeps *= 2
            finer = self._evaluate(self.current.nodes, self.current.z)
            if not math.isfinite(finer.cost) or self._judge(finer).converged:
                self.substeps //= 2
                return status
            self.current = finer
            self._run_stage()
            status = self._judge(self.current)
        return status

    def _run_stage(self) -> None:
        is_last = self.is_loose or self.stage is self.method.stages[-1]
        damping = 1e-3
        for _ in range(self.stage.iterations):
            self.iterations += 1
            trial, damping = self._step(self.current, damping)
            if trial is None:
                break
            before, self.current = self.current, trial
            drop = (before.cost - trial.cost) / max(before.cost, 1e-300)
            moved = float(np.max(np.abs(trial.z - before.z) / (1e-3 + np.abs(before.z)), initial=0.0))
            self._report()
            if drop < (1e-8 if is_last else 1e-3) and (not is_last or moved < 1e-4):
                break

    def _step(self, current: _Iterate, damping: float) -> tuple[_Iterate | None, float]:
        """Shorten the step until the cost falls; None where ten tries do not help."""
        raise_by = 10.0
        for _ in range(10):
            reduced = current.equations.arrow.eliminate(damping)
            step = None if reduced is None else reduced.step(self._movable(current, reduced))
            if reduced and step and np.max(np.abs(step.parameters[self.log]), initial=0.0) <= 2:
                for trial in self._trials(current, reduced, step):
                    if trial.cost < current.cost:
                        return trial, damping * 0.1 if damping > LEAST_DAMPING else 0.0
            damping, raise_by = max(damping, LEAST_DAMPING) * raise_by, 3 * raise_by
        return None, damping

    def _trials(self, current: _Iterate, reduced: Reduced, step: Step) -> Iterator[_Iterate]:
        """The step with its gaps corrected to second order (curved valleys of tight gaps), then the step as it is."""
        z = np.clip(current.z + step.parameters, self.lower, self.upper)
        moved = z - current.z
        shift = reduced.following(moved)  # a bound may have cut the parameters' step short
        nodes = current.nodes + shift * self.segments.nominal
        if self.segments.linked.any():
            end = self.segments.run(nodes, self._values(z), self.substeps, sensitivities=False).x_end
            with np.errstate(all="ignore"):
                shifted = reconnected(self.segments, current.equations, shift, moved, nodes, end)
            if np.isfinite(shifted).all():
                yield self._evaluate(shifted, z)
        yield self._evaluate(nodes, z)

    def _evaluate(self, nodes: Array, z: Array) -> _Iterate:
        sigma = self.stage.gap * self.tightness
        chain = np.where(self.log, np.exp(np.where(self.log, z, 0.0)), 1.0)
        with np.errstate(all="ignore"):  # a step too far may overflow; its cost is infinite then
            equations = normal_equations(self.segments, nodes, self._values(z), chain, sigma, self.substeps)
        return _Iterate(nodes, z, equations)

    def _movable(self, current: _Iterate, reduced: Reduced) -> Mask:
        """Parameters that are neither pressed against a bound nor without any effect on the residuals here."""
        below = (current.z <= self.lower) & (reduced.gradient > 0)
        above = (current.z >= self.upper) & (reduced.gradient < 0)
        return self._felt(current) & ~(below | above)

    def _felt(self, current: _Iterate) -> Mask:
        """Parameters that have an effect on the residuals here."""
        return np.asarray(np.diag(current.equations.arrow.corner) > np.where(self.log, UNFELT, 0.0))

    def _at_bound(self, current: _Iterate) -> Mask:
        return np.asarray((current.z <= self.lower) | (current.z >= self.upper))

    def _judge(self, current: _Iterate) -> Status:
        """Converged means that a full undamped step would move nothing that the data can tell apart."""
        names = np.array(self.segments.transcription.parameters.free_names, dtype=object)
        equations = current.equations
        nothing = np.diag(equations.arrow.corner) == 0  # even at a bound
        idle = ~self._felt(current) & (nothing | ~self._at_bound(current))
        if idle.any():
            told = f"the data do not feel {' and '.join(names[idle])}; fix it, or log a run that does"
            return Status(Code.NOT_CONVERGED, told)
        reduced = equations.arrow.eliminate(0.0)
        if reduced is None:
            return Status(Code.NOT_CONVERGED, "the data do not determine the states; log another output")
        keep = self._movable(current, reduced)
        alike, solved = names[keep][equations.undetermined(reduced, keep)], reduced.step(keep)
        if alike.size or solved is None:
            told = f"the data do not determine {' and '.join(alike)}; fix one, or log a run that tells them apart"
            return Status(Code.NOT_CONVERGED, told)
        inverse = scaled_inverse(reduced.schur[np.ix_(keep, keep)])
        step = np.abs(solved.parameters[keep]) / np.sqrt(np.diag(inverse))
        noise = max(1.0, math.sqrt(equations.chi_square / max(1, equations.count)))
        if np.max(step, initial=0.0) > self.method.tolerance * noise:
            worst = int(np.argmax(step))
            told = f"{names[keep][worst]} would still move by {step[worst] / noise:.2g} standard deviations; "
            return Status(Code.NOT_CONVERGED, told + "try more iterations, other start values, or fix a parameter")
        gap, misfit = equations.largest_gap, 2 * equations.cost / max(1, equations.count)
        if equations.gap_share > MOST_GAP_SHARE and not (self.is_loose and misfit <= NOISE_LEVEL):
            told = f"the gaps between segments carry {equations.gap_share:.0%} of the cost, the largest is {gap:.1g} "
            remedy = "of a state's nominal size: the model cannot follow the log; check its terms, inputs and units"
            return Status(Code.NOT_CONVERGED, told + remedy)
        told = f"{self.iterations} iterations, largest gap {gap:.1g} of a state's nominal size"
        return Status(Code.CONVERGED, told + self._unexplained(equations))

    def _unexplained(self, equations: Equations) -> str:
        """In words, what the model leaves beyond the noise; empty if nothing."""
        lead = "; the model does not explain the log to its noise: "
        tail = ", and the intervals count that as noise: they do not hold the bias of a wrong model"
        if self.is_loose:
            jumps = np.sqrt(np.mean(equations.gaps[self.segments.linked] ** 2, axis=0))
            state = self.segments.system.states[int(np.argmax(jumps))]
            size = f"{np.max(jumps) * state.nominal:.2g} {state.unit}"
            return f"{lead}from segment to segment {state.name} jumps by {size} (rms){tail}"
        worst = int(np.argmax(equations.misfit))
        if equations.misfit[worst] ** 2 <= NOISE_LEVEL:
            return ""
        output = self.segments.system.outputs[worst].name
        return f"{lead}residuals are {equations.misfit[worst]:.2g} times the noise of {output}{tail}"

    def _fit(self, status: Status, seconds: float) -> Fit:
        transcription, current, equations = self.segments.transcription, self.current, self.current.equations
        q = self._values(current.z)
        free = transcription.parameters.free_names
        values = dict(zip(free, q[transcription.free].tolist(), strict=True))
        trajectories = self.segments.trajectories(current.nodes, q, self.substeps)
        stats = {
            "iterations": float(self.iterations),
            "seconds": seconds,
            "cost": equations.cost,
            "substeps": float(self.substeps),
            "largest_gap": equations.largest_gap,
            "gap_share": equations.gap_share,
            "gap_deviation": self.stage.gap,
            "integration_error": self._integration_error(current.nodes, q, self.substeps),
        }
        at_bound = self._at_bound(current)
        keep = self._felt(current) & ~at_bound
        covariance = equations.covariance(keep, noisy_gaps=self.is_loose) if math.isfinite(equations.cost) else None
        solution = Solution(trajectories, transcription.parameters.with_values(values), status, stats)
        jumps = equations.gaps[self.segments.linked] if self.is_loose else None
        return Fit(solution, covariance, equations.chi_square, equations.count, at_bound, jumps)

    def _integration_error(self, nodes: Array, q: Array, substeps: int) -> float:
        """Largest change of an output when the steps are halved [noise standard deviations]."""
        coarse, fine = (self.segments.run(nodes, q, k, sensitivities=False).y for k in (substeps, 2 * substeps))
        error = np.abs(coarse - fine) / self.segments.noise
        return float(np.max(error, where=np.isfinite(self.segments.measured), initial=0.0))

    def _report(self) -> None:
        if self.method.progress is not None:
            current, gap = self.current, self.current.equations.largest_gap
            stages = self.method.stages
            number = "loosened" if self.is_loose else f"stage {stages.index(self.stage) + 1}/{len(stages)}"
            self.method.progress(
                f"{number}  iteration {self.iterations}  cost {current.cost:.6g}  largest gap {gap:.1e}"
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
        # at a bound exactly the bound, which a logarithm there and back would miss by a rounding
        own = np.where(
            z <= self.lower, [p.lower for p in free], np.where(z >= self.upper, [p.upper for p in free], own)
        )
        q[self.segments.transcription.free] = [min(max(v, p.lower), p.upper) for v, p in zip(own, free, strict=True)]
        return q
