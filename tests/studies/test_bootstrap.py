"""`bootstrap`: a right model's fit holds, a model without stick-slip is told with the sign of its error."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.evaluation.rig import Rig, Sensor, record
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.studies.bootstrap import Bootstrap, bootstrap

T = np.arange(1000) * 2e-3
PUSH = 55 * np.sin(2 * np.pi * 1.3 * T) + 20 * np.sin(2 * np.pi * 3.1 * T)
DRIVE, STICKING = ForceDrive(Coulomb()), ForceDrive(Karnopp(Coulomb()))
WIDE = 0.02  # [m/s], over which the model turns friction round where the rig sticks
FREE = ("friction.coulomb", "friction.viscous")
TRUTH = DRIVE.parameters.with_values({"load.mass": 2.0, "friction.coulomb": 30.0, "friction.viscous": 40.0})
SENSORS = {"position": Sensor(noise=2e-5)}


def logged(plant: ForceDrive) -> Experiment:
    own = TRUTH.select(n for n in TRUTH if n in plant.parameters)
    return record(Rig(plant.system(), SENSORS), Trajectory(T, {"force": PUSH}), own, name="run").experiment


def fitted(log: Experiment, smoothing: float) -> IdentificationResult:
    given = TRUTH.with_values({"friction.smoothing": smoothing}).freed(*FREE).fixed("friction.smoothing")
    return identify(DRIVE, log, given, throw=False)


def tried(
    log: Experiment, fit: IdentificationResult, rig: ForceDrive | None = None, *, count: int, seed: int = 0
) -> Bootstrap:
    with ThreadPoolExecutor(1) as executor:
        return bootstrap(DRIVE, log, fit, rig=rig, executor=executor, count=count, seed=seed)


@pytest.fixture(scope="module")
def right() -> tuple[Experiment, IdentificationResult]:
    log = logged(DRIVE)
    return log, fitted(log, TRUTH.value("friction.smoothing"))


def test_the_fit_of_a_right_model_holds(right: tuple[Experiment, IdentificationResult]) -> None:
    found = tried(*right, count=8)
    assert (found.table["intervals"] == 8).all()
    assert found.doubts == {}
    assert (found.table["spread"] / found.table["stderr"]).between(0.5, 2.0).all()
    assert "8 of 8 simulated sets of logs are fitted; no estimate is to be doubted" in repr(found)


def test_the_bias_of_a_model_that_does_not_stick_is_told_with_its_sign_and_size() -> None:
    """The rig sticks; the model's friction is no friction at small speeds. What this did to the fit of the rig's log it
    does to the fits of simulated logs."""
    log = logged(STICKING)
    fit = fitted(log, WIDE)
    found = tried(log, fit, STICKING, count=3)
    done = fit.estimates["value"].loc[list(FREE)] - np.array([TRUTH.value(n) for n in FREE])
    assert found.table["bias"].loc[list(FREE)].to_numpy() == pytest.approx(done.to_numpy(), rel=0.35)
    off = found.table["corrected"].loc[list(FREE)] - np.array([TRUTH.value(n) for n in FREE])
    assert (off.abs() < 0.35 * done.abs()).all()
    assert set(found.doubts) == set(FREE)
    assert "too" in found.doubts["friction.coulomb"]


def test_the_same_seed_gives_the_same_draws_and_another_others(right: tuple[Experiment, IdentificationResult]) -> None:
    once, twice, other = (tried(*right, count=2, seed=seed).draws["friction.coulomb.value"] for seed in (3, 3, 4))
    assert once.tolist() == twice.tolist()
    assert not set(once) & set(other)


def test_a_simulated_log_misses_what_the_log_misses(right: tuple[Experiment, IdentificationResult]) -> None:
    """Half of the samples are missing: the intervals are wider by the root of two."""
    log, fit = right
    column = log.trajectory["position"].copy()
    column[::2] = np.nan
    half = replace(log, trajectory=log.trajectory.with_columns({"position": column}))
    sparse = fitted(half, TRUTH.value("friction.smoothing"))
    found = tried(half, sparse, count=6)
    assert (found.table["stderr"] > 1.2 * fit.estimates["stderr"].loc[found.table.index]).all()
    assert (found.table["spread"] / found.table["stderr"]).between(0.4, 2.2).all()


def test_a_log_from_which_the_simulation_drifts_begins_anew_in_parts() -> None:
    """So wide a model follows the log in windows only; the rig with its estimates soon goes elsewhere."""
    log = logged(STICKING)
    fit = fitted(log, 0.05)
    assert fit.window is not None
    found = tried(log, fit, STICKING, count=2)
    assert found.draws["error"].tolist() == ["", ""]
