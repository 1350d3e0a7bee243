"""What goes wrong in a study, brought about on purpose: nothing is lost, and each fault is said.

    python problems/speed/study_faults.py [--json FILE]

The study certifies plants of the loop T32 of problems/shared/t32.py by `evaluate`, on two processes, with a journal.
Rows *.lost: cells that differ, bit for bit, from the table of the study without a fault, but for the rows of the cases
that are at fault themselves. Rows *.said: 1 where the fault has the words that a user needs: in the row of the case,
or, where no case is at fault, from the journal; a worker that is killed from outside costs nothing and is not said.

* worker: a process is killed by SIGKILL while it computes.
* study: the whole study is killed by SIGKILL when a third is done, and resumed; *.known: cases that were not run again.
* disk: the journal's file may not grow beyond some rows (RLIMIT_FSIZE), as on a full disk.
* nan, hang, memory: one case gives NaN alone, one hangs (limit 8 s), one needs 3 GB (limit 1 GB).
"""

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import SPREADS, STEP, benchmark
from problems.speed import study_faults
from problems.speed.batched_monte_carlo import GAINS
from problems.speed.study_executors import count_differences

if TYPE_CHECKING:
    import pandas as pd

CASES, KILLED_AT = 36, 12
TIME_LIMIT, MEMORY_LIMIT = 8.0, 1000.0  # of a case [s], [MB]
GREED = 3 * 2**30  # what the greedy case takes [byte]
FULL_DISK = 20_000  # bytes that the journal's file may have: some ten rows
REASONS = {
    "nan": ("sample 5", "NaN"),
    "hang": ("sample 11", "took longer than the 8 s"),
    "memory": ("sample 17", "needs more memory than the 1000 MB"),
}


def main() -> "pd.DataFrame":
    with tempfile.TemporaryDirectory() as folder:
        whole, _ = _run("whole", Path(folder))
        worker, shot = _run("worker", Path(folder))
        killed = _start("killed", Path(folder)).returncode
        resumed, told = _run("resumed", Path(folder))
        disk, full = _run("disk", Path(folder))
        faulty, _ = _run("cases", Path(folder))
    at_fault = whole["case"].isin([case for case, _ in REASONS.values()])
    reasons = faulty.set_index("case")["error"]
    return frame(
        [
            Claim("cases", len(whole)),
            Claim("whole.failed", int((whole["error"] != "").sum()), "1", None, "<= 0"),
            Claim("worker.killed", int(shot["shot"]), "1", None, ">= 1"),
            Claim("worker.lost", count_differences(whole, worker), "1", None, "<= 0"),
            Claim("study.killed", int(killed == -signal.SIGKILL), "1", None, ">= 1"),
            Claim("study.known", told["known"], "1", None, f">= {KILLED_AT}"),
            Claim("study.lost", count_differences(whole, resumed), "1", None, "<= 0"),
            Claim("disk.said", int("cases are not kept" in full["problem"]), "1", None, ">= 1"),
            Claim("disk.lost", count_differences(whole, disk), "1", None, "<= 0"),
            *(
                Claim(f"{n}.said", int(words in reasons[case]), "1", None, ">= 1")
                for n, (case, words) in REASONS.items()
            ),
            Claim("cases.lost", count_differences(whole[~at_fault], faulty[~at_fault][list(whole)]), "1", None, "<= 0"),
        ]
    )


def _start(kind: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, __file__, "--kind", kind, "--folder", str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _run(kind: str, folder: Path) -> "tuple[pd.DataFrame, dict[str, Any]]":
    """The table of a study that ends, and what it says."""
    import pandas as pd

    done = _start(kind, folder)
    if done.returncode:
        raise RuntimeError(f"{kind}: {done.stderr}")
    return pd.read_pickle(folder / f"{kind}.pickle"), json.loads(done.stdout)


def study(kind: str, folder: Path) -> dict[str, Any]:
    """Run a study of some kind in this process, leave its table in the folder, and say what there is to say."""
    loop, given = benchmark()
    drawn, shot = po.samples(given, SPREADS, CASES, seed=1), folder / "shot"
    function: Any = partial(po.evaluate, loop, STEP)
    if kind == "worker":
        function = partial(study_faults.certify_or_die, shot, next(iter(drawn.values())), function)
    if kind == "cases":
        at_fault = {name: drawn[case] for name, (case, _) in REASONS.items()}
        function = partial(study_faults.certify_with_faults, at_fault, function)
    journal = po.Journal(folder / ("killed" if kind == "resumed" else kind), "study", resume=kind == "resumed")
    known = len(journal.known)
    limits = (TIME_LIMIT, MEMORY_LIMIT) if kind == "cases" else ()
    if kind == "disk":
        resource.setrlimit(resource.RLIMIT_FSIZE, (FULL_DISK, resource.RLIM_INFINITY))
    where = po.Processes(2, *limits)
    progress = _die_when_a_third_is_done if kind == "killed" else None
    table = po.sweep(function, given.with_values(GAINS), drawn, executor=where, progress=progress, journal=journal)
    journal.close(finished=False)
    if kind == "disk":
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    table.to_pickle(folder / f"{kind}.pickle")
    return {"known": known, "problem": journal.problem, "shot": shot.exists()}


def _die_when_a_third_is_done(progress: po.Progress) -> None:
    if progress.done == KILLED_AT:
        os.kill(os.getpid(), signal.SIGKILL)


def certify_or_die(shot: Path, first: dict[str, float], certify: Any, parameters: po.ParameterSet) -> "pd.DataFrame":
    """Certify a plant; the process is killed, once, in the midst of the first one."""
    found: pd.DataFrame = certify(parameters)
    if _is_plant(parameters, first) and not shot.exists():
        shot.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return found


def certify_with_faults(at_fault: dict[str, dict[str, float]], certify: Any, parameters: po.ParameterSet) -> Any:
    """Certify a plant, but for some: NaN alone, a hang, or far too much memory."""
    kind = next((name for name, values in at_fault.items() if _is_plant(parameters, values)), "")
    if kind == "nan":
        return float("nan")
    if kind == "hang":
        signal.pause()
    return len(bytearray(GREED)) if kind == "memory" else certify(parameters)


def _is_plant(parameters: po.ParameterSet, values: dict[str, float]) -> bool:
    return all(parameters.value(name) == value for name, value in values.items())


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--kind", help="one study, which leaves its table in --folder")
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    if options.kind:
        print(json.dumps(study(options.kind, options.folder)))
    else:
        sys.exit(finish(main(), options))
