"""Outliers and wrong noise levels."""

from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.identify import identify
from pneuopt.identification.losses import Huber, Loss, SoftL1
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.trajectories import Trajectory

TRUTH = {"load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
NOISE = {"position": 2e-5, "speed": 1e-3}
DRIVE = ForceDrive(Coulomb()).system()
FREE = DRIVE.parameters.freed(*TRUTH)


# for what one draw shows: a width that is estimated, too, takes part in each deviation
KNOWN = FREE | ParameterSet({"friction.smoothing": replace(FREE["friction.smoothing"], source="known")})


def exact() -> Trajectory:
    t = np.arange(1000) * 1e-3
    force = 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t)
    run = simulate(DRIVE, Trajectory(t, {"force": force}), DRIVE.parameters.with_values(TRUTH))
    return run.select(["position", "speed"]).with_columns({"force": force})


RUN = exact()


def noisy(seed: int) -> Experiment:
    random = np.random.default_rng(seed)
    columns = {n: RUN[n] + s * random.standard_normal(len(RUN)) for n, s in NOISE.items()}
    return Experiment(RUN.with_columns(columns), NOISE, name=f"run {seed}", intersample={"force": Intersample.HELD})


def spoiled(seed: int) -> Experiment:
    """1 % of the positions 20 to 50 standard deviations off, all to the same side."""
    log, random = noisy(seed), np.random.default_rng(100 + seed)
    x = log.trajectory["position"].copy()
    hit = random.random(x.size) < 0.01
    x[hit] += random.uniform(20, 50, hit.sum()) * NOISE["position"]
    return replace(log, trajectory=log.trajectory.with_columns({"position": x}))


def off(fit: IdentificationResult) -> list[float]:
    rows = fit.estimates
    return [(float(rows["value"][n]) - TRUTH[n]) / float(rows["stderr"][n]) for n in TRUTH]


@pytest.mark.parametrize("loss", [Huber(), SoftL1()])
def test_outliers_do_not_move_a_robust_fit(loss: Loss) -> None:
    clean = identify(DRIVE, [noisy(1)], KNOWN).estimates["stderr"]
    plain = identify(DRIVE, [spoiled(1)], KNOWN, throw=False)
    assert "does not explain" in plain.status.message or not plain.status.converged
    fit = identify(DRIVE, [spoiled(1)], KNOWN, loss=loss)
    assert "explain" not in fit.status.message
    assert "outliers" in fit.status.message
    assert max(map(abs, off(fit))) < 3
    assert fit.estimates["stderr"].to_numpy() == pytest.approx(clean.to_numpy(), rel=0.25)
    assert repr(loss) in fit.provenance["options"]


def test_a_robust_fit_covers_with_and_without_outliers() -> None:
    for logs in ([spoiled(seed) for seed in range(15)], [noisy(seed) for seed in range(15)]):
        found = np.array([off(identify(DRIVE, [log], FREE, loss=Huber())) for log in logs])
        assert 0.7 < np.sqrt(np.mean(found**2)) < 1.5


def test_a_model_error_stays_visible_under_a_loss() -> None:
    wrong = FREE.with_values({"friction.coulomb": 45.0}).fixed("friction.coulomb")
    fit = identify(DRIVE, [spoiled(1)], wrong, loss=Huber(), throw=False)
    assert "does not explain" in fit.status.message or not fit.status.converged


@pytest.mark.parametrize("factor", [10.0, 0.1])
def test_estimated_noise_mends_a_wrong_level(factor: float) -> None:
    wrong = [noisy(seed).with_noise({"position": factor * NOISE["position"]}) for seed in range(15)]
    right = identify(DRIVE, [noisy(0)], FREE).estimates["stderr"]
    fits = [identify(DRIVE, [log], FREE, estimate_noise=True) for log in wrong]
    assert fits[0].estimates["stderr"].to_numpy() == pytest.approx(right.to_numpy(), rel=0.1)
    for channel, sigma in NOISE.items():
        found = np.median([np.asarray(fit.fit["noise"].xs(channel, level="channel"))[0] for fit in fits])
        assert found == pytest.approx(sigma, rel=0.03)
    deviations = np.array([off(fit) for fit in fits])
    assert 0.7 < np.sqrt(np.mean(deviations**2)) < 1.5


def test_estimated_noise_does_not_hide_a_wrong_model() -> None:
    wrong = FREE.with_values({"friction.coulomb": 45.0}).fixed("friction.coulomb")
    fit = identify(DRIVE, [noisy(1)], wrong, estimate_noise=True, throw=False)
    assert "does not explain" in fit.status.message or not fit.status.converged
