"""The gains for makers' PID blocks: the numbers by the makers' own formulas, and the design as the block runs it."""

import re
from typing import Any

import numpy as np
import pytest

from pneuopt.control.compensators import (
    AccelerationFeedback,
    DeadZoneInverse,
    FrictionFeedforward,
    ImpulsiveControl,
    Knocker,
    MotionFeedforward,
    PressureFeedback,
)
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID, AntiWindup, Form, SeriesForm, to_parallel
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.export.blocks import export_settings, run_as_block
from pneuopt.export.languages import Language, export_controller
from pneuopt.export.makers import MAKER_BLOCKS, Block
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from tests.export.maker_emulations import emulations, is_close, read_settings

GAINS = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.Kd": 0.5, "pid.Tf": 4.6e-3, "pid.b": 0.8}
STEP = Step(0.2, horizon=0.6)


def saturated(dead_band: bool = False) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(2e-3, dead_band=dead_band))
    return loop, loop.parameters.with_values({**GAINS, "pid.lower": -46.0, "pid.upper": 46.0})


def settings(block: Block) -> dict[str, float]:
    """The numbers of the settings by their names."""
    loop, given = saturated()
    (text,) = export_settings(loop, given, block, Step(0.2, horizon=0.02), measured_span=1.0).values()
    rows = {name: re.fullmatch(r"(T#)?(-?[\d.e+-]+)(ms)?", value) for name, value in read_settings(text).items()}
    return {name: float(found[2]) / (1000 if found[1] else 1) for name, found in rows.items() if found}


def test_the_numbers_make_the_design_by_each_makers_formula() -> None:
    """Kp, Ki, Kd and Tf again, from what is typed in."""
    s = settings(Block.SIEMENS)
    Kp, Ti, Td = s["Retain.CtrlParams.Gain"] * 92 / 100, s["Retain.CtrlParams.Ti"], s["Retain.CtrlParams.Td"]
    assert (Kp, Kp / Ti, Kp * Td, s["Retain.CtrlParams.TdFiltRatio"] * Td) == pytest.approx((200, 4000, 0.5, 4.6e-3))
    s = settings(Block.ROCKWELL)
    R = 92.0
    assert [s[f"PID .{n}"] * R for n in ("KP", "KI", "KD")] == pytest.approx([200, 4000, 0.5])
    assert [s["PIDE PGain"] * R, s["PIDE IGain"] / 60 * R, s["PIDE DGain"] * 60 * R] == pytest.approx([200, 4000, 0.5])
    s = {n.partition(".")[2]: v for n, v in settings(Block.CODESYS).items()}
    assert (s["KP"], s["KP"] / s["TN"], s["KP"] * s["TV"]) == pytest.approx((200, 4000, 0.5))
    s = settings(Block.SIMULINK)
    assert (s["P"], s["I"], s["D"], 1 / s["N"], 1 / s["Kb"]) == pytest.approx((200, 4000, 0.5, 4.6e-3, 0.1))
    s = settings(Block.BECKHOFF)
    assert (s["fKp"], s["tTn"], s["tTd"]) == pytest.approx((200, 0.05, 0.005))


def test_rockwells_gains_scale_with_the_span_of_its_process_value() -> None:
    loop, given = saturated()
    short = Step(0.2, horizon=0.02)
    (text,) = export_settings(loop, given, Block.ROCKWELL, short, measured_span=0.5).values()
    assert re.search(rf"PID \.KP +{200 * 0.5 / 92:.9g} +Kp S/R, S the span of PV, here 0.5 m/s", text)


def test_what_is_inferred_or_a_sample_late_is_said() -> None:
    loop, given = saturated()
    for block in Block:
        (text,) = export_settings(loop, given, block, Step(0.2, horizon=0.02)).values()
        assert ("INFERRED" in text) == (block in (Block.BECKHOFF, Block.CODESYS))
        assert ("back-calculation acts a sample later" in text) == (block is Block.SIMULINK)


@pytest.mark.parametrize("block", Block)
def test_a_series_form_is_exported_as_its_parallel_one(block: Block) -> None:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(2e-3, form=Form.SERIES, limits=False))
    values = {"pid.K": 100.0, "pid.Ti": 0.1, "pid.Td": 0.01, "pid.Tf": 4e-3}
    own, given, _ = run_as_block(loop, loop.parameters.with_values(values), block)
    wanted = to_parallel(SeriesForm(100.0, 0.1, 0.01, 4e-3))
    assert given.value("pid.Kp") == pytest.approx(wanted.Kp)
    assert given.value("pid.Ki") == pytest.approx(wanted.Ki, rel=0.02)
    assert own.pid.form is Form.PARALLEL


def test_a_block_that_runs_the_design_changes_nothing() -> None:
    loop, given = saturated()
    own, values, found = run_as_block(loop, given, Block.SIMULINK)
    assert found == []
    mine, theirs = (evaluate(*pair)[STEP.label]["Overshoot"] for pair in ((loop, STEP, given), (own, STEP, values)))
    assert mine == theirs
    (text,) = export_settings(loop, given, Block.SIMULINK, STEP).values()
    assert "The block runs the design as it was tuned" in text


def test_what_differs_is_named_simulated_and_shown_beside_the_design() -> None:
    loop, given = saturated(dead_band=True)
    banded = given.with_values({"pid.dead_band": 1e-3})
    own, values, found = run_as_block(loop, banded, Block.CODESYS)
    assert [f.partition(",")[0] for f in found] == [
        "its integral is clamped at a limit",
        "it has no dead band of the integral",
        "its set-point weight b is 1",
        "its derivative has no filter",
    ]
    assert own.pid == PID(2e-3, anti_windup=AntiWindup.CLAMPING)
    assert (values.value("pid.b"), values.value("pid.Tf")) == (1.0, 0.0)
    (text,) = export_settings(loop, given, Block.CODESYS, STEP).values()
    tuned, run = evaluate(loop, STEP, given)[STEP.label], evaluate(own, STEP, values)[STEP.label]
    assert tuned["Overshoot"] > 1.0 > run["Overshoot"]
    assert re.search(rf"Overshoot \[%\] +{tuned['Overshoot']:.4g} +{run['Overshoot']:.4g}$", text, re.MULTILINE)


def test_beckhoffs_times_are_whole_milliseconds() -> None:
    loop, given = saturated()
    _, values, found = run_as_block(loop, given, Block.BECKHOFF)
    assert any("whole milliseconds: Kd, Tf change" in f for f in found)
    assert (values.value("pid.Tf"), values.value("pid.Kd")) == pytest.approx((0.005, 0.4))
    fast = ClosedLoop(ForceDrive(Stribeck()).system(), PID(5e-4))
    assert any("0.0005 s cannot be set" in f for f in run_as_block(fast, fast.parameters, Block.BECKHOFF)[2])


def test_every_block_says_its_formula_and_sources() -> None:
    for form in MAKER_BLOCKS.values():
        assert form.formula
        assert len(form.sources) >= 2
        assert all(text.isascii() and len(text) < 140 for text in (form.formula, *form.sources))


H = 2e-3
FULL = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.Kd": 0.8, "pid.Tf": 4e-3}
ZEROS = ("none", "pid.Kp", "pid.Ki", "pid.Kd", "pid.Tf", "pid.Ki pid.Kd", "pid.Kp pid.Ki pid.Kd")
WITHOUT_FILTER = (Block.ROCKWELL, Block.CODESYS)
MAKER_SHEETS_STEP = Step(0.01, horizon=0.02)
INPUTS = [(0.0, 0.0)] * 5 + [(0.01, 0.0), (0.01, 0.0005), (0.01, 0.002), (0.01, 0.006), (0.01, 0.009), (0.01, 0.0099)]


def force_loop(values: dict[str, float], pid: PID | None = None, **parts: Any) -> tuple[ClosedLoop, ParameterSet]:
    clamping = PID(H, anti_windup=AntiWindup.CLAMPING)
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), pid or clamping, **parts)
    return loop, loop.parameters.with_values({"pid.lower": -46.0, "pid.upper": 40.0, **values})


def sheet(loop: ClosedLoop, given: ParameterSet, block: Block, centre: float = 0.0, **more: Any) -> str:
    (text,) = export_settings(
        loop, given, block, more.pop("references", MAKER_SHEETS_STEP), centre=centre, **more
    ).values()
    return text


def library(loop: ClosedLoop, given: ParameterSet, centre: float) -> Any:
    """The library's own law as the Python class that it exports."""
    space: dict[str, Any] = {}
    exec(export_controller(loop, given, Language.PYTHON, name="own", centre=centre)["own.py"], space)
    return space["Own"]()


@pytest.mark.parametrize("centre", [0.0, 5.0])
@pytest.mark.parametrize("zeros", ZEROS)
@pytest.mark.parametrize("block", Block)
def test_the_block_rests_at_the_centre_and_answers_as_the_design(block: Block, zeros: str, centre: float) -> None:
    """Or the sheet is refused in a sentence: a gain of zero has no third way."""
    values = {**FULL, **({"pid.Tf": 0.0} if block in WITHOUT_FILTER else {}), **dict.fromkeys(zeros.split(), 0.0)}
    values.pop("none", None)
    loop, given = force_loop(values)
    if zeros == "pid.Kp" and block in (Block.SIEMENS, Block.BECKHOFF, Block.CODESYS):
        with pytest.raises(InputError, match="Kp = 0"):
            sheet(loop, given, block, centre)
        return
    blocks = emulations(block.value, sheet(loop, given, block, centre), H)
    assert blocks
    for own in blocks:
        law = library(loop, given, centre)
        own.start(*INPUTS[0])
        law.start(*INPUTS[0], centre)
        assert own.stopped == pytest.approx([centre] * len(own.stopped), abs=1e-6)
        for k, (setpoint, measured) in enumerate(INPUTS):
            theirs, ours = own.step(setpoint, measured), law.step(setpoint, measured)
            assert is_close(theirs, ours, 46.0), (k, theirs, ours)
            assert k > 4 or is_close(theirs, centre, 46.0)


@pytest.mark.parametrize("block", Block)
def test_a_block_without_an_integral_comes_back_to_the_centre_from_a_limit(block: Block) -> None:
    """Thrown to both limits, and at rest away from zero."""
    loop, given = force_loop({"pid.Kp": 200.0, "pid.Tf": 0.0})
    text = sheet(loop, given, block, 5.0, references=Step(0.4, horizon=0.02))
    (own,) = emulations(block.value, text, H)
    own.start(0.0, 0.0)
    wire = [own.step(r, y) for r, y in ((0.0, 0.0), (0.4, 0.0), (0.4, 0.4), (0.0, 0.4), (0.1, 0.1))]
    assert wire == pytest.approx([5.0, 45.0, 5.0, -41.0, 5.0])
    assert ("PIDE is not for this design" in text) == (block is Block.ROCKWELL)


@pytest.mark.parametrize("block", Block)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_direction_is_the_design_s(block: Block, sign: float) -> None:
    loop, given = force_loop({n: v * sign for n, v in FULL.items()} | {"pid.Tf": 0.0})
    for own in emulations(block.value, sheet(loop, given, block, 5.0), H):
        own.start(0.0, 0.0)
        assert (own.step(0.01, 0.0) - 5.0) * sign > 0
    mixed = given.with_values({"pid.Ki": -sign * 4000.0})
    if block is not Block.SIMULINK:
        with pytest.raises(InputError, match="gains"):
            sheet(loop, mixed, block)


@pytest.mark.parametrize("block", Block)
def test_weights_of_zero_and_one_are_set(block: Block) -> None:
    """b = 0 and c = 0, of a block that has them; the others say what they have in their place."""
    loop, given = force_loop({**FULL, "pid.Tf": 0.0, "pid.b": 0.0, "pid.c": 0.0})
    own, values, found = run_as_block(loop, given, block)
    blocks = emulations(block.value, sheet(loop, given, block, 5.0), H)
    law = library(own, values, 5.0)
    assert [f for f in found if "weight" in f] == [] or block is Block.CODESYS
    for one in blocks:
        one.start(0.0, 0.0)
        law.start(0.0, 0.0, 5.0)
        for r, y in INPUTS:
            assert is_close(one.step(r, y), law.step(r, y), 46.0)


def check_rest(block: Block, text: str) -> None:
    (own,) = emulations(block.value, text, H)
    own.start(0.0, 0.0)
    assert own.stopped == pytest.approx([5.0] * len(own.stopped))
    assert own.step(0.0, 0.0) == pytest.approx(5.0)


@pytest.mark.parametrize("block", Block)
def test_every_setting_that_the_centre_hangs_on_is_stated(block: Block) -> None:
    """Struck out or changed, it is missed."""
    loop, given = force_loop({"pid.Kp": 200.0, "pid.Tf": 0.0})
    text = sheet(loop, given, block, 5.0)
    check_rest(block, text)
    rows = read_settings(text)
    placed = {n for n, v in rows.items() if re.fullmatch(r"5|53\.4883\d+", v)}
    assert placed, rows
    for name in placed:
        row = rf"^  {re.escape(name)} +{re.escape(rows[name])}"
        assert len(re.findall(row, text, re.M)) == 1
        for changed in (re.sub(rf"{row}.*\n", "", text, flags=re.M), re.sub(row, f"  {name}  3", text, flags=re.M)):
            with pytest.raises((KeyError, AssertionError)):
                check_rest(block, changed)


def test_a_process_value_beyond_its_range_leaves_the_centre_on_the_wire() -> None:
    loop, given = force_loop(FULL)
    (own,) = emulations("siemens", sheet(loop, given, Block.SIEMENS, 5.0), H)
    own.start(0.0, 0.0)
    assert own.step(0.01, 9.0) == own.step(0.01, -9.0) == 5.0


def position_drive() -> Any:
    return PneumaticDrive(friction=Viscous()).system()


@pytest.mark.parametrize("block", Block)
@pytest.mark.parametrize("Ki", [0.0, 40.0])
def test_a_cascade_is_two_blocks_that_answer_as_one_design(block: Block, Ki: float) -> None:
    pid = PID(1e-3, anti_windup=AntiWindup.CLAMPING)
    loop = ClosedLoop(position_drive(), pid, measured="position", outer=PositionLoop())
    values = {"pid.Kp": 2.0, "pid.Ki": Ki, "pid.lower": -5.0, "pid.upper": 5.0, "position_loop.Kp": 17.0}
    given = loop.parameters.with_values(values)
    text = sheet(loop, given, block, 5.0, references=Step(0.1, horizon=0.02))
    outer, inner = (emulations(block.value, text, 1e-3, f"Settings of the {n} block")[0] for n in ("outer", "inner"))
    law = library(loop, given, 5.0)
    signals = re.findall(
        r"def start\(self, (.*?)\)", export_controller(loop, given, Language.PYTHON, name="own")["own.py"]
    )
    order = [s.partition(":")[0].strip() for s in signals[0].split(",")]
    outer.start(0.0, 0.0)
    inner.start(0.0, 0.0)
    begun = False
    for r, y, v in ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.1, 0.001, 0.3), (0.1, 0.05, 1.5), (0.1, 0.099, 0.1)):
        speed = outer.step(r, y)
        row = {"setpoint": r, "measured": v, "setpoint_speed": 0.0, "position": y}
        given_row = [row[n] for n in order if n in row]
        if not begun:
            law.start(*given_row, 5.0)
            begun = True
        assert is_close(inner.step(speed, v), law.step(*given_row), 10.0)
    assert re.search(r"Outer block: P of the position; its output \+ 1 x speed of the setpoint", text)


SURROUNDINGS: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "the speed from an encoder": ({"sensor": Encoder(1e-5)}, {}),
    "gain schedule of pid.Kp": ({"schedule": GainSchedule(("pid.Kp",), -0.1, 0.1)}, {"schedule.Kp_curve": 0.3}),
    "set-point lead": ({"feedforward": Feedforward()}, {"feedforward.gain": 3.0}),
    "dead_zone_inverse": ({"compensators": (DeadZoneInverse(),)}, {"dead_zone_inverse.width": 1.5}),
    "friction_feedforward": ({"compensators": (FrictionFeedforward(),)}, {"friction_feedforward.level": 1.5}),
    "knocker": ({"compensators": (Knocker(),)}, {"knocker.amplitude": 1.5}),
    "impulsive_control": ({"compensators": (ImpulsiveControl(),)}, {"impulsive_control.amplitude": 1.5}),
    "pressure_feedback": ({"compensators": (PressureFeedback(),)}, {"pressure_feedback.gain": 1e-5}),
    "acceleration_feedback": ({"compensators": (AccelerationFeedback(),)}, {"acceleration_feedback.gain": 1.0}),
    "dead band": ({"pid": PID(H, dead_band=True)}, {"pid.dead_band": 1e-3}),
    "reset": ({"pid": PID(H, reset=True)}, {}),
}


@pytest.mark.parametrize("block", Block)
@pytest.mark.parametrize("told", SURROUNDINGS)
def test_a_part_without_a_counterpart_is_refused_by_name_and_at_zero_left_out(told: str, block: Block) -> None:
    parts, acting = SURROUNDINGS[told]
    pid = parts.get("pid", PID(H))
    measured = "position" if told in ("impulsive_control",) else "speed"
    others = {n: v for n, v in parts.items() if n != "pid"}
    loop = ClosedLoop(position_drive(), pid, measured=measured, **others)
    given = loop.parameters.with_values({"pid.Kp": 20.0, "pid.lower": -5.0, "pid.upper": 5.0})
    with pytest.raises(InputError, match=told):
        sheet(loop, given.with_values(acting), block, 5.0)
    if acting:
        bare = ClosedLoop(position_drive(), PID(H), measured=measured)
        text = sheet(loop, given, block, 5.0)
        assert text == sheet(bare, given.select(n for n in given if n in bare.parameters), block, 5.0)


@pytest.mark.parametrize("block", Block)
def test_constant_gains_and_a_dither_go_into_the_input_that_a_block_has(block: Block) -> None:
    """Before its limits; of a block without one behind it, and what its limits then do not see is said."""
    parts: dict[str, Any] = {"dither": Dither(50.0), "compensators": (MotionFeedforward(),)}
    values = {"dither.amplitude": 2.0, "dither.offset": 0.5, "motion_feedforward.speed": 7.0}
    values["motion_feedforward.acceleration"] = 3.0
    loop, given = force_loop({**FULL, **values}, **parts)
    has_input = block in (Block.SIEMENS, Block.ROCKWELL, Block.CODESYS)
    plain = given.with_values({"pid.Ki": 0.0})
    text = sheet(loop, given, block)
    assert ("its limits, and its integral with them, do not see the sum" in text) == (not has_input)
    assert (
        "Sum: 7 N*s/m x setpoint + 3 N*s^2/m x acceleration of the setpoint + 0.5 N + 2 N x sin(2 pi frac(0.1 k))"
        in " ".join(text.split())
    )
    where = {
        Block.SIEMENS: "Disturbance = 1.1627907 %/(N) x sum",
        Block.ROCKWELL: "BIAS = 53.4883721 + 1.1627907 %/(N)",
    }
    where |= {Block.CODESYS: "Y_OFFSET = 0 N + sum"}
    assert where.get(block, "a sum behind the block, before the limits") in " ".join(text.split())
    if not has_input:
        (integrating,), (own,) = (emulations(block.value, t, H) for t in (text, sheet(loop, plain, block)))
        integrating.start(0.0, 0.0)
        own.start(0.0, 0.0)
        assert integrating.step(0.6, 0.0) == 40.0
        assert own.step(0.6, 0.0) > 40.0  # the one limit stands behind the sum


@pytest.mark.parametrize("block", [Block.SIEMENS, Block.ROCKWELL, Block.CODESYS])
def test_a_dither_by_the_sheets_own_formula_is_the_library_s(block: Block) -> None:
    loop, given = force_loop(
        {**FULL, "pid.Tf": 0.0, "dither.amplitude": 2.0, "dither.offset": 0.5}, dither=Dither(50.0)
    )
    text = " ".join(sheet(loop, given, block, 5.0).split())
    wave = re.search(r"Sum: ([\d.]+) N \+ ([\d.]+) N x sin\(2 pi frac\(([\d.]+) k\)\)", text)
    factor = re.search(r"([\d.]+) %/\(N\) x sum", text)
    assert wave
    offset, size, turns = (float(v) for v in wave.groups())
    (own,), law = emulations(block.value, sheet(loop, given, block, 5.0), H), library(loop, given, 5.0)
    own.start(0.0, 0.0)
    law.start(0.0, 0.0, 5.0)
    for k, (r, y) in enumerate(INPUTS):
        added = (offset + size * np.sin(2 * np.pi * turns * k)) * (float(factor[1]) if factor else 1.0)
        assert is_close(own.step(r, y, added), law.step(r, y), 46.0), k


def test_a_generator_behind_the_output_and_hardware_are_listed() -> None:
    loop, given = force_loop(
        {**FULL, "dither.amplitude": 2.0, "sensor.lag": 4e-3},
        PID(H, delay=1),
        dither=Dither(50.0, analogue=True),
        sensor=SensorLag(4e-3),
    )
    text = " ".join(sheet(loop, given, Block.SIEMENS).split())
    assert "Generator behind the output: a sine of 2 N peak at 50 Hz" in text
    assert "sensor with a lag of 4 ms: add no filter" in text
    assert "one sample from reading to acting" in text
    assert "Sum" not in text.partition("Settings")[0]


def test_the_comparison_runs_what_the_sheet_builds_and_nothing_else() -> None:
    loop, given = force_loop({**FULL, "pid.Tf": 0.0}, PID(H), compensators=(DeadZoneInverse(), MotionFeedforward()))
    own, _, found = run_as_block(loop, given, Block.SIEMENS)
    assert own.compensators == ()
    assert found == ["its integral is clamped at a limit, the design's unwinds by back-calculation"]
    assert run_as_block(loop, given.with_values({"pid.Ki": 0.0}), Block.SIEMENS)[2] == []


def test_the_first_lines_are_the_verdict_and_a_force_is_said_to_be_one() -> None:
    loop, given = force_loop(FULL)
    for block in Block:
        lines = sheet(loop, given, block).split("\n")
        assert lines[0].startswith(
            ("The block runs the design as it was tuned", "The block differs from the design in ")
        )
        assert ("differs" in lines[0]) == ("As the block runs it, the design differs:" in lines)
        assert lines[1].startswith("THE OUTPUT IS NEWTONS, not volts")
        assert lines[3].startswith(MAKER_BLOCKS[block].title)
    valve = ClosedLoop(position_drive(), PID(H), measured="speed")
    limited = valve.parameters.with_values({"pid.lower": -5.0, "pid.upper": 5.0})
    assert "NEWTONS" not in sheet(valve, limited, Block.SIEMENS, 5.0)


@pytest.mark.parametrize("block", Block)
def test_a_start_at_rest_away_from_zero_begins_at_the_centre(block: Block) -> None:
    """With set-point weights that are not 1, which the integral makes up for."""
    loop, given = force_loop({**FULL, "pid.b": 0.8, "pid.c": 0.0})
    own, values, _ = run_as_block(loop, given, block)
    text = sheet(own, values, block, 5.0, references=Step(0.01, initial=0.05, horizon=0.02))
    for one in emulations(block.value, text, H):
        one.start(0.05, 0.05)
        assert [one.step(0.05, 0.05) for _ in range(3)] == pytest.approx([5.0] * 3)


@pytest.mark.parametrize("block", Block)
def test_every_sheet_has_five_checks_and_says_what_stands_on_the_wire_when(block: Block) -> None:
    loop, given = force_loop(FULL)
    text = sheet(loop, given, block, 5.0)
    checks = text.partition("Check before you enable it")[2].partition("Formula:")[0]
    assert re.findall(r"^  (\d)\. (\w+):", checks, re.M) == [
        (str(k), n) for k, n in enumerate(("Centre", "Sign", "Limits", "Units", "Watchdog"), 1)
    ]
    states = text.partition("What the output is")[2].partition("Check before")[0]
    assert "At error 0 from rest" in states or "at error 0 from rest" in states
    assert "fault" in states or "error (Input" in states
    assert states.count("5 N") >= 2
    assert text.isascii()
    assert "nan" not in text


def test_percent_needs_limits_and_the_centre_lies_between_them() -> None:
    loop, given = force_loop(FULL)
    open_end = given.with_values({"pid.upper": np.inf})
    for block in (Block.SIEMENS, Block.ROCKWELL):
        with pytest.raises(InputError, match="no limits"):
            sheet(loop, open_end, block)
    for block in (Block.BECKHOFF, Block.CODESYS, Block.SIMULINK):
        (own,) = emulations(block.value, sheet(loop, open_end, block), H)
        own.start(0.0, 0.0)
        assert own.step(0.5, 0.0) > 40.0
        with pytest.raises(InputError, match="centre"):
            sheet(loop, given.with_values({"pid.lower": 1.0}), block)


def test_the_range_of_the_process_value_holds_the_references() -> None:
    loop, given = force_loop(FULL)
    references = [Step(0.4, horizon=0.02), Step(-0.1, horizon=0.02)]
    rows = read_settings(sheet(loop, given, Block.ROCKWELL, references=references))
    assert (float(rows["PID .MINS"]), float(rows["PID .MAXS"])) == pytest.approx((-0.6, 0.9))
    rows = read_settings(sheet(loop, given, Block.ROCKWELL, references=references, measured_span=1.0))
    assert (float(rows["PID .MINS"]), float(rows["PID .MAXS"])) == pytest.approx((-0.5, 0.5))


def test_a_moving_reference_widens_the_speeds_of_a_cascade() -> None:
    loop = ClosedLoop(position_drive(), PID(1e-3), measured="position", outer=PositionLoop())
    given = loop.parameters.with_values({"pid.lower": -5.0, "pid.upper": 5.0})
    move = Move(0.1, speed=0.5, acceleration=5.0)
    still, moving = (
        float(
            read_settings(sheet(loop, given, Block.SIEMENS, references=r), "Settings of the inner")[
                "Config.InputUpperLimit"
            ]
        )
        for r in (Step(0.1, horizon=0.5), move)
    )
    assert moving == pytest.approx(still + 0.5, rel=0.05)


def test_proportional_weights_away_from_one_are_said_to_move_the_rest() -> None:
    loop, given = force_loop({"pid.Kp": 200.0, "pid.b": 0.8})
    assert "off the centre by Kp (b - 1) x setpoint, b = 0.8" in " ".join(sheet(loop, given, Block.SIEMENS).split())
    assert "off the centre" not in sheet(loop, given, Block.CODESYS)
