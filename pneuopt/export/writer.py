"""`write_expressions`: the operations of an SX Function as assignments in any language, readable by its engineers.

`write_program_text` words a whole program so, and `make_header` says above it where it comes from and what to mind.
A walk over the graph, whose operations a `Syntax` words. Symbols keep their names; what has a label gets its name; what
is used once stands where it is used. Each value is computed at the rarer of two rates: when the parameters are set, or
at every sample; a division by what is known before the sample becomes a multiplication by its reciprocal, which moves a
result by a rounding.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, NamedTuple

import casadi as ca

from pneuopt.control.controller import Controller
from pneuopt.control.pid import integrates, to_series, to_standard
from pneuopt.control.tolerances import LARGEST_SIGNAL
from pneuopt.dynamics.compiled.c_writer import DIVISIONS, Instruction, read_instructions
from pneuopt.export.identifiers import Identifiers
from pneuopt.export.program import C_NAMES, ControllerProgram
from pneuopt.export.tolerances import MAX_IDENTIFIER, SELECT
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import provenance
from pneuopt.quantities.units import difference_unit, unit_ratio, write_value

COMPARISONS = frozenset({ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE})
LOGIC = frozenset({ca.OP_NOT, ca.OP_AND, ca.OP_OR})
STEPS = COMPARISONS | {ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN}  # operations that jump: a rounding before them may show


class Binding(IntEnum):
    """How tightly an expression holds together: what is looser than its place asks for gets parentheses."""

    SELECT = 0
    OR = 1
    AND = 2
    COMPARISON = 3
    SUM = 4
    PRODUCT = 5
    ATOM = 7


class OperationSyntax(NamedTuple):
    """How a language words an operation: a template with {0}, {1}, {2}, how tightly it and its operands bind."""

    template: str
    binding: Binding = Binding.ATOM
    needs: tuple[Binding, ...] = (Binding.SELECT, Binding.SELECT, Binding.SELECT)


_LEFT_TO_RIGHT = {Binding.SUM: Binding.PRODUCT, Binding.PRODUCT: Binding.ATOM, Binding.COMPARISON: Binding.SUM}


def infix(sign: str, binding: Binding) -> OperationSyntax:
    """An operation between its two operands, read from left to right."""
    tighter = _LEFT_TO_RIGHT.get(binding, Binding.ATOM)
    return OperationSyntax(
        f"{{0}} {sign} {{1}}", binding, (tighter if binding is Binding.COMPARISON else binding, tighter)
    )


def unary_calls(names: str, template: str = "{}") -> dict[int, OperationSyntax]:
    """Functions of one argument that a language calls as CasADi does, but for the template around the name."""
    return {getattr(ca, f"OP_{n.upper()}"): OperationSyntax(f"{template.format(n)}({{0}})") for n in names.split()}


COMPARED = (Binding.COMPARISON, Binding.COMPARISON)  # what "and" and "or" need of their operands
ARITHMETIC: Mapping[int, OperationSyntax] = {
    ca.OP_ASSIGN: OperationSyntax("{0}"),
    ca.OP_ADD: infix("+", Binding.SUM),
    ca.OP_SUB: infix("-", Binding.SUM),
    ca.OP_MUL: infix("*", Binding.PRODUCT),
    ca.OP_DIV: infix("/", Binding.PRODUCT),
    ca.OP_NEG: OperationSyntax("-{0}", Binding.SUM, (Binding.ATOM,)),
    ca.OP_SQ: OperationSyntax("{0} * {0}", Binding.PRODUCT, (Binding.ATOM,)),
    ca.OP_TWICE: OperationSyntax("2.0 * {0}", Binding.PRODUCT, (Binding.ATOM,)),
    ca.OP_INV: OperationSyntax("1.0 / {0}", Binding.PRODUCT, (Binding.ATOM,)),
    ca.OP_LT: infix("<", Binding.COMPARISON),
    ca.OP_LE: infix("<=", Binding.COMPARISON),
}
"""What is worded alike in C, structured text, Python and JavaScript."""


@dataclass(frozen=True)
class Syntax:
    """What a language calls the operations."""

    operations: Mapping[int, OperationSyntax]  # by CasADi's operation, and `SELECT`
    infinity: str  # a number larger than all others
    truth: OperationSyntax  # 1 where a condition holds, else 0
    condition: OperationSyntax  # whether a number is not 0

    def literal(self, value: float) -> str:
        """A number that reads back as the same double."""
        if math.isinf(value):
            return self.infinity if value > 0 else f"-{self.infinity}"
        return repr(float(value))


class Assignment(NamedTuple):
    """A name and the expression of its value."""

    name: str
    text: str


@dataclass
class Written:
    """A Function in a language."""

    coefficients: list[Assignment] = field(default_factory=list)  # what depends on the parameters alone
    statements: list[Assignment] = field(default_factory=list)  # what is computed at every sample before the results
    results: dict[str, str] = field(default_factory=dict)  # the expression of each result
    operations: set[int] = field(default_factory=set)  # CasADi's, in them


class Names(NamedTuple):
    """What the numbers of a Function are called."""

    inputs: Sequence[Sequence[str]]  # the entries of each argument
    results: Sequence[str]  # the entries of the first output
    labels: Sequence[str] = ()  # of the second output, which may be absent: it only gives names to values on the way
    parameters: frozenset[str] = frozenset()  # which inputs are known before the sample
    constants: Mapping[float, str] = {}
    coefficient: str = "{}"  # how a value that depends on the parameters alone is reached
    taken: frozenset[str] = frozenset()  # no value on the way may have these


def write_expressions(function: ca.Function, names: Names, syntax: Syntax) -> Written:
    """Write an SX Function with dense results in a language that has a word for each of its operations."""
    instructions = list(read_instructions(function))
    made = {i.target[0]: i for i in instructions if i.operation != ca.OP_OUTPUT}
    needed: set[int] = set()
    kept = []
    for given in reversed(instructions):
        i = _select(given, made) if given.operation == ca.OP_ADD else given
        if i.operation == ca.OP_OUTPUT or i.target[0] in needed:
            kept.append(i)
            needed |= set(_operands(i))
    return _Writer(names, syntax, kept[::-1]).write()


@dataclass(frozen=True)
class _Value:
    text: str
    binding: Binding
    is_condition: bool = False
    varies: bool = False  # from sample to sample
    is_atom: bool = False  # a name or a number


class _Writer:
    """The state of one walk."""

    longest = 70  # [character] of an expression within another: shorter, each operation has a line

    def __init__(self, names: Names, syntax: Syntax, instructions: list[Instruction]) -> None:
        self.names, self.syntax, self.instructions = names, syntax, instructions
        self.written = Written()
        self.values: dict[int, _Value] = {}
        self.reciprocals: dict[int, int] = {}
        labelled = [i for i in instructions if i.operation == ca.OP_OUTPUT and i.target[0] == 1]
        self.uses = Counter(k for i in instructions if i not in labelled for k in _operands(i))
        results = [i for i in instructions if i.operation == ca.OP_OUTPUT and i.target[0] == 0]
        self.labels = {i.sources[0]: names.results[i.target[1]] for i in reversed(results)}
        self.labels |= {i.sources[0]: names.labels[i.target[1]] for i in reversed(labelled)}
        self.exact: set[int] = set()  # from which an operation that jumps is computed: there a rounding could show
        for i in reversed(instructions):
            jumps = i.operation in STEPS or i.target[0] in self.exact
            if jumps and i.operation not in (ca.OP_OUTPUT, ca.OP_INPUT, ca.OP_CONST):
                self.exact |= set(i.sources)
        given = (n for entries in (*names.inputs, names.results, names.labels) for n in entries)
        self.identifiers = Identifiers([*given, *names.constants.values(), *names.taken])

    def write(self) -> Written:
        for i in self.instructions:
            if i.operation == ca.OP_OUTPUT:
                if i.target[0] == 0:
                    self.written.results[self.names.results[i.target[1]]] = self._read(i.sources[0]).text
            else:
                place, value = i.target[0], self._evaluate(i)
                again, is_long = self.uses[place] > 1, len(value.text) > self.longest
                wanted = self.labels.get(place) in self.names.labels or again or is_long
                is_named = wanted and not (value.is_atom or value.is_condition)
                self.values[place] = self._name(place, value) if is_named else value
        return self.written

    def _evaluate(self, i: Instruction) -> _Value:
        if i.operation == ca.OP_INPUT:
            name = self.names.inputs[i.sources[0]][i.sources[1]]
            return _Value(name, Binding.ATOM, varies=name not in self.names.parameters, is_atom=True)
        if i.operation == ca.OP_CONST:
            known = self.names.constants.get(i.constant)
            literal = self.syntax.literal(i.constant)
            return _Value(known or literal, Binding.SUM if literal.startswith("-") else Binding.ATOM, is_atom=True)
        if i.operation not in DIVISIONS or i.operation == ca.OP_INV or i.target[0] in self.exact:
            return self._apply(i.operation, i.sources)
        varying, divisor = i.sources
        if self._read(divisor).varies or not self._read(varying).varies:
            return self._apply(i.operation, i.sources)
        # a division of what varies by what does not, as a multiplication
        if divisor not in self.reciprocals:
            place = -2 - len(self.reciprocals)  # a place that no instruction has
            self.values[place] = self._apply(ca.OP_INV, [divisor])
            self.reciprocals[divisor] = place
        return self._apply(ca.OP_MUL, [varying, self.reciprocals[divisor]])

    def _apply(self, operation: int, sources: Sequence[int]) -> _Value:
        wording = self.syntax.operations.get(operation)
        if wording is None:
            raise NotImplementedError(f"CasADi's operation {operation}")
        self.written.operations.add(operation)
        conditional = operation in (SELECT, ca.OP_IF_ELSE_ZERO)
        asks = [operation in LOGIC or (conditional and k == 0) for k in range(len(sources))]
        found = [self._read(k, as_condition=asked) for k, asked in zip(sources, asks, strict=True)]
        varies = any(v.varies for v in found)
        for k, (source, v) in enumerate(zip(sources, found, strict=True)) if varies else ():
            if not (v.varies or v.is_atom or v.is_condition):  # computed when parameters are set, for a sample's use
                found[k] = self.values[source] = self._name(source, v)
        if wording.template.count("{0}") > 1 and not found[0].is_atom:
            found[0] = self._name(sources[0], found[0])
        texts = (v.text if v.binding >= need else f"({v.text})" for v, need in zip(found, wording.needs, strict=False))
        return _Value(wording.template.format(*texts), wording.binding, operation in COMPARISONS | LOGIC, varies)

    def _name(self, place: int, value: _Value) -> _Value:
        written = self.written
        own = self.labels.get(place)
        taken = {a.name for a in (*written.coefficients, *written.statements)}
        if own is None or own in taken:
            own = self.identifiers.claim_next("v" if value.varies else "k")
        (written.statements if value.varies else written.coefficients).append(Assignment(own, value.text))
        text = own if value.varies else self.names.coefficient.format(own)
        return replace(value, text=text, binding=Binding.ATOM, is_atom=True)

    def _read(self, place: int, *, as_condition: bool = False) -> _Value:
        """A value as a number, or as a condition."""
        value = self.values[place]
        if value.is_condition is as_condition:
            return value
        wording = self.syntax.condition if as_condition else self.syntax.truth
        text = value.text if value.binding >= wording.needs[0] else f"({value.text})"
        return _Value(wording.template.format(text), wording.binding, as_condition, value.varies)


def _operands(i: Instruction) -> Sequence[int]:
    """The places of what an operation is done with."""
    return () if i.operation == ca.OP_INPUT else i.sources


def _select(i: Instruction, made: Mapping[int, Instruction]) -> Instruction:
    """``a where c, plus b where not c`` as one choice."""
    first, second = (made[k] for k in i.sources)
    if not first.operation == second.operation == ca.OP_IF_ELSE_ZERO:
        return i
    for one, other in ((first, second), (second, first)):
        negation = made[other.sources[0]]
        if negation.operation == ca.OP_NOT and negation.sources[0] == one.sources[0]:
            return i._replace(operation=SELECT, sources=(one.sources[0], one.sources[1], other.sources[1]))
    return i


@dataclass(frozen=True)
class Places:
    """How a language reaches the numbers of a block; {} stands for the name."""

    parameter: str = "{}"
    state: str = "{}"
    coefficient: str = "{}"


@dataclass(frozen=True)
class ProgramText:
    """A program in one language."""

    coefficients: tuple[Assignment, ...]  # what is computed when parameters are set
    start_locals: tuple[Assignment, ...]
    start: tuple[Assignment, ...]  # the first states, each once, after `start_locals`
    locals: tuple[Assignment, ...]
    outputs: Mapping[str, str]  # what each becomes, by the locals; a flag's is a condition
    states: Mapping[str, str]  # no state is read here that has been written
    operations: frozenset[int]  # CasADi's, in all of them


def write_program_text(
    program: ControllerProgram, syntax: Syntax, places: Places, taken: Iterable[str] = ()
) -> ProgramText:
    """Word a program in a language; no value on the way has a name of the program or one that is `taken`."""
    parameters = [places.parameter.format(v.name) for v in program.parameters]
    inputs, states = [v.name for v in program.inputs], [v.name for v in program.states]
    outputs, known = [v.name for v in program.outputs], frozenset(parameters)
    used = [*program.names, *C_NAMES, *taken]
    free = Identifiers(used)
    first, after = ([free.claim(f"{n}_{what}") for n in states] for what in ("first", "next"))
    now = [free.claim(f"{n}_now") for n in outputs]
    used += [*first, *after, *now]
    given = [[v.name for v in program.start_inputs], parameters]
    begin = Names(given, first, (), frozenset(), program.constants, taken=frozenset(used))
    started = write_expressions(program.start, begin, syntax)
    used += [a.name for a in (*started.coefficients, *started.statements)]
    names = Names(
        [inputs, [places.state.format(n) for n in states], parameters],
        [*now, *after],
        program.terms,
        known,
        program.constants,
        places.coefficient,
        frozenset(used),
    )
    step = write_expressions(program.step, names, syntax)
    own = [*step.statements]
    found: dict[str, str] = {}
    local = {a.name for a in own} | set(inputs)
    for name, text in step.results.items():
        if text not in local:
            own.append(Assignment(name, text))
        found[name] = text if text in local else name
    return ProgramText(
        tuple(step.coefficients),
        (*started.coefficients, *started.statements),
        tuple(Assignment(n, started.results[begun]) for n, begun in zip(states, first, strict=True)),
        tuple(own),
        {v.name: found[made] + (" > 0.0" if v.is_flag else "") for v, made in zip(program.outputs, now, strict=True)},
        {n: found[made] for n, made in zip(states, after, strict=True)},
        frozenset(started.operations | step.operations),
    )


_COMMENT_MARKS = re.compile(r"\*/|/\*|\(\*|\*\)|//|\"\"\"|'''|\?\?|\\|<!|--|\$")


@dataclass(frozen=True)
class Header:
    """The lines on top of a file, plain text, which no comment of C, structured text or Python ends in."""

    name: str  # of the block, structure or class
    lines: tuple[str, ...] = field(default=())

    @property
    def own_names(self) -> tuple[str, ...]:
        """What the files call the block and what belongs to it."""
        parts = ("parameters", "tuned", "prepare", "start", "step", "test", "h")
        return (self.name, *(f"{self.name}_{part}" for part in parts))


def comment_text(text: str, longest: int = 200) -> str:
    r"""A text that cannot end a comment: one line of printable ASCII, without the marks of comments.

    `longest` [characters] is what counts of it: more of a text from a file would fill the header with words of another.
    """
    plain = "".join(c if c.isprintable() and c.isascii() else " " for c in text[:longest])
    while _COMMENT_MARKS.search(plain):
        plain = _COMMENT_MARKS.sub(lambda mark: " ".join(mark[0]).replace("\\", "").replace("$", ""), plain)
    return " ".join(plain.split())


def check_name(name: str) -> None:
    """Refuse a name that is no identifier in C, structured text and Python: `InputError`."""
    proper = re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name) is not None
    told = "letters, digits and single underscores between them, a letter first"
    require(
        proper and len(name) <= MAX_IDENTIFIER, f"--name {name!r}: a block's name has {told}, {MAX_IDENTIFIER} at most"
    )


def make_header(
    name: str, controller: Controller, parameters: ParameterSet, centre: float, origin: Sequence[str]
) -> Header:
    """Where a controller comes from (`origin`, any text), its sample time, its gains in every form, what to mind."""
    check_name(name)
    h, signal = controller.pid.sample_time or 0.0, controller.feedback
    lines = [
        f"{name}: sampled PID controller of the {signal.name}, written by pneuopt {provenance()['pneuopt']}",
        *origin,
        "",
    ]
    lines += [
        f"Sample time: {write_value(h, 's')}. Call it once a sample, at equal times; the gains hold for no other."
    ]
    of = f" of the inner loop, which controls the {controller.pid_signal.name}" if controller.outer else ""
    lines += ["Numbers are in SI units, as marked.", "", f"Gains{of}, in every form that controllers take:"]
    lines += _gain_lines(controller, parameters)
    complete, parts = controller.complete(parameters), dict[str, list[str]]()
    for n in controller.parameters:
        section, _, own = n.partition(".")
        parts.setdefault(section, []).append(f"{own} = {write_value(complete.value(n), complete[n].unit)}")
    parts.pop("pid", None)
    lines += ["", "Parts beside it, which belong to the design as much as its gains:"] if parts else []
    lines += [f"- {section}: {', '.join(values)}" for section, values in parts.items()]
    lines += ["", *_notes(controller, parameters, centre)]
    return Header(name, tuple(map(comment_text, lines)))


def _gain_lines(controller: Controller, parameters: ParameterSet) -> list[str]:
    """The gains in the parallel, standard and series forms."""
    gains, gain = controller.parallel_form(parameters), unit_ratio(controller.command.unit, controller.pid_signal.unit)
    units = {"Kp": gain, "K": gain, "Ti": "s", "Td": "s", "Tf": "s", "N": ""}
    units["Ki"] = unit_ratio(controller.command.unit, f"{difference_unit(controller.pid_signal.unit)}*s")
    units["Kd"] = unit_ratio(f"{difference_unit(controller.command.unit)}*s", controller.pid_signal.unit)

    def line(name: str, convert: Callable[[], Any], formula: str) -> str:
        try:
            found = vars(convert())
        except InputError as reason:
            return f"- {name}: none ({reason})"
        without = {"N", "Tf"} if gains.Kd == 0 else set()
        shown = [f"{n} = {v:.9g} {units[n]}".rstrip() if math.isfinite(v) else f"{n} = none" for n, v in found.items()]
        return f"- {name}: {', '.join(s for s in shown if s.partition(' ')[0] not in without)}; {formula}"

    return [
        line("parallel", lambda: gains, "Kp + Ki/s + Kd s/(Tf s + 1)"),
        line("standard", lambda: to_standard(gains), "Kp (1 + 1/(Ti s) + Td s/(1 + s Td/N)), N a ratio"),
        line("series", lambda: to_series(gains), "K (1 + 1/(Ti s)) (1 + Td s/(Tf s + 1))"),
    ]


def _notes(controller: Controller, parameters: ParameterSet, centre: float) -> list[str]:
    """What the hardware around the block has to do."""
    value = controller.values(parameters)
    notes, unit = list[str](), controller.command.unit
    if centre:
        notes += [f"The output is {write_value(centre, unit)}, where the valve is closed, plus the command."]
    if controller.pid.limits and all(math.isfinite(value[n]) for n in ("pid.lower", "pid.upper")):
        low, high = (write_value(value[n] + centre, unit) for n in ("pid.lower", "pid.upper"))
        about = "; lower and upper count from the centre" if centre else ""
        notes += [f"The output runs from {low} to {high}{about}."]
    notes += [*_start_notes(controller, parameters, value), *_fault_notes(controller, value, centre)]
    if controller.pid.delay:
        notes += ["The design counts on one sample from reading to acting."]
    if controller.dither is not None and controller.dither.analogue:
        size, frequency = write_value(value["dither.amplitude"], controller.command.unit), value["dither.frequency"]
        shape = controller.dither.waveform.value
        notes += [
            f"A generator behind the block adds a {shape} of {size} peak at {frequency:.9g} Hz; it is not in here."
        ]
    if controller.schedule is not None:
        told = " and with the load told, schedule_load" if controller.schedule.load is not None else ""
        gains = ", ".join(controller.schedule.gains)
        notes += [
            f"Scheduled with the position{told}: {gains}. The gains above hold in the middle, at the nominal load."
        ]
    if controller.sensor is not None:
        notes += [f"Designed behind a sensor: {controller.sensor!r}."]
    if controller.pid.limits and math.isinf(value["pid.lower"]) and math.isinf(value["pid.upper"]):
        notes += ["The output has no limits; set lower and upper."]
    return notes


def _start_notes(controller: Controller, parameters: ParameterSet, value: Mapping[str, float]) -> list[str]:
    """What a start does with the output so far, and why."""
    time = write_value(float(controller.pid.emptying_time({n.removeprefix("pid."): v for n, v in value.items()})), "s")
    if not integrates(controller.parallel_form(parameters).Ki):
        return [
            "A start, or restart, does not make the output jump: the output so far passes to the controller's own",
            f"with a time constant of {time}. Without an integral gain nothing is kept there, at a limit neither.",
        ]
    return [
        "A start, or restart, does not make the output jump, and does not leave the axis waiting for a slow integral:",
        f"the setpoint counts as if it moved from the measurement to its value with a time constant of {time}.",
    ]


def _fault_notes(controller: Controller, value: Mapping[str, float], centre: float) -> list[str]:
    """What happens at a sample that is no number, after how many, and how the controller recovers."""
    count, h = math.ceil(value["pid.fault_samples"]), controller.pid.sample_time or 0.0
    inside = min(max(value["pid.fault_output"], value.get("pid.lower", -math.inf)), value.get("pid.upper", math.inf))
    safe, time = write_value(inside + centre, controller.command.unit), write_value(count * h, "s", 3)
    return [
        f"A sample is bad where an input is no number, or larger than {LARGEST_SIGNAL:g}: the output stays as it was,",
        "fault is set, and the next good sample goes on from there, its differences taken over the whole gap.",
        f"After {count} bad samples in a row (fault_samples), {time}, the output goes to {safe} (fault_output); "
        "the next good sample then begins anew from it, as at a start.",
        "Where the first sample is bad, the output is the safe one until a good sample begins.",
    ]
