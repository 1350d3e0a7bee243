"""The controller as a Python class that imports nothing but `math`."""

import textwrap

import casadi as ca

from pneuopt.export.header import Header, comment_text
from pneuopt.export.page import Places, write_page
from pneuopt.export.program import CENTRE, ControllerProgram, Variable
from pneuopt.export.writer import ARITHMETIC, COMPARED, SELECT, Binding, Form, Syntax, infix, unary_calls

PYTHON = Syntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("==", Binding.COMPARISON),
        ca.OP_NE: infix("!=", Binding.COMPARISON),
        ca.OP_AND: Form("({0} and {1})", needs=COMPARED),
        ca.OP_OR: Form("({0} or {1})", needs=COMPARED),
        ca.OP_NOT: Form("(not ({0}))"),
        ca.OP_FMIN: Form("min({0}, {1})"),
        ca.OP_FMAX: Form("max({0}, {1})"),
        ca.OP_FABS: Form("abs({0})"),
        ca.OP_IF_ELSE_ZERO: Form("({1} if {0} else 0.0)"),
        SELECT: Form("({1} if {0} else {2})"),
        **unary_calls("sqrt exp log sin cos tan tanh floor ceil", "math.{}"),
    },
    infinity="math.inf",
    truth=Form("(1.0 if {0} else 0.0)"),
    condition=Form("{0} != 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


def write_python(program: ControllerProgram, header: Header) -> dict[str, str]:
    """One module with one class; its text by the file's name."""
    page = write_page(program, PYTHON, Places("self.{}", "self.{}", "self.{}"), header.own_names)
    name = "".join(part[:1].upper() + part[1:] for part in header.name.split("_"))
    signature = ", ".join(f"{v.name}: float" for v in program.inputs)
    begin = ", ".join(f"{v.name}: float" for v in program.start_inputs[:-1])
    period = PYTHON.literal(program.sample_time)
    lines = ['"""', *header.lines, '"""', "", "import math", "", f"SAMPLE_TIME = {period}  # s", ""]
    lines += [
        "",
        f"class {name}:",
        '    """The controller: start it, then call step once a sample.',
        "",
        "    Parameters",
    ]
    lines += ["    ----------"]
    for v in program.parameters:
        lines += textwrap.wrap(comment_text(_told(v)), 110, initial_indent="    ", subsequent_indent="        ")
    lines += ['    """', "", "    def __init__(", "        self,", "        *,"]
    lines += [f"        {v.name}: float = {PYTHON.literal(v.value)}," for v in program.parameters]
    lines += ["    ) -> None:", *(f"        self.{v.name} = {v.name}" for v in program.parameters)]
    lines += [_first_value(v) for v in (*program.states, *program.outputs)]
    zeros = ", ".join("0.0" for _ in program.start_inputs[:-1])
    lines += ["        self.prepare()", f"        self.start({zeros})", ""]
    lines += ["    def prepare(self) -> None:", '        """Take over parameters that were changed."""']
    lines += [f"        self.{a.name} = {a.text}" for a in page.coefficients]
    last = program.start_inputs[-1]
    usual = f"self.{program.originals[CENTRE].name}" if CENTRE in program.originals else "0.0"
    lines += ["", f"    def start(self, {begin}, {last.name}: float | None = None) -> None:"]
    lines += [f'        """Begin, or go on without a bump from {last.name}: {last.meaning}."""']
    lines += [f"        {last.name} = {usual} if {last.name} is None else {last.name}"]
    lines += [f"        {a.name} = {a.text}" for a in page.start_locals]
    lines += [f"        self.{a.name} = {a.text}" for a in page.start]
    out = program.outputs[0]
    lines += [
        "",
        f"    def step(self, {signature}) -> float:",
        f'        """Compute a sample: {out.meaning} [{comment_text(out.unit)}]."""',
    ]
    lines += [f"        {a.name} = {a.text}" for a in page.locals]
    lines += [f"        self.{n} = {text}" for n, text in {**page.outputs, **page.states}.items()]
    return {f"{header.name}.py": "\n".join([*lines, f"        return self.{out.name}"]) + "\n"}


def _first_value(v: Variable) -> str:
    return f"        self.{v.name} = {'False' if v.is_flag else '0.0'}  # {comment_text(_told(v))}"


def _told(v: Variable) -> str:
    return f"{v.name} [{v.unit}]: {v.meaning}" if v.meaning else f"{v.name} [{v.unit}]"
