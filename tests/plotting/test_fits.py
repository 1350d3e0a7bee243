"""Fits beside their logs, residuals and correlations; the friction map: points, fitted curve, and its band."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from matplotlib.patches import Rectangle

from pneuopt.dynamics.simulate import simulate
from pneuopt.logs.experiment import Experiment, split
from pneuopt.models.drives import MotionDrive
from pneuopt.models.friction import Coulomb, LuGre
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.plotting import (
    friction_force,
    has_friction_map,
    plot_correlation,
    plot_fit,
    plot_friction,
    plot_prediction,
    plot_residuals,
)
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from tests.plotting.fits import DRIVE, TRUTH, fit_of, fitted, line, table, texts


def test_the_friction_map_is_that_of_the_equations() -> None:
    experiment, run = fitted()
    figure = plot_friction(DRIVE.system(), fit_of(TRUTH, {"run_0": run}), [experiment])
    speed, force = line(figure.axes[0], "fitted")
    smoothing = TRUTH.value("friction.smoothing")
    assert np.allclose(force, 25 * np.tanh(speed / smoothing) + 40 * speed)
    v, implied = line(figure.axes[0], "from the logs")
    good = np.isfinite(implied) & (np.abs(v) > 0.1)
    assert good.sum() > 100
    error = np.abs(implied - (25 * np.sign(v) + 40 * v))[good]
    assert np.median(error) < 0.7
    assert error.max() < 5.0
    assert texts(figure.axes[0]) == "speed [m/s]|friction force [N]|"


def test_points_of_a_perfect_fit_lie_on_the_curve_of_fast_motion_too() -> None:
    """A slope of the log itself over 20 samples is up to 30 N off at 1.5 m/s."""
    t = np.arange(1000) * 2e-3
    force = Trajectory(t, {"force": 270 * np.sin(2 * np.pi * 4 * t)})
    run = simulate(DRIVE.system(), force, TRUTH, rtol=1e-6, intersample={"force": Intersample.LINEAR})
    log = Experiment(force.with_columns({"position": run["position"]}), name="fast")
    (axes,) = plot_friction(DRIVE.system(), fit_of(TRUTH, {"fast": run}), [log]).axes
    speed, implied = line(axes, "from the logs")
    fast = np.isfinite(implied) & (np.abs(speed) > 0.3)
    assert np.abs(speed).max() > 1.0
    assert fast.sum() > 100
    assert np.abs(implied - 25 * np.sign(speed) - 40 * speed)[fast].max() < 0.5


def test_points_of_a_wrong_fit_show_what_it_lacks() -> None:
    experiment, run = fitted()
    wrong = TRUTH.with_values({"friction.coulomb": 15.0})
    force = Trajectory(run.t, {"force": experiment.trajectory["force"]})
    other = simulate(DRIVE.system(), force, wrong, rtol=1e-6, intersample={"force": Intersample.LINEAR})
    speed, implied = line(
        plot_friction(DRIVE.system(), fit_of(wrong, {"run_0": other}), [experiment]).axes[0], "from the logs"
    )
    good = np.isfinite(implied) & (np.abs(speed) > 0.1)
    assert np.median((np.abs(implied) - 40 * np.abs(speed))[good]) == pytest.approx(25.0, abs=0.7)


def test_the_friction_map_of_a_pneumatic_drive_with_bristles_is_the_stribeck_curve() -> None:
    drive = PneumaticDrive(friction=LuGre())
    system = drive.system()
    inputs = Trajectory(t := np.arange(600) * 1e-3, {"valve_voltage": 1.0 * np.sin(12 * t)})
    run = simulate(system, inputs, drive.parameters, initial={"position": 0.1})
    logged = run.select(["position", "pressure_a", "pressure_b"])
    log = Experiment(logged.with_columns({"valve_voltage": inputs["valve_voltage"]}))
    (axes,) = plot_friction(system, fit_of(drive.parameters, {"log 1": run}), [log]).axes
    v, force = line(axes, "fitted")
    Fc, Fs, vs, B = (
        drive.parameters.value(f"friction.{n}") for n in ("coulomb", "static", "stribeck_velocity", "viscous")
    )
    curve = np.sign(v) * (Fc + (Fs - Fc) * np.exp(-((v / vs) ** 2))) + B * v
    assert np.allclose(force, curve, atol=0.02 * Fc)
    speed, implied = line(axes, "from the logs")
    fast = np.isfinite(implied) & (np.abs(speed) > 4 * vs)
    assert fast.sum() > 100
    assert np.median(np.abs(implied - Fc * np.sign(speed) - B * speed)[fast]) < 0.05 * Fc


def test_the_friction_maps_band_is_that_of_the_estimates() -> None:
    experiment, run = fitted()
    result = fit_of(TRUTH, {"run_0": run}, table({"friction.coulomb": 4.0, "friction.viscous": 25.0}))
    axes = plot_friction(DRIVE.system(), result, [experiment]).axes[0]
    (band,) = axes.collections
    speed, force = line(axes, "fitted")
    edges = np.asarray(band.get_paths()[0].vertices, dtype=float)
    for v in (speed[5], speed[-5]):
        at = edges[np.isclose(edges[:, 0], v)][:, 1]
        spread = np.sqrt(4.0 * np.tanh(v / TRUTH.value("friction.smoothing")) ** 2 + 25.0 * v**2)
        assert at.max() - at.min() == pytest.approx(2 * 1.96 * spread, rel=1e-3)
    assert np.isfinite(force).all()
    few = replace(result, estimates=result.estimates.assign(dof=3.0))
    (wide,) = plot_friction(DRIVE.system(), few, [experiment]).axes[0].collections
    highest = [np.asarray(b.get_paths()[0].vertices, dtype=float)[:, 1].max() - force.max() for b in (band, wide)]
    assert highest[1] / highest[0] == pytest.approx(3.182 / 1.96, rel=1e-3)  # Student's t with three degrees of freedom
    blind = fit_of(TRUTH, {"run_0": run}, table({"friction.coulomb": np.nan, "friction.viscous": 25.0}))
    assert len(plot_friction(DRIVE.system(), blind, [experiment]).axes[0].collections) == 0


def test_a_rig_shows_its_measured_force() -> None:
    rig = MotionDrive(Coulomb(), chamber=False)
    t = np.linspace(0, 1, 50)
    speed = 0.1 * np.sin(6 * t)
    measured = 12 * np.sign(speed)
    experiment = Experiment(Trajectory(t, {"speed": speed, "force": measured}))
    figure = plot_friction(
        rig.system(), fit_of(rig.parameters, {"": Trajectory(t, {"force": measured + 1})}), [experiment]
    )
    assert np.array_equal(line(figure.axes[0], "from the logs")[1], measured)
    assert np.array_equal(line(figure.axes[0], "fitted")[1], measured + 1)
    assert figure.axes[0].get_ylabel() == "force [N]"
    assert not has_friction_map(FirstOrder().system())


def test_friction_along_a_run_is_what_the_balance_of_forces_leaves() -> None:
    drive, t = PneumaticDrive(friction=LuGre()), np.linspace(0, 1, 400)
    p = drive.parameters
    speed, bristle = 0.1 * np.sin(9 * t), 3e-4 * np.sin(5 * t)
    rest = drive.rest(p)
    states = {n: np.full(len(t), x) for n, x in rest.states.items()} | {"speed": speed, "friction.bristle": bristle}
    run = Trajectory(t, {**states, "valve_voltage": 0 * t})
    g = LuGre().force
    z = {q.name: ca.SX.sym(q.name) for q in LuGre().states}
    v, values = ca.SX.sym("v"), {n: ca.SX(q.value) for n, q in LuGre().parameters.items()}
    force = ca.Function("force", [v, *z.values()], [g(v, z, {}, values).value])
    expected = np.array(force(speed, bristle)).ravel()
    assert friction_force(drive.system(), run, p) == pytest.approx(expected, abs=1e-9)


def test_a_fit_stands_beside_its_log_with_units() -> None:
    pairs = [fitted(seed) for seed in range(2)]
    figure = plot_fit(fit_of(TRUTH, {e.name: run for e, run in pairs}), [e for e, _ in pairs])
    assert len(figure.axes) == 4
    assert [texts(a) for a in figure.axes[:2]] == ["|position [mm]|run_0", "||run_1"]
    assert figure.axes[3].get_xlabel() == "time [s]"
    y = line(figure.axes[0], "fitted")[1]
    assert np.allclose(y, 1e3 * pairs[0][1]["position"])
    residual = np.asarray(figure.axes[2].lines[0].get_ydata(), dtype=float)
    assert np.abs(residual).max() < 1e-9
    assert [q.get_text() for q in figure.legends[0].get_texts()] == ["measured", "fitted"]
    assert all(a.get_legend() is None for a in figure.axes)


def test_windows_of_a_log_share_its_axes_and_many_logs_are_spread() -> None:
    experiment, run = fitted()
    windows = split(experiment, 0.25)
    runs = [run.rows(125 * k, 125 * (k + 1)) for k in range(len(windows))]
    assert len(plot_prediction(runs, windows, label="predicted").axes) == 2
    several = [Experiment(experiment.trajectory, name=f"log {k}") for k in range(7)]
    figure = plot_prediction([run] * 7, several, label="predicted")
    assert [a.get_title() for a in figure.axes[:3]] == ["log 0", "log 3", "log 6"]
    assert "3 of 7 logs" in [q.get_text() for q in figure.texts]


def test_residuals_show_what_is_left_in_them() -> None:
    experiment, run = fitted()
    rng = np.random.default_rng(0)
    white = 1e-5 * rng.standard_normal(len(run))
    noisy = Experiment(run.with_columns({"force": experiment.trajectory["force"]}), {"position": 1e-5}, name="run")
    good = Experiment(noisy.trajectory.with_columns({"position": run["position"] + white}), {"position": 1e-5})
    pulled = run["position"] + white + 2e-7 * experiment.trajectory["force"]
    bad = Experiment(noisy.trajectory.with_columns({"position": pulled}), {"position": 1e-5})
    for log, expected in ((good.select(["force", "position"]), False), (bad.select(["force", "position"]), True)):
        over_time, own, crossed, spread = plot_residuals([run], [log]).axes
        assert texts(over_time) == "time [s]|position [mm]|residuals"
        assert texts(own).startswith("lag [samples]||autocorrelation")
        rho = np.asarray(line(crossed, "force")[1])
        band = 1.96 / np.sqrt(len(run))
        assert bool(np.abs(rho).max() > 2 * band) is expected
        (told,) = own.texts
        assert told.get_text().startswith("Ljung-Box p")
        assert ("< 1e-4" in told.get_text()) is expected
        assert (spread.get_xlabel(), spread.get_ylabel()) == ("residual / noise", "")
        bars = [bar.get_bbox() for bar in spread.patches if isinstance(bar, Rectangle)]
        inside = [b.width * b.height for b in bars if abs(b.x0 + b.x1) < 2]
        assert 0.1 < sum(inside) < 0.75  # of a normal distribution 0.68 lies within its deviation


def test_correlations_are_cells_and_never_a_rounded_one() -> None:
    names = ["load.force", "friction.coulomb_asymmetry", "load.mass"]
    covariance = pd.DataFrame([[1, 0.99998, 0], [0.99998, 1, 0], [0, 0, np.nan]], index=names, columns=names)
    axes = plot_correlation(fit_of(TRUTH, {}, covariance)).axes[0]
    assert [q.get_text() for q in axes.get_xticklabels()] == names[:2]
    assert sorted(q.get_text() for q in axes.texts) == ["0.9999", "0.9999", "1.00", "1.00"]
