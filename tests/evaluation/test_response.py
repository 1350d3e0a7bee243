"""How a response is run and read: its samples, and between which values the command acts.

What would simulate for minutes without a word is refused first, with the key, the minutes and a budget to raise.
"""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.tolerances import MAX_STEPS
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.response import (
    check_steps,
    command_range,
    highest_dither_frequency,
    loop_inputs,
    readings_a_sample,
    sample_spacing,
    simulation_steps,
)
from pneuopt.evaluation.tolerances import MAX_READINGS_A_SAMPLE, MIN_READINGS_A_SAMPLE, SAMPLES_A_DITHER_PERIOD
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.tune import tune

STEP = Step(0.1, horizon=0.4)
WIDE = {"dither.amplitude": (0.0, 60.0), "dither.frequency": (20.0, 200.0)}


def axis(sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=sample_time), Dither(80.0))
    return loop, loop.parameters.with_values({"pid.lower": -300.0, "pid.upper": 200.0, "dither.amplitude": 40.0})


def test_samples_follow_the_highest_frequency_that_is_allowed() -> None:
    loop, p = axis(None)
    free = p.with_bounds(WIDE).freed(*WIDE)
    assert (highest_dither_frequency(loop, p), highest_dither_frequency(loop, free)) == (80.0, 200.0)
    assert sample_spacing(loop, STEP, free) <= 1 / (SAMPLES_A_DITHER_PERIOD * 200.0) < sample_spacing(loop, STEP, p)
    assert sample_spacing(axis(1e-3)[0], STEP, free) == 1e-3


def test_a_continuous_loop_is_read_at_its_samples_and_a_sampled_one_between_them() -> None:
    assert readings_a_sample(axis(None)[0], STEP) == 1
    counts = [readings_a_sample(axis(h)[0], Step(0.1, horizon=T)) for h, T in ((1e-4, 0.4), (4e-3, 0.8), (4e-3, 0.2))]
    assert counts == [MIN_READINGS_A_SAMPLE, 5, MAX_READINGS_A_SAMPLE]


def test_an_input_that_the_reference_does_not_name_is_zero() -> None:
    run = loop_inputs(axis(None)[0], STEP, 1e-3)
    assert run["reference"][-1] == 0.1
    assert all((run[n] == 0.0).all() for n in run if n != "reference")


def test_the_command_ends_at_the_narrower_of_the_controllers_limits_and_the_valves_span() -> None:
    loop, p = axis(None)
    assert command_range(loop, p) == (-300.0, 200.0, "the command")
    assert command_range(loop, loop.plant.parameters)[:2] == (-float("inf"), float("inf"))


PLANT = FirstOrder().system()
EXTREME = {
    "sample time": (ClosedLoop(PLANT, PID(sample_time=1e-6)), Step(1.0), r"pid.sample_time is 1 us .* horizon of 1 s"),
    "horizon": (
        ClosedLoop(PLANT, PID(sample_time=1e-3)),
        Step(1.0, horizon=1e4),
        "2.2 hours: pid.sample_time is 1 ms over a horizon of 10000 s",
    ),
    "dither": (ClosedLoop(PLANT, PID(), Dither(1e6)), Step(1.0), "2.2 hours: dither.frequency is 1000000 Hz over"),
    "analogue dither": (
        ClosedLoop(PLANT, PID(sample_time=1e-3), Dither(1e6, analogue=True)),
        Step(1.0),
        "33 minutes: dither.frequency is 1000000 Hz over",
    ),
}


@pytest.mark.parametrize("case", EXTREME)
def test_extreme_requests_are_refused_before_any_step(case: str) -> None:
    loop, step, message = EXTREME[case]
    given = loop.parameters.with_bounds({"pid.Kp": (0.1, 20.0)}).freed("pid.Kp")
    with pytest.raises(InputError, match=message) as refused:
        evaluate(loop, step, loop.parameters)
    with pytest.raises(InputError, match=message):
        tune(loop, step, given, minimise=SettlingTime())
    raised = re.search(r"max_steps=([^,]+)", str(refused.value))
    assert raised is not None
    check_steps(loop, [step], loop.parameters, max_steps=float(raised[1]))  # the remedy is right


def test_the_count_is_that_of_the_response() -> None:
    for loop in (
        ClosedLoop(PLANT, PID(sample_time=2e-3)),
        ClosedLoop(PLANT, PID()),
        ClosedLoop(PLANT, PID(), Dither(50.0)),
    ):
        step = Step(1.0, horizon=0.5)
        assert len(respond(loop, step, loop.parameters)) == pytest.approx(
            simulation_steps(loop, step, loop.parameters), rel=0.01
        )


def test_plants_count_and_the_budget_can_be_raised_by_name() -> None:
    loop = ClosedLoop(PLANT, PID(sample_time=1e-3))
    plants = {"a": {"plant.gain": 1.0}, "b": {"plant.gain": 1.1}}
    needed = 3 * simulation_steps(loop, Step(1.0), loop.parameters)
    with pytest.raises(InputError, match="on 3 plants"):
        evaluate(loop, Step(1.0), loop.parameters, scenarios=plants, max_steps=0.99 * needed)
    assert evaluate(loop, Step(1.0), loop.parameters, scenarios=plants, max_steps=needed).shape[1] == 3


def test_a_loop_simulated_over_long_inputs_is_refused() -> None:
    loop = ClosedLoop(PLANT, PID(sample_time=1e-6))
    inputs = Trajectory([0.0, 1e4], {"reference": [1.0, 1.0]})
    with pytest.raises(InputError, match=r"10000 s of samples every 1e-06 s are 1e\+10 samples, .*raise max_steps"):
        simulate(loop, inputs, loop.parameters)
    short = Trajectory([0.0, 1e-4], {"reference": [1.0, 1.0]})
    assert len(simulate(loop, short, loop.parameters)) == 2


@pytest.mark.parametrize("command", ["simulate", "tune"])
def test_the_shell_refuses_and_the_file_holds_the_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("drive.toml").write_text('[drive]\nkind = "linear"\n[plant]\nmodel = "first_order"\n', encoding="utf-8")
    gain = '{ value = "2 V*s/m", lower = "1 V*s/m", upper = "9 V*s/m", free = true }'
    loop = f'[pid]\nsample_time = "1 us"\nKp = {gain}\n[[reference]]\nstep = "0.2 m/s"\n'
    asked = 'horizon = "1 s"\n[minimise]\nsettling_time = { band = "5 %" }\n'
    Path("tuning.toml").write_text(loop + asked, encoding="utf-8")
    result = CliRunner().invoke(app, [command, "drive.toml", "tuning.toml"])
    assert result.exit_code == 2
    assert "13 minutes: pid.sample_time is 1 us" in result.output
    Path("small.toml").write_text(loop.replace("1 us", "1 ms") + asked + "[budget]\nsteps = 10\n", encoding="utf-8")
    result = CliRunner().invoke(app, [command, "drive.toml", "small.toml"])
    assert result.exit_code == 2
    assert "the budget of 10 steps" in result.output


def test_the_budget_is_minutes() -> None:
    assert 1e5 < MAX_STEPS < 1e8
