"""The averaged model of dither against closed formulas, linear theory and the resolved simulation."""

from collections.abc import Callable
from dataclasses import replace
from math import acos, asin, hypot, pi

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.averaging import average_dither, mean_start, ripple
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, define
from pneuopt.models.catalog import r25
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.pneumatic.valve import opening
from pneuopt.quantities.errors import InputError, ModelError, UnknownNameError
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
    with pytest.raises(InputError, match="the loop's dither is a triangle"):
        average_dither(loop, p, waveform=Waveform.SINE)


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


def test_what_cannot_be_averaged_is_refused() -> None:
    plant = FirstOrder().system()
    p = plant.parameters | dither(1.0, 100.0, "V")
    with pytest.raises(InputError, match=r"dither.amplitude > 0"):
        average_dither(plant, plant.parameters)
    with pytest.raises(InputError, match=r"dither.frequency > 0"):
        average_dither(plant, p.with_values({"dither.frequency": 0.0}))
    with pytest.raises(InputError, match="nodes must be at least 8, got 4"):
        average_dither(plant, p, nodes=4)
    with pytest.raises(UnknownNameError, match="unknown input 'voltage'; did you mean 'valve_voltage'"):
        average_dither(plant, p, actuated="voltage")
    with pytest.raises(UnknownNameError, match="unknown state or input 'sped'; did you mean 'speed'"):
        average_dither(plant, p, at={"sped": 1.0})
    with pytest.raises((InputError, ModelError), match="needs a loop with dither"):
        average_dither(ClosedLoop(plant, PID()), p)
    with pytest.raises((InputError, ModelError), match=r"the controller is sampled; average the plant"):
        average_dither(ClosedLoop(plant, PID(sample_time=1e-3), Dither()), p)
