"""Exported controllers and the library at samples that are no number, and at restarts: they do the same."""

import json
import os
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pneuopt.dynamics.system import names
from pneuopt.export.header import make_header
from pneuopt.export.javascript import write_loop_javascript
from pneuopt.export.languages import write_c99
from pneuopt.export.python_class import write_python
from pneuopt.export.reference_run import make_reference_run
from pneuopt.export.structured_text import write_structured_text
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
    run_library,
    run_program,
    run_python,
    run_structured_text,
)
from problems.shared.random_controllers import COUNT
from problems.shared.structured_text_run import FunctionBlock

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="node runs the page's script")
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None or os.name == "nt", reason="no gcc on the path")
TOLERANCE = 1e-12
QUICK = 0  # the seed whose structured text is short: blark takes seconds for a long one


@cache
def drawn(seed: int) -> tuple[Case, Faulty]:
    case = draw_case(seed)
    return case, draw_sequence(case, 7000 + seed)


def sources(case: Case, language: str) -> dict[str, str]:
    header = make_header("pid_x", case.loop, case.parameters, case.centre, [])
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
    runs = {"library": run_library(case, given), "program": run_program(case, given)}
    runs["python"] = run_python(sources(case, "python")["pid_x.py"], given)
    tally = Tally()
    judge(case, given, runs, tally)
    assert max(tally.differences.values()) <= TOLERANCE
    assert tally.counts == {"sequences": 1, "flags": 0, "no_number": 0}


@needs_gcc
@pytest.mark.parametrize("seed", range(0, COUNT, 3))
def test_c_does_so_too_and_is_clean(seed: int, tmp_path: Path) -> None:
    case, given = drawn(seed)
    assert compile_c(case, sources(case, "c"), tmp_path)
    found, clean = run_c(tmp_path, given)
    assert clean
    tally = Tally()
    judge(case, given, {"library": run_library(case, given), "c": found}, tally)
    assert max(tally.differences.values()) <= TOLERANCE
    assert tally.counts["flags"] == 0


def test_structured_text_does_so_too() -> None:
    case = drawn(QUICK)[0]
    block = FunctionBlock(sources(case, "st")["pid_x.st"])
    for given in (draw_sequence(case, 3, 45), restarted(case)):
        tally = Tally()
        runs = {"library": run_library(case, given), "st": run_structured_text(block, case, given)}
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
    runs = {"library": run_library(case, given), "python": run_python(sources(case, "python")["pid_x.py"], given)}
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
