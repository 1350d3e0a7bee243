"""The controller of a loop linearised: its continuous gains, and its response with dead time and sensor."""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.control.loop import ClosedLoop, find_rest
from pneuopt.dynamics.system import Linearisation, names, parameter_vector
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet


def linear_gains(loop: ClosedLoop, p: Any, measured: ArrayLike = 0.0, command: ArrayLike = 0.0) -> Any:
    """Kp, Ki, Kd, Tf of the controller's continuous equivalent, shape (4, m), of loop parameters p (n_parameters, m).

    Backward Euler puts ``(1 - e^(-s h))/h``, nearly ``s/(1 + s h/2)``, for s: a sampled controller is the continuous
    one with ``Kp + Ki h/2`` and ``Tf + h/2``. Compensators that act always multiply the gains by their slope at the
    measured signal and command, shape (m,), and what they feed back of the measured signal is taken from Kp.
    """
    gains, half = loop.gains(p), 0.5 * (loop.pid.sample_time or 0.0)
    found = ca.vertcat(gains[0, :] + half * gains[1, :], gains[1:3, :], gains[3, :] + half)
    if not loop.controller.acting_always:
        return found
    own = loop.controller_part(np.asarray(p, dtype=float))
    slope, feedback = loop.controller.compensation_slopes(own, measured, command)
    scaled = [ca.DM(slope).T * found[k, :] for k in range(3)]
    return ca.vertcat(scaled[0] - ca.DM(feedback).T, *scaled[1:], found[3, :])


def operating_gains(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> tuple[float, float, float, float]:
    """Kp, Ki, Kd, Tf of `linear_gains` at an operating point of the plant. Parameters as for `linear_plant`."""
    x, u = operating_point(loop, parameters, x, u)
    p, command = loop.parameter_vector(parameters), u.get(loop.command.name, 0.0)
    y = loop.plant.ode(
        0, x, [u.get(n, 0.0) for n in names(loop.plant.inputs)], parameter_vector(loop.plant.parameters, parameters)
    )[1]
    measured = float(y[names(loop.plant.outputs).index(loop.feedback.name)])
    Kp, Ki, Kd, Tf = linear_gains(loop, p, measured, command).full().ravel().tolist()
    return Kp, Ki, Kd, Tf


def pade_delay_response(omega: ArrayLike, dead_time: float) -> NDArray[np.complex128]:
    """``e^(-jw dead_time)`` as Padé's approximant of second order has it, shape (n,); omega [rad/s].

    Examples
    --------
    >>> round(float(np.angle(pade_delay_response([1.0], 1.0), deg=True)[0]), 2)
    -57.22
    """
    s = 1j * np.asarray(omega, dtype=float) * dead_time
    return np.asarray((1 - s / 2 + s**2 / 12) / (1 + s / 2 + s**2 / 12))


def controller_matrices(gains: Any, dead_time: float) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of m PIDs, gains (4, m), from the control error to the command, with a dead time [s] in Padé form."""
    Kp, Ki, Kd, Tf = np.reshape(gains, (4, -1, 1))
    zero, one, rate = np.zeros_like(Tf), np.ones_like(Tf), 1 / Tf
    A = np.stack([np.hstack([zero, zero]), np.hstack([zero, -rate])], axis=1)
    B, C, D = np.stack([Ki, rate], axis=1), np.stack([one, -Kd * rate], axis=2), (Kp + Kd * rate)[..., None]
    if dead_time:  # `pade_delay_response` is 1 - (12 s/T)/(s^2 + 6 s/T + 12/T^2), here with states of one size
        m, root = len(Kp), np.sqrt(12) / dead_time
        lags, fed = np.array([[0.0, root], [-root, -6 / dead_time]]), np.array([[0.0], [1.0]])
        taken = np.array([[0.0, -12 / dead_time]])
        A = np.block([[A, np.zeros((m, 2, 2))], [fed @ C, np.broadcast_to(lags, (m, 2, 2))]])
        B = np.concatenate([B, fed @ D], axis=1)
        C = np.concatenate([C, np.broadcast_to(taken, (m, 1, 2))], axis=2)
    return A, B, C, D


def controller_response(
    loop: ClosedLoop, p: Array, omega: ArrayLike, measured: ArrayLike = 0.0, command: ArrayLike = 0.0
) -> NDArray[np.complex128]:
    """Response (m,) from the measured output to the command, its sign left out, at frequencies omega (m,) [rad/s]."""
    s = 1j * np.broadcast_to(np.asarray(omega, dtype=float), len(p))
    Kp, Ki, Kd, Tf = linear_gains(loop, p.T, measured, command).full()
    controller = Kp + Ki / s + Kd * s / (1 + Tf * s)
    return np.asarray(controller * pade_delay_response(s.imag, loop.dead_time) / (1 + s * loop.sensor_lag(p.T)))


def operating_point(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None, u: Mapping[str, float] | None
) -> tuple[Array, Mapping[str, float]]:
    """The plant's state and inputs; without a state those of the closed loop's rest."""
    if x is not None:
        return x, u or {}
    found, command = find_rest(loop, parameters, 0.0, {})
    return found, {loop.command.name: command, **(u or {})}


def linear_controller(loop: ClosedLoop, parameters: ParameterSet, x: Array, u: Mapping[str, float]) -> Linearisation:
    """The controller from the control error to the command, with the loop's dead time in second-order Padé form."""
    gains = np.reshape(operating_gains(loop, parameters, x, u), (4, 1))
    require(gains[3, 0] > 0, "a continuous derivative needs a filter, Tf > 0")
    A, B, C, D = (matrix[0] for matrix in controller_matrices(gains, loop.dead_time))
    own = ("pid.integral", "pid.filter", "pid.held", "pid.held_before")[: len(A)]
    return Linearisation(A, B, C, D, own, ("error",), ("control",))
