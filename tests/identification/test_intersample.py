"""Logs of inputs that vary between the samples: the truth is SciPy's, under the continuous force itself."""

import math
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, LoadDependent
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Intersample, Quantity
from pneuopt.quantities.trajectories import Trajectory

MASS, COULOMB, VISCOUS, SMOOTHING, NOISE = 5.0, 20.0, 80.0, 5e-3, 5e-6
TRUTH = {"load.mass": MASS, "friction.coulomb": COULOMB, "friction.viscous": VISCOUS}
HELD = {"force": Intersample.HELD}


def push(t: Array) -> Array:
    """A force of up to 6 Hz [N], continuous."""
    turns = 2 * math.pi * np.asarray(t)
    return np.asarray(60 * np.sin(1.3 * turns) + 25 * np.sin(3.1 * turns + 1) + 10 * np.sin(5.7 * turns + 2))


@cache
def response(rate: float, seconds: float, load: float) -> Array:
    """The position that SciPy finds at the samples, friction rising by `load` times the force."""

    def slope(t: float, x: Array) -> list[float]:
        force = float(push(np.array(t)))
        friction = (COULOMB + load * abs(force)) * math.tanh(x[1] / SMOOTHING) + VISCOUS * x[1]
        return [x[1], (force - friction) / MASS]

    t = np.arange(round(seconds * rate) + 1) / rate
    run = solve_ivp(slope, (0, t[-1]), [0.1, 0.0], "LSODA", t, rtol=1e-9, atol=1e-12, max_step=2e-3)
    return np.asarray(run.y[0])


def logged(rate: float, seconds: float = 6.0, load: float = 0.0, **others: object) -> Experiment:
    t = np.arange(round(seconds * rate) + 1) / rate
    x = response(rate, seconds, load) + NOISE * np.random.default_rng(1).standard_normal(t.size)
    return Experiment(Trajectory(t, {"force": push(t), "position": x}), {"position": NOISE}, name="run", **others)  # type: ignore[arg-type]


def fitted(log: Experiment, load: float = 0.0, *, throw: bool = True) -> IdentificationResult:
    drive = ForceDrive(LoadDependent(Coulomb()) if load else Coulomb())
    free = drive.parameters.with_values({"friction.smoothing": SMOOTHING}).freed(*TRUTH)
    return identify(drive, log, free.freed("friction.coulomb_load") if load else free, throw=throw)


def errors(result: IdentificationResult) -> dict[str, float]:
    found: pd.Series = result.estimates["value"]
    return {n: float(found[n]) / true - 1 for n, true in TRUTH.items()}


@pytest.mark.parametrize(("rate", "off"), [(50.0, 0.02), (100.0, 0.005), (500.0, 0.001)])
def test_a_measured_force_is_not_held_over_the_sample(rate: float, off: float) -> None:
    found = errors(fitted(logged(rate)))
    assert max(map(abs, found.values())) < off, found


def test_held_over_the_sample_the_same_log_gives_another_mass() -> None:
    assert errors(fitted(logged(50.0, intersample=HELD), throw=False))["load.mass"] < -0.1


def test_load_dependent_friction_from_four_seconds_at_100_hz() -> None:
    found = errors(fitted(logged(100.0, 4.0, load=0.1), load=0.1))
    assert max(abs(found["load.mass"]), abs(found["friction.coulomb"])) < 0.05, found


def test_a_third_of_the_rows_missing_does_not_move_the_mass() -> None:
    log = logged(500.0)
    kept = np.random.default_rng(0).random(len(log.trajectory)) > 1 / 3
    part = Trajectory(log.trajectory.t[kept], {n: log.trajectory[n][kept] for n in log.trajectory})
    found = errors(fitted(Experiment(part, log.noise, name="run")))
    assert max(map(abs, found.values())) < 0.003, found


def test_a_prediction_reads_the_inputs_as_the_fit_does() -> None:
    log, drive = logged(50.0), ForceDrive(Coulomb())
    known = drive.parameters.with_values({**TRUTH, "friction.smoothing": SMOOTHING})
    linear, held = (float(validate(drive, e, known)["rmse"].iloc[0]) for e in (log, log.with_intersample(HELD)))
    assert linear < 0.15 * held
    run = predict(drive, log, known)
    assert float(np.sqrt(np.mean((run["position"] - log.trajectory["position"]) ** 2))) == pytest.approx(linear)


def test_two_logs_of_one_fit_may_differ_in_what_they_hold() -> None:
    measured, drive = logged(100.0), ForceDrive(Coulomb()).system()
    t, force = measured.trajectory.t, measured.trajectory["force"]
    known = drive.parameters.with_values({**TRUTH, "friction.smoothing": SMOOTHING})
    held = simulate(drive, Trajectory(t, {"force": force}), known, initial={"position": 0.1}, rtol=1e-8)["position"]
    noisy = held + NOISE * np.random.default_rng(2).standard_normal(t.size)
    commanded = Experiment(
        Trajectory(t, {"force": force, "position": noisy}), measured.noise, name="commanded", intersample=HELD
    )
    found = errors(identify(drive, [measured, commanded], known.freed(*TRUTH)))
    assert max(map(abs, found.values())) < 0.005, found


def test_a_linear_plant_starts_from_a_measured_input() -> None:
    plant = FirstOrder(input=Quantity("force", "N")).system()
    true = plant.parameters.with_values({"plant.time_constant": 0.08, "plant.gain": 0.02})
    t = np.arange(0, 4, 0.02)
    x = solve_ivp(lambda s, v: (0.02 * push(np.array(s)) - v) / 0.08, (0, 4), [0.0], t_eval=t, rtol=1e-9, atol=1e-12).y[
        0
    ]
    log = Trajectory(t, {"force": push(t), "speed": x})
    start = {
        kind: plant.starts({"run": Log(log, true.freed("plant.*"), {"force": kind})})[0].parameters
        for kind in Intersample
    }
    off = {kind: abs(values["plant.time_constant"] / 0.08 - 1) for kind, values in start.items()}
    assert off[Intersample.LINEAR] < 0.05 < off[Intersample.HELD]
