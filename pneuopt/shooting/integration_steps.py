"""How a search integrates, and in how many steps a sample: by the stiffness where it is, then finer ones at its end."""

import math
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.dynamics.partitioned_step import PARTITIONED_MAX_H_GROWTH, PARTITIONED_MAX_H_LAMBDA
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Status
from pneuopt.shooting.segments import Segments, count_steps, largest_rate, stiffness_jacobians

if TYPE_CHECKING:
    from pneuopt.shooting.search import Search

# relative change of a parameter [1] after which the stiffness is computed anew: higher risks unstable steps
STIFFNESS_UPDATE_CHANGE = 0.03
MAX_SEARCH_SUBSTEPS = 200  # integration steps a sample: a search with more would take hours, fewer refuse stiff models
MAX_STEP_HALVINGS = 3  # halvings of the integration steps: more cost time, fewer leave an answer that depends on them
MAX_STAGE_REFINEMENT = 8  # factor on the start's integration steps in a stage: higher takes long, lower may be unstable
# RK4 steps over steps that are implicit in a state, at least [1]: such a step takes as long as one and a half of RK4's
# and is of lower order; higher leaves stiff plants slow, lower gives exactness away
MIN_IMPLICIT_GAIN = 4.0
# steps a sample that are implicit in a state, at least: fewer take crossings of rest so coarsely that estimates move,
# more take longer
MIN_IMPLICIT_SUBSTEPS = 4
# factor on a stage's refinement where steps are implicit in a state [1]: lower leaves errors that add up along a log,
# higher takes longer
IMPLICIT_REFINEMENT = 4
STABILITY_RESERVE = 1.3  # RK4 steps over those that it needs, as they are counted, below which it becomes unstable [1]
# values of a state at which its growth rate is asked for, on either side of zero, and the range that they span [1]:
# fewer may miss the steepest fall of friction, more take longer
GROWTH_POINTS, GROWTH_RANGE = 12, 1e-3


def choose_integration(
    segments: Segments, nodes: Array, values: Array, given: int | None = None
) -> tuple[Segments, int]:
    """Choose how segments are integrated: by RK4, or implicitly in the state that makes RK4 slow.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n_states)
    values : ndarray
        All the problem's parameters.
    given : int, optional
        The steps a sample, where they are known.

    Returns
    -------
    segments : Segments
        The same, or a copy with another `implicit_state`.
    steps : int
        Integration steps a sample.
    """
    state, steps = None, 1
    if nodes.shape[1]:
        jacobians = stiffness_jacobians(segments, nodes, values)
        steps = count_steps(segments, largest_rate(jacobians), RK4_MAX_H_LAMBDA)
        if steps > STABILITY_RESERVE * (given or MIN_IMPLICIT_GAIN * MIN_IMPLICIT_SUBSTEPS / STABILITY_RESERVE):
            state, steps = _choose_implicit_state(segments, nodes, values, jacobians, steps)
    if state != segments.implicit_state:
        segments = segments.with_implicit_state(state)
    return segments, given or steps


def _choose_implicit_state(
    segments: Segments, nodes: Array, values: Array, jacobians: Array, steps: int
) -> tuple[int | None, int]:
    """The state whose own rate asks RK4 for so many steps, and the steps with it implicit; None if that is no gain."""
    if segments.system.pieces.ode is None:
        return None, steps
    state = int(np.argmin(np.einsum("kii->ki", jacobians).min(axis=0, initial=0.0)))
    reach = float(np.abs(nodes[:, state]).max())
    sizes = reach * np.geomspace(GROWTH_RANGE, 1.0, GROWTH_POINTS)
    if not 0 < reach < np.inf:
        return None, steps
    moving = stiffness_jacobians(segments, nodes, values, (state, np.concatenate([-sizes, sizes])))
    others = np.concatenate([jacobians, moving])
    growth = float(others[:, state, state].max(initial=0.0))
    others[:, state, state] = 0.0
    needed = max(
        MIN_IMPLICIT_SUBSTEPS,
        count_steps(segments, largest_rate(others), PARTITIONED_MAX_H_LAMBDA),
        count_steps(segments, growth, PARTITIONED_MAX_H_GROWTH),
    )
    return (state, needed) if steps >= MIN_IMPLICIT_GAIN * needed else (None, steps)


def fine_steps(segments: Segments, steps: int, refine: int) -> int:
    """The steps a sample that correct the residuals of coarse ones; those implicit in a state are of lower order."""
    return steps * refine * (1 if segments.implicit_state is None else IMPLICIT_REFINEMENT)


class IntegrationSteps:
    """The integration of a search, and its steps a sample.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n_states)
        Of the start.
    values : ndarray
        All parameters of the start.
    given : int, optional
        What the user has asked for, in place of all this.

    Attributes
    ----------
    segments : Segments
        By the integration at the start.
    """

    def __init__(self, segments: Segments, nodes: Array, values: Array, given: int | None) -> None:
        self._values, self._given = values, given
        self.segments, self.required = choose_integration(segments, nodes, values, given)
        self.start = given or min(self.required, MAX_SEARCH_SUBSTEPS)

    @property
    def are_too_many(self) -> bool:
        """Whether a sample of the start takes more integration steps than a search can afford."""
        return self.required > self.start

    def renew(self, segments: Segments, nodes: Array, values: Array, current: int) -> tuple[Segments, int]:
        """The integration at these nodes and parameters, or the current one; fewer steps, too, after a bad start."""
        if not self._given and not np.allclose(values, self._values, rtol=STIFFNESS_UPDATE_CHANGE):
            self._values = values
            segments, needed = choose_integration(segments, nodes, values)
            return segments, min(needed, MAX_STAGE_REFINEMENT * max(self.start, MIN_IMPLICIT_SUBSTEPS))
        return segments, current


def refine_steps(search: "Search", status: Status) -> Status:
    """Halve the integration steps until no estimate moves; steps that the user gave stay.

    Where the finer steps of the last stage have moved none, still finer ones would move it less: these are run once
    more where the search has ended.

    Parameters
    ----------
    search : Search
        Of this status; moves to the optimum by the finer steps.
    status : Status

    Returns
    -------
    Status
        Of where it is then.
    """
    for _ in range(MAX_STEP_HALVINGS):
        if not (status.converged and search.method.checks_steps):
            break
        before, correction = search.snapshot(), search.correction
        are_fine = correction is not None and search.moves_no_estimate(correction.y)
        change = search.apply_finer_steps((1 if search.method.substeps or are_fine else 2) * search.output_substeps)
        if are_fine and search.correction is not None:
            change = search.largest_change(search.correction.y)
        if not math.isfinite(search.current.cost):
            search.restore(before)
            break
        if search.assess(search.current).status.converged:
            search.integration_change = math.nan if search.method.substeps else change
            if search.noisy_gaps:
                search.run_stage(search.stage.iterations)  # the finer steps have moved its optimum a little
            break
        search.run_stage(search.stage.iterations)
        status = search.assess(search.current).status
    return status
