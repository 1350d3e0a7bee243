"""How a response is run and read: its samples, and between which values the command acts."""

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.response import (
    MAX_READINGS_A_SAMPLE,
    MIN_READINGS_A_SAMPLE,
    SAMPLES_A_DITHER_PERIOD,
    command_range,
    highest_dither_frequency,
    loop_inputs,
    readings_a_sample,
    sample_spacing,
)
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.parameters import ParameterSet

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
