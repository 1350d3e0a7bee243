"""Restarts of exported controllers: does the output jump, and does the axis arrive?

    python problems/demo/restart_tables.py [--quick | --every] [--json FILE]

A speed and a position loop on a force-driven axis, a cascade on a pneumatic drive and a position loop on a rotary axis;
without an integral, with a slow one (Ti = 8 s) and with a usual one (Ti = 0.5 s); without limits, with back-calculation
and with clamping; the three forms and a delay of one sample in turn, or with --every each with each. Each begins in
four ways: at rest on its setpoint; at rest 50 mm, 30 deg or 0.2 m/s away from it; away, and moved by hand with a tenth
of the full output; and running, at rest, with a step of 200 mm, 120 deg or 0.8 m/s that drives the output to its
limits. C99, Python and structured text get the inputs of a loop closed with the library's program, and are restarted as
their users would.

Rows bump.*: the largest jump of the output at the restart, over the full output. Rows error.*: how far the axis is 5 s
later from where the same loop is that was running all along, without limits, over the distance. From a hand's output, a
slow integral keeps what seems to hold the axis for as long as it takes, and back-calculation is known to leave a rest;
these rows are shown only. Row difference: of the languages' outputs, over the largest output.
"""

import itertools
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

from pneuopt.control.controller import PositionLoop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, AntiWindup, Form, ParallelForm, to_series, to_standard
from pneuopt.dynamics.system import System, discretise, names
from pneuopt.export.languages import make_reference_run, write_c99, write_python, write_structured_text
from pneuopt.export.program import ControllerProgram, controller_program
from pneuopt.export.writer import make_header
from pneuopt.models.drives import ForceDrive, RotaryDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.structured_text_run import FunctionBlock

if TYPE_CHECKING:
    import pandas as pd

H, DURATION, SUBSTEPS = 5e-3, 5.0, 4  # [s], [s], [1]
BEFORE = 5  # samples that a controller has run before it is restarted
SITUATIONS = ("rest", "away", "manual", "saturation")
INTEGRALS = {"none": np.inf, "slow": 8.0, "usual": 0.5}  # Ti [s]
WINDUPS = {"unlimited": None, "back_calculation": AntiWindup.BACK_CALCULATION, "clamping": AntiWindup.CLAMPING}


@dataclass(frozen=True)
class Structure:
    """A loop's plant and gains, and the sizes of what is tried with it.

    `away` and `far` are distances of the setpoint, `full` is the output at its limit.
    """

    name: str
    plant: System
    settings: Mapping[str, float]
    measured: str
    gains: ParallelForm
    away: float
    far: float
    full: float
    outer: PositionLoop | None = None


AIR = {"cylinder.stroke": 0.6, "friction.viscous": 200.0, "position_loop.Kp": 4.0}
FORCE, TURN = ForceDrive(friction=Viscous()).system(), RotaryDrive(friction=Viscous()).system()
POSITION, ANGLE = ParallelForm(2000.0, Kd=100.0, Tf=0.01), ParallelForm(0.2, Kd=0.02, Tf=0.01)
AXIS = PneumaticDrive(friction=Viscous()).system()
STRUCTURES = (
    Structure("speed", FORCE, {}, "speed", ParallelForm(150.0), 0.2, 0.8, 60.0),
    Structure("cascade", AXIS, AIR, "position", ParallelForm(2.0), 0.05, 0.2, 1.0, PositionLoop()),
    Structure("position", FORCE, {}, "position", POSITION, 0.05, 0.2, 200.0),
    Structure("rotary", TURN, {}, "angle", ANGLE, np.pi / 6, 2 * np.pi / 3, 0.3),
)


class Trial(NamedTuple):
    """One restart."""

    structure: Structure
    integral: str
    windup: str
    form: Form
    delay: int
    situation: str


class Run(NamedTuple):
    """What a controller was given, the output from which it was started, what it gave, and where the axis was."""

    inputs: Array
    start_output: float
    outputs: Array
    measured: Array


def trials(every: bool) -> Iterator[Trial]:
    """All combinations, with forms and delays in turn or all of them, too."""
    kinds = list(itertools.product(Form, (0, 1)))
    turn = itertools.cycle(kinds)
    for structure, integral, windup in itertools.product(STRUCTURES, INTEGRALS, WINDUPS):
        for form, delay in kinds if every else [next(turn)]:
            for situation in SITUATIONS:
                yield Trial(structure, integral, windup, form, delay, situation)


def make_loop(trial: Trial) -> tuple[ClosedLoop, ParameterSet]:
    """The loop of a trial."""
    own, kind = trial.structure, WINDUPS[trial.windup]
    pid = PID(H, kind is not None, trial.form, trial.delay, anti_windup=kind or AntiWindup.BACK_CALCULATION)
    loop = ClosedLoop(own.plant, pid, measured=own.measured, outer=own.outer)
    gains = replace(own.gains, Ki=own.gains.Kp / INTEGRALS[trial.integral])
    converted = {Form.PARALLEL: lambda g: g, Form.STANDARD: to_standard, Form.SERIES: to_series}[trial.form](gains)
    values = {f"pid.{n}": v for n, v in vars(converted).items()}
    values |= {n: v for n, v in own.settings.items() if n in loop.parameters}
    values |= {"pid.lower": -own.full, "pid.upper": own.full} if kind else {}
    return loop, loop.parameters.with_values(values)


def run_loop(
    trial: Trial, loop: ClosedLoop, parameters: ParameterSet, program: ControllerProgram, runs: bool = False
) -> Run:
    """The program on the plant, started as the situation says; or running at rest when the setpoint changes."""
    own, plant = trial.structure, loop.plant
    step, pv = discretise(plant, SUBSTEPS).step, [parameters.value(n) for n in plant.parameters]
    x = np.array(loop.initial(parameters, reference=0.0))[: len(plant.states)]
    outputs, states = names(plant.outputs), [v.name for v in program.states]
    hand = 0.1 * own.full if trial.situation == "manual" and not runs else 0.0
    for _ in range(int(0.3 / H) if hand else 0):
        x = step(0.0, H, x, [hand], pv)[0].full().ravel()
    wanted = {"rest": 0.0, "saturation": own.far}.get(trial.situation, own.away)
    begun, sent, rows, found, shown = None, hand, [], [], []
    for _ in range(int(DURATION / H)):
        y = dict(zip(outputs, plant.ode(0.0, x, [0.0], pv)[1].full().ravel(), strict=True))
        given = {"setpoint": wanted, "measured": y[loop.pid_signal.name], "setpoint_speed": 0.0}
        row = [given[v.name] if v.name in given else y[v.name] for v in program.inputs]
        first = [0.0 if runs else row[0], *row[1:], hand]
        begun = program.start(first, program.values) if begun is None else begun
        results = program.step(row, begun, program.values)[0].full().ravel()
        begun = results[len(results) - len(states) :]
        x = step(0.0, H, x, [sent if trial.delay else results[0]], pv)[0].full().ravel()
        sent = results[0]
        rows.append(row)
        found.append(sent)
        shown.append(y[own.measured])
    return Run(np.array(rows), hand, np.array(found), np.array(shown))


def run_python(source: str, run: Run) -> Array:
    """The exported class, which has run before, started and stepped."""
    space: dict[str, type] = {}
    exec(compile(source, "pid.py", "exec"), space)
    controller = space["Pid"]()
    for row in run.inputs[-BEFORE:].tolist():
        controller.step(*row)
    controller.start(*run.inputs[0].tolist(), run.start_output)
    return np.array([controller.step(*row) for row in run.inputs.tolist()])


def run_structured_text(program: ControllerProgram, source: str, run: Run, samples: int) -> Array:
    """The exported block, which has run before, with restart at the first of a few samples."""
    block, signals = FunctionBlock(source), [v.name for v in program.inputs]
    for row in run.inputs[-BEFORE:].tolist():
        block.call(**dict(zip(signals, row, strict=True)))
    block.variables |= {"restart": True, "start_output": run.start_output}
    found = []
    for row in run.inputs[:samples].tolist():
        found.append(block.call(**dict(zip(signals, row, strict=True)))["output"])
        block.variables["restart"] = False
    return np.array(found)


C_MAIN = """#include "pid.h"
#include <stdio.h>
int main(void)
{
    pid c;
    double row[WIDTH], out;
    int k;
    pid_prepare(&c, &pid_tuned);
    for (k = 0; fread(row, sizeof row, 1, stdin) == 1; ++k) {
        if (k == 0 || k == BEFORE)
            pid_start(&c, SIGNALS, k ? OUTPUT : 0.0);
        out = pid_step(&c, SIGNALS);
        fwrite(&out, sizeof out, 1, stdout);
    }
    return 0;
}
"""


def run_c(files: Mapping[str, str], program: ControllerProgram, run: Run) -> Array:
    """The exported C, which has run before, too."""
    count = len(program.inputs)
    words = {"WIDTH": str(count), "SIGNALS": ", ".join(f"row[{k}]" for k in range(count))}
    words |= {"BEFORE": str(BEFORE), "OUTPUT": repr(run.start_output)}
    main = re.sub("[A-Z]{5,}", lambda word: words[word[0]], C_MAIN)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, text in {**files, "main.c": main}.items():
            (folder / name).write_text(text, "ascii")
        subprocess.run(["gcc", "-std=c99", "-O1", "pid.c", "main.c", "-lm", "-o", "run"], cwd=folder, check=True)
        rows = np.concatenate([run.inputs[-BEFORE:], run.inputs]).astype(float).tobytes()
        done = subprocess.run([folder / "run"], input=rows, capture_output=True, check=True)
    return np.frombuffer(done.stdout)[BEFORE:]


def compare_languages(
    loop: ClosedLoop, parameters: ParameterSet, program: ControllerProgram, run: Run, text: bool
) -> float:
    """The largest difference of the exported languages, over the largest output."""
    header = make_header("pid", loop.controller, parameters, 0.0, [])
    found = {
        "python": run_python(write_python(program, header)["pid.py"], run),
        "c": run_c(write_c99(program, header, make_reference_run(program)), program, run),
    }
    if text:
        source = write_structured_text(program, header)["pid.st"]
        found["structured_text"] = run_structured_text(program, source, run, 100)
    size = max(1e-12, float(np.max(np.abs(run.outputs))))
    return max(float(np.max(np.abs(own - run.outputs[: len(own)]))) / size for own in found.values())


def end_of_running(trial: Trial) -> float:
    """Where the loop ends that ran without limits when its setpoint changed."""
    free = trial._replace(windup="unlimited")
    loop, parameters = make_loop(free)
    return float(
        run_loop(free, loop, parameters, controller_program(loop.controller, parameters), runs=True).measured[-1]
    )


def try_restart(trial: Trial, text: bool) -> tuple[float, float, float]:
    """The jump, the error at the end, and the languages' difference (with structured text or without)."""
    own, far = trial.structure, trial.situation == "saturation"
    loop, parameters = make_loop(trial)
    program = controller_program(loop.controller, parameters)
    run = run_loop(trial, loop, parameters, program, runs=far)
    error = abs(run.measured[-1] - end_of_running(trial)) / (own.far if far else own.away)
    same = trial.situation in ("rest", "saturation")
    difference = 0.0 if same else compare_languages(loop, parameters, program, run, text)
    return abs(run.outputs[0] - run.start_output) / own.full, error, difference


def main(quick: bool = False, every: bool = False) -> "pd.DataFrame":
    """The claims."""
    bumps, errors, differences = dict[str, float](), dict[str, float](), [0.0]
    for k, trial in enumerate(trials(every)):
        if quick and (trial.structure.name != "cascade" or trial.windup != "back_calculation"):
            continue
        bump, error, difference = try_restart(trial, text=k % 8 == 1)
        key = f"{trial.structure.name}.{trial.integral}.{trial.situation}"
        bumps[key] = max(bumps.get(key, 0.0), bump)
        errors[key] = max(errors.get(key, 0.0), error)
        differences.append(difference)
        print(*trial[1:], key, bump, error, difference, file=sys.stderr, flush=True)
    rows = [Claim(f"bump.{n}", v, "1", None, "<= 0.02") for n, v in bumps.items() if "saturation" not in n]
    shown = ("slow.manual", "slow.saturation")
    rows += [Claim(f"error.{n}", v, "1", None, "" if n.endswith(shown) else "<= 0.02") for n, v in errors.items()]
    return frame([*rows, Claim("difference", max(differences), "1", None, "<= 1e-12")])


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="the cascade with back-calculation alone")
    parser.add_argument("--every", action="store_true", help="every form with and without a delay: six times as long")
    options = parser.parse_args()
    sys.exit(finish(main(options.quick, options.every), options))
