"""An exported controller equals the library's loop in every language, whatever it is called and at faulty samples."""

import json
import math
import os
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, AntiWindup
from pneuopt.dynamics.system import names
from pneuopt.export.identifiers import RESERVED
from pneuopt.export.languages import (
    C99,
    JAVASCRIPT,
    PYTHON,
    STRUCTURED_TEXT,
    Language,
    ReferenceRun,
    export_controller,
    make_reference_run,
    write_c99,
    write_loop_javascript,
    write_python,
    write_structured_text,
)
from pneuopt.export.program import controller_program
from pneuopt.export.writer import Syntax, make_header
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from problems.demo.export_controllers import files_of
from problems.demo.exported_names import Counts, check_code, check_text
from problems.demo.faulty_samples import (
    Case,
    Faulty,
    Tally,
    compile_c,
    draw_case,
    draw_sequence,
    draw_signals,
    judge,
    run_c,
    run_program,
    run_python,
    run_structured_text,
)
from problems.demo.faulty_samples import (
    run_library as library_run,
)
from problems.shared.exported_words import LITERAL, wrong_literals, wrong_names
from problems.shared.hostile_names import FORBIDDEN, OWN_WORDS, hostile_run
from problems.shared.random_controllers import COUNT, run_library
from problems.shared.structured_text_run import FunctionBlock

GCC = shutil.which("gcc") or shutil.which("clang")
needs_gcc = pytest.mark.skipif(GCC is None or os.name == "nt", reason="no C compiler on the path")
needs_gcc_by_name = pytest.mark.skipif(shutil.which("gcc") is None or os.name == "nt", reason="no gcc on the path")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Wconversion", "-Wshadow", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
TOLERANCE = 1e-12
QUICK = 0  # the seed whose structured text is short: blark takes seconds for a long one


def written(seed: int, language: str) -> tuple[dict[str, str], ReferenceRun, float]:
    run = run_library(seed)
    program = controller_program(run.loop.controller, run.parameters, run.centre)
    header = make_header("pid_x", run.loop.controller, run.parameters, run.centre, ["of tuned.toml"])
    given = ReferenceRun(run.inputs, run.outputs)
    if language == "c":
        return write_c99(program, header, given), given, run.centre
    return (write_python if language == "python" else write_structured_text)(program, header), given, run.centre


def largest_difference(found: list[float], run: ReferenceRun) -> float:
    return float(np.max(np.abs(np.array(found) - run.outputs)) / np.max(np.abs(run.outputs)))


@needs_gcc
@pytest.mark.parametrize("seed", range(COUNT))
def test_c_equals_the_loop_and_is_clean(seed: int, tmp_path: Path) -> None:
    files, _, _ = written(seed, "c")
    for name, text in files.items():
        (tmp_path / name).write_text(text, "ascii")
    sources = [str(tmp_path / name) for name in files if name.endswith(".c")]
    program = tmp_path / "run"
    built = subprocess.run(
        [str(GCC), *STRICT, *SANITIZERS, *sources, "-lm", "-o", str(program)], capture_output=True, check=False
    )
    assert built.returncode == 0, built.stderr.decode()
    run = subprocess.run([str(program)], capture_output=True, check=False, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "malloc" not in files["pid_x.c"]
    assert [line for line in files["pid_x.c"].splitlines() if line.startswith("#include <")] == ["#include <math.h>"]


@pytest.mark.parametrize("seed", range(COUNT))
def test_python_equals_the_loop(seed: int) -> None:
    files, run, centre = written(seed, "python")
    space: dict[str, type] = {}
    exec(compile(files["pid_x.py"], "pid_x.py", "exec"), space)
    controller = space["PidX"]()
    controller.start(*run.inputs[0].tolist(), centre)
    assert largest_difference([controller.step(*row) for row in run.inputs.tolist()], run) <= TOLERANCE


@pytest.mark.parametrize(
    "seed", [seed if seed == QUICK else pytest.param(seed, marks=pytest.mark.slow) for seed in range(COUNT)]
)
def test_structured_text_parses_runs_and_equals_the_loop(seed: int) -> None:
    files, run, centre = written(seed, "st")
    one = run_library(seed)
    block = FunctionBlock(files["pid_x.st"])
    block.variables["start_output"] = centre
    given = [v.name for v in controller_program(one.loop.controller, one.parameters, one.centre).inputs]
    found = [block.call(**dict(zip(given, row, strict=True)))["output"] for row in run.inputs.tolist()]
    assert largest_difference(found, run) <= TOLERANCE


def test_every_form_and_part_is_among_the_random_controllers() -> None:
    loops = [run_library(seed).loop for seed in range(COUNT)]
    parts = {type(c).__name__ for loop in loops for c in loop.compensators}
    assert parts == {kind.__name__ for kind in COMPENSATORS.values()}
    assert {loop.pid.form.value for loop in loops} == {"parallel", "standard", "series"}
    assert {str(type(loop.sensor).__name__) for loop in loops} == {"NoneType", "Encoder", "SensorLag"}
    assert {(loop.dither.waveform.value, loop.dither.analogue) for loop in loops if loop.dither} == {
        ("sine", False), ("triangle", False), ("sine", True)
    }  # fmt: skip
    for option in ("delay", "dead_band", "limits", "reset"):
        assert {bool(getattr(loop.pid, option)) for loop in loops} == {False, True}
    assert {loop.pid.anti_windup for loop in loops if loop.pid.limits} == set(AntiWindup)
    assert {loop.feedforward is None for loop in loops} == {False, True}
    assert {type(loop.sensor).__name__ for loop in loops if loop.outer} == {"NoneType", "Encoder"}
    scheduled = [(loop.pid_signal.name, loop.schedule.load, bool(loop.outer)) for loop in loops if loop.schedule]
    assert [set(kinds) for kinds in zip(*scheduled, strict=True)] == [
        {"position", "speed"}, {None, 5.0}, {False, True}
    ]  # fmt: skip


SOME = 10  # seeds that a fast run looks at; the script takes hundreds
LOOP = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3))


@pytest.mark.parametrize("seed", range(SOME))
def test_names_and_literals_of_a_controller_are_taken_by_every_compiler(seed: int) -> None:
    text = files_of(run_library(seed))[2]["pid_x.st"]
    assert wrong_names(text) == []
    assert wrong_literals(text) == []


@needs_gcc_by_name
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


@needs_gcc_by_name
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
    with pytest.raises(InputError, match=r"pid\.upper"):
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
    with pytest.raises(InputError, match=f"--name {name}") as refused:
        export_controller(LOOP, LOOP.parameters, kind, name=name)
    free = str(refused.value).rpartition(" ")[2]
    assert export_controller(LOOP, LOOP.parameters, kind, name=free)


def test_a_value_on_the_way_is_not_called_as_the_block() -> None:
    run = run_library(0)
    program = controller_program(run.loop.controller, run.parameters, run.centre)
    text = write_structured_text(program, make_header("v1", run.loop.controller, run.parameters, run.centre, []))[
        "v1.st"
    ]
    assert wrong_names(text) == []


def test_names_are_alike_in_every_language() -> None:
    program = controller_program(LOOP.controller, LOOP.parameters)
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
    program = controller_program(LOOP.controller, LOOP.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 30.0}))
    header = make_header("axis", LOOP.controller, LOOP.parameters, 0.0, [])
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


needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="node runs the page's script")


@cache
def drawn(seed: int) -> tuple[Case, Faulty]:
    case = draw_case(seed)
    return case, draw_sequence(case, 7000 + seed)


def sources(case: Case, language: str) -> dict[str, str]:
    header = make_header("pid_x", case.loop.controller, case.parameters, case.centre, [])
    if language == "c":
        return write_c99(case.program, header, make_reference_run(case.program))
    return {"python": write_python, "st": write_structured_text}[language](case.program, header)


def restarted(case: Case, length: int = 40) -> Faulty:
    """Good samples, with restarts from other outputs than its own, the setpoint away from the measurement."""
    given = draw_signals(case, 1, length)
    return given._replace(restarts={0: case.centre, 12: case.centre + 0.7, 29: case.centre - 1.3})


def test_the_sequences_hold_every_kind_of_fault() -> None:
    given = [drawn(seed)[1] for seed in range(COUNT)]
    bad = np.concatenate([g.inputs[g.is_bad].ravel() for g in given])
    assert {np.isnan(bad).any(), (bad == np.inf).any(), (bad == -np.inf).any(), (bad == 1e31).any()} == {True}
    assert any(np.isnan(output) for g in given for output in g.restarts.values())
    assert any(g.is_bad[k] for g in given for k in g.restarts)
    assert {bool(d[0].loop.pid.delay) for d in map(drawn, range(COUNT))} == {False, True}


@pytest.mark.parametrize("seed", range(COUNT))
def test_python_and_the_program_do_as_the_loop_and_as_promised(seed: int) -> None:
    case, given = drawn(seed)
    runs = {"library": library_run(case, given), "program": run_program(case, given)}
    runs["python"] = run_python(sources(case, "python")["pid_x.py"], given)
    tally = Tally()
    judge(case, given, runs, tally)
    assert max(tally.differences.values()) <= TOLERANCE
    assert tally.counts == {"sequences": 1, "flags": 0, "no_number": 0}


@needs_gcc_by_name
@pytest.mark.parametrize("seed", range(0, COUNT, 3))
def test_c_does_so_too_and_is_clean(seed: int, tmp_path: Path) -> None:
    case, given = drawn(seed)
    assert compile_c(case, sources(case, "c"), tmp_path)
    found, clean = run_c(tmp_path, given)
    assert clean
    tally = Tally()
    judge(case, given, {"library": library_run(case, given), "c": found}, tally)
    assert max(tally.differences.values()) <= TOLERANCE
    assert tally.counts["flags"] == 0


def test_structured_text_does_so_too() -> None:
    case = drawn(QUICK)[0]
    block = FunctionBlock(sources(case, "st")["pid_x.st"])
    for given in (draw_sequence(case, 3, 45), restarted(case)):
        tally = Tally()
        runs = {"library": library_run(case, given), "st": run_structured_text(block, case, given)}
        judge(case, given, runs, tally)
        assert max(tally.differences.values()) <= TOLERANCE
        assert tally.counts["flags"] == 0


def test_a_restart_that_is_ignored_shows() -> None:
    """What the comparisons above would find of a language whose start does nothing, unless the output stays clipped."""
    shown = []
    for seed in range(COUNT):
        case = drawn(seed)[0]
        given = restarted(case)
        heard, ignored = (run_program(case, g)[0] for g in (given, given._replace(restarts={0: case.centre})))
        shown.append(bool(np.max(np.abs(heard - ignored)) > 1e-3))
    assert shown[QUICK]
    assert sum(shown) >= COUNT - 2


@pytest.mark.parametrize("seed", range(COUNT))
def test_a_restart_begins_at_the_output_so_far(seed: int) -> None:
    """Of the PID's own command; what is added to it, and the integral's first step, come at once."""
    case, given = drawn(seed)[0], restarted(drawn(seed)[0])
    runs = {
        "library": library_run(case, given),
        "python": run_python(sources(case, "python")["pid_x.py"], given),
    }
    assert np.max(np.abs(runs["python"][0] - runs["library"][0])) <= TOLERANCE * np.max(np.abs(runs["library"][0]))
    for k, output in given.restarts.items():
        first = case.program.start([*given.inputs[k], output], case.program.values)
        results = case.program.step(given.inputs[k], first, case.program.values)
        terms = dict(zip(case.program.terms, results[1].full().ravel(), strict=True))
        added = [terms.get(f"{n}_term", 0.0) for n in ("feedforward", "compensation", "dither")]
        begun = dict(zip((v.origin for v in case.program.states), first.full().ravel(), strict=True))
        grown = terms["integral_term"] - begun["pid.integral"]
        offset = case.value.get("dither_offset", 0.0) if "dither_term" not in terms else 0.0
        bare = terms["unlimited"] - sum(added) - grown - offset
        assert bare == pytest.approx(output - case.centre, abs=1e-9)


@needs_node
@pytest.mark.parametrize("seed", [1, 2, 5])
def test_the_pages_javascript_does_so_too(seed: int, tmp_path: Path) -> None:
    """The loop's update from one sample to the next, as the page computes it."""
    loop, p = drawn(seed)[0].loop, drawn(seed)[0].loop.parameter_vector(drawn(seed)[0].parameters)
    g, order = np.random.default_rng(seed), names(loop.states)
    x = g.normal(size=(12, len(order)))
    x[:, [order.index(n) for n in order if n.startswith("pressure")]] += 5e5
    x[:, order.index("pid.bad_samples")] = np.arange(12)
    u = g.normal(size=(12, len(loop.inputs)))
    u[::2, 0], u[9, 0] = np.nan, np.inf
    expected = np.array([loop.update(0.1, *each, p).full().ravel() for each in zip(x, u, strict=True)])
    values = [[[str(v) for v in row] for row in rows] for rows in (x, u, [p])]
    script = f"""{write_loop_javascript(loop)}
const read = (rows) => rows.map((row) => row.map((v) => Number(v.replace("inf", "Infinity"))));
const [x, u, [p]] = {json.dumps(values)}.map(read);
const found = x.map(() => []);
x.forEach((row, k) => makeLoop(p).update(0.1, row, u[k], found[k]));
console.log(JSON.stringify(found.map((row) => row.map(String))));"""
    (tmp_path / "run.js").write_text(script, "utf-8")
    done = subprocess.run(["node", tmp_path / "run.js"], capture_output=True, text=True, check=True)
    found = np.array([[float(v) for v in row] for row in json.loads(done.stdout)])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert np.isfinite(found).all()
