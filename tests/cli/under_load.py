"""Starts `identify` many times on a busy machine: ``python -m tests.cli.under_load COUNT [LOOPS]`` counts what came.

Each run is a fresh process on the small axis of `tests/conftest.py`, with `PYTHONFAULTHANDLER` set, two at a time
beside so many busy loops. A crash shows as a negative status with the handler's trace; any status but 0 is printed.
"""

import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.cli.circumstances import WRITE, Place, write_inputs

AT_ONCE = 2
BUSY_LOOPS = "4"


def run_under_load(count: int, loops: int, base: Path) -> Counter[int]:
    """The exit status of each run."""
    place = Place(write_inputs(base / "run"), base / "cache", {"PYTHONFAULTHANDLER": "1"})
    assert place.run().returncode == 0
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    seen = Counter[int]()
    try:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            lines = [WRITE.replace("out.", f"out{k}.") for k in range(count)]
            for done in pool.map(place.run, lines):
                seen[done.returncode] += 1
                if done.returncode:
                    sys.stdout.write(f"{done.returncode}: {done.stderr[-4000:]}\n")
                sys.stdout.write(f"{seen.total()} runs, by exit status {dict(seen)}\n")
                sys.stdout.flush()
    finally:
        for each in busy:
            each.kill()
            each.wait()
    return seen


if __name__ == "__main__":
    _, times, loops, *_rest = (*sys.argv, BUSY_LOOPS)
    with tempfile.TemporaryDirectory() as folder:
        statuses = run_under_load(int(times), int(loops), Path(folder))
    sys.exit(set(statuses) != {0})
