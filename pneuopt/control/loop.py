"""`ClosedLoop`: a plant, a PID and a dither, as a `System` or a `DiscreteSystem` for the solvers.

Where the parts meet: the reference r and the measured output y, or what a lagging sensor shows of it, enter the PID,
dither is added to its command, the sum is clipped, and the result, the output "control", drives the actuated input.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.dither import Dither
from pneuopt.control.pid import PID
from pneuopt.control.rest import find_rest, sliding, wired
from pneuopt.control.sensor import SensorLag
from pneuopt.errors import ModelError, check_known, require
from pneuopt.parameters import ParameterSet, Quantity
from pneuopt.system import (
    DiscreteSystem,
    Linearisation,
    Symbols,
    System,
    define,
    discretise,
    names,
    stacked,
    symbols,
)

Array = NDArray[np.float64]
Signals = dict[str, ca.SX]
READING = "sensor.reading"


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant under feedback.

    Parameters
    ----------
    plant : System
    pid : PID
    dither : Dither, optional
    actuated : str, optional
        The plant's input that the controller drives; by default its only one. Others stay inputs of the loop.
    measured : str, optional
        The plant's output that is fed back; by default "speed", or the only one.
    sensor : SensorLag, optional
        Through which the controller sees it. What the loop is judged by is the output itself.

    Raises
    ------
    ModelError
        If the input or output is ambiguous or unknown, if the measured output depends on the command without any lag
        (an algebraic loop), or if names collide.
    InputError
        If the dither cannot be sampled.
    """

    plant: System
    pid: PID
    dither: Dither | None = None
    actuated: str | None = None
    measured: str | None = None
    sensor: SensorLag | None = None

    def __post_init__(self) -> None:
        if self.sensor is None:
            _check_lag(self)
        reserved = {"reference": names(self.plant.inputs), "control": names(self.plant.outputs)}
        for name, taken in reserved.items():
            require(name not in taken, f"the plant has a signal {name!r} of its own; rename it", ModelError)
        doubled = self.sensor is not None and "sensor.lag" in self.plant.parameters
        require(not doubled, "the plant has a sensor.lag of its own; leave sensor= out", ModelError)
        _ = self.parameters

    def __repr__(self) -> str:
        model = self.system() if self.pid.sample_time is None else self.discrete()
        return repr(model).replace(type(model).__name__, "ClosedLoop", 1)

    @cached_property
    def command(self) -> Quantity:
        """The plant's input that the controller drives."""
        return _chosen("input", self.actuated, self.plant.inputs, None)

    @cached_property
    def feedback(self) -> Quantity:
        """The plant's output that is fed back."""
        return _chosen("output", self.measured, self.plant.outputs, "speed")

    @cached_property
    def parameters(self) -> ParameterSet:
        """Those of the plant, "pid.*", "dither.*" and "sensor.lag", with their defaults."""
        h, unit = self.pid.sample_time, self.command.unit
        dither = self.dither.parameters(unit, h) if self.dither else ParameterSet()
        pid = self.pid.parameters(self.feedback.unit, unit)
        sensor = self.sensor.parameters() if self.sensor else ParameterSet()
        return self.plant.parameters | pid.prefixed("pid") | dither.prefixed("dither") | sensor.prefixed("sensor")

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The plant's, a lagging sensor's "sensor.reading", then the controller's ("pid.*")."""
        own = self.pid.states(self.feedback, self.command)
        reading = (replace(self.feedback, name=READING),) if self.sensor else ()
        return (*self.plant.states, *reading, *(replace(q, name=f"pid.{q.name}") for q in own))

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """The reference, then the plant's inputs that the controller does not drive."""
        reference = replace(self.feedback, name="reference")
        return (reference, *(q for q in self.plant.inputs if q.name != self.command.name))

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """The plant's, then "control": what the actuator gets."""
        return (*self.plant.outputs, replace(self.command, name="control"))

    def system(self) -> System:
        """The loop as one ODE, with a continuous PID.

        Raises
        ------
        ModelError
            If the PID is sampled: use `discrete`, or `held` and `update`.
        """
        h = self.pid.sample_time
        require(
            h is None, f"a loop sampled every {h} s is no ODE; use discrete(), or held() between samples", ModelError
        )
        return define(self.states, self.inputs, self.outputs, self.parameters, self._continuous)

    def held(self) -> System:
        """Between two samples of a sampled PID: the plant runs on the held command, the controller's states rest.

        An analogue dither is in here, as a function of time; a sampled one is part of the held command.
        """
        require(self.pid.sample_time is not None, "a continuous loop holds nothing; use system()", ModelError)
        return define(self.states, self.inputs, self.outputs, self.parameters, self._between)

    @cached_property
    def update(self) -> ca.Function:
        """What a sampled PID does at a sample: ``(t, x, u, p) -> x`` with the loop's states, inputs and parameters."""
        require(self.pid.sample_time is not None, "a continuous loop has no update; use system()", ModelError)
        t, x, u = ca.SX.sym("t"), symbols(self.states), symbols(self.inputs)
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        own = self.pid.update(
            _part("pid", x), u["reference"], self._measured(t, x, u, p), self._dither(t, p), _part("pid", p)
        )
        after = stacked({n: own.get(n.removeprefix("pid."), x[n]) if n.startswith("pid.") else x[n] for n in x})
        return ca.Function("update", [t, *map(stacked, (x, u, p))], [after], ["t", "x", "u", "p"], ["x_after"])

    def discrete(self, substeps: int = 1) -> DiscreteSystem:
        """The loop as a sampled step of RK4; its inputs are held from sample to sample.

        Parameters
        ----------
        substeps : int
            RK4 steps a sample; with a sampled PID, the plant's on the held command.
        """
        if self.pid.sample_time is None:
            return discretise(self.system(), substeps)
        return replace(discretise(self.held(), substeps), update=self.update, sample_time=self.pid.sample_time)

    def check(self, parameters: ParameterSet) -> None:
        """Refuse values that no loop can run with, whatever their bounds: `InputError` names the parameter."""
        self.plant.check(parameters)
        value = dict(zip(self.parameters, self.numbers(parameters), strict=True))
        h = self.pid.sample_time
        if self.dither:
            self.dither.check(value["dither.frequency"], h)
        require(
            value["pid.Tf"] > 0 or h is not None,
            f"pid.Tf = {value['pid.Tf']:g} s: a continuous derivative needs a filter, Tf > 0",
        )
        if self.pid.limits:
            low, high, Tt = value["pid.lower"], value["pid.upper"], value["pid.Tt"]
            require(low < high, f"pid.lower {low:g} is not below pid.upper {high:g} {self.command.unit}")
            require(
                Tt > 0 and Tt >= (h or 0.0),
                f"pid.Tt = {Tt:g} s: anti-windup needs Tt > 0, and with sampling at least one sample ({h or 0:g} s)",
            )

    def numbers(self, parameters: ParameterSet) -> Array:
        """The vector p of `parameters` in the loop's order; a missing one keeps the loop's default."""
        return np.array([parameters.value(n) if n in parameters else q.value for n, q in self.parameters.items()])

    def dither_period(self, parameters: ParameterSet) -> float | None:
        """The time over which averages and ripple are taken [s] (`Dither.period`); None without dither."""
        value = dict(zip(self.parameters, self.numbers(parameters), strict=True))
        if self.dither is None or value["dither.amplitude"] == 0:
            return None
        return self.dither.period(value["dither.frequency"], self.pid.sample_time)

    def initial(
        self,
        parameters: ParameterSet,
        x_plant: Sequence[float] | Array | None = None,
        *,
        reference: float = 0.0,
        command: float = 0.0,
        start: Mapping[str, float] | None = None,
    ) -> Array:
        """The loop at rest, or in steady motion, before dither is switched on.

        Parameters
        ----------
        parameters : ParameterSet
        x_plant : array_like, shape (n_plant_states,), optional
            The plant's state. Without it the closed loop is solved for its equilibrium at `reference`, other inputs 0;
            a plant that knows its rest stands there, or moves steadily, and the controller takes over the command that
            keeps it so. A position on which nothing depends may move on.
        reference : float
            The reference so far [unit of the measured signal].
        command : float
            With `x_plant`: the command so far, which the controller takes over without a bump [unit of the command].
        start : mapping of str to float, optional
            Without `x_plant`: what else is known of the plant, by name, as for `Step`.

        Returns
        -------
        ndarray, shape (n_states,)

        Raises
        ------
        ConvergenceError
            If the closed loop has no equilibrium there (a spring that a motion loads, say); give `x_plant`.
        InputError
            If a value cannot run (`check`), the plant cannot move so, the command lies beyond the controller's limits,
            or `start` names what this plant does not start from.
        """
        self.check(parameters)
        parameters = sliding(self, parameters, reference)
        p = self.numbers(parameters)
        value = dict(zip(self.parameters, p, strict=True))
        if x_plant is None:
            x, command = find_rest(self, parameters, reference, start or {})
        else:
            x, shape = np.asarray(x_plant, dtype=float), (len(self.plant.states),)
            require(x.shape == shape, f"x_plant has shape {x.shape}, the plant's state has {shape}")
        _check_reach(command, value, self.command.unit)
        y = float(self._measure(0, x, p))
        error = value["pid.c"] * reference - y
        integral = command - value["pid.Kp"] * (value["pid.b"] * reference - y)
        own = [integral, error] if self.pid.sample_time is None else [integral, 0.0, error, command]
        return np.concatenate([x, [y] if self.sensor else [], own])

    def linear_plant(
        self, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
    ) -> Linearisation:
        """The plant from command to measured output, or to what its sensor shows, linearised.

        Parameters
        ----------
        parameters : ParameterSet
        x : ndarray, shape (n_plant_states,), optional
            The plant's operating point, an equilibrium or not; by default the closed loop's rest. Dry friction makes a
            resting plant look stiff: linearise such a plant in motion.
        u : mapping of str to float, optional
            The plant's inputs there, zero where absent; at rest the command is solved for.
        """
        self.check(parameters)
        if x is None:
            x, command = find_rest(self, parameters, 0.0, {})
            u = {self.command.name: command, **(u or {})}
        plant = self.plant.linearise(x, u or {}, parameters)
        j, i = plant.inputs.index(self.command.name), plant.outputs.index(self.feedback.name)
        A, B, C, D = plant.A, plant.B[:, j : j + 1], plant.C[i : i + 1], plant.D[i : i + 1, j : j + 1]
        states = plant.states
        if self.sensor is not None:
            rate, n = 1 / (self.parameters | parameters).value("sensor.lag"), len(A)
            A = np.block([[A, np.zeros((n, 1))], [rate * C, np.array([[-rate]])]])
            B, C, D = np.vstack([B, rate * D]), np.eye(1, n + 1, n), np.zeros((1, 1))
            states = (*states, READING)
        return Linearisation(A, B, C, D, states, (self.command.name,), (self.feedback.name,))

    def open_loop(
        self, parameters: ParameterSet, x: Array | None = None, u: Mapping[str, float] | None = None
    ) -> Linearisation:
        """``L(s) = C(s) P(s)`` under negative feedback, cut at the measured output, without clip and dither.

        A sampled PID counts as its continuous equivalent behind a hold, half a sample of delay in first-order Padé form
        ``(1 - s h/4)/(1 + s h/4)``. Parameters as for `linear_plant`.

        Returns
        -------
        Linearisation
            From the control error, input "error", to the measured output; the plant's states come first.
        """
        plant, controller = self.linear_plant(parameters, x, u), self._controller(parameters)
        m, n = len(controller.A), len(plant.A)
        return Linearisation(
            np.block([[plant.A, plant.B @ controller.C], [np.zeros((m, n)), controller.A]]),
            np.vstack([plant.B @ controller.D, controller.B]),
            np.hstack([plant.C, np.zeros((1, m))]),
            np.zeros((1, 1)),
            plant.states + controller.states,
            ("error",),
            (self.feedback.name,),
        )

    def _controller(self, parameters: ParameterSet) -> Linearisation:
        value = dict(zip(self.parameters, self.numbers(parameters), strict=True))
        Kp, Ki, Kd, Tf = (value[f"pid.{n}"] for n in ("Kp", "Ki", "Kd", "Tf"))
        h = self.pid.sample_time
        require(Tf > 0, "pid.Tf = 0: margins are those of the continuous equivalent, which needs Tf > 0")
        A, B = np.diag([0.0, -1 / Tf]), np.array([[Ki], [1 / Tf]])
        C, D = np.array([[1.0, -Kd / Tf]]), np.array([[Kp + Kd / Tf]])
        if h is not None:
            a = 4 / h
            A = np.block([[A, np.zeros((2, 1))], [2 * a * C, np.array([[-a]])]])
            B, C, D = np.vstack([B, 2 * a * D]), np.hstack([-C, [[1.0]]]), -D
        own = ("pid.integral", "pid.filter", "pid.hold")[: len(A)]
        return Linearisation(A, B, C, D, own, ("error",), ("control",))

    def _continuous(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
        rates, command = self.pid.rates(
            _part("pid", x), u["reference"], self._measured(t, x, u, p), self._dither(t, p), _part("pid", p)
        )
        xdot, y = self._plant(t, x, u, p, command)
        own = {f"pid.{n}": rate for n, rate in rates.items()} | self._sensing(x, y, p)
        return xdot | own, y | {"control": command}

    def _between(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
        command = x["pid.command"]
        if self.dither and self.dither.analogue:
            command = self.pid.clip(command + self.dither.sine(t, _part("dither", p)), _part("pid", p))
        xdot, y = self._plant(t, x, u, p, command)
        own = {n: ca.SX(0) for n in x if n.startswith("pid.")} | self._sensing(x, y, p)
        return xdot | own, y | {"control": command}

    def _dither(self, t: ca.SX, p: Symbols) -> ca.SX:
        """What the controller itself adds."""
        if self.dither is None:
            return ca.SX(0)
        own = _part("dither", p)
        sampled_apart = self.dither.analogue and self.pid.sample_time is not None
        return own["offset"] if sampled_apart else own["offset"] + self.dither.sine(t, own)

    def _sensing(self, x: Symbols, y: Symbols, p: Symbols) -> Signals:
        return {READING: (y[self.feedback.name] - x[READING]) / p["sensor.lag"]} if self.sensor else {}

    def _measured(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> ca.SX:
        """What the controller sees."""
        return x[READING] if self.sensor else self._true(t, x, u, p)

    def _true(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> ca.SX:
        return self._plant(t, x, u, p, ca.SX(0))[1][self.feedback.name]

    def _plant(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols, command: ca.SX) -> tuple[Signals, Signals]:
        return wired(self.plant, self.command.name, t, x, u, p, command)

    @cached_property
    def _measure(self) -> ca.Function:
        t, x, u = ca.SX.sym("t"), symbols(self.plant.states), {q.name: ca.SX(0) for q in self.plant.inputs}
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        return ca.Function("measure", [t, stacked(x), stacked(p)], [self._true(t, x, u, p)])


def _chosen(kind: str, name: str | None, known: Sequence[Quantity], usual: str | None) -> Quantity:
    by_name = {q.name: q for q in known}
    if name is None:
        name = usual if usual in by_name else next(iter(by_name)) if len(by_name) == 1 else None
    field = "actuated" if kind == "input" else "measured"
    require(name is not None, f"the plant has the {kind}s {', '.join(by_name) or 'none'}; choose {field}=", ModelError)
    check_known(kind, [str(name)], by_name, f"ClosedLoop {field}")
    return by_name[str(name)]


def _check_lag(loop: ClosedLoop) -> None:
    plant = loop.plant
    t, x, u = (ca.SX.sym(k, plant.ode.size1_in(i)) for i, k in enumerate("txu"))
    y = plant.ode(t, x, u, ca.SX.sym("p", plant.ode.size1_in(3)))[1]
    j, i = names(plant.inputs).index(loop.command.name), names(plant.outputs).index(loop.feedback.name)
    require(
        ca.jacobian(y[i], u[j]).nnz() == 0,
        f"algebraic loop: output {loop.feedback.name!r} depends on input {loop.command.name!r} without any lag; "
        "measure another output, or give the plant an actuator or a sensor with a lag",
        ModelError,
    )


def _check_reach(command: float, value: Mapping[str, float], unit: str) -> None:
    low, high = value.get("pid.lower", -inf), value.get("pid.upper", inf)
    require(
        low <= command <= high,
        f"the loop cannot start at rest: it needs a command of {command:g} {unit}, the limits are {low:g} and {high:g}",
    )


def _part(prefix: str, values: Symbols) -> Signals:
    return {n.removeprefix(f"{prefix}."): v for n, v in values.items() if n.startswith(f"{prefix}.")}
