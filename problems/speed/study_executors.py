"""The same study in one thread, on two processes and on a dask cluster of this machine: its table, and what it costs.

    python problems/speed/study_executors.py [--cases 600] [--json FILE]

The cases are plants of the loop T32 of problems/shared/t32.py with dither, mass and friction +-30 %, supply +-10 %,
each certified by `evaluate` over a step of 1 s. Each executor serves a study in a process of its own, with one thread
for linear algebra. Row case.cpu: CPU seconds of a certified case within the study in one thread, once the first ten are
done. Rows *.differ: cells of the table, without "seconds", whose bits differ from those of one thread. Rows
*.efficiency_cpu: CPU seconds in one thread over those of all processes together, their start and imports included.
Shown beside them: "start", the CPU seconds of the same study of twenty cases, most of which is the start; and what ends
in "going", the efficiencies of the other cases, by the differences from that study, as of one that goes on for hours.
The wall efficiency, wall time in one thread over twice that on two workers, tells nothing unless two cores are idle: it
is shown beside the number of cores that the study had on average.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import SPREADS, STEP, benchmark
from problems.speed.batched_monte_carlo import GAINS

if TYPE_CHECKING:
    import pandas as pd

SERIAL, WORKERS = "serial", 2
PLACES = (SERIAL, "processes", "dask")
CASES, WARMING, STARTING = 600, 10, 20
EFFICIENCY, CASE_CPU = 0.85, 0.2  # what a study should reach [1], and what a case may take [s]
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Cost(NamedTuple):
    """What a study took: wall time and CPU time of all its processes [s], and CPU time of a warm case in one [s]."""

    wall: float
    cpu: float
    case: float


def main(cases: int = CASES, places: tuple[str, ...] = PLACES) -> "pd.DataFrame":
    import pandas as pd

    tables, costs, starts = dict[str, pd.DataFrame](), dict[str, Cost](), dict[str, Cost]()
    with tempfile.TemporaryDirectory() as folder:
        for place in places:
            path = Path(folder) / f"{place}.pickle"
            starts[place] = _run(place, min(STARTING, cases), path)
            costs[place], tables[place] = _run(place, cases, path), pd.read_pickle(path)
    alone, table, begun = costs[SERIAL], tables[SERIAL], starts[SERIAL]
    claims = [
        Claim("cases", len(table)),
        Claim("failed", int((table["error"] != "").sum()), "1", None, "<= 0"),
        Claim("case.cpu", alone.case, "s", None, f"<= {CASE_CPU}"),
        Claim(f"{SERIAL}.wall", alone.wall, "s"),
        Claim(f"{SERIAL}.cpu", alone.cpu, "s"),
    ]
    for place in places[1:]:
        cost, start = costs[place], starts[place]
        claims += [
            Claim(f"{place}.differ", count_differences(table, tables[place]), "1", None, "<= 0"),
            Claim(f"{place}.wall", cost.wall, "s"),
            Claim(f"{place}.cpu", cost.cpu, "s"),
            Claim(f"{place}.cores", cost.cpu / cost.wall),
            Claim(f"{place}.efficiency", alone.wall / (WORKERS * cost.wall), "1"),
            Claim(f"{place}.efficiency_cpu", alone.cpu / cost.cpu, "1", None, f">= {EFFICIENCY}"),
            Claim(f"{place}.start", start.cpu, "s"),
        ]
        if cases > STARTING:
            wall, cpu = WORKERS * (cost.wall - start.wall), cost.cpu - start.cpu
            claims += [
                Claim(f"{place}.efficiency.going", (alone.wall - begun.wall) / wall),
                Claim(f"{place}.efficiency_cpu.going", (alone.cpu - begun.cpu) / cpu),
            ]
    return frame(claims)


def _run(place: str, cases: int, path: Path) -> Cost:
    """What a study costs that serves alone in a process, and leaves its table."""
    command = [sys.executable, __file__, "--cases", str(cases), "--place", place, "--table", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, **ONE_THREAD})
    return Cost(*map(float, done.stdout.split()))


def count_differences(one: "pd.DataFrame", other: "pd.DataFrame") -> int:
    """Cells of two tables whose bits differ, without the time; all of them where rows or columns do."""
    one, other = (table.drop(columns="seconds") for table in (one, other))
    if list(one) != list(other) or len(one) != len(other):
        return int(one.size)
    numbers = one.select_dtypes("number").columns
    bits = sum(int((one[c].to_numpy(float).view("i8") != other[c].to_numpy(float).view("i8")).sum()) for c in numbers)
    return bits + sum(int((one[c] != other[c]).sum()) for c in one if c not in numbers)


def study(place: str, cases: int, path: Path) -> Cost:
    """Run the study and leave its table."""
    loop, given = benchmark()
    design, drawn = given.with_values(GAINS), po.samples(given, SPREADS, cases, seed=1)
    clock, begun, before = _WarmClock(), time.monotonic(), used_cpu()
    with open_place(place) as executor:
        certify = partial(po.evaluate, loop, STEP)
        table = po.sweep(certify, design, drawn, executor=executor, progress=clock)
    cost = Cost(time.monotonic() - begun, used_cpu() - before, clock.seconds_a_case)
    table.to_pickle(path)
    return cost


def used_cpu() -> float:
    """CPU time of this process and of those that it has waited for [s]."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


@contextmanager
def open_place(place: str) -> Iterator[Executor | po.Processes]:
    """Open the executor of this name."""
    if place == SERIAL:
        with ThreadPoolExecutor(1) as executor:
            yield executor
        return
    with po.open_executor(str(WORKERS) if place == "processes" else place) as executor:
        yield executor


class _WarmClock:
    """CPU time of a case in this process after the first ones."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self.seconds_a_case = float("nan")

    def __call__(self, progress: po.Progress) -> None:
        done, now = progress.done or 0, time.process_time()
        if self._first is None and done >= WARMING:
            self._first = done, now
        elif self._first is not None:
            self.seconds_a_case = (now - self._first[1]) / (done - self._first[0])


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--cases", type=int, default=CASES, help="how many plants")
    parser.add_argument("--place", choices=PLACES, help="one study, whose figures are printed")
    parser.add_argument("--table", type=Path, help="where that study leaves its table")
    options = parser.parse_args()
    if options.place:
        print(*study(options.place, options.cases, options.table))
    else:
        sys.exit(finish(main(options.cases), options))
