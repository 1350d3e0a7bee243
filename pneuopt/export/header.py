"""`Header`: what stands on top of an exported file, in words, and how text becomes a comment that stays one."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pneuopt.control.controller import LARGEST_SIGNAL
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import integrates, to_series, to_standard
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.provenance import provenance
from pneuopt.quantities.unit_algebra import difference_unit, unit_ratio
from pneuopt.quantities.units import write_value

MAX_BLOCK_NAME = 40
"""Length of a block's name [character]: some controllers cut longer ones."""
_COMMENT_MARKS = re.compile(r"\*/|/\*|\(\*|\*\)|//|\"\"\"|'''|\?\?|\\|<!|--|\$")
MAX_COMMENT = 200
"""Length of a text that comes from a file [character]: longer ones fill the header with another's words."""


@dataclass(frozen=True)
class Header:
    """The lines on top of a file.

    Attributes
    ----------
    name : str
        Of the block, structure or class.
    lines : tuple of str
        Plain text, which no comment of C, structured text or Python ends in.
    """

    name: str
    lines: tuple[str, ...] = field(default=())

    @property
    def own_names(self) -> tuple[str, ...]:
        """What the files call the block and what belongs to it."""
        parts = ("parameters", "tuned", "prepare", "start", "step", "test", "h")
        return (self.name, *(f"{self.name}_{part}" for part in parts))


def comment_text(text: str) -> str:
    r"""A text that cannot end a comment: one line of printable ASCII, without the marks of comments.

    Examples
    --------
    >>> comment_text("a */ system(1); *) b \\\n c")
    'a * / system(1); * ) b c'
    """
    plain = "".join(c if c.isprintable() and c.isascii() else " " for c in text[:MAX_COMMENT])
    while _COMMENT_MARKS.search(plain):
        plain = _COMMENT_MARKS.sub(lambda mark: " ".join(mark[0]).replace("\\", "").replace("$", ""), plain)
    return " ".join(plain.split())


def check_name(name: str) -> None:
    """Refuse a name that is no identifier in C, structured text and Python: `InputError`."""
    proper = re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name) is not None
    told = "letters, digits and single underscores between them, a letter first"
    require(
        proper and len(name) <= MAX_BLOCK_NAME, f"--name {name!r}: a block's name has {told}, {MAX_BLOCK_NAME} at most"
    )


def make_header(name: str, loop: ClosedLoop, parameters: ParameterSet, centre: float, origin: Sequence[str]) -> Header:
    """The header of a controller: where it comes from, its sample time, its gains in every form, what to mind.

    Parameters
    ----------
    name : str
    loop : ClosedLoop
    parameters : ParameterSet
    centre : float
        Of the valve [the command's unit].
    origin : sequence of str
        Sentences on where the gains come from; they may hold any text.

    Raises
    ------
    InputError
        If the name is no identifier.
    """
    check_name(name)
    h, signal = loop.pid.sample_time or 0.0, loop.feedback
    lines = [
        f"{name}: sampled PID controller of the {signal.name}, written by pneuopt {provenance()['pneuopt']}",
        *origin,
        "",
    ]
    lines += [
        f"Sample time: {write_value(h, 's')}. Call it once a sample, at equal times; the gains hold for no other."
    ]
    of = f" of the inner loop, which controls the {loop.pid_signal.name}" if loop.outer else ""
    lines += ["Numbers are in SI units, as marked.", "", f"Gains{of}, in every form that controllers take:"]
    lines += [*_gain_lines(loop, parameters), *_part_lines(loop, parameters), "", *_notes(loop, parameters, centre)]
    return Header(name, tuple(map(comment_text, lines)))


def _gain_lines(loop: ClosedLoop, parameters: ParameterSet) -> list[str]:
    """The gains in the parallel, standard and series forms."""
    gains, gain = loop.parallel_form(parameters), unit_ratio(loop.command.unit, loop.pid_signal.unit)
    units = {"Kp": gain, "K": gain, "Ti": "s", "Td": "s", "Tf": "s", "N": ""}
    units["Ki"] = unit_ratio(loop.command.unit, f"{difference_unit(loop.pid_signal.unit)}*s")
    units["Kd"] = unit_ratio(f"{difference_unit(loop.command.unit)}*s", loop.pid_signal.unit)

    def line(name: str, convert: Callable[[], Any], formula: str) -> str:
        try:
            found = vars(convert())
        except InputError as reason:
            return f"- {name}: none ({reason})"
        without = {"N", "Tf"} if gains.Kd == 0 else set()
        shown = [f"{n} = {v:.9g} {units[n]}".rstrip() if math.isfinite(v) else f"{n} = none" for n, v in found.items()]
        return f"- {name}: {', '.join(s for s in shown if s.partition(' ')[0] not in without)}; {formula}"

    return [
        line("parallel", lambda: gains, "Kp + Ki/s + Kd s/(Tf s + 1)"),
        line("standard", lambda: to_standard(gains), "Kp (1 + 1/(Ti s) + Td s/(1 + s Td/N)), N a ratio"),
        line("series", lambda: to_series(gains), "K (1 + 1/(Ti s)) (1 + Td s/(Tf s + 1))"),
    ]


def _part_lines(loop: ClosedLoop, parameters: ParameterSet) -> list[str]:
    """The parts beside the PID, each with its parameters, in the loop's order."""
    complete, parts = loop.complete(parameters), dict[str, list[str]]()
    for n in (n for n in loop.parameters if n not in loop.plant.parameters):
        section, _, name = n.partition(".")
        parts.setdefault(section, []).append(f"{name} = {write_value(complete.value(n), complete[n].unit)}")
    parts.pop("pid", None)
    lines = [f"- {section}: {', '.join(values)}" for section, values in parts.items()]
    return ["", "Parts beside it, which belong to the design as much as its gains:", *lines] if lines else []


def _notes(loop: ClosedLoop, parameters: ParameterSet, centre: float) -> list[str]:
    """What the hardware around the block has to do."""
    value = dict(zip(loop.parameters, loop.parameter_vector(parameters).tolist(), strict=True))
    notes, unit = list[str](), loop.command.unit
    if centre:
        notes += [f"The output is {write_value(centre, unit)}, where the valve is closed, plus the command."]
    if loop.pid.limits and all(math.isfinite(value[n]) for n in ("pid.lower", "pid.upper")):
        low, high = (write_value(value[n] + centre, unit) for n in ("pid.lower", "pid.upper"))
        about = "; lower and upper count from the centre" if centre else ""
        notes += [f"The output runs from {low} to {high}{about}."]
    notes += [*_start_notes(loop, parameters, value), *_fault_notes(loop, value, centre)]
    if loop.pid.delay:
        notes += ["The design counts on one sample from reading to acting."]
    if loop.dither is not None and loop.dither.analogue:
        size, frequency = write_value(value["dither.amplitude"], loop.command.unit), value["dither.frequency"]
        shape = loop.dither.waveform.value
        notes += [
            f"A generator behind the block adds a {shape} of {size} peak at {frequency:.9g} Hz; it is not in here."
        ]
    if loop.schedule is not None:
        told = " and with the load told, schedule_load" if loop.schedule.load is not None else ""
        gains = ", ".join(loop.schedule.gains)
        notes += [
            f"Scheduled with the position{told}: {gains}. The gains above hold in the middle, at the nominal load."
        ]
    if loop.sensor is not None:
        notes += [f"Designed behind a sensor: {loop.sensor!r}."]
    if loop.pid.limits and math.isinf(value["pid.lower"]) and math.isinf(value["pid.upper"]):
        notes += ["The output has no limits; set lower and upper."]
    return notes


def _start_notes(loop: ClosedLoop, parameters: ParameterSet, value: Mapping[str, float]) -> list[str]:
    """What a start does with the output so far, and why."""
    time = write_value(float(loop.pid.emptying_time({n.removeprefix("pid."): v for n, v in value.items()})), "s")
    if not integrates(loop.parallel_form(parameters).Ki):
        return [
            "A start, or restart, does not make the output jump: the output so far passes to the controller's own",
            f"with a time constant of {time}. Without an integral gain nothing is kept there, at a limit neither.",
        ]
    return [
        "A start, or restart, does not make the output jump, and does not leave the axis waiting for a slow integral:",
        f"the setpoint counts as if it moved from the measurement to its value with a time constant of {time}.",
    ]


def _fault_notes(loop: ClosedLoop, value: Mapping[str, float], centre: float) -> list[str]:
    """What happens at a sample that is no number, after how many, and how the controller recovers."""
    count, h = math.ceil(value["pid.fault_samples"]), loop.pid.sample_time or 0.0
    inside = min(max(value["pid.fault_output"], value.get("pid.lower", -math.inf)), value.get("pid.upper", math.inf))
    safe, time = write_value(inside + centre, loop.command.unit), write_value(count * h, "s", 3)
    return [
        f"A sample is bad where an input is no number, or larger than {LARGEST_SIGNAL:g}: the output stays as it was,",
        "fault is set, and the next good sample goes on from there, its differences taken over the whole gap.",
        f"After {count} bad samples in a row (fault_samples), {time}, the output goes to {safe} (fault_output); "
        "the next good sample then begins anew from it, as at a start.",
        "Where the first sample is bad, the output is the safe one until a good sample begins.",
    ]
