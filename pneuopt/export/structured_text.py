"""The controller as one function block in IEC 61131-3 structured text, of standard functions alone.

Type conversions and functions are those of IEC 61131-3:2013, 6.6.2.5; it has neither tanh nor floor, which are made of
EXP and of a rounding. All numbers are LREAL, flags BOOL.
"""

import math
import textwrap

import casadi as ca

from pneuopt.export.header import Header, comment_text
from pneuopt.export.page import Places, write_page
from pneuopt.export.program import ControllerProgram, Variable
from pneuopt.export.writer import ARITHMETIC, COMPARED, SELECT, Binding, Form, Syntax, infix
from pneuopt.quantities.errors import require

_WHOLE = "LINT_TO_LREAL(LREAL_TO_LINT({0}))"
_TANH = "(1.0 - 2.0 / (EXP(2.0 * MAX(-20.0, MIN(20.0, {0}))) + 1.0))"  # beyond 20 it is 1 in 16 digits
LARGEST_LITERAL = 1e38
"""In place of infinity: some compilers refuse an LREAL's literal that is no REAL (matiec, issue 12), from 3.4E38 on."""
SMALLEST_LITERAL = 1e-37
"""In place of what is nearer to zero: below 1.2E-38 those compilers refuse it, and zero would divide by zero."""


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
        ca.OP_AND: Form("({0} AND {1})", needs=COMPARED),
        ca.OP_OR: Form("({0} OR {1})", needs=COMPARED),
        ca.OP_NOT: Form("(NOT ({0}))"),
        ca.OP_FMIN: Form("MIN({0}, {1})"),
        ca.OP_FMAX: Form("MAX({0}, {1})"),
        ca.OP_FABS: Form("ABS({0})"),
        ca.OP_LOG: Form("LN({0})"),
        ca.OP_TANH: Form(_TANH),
        ca.OP_FLOOR: Form(f"({_WHOLE} - SEL({_WHOLE} > {{0}}, 0.0, 1.0))"),
        ca.OP_IF_ELSE_ZERO: Form("SEL({0}, 0.0, {1})"),
        SELECT: Form("SEL({0}, {2}, {1})"),
        ca.OP_SQRT: Form("SQRT({0})"),
        ca.OP_EXP: Form("EXP({0})"),
        ca.OP_SIN: Form("SIN({0})"),
        ca.OP_COS: Form("COS({0})"),
    },
    infinity="1.0E38",
    truth=Form("SEL({0}, 0.0, 1.0)"),
    condition=Form("{0} <> 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


def write_structured_text(program: ControllerProgram, header: Header) -> dict[str, str]:
    """One function block; its text by the file's name."""
    page, name = write_page(program, STRUCTURED_TEXT, Places(), header.own_names), header.name
    values = [*page.coefficients, *page.start_locals, *page.locals]
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
    lines += _assign({a.name: a.text for a in page.coefficients})
    lines += ["", "IF restart OR NOT runs THEN"]
    started = {a.name: a.text for a in (*page.start_locals, *page.start)}
    lines += [f"    {line}" for line in _assign(started)]
    lines += ["    runs := TRUE;", "END_IF;", "", *_assign({a.name: a.text for a in page.locals}), ""]
    lines += [*_assign({**page.outputs, **page.states}), "END_FUNCTION_BLOCK"]
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
