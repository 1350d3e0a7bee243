"""`find_surroundings`: what of a design stands around a maker's PID block, in the order of the signals.

A block holds a PID and limits. Around it a sheet may ask for what every controller has: a second block before it,
sums of constant gains into an input of the block, a sine. Whatever has a law of its own (a filter, an inverse, a
pulse, gains that change) has no counterpart there, and the design is refused: the block alone would be
another controller.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pneuopt.control.compensators import MotionFeedforward
from pneuopt.control.dither import Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import ParallelForm
from pneuopt.control.reference import Reference
from pneuopt.control.sensor import REFERENCE_SPEED, Encoder, SensorLag
from pneuopt.export.makers.block_form import BlockForm, Design, number
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.unit_algebra import difference_unit
from pneuopt.quantities.units import write_value

RANGE_MARGIN = 1.0  # travels of the references that the process value's range goes beyond them, at either end


@dataclass(frozen=True)
class Surroundings:
    """What stands around a block.

    Attributes
    ----------
    lines : tuple of str
        From the sensor to the wire.
    inner : Design
        The block itself.
    outer : Design or None
        A cascade's outer block, whose output is the setpoint of the inner one.
    """

    lines: tuple[str, ...]
    inner: Design
    outer: Design | None


def acting_loop(loop: ClosedLoop, parameters: ParameterSet) -> ClosedLoop:
    """The loop without the parts whose parameters make them add nothing."""
    value = _values(loop, parameters)
    schedule, lead, dither = loop.schedule, loop.feedforward, loop.dither
    scheduled = schedule is not None and any(
        value[n]
        for n in loop.parameters
        if n.startswith("schedule.") and n.endswith(("_slope", "_curve", "_load"))
        if n != "schedule.nominal_load"
    )
    oscillates = dither is not None and (value["dither.amplitude"] != 0 or value["dither.offset"] != 0)
    return replace(
        loop,
        pid=replace(loop.pid, dead_band=loop.pid.dead_band and value["pid.dead_band"] > 0),
        dither=dither if oscillates else None,
        feedforward=lead if lead is not None and value["feedforward.gain"] != 0 else None,
        compensators=tuple(c for c in loop.compensators if _acts(c, value)),
        schedule=schedule if scheduled else None,
    )


def find_surroundings(
    loop: ClosedLoop,
    parameters: ParameterSet,
    form: BlockForm,
    references: Sequence[Reference],
    centre: float,
    measured_span: float | None,
) -> Surroundings:
    """What stands around a block, as lines, and the numbers of the block or of the two of a cascade.

    Parameters
    ----------
    loop : ClosedLoop
        Of `acting_loop`.
    parameters : ParameterSet
    form : BlockForm
    references : sequence of Reference
        Whose values the range of the process value holds.
    centre : float
        Of the valve [the command's unit].
    measured_span : float, optional
        Of the process value [its unit]; by default of the references and their travel again beyond either end.

    Raises
    ------
    InputError
        If a part of the design has no counterpart among the maker's standard blocks.
    """
    value = _values(loop, parameters)
    low, high = _process_range(references, measured_span, loop.feedback.unit)
    outer = _outer_design(loop, value, references, (low, high))
    if outer is not None:
        low, high = outer.low, outer.high
    inner = replace(design_of(loop, parameters, centre), pv_low=low, pv_high=high)
    given = references[0].origin
    inner = replace(inner, start=given) if outer is None else replace(inner, reach="what the outer block gives at most")
    _check_parts(loop, value, form)
    rest_is_inside = inner.low <= inner.centre <= inner.high
    told = f"the valve's centre, {write_value(centre, inner.command_unit)}, lies beyond the limits of the output"
    require(rest_is_inside, f"{told}: no setting of {form.maker} rests there; mend the limits under [pid]")
    lines = list(_lines(loop, value, form, inner, outer, references))
    return Surroundings(tuple(f"{k}. {line}" for k, line in enumerate(lines, 1)), inner, outer)


def design_of(loop: ClosedLoop, parameters: ParameterSet, centre: float) -> Design:
    """The numbers of a loop's PID."""
    value = _values(loop, parameters)
    motion = any(isinstance(c, MotionFeedforward) for c in loop.compensators)
    sampled_dither = loop.dither is not None and (not loop.dither.analogue or value["dither.offset"] != 0)
    return Design(
        loop.parallel_form(parameters),
        value["pid.b"],
        value["pid.c"],
        value.get("pid.Tt", math.nan),
        value.get("pid.lower", -math.inf) + centre,
        value.get("pid.upper", math.inf) + centre,
        centre,
        loop.pid.sample_time or 0.0,
        loop.pid_signal.name,
        loop.pid_signal.unit,
        loop.command.unit,
        is_added_to=motion or sampled_dither,
    )


def _values(loop: ClosedLoop, parameters: ParameterSet) -> dict[str, float]:
    return {n: p.value for n, p in loop.complete(parameters).items()}


def _acts(part: object, value: Mapping[str, float]) -> bool:
    section, size = getattr(part, "section"), getattr(part, "size")  # noqa: B009 - of the protocol of compensators
    sizes = ("speed", "acceleration") if isinstance(part, MotionFeedforward) else (size,)
    return any(value[f"{section}.{n}"] != 0 for n in sizes)


def _process_range(references: Sequence[Reference], span: float | None, unit: str) -> tuple[float, float]:
    """The least and the largest process value."""
    low = min(min(r.origin, r.initial, r.final, *_values_of(r)) for r in references)
    high = max(max(r.origin, r.initial, r.final, *_values_of(r)) for r in references)
    if span is None:
        travel = (high - low or max(abs(high), *(abs(r.nominal_size) for r in references)) or 1.0) * RANGE_MARGIN
        return low - travel, high + travel
    told = f"the process value's span of {write_value(span, difference_unit(unit))} does not hold the references, from"
    ends = f"{write_value(low, unit)} to {write_value(high, unit)}"
    require(span >= high - low, f"{told} {ends}; state a larger one")
    for ends_of_range in ((-span / 2, span / 2), (0.0, span), (-span, 0.0)):
        if ends_of_range[0] <= low and high <= ends_of_range[1]:
            return ends_of_range
    return (low + high - span) / 2, (low + high + span) / 2


def _values_of(reference: Reference) -> list[float]:
    step = reference.horizon / 1000
    return [float(v) for v in reference.trajectory(step)["reference"]]


def _top_speed(references: Sequence[Reference]) -> float:
    """The largest speed that a reference states of itself; 0 of steps."""
    found = [r.trajectory(r.horizon / 1000) for r in references]
    return max((float(abs(t[REFERENCE_SPEED]).max()) for t in found if REFERENCE_SPEED in t), default=0.0)


def _outer_design(
    loop: ClosedLoop, value: Mapping[str, float], references: Sequence[Reference], span: tuple[float, float]
) -> Design | None:
    """The outer block of a cascade: proportional; it reaches its limits only with its process value out of range."""
    if loop.outer is None:
        return None
    Kp, weight = (value[f"{loop.outer.section}.{n}"] for n in ("Kp", "weight"))
    top = Kp * (span[1] - span[0]) + weight * _top_speed(references)
    gains, h = ParallelForm(Kp), loop.pid.sample_time or 0.0
    on, speed = loop.feedback, loop.pid_signal.unit
    found = Design(gains, 1.0, 1.0, math.nan, -top, top, 0.0, h, on.name, on.unit, speed, *span)
    return replace(found, goes="to the inner block", zero="no speed")


def _check_parts(loop: ClosedLoop, value: Mapping[str, float], form: BlockForm) -> None:
    missing = list(_missing_parts(loop, value))
    block = form.title.partition(" (")[0].partition(",")[0]
    told = f"{block} cannot hold this design: {'; '.join(missing)}. No standard block of {form.maker} stands for that"
    remedy = "use --to st, which writes the whole controller"
    require(not missing, f"{told}; {remedy}")


def _missing_parts(loop: ClosedLoop, value: Mapping[str, float]) -> Iterator[str]:
    """The parts without a counterpart, with their numbers."""
    if isinstance(loop.sensor, Encoder) and loop.sensor.differentiates(loop.sensed_signal):
        yield f"the speed from an encoder's counts ({_numbers(loop, value, 'sensor')})"
    if loop.schedule is not None:
        yield f"a gain schedule of {', '.join(loop.schedule.gains)}"
    if loop.pid.dead_band:
        yield f"the integral's dead band ({_shown('pid.dead_band', loop, value)})"
    if loop.pid.reset:
        yield "the integral's reset"
    if loop.feedforward is not None:
        yield f"the set-point lead feedforward ({_numbers(loop, value, 'feedforward')})"
    for part in loop.compensators:
        if not isinstance(part, MotionFeedforward):
            yield f"{part.section} ({_numbers(loop, value, part.section)})"


def _numbers(loop: ClosedLoop, value: Mapping[str, float], section: str) -> str:
    return ", ".join(_shown(n, loop, value) for n in loop.parameters if n.startswith(f"{section}."))


def _shown(name: str, loop: ClosedLoop, value: Mapping[str, float]) -> str:
    return f"{name.partition('.')[2]} = {write_value(value[name], loop.parameters[name].unit)}"


def _lines(
    loop: ClosedLoop,
    value: Mapping[str, float],
    form: BlockForm,
    inner: Design,
    outer: Design | None,
    references: Sequence[Reference],
) -> Iterator[str]:
    """From the setpoint and the sensor to the wire."""
    first = outer or inner
    example = max((abs(v) for r in references for v in (r.initial, r.final)), default=0.0) or first.pv_high
    unit = first.measured_unit
    typed = f"{write_value(example, unit)} is the number {number(example)}"
    yield f"Setpoint: the {first.measured} in {unit}; {typed}."
    seen = _sensor_words(loop, value)
    yield f"Process value: the {first.measured}, in {unit}, too{'' if outer else seen}."
    if outer is not None:
        weight = value["position_loop.weight"]
        rate = f" + {number(weight)} x speed of the setpoint (0 where it steps)" if weight else ""
        speed = f"{inner.measured} in {inner.measured_unit}"
        yield f"Outer block: P of the {outer.measured}; its output{rate} is the setpoint of the inner block, a {speed}."
        yield f"Process value of the inner block: the {speed}, measured{seen}."
        yield "Order: enable the inner block first; hold the outer one in manual while the inner one is."
    yield f"{'Inner block' if outer else 'Block'}: {form.title}; {_block_words(inner)}."
    yield from _added_lines(loop, value, form, inner)
    yield f"Limits: {_limit_words(inner, form)}."
    zero = write_value(inner.centre, inner.command_unit)
    yield f"Centre: {zero} on the wire is the command 0, at which the valve is closed or the drive without force."
    yield from _hardware_lines(loop, value)


def _sensor_words(loop: ClosedLoop, value: Mapping[str, float]) -> str:
    if isinstance(loop.sensor, SensorLag):
        return f"; the design counts on a sensor with a lag of {write_value(value['sensor.lag'], 's')}: add no filter"
    if isinstance(loop.sensor, Encoder) and loop.sensor.resolution:
        unit = loop.sensed_signal.outputs[loop.sensor.position].unit
        return f"; counted in steps of {write_value(value['sensor.resolution'], unit)}"
    return "; the design counts on no filter of it"


def _block_words(d: Design) -> str:
    terms = (("P", d.gains.Kp), ("I", d.gains.Ki), ("D", d.gains.Kd))
    return "settings below, " + ("".join(n for n, gain in terms if gain) or "no gain")


def _added_lines(loop: ClosedLoop, value: Mapping[str, float], form: BlockForm, inner: Design) -> Iterator[str]:
    terms = [*_motion_terms(loop, value), *_dither_terms(loop, value, inner.sample_time)]
    if terms:
        where = form.added(inner) if form.added else "a sum behind the block, before the limits"
        yield f"Sum: {' + '.join(terms)}; in your program once a sample, 0 while the block is not in automatic."
        yield f"Where it goes: {where}."


def _motion_terms(loop: ClosedLoop, value: Mapping[str, float]) -> Iterator[str]:
    is_speed = REFERENCE_SPEED not in (q.name for q in loop.inputs)  # a loop of the speed: the setpoint is one
    factors = {
        "speed": "setpoint" if is_speed else "speed of the setpoint",
        "acceleration": "acceleration of the setpoint",
    }
    for part in loop.compensators:
        for name, factor in factors.items() if isinstance(part, MotionFeedforward) else ():
            gain = f"{part.section}.{name}"
            if value[gain]:
                yield f"{write_value(value[gain], loop.parameters[gain].unit, 9)} x {factor}"


def _dither_terms(loop: ClosedLoop, value: Mapping[str, float], sample_time: float) -> Iterator[str]:
    if loop.dither is None:
        return
    unit, turns = loop.command.unit, f"{number(value['dither.frequency'] * sample_time)} k"
    is_sine = loop.dither.waveform is Waveform.SINE
    wave = f"sin(2 pi frac({turns}))" if is_sine else f"(1 - 4 abs(frac({turns} + 0.25) - 0.5))"
    if value["dither.offset"]:
        yield write_value(value["dither.offset"], unit, 9)
    if not loop.dither.analogue and value["dither.amplitude"]:
        yield f"{write_value(value['dither.amplitude'], unit, 9)} x {wave}, k the number of the sample"


def _limit_words(d: Design, form: BlockForm) -> str:
    if not (math.isfinite(d.low) or math.isfinite(d.high)):
        return "the design has none; the output stage has its own"
    ends = [write_value(v, d.command_unit) if math.isfinite(v) else "none" for v in (d.low, d.high)]
    if not d.is_added_to or form.added is not None:
        return f"{ends[0]} to {ends[1]} on the wire, in the block"
    own = "; the block has the same, for its integral" if d.integrates else ""
    return f"{ends[0]} to {ends[1]} on the wire, behind that sum, in your program{own}"


def _hardware_lines(loop: ClosedLoop, value: Mapping[str, float]) -> Iterator[str]:
    if loop.pid.delay:
        yield "Delay: the design counts on one sample from reading to acting: write the output at the next sample."
    if loop.dither is not None and loop.dither.analogue and value["dither.amplitude"]:
        size, frequency = write_value(value["dither.amplitude"], loop.command.unit), number(value["dither.frequency"])
        yield f"Generator behind the output: a {loop.dither.waveform.value} of {size} peak at {frequency} Hz; hardware."
