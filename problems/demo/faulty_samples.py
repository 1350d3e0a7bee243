"""Samples that are no number: do the library and its exports hold, stop and recover alike?

    python problems/demo/faulty_samples.py [--controllers 100] [--first 0] [--json FILE]

Random sampled controllers of every form, with every part that can be tuned, each over ten random sequences of 120
samples. In runs of 1 to 20 samples one input, or all at once (a dropout), is NaN, plus or minus infinity, or beyond
1e30; now and then the controller is restarted, at times with such inputs, or from such an output. The library's closed
loop, its CasADi program, the Python class, the C (gcc, -Wall -Wextra -Werror, under the address and undefined-behaviour
sanitizers) and the structured text (parsed by blark, run over its tree) compute the same.

Rows difference.*: the largest difference from the library of any output, over the largest output of its sequence; 1e-12
at most. Row held: the same of the outputs at bad samples from what was sent last, or from the safe output once
`fault_samples` were bad. Row anew: of the outputs after so many from those of a controller that is started there. Rows
count.*: sequences, and what is wrong: flags, outputs that are no number, C that compiler or sanitizers do not like.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import names
from pneuopt.export.languages import make_reference_run, write_c99, write_python, write_structured_text
from pneuopt.export.program import SAMPLE, ControllerProgram, controller_program
from pneuopt.export.writer import make_header
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.random_controllers import random_loop, shown_signal
from problems.shared.structured_text_run import FunctionBlock

if TYPE_CHECKING:
    import pandas as pd

SAMPLES, SEQUENCES, TOLERANCE = 120, 10, 1e-12
BAD_VALUES = (np.nan, np.inf, -np.inf, 1e31, -3e300)
LONGEST = 20  # samples of a fault
COMPILE = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow"]
COMPILE += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
Flags = NDArray[np.bool_]
Outputs = tuple[Array, Flags]
"""By sample the output, and whether the flag of a fault is on."""


class Faulty(NamedTuple):
    """What a controller is given: inputs by sample, and by sample the outputs from which it is restarted.

    `motion` holds the position and the speed of the plant, one of which the second input shows, where that is good.
    """

    inputs: Array
    motion: Array
    restarts: Mapping[int, float]

    @property
    def is_bad(self) -> Flags:
        """By sample."""
        return np.asarray(~np.all(np.abs(self.inputs) <= 1e30, axis=1))


@dataclass(frozen=True)
class Case:
    """A controller and its program."""

    loop: ClosedLoop
    parameters: ParameterSet
    centre: float
    program: ControllerProgram

    @property
    def value(self) -> dict[str, float]:
        """The parameters."""
        return {v.name: v.value for v in self.program.parameters}


@dataclass
class Tally:
    """The worst of what was seen, and how often something was wrong."""

    differences: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("sequences", "flags", "no_number"), 0))

    def see(self, name: str, found: Array, wanted: Array, size: float) -> None:
        """Keep the largest difference."""
        worst = float(np.max(np.abs(found - wanted), initial=0.0)) / size
        self.differences[name] = max(self.differences.get(name, 0.0), np.inf if np.isnan(worst) else worst)

    def count(self, name: str, more: int) -> None:
        """Count more of a kind."""
        self.counts[name] = self.counts.get(name, 0) + more


def draw_case(seed: int) -> Case:
    """A random controller, with its own handling of faults."""
    loop, parameters, centre = random_loop(seed)
    g = np.random.default_rng(seed + 2000)
    faults = {"pid.fault_samples": float(g.integers(1, 9)), "pid.fault_output": float(g.uniform(-3.0, 3.0))}
    parameters = parameters.with_values(faults)
    return Case(loop, parameters, centre, controller_program(loop.controller, parameters, centre))


def draw_sequence(case: Case, seed: int, samples: int = SAMPLES) -> Faulty:
    """Signals with faults and restarts among them."""
    clean = draw_signals(case, seed, samples)
    g, inputs = np.random.default_rng(seed + 500_000), clean.inputs
    k = int(g.integers(2, 20))
    while k < samples:
        length, kind = int(g.integers(1, LONGEST + 1)), float(g.choice(BAD_VALUES))
        inputs[k : k + length, g.integers(inputs.shape[1]) if g.random() < 0.7 else slice(None)] = kind
        k += length + int(g.integers(1, 25))
    restarts = dict(clean.restarts)
    for at in g.integers(1, samples, size=g.integers(3)).tolist():
        restarts[at] = float(g.choice([case.centre + g.uniform(-3.0, 3.0), np.nan]))
    return clean._replace(restarts=restarts)


def draw_signals(case: Case, seed: int, samples: int) -> Faulty:
    """A reference in steps and a plant that is moved at random; started once."""
    g, loop = np.random.default_rng(seed), case.loop
    motion = 0.05 * np.cumsum(g.normal(size=(samples, 2)), axis=0) * [0.02, 0.2]
    reference = 0.3 * np.repeat(g.normal(size=samples // 40 + 1), 40)[:samples]
    more = g.normal(size=(samples, len(loop.motion_inputs))) * 0.1
    air = 5e5 + 1e4 * np.cumsum(g.normal(size=(samples, len(loop.readings))), axis=0)
    air[:, [n == "position" for n in loop.readings]] = motion[:, :1]
    shown = np.array([shown_signal(loop, row) for row in motion])
    inputs = np.column_stack([reference, shown, more, air])
    return Faulty(inputs, motion, {0: case.centre})


def run_library(case: Case, given: Faulty) -> Outputs:
    """By the closed loop's own update, whose plant is moved along; a bad input is a bad state of it."""
    loop, p, h = case.loop, case.loop.parameter_vector(case.parameters), case.loop.pid.sample_time or 0.0
    order, plant, x = names(loop.states), names(loop.plant.states), np.zeros(len(loop.states))
    by_position = isinstance(loop.sensor, Encoder) or loop.pid_signal.name == "position"
    seen = "sensor.reading" if isinstance(loop.sensor, SensorLag) else "position" if by_position else "speed"
    count = len(loop.motion_inputs)
    sent, faults, begun = [], [], 0
    for k, row in enumerate(given.inputs):
        if k in given.restarts:
            first = case.program.start([*row, given.restarts[k]], case.program.values).full().ravel()
            by_origin = dict(zip((v.origin for v in case.program.states), first, strict=True))
            x, begun = np.array([by_origin.get(n, 0.0) for n in order]), k
        x[[plant.index("position"), plant.index("speed")]] = given.motion[k]
        good = bool(np.abs(row[1]) <= 1e30)
        x[order.index(seen)] = (
            given.motion[k][int(loop.pid_signal.name == "speed" and not by_position)] if good else row[1]
        )
        x[[plant.index(n) for n in loop.readings]] = row[2 + count :]
        x = loop.update((k - begun) * h, x, [row[0], *row[2 : 2 + count]], p).full().ravel()
        after = dict(zip(order, x, strict=True))
        sent.append(after["pid.pending" if loop.pid.delay else "pid.command"] + case.centre)
        faults.append(after["pid.bad_samples"] > 0)
    return np.array(sent), np.array(faults)


def run_program(case: Case, given: Faulty) -> Outputs:
    program, x, found = case.program, np.zeros(len(case.program.states)), list[Array]()
    count = len(program.outputs)
    for k, row in enumerate(given.inputs):
        if k in given.restarts:
            x = program.start([*row, given.restarts[k]], program.values).full().ravel()
        results = program.step(row, x, program.values)[0].full().ravel()
        found.append(results[[0, count - 1]])
        x = results[count:]
    return np.array(found)[:, 0], np.array(found)[:, 1] > 0


def run_python(source: str, given: Faulty) -> Outputs:
    space: dict[str, type] = {}
    exec(compile(source, "pid_x.py", "exec"), space)
    controller, sent, faults = space["PidX"](), [], []
    for k, row in enumerate(given.inputs.tolist()):
        if k in given.restarts:
            controller.start(*row, given.restarts[k])
        sent.append(controller.step(*row))
        faults.append(controller.fault)
    return np.array(sent), np.array(faults)


def run_structured_text(block: FunctionBlock, case: Case, given: Faulty) -> Outputs:
    signals, sent, faults = [v.name for v in case.program.inputs], [], []
    for k, row in enumerate(given.inputs.tolist()):
        begins = k in given.restarts
        block.variables |= {"restart": begins, "start_output": given.restarts[k] if begins else 1e6}
        after = block.call(**dict(zip(signals, row, strict=True)))
        sent.append(after["output"])
        faults.append(after["fault"])
    return np.array(sent), np.array(faults)


C_MAIN = """#include "pid_x.h"
#include <stdio.h>
int main(void)
{
    pid_x c;
    double row[WIDTH], out[2];
    pid_x_prepare(&c, &pid_x_tuned);
    while (fread(row, sizeof row, 1, stdin) == 1) {
        if (row[0] > 0.5)
            pid_x_start(&c, SIGNALS, row[1]);
        out[0] = pid_x_step(&c, SIGNALS);
        out[1] = c.fault;
        fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
"""


def c_runner(case: Case) -> str:
    """A program that reads rows of restart, start_output and inputs, and writes output and flag, all as doubles."""
    count = len(case.program.inputs)
    signals = ", ".join(f"row[{k + 2}]" for k in range(count))
    return C_MAIN.replace("WIDTH", str(count + 2)).replace("SIGNALS", signals)


def compile_c(case: Case, files: Mapping[str, str], folder: Path) -> bool:
    """Whether it is compiled without a warning."""
    for name, text in {**files, "main.c": c_runner(case)}.items():
        (folder / name).write_text(text, "ascii")
    command = [*COMPILE, "pid_x.c", "main.c", "-lm", "-o", "run"]
    return subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0


def run_c(folder: Path, given: Faulty) -> tuple[Outputs, bool]:
    """The outputs, and whether the sanitizers are content."""
    starts = np.array(
        [[k in given.restarts, given.restarts.get(k, 0.0)] for k in range(len(given.inputs))], dtype=float
    )
    rows = np.column_stack([starts, given.inputs]).tobytes()
    run = subprocess.run([folder / "run"], input=rows, capture_output=True, check=False)
    found = np.frombuffer(run.stdout).reshape(-1, 2)
    return (found[:, 0], found[:, 1] > 0), run.returncode == 0 and not run.stderr


def expected_outputs(case: Case, given: Faulty, sent: Array) -> Array:
    """The outputs by what is promised of bad samples, NaN at good ones."""
    value, expected, count = case.value, np.full(len(sent), np.nan), 0.0
    safe = min(max(value["fault_output"], value.get("lower", -np.inf)), value.get("upper", np.inf)) + case.centre
    for k, bad in enumerate(given.is_bad):
        count = value["fault_samples"] if k in given.restarts and bad else 0.0 if k in given.restarts else count
        count = count + 1 if bad else 0.0
        if bad:
            expected[k] = safe if count >= value["fault_samples"] else sent[k - 1]
    return expected


def begun_anew(case: Case, given: Faulty, sent: Array) -> list[tuple[slice, Array]]:
    """Stretches of good samples after a stop, and the outputs of a controller that is started at each."""
    program, bad, found = case.program, given.is_bad, []
    states, count = [v.name for v in program.states], len(program.outputs)
    in_row, sample = 0.0, 0
    for k, row in enumerate(given.inputs):
        if k in given.restarts:
            in_row, sample = case.value["fault_samples"] if bad[k] else 0.0, 0
        if not bad[k] and in_row >= case.value["fault_samples"] and k > 0:
            x, outputs, last = program.start([*row, sent[k - 1]], program.values).full().ravel(), [], k
            if SAMPLE in states:
                x[states.index(SAMPLE)] = sample
            while last < len(bad) and not bad[last] and (last == k or last not in given.restarts):
                results = program.step(given.inputs[last], x, program.values)[0].full().ravel()
                outputs.append(results[0])
                x, last = results[count:], last + 1
            found.append((slice(k, last), np.array(outputs)))
        in_row, sample = in_row + 1 if bad[k] else 0.0, sample + 1
    return found


def judge(case: Case, given: Faulty, runs: Mapping[str, Outputs], tally: Tally) -> None:
    """Compare the runs of a sequence with the library's, and that with what is promised."""
    sent = runs["library"][0]
    size = float(np.max(np.abs(sent)))
    expected, bad = expected_outputs(case, given, sent), given.is_bad
    tally.count("sequences", 1)
    tally.see("held", sent[bad], expected[bad], size)
    for where, outputs in begun_anew(case, given, sent):
        tally.see("anew", sent[where], outputs, size)
    for name, (found, flags) in runs.items():
        tally.count("flags", int(np.sum(flags != bad)))
        tally.count("no_number", int(np.sum(~np.isfinite(found))))
        if name != "library":
            tally.see(f"difference.{name}", found, sent, size)


def try_controller(
    seed: int, tally: Tally, sequences: int = SEQUENCES, languages: Iterable[str] = ("python", "c", "st")
) -> None:
    """One controller over its sequences, in all languages."""
    case, wanted = draw_case(seed), set(languages)
    header = make_header("pid_x", case.loop.controller, case.parameters, case.centre, [])
    given = [draw_sequence(case, 1000 * seed + k) for k in range(sequences)]
    runs: list[dict[str, Outputs]] = [{"library": run_library(case, s), "program": run_program(case, s)} for s in given]
    if "python" in wanted:
        source = write_python(case.program, header)["pid_x.py"]
        for own, s in zip(runs, given, strict=True):
            own["python"] = run_python(source, s)
    if "st" in wanted:
        block = FunctionBlock(write_structured_text(case.program, header)["pid_x.st"])
        for own, s in zip(runs, given, strict=True):
            own["structured_text"] = run_structured_text(block, case, s)
    if "c" in wanted:
        with tempfile.TemporaryDirectory() as folder:
            files = write_c99(case.program, header, make_reference_run(case.program))
            compiled = compile_c(case, files, Path(folder))
            tally.count("unclean_c", not compiled)
            for own, s in zip(runs, given, strict=True) if compiled else ():
                own["c"], clean = run_c(Path(folder), s)
                tally.count("unclean_c", not clean)
    for own, s in zip(runs, given, strict=True):
        judge(case, s, own, tally)


def main(seeds: Iterable[int]) -> "pd.DataFrame":
    """The claims."""
    tally = Tally()
    for seed in seeds:
        try_controller(seed, tally)
        print(f"controller {seed}: {tally.differences} {tally.counts}", file=sys.stderr, flush=True)
    claims = [Claim(name, value, "1", None, f"<= {TOLERANCE:g}") for name, value in sorted(tally.differences.items())]
    for name, value in tally.counts.items():
        claims.append(Claim(f"count.{name}", value, "1", None, "" if name == "sequences" else "<= 0"))
    return frame(claims)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--controllers", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first controller")
    options = parser.parse_args()
    sys.exit(finish(main(range(options.first, options.first + options.controllers)), options))
