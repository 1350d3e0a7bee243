"""Sensors before a line: their pressures are the chambers' and a drop in proportion to the flow, from the gas law."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pneuopt as po
from pneuopt.dynamics.hooks import Log
from pneuopt.models.catalog import b32, s32, t32
from pneuopt.models.pneumatic.cylinder import volumes
from pneuopt.models.pneumatic.line_pressure import LEADS, Balance, LinePressureCheck
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import without_prefix
from pneuopt.quantities.trajectories import Trajectory

DATA = Path(__file__).parents[3] / "data"
SETS = {"b32": (b32, 0.25, 5.0), "s32": (s32, 0.35, 2.5), "t32": (t32, 0.3, 2.5)}  # opening, frequency [Hz]
BOTH = ("pressure_a", "pressure_b")


@pytest.fixture(scope="module", params=SETS)
def swing(request: pytest.FixtureRequest) -> tuple[po.System, po.ParameterSet, Trajectory, dict[str, Array]]:
    """1.5 s of a valve opened to and fro, with 20 um and 1 kPa of noise, and the flow into each chamber [kg/s]."""
    make, opening, frequency = SETS[request.param]
    drive, truth = make()
    t = np.arange(1500) * 1e-3
    voltage = opening * truth.value("valve.span") * np.cos(2 * np.pi * frequency * t) * np.cos(2 * np.pi * 0.4 * t)
    rest = drive.rest(truth, position=truth.value("cylinder.stroke") / 2)
    run = po.simulate(drive.system(), Trajectory(t, {"valve_voltage": voltage}), truth, initial=rest.states, rtol=1e-7)
    geometry: Any = without_prefix({n: p.value for n, p in truth.items()}, "cylinder")
    position: Any = run["position"]
    size: Any = volumes(position, geometry)
    gas = truth.value("gas.constant") * truth.value("ambient.temperature")
    flows = {n: np.gradient(run[n] * v, t) / gas for n, v in zip(BOTH, size, strict=True)}
    rng = np.random.default_rng(0)
    noise = {"position": 2e-5, **dict.fromkeys(BOTH, 1e3)}
    noisy = {n: run[n] + level * rng.standard_normal(t.size) for n, level in noise.items()}
    return drive.system(), truth.freed("friction.*"), Trajectory(t, {"valve_voltage": voltage, **noisy}), flows


@pytest.mark.parametrize("drop", [0.4e5, 0.8e5])
def test_the_drop_of_a_line_is_seen_and_its_size_found(
    swing: tuple[po.System, po.ParameterSet, Trajectory, dict[str, Array]], drop: float
) -> None:
    system, truth, log, flows = swing
    most = max(float(np.quantile(np.abs(flow), 0.999)) for flow in flows.values())
    before = log.with_columns({n: log[n] + drop * flows[n] / most for n in BOTH})
    (said,) = system.log_warnings({"run": Log(before, truth)})
    found = re.search(r"lead the chambers by .* ms, as before a line that drops up to (\S+) bar", said)
    assert found is not None
    assert float(found.group(1)) == pytest.approx(drop / 1e5, rel=0.5)


def test_pressures_of_the_chambers_and_late_ones_are_not_doubted(
    swing: tuple[po.System, po.ParameterSet, Trajectory, dict[str, Array]],
) -> None:
    system, truth, log, _ = swing
    late = log.with_columns({n: np.interp(log.t - 5e-3, log.t, log[n]) for n in BOTH})
    for right in (log, late):
        assert system.log_warnings({"run": Log(right, truth)}) == []


@pytest.mark.parametrize("run", ["run_01", "run_02"])
def test_the_example_rig_is_not_doubted(run: str) -> None:
    drive, given = po.read_drive(DATA / "pneumatic_rig" / "drive.toml")
    system, log = drive.system(), po.read_log(DATA / "pneumatic_rig" / f"{run}.csv")
    assert system.log_warnings({run: Log(log.trajectory, system.parameters | given)}) == []


def test_longer_leads_are_not_tried_once_two_are_worse(
    swing: tuple[po.System, po.ParameterSet, Trajectory, dict[str, Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    system, truth, log, flows = swing
    tried, behind = list[float](), LinePressureCheck._behind_line

    def counted(self: LinePressureCheck, log: Log, given: Balance, lead: float) -> Balance:
        tried.append(lead)
        return behind(self, log, given, lead)

    monkeypatch.setattr(LinePressureCheck, "_behind_line", counted)
    most = max(float(np.quantile(np.abs(flow), 0.999)) for flow in flows.values())
    before = log.with_columns({n: log[n] + 0.8e5 * flows[n] / most for n in BOTH})
    (said,) = system.log_warnings({"run": Log(before, truth)})
    lead = next(each for each in LEADS if f"lead the chambers by {1e3 * each:.2g} ms" in said)
    assert tuple(tried) == LEADS[: LEADS.index(lead) + 3]
