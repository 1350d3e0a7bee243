"""`average_dither`: the mean motion of a plant under a fast dither, without the dither's own oscillation.

Every state swings about its mean, ``x = m + X(theta)``; the means obey ``dm/dt = mean over theta of f(m + X, u + A sin
theta)``, or with a triangle in place of the sine. That smooths at once what the spool's ripple does to the openings and
the piston's to its friction. X is the first harmonic (`ripple`), about one operating point. Valid where the dither is
fast against the loop: the error is of the order of its period. Zames & Shneydor, IEEE Trans. Autom. Control 21, 1976.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, DITHER_OFFSET, Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import Symbols, System, define, names, parameter_vector, stack, symbols
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

AMPLITUDE_FRACTIONS = np.geomspace(1e-3, 1.0, 13)  # fractions of the amplitude, where the whole is too much at once
MAX_NEWTON_ITERATIONS, NEWTON_TOLERANCE, MIN_NEWTON_STEP = 50, 1e-9, 1e-3


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
    given = dithered.parameters | parameters.select(n for n in parameters if n in dithered.parameters)
    swing = _first_harmonic(dithered, given, _operating_point(dithered, given, at, reference), nodes)
    return dict(zip(names(dithered.system.states), swing.tolist(), strict=True))


def mean_start(swing: Mapping[str, complex], x: Sequence[float] | Array) -> Array:
    """Where the means begin if the dither is switched on, at the sine's zero, in state x.

    The swing starts at its phase, not at zero, so the mean starts beside x; without this, what spool and chambers
    gain in the first half period is missing for as long as they remember it.

    Parameters
    ----------
    swing : mapping of state to complex
        As `ripple` gives it.
    x : array_like, shape (n_states,)

    Returns
    -------
    ndarray, shape (n_states,)

    Examples
    --------
    >>> mean_start({"level": 3 - 1j}, [5.0]).tolist()
    [6.0]
    """
    begun: Array = np.asarray(x, dtype=float) - np.array([amplitude.imag for amplitude in swing.values()])
    return begun


@dataclass(frozen=True, eq=False)
class _DitheredSystem:
    """A system and where the wave enters: an input, or, of a loop, the dither's offset.

    `steady_motion` gives states and inputs from the parameters and the reference.
    """

    system: System
    parameters: ParameterSet
    frequency: float
    dithered_input: str | None
    waveform: Waveform
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
            rates, outputs = (_sum_with_weights(column, weights) for column in zip(*found, strict=True))
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
    frequency = parameters.value(DITHER_FREQUENCY)
    if model.loop is not None:
        return _dithered_loop(model.loop, frequency, waveform)
    return _dithered_plant(model.plant, frequency, actuated, waveform)


def _dithered_loop(loop: ClosedLoop, frequency: float, waveform: Waveform | None) -> _DitheredSystem:
    sampled = "the controller is sampled; average the plant, ClosedLoop(average_dither(plant, parameters), pid)"
    require(loop.dither is not None, "averaging needs a loop with dither: ClosedLoop(plant, pid, Dither())")
    require(loop.pid.sample_time is None, sampled)
    own = loop.dither.waveform if loop.dither else Waveform.SINE
    require(waveform in (None, own), f"the loop's dither is a {own.value}; leave waveform= out")

    def steady_motion(parameters: ParameterSet, reference: float) -> tuple[Array, Array]:
        inputs = np.array([reference if n == "reference" else 0.0 for n in names(loop.inputs)])
        return loop.initial(parameters, reference=reference), inputs

    return _DitheredSystem(loop.system(), loop.parameters, frequency, None, own, steady_motion)


def _dithered_plant(
    plant: System, frequency: float, actuated: str | None, waveform: Waveform | None
) -> _DitheredSystem:
    inputs = {q.name: q for q in plant.inputs}
    name = actuated or next(iter(inputs), "")
    require(actuated is not None or len(inputs) == 1, f"the plant has the inputs {', '.join(inputs)}; choose actuated=")
    check_names("input", [name], inputs, "average_dither: actuated")
    added = ParameterSet({n: Parameter(0.0, inputs[name].unit) for n in (DITHER_AMPLITUDE, DITHER_OFFSET)})

    def steady_motion(parameters: ParameterSet, reference: float) -> tuple[Array, Array]:
        if plant.rest_hook is None:
            return np.zeros(len(plant.states)), np.zeros(len(inputs))
        rest = plant.rest_hook(parameters, {"speed": reference})
        states = np.array([rest.states.get(n, 0.0) for n in names(plant.states)])
        return states, np.array([rest.inputs.get(n, 0.0) for n in inputs])

    own = waveform or Waveform.SINE
    return _DitheredSystem(plant, plant.parameters | added, frequency, name, own, steady_motion)


def _operating_point(
    dithered: _DitheredSystem, parameters: ParameterSet, at: Mapping[str, float] | None, reference: float
) -> tuple[Array, Array]:
    """The operating point: states and inputs."""
    if at is None:
        return dithered.steady_motion(parameters, reference)
    states, inputs = names(dithered.system.states), names(dithered.system.inputs)
    check_names("state or input", at, [*states, *inputs], "average_dither: at")
    return np.array([at.get(n, 0.0) for n in states]), np.array([at.get(n, 0.0) for n in inputs])


def _first_harmonic(
    dithered: _DitheredSystem, parameters: ParameterSet, point: tuple[Array, Array], nodes: int
) -> NDArray[np.complex128]:
    """Newton's method; where it fails, the amplitude is raised step by step."""
    require(nodes >= 8, f"nodes must be at least 8, got {nodes}")
    imbalance, full = dithered.imbalance(nodes), parameters.value(DITHER_AMPLITUDE)
    scale = np.tile([q.nominal for q in dithered.system.states], 2)

    def solve_harmonic(fraction: float, start: Array) -> Array | None:
        p = parameter_vector(dithered.parameters, parameters.with_values({DITHER_AMPLITUDE: fraction * full}))
        return _newton_root(lambda z: imbalance(z * scale, *point, p), scale, start)

    found = solve_harmonic(1.0, np.zeros_like(scale))
    if found is None:
        found, before = np.zeros_like(scale), AMPLITUDE_FRACTIONS[0]
        for fraction in AMPLITUDE_FRACTIONS:
            found, before = solve_harmonic(fraction, found * fraction / before), fraction
            where = f"for a dither of {fraction * full:g} at {dithered.frequency:g} Hz"
            if found is None:
                raise ConvergenceError(f"no ripple found {where}; give another operating point, or more nodes")
    a, b = np.split(found * scale, 2)
    return np.asarray(a + 1j * b)


def _newton_root(function: Callable[[Array], Sequence[ca.DM]], scale: Array, z: Array) -> Array | None:
    """A zero by Newton's method with halved steps; None where it does not come."""

    def residual_and_slope(z: Array) -> tuple[Array, Array]:
        left, slope = function(z)
        return left.full().ravel() / scale, slope.full() * scale / scale[:, None]

    left, slope = residual_and_slope(z)
    for _ in range(MAX_NEWTON_ITERATIONS):
        step, size, part = np.linalg.solve(slope, -left), np.abs(left).max(), 1.0
        while not np.abs(residual_and_slope(z + part * step)[0]).max() < size and part > MIN_NEWTON_STEP:
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


def _sum_with_weights(values: Sequence[ca.SX], weights: Array) -> ca.SX:
    return sum((w * v for w, v in zip(weights.tolist(), values, strict=True)), start=ca.SX(0))


def _by_name(quantities: Sequence[Quantity], column: ca.SX) -> dict[str, ca.SX]:
    return {q.name: column[k] for k, q in enumerate(quantities)}
