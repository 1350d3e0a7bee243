"""The widths over which a model rounds its kinks are chosen by the logs, unless the user states them."""

from dataclasses import replace

import numpy as np
import pytest

import pneuopt as po
from pneuopt.dynamics.hooks import Width
from pneuopt.identification import widths
from pneuopt.identification.problem import EstimationProblem, check_logs
from pneuopt.identification.tolerances import CONFIRMING_STAGES, MAX_TRIAL_SAMPLES
from pneuopt.identification.widths import CHOSEN_WIDTH, advise_widths, choose_widths, excerpts
from pneuopt.shooting import segments
from pneuopt.shooting.least_squares import CpuBudget, Fit, LeastSquares, Stage, solve_least_squares
from pneuopt.shooting.transcription import Transcription

FREE = ("friction.coulomb", "friction.static", "friction.viscous", "friction.stribeck_velocity")
WIDTH = "friction.smoothing"


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


def sliding(width: float, step: float = 1e-3) -> po.Experiment:
    """A mass that slides to and fro, of which the friction turns round over a width."""
    system = po.ForceDrive(po.Stribeck()).system()
    t = np.arange(round(1.2 / step)) * step
    push = 60 * np.sin(2 * np.pi * 2 * t) + 30 * np.sin(2 * np.pi * 3.3 * t)
    run = po.simulate(system, po.Trajectory(t, {"force": push}), system.parameters.with_values({WIDTH: width}))
    noisy = run["position"] + 1e-5 * np.random.default_rng(1).standard_normal(len(t))
    return po.Experiment(po.Trajectory(t, {"force": push, "position": noisy}), {"position": 1e-5}, name="run")


def test_a_log_that_sticks_is_explained_by_defaults_and_the_width_is_reported() -> None:
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    fit = po.identify(system, [log], system.parameters.with_values({"load.mass": 5.0}).freed(*FREE))
    for name, true in (("friction.coulomb", 30.0), ("friction.static", 45.0)):
        assert abs(fit.parameters.value(name) / true - 1) < 0.05
    assert fit.parameters.value(WIDTH) < 2e-4  # m/s
    assert fit.parameters[WIDTH].source == CHOSEN_WIDTH
    assert [(w.name, w.value, w.given) for w in fit.widths] == [(WIDTH, fit.parameters.value(WIDTH), 1e-3)]
    assert str(fit.widths[0]).startswith(f"{WIDTH} narrowed to {1e3 * fit.parameters.value(WIDTH):.3g} mm/s")


def test_a_stated_width_stays_and_a_failure_names_a_better_one() -> None:
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    given = system.parameters.with_values({"load.mass": 5.0, WIDTH: 2e-3}).freed(*FREE[:3])
    hasty = po.LeastSquares(stages=(Stage(1e-3, 2),))
    failed = po.identify(system, [log], given, method=hasty, throw=False)
    assert not failed.status.converged
    assert (failed.parameters.value(WIDTH), failed.widths) == (2e-3, ())
    advice = next(s for s in failed.status.sentences if s.startswith(f"try {WIDTH} = "))
    assert "in place of 0.002 m/s" in advice
    assert float(advice.split()[3]) < 5e-4
    better = given.with_values({WIDTH: float(advice.split()[3])})
    assert advise_widths(problem(system, log, better)) == ()


def test_a_budget_that_ends_while_advice_is_sought_leaves_none() -> None:
    """It ended the command in a traceback, in place of a result that had not converged."""
    system, log = po.ForceDrive(po.Stribeck()).system(), sliding(1e-3)
    given = system.parameters.with_values({WIDTH: 2e-3}).freed(*FREE[:3])
    spent = replace(problem(system, log, given), method=po.LeastSquares(budget=CpuBudget(1e-9)))
    assert advise_widths(spent) == ()


def test_a_width_is_stated_by_its_source_even_at_the_usual_value() -> None:
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    usual = system.parameters.with_values({"load.mass": 5.0}).freed(*FREE)
    stated = usual.with_values({WIDTH: usual.value(WIDTH)})
    assert choose_widths(problem(system, log, stated))[1] == ()
    chosen, widths = choose_widths(problem(system, log, usual))
    assert len(widths) == 1
    again = choose_widths(problem(system, log, chosen.parameters))[1]
    assert (again[0].value, again[0].given) == (widths[0].value, widths[0].value)


def test_a_narrower_width_that_is_foreseen_is_not_searched_with_tight_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The linearised equations of a trial say by themselves that tighter gaps prefer its width by far."""
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    posed = problem(system, log, system.parameters.with_values({"load.mass": 5.0}).freed(*FREE[:3]))
    searched = list[int]()

    def record(transcription: Transcription, method: LeastSquares) -> Fit:
        searched.append(len(method.stages))
        return solve_least_squares(transcription, method)

    monkeypatch.setattr(widths, "solve_least_squares", record)
    chosen = choose_widths(posed)[1]
    assert set(searched) == {2}  # a trial's stage, and an empty one
    monkeypatch.setattr(widths, "FORESEEN_RATIO", 0.0)
    assert [w.value for w in choose_widths(posed)[1]] == [w.value for w in chosen]
    assert searched.count(1 + CONFIRMING_STAGES) == 2


@pytest.mark.parametrize(("width", "chosen"), [(1e-3, 1e-3), (1e-2, 1e-2)])
def test_a_log_that_slides_keeps_or_gets_the_width_of_its_friction(width: float, chosen: float) -> None:
    system = po.ForceDrive(po.Stribeck()).system()
    found = choose_widths(problem(system, sliding(width), system.parameters.freed(*FREE)))[1]
    assert found[0].value == pytest.approx(chosen)


def test_a_width_does_not_take_the_place_of_a_term_that_the_model_lacks() -> None:
    """Friction that rises with the speed looks like a wide sign to a model without viscous friction."""
    system = po.MotionDrive(po.Coulomb()).system()
    t = np.arange(3000) * 1e-3
    speed = 0.01 * np.sin(2 * np.pi * t) * np.where(t < 1.5, 1.0, 1.5)
    given = po.Trajectory(t, {"speed": speed, "pressure_a": np.full(len(t), 2e5)})
    truth = system.parameters.with_values({"friction.coulomb": 5.0, "friction.viscous": 400.0})
    force = po.simulate(system, given, truth)["force"]
    noisy = force + 0.01 * np.random.default_rng(2).standard_normal(len(t))
    log = po.Experiment(given.with_columns({"force": noisy}), {"force": 0.01}, name="rubbed")
    lacking = system.parameters.with_values({"friction.viscous": 0.0}).freed("friction.coulomb")
    assert choose_widths(problem(system, log, lacking))[0].parameters.value(WIDTH) <= 1e-3


def test_a_width_too_narrow_for_the_log_rate_is_widened_in_place_of_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """30 N over 1 mm/s on 20 g take 1500 steps of RK4 a sample of 2 ms, more than a search allows; implicit ones do."""
    system, log = po.ForceDrive(po.Coulomb()).system(), sliding(1e-2, step=2e-3)
    light = system.parameters.with_values({"load.mass": 0.02}).freed("friction.coulomb")
    assert choose_widths(problem(system, log, light))[1][0].value == 1e-3
    monkeypatch.setattr(segments, "MIN_IMPLICIT_GAIN", np.inf)
    assert choose_widths(problem(system, log, light))[1][0].value > 1e-3


def test_a_width_is_narrowed_no_further_than_simulation_and_tuning_by_runge_kutta_follow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Implicit steps would take it to 10 um/s on data/own_rig, at which no loop could be tuned."""
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    posed = problem(system, log, system.parameters.with_values({"load.mass": 5.0}).freed(*FREE))
    monkeypatch.setattr(widths, "MAX_SEARCH_SUBSTEPS", 20)
    chosen, (found,) = choose_widths(posed)
    steps = 45.0 / (found.value * 5.0) * 1e-3 / 2.785  # of RK4 a sample, by hand
    assert 1 < steps < 20
    assert found.too_stiff
    start = chosen.transcription(chosen.candidates[0])
    assert not widths.is_too_stiff(start, chosen.method, implicit=False)


def test_an_edge_that_hides_the_dead_zone_is_narrowed() -> None:
    drive = po.PneumaticDrive(po.ProportionalValve(spool=po.Spool.RIGID), po.Viscous())
    t = np.arange(400) * 2e-3
    truth = drive.parameters.with_values({"valve.dead_zone": 0.03, "valve.rounding": 0.002})
    voltage = 0.6 * np.sin(2 * np.pi * 1.5 * t)
    run = po.simulate(drive.system(), po.Trajectory(t, {"valve_voltage": voltage}), truth, initial={"position": 0.1})
    log = po.Experiment(run.select(["position", "pressure_a", "pressure_b"]).with_columns({"valve_voltage": voltage}))
    log = log.with_noise({"position": 1e-5, "pressure_a": 500.0, "pressure_b": 500.0})
    given = drive.parameters.freed("valve.dead_zone", "valve.conductance")
    fit = po.identify(drive.system(), [log], given, throw=False)
    assert fit.parameters.value("valve.dead_zone") == pytest.approx(0.03, rel=0.1)
    assert fit.parameters.value("valve.rounding") <= 0.25 * 0.03 * 1.4


def test_long_logs_are_tried_in_stretches() -> None:
    t = np.arange(100_000) * 1e-3
    log = po.Experiment(po.Trajectory(t, {"force": t, "position": t}), name="long")
    parts = excerpts([log])
    assert sum(len(e.trajectory) for e in parts) <= MAX_TRIAL_SAMPLES
    assert [round(e.trajectory.t[0]) for e in parts] == [0, 25, 50, 75]
    assert excerpts(parts) == parts


def test_a_stretch_has_the_holes_that_lie_in_it() -> None:
    """A hole of the whole log at the stretch's own count of samples would let the model stand still there."""
    t = np.arange(20_000) * 1e-3
    holes = ((700, 900), (5500, 5500), (6900, 7400), (10_000, 15_000), (15_500, 15_900))
    log = po.Experiment(po.Trajectory(t, {"force": t, "position": t}), name="long", holes=holes)
    parts = excerpts([log])
    assert [round(e.trajectory.t[0]) for e in parts] == [0, 5, 15]  # nothing is known of the third
    assert [e.holes for e in parts] == [((700, 900),), ((500, 500), (1900, 2000)), ((500, 900),)]


def test_widths_are_confirmed_at_the_same_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that takes tight gaps for noise of the states ends at loose ones, where any width costs little.

    Once a wide width stayed so: its cost at loose gaps stood beside that of a narrow one at tight gaps.
    """
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    posed = problem(system, log, system.parameters.with_values({"load.mass": 5.0}).freed(*FREE))
    gaps = list[float]()

    def record(transcription: Transcription, method: LeastSquares) -> Fit:
        fit = solve_least_squares(transcription, method)
        if len(method.stages) > 2:
            gaps.append(fit.stats["gap_deviation"])
        return fit

    monkeypatch.setattr(widths, "solve_least_squares", record)
    monkeypatch.setattr(widths, "FORESEEN_RATIO", 0.0)
    choose_widths(posed)
    assert gaps == [LeastSquares().stages[CONFIRMING_STAGES - 1].gap] * 2


@pytest.mark.parametrize(("tight_cost", "is_taken"), [(900.0, False), (100.0, True)])
def test_a_width_that_tight_gaps_do_not_confirm_is_not_taken(tight_cost: float, is_taken: bool) -> None:
    """A narrower one lowers the cost with loose gaps by a half, which the given one's equations do not foresee."""
    width = Width(WIDTH, 4.0)
    parameters = po.ParameterSet({WIDTH: po.Parameter(1e-3, "m/s", 1e-6, 1.0)})

    def trial(value: float, cost: float) -> widths._WidthTrial:
        return widths._WidthTrial({WIDTH: value}, cost, np.inf, 1000, parameters, too_stiff=False)

    class Race:
        def run_scaled(self, at: widths._WidthTrial, _: Width, factor: float) -> widths._WidthTrial:
            value = at.widths[WIDTH] * factor
            return trial(value, 300.0 if value == pytest.approx(2.5e-4) else 1e4)

        def run(self, at: dict[str, float], *, confirms: bool) -> widths._WidthTrial:
            assert confirms
            return trial(at[WIDTH], 500.0 if at[WIDTH] == 1e-3 else tight_cost)

    given = trial(1e-3, 600.0)
    found, _ = widths._search_width(Race(), width, given)  # type: ignore[arg-type]
    assert (found is not given) == is_taken
