"""`export_settings`: the gains of a design for another maker's PID block, and what the design is worth as that runs."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.pid import AntiWindup, Form
from pneuopt.control.reference import Reference, as_references
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.export.header import check_name, comment_text
from pneuopt.export.makers.block_form import BlockForm, Design, Setting, standard_times, wire
from pneuopt.export.surroundings import acting_loop, design_of, find_surroundings
from pneuopt.export.vendor_blocks import BLOCK_FORMS, Block
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, require
from pneuopt.quantities.parameters import ParameterSet

COMPARED_METRICS = {"SettlingTime": "s", "Overshoot": "%", "SteadyStateError": "%"}
"""What the two are compared by, and its unit."""
SHEET_WIDTH = 116  # [character] of the sheet's sentences
BLIND_LIMITS = "its limits, and its integral with them, do not see the sum with what is added behind it"
MECHANICAL_UNITS = {"N": "newtons", "N*m": "newton metres"}
"""Units of a command that no output module has: the amplifier's scale lies between."""


def export_settings(
    loop: ClosedLoop,
    parameters: ParameterSet,
    block: Block,
    references: Reference | Sequence[Reference],
    *,
    name: str = "controller",
    centre: float = 0.0,
    origin: Sequence[str] = (),
    measured_span: float | None = None,
) -> dict[str, str]:
    """Write what is to be typed into a PID block, with formula and source, and the design as that block runs it.

    First come how near the block is to the design, what stands around it in the order of the signals, and what is to
    be checked before it is enabled. The loop is simulated with the block's set-point weights, filter, rounding of times
    and anti-windup, and with what the sheet says of its surroundings.

    Parameters
    ----------
    loop : ClosedLoop
        With a sample time.
    parameters : ParameterSet
    block : Block
    references : Reference or sequence of Reference
        On which the two are compared.
    name : str
        Of the file.
    centre : float
        Of the valve [the command's unit].
    origin : sequence of str
        Where the gains come from; any text.
    measured_span : float, optional
        From the least to the largest process value as the block scales it [unit of what the loop is judged by];
        by default of the references, and as far again beyond either end. Rockwell's gains are for errors in percent
        of it.

    Returns
    -------
    dict of str to str
        The text by its file's name.

    Raises
    ------
    InputError
        If the block cannot have these gains (Kp = 0 in the standard form), if a part of the design has no counterpart
        among the maker's blocks, or if the loop is continuous.
    """
    check_closed_loop(loop)
    check_name(name)
    told = "a continuous controller cannot be exported: give it a sample time, sample_time under [pid], and tune again"
    require(loop.pid.sample_time is not None, told, ModelError)
    loop.check(parameters)
    if measured_span is not None:
        message = f"measured_span must be positive and finite, got {measured_span:g} {loop.feedback.unit}"
        require(0 < measured_span < math.inf, message)
    form, steps = BLOCK_FORMS[block], as_references(references)
    around = find_surroundings(acting_loop(loop, parameters), parameters, form, steps, centre, measured_span)
    d = around.inner
    settings = form.settings(d)  # first of all: it refuses what the block cannot have
    compared = compare_with_block(loop, parameters, block, steps)
    lines = [_verdict(loop, parameters, block), *_scale_lines(d), f"{form.title}: the gains of {name}"]
    lines += [*map(comment_text, origin), "", "What stands around it, in the order of the signals", ""]
    lines += _wrap(around.lines)
    if around.outer:
        lines += ["", f"Settings of the outer block ({around.outer.measured})", "", *_rows(form.settings(around.outer))]
    lines += ["", f"Settings{f' of the inner block ({d.measured})' if around.outer else ''}", "", *_rows(settings)]
    lines += ["", "What the output is", "", *_wrap([*form.states(d), *_rest_words(d, form)])]
    lines += ["", "Check before you enable it", "", *_wrap(_checks(d, around.outer or d, form))]
    lines += ["", f"Formula: {form.formula}", "Sources:", *(f"- {source}" for source in form.sources)]
    lines += ["", *compared] if compared else []
    return {f"{name}_{block.value}.txt": "\n".join(lines) + "\n"}


def describe_refusal(
    loop: ClosedLoop,
    parameters: ParameterSet,
    block: Block,
    references: Reference | Sequence[Reference],
    centre: float = 0.0,
) -> str:
    """Why a block cannot hold a design, as `export_settings` refuses it; empty where it can."""
    form, steps = BLOCK_FORMS[block], as_references(references)
    try:
        around = find_surroundings(acting_loop(loop, parameters), parameters, form, steps, centre, None)
        for design in filter(None, (around.inner, around.outer)):
            form.settings(design)
    except InputError as reason:
        return str(reason)
    return ""


def run_as_block(
    loop: ClosedLoop, parameters: ParameterSet, block: Block
) -> tuple[ClosedLoop, ParameterSet, list[str]]:
    """A loop whose controller is another maker's block with the same gains.

    Returns
    -------
    loop : ClosedLoop
    parameters : ParameterSet
    differences : list of str
        In what that differs from the design; empty where the block runs it as it is.
    """
    form, found = BLOCK_FORMS[block], list[str]()
    acting = acting_loop(loop, parameters)
    integrates = loop.parallel_form(parameters).Ki != 0
    clamps = form.clamps and loop.pid.limits and loop.pid.anti_windup is AntiWindup.BACK_CALCULATION
    kind = AntiWindup.CLAMPING if clamps else loop.pid.anti_windup
    found += ["its integral is clamped at a limit, the design's unwinds by back-calculation"] * (clamps and integrates)
    behind = integrates and form.added is None and design_of(acting, parameters, 0.0).is_added_to
    found += [f"{BLIND_LIMITS} (simulated as if they saw it)"] if behind and loop.pid.limits else []
    found += ["it has no dead band of the integral"] if acting.pid.dead_band else []
    found += ["it has no reset of the integral"] if loop.pid.reset else []
    pid = replace(loop.pid, form=Form.PARALLEL, anti_windup=kind, dead_band=False, reset=False)
    own = replace(acting, pid=pid)
    gains = loop.parallel_form(parameters)
    values = {f"pid.{n}": v for n, v in vars(gains).items()} | _block_gains(loop, parameters, form, found)
    shared = parameters.select(n for n in parameters if n in own.parameters and n not in values)
    return own, own.parameters.with_values({n: p.value for n, p in shared.items()} | values), found


def compare_with_block(
    loop: ClosedLoop, parameters: ParameterSet, block: Block, references: Reference | Sequence[Reference]
) -> list[str]:
    """Lines that say what a design is worth as a block runs it, beside what it is worth as tuned; none if it is."""
    own, values, found = run_as_block(loop, parameters, block)
    if not found:
        return []
    lines = ["As the block runs it, the design differs:", *(f"- {difference}" for difference in found), ""]
    unit, steps = loop.feedback.unit, as_references(references)
    try:
        tuned, run = evaluate(loop, steps, parameters), evaluate(own, steps, values)
    except (ConvergenceError, InputError) as error:
        return [*lines, f"It cannot be simulated so: {error}"]
    lines += [f"  {'reference':<24}{'metric':<18}{'as tuned':>12}{'as the block':>14}"]
    for step in steps:
        for metric, of in COMPARED_METRICS.items():
            before, after = (_shown(float(frame[step.label][metric])) for frame in (tuned, run))
            lines += [f"  {f'{step.label} {unit}':<24}{f'{metric} [{of}]':<22}{before:>8}{after:>14}"]
    return [*lines, "", "To tune for the block, state what it has under [pid] of tuning.toml:", *_advice(own, values)]


def _verdict(loop: ClosedLoop, parameters: ParameterSet, block: Block) -> str:
    """How near the block is to the design, in a line."""
    form, found = BLOCK_FORMS[block], run_as_block(loop, parameters, block)[2]
    if found:
        points = "one point; it stands" if len(found) == 1 else f"{len(found)} points; they stand"
        return f"The block differs from the design in {points} at the end of this sheet, with its figures."
    back = loop.pid.limits and loop.pid.anti_windup is AntiWindup.BACK_CALCULATION
    late = block is Block.SIMULINK and back and loop.parallel_form(parameters).Ki != 0
    but = ", but for one sample: at a limit its back-calculation acts a sample later" if late else ""
    inferred = "; its formula is INFERRED: compare a step first" if form.is_inferred else ""
    return f"The block runs the design as it was tuned{but}{inferred}."


def _scale_lines(d: Design) -> list[str]:
    """That an output is in no output module's unit."""
    words = MECHANICAL_UNITS.get(d.command_unit)
    if words is None:
        return []
    return [
        f"THE OUTPUT IS {words.upper()}, not volts: behind the block apply your amplifier's scale, volts per "
        f"{d.command_unit}.",
        f"No scale is stated in the files; every limit and value of the output below is in {d.command_unit}.",
    ]


def _rest_words(d: Design, form: BlockForm) -> Iterator[str]:
    """What the design itself makes of its rest."""
    b = form.weights(d)[0]
    if d.is_added_to:
        yield "The sum of its surroundings is added to that."
    if b != 1 and d.gains.Kp and not d.integrates:
        off = f"Kp (b - 1) x setpoint, b = {b:g}"
        yield f"That is so at the setpoint 0; elsewhere the rest is off the centre by {off}: no integral is there."


def _wrap(lines: Iterable[str]) -> list[str]:
    fill = textwrap.TextWrapper(SHEET_WIDTH, "  ", "     ", break_on_hyphens=False)
    return [part for line in lines for part in fill.wrap(line)]


def _rows(settings: list[Setting]) -> list[str]:
    widths = [max(len(s[k]) for s in settings) for k in (0, 1)]
    return [f"  {s.name:<{widths[0]}}  {s.value:<{widths[1]}}  {s.formula}".rstrip() for s in settings]


def _checks(d: Design, first: Design, form: BlockForm) -> Iterator[str]:
    """What an engineer tries before the loop is closed."""
    rest = wire(d.centre, d)
    rises = "rise" if (d.gains.Kp or d.gains.Ki or d.gains.Kd) >= 0 else "fall"
    yield f"1. Centre: in manual ({form.manual}) and at error 0, {rest} stands on the wire and nothing moves."
    yield f"2. Sign: in manual, a little more than {rest} makes the {d.measured} {rises}; else turn a sign, not a gain."
    ends = [wire(v, d) if math.isfinite(v) else "no limit" for v in (d.low, d.high)]
    yield f"3. Limits: the least and the largest output on the wire are {ends[0]} and {ends[1]}."
    size = f"{first.measured_unit}, not in its thousandths"
    yield f"4. Units: setpoint and process value ({first.measured}) read the same at rest, both in {size}."
    yield f"5. Watchdog: pull the sensor, stop the controller: each time {rest} stands on the wire afterwards."


def _block_gains(loop: ClosedLoop, parameters: ParameterSet, form: BlockForm, found: list[str]) -> dict[str, float]:
    """Weights, filter and times as a block has them; what that changes is added to `found`."""
    design = design_of(acting_loop(loop, parameters), parameters, 0.0)
    gains, values = design.gains, dict[str, float]()
    matters = {"b": gains.Kp != 0, "c": gains.Kd != 0}
    for weight, wanted, own in zip("bc", (design.b, design.c), form.weights(design), strict=True):
        differs = own != wanted and matters[weight]
        found += [f"its set-point weight {weight} is {own:g}, the design's {wanted:g}"] if differs else []
        values[f"pid.{weight}"] = own
    if not form.has_filter and gains.Kd != 0 and gains.Tf != 0:
        found += [f"its derivative has no filter, the design's has one of {gains.Tf:g} s"]
        values["pid.Tf"] = 0.0
    if form.time_grain:
        rounded = _round_times(design, form)
        off = {n: v for n, v in rounded.items() if not math.isclose(v, getattr(gains, n), rel_tol=1e-9)}
        found += [f"its times are whole milliseconds: {', '.join(off)} change"] if off else []
        h = design.sample_time
        whole = math.isclose(h, form.time_grain * max(1, round(h / form.time_grain)), rel_tol=1e-9)
        found += [] if whole else [f"its cycle is in whole milliseconds: {h:g} s cannot be set; what follows keeps it"]
        values |= {f"pid.{n}": v for n, v in off.items()}
    return values


def _round_times(design: Design, form: BlockForm) -> dict[str, float]:
    """Ki, Kd and, of a derivative, Tf of times that are rounded."""
    gains, grain = design.gains, form.time_grain
    times = (*standard_times(design, form.title.partition(" (")[0]), gains.Tf)
    Ti, Td, Tf = (grain * round(t / grain) if math.isfinite(t) else t for t in times)
    found = {"Ki": gains.Kp / Ti if Ti else 0.0, "Kd": gains.Kp * Td}
    return found | ({"Tf": Tf} if design.differentiates else {})


def _shown(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "never"


def _advice(own: ClosedLoop, values: ParameterSet) -> list[str]:
    kind = f'  anti_windup = "{own.pid.anti_windup.value}"'
    weights = [f"  {n} = {values.value(f'pid.{n}'):g}" for n in ("b", "c")]
    return [*([kind] if own.pid.limits else []), *weights, *(['  Tf = "0 s"'] if values.value("pid.Tf") == 0 else [])]
