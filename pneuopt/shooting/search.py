"""`Search`: the stages of a lifted least squares, from loose gaps to tight ones, and from coarse steps to fine ones.

A first stage that explains the logs to their noise is followed by the last one at once; the stages between are for
starts from which that does not soon converge. Where the linearised equations say that tight gaps would leave many times
the noise, it is followed by the search for noise of the states: the model is wrong, and the stages between would only
show that.
"""

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.dynamics.compiled.rollout import RolloutResult, check_during_runs
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.arrow import GaussNewtonStep, ReducedEquations
from pneuopt.shooting.convergence import (
    MAX_CHI_SQUARE_RATIO,
    MAX_GAP_SHARE,
    ConvergenceTest,
    assess_convergence,
)
from pneuopt.shooting.equations import correct_residuals, weigh_gaps
from pneuopt.shooting.integration_steps import IntegrationSteps, fine_steps, refine_steps
from pneuopt.shooting.last_stage import is_near_end, repeat_last_stage
from pneuopt.shooting.levenberg_marquardt import INITIAL_DAMPING, Descent, Iterate, Objective
from pneuopt.shooting.scaling import ParameterScaling
from pneuopt.shooting.search_end import (
    ABANDONED_START,
    GAPS_ABSORB_MISFIT,
    INTERRUPTED_SEARCH,
    JOINED_SEARCH,
    Snapshot,
    StageEnd,
    end_search,
    joins_known_search,
)
from pneuopt.shooting.segments import IntegrationCorrection, Segments, gap_scales, start_nodes
from pneuopt.shooting.solution import Fit
from pneuopt.shooting.stage_end import creeps, describe_iteration, is_negligible_step

if TYPE_CHECKING:
    from pneuopt.shooting.least_squares import LeastSquares, Stage

# relative decrease of the cost an iteration [1] below which a search has stalled: lower keeps crawling, higher gives up
STALL_COST_DECREASE = 2e-3
# error of the parameters [standard deviations] by derivatives from before the integration was refined: higher shifts
# estimates, lower costs a run with sensitivities
MAX_GRADIENT_ERROR = 0.01
# iterations of the last stage right after the first: more are lost where stages between are needed, fewer may not
# converge
JUMP_ITERATIONS = 10
# squares that the last stage promises by the linearised equations, in noise variances [1], above which it is not tried
# right after the first: lower passes over it for a start that is only not yet near, higher iterates for wrong models
MAX_JUMP_MISFIT = 10.0
# stages at whose gaps noise of the states is tried [1]: fewer miss those at which a search settles, more of them hardly
# hold the states together
MAX_LOOSENED = 2
# creeping steps in a row after which a search with noise of the states leaps: fewer leave a way that leads on, more
# take long
MAX_CREEPING_STEPS = 3


class Search:
    """The stages of a search for the nodes and the free parameters of the segments of one transcription.

    Parameters
    ----------
    segments : Segments
    method : LeastSquares
    """

    def __init__(self, segments: Segments, method: "LeastSquares") -> None:
        self.method = method
        self.scaling = ParameterScaling(segments.transcription)
        nodes = start_nodes(segments)
        self.steps = IntegrationSteps(segments, nodes, self.scaling.values(self.scaling.start), method.substeps)
        self.segments = segments = self.steps.segments
        self.gap_scales = gap_scales(segments, method.kinematic)
        self.iterations, self.stage_began, self.noisy_gaps, self.has_stalled = 0, 0, False, False
        self.last_decrease = 0.0  # of a stage's cost by its last iteration, over itself
        self.tolerance = method.tolerance  # wider where kinks hold up a search that has settled
        self.stage, self.stage_ends, self.unsettled_gaps = method.stages[0], list[StageEnd](), set[float]()
        self.substeps = self.output_substeps = self.steps.start
        self.correction: IntegrationCorrection | None = None
        self.integration_change, self.is_coarse = math.nan, False
        self.node_damping = np.zeros(segments.count)  # where the stage has ended, of each node alone
        self.current = self.evaluate(nodes, self.scaling.start)

    @property
    def cost(self) -> float:
        """Half of the squares of data and gaps, without the prior of a stage."""
        return self.current.cost - self.stage.has_prior * self.scaling.start_prior_cost(self.current.z)

    def solve(self) -> Fit:
        """Run all stages; an interruption (Ctrl-C) ends them with the best iterate so far, marked."""
        began = time.perf_counter()
        try:
            with check_during_runs(self.method.budget.check):
                status = self._run_stages()
        except KeyboardInterrupt:
            status = INTERRUPTED_SEARCH
        return end_search(self, status, time.perf_counter() - began)

    def _run_stages(self) -> Status:
        if self.steps.are_too_many:
            verdict = f"the model is so stiff that a sample takes {self.steps.required} integration steps"
            remedy = "widen the smoothing of its sharpest term, or give LeastSquares(substeps=)"
            return Status(Code.NOT_CONVERGED, (verdict, remedy))
        last, allowed = self.method.stages[-1], None
        for stage in self.method.stages:
            if stage is last and self._gaps_absorb_misfit() and self.method.allows_state_noise:
                allowed = self._allow_state_noise()
                if allowed.converged:
                    return refine_steps(self, allowed)
            elif stage is last and self.stage_ends and self._is_hopeless():
                return ABANDONED_START
            self._enter_stage(stage, self.current.nodes, self.current.z)
            if not math.isfinite(self.current.cost):
                return Status(Code.DIVERGED, ("the model is not finite at the start", "check values and units"))
            self.has_stalled = self._finish_stage(stage.iterations)
            self.stage_ends.append(StageEnd(self.current.nodes, self.current.z, self.cost))
            if found := self._early_end(stage):
                return refine_steps(self, found)
        status = repeat_last_stage(self)
        # gaps that absorb the misfit of the model: the answer depends on their weight
        gaps_absorb = self.current.equations.gap_share > MAX_GAP_SHARE and allowed is None
        return refine_steps(self, self._allow_state_noise(status) if gaps_absorb else status)

    def _early_end(self, stage: "Stage") -> Status | None:
        """The status of a search that ends with a stage before the last; None where it goes on."""
        if joins_known_search(self):
            return JOINED_SEARCH
        if stage is not self.method.stages[0]:
            return None
        return ABANDONED_START if self._is_hopeless() else self._jump()

    def _is_hopeless(self) -> bool:
        """Whether this search is to be left for those from other starts."""
        return 2 * self.current.cost > self.method.max_misfit * self.current.equations.count

    def _jump(self) -> Status | None:
        """The status of an optimum that is soon reached after a first stage that explains the log; or None."""
        stays = len(self.method.stages) < 3 or bool(self.method.known_costs)
        if stays or not self.is_noise(self.current.cost):
            return None
        if self.segments.implicit_state is not None:  # the errors of coarse steps add up where no gaps take them
            self._correct_residuals(fine_steps(self.segments, self.substeps, self.method.stages[-1].refine))
        count, (first, *between, last) = self.current.equations.count, self.method.stages
        if not self._promised_squares(last) > MAX_JUMP_MISFIT * count:
            return self._jump_to_last_stage()
        if not self.method.allows_state_noise:
            return None
        near_noise = [s for s in between if self._promised_squares(s) <= MAX_CHI_SQUARE_RATIO * count]
        found = self._loosen(near_noise[-1] if near_noise else first, self.current.nodes, self.current.z)
        return found if found.converged else None

    def _promised_squares(self, stage: "Stage") -> float:
        """The squares, in noise variances, to which the gaps of a stage would lead by the linearised equations."""
        equations = weigh_gaps(self.segments, self.current.equations.linearisation, stage.gap * self.gap_scales)
        return equations.promised_squares(self.scaling.has_effect(equations) & ~self.scaling.held)

    def _jump_to_last_stage(self) -> Status | None:
        """The status of an optimum that the last stage soon reaches; or None."""
        before = self.snapshot()
        self._enter_stage(self.method.stages[-1], self.current.nodes, self.current.z)
        if math.isfinite(self.current.cost):
            self.run_stage(JUMP_ITERATIONS)
            if self.is_noise(self.current.cost):  # finer steps are lost on what has not come near the noise by then
                self._finish_stage(JUMP_ITERATIONS)
                if (found := self._convergence_status(self.current)).converged and self.is_noise(self.current.cost):
                    return found
        self.restore(before)
        return None

    def _gaps_absorb_misfit(self) -> bool:
        """Whether the gaps absorb the misfit of the model in a stalled search: tighter gaps cost more."""
        absorbing = self.current.equations.gap_share > MAX_GAP_SHARE
        return self.has_stalled and absorbing and not self.is_noise(self.current.cost)

    def _allow_state_noise(self, status: Status = GAPS_ABSORB_MISFIT) -> Status:
        """Let the gaps stand for noise of the states of a wrong model: the tightest with which all residuals agree."""
        if not self.method.allows_state_noise:
            return status
        ended = zip(self.method.stages[:-1], self.stage_ends, strict=False)
        explaining = [(stage, end) for stage, end in ended if self.is_noise(end.cost)]
        for stage, end in reversed(explaining[-MAX_LOOSENED:]):
            if stage.gap in self.unsettled_gaps:  # the same squares, from another start: it creeps again
                continue
            found = self._loosen(stage, end.nodes, end.z)
            if found.converged:
                return found
        return status

    def _loosen(self, stage: "Stage", nodes: Array, z: Array) -> Status:
        """The status of the optimum with a stage's gaps as noise of the states, or with tight gaps where it leads.

        Where there is none, nothing moves.
        """
        before, last, self.noisy_gaps = self.snapshot(), self.method.stages[-1], True
        self._enter_stage(replace(stage, iterations=last.iterations, refine=last.refine), nodes, z)
        self._finish_stage(last.iterations)
        found = repeat_last_stage(self)
        if found.converged:
            return self._tighten() or found
        self.unsettled_gaps.add(stage.gap)
        self.restore(before)
        self.noisy_gaps = False
        return found

    def _tighten(self) -> Status | None:
        """The status of an optimum with tight gaps, where one with noise of the states leads to it; or None.

        The nodes of a first stage may lie across kinks, and its equations then foresee a misfit that a right model has
        not; at an optimum that is nearer they are right.
        """
        before, last = self.snapshot(), self.method.stages[-1]
        if self._promised_squares(last) > MAX_JUMP_MISFIT * self.current.equations.count:
            return None
        self.noisy_gaps = False
        for stage in self.method.stages:
            if stage.gap < before.stage.gap and self.is_noise(self.current.cost):
                self._enter_stage(stage, self.current.nodes, self.current.z)
                self._finish_stage(stage.iterations)
        found = self._convergence_status(self.current)
        if self.stage is last and found.converged and self.is_noise(self.current.cost):
            return found
        self.restore(before)
        self.noisy_gaps = True
        return None

    def snapshot(self) -> Snapshot:
        """Where the search is, to which `restore` returns."""
        return Snapshot(self.stage, self.current, self.correction, self.substeps, self.output_substeps)

    def restore(self, to: Snapshot) -> None:
        """Return to where the search was."""
        self.stage, self.current, self.correction, self.substeps, self.output_substeps = to
        self.segments = self.current.equations.segments

    def _enter_stage(self, stage: "Stage", nodes: Array, z: Array) -> None:
        """Weigh the gaps as in a stage, with integration steps from the stiffness at these nodes."""
        self.segments, steps = self.steps.renew(self.segments, nodes, self.scaling.values(z), self.substeps)
        is_same = self.segments is self.current.equations.segments and nodes is self.current.nodes
        is_known = is_same and steps == self.substeps and self.correction is None
        self.stage, self.tolerance = stage, self.method.tolerance
        self.substeps, self.output_substeps, self.correction = steps, steps, None
        self.is_coarse, self.node_damping = stage.refine > 1, np.zeros(len(nodes))
        if is_known:
            equations = weigh_gaps(self.segments, self.current.equations.linearisation, stage.gap * self.gap_scales)
            self.current = self._objective().with_prior(nodes, z, equations)
        else:
            self.current = self.evaluate(nodes, z)

    def apply_finer_steps(self, steps: int) -> float:
        """Integrate the current iterate by finer steps; return the largest change of y [standard deviations]."""
        nodes, z, before = self.current.nodes, self.current.z, self._outputs()
        self.is_coarse = False
        if self._corrects_residuals:
            self._correct_residuals(steps)
        else:
            self.substeps, self.output_substeps, self.correction = steps, steps, None
            self.current = self.evaluate(nodes, z)
        return self.largest_change(self._outputs() - before)

    @property
    def _corrects_residuals(self) -> bool:
        """Whether finer steps are for the residuals alone: derivatives need them where these exceed the noise."""
        return not self.noisy_gaps and self.is_noise(self.current.cost)

    def _correct_residuals(self, steps: int) -> None:
        """Add what finer steps change to the current residuals; derivatives are computed anew where that is much."""
        current, before, fine, self.is_coarse = self.current, self._outputs(), self.run(steps), False
        slopes = current.equations.linearisation
        self.correction = IntegrationCorrection(fine.y - slopes.y, fine.x_end - slopes.x_end, fine)
        self.output_substeps, sigma = steps, self.stage.gap * self.gap_scales
        if self.moves_no_estimate(fine.y - before):
            equations = correct_residuals(current.equations, current.nodes, self.correction, sigma)
            self.current = Iterate(current.nodes, current.z, equations)
        else:
            self.current = self.evaluate(current.nodes, current.z)

    def moves_no_estimate(self, change: Array) -> bool:
        """Whether a change of the outputs moves no estimate: none moves by more deviations than the norm of it."""
        weighted = (change * self.segments.weights)[np.isfinite(self.segments.measured)]
        return float(np.nansum(weighted**2)) <= MAX_GRADIENT_ERROR**2

    def _outputs(self) -> Array:
        """The model's outputs with the correction of finer steps, shape (m, n, n_outputs)."""
        y = self.current.equations.linearisation.y
        return y if self.correction is None else y + self.correction.y

    def _finish_stage(self, iterations: int) -> bool:
        """Run a stage, then again with the finer steps that it asks for; return as `run_stage` does.

        Where an iterate explains the log to its noise, the finer steps correct its residuals within the stage.
        """
        has_ended = self.run_stage(iterations)
        if self.stage.refine > 1 and self.correction is None and not self._is_hopeless():
            before = self.snapshot()
            self.apply_finer_steps(fine_steps(self.segments, self.substeps, self.stage.refine))
            if math.isfinite(self.current.cost):
                return self.run_stage(iterations)
            self.restore(before)
        return has_ended

    def is_noise(self, cost: float) -> bool:
        """Whether this cost is that of the noise alone."""
        return 2 * cost <= MAX_CHI_SQUARE_RATIO * self.current.equations.count

    def run_stage(self, iterations: int) -> bool:
        """Iterate in a stage; return whether it converged, or had stalled when its iterations were used up."""
        damping, before = min(INITIAL_DAMPING, 10 * self.stage.gap**2), math.inf  # as the diagonal grows
        descent = Descent(self._objective(), damping, self._is_negligible_step)
        descent.node_damping = np.zeros(len(self.node_damping)) if self.noisy_gaps else self.node_damping
        hopeless, self.stage_began, self.last_decrease = 0, self.iterations, 0.0
        for _ in range(iterations):
            if self.stage.refine > 1 and self._corrects_residuals and self.correction is None:
                self._correct_residuals(fine_steps(self.segments, self.substeps, self.stage.refine))
                descent.objective = self._objective()
            descent.damps_nodes = self.noisy_gaps or is_near_end(self)
            trial = descent.step(self.current)
            self.node_damping = descent.node_damping
            if trial is None:
                return True
            self.iterations += 1
            before, self.current = self.current.cost, trial
            self._report()
            hopeless = hopeless + 1 if creeps(self, before, descent.promised) else 0
            if hopeless == MAX_CREEPING_STEPS:
                if not self._leap(descent):
                    return True
                hopeless = 0
        self.last_decrease = 1 - self.current.cost / before
        return self.last_decrease < STALL_COST_DECREASE

    def _leap(self, descent: Descent) -> bool:
        """Leap over a kink at which a descent with noise of the states creeps; return whether that helps."""
        if not self.noisy_gaps:
            return False
        before, (self.current, taken) = self.current.cost, descent.leap(self.current)
        self.iterations += taken
        return self.current.cost < before

    def _is_negligible_step(self, current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> bool:
        return is_negligible_step(self, current, reduced, step)

    def _objective(self) -> Objective:
        sigma = self.stage.gap * self.gap_scales
        return Objective(self.segments, self.scaling, sigma, self.substeps, self.correction, self.stage.has_prior)

    def evaluate(self, nodes: Array, z: Array) -> Iterate:
        """The iterate at these nodes and searched parameters."""
        return self._objective().evaluate(nodes, z)

    def _convergence_status(self, current: Iterate) -> Status:
        return self.assess(current).status

    def assess(self, current: Iterate) -> ConvergenceTest:
        """The convergence test of an iterate."""
        message = f"{self.iterations} iterations"
        found = assess_convergence(
            current.equations, self.scaling, current.z, self.tolerance, message, noisy_gaps=self.noisy_gaps
        )
        if not (found.status.converged and found.largest_step > self.method.tolerance):
            return found
        asked = f"kinks of the model ask for {found.largest_step:.2g} standard deviations, which the intervals hold"
        return found._replace(status=found.status.with_details(f"the estimates have settled; {asked}"))

    def largest_change(self, change: Array) -> float:
        """The largest change of a measured output [noise standard deviations], of all that are given."""
        weighted = np.abs(change) * self.segments.weights
        return float(np.max(weighted, where=np.isfinite(self.segments.measured), initial=0.0))

    def run(self, steps: int) -> RolloutResult:
        """The run of the current iterate by so many integration steps a sample, with states."""
        return self.segments.run(self.current.nodes, self.scaling.values(self.current.z), steps, states=True)

    def _report(self) -> None:
        if self.method.progress is not None:
            self.method.progress(describe_iteration(self))
