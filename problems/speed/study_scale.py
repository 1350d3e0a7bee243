"""What a case costs the coordinator of a study, in CPU time and in memory, from 1000 to 100 000 cases.

    python problems/speed/study_scale.py [--most 100000] [--json FILE]

The function is trivial, so that the study itself is what remains: checking, sending, collecting, the journal and the
table. Each size runs in a process of its own, with one process that computes. Memory is the growth of the largest
resident set during the study, over that before it, which holds the cases already. Rows *.cpu: constant from 10 000
cases on. Rows *.memory: what the table itself takes, some numbers and pointers a case.
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame
from problems.speed import study_scale

if TYPE_CHECKING:
    import pandas as pd

SIZES = (1_000, 10_000, 100_000)
LARGE = 10_000  # cases from which the study's beginning counts no more [1]
TABLE_BYTES = 1000  # of the table and its names, for a case [byte]: an outcome that is kept whole takes more
RATIO = 1.5  # CPU time of a case among 100 000 over that of one among 10 000 [1]: 1 is constant, 10 is quadratic
KIB = 1024  # byte: getrusage counts in these on Linux


def main(most: int = SIZES[-1]) -> "pd.DataFrame":
    claims, costs = [], dict[int, float]()
    for size in (s for s in SIZES if s <= most):
        done = subprocess.run(
            [sys.executable, __file__, "--size", str(size)], capture_output=True, text=True, check=True
        )
        seconds, memory, good = map(float, done.stdout.split())
        costs[size] = 1e6 * seconds / size
        slower = f"<= {RATIO * costs[LARGE]:.4g}" if size > LARGE else ""
        claims += [
            Claim(f"{size}.good", good, "1", None, f">= {size}"),
            Claim(f"{size}.cpu", costs[size], "us", None, slower),
            Claim(f"{size}.memory", memory / size, "byte", None, f"<= {TABLE_BYTES}" if size >= LARGE else ""),
        ]
    return frame(claims)


def study(size: int) -> tuple[float, float, int]:
    """CPU time of the coordinator [s], how much its memory grew [byte], and how many cases are good."""
    rig = po.ParameterSet({"mass": po.Parameter(5.0, "kg", 0.1, 100.0), "force": po.Parameter(10.0, "N")})
    cases = po.samples(rig, {"mass": 0.3, "force": 0.2}, size, seed=1)
    one = po.Processes(1)
    po.sweep(study_scale.acceleration, rig, dict(list(cases.items())[:10]), executor=one)  # what is loaded but once
    with tempfile.TemporaryDirectory() as folder:
        journal = po.Journal(Path(folder) / "journal", "scale")
        held, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
        table = po.sweep(study_scale.acceleration, rig, cases, executor=one, journal=journal)
        spent, grown = time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - held
        journal.close(finished=True)
    return spent, KIB * grown, int((table["error"] == "").sum())


def acceleration(parameters: po.ParameterSet) -> float:
    return parameters.value("force") / parameters.value("mass")


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--most", type=int, default=SIZES[-1], help="leave larger studies out")
    parser.add_argument("--size", type=int, help="one study, whose figures are printed")
    options = parser.parse_args()
    if options.size:
        print(*study(options.size))
    else:
        sys.exit(finish(main(options.most), options))
