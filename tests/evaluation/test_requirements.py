"""Air and valve travel against mass balances and SciPy, and the search's figure against the certificate's."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveProfile
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.metrics import meter_record
from pneuopt.evaluation.requirements import (
    IAE,
    METRICS,
    REQUIREMENT_KINDS,
    AirUse,
    GainMargin,
    Overshoot,
    PhaseMargin,
    Requirement,
    SettlingTime,
    StepEnvelope,
    describe_value,
    metric_name,
    requirement_values,
    upper_limit,
)
from pneuopt.evaluation.specification import specify
from pneuopt.models.catalog import t32
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import Smoothing
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ANR_DENSITY
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import loop_pieces, search_space


def test_an_overshoot_of_zero_is_a_hundredth_of_a_percent() -> None:
    assert Overshoot(0) == Overshoot(1e-4)
    spec = specify(SettlingTime(), [Overshoot(0.0)])
    assert not spec.violations({"Overshoot": 9e-5})
    assert [type(q) for q in spec.violations({"Overshoot": 1.1e-4})] == [Overshoot]


def test_metrics_in_percent_become_fractions() -> None:
    metrics = {"SettlingTime": 0.3, "Overshoot": 5.0, "SteadyStateError": 2.0, "PeakControl": 4.0, "Undershoot": 0.1}
    assert requirement_values(metrics) == {
        "SettlingTime": 0.3,
        "Overshoot": 0.05,
        "SteadyStateError": 0.02,
        "PeakControl": 4.0,
    }


def test_a_margin_counts_by_its_reciprocal() -> None:
    """A gain margin below one is the factor down that makes a loop oscillate: 0.5 is as good as 2."""
    values = requirement_values(
        {"GainMargin": np.array([2.0, 0.5, 4.0, math.inf]), "PhaseMargin": np.array([50.0, -50.0, 0.0, math.inf])}
    )
    np.testing.assert_allclose(values["GainMargin"], [0.5, 0.5, 0.25, 0.0])
    np.testing.assert_allclose(values["PhaseMargin"], [0.02, 0.02, math.inf, 0.0])
    assert math.isnan(requirement_values({"PhaseMargin": math.nan})["PhaseMargin"])


@given(st.floats(1.001, 100.0), st.floats(1.001, 100.0))
def test_a_margin_is_kept_where_it_is_large_enough(least: float, margin: float) -> None:
    for requirement, metric in ((GainMargin(least), "GainMargin"), (PhaseMargin(least), "PhaseMargin")):
        kept = requirement_values({metric: margin})[metric] <= upper_limit(requirement) * (1 + 1e-12)
        assert kept == (margin >= least * (1 - 1e-12)) or margin == pytest.approx(least, rel=1e-9)


def test_limits_are_told_as_they_were_written() -> None:
    assert describe_value(PhaseMargin(45.0), 1 / 30) == ("30", "at least 45")
    assert describe_value(GainMargin(2.0), 0.0) == ("inf", "at least 2")
    assert describe_value(IAE(0.1), 0.125) == ("0.125", "allowed 0.1")


@pytest.mark.parametrize("kind", [k for k in REQUIREMENT_KINDS if k is not StepEnvelope])
def test_without_a_bound_nothing_is_forbidden(kind: type[Requirement]) -> None:
    assert upper_limit(kind()) == math.inf
    assert metric_name(kind()) == kind.__name__


def metered(t: np.ndarray, flow: np.ndarray, spool: np.ndarray, start: float) -> dict[str, float]:
    record = meter_record(t, {"air": flow, "spool": spool}, start)
    return {n: METRICS[n].largest(record).item() for n in ("AirUse", "ValveTravel")}


STEP = Step(0.1, horizon=0.4, start={"position": 0.2, "pressure_b": 3.5e5})


def driven(amplitude: float = 0.0, sample_time: float | None = 1e-3) -> tuple[ClosedLoop, ParameterSet]:
    drive, values = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=sample_time), Dither(60.0))
    gains = {"pid.Kp": 2.0, "pid.Ki": 20.0, "pid.lower": -5.0, "pid.upper": 5.0, "dither.amplitude": amplitude}
    return loop, (loop.parameters | values).with_values(gains)


@pytest.mark.parametrize(("side", "volts"), [("a", 1.0), ("b", -1.0)])
def test_air_that_fills_a_chamber_of_constant_volume_is_what_the_supply_gave(side: str, volts: float) -> None:
    """The valve opens to one chamber; the air drawn is what that chamber gained, m = p V/(R T) at n = 1."""
    drive, values = t32()
    plant = drive.system()
    assert plant.meter is not None
    held = {"load.mass": 1e5, "chamber.exponent": 1.0, "friction.viscous": 1e5}
    p = values.with_values(held)
    start = drive.rest(p, position=0.25, pressure_b=3.5e5).states
    t = np.linspace(0.0, 0.2, 401)
    run = simulate(plant, Trajectory(t, {"valve_voltage": np.full(len(t), volts)}), p, initial=start)
    full = (plant.parameters | p).select(plant.parameters)
    states, u = run.matrix([q.name for q in plant.states]).T, np.full((1, len(t)), volts)
    flow, spool, _ = (np.array(r) for r in plant.meter.map(len(t))(0, states, u, [full.value(n) for n in full]))
    litres = metered(t, flow, spool, 0.0)["AirUse"]
    bore, rod, stroke = (p.value(f"cylinder.{n}") for n in ("bore", "rod", "stroke"))
    area = np.pi / 4 * (bore**2 - (rod**2 if side == "b" else 0.0))
    x = run["position"][-1]
    volume = p.value(f"cylinder.dead_volume_{side}") + area * (x if side == "a" else stroke - x)
    pressure = run[f"pressure_{side}"]
    gained = (pressure[-1] - pressure[0]) * volume / (287.0 * p.value("ambient.temperature"))
    assert x == pytest.approx(0.25, abs=1e-4)
    assert litres == pytest.approx(1e3 * gained / ANR_DENSITY, rel=2e-3)
    np.testing.assert_allclose(spool[0], run["valve.spool"], atol=1e-12)


HARDWARE = {
    "cylinder.bore": 0.032,
    "cylinder.rod": 0.012,
    "cylinder.stroke": 0.3,
    "cylinder.dead_volume_a": 2e-5,
    "cylinder.dead_volume_b": 3e-5,
    "valve.conductance": 2e-8,
    "valve.critical_ratio": 0.3,
    "valve.dead_zone": 0.03,
    "valve.rounding": 1e-4,
    "valve.span": 5.0,
    "supply.pressure": 7e5,
    "ambient.pressure": 1e5,
    "ambient.temperature": 288.0,
    "gas.constant": 287.0,
    "chamber.exponent": 1.2,
    "load.mass": 5.0,
    "friction.viscous": 80.0,
}
GAIN, SAMPLE_TIME, TRAVEL_TIME, DWELL = 30.0, 1e-3, 0.5, 0.4  # [V/m, s, s, s]
BEGIN, DISTANCE, START_PRESSURE = 0.1, 0.12, 3.5e5  # [m, m, Pa(a)]


def air_by_scipy() -> float:
    """Litres that a drive with sharp edges draws over a move of least jerk, under a sampled P controller."""
    h = HARDWARE
    area_a = np.pi / 4 * h["cylinder.bore"] ** 2
    area_b = area_a - np.pi / 4 * h["cylinder.rod"] ** 2
    heat = h["gas.constant"] * h["ambient.temperature"]
    supply, ambient = h["supply.pressure"], h["ambient.pressure"]

    def flow(high: float, low: float, opening: float) -> float:
        """ISO 6358-1 [kg/s]."""
        if low > high:
            return -flow(low, high, opening)
        choked = h["valve.conductance"] * 1.185 * np.sqrt(293.15 / h["ambient.temperature"]) * opening * high
        beyond = max(low / high - h["valve.critical_ratio"], 0.0) / (1 - h["valve.critical_ratio"])
        return float(choked * np.sqrt(1 - beyond**2))

    def rates(_t: float, z: np.ndarray, spool: float) -> list[float]:
        y, v, a, b, _ = z
        to_a, to_b = (max(0.0, sign * spool - h["valve.dead_zone"]) for sign in (1, -1))
        into_a, into_b = flow(supply, a, to_a), flow(supply, b, to_b)
        volume_a = h["cylinder.dead_volume_a"] + area_a * y
        volume_b = h["cylinder.dead_volume_b"] + area_b * (h["cylinder.stroke"] - y)
        force = area_a * (a - ambient) - area_b * (b - ambient) - h["friction.viscous"] * v
        rise_a = h["chamber.exponent"] / volume_a * (heat * (into_a - flow(a, ambient, to_b)) - area_a * v * a)
        rise_b = h["chamber.exponent"] / volume_b * (heat * (into_b - flow(b, ambient, to_a)) + area_b * v * b)
        return [v, force / h["load.mass"], rise_a, rise_b, into_a + into_b]

    balanced = ambient + area_b / area_a * (START_PRESSURE - ambient)
    z = np.array([BEGIN, 0.0, balanced, START_PRESSURE, 0.0])
    for k in range(round((TRAVEL_TIME + DWELL) / SAMPLE_TIME)):
        s = min(k * SAMPLE_TIME / TRAVEL_TIME, 1.0)
        error = BEGIN + DISTANCE * (10 * s**3 - 15 * s**4 + 6 * s**5) - z[0]
        spool = float(np.clip(GAIN * error / h["valve.span"], -1.0, 1.0))
        z = solve_ivp(rates, (0.0, SAMPLE_TIME), z, args=(spool,), rtol=1e-5, atol=1e-8).y[:, -1]
    assert z[0] == pytest.approx(BEGIN + DISTANCE, abs=5e-3)
    return float(z[4]) / 1.185 * 1e3


def test_the_air_of_a_move_is_that_of_the_equations_in_plain_scipy() -> None:
    """Of a sampled P controller on a drive whose edges are sharp and close."""
    valve = ProportionalValve(spool=Spool.RIGID, smoothing=Smoothing(corner=1e-3, zero=1e-3, pressure=1.0))
    drive = PneumaticDrive(valve, Viscous(), cylinder=Cylinder(stops=False))
    loop = ClosedLoop(drive.system(), PID(SAMPLE_TIME), measured="position")
    p = loop.parameters.with_values(HARDWARE | {"pid.Kp": GAIN, "pid.Ki": 0.0})
    # A move of least jerk is as fast as its peak speed allows, 15/8 of its mean.
    move = Move(
        DISTANCE,
        speed=15 / 8 * DISTANCE / TRAVEL_TIME,
        acceleration=1e3,
        profile=MoveProfile.MINIMUM_JERK,
        initial=BEGIN,
        dwell=DWELL,
        start={"pressure_b": START_PRESSURE},
    )
    assert move.duration == pytest.approx(TRAVEL_TIME)
    assert evaluate(loop, move, p)[move.label]["AirUse"] == pytest.approx(air_by_scipy(), rel=5e-4)


def test_a_closed_valve_draws_nothing_and_travel_counts_to_and_fro() -> None:
    t = np.linspace(0.0, 1.0, 1001)
    found = metered(t, np.zeros((1, 1001)), 0.1 * np.sin(2 * np.pi * 5 * t)[None], 0.0)
    assert found["AirUse"] == 0.0
    assert found["ValveTravel"] == pytest.approx(4 * 0.1 * 5, rel=1e-4)
    later = metered(t, np.ones((1, 1001)), np.zeros((1, 1001)), 0.5)["AirUse"]
    assert later == pytest.approx(0.5e3 / ANR_DENSITY)


@pytest.mark.parametrize("amplitude", [0.0, 0.6])
def test_the_search_counts_the_air_that_the_certificate_counts(amplitude: float) -> None:
    loop, p = driven(amplitude)
    freed = p.with_bounds({"pid.Kp": (1.0, 4.0)}).freed("pid.Kp")
    spec = specify({SettlingTime(): 1.0, AirUse(): 1.0})
    claimed = Simulator(loop, [STEP], search_space(loop, freed), spec=spec).table(np.array([2.0]), spec)[0]["AirUse"]
    certified = evaluate(loop, STEP, p)[STEP.label]
    assert claimed == pytest.approx(certified["AirUse"], rel=0.01)
    assert certified["ValveTravel"] > 0


def test_dither_costs_air_and_travel() -> None:
    (loop, still), (_, shaken) = driven(0.0), driven(1.0)
    before, after = (evaluate(loop, STEP, p)[STEP.label] for p in (still, shaken))
    assert after["AirUse"] > 1.2 * before["AirUse"]
    assert after["ValveTravel"] > 5 * before["ValveTravel"]


def test_the_meter_is_no_output_and_watched_only_where_air_is_asked_for() -> None:
    loop, p = driven()
    assert set(respond(loop, STEP, p).names) == {q.name for q in (*loop.states, *loop.outputs)}
    plain, metered = (loop_pieces(loop, asked).step for asked in ((), ("air", "spool")))
    assert metered.numel_out(1) - plain.numel_out(1) == 2


def test_air_of_a_plant_that_draws_none_is_refused() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID())
    given = loop.parameters.with_bounds({"pid.Kp": (0.5, 2.0)}).freed("pid.Kp")
    with pytest.raises(InputError, match="this plant does not show AirUse: it has no meter"):
        Simulator(loop, [Step(1.0)], search_space(loop, given), spec=specify(AirUse(max=1.0)))
    assert "AirUse" not in evaluate(loop, Step(1.0), given).index
