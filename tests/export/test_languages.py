"""An exported controller equals the library's closed loop, sample by sample, in every language."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.pid import AntiWindup
from pneuopt.export.header import make_header
from pneuopt.export.languages import write_c99
from pneuopt.export.program import controller_program
from pneuopt.export.python_class import write_python
from pneuopt.export.reference_run import ReferenceRun
from pneuopt.export.structured_text import write_structured_text
from problems.shared.random_controllers import COUNT, run_library
from problems.shared.structured_text_run import FunctionBlock

GCC = shutil.which("gcc") or shutil.which("clang")
needs_gcc = pytest.mark.skipif(GCC is None or os.name == "nt", reason="no C compiler on the path")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Wconversion", "-Wshadow", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
TOLERANCE = 1e-12
QUICK = 0  # the seed whose structured text is short: blark takes seconds for a long one


def written(seed: int, language: str) -> tuple[dict[str, str], ReferenceRun, float]:
    run = run_library(seed)
    program = controller_program(run.loop, run.parameters, run.centre)
    header = make_header("pid_x", run.loop, run.parameters, run.centre, ["of tuned.toml"])
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
    given = [v.name for v in controller_program(one.loop, one.parameters, one.centre).inputs]
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
