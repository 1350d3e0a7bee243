"""`export_settings`: the gains of a design for another maker's PID block, and what the design is worth as that runs.

A block holds a PID and limits. Around it a sheet may ask for what every controller has: a second block before it,
sums of constant gains into an input of the block, a sine. Whatever has a law of its own (a filter, an inverse, a
pulse, gains that change) has no counterpart there, and the design is refused: the block alone would be
another controller.
"""

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pneuopt.control.compensators import Compensator, MotionFeedforward
from pneuopt.control.controller import Controller
from pneuopt.control.dither import Waveform
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.pid import AntiWindup, Form, ParallelForm
from pneuopt.control.reference import Reference, as_references
from pneuopt.control.sensor import REFERENCE_SPEED, Encoder, SensorLag
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.export.makers import MAKER_BLOCKS, Block, BlockNumbers, MakerBlock, Setting, number, standard_times, wire
from pneuopt.export.program import check_sampled
from pneuopt.export.writer import check_name, comment_text
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import difference_unit, write_value

COMPARED_METRICS = {"SettlingTime": "s", "Overshoot": "%", "SteadyStateError": "%"}
"""What the two are compared by, and its unit."""
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
        A missing one has the loop's default.
    block : Block
        Whose block is set.
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
    check_sampled(loop.controller)
    loop.check(parameters)
    if measured_span is not None:
        message = f"measured_span must be positive and finite, got {measured_span:g} {loop.feedback.unit}"
        require(0 < measured_span < math.inf, message)
    maker_block, steps = MAKER_BLOCKS[block], as_references(references)
    acting = acting_controller(loop.controller, parameters)
    around = find_surroundings(acting, parameters, maker_block, steps, centre, measured_span)
    d = around.inner
    settings = maker_block.settings(d)  # first of all: it refuses what the block cannot have
    compared = compare_with_block(loop, parameters, block, steps)
    lines, unit = [_verdict(loop, parameters, block)], d.command_unit
    if unit in MECHANICAL_UNITS:
        scale = f"not volts: behind the block apply your amplifier's scale, volts per {unit}."
        lines += [f"THE OUTPUT IS {MECHANICAL_UNITS[unit].upper()}, {scale}"]
        lines += [f"No scale is stated in the files; every limit and value of the output below is in {unit}."]
    lines += [f"{maker_block.title}: the gains of {name}"]
    lines += [*map(comment_text, origin), "", "What stands around it, in the order of the signals", ""]
    lines += _wrap(around.lines)
    if around.outer:
        lines += ["", f"Settings of the outer block ({around.outer.measured})", ""]
        lines += _rows(maker_block.settings(around.outer))
    lines += ["", f"Settings{f' of the inner block ({d.measured})' if around.outer else ''}", "", *_rows(settings)]
    lines += ["", "What the output is", "", *_wrap(_output_words(d, maker_block))]
    lines += ["", "Check before you enable it", "", *_wrap(_checks(d, around.outer or d, maker_block))]
    lines += ["", f"Formula: {maker_block.formula}", "Sources:", *(f"- {source}" for source in maker_block.sources)]
    lines += ["", *compared] if compared else []
    return {f"{name}_{block.value}.txt": "\n".join(lines) + "\n"}


def describe_refusal(
    controller: Controller,
    parameters: ParameterSet,
    block: Block,
    references: Reference | Sequence[Reference],
    centre: float = 0.0,
) -> str:
    """Why a block cannot hold a design, as `export_settings` refuses it; empty where it can."""
    maker_block, steps = MAKER_BLOCKS[block], as_references(references)
    try:
        acting = acting_controller(controller, parameters)
        around = find_surroundings(acting, parameters, maker_block, steps, centre, None)
        for design in filter(None, (around.inner, around.outer)):
            maker_block.settings(design)
    except InputError as reason:
        return str(reason)
    return ""


def run_as_block(
    loop: ClosedLoop, parameters: ParameterSet, block: Block
) -> tuple[ClosedLoop, ParameterSet, list[str]]:
    """A loop whose controller is a maker's block with the same gains, its parameters, and in what it differs."""
    maker_block, found = MAKER_BLOCKS[block], list[str]()
    acting = acting_controller(loop.controller, parameters)
    integrates = loop.parallel_form(parameters).Ki != 0
    clamps = maker_block.clamps and loop.pid.limits and loop.pid.anti_windup is AntiWindup.BACK_CALCULATION
    kind = AntiWindup.CLAMPING if clamps else loop.pid.anti_windup
    found += ["its integral is clamped at a limit, the design's unwinds by back-calculation"] * (clamps and integrates)
    numbers = block_numbers(acting, parameters, 0.0)
    behind = integrates and maker_block.sum_input(numbers) is None and numbers.is_added_to
    found += [f"{BLIND_LIMITS} (simulated as if they saw it)"] if behind and loop.pid.limits else []
    found += ["it has no dead band of the integral"] if acting.pid.dead_band else []
    found += ["it has no reset of the integral"] if loop.pid.reset else []
    pid = replace(loop.pid, form=Form.PARALLEL, anti_windup=kind, dead_band=False, reset=False)
    parts = {n: getattr(acting, n) for n in ("dither", "feedforward", "compensators", "schedule")}
    own = replace(loop, pid=pid, **parts)
    gains = loop.parallel_form(parameters)
    values = {f"pid.{n}": v for n, v in vars(gains).items()} | _block_gains(loop, parameters, maker_block, found)
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
            figures = (float(frame[step.label][metric]) for frame in (tuned, run))
            before, after = (f"{figure:.4g}" if math.isfinite(figure) else "never" for figure in figures)
            lines += [f"  {f'{step.label} {unit}':<24}{f'{metric} [{of}]':<22}{before:>8}{after:>14}"]
    lines += ["", "To tune for the block, state what it has under [pid] of tuning.toml:"]
    lines += [f'  anti_windup = "{own.pid.anti_windup.value}"'] if own.pid.limits else []
    lines += [f"  {n} = {values.value(f'pid.{n}'):g}" for n in ("b", "c")]
    return [*lines, *(['  Tf = "0 s"'] if values.value("pid.Tf") == 0 else [])]


def _verdict(loop: ClosedLoop, parameters: ParameterSet, block: Block) -> str:
    """How near the block is to the design, in a line."""
    maker_block, found = MAKER_BLOCKS[block], run_as_block(loop, parameters, block)[2]
    if found:
        points = "one point; it stands" if len(found) == 1 else f"{len(found)} points; they stand"
        return f"The block differs from the design in {points} at the end of this sheet, with its figures."
    back = loop.pid.limits and loop.pid.anti_windup is AntiWindup.BACK_CALCULATION
    late = block is Block.SIMULINK and back and loop.parallel_form(parameters).Ki != 0
    but = ", but for one sample: at a limit its back-calculation acts a sample later" if late else ""
    inferred = "; its formula is INFERRED: compare a step first" if maker_block.is_inferred else ""
    return f"The block runs the design as it was tuned{but}{inferred}."


def _output_words(d: BlockNumbers, maker_block: MakerBlock) -> Iterator[str]:
    """What the output is at rest and while the block does not control, by the maker's states and the design's own."""
    b = maker_block.weights(d)[0]
    yield from maker_block.states(d)
    if d.is_added_to:
        yield "The sum of its surroundings is added to that."
    if b != 1 and d.gains.Kp and not d.integrates:
        off = f"Kp (b - 1) x setpoint, b = {b:g}"
        yield f"That is so at the setpoint 0; elsewhere the rest is off the centre by {off}: no integral is there."


def _wrap(lines: Iterable[str], width: int = 116) -> list[str]:
    fill = textwrap.TextWrapper(width, "  ", "     ", break_on_hyphens=False)
    return [part for line in lines for part in fill.wrap(line)]


def _rows(settings: list[Setting]) -> list[str]:
    widths = [max(len(s[k]) for s in settings) for k in (0, 1)]
    return [f"  {s.name:<{widths[0]}}  {s.value:<{widths[1]}}  {s.formula}".rstrip() for s in settings]


def _checks(d: BlockNumbers, first: BlockNumbers, maker_block: MakerBlock) -> Iterator[str]:
    """What an engineer tries before the loop is closed."""
    rest = d.at_rest
    rises = "rise" if (d.gains.Kp or d.gains.Ki or d.gains.Kd) >= 0 else "fall"
    yield f"1. Centre: in manual ({maker_block.manual}) and at error 0, {rest} stands on the wire and nothing moves."
    yield f"2. Sign: in manual, a little more than {rest} makes the {d.measured} {rises}; else turn a sign, not a gain."
    ends = [wire(v, d) if math.isfinite(v) else "no limit" for v in (d.low, d.high)]
    yield f"3. Limits: the least and the largest output on the wire are {ends[0]} and {ends[1]}."
    size = f"{first.measured_unit}, not in its thousandths"
    yield f"4. Units: setpoint and process value ({first.measured}) read the same at rest, both in {size}."
    yield f"5. Watchdog: pull the sensor, stop the controller: each time {rest} stands on the wire afterwards."


def _block_gains(
    loop: ClosedLoop, parameters: ParameterSet, maker_block: MakerBlock, found: list[str]
) -> dict[str, float]:
    """Weights, filter and times as a block has them; what that changes is added to `found`."""
    design = block_numbers(acting_controller(loop.controller, parameters), parameters, 0.0)
    gains, values = design.gains, dict[str, float]()
    matters = {"b": gains.Kp != 0, "c": gains.Kd != 0}
    for weight, wanted, own in zip("bc", (design.b, design.c), maker_block.weights(design), strict=True):
        differs = own != wanted and matters[weight]
        found += [f"its set-point weight {weight} is {own:g}, the design's {wanted:g}"] if differs else []
        values[f"pid.{weight}"] = own
    if not maker_block.has_filter and gains.Kd != 0 and gains.Tf != 0:
        found += [f"its derivative has no filter, the design's has one of {gains.Tf:g} s"]
        values["pid.Tf"] = 0.0
    if maker_block.time_grain:
        grain = maker_block.time_grain
        times = (*standard_times(design, maker_block.title.partition(" (")[0]), gains.Tf)
        Ti, Td, Tf = (grain * round(t / grain) if math.isfinite(t) else t for t in times)
        rounded = {"Ki": gains.Kp / Ti if Ti else 0.0, "Kd": gains.Kp * Td}
        rounded |= {"Tf": Tf} if design.differentiates else {}
        off = {n: v for n, v in rounded.items() if not math.isclose(v, getattr(gains, n), rel_tol=1e-9)}
        found += [f"its times are whole milliseconds: {', '.join(off)} change"] if off else []
        h = design.sample_time
        whole = math.isclose(h, grain * max(1, round(h / grain)), rel_tol=1e-9)
        found += [] if whole else [f"its cycle is in whole milliseconds: {h:g} s cannot be set; what follows keeps it"]
        values |= {f"pid.{n}": v for n, v in off.items()}
    return values


@dataclass(frozen=True)
class Surroundings:
    """What stands around a block, or around the two of a cascade."""

    lines: tuple[str, ...]  # from the sensor to the wire
    inner: BlockNumbers
    outer: BlockNumbers | None  # whose output is the setpoint of the inner one


def acting_controller(controller: Controller, parameters: ParameterSet) -> Controller:
    """The controller without the parts whose parameters make them add nothing."""
    value = controller.values(parameters)
    schedule, lead, dither = controller.schedule, controller.feedforward, controller.dither
    scheduled = schedule is not None and any(
        value[n]
        for n in controller.parameters
        if n.startswith("schedule.") and n.endswith(("_slope", "_curve", "_load"))
        if n != "schedule.nominal_load"
    )
    oscillates = dither is not None and (value["dither.amplitude"] != 0 or value["dither.offset"] != 0)

    def acts(part: Compensator) -> bool:
        sizes = ("speed", "acceleration") if isinstance(part, MotionFeedforward) else (part.size,)
        return any(value[f"{part.section}.{n}"] != 0 for n in sizes)

    return replace(
        controller,
        pid=replace(controller.pid, dead_band=controller.pid.dead_band and value["pid.dead_band"] > 0),
        dither=dither if oscillates else None,
        feedforward=lead if lead is not None and value["feedforward.gain"] != 0 else None,
        compensators=tuple(filter(acts, controller.compensators)),
        schedule=schedule if scheduled else None,
    )


def find_surroundings(
    controller: Controller,
    parameters: ParameterSet,
    maker_block: MakerBlock,
    references: Sequence[Reference],
    centre: float,
    measured_span: float | None,
) -> Surroundings:
    """What stands around a block, and the numbers of it or of a cascade's two; refuses what no block holds."""
    value = controller.values(parameters)
    low, high = _process_range(references, measured_span, controller.feedback.unit)
    inner, outer = block_numbers(controller, parameters, centre), None
    if controller.outer is None:
        inner = replace(inner, pv_low=low, pv_high=high, start=references[0].origin)
    else:  # proportional; it reaches its limits only with its process value out of range
        Kp, weight = (value[f"{controller.outer.section}.{n}"] for n in ("Kp", "weight"))
        motions = [r.trajectory(r.horizon / 1000) for r in references]  # a step has no speed
        speeds = (float(abs(t[REFERENCE_SPEED]).max()) for t in motions if REFERENCE_SPEED in t)
        top, on = Kp * (high - low) + weight * max(speeds, default=0.0), controller.feedback
        given = (math.nan, -top, top, 0.0, inner.sample_time, on.name, on.unit, inner.measured_unit, low, high)
        outer = BlockNumbers(ParallelForm(Kp), 1.0, 1.0, *given, goes="to the inner block", zero="no speed")
        inner = replace(inner, pv_low=-top, pv_high=top, reach="what the outer block gives at most")
    missing = "; ".join(_missing_parts(controller, value))
    title = maker_block.title.partition(" (")[0].partition(",")[0]
    told = f"{title} cannot hold this design: {missing}. No standard block of {maker_block.maker} stands for that"
    require(not missing, f"{told}; use --to st, which writes the whole controller")
    rest_is_inside = inner.low <= inner.centre <= inner.high
    told = f"the valve's centre, {write_value(centre, inner.command_unit)}, lies beyond the limits of the output"
    require(rest_is_inside, f"{told}: no setting of {maker_block.maker} rests there; mend the limits under [pid]")
    lines = list(_lines(controller, value, maker_block, inner, outer, references))
    return Surroundings(tuple(f"{k}. {line}" for k, line in enumerate(lines, 1)), inner, outer)


def block_numbers(controller: Controller, parameters: ParameterSet, centre: float) -> BlockNumbers:
    """The numbers of a controller's PID."""
    value = controller.values(parameters)
    motion = any(isinstance(c, MotionFeedforward) for c in controller.compensators)
    sampled_dither = controller.dither is not None and (not controller.dither.analogue or value["dither.offset"] != 0)
    return BlockNumbers(
        controller.parallel_form(parameters),
        value["pid.b"],
        value["pid.c"],
        value.get("pid.Tt", math.nan),
        value.get("pid.lower", -math.inf) + centre,
        value.get("pid.upper", math.inf) + centre,
        centre,
        controller.pid.sample_time or 0.0,
        controller.pid_signal.name,
        controller.pid_signal.unit,
        controller.command.unit,
        is_added_to=motion or sampled_dither,
    )


def _process_range(references: Sequence[Reference], span: float | None, unit: str) -> tuple[float, float]:
    """The least and the largest process value."""
    on_the_way = [float(v) for r in references for v in r.trajectory(r.horizon / 1000)["reference"]]
    values = [*(v for r in references for v in (r.origin, r.initial, r.final)), *on_the_way]
    low, high = min(values), max(values)
    if span is None:  # as far again beyond either end
        travel = high - low or max(abs(high), *(abs(r.nominal_size) for r in references)) or 1.0
        return low - travel, high + travel
    told = f"the process value's span of {write_value(span, difference_unit(unit))} does not hold the references, from"
    ends = f"{write_value(low, unit)} to {write_value(high, unit)}"
    require(span >= high - low, f"{told} {ends}; state a larger one")
    for ends_of_range in ((-span / 2, span / 2), (0.0, span), (-span, 0.0)):
        if ends_of_range[0] <= low and high <= ends_of_range[1]:
            return ends_of_range
    return (low + high - span) / 2, (low + high + span) / 2


def _missing_parts(controller: Controller, value: Mapping[str, float]) -> Iterator[str]:
    """The parts without a counterpart, with their numbers."""
    if isinstance(controller.sensor, Encoder) and controller.sensor.differentiates(controller.sensed_signal):
        yield f"the speed from an encoder's counts ({_numbers(controller, value, 'sensor')})"
    if controller.schedule is not None:
        yield f"a gain schedule of {', '.join(controller.schedule.gains)}"
    if controller.pid.dead_band:
        yield f"the integral's dead band ({_named_value('pid.dead_band', controller, value)})"
    if controller.pid.reset:
        yield "the integral's reset"
    if controller.feedforward is not None:
        yield f"the set-point lead feedforward ({_numbers(controller, value, 'feedforward')})"
    for part in controller.compensators:
        if not isinstance(part, MotionFeedforward):
            yield f"{part.section} ({_numbers(controller, value, part.section)})"


def _numbers(controller: Controller, value: Mapping[str, float], section: str) -> str:
    return ", ".join(_named_value(n, controller, value) for n in controller.parameters if n.startswith(f"{section}."))


def _named_value(name: str, controller: Controller, value: Mapping[str, float]) -> str:
    return f"{name.partition('.')[2]} = {write_value(value[name], controller.parameters[name].unit)}"


def _lines(
    controller: Controller,
    value: Mapping[str, float],
    maker_block: MakerBlock,
    inner: BlockNumbers,
    outer: BlockNumbers | None,
    references: Sequence[Reference],
) -> Iterator[str]:
    """From the setpoint and the sensor to the wire."""
    first = outer or inner
    example = max((abs(v) for r in references for v in (r.initial, r.final)), default=0.0) or first.pv_high
    unit = first.measured_unit
    typed = f"{write_value(example, unit)} is the number {number(example)}"
    yield f"Setpoint: the {first.measured} in {unit}; {typed}."
    seen = "; the design counts on no filter of it"
    if isinstance(controller.sensor, SensorLag):
        seen = f"; the design counts on a sensor with a lag of {write_value(value['sensor.lag'], 's')}: add no filter"
    elif isinstance(controller.sensor, Encoder) and controller.sensor.resolution:
        counted = controller.sensed_signal.outputs[controller.sensor.position].unit
        seen = f"; counted in steps of {write_value(value['sensor.resolution'], counted)}"
    yield f"Process value: the {first.measured}, in {unit}, too{'' if outer else seen}."
    if outer is not None:
        weight = value["position_loop.weight"]
        rate = f" + {number(weight)} x speed of the setpoint (0 where it steps)" if weight else ""
        speed = f"{inner.measured} in {inner.measured_unit}"
        yield f"Outer block: P of the {outer.measured}; its output{rate} is the setpoint of the inner block, a {speed}."
        yield f"Process value of the inner block: the {speed}, measured{seen}."
        yield "Order: enable the inner block first; hold the outer one in manual while the inner one is."
    terms = "".join(n for n, gain in zip("PID", (inner.gains.Kp, inner.gains.Ki, inner.gains.Kd), strict=True) if gain)
    yield f"{'Inner block' if outer else 'Block'}: {maker_block.title}; settings below, {terms or 'no gain'}."
    yield from _added_lines(controller, value, maker_block, inner)
    yield f"Limits: {_limit_words(inner, maker_block)}."
    zero = write_value(inner.centre, inner.command_unit)
    yield f"Centre: {zero} on the wire is the command 0, at which the valve is closed or the drive without force."
    if controller.pid.delay:
        yield "Delay: the design counts on one sample from reading to acting: write the output at the next sample."
    if controller.dither is not None and controller.dither.analogue and value["dither.amplitude"]:
        size = write_value(value["dither.amplitude"], controller.command.unit)
        wave, frequency = controller.dither.waveform.value, number(value["dither.frequency"])
        yield f"Generator behind the output: a {wave} of {size} peak at {frequency} Hz; hardware."


def _added_lines(
    controller: Controller, value: Mapping[str, float], maker_block: MakerBlock, inner: BlockNumbers
) -> Iterator[str]:
    is_speed = REFERENCE_SPEED not in (q.name for q in controller.inputs)  # a loop of the speed: the setpoint is one
    speed = "setpoint" if is_speed else "speed of the setpoint"
    motion = {"speed": speed, "acceleration": "acceleration of the setpoint"}
    gains = {f"{MotionFeedforward.section}.{n}": factor for n, factor in motion.items()}
    terms = [
        f"{write_value(value[gain], controller.parameters[gain].unit, 9)} x {factor}"
        for gain, factor in gains.items()
        if value.get(gain)
    ]
    if controller.dither is not None:
        unit, turns = controller.command.unit, f"{number(value['dither.frequency'] * inner.sample_time)} k"
        is_sine = controller.dither.waveform is Waveform.SINE
        wave = f"sin(2 pi frac({turns}))" if is_sine else f"(1 - 4 abs(frac({turns} + 0.25) - 0.5))"
        size = f"{write_value(value['dither.amplitude'], unit, 9)} x {wave}, k the number of the sample"
        terms += [write_value(value["dither.offset"], unit, 9)] if value["dither.offset"] else []
        terms += [size] if not controller.dither.analogue and value["dither.amplitude"] else []
    if terms:
        where = maker_block.sum_input(inner) or "a sum behind the block, before the limits"
        yield f"Sum: {' + '.join(terms)}; in your program once a sample, 0 while the block is not in automatic."
        yield f"Where it goes: {where}."


def _limit_words(d: BlockNumbers, maker_block: MakerBlock) -> str:
    if not (math.isfinite(d.low) or math.isfinite(d.high)):
        return "the design has none; the output stage has its own"
    ends = [write_value(v, d.command_unit) if math.isfinite(v) else "none" for v in (d.low, d.high)]
    if not d.is_added_to or maker_block.sum_input(d) is not None:
        return f"{ends[0]} to {ends[1]} on the wire, in the block"
    own = "; the block has the same, for its integral" if d.integrates else ""
    return f"{ends[0]} to {ends[1]} on the wire, behind that sum, in your program{own}"
