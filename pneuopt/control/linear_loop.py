"""The loop linearised: `linear_plant`, the plant as the controller sees it; `open_loop`, whose margins count.

Sampled loops, and loops whose controller feeds back several signals, are cut at the command (`ComposedLoops`). The
controller's law is differentiated as it runs (`Controller.update`), so there is one law. A sampled one is exact: the
plant on a held command by its matrix exponential, the controller from sample to sample with its delay, and the discrete
loop L(z) in continuous form by the bilinear transformation ``z = (1 + s h/2)/(1 - s h/2)``, which maps the unit circle
to the imaginary axis.

A plant's dead time is in the matrices as a Padé approximant, which decides nothing: responses take the delay itself
(`delay_over_pade`). On a held command that part of it which is no whole number of samples is exact in the matrices.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from pneuopt.control.averaging import AveragedPlant, linear_controller, operating_point
from pneuopt.control.compensators import ControllerSnapshot
from pneuopt.control.controller import Controller
from pneuopt.control.dither import DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.sensor import Encoder, SensorLag, Signals
from pneuopt.control.tolerances import LARGEST_TAYLOR_NORM, LEAST_SAMPLES, TAYLOR_TERMS
from pneuopt.dynamics.dead_time import pade_matrices
from pneuopt.dynamics.system import Linearisation, names, stack
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet, with_prefix, without_prefix

Matrices = tuple[Array, Array, Array, Array]
"""A, B, C, D of m systems with one input and one output, shapes (m, n, n), (m, n, 1), (m, 1, n), (m, 1, 1)."""


def linear_plant(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> Linearisation:
    """The plant from command to measured output, or to the reading of a sensor with a lag, linearised.

    Under dither it is the mean over the ripple (`AveragedPlant`), which is what a signal slower than the dither meets.

    Parameters
    ----------
    loop : ClosedLoop
        Whose plant it is.
    parameters : ParameterSet
        A missing one has the loop's default.
    x : ndarray, shape (n_plant_states,), optional
        The plant's operating point, an equilibrium or not, under dither its means; by default the closed loop's rest.
        Dry friction makes a resting plant look stiff: linearise such a plant in motion.
    u : mapping of str to float, optional
        The plant's inputs there, zero where absent; at rest the command is solved for.

    Returns
    -------
    Linearisation
        With one input, the command, and one output; a sensor's lag adds the state "sensor.reading".
    """
    loop.check(parameters)
    x, u = operating_point(loop, parameters, x, u)
    plant = loop.plant.linearise(x, u, parameters)
    j, i = plant.inputs.index(loop.command.name), plant.outputs.index(loop.feedback.name)
    A, B, C, D = plant.A, plant.B[:, j : j + 1], plant.C[i : i + 1], plant.D[i : i + 1, j : j + 1]
    p = loop.parameter_vector(parameters)
    if loop.dither_period(parameters):
        at = np.array([[u.get(n, 0.0) for n in plant.inputs]])
        A, B, C, D, _ = (M[0] for M in _averaged_plant(loop)(p[None], np.asarray(x, dtype=float)[None], at))
        B, C, D = B[:, None], C[None], np.array([[D]])
    states, lag = plant.states, loop.sensor_lag(p)
    if lag:
        n = len(A)
        A = np.block([[A, np.zeros((n, 1))], [C / lag, np.array([[-1 / lag]])]])
        B, C, D = np.vstack([B, D / lag]), np.eye(1, n + 1, n), np.zeros((1, 1))
        states = (*states, "sensor.reading")
    late, order = dead_times(loop, p[None])
    return Linearisation(A, B, C, D, states, (loop.command.name,), (loop.feedback.name,), float(late[0]), order)


def dead_times(loop: ClosedLoop, p: Array) -> tuple[Array, int]:
    """The plant's dead times between command and effect (m,) [s], of loop parameters p (m, ...), and the Padé order."""
    late = loop.plant.dead_time
    if late is None or late.input != loop.command.name:
        return np.zeros(len(p)), 0
    return p[:, list(loop.parameters).index(late.parameter)], len(late.states)


def is_cut_at_command(loop: ClosedLoop) -> bool:
    """Whether a loop is linearised by `ComposedLoops`; a continuous PID of one signal needs only its gains."""
    return loop.is_composed or loop.pid.sample_time is not None


def open_loop(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> Linearisation:
    """``L(s) = C(s) P(s)`` under negative feedback, cut at the measured output, without saturation.

    P is the `linear_plant`, averaged under dither. An integral counts as one without dead band and resets. Compensators
    that act always count by their slopes at the operating point; a knocker's pulses do not. A sampled loop, and one
    with further feedback (`ClosedLoop.is_composed`), is cut at the command; a sampled one is the loop L(z) from sample
    to sample, hold and computing delay included. Parameters as for `linear_plant`.

    Returns
    -------
    Linearisation
        From the control error, input "error", to the measured output; the plant's states come first. A sampled loop is
        in the form of ``z = (1 + s h/2)/(1 - s h/2)``, see its `sample_time`.
    """
    x, u = operating_point(loop, parameters, x, u)
    if is_cut_at_command(loop):
        return _composed_loops(loop, parameters, x, u)[0]
    plant, controller = linear_plant(loop, parameters, x, u), linear_controller(loop, parameters, x, u)
    m, n = len(controller.A), len(plant.A)
    return Linearisation(
        np.block([[plant.A, plant.B @ controller.C], [np.zeros((m, n)), controller.A]]),
        np.vstack([plant.B @ controller.D, controller.B]),
        np.hstack([plant.C, np.zeros((1, m))]),
        np.zeros((1, 1)),
        plant.states + controller.states,
        ("error",),
        (loop.feedback.name,),
        plant.dead_time,
        plant.pade_order,
    )


def noise_path(
    loop: ClosedLoop, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
) -> Linearisation:
    """The controller of a loop cut at the command, from noise on what the PID or outer loop sees to the command."""
    return _composed_loops(loop, parameters, *operating_point(loop, parameters, x, u))[1]


def _composed_loops(
    loop: ClosedLoop, parameters: ParameterSet, x: Array, u: Mapping[str, float]
) -> tuple[Linearisation, Linearisation]:
    """The open loop and the noise path at an operating point."""
    loop.check(parameters)
    at = np.array([[u.get(n, 0.0) for n in names(loop.plant.inputs)]])
    found = _composed_loop(loop)(loop.parameter_vector(parameters)[None], np.asarray(x, dtype=float)[None], at)
    h, line = loop.pid.sample_time, loop.plant.dead_time.states if loop.plant.dead_time else ()
    # of a sampled loop the dead time stands behind the controller, not in the plant
    plant = tuple(n for n in names(loop.plant.states) if h is None or n not in line)
    own = [f"controller.{k}" for k in range(found.loop[0].shape[-1] - len(plant))]
    A, B, C, D = (M[0] for M in found.loop)
    late, order = float(found.dead_time[0]), found.pade_order
    opened = Linearisation(A, B, C, D, (*plant, *own), ("error",), (loop.command.name,), late, order, h)
    A, B, C, D = (M[0] for M in found.noise)
    states = tuple(f"controller.{k}" for k in range(found.noise[0].shape[-1]))
    return opened, Linearisation(A, B, C, D, states, ("noise",), (loop.command.name,), sample_time=h)


class OpenLoops(NamedTuple):
    """m loops cut at their commands."""

    loop: Matrices  # under negative feedback; the plant's states come first
    # the controllers alone, from noise on what the PID sees, in a cascade on the position, to the command
    noise: Matrices
    dead_time: Array  # (m,) [s], in the loops' matrices as a Padé approximant of this order
    pade_order: int


@dataclass(frozen=True, eq=False)
class ComposedLoops:
    """Function that linearises many loops of one kind; machine code of the plant's Jacobian pays for many plants.

    Under dither the plant is the mean over its ripple (`AveragedPlant`), to which the controller does not react.
    """

    loop: ClosedLoop
    compiled: bool = False

    def __call__(self, p: Array, x: Array, u: Array) -> OpenLoops:
        """Linearise m loops: parameters p, and the operating points' plant states x and inputs u, (m, ...) each."""
        loop, listed = self.loop, list(self.loop.parameters)
        plant, shown = self._plants(p, x, u)
        p = self._frozen(p.T, shown.T).full().T
        offset = p[:, listed.index(DITHER_OFFSET)] if DITHER_OFFSET in listed else 0.0
        command = u[:, names(loop.plant.inputs).index(loop.command.name)] - offset
        y = dict(zip(names(loop.plant.outputs), shown.T, strict=True))
        seen, read = y[loop.pid_signal.name], np.array([y[n] for n in loop.readings])
        v = loop.controller.uncompensated_command(loop.controller_part(p.T), seen, seen, command, read)
        law = _Laws(*(_split_columns(M.full(), len(p)) for M in self._law(shown.T, v[None], p.T)))
        h, direct, (late, order) = loop.pid.sample_time, np.zeros((*plant[2].shape[:2], 1)), dead_times(loop, p)
        if h is None:
            return OpenLoops(_join((*plant, direct), law.feedback), law.noise, late, order)
        samples = np.floor(late / h + LEAST_SAMPLES)
        held = _bilinear((*_hold(*plant, h, np.maximum(late - samples * h, 0.0)), direct), h)
        joined = _join(held, _bilinear(law.feedback, h))
        if loop.pid.delay:  # a sample behind it, 1/z = (1 - s h/2)/(1 + s h/2)
            one = np.ones((len(p), 1, 1))
            joined = _join(joined, (-2 / h * one, 2 / np.sqrt(h) * one, 2 / np.sqrt(h) * one, -one))
        if not samples.any():
            return OpenLoops(joined, _bilinear(law.noise, h), np.zeros(len(p)), 0)
        whole = np.maximum(samples, LEAST_SAMPLES) * h  # so that all have the same states
        Ad, Bd, Cd, Dd = pade_matrices(order)
        rate, one = 1 / whole[:, None, None], np.ones((len(p), 1, 1))
        return OpenLoops(
            _join(joined, (Ad * rate, Bd * rate, Cd * one, Dd * one)), _bilinear(law.noise, h), whole, order
        )

    def _plants(self, p: Array, x: Array, u: Array) -> tuple[tuple[Array, Array, Array], Array]:
        """A, B and C of the plants with a sensor's lag, in scaled states, and their outputs, shape (m, n_outputs)."""
        loop, scale = self.loop, np.array([q.nominal for q in self.loop.plant.states])
        A, B, _, _, _ = _averaged_plant(loop, self.compiled)(p, x, u)
        A, B = A * scale / scale[:, None], (B / scale)[..., None]
        own = p[:, [list(loop.parameters).index(n) for n in loop.plant.parameters]]
        slopes, shown = self._outputs(x.T, u.T, own.T)
        C = _split_columns(slopes.full(), len(x)) * scale
        order = dead_times(loop, p)[1]
        if loop.pid.sample_time is not None and order:  # without the dead time's states, whose gain at once is +-1
            late = loop.plant.dead_time.states if loop.plant.dead_time else ()
            kept = [k for k, n in enumerate(names(loop.plant.states)) if n not in late]
            A, B, C = A[:, kept][:, :, kept], (-1.0) ** order * B[:, kept], C[:, :, kept]
        if isinstance(loop.sensor, SensorLag):
            rate = 1 / np.reshape(loop.sensor_lag(p.T), (-1, 1, 1)) + np.zeros((len(x), 1, 1))
            k, n = names(loop.plant.outputs).index(loop.pid_signal.name), A.shape[-1]
            A = np.block([[A, np.zeros((len(x), n, 1))], [rate * C[:, k : k + 1], -rate]])
            B = np.concatenate([B, np.zeros((len(x), 1, 1))], axis=1)
            C = np.concatenate([C, np.zeros((*C.shape[:2], 1))], axis=2)
            C[:, k] = np.eye(1, n + 1, n)
        return (A, B, C), shown.full().T

    @cached_property
    def _frozen(self) -> ca.Function:
        """``(p, y) -> p`` with the gains that a schedule has at the plant's outputs."""
        loop = self.loop
        y, p = ({n: ca.SX.sym(n) for n in own} for own in (names(loop.plant.outputs), loop.parameters))
        frozen = loop.controller.schedule_gains(p, y[loop.pid_signal.name], {}, y)
        return ca.Function("frozen", [stack(p), stack(y)], [stack(frozen)])

    @cached_property
    def _outputs(self) -> ca.Function:
        """``(x, u, p) -> slopes to the states, outputs`` of the plant."""
        x, u, p = (ca.SX.sym(s, self.loop.plant.ode.size1_in(i)) for i, s in enumerate("xup", 1))
        y = self.loop.plant.ode(0, x, u, p)[1]
        return ca.Function("outputs", [x, u, p], [ca.densify(ca.jacobian(y, x)), y])

    @cached_property
    def _law(self) -> ca.Function:
        """``(y, v, p) -> A, B, C, D`` of the controller, from outputs and noise to the command; v is the PID's own."""
        # without what a linearisation leaves out: limits, dead band, resets, counts, dither, pulses
        whole, sensor = self.loop.controller, self.loop.sensor
        sensor = replace(sensor, resolution=0.0) if isinstance(sensor, Encoder) else sensor
        pid, acting = replace(whole.pid, limits=False, dead_band=False, reset=False), whole.acting_always
        law = replace(whole, pid=pid, sensor=sensor, dither=None, compensators=acting, schedule=None)
        y, p = ({n: ca.SX.sym(n) for n in own} for own in (law.signals.outputs, self.loop.parameters))
        v, noise, r = ca.SX.sym("v"), ca.SX.sym("noise"), ca.SX.sym("reference")
        apart = (*_COMMANDS, "sensor.reading") if isinstance(law.sensor, SensorLag) else _COMMANDS
        x: Signals = {n: ca.SX.sym(n) for n in names(law.states) if n not in apart}
        moved, w = _unlimited_law(law, x, r, y, noise, p)
        at = _resting_states(law, x, y, v, p)
        z = ca.vertcat(stack(x), stack(y), noise)
        J = ca.jacobian(ca.vertcat(stack({n: moved[n] for n in x}), w), z)
        point = ca.vertcat(stack({n: at[n] for n in x}), 0, y[law.feedback.name])
        J = ca.substitute(J, ca.vertcat(stack(x), noise, r), point)
        n = len(x)
        blocks = (J[:n, :n], J[:n, n:], J[n, :n], J[n, n:])
        return ca.Function("law", [stack(y), v, stack(p)], [ca.densify(block) for block in blocks])


# the functions of a loop, kept for the cases and operating points of one evaluation
_composed_loop, _averaged_plant = lru_cache(maxsize=8)(ComposedLoops), lru_cache(maxsize=8)(AveragedPlant)


# States that hold the command, as the hold and the delay have their own, and those that nothing moves in normal work.
_COMMANDS = ("pid.command", "pid.pending", "pid.transfer", "pid.bad_samples")


class _Laws(NamedTuple):
    """Controllers from the plant's outputs and the noise to the command, shapes (m, rows, columns)."""

    A: Array
    B: Array
    C: Array
    D: Array

    @property
    def feedback(self) -> Matrices:
        """From the plant's outputs, the sign turned."""
        return self.A, self.B[..., :-1], -self.C, -self.D[..., :-1]

    @property
    def noise(self) -> Matrices:
        """From the noise alone."""
        return self.A, self.B[..., -1:], self.C, self.D[..., -1:]


def _split_columns(joined: Array, m: int) -> Array:
    """Matrices of shape (m, rows, columns) from those that a Function of m points has joined side by side."""
    return joined.reshape(len(joined), m, joined.shape[1] // m).transpose(1, 0, 2)


def _unlimited_law(
    law: Controller, x: Signals, r: ca.SX, y: Signals, noise: ca.SX, p: Signals
) -> tuple[Signals, ca.SX]:
    """Rates or next values of a controller's states, and its command before the limits, under a reference at rest."""
    own = without_prefix(x, "sensor")
    noisy = law.feedback.name
    y = {**y, noisy: y[noisy] + noise} if law.outer else y
    seen = (
        law.sensor.update(own, y, law.sensed_signal, without_prefix(p, "sensor"), law.pid.sample_time or 0.0)
        if isinstance(law.sensor, Encoder)
        else {}
    )
    measured = seen.get("reading", y[law.pid_signal.name]) + (0 if law.outer else noise)
    bare, u = replace(law, sensor=None), dict.fromkeys(names(law.inputs), ca.SX(0))
    u["reference"] = r
    shown = {**y, law.pid_signal.name: measured}
    if law.pid.sample_time is None:
        return bare.rates(ca.SX(0), x, u, shown, p)
    held = {n: ca.SX(0) for n in _COMMANDS}
    found = bare.update(ca.SX(0), x | held, u, shown, p)
    return with_prefix(seen, "sensor") | found.states, found.terms["unlimited"]


def _resting_states(law: Controller, x: Signals, y: Signals, v: ca.SX, p: Signals) -> Signals:
    """The states under constant signals, with the integral that makes the PID's command v."""
    h, measured = law.pid.sample_time or 0.0, y[law.pid_signal.name]
    at: Signals = {n: ca.SX(0) for n in x}
    if isinstance(law.sensor, Encoder):
        at["sensor.reading"], position = measured, y[law.sensor.position]
        at["sensor.count"] = position - h * measured
    seen = ControllerSnapshot(ca.SX(0), measured, measured, v, law.pid.sample_time, {}, y)
    for part in law.compensators:
        named = (f"{part.section}.{q.name}" for q in part.states(law.sensed_signal, law.command))
        at |= dict(zip(named, map(ca.SX, part.start(law.sensed_signal, seen)), strict=True))
    given: Mapping[str, ca.SX] = {**at, "pid.integral": ca.SX(0), **{n: ca.SX(0) for n in _COMMANDS}}
    own, position = without_prefix(given, "pid"), y[law.feedback.name]
    wanted = law.inner_inputs({"reference": position}, position, p)["reference"]
    at["pid.integral"] = v - law.pid.output(own, wanted, measured, without_prefix(p, "pid"))
    return at


def _join(plant: Matrices, controller: Matrices) -> Matrices:
    """The open loop from command to fed-back signal; in continuous form a double integral keeps its poles at zero."""
    (A, B, C, D), (Ac, Bc, Cc, Dc) = plant, controller
    joined = np.block([[A, np.zeros((len(A), A.shape[-1], Ac.shape[-1]))], [Bc @ C, Ac]])
    return joined, np.concatenate([B, Bc @ D], axis=1), np.concatenate([Dc @ C, Cc], axis=2), Dc @ D


def _hold(A: Array, B: Array, C: Array, h: float, late: Array) -> tuple[Array, Array, Array]:
    """Plants from sample to sample on a command that is held, and arrives late by less than a sample (m,) [s].

    K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed., Prentice Hall 1997, section 2.3.
    """
    if not late.any():
        return *_advance(A, B, np.full(len(A), h)), C
    (first, old), (last, new) = _advance(A, B, late), _advance(A, B, h - late)
    held = np.zeros((len(A), 1, A.shape[-1] + 1))
    moved = np.concatenate([np.concatenate([last @ first, last @ old], axis=2), held], axis=1)
    return moved, np.concatenate([new, np.ones((len(A), 1, 1))], axis=1), np.pad(C, ((0, 0), (0, 0), (0, 1)))


def _advance(A: Array, B: Array, h: Array) -> tuple[Array, Array]:
    """Matrices of plants over times (m,) [s] in which their inputs are held."""
    m, n = A.shape[:2]
    both = np.concatenate([np.concatenate([A, B], axis=2), np.zeros((m, 1, n + 1))], axis=1)
    sound = np.isfinite(both).all(axis=(1, 2))
    moved = np.full_like(both, np.nan)
    moved[sound] = _exponentials(both[sound] * h[sound, None, None])
    return moved[:, :n, :n], moved[:, :n, n:]


def _exponentials(A: Array) -> Array:
    """Exponentials of small matrices, shape (m, n, n): Taylor's series of A/2^k, squared k times.

    C. Moler & C. Van Loan, Nineteen dubious ways to compute the exponential of a matrix, twenty-five years later, SIAM
    Rev. 45 (2003) 3-49, methods 1 and 3. SciPy's own takes 20 ms a matrix where BLAS has threads that wait for a CPU.
    """
    largest = float(np.abs(A).sum(axis=-1).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(max(largest, 1e-300) / LARGEST_TAYLOR_NORM))))
    scaled, one = A / 2.0**squarings, np.eye(A.shape[-1])
    found = np.broadcast_to(one, A.shape)
    for k in range(TAYLOR_TERMS, 0, -1):
        found = one + scaled @ found / k
    for _ in range(squarings):
        found = found @ found
    return np.asarray(found)


def _bilinear(system: Matrices, h: float) -> Matrices:
    """Discrete systems in continuous form, ``z = (1 + s h/2)/(1 - s h/2)``, of any number of inputs and outputs."""
    A, B, C, D = system
    one = np.eye(A.shape[-1])
    M = np.linalg.inv(A + one)
    root = 2 / np.sqrt(h)
    return 2 / h * M @ (A - one), root * M @ B, root * C @ M, D - C @ M @ B
