"""Event-accurate stick-slip: against closed solutions, an independent integration, and the smooth model's limit."""

from collections.abc import Callable
from math import asin, pi, sin, sqrt
from types import ModuleType

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics import stick_slip
from pneuopt.dynamics.simulate import StickSlipResult, simulate, simulate_stick_slip
from pneuopt.dynamics.stick_slip import EventKind
from pneuopt.dynamics.system import FRICTION_DIRECTION, System, define
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import (
    Asymmetric,
    Coulomb,
    FrictionModel,
    Karnopp,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
)
from pneuopt.models.load import GRAVITY, Load
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

BREAK_AWAY, STANDSTILL, REVERSAL = EventKind
STRIBECK = {"friction.coulomb": 30.0, "friction.static": 45.0, "friction.stribeck_velocity": 0.02}


def given_values(system: System, values: dict[str, float]) -> ParameterSet:
    return system.parameters.with_values(values)


def held(force: float, seconds: float, n: int = 2) -> Trajectory:
    return Trajectory(np.linspace(0, seconds, n), {"force": np.full(n, force)})


def pulled(friction: FrictionModel) -> System:
    """A mass at the end of a spring (2000 N/m) whose other end moves at 10 mm/s; outputs the friction force, too."""
    own = friction.parameters.with_prefix("friction")
    mass = ParameterSet({"load.mass": Parameter(2.0, "kg")})
    states = (Quantity("position", "m"), Quantity("speed", "m/s"), Quantity("end", "m"))

    def rhs(_t: ca.SX, x: dict[str, ca.SX], _u: object, p: dict[str, ca.SX]) -> tuple[dict[str, ca.SX], ...]:
        named = {n.removeprefix("friction."): v for n, v in p.items()}
        drag, pull = friction.force(x["speed"], {}, {}, named).value, 2000 * (x["end"] - x["position"])
        rates = {"position": x["speed"], "speed": (pull - drag) / p["load.mass"], "end": ca.SX(0.01)}
        return rates, {"pull": pull, "drag": drag}

    outputs = (Quantity("pull", "N"), Quantity("drag", "N"))
    return define(states, (), outputs, mass | own, rhs)  # type: ignore[arg-type]


def slide(friction: FrictionModel, seconds: float, n: int = 2, **values: float) -> StickSlipResult:
    plant = pulled(friction)
    p = plant.parameters.with_values(STRIBECK | {"friction.viscous": 50.0} | values)
    return simulate_stick_slip(plant, Trajectory(np.linspace(0, seconds, n), {}), p)


def test_a_slow_pull_breaks_away_exactly_at_the_static_friction() -> None:
    run = slide(Karnopp(Stribeck()), 2.3)
    first = run.events[0]
    assert (first.kind, first.direction) == (BREAK_AWAY, 1)
    assert first.t == pytest.approx(45.0 / (2000 * 0.01), abs=1e-12)


def test_stick_slip_of_a_pulled_mass_against_an_independent_integration() -> None:
    """Slips by DOP853 with its own event search, sticks in closed form, no CasADi: ten break-aways and standstills."""
    m, k, V, Fs, Fc, vs, s2 = 2.0, 2000.0, 0.01, 45.0, 30.0, 0.02, 50.0

    def slip(t: float, x: Array) -> Array:
        drag = Fc + (Fs - Fc) * np.exp(-((x[1] / vs) ** 2)) + s2 * x[1]
        return np.array([x[1], (k * (V * t - x[0]) - drag) / m])

    def stands(_t: float, x: Array) -> float:
        return float(x[1] - 1e-9)

    stands.terminal, stands.direction = True, -1  # type: ignore[attr-defined]
    y, times = 0.0, []
    for _ in range(10):
        t = (Fs / k + y) / V
        # an exact root of the force is an equilibrium: leave it along da/dt = kV/m
        dt = 1e-6
        x = np.array([y + k * V / m * dt**3 / 6, k * V / m * dt**2 / 2])
        found = solve_ivp(slip, (t + dt, t + 1), x, "DOP853", events=stands, rtol=1e-12, atol=1e-14)
        y = float(found.y[0, -1])
        times += [t, float(found.t[-1])]
    run = slide(Karnopp(Stribeck()), times[-1] + 1e-3, 1000)
    assert [e.t for e in run.events] == pytest.approx(times, abs=1e-6)
    assert [e.kind for e in run.events] == [BREAK_AWAY, STANDSTILL] * 10
    assert run.trajectory["position"][-1] == pytest.approx(y, abs=1e-8)


def test_the_friction_of_a_stuck_mass_balances_the_pull() -> None:
    for friction in (Karnopp(Stribeck()), Karnopp(Asymmetric(Stribeck()))):
        values = {"friction.coulomb_asymmetry": 0.2} if isinstance(friction.base, Asymmetric) else {}
        run = slide(friction, 5.0, 2001, **values).trajectory
        stuck = run["stuck"] == 1
        assert 0.5 < stuck.mean() < 1
        assert run["drag"][stuck] == pytest.approx(run["pull"][stuck], abs=1e-9)
        assert np.all(run["speed"][stuck] == 0)


def test_a_mass_on_a_spring_with_dry_friction_loses_a_fixed_amount_a_half_swing() -> None:
    """Closed form: reversals every pi/w, each amplitude lower by 2 F_c/k, the end where |y| <= F_c/k."""
    drive = ForceDrive(Karnopp(Coulomb()), Load(spring=True)).system()
    k, m, Fc, y0 = 1000.0, 4.0, 5.0, 0.0643
    values = {"load.stiffness": k, "load.mass": m, "friction.coulomb": Fc, "friction.viscous": 0.0}
    run = simulate_stick_slip(drive, held(0.0, 2.5), given_values(drive, values), initial={"position": y0})
    n = int(np.ceil((y0 - Fc / k) / (2 * Fc / k)))
    half = pi / sqrt(k / m)
    assert [e.t for e in run.events] == pytest.approx([half * i for i in range(n + 1)], abs=1e-8)
    assert [e.kind for e in run.events] == [BREAK_AWAY, *[REVERSAL] * (n - 1), STANDSTILL]
    assert [e.direction for e in run.events] == [*((-1) ** (i + 1) for i in range(n)), 0]
    assert run.trajectory["position"][-1] == pytest.approx((-1) ** n * (y0 - 2 * n * Fc / k), abs=1e-9)
    assert run.trajectory["stuck"].tolist() == [0, 1]


@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_block_on_a_slope(begin: float) -> None:
    drive = ForceDrive(Karnopp(Coulomb()), Load(inclined=True)).system()
    limit = asin(30.0 / (5.0 * GRAVITY))
    t = begin + np.linspace(0, 1, 5)
    for angle in (0.9999999 * limit, -0.9999999 * limit, 1.0001 * limit, 0.7):
        values = {"load.inclination": angle, "friction.coulomb": 30.0, "friction.viscous": 0.0}
        run = simulate(drive, Trajectory(t, {"force": np.zeros(5)}), given_values(drive, values))
        a = max(0.0, GRAVITY * sin(angle) - 30.0 / 5.0)
        assert run["position"] == pytest.approx(-a * (t - begin) ** 2 / 2, abs=1e-11 if a else 0.0), angle


def test_a_stuck_piston_under_load_does_not_move_at_all() -> None:
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(sample_time=1e-3), Dither(frequency=100.0))
    values = {"load.force": 40.0, "dither.amplitude": 4.999, "pid.Kp": 10.0, **STRIBECK}
    t = np.linspace(0, 1, 1001)
    inputs, p = Trajectory(t, {"reference": np.zeros(1001)}), loop.parameters.with_values(values)
    run = simulate_stick_slip(loop, inputs, p, initial={})
    assert not run.events
    assert np.all(run.trajectory["position"] == 0)
    assert np.all(run.trajectory["stuck"] == 1)


@pytest.mark.parametrize("analogue", [False, True])
def test_a_sine_that_barely_exceeds_the_static_friction_is_not_stepped_over(analogue: bool) -> None:
    """Only two instants are asked for; the time of the first break-away is asin(F_s/A)/w."""
    pid = PID(sample_time=1.0) if analogue else PID()
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), pid, Dither(frequency=7.0, analogue=analogue))
    grid = Trajectory([0.0, 0.95], {"reference": [0.0, 0.0]})
    for amplitude in (44.9999, 45.0001, 46.0, 300.0):
        values = STRIBECK | {"pid.Kp": 0.0, "dither.amplitude": amplitude}
        run = simulate_stick_slip(loop, grid, loop.parameters.with_values(values))
        if amplitude < 45.0:
            assert not run.events
        else:
            assert run.events[0].t == pytest.approx(asin(45.0 / amplitude) / (2 * pi * 7.0), abs=1e-7)


@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-6])
def test_a_speed_that_dips_to_zero_within_a_step_sticks_until_it_breaks_away(depth: float) -> None:
    """A mass that a force F = k (t - 1) brakes and then drives; without sticking its speed would fall to -depth.

    With Coulomb friction C the mass m sticks until F = C, at t' = 1 + C/k; from there on v = k (t - t')^2/2m. Speeds on
    the way are those of a parabola, which an integrator of second order crosses in one step.
    """
    mass, level, slope = 2.0, 10.0, 40.0
    drive = ForceDrive(Karnopp(Coulomb())).system()
    p = given_values(drive, {"load.mass": mass, "friction.coulomb": level, "friction.viscous": 0.0})
    leaves, begin = 1 + level / slope, slope / (2 * mass) * (1 + level / slope) ** 2 - depth
    t, at = np.array([0.0, 2.0]), np.array([0.0, 0.5, leaves, 1.5, 2.0])
    run = simulate_stick_slip(
        drive,
        Trajectory(t, {"force": slope * (t - 1)}),
        p,
        initial={"speed": begin, "position": 0.0},
        t_out=at,
        intersample={"force": Intersample.LINEAR},
    )
    assert [e.kind for e in run.events] == [STANDSTILL, BREAK_AWAY]
    stops = leaves - sqrt(2 * mass * depth / slope)
    assert [e.t for e in run.events] == pytest.approx([stops, leaves], abs=1e-6)
    sliding = slope / (2 * mass) * (at - leaves) ** 2
    assert run.trajectory["speed"] == pytest.approx(np.where(at < leaves, sliding - depth, sliding), abs=1e-8)


def test_directions_and_pressures_raise_the_level() -> None:
    drive = ForceDrive(Karnopp(PressureDependent(Asymmetric(Stribeck())))).system()
    values = {"friction.coulomb_asymmetry": 0.2, "friction.coulomb_pressure_a": 1e-5, **STRIBECK}
    level = 45.0 + 1e-5 * 3e5
    pressures = {"pressure_a": [401325.0] * 2, "pressure_b": [101325.0] * 2}
    for force, sticks in {1.2: True, -0.8: True}.items():
        for factor in (0.999999, 1.000001):
            inputs = Trajectory([0.0, 0.01], {"force": [force * factor * level] * 2, **pressures})
            run = simulate(drive, inputs, given_values(drive, values))
            assert bool(run["stuck"][-1]) == (sticks and factor < 1), (force, factor)


def test_work_in_is_kinetic_energy_and_heat_and_load() -> None:
    """Every joule of the driving force is found again, to 1e-8 of it, over some 60 events."""
    friction = Karnopp(Stribeck())
    plant = ForceDrive(friction, Load(spring=True)).system()
    energies = tuple(Quantity(n, "J", nominal=0.1) for n in ("work", "heat", "against_load"))

    def rhs(t: ca.SX, x: dict[str, ca.SX], u: dict[str, ca.SX], p: dict[str, ca.SX]) -> tuple[dict[str, ca.SX], ...]:
        y, v = x["position"], x["speed"]
        rates, _ = plant.ode(t, ca.vertcat(y, v), u["force"], ca.vertcat(*p.values()))
        drag = friction.force(v, {}, {}, {n.removeprefix("friction."): q for n, q in p.items()}).value
        stored = p["load.stiffness"] * y + p["load.force"]
        power = {"work": u["force"] * v, "heat": drag * v, "against_load": stored * v}
        return {"position": rates[0], "speed": rates[1], **power}, {}

    system = define((*plant.states, *energies), plant.inputs, (), plant.parameters, rhs)  # type: ignore[arg-type]
    t = np.linspace(0, 2.5, 2501)
    force = 60 * np.sin(2 * pi * 3 * t) + 80 * np.sin(2 * pi * 13 * t)
    p = given_values(plant, {"load.stiffness": 800.0, "load.force": 7.0, "load.mass": 1.5, **STRIBECK})
    result = simulate_stick_slip(system, Trajectory(t, {"force": force}), p)
    run = result.trajectory
    assert len(result.events) > 50
    residual = run["work"] - run["heat"] - run["against_load"] - 0.5 * 1.5 * run["speed"] ** 2
    assert np.abs(residual).max() < 1e-8 * run["work"][-1]
    assert np.all(np.diff(run["heat"]) >= -1e-12)
    stored = 400.0 * run["position"] ** 2 + 7.0 * run["position"]
    assert run["against_load"] == pytest.approx(stored, abs=1e-9 * run["work"][-1])


@settings(deadline=None, max_examples=15)
@given(st.lists(st.floats(-120, 120), min_size=4, max_size=25), st.floats(0.5, 10.0), st.floats(1.0, 2.0))
def test_any_push_keeps_the_law_of_dry_friction_and_is_mirrored(forces: list[float], mass: float, ratio: float) -> None:
    drive = ForceDrive(Karnopp(Stribeck())).system()
    p = given_values(drive, STRIBECK | {"load.mass": mass, "friction.static": 30.0 * ratio})
    t = 0.02 * np.arange(len(forces) + 1)
    push = np.array([*forces, 0.0])
    run, mirrored = (simulate_stick_slip(drive, Trajectory(t, {"force": s * push}), p) for s in (1, -1))
    stuck = run.trajectory["stuck"] == 1
    assert np.all(np.abs(push[stuck]) <= 30.0 * ratio)
    assert np.all(run.trajectory["speed"][stuck] == 0)
    still = np.flatnonzero(stuck[:-1] & stuck[1:])
    for k in still:
        if not any(t[k] < e.t < t[k + 1] for e in run.events):
            assert run.trajectory["position"][k + 1] == run.trajectory["position"][k]
    assert np.all(mirrored.trajectory["position"] == -run.trajectory["position"])
    assert [(e.t, e.kind, -e.direction) for e in mirrored.events] == [(e.t, e.kind, e.direction) for e in run.events]


def slips(run: Trajectory) -> tuple[float, float, float]:
    """When the mass first exceeds 5 mm/s [s], the share of time it does not, its mean speed [m/s]."""
    v, fast = run["speed"], run["speed"] > 5e-3
    k = int(np.argmax(fast))
    first = np.interp(5e-3, v[k - 1 : k + 1], run.t[k - 1 : k + 1])
    return float(first), float(1 - fast.mean()), float(run["position"][-1] / run.t[-1])


def test_the_smooth_model_tends_to_it_as_the_smoothing_goes_to_zero() -> None:
    """Break-away, share of time at rest and mean speed of the pulled mass: errors fall with the smoothing width."""
    t = np.linspace(0, 6, 12001)
    exact = slide(Karnopp(Stribeck()), 6.0, len(t))
    assert sum(e.kind is BREAK_AWAY for e in exact.events) == 4
    plant, errors = pulled(Stribeck()), []
    for width in (1e-3, 1e-4, 1e-5):
        p = plant.parameters.with_values(STRIBECK | {"friction.viscous": 50.0, "friction.smoothing": width})
        run = simulate(plant, Trajectory([0.0, 6.0], {}), p, t_out=t)
        errors.append(np.abs(np.subtract(slips(run), slips(exact.trajectory))))
    breaks, shares, means = np.array(errors).T
    assert breaks[:-1] / breaks[1:] == pytest.approx(10, rel=0.02)
    assert means[:-1] / means[1:] == pytest.approx(10, rel=0.15)
    assert np.all(np.diff(shares) <= 0)
    assert errors[-1] == pytest.approx([0, 0, 0], abs=2e-3)


def speed_loop(friction: FrictionModel) -> tuple[ClosedLoop, ParameterSet, Trajectory]:
    """A speed PI at 1 kHz, on a sine that makes the piston stick at every turn."""
    loop = ClosedLoop(ForceDrive(friction).system(), PID(sample_time=1e-3))
    values = {"pid.Kp": 1500.0, "pid.Ki": 3e4, "friction.viscous": 20.0, "load.mass": 2.0, **STRIBECK}
    t = np.linspace(0, 0.5, 501)
    return loop, loop.parameters.with_values(values), Trajectory(t, {"reference": 0.05 * np.sin(2 * pi * 60 * t)})


def test_two_simulators_agree_on_a_sampled_loop() -> None:
    loop, p, inputs = speed_loop(Karnopp(Stribeck()))
    exact = simulate(loop, inputs, p)
    loop, p, inputs = speed_loop(Stribeck())
    differences = []
    for width in (1e-4, 1e-6):
        run = simulate(loop, inputs, p.with_values({"friction.smoothing": width}))
        differences.append(np.abs(run["speed"] - exact["speed"]).max())
    assert differences == pytest.approx([2.3e-4, 2.3e-6], rel=0.05)


def test_hundreds_of_events_a_second_take_few_evaluations(count_calls: Callable[[ModuleType], list[int]]) -> None:
    loop, p, inputs = speed_loop(Karnopp(Stribeck()))
    calls = count_calls(stick_slip)
    run = simulate_stick_slip(loop, inputs, p)
    assert len(run.events) == 120
    assert sum(calls) < 90_000  # 44,937 when this was written


def test_tolerances_converge() -> None:
    loop, p, inputs = speed_loop(Karnopp(Stribeck()))
    loose, usual, tight = (simulate(loop, inputs, p, rtol=tol)["position"] for tol in (1e-6, 1e-9, 1e-12))
    assert np.abs(usual - tight).max() < 1e-11
    assert np.abs(loose - tight).max() < 1e-7


def test_a_pneumatic_drive_sticks_and_slips_too() -> None:
    """A creeping speed loop: the smooth model with a width of 1e-6 m/s meets the event-accurate run."""
    runs = {}
    for friction in (Karnopp(Stribeck()), Stribeck()):
        loop = ClosedLoop(PneumaticDrive(friction=friction).system(), PID(sample_time=2e-3))
        values = {"pid.Kp": 10.0, "pid.Ki": 100.0, "pid.lower": -5.0, "pid.upper": 5.0, **STRIBECK}
        p = loop.parameters.with_values(values)
        p = p.with_values({"friction.smoothing": 1e-6}) if "friction.smoothing" in p else p
        t = np.linspace(0, 0.4, 201)
        runs[friction] = simulate(loop, Trajectory(t, {"reference": np.full(201, 0.02)}), p)
    exact, smooth = runs.values()
    assert 0.2 < exact["stuck"].mean() < 0.9
    assert smooth["position"] == pytest.approx(exact["position"], abs=1e-6)
    assert smooth["pressure_a"] == pytest.approx(exact["pressure_a"], rel=1e-3)


def test_what_cannot_stick_is_refused() -> None:
    for base in (LuGre(), Viscous()):
        with pytest.raises(ModelError, match="needs a static map with a Coulomb level"):
            Karnopp(base)
    smooth = ForceDrive(Stribeck()).system()
    with pytest.raises(ModelError, match="has no Karnopp friction"):
        simulate_stick_slip(smooth, held(1.0, 1.0), smooth.parameters)
    drive = ForceDrive(Karnopp(PressureDependent(Coulomb()))).system()
    p = given_values(drive, {"friction.coulomb_pressure_a": -1e-3})
    inputs = Trajectory([0.0, 1.0], {"force": [0.0] * 2, "pressure_a": [5e5] * 2, "pressure_b": [1e5] * 2})
    with pytest.raises(ModelError, match="the static friction is negative at t = 0 s"):
        simulate(drive, inputs, p)


def test_a_run_that_escapes_says_when_and_where() -> None:
    speed, direction = Quantity("speed", "m/s"), Parameter(0.0, "1")
    runaway = define(
        [speed],
        [],
        [],
        ParameterSet({FRICTION_DIRECTION: direction}),
        lambda _t, x, _u, _p: ({"speed": x["speed"] ** 2}, {}),
    )
    with pytest.raises(ConvergenceError, match=r"stopped after t = 0\.\d* s, where speed .* m/s") as caught:
        simulate(runaway, Trajectory([0.0, 0.2, 0.3, 1.0], {}), ParameterSet(), initial={"speed": 2.5})
    assert caught.value.solution["speed"][-1] == pytest.approx(10.0, rel=1e-7)


def test_a_model_that_is_undefined_says_so() -> None:
    states = (Quantity("speed", "m/s"), Quantity("level", "1"))
    root = define(
        states,
        [],
        [],
        ParameterSet({FRICTION_DIRECTION: Parameter(0.0, "1")}),
        lambda _t, x, _u, p: ({"speed": -p[FRICTION_DIRECTION], "level": -ca.sqrt(x["level"]) - 1}, {}),
    )
    with pytest.raises(ConvergenceError, match="not defined there"):
        simulate(root, Trajectory([0.0, 0.5, 1.5], {}), ParameterSet(), initial={"level": 1.0})


def test_a_plant_without_a_speed_is_refused() -> None:
    level = Quantity("level", "1")
    plant = define(
        [level],
        [],
        [],
        ParameterSet({FRICTION_DIRECTION: Parameter(0.0, "1")}),
        lambda _t, x, _u, _p: ({"level": x["level"]}, {}),
    )
    with pytest.raises(ModelError, match="needs a plant with a state 'speed'"):
        simulate(plant, Trajectory([0.0, 1.0], {}), ParameterSet())


def test_an_endless_run_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mass sticks beside an oscillator of 160 kHz, which takes a million steps a second; none of them is an event."""
    states = (Quantity("speed", "m/s"), Quantity("sine", "1"), Quantity("cosine", "1"))
    plant = define(
        states,
        [],
        [],
        ParameterSet({FRICTION_DIRECTION: Parameter(0.0, "1")}),
        lambda _t, x, _u, p: (
            {"speed": -p[FRICTION_DIRECTION], "sine": 1e6 * x["cosine"], "cosine": -1e6 * x["sine"]},
            {},
        ),
    )
    start = {"cosine": 1.0}
    short = simulate_stick_slip(plant, Trajectory([0.0, 1e-5], {}), ParameterSet(), initial=start).trajectory
    assert short["sine"][-1] == pytest.approx(sin(10.0), abs=1e-6)
    monkeypatch.setattr(stick_slip, "MAX_INTERNAL_STEPS", 2000)
    with pytest.raises(ConvergenceError, match=r"stopped after t = .* s, where speed 0 m/s, .* too stiff"):
        simulate_stick_slip(plant, Trajectory([0.0, 3600.0], {}), ParameterSet(), initial=start)


def test_a_mistyped_sample_time_is_refused() -> None:
    loop = ClosedLoop(ForceDrive(Karnopp(Coulomb())), PID(sample_time=1e-8))
    steps = Trajectory([0.0, 1.0], {"reference": [0.1, 0.1]})
    with pytest.raises(InputError, match=r"1e-08 s are 1e.08 samples.* raise max_steps"):
        simulate_stick_slip(loop, steps, loop.parameters)
