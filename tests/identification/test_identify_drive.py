"""A pneumatic drive identified from whatever was logged; the logs are generated, so the truth is known."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

import pneuopt as po
from pneuopt.models.catalog import b32
from pneuopt.models.pneumatic.drive import PneumaticDrive
from problems.shared.b32 import FREE, LOGGED, VALVE, generate

WRONG = {"valve.conductance": 5e-8, "valve.leak": 0.0, "load.mass": 4.0, "supply.pressure": 6.5e5}
WRONG |= {"valve.critical_ratio": 0.3, "valve.dead_zone": 0.0}
TRUTH = {"supply.pressure": 6e5, "load.mass": 3.0}


@pytest.fixture(scope="module")
def log() -> po.Experiment:
    drive, truth = b32()
    return generate(drive, truth, seconds=2.0)


def blind(drive: PneumaticDrive, truth: po.ParameterSet, *free: str) -> po.ParameterSet:
    """Free parameters start from the drive's defaults or from wrong values; no start finder reads friction's."""
    return truth.with_values({n: WRONG.get(n, drive.parameters.value(n)) for n in free}).freed(*free)


def check(fit: po.IdentificationResult, truth: Mapping[str, float], near: float) -> None:
    """Within some percent, and within four deviations."""
    for name, row in fit.estimates.iterrows():
        true = truth[str(name)]
        assert row["value"] == pytest.approx(true, rel=near), name
        assert abs(row["value"] - true) < 4 * row["stderr"], name


def numbers(truth: po.ParameterSet) -> dict[str, float]:
    return {n: p.value for n, p in truth.items()}


@pytest.mark.parametrize(
    ("channels", "free"),
    [
        (("position", "pressure_a"), (*FREE, *VALVE)),
        (("position", "pressure_b"), (*FREE, *VALVE)),
        (("position",), FREE),
        (("position",), (*FREE, *VALVE)),
    ],
)
def test_fewer_channels_still_tell(log: po.Experiment, channels: tuple[str, ...], free: tuple[str, ...]) -> None:
    drive, truth = b32()
    fit = po.identify(drive.system(), [log.select(("valve_voltage", *channels))], blind(drive, truth, *free))
    check(fit, numbers(truth), 0.05)


@pytest.mark.parametrize("off", [0.0, -0.02])
def test_speed_alone_identifies_friction_and_where_it_began(log: po.Experiment, off: float) -> None:
    """The air in both chambers identifies the position, if the log begins elsewhere than it is said to."""
    drive, truth = b32()
    true = float(log.trajectory["position"][0])
    begin = {"cylinder.start": (true + off) / truth.value("cylinder.stroke")}
    speed = log.select(("valve_voltage", "speed")).with_conditions(begin)
    fit = po.identify(drive.system(), [speed], blind(drive, truth, *FREE))
    check(fit, numbers(truth), 0.15)
    assert fit.trajectories["b32"]["position"][0] == pytest.approx(true, abs=1e-3)


def test_supply_and_load_are_known_of_each_log_or_found_for_each(log: po.Experiment) -> None:
    drive, truth = b32()
    other = replace(generate(drive, truth.with_values(TRUTH), seconds=2.0).select(LOGGED), name="other")
    logs = [replace(log.select(LOGGED), name="first"), other]
    known = [logs[0], other.with_conditions(TRUTH)]
    check(po.identify(drive.system(), known, blind(drive, truth, *FREE, *VALVE)), numbers(truth), 0.02)
    own = blind(drive, truth, *FREE, *VALVE, *TRUTH).per_log(*TRUTH)
    each = {f"{n}[first]": truth.value(n) for n in TRUTH} | {f"{n}[other]": v for n, v in TRUTH.items()}
    fit = po.identify(drive.system(), logs, own)
    assert set(each) <= set(fit.estimates.index)
    check(fit, numbers(truth) | each, 0.02)


def test_dead_zone_and_critical_ratio_are_found_with_friction() -> None:
    drive, truth = b32()
    truth = truth.with_values({"valve.dead_zone": 0.05, "valve.critical_ratio": 0.4})
    free = (*FREE, *VALVE, "valve.dead_zone", "valve.critical_ratio")
    log = generate(drive, truth, seconds=2.0).select(LOGGED)
    check(po.identify(drive.system(), [log], blind(drive, truth, *free)), numbers(truth), 0.05)


def test_friction_from_the_force_of_the_logged_pressures_comes_near(log: po.Experiment) -> None:
    drive, truth = b32()
    force = drive.air_force(log.trajectory, truth)
    p = numbers(truth)
    areas = np.pi / 4 * p["cylinder.bore"] ** 2 * np.array([1, 1 - (p["cylinder.rod"] / p["cylinder.bore"]) ** 2])
    gauge = log.trajectory.matrix(["pressure_a", "pressure_b"]) - p["ambient.pressure"]
    assert force == pytest.approx(gauge @ (areas * [1, -1]))
    load = po.ForceDrive(drive.friction, drive.load)
    pushed = replace(log, trajectory=log.trajectory.with_columns({"force": force})).select(["force", "position"])
    known = truth.select(load.parameters)
    free = {n: load.parameters.value(n) for n in FREE}
    fit = po.identify(load.system(), [pushed], known.with_values(free).freed(*FREE), throw=False)
    for name in ("friction.coulomb", "friction.static", "friction.viscous"):
        assert fit.parameters.value(name) == pytest.approx(truth.value(name), rel=0.1), name
