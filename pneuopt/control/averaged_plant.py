"""`AveragedPlant`: the plants of many loops, linearised from command to measured output and averaged over their ripple.

A dither swings the plant's states about their means by ``X(theta)``, its command by ``U(theta)``; what a slow signal
sees of a nonlinear plant is then the mean over theta of its Jacobian at ``m + X, u + U`` (Zames & Shneydor, IEEE Trans.
Autom. Control 21, 1976). X is the first harmonic, by the balance of the nonlinear equations, the controller's reaction
to it included; a sampled wave is held from sample to sample. At amplitude zero it is the plant's own linearisation.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import ceil, pi
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.averaging import phase_quadrature
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, Dither
from pneuopt.control.linear_controller import controller_response
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.ripple_moments import Moments, RippleMoments, Waves
from pneuopt.dynamics.system import System, names
from pneuopt.quantities.arrays import Array, Mask

# Phases of a dither period over which is averaged, at least: fewer miss the edge of a dead zone between two of them,
# more cost time in proportion.
RIPPLE_PHASES = 32
# Newton steps, halved ones included, that the balance of the first harmonic may take. With fewer, a swing across
# Stribeck's minimum is left unbalanced; more are spent on lanes that have no balance at all.
MAX_BALANCE_STEPS = 40
# Newton step at which the balance counts as solved, a fraction of the swing; what is left is about its square. A larger
# one shows in Ms (0.01: 1e-4); a smaller one costs a step and changes nothing.
BALANCE_TOLERANCE = 1e-4
MIN_BALANCE_FRACTION = 1e-3  # of a Newton step: a swing that a smaller one does not improve is kept as it is


class PlantMatrices(NamedTuple):
    """Plants from command to measured output, shapes (m, n, n), (m, n), (m, n), (m,), and that output, shape (m,)."""

    A: Array
    B: Array
    C: Array
    D: Array
    measured: Array


@dataclass(frozen=True, eq=False)
class AveragedPlant:
    """Function that linearises the plants of many loops, averaged over the ripple of their dithers.

    Parameters
    ----------
    loop : ClosedLoop
    compiled : bool
        Whether machine code is made of the plant's Jacobian, which pays for many plants, not for one.
    phases : int
        Phases over which is averaged, at least.
    """

    loop: ClosedLoop
    compiled: bool = False
    phases: int = RIPPLE_PHASES

    def __call__(self, p: Array, x: Array, u: Array) -> PlantMatrices:
        """Linearise.

        Parameters
        ----------
        p : ndarray, shape (m, n_parameters)
            In the order of ``loop.parameters``.
        x : ndarray, shape (m, n_plant_states)
        u : ndarray, shape (m, n_plant_inputs)
            Means under dither, the command among the inputs.

        Returns
        -------
        PlantMatrices
        """
        (m, n), scale = x.shape, self._moments.scale
        J, output = np.empty((m, n, n + 1)), np.empty((m, n + 2))
        for rows, found in self._balances(p, x, u):
            J[rows], output[rows] = found.J, found.output
        A, B = J[:, :, :n] * scale[:, None] / scale, J[:, :, n] * scale
        return PlantMatrices(A, B, output[:, :n] / scale, output[:, n], output[:, n + 1])

    def swings(self, p: Array, x: Array, u: Array) -> NDArray[np.complex128]:
        """First harmonics of the plants' states, shape (m, n_plant_states), each as `ripple` gives it."""
        n, found = x.shape[1], np.zeros(x.shape, dtype=np.complex128)
        for rows, moments in self._balances(p, x, u):
            found[rows] = (moments.swing[:, :n] + 1j * moments.swing[:, n:]) * self._moments.scale
        return found

    @cached_property
    def _moments(self) -> RippleMoments:
        return RippleMoments(self.loop, self.compiled)

    def _balances(self, p: Array, x: Array, u: Array) -> Iterator[tuple[Mask, Moments]]:
        """Rows of one frequency, and their moments along the swing that balances."""
        for rows, waves in self._waves(p):
            yield rows, self._balance(p[rows], x[rows], u[rows], waves)

    def _waves(self, p: Array) -> Iterator[tuple[Mask, Waves]]:
        """Rows of one frequency, and their waves; one phase is enough where nothing swings, or a swing does nothing."""
        order, dither = list(self.loop.parameters), self.loop.dither
        amplitudes = np.zeros(len(p)) if dither is None else p[:, order.index(DITHER_AMPLITUDE)]
        moving = np.logical_and(amplitudes != 0, not is_affine(self.loop.plant))
        if not moving.all():
            still, count = (np.zeros(1), np.ones(1), np.zeros(1)), int((~moving).sum())
            yield ~moving, Waves(0.0, np.zeros(count), *still, np.zeros(count, dtype=np.complex128))
        if dither is None or not moving.any():
            return
        rates = p[:, order.index(DITHER_FREQUENCY)]
        for rate in np.unique(rates[moving]).tolist():
            rows, w = moving & (rates == rate), 2 * pi * rate
            yield rows, Waves(w, amplitudes[rows], *self._phases(dither, rate), np.zeros(int(rows.sum()), complex))

    def _phases(self, dither: Dither, rate: float) -> tuple[Array, Array, Array]:
        """Phases of the swing, their weights, and the wave there, which is held over whole periods and samples."""
        h = self.loop.pid.sample_time
        if h is None or dither.analogue:
            phases, weights = phase_quadrature(self.phases, dither.waveform)
            return phases, weights, dither.waveform.at(phases)
        samples = max(1, round(dither.period(rate, h) / h))
        each = ceil(self.phases / samples)
        t = (np.arange(samples * each) + 0.5) * (h / each)
        w = 2 * pi * rate
        return np.asarray(w * t), np.full(len(t), 1 / len(t)), dither.waveform.at(np.asarray(w * h * np.floor(t / h)))

    def _balance(self, p: Array, x: Array, u: Array, waves: Waves) -> Moments:
        """Moments along the first harmonic that balances, by Newton's method, each row halving its own steps."""
        loop, q = self.loop, p[:, [list(self.loop.parameters).index(n) for n in self.loop.plant.parameters]]
        best = self._moments(q, x, u, waves, np.zeros((len(x), 2 * x.shape[1])))
        if not waves.frequency:
            return best
        point = best.output[:, -1], u[:, names(loop.plant.inputs).index(loop.command.name)]
        if not loop.is_composed:  # far above its bandwidth such a controller is taken not to react
            waves = replace(waves, feedback=controller_response(loop, p, waves.frequency, *point))
        left = _imbalance(best, waves)
        step, size = _newton_step(best, waves, left), np.linalg.norm(left, axis=1)
        fraction, k = np.ones(len(x)), np.arange(len(x))
        for _ in range(MAX_BALANCE_STEPS):
            moved = fraction[k, None] * step[k]
            trial = self._moments(q[k], x[k], u[k], waves.select(k), best.swing[k] + moved)
            left = _imbalance(trial, waves.select(k))
            after = np.linalg.norm(left, axis=1)
            better = after < size[k]
            for mine, theirs in ((best.swing, trial.swing), (best.J, trial.J), (best.output, trial.output)):
                mine[k[better]] = theirs[better]
            size[k[better]], fraction[k] = after[better], np.where(better, 1.0, fraction[k] / 2)
            done = np.abs(moved).max(axis=1) <= BALANCE_TOLERANCE * np.abs(trial.swing).max(axis=1)
            goes_on = ~done & (fraction[k] >= MIN_BALANCE_FRACTION)
            new = np.flatnonzero(better & goes_on)
            step[k[new]] = _newton_step(trial.select(new), waves.select(k[new]), left[new])
            k = k[goes_on]
            if not len(k):
                break
        return best


@lru_cache(maxsize=32)
def is_affine(plant: System) -> bool:
    """Whether the plant's Jacobian is the same in every state, so that neither motion nor ripple changes it."""
    x, u, p = (ca.SX.sym(s, plant.ode.size1_in(i)) for i, s in enumerate("xup", 1))
    z = ca.vertcat(x, u)
    return not ca.depends_on(ca.jacobian(ca.vertcat(*plant.ode(0, x, u, p)), z), z)


def _imbalance(found: Moments, waves: Waves) -> Array:
    """What is left of the balance ``2 mean(f sin) = -w b`` and ``2 mean(f cos) = w a``, over w, shape (m, 2 n)."""
    n, w = found.J.shape[1], waves.frequency
    a, b = found.swing[:, :n], found.swing[:, n:]
    return np.concatenate([2 / w * found.rates[:, :n] + b, 2 / w * found.rates[:, n:] - a], axis=1)


def _newton_step(found: Moments, waves: Waves, imbalance: Array) -> Array:
    """Newton's step of the swing that removes the imbalance, shape (m, 2 n).

    The command swings by -feedback times the output.
    """
    n, w = found.J.shape[1], waves.frequency
    C, real, imaginary = found.output[:, None, :n], waves.feedback.real, waves.feedback.imag
    ss, sc, cc = (2 / w * M for M in (found.J_ss, found.J_sc, found.J - found.J_ss))
    into_sine, into_cosine = ((-real, imaginary), (-imaginary, -real))  # of the command, by a and by b

    def block(by_sine: Array, by_cosine: Array, direct: Array, column: int) -> Array:
        """Slope of a half of the imbalance to a half of the swing: directly, and through the command."""
        s, c = into_sine[column][:, None, None], into_cosine[column][:, None, None]
        return np.asarray(direct[:, :, :n] + (by_sine[:, :, n:] * s + by_cosine[:, :, n:] * c) * C)

    one = np.eye(n)
    above = np.concatenate([block(ss, sc, ss, 0), block(ss, sc, sc, 1) + one], axis=2)
    below = np.concatenate([block(sc, cc, sc, 0) - one, block(sc, cc, cc, 1)], axis=2)
    slope = np.concatenate([above, below], axis=1)
    return np.asarray(np.linalg.solve(slope, -imbalance[..., None])[..., 0])
