"""Inputs that run linearly from sample to sample: as an integration reads them, and as inputs of a sampled step.

A held input stays what it is, so that it costs nothing. Of a linear one the sampled step also gets its slope, and the
instant of the sample, from which it computes the input wherever within the sample RK4 asks for it.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from pneuopt.dynamics.runge_kutta import rk4
from pneuopt.dynamics.system import DiscreteSystem
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import Quantity

SAMPLE_INSTANT = "sample_instant"


@dataclass(frozen=True, eq=False)
class Ramp:
    """Inputs from an instant `t` [s] on: held, or with a slope."""

    t: float
    u: Array
    slope: Array | None = None

    def at(self, t: float) -> Array:
        """The inputs at an instant, shape (n_inputs,)."""
        return self.u if self.slope is None else self.u + (t - self.t) * self.slope


def slopes(t: Array, u: Array, linear: Mask) -> Array:
    """Slopes of the inputs u, shape (n, n_inputs), behind each sample: zero behind the last, and if not `linear`."""
    out = np.zeros_like(u)
    out[:-1] = np.where(linear, np.diff(u, axis=0) / np.diff(t)[:, None], 0.0)
    return out


def add_slopes(discrete: DiscreteSystem, linear: Mask) -> DiscreteSystem:
    """A sampled system of which some inputs run linearly within a sample; where none does, the system itself.

    Its inputs are those of `discrete`, then a slope for each linear one, then the instant of the sample [s], as
    `append_slopes` gives them. It takes every slope, zero too, so one system serves logs that differ in what they hold.

    Raises
    ------
    ModelError
        If the system has no right-hand side, only a step.
    """
    if not linear.any():
        return discrete
    if discrete.ode is None:
        raise ModelError("linear inputs need the system's ode, not only its step")
    positions = np.flatnonzero(linear).tolist()
    n = {k: discrete.ode.size1_in(i) for i, k in enumerate("txup")}
    t, h, x, u, p = (ca.SX.sym(k, n.get(k, 1)) for k in "thxup")
    slope, since = ca.SX.sym("slope", len(positions)), ca.SX.sym(SAMPLE_INSTANT)
    moved = ca.SX(u)
    moved[positions] += slope * (t - since)
    given = ca.vertcat(u, slope, since)
    ode = ca.Function("ode", [t, x, given, p], [*discrete.ode(t, x, moved, p)], ["t", "x", "u", "p"], ["xdot", "y"])
    results = [rk4(lambda at, z: ode(at, z, given, p)[0], t, h, x), ode(t, x, given, p)[1]]
    step = ca.Function("step", [t, h, x, given, p], results, ["t", "h", "x", "u", "p"], ["x_next", "y"], {"cse": True})
    update = discrete.update
    if update is not None:
        update = ca.Function("update", [t, x, given, p], [update(t, x, u, p)], ["t", "x", "u", "p"], ["x_after"])
    more = [Quantity(f"{discrete.inputs[i].name}_slope", f"{discrete.inputs[i].unit}/s") for i in positions]
    inputs = (*discrete.inputs, *more, Quantity(SAMPLE_INSTANT, "s"))
    return replace(discrete, inputs=inputs, step=step, ode=ode, update=update)


def append_slopes(t: Array, u: Array, linear: Mask, rising: Mask) -> Array:
    """The inputs of `add_slopes` along a log, of which only some are `rising`.

    Parameters
    ----------
    t : ndarray, shape (n,)
    u : ndarray, shape (n, n_inputs)
    linear, rising : ndarray of bool, shape (n_inputs,)

    Returns
    -------
    ndarray, shape (n, n_inputs + linear.sum() + 1)
    """
    return np.column_stack([u, slopes(t, u, rising)[:, linear], t]) if linear.any() else u
