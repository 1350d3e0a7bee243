"""`export_settings`: the gains of a design for another maker's PID block, and what the design is worth as that runs."""

import math
from collections.abc import Sequence
from dataclasses import replace

from pneuopt.control.forms import Form
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.pid import AntiWindup
from pneuopt.control.reference import Reference, as_references
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.export.header import check_name, comment_text
from pneuopt.export.vendor_blocks import BLOCK_FORMS, Block, BlockForm, Design
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, require
from pneuopt.quantities.parameters import ParameterSet

COMPARED_METRICS = {"SettlingTime": "s", "Overshoot": "%", "SteadyStateError": "%"}
"""What the two are compared by, and its unit."""


def export_settings(
    loop: ClosedLoop,
    parameters: ParameterSet,
    block: Block,
    references: Reference | Sequence[Reference],
    *,
    name: str = "controller",
    centre: float = 0.0,
    origin: Sequence[str] = (),
    measured_span: float = 1.0,
) -> dict[str, str]:
    """Write what is to be typed into a PID block, with formula and source, and the design as that block runs it.

    The loop is simulated with the block's set-point weights, filter, rounding of times and anti-windup; what the block
    has not at all (dither, feedforward, compensators, an outer loop) is taken to be programmed around it, as in the
    design.

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
    measured_span : float
        From the least to the largest process value as the block scales it [the measured unit]; Rockwell's gains
        are for errors in percent of it.

    Returns
    -------
    dict of str to str
        The text by its file's name.

    Raises
    ------
    InputError
        If the block cannot have these gains (Kp = 0 in the standard form), or the loop is continuous.
    """
    check_closed_loop(loop)
    check_name(name)
    told = "a continuous controller cannot be exported: give it a sample time, sample_time under [pid], and tune again"
    require(loop.pid.sample_time is not None, told, ModelError)
    loop.check(parameters)
    message = f"measured_span must be positive and finite, got {measured_span:g} {loop.feedback.unit}"
    require(0 < measured_span < math.inf, message)
    form, design = BLOCK_FORMS[block], replace(_design(loop, parameters, centre), measured_span=measured_span)
    lines = [f"{form.title}: the gains of {name}", *map(comment_text, origin), "", "Settings", ""]
    settings = form.settings(design)
    widths = [max(len(s[k]) for s in settings) for k in (0, 1)]
    lines += [f"  {s.name:<{widths[0]}}  {s.value:<{widths[1]}}  {s.formula}" for s in settings]
    lines += ["", f"Formula: {form.formula}", "Sources:", *(f"- {source}" for source in form.sources), ""]
    lines += compare_with_block(loop, parameters, block, references)
    return {f"{name}_{block.value}.txt": "\n".join(lines) + "\n"}


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
    clamps = form.clamps and loop.pid.limits and loop.pid.anti_windup is AntiWindup.BACK_CALCULATION
    kind = AntiWindup.CLAMPING if clamps else loop.pid.anti_windup
    found += ["its integral is clamped at a limit, the design's unwinds by back-calculation"] if clamps else []
    found += ["it has no dead band of the integral"] if loop.pid.dead_band else []
    found += ["it has no reset of the integral"] if loop.pid.reset else []
    pid = replace(loop.pid, form=Form.PARALLEL, anti_windup=kind, dead_band=False, reset=False)
    own = replace(loop, pid=pid)
    gains = loop.parallel_form(parameters)
    values = {f"pid.{n}": v for n, v in vars(gains).items()} | _block_gains(loop, parameters, form, found)
    shared = parameters.select(n for n in parameters if n in own.parameters and n not in values)
    return own, own.parameters.with_values({n: p.value for n, p in shared.items()} | values), found


def compare_with_block(
    loop: ClosedLoop, parameters: ParameterSet, block: Block, references: Reference | Sequence[Reference]
) -> list[str]:
    """Lines that say what a design is worth as a block runs it, beside what it is worth as tuned."""
    own, values, found = run_as_block(loop, parameters, block)
    if not found:
        late = block is Block.SIMULINK and loop.pid.limits and loop.pid.anti_windup is AntiWindup.BACK_CALCULATION
        but = ", but for one sample: at a limit its back-calculation acts a sample later" if late else ""
        return [f"The block runs the design as it was tuned{but}."]
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


def _block_gains(loop: ClosedLoop, parameters: ParameterSet, form: BlockForm, found: list[str]) -> dict[str, float]:
    """Weights, filter and times as a block has them; what that changes is added to `found`."""
    given = loop.complete(parameters)
    gains, values = loop.parallel_form(parameters), dict[str, float]()
    for weight in ("b", "c"):
        wanted = given.value(f"pid.{weight}")
        own = min(form.weights, key=lambda v: abs(v - wanted)) if form.weights else wanted
        matters = weight == "b" or gains.Kd != 0
        found += (
            [f"its set-point weight {weight} is {own:g}, the design's {wanted:g}"] if own != wanted and matters else []
        )
        values[f"pid.{weight}"] = own
    if not form.has_filter and gains.Kd != 0 and gains.Tf != 0:
        found += [f"its derivative has no filter, the design's has one of {gains.Tf:g} s"]
        values["pid.Tf"] = 0.0
    if form.time_grain:
        rounded = _round_times(loop, parameters, form.time_grain)
        off = {n: v for n, v in rounded.items() if not math.isclose(v, getattr(gains, n), rel_tol=1e-9)}
        found += [f"its times are whole milliseconds: {', '.join(off)} change"] if off else []
        h = loop.pid.sample_time or 0.0
        whole = math.isclose(h, form.time_grain * max(1, round(h / form.time_grain)), rel_tol=1e-9)
        found += [] if whole else [f"its cycle is in whole milliseconds: {h:g} s cannot be set; what follows keeps it"]
        values |= {f"pid.{n}": v for n, v in off.items()}
    return values


def _round_times(loop: ClosedLoop, parameters: ParameterSet, grain: float) -> dict[str, float]:
    """Ki, Kd and Tf of times that are rounded."""
    gains = loop.parallel_form(parameters)
    design = _design(loop, parameters, 0.0)
    Ti, Td = design.times
    whole = [grain * round(t / grain) if math.isfinite(t) else t for t in (Ti, Td, gains.Tf)]
    return {"Ki": gains.Kp / whole[0] if whole[0] else 0.0, "Kd": gains.Kp * whole[1], "Tf": whole[2]}


def _design(loop: ClosedLoop, parameters: ParameterSet, centre: float) -> Design:
    value = {n: p.value for n, p in loop.complete(parameters).items()}
    return Design(
        loop.parallel_form(parameters),
        value["pid.b"],
        value["pid.c"],
        value.get("pid.Tt", math.nan),
        value.get("pid.lower", -math.inf) + centre,
        value.get("pid.upper", math.inf) + centre,
        centre,
        loop.pid.sample_time or 0.0,
        loop.feedback.unit,
        loop.command.unit,
    )


def _shown(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "never"


def _advice(own: ClosedLoop, values: ParameterSet) -> list[str]:
    kind = f'  anti_windup = "{own.pid.anti_windup.value}"'
    weights = [f"  {n} = {values.value(f'pid.{n}'):g}" for n in ("b", "c")]
    return [*([kind] if own.pid.limits else []), *weights, *(['  Tf = "0 s"'] if values.value("pid.Tf") == 0 else [])]
