"""Exported controllers: are they the loop's, what do they cost, and what is a design worth in a maker's PID block?

    python problems/demo/export_controllers.py [--json FILE]

Twenty random sampled controllers of every form, with every part that can be tuned, as C99, structured text and a Python
class, beside the library's own closed loop over 300 random samples. Rows difference.*: the largest difference of any
output over the largest output of that run. `c.not_clean`: how many are not compiled without a warning under -Wall
-Wextra -pedantic -Wconversion, or are stopped by the address or undefined-behaviour sanitizer. The structured text is
parsed by blark and run by an evaluator over its tree.

Rows step.*: instructions of one call by valgrind's callgrind, and machine code of the whole controller by `size`, both
of gcc -O2 for this machine: a PID with filter, limits and its handling of faults (60 at most), with a dither besides,
whose sine takes most of it, and with everything; 4 KiB of code at most.

Rows block.*: a force-driven axis whose command is clipped, tuned with back-calculation; the same gains as CODESYS'
PID_FIXCYCLE runs them (clamping, no filter, no set-point weights), and the design tuned for that block. Rows price.*:
their settling time over the design's: as the block runs it half as long again at least, tuned for it the same to 5 %.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.export.blocks import run_as_block
from pneuopt.export.languages import ReferenceRun, make_reference_run, write_c99, write_python, write_structured_text
from pneuopt.export.program import controller_program
from pneuopt.export.writer import make_header
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.random_controllers import COUNT, Run, run_library
from problems.shared.structured_text_run import FunctionBlock

if TYPE_CHECKING:
    import pandas as pd

COMPILE = ["gcc", "-std=c99", "-Wall", "-Wextra", "-pedantic", "-Wconversion", "-Wshadow"]
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
STEP = po.Step(0.2, horizon=0.6)  # [m/s]
LIMIT = 46.0  # [N] of the command: the friction at 0.2 m/s takes most of it
RANGES = {"pid.Kp": (20.0, 600.0), "pid.Ki": (100.0, 8000.0), "pid.Kd": (0.0, 3.0)}
FREE = {**RANGES, "pid.Tf": (2e-3, 0.02), "pid.b": (0.0, 1.0), "pid.Tt": (4e-3, 1.0)}
MOST_INSTRUCTIONS = {"pid": 60, "pid_with_dither": 300, "everything": 600}
AIM, LIMITS = po.SettlingTime(band=0.02), (po.Overshoot(0.05), po.MaxSensitivity(1.6))


@dataclass(frozen=True)
class Job:
    """What was measured: differences by language, how many are not clean, costs by controller, metrics by design."""

    differences: dict[str, float]
    unclean: int
    costs: dict[str, tuple[float, float]]
    designs: dict[str, "pd.Series[float]"]


def files_of(run: Run) -> tuple[dict[str, str], dict[str, str], dict[str, str]]:
    """C, Python and structured text of a controller, the C with the library's run in its test."""
    program = controller_program(run.loop.controller, run.parameters, run.centre)
    header = make_header("pid_x", run.loop.controller, run.parameters, run.centre, [])
    given = ReferenceRun(run.inputs, run.outputs)
    return write_c99(program, header, given), write_python(program, header), write_structured_text(program, header)


def run_c(files: dict[str, str], folder: Path) -> tuple[float, bool]:
    """The largest difference that the test prints, and whether compiler and sanitizers are content."""
    for name, text in files.items():
        (folder / name).write_text(text, "ascii")
    command = [*COMPILE, *SANITIZE, "pid_x.c", "pid_x_test.c", "-lm", "-o", "run"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    run = subprocess.run([folder / "run"], capture_output=True, text=True, check=False)
    found = re.search(r"largest difference (\S+) of (\S+)", run.stdout)
    difference = float(found[1]) / float(found[2]) if found else np.nan
    return difference, run.returncode == 0 and not built.stderr and not run.stderr


def relative_difference(found: list[float], run: Run) -> float:
    return float(np.max(np.abs(np.array(found) - run.outputs)) / np.max(np.abs(run.outputs)))


def compare_languages(seeds: Iterable[int]) -> tuple[dict[str, float], int]:
    worst, unclean = dict.fromkeys(("c", "python", "structured_text"), 0.0), 0
    for seed in seeds:
        run = run_library(seed)
        c, python, text = files_of(run)
        with tempfile.TemporaryDirectory() as folder:
            difference, clean = run_c(c, Path(folder))
        unclean += not clean
        space: dict[str, type] = {}
        exec(python["pid_x.py"], space)
        controller, block = space["PidX"](), FunctionBlock(text["pid_x.st"])
        controller.start(*run.inputs[0].tolist(), run.centre)
        block.variables["start_output"] = run.centre
        given = [v.name for v in controller_program(run.loop.controller, run.parameters, run.centre).inputs]
        rows = [dict(zip(given, row, strict=True)) for row in run.inputs.tolist()]
        outputs = [block.call(**row)["output"] for row in rows]
        found = {
            "c": difference,
            "python": relative_difference([controller.step(*row) for row in run.inputs.tolist()], run),
            "structured_text": relative_difference(outputs, run),
        }
        worst = {n: max(worst[n], found[n]) for n in worst}
    return worst, unclean


def costs_of(loop: po.ClosedLoop) -> tuple[float, float]:
    """Instructions of a step, and bytes of the machine code; NaN where valgrind or size is not there."""
    program = controller_program(loop.controller, loop.parameters)
    header = make_header("pid_x", loop.controller, loop.parameters, 0.0, [])
    with tempfile.TemporaryDirectory() as folder:
        for name, text in write_c99(program, header, make_reference_run(program)).items():
            (Path(folder) / name).write_text(text, "ascii")
        sources = ["pid_x.c", "pid_x_test.c"]
        subprocess.run([*COMPILE, "-O2", *sources, "-lm", "-o", "run"], cwd=folder, check=True)
        subprocess.run([*COMPILE, "-O2", "-c", "pid_x.c"], cwd=folder, check=True)
        code = instructions = np.nan
        if shutil.which("size"):
            shown = subprocess.run(["size", "pid_x.o"], cwd=folder, capture_output=True, text=True, check=True).stdout
            code = float(shown.splitlines()[1].split()[0])
        if shutil.which("valgrind"):
            watch = ["valgrind", "--tool=callgrind", "--toggle-collect=pid_x_step", "--callgrind-out-file=/dev/null"]
            said = subprocess.run([*watch, "./run"], cwd=folder, capture_output=True, text=True, check=True).stderr
            total = re.search(r"Collected : (\d+)", said)
            instructions = float(total[1]) / 200 if total else np.nan
    return instructions, code


def measure_costs() -> dict[str, tuple[float, float]]:
    plant = po.ForceDrive(po.Viscous())
    extras = (po.FrictionFeedforward(), po.Knocker(), po.DeadZoneInverse())
    pid, encoder = po.PID(1e-3, delay=1, dead_band=True), po.Encoder(1e-5)
    full = po.ClosedLoop(plant, pid, po.Dither(), None, None, encoder, po.Feedforward(), extras)
    plain = po.ClosedLoop(plant, po.PID(1e-3))
    return {
        "pid": costs_of(plain),
        "pid_with_dither": costs_of(po.ClosedLoop(plant, po.PID(1e-3), po.Dither())),
        "everything": costs_of(full),
    }


def tune_for(pid: po.PID, ranges: dict[str, tuple[float, float]], values: dict[str, float]) -> po.TuningResult:
    loop = po.ClosedLoop(po.ForceDrive(po.Stribeck()), pid)
    hand = {"pid.Kp": 200.0, "pid.Ki": 2000.0, "pid.lower": -LIMIT, "pid.upper": LIMIT, **values}
    given = loop.parameters.fixed("*").with_values(hand).with_bounds(ranges).freed(*ranges)
    return po.tune(loop, STEP, given, minimise=AIM, subject_to=LIMITS, plants={})


def compare_block() -> dict[str, "pd.Series[float]"]:
    best = tune_for(po.PID(2e-3), FREE, {})
    loop = po.ClosedLoop(po.ForceDrive(po.Stribeck()), po.PID(2e-3))
    own, values, _ = run_as_block(loop, best.parameters, po.Block.CODESYS)
    again = tune_for(po.PID(2e-3, anti_windup=po.AntiWindup.CLAMPING), RANGES, {"pid.Tf": 0.0})
    label = STEP.label
    run = po.evaluate(own, STEP, values)[label]
    return {"tuned": best.certified[label], "as_it_runs": run, "tuned_for_it": again.certified[label]}


def run(seeds: Iterable[int] = range(COUNT)) -> Job:
    return Job(*compare_languages(seeds), measure_costs(), compare_block())


def main(job: Job) -> "pd.DataFrame":
    claims = [Claim(f"difference.{n}", value, "1", None, "<= 1e-12") for n, value in job.differences.items()]
    claims.append(Claim("c.not_clean", float(job.unclean), "1", None, "<= 0"))
    for name, (instructions, code) in job.costs.items():
        most = MOST_INSTRUCTIONS[name]
        claims.append(Claim(f"step.{name}.instructions", instructions, "1", None, f"<= {most}"))
        claims.append(Claim(f"step.{name}.code", code, "byte", None, "<= 4096"))
    for name, metrics in job.designs.items():
        kept = name != "as_it_runs"
        claims.append(Claim(f"block.{name}.settling_time", float(metrics["SettlingTime"]), "s"))
        claims.append(Claim(f"block.{name}.overshoot", float(metrics["Overshoot"]), "%", None, "<= 5" if kept else ""))
        claims.append(
            Claim(
                f"block.{name}.max_sensitivity", float(metrics["MaxSensitivity"]), "1", None, "<= 1.6" if kept else ""
            )
        )
    settling = {name: float(metrics["SettlingTime"]) for name, metrics in job.designs.items()}
    for name, bound in (("as_it_runs", ">= 1.5"), ("tuned_for_it", "<= 1.05")):
        claims.append(Claim(f"price.{name}", settling[name] / settling["tuned"], "1", None, bound))
    return frame(claims)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(run()), options))
