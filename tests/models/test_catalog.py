from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import Linearisation, discretise, parameter_vector
from pneuopt.models import catalog
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import CRITICAL_RATIO, IsentropicNozzle, Iso6358, Smoothing
from pneuopt.models.pneumatic.valve import Spool
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from problems.shared.paper2015 import OperatingPoint, second_order

K_S = 20.0  # [V s/m] transducer
SPEED, AIR = 1, slice(2, 4)  # places in the state of a drive without spool lag
LOWER, UPPER = -5.0, 5.0
SETS: dict[str, Callable[[], catalog.DriveSet]] = {
    "s25": catalog.s25, "s32": catalog.s32, "s40": catalog.s40, "r25": catalog.r25,
    "b32": catalog.b32, "t32": catalog.t32,
}  # fmt: skip


def linear(drive: PneumaticDrive, p: ParameterSet) -> Linearisation:
    rest = drive.rest(p)
    return drive.system().linearise(np.array(list(rest.states.values())), rest.inputs, p)


def eq16(drive: PneumaticDrive, p: ParameterSet) -> tuple[float, float, float, float, float]:
    """Coefficients of s and 1 in the denominator, the numerator, the third pole and the zero."""
    found = linear(drive, p)
    A, B, C = found.A[1:, 1:], found.B[1:], found.C[1:2, 1:]  # position moves nothing at mid stroke
    poles = np.linalg.eigvals(A)
    third = float(np.real(poles[np.argmin(np.abs(poles + 0.83))]))
    second = np.polydiv(np.poly(A), [1.0, -third])[0]
    numerator = (np.poly(A - B @ C) - np.poly(A)) * K_S
    return second[1], second[2], numerator[2], third, -numerator[3] / numerator[2]


def loop_run(p: ParameterSet, drive: PneumaticDrive, volts: float, **gains: float) -> Array:
    """Speed over its reference, both in volts, on 2 s in steps of 1 ms."""
    loop = ClosedLoop(drive.system(), PID())
    values = {"pid.Kp": K_S, "pid.lower": LOWER, "pid.upper": UPPER} | {f"pid.{n}": v for n, v in gains.items()}
    run = simulate(loop, Step(volts / K_S, horizon=2.0).trajectory(1e-3), (loop.parameters | p).with_values(values))
    return np.asarray(run["speed"] * K_S / volts)


@pytest.mark.parametrize("name", SETS)
def test_sets_are_sourced_possible_and_fresh(name: str) -> None:
    (drive, p), (again, other) = SETS[name](), SETS[name]()
    drive.check(p)
    assert tuple(p) == tuple(drive.system().parameters)
    assert (drive, p) == (again, other)
    assert p is not other
    assert all(p[n].source for n in p if n.startswith(("cylinder.bore", "load.mass", "friction.viscous", "valve.cond")))


def test_r25_linearises_to_equation_16() -> None:
    drive, p = catalog.r25()
    damping, constant, gain, third, zero = eq16(drive, p)
    assert [damping, constant, gain] == pytest.approx([17.5, 86.34, 1270.12], rel=1e-9)
    assert [third, zero] == pytest.approx([-0.83333, -0.83333], abs=1e-5)
    assert drive.rest(p).states["pressure_a"] == pytest.approx(4.84457876e5, rel=1e-9)


def point(drive: PneumaticDrive, p: ParameterSet) -> OperatingPoint:
    """The paper's symbols read off the nonlinear drive by AD."""
    found, states = linear(drive, p), drive.rest(p).states
    V, k = p.value("cylinder.dead_volume_a") + OperatingPoint().A_a * 0.5, 1.4 * 287.05 * 293.15
    K_d = 2e-4  # m/V
    return OperatingPoint(
        K_ma=float(found.B[2, 0]) * V / k / K_d,
        K_mb=-float(found.B[3, 0]) * V / k / K_d,
        K_ca=-float(found.A[2, 2]) * V / k,
        K_cb=-float(found.A[3, 3]) * V / k,
        p_ai=states["pressure_a"],
        V_0a=V,
        M_L=p.value("load.mass"),
        k_v=p.value("friction.viscous"),
    )


def test_equations_1_to_16_in_one_chain() -> None:
    drive, p = catalog.r25()
    found, record = point(drive, p), OperatingPoint()
    for name in ("K_ma", "K_mb", "K_ca", "K_cb", "p_ai", "V_0a"):
        assert getattr(found, name) == pytest.approx(getattr(record, name), rel=2e-9)
    numerator, denominator = second_order(found)
    assert [*denominator, numerator[0] * 2e-4 * K_S] == pytest.approx([1.0, *eq16(drive, p)[:3]], rel=1e-9)


def test_without_smoothing_and_with_the_ellipse() -> None:
    drive, p = catalog.r25()
    sharp = replace(drive, valve=replace(drive.valve, smoothing=Smoothing(1e-7, 1e-8, 1e-3)))
    assert eq16(sharp, p)[:3] == pytest.approx([17.50012, 86.3445, 1270.166], rel=1e-6)
    ellipse = replace(drive, valve=replace(drive.valve, law=Iso6358()))
    q = ellipse.parameters | p
    found = eq16(ellipse, q.with_values({"valve.critical_ratio": CRITICAL_RATIO}))
    assert found[:3] == pytest.approx([17.4996, 86.285, 1269.26], rel=6e-6)


def test_other_hardware_with_the_same_equation() -> None:
    """Equation (15) exactly as printed, whose true constant is 98.1; and a valve that does not leak."""
    drive, p = catalog.r25()
    printed = p.with_values(
        {
            "cylinder.dead_volume_a": 1e-4, "cylinder.dead_volume_b": 1e-4, "valve.rounding": 7.5e-2,
            "load.mass": 10.95905345, "friction.viscous": 184.108273,
            "valve.conductance": p.value("valve.conductance") * 0.01298376921 / 1.5472759716e-2,
        }
    )  # fmt: skip
    at = point(drive, printed)
    numerator, denominator = second_order(at, dropped_constant=True)
    assert [*denominator[1:], numerator[0] * 2e-4 * K_S] == pytest.approx([17.5, 86.34, 1270.12], rel=1e-7)
    assert eq16(drive, printed)[1] == pytest.approx(98.1, abs=0.05)


def test_the_leak_free_set() -> None:
    drive, p = catalog.r25()
    tight = p.with_values(
        {
            "valve.rounding": 1e-6, "load.mass": 10.069647123928888, "friction.viscous": 176.21882466875553,
            "valve.conductance": p.value("valve.conductance") * 0.0129837692 / 1.5472759716e-2,
        }
    )  # fmt: skip
    found = linear(drive, tight)
    A, B, C = found.A[1:, 1:], found.B[1:], found.C[1:2, 1:]
    w = 1j * 5.0
    response = (C @ np.linalg.solve(w * np.eye(3) - A, B)).item() * K_S
    assert response == pytest.approx(1270.12 / (w**2 + 17.5 * w + 86.34), rel=1e-4)


@pytest.mark.parametrize(
    ("volts", "deviation", "peak"), [(0.1, 0.0002, 1.3705), (1.0, 0.013, 1.3613), (5.0, 0.13, None)]
)
def test_the_nonlinear_loop_beside_equation_16(volts: float, deviation: float, peak: float | None) -> None:
    drive, p = catalog.r25()
    y = loop_run(p, drive, volts)
    line = np.linspace(0, 2, 2001)
    linear_y = signal.step(([1270.12], [1.0, 17.5, 86.34 + 1270.12]), T=line)[1]
    assert linear_y.max() == pytest.approx(1.3706, abs=1e-4)
    assert np.abs(y - linear_y).max() == pytest.approx(deviation, rel=0.05)
    assert peak is None or y.max() == pytest.approx(peak, abs=1e-4)


def test_friction_takes_overshoot_away_from_p_and_adds_it_to_pid() -> None:
    drive, p = catalog.r25(lugre=True)
    y = loop_run(p, drive, 1.0)
    assert (y.max(), y[1000:].mean()) == pytest.approx((1.0925, 0.9110), abs=1e-4)
    assert loop_run(p.with_values({"friction.damping_velocity": 1e3}), drive, 1.0).max() == pytest.approx(
        1.1035, abs=2e-4
    )
    gains = {"Kp": 0.225 * K_S, "Ki": 1.23 * K_S, "Kd": 0.01 * K_S, "Tf": 0.01}
    smooth = catalog.r25()
    assert loop_run(smooth[1], smooth[0], 1.0, **gains).max() == pytest.approx(1.014, abs=2e-3)
    assert loop_run(p, drive, 1.0, **gains).max() == pytest.approx(1.402, abs=2e-3)
    assert loop_run(p, drive, 1.0, **gains, c=0.0).max() == pytest.approx(1.46, abs=5e-3)


@pytest.mark.parametrize(
    ("name", "p_a", "p_b", "w0", "damping", "third", "gain", "dither"),
    [
        ("s25", 4.92, 5.66, 51.6, 0.26, -1.56, 0.60, 3.2),
        ("s32", 4.97, 5.62, 34.9, 0.22, -1.29, 0.72, 4.4),
        ("s40", 4.92, 5.66, 19.6, 0.21, -1.02, 0.93, 5.3),
        ("r25", 4.84, 4.84, 9.29, 0.94, -0.83, 0.736, 0.76),
    ],
)
def test_what_the_sets_amount_to(
    name: str, p_a: float, p_b: float, w0: float, damping: float, third: float, gain: float, dither: float
) -> None:
    """Without spool lag and dry friction, about rest; dither is the force per volt at 1000 rad/s on a stuck piston."""
    whole, given = SETS[name]()
    drive = replace(whole, friction=Viscous(), valve=replace(whole.valve, spool=Spool.RIGID))
    p = given.select(n for n in given if n in drive.parameters)
    states, found = drive.rest(p).states, linear(drive, p)
    assert [states["pressure_a"] / 1e5, states["pressure_b"] / 1e5] == pytest.approx([p_a, p_b], abs=0.006)
    A, B, C = found.A[1:, 1:], found.B[1:], found.C[1:2, 1:]
    poles = np.linalg.eigvals(A)
    swinging = poles[np.argmax(poles.imag)]
    real = poles[np.argmin(np.abs(poles.imag))]
    assert abs(swinging) == pytest.approx(w0, rel=3e-3)
    assert -swinging.real / abs(swinging) == pytest.approx(damping, abs=0.006)
    assert real.real == pytest.approx(third, abs=0.006)
    assert (-C @ np.linalg.solve(A, B)).item() == pytest.approx(gain, abs=0.006 if gain < 0.7 else 0.003)
    air = 1000j * np.eye(2) - found.A[AIR, AIR]
    force = (found.A[SPEED : SPEED + 1, AIR] @ np.linalg.solve(air, found.B[AIR])).item() * p.value("load.mass")
    assert abs(force) == pytest.approx(dither, rel=0.02)


@pytest.mark.parametrize(
    ("w", "force", "speed", "travel"),
    [
        (62.8, 12.1, 1.6e-2, 2.5e-4),
        (125.7, 6.1, 4.0e-3, 3.2e-5),
        (628, 1.21, 1.6e-4, 2.6e-7),
        (1000, 0.76, 6.4e-5, 6.4e-8),
    ],
)
def test_what_a_volt_of_dither_moves(w: float, force: float, speed: float, travel: float) -> None:
    drive, p = catalog.r25()
    found = linear(drive, p)
    A, B, C = found.A[1:, 1:], found.B[1:], found.C[1:2, 1:]
    v = abs((C @ np.linalg.solve(1j * w * np.eye(3) - A, B)).item())
    air = 1j * w * np.eye(2) - found.A[AIR, AIR]
    stuck = (found.A[SPEED : SPEED + 1, AIR] @ np.linalg.solve(air, found.B[AIR])).item() * p.value("load.mass")
    assert [abs(stuck), v, v / w] == pytest.approx([force, speed, travel], rel=0.02)


@pytest.mark.parametrize(("volts", "mean", "peak"), [(1.0, 0.9277, None), (4.0, 0.887, 1.235)])
def test_dither_opens_the_lap_and_costs_gain(volts: float, mean: float, peak: float | None) -> None:
    drive, p = catalog.r25()
    loop = ClosedLoop(drive.system(), PID(), Dither())
    gains = {"pid.Kp": K_S, "pid.lower": LOWER, "pid.upper": UPPER}
    dither = {"dither.amplitude": volts, "dither.frequency": 1000 / (2 * np.pi)}
    t = np.linspace(0, 2, 4001)
    step = Trajectory(t, {"reference": np.full_like(t, 1 / K_S)})
    y = simulate(loop, step, (loop.parameters | p).with_values(gains | dither), rtol=1e-8)["speed"] * K_S
    assert y[3000:].mean() == pytest.approx(mean, abs=5e-4)
    assert peak is None or y.max() == pytest.approx(peak, abs=1e-3)


def test_the_resting_spool_of_a_single_rod_is_off_centre() -> None:
    for name in ("s25", "s32", "s40"):
        drive, p = SETS[name]()
        assert drive.rest(p).states["valve.spool"] == pytest.approx(-0.003, abs=4e-4)
    drive, p = catalog.r25()
    assert drive.rest(p).inputs["valve_voltage"] == 0.0


def test_theoretical_forces() -> None:
    for name, force in (("s25", 295), ("s32", 483), ("s40", 754)):
        assert np.pi / 4 * SETS[name]()[1].value("cylinder.bore") ** 2 * 6e5 == pytest.approx(force, abs=1)


def test_null_leak_and_size_of_r25() -> None:
    drive, p = catalog.r25()
    assert p.value("valve.conductance") == pytest.approx(2.16e-8, rel=2e-3)
    assert drive.valve.law == IsentropicNozzle()
    opening, at = p.value("valve.rounding") / 2, drive.rest(p).states["pressure_a"]
    exhaust = opening * p.value("valve.conductance") * at * 60e3  # chamber to ambient is choked
    assert 2 * exhaust == pytest.approx(51, abs=1)


def b32_by_hand(x: Array, u: float) -> Array:
    """The benchmark as its text gives it: hard clip, sharp maximum."""
    y, v, p_a, p_b, x_v = x
    L, A_a, A_b = 0.2, np.pi / 4 * 0.032**2, np.pi / 4 * (0.032**2 - 0.012**2)
    R, T, rho, C, b, n = 287.0, 293.15, 1.185, 2e-8, 0.3, 1.2

    def flow(p1: float, p2: float, spool: float) -> float:
        high = max(p1, p2)
        s = float(np.clip((p1 - p2) / (high * (1 - b)), -1, 1))
        q = np.sqrt(s**2 + 0.005**2)
        opening = 0.5 * (spool + np.sqrt(spool**2 + 0.01**2)) + 0.01
        return float(C * rho * high * opening * s * np.sqrt(2 - q) / np.sqrt(q))

    m_a, m_b = flow(7e5, p_a, x_v) - flow(p_a, 1e5, -x_v), flow(7e5, p_b, -x_v) - flow(p_b, 1e5, x_v)
    V_a, V_b = A_a * (y + 0.05 * L), A_b * (L - y + 0.05 * L)
    F = (40 + 30 * np.exp(-((v / 0.02) ** 2))) * np.tanh(v / 1e-3) + 80 * v
    acceleration = (A_a * (p_a - 1e5) - A_b * (p_b - 1e5) - F) / 5
    p_rates = n / V_a * (R * T * m_a - p_a * A_a * v), n / V_b * (R * T * m_b + p_b * A_b * v)
    return np.array([v, acceleration, *p_rates, (u - x_v) * 2 * np.pi * 50])


def test_b32_is_its_text() -> None:
    drive, p = catalog.b32()
    rng, values = np.random.default_rng(3), parameter_vector(drive.parameters, p)
    scale = np.array([1.0, 100.0, 1e7, 1e7, 100.0])
    for _ in range(300):
        x = rng.uniform([0.0, -0.5, 1.05e5, 1.05e5, -0.6], [0.2, 0.5, 6.9e5, 6.9e5, 0.6])
        u = rng.uniform(-0.6, 0.6)
        ours = np.asarray(drive.system().ode(0, x, [u], values)[0]).ravel()
        assert np.abs(ours - b32_by_hand(x, u)).max() == pytest.approx(0, abs=50)  # Pa/s, of millions
        assert ours / scale == pytest.approx(b32_by_hand(x, u) / scale, abs=2e-6)


def test_t32_starts_as_its_text_says() -> None:
    drive, p = catalog.t32()
    rest = drive.rest(p, pressure_b=3.5e5)
    A_a, A_b = np.pi / 4 * 0.032**2, np.pi / 4 * (0.032**2 - 0.012**2)
    assert rest.states["pressure_a"] == pytest.approx(1e5 + A_b / A_a * 2.5e5, rel=1e-12)
    assert rest.states["position"] == pytest.approx(0.05)
    x = {**rest.states, "valve.spool": 0.2, "valve.spool_rate": 3.0, "speed": 0.1, "friction.bristle": 1e-4}
    rates = np.asarray(drive.system().ode(0, list(x.values()), [2.0], parameter_vector(drive.parameters, p))[0]).ravel()
    w = 2 * np.pi * 80
    assert rates[5] == pytest.approx(w**2 * (2.0 / 5 - 0.2) - 1.6 * w * 3.0)
    z_rate = 0.1 - 1e5 * 0.1 * 1e-4 / (40 + 30 * np.exp(-25.0))
    friction = 1e5 * 1e-4 + 424 * np.exp(-4.0) * z_rate + 80 * 0.1
    assert rates[6] == pytest.approx(z_rate)
    assert rates[1] == pytest.approx(-friction / 5)
    opening = 0.5 * (0.17 + np.sqrt(0.17**2 + 0.002**2))
    shut = 0.5 * (-0.23 + np.sqrt(0.23**2 + 0.002**2))
    p_a, V = rest.states["pressure_a"], 20e-6 + A_a * 0.05
    s = [(7e5 - p_a) / (7e5 * 0.7), min(1.0, (p_a - 1e5) / (p_a * 0.7))]
    fed = (
        2e-8 * 1.185 * (7e5 * opening * s[0] ** 0.5 * (2 - s[0]) ** 0.5 - p_a * shut * s[1] ** 0.5 * (2 - s[1]) ** 0.5)
    )
    assert rates[2] == pytest.approx(1.2 / V * (287.0 * 293.15 * fed - p_a * A_a * 0.1), rel=1e-4)


def test_b32_runs_as_its_log_was_made() -> None:
    """It sticks, slips and moves both ways under its own law, ``u = clip(4 (r - x) - 0.15 v)``, by hand."""
    drive, p = catalog.b32()
    plant = drive.system()
    loop = ClosedLoop(plant, PID(sample_time=1e-3), measured="position")
    gains = {"pid.Kp": 4.0, "pid.Kd": 0.15, "pid.c": 0.0, "pid.Tf": 0.0, "pid.lower": -0.6, "pid.upper": 0.6}
    given = (loop.parameters | p).with_values(gains)
    t = np.arange(1000) * 1e-3
    reference = np.where(t < 0.5, 0.15, 0.05)
    x = loop.initial(given, reference=0.1)[: len(plant.states)]
    begun = loop.initial(given, x, reference=0.1, command=0.0)
    run = simulate(loop, Trajectory(t, {"reference": reference}), given, initial=begun)
    step, values = discretise(plant).step, [given.value(n) for n in plant.parameters]
    place, positions = [q.name for q in plant.outputs].index("position"), []
    for r in reference.tolist():
        positions.append(float(plant.ode(0.0, x, [0.0], values)[1][place]))
        damping = 0.15 * (positions[-1] - positions[-2 if len(positions) > 1 else -1]) / 1e-3
        u = min(max(4.0 * (r - positions[-1]) - damping, -0.6), 0.6)
        for _ in range(40):
            x = step(0.0, 1e-3 / 40, x, [u], values)[0].full().ravel()
    assert run["position"] == pytest.approx(np.array(positions), abs=1e-5)
    assert run["position"][499] == pytest.approx(0.15, abs=5e-3)
    assert run["speed"].max() > 0.3
    assert run["speed"].min() < -0.3
