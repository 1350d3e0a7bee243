"""`Rig`: a plant or a loop with real hardware around it, `Sensor`s and an `Actuator`; `record` gives its log."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.system import Symbols, System, define, names, stack
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import Quantity


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
            _check_loop(self.loop)
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


def _check_loop(loop: ClosedLoop) -> None:
    analogue = loop.dither is not None and loop.dither.analogue
    require(loop.pid.sample_time is not None, "a rig's controller is sampled: PID(sample_time=1e-3)", ModelError)
    require(not analogue, "a rig's dither comes from its controller: Dither(analogue=False)", ModelError)
