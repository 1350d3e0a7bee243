"""`export_controller`: a tuned controller as the files of another language; the languages, each a row of `_WRITERS`.

A language has a table of operations and the layout of its file: C99 with a test, one function block of IEC 61131-3
structured text, a Python class; and JavaScript, in which a page runs the whole loop.
"""

import json
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from importlib import resources

import casadi as ca
import numpy as np

from pneuopt.control.controller import Controller
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.dynamics.system import FRICTION_DIRECTION
from pneuopt.export.identifiers import RESERVED_FILES, Identifiers, reserved_as
from pneuopt.export.program import CENTRE, ControllerProgram, Variable, controller_program
from pneuopt.export.tolerances import LARGEST_LITERAL, RUN_TOLERANCE, SELECT, SMALLEST_LITERAL
from pneuopt.export.writer import (
    ARITHMETIC,
    COMPARED,
    Assignment,
    Binding,
    Header,
    Names,
    OperationSyntax,
    Places,
    ProgramText,
    Syntax,
    comment_text,
    infix,
    make_header,
    unary_calls,
    write_expressions,
    write_program_text,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet


class Language(Enum):
    """In what a controller is written."""

    C = "c"
    STRUCTURED_TEXT = "st"
    PYTHON = "python"


def export_controller(
    loop: ClosedLoop | Controller,
    parameters: ParameterSet,
    language: Language,
    *,
    name: str = "controller",
    centre: float = 0.0,
    origin: Sequence[str] = (),
) -> dict[str, str]:
    """Write the sampled controller of a loop in another language.

    Parameters
    ----------
    loop : ClosedLoop or Controller
        With a sample time. Of a loop, its controller alone is written.
    parameters : ParameterSet
        A missing one has the loop's default.
    language : Language
        C99 with a test, one function block of IEC 61131-3 structured text, or a Python class without dependencies.
    name : str
        Of the structure, block or class, and of the files.
    centre : float
        On the wire to the valve while the command is zero [the command's unit].
    origin : sequence of str
        What the files shall say of where the gains come from; any text.

    Returns
    -------
    dict of str to str
        Texts by the names of the files.

    Raises
    ------
    InputError
        If the name is no identifier, is reserved in a language, or is that of a number in the block; if the parameters
        cannot run; `ModelError` if the controller is continuous.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.models.linear import FirstOrder
    >>> loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3, limits=False))
    >>> list(export_controller(loop, loop.parameters, Language.C))
    ['controller.h', 'controller.c', 'controller_test.c']
    """
    if isinstance(loop, Controller):
        controller = loop
    else:
        check_closed_loop(loop)
        loop.check(parameters)
        controller = loop.controller
    program = controller_program(controller, parameters, centre)
    header = make_header(name, controller, parameters, centre, origin)
    within = {n.casefold() for n in program.names}
    taken = [n for n in header.own_names if n.casefold() in within]
    reserved = "a file that compilers or Windows have" if header.name.casefold() in RESERVED_FILES else None
    what = reserved_as(name) or reserved or (f"{taken[0]}, a number of the block" if taken else None)
    free = Identifiers([*program.names, *RESERVED_FILES]).claim(f"{name}_control", f"{name}_block")
    require(what is None, f"--name {name}: is {what}; take another, as --name {free}")
    return _WRITERS[language](program, header)


@dataclass(frozen=True)
class ReferenceRun:
    """A run of a controller: inputs, shape (n_samples, n_inputs), and its first output, shape (n_samples,)."""

    inputs: Array
    outputs: Array


def make_reference_run(program: ControllerProgram, samples: int = 200) -> ReferenceRun:
    """A step of the reference, half of which drives the output to its limits, with a measured signal that swings in.

    Rates of the reference and further readings are waves. One sample of the measured signal is no number, and then so
    many in a row that the controller begins anew.
    """
    k = np.arange(samples)
    value = {n: v.value for n, v in program.originals.items()}
    gain, upper = abs(value.get("pid.Kp", value.get("pid.K", 1.0))), value.get("pid.upper", np.inf)
    has_limit = np.isfinite(upper) and upper > 0 and gain > 0
    size = float(1.5 * upper / gain) if has_limit else 1.0  # beyond its limits for a while
    reference = np.where((k >= 5) & (k < 150), size, -0.3 * size)
    # a faster rise hides the integral, a slower one the approach
    measured = size * (1 - np.exp(-np.maximum(k - 5, 0) / 25.0)) + 0.02 * size * np.sin(0.9 * k)
    others = [size * np.sin(0.1 * (n + 1) * k) for n in range(len(program.inputs) - 2)]
    gap = int(min(value["pid.fault_samples"], 30)) + 1
    measured[60] = measured[100 : 100 + gap] = np.nan
    inputs = np.column_stack([reference, measured, *others])
    return ReferenceRun(inputs, run_program(program, inputs)[:, 0])


def run_program(program: ControllerProgram, inputs: Array) -> Array:
    """What CasADi computes of inputs (n_samples, n_inputs), started with the first: outputs (n_samples, n_outputs)."""
    p, count, found = program.values, len(program.outputs), []
    centre = program.originals[CENTRE].value if CENTRE in program.originals else 0.0
    x = program.start([*inputs[0], centre], p)
    for row in inputs:
        results = program.step(row, x, p)[0].full().ravel()
        found.append(results[:count])
        x = results[count:]
    return np.array(found)


C99 = Syntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("==", Binding.COMPARISON),
        ca.OP_NE: infix("!=", Binding.COMPARISON),
        ca.OP_AND: OperationSyntax("({0} && {1})", needs=COMPARED),
        ca.OP_OR: OperationSyntax("({0} || {1})", needs=COMPARED),
        ca.OP_NOT: OperationSyntax("!({0})"),
        ca.OP_FMIN: OperationSyntax("least({0}, {1})"),
        ca.OP_FMAX: OperationSyntax("largest({0}, {1})"),
        ca.OP_IF_ELSE_ZERO: OperationSyntax("({0} ? {1} : 0.0)", needs=(Binding.COMPARISON, Binding.OR)),
        SELECT: OperationSyntax("({0} ? {1} : {2})", needs=(Binding.COMPARISON, Binding.OR, Binding.OR)),
        **unary_calls("sqrt exp log sin cos tan tanh fabs floor ceil"),
    },
    infinity="INFINITY",
    truth=OperationSyntax("({0} ? 1.0 : 0.0)", needs=(Binding.COMPARISON,)),
    condition=OperationSyntax("{0} != 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


_HELPERS = {
    ca.OP_FMIN: "static double least(double a, double b)\n{\n    return a < b ? a : b;\n}\n",
    ca.OP_FMAX: "static double largest(double a, double b)\n{\n    return a > b ? a : b;\n}\n",
}
"""Not fmin and fmax of math.h: with their rules for what is not a number they take a call each."""


def write_c99(program: ControllerProgram, header: Header, run: ReferenceRun) -> dict[str, str]:
    """Header, source and test; their texts by the files' names."""
    name, body = header.name, write_program_text(program, C99, Places("c->p.{}", "c->{}", "c->{}"), header.own_names)
    return {
        f"{name}.h": _header(program, header, body),
        f"{name}.c": _source(program, header, body),
        f"{name}_test.c": _test(program, header, run),
    }


def _comment(header: Header) -> list[str]:
    return ["/*", *(f" * {line}".rstrip() for line in header.lines), " */"]


def _members(variables: tuple[Variable, ...]) -> list[str]:
    kinds = ("double", "int")
    return [f"    {kinds[v.is_flag]} {v.name}; /* {comment_text(f'[{v.unit}] {v.meaning}')} */" for v in variables]


def _prototypes(program: ControllerProgram, name: str) -> tuple[str, str, str]:
    given, begin = (", ".join(f"double {v.name}" for v in own) for own in (program.inputs, program.start_inputs))
    return (
        f"void {name}_prepare({name} *c, const {name}_parameters *p)",
        f"void {name}_start({name} *c, {begin})",
        f"double {name}_step({name} *c, {given})",
    )


def _header(program: ControllerProgram, header: Header, body: ProgramText) -> str:
    name, guard = header.name, f"{header.name.upper()}_H"
    prepare, start, step = _prototypes(program, name)
    signals = [f" * {v.name} {comment_text(f'[{v.unit}]: {v.meaning}')}" for v in program.inputs]
    last, out = program.start_inputs[-1], program.outputs[0]
    coefficients = [f"    double {a.name};" for a in body.coefficients]
    lines = [*_comment(header), f"#ifndef {guard}", f"#define {guard}", ""]
    lines += ["typedef struct {", *_members(program.parameters), f"}} {name}_parameters;", ""]
    lines += ["typedef struct {", f"    {name}_parameters p;", "    /* computed of them by prepare: */", *coefficients]
    lines += ["    /* states: */", *_members(program.states), "    /* outputs: */", *_members(program.outputs)]
    lines += [f"}} {name};", "", f"extern const {name}_parameters {name}_tuned;", ""]
    lines += ["/* Take over parameters, at first or while it runs. */", f"{prepare};", ""]
    lines += [f"/* Begin, or go on without a bump; {last.name} {comment_text(f'[{last.unit}]: {last.meaning}')}. */"]
    lines += [f"{start};", "", "/*"]
    lines += [f" * Compute a sample; returns {out.name} {comment_text(f'[{out.unit}]: {out.meaning}')}."]
    lines += [*signals, " */", f"{step};", "", "#endif"]
    return "\n".join(lines) + "\n"


def _source(program: ControllerProgram, header: Header, body: ProgramText) -> str:
    name = header.name
    prepare, start, step = _prototypes(program, name)
    texts = [a.text for a in (*body.coefficients, *body.start_locals, *body.start, *body.locals)]
    lines = [*_comment(header), f'#include "{name}.h"', "", "#include <math.h>", ""]
    if any("SAMPLE_TIME" in text for text in texts):
        lines += [f"#define SAMPLE_TIME {C99.literal(program.sample_time)} /* s */", ""]
    lines += [text for operation, text in _HELPERS.items() if operation in body.operations]
    values = [f"    {C99.literal(v.value)}, /* {v.name} [{comment_text(v.unit)}] */" for v in program.parameters]
    lines += [f"const {name}_parameters {name}_tuned = {{", *values, "};", "", prepare, "{", "    c->p = *p;"]
    lines += [f"    c->{a.name} = {a.text};" for a in body.coefficients]

    def unread_names(variables: Iterable[Variable], *assignments: Assignment) -> list[str]:
        text = " ".join(a.text for a in assignments)  # in which a name stands as a whole word, or not at all
        return [v.name for v in variables if not re.search(rf"(?<![\w>.]){v.name}\b", text)]

    unread = unread_names(program.start_inputs, *body.start_locals, *body.start)
    lines += ["}", "", start, "{", *(f"    (void)({n});" for n in unread)]
    lines += [f"    const double {a.name} = {a.text};" for a in body.start_locals]
    lines += [f"    c->{a.name} = {a.text};" for a in body.start]
    lines += ["}", "", step, "{", *(f"    (void)({n});" for n in unread_names(program.inputs, *body.locals))]
    lines += [*(f"    const double {a.name} = {a.text};" for a in body.locals), ""]
    lines += [f"    c->{n} = {text};" for n, text in {**body.outputs, **body.states}.items()]
    return "\n".join([*lines, f"    return c->{program.outputs[0].name};", "}"]) + "\n"


def _test(program: ControllerProgram, header: Header, run: ReferenceRun) -> str:
    name, columns = header.name, len(program.inputs) + 1
    rows = [
        "    {" + ", ".join("NAN" if math.isnan(v) else C99.literal(v) for v in (*given, out)) + "},"
        for given, out in zip(run.inputs, run.outputs, strict=True)
    ]
    read = ", ".join(f"run[k][{i}]" for i in range(columns - 1))
    begin = ", ".join(f"run[0][{i}]" for i in range(columns - 1))
    centre = f"{name}_tuned.{program.originals[CENTRE].name}" if CENTRE in program.originals else "0.0"
    told = ", ".join([*(v.name for v in program.inputs), program.outputs[0].name])
    lines = [f"/* Compares {name} with the library, sample by sample; status 1 if they differ. */"]
    lines += [f'#include "{name}.h"', "", "#include <math.h>", "#include <stdio.h>", ""]
    lines += [f"/* {told} */", f"static const double run[][{columns}] = {{", *rows, "};", "", "int main(void)", "{"]
    lines += [f"    {name} c;", "    double largest = 1e-300, worst = 0.0;", "    unsigned k;", ""]
    lines += [f"    {name}_prepare(&c, &{name}_tuned);", f"    {name}_start(&c, {begin}, {centre});"]
    lines += ["    for (k = 0; k < sizeof run / sizeof run[0]; ++k) {"]
    lines += [f"        const double wanted = run[k][{columns - 1}];"]
    lines += [f"        const double off = fabs({name}_step(&c, {read}) - wanted);"]
    lines += ["        worst = off <= worst ? worst : off;", "        if (!(off < INFINITY))", "            return 1;"]
    lines += ["        largest = fabs(wanted) > largest ? fabs(wanted) : largest;", "    }"]
    lines += ['    printf("largest difference %.3g of %.3g\\n", worst, largest);']
    lines += [f"    return worst <= {C99.literal(RUN_TOLERANCE)} * largest ? 0 : 1;", "}"]
    return "\n".join(lines) + "\n"


_WHOLE = "LINT_TO_LREAL(LREAL_TO_LINT({0}))"


_TANH = "(1.0 - 2.0 / (EXP(2.0 * MAX(-20.0, MIN(20.0, {0}))) + 1.0))"  # beyond 20 it is 1 in 16 digits


class _StructuredTextSyntax(Syntax):
    """A real literal has a point and, before an exponent, a capital E; it fits a REAL, or the number is refused."""

    def literal(self, value: float) -> str:
        if math.isfinite(value) and value != 0:
            _check_size(value, "a number")
            value = math.copysign(max(abs(value), SMALLEST_LITERAL), value)
        mantissa, e, exponent = super().literal(value).partition("e")
        if not e:
            return mantissa
        return f"{mantissa if '.' in mantissa else f'{mantissa}.0'}E{int(exponent)}"


def _check_size(value: float, what: str) -> None:
    told = f"{what} of {value:g} cannot be written in structured text, whose largest literal is {LARGEST_LITERAL:g}"
    require(math.isinf(value) or abs(value) <= LARGEST_LITERAL, f"{told}; make it smaller, or infinite for no limit")


STRUCTURED_TEXT = _StructuredTextSyntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("=", Binding.COMPARISON),
        ca.OP_NE: infix("<>", Binding.COMPARISON),
        ca.OP_AND: OperationSyntax("({0} AND {1})", needs=COMPARED),
        ca.OP_OR: OperationSyntax("({0} OR {1})", needs=COMPARED),
        ca.OP_NOT: OperationSyntax("(NOT ({0}))"),
        ca.OP_FMIN: OperationSyntax("MIN({0}, {1})"),
        ca.OP_FMAX: OperationSyntax("MAX({0}, {1})"),
        ca.OP_FABS: OperationSyntax("ABS({0})"),
        ca.OP_LOG: OperationSyntax("LN({0})"),
        ca.OP_TANH: OperationSyntax(_TANH),
        ca.OP_FLOOR: OperationSyntax(f"({_WHOLE} - SEL({_WHOLE} > {{0}}, 0.0, 1.0))"),
        ca.OP_IF_ELSE_ZERO: OperationSyntax("SEL({0}, 0.0, {1})"),
        SELECT: OperationSyntax("SEL({0}, {2}, {1})"),
        **unary_calls("SQRT EXP SIN COS"),
    },
    infinity="1.0E38",
    truth=OperationSyntax("SEL({0}, 0.0, 1.0)"),
    condition=OperationSyntax("{0} <> 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


def write_structured_text(program: ControllerProgram, header: Header) -> dict[str, str]:
    """One function block; its text by the file's name."""
    body, name = write_program_text(program, STRUCTURED_TEXT, Places(), header.own_names), header.name
    values = [*body.coefficients, *body.start_locals, *body.locals]
    lines = ["(*", *(f"  {line}".rstrip() for line in header.lines), "*)", f"FUNCTION_BLOCK {name}", "VAR_INPUT"]
    lines += (
        _declare(program.inputs, False)
        + _declare(program.parameters, True)
        + _declare(program.start_inputs[-1:], False)
    )
    lines += ["    restart : BOOL; (* TRUE: begin at start_output, without a bump; the first call always begins *)"]
    lines += ["END_VAR", "VAR_OUTPUT", *_declare(program.outputs, False), "END_VAR", "VAR"]
    lines += ["    runs : BOOL; (* whether it has begun *)", *_declare(program.states, False)]
    lines += [f"    {n} : LREAL;" for n in dict.fromkeys(a.name for a in values)]
    period = STRUCTURED_TEXT.literal(program.sample_time)
    lines += ["END_VAR", "VAR CONSTANT", f"    SAMPLE_TIME : LREAL := {period}; (* s *)", "END_VAR", ""]
    lines += ["(* what the parameters alone give; they may be changed while it runs *)"]
    lines += _assign({a.name: a.text for a in body.coefficients})
    lines += ["", "IF restart OR NOT runs THEN"]
    started = {a.name: a.text for a in (*body.start_locals, *body.start)}
    lines += [f"    {line}" for line in _assign(started)]
    lines += ["    runs := TRUE;", "END_IF;", "", *_assign({a.name: a.text for a in body.locals}), ""]
    lines += [*_assign({**body.outputs, **body.states}), "END_FUNCTION_BLOCK"]
    return {f"{name}.st": "\n".join(lines) + "\n"}


def _declare(variables: tuple[Variable, ...], initial: bool) -> list[str]:
    lines = []
    for v in variables:
        _check_size(v.value, v.origin or v.name)
        value = f" := {STRUCTURED_TEXT.literal(v.value)}" if initial else ""
        kind, told = ("BOOL", v.meaning) if v.is_flag else (f"LREAL{value}", f"{v.unit}: {v.meaning}")
        told += f"; {STRUCTURED_TEXT.infinity}: infinite" if math.isinf(v.value) else ""
        lines.append(f"    {v.name} : {kind}; (* {comment_text(told)} *)")
    return lines


def _assign(values: dict[str, str]) -> list[str]:
    lines = []
    for name, text in values.items():
        lines += textwrap.wrap(
            f"{name} := {text};", 110, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
        )
    return lines


PYTHON = Syntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("==", Binding.COMPARISON),
        ca.OP_NE: infix("!=", Binding.COMPARISON),
        ca.OP_AND: OperationSyntax("({0} and {1})", needs=COMPARED),
        ca.OP_OR: OperationSyntax("({0} or {1})", needs=COMPARED),
        ca.OP_NOT: OperationSyntax("(not ({0}))"),
        ca.OP_FMIN: OperationSyntax("min({0}, {1})"),
        ca.OP_FMAX: OperationSyntax("max({0}, {1})"),
        ca.OP_FABS: OperationSyntax("abs({0})"),
        ca.OP_IF_ELSE_ZERO: OperationSyntax("({1} if {0} else 0.0)"),
        SELECT: OperationSyntax("({1} if {0} else {2})"),
        **unary_calls("sqrt exp log sin cos tan tanh floor ceil", "math.{}"),
    },
    infinity="math.inf",
    truth=OperationSyntax("(1.0 if {0} else 0.0)"),
    condition=OperationSyntax("{0} != 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


def write_python(program: ControllerProgram, header: Header) -> dict[str, str]:
    """One module with one class; its text by the file's name."""
    body = write_program_text(program, PYTHON, Places("self.{}", "self.{}", "self.{}"), header.own_names)
    name = "".join(part[:1].upper() + part[1:] for part in header.name.split("_"))
    signature = ", ".join(f"{v.name}: float" for v in program.inputs)
    begin = ", ".join(f"{v.name}: float" for v in program.start_inputs[:-1])
    period = PYTHON.literal(program.sample_time)
    lines = ['"""', *header.lines, '"""', "", "import math", "", f"SAMPLE_TIME = {period}  # s", "", ""]
    lines += [f"class {name}:", '    """The controller: start it, then call step once a sample.', ""]
    lines += ["    Parameters", "    ----------"]
    for v in program.parameters:
        lines += textwrap.wrap(comment_text(_description(v)), 110, initial_indent="    ", subsequent_indent="        ")
    lines += ['    """', "", "    def __init__(", "        self,", "        *,"]
    lines += [f"        {v.name}: float = {PYTHON.literal(v.value)}," for v in program.parameters]
    lines += ["    ) -> None:", *(f"        self.{v.name} = {v.name}" for v in program.parameters)]
    for v in (*program.states, *program.outputs):
        lines += [f"        self.{v.name} = {'False' if v.is_flag else '0.0'}  # {comment_text(_description(v))}"]
    zeros = ", ".join("0.0" for _ in program.start_inputs[:-1])
    lines += ["        self.prepare()", f"        self.start({zeros})", ""]
    lines += ["    def prepare(self) -> None:", '        """Take over parameters that were changed."""']
    lines += [f"        self.{a.name} = {a.text}" for a in body.coefficients]
    last = program.start_inputs[-1]
    usual = f"self.{program.originals[CENTRE].name}" if CENTRE in program.originals else "0.0"
    lines += ["", f"    def start(self, {begin}, {last.name}: float | None = None) -> None:"]
    lines += [f'        """Begin, or go on without a bump from {last.name}: {last.meaning}."""']
    lines += [f"        {last.name} = {usual} if {last.name} is None else {last.name}"]
    lines += [f"        {a.name} = {a.text}" for a in body.start_locals]
    lines += [f"        self.{a.name} = {a.text}" for a in body.start]
    out = program.outputs[0]
    lines += ["", f"    def step(self, {signature}) -> float:"]
    lines += [f'        """Compute a sample: {out.meaning} [{comment_text(out.unit)}]."""']
    lines += [f"        {a.name} = {a.text}" for a in body.locals]
    lines += [f"        self.{n} = {text}" for n, text in {**body.outputs, **body.states}.items()]
    return {f"{header.name}.py": "\n".join([*lines, f"        return self.{out.name}"]) + "\n"}


def _description(v: Variable) -> str:
    return f"{v.name} [{v.unit}]: {v.meaning}" if v.meaning else f"{v.name} [{v.unit}]"


JAVASCRIPT = Syntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("===", Binding.COMPARISON),
        ca.OP_NE: infix("!==", Binding.COMPARISON),
        ca.OP_AND: OperationSyntax("({0} && {1})", needs=COMPARED),
        ca.OP_OR: OperationSyntax("({0} || {1})", needs=COMPARED),
        ca.OP_NOT: OperationSyntax("!({0})"),
        ca.OP_FMIN: OperationSyntax("Math.min({0}, {1})"),
        ca.OP_FMAX: OperationSyntax("Math.max({0}, {1})"),
        ca.OP_FABS: OperationSyntax("Math.abs({0})"),
        ca.OP_POW: OperationSyntax("Math.pow({0}, {1})"),
        ca.OP_CONSTPOW: OperationSyntax("Math.pow({0}, {1})"),
        ca.OP_ATAN2: OperationSyntax("Math.atan2({0}, {1})"),
        ca.OP_HYPOT: OperationSyntax("Math.hypot({0}, {1})"),
        ca.OP_IF_ELSE_ZERO: OperationSyntax("({0} ? {1} : 0.0)"),
        SELECT: OperationSyntax("({0} ? {1} : {2})"),
        **unary_calls(
            "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil sign",
            "Math.{}",
        ),
    },
    infinity="Infinity",
    truth=OperationSyntax("({0} ? 1.0 : 0.0)"),
    condition=OperationSyntax("{0} !== 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


def write_loop_javascript(loop: ClosedLoop) -> str:
    """A loop as JavaScript: ``makeLoop(p)`` binds parameters, ``simulateLoop(...)`` integrates; no module, no library.

    ``simulateLoop(p, x0, reference, horizon, points)`` gives ``{t, states, outputs}``, an array a state and an output
    at ``points + 1`` equal instants; null where the loop is too stiff or leaves what its model describes. Parameters,
    states and outputs are those of the loop, in its order, which ``LOOP`` names. The reference is ``{at, initial,
    final, inputs}``, the last one optional: what other inputs are from that instant on, ``[[place, value], ...]``.
    A loop with an operation that JavaScript has no word for, or a friction that sticks, raises `NotImplementedError`.
    """
    if FRICTION_DIRECTION in loop.parameters:
        raise NotImplementedError("a friction that sticks is simulated from event to event, which the page does not do")
    sampled = loop.pid.sample_time is not None
    system = loop.hold_system() if sampled else loop.system()
    sizes = len(loop.states), len(loop.inputs), len(loop.parameters)
    t, *symbols = ca.SX.sym("t"), *(ca.SX.sym(n, size) for n, size in zip("xup", sizes, strict=True))
    found, measured = system.ode(t, *symbols)
    results = ca.densify(ca.vertcat(found, measured))
    names = [*(f"dx[{k}]" for k in range(sizes[0])), *(f"y[{k}]" for k in range(len(loop.outputs)))]
    parts = [_method("rates", "t, x, u, dx, y", ca.Function("rates", [t, *symbols], [results]), names)]
    if sampled:
        after = ca.Function("update", [t, *symbols], [ca.densify(loop.update(t, *symbols))])
        parts.append(_method("update", "t, x, u, after", after, [f"after[{k}]" for k in range(sizes[0])]))
    about = {
        "parameters": list(loop.parameters),
        "states": [q.name for q in loop.states],
        "outputs": [q.name for q in loop.outputs],
        "inputs": [q.name for q in loop.inputs],
        "nominal": [q.nominal for q in loop.states],
        "sampleTime": loop.pid.sample_time,
    }
    coefficients = [line for own, _ in parts for line in own]
    methods = [line for _, own in parts for line in own]
    integrator = resources.files(__package__).joinpath("loop_integrator.js").read_text("utf-8")
    head = f"const LOOP = {json.dumps(about, ensure_ascii=True).replace('<', chr(92) + 'u003c')};"
    body = [head, "function makeLoop(p) {", *coefficients, "  return {", *methods, "  };", "}"]
    return "\n".join(body) + "\n" + integrator


def _method(name: str, signature: str, function: ca.Function, results: Sequence[str]) -> tuple[list[str], list[str]]:
    """What depends on the parameters alone, and the method that computes the rest."""
    counts = [function.numel_in(k) for k in range(1, 4)]
    inputs = [["t"], *([f"{n}[{k}]" for k in range(count)] for n, count in zip("xup", counts, strict=True))]
    known = frozenset(inputs[3])
    own = [f"r{k}" for k in range(len(results))]  # an entry that is used again has this name
    found = write_expressions(function, Names(inputs, own, parameters=known, coefficient=f"{name}_{{}}"), JAVASCRIPT)
    coefficients = [f"  const {name}_{a.name} = {a.text};" for a in found.coefficients]
    lines = [f"    {name}({signature}) {{"]
    lines += [f"      const {a.name} = {a.text};" for a in found.statements]
    lines += [f"      {place} = {text};" for place, text in zip(results, found.results.values(), strict=True)]
    return coefficients, [*lines, "    },"]


_WRITERS: Mapping[Language, Callable[[ControllerProgram, Header], dict[str, str]]] = {
    Language.C: lambda program, header: write_c99(program, header, make_reference_run(program)),
    Language.STRUCTURED_TEXT: write_structured_text,
    Language.PYTHON: write_python,
}
