"""Ms of the loops of P32 at the steady motions that its statement names, and of the pressures' loop where it sticks."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from math import inf

import numpy as np

import pneuopt as po
from pneuopt.control.linear_loop import ComposedLoops
from pneuopt.dynamics.system import names
from pneuopt.evaluation.margins import batch_margin_function
from problems.shared.arrays import Array
from problems.shared.p32 import RESERVE, SAMPLE_TIME, SPEEDS, STROKE, drive

MAX_SENSITIVITY = "MaxSensitivity"
PLACES = (RESERVE, STROKE / 2, STROKE - RESERVE)  # [m]
POINTS = 80  # frequencies: fewer miss a peak by more than a hundredth
STANDING_MASS = 1e15  # [kg] that no pressure moves; one of 1e12 has integrals drift faster than LEAST_POLE
SLIDING = "exact_linearisation.sliding"
LEAST_POLE = 1e-2  # [rad/s]; those of a piston that sticks lie below, at zero but for rounding


class Margins:
    """Ms of a loop on some plants, for any gains.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
        Of the loop.
    plants : sequence of mapping
        What differs from the nominal one.
    speeds : tuple of float
        Of the steady motions, both ways [m/s].
    points : int
        Frequencies.
    """

    def __init__(
        self,
        loop: po.ClosedLoop,
        parameters: po.ParameterSet,
        plants: Sequence[Mapping[str, float]],
        speeds: tuple[float, ...] = SPEEDS,
        points: int = POINTS,
    ) -> None:
        self.loop, self.plants, self.speeds = loop, plants, speeds
        self.parameters = loop.complete(parameters)
        self.omega = np.geomspace(1.0, 0.9 * np.pi / SAMPLE_TIME, points)

    @cached_property
    def _points(self) -> tuple[Array, Array, Array]:
        """Parameters, states and inputs of every steady motion of every plant, shapes (k, n)."""
        plant, (own, _) = self.loop.plant, drive()
        rows, states, inputs = [], [], []
        for values in self.plants:
            for place in PLACES:
                for speed in (s * sign for s in self.speeds for sign in (1, -1)):
                    p = self.parameters.with_values({**values, "friction.direction": float(np.sign(speed))})
                    rest = own.rest(p, position=place, speed=speed)
                    rows.append(self.loop.parameter_vector(p))
                    states.append([rest.states[n] for n in names(plant.states)])
                    inputs.append([rest.inputs[n] for n in names(plant.inputs)])
        return np.array(rows), np.array(states), np.array(inputs)

    def _rows(self, gains: Mapping[str, float]) -> Array:
        order, p = list(self.loop.parameters), self._points[0].copy()
        for name, value in gains.items():
            p[:, order.index(name)] = value
        if SLIDING in order:
            p[:, order.index(SLIDING)] = 1.0
        return p

    def peaks(self, gains: Mapping[str, float]) -> tuple[float, float]:
        """The largest Ms of the steady motions, and of the pressures' loop of a piston that sticks; inf: unstable."""
        sliding, sticking = self.peaks_of([gains])[0].tolist()
        return sliding, sticking

    def peaks_of(self, each: Sequence[Mapping[str, float]]) -> Array:
        """The same of several sets of gains, a row each."""
        return np.asarray(self._all(each).max(axis=1))

    def plant_peaks(self, gains: Mapping[str, float]) -> Array:
        """The same of each plant, shape (plants, 2)."""
        return np.asarray(self._all([gains]).reshape(len(self.plants), -1, 2).max(axis=1))

    def _all(self, each: Sequence[Mapping[str, float]]) -> Array:
        """Ms of sliding and of sticking at each steady motion of each plant, shape (gains, motions, 2)."""
        (_, x, u), k = self._points, len(each)
        p = np.vstack([self._rows(gains) for gains in each])
        x, u = np.tile(x, (k, 1)), np.tile(u, (k, 1))
        if not self.loop.is_composed:  # no pressure is fed back: nothing answers a command that moves nothing
            sliding = self._alone(p, x[None], u[None], {MAX_SENSITIVITY})[MAX_SENSITIVITY]
            return np.stack([sliding.reshape(k, -1), np.ones((k, len(x) // k))], axis=-1)
        stuck = p.copy()
        stuck[:, list(self.loop.parameters).index("load.mass")] = STANDING_MASS
        loops = self._linearise(np.vstack([p, stuck]), np.vstack([x, x]), np.vstack([u, u])).loop
        return np.moveaxis(self._peaks(*loops).reshape(2, k, -1), 0, -1)

    def response(self, gains: Mapping[str, float], omega: Array) -> Array:
        """L(jw) of the loop cut at the command, a row each steady motion of each plant, at frequencies [rad/s]."""
        _, x, u = self._points
        return _response(*self._linearise(self._rows(gains), x, u).loop, omega)

    def _peaks(self, A: Array, B: Array, C: Array, D: Array) -> Array:
        """Ms of open loops on the grid of frequencies, shape (m,)."""
        poles = np.linalg.eigvals(A - B @ C / (1 + D))
        unstable = np.where(np.abs(poles) > LEAST_POLE, poles.real, -1.0).max(axis=1) > 0
        least = np.minimum(np.abs(1 + D[:, 0, 0]), np.abs(1 + _response(A, B, C, D, self.omega)).min(axis=1))
        return np.where(unstable, inf, 1 / least)

    @cached_property
    def _linearise(self) -> ComposedLoops:
        return ComposedLoops(self.loop, compiled=True)

    @cached_property
    def _alone(self):  # type: ignore[no-untyped-def]  # a MarginFunction
        return batch_margin_function(self.loop, self.omega)


def _response(A: Array, B: Array, C: Array, D: Array, omega: Array) -> Array:
    """Frequency responses of systems, shape (m, frequencies)."""
    one = np.eye(A.shape[-1])
    found = [(C @ np.linalg.solve(1j * w * one - A, B.astype(complex)) + D)[:, 0, 0] for w in omega]
    return np.stack(found, axis=-1)
