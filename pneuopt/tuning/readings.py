"""What a search watches of a response, on which grid, and the metrics that it reads off it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.dynamics.compiled.rollout import Pieces
from pneuopt.dynamics.runge_kutta import rk4
from pneuopt.dynamics.system import names
from pneuopt.evaluation.air import consumption, metered
from pneuopt.evaluation.metrics import About, Envelope, batch_metrics
from pneuopt.evaluation.window import Window
from pneuopt.tuning.space import MOST_READINGS

Array = NDArray[np.float64]
SIGNAL, CONTROL, FLOW, SPOOL = range(4)  # outputs that are run, the last two for `METERED` only
INTEGRAL = -1  # under dither the last output, and the last state, is the signal's integral
METERED = "AirUse"
LOST = 1e6


@dataclass(frozen=True, eq=False)
class Grid:
    """The samples of one reference.

    Attributes
    ----------
    reference : Step
    t : ndarray, shape (n,)
    u : ndarray, shape (n, n_inputs)
    spacing : float
        [s]
    sample_time : float or None
        Of the controller that holds its command [s].
    """

    reference: Step
    t: Array
    u: Array
    spacing: float
    sample_time: float | None = None

    @property
    def after(self) -> int:
        """The first sample from the step on."""
        return int(np.searchsorted(self.t, self.reference.at - 1e-12))

    def padded(self, n: int) -> tuple[Array, Array, Array]:
        """Inputs, instants and steps, the last sample repeated to n samples; no step leaves it: runs end there."""
        k = np.minimum(np.arange(n), len(self.t) - 1)
        return self.u[k], self.t[k], np.where(np.arange(n) < len(self.t) - 1, self.spacing, 0.0)


def watched(loop: ClosedLoop, *, with_meter: bool = False) -> Pieces:
    """The loop's sampled step with no outputs but the measured signal and the command, and what a meter shows.

    Under dither the signal's integral, from zero on, is one more state and the last output.

    Raises
    ------
    InputError
        If a plant without a meter shall be metered.
    """
    discrete, outputs = loop.discrete(), names(loop.outputs)
    ode = (loop.system() if loop.pid.sample_time is None else loop.held()).ode
    kept = [outputs.index(loop.feedback.name), outputs.index("control")]
    t, h, x, u, p = (ca.SX.sym(n, discrete.step.size1_in(i)) for i, n in enumerate("thxup"))
    total = ca.SX.sym("integral", int(is_averaged(loop)))
    z = ca.vertcat(x, total)

    def rates(t: ca.SX, z: ca.SX) -> tuple[ca.SX, ca.SX]:
        x = z[: len(loop.states)]
        xdot, y = ode(t, x, u, p)
        shown = y[kept]
        if with_meter:
            shown = ca.vertcat(shown, metered(loop, x, u, p, shown[CONTROL]))
        grown = [] if total.is_empty() else [shown[SIGNAL]]
        return ca.vertcat(xdot, *grown), ca.vertcat(shown, z[len(loop.states) :])

    y = rates(t, z)[1]
    after = rk4(lambda at, z: rates(at, z)[0], t, h, z)
    step = ca.Function("step", [t, h, z, u, p], [after, y], {"cse": True})
    update = discrete.update and ca.Function("update", [t, z, u, p], [ca.vertcat(_updated(loop, t, x, u, p), total)])
    return Pieces(step, update, ca.Function("ode", [t, z, u, p], [rates(t, z)[0], y]))


def _updated(loop: ClosedLoop, t: ca.SX, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """The state after an instant that may be a sample of the controller, or lie between two."""
    h = loop.pid.sample_time
    assert h is not None
    near = 0.25 / MOST_READINGS
    return ca.if_else(ca.fmod(t / h + near, 1.0) < 2 * near, loop.update(t, x, u, p), x)


def is_averaged(loop: ClosedLoop) -> bool:
    """Whether the runs of `watched` carry the signal's integral."""
    return loop.dither is not None


def read_off(
    grid: Grid, y: Array, bands: Sequence[float], period: float | None, only: Collection[str], envelope: Envelope
) -> dict[str, Array]:
    """The metrics `only` of sound responses y, shape (m, n, n_watched).

    Over several bands SettlingTime is the mean, in which an unsettled one counts for `unsettled`.
    """
    reference, signal, since = grid.reference, y[:, :, SIGNAL], slice(grid.after, None)
    late = slice(int(np.searchsorted(grid.t, 0.8 * reference.horizon + 0.2 * reference.at)), None)
    excess = np.abs(signal[:, late] - reference.final).mean(axis=1) / abs(reference.whole)
    averaged = None
    if period is not None:
        averaged = Window(period, grid.spacing).means(signal[:, since], y[:, since, INTEGRAL], reference.initial)
    settings: Any = {"start": reference.at, "about": About.REFERENCE, "dither_period": period, "averaged": averaged}
    settings["sample_time"] = grid.sample_time
    settings["scale"] = None if reference.is_step else reference.whole
    given = (grid.t, signal, reference.final, reference.initial)
    control = y[:, :, CONTROL]
    found = batch_metrics(*given, band=bands[0], control=control, envelope=envelope, only=only, **settings)
    if len(bands) > 1:
        more = (batch_metrics(*given, band=band, only=("SettlingTime",), **settings) for band in bands[1:])
        times = [found["SettlingTime"], *(wider["SettlingTime"] for wider in more)]
        most = unsettled(reference.horizon - reference.at, excess)
        found["SettlingTime"] = np.mean([np.where(np.isnan(t), most, t) for t in times], axis=0)
    if METERED in only:
        found |= consumption(grid.t, y[:, :, FLOW], y[:, :, SPOOL], reference.at)
    found["Excess"] = excess
    return {n: found[n] for n in only}


def unsettled(scale: float, excess: Array) -> Array:
    """What a search takes for the settling time of a response that never settles [s]: graded, so that it can start."""
    return np.asarray(scale * (2 + np.minimum(excess, LOST)))
