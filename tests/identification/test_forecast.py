"""A forecast's band: what it holds, and that it is given before the truth is looked at."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_drive, read_fit, write_fit
from pneuopt.identification.forecast import predict, predict_logs, validate
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult, report_band
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import solve_least_squares

DRIVE, NOISE = ForceDrive(Coulomb()), 1e-5
TRUTH = {"load.mass": 4.0, "friction.coulomb": 20.0, "friction.viscous": 60.0}
FREE = tuple(TRUTH)
DATA = Path(__file__).parents[2] / "data"


def record(seed: int, *, exact: bool = True, seconds: float = 2.0) -> Experiment:
    """A log of an axis under a force of many tones, and of another one that wanders and that no channel shows."""
    random = np.random.default_rng(seed)
    t = np.arange(0, seconds, 2e-3)
    tones, phases = random.uniform(0.4, 3, 4), random.uniform(0, 2 * np.pi, 4)
    force = 35 * np.sin(2 * np.pi * np.outer(t, tones) + phases).sum(axis=1)
    unknown = lfilter([1.0], [1.0, -0.98], 0.2 * random.standard_normal(len(t))) * (not exact)
    rig = ForceDrive(Coulomb()).system()
    run = simulate(rig, Trajectory(t, {"force": force + unknown}), rig.parameters.with_values(TRUTH))
    position = run["position"] + NOISE * random.standard_normal(len(t))
    log = Experiment(Trajectory(t, {"force": force, "position": position}), name=f"run {seed}")
    return log.with_intersample({"force": Intersample.HELD})


@cache
def fitted(seed: int, *, exact: bool) -> IdentificationResult:
    logs = [record(100 * seed + k, exact=exact) for k in range(2)]
    return identify(DRIVE, logs, DRIVE.parameters.freed(*FREE), throw=False)


@pytest.mark.parametrize("exact", [True, False])
def test_the_band_holds_what_it_promises_and_is_no_wider_than_it_must(exact: bool) -> None:
    inside, half, error = list[float](), list[float](), list[float]()
    for seed in range(2):
        held_out = [record(100 * seed + 50 + k, exact=exact) for k in range(2)]
        table = validate(DRIVE, held_out, fitted(seed, exact=exact))
        inside += table["inside"].tolist()
        half += table["half_band"].tolist()
        error += table["forecast_rmse"].tolist()
    # what wanders is off by a similar amount for long, so that a log may lie inside as a whole
    assert 0.9 <= float(np.mean(inside)) <= (0.99 if exact else 1.0), inside
    assert float(np.sum(np.square(half)) / np.sum(np.square(error))) <= 9, (half, error)
    if not exact:  # what the model has not is seen: noise alone would hold nothing
        assert float(np.mean(error)) > 5 * NOISE


def test_the_band_does_not_look_at_what_it_forecasts() -> None:
    log, fit = record(7, exact=False), fitted(0, exact=False)
    position = log.trajectory["position"].copy()
    position[len(position) // 10 + 1 :] = np.random.default_rng(1).uniform(-9, 9, len(position) * 9 // 10 - 1)
    wrong = replace(log, trajectory=log.trajectory.with_columns({"position": position}))
    seen, blind = predict(DRIVE, log, fit), predict(DRIVE, wrong, fit)
    assert {"position_low", "position_high"} <= set(seen)
    for name in seen:
        np.testing.assert_array_equal(seen[name], blind[name])
    assert validate(DRIVE, wrong, fit)["inside"].iloc[0] < 0.1


def test_a_forecast_fits_its_start_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = list[int]()

    def counted(*given: object) -> object:
        calls.append(1)
        return solve_least_squares(*given)  # type: ignore[arg-type]

    fit = fitted(0, exact=True)
    monkeypatch.setattr("pneuopt.identification.forecast.solve_least_squares", counted)
    predict_logs(DRIVE, record(8), fit)
    assert len(calls) == 1


def test_the_start_of_a_long_log_is_fitted_to_a_part_of_bounded_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of a log of a million samples cost as much as its identification."""
    log, fit = record(9), fitted(0, exact=True)
    assert np.isnan(predict(DRIVE, log, fit)["position_low"]).sum() == pytest.approx(0.1 * len(log.trajectory), abs=1)
    monkeypatch.setattr("pneuopt.identification.forecast.EXCERPT_SEGMENTS", 5)  # of 10 ms, at 2 ms a sample
    assert np.isnan(predict(DRIVE, log, fit)["position_low"]).sum() == pytest.approx(25, abs=1)


def test_parameters_alone_have_no_band() -> None:
    fit, log = fitted(0, exact=True), record(8)
    assert "position_low" not in predict(DRIVE, log, fit.parameters)
    table = validate(DRIVE, log, fit.parameters)
    assert table["inside"].isna().all()
    assert report_band(table).parts == ()
    (line,) = report_band(validate(DRIVE, log, fit)).parts
    assert "of the forecast samples are inside the 95 % band" in str(line)


def test_a_file_of_a_fit_gives_the_same_band(tmp_path: Path) -> None:
    folder = DATA / "step_rig"
    drive, given = read_drive(folder / "drive.toml")
    own, other = (read_log(folder / f"{n}.csv", plant=drive.system()) for n in ("step_up_and_back", "step_held_out"))
    fit = identify(drive, own, given)
    write_fit(tmp_path / "fit.toml", folder / "drive.toml", fit)
    one, two = predict(drive, other, fit), predict(drive, other, read_fit(tmp_path / "fit.toml"))
    for name in ("speed_low", "speed", "speed_high"):
        np.testing.assert_allclose(one[name], two[name], rtol=1e-4, atol=1e-5)
    text = (tmp_path / "fit.toml").read_text("utf-8").replace("speed = [", "speed = [-", 1)
    assert "speed = [-" in text
    (tmp_path / "bad.toml").write_text(text, "utf-8")
    with pytest.raises(InputError, match=r"bad\.toml: \[forecast_error\] must hold times"):
        predict(drive, other, read_fit(tmp_path / "bad.toml"))
