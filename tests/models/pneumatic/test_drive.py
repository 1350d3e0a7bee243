from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.models.friction import (
    Coulomb,
    FrictionModel,
    Karnopp,
    LoadDependent,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
)
from pneuopt.models.load import GRAVITY, Load
from pneuopt.models.pneumatic.chamber import ChamberModel, Polytropic, Thermal
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import IsentropicNozzle
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import HardwareError, InputError, PhysicsWarning, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory

DRIVES = {
    "plain": PneumaticDrive(),
    "lugre": PneumaticDrive(friction=PressureDependent(LuGre()), load=Load(spring=True, inclined=True)),
    "thermal": PneumaticDrive(chamber=Thermal(), friction=Coulomb()),
    "nozzle": PneumaticDrive(ProportionalValve(IsentropicNozzle(), Spool.FIRST_ORDER), chamber=Polytropic(mixed=True)),
    "rigid": PneumaticDrive(ProportionalValve(spool=Spool.RIGID), Viscous(), cylinder=Cylinder(stops=False)),
}
AREAS = np.pi / 4 * 0.032**2, np.pi / 4 * (0.032**2 - 0.012**2)
RANGE = {  # the operating box: beyond the stroke as far as a stop gives way, from vacuum pumps to compressors
    "position": (-2e-3, 0.202), "speed": (-3.0, 3.0), "pressure_a": (1e3, 1.2e6), "pressure_b": (1e3, 1.2e6),
    "temperature_a": (200.0, 450.0), "temperature_b": (200.0, 450.0), "valve.spool": (-1.3, 1.3),
    "valve.spool_rate": (-1e3, 1e3), "friction.bristle": (-2e-3, 2e-3), "valve_voltage": (-8.0, 8.0),
}  # fmt: skip


@st.composite
def points(draw: st.DrawFn, drive: PneumaticDrive) -> tuple[Array, Array]:
    """A state and an input within the box; often where a formula could break."""
    special = {"pressure_a": [101325.0, 701325.0], "pressure_b": [101325.0, 701325.0], "position": [0.0, 0.2]}
    system, values = drive.system(), []
    for q in (*system.states, *system.inputs):
        own = st.floats(*RANGE[q.name]) | st.sampled_from([*special.get(q.name, []), sum(RANGE[q.name]) / 2])
        values.append(draw(own))
    return np.array(values[: len(system.states)]), np.array(values[len(system.states) :])


def derivatives(system: System) -> ca.Function:
    sizes = [system.ode.size1_in(i) for i in range(4)]
    t, x, u, p = (ca.SX.sym(n, size) for n, size in zip("txup", sizes, strict=True))
    free, weights = ca.vertcat(x, u, p), ca.SX.sym("w", len(system.states))
    xdot = system.ode(t, x, u, p)[0]
    hessian = ca.hessian(ca.dot(weights, xdot), free)[0]
    return ca.Function("D", [x, u, p, weights], [xdot, ca.jacobian(xdot, free), hessian])


DERIVATIVES = {name: derivatives(drive.system()) for name, drive in DRIVES.items()}


def with_values(drive: PneumaticDrive, **values: float) -> ParameterSet:
    return drive.parameters.with_values({k.replace("__", "."): v for k, v in values.items()})


def rates(drive: PneumaticDrive, x: Array, u: float, p: ParameterSet) -> Array:
    return np.asarray(drive.system().ode(0, x, [u], parameter_vector(drive.parameters, p))[0]).ravel()


@pytest.mark.parametrize("name", DRIVES)
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_nan_in_value_gradient_or_hessian(name: str, data: st.DataObject) -> None:
    drive = DRIVES[name]
    p, weights = parameter_vector(drive.parameters, drive.parameters), np.ones(len(drive.states))
    x, u = data.draw(points(drive))
    equal = np.where(np.array(names(drive.states)) == "pressure_b", x[2], x)
    for state in (x, equal):
        for value in DERIVATIVES[name](state, u, p, weights):
            assert np.all(np.isfinite(np.array(value)))


@pytest.mark.parametrize("name", DRIVES)
def test_derivatives_are_the_central_differences(name: str) -> None:
    drive, rng = DRIVES[name], np.random.default_rng(2)
    system, p = drive.system(), parameter_vector(drive.parameters, drive.parameters)
    nominal = np.array([q.nominal for q in (*system.states, *system.inputs)])
    middle = np.array([np.mean(RANGE[q.name]) for q in (*system.states, *system.inputs)])
    n, m = len(system.states), len(system.inputs)
    for _ in range(3):
        # voltage within the clip; speeds well away from the narrow turning of the friction
        w = np.concatenate([middle + 0.3 * nominal * rng.uniform(-1, 1, n + m), p])
        w[1] = rng.choice([-1, 1]) * rng.uniform(0.02, 0.3)
        exact = np.array(DERIVATIVES[name](w[:n], w[n : n + m], w[n + m :], np.ones(n))[1])
        scale = np.concatenate([nominal, np.maximum(np.abs(p), 1e-6)])
        for k, step in enumerate(1e-6 * scale):
            shift = step * (np.arange(len(w)) == k)
            high, low = (
                np.array(system.ode(0, *np.split(point, [n, n + m]))[0]).ravel() for point in (w + shift, w - shift)
            )
            rounding = 1e-13 * np.maximum(np.abs(high), 1.0) / step
            assert np.all(np.abs(exact[:, k] - (high - low) / (2 * step)) <= 1e-4 * np.abs(exact[:, k]) + rounding)


def test_names_units_and_wiring() -> None:
    text = repr(DRIVES["thermal"].system())
    assert "position [m], speed [m/s], pressure_a [Pa(a)], pressure_b [Pa(a)], temperature_a [K]" in text
    assert "valve.spool [1], valve.spool_rate [1/s]" in text
    assert "inputs: valve_voltage [V]\n  outputs: position [m], speed [m/s], pressure_a [Pa(a)], pressure_b" in text
    assert DRIVES["plain"] == PneumaticDrive()
    assert names(DRIVES["lugre"].states)[-1] == "friction.bristle"


def test_newtons_law() -> None:
    drive = replace(DRIVES["lugre"], cylinder=Cylinder(stops=False))
    values = {"load__mass": 3.0, "load__force": 7.0, "load__stiffness": 200.0, "load__rest_position": 0.05}
    p = with_values(drive, **values, load__inclination=0.3, friction__viscous=50.0, friction__coulomb_pressure_a=1e-5)
    state = dict.fromkeys(names(drive.states), 0.0) | {"position": 0.1, "pressure_a": 5e5, "pressure_b": 4e5}
    a, b = AREAS
    push = a * 5e5 - b * 4e5 - (a - b) * 101325.0
    expected = (push - 7.0 - 200.0 * 0.05) / 3.0 - GRAVITY * np.sin(0.3)
    assert rates(drive, np.array(list(state.values())), 0.0, p)[1] == pytest.approx(expected, rel=1e-4)
    sliding = np.array(list((state | {"speed": 1.0, "friction.bristle": (30 + 1e-5 * (5e5 - 101325)) / 5e4}).values()))
    friction = 30 + 1e-5 * (5e5 - 101325) + 50.0
    assert rates(drive, sliding, 0.0, p)[1] == pytest.approx(expected - friction / 3.0, rel=1e-4)


def test_stops_push_back_beyond_the_stroke_only() -> None:
    plain, free = DRIVES["plain"], replace(DRIVES["plain"], cylinder=Cylinder(stops=False))

    def stop(y: float, v: float) -> float:
        x = np.array([y, v, 3e5, 3e5, 0.0, 0.0])
        return float((rates(plain, x, 0.0, plain.parameters) - rates(free, x, 0.0, free.parameters))[1] * 5.0)

    assert stop(0.201, 0.0) == pytest.approx(-1000.0, rel=0.01)
    assert stop(-0.001, 0.0) == pytest.approx(1000.0, rel=0.01)
    assert stop(0.201, 0.5) == pytest.approx(-1500.0, rel=0.01)  # on its way in it pushes harder
    assert stop(-0.001, 0.5) == pytest.approx(500.0, rel=0.01)
    for y in (2e-4, 0.01, 0.1, 0.19, 0.1998):  # a push that depends on the speed here would count as viscous friction
        for v in (0.0, 0.5, -0.5):
            assert stop(y, v) == 0.0


@given(st.floats(-3e-4, 3e-4), st.floats(1e-6, 1e-4))
def test_a_cover_pushes_the_more_the_deeper_the_piston_is_and_without_a_kink(y: float, step: float) -> None:
    at = ca.SX.sym("y")
    p = {"stroke": ca.SX(0.2), "stop_stiffness": ca.SX(1e6), "stop_damping": ca.SX(0.0)}
    force = Cylinder().stop_force(at, ca.SX(0.0), p)
    push = ca.Function("push", [at], [force, ca.gradient(force, at)])
    (near, slope), (deep, steeper) = ([float(v) for v in push(d)] for d in (y, y - step))
    assert deep >= near >= 0.0
    assert 0.0 <= -slope <= -steeper + 1e-6 <= 1e6 + 1.0
    assert abs(deep - near + slope * step) <= 0.75e10 * step**2 / 2 + 1e-9  # within the greatest curvature of its onset


def test_it_runs_into_the_stop_and_stays() -> None:
    drive = DRIVES["plain"]
    rest = drive.rest(drive.parameters)
    t = np.linspace(0, 2, 401)
    open_wide = Trajectory(t, {"valve_voltage": np.full_like(t, 5.0)})
    with pytest.warns(PhysicsWarning, match=r"reached the front end stop \(position 199.9 mm\) at t = 0.0763"):
        run = simulate(drive.system(), open_wide, drive.parameters, initial=rest.states)
    assert 0.2 < run["position"][-1] < 0.2006
    assert abs(run["speed"][-1]) < 1e-6
    assert run["pressure_a"][-1] == pytest.approx(701325.0, rel=1e-3)
    assert run["position"].max() < 0.205


@pytest.mark.parametrize("name", DRIVES)
def test_at_rest_nothing_changes(name: str) -> None:
    drive = DRIVES[name]
    p = with_values(drive, load__force=60.0, cylinder__leak=1e-10, valve__leak=0.005)
    rest = drive.rest(p, position=0.07)
    scale = np.array([q.nominal for q in drive.states])
    found = rates(drive, np.array(list(rest.states.values())), rest.inputs["valve_voltage"], p)
    assert np.abs(found / scale).max() < 1e-6
    assert rest.states["position"] == 0.07
    assert tuple(rest.states) == names(drive.states)


def test_more_load_takes_more_opening_and_the_wrong_way_round() -> None:
    drive = DRIVES["plain"]
    voltages = [
        drive.rest(with_values(drive, load__force=force)).inputs["valve_voltage"] for force in (-100.0, 0.0, 100.0)
    ]
    assert voltages == sorted(voltages)
    assert voltages[1] < 0  # the area without rod is larger


def test_trapped_air() -> None:
    drive = DRIVES["plain"]
    rest = drive.rest(drive.parameters, position=0.05, pressure_b=3.5e5)
    assert (rest.states["pressure_b"], rest.inputs["valve_voltage"]) == (3.5e5, 0.0)
    assert rates(drive, np.array(list(rest.states.values())), 0.0, drive.parameters)[1] == pytest.approx(0.0, abs=1e-9)


def test_a_loop_finds_its_rest() -> None:
    drive = PneumaticDrive(friction=LuGre())
    loop = ClosedLoop(drive.system(), PID())
    p = loop.parameters.with_values({"cylinder.start": 0.2, "pid.Ki": 5.0})
    for Ki in (0.0, 5.0):
        x = loop.initial(p.with_values({"pid.Ki": Ki}))
        system = loop.system()
        scale = np.array([q.nominal for q in system.states])
        assert np.abs(np.array(system.ode(0, x, [0.0], loop.parameter_vector(p))[0]).ravel() / scale).max() < 1e-6
        assert x[0] == pytest.approx(0.04)
    position = ClosedLoop(drive.system(), PID(), measured="position")
    assert position.initial(position.parameters, reference=0.13)[0] == 0.13
    with pytest.raises(InputError, match="valve"):
        loop.initial(p, start={"valve": 0.1})


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("speed", [0.2, -0.35, 0.005])
def test_steady_motion_leaves_only_the_position_to_change(name: str, speed: float) -> None:
    drive = DRIVES[name]
    p = with_values(drive, load__force=40.0, cylinder__leak=1e-10, valve__leak=0.002)
    rest = drive.rest(p, position=0.07, speed=speed)
    scale = np.array([q.nominal for q in drive.states])
    found = rates(drive, np.array(list(rest.states.values())), rest.inputs["valve_voltage"], p)
    assert found[0] == speed
    assert np.abs(found[1:] / scale[1:]).max() < 1e-6


@pytest.mark.parametrize("friction", [Stribeck(), LuGre(), Karnopp(Stribeck())])
def test_a_loop_in_motion_stays_in_motion(friction: FrictionModel) -> None:
    """50 ms at 0.2 m/s, the command in the controller's hands."""
    drive = PneumaticDrive(friction=friction)
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3))
    p = loop.parameters.with_values(
        {"pid.Kp": 10.0, "pid.Ki": 40.0, "pid.Kd": 0.1, "pid.lower": -5.0, "pid.upper": 5.0}
    )
    for speed in (0.2, -0.2):
        x = loop.initial(p, reference=speed, start={"position": 0.1})
        t = np.linspace(0, 0.05, 51)
        run = simulate(loop, Trajectory(t, {"reference": np.full(51, speed)}), p, initial=x)
        assert run["position"][-1] == pytest.approx(0.1 + 0.05 * speed, abs=1e-9)
        for n in ("speed", "pressure_a", "pressure_b", "control"):
            assert np.ptp(run[n]) < 1e-6 * np.abs(run[n]).mean()


def test_motion_of_a_rodless_drive_is_its_own_mirror_image() -> None:
    drive = PneumaticDrive(friction=LuGre())
    p = with_values(drive, cylinder__rod=0.0, valve__dead_zone=0.02)
    there, back = (drive.rest(p, speed=v) for v in (0.3, -0.3))
    assert back.inputs["valve_voltage"] == pytest.approx(-there.inputs["valve_voltage"], rel=1e-9)
    assert back.states["pressure_a"] == pytest.approx(there.states["pressure_b"], rel=1e-9)
    assert back.states["friction.bristle"] == pytest.approx(-there.states["friction.bristle"], rel=1e-9)


def test_motion_takes_the_force_that_friction_and_load_take() -> None:
    drive = PneumaticDrive(friction=Viscous(), cylinder=Cylinder(stops=False))
    rest = drive.rest(with_values(drive, load__force=25.0, friction__viscous=90.0), speed=0.4)
    a, b = AREAS
    push = a * rest.states["pressure_a"] - b * rest.states["pressure_b"] - (a - b) * 101325.0
    assert push == pytest.approx(90.0 * 0.4 + 25.0, abs=1e-6)


BY_AREA = {"conductance", "mass", "force", "coulomb", "static", "viscous", "bristle_stiffness", "bristle_damping"}
BY_AREA |= {"dead_volume_a", "dead_volume_b", "wall_conductance"}


@pytest.mark.parametrize("chamber", [Polytropic(), Polytropic(mixed=True), Thermal()], ids=["one", "mixed", "thermal"])
@given(v=st.floats(-0.5, 0.5), a=st.floats(1.1e5, 6.9e5), b=st.floats(1.1e5, 6.9e5), opening=st.floats(-1.0, 1.0))
@settings(max_examples=30, deadline=None)
def test_drives_of_every_size_move_alike(chamber: ChamberModel, v: float, a: float, b: float, opening: float) -> None:
    """Areas, flows, masses and forces a hundred times as large: no newton and no kg/s is built in."""
    drive = PneumaticDrive(friction=LoadDependent(LuGre()), chamber=chamber)
    sizes = {"cylinder__bore": 0.01, "cylinder__rod": 0.004, "friction__bristle_damping": 20.0}
    small = with_values(drive, load__force=20.0, valve__leak=0.003, friction__coulomb_load=0.1, **sizes)
    scale = 100.0
    large = small.with_values({n: scale * p.value for n, p in small.items() if n.partition(".")[2] in BY_AREA})
    large = large.with_values({f"cylinder.{n}": small.value(f"cylinder.{n}") * scale**0.5 for n in ("bore", "rod")})
    state = {"position": 0.08, "speed": v, "pressure_a": a, "pressure_b": b, "valve.spool": opening}
    state |= {"temperature_a": 290.0, "temperature_b": 300.0, "friction.bristle": 2e-4}
    x = np.array([state.get(n, 0.0) for n in names(drive.states)])
    unit = np.array([q.nominal for q in drive.states])
    assert rates(drive, x, 1.0, large) / unit == pytest.approx(rates(drive, x, 1.0, small) / unit, rel=1e-9, abs=1e-9)


@st.composite
def rodless(draw: st.DrawFn) -> tuple[Array, float]:
    spans = [(0.0, 0.2), (-2.0, 2.0), (1e5, 8e5), (1e5, 8e5), (-1.0, 1.0), (-300.0, 300.0), (-5e-4, 5e-4)]
    return np.array([draw(st.floats(*span)) for span in spans]), draw(st.floats(-6.0, 6.0))


@settings(max_examples=60, deadline=None)
@given(rodless())
def test_a_rodless_drive_is_its_own_mirror_image(point: tuple[Array, float]) -> None:
    drive = PneumaticDrive(friction=LuGre())
    p = with_values(drive, cylinder__rod=0.0, cylinder__leak=1e-10, valve__dead_zone=0.02)
    x, u = point
    mirror = np.array([0.2 - x[0], -x[1], x[3], x[2], -x[4], -x[5], -x[6]])
    there, back = rates(drive, x, u, p), rates(drive, mirror, -u, p)
    swapped = np.array([-there[0], -there[1], there[3], there[2], -there[4], -there[5], -there[6]])
    scale = np.array([1.0, 1e3, 1e7, 1e7, 1e3, 1e5, 1.0])
    assert back / scale == pytest.approx(swapped / scale, rel=1e-9, abs=1e-9)


IMPOSSIBLE = {
    "cylinder.rod": (0.04, "m"),
    "cylinder.dead_volume_a": (-1e-6, "m^3"),
    "valve.critical_ratio": (1.2, "1"),
    "supply.pressure": (9e4, "Pa(a)"),
    "cylinder.start": (1.5, "1"),
    "cylinder.leak": (-1.0, "kg/(s*Pa)"),
    "chamber.exponent": (0.0, "1"),
    "load.mass": (0.0, "kg"),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_hardware_is_refused(name: str) -> None:
    drive = DRIVES["plain"]
    value, unit = IMPOSSIBLE[name]
    p = drive.parameters | ParameterSet({name: Parameter(value, unit, source="a sketch")})
    for refuse in (drive.check, drive.rest, ClosedLoop(drive.system(), PID()).initial):
        with pytest.raises(HardwareError) as refused:
            refuse(p)
        assert refused.value.parameter == name


def test_all_friction_models_fit_in() -> None:
    for friction in (Viscous(), Coulomb(), Stribeck(), LuGre(), PressureDependent(Stribeck())):
        drive = PneumaticDrive(friction=friction)
        rest = drive.rest(drive.parameters)
        assert np.all(np.isfinite(rates(drive, np.array(list(rest.states.values())), 1.0, drive.parameters)))


def test_a_position_that_no_stroke_holds_is_doubted() -> None:
    """A sensor's zero may be 5 % of the stroke off; then only the sign, the unit or the stroke is wrong."""
    drive = DRIVES["plain"]
    t = np.linspace(0, 1, 200)
    log = Trajectory(t, {"valve_voltage": np.cos(t), "position": 0.1 + 0.095 * np.sin(6 * t)})
    assert drive.system().log_warnings({"run": Log(log, drive.parameters)}) == []
    for column in (-log["position"], 1e3 * log["position"], log["position"] + 0.05):
        (told,) = drive.system().log_warnings({"run": Log(log.with_columns({"position": column}), drive.parameters)})
        assert told.startswith("run: position runs from ")
        assert told.endswith("outside the stroke, 0 to 200 mm: check its sign, unit and zero, and cylinder.stroke")


def test_a_spring_on_the_load_shows_the_force_on_it() -> None:
    """A force loop rests where the spring has the wanted force, with the air in balance with it."""
    drive = PneumaticDrive(load=Load(spring=True))
    system = drive.system()
    p = drive.parameters.with_values({"load.stiffness": 1e5, "load.rest_position": 0.1})
    assert [q.unit for q in system.outputs if q.name == "load_force"] == ["N"]
    loop = ClosedLoop(system, PID(1e-3), measured="load_force")
    values = (loop.parameters | p).with_values({"pid.Kp": 1e-3})
    x = dict(zip((q.name for q in loop.states), loop.initial(values, reference=150.0), strict=True))
    assert x["position"] == pytest.approx(0.1 + 150.0 / 1e5, rel=1e-12)
    air = Trajectory([0.0, 1.0], {n: [x[n]] * 2 for n in ("pressure_a", "pressure_b")})
    assert drive.air_force(air, p)[0] == pytest.approx(150.0, rel=1e-5)
    run = simulate(loop, Step(20.0, initial=150.0, horizon=0.2).trajectory(1e-3), values, initial=list(x.values()))
    assert run["load_force"] == pytest.approx(1e5 * (run["position"] - 0.1), rel=1e-12)


def test_a_force_loop_needs_a_spring() -> None:
    plain, pressed = (PneumaticDrive(load=Load(spring=k)) for k in (False, True))
    with pytest.raises(UnknownNameError, match="load_force"):
        ClosedLoop(plain.system(), PID(), measured="load_force")
    with pytest.raises(InputError, match=r"load\.stiffness"):
        pressed.system().rest_state(pressed.parameters, {"load_force": 100.0})
