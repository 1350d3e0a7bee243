"""`Page`: what a page holds and how it becomes HTML, by the template beside this file.

Below it what pages share: their data and provenance, a controller's gains in every form, and the figures of a loop.
"""

import base64
import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.controller import Controller
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import ParallelForm, to_series, to_standard
from pneuopt.control.reference import Reference
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.evaluate import respond
from pneuopt.evaluation.margins import worst_open_loop
from pneuopt.evaluation.metric import Band
from pneuopt.export.blocks import describe_refusal
from pneuopt.export.makers import MAKER_BLOCKS, Block
from pneuopt.logs.experiment import Experiment
from pneuopt.plotting import (
    Response,
    friction_force,
    has_friction_map,
    plot_bode,
    plot_loop,
    plot_steps,
    replace_unprintable,
    to_svg,
)
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.output import write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import TIED, Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import unit_ratio, write_value

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure


_SEVERITY = [tone.value for tone in (Tone.PLAIN, Tone.HEADING, Tone.GOOD, Tone.DOUBTFUL, Tone.BAD)]


@dataclass(frozen=True)
class Picture:
    """A figure of a page."""

    # makes the figure; one that raises `InputError` leaves its reason in the figure's place
    draw: Callable[[], "Figure"]
    alt: str  # what it shows, for those who do not see it
    caption: str  # what stands below it


@dataclass(frozen=True)
class Section:
    """A part of a page under a heading; it is left out where it holds nothing."""

    title: str
    parts: tuple[Report | Picture, ...]


@dataclass(frozen=True)
class Page:
    """A result for a reader who has nothing but this page."""

    title: str  # what was done with what: "Identification of drive.toml"
    verdict: Report  # what stands first: how it ended, in colour, with details and remedies
    sections: tuple[Section, ...]
    warnings: tuple[str, ...] = ()  # what to know before any figure is believed; stands below the verdict
    # makes what moves the page's last part, `live_script`; no other script runs in the page
    script: Callable[[], str] | None = None


def write_page(path: str | Path, page: Page, *, draws: bool = True) -> None:
    """Write a page, whole or not at all; without figures and script for an interrupted command."""
    write_text(path, render_page(page, draws=draws))


def render_page(page: Page, *, draws: bool = True) -> str:
    """The page as HTML."""
    from importlib import resources

    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    template = resources.files(__package__).joinpath("page.html").read_text("utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    numbers = count(1) if draws else None
    made = ((section.title, list(_make_blocks(section.parts, numbers))) for section in page.sections)
    sections = [{"title": title, "blocks": blocks} for title, blocks in made if blocks]
    verdict = list(_make_blocks((page.verdict,), numbers))
    tones = [block.get("tone", Tone.PLAIN.value) for block in verdict]
    tone = max(tones, key=_SEVERITY.index, default=Tone.PLAIN.value)
    script = page.script() if page.script is not None and draws else ""
    text = environment.from_string(template).render(
        title=page.title,
        tone=tone,
        verdict=verdict,
        warnings=page.warnings,
        sections=sections,
        script=Markup(script),
        script_hash=Markup(base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()),
    )
    return replace_unprintable(text)  # of a file's name, say, whose bytes are no letters


def _make_blocks(parts: Sequence[Report | Picture], numbers: Iterator[int] | None) -> Iterator[dict[str, Any]]:
    """What the template shows of a section's parts; without `numbers` no figures."""
    from markupsafe import Markup

    for part in parts:
        if isinstance(part, Picture):
            if numbers is None:
                continue
            number = next(numbers)
            try:
                svg = Markup(to_svg(part.draw(), f"figure{number}", part.alt))
                yield {"kind": "picture", "svg": svg, "number": number, "caption": part.caption}
            except InputError as error:
                text = f"{part.caption} is not drawn: {error}"
                yield {"kind": "line", "text": text, "tone": Tone.PLAIN.value, "indent": 0}
            continue
        for own in part.parts:
            if isinstance(own, Line):
                yield {"kind": "line", "text": own.text, "tone": own.tone.value, "indent": own.indent}
            else:
                columns = [{"heading": c.heading.split("\n"), "is_text": c.is_text} for c in own.columns]
                yield {"kind": "table", "columns": columns, "rows": own.rows}


_HASH = "sha256["
"""What a name in a provenance begins with, where its value is the hash of a file or a log."""


def data_section(experiments: Sequence[Experiment], noise: Mapping[tuple[str, str], float] | None = None) -> Section:
    """Logs, a row each, and their channels with range and noise, as stated or as a fit found it."""
    if not experiments:
        return Section("Data", ())
    logs, channels = [], []
    for log in experiments:
        t = log.trajectory.t
        rate = write_value(float(np.median(np.diff(t))), "s", 4) if len(t) > 1 else "-"
        source = log.source.path if log.source else ""
        logs.append((log.name or "log", str(len(t)), f"{t[0]:.6g}", f"{t[-1]:.6g}", rate, source))
        for channel in log.trajectory:
            values, unit = log.trajectory[channel], log.unit(channel) or "1"
            column = log.source.columns.get(channel) if log.source else None
            finite = values[np.isfinite(values)]
            ends = [write_value(float(f(finite)), unit, 4) if finite.size else "-" for f in (np.min, np.max)]
            level = log.noise.get(channel, (noise or {}).get((log.name, channel), math.nan))
            shown = "-" if math.isnan(level) else write_value(level, unit, 3)
            missing = format_number(len(values) - finite.size, 6)
            channels.append((log.name or "log", channel, column.name if column else "", *ends, shown, missing))
    heads = *text_columns("log"), *number_columns("samples", "from [s]", "to [s]", "one every")
    own = *text_columns("log", "channel", "column"), *number_columns("least", "largest", "noise", "missing")
    known = (Line(f"in {e.name}: {n} = {value:.6g}") for e in experiments for n, value in e.conditions.items())
    remarks = (Line(f"{e.name}: {remark}") for e in experiments for remark in e.remarks)
    table = Table((*heads, *text_columns("file")), tuple(logs))
    return Section("Data", (Report((table, Table(own, tuple(channels)), *known, *remarks)),))


def log_hashes(experiments: Sequence[Experiment]) -> dict[str, str]:
    """The hashes of logs, by their names in a provenance."""
    return {f"{_HASH}{e.name}]": e.sha256 for e in experiments}


def provenance_section(provenance: Mapping[str, str], hashes: Mapping[str, str]) -> Section:
    """What a result was computed from, by hash, and with which versions and options."""
    known = {**{n: v for n, v in provenance.items() if n.startswith(_HASH)}, **hashes}
    files = tuple((n.removeprefix(_HASH).removesuffix("]"), str(value)) for n, value in known.items() if value)
    others = {n: str(v) for n, v in provenance.items() if not n.startswith(_HASH)}
    options = others.pop("options", "")
    lines = [Line(", ".join(f"{n} {value}" for n, value in others.items()))] if others else []
    tables = [Table(text_columns("read", "SHA-256"), files)] if files else []
    heading = [Line("options", Tone.HEADING), *(Line(text) for text in options.split("; "))] if options else []
    return Section("Provenance", (Report((*tables, *lines, *heading)),))


LAW_TEXTS = {
    "parallel": "Kp~(b~r~−~y) + Ki~e/s + Kd~s/(Tf~s~+~1)~(c~r~−~y)",
    "standard (ISA)": "Kp~((b~r~−~y) + e/(Ti~s) + Td~s/(1~+~s~Td/N)~(c~r~−~y))",
    "series": "K (1~+~1/(Ti~s)) (1~+~Td~s/(Tf~s~+~1))~e",
}
"""The forms and their laws; no line ends at a tilde."""
_CONVERSIONS: Mapping[str, Callable[[ParallelForm], object]] = {"standard (ISA)": to_standard, "series": to_series}
EXPORTS = {
    "st": "a PLC (IEC 61131-3 structured text)",
    "c": "a microcontroller (C99, with a test)",
    "python": "a Python program",
    **{block.value: f"the PID block of {MAKER_BLOCKS[block].maker}" for block in Block},
    "fmu": "a simulation tool (the plant as FMU)",
}
"""The forms of `pneuopt export`, and who takes them."""
N_NOTE = "N of the standard form is ISA's ratio Td/Tf. Simulink's N is the filter's pole in rad/s, 1/Tf."


def report_forms(controller: Controller, parameters: ParameterSet) -> Report:
    """The gains in the parallel, the standard and the series form; why one of them has none."""
    parallel = controller.parallel_form(parameters)
    unit = unit_ratio(controller.command.unit, controller.pid_signal.unit)
    units = {"Kp": unit, "K": unit, "Ki": unit_ratio(unit, "s"), "Kd": unit_ratio(f"({unit})*s", "1"), "N": "1"}
    rows, refused = [], []
    for name, law in LAW_TEXTS.items():
        try:
            gains = vars(_CONVERSIONS[name](parallel) if name in _CONVERSIONS else parallel)
        except InputError as error:
            refused.append(Line(str(error)))
            continue
        if gains.get("Td") == 0:
            gains = {n: math.nan if n == "N" else v for n, v in gains.items()}  # of no derivative there is no ratio
        written = {n: write_value(v, units.get(n, "s")) for n, v in gains.items() if not math.isnan(v)}
        rows.append((name, *(f"{n} {written.get(n, '-')}" for n in gains), law.replace("~", TIED)))
    return Report((Table(text_columns("form", "", "", "", "", "law"), tuple(rows)), *refused, Line(N_NOTE)))


def report_exports(
    controller: Controller,
    parameters: ParameterSet,
    references: Sequence[Reference],
    centre: float,
    fit: Path,
    tuned: Path,
) -> Report:
    """The commands that take a design to a controller, and the makers whose block cannot hold it."""
    if controller.pid.sample_time is None:
        return Report((Line("A continuous controller has no export: give it a sample_time, and tune it so."),))
    refused = [block for block in Block if describe_refusal(controller, parameters, block, references, centre)]
    taken = {form: what for form, what in EXPORTS.items() if form not in {block.value for block in refused}}
    rows = tuple((what, f"pneuopt export {fit} {tuned} --to {form}") for form, what in taken.items())
    makers = ", ".join(MAKER_BLOCKS[block].maker for block in refused)
    message = f"The PID block of these makers cannot hold this design: {makers}. The structured text holds it whole."
    return Report((Table(text_columns("what it takes", "command"), rows), *([Line(message)] if refused else [])))


def report_settings(controller: Controller, parameters: ParameterSet) -> Report:
    """What else a controller is set to, the numbers that are not tuned, and how it computes."""
    full = controller.complete(parameters)
    rows = tuple((n, write_value(full.value(n), full[n].unit)) for n in controller.parameters if not full[n].free)
    pid, lines = controller.pid, []
    if pid.sample_time is None:
        lines.append("a continuous controller")
    else:
        late = f", its command acts {pid.delay} sample late" if pid.delay else ""
        lines.append(f"computes every {write_value(pid.sample_time, 's')} by backward Euler{late}")
    return Report((Line("; ".join(lines)), *([Table(text_columns("setting", "value"), rows)] if rows else [])))


def simulate_responses(
    loop: ClosedLoop, references: Sequence[Reference], parameters: ParameterSet, before: ParameterSet | None = None
) -> list[Response]:
    """The response to each reference, with that of the gains before where they can be simulated."""
    units = (loop.feedback.unit, loop.command.unit)
    found = []
    for reference in references:
        run = _simulate_response(loop, reference, parameters)
        earlier = None
        if before is not None:
            with suppress(ConvergenceError, InputError):
                earlier = _simulate_response(loop, reference, before)
        period, push = loop.dither_period(parameters), loop.plant.axis.force if loop.plant.axis else "N"
        found.append(Response(run, reference, loop.feedback.name, units, earlier, period, push))
    return found


def loop_figures(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    before: ParameterSet | None = None,
    *,
    band: Band = 0.02,
) -> dict[str, "Figure"]:
    """The steps, "", and the Bode plot, "bode", at the first one's operating point with the largest sensitivity."""
    responses = simulate_responses(loop, references, parameters, before)
    first, earlier = responses[0], None
    if first.before is not None and before is not None:
        earlier = _open_loop(loop, before, first.reference, first.before)
    bode = plot_bode(_open_loop(loop, parameters, first.reference, first.run), earlier)
    return {"": plot_steps(responses, band=band), "bode": bode}


def loop_pictures(draw: Callable[[], Mapping[str, "Figure"]], *, compared: bool) -> tuple[Picture, Picture]:
    """The steps and the Bode plot for a page; both are simulated when the first one is drawn."""
    drawn: dict[str, Figure] = {}

    def figure(name: str) -> "Figure":
        if not drawn:
            try:
                drawn.update(draw())
            except ConvergenceError as error:
                raise InputError(str(error)) from None
        return drawn[name]

    beside = ", before and after the tuning" if compared else ""
    steps = Picture(
        partial(figure, ""),
        f"Step responses{beside}: the signal with its reference and band, the command, valve and friction over time.",
        f"Steps{beside}: signal, reference and settling band, command, and what goes on inside the drive.",
    )
    bode = Picture(
        partial(figure, "bode"),
        f"Bode plot of the open loop{beside}: gain and phase with margins marked, and the two sensitivities.",
        f"The open loop where its sensitivity is largest in the first step{beside}; below, what feedback leaves of a "
        "disturbance (S) and what of the reference arrives (T).",
    )
    return steps, bode


def diagram_picture(loop: ClosedLoop) -> Picture:
    """The block diagram for a page."""
    alt = (
        f"Block diagram: reference, {loop.pid.form.value} PID{', dither' if loop.dither else ''}, the plant driven by "
        f"{loop.command.name} and feedback of {loop.feedback.name}."
    )
    return Picture(partial(plot_loop, loop), alt, "The loop as it was simulated.")


def _simulate_response(loop: ClosedLoop, reference: Reference, parameters: ParameterSet) -> Trajectory:
    """The response, with the friction force where the plant has one."""
    run, plant = respond(loop, reference, parameters), loop.plant
    if not plant.states or not has_friction_map(plant):
        return run
    others = {q.name: np.zeros(len(run)) for q in plant.inputs if q.name not in run}
    whole = run.with_columns({**others, loop.command.name: run["control"]})
    return run.with_columns({"friction.force": friction_force(plant, whole, parameters)})


def _open_loop(loop: ClosedLoop, parameters: ParameterSet, reference: Reference, run: Trajectory) -> Linearisation:
    disturbed = add_disturbances(loop, [reference])
    return worst_open_loop(disturbed, loop.complete(parameters), reference, run)[1]
