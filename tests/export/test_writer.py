"""The walk over a graph: its text computes what the graph computes, in its order, with divisions where needed."""

import ast
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.compensators import FrictionFeedforward
from pneuopt.control.controller import PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, Form
from pneuopt.export.languages import PYTHON, Language, export_controller
from pneuopt.export.writer import Names, Written, comment_text, make_header, write_expressions
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.units import write_value
from problems.shared.structured_text_run import FunctionBlock

a, b, c = (ca.SX.sym(n) for n in "abc")
EXPRESSIONS = [
    a - (b - c), a - b - c, a - (b + c), a / (b / c), a / b / c, a * (b / c), -(a + b) * c, -a - -b, (a * b) ** 2,
    (a - b) * (a + b), 2 * (a + b), 1 / (a + b), ca.if_else(a > b, a - b, c), (a < b) * c, ca.fmin(ca.fmax(a, -b), c),
    ca.if_else(ca.logic_and(a > 0, b < c), a, b + c), ca.if_else(ca.logic_not(a > b), 1, ca.fabs(c)), (a + b) + (c + a),
]  # fmt: skip


def write(expression: ca.SX, parameters: frozenset[str] = frozenset()) -> Written:
    function = ca.Function("f", [ca.vertcat(a, b, c)], [expression])
    return write_expressions(function, Names([["a", "b", "c"]], ["y"], parameters=parameters), PYTHON)


def value(written: Written, given: dict[str, float]) -> float:
    space = dict(given)
    for line in (*written.coefficients, *written.statements):
        space[line.name] = eval(line.text, {"math": __import__("math")}, space)
    return float(eval(written.results["y"], {"math": __import__("math")}, space))


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
@pytest.mark.parametrize("parameters", [frozenset(), frozenset("b"), frozenset("bc")], ids=len)
def test_the_text_is_the_expression(expression: ca.SX, parameters: frozenset[str]) -> None:
    function = ca.Function("f", [ca.vertcat(a, b, c)], [expression])
    for given in np.random.default_rng(0).normal(size=(5, 3)):
        own = value(write(expression, parameters), dict(zip("abc", given.tolist(), strict=True)))
        assert own == pytest.approx(float(function(given)), rel=1e-14)


def test_a_division_by_a_parameter_is_a_factor_but_not_before_a_jump() -> None:
    assert "/" not in write(a / b, frozenset("b")).results["y"]
    exact = write(ca.floor(a / b), frozenset("b"))
    assert value(exact, {"a": 49.0, "b": 49.0, "c": 0.0}) == 1.0
    assert 49.0 * (1 / 49.0) < 1.0  # which a factor would have made 0


HOSTILE = [
    "a */ int evil; /*",
    "b *) evil := 1; (*",
    'c """\nimport os\n"""',
    "d \\\nint evil;",
    "e ??/\n */ evil",
    "f *\n/ evil *\\/ evil",
    "g **//** evil **)) ((**",
    "h '''{$crlf} <script>evil</script> \x00\x1b[2J\u2028evil",
    "i \\u002a/ evil",
    "j höher, 軸, Ω évil",
]
LOOP = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3, limits=False))


@pytest.mark.parametrize("text", HOSTILE)
def test_a_hostile_text_ends_no_comment(text: str) -> None:
    plain = comment_text(text)
    assert plain.isascii()
    assert plain.isprintable()
    assert not any(mark in plain for mark in ("*/", "/*", "(*", "*)", '"""', "'''", "\\", "??", "//"))


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler on the path")
def test_hostile_texts_leave_the_code_as_it_is(tmp_path: Path) -> None:
    plain = {n: t for kind in Language for n, t in export_controller(LOOP, LOOP.parameters, kind).items()}
    hostile = {n: t for k in Language for n, t in export_controller(LOOP, LOOP.parameters, k, origin=HOSTILE).items()}
    for files, folder in ((plain, tmp_path / "plain"), (hostile, tmp_path / "hostile")):
        folder.mkdir()
        for name, text in files.items():
            (folder / name).write_text(text, "ascii")
    built = [
        subprocess.run(["gcc", "-E", "-P", "controller.c"], cwd=tmp_path / n, capture_output=True, check=True).stdout
        for n in ("plain", "hostile")
    ]
    assert built[0] == built[1]
    trees = [ast.parse(files["controller.py"]) for files in (plain, hostile)]
    assert ast.dump(trees[0].body[1]) == ast.dump(trees[1].body[1])
    assert [len(tree.body) for tree in trees] == [len(trees[0].body)] * 2


def test_hostile_texts_leave_structured_text_as_it_is() -> None:
    text = export_controller(LOOP, LOOP.parameters, Language.STRUCTURED_TEXT, origin=HOSTILE)["controller.st"]
    assert "evil" in text
    assert not any("evil" in name for name in FunctionBlock(text).variables)


@pytest.mark.parametrize("name", ["a b", "1a", "x*/", "", "a__b", "ä", "a" * 41, "if\n", "_x"])
def test_a_name_that_is_no_identifier_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="--name"):
        export_controller(LOOP, LOOP.parameters, Language.C, name=name)


def test_the_gains_stand_there_in_every_form() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3, form=Form.STANDARD, limits=False))
    given = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ti": 0.5, "pid.Td": 0.05, "pid.N": 10.0})
    text = export_controller(loop, given, Language.C)["controller.h"]
    assert "parallel: Kp = 2 V*s/m, Ki = 4 V/m, Kd = 0.1 V*s^2/m, Tf = 0.005 s" in text
    assert "standard: Kp = 2 V*s/m, Ti = 0.5 s, Td = 0.05 s, N = 10" in text
    assert "series: K = " in text


@pytest.mark.parametrize("delay", [0, 1])
def test_a_header_says_that_the_design_counts_on_a_delay(delay: int) -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3, delay=delay, limits=False))
    for kind in Language:
        first = next(iter(export_controller(loop, loop.parameters, kind).values()))
        assert ("The design counts on one sample from reading to acting." in first) == bool(delay)


@pytest.mark.parametrize("kind", Language)
def test_files_are_ascii_whatever_their_origin_says(kind: Language) -> None:
    files = export_controller(LOOP, LOOP.parameters, kind, origin=["Größe µ, 図"])
    assert all(text.isascii() for text in files.values())


@pytest.mark.parametrize("language", Language)
def test_a_header_names_every_number_of_the_controller(language: Language) -> None:
    plant = ForceDrive(Stribeck()).system()
    loop = ClosedLoop(
        plant,
        PID(sample_time=1e-3),
        Dither(frequency=100.0),
        measured="position",
        outer=PositionLoop(),
        compensators=(FrictionFeedforward(),),
    )
    numbers = {n: 0.011 + 0.001 * k for k, n in enumerate(loop.parameters) if not n.startswith("pid.")}
    numbers = {n: v for n, v in numbers.items() if n not in plant.parameters}
    files = export_controller(loop, loop.parameters.with_values(numbers), language)
    header = " ".join(next(text for name, text in files.items() if "test" not in name)[:6000].split())
    assert len({n.partition(".")[0] for n in numbers}) == 3
    for n, value in numbers.items():
        section, _, name = n.partition(".")
        assert f"{section}: " in header
        assert f"{name} = {write_value(value, loop.parameters[n].unit)}" in header


@pytest.mark.parametrize(
    ("Ki", "told"), [(0.0, "the output so far passes"), (50.0, "the setpoint counts as if it moved")]
)
def test_the_header_tells_of_starts_and_faults(Ki: float, told: str) -> None:
    """With their time, count and safe output, on the wire and within the limits."""
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-2))
    values = {"pid.Ki": Ki, "pid.Tt": 0.25, "pid.lower": -5.0, "pid.upper": 5.0}
    p = loop.parameters.with_values({**values, "pid.fault_samples": 7.0, "pid.fault_output": -9.0})
    text = " ".join(make_header("pid", loop.controller, p, 5.0, []).lines)
    assert told in text
    assert "a time constant of 250 ms" in text
    assert "After 7 bad samples in a row (fault_samples), 70 ms, the output goes to 0 V (fault_output)" in text
