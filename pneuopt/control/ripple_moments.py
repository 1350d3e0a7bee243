"""Sums over the phases of a dither period, for many plants at once: their rates and Jacobians along a swing."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.system import names
from pneuopt.quantities.arrays import Array, Indices


@dataclass(frozen=True, eq=False)
class Waves:
    """The waves on the commands of m plants at one frequency, phase by phase.

    Attributes
    ----------
    frequency : float
        [rad/s]; 0 where nothing swings.
    amplitudes : ndarray, shape (m,)
        [command's unit]
    phases, weights, shape : ndarray, shape (n,)
        Phases [rad] and their weights in a mean, and the wave there as the plant gets it, of amplitude 1.
    feedback : ndarray of complex, shape (m,)
        The controller's response to the measured output at this frequency.
    """

    frequency: float
    amplitudes: Array
    phases: Array
    weights: Array
    shape: Array
    feedback: NDArray[np.complex128]

    def select(self, rows: Indices) -> "Waves":
        """The waves on some of the commands."""
        return replace(self, amplitudes=self.amplitudes[rows], feedback=self.feedback[rows])


class Moments(NamedTuple):
    """Means over the phases of m plants, in states scaled by their nominal values; J is [A B], B the command's column.

    Attributes
    ----------
    swing : ndarray, shape (m, 2 n)
        The swing ``a sin theta + b cos theta``, a before b.
    rates : ndarray, shape (m, 2 n)
        The rates times sin theta, then times cos theta.
    J, J_ss, J_sc : ndarray, shape (m, n, n + 1)
        The Jacobian, and that times ``sin^2`` and times ``sin cos``.
    output : ndarray, shape (m, n + 2)
        [C D] of the measured output, then the output itself.
    """

    swing: Array
    rates: Array
    J: Array
    J_ss: Array
    J_sc: Array
    output: Array

    def select(self, rows: Indices) -> "Moments":
        """The moments of some of the plants."""
        return Moments(*(field[rows] for field in self))


@dataclass(frozen=True, eq=False)
class RippleMoments:
    """Function that computes `Moments`: a rollout in which a phase takes the place of a sample.

    Parameters
    ----------
    loop : ClosedLoop
    compiled : bool
        Machine code in place of the CasADi VM.
    """

    loop: ClosedLoop
    compiled: bool = False

    @cached_property
    def scale(self) -> Array:
        """The nominal values of the plant's states."""
        return np.array([q.nominal for q in self.loop.plant.states])

    def __call__(self, q: Array, x: Array, u: Array, waves: Waves, swing: Array) -> Moments:
        """Sum up.

        Parameters
        ----------
        q : ndarray, shape (m, n_plant_parameters)
        x : ndarray, shape (m, n)
        u : ndarray, shape (m, n_plant_inputs)
            Means, the command among the inputs.
        waves : Waves
        swing : ndarray, shape (m, 2 n)
        """
        (m, n), count = x.shape, len(waves.phases)
        start = np.zeros((m, self._rollout.n_states))
        start[:, : 3 * n] = np.concatenate([x, swing], axis=1)
        along = np.empty((m, count, u.shape[1] + 4))
        along[:, :, : u.shape[1]], along[:, :, -4] = u[:, None], waves.amplitudes[:, None] * waves.shape
        along[:, :, -3:] = np.array([np.sin(waves.phases), np.cos(waves.phases), waves.weights]).T
        p = np.column_stack([q, waves.feedback.real, waves.feedback.imag])
        t = np.zeros((m, count))
        sums = self._rollout.run(start, along, p, t, t).x_end[:, 3 * n :]
        ends = np.cumsum([2 * n, *[n * (n + 1)] * 3])
        rates, J, J_ss, J_sc, output = np.split(sums, ends, axis=1)
        shape = (m, n, n + 1)
        return Moments(swing, rates, J.reshape(shape), J_ss.reshape(shape), J_sc.reshape(shape), output)

    @cached_property
    def _rollout(self) -> Rollout:
        """The plant's rates and Jacobians summed up as states, the means and the swing before them."""
        plant, scale = self.loop.plant, ca.DM(self.scale)
        n, k = len(plant.states), names(plant.inputs).index(self.loop.command.name)
        x, a, b, u = (ca.SX.sym(s, size) for s, size in (("x", n), ("a", n), ("b", n), ("u", len(plant.inputs))))
        q, feedback = ca.SX.sym("q", len(plant.parameters)), ca.SX.sym("feedback", 2)
        wave, s, c, weight = (ca.SX.sym(name) for name in ("wave", "sine", "cosine", "weight"))
        jacobians = self._jacobians
        C = ca.transpose(jacobians(x, u, q)[2])
        ya, yb = ca.dot(C[:n], a), ca.dot(C[:n], b)
        at = ca.SX(u)
        at[k] += wave - s * (feedback[0] * ya - feedback[1] * yb) - c * (feedback[1] * ya + feedback[0] * yb)
        f, J, output = jacobians(x + scale * (a * s + b * c), at, q)
        terms = ca.vertcat(s * f, c * f, *(ca.vec(ca.transpose(w * J)) for w in (1, s * s, s * c)), ca.vec(output))
        sums = ca.SX.sym("sums", terms.numel())
        z, inputs, p = ca.vertcat(x, a, b, sums), ca.vertcat(u, wave, s, c, weight), ca.vertcat(q, feedback)
        t, h = ca.SX.sym("t"), ca.SX.sym("h")
        step = ca.Function(
            "step", [t, h, z, inputs, p], [ca.vertcat(x, a, b, sums + weight * terms), ca.SX(0, 1)], {"cse": True}
        )
        return Rollout(Pieces(step), lanes=None if self.compiled else 0)

    @cached_property
    def _jacobians(self) -> ca.Function:
        """``(x, u, q) -> rates, [A B], [C D y]`` in scaled states, from command to measured output."""
        plant = self.loop.plant
        x, u, q = (ca.SX.sym(s, plant.ode.size1_in(i)) for i, s in enumerate("xuq", 1))
        k, j = (names(plant.inputs).index(self.loop.command.name), names(plant.outputs).index(self.loop.feedback.name))
        xdot, y = plant.ode(0, x, u, q)
        inward, outward = ca.diag(1 / ca.DM(self.scale)), ca.diag(ca.DM(self.scale))
        J = ca.horzcat(inward @ ca.jacobian(xdot, x) @ outward, inward @ ca.jacobian(xdot, u[k]))
        output = ca.horzcat(ca.jacobian(y[j], x) @ outward, ca.jacobian(y[j], u[k]), y[j])
        return ca.Function("jacobians", [x, u, q], [ca.densify(v) for v in (inward @ xdot, J, output)])
