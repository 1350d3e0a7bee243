"""`pneuopt init --run`: a run of moves to play, from whose log a drive is identified."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path

import typer

from pneuopt.cli.exit_status import EXIT_SUCCESS
from pneuopt.cli.init import say, write_files
from pneuopt.evaluation.excitation_run import excitation_run
from pneuopt.files.drive import read_drive
from pneuopt.files.first_files import PLAYED_FILE, RUN_FILE, logged_channels, run_files
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import read_value, write_value


@dataclass(frozen=True)
class RunOptions:
    """Limits of a run as the command line says them, with their units; empty: as the drive has them."""

    between: str
    speed: str
    sample_time: str


def run_init_run(drive: Path, folder: Path, options: RunOptions, force: bool, unused: Mapping[str, object]) -> int:
    """Write the run's files and say what it is for, how long it takes and what to log.

    Parameters
    ----------
    drive : Path
        The drive's file.
    folder : Path
        Made where it is missing.
    options : RunOptions
    force : bool
        Whether old files may be replaced.
    unused : mapping of str to object
        Options of `pneuopt init` that have no sense here, by their names; None where they are not given.
    """
    given = ", ".join(n for n, value in unused.items() if value is not None)
    require(not given, f"--run reads the drive from its file: leave out {given}")
    model, parameters = read_drive(drive)
    speed = read_value(options.speed, "m/s", where="--speed") if options.speed else inf
    sample_time = read_value(options.sample_time, "s", where="--sample-time")
    require(sample_time > 0, f"--sample-time {options.sample_time}: give the controller's, such as 1ms")
    between = _read_between(options.between) if options.between else None
    run = excitation_run(model.system(), parameters, sample_time=sample_time, between=between, speed=speed)
    write_files({folder / name: text for name, text in run_files(run, drive.name).items()}, force)
    low, high, trail = (write_value(x, "m", 3) for x in (*run.between, run.following_error))
    fast, gain = write_value(run.fastest, "m/s", 3), write_value(run.parameters.value("pid.Kp"), "V/m", 3)
    place = "" if folder == Path() else f" in {folder}"
    say(f"wrote {PLAYED_FILE}, which a position controller plays, and {RUN_FILE}, which pneuopt simulates{place}")
    say(f"{run.duration:.3g} s between {low} and {high}, at {fast} at most; with a gain of {gain} it trails by {trail}")
    say(f"Log {', '.join(logged_channels(run))} at the controller's samples, from before the first move on, then")
    typer.echo(f"  pneuopt identify {drive} LOG -o fit.toml")
    return EXIT_SUCCESS


def _read_between(text: str) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    require(bool(dots), f"--between {text}: give both ends, as in 20mm..180mm")
    first, last = (read_value(end.strip(), "m", where="--between") for end in (low, high))
    require(first < last, f"--between {text}: the first end must be below the second")
    return first, last
