"""`Polish`: points improved by gradients, quadratic programs on compiled simulations with sensitivities.

Differential evolution finds the basin; within it gradients are worth a hundred trials each. On 32 plants of the drive
in problems/shared/t32.py points that an evolution left at 0.062 and 0.065 s came to 0.050 s in some thirty simulations.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.evaluation.requirements import SettlingTime, metric_name
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.linearised import SMOOTH_REQUIREMENTS, LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.responses import to_records
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space
from pneuopt.tuning.sqp import SQP, descend

# Free parameters that no gradient serves: the averaging time moves with the frequency, and a clip that no response
# meets has derivative zero.
NONSMOOTH_PARAMETERS = ("dither.frequency", "pid.Tt", "pid.lower", "pid.upper")
QUANTISER_PARAMETERS = ("sensor.resolution",)  # an encoder's: its counts make responses piecewise flat
# Share by which the programs' band and limits are tighter than the search's. With less, a solution, which lies on its
# limits, breaks them between the nodes; more gives performance away.
PROGRAM_MARGIN = 0.005
PENALTY_RAISES = 2  # descents with penalties ten times the last where limits stay broken; more slow each program
NODES = 2000  # instants at which a response is read, at most: fewer miss what a response does between them


def nonsmooth_terms(loop: ClosedLoop, space: Space, spec: Specification) -> list[str]:
    """The names of requirements without a gradient, and of free parameters to which there is none."""
    rough = [metric_name(q) for q in (*spec.weights, *spec.limits) if not isinstance(q, SMOOTH_REQUIREMENTS)]
    counted = [f"{n} (an encoder's counts)" for n in QUANTISER_PARAMETERS if n in space.parameters]
    jumping = {f"{c.section}.{n}" for c in loop.compensators for n in c.without_gradient}
    return [*rough, *(n for n in space.names if n in NONSMOOTH_PARAMETERS or n in jumping), *counted]


@dataclass(frozen=True, eq=False)
class Polish:
    """Improve points of a search.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
    """

    simulator: Simulator
    spec: Specification

    @property
    def is_possible(self) -> bool:
        """Whether there are gradients of all that is asked for."""
        return not nonsmooth_terms(self.simulator.loop, self.simulator.space, self.spec)

    @cached_property
    def _rollout(self) -> Rollout:
        return sensitivity_rollout(self.simulator)

    def improve(self, unit: Array, on: Simulator, iterations: int) -> tuple[Array, int]:
        """Descend from points of the unit cube, shape (m, n); where each ends, and how many points were simulated.

        Parameters
        ----------
        unit : ndarray, shape (m, n)
        on : Simulator
            The one given, or one with other samples.
        iterations : int
        """
        inside, count, space = self.spec.tighten(PROGRAM_MARGIN, PROGRAM_MARGIN), 0, self.simulator.space
        scale = self._objective(on, unit[0])
        for raises in range(PENALTY_RAISES + 1):
            problem = LinearisedProblem(on, self._rollout, inside, NODES, scale * 10.0**raises)
            found = descend(problem, problem.start(unit), iterations, SQP())
            unit, count = np.array([point.z[:-1] for point in found]), count + problem.count
            values = to_records(on.values(space.from_unit(unit), self.spec))
            if not any(self.spec.violations(row) for row in values):
                break
        return unit, count

    def _objective(self, on: Simulator, unit: Array) -> float:
        """The objective's size at a point, which sets that of the penalties."""
        values = to_records(on.values(on.space.from_unit(unit[None]), self.spec))[0]
        horizon = max(grid.reference.horizon for grid in on.grids)
        unknown = {SettlingTime.metric.name: horizon}
        return self.spec.objective({n: v if np.isfinite(v) else unknown.get(n, 1.0) for n, v in values.items()})
