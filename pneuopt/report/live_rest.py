"""`RestFinder`: what a page needs to find the rest, or steady motion, that a slider changes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet

RESIDUAL = 1e-6
"""Share of a state's nominal size, a second, that counts as zero: what a rest's own root searches leave is below."""
UNCHANGED_RATIO, UNCHANGED_LEAST = 1e-9, 1e-12
"""When two rests are one, as a share and in SI: below these a response cannot be told from the other."""
INDEPENDENT = 1e-9
"""Least share of the largest singular value of the residuals' slopes: below it a direction is undetermined."""


@dataclass(frozen=True, eq=False)
class RestFinder:
    """The residuals of a loop that vanish where it rests, or moves steadily, before a reference.

    A page solves them by Newton's method; `is_singular` says when it could not.

    Attributes
    ----------
    loop : ClosedLoop
    reference : Step
    parameters : ParameterSet
        Every parameter of the loop, as designed.
    """

    loop: ClosedLoop
    reference: Step
    parameters: ParameterSet

    @cached_property
    def start(self) -> Array:
        """The loop's state as designed, shape (n_states,); a `ConvergenceError` or `InputError` where it has none."""
        return self.rest(self.parameters)

    def rest(self, parameters: ParameterSet) -> Array:
        """The loop's state with other parameters, shape (n_states,)."""
        return self.loop.initial(parameters, reference=self.reference.initial, start=self.reference.start)

    def moved_states(self, values: Sequence[tuple[str, float]]) -> set[int]:
        """Places of the states that differ with any of these values, a name and a value each; errors as `start`."""
        moved: set[int] = set()
        for name, value in values:
            found = self.rest(self.parameters.with_values({name: value}))
            moved |= set(np.flatnonzero(~np.isclose(found, self.start, UNCHANGED_RATIO, UNCHANGED_LEAST)).tolist())
        return moved

    def is_singular(self, unknown: Sequence[int]) -> bool:
        """Whether the residuals that vanish at the design leave one of these states undetermined."""
        if not unknown:
            return False
        sizes = np.array([self.loop.states[k].nominal for k in unknown])
        slopes = np.column_stack([self._slope(k, 1e-6 * size) for k, size in zip(unknown, sizes, strict=True)])
        weights = np.abs(slopes).max(axis=1)
        slopes = slopes[weights > 0] / weights[weights > 0, None]
        singular = np.linalg.svd(slopes, compute_uv=False) if len(slopes) >= len(unknown) else np.zeros(1)
        return bool(singular[-1] <= INDEPENDENT * singular[0])

    def data(self, unknown: Sequence[int], places: Sequence[int]) -> dict[str, Any]:
        """What the page's `findRest` reads: the residuals and states, and the parameters that move the rest."""
        return {"rows": self._vanishing, "holds": self._holds, "unknown": list(unknown), "places": list(places)}

    @cached_property
    def _vanishing(self) -> list[int]:
        """Places of the residuals that are zero at the design: rates, then what a sample changes."""
        nominal = np.array([q.nominal for q in self.loop.states])
        found, count = self._residuals(self.start)[0], len(nominal)
        sizes = np.tile(nominal, len(found) // count)
        return np.flatnonzero(np.abs(found) <= RESIDUAL * sizes).tolist()

    @cached_property
    def _holds(self) -> bool:
        """Whether the measured signal is the reference there; a controller without an integral leaves an error."""
        return abs(self._residuals(self.start)[1]) <= RESIDUAL * self.loop.feedback.nominal

    def _residuals(self, x: Array) -> tuple[Array, float]:
        """Rates and what a sample changes, one after the other; the error of the measured signal."""
        loop = self.loop
        still = {n: 0.0 for n in (DITHER_AMPLITUDE, DITHER_OFFSET) if n in self.parameters}  # a rest is before dither
        p = loop.parameter_vector(self.parameters.with_values(still))
        u = [self.reference.initial, *([0.0] * (len(loop.inputs) - 1))]
        motion = loop.motion()
        rates, y = (found.full().ravel() for found in motion.system.ode(0, x, u, p))
        parts = [rates] if motion.update is None else [rates, motion.update(0, x, u, p).full().ravel() - x]
        place = [q.name for q in loop.outputs].index(loop.feedback.name)
        return np.concatenate(parts), float(y[place]) - self.reference.initial

    def _slope(self, k: int, h: float) -> Array:
        """Of the residuals that vanish, by a state [their units a nominal size]."""
        moved = self.start + h * (np.arange(len(self.start)) == k)
        now, then = (self._residuals(x) for x in (self.start, moved))
        own = (then[0] - now[0])[self._vanishing]
        return np.append(own, then[1] - now[1] if self._holds else 0.0) / h * self.loop.states[k].nominal


def is_refused(finder: RestFinder, name: str, value: float) -> bool:
    """Whether the loop cannot rest, or move steadily, with this value."""
    try:
        finder.moved_states([(name, value)])
    except (InputError, ConvergenceError):
        return True
    return False
