"""The gains for makers' PID blocks: the numbers by the makers' own formulas, and the design as the block runs it."""

import re

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, AntiWindup, Form, SeriesForm, to_parallel
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.export.block_settings import export_settings, run_as_block
from pneuopt.export.vendor_blocks import BLOCK_FORMS, Block
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from tests.export.maker_emulations import read_settings

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
    with pytest.raises(InputError, match="measured_span must be positive"):
        export_settings(loop, given, Block.ROCKWELL, short, measured_span=0.0)


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
    for form in BLOCK_FORMS.values():
        assert form.formula
        assert len(form.sources) >= 2
        assert all(text.isascii() and len(text) < 140 for text in (form.formula, *form.sources))


def test_gains_that_the_standard_form_cannot_have_are_refused() -> None:
    loop, given = saturated()
    with pytest.raises(InputError, match="Kp = 0"):
        export_settings(loop, given.with_values({"pid.Kp": 0.0}), Block.SIEMENS, STEP)
