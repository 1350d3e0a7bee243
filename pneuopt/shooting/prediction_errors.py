"""`PredictionErrors`: how well several sets of parameters predict a part of a log, and where they had better be.

Where a drive sticks and slips, nodes with wide gaps take over what wrong parameters miss, and tight gaps trap them. An
extended Kalman filter has no such unknowns: it predicts each segment from those before it, and its errors lead to the
parameters (Ljung, System Identification, 2nd ed. 1999, chapter 7), though over many side minima. Where the state may
gather a wide deviation from segment to segment these are few; it then shrinks, as the gaps of a search do.
"""

from typing import NamedTuple

import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting.integration_steps import choose_integration
from pneuopt.shooting.scaling import ParameterScaling
from pneuopt.shooting.segments import Segments
from pneuopt.shooting.state_filter import START_DEVIATION, StateUpdate, solve_each, update_states

# squares of a segment, over its samples, beyond which they count by their logarithm [1]: lower is blind to what wrong
# parameters miss, higher lets one lost slip outweigh a log
ROBUST_SQUARES = 4.0
DAMPINGS = (1e-2, 10**-0.75, 10**0.5, 10**1.75, 1e3)  # over the last one, tried side by side: wider spreads overshoot
FIRST_DAMPING, LEAST_DAMPING = 1e-2, 1e-6  # over the diagonal [1]: lower takes wild first steps, higher small ones
GIVEN_UP_DAMPING = 10.0  # where no damping helps beyond it, a descent has ended; higher takes time
MAX_STEP = (
    1.0  # of a parameter as searched, over its size where it is no log parameter: longer leaves the model's range
)
SETTLED_DECREASE = 1e-4  # of the cost [1] at which a descent has ended: lower takes time, higher ends too early


class Errors(NamedTuple):
    """The cost of some sets of k parameters with its gradient and curvature: (s,), (s, k), (s, k, k)."""

    costs: Array
    gradients: Array
    curvatures: Array


class PredictionErrors:
    """The prediction errors of an extended Kalman filter, for several sets of parameters side by side.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n_states)
        Rough states, from which the filter begins where a segment does not continue the one before it.
    scaling : ParameterScaling
    part : ndarray of int
        Positions of the segments, rising.
    """

    def __init__(self, segments: Segments, nodes: Array, scaling: ParameterScaling, part: Indices) -> None:
        self.segments, self.scaling, self.part, self._rough = segments, scaling, part, nodes / segments.nominal
        self._begins = np.append(True, (np.diff(part) > 1) | ~segments.linked[part[:-1]])
        self._counts = np.isfinite(segments.measured).sum(axis=(1, 2))
        self.count = int(self._counts[part].sum())
        self.adapt_steps(scaling.start[None])

    def adapt_steps(self, z: Array) -> None:
        """Take as many integration steps as the stiffest of some sets asks for, shape (s, k).

        With those of a softer one, slips were lost at the right parameters, which then cost more than wrong ones.
        """
        nodes = self._rough * self.segments.nominal
        found = [choose_integration(self.segments, nodes, self.scaling.values(each)) for each in z]
        implicit = [segments for segments, _ in found if segments.implicit_state is not None]
        self.segments, self.substeps = (implicit or [found[0][0]])[0], max(steps for _, steps in found)

    @np.errstate(all="ignore")  # what overflows is lost, and its cost infinite
    def evaluate(self, z: Array, gathered: float) -> Errors:
        """The errors of sets of searched parameters.

        The gain of the filter counts as constant in the derivatives.

        Parameters
        ----------
        z : ndarray, shape (s, k)
        gathered : float
            Deviation that each state gathers along a segment, over its nominal size.

        Returns
        -------
        Errors
        """
        (count, k), n = z.shape, self._rough.shape[1]
        q = np.array([self.scaling.values(each) for each in z])
        chain = np.array([self.scaling.chain(each) for each in z])[:, None]
        sums = Errors(np.zeros(count), np.zeros((count, k)), np.zeros((count, k, k)))
        for at, begins in zip(self.part.tolist(), self._begins.tolist(), strict=True):
            if begins:
                x, X = np.tile(self._rough[at], (count, 1)), np.zeros((count, n, k))
                P = np.tile(START_DEVIATION**2 * np.eye(n), (count, 1, 1))
            values = q[:, self.segments.parameter_positions[at]]
            found = update_states(self.segments, np.full(count, at), x, P, values, self.substeps)
            x, X, P = self._add(sums, at, found, (x, X), chain, gathered)
            lost = ~(np.isfinite(x).all(axis=1) & np.isfinite(P).all(axis=(1, 2)) & np.isfinite(X).all(axis=(1, 2)))
            sums.costs[lost], x[lost], X[lost], P[lost] = np.inf, self._rough[at], 0.0, START_DEVIATION**2 * np.eye(n)
        return sums

    def _add(
        self,
        sums: Errors,
        at: int,
        found: StateUpdate,
        before: tuple[Array, Array],
        chain: Array,
        gathered: float,
    ) -> tuple[Array, Array, Array]:
        """Add a segment's errors; return the states, their slopes and covariance at its end from those before it."""
        (x, X), n, prior = before, before[0].shape[1], found.prior
        gram, errors = found.gram[:, :-1, :-1], found.gram[:, :-1, -1:]
        direct = self._parameter_moves(at, chain)
        moved = solve_each(found.information, prior @ X - gram[:, :n, n:] @ direct)
        moves, away = np.concatenate([moved, direct], axis=1), moved - X
        turned, pull = moves.transpose(0, 2, 1), prior @ away
        limit = ROBUST_SQUARES * self._counts[at]
        weights = 1 / (1 + found.squares / limit)
        uphill = turned @ errors + pull.transpose(0, 2, 1) @ (found.state - x)[..., None]
        squares = turned @ (gram @ moves) + away.transpose(0, 2, 1) @ pull
        sums.costs[:] += limit * np.log1p(found.squares / limit)
        sums.gradients[:] += weights[:, None] * uphill[..., 0]
        sums.curvatures[:] += weights[:, None, None] * squares
        return found.end, found.moved @ moves, found.spread(gathered)

    def _parameter_moves(self, at: int, chain: Array) -> Array:
        """How a segment's own parameters move with those searched, of sets with these chains. Shape (s, n_own, k)."""
        unknowns = self.segments.unknowns[at]
        own = np.flatnonzero(unknowns >= 0)
        moves = np.zeros((len(chain), len(unknowns), chain.shape[2]))
        moves[:, own, unknowns[own]] = chain[:, 0, unknowns[own]]
        return moves

    def descend(self, z: Array, gathered: float, steps: int) -> tuple[Array, Array]:
        """Levenberg-Marquardt steps from several sets of searched parameters, side by side.

        Parameters
        ----------
        z : ndarray, shape (s, k)
        gathered : float
            As of `evaluate`.
        steps : int
            At most.

        Returns
        -------
        z : ndarray, shape (s, k)
            Where they end.
        costs : ndarray, shape (s,)
        """
        self.adapt_steps(z)
        z, damping = z.copy(), np.full(len(z), FIRST_DAMPING)
        costs, gradients, curvatures = (a.copy() for a in self.evaluate(z, gathered))
        active = np.isfinite(costs)
        for _ in range(steps):
            rows = np.flatnonzero(active)
            if not rows.size:
                break
            tries = [(i, each) for i in rows.tolist() for each in (np.array(DAMPINGS) * damping[i]).tolist()]
            trials = np.array([self._step(z[i], gradients[i], curvatures[i], each) for i, each in tries])
            found = self.evaluate(trials, gathered)
            for j, i in enumerate(rows.tolist()):
                best = j * len(DAMPINGS) + int(np.argmin(found.costs[j * len(DAMPINGS) : (j + 1) * len(DAMPINGS)]))
                if found.costs[best] < costs[i]:
                    active[i] = costs[i] - found.costs[best] > SETTLED_DECREASE * costs[i]
                    z[i], damping[i] = trials[best], max(tries[best][1], LEAST_DAMPING)
                    costs[i], gradients[i], curvatures[i] = (part[best] for part in found)
                else:
                    active[i], damping[i] = damping[i] < GIVEN_UP_DAMPING, 1e3 * damping[i]
        return z, costs

    def _step(self, z: Array, gradient: Array, curvature: Array, damping: float) -> Array:
        """Where a damped step of the parameters that are not held leads, within the bounds."""
        free = np.flatnonzero(~self.scaling.held & (np.diag(curvature) > 0))
        own = curvature[np.ix_(free, free)]
        step = np.zeros(len(z))
        step[free] = -np.linalg.lstsq(own + damping * np.diag(np.diag(own)), gradient[free], rcond=None)[0]
        longest = MAX_STEP * np.where(self.scaling.log, 1.0, np.maximum(np.abs(z), 1.0))
        return self.scaling.project_to_bounds(z + np.clip(step, -longest, longest))
