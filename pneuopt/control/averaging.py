"""The mean motion of a plant under a fast dither, without the dither's own oscillation: simulated, and linearised.

Every state swings about its mean, ``x = m + X(theta)``; the means obey ``dm/dt = mean over theta of f(m + X, u + A sin
theta)``, or with a triangle in place of the sine (`average_dither`). That smooths at once what the spool's ripple does
to the openings and the piston's to its friction. X is the first harmonic (`ripple`), about one operating point. Valid
where the dither is fast against the loop: the error is of the order of its period.

What a slow signal sees of the plant (`AveragedPlant`) is the mean over theta of its Jacobian at ``m + X, u + U``, the
controller's reaction to the ripple included; a sampled wave is held from sample to sample. At amplitude zero it is the
plant's own linearisation. Zames & Shneydor, IEEE Trans. Autom. Control 21, 1976.

`controller_response` is the controller's own frequency response, with dead time and sensor, which both views share.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import ceil, pi
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, DITHER_OFFSET, Dither, Waveform
from pneuopt.control.loop import ClosedLoop, find_rest
from pneuopt.control.tolerances import (
    BALANCE_TOLERANCE,
    MAX_NEWTON_STEPS,
    MAX_RIPPLE_STEPS,
    MIN_NEWTON_FRACTION,
    NEWTON_TOLERANCE,
    RIPPLE_PHASES,
)
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.system import Linearisation, Symbols, System, define, names, parameter_vector, stack, symbols
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import ConvergenceError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

AMPLITUDE_FRACTIONS = np.geomspace(1e-3, 1.0, 13)  # fractions of the amplitude, where the whole is too much at once


def average_dither(
    model: System | ClosedLoop,
    parameters: ParameterSet,
    *,
    at: Mapping[str, float] | None = None,
    reference: float = 0.0,
    actuated: str | None = None,
    nodes: int = 64,
    waveform: Waveform | None = None,
) -> System:
    """The mean motion of a plant, or of a loop, under dither.

    Parameters
    ----------
    model : System or ClosedLoop
        A plant; or a loop with dither and a continuous controller, which then reacts to its own ripple, and is clipped
        on its average.
    parameters : ParameterSet
        With "dither.amplitude" and "dither.frequency" [Hz], as of the loop. The amplitude stays a parameter: the ripple
        grows with it in proportion. The frequency, and the operating point, are built in.
    at : mapping of state or input to value, optional
        The operating point of the ripple; absent ones are zero. By default the steady motion at `reference`.
    reference : float
        [unit of the measured signal, a plant's speed]; dry friction at rest leaves next to no ripple of the speed.
    actuated : str, optional
        Of a plant: the input that is dithered; by default its only one.
    nodes : int
        Phases over which is averaged; a function of the sine alone sees the half as many nodes of Gauss and Chebyshev,
        ``A cos((2 i - 1) pi / nodes)``, one of the triangle, which is spread evenly, those of Gauss and Legendre.
    waveform : Waveform, optional
        Of the dither on a plant, by default a sine; a loop's dither has its own.

    Returns
    -------
    System
        States and outputs are means. Of a plant it has "dither.amplitude" and "dither.offset", too:
        ``ClosedLoop(average_dither(plant, p), pid)`` takes the parameters of the dithered loop.

    Raises
    ------
    InputError
        If the parameters say no dither, or the loop has none or a sampled controller.
    ConvergenceError
        If no ripple is found; give another operating point.

    Examples
    --------
    A dead zone of 0.2 under a sine of 0.4 passes (2/pi) acos(0.2/0.4) = 2/3 of the slope:

    >>> from pneuopt.models.pneumatic.valve import opening
    >>> from pneuopt.quantities.parameters import Quantity
    >>> x, u = Quantity("level", "1"), Quantity("spool", "1")
    >>> edge = {"dead_zone": 0.2, "rounding": 0.02, "leak": 0.0}
    >>> flow = lambda t, x, u, p: ({"level": opening(u["spool"], edge) - opening(-u["spool"], edge)}, dict(x))
    >>> given = ParameterSet({"dither.amplitude": Parameter(0.4, "1"), "dither.frequency": Parameter(100.0, "Hz")})
    >>> mean = average_dither(define([x], [u], [x], ParameterSet(), flow), given)
    >>> round(float(mean.linearise(np.zeros(1), {}, given).B[0, 0]), 2)
    0.67
    """
    swing = ripple(model, parameters, at=at, reference=reference, actuated=actuated, nodes=nodes, waveform=waveform)
    share = np.array([*swing.values()], dtype=np.complex128) / parameters.value(DITHER_AMPLITUDE)
    return _add_dither(model, parameters, actuated, waveform).mean_system(share, nodes)


def ripple(
    model: System | ClosedLoop,
    parameters: ParameterSet,
    *,
    at: Mapping[str, float] | None = None,
    reference: float = 0.0,
    actuated: str | None = None,
    nodes: int = 64,
    waveform: Waveform | None = None,
) -> dict[str, complex]:
    """How every state swings under dither: the balance of the first harmonic, with friction and openings as they are.

    Parameters and errors as for `average_dither`.

    Returns
    -------
    dict of str to complex
        By state: the peak, and the phase by which it leads the sine, or the triangle.
    """
    dithered = _add_dither(model, parameters, actuated, waveform)
    complete = dithered.parameters | parameters.select(n for n in parameters if n in dithered.parameters)
    states, inputs = names(dithered.system.states), names(dithered.system.inputs)
    if at is None:
        point = dithered.steady_motion(complete, reference)
    else:
        check_names("state or input", at, [*states, *inputs], "average_dither: at")
        point = np.array([at.get(n, 0.0) for n in states]), np.array([at.get(n, 0.0) for n in inputs])
    require(nodes >= 8, f"nodes must be at least 8, got {nodes}")
    imbalance, full = dithered.imbalance(nodes), complete.value(DITHER_AMPLITUDE)
    scale = np.tile([q.nominal for q in dithered.system.states], 2)

    def solve_harmonic(fraction: float, start: Array) -> Array | None:
        p = parameter_vector(dithered.parameters, complete.with_values({DITHER_AMPLITUDE: fraction * full}))
        return _newton_root(lambda z: imbalance(z * scale, *point, p), scale, start)

    found = solve_harmonic(1.0, np.zeros_like(scale))
    if found is None:  # the amplitude is raised step by step
        found, before = np.zeros_like(scale), AMPLITUDE_FRACTIONS[0]
        for fraction in AMPLITUDE_FRACTIONS:
            found, before = solve_harmonic(fraction, found * fraction / before), fraction
            where = f"for a dither of {fraction * full:g} at {dithered.frequency:g} Hz"
            if found is None:
                raise ConvergenceError(f"no ripple found {where}; give another operating point, or more nodes")
    a, b = np.split(found * scale, 2)
    return dict(zip(states, (a + 1j * b).tolist(), strict=True))


def mean_start(swing: Mapping[str, complex], x: Sequence[float] | Array) -> Array:
    """Where the means begin if the dither is switched on, at the sine's zero, in state x.

    The swing starts at its phase, not at zero, so the mean starts beside x; without this, what spool and chambers
    gain in the first half period is missing for as long as they remember it.

    Parameters
    ----------
    swing : mapping of state to complex
        As `ripple` gives it.
    x : array_like, shape (n_states,)
        The state when the dither is switched on.

    Returns
    -------
    ndarray, shape (n_states,)
        The means at that instant.

    Examples
    --------
    >>> mean_start({"level": 3 - 1j}, [5.0]).tolist()
    [6.0]
    """
    begun: Array = np.asarray(x, dtype=float) - np.array([amplitude.imag for amplitude in swing.values()])
    return begun


@dataclass(frozen=True, eq=False)
class _DitheredSystem:
    """A system and where the wave enters: an input, or, of a loop, the dither's offset."""

    system: System
    parameters: ParameterSet
    frequency: float  # [Hz]
    dithered_input: str | None  # None of a loop
    waveform: Waveform
    # from parameters and reference, the states and inputs
    steady_motion: Callable[[ParameterSet, float], tuple[Array, Array]]

    def rates(self, t: ca.SX, x: ca.SX, u: Symbols, p: Symbols, wave: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Rates and outputs while the wave has this value."""
        own = {n: p[n] for n in self.system.parameters}
        if self.dithered_input is None:
            own |= {DITHER_AMPLITUDE: ca.SX(0), DITHER_OFFSET: p[DITHER_OFFSET] + wave}
        else:
            u = {**u, self.dithered_input: u[self.dithered_input] + p[DITHER_OFFSET] + wave}
        xdot, y = self.system.ode(t, x, stack(u), stack(own))
        return xdot, y

    def mean_system(self, unit: NDArray[np.complex128], nodes: int) -> System:
        """The system of the means, for a ripple of `unit` per amplitude."""
        system, (phases, weights) = self.system, phase_quadrature(nodes, self.waveform)
        waves, swings = (
            self.waveform.at(phases),
            np.outer(np.sin(phases), unit.real) + np.outer(np.cos(phases), unit.imag),
        )

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
            A, z = p[DITHER_AMPLITUDE], stack(x)
            found = [self.rates(t, z + A * ca.DM(X), u, p, A * w) for w, X in zip(waves.tolist(), swings, strict=True)]
            rates, outputs = (
                sum((w * v for w, v in zip(weights.tolist(), column, strict=True)), start=ca.SX(0))
                for column in zip(*found, strict=True)
            )
            return _by_name(system.states, rates), _by_name(system.outputs, outputs)

        mean = define(system.states, system.inputs, system.outputs, self.parameters, rhs)
        return replace(
            mean,
            rest_hook=system.rest_hook,
            hardware_check_hook=system.hardware_check_hook,
            validity_limits=system.validity_limits,
            axis=system.axis,
        )

    def imbalance(self, nodes: int) -> ca.Function:
        """``(a, b; x, u, p) -> first harmonic of the rates, less that of the swing a sin theta + b cos theta``."""
        n, w = len(self.system.states), 2 * pi * self.frequency
        a, b, x = (ca.SX.sym(k, n) for k in "abx")
        u, p = symbols(self.system.inputs), {n: ca.SX.sym(n) for n in self.parameters}
        inphase, quadrature = ca.SX(n, 1), ca.SX(n, 1)
        for phase, weight in zip(*phase_quadrature(nodes, self.waveform), strict=True):
            sine, cosine, wave = np.sin(phase), np.cos(phase), float(self.waveform.at(phase))
            rate = self.rates(ca.SX(0), x + a * sine + b * cosine, u, p, p[DITHER_AMPLITUDE] * wave)[0]
            inphase, quadrature = inphase + 2 * weight * sine * rate, quadrature + 2 * weight * cosine * rate
        unknown, left = ca.vertcat(a, b), ca.vertcat(quadrature - w * a, inphase + w * b) / w
        values = [unknown, x, stack(u), stack(p)]
        return ca.Function("imbalance", values, [left, ca.jacobian(left, unknown)])


def _add_dither(
    model: System | ClosedLoop, parameters: ParameterSet, actuated: str | None, waveform: Waveform | None
) -> _DitheredSystem:
    for name in (DITHER_AMPLITUDE, DITHER_FREQUENCY):
        positive = name in parameters and parameters.value(name) > 0
        require(positive, f"averaging needs a dither: parameters with {name} > 0")
    frequency, plant, loop = parameters.value(DITHER_FREQUENCY), model.plant, model.loop
    if loop is not None:
        sampled = "the controller is sampled; average the plant, ClosedLoop(average_dither(plant, parameters), pid)"
        require(loop.dither is not None, "averaging needs a loop with dither: ClosedLoop(plant, pid, Dither())")
        require(loop.pid.sample_time is None, sampled)
        own = loop.dither.waveform if loop.dither else Waveform.SINE
        require(waveform in (None, own), f"the loop's dither is a {own.value}; leave waveform= out")

        def loop_motion(parameters: ParameterSet, reference: float) -> tuple[Array, Array]:
            inputs = np.array([reference if n == "reference" else 0.0 for n in names(loop.inputs)])
            return loop.initial(parameters, reference=reference), inputs

        return _DitheredSystem(loop.system(), loop.parameters, frequency, None, own, loop_motion)
    inputs = {q.name: q for q in plant.inputs}
    name = actuated or next(iter(inputs), "")
    require(actuated is not None or len(inputs) == 1, f"the plant has the inputs {', '.join(inputs)}; choose actuated=")
    check_names("input", [name], inputs, "average_dither: actuated")
    added = ParameterSet({n: Parameter(0.0, inputs[name].unit) for n in (DITHER_AMPLITUDE, DITHER_OFFSET)})

    def plant_motion(parameters: ParameterSet, reference: float) -> tuple[Array, Array]:
        if plant.rest_hook is None:
            return np.zeros(len(plant.states)), np.zeros(len(inputs))
        rest = plant.rest_hook(parameters, {"speed": reference})
        states = np.array([rest.states.get(n, 0.0) for n in names(plant.states)])
        return states, np.array([rest.inputs.get(n, 0.0) for n in inputs])

    own = waveform or Waveform.SINE
    return _DitheredSystem(plant, plant.parameters | added, frequency, name, own, plant_motion)


def _newton_root(function: Callable[[Array], Sequence[ca.DM]], scale: Array, z: Array) -> Array | None:
    """A zero by Newton's method with halved steps; None where it does not come."""

    def residual_and_slope(z: Array) -> tuple[Array, Array]:
        left, slope = function(z)
        return left.full().ravel() / scale, slope.full() * scale / scale[:, None]

    left, slope = residual_and_slope(z)
    for _ in range(MAX_RIPPLE_STEPS):
        step, size, part = np.linalg.solve(slope, -left), np.abs(left).max(), 1.0
        while not np.abs(residual_and_slope(z + part * step)[0]).max() < size and part > MIN_NEWTON_FRACTION:
            part /= 2
        z = z + part * step
        if part * np.abs(step).max() <= NEWTON_TOLERANCE * np.abs(z).max():
            return z
        left, slope = residual_and_slope(z)
    return None


def phase_quadrature(nodes: int, waveform: Waveform) -> tuple[Array, Array]:
    """Phases of a period, and their weights: for a sine evenly, on no turning point; for a triangle on either slope."""
    if waveform is Waveform.SINE:
        return (2 * np.arange(1, nodes + 1) - 1) * pi / nodes, np.full(nodes, 1 / nodes)
    at, weights = np.polynomial.legendre.leggauss(nodes // 2)
    return np.concatenate([at * pi / 2, at * pi / 2 + pi]), np.tile(weights / 4, 2)


def _by_name(quantities: Sequence[Quantity], column: ca.SX) -> dict[str, ca.SX]:
    return {q.name: column[k] for k, q in enumerate(quantities)}


@dataclass(frozen=True, eq=False)
class Waves:
    """The waves on the commands of m plants at one frequency, at n phases."""

    frequency: float  # [rad/s]; 0 where nothing swings
    amplitudes: Array  # (m,) [command's unit]
    phases: Array  # (n,) [rad]
    weights: Array  # (n,) of the phases in a mean
    shape: Array  # (n,) the wave as the plant gets it, of amplitude 1
    feedback: NDArray[np.complex128]  # (m,) the controller's response to the measured output at this frequency

    def select(self, rows: Indices) -> "Waves":
        """The waves on some of the commands."""
        return replace(self, amplitudes=self.amplitudes[rows], feedback=self.feedback[rows])


class Moments(NamedTuple):
    """Means over the phases of m plants, their n states scaled by nominal values; J is [A B], B the command's."""

    swing: Array  # (m, 2 n): a sin theta + b cos theta, a before b
    rates: Array  # (m, 2 n): the rates times sin theta, then times cos theta
    J: Array  # (m, n, n + 1): the Jacobian
    J_ss: Array  # likewise, times sin^2
    J_sc: Array  # likewise, times sin cos
    output: Array  # (m, n + 2): [C D] of the measured output, then the output itself

    def select(self, rows: Indices) -> "Moments":
        """The moments of some of the plants."""
        return Moments(*(field[rows] for field in self))


@dataclass(frozen=True, eq=False)
class RippleMoments:
    """Function that computes `Moments`: a rollout in which a phase takes the place of a sample."""

    loop: ClosedLoop
    compiled: bool = False

    @cached_property
    def scale(self) -> Array:
        """The nominal values of the plant's states."""
        return np.array([q.nominal for q in self.loop.plant.states])

    def __call__(self, q: Array, x: Array, u: Array, waves: Waves, swing: Array) -> Moments:
        """Moments of m plants of parameters q, mean states x (m, n), mean inputs u, and the swing (m, 2 n)."""
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

    Machine code of the plant's Jacobian pays for many plants, not for one.
    """

    loop: ClosedLoop
    compiled: bool = False
    phases: int = RIPPLE_PHASES

    def __call__(self, p: Array, x: Array, u: Array) -> PlantMatrices:
        """Linearise m plants: loop parameters p, and under dither the means of states x and inputs u, (m, ...) each."""
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
        """Rows of one frequency, and their moments along the swing that balances.

        One phase is enough where nothing swings, or a swing does nothing.
        """
        order, dither = list(self.loop.parameters), self.loop.dither
        amplitudes = np.zeros(len(p)) if dither is None else p[:, order.index(DITHER_AMPLITUDE)]
        moving = np.logical_and(amplitudes != 0, not is_affine(self.loop.plant))
        if not moving.all():
            still, count = (np.zeros(1), np.ones(1), np.zeros(1)), int((~moving).sum())
            waves = Waves(0.0, np.zeros(count), *still, np.zeros(count, dtype=np.complex128))
            yield ~moving, self._balance(p[~moving], x[~moving], u[~moving], waves)
        if dither is None or not moving.any():
            return
        rates = p[:, order.index(DITHER_FREQUENCY)]
        for rate in np.unique(rates[moving]).tolist():
            rows, w = moving & (rates == rate), 2 * pi * rate
            waves = Waves(w, amplitudes[rows], *self._phases(dither, rate), np.zeros(int(rows.sum()), complex))
            yield rows, self._balance(p[rows], x[rows], u[rows], waves)

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
        for _ in range(MAX_NEWTON_STEPS):
            moved = fraction[k, None] * step[k]
            trial = self._moments(q[k], x[k], u[k], waves.select(k), best.swing[k] + moved)
            left = _imbalance(trial, waves.select(k))
            after = np.linalg.norm(left, axis=1)
            better = after < size[k]
            for mine, theirs in ((best.swing, trial.swing), (best.J, trial.J), (best.output, trial.output)):
                mine[k[better]] = theirs[better]
            size[k[better]], fraction[k] = after[better], np.where(better, 1.0, fraction[k] / 2)
            done = np.abs(moved).max(axis=1) <= BALANCE_TOLERANCE * np.abs(trial.swing).max(axis=1)
            goes_on = ~done & (fraction[k] >= MIN_NEWTON_FRACTION)
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
    """Newton's step of the swing, shape (m, 2 n), that removes the imbalance; the command swings by -feedback y."""
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


def controller_matrices(gains: Any) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of m continuous PIDs, gains (4, m), from the control error to the command."""
    Kp, Ki, Kd, Tf = np.reshape(gains, (4, -1, 1))
    zero, rate = np.zeros_like(Tf), 1 / Tf
    A = np.stack([np.hstack([zero, zero]), np.hstack([zero, -rate])], axis=1)
    C = np.stack([np.ones_like(Tf), -Kd * rate], axis=2)
    return A, np.stack([Ki, rate], axis=1), C, (Kp + Kd * rate)[..., None]


def controller_response(
    loop: ClosedLoop, p: Array, omega: ArrayLike, measured: ArrayLike = 0.0, command: ArrayLike = 0.0
) -> NDArray[np.complex128]:
    """Response (m,) from the measured output to the command, its sign left out, at frequencies omega (m,) [rad/s]."""
    s = 1j * np.broadcast_to(np.asarray(omega, dtype=float), len(p))
    Kp, Ki, Kd, Tf = linear_gains(loop, p.T, measured, command).full()
    controller = Kp + Ki / s + Kd * s / (1 + Tf * s)
    return np.asarray(controller * np.exp(-s * loop.dead_time) / (1 + s * loop.sensor_lag(p.T)))


def operating_point(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None, u: Mapping[str, float] | None
) -> tuple[Array, Mapping[str, float]]:
    """The plant's state and inputs; without a state those of the closed loop's rest."""
    if x is not None:
        return x, u or {}
    found, command = find_rest(loop, parameters, 0.0, {})
    return found, {loop.command.name: command, **(u or {})}


def linear_controller(loop: ClosedLoop, parameters: ParameterSet, x: Array, u: Mapping[str, float]) -> Linearisation:
    """The continuous PID from the control error to the command."""
    gains = np.reshape(operating_gains(loop, parameters, x, u), (4, 1))
    require(gains[3, 0] > 0, "a continuous derivative needs a filter, Tf > 0")
    A, B, C, D = (matrix[0] for matrix in controller_matrices(gains))
    return Linearisation(A, B, C, D, ("pid.integral", "pid.filter"), ("error",), ("control",))
