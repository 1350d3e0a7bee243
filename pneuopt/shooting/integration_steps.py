"""`IntegrationSteps`: how many integration steps a sample takes, from the stiffness where a search is."""

import numpy as np

from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.quantities.arrays import Array
from pneuopt.shooting.segments import Segments, stable_substeps

# relative change of a parameter [1] after which the stiffness is computed anew: higher risks unstable steps
STIFFNESS_UPDATE_CHANGE = 0.03
MAX_SEARCH_SUBSTEPS = 200  # integration steps a sample: a search with more would take hours, fewer refuse stiff models
MAX_STAGE_REFINEMENT = 8  # factor on the start's integration steps in a stage: higher takes long, lower may be unstable


class IntegrationSteps:
    """The integration steps a sample that a search takes.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n_states)
        Of the start.
    values : ndarray
        All parameters of the start.
    given : int, optional
        What the user has asked for, in place of all this.
    """

    def __init__(self, segments: Segments, nodes: Array, values: Array, given: int | None) -> None:
        self._segments, self._values, self._given = segments, values, given
        self.required = given or stable_substeps(segments, nodes, values, RK4_MAX_H_LAMBDA)
        self.start = given or min(self.required, MAX_SEARCH_SUBSTEPS)

    @property
    def are_too_many(self) -> bool:
        """Whether a sample of the start takes more integration steps than a search can afford."""
        return self.required > self.start

    def renew(self, nodes: Array, values: Array, current: int) -> int:
        """The steps at these nodes and parameters, or the current ones; fewer, too, for a bad start may be stiff."""
        if not self._given and not np.allclose(values, self._values, rtol=STIFFNESS_UPDATE_CHANGE):
            self._values, needed = values, stable_substeps(self._segments, nodes, values, RK4_MAX_H_LAMBDA)
            return min(needed, MAX_STAGE_REFINEMENT * self.start)
        return current
