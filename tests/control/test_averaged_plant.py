"""Linearisations averaged over a dither's ripple, against plain ones, the averaged equations and hand-made means."""

from math import pi

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.control import averaged_plant
from pneuopt.control.averaged_plant import AveragedPlant, is_affine
from pneuopt.control.averaging import average_dither, ripple
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.linear_loop import linear_plant
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, define, names
from pneuopt.models.catalog import t32
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import LuGre, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

QUIET = {"pid.Kp": 0.0, "pid.Ki": 0.0, "pid.Kd": 0.0}  # a controller that does not react to the ripple


def cylinder(waveform: Waveform = Waveform.SINE) -> tuple[ClosedLoop, ParameterSet, Array, float]:
    """The 32 mm cylinder with LuGre friction at a slow speed, where the ripple crosses the dead zone's edge."""
    drive, p = t32()
    loop = ClosedLoop(drive.system(), PID(), Dither(1000 / (2 * pi), waveform=waveform))
    rest = drive.rest(p, position=0.1, speed=0.05)
    full = loop.complete(p).with_values({**QUIET, "dither.amplitude": 1.2})
    return loop, full, np.array([rest.states[n] for n in names(loop.plant.states)]), rest.inputs["valve_voltage"]


def test_without_amplitude_it_is_the_plain_linearisation_and_it_grows_out_of_it() -> None:
    loop, p, x, command = cylinder()
    at = {loop.command.name: command}
    none = ClosedLoop(loop.plant, PID())
    plain, still, tiny, small = (
        linear_plant(model, p.with_values({"dither.amplitude": A}), x, at)
        for model, A in ((none, 1.2), (loop, 0.0), (loop, 1e-9), (loop, 1e-3))
    )
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(plain, name), getattr(still, name))
    for row, (same, near, expected) in enumerate(zip(tiny.A, small.A, plain.A, strict=True)):
        assert_allclose(same, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max(), err_msg=str(row))
        assert_allclose(near, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max(), err_msg=str(row))


@pytest.mark.parametrize("waveform", Waveform)
def test_it_is_the_averaged_equations_linearised(waveform: Waveform) -> None:
    loop, p, x, command = cylinder(waveform)
    at = {loop.command.name: command, **dict(zip(names(loop.plant.states), x.tolist(), strict=True))}
    mean = average_dither(loop.plant, p, at=at, waveform=waveform).linearise(x, {loop.command.name: command}, p)
    plain = loop.plant.linearise(x, {loop.command.name: command}, p)
    found = AveragedPlant(loop, phases=64)(loop.parameter_vector(p)[None], x[None], np.array([[command]]))
    moved = np.abs(mean.A - plain.A).max(axis=1)
    assert np.all(np.abs(found.A[0] - mean.A).max(axis=1) <= 5e-3 * moved + 1e-9)
    assert moved.max() > 0.1 * np.abs(plain.A[names(loop.plant.states).index("pressure_a")]).max()
    assert_allclose(found.B[0], mean.B[:, 0], rtol=1e-9)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_swings_are_those_of_the_balance(compiled: bool) -> None:
    loop, p, x, command = cylinder()
    at = {loop.command.name: command, **dict(zip(names(loop.plant.states), x.tolist(), strict=True))}
    vectors = np.array([loop.parameter_vector(p.with_values({"dither.amplitude": A})) for A in (0.0, 0.4, 1.2)])
    found = AveragedPlant(loop, compiled, phases=64).swings(vectors, np.tile(x, (3, 1)), np.full((3, 1), command))
    assert not found[0].any()
    for A, row in zip((0.4, 1.2), found[1:], strict=True):
        expected = [*ripple(loop.plant, p.with_values({"dither.amplitude": A}), at=at).values()]
        assert_allclose(row, expected, rtol=1e-5)


def test_the_controller_reacts_to_the_ripple(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a linear plant: the closed loop's own response to a sine behind the controller."""
    loop = ClosedLoop(SecondOrder().system(), PID(), Dither(12.0))
    p = loop.parameters.with_values(
        {"pid.Kp": 0.2, "pid.Ki": 1.0, "pid.Kd": 0.01, "pid.Tf": 0.01, "dither.amplitude": 0.5}
    )
    t = np.linspace(0, 2, 4801)
    run = simulate(loop, Trajectory(t, {"reference": np.zeros(len(t))}), p)
    last, output = t >= 1.5 - 1e-9, loop.feedback.name
    phasor = 2j * np.mean((run[output] * np.exp(-24j * pi * t))[last][:-1])
    nonlinear = AveragedPlant(loop)
    monkeypatch.setattr(averaged_plant, "is_affine", lambda _: False)  # of an affine plant nothing is balanced
    swing = nonlinear.swings(loop.parameter_vector(p)[None], np.zeros((1, 2)), np.zeros((1, 1)))[0]
    assert abs(swing[names(loop.plant.states).index(output)] - phasor) < 5e-3 * abs(phasor)  # without the reaction 3e-2


def edge() -> System:
    """A level that fills by the cube of the command: its slope, three times the square, shows where the command is."""
    level, command = Quantity("level", "1"), Quantity("command", "1")
    return define(
        [level], [command], [level], ParameterSet(), lambda _t, x, u, _p: ({"level": u["command"] ** 3}, dict(x))
    )


@pytest.mark.parametrize("waveform", Waveform)
@pytest.mark.parametrize(("sample_time", "analogue"), [(None, False), (1e-3, False), (1e-3, True)])
def test_a_sampled_wave_is_averaged_as_it_is_held(
    sample_time: float | None, waveform: Waveform, analogue: bool
) -> None:
    """At 300 Hz and 1 ms a period has three and a third samples: the mean square of what is held, exactly."""
    loop = ClosedLoop(edge(), PID(sample_time), Dither(300.0, analogue=analogue, waveform=waveform))
    p = loop.parameters.with_values({**QUIET, "dither.amplitude": 0.6})
    held = waveform.at(np.asarray(2 * pi * 0.3 * np.arange(10), dtype=float))
    own = (
        np.mean(held**2) if sample_time and not analogue else {Waveform.SINE: 1 / 2, Waveform.TRIANGLE: 1 / 3}[waveform]
    )
    slope = linear_plant(loop, p, np.zeros(1), {"command": 0.2}).B[0, 0]
    assert slope == pytest.approx(3 * (0.2**2 + 0.36 * own), rel=2e-3)


@pytest.mark.parametrize("friction", [Stribeck(), LuGre()], ids=["stribeck", "lugre"])
@pytest.mark.parametrize("speed", [0.0, 0.01, 0.2])
def test_a_balance_is_found_at_rest_and_sliding(friction: Stribeck | LuGre, speed: float) -> None:
    """Its swing is that of the force's own simulation, as long as the body neither sticks nor turns in between."""
    plant = ForceDrive(friction).system()
    loop = ClosedLoop(plant, PID(), Dither(100.0))
    assert plant.rest_hook is not None
    for A in (0.1, 1.0, 10.0, 40.0):
        p = loop.parameters.with_values({**QUIET, "dither.amplitude": A})
        rest = plant.rest_hook(p, {"speed": speed})
        x, force = np.array([rest.states[n] for n in names(plant.states)]), rest.inputs["force"]
        found = AveragedPlant(loop)(loop.parameter_vector(p)[None], x[None], np.array([[force]]))
        assert np.isfinite(found.A).all()
        if speed == 0.2:
            assert found.A[0][1, 1] == pytest.approx(-70.0 / p.value("load.mass"), rel=0.05, abs=20)


def test_a_linear_plant_needs_no_average() -> None:
    assert is_affine(SecondOrder().system())
    assert not is_affine(ForceDrive(Stribeck()).system())
