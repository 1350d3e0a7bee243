"""The averaged model of dither and linearisations over its ripple, against theory and the resolved simulation."""

from collections.abc import Callable
from dataclasses import replace
from math import acos, asin, hypot, pi

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.control import averaging
from pneuopt.control.averaging import AveragedPlant, average_dither, is_affine, mean_start, ripple
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.linear_loop import linear_plant
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, define, names
from pneuopt.models.catalog import r25, t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, LuGre, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.models.pneumatic.valve import opening
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory


def dither(amplitude: float, frequency: float, unit: str = "1") -> ParameterSet:
    values = {"dither.amplitude": Parameter(amplitude, unit), "dither.frequency": Parameter(frequency, "Hz")}
    return ParameterSet(values)


def lands(overlap: float, rounding: float, both: bool = True) -> System:
    """What a valve's land, or two against each other, let through: the rate of a level."""
    edge = {n: ca.SX(v) for n, v in {"dead_zone": overlap, "rounding": rounding, "leak": 0.0}.items()}
    level, spool = Quantity("level", "1"), Quantity("spool", "1")
    return define(
        [level],
        [spool],
        [level],
        ParameterSet(),
        lambda _t, x, u, _p: (
            {"level": opening(u["spool"], edge) - (opening(-u["spool"], edge) if both else 0)},
            dict(x),
        ),
    )


def rate(system: System, u: float, p: ParameterSet) -> float:
    values = [p.value(n) if n in p else 0.0 for n in system.parameters]
    return float(system.ode(0, [0.0], [u], values)[0])


@pytest.mark.parametrize("X", [0.03, 0.1, 0.4, 0.8])
def test_the_null_opening_of_a_land_is_the_amplitude_over_pi(X: float) -> None:
    """Up to ten times the rounding, 64 phases (32 nodes of Gauss and Chebyshev) give the integral within 3e-6 X/pi."""
    p, phases = dither(X, 100.0), np.linspace(-pi, pi, 20001)[:-1]
    exact = np.mean([(x + hypot(x, 0.08)) / 2 for x in X * np.sin(phases)])
    assert rate(average_dither(lands(0.0, 0.08, both=False), p), 0.0, p) == pytest.approx(exact, abs=3e-6 * X / pi)
    sharp = average_dither(lands(0.0, 1e-6, both=False), p, nodes=256)
    assert rate(sharp, 0.0, p) == pytest.approx(X / pi, rel=1e-4)


@pytest.mark.parametrize("X", [0.25, 0.4, 1.0])
def test_dither_opens_a_dead_zone(X: float) -> None:
    p = dither(X, 100.0)
    mean = average_dither(lands(0.2, 2e-3), p, nodes=512)
    assert mean.linearise(np.zeros(1), {}, p).B[0, 0] == pytest.approx(2 / pi * acos(0.2 / X), rel=2e-3)
    assert lands(0.2, 2e-3).linearise(np.zeros(1), {}, p).B[0, 0] < 1e-4


def test_the_offset_and_the_amplitude_stay_parameters() -> None:
    p = dither(0.4, 100.0)
    mean = average_dither(lands(0.2, 0.02), p)
    half = average_dither(lands(0.2, 0.02), p.with_values({"dither.amplitude": 0.2}))
    for u in (-0.3, 0.05):
        moved = p | ParameterSet({"dither.offset": Parameter(0.1, "1")})
        assert rate(mean, u, moved) == pytest.approx(rate(mean, u + 0.1, p), rel=1e-12)
        other = p.with_values({"dither.amplitude": 0.2})
        assert rate(mean, u, other) == pytest.approx(rate(half, u, other), rel=1e-12)


@pytest.mark.parametrize("X", [0.25, 0.4, 1.0])
def test_a_triangle_opens_a_dead_zone_by_the_time_that_it_spends_beyond(X: float) -> None:
    """Its values are spread evenly: at null the slope is ``1 - x0/X``, where a sine has ``(2/pi) acos(x0/X)``."""
    p = dither(X, 100.0)
    mean = average_dither(lands(0.2, 2e-3), p, nodes=512, waveform=Waveform.TRIANGLE)
    assert mean.linearise(np.zeros(1), {}, p).B[0, 0] == pytest.approx(1 - 0.2 / X, rel=5e-3)


@pytest.mark.parametrize(
    ("waveform", "law"), [(Waveform.TRIANGLE, lambda s: s), (Waveform.SINE, lambda s: 2 / pi * asin(s))]
)
def test_a_relay_under_dither_becomes_its_distribution(waveform: Waveform, law: Callable[[float], float]) -> None:
    """The mean of sgn(u + X w): a straight line under a triangle, an arcsine under a sine (Zames & Shneydor)."""
    level, command = Quantity("level", "1"), Quantity("command", "1")
    relay = define(
        [level], [command], [level], ParameterSet(), lambda _t, x, u, _p: ({"level": ca.sign(u["command"])}, dict(x))
    )
    mean = average_dither(relay, dither(0.5, 100.0), nodes=256, waveform=waveform)
    for share in (-0.7, -0.2, 0.0, 0.4, 0.9):
        assert rate(mean, 0.5 * share, dither(0.5, 100.0)) == pytest.approx(law(share), abs=2 / 128), share


def test_a_triangles_ripple_is_that_of_its_fundamental() -> None:
    """8/pi^2 of a sine's of the same peak, whatever the linear plant."""
    plant = SecondOrder().system()
    p = plant.parameters | dither(2.0, 20.0, "V")
    sine, triangle = (list(ripple(plant, p, waveform=w).values()) for w in Waveform)
    assert triangle == pytest.approx([8 / pi**2 * x for x in sine], rel=1e-9)


def test_an_averaged_loop_under_a_triangle_is_the_moving_average_of_the_resolved_one() -> None:
    """A level behind lands with a dead zone, which a wave of 1.5 times that opens by a third."""
    loop = ClosedLoop(lands(0.2, 0.02), PID(limits=False), Dither(100.0, waveform=Waveform.TRIANGLE))
    p = loop.parameters.with_values({"pid.Kp": 2.0, "dither.amplitude": 0.3, "dither.frequency": 100.0})
    t = np.arange(6001) * 2.5e-4
    inputs, start = Trajectory(t, {"reference": np.full(len(t), 0.5)}), loop.initial(p)
    resolved = simulate(loop, inputs, p, initial=start, rtol=1e-8)["level"]
    over, at = (np.convolve(y, np.ones(40) / 40, "valid") for y in (resolved, t))
    begun = mean_start(ripple(loop, p), start)
    sine = replace(loop, dither=Dither(100.0))
    off = []
    for mean in (average_dither(loop, p), average_dither(sine, p)):
        run = simulate(mean, inputs, p, initial=begun, rtol=1e-8)
        off.append(np.abs(np.interp(at, run.t, run["level"]) - over).max())
    assert off[0] < 2e-3
    assert off[1] > 5 * off[0]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_coulomb_friction_under_a_ripple_of_speed_follows_the_arcsine(share: float) -> None:
    """The mean of sgn(v + V sin) is (2/pi) asin(v/V): what was stiction is a damping."""
    drive = ForceDrive(Coulomb()).system()
    values = {"friction.coulomb": 30.0, "friction.viscous": 0.0, "friction.smoothing": 1e-5, "load.mass": 2.0}
    p = drive.parameters.with_values(values) | dither(500.0, 160.0, "N")
    V = abs(ripple(drive, p, nodes=512)["speed"])
    mean = average_dither(drive, p, nodes=512)
    x = [share * V if q.name == "speed" else 0.0 for q in mean.states]
    full = mean.parameters | p.select(n for n in p if n in mean.parameters)
    acceleration = float(mean.ode(0, x, [0.0], [q.value for q in full.values()])[0][1])
    friction = -2.0 * acceleration
    assert friction == pytest.approx(30.0 * 2 / pi * asin(share), abs=30.0 * 2 / 512)


def test_the_ripple_under_coulomb_friction_is_that_of_its_describing_function() -> None:
    """m w V, and at a right angle the friction's first harmonic 4 F_c / pi, in phase with the speed: together F."""
    drive = ForceDrive(Coulomb()).system()
    values = {"friction.coulomb": 30.0, "friction.viscous": 0.0, "friction.smoothing": 1e-5, "load.mass": 2.0}
    p = drive.parameters.with_values(values) | dither(500.0, 160.0, "N")
    V = abs(ripple(drive, p, nodes=512)["speed"])
    force = hypot(2.0 * 2 * pi * 160.0 * V, 4 / pi * 30.0)
    assert force == pytest.approx(500.0, rel=1e-3)


def test_the_ripple_of_a_linear_plant_is_its_frequency_response_and_its_mean_is_untouched() -> None:
    plant = SecondOrder().system()
    p = plant.parameters | dither(2.0, 20.0, "V")
    linear, w = plant.linearise(np.zeros(2), {}, p), 2j * pi * 20.0
    expected = 2.0 * np.linalg.solve(w * np.eye(2) - linear.A, linear.B[:, 0])
    assert list(ripple(plant, p).values()) == pytest.approx(expected.tolist(), rel=1e-9)
    mean = average_dither(plant, p).linearise(np.zeros(2), {}, p)
    for found, given in zip((mean.A, mean.B), (linear.A, linear.B), strict=True):
        np.testing.assert_allclose(found, given, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("volts", "gain"), [(0.0, 0.936349), (1.0, 0.9276), (4.0, 0.887)])
def test_lap_averaging_of_r25_lowers_the_loops_gain(volts: float, gain: float) -> None:
    """Golden: more leak at null, more damping; unit feedback of 20 V/(m/s) around the drive."""
    drive, p = r25()
    plant, given = drive.system(), p | dither(volts, 1000.0 / (2 * pi), "V")
    mean = average_dither(plant, given) if volts else plant
    x, rest = np.array(list(drive.rest(p).states.values())), drive.rest(p).inputs
    linear = mean.linearise(x, rest, given)
    A, B, C = linear.A[1:, 1:], linear.B[1:], linear.C[1:2, 1:]  # without the position
    static = float(20 * (C @ np.linalg.solve(-A, B))[0, 0])
    assert static / (1 + static) == pytest.approx(gain, abs=1e-4 if volts < 4 else 1e-3)


def test_an_averaged_loop_is_the_moving_average_of_the_dithered_one() -> None:
    """R25 with 2 V at 1000 rad/s: within 0.5 % of the step, where no averaging is 2 % off."""
    drive, values = r25()
    loop = ClosedLoop(drive.system(), PID(limits=False), Dither(frequency=1000.0 / (2 * pi)))
    p = (loop.parameters | values).with_values({"pid.Kp": 20.0, "dither.amplitude": 4.0})
    period, count = 2 * pi / 1000.0, 40
    t = np.arange(150 * count + 1) * period / count
    inputs, start = Trajectory(t, {"reference": np.full(len(t), 0.05)}), loop.initial(p)
    resolved = simulate(loop, inputs, p, initial=start, rtol=1e-8)["speed"]
    over = np.convolve(resolved, np.ones(count) / count, "valid")
    at = np.convolve(t, np.ones(count) / count, "valid")
    few = Trajectory(t[::20], {"reference": np.full(len(t[::20]), 0.05)})
    begun = mean_start(ripple(loop, p, nodes=32), start)
    missed = {}
    for label, model, x, q in (
        ("averaged", average_dither(loop, p, nodes=32), begun, p),
        ("plant", ClosedLoop(average_dither(loop.plant, p, nodes=32), loop.pid), begun, p),
        ("started beside", average_dither(loop, p, nodes=32), start, p),
        ("ignored", loop, start, p.with_values({"dither.amplitude": 0.0})),
    ):
        run = simulate(model, few, q.select(n for n in q if n in model.parameters), initial=x, rtol=1e-8)
        missed[label] = np.abs(np.interp(at, run.t, run["speed"]) - over).max() / 0.05
    assert max(missed["averaged"], missed["plant"]) < 0.01
    assert min(missed["ignored"], missed["started beside"]) > 5 * missed["averaged"]


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
    monkeypatch.setattr(averaging, "is_affine", lambda _: False)  # of an affine plant nothing is balanced
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
