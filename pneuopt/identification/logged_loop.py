"""`LoggedLoop`: a sampled loop as an identification reads it from a log that holds the reference, but not the command.

The controller is known; replayed along the logged feedback, it gives the command. With that command the plant proposes
its starts; the fit itself then runs plant and controller together, with the exact sampled update and its clip.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.signal import savgol_filter

from pneuopt.control.loop import ClosedLoop, unobservable_states
from pneuopt.control.reset_integral import RESET_STATES
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, Encoder
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.hooks import Log, Start
from pneuopt.dynamics.system import DiscreteSystem, Motion, Symbols, System, define, names
from pneuopt.identification.tolerances import SAMPLE_TIME_TOLERANCE
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, ModelError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

MOTION = ("speed", "position")  # signals of which one follows from the other where a log lacks it
REFERENCE_CHANNELS = {"speed": "speed_reference", "position": "position_reference"}
UNSEEN_STATES = ("pid.command", "pid.previous_error", "pid.transfer", "pid.bad_samples")
CONTROLLER_ACTS = "controller_acts"  # 1 at the log's samples at which the controller computes, 0 in between


@dataclass(frozen=True, eq=False)
class LoggedLoop:
    """A loop with a sampled controller, its reference named as logs name it.

    A log has a sample wherever the controller acts, from its first one on, and any number in between. The model's
    controller sees the plant's outputs without the sensors' noise: the noise that a high gain puts into the command is
    left to the residuals; where it is not small, the intervals are too narrow.

    The rates of the reference that a cascade or a feedforward uses are those of the log's "speed_reference" beside its
    "position_reference", where it holds both, and else differences of the reference from one sample of the controller
    to the next; a reference that is logged in coarse steps needs its speed beside it.
    """

    loop: ClosedLoop

    def __post_init__(self) -> None:
        message = "a log comes from a sampled controller: give the loop's PID its sample_time"
        require(self.loop.pid.sample_time is not None, message, ModelError)
        message = "an identification has no derivatives through an Encoder; give SensorLag(filter + half a sample)"
        require(not isinstance(self.loop.sensor, Encoder), message, ModelError)
        message = (
            "an identification has no derivatives through the jumps of a resetting integral: switch the reset off for "
            "the run (PID(reset=False)), or log the command and identify the plant alone (loop.plant)"
        )
        require(not self.loop.pid.reset, message, ModelError)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The states of the plant, then those of the controller."""
        return self.loop.states

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """The inputs that a log has to hold: the reference of what is fed back, and inputs not controlled."""
        rates = names(self.loop.motion_inputs)
        return tuple(q for q in self._all_inputs if q.name not in rates)

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """The outputs of the plant, and "control"."""
        return self.loop.outputs

    @property
    def parameters(self) -> ParameterSet:
        """The parameters of the loop."""
        return self.loop.parameters

    @property
    def plant(self) -> System:
        """The plant of the loop."""
        return self.loop.plant

    def motion(self) -> Motion:
        """The motion of the loop, its reference named as in a log."""
        motion = self.loop.motion()
        return replace(motion, system=replace(motion.system, inputs=self._all_inputs))

    def rest_state(self, parameters: ParameterSet, outputs: Mapping[str, float] | None = None) -> Array:
        """The state of the loop at rest, as `ClosedLoop.rest_state`."""
        return self.loop.rest_state(parameters, outputs)

    def check(self, parameters: ParameterSet) -> None:
        """Check the parameters, as `ClosedLoop.check`."""
        self.loop.check(parameters)

    def check_log(self, measured: Trajectory, name: str) -> None:
        """Refuse a log that holds the command, or that has no sample where the controller acts."""
        command, reference = self.loop.command.name, self.inputs[0].name
        remedy = "identify the plant alone with it as input (loop.plant), which needs no controller; or leave it out"
        require(command not in measured, f"{name}: the log holds the command {command!r}; {remedy}", LogError)
        require(reference in measured, f"{name}: the loop needs the channel {reference!r} as input", LogError)
        for channel in (n for n in self.loop.readings if n not in MOTION):
            told = f"{name}: the controller reads {channel!r}, which the log does not hold; log it"
            require(channel in measured, told, LogError)
        _acting_samples(measured.t, self._sample_time, name)

    def discrete(self, substeps: int = 1) -> DiscreteSystem:
        """The loop's sampled step; its last input is 1 at samples at which the controller acts."""
        return _add_acting_input(self.loop.discrete(substeps), self._all_inputs)

    def input_matrix(self, measured: Trajectory, name: str) -> Array:
        """The inputs of `discrete` along a log, shape (n, n_inputs)."""
        acts = _acting_samples(measured.t, self._sample_time, name)
        columns = {n: measured[n] for n in names(self.inputs)} | self._reference_rates(measured, acts)
        return np.column_stack([*(columns[n] for n in names(self._all_inputs)), acts])

    def unobservable_start(self, measured: Trajectory, states: Trajectory, parameters: ParameterSet) -> Array:
        """The start states on which no measured output depends, from a candidate; NaN for those that are estimated.

        Of previous error and derivative only a sum counts, and what a compensator remembers soon passes.
        """
        held = {*UNSEEN_STATES, *(f"pid.{n}" for n in RESET_STATES)}
        held |= {
            f"{c.section}.{q.name}"
            for c in self.loop.compensators
            for q in c.states(self.loop.controller.sensed_signal, self.loop.command)
        }
        acting = {"pid.Kd": "pid.derivative", "pid.Td": "pid.derivative", "feedforward.gain": "feedforward.filter"}
        for gain, state in acting.items():
            idle = gain in parameters and not (parameters[gain].free or parameters[gain].value)
            held |= {state} if idle else set()
        read = (self.loop.feedback.name, self.loop.pid_signal.name, *self.loop.readings)
        seen = {*read, *(n for n in names(self.loop.plant.outputs) if n in measured)}
        held |= set.intersection(*(set(unobservable_states(self.loop.plant, n)) for n in seen))
        return np.array([states[n][0] if n in held else np.nan for n in names(self.states)])

    def starts(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """The plant's candidates under the replayed command, for a log that began at rest.

        One more candidate assumes that the controller was just switched on, its integral empty.
        """
        out: list[Start] = []
        for was_at_rest in (True, False):
            replayed = {n: self._replay_controller(log, n, was_at_rest=was_at_rest) for n, log in logs.items()}
            plant = {}
            for n, log in logs.items():
                measured = log.measured.with_columns({self.loop.command.name: replayed[n]["control"]})
                plant[n] = Log(measured, log.parameters.select(self.loop.plant.parameters))
            controller = {n: {s: run[s] for s in run if s != "control"} for n, run in replayed.items()}
            label = "from rest" if was_at_rest else "from an empty integral"
            for start in self.loop.plant.starts(plant)[: None if was_at_rest else 1]:
                states = {n: run.with_columns(controller[n]) for n, run in start.states.items()}
                out.append(Start(states, start.parameters, ", ".join(filter(None, (start.label, label)))))
        return out

    def log_warnings(self, logs: Mapping[str, Log]) -> Sequence[str]:  # noqa: ARG002 - as `Fittable`
        """No warnings: the log lacks the command, without which the plant cannot examine it."""
        return ()

    @property
    def _all_inputs(self) -> tuple[Quantity, ...]:
        """The loop's inputs, its reference named as in a log."""
        reference, *others = self.loop.inputs
        fed_back = self.loop.feedback.name
        return (replace(reference, name=REFERENCE_CHANNELS.get(fed_back, f"{fed_back}_reference")), *others)

    def _reference_rates(self, measured: Trajectory, acts: Array) -> dict[str, Array]:
        """The rates of the reference that the controller uses, each held from one of its samples to the next."""
        wanted, at = names(self.loop.motion_inputs), np.flatnonzero(acts)
        if not wanted or at.size < 2:
            return {n: np.zeros(len(measured)) for n in wanted}
        t, held = measured.t[at], np.cumsum(acts).astype(np.intp) - 1
        is_speed = REFERENCE_SPEED not in wanted
        beside = REFERENCE_CHANNELS["speed"]
        own = measured[self.inputs[0].name][at]
        speed = own if is_speed else measured[beside][at] if beside in measured else np.gradient(own, t)
        rates = {REFERENCE_SPEED: speed, REFERENCE_ACCELERATION: np.gradient(speed, t)}
        return {n: rates[n][held] for n in wanted}

    @property
    def _sample_time(self) -> float:
        return self.loop.pid.sample_time or 0.0

    @cached_property
    def _controller(self) -> tuple[DiscreteSystem, Rollout, ClosedLoop]:
        """The controller alone, with the logged signals that it sees as inputs."""
        plant = self.loop.plant
        seen = [q for q in plant.outputs if q.name in self._seen]

        def rhs(_t: ca.SX, _x: Symbols, u: Symbols, _p: Symbols) -> tuple[Symbols, Symbols]:
            return {}, {q.name: u[f"logged.{q.name}"] for q in seen}

        logged = [replace(q, name=f"logged.{q.name}") for q in seen]
        echo = define([], [self.loop.command, *logged], seen, plant.parameters, rhs)
        echo = replace(echo, axis=plant.axis)
        alone = replace(self.loop, plant=echo, actuated=self.loop.command.name, measured=self.loop.feedback.name)
        discrete = _add_acting_input(alone.discrete(), alone.inputs)
        return discrete, Rollout(discrete.pieces), alone

    @property
    def _seen(self) -> set[str]:
        """The plant's outputs that the controller sees."""
        return {self.loop.feedback.name, self.loop.pid_signal.name, *self.loop.readings}

    def _replay_controller(self, log: Log, name: str, *, was_at_rest: bool) -> Trajectory:
        """The controller's states before each sample, of a rest or an empty integral, and "control", along a log."""
        discrete, rollout, alone = self._controller
        t, wanted = log.measured.t, self.inputs[0].name
        acts = _acting_samples(t, self._sample_time, name)
        columns = {
            f"logged.{n}": _signal_along_log(log.measured, n, self.loop.feedback.name, wanted, name) for n in self._seen
        }
        columns |= {"reference": log.measured[wanted]} | self._reference_rates(log.measured, acts)
        controller, shown = alone.controller, {n: columns[f"logged.{n}"][0] for n in self._seen}
        known, measured = controller.values(log.parameters), shown[controller.pid_signal.name]
        position = shown[controller.feedback.name]
        inner = controller.inner_inputs({"reference": columns["reference"][0]}, position, known)
        begun = {n: float(v) for n, v in controller.start(inner, measured, shown, 0.0, known).items()}
        rested = begun["pid.integral"] + begun["pid.transfer"]  # noise keeps the error of a rest from being zero
        begun |= {"sensor.reading": measured, "pid.integral": rested if was_at_rest else 0.0, "pid.transfer": 0.0}
        start = np.array([[begun[n] for n in names(discrete.states)]])
        u = np.column_stack([*(columns[n] for n in names(alone.inputs)), acts])
        p, h = alone.parameter_vector(log.parameters), np.append(np.diff(t), 0.0)
        lag = log.parameters.value("sensor.lag") if alone.sensor else math.inf
        run = rollout.run(start, u[None], p, t[None], h[None], substeps=math.ceil(h.max() / lag) or 1, states=True)
        assert run.x is not None
        states = dict(zip(names(discrete.states), run.x[0].T, strict=True))
        return Trajectory(t, states | {"control": run.y[0, :, names(discrete.outputs).index("control")]})


def _add_acting_input(discrete: DiscreteSystem, inputs: Sequence[Quantity]) -> DiscreteSystem:
    """The loop's step with one more input that lets the controller act (1) or rest (0)."""
    assert discrete.update is not None
    assert discrete.ode is not None
    n = {k: discrete.step.size1_in(i) for i, k in enumerate(("t", "h", "x", "u", "p"))}
    t, h, acts = ca.SX.sym("t"), ca.SX.sym("h"), ca.SX.sym(CONTROLLER_ACTS)
    x, u, p = (ca.SX.sym(k, n[k]) for k in "xup")
    fed = ca.vertcat(u, acts)
    step = ca.Function(
        "step", [t, h, x, fed, p], [*discrete.step(t, h, x, u, p)], ["t", "h", "x", "u", "p"], ["x_next", "y"]
    )
    ode = ca.Function("ode", [t, x, fed, p], [*discrete.ode(t, x, u, p)], ["t", "x", "u", "p"], ["xdot", "y"])
    after = x + acts * (discrete.update(t, x, u, p) - x)
    update = ca.Function("update", [t, x, fed, p], [after], ["t", "x", "u", "p"], ["x_after"])
    return replace(
        discrete, inputs=(*inputs, Quantity(CONTROLLER_ACTS, "1")), step=step, ode=ode, update=update, sample_time=None
    )


def _acting_samples(t: Array, sample_time: float, name: str) -> Array:
    """1 where the controller acts: at the log's first sample and every sample time after it."""
    phase = (t - t[0]) / sample_time
    acts = np.abs(phase - np.round(phase)) < SAMPLE_TIME_TOLERANCE
    missing = np.setdiff1d(np.arange(int(phase[-1] + SAMPLE_TIME_TOLERANCE) + 1), np.round(phase[acts]))
    if missing.size:
        raise LogError(
            f"{name}: the controller acts every {sample_time:g} s from the log's first sample on, but the log has no "
            f"sample at t = {t[0] + missing[0] * sample_time:g} s; log at the controller's sample time or a whole "
            "fraction of it, and leave a missing reading empty"
        )
    return np.asarray(acts, dtype=float)


def _signal_along_log(
    measured: Trajectory, wanted: str, feedback: str, reference: str, name: str, window: int = 21
) -> Array:
    """A signal that the controller sees along a log, without holes; a speed follows from `window` of positions."""
    if wanted in measured:
        return measured.fill_gaps(wanted)
    t, step = measured.t, float(np.median(np.diff(measured.t)))
    if wanted == "speed" and "position" in measured:
        window = min(window, (len(t) - 1) // 2 * 2 + 1)
        return np.asarray(savgol_filter(measured.fill_gaps("position"), window, 2, deriv=1, delta=step))
    message = f"{name}: the loop feeds back {wanted!r}; log it, or the motion it follows from"
    require(wanted == "position" and "speed" in measured, message, LogError)
    speed = measured.fill_gaps("speed")
    travel = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t)))
    return np.asarray(measured[reference][0] * (wanted == feedback) + travel)
