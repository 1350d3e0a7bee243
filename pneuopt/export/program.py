"""`ControllerProgram`: a sampled controller as named numbers and two symbolic functions."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca

from pneuopt.control.controller import Controller, signals_are_good
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.pid import BAD_SAMPLES
from pneuopt.control.sensor import Encoder, Signals
from pneuopt.dynamics.system import Symbols, symbols
from pneuopt.export.identifiers import Identifiers
from pneuopt.export.tolerances import UNNAMED_CONSTANTS
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity, without_prefix

SAMPLE, CENTRE = "sample", "centre"  # the state that counts samples; the parameter of the valve's centre
ADDED_TERMS = ("integral", "derivative", "proportional", "feedforward", "compensation", "dither")
"""Terms of the command, whose names end in _term: each is one summand, no state."""
FIXED_NAMES = ("setpoint", "measured", "start_output")  # signals of every block
C_NAMES = ("c", "p")  # by which C reaches what is kept; a parameter, in a structure of its own, may have them
STATE_MEANINGS: Mapping[str, str] = {
    SAMPLE: "samples since the start",
    "sensor.reading": "filtered speed",
    "sensor.count": "position of the sample before",
    "pid.integral": "integral term, with what unwinds it",
    "pid.derivative": "filtered derivative term",
    "pid.previous_error": "weighted error of the sample before",
    "pid.side": "side on which the error was last",
    "pid.excursion": "how far the error has gone since it changed sides",
    "pid.command": "command that was sent last",
    "pid.pending": "command that acts at the next sample",
    "pid.transfer": "what a start takes back for the distance to the setpoint, until it has passed",
    "pid.bad_samples": "samples in a row that were no numbers",
    "feedforward.filter": "reference, filtered",
    "pressure_feedback.slow": "differential pressure, its slow part",
    "acceleration_feedback.position": "filtered position",
    "acceleration_feedback.speed": "filtered speed",
    "knocker.command": "command at the last pulse's onset",
    "knocker.direction": "direction of the last pulse",
    "impulsive_control.error": "error that has stood still",
    "impulsive_control.standing": "samples for which it has",
    "impulsive_control.phase": "samples since the last pulse's onset",
    "impulsive_control.length": "samples of the last pulse",
    "impulsive_control.peak": "peak of the last pulse, with its sign",
    "impulsive_control.before": "error at the last pulse's onset",
    "impulsive_control.ceiling": "peak of the last pulse towards this side that went too far; 0: none",
}
FAULT = "fault"
_NOT_READ = ("measured_read", "output_read")


@dataclass(frozen=True)
class Variable:
    """A number of a program."""

    name: str  # an identifier in every language
    unit: str
    meaning: str
    value: float = 0.0  # of a parameter
    origin: str = ""  # what the loop calls it, "pid.Kp"
    is_flag: bool = False  # whether it is on or off, 1 or 0


FAULT_FLAG = Variable(FAULT, "1", "whether this sample had a signal that is no number", is_flag=True)


@dataclass(frozen=True)
class ControllerProgram:
    """What a sampled controller computes, apart from any plant and any language."""

    sample_time: float  # [s]
    parameters: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    states: tuple[Variable, ...]
    outputs: tuple[Variable, ...]  # the first is what the actuator gets, the last the flag of a fault
    start_inputs: tuple[Variable, ...]
    # (start_inputs, parameters) -> states: at rest, or from another controller's output without a bump
    start: ca.Function
    step: ca.Function  # (inputs, states, parameters) -> (outputs and next states, terms)
    terms: tuple[str, ...]  # names of values on the way

    @property
    def values(self) -> list[float]:
        """Of the parameters."""
        return [v.value for v in self.parameters]

    @property
    def originals(self) -> Mapping[str, Variable]:
        """The parameters by what the loop calls them."""
        return {v.origin: v for v in self.parameters}

    @property
    def names(self) -> frozenset[str]:
        """Those of all its numbers."""
        variables = (*self.parameters, *self.states, *self.start_inputs, *self.outputs)
        return frozenset((*(v.name for v in variables), *self.terms))

    @property
    def constants(self) -> Mapping[float, str]:
        """Constants that have a name."""
        return {} if self.sample_time in UNNAMED_CONSTANTS else {self.sample_time: "SAMPLE_TIME"}


def controller_program(controller: Controller, parameters: ParameterSet, centre: float = 0.0) -> ControllerProgram:
    """The program of a sampled controller; `centre` is on the wire while the command is zero [the command's unit].

    What is behind it, an analogue dither say, and before it, a sensor's lag or steps, is hardware and not in the
    program; what an `Encoder` computes of a position is.
    """
    check_sampled(controller)
    controller.check(parameters)
    law = _symbolic_law(controller)  # of whose states and parameters stand those that are needed
    outputs = _outputs(law, controller, centre)
    states = _needed_states(ca.vertcat(*(v for v, _ in outputs.values())), law.states, law.after)
    after, first = (ca.densify(ca.vertcat(*(v[n] for n in states))) for v in (law.after, law.start))
    results = ca.vertcat(*(v for v, _ in outputs.values()), after)
    everything = ca.vertcat(results, first)
    given = [n for n, s in law.parameters.items() if ca.depends_on(everything, s)]
    terms = {n: v for n, v in law.terms.items() if not (v.is_symbolic() or v.is_constant())}
    x, p = (ca.vertcat(*(own[n] for n in chosen)) for own, chosen in ((law.states, states), (law.parameters, given)))
    signals = ca.vertcat(*(v for n, v in law.inputs.items() if n != "output"))
    begin = ca.vertcat(signals, law.inputs["output"])
    value = {**controller.values(parameters), CENTRE: centre}
    unit, signal = controller.command.unit, controller.feedback
    wanted = Variable("setpoint", signal.unit, f"the {signal.name} wanted")
    measured = Variable("measured", law.measured.unit, f"the {law.measured.name}, as the controller's input shows it")
    names = _claim_names(controller, outputs, given, states, terms)
    inputs = (wanted, measured, *_more_inputs(controller, names.readings))
    declared = {n: (q.unit, q.meaning or n) for n, q in controller.parameters.items()}
    declared[CENTRE] = (unit, "output while the command is zero, as a valve's centre")
    units = {q.name: q.unit for q in controller.states} | {SAMPLE: "1"}
    return ControllerProgram(
        controller.pid.sample_time or 0.0,
        tuple(Variable(names.parameters[n], *declared[n], value[n], n) for n in given),
        inputs,
        tuple(Variable(names.states[n], units[n], STATE_MEANINGS.get(n, n), 0.0, n) for n in states),
        (*(Variable(n, unit, what) for n, (_, what) in outputs.items() if n != FAULT), FAULT_FLAG),
        (*inputs, Variable("start_output", unit, "what the actuator has got so far, from which it goes on")),
        ca.Function("start", [begin, p], [first]),
        ca.Function("step", [signals, x, p], [ca.densify(results), ca.densify(ca.vertcat(*terms.values()))]),
        tuple(names.terms.values()),
    )


def check_sampled(controller: Controller) -> None:
    """Refuse a continuous controller: `ModelError`."""
    told = "a continuous controller cannot be exported: give it a sample time, sample_time under [pid], and tune again"
    require(controller.pid.sample_time is not None, told, ModelError)


@dataclass(frozen=True)
class _WrappedDither(Dither):
    """A dither whose sine sees less than a turn: after days of samples a PLC's sine of their angle is poor."""

    def wave(self, t: ca.SX, p: Symbols) -> ca.SX:
        """As `Dither.wave`."""
        if self.waveform is not Waveform.SINE:
            return super().wave(t, p)  # its own turns are wrapped
        turns = p["frequency"] * t
        return super().wave(turns - ca.floor(turns), {**p, "frequency": ca.SX(1)})


@dataclass(frozen=True)
class _SymbolicLaw:
    """The controller symbolically, by the loop's names."""

    inputs: Signals  # "measured", "output" and "reading NAME", too
    states: Signals
    parameters: Signals
    measured: Quantity  # what the controller's input shows
    after: Signals
    start: Signals
    terms: Signals


def _symbolic_law(controller: Controller) -> _SymbolicLaw:
    """What is computed at a sample, and at the start."""
    sensor, dither = controller.sensor, controller.dither
    counts = isinstance(sensor, Encoder) and sensor.differentiates(controller.sensed_signal)
    encoder = replace(sensor, resolution=0.0) if counts and isinstance(sensor, Encoder) else None
    wrapped = None if dither is None else _WrappedDither(**vars(dither))
    computed = replace(controller, dither=wrapped, sensor=encoder)
    measured = controller.signals.outputs[encoder.position] if encoder else controller.pid_signal
    x = symbols([q for q in controller.states if encoder or not q.name.startswith("sensor.")])
    x |= {SAMPLE: ca.SX.sym(SAMPLE)}
    p: Signals = {n: ca.SX.sym(n) for n in (*controller.parameters, CENTRE)}
    rates, readings = [q.name for q in controller.motion_inputs], controller.readings
    u: Signals = {n: ca.SX.sym(n) for n in ("reference", "measured", *rates, *map(_reading, readings), "output")}
    t = (controller.pid.sample_time or 0.0) * x[SAMPLE]
    shown = {n: u[_reading(n)] for n in readings} | {measured.name: u["measured"]}
    found = computed.update(t, x, u, shown, p)
    after = {**found.states, SAMPLE: x[SAMPLE] + 1}
    renamed = {"reference_read": "setpoint_read", f"{measured.name}_read": "measured_read"}
    renamed |= {n: f"{n}_term" for n in ADDED_TERMS}
    terms = {renamed.get(n, n): v for n, v in found.terms.items() if n not in _NOT_READ}
    return _SymbolicLaw(u, x, p, measured, after, _start(computed, u, measured.name, readings, p), terms)


def _reading(name: str) -> str:
    """The key of one among a law's inputs, whose other keys no plant knows to avoid."""
    return f"reading {name}"


def _start(computed: Controller, u: Signals, measured: str, readings: Iterable[str], p: Signals) -> Signals:
    """The first states, as `ClosedLoop.initial` has them, from what the actuator has got so far.

    Where a signal is bad, nothing is known: the controller begins anew with the first good sample, and its output is
    the safe one until then.
    """
    signals = [n for n in u if n != "output"]
    good, told = signals_are_good([u[n] for n in signals]), signals_are_good([u["output"]])
    u = {n: ca.if_else(good, u[n], 1) for n in signals} | {"output": u["output"]}
    own, shown = without_prefix(p, "pid"), {n: u[_reading(n)] for n in readings} | {measured: u["measured"]}
    command = ca.if_else(told, u["output"] - p[CENTRE], computed.pid.clip(own["fault_output"], own))
    given: Signals = {"count": u["measured"]} if computed.sensor else {}
    frozen = computed.schedule_gains(p, u["measured"], given, shown)
    inner = computed.inner_inputs(u, shown[computed.feedback.name], frozen) if computed.outer else u
    seen = ca.SX(0) if computed.sensor else u["measured"]  # a position says no speed: the start is at rest
    begun: Signals = {"sensor.reading": seen, "sensor.count": u["measured"]}
    begun |= computed.start(inner, seen, shown, command, frozen)
    return {**begun, f"pid.{BAD_SAMPLES}": ca.if_else(good, 0, own["fault_samples"]), SAMPLE: ca.SX(0)}


class _ClaimedNames(NamedTuple):
    """What is called how, by the loop's names."""

    parameters: Mapping[str, str]
    states: Mapping[str, str]
    readings: Mapping[str, str]
    terms: Mapping[str, str]


def _claim_names(
    controller: Controller, outputs: Iterable[str], given: Iterable[str], states: Iterable[str], terms: Iterable[str]
) -> _ClaimedNames:
    """The shortest name of each that is free: the block's signals first, so that they are called alike everywhere."""
    taken = Identifiers([*FIXED_NAMES, *outputs, *(_rate_name(q.name) for q in controller.motion_inputs)])
    parameters = {n: taken.claim(_short_name(n), n) for n in sorted(given, key=lambda n: n != CENTRE)}
    taken.take(*C_NAMES)
    return _ClaimedNames(
        parameters,
        {n: taken.claim(_short_name(n), n) for n in states},
        {n: taken.claim(n, f"{n}_reading") for n in controller.readings},
        {n: taken.claim(n, f"{n}_term") for n in terms},
    )


def _rate_name(name: str) -> str:
    return name.replace("reference", "setpoint")


def _more_inputs(controller: Controller, names: Mapping[str, str]) -> tuple[Variable, ...]:
    """The rates of the reference and the readings that compensators use, as their parts name them."""
    units = {q.name: q.unit for q in (*controller.motion_inputs, *controller.signals.outputs.values())}
    rates = (
        Variable(_rate_name(q.name), q.unit, f"the {q.name.partition('_')[2]} of the setpoint")
        for q in controller.motion_inputs
    )
    shown = (n.replace("_", " ") if names[n] == n else n for n in controller.readings)  # a renamed one is told as it is
    read = zip(controller.readings, shown, strict=True)
    return (*rates, *(Variable(names[n], units[n], f"{told}, as its sensor shows it") for n, told in read))


def _outputs(law: _SymbolicLaw, controller: Controller, centre: float) -> dict[str, tuple[ca.SX, str]]:
    """What the controller gives: the value, and what it is."""
    delayed, wire = bool(controller.pid.delay), law.parameters[CENTRE] if centre else ca.SX(0)
    command = law.after["pid.pending" if delayed else "pid.command"]
    later = ": write it at once, the design counts on one sample until it acts" if delayed else ""
    found = {"output": (command + wire, f"what the actuator gets{later}")}
    if centre:
        found["command"] = (command, "the output less the valve's centre")
    if delayed:
        held = law.after["pid.command"] + wire
        found["output_delayed"] = (held, "output of the sample before: for hardware on which an output acts at once")
    found[FAULT] = (law.after[f"pid.{BAD_SAMPLES}"] > 0, FAULT_FLAG.meaning)
    return found


def _needed_states(results: ca.SX, states: Signals, after: Signals) -> list[str]:
    """The states on which results depend, now or later, in the loop's order."""
    needed: set[str] = set()
    while True:
        sought = ca.vertcat(results, *(after[n] for n in needed))
        found = {n for n, symbol in states.items() if ca.depends_on(sought, symbol)}
        if found == needed:
            return [n for n in states if n in needed]
        needed = found


def _short_name(name: str) -> str:
    """A parameter's or state's name in a program where it is free: "pid.Kp" is Kp, "dither.offset" dither_offset."""
    if name == "pid.command":
        return "last_command"  # an output is called command
    return name.removeprefix("pid.").replace(".", "_")
