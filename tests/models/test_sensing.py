"""Sensors that come late, lag or are off, as parameters of a plant."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.identification.identify import identify
from pneuopt.logs.experiment import Experiment
from pneuopt.models.catalog import b32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.models.sensing import coarse_delay, with_sensors
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory

TRUTH = {"load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
NOISE = {"position": 2e-5, "speed": 1e-3}
DRIVE = ForceDrive(Coulomb()).system()


def pushed(seed: int = 0, late: int = 0, off: float = 0.0, n: int = 1500) -> Experiment:
    """A log of a force-driven load whose position comes whole samples late, and whose speed is off."""
    t = np.arange(n + late) * 1e-3
    force = 50 * np.sin(2 * np.pi * t + seed) + 40 * np.sin(2 * np.pi * 2.3 * t)
    run = simulate(
        DRIVE,
        Trajectory(t, {"force": force}),
        DRIVE.parameters.with_values(TRUTH),
        intersample={"force": Intersample.LINEAR},
    )
    random = np.random.default_rng(seed)
    columns = {"force": force[late:], "position": run["position"][:n], "speed": run["speed"][late:] + off}
    noisy = {c: columns[c] + s * random.standard_normal(n) for c, s in NOISE.items()}
    return Experiment(Trajectory(t[late:], columns | noisy), NOISE, name=f"run {seed}")


def gain(system: System, delay: float, frequency: float) -> complex:
    """Of the position's sensor alone: what is read over what is."""
    p = system.parameters.with_values({"sensor.position.delay": delay})
    plant = system.linearise(np.array([0.0, 0.5, *np.zeros(len(system.states) - 2)]), {}, p)
    own = [i for i, n in enumerate(names(system.states)) if n.startswith("sensor.")]
    A, B = plant.A[np.ix_(own, own)], plant.A[np.ix_(own, [0])]
    C, row = plant.C[:, own], plant.outputs.index("position")
    D = plant.C[row, 0]
    resolvent = np.linalg.solve(2j * math.pi * frequency * np.eye(len(own)) - A, B)
    return complex((C[row] @ resolvent)[0] + D)


@pytest.mark.parametrize(("angle", "error"), [(0.5, 1e-4), (1.0, 1.5e-3), (2.0, 4.5e-2)])
def test_a_delay_passes_every_size_and_is_late_as_stated(angle: float, error: float) -> None:
    system, delay = with_sensors(DRIVE, delay=["position"]), 5e-3
    found = gain(system, delay, angle / (2 * math.pi * delay))
    assert abs(found) == pytest.approx(1, abs=1e-9)
    assert abs(np.angle(found * np.exp(1j * angle))) < error
    assert abs(np.angle(found * np.exp(1j * angle))) < 1.01 * angle**5 / 720


def test_skew_and_zero_points_are_recovered_with_their_intervals() -> None:
    """Two logs with different channels; the position comes 5 ms late, each speed has its own zero point."""
    zeros = {"run 0": 0.02, "run 1": -0.01}
    logs = [pushed(seed, late=5, off=zero) for seed, zero in enumerate(zeros.values())]
    logs = [logs[0], logs[1], replace(pushed(2, late=5), name="position only").select(["force", "position"])]
    system = with_sensors(DRIVE, offset=["speed"], delay=["position"])
    free = system.parameters.freed(*TRUTH, "sensor.*").per_log("sensor.speed.offset")
    free = free.with_bounds({"sensor.speed.offset": (-0.1, 0.1)})
    fit = identify(system, [logs[0], logs[1]], free)
    truth = {**TRUTH, "sensor.position.delay": 5e-3, **{f"sensor.speed.offset[{n}]": z for n, z in zeros.items()}}
    for name, row in fit.estimates.loc[[*truth]].iterrows():
        assert abs(row["value"] - truth[str(name)]) < 4 * row["stderr"], name
    assert fit.estimates["value"]["sensor.position.delay"] == pytest.approx(5e-3, abs=5e-4)
    alone = identify(system, [logs[2]], system.parameters.freed(*TRUTH, "sensor.position.delay"))
    assert alone.estimates["value"]["sensor.position.delay"] == pytest.approx(5e-3, abs=5e-4)


def test_the_start_takes_the_delay_from_cross_correlation() -> None:
    log, system = pushed(late=5), with_sensors(DRIVE, delay=["position"])
    assert coarse_delay(log.trajectory, "position", "speed") == pytest.approx(5e-3, abs=5e-4)
    assert coarse_delay(log.trajectory, "speed", "position") == pytest.approx(-5e-3, abs=5e-4)
    start, *_ = system.starts({"run": Log(log.trajectory, system.parameters.freed(*TRUTH, "sensor.*"))})
    assert start.parameters["sensor.position.delay"] == pytest.approx(5e-3, abs=5e-4)
    assert start.states["run"].names[-2:] == ("sensor.position.level", "sensor.position.late")


def test_lag_and_delay_settle_on_the_truth() -> None:
    system = with_sensors(DRIVE, delay=["speed"], lag=["speed", "position"], offset=["position"])
    given = {**TRUTH, "sensor.position.offset": 0.1, "sensor.speed.lag": 4e-3}
    t = np.arange(2000) * 1e-3
    run = simulate(system, Trajectory(t, {"force": np.full(t.size, 100.0)}), system.parameters.with_values(given))
    plain = simulate(DRIVE, Trajectory(t, {"force": np.full(t.size, 100.0)}), DRIVE.parameters.with_values(TRUTH))
    assert run["speed"][-1] == pytest.approx(plain["speed"][-1], rel=1e-6)
    late = plain["position"][-1] - (run["position"][-1] - 0.1)
    assert late == pytest.approx(1e-3 * plain["speed"][-1], rel=1e-3)


def test_a_drive_behind_its_sensors_still_rests() -> None:
    drive, parameters = b32()
    system = with_sensors(drive.system(), offset=["pressure_a"], delay=["position"], lag=["pressure_b"])
    assert system.rest_hook is not None
    rest = system.rest_hook(parameters, {"position": 0.05})
    x, u = (
        np.array([part.get(n, 0.0) for n in names(q)])
        for part, q in zip(rest, (system.states, system.inputs), strict=True)
    )
    p = [(system.parameters | parameters).value(n) for n in system.parameters]
    rate = np.array(system.ode(0, x, u, p)[0])
    nominal = np.array([q.nominal for q in system.states])
    assert np.abs(rate.ravel() / nominal).max() < 1e-3
