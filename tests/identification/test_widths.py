"""Widths over which a model rounds its kinks are estimated with the rest, unless the user states them."""

from dataclasses import replace

import numpy as np
import pytest

import pneuopt as po
from pneuopt.identification.problem import EstimationProblem, check_logs
from pneuopt.identification.tolerances import WIDTH_RANGE
from pneuopt.identification.widths import ESTIMATED_WIDTH, estimated_widths, free_widths, sticking_covariance
from pneuopt.shooting.least_squares import LeastSquares, solve_least_squares

FREE = ("friction.coulomb", "friction.static", "friction.viscous", "friction.stribeck_velocity")
WIDTH, ROUNDING = "friction.smoothing", "valve.rounding"
SERVO = po.ForceDrive(po.Stribeck()).system()


def problem(system: po.System, log: po.Experiment, parameters: po.ParameterSet) -> EstimationProblem:
    logs = tuple(check_logs(system, [log], parameters))
    return EstimationProblem(system, logs, system.parameters | parameters, LeastSquares())


def sticking() -> po.Experiment:
    """A pulled mass that sticks between its slips, its events located."""
    t = np.arange(1200) * 1e-3
    rig = po.ForceDrive(po.Karnopp(po.Stribeck()))
    truth = rig.parameters.with_values({"friction.coulomb": 30.0, "friction.static": 45.0, "load.mass": 5.0})
    pull = np.where(t % 1.0 < 0.5, 1, -1) * (20 + 60 * (t % 0.5))
    sensors = {"position": po.Sensor(noise=1e-5)}
    return po.record(po.Rig(rig.system(), sensors), po.Trajectory(t, {"force": pull}), truth).experiment


def sliding(width: float) -> po.Experiment:
    """A mass that slides to and fro, of which the friction turns round over a width."""
    t = np.arange(1200) * 1e-3
    push = 60 * np.sin(2 * np.pi * 2 * t) + 30 * np.sin(2 * np.pi * 3.3 * t)
    run = po.simulate(SERVO, po.Trajectory(t, {"force": push}), SERVO.parameters.with_values({WIDTH: width}))
    noisy = run["position"] + 1e-5 * np.random.default_rng(1).standard_normal(len(t))
    return po.Experiment(po.Trajectory(t, {"force": push, "position": noisy}), {"position": 1e-5}, name="run")


def is_near(fit: po.IdentificationResult, name: str, true: float) -> bool:
    """Whether an estimate lies within 2 % of the truth, or within 4 of its own deviations."""
    row = fit.estimates.loc[name]
    return bool(abs(row["value"] - true) < max(0.02 * true, 4 * row["stderr"]))


@pytest.mark.parametrize("width", [2e-4, 1e-3, 3.7e-3])
def test_a_servo_is_identified_whose_width_nobody_has_stated(width: float) -> None:
    """Of a ladder of tens none is 3.7 mm/s: static friction took the place of the width, up to 359 % off."""
    fit = po.identify(SERVO, [sliding(width)], SERVO.parameters.freed(*FREE))
    for name in FREE:
        assert is_near(fit, name, SERVO.parameters.value(name)), fit
    assert is_near(fit, WIDTH, width), fit
    assert fit.parameters[WIDTH].source == ESTIMATED_WIDTH
    assert fit.estimates["value"][WIDTH] == fit.parameters.value(WIDTH)


@pytest.mark.parametrize("rounding", [2e-3, 0.013])
def test_a_drive_is_identified_whose_edges_nobody_has_stated(rounding: float) -> None:
    """The usual rounding hid the dead zone beside it."""
    drive = po.PneumaticDrive(po.ProportionalValve(spool=po.Spool.RIGID), po.Viscous())
    t = np.arange(400) * 2e-3
    truth = drive.parameters.with_values({"valve.dead_zone": 0.03, ROUNDING: rounding})
    voltage = 0.6 * np.sin(2 * np.pi * 1.5 * t)
    run = po.simulate(drive.system(), po.Trajectory(t, {"valve_voltage": voltage}), truth, initial={"position": 0.1})
    noise, random = {"position": 1e-5, "pressure_a": 500.0, "pressure_b": 500.0}, np.random.default_rng(1)
    columns = {n: run[n] + s * random.standard_normal(len(t)) for n, s in noise.items()}
    log = po.Experiment(po.Trajectory(t, {"valve_voltage": voltage, **columns}), noise, name="run")
    fit = po.identify(drive.system(), [log], drive.parameters.freed("valve.dead_zone", "valve.conductance"))
    for name in ("valve.dead_zone", "valve.conductance", ROUNDING):
        assert is_near(fit, name, truth.value(name)), fit


def test_the_width_of_a_law_that_sticks_falls_to_its_lower_bound() -> None:
    fit = po.identify(SERVO, [sticking()], SERVO.parameters.with_values({"load.mass": 5.0}).freed(*FREE))
    row = fit.estimates.loc[WIDTH]
    assert row["at_bound"]
    assert row["value"] == pytest.approx(SERVO.parameters.value(WIDTH) / WIDTH_RANGE)
    assert fit.status.code is po.Code.CONVERGED, fit.status
    assert fit.verdict is not None
    assert WIDTH not in str(fit.verdict)
    for name, true in (("friction.coulomb", 30.0), ("friction.static", 45.0)):
        assert is_near(fit, name, true), fit
    assert is_near(fit, "friction.stribeck_velocity", SERVO.parameters.value("friction.stribeck_velocity")), fit


def test_an_interval_counts_what_a_width_at_its_bound_leaves_uncertain() -> None:
    """To first order: by how much an e-fold of the width moves an estimate, against a literal refit."""
    posed = free_widths(problem(SERVO, sticking(), SERVO.parameters.with_values({"load.mass": 5.0}).freed(*FREE)))
    fit = solve_least_squares(posed.transcription(posed.candidates[0]), posed.method)
    names = fit.parameters.free_names
    added = np.sqrt(np.diag(sticking_covariance(posed, fit)))
    found = dict(zip(names, added, strict=True))
    assert found[WIDTH] == 0.0
    width = fit.parameters.value(WIDTH)
    wider = replace(posed, fixed={WIDTH: 1.05 * width})
    refit = solve_least_squares(wider.transcription(wider.start_from(fit)), posed.method)
    velocity = "friction.stribeck_velocity"
    moved = abs(refit.parameters.value(velocity) - fit.parameters.value(velocity)) / np.log(1.05)
    assert found[velocity] == pytest.approx(moved, rel=0.5)
    assert found[velocity] > 0


def test_a_width_away_from_its_bound_adds_nothing_to_the_intervals() -> None:
    posed = free_widths(problem(SERVO, sliding(1e-3), SERVO.parameters.freed(*FREE)))
    fit = solve_least_squares(posed.transcription(posed.candidates[0]), posed.method)
    assert not sticking_covariance(posed, fit).any()


@pytest.mark.parametrize("stated", [2e-3, SERVO.parameters.value(WIDTH)])
def test_a_stated_width_stays_even_at_the_usual_value(stated: float) -> None:
    given = SERVO.parameters.with_values({WIDTH: stated}).freed(*FREE)
    assert free_widths(problem(SERVO, sliding(1e-3), given)).parameters == given
    fit = po.identify(SERVO, [sliding(1e-3)], given, throw=False)
    assert fit.parameters[WIDTH] == given[WIDTH]
    assert WIDTH not in fit.estimates.index


def test_a_width_that_the_user_frees_and_one_that_a_log_states_are_left_as_they_are() -> None:
    own = SERVO.parameters.with_values({WIDTH: 2e-3}).freed(*FREE, WIDTH)
    assert free_widths(problem(SERVO, sliding(1e-3), own)).parameters == own
    known = replace(sliding(1e-3), conditions={WIDTH: 1e-3})
    assert estimated_widths(free_widths(problem(SERVO, known, SERVO.parameters.freed(*FREE))).parameters) == []


def test_a_fit_begins_again_with_the_widths_that_it_has_estimated() -> None:
    log = sliding(3.7e-3)
    fit = po.identify(SERVO, [log], SERVO.parameters.freed(*FREE))
    again = po.identify(SERVO, [log], fit.parameters)
    assert estimated_widths(again.parameters) == [WIDTH]
    assert again.parameters.value(WIDTH) == pytest.approx(fit.parameters.value(WIDTH), rel=1e-3)


def test_nobody_is_told_that_a_width_is_unidentifiable() -> None:
    """No speed of the log lies within the step: its width takes any value, and nothing else leans on it."""
    system = po.MotionDrive(po.Coulomb(), chamber=False).system()
    t = np.arange(600) * 1e-2
    speed = np.where(t % 2 < 1, 0.1, -0.1) * (1 + t / 6)
    force = 5 * np.sign(speed) + 40 * speed + 0.01 * np.random.default_rng(2).standard_normal(len(t))
    log = po.Experiment(po.Trajectory(t, {"speed": speed, "force": force}), {"force": 0.01}, name="rubbed")
    fit = po.identify(system, [log], system.parameters.freed("friction.coulomb", "friction.viscous"), throw=False)
    assert fit.status.code is po.Code.CONVERGED, fit.status
    assert fit.verdict is not None
    assert fit.verdict.unidentifiable == ()
    assert fit.estimates["mark"][WIDTH] == po.Mark.UNIDENTIFIABLE
    assert WIDTH not in str(fit.status)
