"""Are the names and literals of exported controllers such that every compiler takes them, whatever a plant's names are?

    python problems/demo/exported_names.py [--json FILE] [--seeds FIRST LAST]

Two hundred random controllers of every form and part, as structured text, and a hundred loops whose plant and
compensator have names drawn from the words of C, C++, structured text, Python and JavaScript, of the exported files
themselves, and from what is no identifier ("a__b", "2nd"): as C, Python and structured text.

Rows *.wrong_names: how many names of a file are reserved in one of the languages, no identifier, longer than 40
characters, given twice (structured text knows no case), or used without a declaration. Rows *.wrong_literals: how many
numbers have no form of a real literal or are outside 1.2E-38 .. 3.4E38, which compilers that take a literal for a REAL
ask for. Rows *.difference.*: the largest difference of any output from the library's own loop, over the largest output
of that run. `hostile.not_compiled`: how many are not compiled by gcc without a warning under -Wall -Wextra -pedantic
-Wconversion -Wshadow, or are stopped by a sanitizer.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

from pneuopt.export.program import controller_program
from problems.demo.export_controllers import files_of, relative_difference, run_c
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.exported_words import wrong_literals, wrong_names
from problems.shared.hostile_names import hostile_run
from problems.shared.random_controllers import Run, run_library
from problems.shared.structured_text_run import FunctionBlock

if TYPE_CHECKING:
    import pandas as pd

CONTROLLERS, HOSTILE = 200, 100


@dataclass
class Counts:
    """What is wrong in some files."""

    files: int = 0
    names: int = 0
    literals: int = 0
    not_compiled: int = 0
    differences: dict[str, float] = field(default_factory=dict)

    def add(self, language: str, difference: float) -> None:
        """Keep a difference, if it is the largest."""
        self.differences[language] = max(self.differences.get(language, 0.0), difference)


def check_text(run: Run, text: str, counts: Counts) -> None:
    """Count a block's wrong words and run it."""
    counts.files += 1
    counts.names += len(wrong_names(text))
    counts.literals += len(wrong_literals(text))
    block = FunctionBlock(text)
    block.variables["start_output"] = run.centre
    given = [v.name for v in controller_program(run.loop.controller, run.parameters, run.centre).inputs]
    found = [block.call(**dict(zip(given, row, strict=True)))["output"] for row in run.inputs.tolist()]
    counts.add("structured_text", relative_difference(found, run))


def check_code(run: Run, c: dict[str, str], python: dict[str, str], counts: Counts) -> None:
    """Compile and run a controller as C and as Python."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            difference, clean = run_c(c, Path(folder))
        except subprocess.CalledProcessError:
            difference, clean = 0.0, False
    counts.not_compiled += not clean
    counts.add("c", difference)
    space: dict[str, type] = {}
    exec(compile(python["pid_x.py"], "pid_x.py", "exec"), space)
    controller = space["PidX"]()
    controller.start(*run.inputs[0].tolist(), run.centre)
    counts.add("python", relative_difference([controller.step(*row) for row in run.inputs.tolist()], run))


def check_random(seeds: Iterable[int]) -> Counts:
    counts = Counts()
    for seed in seeds:
        run = run_library(seed)
        check_text(run, files_of(run)[2]["pid_x.st"], counts)
    return counts


def check_hostile(seeds: Iterable[int]) -> Counts:
    counts = Counts()
    for seed in seeds:
        run = hostile_run(seed)
        c, python, text = files_of(run)
        check_code(run, c, python, counts)
        check_text(run, text["pid_x.st"], counts)
    return counts


def main(random: Counts, hostile: Counts) -> "pd.DataFrame":
    claims = []
    for kind, found in (("random", random), ("hostile", hostile)):
        claims += [
            Claim(f"{kind}.files", found.files, "1"),
            Claim(f"{kind}.wrong_names", found.names, "1", None, "<= 0"),
            Claim(f"{kind}.wrong_literals", found.literals, "1", None, "<= 0"),
        ]
        claims += [Claim(f"{kind}.difference.{n}", v, "1", None, "<= 1e-12") for n, v in found.differences.items()]
    return frame([*claims, Claim("hostile.not_compiled", hostile.not_compiled, "1", None, "<= 0")])


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=[0, 100], help="per cent of the seeds that are run")
    options = parser.parse_args()
    first, last = options.seeds
    random = check_random(range(CONTROLLERS * first // 100, CONTROLLERS * last // 100))
    sys.exit(finish(main(random, check_hostile(range(HOSTILE * first // 100, HOSTILE * last // 100))), options))
