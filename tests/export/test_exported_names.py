"""Exports of any plant compile, whatever it is called: names, literals, results; and the block's own name is free."""

import math
import os
import re
import shutil

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.export.header import make_header
from pneuopt.export.identifiers import RESERVED
from pneuopt.export.javascript import JAVASCRIPT, write_loop_javascript
from pneuopt.export.languages import C99
from pneuopt.export.program import controller_program
from pneuopt.export.python_class import PYTHON
from pneuopt.export.structured_text import STRUCTURED_TEXT, write_structured_text
from pneuopt.export.targets import Language, export_controller
from pneuopt.export.writer import Syntax
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from problems.demo.export_controllers import files_of
from problems.demo.exported_names import Counts, check_code, check_text
from problems.shared.exported_words import LITERAL, wrong_literals, wrong_names
from problems.shared.hostile_names import FORBIDDEN, OWN_WORDS, hostile_run
from problems.shared.random_controllers import run_library
from problems.shared.structured_text_run import FunctionBlock

SOME = 10  # seeds that a fast run looks at; the script takes hundreds
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None or os.name == "nt", reason="no C compiler on the path")
LOOP = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3))


@pytest.mark.parametrize("seed", range(SOME))
def test_names_and_literals_of_a_controller_are_taken_by_every_compiler(seed: int) -> None:
    text = files_of(run_library(seed))[2]["pid_x.st"]
    assert wrong_names(text) == []
    assert wrong_literals(text) == []


@needs_gcc
@pytest.mark.parametrize("seed", range(SOME))
def test_a_plant_of_hostile_names_is_exported_as_the_loop_is(seed: int) -> None:
    run, counts = hostile_run(seed, samples=100), Counts()
    c, python, text = files_of(run)
    check_code(run, c, python, counts)
    check_text(run, text["pid_x.st"], counts)
    assert (counts.names, counts.literals, counts.not_compiled) == (0, 0, 0)
    assert max(counts.differences.values()) <= 1e-12


ODD = ["(*", "*)", "*/", "//", 'q"""', "a\nb", "$n", "??/", "x;y", "\\", "0.5", "é"]
WORDS = [n for n in dict.fromkeys([*OWN_WORDS, *ODD]) if n not in FORBIDDEN]


@needs_gcc
@pytest.mark.parametrize("words", [WORDS[k : k + 6] for k in range(0, len(WORDS), 6)], ids=" ".join)
def test_a_word_names_a_reading_a_parameter_and_a_state_at_once(words: list[str]) -> None:
    run, counts = hostile_run(3, 50, words), Counts()
    c, python, text = files_of(run)
    check_code(run, c, python, counts)
    assert counts.not_compiled == 0
    assert max(counts.differences.values()) <= 1e-12
    assert wrong_names(text["pid_x.st"]) == []


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("integral : LREAL;", ["integral"]),
        ("kp : LREAL; Kp : LREAL;\nKp : LREAL;", ["kp"]),
        ("a__b : LREAL;", ["a__b"]),
        ("x_ : LREAL;", ["x_"]),
        ("x : LREAL := y;", ["y"]),
        ("x : LREAL := 5e-05;", []),
    ],
)
def test_the_check_finds_a_wrong_name(line: str, wrong: list[str]) -> None:
    assert wrong_names(f"FUNCTION_BLOCK b1\nVAR\n{line}\nEND_VAR\nEND_FUNCTION_BLOCK") == wrong


@pytest.mark.parametrize("number", ["5e-05", "1", "1.0E308", "3.5E38", "1.0E-38", "1.0e5", "1.", "1E5"])
def test_the_check_finds_a_wrong_literal(number: str) -> None:
    assert wrong_literals(f"x := 0.0 + {number};") == [number]


@pytest.mark.parametrize("syntax", [C99, PYTHON, JAVASCRIPT, STRUCTURED_TEXT], ids=["c", "python", "js", "st"])
@pytest.mark.parametrize("value", [0.0, 5e-5, -5e-5, 1e16, -1e22, 0.1, 1 / 3, 1e-37, np.float64(2e-7), 3])
def test_a_literal_is_the_number(syntax: Syntax, value: float) -> None:
    text = syntax.literal(value)
    assert float(text) == value
    assert syntax is not STRUCTURED_TEXT or LITERAL.fullmatch(text.removeprefix("-"))


@pytest.mark.parametrize(
    ("value", "text"),
    [(math.inf, "1.0E38"), (-math.inf, "-1.0E38"), (5e-324, "1.0E-37"), (-1e-300, "-1.0E-37"), (0.0, "0.0")],
)
def test_structured_text_has_no_literal_that_is_no_real(value: float, text: str) -> None:
    assert STRUCTURED_TEXT.literal(value) == text


def test_a_number_too_large_for_structured_text_is_refused_by_its_name() -> None:
    given = LOOP.parameters.with_values({"pid.upper": 1e39})
    with pytest.raises(InputError, match=r"pid\.upper of 1e\+39"):
        export_controller(LOOP, given, Language.STRUCTURED_TEXT)
    assert "1e+39" in export_controller(LOOP, given, Language.C)["controller.c"]


def test_a_short_sample_time_has_the_literals_form_everywhere() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=5e-5))
    files = {n: t for kind in Language for n, t in export_controller(loop, loop.parameters, kind).items()}
    assert "SAMPLE_TIME : LREAL := 5.0E-5;" in files["controller.st"]
    assert "SAMPLE_TIME 5e-05" in files["controller.c"]
    assert "SAMPLE_TIME = 5e-05" in files["controller.py"]


@pytest.mark.parametrize("kind", Language)
@pytest.mark.parametrize(
    "name", ["pid", "Integral", "int", "lambda", "class", "output", "Kp", "con", "math", "restart"]
)
def test_a_block_that_is_called_as_something_else_is_refused_with_a_name_that_goes(kind: Language, name: str) -> None:
    with pytest.raises(InputError, match=f"--name {name}: is .*take another, as --name ") as refused:
        export_controller(LOOP, LOOP.parameters, kind, name=name)
    free = str(refused.value).rpartition(" ")[2]
    assert export_controller(LOOP, LOOP.parameters, kind, name=free)


def test_a_value_on_the_way_is_not_called_as_the_block() -> None:
    run = run_library(0)
    program = controller_program(run.loop, run.parameters, run.centre)
    text = write_structured_text(program, make_header("v1", run.loop, run.parameters, run.centre, []))["v1.st"]
    assert wrong_names(text) == []


def test_names_are_alike_in_every_language() -> None:
    program = controller_program(LOOP, LOOP.parameters)
    files = {n: t for kind in Language for n, t in export_controller(LOOP, LOOP.parameters, kind).items()}
    for v in (*program.parameters, *program.inputs, *program.states, *program.outputs):
        assert all(v.name in files[f"controller.{end}"] for end in ("h", "st", "py"))
    assert {"pid.integral": "pid_integral"}.items() <= {v.origin: v.name for v in program.states}.items()


@pytest.mark.parametrize("seed", range(3))
def test_the_pages_script_has_no_reserved_or_doubled_name(seed: int) -> None:
    script = write_loop_javascript(hostile_run(seed, samples=1).loop)
    head, _, body = script.partition("function makeLoop(p) {")
    assert head.isascii()
    body = body.partition("\n}\n")[0]
    outside = re.findall(r"^  const (\S+) =", body, re.M)
    for text in re.split(r"^    (?=rates|update)", body, flags=re.M):
        names = [*outside, *re.findall(r"^      const (\S+) =", text, re.M)]
        assert len(set(names)) == len(names)
        assert not RESERVED["a word of JavaScript"] & {n.casefold() for n in names}
        assert not {"t", "x", "u", "p", "dx", "y", "after", "LOOP", "makeLoop"} & set(names)


def test_restart_begins_a_block_anew() -> None:
    program = controller_program(LOOP, LOOP.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 30.0}))
    header = make_header("axis", LOOP, LOOP.parameters, 0.0, [])
    text = write_structured_text(program, header)["axis.st"]
    block, fresh = FunctionBlock(text), FunctionBlock(text)
    rows = np.random.default_rng(0).normal(size=(20, 2)).tolist()
    for setpoint, measured in rows:
        block.call(setpoint=setpoint, measured=measured, restart=False)
    before = block.call(setpoint=1.0, measured=0.0, restart=False)["output"]
    again = block.call(setpoint=1.0, measured=0.0, restart=True, start_output=0.25)["output"]
    assert again == fresh.call(setpoint=1.0, measured=0.0, start_output=0.25)["output"]
    assert again != before
    for setpoint, measured in rows:
        own = {"setpoint": setpoint, "measured": measured, "restart": False}
        assert block.call(**own)["output"] == fresh.call(**own)["output"]
