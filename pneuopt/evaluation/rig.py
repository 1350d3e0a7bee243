"""`record`: the log that a real rig would give, with the effects that models for identification and tuning leave out.

A `Rig` is a plant or a loop with `Sensor`s and an `Actuator`. Between two samples the plant is integrated as in
`simulate`, event by event with Karnopp's friction. Beyond that a rig has a valve that lags behind its command in
position (hysteresis) and ignores small ones, sensors with lag, noise and finite resolution, and a controller that sees
only those sensors, and differentiates an encoder to get a speed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.compiled.functions import compile_function
from pneuopt.dynamics.simulate import contacts, initial_state, input_rows, new_integration, warn_contacts
from pneuopt.dynamics.smooth import Integration, without_solver_warnings
from pneuopt.dynamics.stick_slip import Event, StickSlipIntegration
from pneuopt.dynamics.system import Symbols, System, define, names, parameter_vector, stack
from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import Intersample, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory


@dataclass(frozen=True)
class Sensor:
    """A sensor of one channel: a lag of first order, then white noise, then rounding to a resolution.

    Parameters
    ----------
    lag : float
        Time constant [s].
    noise : float
        Standard deviation [unit of the channel].
    resolution : float
        Step of the digital value [unit of the channel]; 0 is none.
    """

    lag: float = 0.0
    noise: float = 0.0
    resolution: float = 0.0

    def __post_init__(self) -> None:
        for name in ("lag", "noise", "resolution"):
            value = getattr(self, name)
            require(0 <= value < inf, f"Sensor: {name} must not be negative, got {value:g}; 0 is none")

    @property
    def standard_deviation(self) -> float:
        """Standard deviation of noise and rounding together; rounding counts as uniform noise [unit of the channel].

        Examples
        --------
        >>> round(Sensor(noise=2e-6, resolution=12e-6).standard_deviation * 1e6, 6)
        4.0
        """
        return float(np.hypot(self.noise, self.resolution / np.sqrt(12)))

    def reading(self, value: float, noise: float) -> float:
        """Return the digital value; `noise` is a draw of the standard normal distribution."""
        noisy = value + self.noise * noise
        return self.resolution * round(noisy / self.resolution) if self.resolution else noisy


@dataclass(frozen=True)
class Actuator:
    """An imperfect valve or amplifier: hysteresis of the command, then a dead zone.

    Parameters
    ----------
    hysteresis : float
        Width of the loop, as catalogues give it [unit of the command]: a play operator of half that width.
    dead_zone : float
        Half width of the range around zero in which a command does nothing [unit of the command]; beyond it the
        command acts less this half width. The overlap of a `ProportionalValve` is a parameter of the valve instead.
    """

    hysteresis: float = 0.0
    dead_zone: float = 0.0

    def __post_init__(self) -> None:
        for name in ("hysteresis", "dead_zone"):
            value = getattr(self, name)
            require(0 <= value < inf, f"Actuator: {name} must not be negative, got {value:g}; 0 is none")

    def apply_hysteresis(self, command: float, before: float) -> float:
        """Position of the spool by the play operator, which moves it from `before` [unit of the command].

        Examples
        --------
        >>> valve = Actuator(hysteresis=0.2)
        >>> round(valve.apply_hysteresis(1.0, 0.0), 9), valve.apply_hysteresis(0.95, 0.9)
        (0.9, 0.9)
        """
        half = self.hysteresis / 2
        return min(max(before, command - half), command + half)

    def apply_dead_zone(self, value: float) -> float:
        """Command less the half width of the dead zone, and zero inside it [unit of the command]."""
        return value - min(max(value, -self.dead_zone), self.dead_zone)


@dataclass(frozen=True, eq=False)
class Rig:
    """A plant, alone or in a sampled loop, with real hardware around it.

    Parameters
    ----------
    model : System or ClosedLoop
        With Karnopp's friction (`ForceDrive(Karnopp(Stribeck()))`) it sticks and slips. A loop is sampled; the rig's
        sensors stand in for the loop's own.
    sensors : mapping of str to Sensor
        Sensors by the plant's output; these outputs are measured and logged.
    actuator : Actuator
    encoder : Encoder
        Source of a speed loop's speed where no sensor measures it: the encoder rounds the position sensor's readings
        to its resolution and differentiates them.
    actuated : str, optional
        The input that the actuator drives, for a plant alone; by default its only input.

    Raises
    ------
    ModelError
        If the loop is continuous, its dither is analogue, or no sensor measures its feedback.
    UnknownNameError
        If a sensor's output or the input is unknown.
    """

    model: System | ClosedLoop
    sensors: Mapping[str, Sensor]
    actuator: Actuator = field(default_factory=Actuator)
    encoder: Encoder = field(default_factory=Encoder)
    actuated: str | None = None

    def __post_init__(self) -> None:
        check_names("output", self.sensors, names(self.plant.outputs), "Rig: sensors")
        _ = self.command
        if self.loop is not None:
            analogue, h = self.loop.dither is not None and self.loop.dither.analogue, self.loop.pid.sample_time
            require(h is not None, "a rig's controller is sampled: PID(sample_time=1e-3)", ModelError)
            require(not analogue, "a rig's dither comes from its controller: Dither(analogue=False)", ModelError)
            message = f"the controller needs {self.feedback!r}, which no sensor measures; add it to sensors"
            require(self.feedback in self.sensors, message, ModelError)
            read = dict.fromkeys(replace(self.loop, sensor=None).readings)
            absent = ", ".join(n for n in read if n not in self.sensors)
            require(not absent, f"the controller reads {absent}, which no sensor measures; add to sensors", ModelError)

    @property
    def loop(self) -> ClosedLoop | None:
        """The loop; None where the plant is alone."""
        return self.model.loop

    @property
    def plant(self) -> System:
        """The plant without sensors and controller."""
        return self.model.plant

    @cached_property
    def command(self) -> Quantity:
        """Input of the plant that the actuator drives."""
        if self.loop is not None:
            return self.loop.command
        inputs = {q.name: q for q in self.plant.inputs}
        name = self.actuated or (next(iter(inputs)) if len(inputs) == 1 else "")
        require(bool(name), f"the plant has the inputs {', '.join(inputs) or 'none'}; choose actuated=", ModelError)
        check_names("input", [name], inputs, "Rig: actuated")
        return inputs[name]

    @property
    def feedback(self) -> str | None:
        """Channel that the controller reads, the position where an encoder gives the speed; None without a loop."""
        if self.loop is None:
            return None
        wanted = self.loop.pid_signal.name
        return self.encoder.position if wanted == "speed" and "speed" not in self.sensors else wanted

    @property
    def channels(self) -> tuple[str, ...]:
        """The measured outputs, in the plant's order."""
        return tuple(n for n in names(self.plant.outputs) if n in self.sensors)

    @cached_property
    def sensor_system(self) -> System:
        """The plant with an output "sensor.*" for each sensor, and a state of that name for each lag."""
        plant = self.plant
        shown = {f"sensor.{q.name}": q for q in plant.outputs if q.name in self.channels}
        lags = {n: self.sensors[q.name].lag for n, q in shown.items()}

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
            xdot, y = plant.ode(t, ca.vertcat(*(x[n] for n in names(plant.states))), stack(u), stack(p))
            rates = {n: xdot[k] for k, n in enumerate(names(plant.states))}
            outputs = {n: y[k] for k, n in enumerate(names(plant.outputs))}
            true = {n: outputs[q.name] for n, q in shown.items()}
            rates |= {n: (true[n] - x[n]) / lag for n, lag in lags.items() if lag > 0}
            return rates, outputs | {n: x.get(n, true[n]) for n in shown}

        sensors = {n: replace(q, name=n) for n, q in shown.items()}
        lagging = (q for n, q in sensors.items() if lags[n] > 0)
        states, outputs = (*plant.states, *lagging), (*plant.outputs, *sensors.values())
        return define(states, plant.inputs, outputs, plant.parameters, rhs)


@dataclass(frozen=True, eq=False)
class Recording:
    """A rig's log with the truth behind it, as `record` returns them.

    Attributes
    ----------
    experiment : Experiment
        The log at the rig's samples: inputs, which are held, references, readings with their noise; "feedback" is the
        signal that the controller used.
    truth : Trajectory
        States and outputs of the plant at the same instants, "control" after the actuator, and "stuck" with Karnopp's
        friction.
    events : tuple of Event
        Instants at which the piston broke away, reversed or stuck; only with Karnopp's friction.
    parameters : ParameterSet
        The values that generated the log.
    """

    experiment: Experiment
    truth: Trajectory
    events: tuple[Event, ...]
    parameters: ParameterSet


def record(
    rig: Rig,
    inputs: Trajectory,
    parameters: ParameterSet,
    *,
    seed: int = 0,
    initial: Mapping[str, float] | ArrayLike | None = None,
    name: str = "rig",
    rtol: float = 1e-8,
) -> Recording:
    """Run a rig and log it.

    Parameters
    ----------
    rig : Rig
    inputs : Trajectory
        "reference" for a loop, the actuated input for a plant alone; and the plant's other inputs. Each is held from
        one instant of the log to the next. The instants are those of this trajectory for a plant alone, and the
        controller's samples from ``inputs.t[0]`` on for a loop.
    parameters : ParameterSet
        Missing parameters keep the model's defaults.
    seed : int
        Seed of the noise: the same seed gives the same log.
    initial : mapping of state to value, or array, optional
        Initial state of the plant or the loop, as for `simulate`.
    name : str
        Name of the experiment.
    rtol : float
        Relative tolerance of the integration.

    Returns
    -------
    Recording

    Raises
    ------
    InputError
        If an input is missing or NaN, or a state starts outside its physical range.
    ConvergenceError
        If the integration stops.

    Examples
    --------
    >>> from pneuopt.models.drives import ForceDrive
    >>> from pneuopt.models.friction import Coulomb
    >>> from pneuopt.models.friction import Karnopp
    >>> rig = Rig(ForceDrive(Karnopp(Coulomb())).system(), {"position": Sensor(resolution=1e-3)})
    >>> push = Trajectory([0.0, 0.1, 0.2, 0.3], {"force": [29.0, 65.0, 65.0, 29.0]})
    >>> run = record(rig, push, rig.plant.parameters)
    >>> run.experiment.trajectory["position"].round(9).tolist(), [event.t for event in run.events]
    ([0.0, 0.0, 0.023, 0.066], [0.1])
    """
    rows, t, slack = input_rows(rig.model.inputs, inputs), inputs.t, 1e-9
    if rig.loop is not None:  # the log's instants are the controller's samples
        h = rig.loop.pid.sample_time or 0.0
        slack = max(1e-6 * h, 4 * float(np.spacing(np.abs(t).max())))
        t = t[0] + h * np.arange(int((t[-1] - t[0] + slack) / h) + 1)
    rows = rows[np.searchsorted(inputs.t, t + slack, side="right") - 1]
    log_inputs = Trajectory(t, dict(zip(names(rig.model.inputs), rows.T, strict=True)))
    x, p = initial_state(rig.model, parameters, initial), parameter_vector(rig.plant.parameters, parameters)
    source = (
        _SampledController(rig, rig.loop, parameters, log_inputs, x)
        if rig.loop is not None
        else _CommandPlayer(rig, log_inputs)
    )
    run = new_integration(rig.sensor_system, p, log_inputs.t, rtol, 1e-2 * rtol)
    with without_solver_warnings():
        readings, control = _run_samples(
            rig, run, source, log_inputs, x[: len(rig.plant.states)], p, np.random.default_rng(seed)
        )
    logged = {n: log_inputs[n] for n in names(rig.plant.inputs) if n != rig.command.name} | source.columns()
    logged |= dict(zip(rig.channels, readings.T, strict=True))
    truth = run.trajectory().with_columns({"control": control})
    warn_contacts(contacts(truth, rig.plant, parameters))
    held = dict.fromkeys(names(rig.plant.inputs), Intersample.HELD)
    spread = {n: s.standard_deviation for n, s in rig.sensors.items() if s.standard_deviation > 0}
    return Recording(
        Experiment(Trajectory(log_inputs.t, logged), spread, name=name, intersample=held),
        truth.select(n for n in truth.names if not n.startswith("sensor.")),
        run.events if isinstance(run, StickSlipIntegration) else (),
        parameters,
    )


class _CommandPlayer:
    """Source of commands that are known beforehand: a plant without a controller."""

    def __init__(self, rig: Rig, log_inputs: Trajectory) -> None:
        self._name, self._commands = rig.command.name, log_inputs[rig.command.name]
        self.initial_command = float(self._commands[0])

    def act(self, k: int, readings: Mapping[str, float]) -> float:  # noqa: ARG002 - as `_SampledController`
        """Return the command at sample k."""
        return float(self._commands[k])

    def columns(self) -> dict[str, ArrayLike]:
        """Columns that it adds to the log."""
        return {self._name: self._commands}


class _SampledController:
    """The loop's controller, run on a stand-in plant whose only states are the latest readings."""

    def __init__(self, rig: Rig, loop: ClosedLoop, parameters: ParameterSet, log_inputs: Trajectory, x: Array) -> None:
        loop.check(parameters)
        signal, read = loop.pid_signal, replace(loop, sensor=None).readings
        others = [q for q in loop.plant.outputs if q.name in read and q != signal]
        shown, self._others = [signal, *others], names(others)
        echo_plant = define(
            shown, [loop.command], shown, loop.plant.parameters, lambda _t, y, _u, _p: ({n: ca.SX(0) for n in y}, y)
        )
        echo_loop = replace(loop, plant=replace(echo_plant, axis=loop.plant.axis), sensor=None)
        self._update, self._p = compile_function(echo_loop.update), echo_loop.parameter_vector(parameters)
        plant_state, controller_state = x[: len(rig.plant.states)], x[len(shown) - len(echo_loop.states) :]
        self._rig, self._loop, self._inputs, self._x = rig, loop, log_inputs, controller_state
        self._command = names(echo_loop.states).index("pid.command")
        self.initial_command = float(controller_state[self._command - len(shown)])
        self._references = log_inputs.matrix(names(echo_loop.inputs))
        no_input = np.zeros(len(rig.plant.inputs))
        self._first_reading = _plant_outputs(
            rig, log_inputs.t[0], plant_state, no_input, parameter_vector(rig.plant.parameters, parameters)
        )[signal.name]
        self._feedback_values, self._commands = list[float](), list[float]()
        self._position: float | None = None

    def act(self, k: int, readings: Mapping[str, float]) -> float:
        """Return the command at sample k, and advance the controller by one sample."""
        wanted, source = self._loop.pid_signal.name, self._rig.feedback
        if source == wanted:
            self._feedback_values.append(readings[wanted])
        else:  # a speed, which is differentiated from an encoder's position
            counts = Sensor(resolution=self._rig.encoder.resolution)
            before, self._position = self._position, counts.reading(readings[str(source)], 0.0)
            h, last = self._loop.pid.sample_time or 0.0, (self._feedback_values or [self._first_reading])[-1]
            raw = last if before is None else (self._position - before) / h
            self._feedback_values.append(last + h / (h + self._rig.encoder.filter) * (raw - last))
        counted = {self._rig.encoder.position: self._position} if self._position is not None else {}
        shown = {**readings, **counted}
        t, seen = self._inputs.t[k], [self._feedback_values[-1], *(shown[n] for n in self._others)]
        after = self._update(t, np.append(seen, self._x), self._references[k], self._p)[0]
        self._x = after[len(seen) :]
        self._commands.append(float(after[self._command]))
        return self._commands[-1]

    def columns(self) -> dict[str, ArrayLike]:
        """Columns that it adds to the log."""
        name = self._loop.feedback.name
        reference = f"{name}_reference" if f"{name}_reference" in CHANNELS else "reference"
        return {
            reference: self._inputs["reference"],
            **{q.name: self._inputs[q.name] for q in self._loop.motion_inputs},
            self._loop.command.name: self._commands,
            "feedback": self._feedback_values,
        }


def _run_samples(
    rig: Rig,
    run: Integration,
    source: _CommandPlayer | _SampledController,
    log_inputs: Trajectory,
    x: Array,
    p: Array,
    random: np.random.Generator,
) -> tuple[Array, Array]:
    """Run from sample to sample; return the readings, a row a sample, and the commands after the actuator."""
    inputs, column = names(rig.plant.inputs), names(rig.plant.inputs).index(rig.command.name)
    u = np.column_stack([log_inputs[n] if n != rig.command.name else np.zeros(len(log_inputs)) for n in inputs])
    spool, sensors = source.initial_command, [rig.sensors[n] for n in rig.channels]
    noise, readings = random.standard_normal((len(log_inputs), len(sensors))), np.zeros((len(log_inputs), len(sensors)))
    u[0, column] = rig.actuator.apply_dead_zone(spool)
    rest = _plant_outputs(rig, log_inputs.t[0], x, u[0], p)  # of the sensors too
    run.restart(log_inputs.t[0], np.append(x, [rest[n] for n in rig.channels if rig.sensors[n].lag > 0]), u[0])
    for k, t in enumerate(log_inputs.t):
        x, shown = run.advance(t), run.outputs()[len(rig.plant.outputs) :]
        readings[k] = [s.reading(y, z) for s, y, z in zip(sensors, shown, noise[k], strict=True)]
        command = source.act(k, dict(zip(rig.channels, readings[k], strict=True)))
        spool = rig.actuator.apply_hysteresis(command, spool)
        u[k, column] = rig.actuator.apply_dead_zone(spool)
        run.restart(t, x, u[k])
        run.record()
    return readings, u[:, column]


def _plant_outputs(rig: Rig, t: float, x: Array, u: Array, p: Array) -> dict[str, float]:
    """Outputs of the plant by name."""
    return dict(zip(names(rig.plant.outputs), np.array(rig.plant.ode(t, x, u, p)[1]).ravel().tolist(), strict=True))
