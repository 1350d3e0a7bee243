"""`pneuopt init`: the first files of a new user, none over an old one; with --run, moves to play and to log."""

import os
import sys
import textwrap
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path

import typer

from pneuopt.cli.run import ExitStatus
from pneuopt.evaluation.moves import excitation_run
from pneuopt.files.drive import read_drive
from pneuopt.files.first_files import (
    PLAYED_FILE,
    RUN_FILE,
    first_channels,
    first_files,
    first_kinds,
    logged_channels,
    run_files,
    sidecar_name,
    unused_channels,
)
from pneuopt.files.tolerances import SAMPLE_TIME
from pneuopt.logs.columns import LogGuess, Question, guess_channels, guess_log
from pneuopt.logs.foreign import parse_log
from pneuopt.logs.noise import estimate_noise
from pneuopt.logs.table import LogTable, read_bytes
from pneuopt.models.catalog import CATALOGUE_SOURCE, catalogue_values
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import check_output_paths, write_bytes
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import read_value, si_conversion, write_value

USUAL_SIZE = "s32"  # of the catalogue: the middle one
_PNEUMATIC = "pneumatic"  # the kind that has a catalogue, and its valve's centre as a parameter


@dataclass
class Asker:
    """Answers the doubts about a log: by the user on a terminal, else by the guess, which it keeps to be told."""

    interactive: bool
    assumed: list[str] = field(default_factory=list)

    def __call__(self, question: Question) -> str:
        """One of the question's options."""
        if not self.interactive:
            self.assumed.append(f"{question.channel}: {question.text} Taken: {question.options[0]}")
            return question.options[0]
        while True:
            text = f"{question.text}\n  {' / '.join(question.options)}"
            answer = typer.prompt(text, default=question.options[0]).strip()
            letter = f"({answer.strip('()')})"  # of "bar(g)"
            for option in question.options:
                if answer == option or option.endswith(letter):
                    return option
            typer.echo(f"answer one of {', '.join(question.options)}")


def run_init(
    kind: str | None,
    folder: Path,
    parts: Mapping[str, str | None],
    log: Path | None,
    force: bool,
    *,
    sample_times: tuple[float, float] = (1e-4, 0.02),  # a controller's [s]: none wrote a log with another step
) -> int:
    """Write the files of a kind of drive, by default the one that the log's channels show; returns the exit status."""
    table = None if log is None else parse_log(log, read_bytes(log))
    guessed = None if table is None or kind is not None else _guess_kind(table)
    message = f"say what drives the load: pneuopt init KIND, one of {', '.join(first_kinds())}"
    require(
        kind is not None or guessed is not None, f"{message}; or pneuopt init --from LOG, whose columns may show it"
    )
    name = str(kind or guessed)
    check_names("kind", [name], first_kinds(), "init")
    known, source = _read_catalogue(name, parts)
    ask = Asker(sys.stdin.isatty() and sys.stdout.isatty())
    guess = LogGuess((), (), SAMPLE_TIME)
    if table is not None:
        guess = guess_log(table, first_channels(name), ask, has_centre=name == _PNEUMATIC)
    unused = unused_channels(name)
    columns = {c.channel: "false" if c.channel in unused else c.entry for c in guess.columns}
    least, most = sample_times
    sample_time = guess.sample_time if least <= guess.sample_time <= most else SAMPLE_TIME
    files = first_files(
        name,
        known,
        columns,
        log=log.name if log else "log.csv",
        sample_time=sample_time,
        counts_from_zero=any(column.centre_is_estimated for column in guess.columns),
        counts={} if table is None else _find_counts(table, guess, first_channels(name)),
        source=source,
        doubts=ask.assumed,
    )
    placed = _place_files(folder, files, log)
    kept = (
        [] if log is None or force else [path for path in placed if path != log.with_suffix(".toml") and path.exists()]
    )
    write_files({path: text for path, text in placed.items() if path not in kept}, force)
    if guessed is not None:
        others = ", ".join(kind for kind in first_kinds() if kind != name)
        say(f"by the log's columns a {name} drive; for another KIND, one of {others}:")
        typer.echo(f"  pneuopt init KIND --from {log} --force")
    written = [n for n in files if folder / n not in kept]
    _show_files(folder, written, guess, unused, ask.assumed, log)
    return ExitStatus.SUCCESS


def read_range(text: str, unit: str, where: str) -> tuple[float, float]:
    """Read both ends of "20mm..180mm"."""
    low, dots, high = text.partition("..")
    require(bool(dots), f"{where}: give both ends, as in 20mm..180mm")
    return read_value(low.strip(), unit, where=where), read_value(high.strip(), unit, where=where)


def write_files(files: Mapping[Path, str | bytes], force: bool) -> None:
    """Write files, all or none: an old one with another text is refused, unless forced."""
    contents = {path: text.encode() if isinstance(text, str) else text for path, text in files.items()}
    for path, content in contents.items():
        is_new = force or not path.exists() or (path.is_file() and path.read_bytes() == content)
        require(is_new, f"{path}: is there already, and stays as it is; --force replaces it, -o names another folder")
    for parent in dict.fromkeys(path.parent for path in files):
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            require(False, f"{parent}: the folder cannot be made ({error.strerror}); name another with -o")
    check_output_paths(files, [])
    for path, content in contents.items():
        write_bytes(path, content)


def _guess_kind(table: LogTable) -> str:
    """What drives the load, by the channels that a log's columns may be."""
    channels = {n: unit for kind in first_kinds() for n, unit in first_channels(kind).items()}
    found = guess_channels(table.names, channels)
    if "torque" in found or "angle" in found:
        return "rotary"
    pressures = {"pressure_a", "pressure_b"} & found.keys()
    if "valve_voltage" in found and (pressures or "force" not in found):
        return _PNEUMATIC if pressures or ("position" in found and "speed" not in found) else "linear"
    message = f"{table.path}: its columns do not say what drives the load; say it before --from"
    require("force" in found, f"{message}: pneuopt init KIND, one of {', '.join(first_kinds())}")
    return "force"


def _find_counts(table: LogTable, guess: LogGuess, channels: Mapping[str, str]) -> dict[str, float]:
    """The step of each channel that a sensor counts [SI], by the log's values; noise hides that of the others."""
    found = dict[str, float]()
    for column in (c for c in guess.columns if c.channel in channels and c.unit):
        noise = estimate_noise(table.read([column.column])[column.column])
        if noise.resolution > noise.random:  # of a moving signal the rounding alone looks like noise
            factor = si_conversion(column.unit, channels[column.channel])[0]
            found[column.channel] = float(f"{abs(factor) * noise.resolution:.6g}")
    return found


def _place_files(folder: Path, files: Mapping[str, str], log: Path | None) -> dict[Path, str]:
    """Where each file goes: the sidecar beside its log, with the way from there to its schema."""
    placed = {folder / name: text for name, text in files.items()}
    if log is None:
        return placed
    side = sidecar_name(log.name)
    text = placed.pop(folder / side)
    try:
        way = os.path.relpath(folder, log.parent)
    except ValueError:  # on another disk of Windows there is none
        way = str(folder.resolve())
    schema = Path(way, "schemas", "sidecar.json").as_posix()
    return placed | {log.with_suffix(".toml"): text.replace("schemas/sidecar.json", schema, 1)}


def _read_catalogue(kind: str, parts: Mapping[str, str | None]) -> tuple[ParameterSet, tuple[str, ...]]:
    """The catalogue's values, and the lines that say where they come from."""
    asked = {what: name for what, name in parts.items() if name is not None}
    if kind != _PNEUMATIC:
        require(not asked, f"--{next(iter(asked), '')} is of the catalogue of pneumatic drives; leave it out")
        return ParameterSet(), ()
    chosen = {"size": USUAL_SIZE, **asked}
    known = catalogue_values(chosen["size"], chosen.get("cylinder"), chosen.get("valve"))
    words = ", ".join(f"{what} {name}" for what, name in chosen.items())
    return known, (f"Values of the catalogue ({words}): {CATALOGUE_SOURCE}.",)


def _show_files(
    folder: Path,
    written: Sequence[str],
    guess: LogGuess,
    unused: Container[str],
    assumed: Sequence[str],
    log: Path | None,
) -> None:
    """Say what was written, what was assumed, and what comes next."""
    names = [name for name in written if name.endswith(".toml")]
    schemas = " and schemas/" if len(names) < len(written) else ""
    say(f"wrote {', '.join(names)}{schemas}" + ("" if folder == Path() else f" in {folder}"))
    if log is not None:
        for column in guess.columns:
            unit = f" [{column.unit}]" if column.unit else ", time stamps"
            centre = f", less {column.centre}" if column.centre else ""
            note = "; its centre, near 5 V, is estimated by identify" if column.centre_is_estimated else ""
            text = f"column {column.column!r}{unit}{centre}{note}"
            if column.channel in unused:
                text = f"left out, column {column.column!r}: this kind of drive does not use it"
            say(f"{column.channel}: {text}", "  ")
        # how a voltage that was left out becomes the force or torque that the log lacks
        found = {column.channel: column.column for column in guess.columns}
        command, unit = ("force", "N") if "force" not in unused else ("torque", "N*m")
        if "valve_voltage" in unused and "valve_voltage" in found and command not in found:
            entry = f'{command} = {{ column = "{found["valve_voltage"]}", unit = "V", scale = "1 {unit}/V" }}'
            held = f'[intersample] {command} = "held", for a controller holds it over a sample'
            text = f"no column; where the voltage commands it, [columns] takes {entry} with its scale, and"
            say(f"{command}: {text}", "  ")
            say(held, "    ")
        if guess.unused:
            say(f"not read: {', '.join(guess.unused)}", "  ")
        say(f"a row every {write_value(guess.sample_time, 's')}", "  ")
    for doubt in assumed:
        say(f"assumed, check it in [columns] of {sidecar_name(log.name) if log else ''}: {doubt}")
    say("Next: put what you know into drive.toml, then")
    place = "LOG" if log is None else str(log)
    typer.echo(f"  pneuopt check drive.toml {place}")
    typer.echo(f"  pneuopt identify drive.toml {place} -o fit.toml")
    typer.echo("  pneuopt tune fit.toml tuning.toml -o tuned.toml")
    typer.echo("What a key means: pneuopt keys KEY")


def say(text: str, indent: str = "", width: int = 80) -> None:
    """Print a sentence in lines of the screen's width."""
    typer.echo("\n".join(textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent + "  ")))


@dataclass(frozen=True)
class RunOptions:
    """Limits of a run as the command line says them, with their units; empty: as the drive has them."""

    between: str
    speed: str
    sample_time: str


def run_init_run(drive: Path, folder: Path, options: RunOptions, force: bool, unused: Mapping[str, object]) -> int:
    """Write a run's files, and show how long it takes and what to log; `unused` are options that it does not take."""
    given = ", ".join(n for n, value in unused.items() if value is not None)
    require(not given, f"--run reads the drive from its file: leave out {given}")
    model, parameters = read_drive(drive)
    speed = read_value(options.speed, "m/s", where="--speed") if options.speed else inf
    sample_time = read_value(options.sample_time, "s", where="--sample-time")
    require(sample_time > 0, f"--sample-time {options.sample_time}: give the controller's, such as 1ms")
    between = None
    if options.between:
        between = read_range(options.between, "m", f"--between {options.between}")
        require(between[0] < between[1], f"--between {options.between}: the first end must be below the second")
    run = excitation_run(model.system(), parameters, sample_time=sample_time, between=between, speed=speed)
    write_files({folder / name: text for name, text in run_files(run, drive.name).items()}, force)
    low, high, trail = (write_value(x, "m", 3) for x in (*run.between, run.following_error))
    fast, gain = write_value(run.fastest, "m/s", 3), write_value(run.parameters.value("pid.Kp"), "V/m", 3)
    place = "" if folder == Path() else f" in {folder}"
    say(f"wrote {PLAYED_FILE}, which a position controller plays, and {RUN_FILE}, which pneuopt simulates{place}")
    say(f"{run.duration:.3g} s between {low} and {high}, at {fast} at most; with a gain of {gain} it trails by {trail}")
    say(f"Log {', '.join(logged_channels(run))} at the controller's samples, from before the first move on, then")
    typer.echo(f"  pneuopt identify {drive} LOG -o fit.toml")
    return ExitStatus.SUCCESS
