"""Ends commands by signals at random times: ``python -m tests.cli.interruptions COUNT [SEED]`` prints what was kept.

`identify`, `tune` and `study` run on the small axis of `tests/conftest.py` with a result of an earlier run in place.
SIGINT, SIGTERM and SIGKILL come COUNT times each, uniformly over the time that a whole run takes. A run passes if its
status is that of the signal, no traceback is shown, each file is whole, the earlier result stands or is replaced whole
and no other file is left (after SIGKILL a hidden one may be); a study goes on where it was.
"""

import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.conftest import DRIVE, TUNING, generate_axis_logs

LAST_MOMENT = 60.0
"""Time for a command and its processes to end [s]: less takes a loaded machine for a hang; more waits longer."""
EARLIER = "# an earlier result\n"
STUDY = """[study]
drive = "drive.toml"
tuning = "tuning.toml"
[axes]
"load.mass" = ["3 kg", "4 kg", "5 kg", "6 kg", "7 kg", "8 kg"]
"friction.coulomb" = ["20 N", "40 N"]
"""
COMMANDS: dict[str, tuple[str, str]] = {
    "identify": ("identify drive.toml run_01.csv run_02.csv -o out.toml --json out.json", "out.toml"),
    "tune": ("tune drive.toml tuning.toml -o out.toml --json out.json", "out.toml"),
    "study": ("study study.toml -o out.csv", "out.csv"),
}
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
LISTENS = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); sys.argv[0] = 'pneuopt'; "
LISTENS += "from pneuopt.__main__ import main; main()"  # a job in the background inherits SIGINT as ignored


@dataclass
class Tally:
    """What came of the runs of one command under one signal."""

    runs: int = 0
    finished: int = 0
    best_kept: int = 0
    rows_kept: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        ends = f"{statistics.median(self.seconds):.2f} / {max(self.seconds):.2f} s" if self.seconds else "-"
        rows = f", rows kept {self.rows_kept}" if self.rows_kept else ""
        return (
            f"{self.runs} runs: {self.finished} had finished, {self.best_kept} left a best so far{rows}; "
            f"ended after (median / worst) {ends}; {len(self.faults)} faults"
        )


def interrupt_commands(count: int, seed: int, commands: Sequence[str] = tuple(COMMANDS)) -> Iterator[tuple[str, Tally]]:
    """Run each command under each signal, so many times; yields the command's name with the signal's, and the tally."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as base:
        for command in commands:
            whole = _time_whole_run(command, Path(base))
            for number in SIGNALS:
                tally = Tally()
                for k in range(count):
                    folder = _write_inputs(Path(base) / f"{command}{number}_{k}")
                    _try(tally, command, number, rng.uniform(0, whole), folder)
                yield f"{command} {number.name}", tally


def _write_inputs(folder: Path) -> Path:
    folder.mkdir()
    texts = {"drive.toml": DRIVE, "tuning.toml": TUNING, "study.toml": STUDY}
    texts |= {f"{name}.csv": text for name, text in generate_axis_logs().items()}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def _start(command: str, folder: Path) -> "subprocess.Popen[str]":
    line = [sys.executable, "-c", LISTENS, *COMMANDS[command][0].split()]
    root = {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), os.environ.get("PYTHONPATH")]))}
    return subprocess.Popen(
        line, cwd=folder, env={**os.environ, **root}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def _time_whole_run(command: str, base: Path) -> float:
    folder = _write_inputs(base / command)
    begun = time.perf_counter()
    out, err = _start(command, folder).communicate()
    assert (folder / COMMANDS[command][1]).exists(), out + err
    return time.perf_counter() - begun


def _try(tally: Tally, command: str, number: signal.Signals, moment: float, folder: Path) -> None:
    output = folder / COMMANDS[command][1]
    output.write_text(EARLIER, encoding="utf-8")
    given = {path.name for path in folder.iterdir()}
    process = _start(command, folder)
    time.sleep(moment)
    finished = process.poll() is not None
    sent = time.perf_counter()
    process.send_signal(number)
    try:
        out, err = process.communicate(timeout=LAST_MOMENT)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = "", f"nothing had ended after {LAST_MOMENT:g} s, or a process of it holds its streams"
        tally.faults.append(f"{moment:.2f} s: {err}")
    tally.runs += 1
    tally.finished += finished
    if not finished:
        tally.seconds.append(time.perf_counter() - sent)
    expected = {0, 1} if finished else {-9, 0} if number is signal.SIGKILL else {128 + number, -number}
    new = {path.name for path in folder.iterdir()} - given
    tally.best_kept += any("interrupted" in name or "best" in name for name in new)
    rules: dict[str, Callable[[], bool]] = {
        f"status {process.returncode}": lambda: process.returncode in expected,
        "traceback": lambda: "Traceback" not in out + err or process.returncode == -number,
        "a file is not whole": lambda: all(map(_is_whole, folder.iterdir())),
        "the earlier result is lost": lambda: finished or output.read_text("utf-8").strip() != "",
        f"left {new}": lambda: number is signal.SIGKILL or not any(name.endswith(".part") for name in new),
    }
    tally.faults += [f"{moment:.2f} s: {what}: {err[-300:]}" for what, holds in rules.items() if not holds()]
    journal = folder / f"{output.name}.journal"
    if command == "study" and not finished:
        tally.rows_kept.append(max(0, len(journal.read_text("utf-8").splitlines()) - 1) if journal.exists() else 0)


def _is_whole(path: Path) -> bool:
    if path.name.startswith(".") or path.suffix == ".journal":
        return True
    text = path.read_text("utf-8")
    try:
        if path.suffix == ".toml":
            tomllib.loads(text)
        elif path.suffix == ".json":
            json.loads(text)
    except ValueError:
        return False
    return text.endswith("\n")


if __name__ == "__main__":
    _, times, start, *chosen = (*sys.argv, *("0",)[len(sys.argv) - 2 :])
    for name, tally in interrupt_commands(int(times), int(start), chosen or tuple(COMMANDS)):
        sys.stdout.write(f"{name:18s} {tally}\n")
        sys.stdout.flush()
        for fault in tally.faults:
            sys.stdout.write(f"    {fault}\n")
