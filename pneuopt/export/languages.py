"""The controller in C99: header, source, and a test that compares it with the library; no allocation, math.h alone."""

import math

import casadi as ca

from pneuopt.export.header import Header, comment_text
from pneuopt.export.page import Page, Places, write_page
from pneuopt.export.program import CENTRE, ControllerProgram, Variable
from pneuopt.export.reference_run import RUN_TOLERANCE, ReferenceRun
from pneuopt.export.writer import ARITHMETIC, COMPARED, SELECT, Binding, Form, Syntax, infix, unary_calls

C99 = Syntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("==", Binding.COMPARISON),
        ca.OP_NE: infix("!=", Binding.COMPARISON),
        ca.OP_AND: Form("({0} && {1})", needs=COMPARED),
        ca.OP_OR: Form("({0} || {1})", needs=COMPARED),
        ca.OP_NOT: Form("!({0})"),
        ca.OP_FMIN: Form("least({0}, {1})"),
        ca.OP_FMAX: Form("largest({0}, {1})"),
        ca.OP_IF_ELSE_ZERO: Form("({0} ? {1} : 0.0)", needs=(Binding.COMPARISON, Binding.OR)),
        SELECT: Form("({0} ? {1} : {2})", needs=(Binding.COMPARISON, Binding.OR, Binding.OR)),
        **unary_calls("sqrt exp log sin cos tan tanh fabs floor ceil"),
    },
    infinity="INFINITY",
    truth=Form("({0} ? 1.0 : 0.0)", needs=(Binding.COMPARISON,)),
    condition=Form("{0} != 0.0", Binding.COMPARISON, (Binding.SUM,)),
)
_HELPERS = {
    ca.OP_FMIN: "static double least(double a, double b)\n{\n    return a < b ? a : b;\n}\n",
    ca.OP_FMAX: "static double largest(double a, double b)\n{\n    return a > b ? a : b;\n}\n",
}
"""Not fmin and fmax of math.h: with their rules for what is not a number they take a call each."""


def write_c99(program: ControllerProgram, header: Header, run: ReferenceRun) -> dict[str, str]:
    """Header, source and test; their texts by the files' names."""
    name, page = header.name, write_page(program, C99, Places("c->p.{}", "c->{}", "c->{}"), header.own_names)
    return {
        f"{name}.h": _header(program, header, page),
        f"{name}.c": _source(program, header, page),
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


def _header(program: ControllerProgram, header: Header, page: Page) -> str:
    name, guard = header.name, f"{header.name.upper()}_H"
    prepare, start, step = _prototypes(program, name)
    signals = [f" * {v.name} {comment_text(f'[{v.unit}]: {v.meaning}')}" for v in program.inputs]
    last, out = program.start_inputs[-1], program.outputs[0]
    coefficients = [f"    double {a.name};" for a in page.coefficients]
    lines = [*_comment(header), f"#ifndef {guard}", f"#define {guard}", ""]
    lines += ["typedef struct {", *_members(program.parameters), f"}} {name}_parameters;", ""]
    lines += ["typedef struct {", f"    {name}_parameters p;", "    /* computed of them by prepare: */", *coefficients]
    lines += ["    /* states: */", *_members(program.states), "    /* outputs: */", *_members(program.outputs)]
    lines += [f"}} {name};", "", f"extern const {name}_parameters {name}_tuned;", ""]
    lines += ["/* Take over parameters, at first or while it runs. */", f"{prepare};", ""]
    lines += [f"/* Begin, or go on without a bump; {last.name} {comment_text(f'[{last.unit}]: {last.meaning}')}. */"]
    lines += [
        f"{start};",
        "",
        "/*",
        f" * Compute a sample; returns {out.name} {comment_text(f'[{out.unit}]: {out.meaning}')}.",
    ]
    lines += [*signals, " */", f"{step};", "", "#endif"]
    return "\n".join(lines) + "\n"


def _source(program: ControllerProgram, header: Header, page: Page) -> str:
    name = header.name
    prepare, start, step = _prototypes(program, name)
    texts = [a.text for a in (*page.coefficients, *page.start_locals, *page.start, *page.locals)]
    lines = [*_comment(header), f'#include "{name}.h"', "", "#include <math.h>", ""]
    if any("SAMPLE_TIME" in text for text in texts):
        lines += [f"#define SAMPLE_TIME {C99.literal(program.sample_time)} /* s */", ""]
    lines += [text for operation, text in _HELPERS.items() if operation in page.operations]
    values = [f"    {C99.literal(v.value)}, /* {v.name} [{comment_text(v.unit)}] */" for v in program.parameters]
    lines += [f"const {name}_parameters {name}_tuned = {{", *values, "};", "", prepare, "{", "    c->p = *p;"]
    lines += [f"    c->{a.name} = {a.text};" for a in page.coefficients]
    unread = [v.name for v in program.start_inputs if not _reads((*page.start_locals, *page.start), v.name)]
    lines += ["}", "", start, "{", *(f"    (void)({n});" for n in unread)]
    lines += [f"    const double {a.name} = {a.text};" for a in page.start_locals]
    lines += [f"    c->{a.name} = {a.text};" for a in page.start]
    unused = [v.name for v in program.inputs if not _reads(page.locals, v.name)]
    lines += ["}", "", step, "{", *(f"    (void)({n});" for n in unused)]
    lines += [*(f"    const double {a.name} = {a.text};" for a in page.locals), ""]
    lines += [f"    c->{n} = {text};" for n, text in {**page.outputs, **page.states}.items()]
    return "\n".join([*lines, f"    return c->{program.outputs[0].name};", "}"]) + "\n"


def _reads(assignments: tuple[tuple[str, str], ...], name: str) -> bool:
    """Whether a name stands in one of the expressions, as a whole word."""
    import re

    return any(re.search(rf"(?<![\w>.]){name}\b", text) for _, text in assignments)


def _test(program: ControllerProgram, header: Header, run: ReferenceRun) -> str:
    name, columns = header.name, len(program.inputs) + 1
    rows = [
        "    {" + ", ".join(_number(v) for v in (*given, out)) + "},"
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


def _number(value: float) -> str:
    """A number of the test's run, or none."""
    return "NAN" if math.isnan(value) else C99.literal(value)
