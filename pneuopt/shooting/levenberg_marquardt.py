"""`Descent`: Levenberg-Marquardt steps on the nodes and the free parameters, at one weight of the gaps."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.shooting.arrow import GaussNewtonStep, ReducedEquations
from pneuopt.shooting.equations import NormalEquations, missed_curvature, normal_equations
from pneuopt.shooting.scaling import ParameterScaling
from pneuopt.shooting.segments import IntegrationCorrection, Segments

# Marquardt's damping over the diagonal [1] with loose gaps: lower takes wild first steps, higher small ones
INITIAL_DAMPING = 1e-3
# least damping over the diagonal [1], in which the gaps weigh up to 1e14: higher slows parameters, lower is rounding
MIN_DAMPING = 1e-15
# actual over promised decrease [1] below which the nodes settle after a step: higher costs evaluations, lower crawls in
# valleys
MIN_GAIN_RATIO = 0.5
# steps of the nodes alone after a step whose gaps miss its promise: fewer creep along the bend of a valley (bristles at
# 60 s: .05 % an iteration), more follow nodes that do not settle
MAX_NODE_STEPS = 3
MAX_TRIES = 10  # dampings tried for a step: fewer give up where a step exists, more try what no longer moves anything
# undamped steps over a kink: fewer turn back before the cost has fallen again, more follow steps that diverge
MAX_LEAP_STEPS = 10
MAX_LOG_CHANGE = (
    2.0  # e-folds of a log parameter in a step: longer ones leave the model's range, shorter ones take more
)


@dataclass(frozen=True, eq=False)
class Iterate:
    """The unknowns (nodes in SI, z as searched), and the equations linearised there."""

    nodes: Array
    z: Array
    equations: NormalEquations

    @property
    def cost(self) -> float:
        """Half the sum of all squares; infinite where the model is not finite."""
        return self.equations.cost


@dataclass(frozen=True, eq=False)
class Objective:
    """The lifted least squares with given gaps' weights and integration steps.

    Attributes
    ----------
    segments : Segments
    scaling : ParameterScaling
    sigma : ndarray, shape (n_states,)
        Standard deviation of a gap, in nominal sizes.
    substeps : int
        Integration steps a sample.
    correction : IntegrationCorrection or None
        The change of outputs and ends by finer steps.
    has_prior : bool
        Whether log parameters are drawn to their start (`ParameterScaling.add_start_prior`).
    """

    segments: Segments
    scaling: ParameterScaling
    sigma: Array
    substeps: int
    correction: IntegrationCorrection | None = None
    has_prior: bool = False

    def evaluate(self, nodes: Array, z: Array) -> Iterate:
        """The iterate at these nodes, shape (m, n_states), and searched parameters."""
        with np.errstate(all="ignore"):  # a step too far may overflow; its cost is infinite then
            given = (nodes, self.scaling.values(z), self.scaling.chain(z), self.sigma, self.substeps, self.correction)
            equations = normal_equations(self.segments, *given)
        return self.with_prior(nodes, z, equations)

    def with_prior(self, nodes: Array, z: Array, equations: NormalEquations) -> Iterate:
        """The iterate with these equations, to which the prior is added where there is one."""
        return Iterate(nodes, z, self.scaling.add_start_prior(equations, z) if self.has_prior else equations)


IsNegligible = Callable[[Iterate, ReducedEquations, GaussNewtonStep], bool]


class Descent:
    """Levenberg-Marquardt steps on one objective.

    Parameters
    ----------
    objective : Objective
    damping : float
        Of the first step.
    is_negligible : callable
        Whether a step that is hardly damped is not worth a try.

    Attributes
    ----------
    damps_nodes : bool
        Whether nodes that overshoot are damped alone. Near an optimum this saves the rest of the log many short steps;
        far from it, nodes are left behind that tighter gaps then cannot free.
    node_damping : ndarray, shape (m,)
        Of each node alone, over its diagonal.
    """

    def __init__(self, objective: Objective, damping: float, is_negligible: IsNegligible) -> None:
        self.damps_nodes, self.promised = False, math.inf
        self.objective, self.damping, self._is_negligible = objective, damping, is_negligible
        self.node_damping = np.zeros(objective.segments.count)

    def step(self, current: Iterate) -> Iterate | None:
        """The next iterate; None if no damping lowers the cost, or the step would be negligible.

        After the first try the damping rises only at the nodes that have overshot, if there are any.
        """
        raise_by, scaling = 10.0, self.objective.scaling
        for k in range(MAX_TRIES):
            reduced = current.equations.arrow.eliminate(self.damping, self.node_damping)
            step = reduced and reduced.step(scaling.movable(current.z, current.equations, reduced))
            if k == 0 and step:
                self.promised = 0.5 * current.equations.arrow.descent_rate(step)
            if reduced and step and np.max(np.abs(step.parameters[scaling.log]), initial=0.0) <= MAX_LOG_CHANGE:
                is_hardly_damped = self.damping <= INITIAL_DAMPING and (k == 0 or (k == 1 and self.node_damping.any()))
                if is_hardly_damped and self._is_negligible(current, reduced, step):
                    break
                trial = self._trial(current, reduced, step)
                is_lower = trial.cost < current.cost
                if self.damps_nodes and (not is_lower or self.node_damping.any()):
                    self.node_damping = self._missed_curvature(current, trial)
                if is_lower:
                    self.damping = self.damping * 0.1 if self.damping > MIN_DAMPING else 0.0
                    return trial
                if k == 0 and self.node_damping.any():
                    continue
            self.damping, raise_by = max(self.damping, MIN_DAMPING) * raise_by, 3 * raise_by
        return None

    def leap(self, current: Iterate) -> tuple[Iterate, int]:
        """Take undamped steps, which may raise the cost for a while: the best iterate among them, and their number.

        Over a kink of the model, at which a descent creeps, this is the way (the watchdog technique: Chamberlain et
        al., Mathematical Programming Study 16, 1982).
        """
        trial: Iterate | None = current
        best, taken = current, 0
        while trial is not None and math.isfinite(trial.cost) and taken < MAX_LEAP_STEPS:
            best, trial = min(best, trial, key=lambda each: each.cost), self._step_undamped(trial)
            taken += trial is not None
        return best if trial is None else min(best, trial, key=lambda each: each.cost), taken

    def _step_undamped(self, current: Iterate) -> Iterate | None:
        """The iterate after an undamped step, whatever its cost; None without one, or where it would be negligible."""
        reduced, scaling = current.equations.arrow.eliminate(0.0), self.objective.scaling
        step = reduced and reduced.step(scaling.movable(current.z, current.equations, reduced))
        if not reduced or not step or self._is_negligible(current, reduced, step):
            return None
        z = scaling.project_to_bounds(current.z + step.parameters)
        shift = reduced.back_substitute(z - current.z)
        return self.objective.evaluate(current.nodes + shift * self.objective.segments.nominal, z)

    def _trial(self, current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> Iterate:
        """The iterate after a step; where its gaps let the cost fall too little, with the nodes settled.

        Tight gaps make a narrow valley of what the parameters and the whole trajectory do together, and its bend turns
        a long step into gaps. A Gauss-Newton step of the nodes alone, from the trial's own derivatives, closes them
        again without the log being left, as shooting on from the first node would.
        """
        z = self.objective.scaling.project_to_bounds(current.z + step.parameters)
        moved = z - current.z
        shift = reduced.back_substitute(moved)  # a bound may have cut the parameters' step short
        trial = self.objective.evaluate(current.nodes + shift * self.objective.segments.nominal, z)
        promised = 0.5 * current.equations.arrow.descent_rate(GaussNewtonStep(shift, moved))
        for _ in range(MAX_NODE_STEPS):
            if current.cost - trial.cost >= MIN_GAIN_RATIO * promised or not _misses_by_gaps(current, trial):
                break
            settled = self._settle_nodes(trial, current.cost)
            if settled is None or not settled.cost < trial.cost:
                break
            trial = settled
        return trial

    def _settle_nodes(self, trial: Iterate, cost: float) -> Iterate | None:
        """A trial after a step of its nodes alone; None where that does not promise less than a cost."""
        arrow = trial.equations.arrow
        shift = arrow.node_step(self.damping + self.node_damping)
        if shift is None or trial.cost - 0.5 * arrow.descent_rate(GaussNewtonStep(shift, 0.0 * trial.z)) >= cost:
            return None
        return self.objective.evaluate(trial.nodes + shift * self.objective.segments.nominal, trial.z)

    def _missed_curvature(self, current: Iterate, trial: Iterate) -> Array:
        """The curvature that a trial shows and the model has missed, by node; none of a trial that is not finite."""
        if not math.isfinite(trial.cost):
            return np.zeros(len(current.nodes))
        step, moved = (trial.nodes - current.nodes) / self.objective.segments.nominal, trial.z - current.z
        return missed_curvature(current.equations, step, moved, trial.equations, self.objective.sigma)


def _misses_by_gaps(current: Iterate, trial: Iterate) -> bool:
    """Whether the gaps of a trial, more than its data, make it cost more than where it comes from."""
    by_data = 0.5 * (trial.equations.chi_square - current.equations.chi_square)
    return math.isfinite(trial.cost) and trial.cost - current.cost > 2 * by_data
