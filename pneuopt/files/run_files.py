"""The files of an excitation run: the reference that a controller plays, and the run as a tuning.toml to simulate."""

import textwrap
from collections.abc import Iterator, Sequence

from pneuopt.control.moves import Move
from pneuopt.evaluation.excitation_run import ExcitationRun
from pneuopt.quantities.units import write_value

PLAYED_FILE, RUN_FILE = "moves.csv", "run.toml"  # not one name: run.toml would be taken for the sidecar of run.csv
_COMMENT_WIDTH = 108  # characters of a line of comment


def run_files(run: ExcitationRun, drive: str = "drive.toml") -> dict[str, str]:
    """The texts of both files, by their names; `drive` is the name of the drive's file."""
    return {PLAYED_FILE: _play_file(run), RUN_FILE: "\n".join([*_head(run, drive), *_loop(run), *_moves(run)]) + "\n"}


def logged_channels(run: ExcitationRun) -> tuple[str, ...]:
    """What the run's log has to hold: the command, the position, and what pushes."""
    axis = run.loop.plant.axis
    assert axis is not None
    assert axis.final_element is not None
    return run.loop.command.name, run.loop.feedback.name, *axis.final_element.pushing


def _play_file(run: ExcitationRun) -> str:
    """Time, position and speed of the reference at each sample."""
    columns = run.moves.trajectory(run.loop.pid.sample_time or 0.0)
    rows = zip(columns.t.tolist(), columns["reference"].tolist(), columns["reference_speed"].tolist(), strict=True)
    header = "time [s],position_reference [mm],speed_reference [m/s]"
    return "\n".join([header, *(f"{t:.9g},{1e3 * r:.9g},{v:.6g}" for t, r, v in rows)]) + "\n"


def _head(run: ExcitationRun, drive: str) -> list[str]:
    low, high = (write_value(x, "m", 3) for x in run.between)
    fast = write_value(run.fastest, "m/s", 3)
    trail = write_value(run.following_error, "m", 2)
    text = (
        f"An excitation run of {run.duration:.3g} s for the drive of {drive}, between {low} and {high}, at {fast} at "
        "most, made by pneuopt init --run. From its log alone friction (static, Coulomb, Stribeck, viscous), the "
        "valve's conductance and dead zone, and the mass are identified.",
        f"Play it: a plain position controller (below: proportional, no integral, which would hunt) follows "
        f"{PLAYED_FILE} from rest at its first position. Begin with a tenth of the gain, raise it while the axis does "
        f"not swing, and keep the end stops free. The axis trails by up to {trail}: that does no harm.",
        f"Log {', '.join(logged_channels(run))} at the controller's samples, from before the first move on.",
        f"Then: pneuopt identify {drive} LOG -o fit.toml",
        f"Simulated on the drive as guessed: pneuopt simulate {drive} {RUN_FILE} -o predicted.csv",
    )
    return [f"# {line}" for part in text for line in textwrap.wrap(part, _COMMENT_WIDTH, subsequent_indent="  ")]


def _loop(run: ExcitationRun) -> Iterator[str]:
    p, unit, loop = run.parameters, run.loop.command.unit, run.loop
    limits = (write_value(p.value(f"pid.{end}") + run.centre, unit) for end in ("lower", "upper"))
    gain = write_value(p.value("pid.Kp"), p["pid.Kp"].unit)
    yield from ["", "[loop]", f'measured = "{loop.feedback.name}"', "", "[pid]", 'form = "parallel"']
    yield f'sample_time = "{write_value(loop.pid.sample_time or 0.0, "s")}"'
    yield f'Kp = "{gain}"'
    yield "limits = [" + ", ".join(f'"{end}"' for end in limits) + "]"


def _moves(run: ExcitationRun) -> Iterator[str]:
    moves: Sequence[Move] = run.moves.moves
    first = moves[0]
    shared = {"speed": ("m/s", run.fastest), "acceleration": ("m/s^2", first.acceleration), "at": ("s", first.at)}
    yield from ["", "[[reference]]"]
    for name, (unit, value) in shared.items():
        yield f'{name} = "{write_value(value, unit)}"'
    yield f'initial = "{write_value(first.initial, "m")}"'
    yield "moves = ["
    for move in moves:
        own = {"distance": (move.distance, "m"), "speed": (move.speed, "m/s"), "dwell": (move.dwell, "s")}
        cells = ", ".join(f'{n} = "{write_value(value, unit)}"' for n, (value, unit) in own.items())
        yield f"  {{ {cells} }},"
    yield "]"
