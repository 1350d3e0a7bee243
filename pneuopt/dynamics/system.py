"""`System` (an ODE with named signals) and `DiscreteSystem` (its sampled step), which every solver reads.

`define` makes the first from named signals, `discretise` the second. Inputs that run linearly from sample to sample
(`Ramp`, `add_slopes`) stand last: a held one costs nothing; of a linear one the sampled step also gets its slope and
the sample's instant, from which it computes the input wherever within the sample RK4 asks for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from pneuopt.dynamics.compiled.rollout import Pieces
from pneuopt.dynamics.dead_time import check_pade_order, delay_line, pade_delay
from pneuopt.dynamics.hooks import (
    Axis,
    HardwareCheckHook,
    IdentificationHints,
    Log,
    LogWarningHook,
    RestHook,
    Start,
    StartHook,
    ValidityLimit,
)
from pneuopt.dynamics.integrators import rk4
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import ConvergenceError, ModelError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

Symbols = Mapping[str, ca.SX]
Rhs = Callable[[ca.SX, Symbols, Symbols, Symbols], tuple[Symbols, Symbols]]
FRICTION_DIRECTION = "friction.direction"  # parameter of Karnopp's friction: the sign of the motion, set by `simulate`


@dataclass(frozen=True)
class Linearisation:
    """`dx/dt = A x + B u, y = C x + D u` about an operating point; names in the order of the matrices."""

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dead_time: float = 0.0  # of the input [s], in the matrices a Padé approximant, in a `frequency_response` the delay
    pade_order: int = 0
    sample_time: float | None = None  # [s], of a sampled system in the form of ``z = (1 + s h/2)/(1 - s h/2)``


@dataclass(frozen=True)
class DeadTime:
    """The dead time of a system between an input and its effect; `states` are those of its Padé approximant."""

    parameter: str  # the dead time [s]
    input: str
    states: tuple[str, ...]
    undelayed: "System"  # the same system without it


@dataclass(frozen=True, eq=False)
class System:
    """An ODE with named states, inputs, outputs and parameters.

    Parameters
    ----------
    states, inputs, outputs : tuple of Quantity
        The signals, in the order of the vectors x, u, y.
    parameters : ParameterSet
        Every parameter with its default; their order is that of the vector p.
    ode : casadi.Function
        ``(t, x, u, p) -> (xdot, y)`` in SI units, built from SX.
    start_hook : StartHook, optional
        How an identification of this model starts from logs.
    rest_hook : RestHook, optional
        Where the plant rests, and which inputs keep it there.
    hardware_check_hook : HardwareCheckHook, optional
        Which parameter values no hardware can have.
    validity_limits : tuple of ValidityLimit
        Limits that a simulation watches: an end stop, a vacuum.
    log_warning_hook : LogWarningHook, optional
        What is wrong with logs, as far as the model can see it.
    meter : casadi.Function, optional
        ``(t, x, u, p) -> (...)``: what the plant consumes, a named output for each channel, "power" [W] say. They are
        no outputs of the system, as no log holds them.
    identification_hints : IdentificationHints
        Which motion a log must show for its parameters to be identifiable.
    axis : Axis, optional
        The body that it moves against friction.
    centre : str, optional
        The parameter from which the command counts, where a log's may count from elsewhere; a controller's counts from
        there.
    dead_time : DeadTime, optional
        Of an input, which the equations approximate; margins take the delay itself.
    """

    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    parameters: ParameterSet
    ode: ca.Function
    start_hook: StartHook | None = None
    rest_hook: RestHook | None = None
    hardware_check_hook: HardwareCheckHook | None = None
    validity_limits: tuple[ValidityLimit, ...] = ()
    log_warning_hook: LogWarningHook | None = None
    meter: ca.Function | None = None
    identification_hints: IdentificationHints = field(default_factory=IdentificationHints)
    axis: Axis | None = None
    centre: str | None = None
    dead_time: DeadTime | None = None

    def __repr__(self) -> str:
        return describe(self)

    def check(self, parameters: ParameterSet, start: Mapping[str, float] | None = None) -> None:
        """Raise `InputError` where no hardware has these parameters, or none can be in the state `start`, by name.

        A missing parameter has its default; those of other models are ignored.
        """
        if self.hardware_check_hook is not None:
            self.hardware_check_hook(parameters, start)

    def starts(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Candidates from which an identification can start.

        Parameters
        ----------
        logs : mapping of str to Log
            By the log's name; the same parameters are free in all of them.

        Returns
        -------
        sequence of Start
            The most plausible first. Without a `start_hook`: logged states as measured, others zero.
        """
        if self.start_hook is not None:
            return self.start_hook(logs)
        found = {}
        for name, (measured, *_) in logs.items():
            logged = [n for n in names(self.states) if n in measured and np.isfinite(measured[n]).any()]
            zeros = {n: np.zeros(len(measured)) for n in names(self.states)}
            found[name] = Trajectory(measured.t, zeros | {n: measured.fill_gaps(n) for n in logged})
        return [Start(found, {}, "as given")]

    def log_warnings(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """What is wrong with the logs, a sentence each; without a `log_warning_hook`, nothing."""
        return self.log_warning_hook(logs) if self.log_warning_hook is not None else ()

    @property
    def plant(self) -> "System":
        """The model itself, as it has no controller."""
        return self

    @property
    def loop(self) -> None:
        """None, where `ClosedLoop.loop` is the loop."""

    def system(self) -> "System":
        """The system itself, so that a verb takes a drive as well as its system."""
        return self

    def motion(self) -> "Motion":
        """See `Runnable`."""
        return Motion(self)

    def discrete(self, substeps: int = 1) -> "DiscreteSystem":
        """See `discretise`."""
        return discretise(self, substeps)

    def rest_state(self, parameters: ParameterSet, outputs: Mapping[str, float] | None = None) -> Array:
        """See `Runnable`; zeros without a `rest_hook`."""
        rest = self.rest_hook(parameters, outputs or {}).states if self.rest_hook is not None else {}
        return np.array([rest.get(n, 0.0) for n in names(self.states)])

    def check_log(self, measured: Trajectory, name: str) -> None:
        """See `Fittable`; a plant without a controller takes every log that holds its inputs."""

    def input_matrix(self, measured: Trajectory, name: str) -> Array:  # noqa: ARG002 - as `Fittable`
        """See `Fittable`."""
        return measured.matrix(names(self.inputs))

    def unobservable_start(self, measured: Trajectory, states: Trajectory, parameters: ParameterSet) -> None:
        """See `Fittable`; None, as every initial state of a plant is estimated."""

    def equilibrium(self, u: Mapping[str, float], p: ParameterSet, guess: Mapping[str, float] | None = None) -> Array:
        """Solve ``xdot(x, u, p) = 0`` by Newton from `guess` (zeros where absent), by least-norm steps.

        Returns
        -------
        ndarray, shape (n_states,)

        Raises
        ------
        InputError
            If the hardware is impossible.
        ConvergenceError
            If no equilibrium is found; the message names the state whose rate stays largest.
        """
        self.check(p)
        guess = dict(guess or {})
        check_names("state", guess, names(self.states))
        scale = np.array([s.nominal for s in self.states])
        x = np.array([guess.get(s.name, 0.0) for s in self.states])
        us, ps = self._input_vector(u), parameter_vector(self.parameters, p)
        for _ in range(100):
            rate = np.array(self.ode(0, x, us, ps)[0]).ravel()
            step, *_ = np.linalg.lstsq(np.array(self._jacobian(0, x, us, ps)[0]) * scale, -rate, rcond=1e-12)
            x = x + step * scale
            if np.max(np.abs(step), initial=0.0) < 1e-12:
                break
        rate = np.abs(np.array(self.ode(0, x, us, ps)[0]).ravel() / scale)
        if not np.max(rate, initial=0.0) < 1e-6:
            worst = self.states[int(np.argmax(rate))]
            raise ConvergenceError(
                f"no equilibrium found: d({worst.name})/dt stays at {np.max(rate) * worst.nominal:.3g} "
                f"{worst.unit}/s; give a guess nearer to it",
                x,
            )
        return x

    def linearise(self, x: Array, u: Mapping[str, float], p: ParameterSet) -> Linearisation:
        """Differentiate (AD) about a point; it need not be an equilibrium.

        Parameters
        ----------
        x : array_like, shape (n_states,)
        u : mapping of input name to value; absent ones are zero

        Raises
        ------
        InputError
            If the hardware is impossible.
        """
        self.check(p)
        matrices = self._jacobian(0, x, self._input_vector(u), parameter_vector(self.parameters, p))
        A, B, C, D = (np.array(m) for m in matrices)
        return Linearisation(A, B, C, D, names(self.states), names(self.inputs), names(self.outputs))

    @cached_property
    def _jacobian(self) -> ca.Function:
        t, x, u, p = (ca.SX.sym(n, self.ode.size1_in(i)) for i, n in enumerate("txup"))
        xdot, y = self.ode(t, x, u, p)
        return ca.Function("jacobian", [t, x, u, p], [ca.jacobian(f, v) for f in (xdot, y) for v in (x, u)])

    def _input_vector(self, u: Mapping[str, float]) -> Array:
        check_names("input", u, names(self.inputs))
        return np.array([u.get(q.name, 0.0) for q in self.inputs], dtype=float)


@dataclass(frozen=True, eq=False)
class Motion:
    """The equations of a model between two samples, and its controller's update at a sample."""

    system: System
    update: ca.Function | None = None  # ``(t, x, u, p) -> x``: the state after a sampled controller has acted
    sample_time: float | None = None  # from one sample to the next [s]


@dataclass(frozen=True, eq=False)
class DiscreteSystem:
    """A sampled model: at each sample an optional update, then `substeps` integration steps to the next sample.

    Parameters
    ----------
    states, inputs, outputs, parameters
        As for `System`; the inputs are held from sample to sample.
    step : casadi.Function
        ``(t, h, x, u, p) -> (x_next, y)``: one integration step of length h [s], and the output at its beginning.
    update : casadi.Function, optional
        ``(t, x, u, p) -> x``: what a sampled controller does at the instant, before the steps and before y is read.
    substeps : int
        Integration steps from one sample to the next.
    sample_time : float, optional
        The controller's sample time [s]; None if any grid will do.
    ode : casadi.Function, optional
        ``(t, x, u, p) -> (xdot, y)``, where `step` is its RK4 step.
    """

    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    parameters: ParameterSet
    step: ca.Function
    update: ca.Function | None = None
    substeps: int = 1
    sample_time: float | None = None
    ode: ca.Function | None = None

    @property
    def pieces(self) -> Pieces:
        """The CasADi Functions that `Rollout` compiles."""
        return Pieces(self.step, self.update, self.ode)

    def __repr__(self) -> str:
        return describe(self)

    def with_substeps(self, substeps: int) -> "DiscreteSystem":
        """Change the number of integration steps a sample, by copy."""
        require(substeps >= 1, f"substeps must be at least 1, got {substeps}")
        return replace(self, substeps=substeps)

    def advance_sample(self, t: ca.MX, h: ca.MX, x: ca.MX, u: ca.MX, p: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Advance symbolically by one whole sample of length h; returns (x_next, y at the sample)."""
        if self.update is not None:
            x = self.update(t, x, u, p)
        dt = h / self.substeps
        y = self.step(t, dt, x, u, p)[1]
        for k in range(self.substeps):
            x = self.step(t + k * dt, dt, x, u, p)[0]
        return x, y


def define(
    states: Sequence[Quantity],
    inputs: Sequence[Quantity],
    outputs: Sequence[Quantity],
    parameters: ParameterSet,
    rhs: Rhs,
    start_hook: StartHook | None = None,
    rest_hook: RestHook | None = None,
) -> System:
    """Make a `System` from a right-hand side written with names.

    Parameters
    ----------
    rhs : callable
        ``rhs(t, x, u, p) -> (xdot, y)``: t an SX, the others mappings from name to SX.
    start_hook, rest_hook : StartHook, RestHook, optional

    Raises
    ------
    ModelError
        If the right-hand side leaves out a state's rate or an output, or if two signals of a kind share a name.
    """
    for kind, quantities in (("state", states), ("input", inputs), ("output", outputs)):
        listed = names(quantities)
        twice = {n for n in listed if listed.count(n) > 1}
        require(not twice, f"{kind} {', '.join(map(repr, sorted(twice)))} is declared twice; rename one", ModelError)
    t = ca.SX.sym("t")
    x, u = symbols(states), symbols(inputs)
    p = {n: ca.SX.sym(n) for n in parameters}
    rates, measured = rhs(t, x, u, p)
    xdot = _stack_in_order("rate of state", rates, states)
    y = _stack_in_order("output", measured, outputs)
    ode = ca.Function("ode", [t, *map(stack, (x, u, p))], [xdot, y], ["t", "x", "u", "p"], ["xdot", "y"])
    return System(tuple(states), tuple(inputs), tuple(outputs), parameters, ode, start_hook, rest_hook)


def add_dead_time(system: System, order: int = 3) -> System:
    """A system whose one input acts late, by its parameter "dead_time" [s].

    Parameters
    ----------
    system : System
        With one input.
    order : int
        Of the Padé approximant by which it is simulated, 1 to 5; margins take the delay itself.

    Returns
    -------
    System
        With so many states more.

    Raises
    ------
    ModelError
        If the system has other than one input, or has a dead time.

    Examples
    --------
    >>> lag = lambda t, x, u, p: ({"y": u["u"] - x["y"]}, {"y": x["y"]})
    >>> u, y = Quantity("u", "V"), Quantity("y", "V")
    >>> list(add_dead_time(define([y], [u], [y], ParameterSet(), lag)).parameters)
    ['dead_time']
    """
    require(len(system.inputs) == 1, f"a dead time needs one input, got {', '.join(names(system.inputs))}", ModelError)
    require(system.dead_time is None, "the system has a dead time; change its parameter instead", ModelError)
    (source,), name, meaning = system.inputs, "dead_time", "delay from the input to its effect"
    late = Parameter(0.01, "s", 1e-3, 10.0, log=True, meaning=meaning)
    empty = DeadTime(name, source.name, (), system)
    check_pade_order(max(1, order))
    return with_pade_order(
        replace(system, parameters=system.parameters | ParameterSet({name: late}), dead_time=empty), order
    )


@lru_cache(maxsize=16)
def with_pade_order(system: System, order: int) -> System:
    """A system with its dead time simulated by an approximant of this order; one without a dead time as it is."""
    late = system.dead_time
    if late is None or len(late.states) == order:
        return system
    inner = late.undelayed
    (source,), n, m = inner.inputs, len(inner.states), len(system.parameters)
    line = delay_line(source, order)
    t, x, u, p = (ca.SX.sym(k, size) for k, size in (("t", 1), ("x", n + order), ("u", 1), ("p", m)))
    place = list(system.parameters).index
    delayed, rates = pade_delay(u, ca.vertsplit(x[n:]), p[place(late.parameter)])
    xdot, y = inner.ode(t, x[:n], delayed, p[[place(k) for k in inner.parameters]])
    ode = ca.Function("ode", [t, x, u, p], [ca.vertcat(xdot, *rates), y], ["t", "x", "u", "p"], ["xdot", "y"])
    states = (*inner.states, *line)
    return replace(system, states=states, inputs=inner.inputs, ode=ode, dead_time=replace(late, states=names(line)))


@lru_cache(maxsize=64)
def discretise(system: System, substeps: int = 1) -> DiscreteSystem:
    """The sampled form of a system, by `substeps` classical Runge-Kutta steps (RK4) a sample; `InputError` below 1.

    A step h is stable for h < 2.78/|lambda|.
    """
    require(substeps >= 1, f"substeps must be at least 1, got {substeps}")
    n = {k: system.ode.size1_in(i) for i, k in enumerate("txup")}
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    x, u, p = (ca.SX.sym(k, n[k]) for k in "xup")
    results = [rk4(lambda at, z: system.ode(at, z, u, p)[0], t, h, x), system.ode(t, x, u, p)[1]]
    step = ca.Function("step", [t, h, x, u, p], results, ["t", "h", "x", "u", "p"], ["x_next", "y"], {"cse": True})
    own = (system.states, system.inputs, system.outputs, system.parameters)
    return DiscreteSystem(*own, step, substeps=substeps, ode=system.ode)


def symbols(quantities: Sequence[Quantity]) -> dict[str, ca.SX]:
    """One SX scalar a signal, by name."""
    return {q.name: ca.SX.sym(q.name) for q in quantities}


def stack(values: Symbols) -> ca.SX:
    """The values of a mapping as one column, in order."""
    return ca.vertcat(*values.values()) if values else ca.SX(0, 1)


def names(quantities: Sequence[Quantity]) -> tuple[str, ...]:
    """The signals' names, in order."""
    return tuple(q.name for q in quantities)


def parameter_vector(order: ParameterSet, values: ParameterSet) -> Array:
    """The numbers of `values` in the order of `order`; a missing one keeps the default of `order`."""
    return np.array([values.value(n) if n in values else order.value(n) for n in order], dtype=float)


def describe(system: System | DiscreteSystem) -> str:
    """Every state, input, output and parameter with its unit, a line each."""
    lines = [type(system).__name__]
    for kind in ("states", "inputs", "outputs"):
        lines += [f"  {kind}: " + (", ".join(f"{q.name} [{q.unit}]" for q in getattr(system, kind)) or "none")]
    return "\n".join([*lines, "  parameters:", *("    " + line for line in repr(system.parameters).splitlines())])


def _stack_in_order(kind: str, values: Symbols, quantities: Sequence[Quantity]) -> ca.SX:
    check_names(kind, values, names(quantities))
    for q in quantities:
        require(q.name in values, f"the right-hand side gives no {kind} {q.name!r}", ModelError)
    return ca.vertcat(*(values[q.name] for q in quantities)) if quantities else ca.SX(0, 1)


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

    Its inputs are those of `append_slopes`; it takes every slope, zero too, so that it serves logs that differ in that.
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
    """The inputs of `add_slopes` along a log, (n, n_inputs + linear.sum() + 1), of which only some are `rising`."""
    return np.column_stack([u, slopes(t, u, rising)[:, linear], t]) if linear.any() else u
