"""The estimation problem: a fit, or a result, becomes the start of the next one.

A valve's command that was logged from 0 to 10 V: the centre is found, and estimated; one about 0 V stays.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import Symbols, System, define
from pneuopt.identification.forecast import predict, validate
from pneuopt.identification.identifiability import check_content
from pneuopt.identification.identify import identify
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.identification.losses import Huber
from pneuopt.identification.problem import (
    UNSEEN_CENTRE,
    EstimationProblem,
    check_logs,
    find_centre,
    known_runs,
    log_remarks,
    repair_log,
)
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.select_model import select_model
from pneuopt.identification.tolerances import MAX_BRIDGE, MIN_RUN
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, Viscous
from pneuopt.models.linear import FirstOrder, Integrator, Plant, SecondOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, PhysicsWarning, UnknownNameError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares, solve_least_squares
from pneuopt.tuning.racing import Racing

TIME = np.arange(200) * 1e-3
DRIVE = ForceDrive(Viscous())


def problem() -> EstimationProblem:
    force = 50 * np.sin(20 * TIME)
    run = simulate(
        DRIVE.system(), Trajectory(TIME, {"force": force}), DRIVE.parameters, intersample={"force": Intersample.LINEAR}
    )
    log = Experiment(Trajectory(TIME, {"force": force, "position": run["position"]}), {"position": 1e-5}, name="run")
    free = DRIVE.parameters.freed("load.mass", "friction.viscous")
    return EstimationProblem(DRIVE.system(), (log,), free, LeastSquares())


def test_a_fit_becomes_the_start_of_the_next_one() -> None:
    posed = problem()
    fit = solve_least_squares(posed.transcription(posed.candidates[0]))
    start = posed.start_from(fit, "again")
    assert start.label == "again"
    assert start.parameters == {n: fit.parameters.value(n) for n in fit.parameters.free_names}
    assert start.states["run"] is fit.trajectories[0]
    again = solve_least_squares(posed.transcription(start))
    assert again.with_effort_of(fit).stats["iterations"] == fit.stats["iterations"] + again.stats["iterations"]
    assert again.stats["cost"] <= 1.001 * fit.stats["cost"] + 1e-9


def test_a_result_without_a_value_starts_at_the_given_one() -> None:
    posed = problem()
    fit = solve_least_squares(posed.transcription(posed.candidates[0]))
    estimates = pd.DataFrame({"value": {"load.mass": 4.5, "friction.viscous": np.nan}})
    table, runs = pd.DataFrame(), {"run": fit.trajectories[0]}
    result = IdentificationResult(fit.parameters, estimates, table, table, runs, fit.status, fit.stats, {})
    given = posed.parameters.value("friction.viscous")
    assert posed.start_from(result).parameters == {"load.mass": 4.5, "friction.viscous": given}
    held = replace(posed, fixed={"friction.viscous": 7.0})
    assert held.transcription(held.start_from(result)).parameters.value("friction.viscous") == 7.0


PLANT = ForceDrive(Coulomb()).system()
NOISE = 2e-5  # [m]
RIG = ForceDrive(Coulomb())


def log_with(**columns: Array | None) -> Experiment:
    """100 ms of a drive that coasts, with other columns, or without those that are None."""
    t = np.linspace(0, 0.1, 100, endpoint=False)
    position = 0.01 * t + NOISE * np.random.default_rng(0).standard_normal(100)
    given = {"force": np.zeros(100), "position": position, **columns}
    return Experiment(Trajectory(t, {n: c for n, c in given.items() if c is not None}), name="run 0")


def test_a_loops_set_point_may_stay_in_the_log_and_names_become_distinct() -> None:
    log = log_with(speed_reference=np.zeros(100))
    anonymous = replace(log, name="")
    free = RIG.parameters.freed("friction.coulomb")
    result = identify(RIG.system(), [log, log, anonymous], free, throw=False)
    assert list(result.trajectories) == ["run 0", "run 0 (2)", "log 3"]


def test_a_sensors_noise_is_shared_between_logs() -> None:
    still = log_with(position=np.full(100, 0.5))
    result = identify(
        RIG.system(),
        [log_with(), replace(still, name="b")],
        RIG.parameters.freed("load.force"),
        throw=False,
    )
    noise = result.fit["noise"]
    assert noise.iloc[0] == noise.iloc[1] == pytest.approx(NOISE, rel=0.3)


def test_a_log_that_contradicts_itself_is_refused() -> None:
    t = np.linspace(0, 2, 2000, endpoint=False)
    swing = {"position": 0.1 * np.sin(6 * t), "force": -(30 * np.sign(np.cos(6 * t)) + 20 * np.cos(6 * t))}
    log = Experiment(Trajectory(t, swing), name="run")
    with pytest.raises(LogError, match=r"run: the force brakes the motion on balance .* change the sign of 'force'"):
        identify(RIG.system(), [log], RIG.parameters.freed("friction.coulomb"))


def test_a_still_window_among_moving_ones_is_no_fault() -> None:
    still = log_with(position=np.full(100, 0.5))
    check_content(RIG.system(), [log_with(), replace(still, name="b")], RIG.parameters)
    with pytest.raises(LogError, match="b: 'position' is constant"):
        check_content(RIG.system(), [replace(still, name="b")], RIG.parameters)


def test_what_a_model_doubts_is_warned_of_and_stands_in_the_status() -> None:
    """The doubter sees the parameters as they are in each log."""

    def doubting(logs: Mapping[str, Log]) -> Sequence[str]:
        return [f"{name}: {log.parameters.value('load.mass'):g} kg?" for name, log in logs.items()]

    system = replace(RIG.system(), log_warning_hook=doubting)
    t = np.arange(400) * 1e-3
    motion = {"force": 100 * np.cos(20 * t), "position": 0.02 * np.sin(20 * t) + 1e-6 * np.sin(1e5 * t)}
    log = Experiment(Trajectory(t, motion), name="run").with_conditions({"load.mass": 7.0})
    with pytest.warns(PhysicsWarning, match=r"run: 7 kg\?"):
        fit = identify(system, [log], RIG.parameters.freed("friction.viscous"), throw=False)
    assert fit.status.message.endswith("; run: 7 kg?")


def braked(accept: tuple[str, ...] = ()) -> Experiment:
    """A log whose force brakes; smooth, so that a fit of it is quick."""
    t = np.linspace(0, 2, 2000, endpoint=False)
    swing = {"position": 0.1 * np.sin(6 * t), "force": -(30 * np.sign(np.cos(6 * t)) + 20 * np.cos(6 * t))}
    return Experiment(Trajectory(t, swing), name="run", accept=accept)


def test_a_refusal_names_its_check_and_is_overridden_by_that_name() -> None:
    system = RIG.system()
    with pytest.raises(LogError, match=r"if the log is right, accept = \['work'\] in its sidecar, or --accept work"):
        check_content(system, [braked()], RIG.parameters)
    (told,) = check_content(system, [braked(("work",))], RIG.parameters)
    assert told.startswith("run: accepted as right: the force brakes the motion on balance")
    with pytest.raises(LogError, match="brakes the motion"):
        check_content(system, [braked(("speed",))], RIG.parameters)
    fit = identify(system, braked(), RIG.parameters.freed("friction.coulomb"), accept=["work"], throw=False)
    assert "accepted as right" in fit.status.message


def test_a_channel_that_no_model_reads_is_left_out_by_name() -> None:
    extra = log_with(temperature=np.full(100, 300.0))
    with pytest.raises(LogError, match=r"cannot use channel 'temperature'.* or accept = \['channels'\]"):
        check_logs(RIG.system(), extra, RIG.parameters)
    accepting = extra.accepting("channels")
    (checked,) = check_logs(RIG.system(), accepting, RIG.parameters)
    assert checked.trajectory.names == ("force", "position")
    (said,) = log_remarks(RIG.system(), [accepting], [checked])
    assert said == "run 0: accepted: temperature, which the model does not read"


def test_a_constant_channel_is_no_obstacle_where_its_noise_is_stated() -> None:
    still = log_with(position=np.full(100, 3.0)).with_noise({"position": NOISE})
    assert check_logs(RIG.system(), still, RIG.parameters)[0].noise == {"position": NOISE}


def test_a_channel_that_stands_exactly_still_for_long_is_told_to_state_its_noise() -> None:
    """A quarter of the log without any change looks like noise of 0, by which no residual can be divided."""
    t = np.arange(2000) * 1e-3
    moves = np.where(t < 1.0, 0.0, 0.05 * (1 - np.cos(np.sqrt(50.0) * (t - 1.0))))
    log = Experiment(Trajectory(t, {"force": np.sin(3 * t), "position": moves}), name="run")
    with pytest.raises(
        LogError, match=r"run: channel 'position' shows no noise, not even rounding; state its \[noise\]"
    ):
        check_logs(RIG.system(), log, RIG.parameters)


def test_a_sidecar_accepts_checks_by_name(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k * k}\n" for k in range(12))
    (tmp_path / "run.csv").write_text(f"time [s],position [m]\n{rows}", encoding="utf-8")
    (tmp_path / "run.toml").write_text('accept = ["work"]\n', encoding="utf-8")
    assert read_log(tmp_path / "run.csv").accept == ("work",)
    (tmp_path / "run.toml").write_text('accept = "work"\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"run.toml: accept must be a list"):
        read_log(tmp_path / "run.csv")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("window", math.nan),
        ("window", "1 s"),
        ("loss", Huber),
        ("loss", "huber"),
        ("method", LeastSquares),
        ("method", Racing()),
        ("start", ParameterSet()),
        ("cpu_seconds", math.nan),
        ("cpu_seconds", "60 s"),
        ("accept", 3),
    ],
)
def test_an_option_that_is_none_is_named_with_what_it_takes(option: str, value: object) -> None:
    """They were tracebacks, or had another meaning: a window of NaN cut no log."""
    with pytest.raises(InputError, match=rf"^{option} takes .*; got "):
        identify(PLANT, braked(), PLANT.parameters.freed("load.mass"), **{option: value})  # type: ignore[arg-type]
    if option == "window":
        for use in (validate, predict):
            with pytest.raises(InputError, match=r"^window takes"):
                use(PLANT, braked(), PLANT.parameters, window=value)  # type: ignore[arg-type]


def test_one_name_is_a_name_and_no_letters() -> None:
    free = PLANT.parameters.freed("load.mass")
    with pytest.raises(UnknownNameError, match="unknown check 'motions'"):
        identify(PLANT, braked(), free, accept="motions")
    assert replace(braked(), accept="motion").accept == ("motion",)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match=r"unknown parameter 'friction\.x\*'"):
        select_model({"a": PLANT, "b": PLANT}, braked(), PLANT.parameters, free="friction.x*")


SYSTEM = ForceDrive(Coulomb()).system()
TRUTH = {"load.mass": 5.0, "friction.coulomb": 20.0, "friction.viscous": 60.0}
KNOWN = SYSTEM.parameters.with_values(TRUTH)
FREE = KNOWN.with_values({"load.mass": 3.0}).freed(*TRUTH)
SMALL_NOISE, LINEAR = 1e-5, {"force": Intersample.LINEAR}


def logged(t: Array) -> Experiment:
    force = 60 * np.sin(9 * t) + 40 * np.sin(21 * t)
    run = simulate(SYSTEM, Trajectory(t, {"force": force}), KNOWN, rtol=1e-8, intersample=LINEAR)
    noisy = run["position"] + SMALL_NOISE * np.random.default_rng(0).standard_normal(t.size)
    return Experiment(Trajectory(t, {"force": force, "position": noisy}), {"position": SMALL_NOISE}, name="run")


WHOLE = logged(np.linspace(0.0, 3.998, 2000))


def without(*parts: slice, channel: str = "force") -> Experiment:
    column = WHOLE.trajectory[channel].copy()
    for part in parts:
        column[part] = math.nan
    return replace(WHOLE, trajectory=WHOLE.trajectory.with_columns({channel: column}))


def pausing(begin: int, end: int) -> Experiment:
    """The same log without these rows."""
    kept = np.r_[0:begin, end : len(WHOLE.trajectory)]
    log = WHOLE.trajectory
    return replace(WHOLE, trajectory=Trajectory(log.t[kept], {n: log[n][kept] for n in log}))


def assert_recovered(log: Experiment, *said: str) -> None:
    fit = identify(SYSTEM, log, FREE)
    rows = fit.estimates
    assert len(fit.trajectories["run"]) == len(log.trajectory)
    off = {n: abs(float(rows["value"][n]) - true) / float(rows["stderr"][n]) for n, true in TRUTH.items()}
    assert max(off.values()) < 4, off
    assert fit.stats["chi_square_ratio"] == pytest.approx(1, abs=0.15)
    for sentence in said:
        assert sentence in fit.status.message


def test_a_short_hole_of_a_measured_input_is_bridged() -> None:
    part = slice(500, 500 + 4)
    assert_recovered(without(part), "run: 4 samples lack an input, 4 in a row at most; they are bridged")
    mended, (said,) = repair_log(SYSTEM, without(part, slice(700, 701)))
    assert "5 samples lack an input, 4 in a row" in said
    np.testing.assert_allclose(mended.trajectory["force"][part], WHOLE.trajectory["force"][part], atol=0.2)
    assert mended.holes == ()


def test_a_command_holds_its_last_value_over_a_hole() -> None:
    held = without(slice(500, 505)).with_intersample({"force": Intersample.HELD})
    mended = repair_log(SYSTEM, held)[0].trajectory["force"]
    assert set(mended[499:505]) == {WHOLE.trajectory["force"][499]}


@pytest.mark.parametrize("where", [(800, 900), (0, 300), (1700, 2000)])
def test_a_long_hole_of_an_input_cuts_the_log(where: tuple[int, int]) -> None:
    log = without(slice(*where))
    t = log.trajectory.t
    said = f"from {t[max(where[0] - 1, 0)]:g} s to {t[min(where[1], 1999)]:g} s; the log is cut there"
    assert_recovered(log, f"run: inputs are unknown {said}")
    mended = repair_log(SYSTEM, log)[0]
    assert mended.holes == (where,)
    assert not np.isfinite(mended.trajectory["position"][slice(*where)]).any()


def test_a_pause_cuts_the_log() -> None:
    assert_recovered(pausing(800, 1100), "run: inputs are unknown from 1.598 s to 2.2 s; the log is cut there")
    assert repair_log(SYSTEM, pausing(800, 1100))[0].holes == ((800, 800),)
    assert repair_log(SYSTEM, pausing(800, 800 + MAX_BRIDGE))[0].holes == ()


def test_ten_samples_are_bridged_and_eleven_are_cut() -> None:
    for count, holes in ((10, False), (11, True)):
        for log in (without(slice(800, 800 + count)), pausing(800, 800 + count)):
            assert bool(repair_log(SYSTEM, log)[0].holes) is holes


def test_a_logger_that_polls_one_sensor_after_the_other_is_read_without_a_cut() -> None:
    """No row holds an input and an output; the position is logged where the force is not.

    What lines between samples 4 ms apart leave out of a sine of 21 rad/s is (21 * .004)^2 / 12 of it, .06 %.
    """
    force, position = (WHOLE.trajectory[n].copy() for n in ("force", "position"))
    force[1::2], position[::2] = math.nan, math.nan
    log = replace(WHOLE, trajectory=WHOLE.trajectory.with_columns({"force": force, "position": position}))
    fit = identify(SYSTEM, log, FREE)
    assert "999 samples lack an input, 1 in a row at most; they are bridged" in fit.status.message
    assert {n: fit.estimates["value"][n] for n in TRUTH} == pytest.approx(TRUTH, rel=2e-3)


def test_what_is_left_between_two_holes_has_to_hold_some_samples() -> None:
    few = without(slice(800, 900), slice(900 + MIN_RUN - 1, 1000))
    assert repair_log(SYSTEM, few)[0].holes == ((800, 1000),)
    enough = without(slice(800, 900), slice(900 + MIN_RUN, 1000))
    assert known_runs(repair_log(SYSTEM, enough)[0]) == [(0, 800), (900, 900 + MIN_RUN), (1000, 2000)]
    assert_recovered(enough)


def test_a_prediction_begins_anew_behind_a_hole() -> None:
    log = without(slice(200, 300))
    log = replace(log, trajectory=log.trajectory.rows(0, 500))
    run = predict(SYSTEM, log, KNOWN)
    off = run["position"] - WHOLE.trajectory["position"][:500]
    assert np.isnan(off[200:300]).all()
    assert np.isfinite(np.delete(off, range(200, 300))).all()
    assert float(np.nanmax(np.abs(off))) < 6 * SMALL_NOISE
    assert validate(SYSTEM, log, KNOWN)["samples"].tolist() == [400]


def test_a_static_map_needs_no_cut() -> None:
    rig = MotionDrive(Coulomb(), chamber=False).system()
    t = np.arange(400) * 1e-2
    speed = np.where(np.arange(400) % 50 < 20, math.nan, 0.1 * np.sin(t))
    log = Experiment(Trajectory(np.where(t > 2, t + 5, t), {"speed": speed, "force": np.ones(400)}), name="map")
    mended, said = repair_log(rig, log)
    assert (mended.holes, said) == ((), ())
    np.testing.assert_array_equal(np.isfinite(mended.trajectory["force"]), np.isfinite(speed))


def test_a_sampled_loop_goes_on_over_a_hole() -> None:
    loop = LoggedLoop(ClosedLoop(SYSTEM, PID(sample_time=2e-3), measured="position"))
    reference = np.where(np.arange(2000) // 100 == 3, math.nan, 0.1)
    log = Experiment(WHOLE.trajectory.select(["position"]).with_columns({"position_reference": reference}), name="run")
    with pytest.raises(LogError, match=r"unknown from 0\.598 s to 0\.8 s, and a sampled controller goes on meanwhile"):
        repair_log(loop, log)


def test_a_stated_noise_is_checked_against_the_log() -> None:
    for stated, told in ((SMALL_NOISE, False), (10 * SMALL_NOISE, True), (SMALL_NOISE / 10, True)):
        fit = identify(SYSTEM, WHOLE.with_noise({"position": stated}), FREE, throw=False)
        assert ("leave it out to have it estimated" in fit.status.message) is told
    assert "noise of position is stated as 1e-06 m" in fit.status.message


PNEUMATIC = po.PneumaticDrive(friction=po.Viscous())
GIVEN = PNEUMATIC.parameters
CENTRE = "valve.centre"


def logged_command(centre: float, rest: float = 0.05, swing: float = 2.0, name: str = "run") -> po.Experiment:
    """A piston that stands between two strokes, while its command rests a little off the valve's middle."""
    t = np.arange(600) * 2e-3
    moving = np.where((t > 0.2) & (t < 0.5), 1.0, np.where((t > 0.8) & (t < 1.1), -1.0, 0.0))
    position = 0.05 + np.cumsum(moving) * 2e-3 * 0.1 + 1e-6 * np.sin(1e3 * t)
    command = centre + np.where(moving == 0, rest, swing * moving)
    pressures = {f"pressure_{s}": 3e5 + 1e4 * np.sin(9 * t) for s in "ab"}
    return po.Experiment(po.Trajectory(t, {"valve_voltage": command, "position": position, **pressures}), name=name)


def found(*logs: po.Experiment, given: po.ParameterSet = GIVEN) -> po.ParameterSet:
    return find_centre(PNEUMATIC.system(), logs, given)


def test_a_command_from_0_to_10_V_frees_the_valves_centre_in_words() -> None:
    words = (
        r"run: valve_voltage runs from 3 to 7 V and rests at 5.05 V: the valve is closed near 5 V; valve.centre is "
        r'estimated with the rest, or state it, centre = "5 V", under \[valve\]'
    )
    with pytest.warns(po.PhysicsWarning, match=words):
        centre = found(logged_command(5.0))[CENTRE]
    assert centre.free
    assert (centre.value, centre.lower, centre.upper) == pytest.approx((5.05, 4.05, 6.05))


@pytest.mark.parametrize(
    ("centre", "rest", "swing"),
    [(0.0, 0.05, 2.0), (0.0, 0.05, 5.0), (2.0, 0.05, 1.0), (5.0, 2.0, 4.0), (5.0, 0.05, 6.0)],
    ids=["about zero", "full range about zero", "rests at 2 V", "held by 7 V", "beyond 10 V"],
)
def test_another_command_leaves_the_centre_as_it_is(centre: float, rest: float, swing: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found(logged_command(centre, rest, swing)) is GIVEN


def one_sided(centre: float) -> po.Experiment:
    """A piston that moves forwards only: its command stays above the valve's middle."""
    log = logged_command(centre, rest=0.3, swing=0.0)
    t = log.trajectory.t
    push = 0.4 * np.maximum(np.sin(10 * t), 0.0) + 0.3
    position = 0.05 + np.cumsum(np.maximum(np.sin(10 * t), 0.0)) * 2e-3 * 0.1
    columns = {"valve_voltage": centre + push, "position": position + 1e-6 * np.sin(1e3 * t)}
    return replace(log, trajectory=log.trajectory.with_columns(columns))


def test_a_command_on_one_side_of_5_V_takes_the_middle_and_says_so() -> None:
    """A valve that closes at 0 V is open all the while there; with 5 V the conductance once 14 times off was right."""
    words = (
        "run: valve_voltage runs from 5.3 to 5.7 V and rests at 5.3 V: .* is taken as 5 V, for the log uses one side"
    )
    with pytest.warns(po.PhysicsWarning, match=words):
        centre = found(one_sided(5.0), given=GIVEN.freed("valve.dead_zone"))[CENTRE]
    assert (centre.free, centre.value, centre.source) == (True, 5.0, UNSEEN_CENTRE)
    with pytest.warns(po.PhysicsWarning, match="is estimated with the rest"):  # the known dead zone tells it
        assert found(one_sided(5.0))[CENTRE].value == pytest.approx(5.3)
    both = one_sided(5.0), logged_command(5.0, name="other")  # which uses both sides
    with pytest.warns(po.PhysicsWarning, match="is estimated with the rest"):
        assert found(*both, given=GIVEN.freed("valve.dead_zone"))[CENTRE].source != UNSEEN_CENTRE
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found(one_sided(0.0)) is GIVEN


def test_a_stated_centre_is_kept_of_a_drive_and_of_a_log() -> None:
    given = GIVEN.with_values({CENTRE: 5.1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found(logged_command(5.0), given=given) is given
        assert found(logged_command(5.0).with_conditions({CENTRE: 5.1})) is GIVEN


def test_the_valves_span_counts_and_a_log_knows_its_own() -> None:
    assert not found(logged_command(5.0).with_conditions({"valve.span": 10.0}))[CENTRE].free


def test_a_log_without_motion_sensors_counts_as_a_whole() -> None:
    log = logged_command(5.0).select(["valve_voltage", "pressure_a", "pressure_b"])
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        assert abs(found(log).value(CENTRE) - 5) < 1


def test_logs_that_count_from_different_voltages_are_refused() -> None:
    words = "one: valve_voltage .* rests at 5.05 V, but other: valve_voltage .* rests at 0.05 V; subtract"
    with pytest.raises(LogError, match=words):
        found(logged_command(5.0, name="one"), logged_command(0.0, name="other"))


def test_a_centre_that_is_counted_twice_is_refused() -> None:
    words = "run: valve_voltage .* rests at 0.05 V, which is no command of a valve with valve.centre = 5 V; leave that"
    with pytest.raises(LogError, match=words):
        found(logged_command(0.0), given=GIVEN.with_values({CENTRE: 5.0}))


def test_a_loop_counts_from_the_centre_and_has_none_to_find() -> None:
    loop = po.ClosedLoop(PNEUMATIC, po.PID(1e-3))
    assert find_centre(loop.plant, [logged_command(5.0)], loop.parameters) is loop.parameters


def simulated(centre: float) -> tuple[po.System, po.ParameterSet, po.Experiment]:
    system = PNEUMATIC.system()
    values = {CENTRE: centre, "valve.dead_zone": 0.03, "valve.rounding": 0.01, "friction.viscous": 90.0}
    truth = system.parameters.with_values(values)
    t, random = np.arange(1500) * 1e-3, np.random.default_rng(1)
    swing = np.where((t % 0.5) < 0.1, 0.0, 0.8 * np.sin(2 * np.pi * 3 * t))
    rest = dict(zip((q.name for q in system.states), system.rest_state(truth), strict=True))
    run = po.simulate(system, po.Trajectory(t, {"valve_voltage": centre + swing}), truth, initial=rest)
    levels = {"position": 1e-5, "pressure_a": 500.0, "pressure_b": 500.0}
    noisy = {n: run[n] + s * random.standard_normal(t.size) for n, s in levels.items()}
    return system, truth, po.Experiment(po.Trajectory(t, {"valve_voltage": centre + swing, **noisy}), name="run")


def test_the_centre_is_estimated_with_the_rest_and_predicts_the_log() -> None:
    system, truth, log = simulated(5.06)
    given = truth.with_values({CENTRE: 0.0, "valve.dead_zone": 0.0, "friction.viscous": 50.0})
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        fit = po.identify(system, [log], given.freed("valve.dead_zone", "friction.viscous"))
    for name in (CENTRE, "valve.dead_zone", "friction.viscous"):
        row = fit.estimates.loc[name]
        assert abs(row["value"] - truth.value(name)) < 4 * row["stderr"]
    assert 0 < fit.estimates["stderr"][CENTRE] < 0.002
    assert fit.parameters.value(CENTRE) == fit.estimates["value"][CENTRE]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = po.validate(system, [log], fit.parameters)
    assert (table["nrmse"] < 0.05).all()
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        blind = po.identifiability(system, [log], system.parameters.freed("friction.viscous"))
    assert CENTRE in blind.table.index


def test_a_log_predicted_before_any_fit_is_read_from_where_it_rests() -> None:
    system, truth, log = simulated(5.06)
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        run = po.predict(system, log, truth.with_values({CENTRE: 0.0}))
    travel = float(np.ptp(log.trajectory["position"]))
    assert np.abs(run["position"] - log.trajectory["position"]).max() < 0.3 * travel


def test_a_search_starts_at_the_centre_that_the_pressures_show() -> None:
    """From 0.16 V beside it, where a mass balance would take the supply's pressure for a wrong one."""
    system, truth, log = simulated(5.06)
    beside = replace(truth[CENTRE], value=4.9, lower=4.0, upper=6.0, free=True)
    given = truth.with_values({"valve.dead_zone": 0.0, "valve.conductance": 1.5e-8})
    given = given.freed("valve.dead_zone", "valve.conductance") | po.ParameterSet({CENTRE: beside})
    logs = {"run": Log(log.trajectory, given)}
    start = system.starts(logs)[0].parameters
    assert start[CENTRE] == pytest.approx(5.06, abs=0.02)
    assert start["valve.conductance"] == pytest.approx(truth.value("valve.conductance"), rel=0.2)
    assert list(system.log_warnings(logs)) == []


def test_a_sensor_slower_than_its_log_counts_where_it_is_new() -> None:
    """Repeated values once made the noise 3.3e-7 for .05, and a stated noise a doubt; inputs keep all their rows."""
    t = np.arange(0, 4, 1e-3)
    force, rng = 40 * np.sin(6 * t) + 25 * np.sin(17 * t), np.random.default_rng(2)
    truth = DRIVE.parameters.with_values({"load.mass": 4.0, "friction.viscous": 30.0})
    run = simulate(DRIVE.system(), Trajectory(t, {"force": force}), truth, intersample={"force": Intersample.LINEAR})
    sampled = run["position"] + 1e-4 * rng.standard_normal(t.size)
    held = sampled[np.maximum(5 * ((np.arange(t.size) - 3) // 5) + 3, 0)]
    log = Experiment(Trajectory(t, {"force": force, "position": held}), name="slow")
    (checked,) = check_logs(DRIVE.system(), log, truth)
    known = np.flatnonzero(np.isfinite(checked.trajectory["position"]))
    assert set(known % 5) == {3}
    assert np.isfinite(checked.trajectory["force"]).all()
    assert checked.noise["position"] == pytest.approx(1e-4, rel=0.1)
    sentence = "slow: position is new every 5th row; what the log repeats does not count"
    assert log_remarks(DRIVE.system(), [log], [checked]) == (sentence,)
    stated = log.with_noise({"position": 1e-4})
    assert log_remarks(DRIVE.system(), [stated], check_logs(DRIVE.system(), stated, truth)) == (sentence,)
    assert log_remarks(DRIVE.system(), [checked], [checked]) == ()  # nothing is left that repeats
    fit = identify(DRIVE, log, DRIVE.parameters.freed("load.mass", "friction.viscous"))
    for name in ("load.mass", "friction.viscous"):
        assert abs(fit.parameters.value(name) - truth.value(name)) < 4 * fit.estimates["stderr"][name]
    assert sentence in str(fit.status)


def test_a_valve_used_on_one_side_gives_all_but_its_middle_and_dead_zone() -> None:
    """Of a valve of 0 to 10 V that opens one way: 14 times off, "converged", with the middle at 0 V."""
    drive = po.PneumaticDrive(po.ProportionalValve(spool=po.Spool.RIGID), po.Viscous())
    truth = drive.parameters.with_values({CENTRE: 5.1, "valve.dead_zone": 0.06, "valve.rounding": 3e-3})
    t = np.arange(700) * 2e-3
    push = 5.1 + 0.15 + 0.6 * np.maximum(np.sin(9 * t), 0) * (1 + 0.3 * np.sin(2.3 * t))
    run = simulate(drive.system(), Trajectory(t, {"valve_voltage": push}), truth, initial={"position": 0.02})
    rng = np.random.default_rng(3)
    noise = {"position": 1e-5, "pressure_a": 300.0, "pressure_b": 300.0}
    measured = {n: run[n] + sigma * rng.standard_normal(t.size) for n, sigma in noise.items()}
    log = Experiment(Trajectory(t, {"valve_voltage": push, **measured}), noise, name="one way")
    free = drive.parameters.freed("valve.conductance", "valve.dead_zone", "friction.viscous")
    said = pytest.warns(PhysicsWarning, match="is taken as 5 V")
    with said, pytest.warns(PhysicsWarning, match="on one side of the valve's middle"):
        fit = identify(drive, log, free)
    assert fit.verdict is not None
    assert set(fit.verdict.unidentifiable) == {CENTRE, "valve.dead_zone"}
    for name in ("valve.conductance", "friction.viscous"):
        assert fit.parameters.value(name) == pytest.approx(truth.value(name), rel=0.02)


def cascade() -> System:
    """Two tanks, of which the upper one overflows, and only the lower one's level is logged, as no state is called."""

    def rhs(_t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        upper, lower = (p[f"{n}.outflow"] * ca.sqrt(ca.fmax(x[n], 1e-4)) for n in ("upper", "lower"))
        over = ca.fmax(x["upper"] - 10.0, 0.0)
        rates = {"upper": p["pump.gain"] * u["pump"] - upper - over, "lower": upper + p["upper.caught"] * over - lower}
        return rates, {"level": x["lower"]}

    units = {"pump.gain": "1/s", "upper.outflow": "V**0.5/s", "lower.outflow": "V**0.5/s"}
    free = {n: Parameter(0.5, unit, 1e-3, 1.0, log=True, free=True) for n, unit in units.items()}
    free["upper.caught"] = Parameter(0.5, "1", 0.0, 1.0, free=True)
    levels = Quantity("upper", "V", 5.0), Quantity("lower", "V", 5.0)
    return define(levels, [Quantity("pump", "V", 3.0)], [Quantity("level", "V", 5.0)], ParameterSet(free), rhs)


def test_a_model_without_starts_begins_where_its_states_may_be() -> None:
    """A search from states of zero, where nothing overflows, ended with residuals of 34 times the noise."""
    tanks, rng = cascade(), np.random.default_rng(5)
    truth = {"pump.gain": 0.045, "upper.outflow": 0.045, "lower.outflow": 0.04, "upper.caught": 0.4}
    t = 4.0 * np.arange(500)
    pump = np.interp(t, t[::25], rng.uniform(1.0, 5.0, 20))
    true = tanks.parameters.with_values(truth)
    run = simulate(tanks, Trajectory(t, {"pump": pump}), true, initial={"upper": 6.0, "lower": 5.0})
    channels = {"pump": pump, "level": run["level"] + 0.02 * rng.standard_normal(500)}
    log = Experiment(Trajectory(t, channels), name="run", units={"pump": "V", "level": "V"})
    fit = identify(tanks, log, tanks.parameters)
    for name, value in truth.items():
        assert abs(fit.parameters.value(name) - value) < 4 * fit.estimates["stderr"][name]
        assert fit.estimates["stderr"][name] < 0.02 * value


OFFSET = "plant.input_offset"


def oscillator_log(zero: float, shown: float = 0.0, seed: int = 0) -> Experiment:
    """Steps of a second-order plant, whose input counts from `zero` [V] and its output from `shown`."""
    plant, t = SecondOrder().system(), np.arange(600) * 5e-3
    u = np.array([0.0, 0.3, -0.2, 0.1])[np.arange(600) // 150]
    truth = plant.parameters.with_values({"plant.gain": 8.0, "plant.natural_frequency": 20.0, "plant.damping": 0.4})
    y = simulate(plant, Trajectory(t, {"valve_voltage": u}), truth)["speed"]
    noisy = y + shown + 0.02 * np.random.default_rng(seed).standard_normal(600)
    return Experiment(Trajectory(t, {"valve_voltage": u + zero, "speed": noisy}), name=f"run{seed}")


def test_a_log_that_counts_from_elsewhere_has_its_offset_estimated() -> None:
    """A centre that was 1 V off led to a gain half as large again, and nothing was said."""
    plant = SecondOrder().system()
    free = plant.parameters.freed("plant.gain", "plant.natural_frequency", "plant.damping")
    for zero, shown, offset in ((1.0, 0.0, 1.0), (0.0, 4.0, -0.5), (2.4, 13.2, 2.4 - 13.2 / 8)):
        fit = identify(plant, oscillator_log(zero, shown), free)
        assert fit.parameters.value("plant.gain") == pytest.approx(8.0, rel=0.01)
        assert fit.parameters.value(OFFSET) == pytest.approx(offset, abs=0.01)
        assert f"{OFFSET} is estimated with the rest" in str(fit.status)
    assert fit.estimates["ci_low"][OFFSET] < offset < fit.estimates["ci_high"][OFFSET]


def test_the_covariance_of_a_fit_far_from_zero_is_symmetric() -> None:
    """Rounding left it lopsided by a few millionths, and `simulate` refused the fit.toml that `identify` wrote."""
    plant = SecondOrder().system()
    free = plant.parameters.freed("plant.gain", "plant.natural_frequency", "plant.damping", OFFSET)
    covariance = identify(plant, oscillator_log(2.4, 13.2), free).covariance.to_numpy()
    assert np.array_equal(covariance, covariance.T)


def test_an_offset_that_no_log_shows_or_that_is_stated_stays() -> None:
    plant = SecondOrder().system()
    free = plant.parameters.freed("plant.gain", "plant.natural_frequency", "plant.damping")
    fit = identify(plant, [oscillator_log(0.0, seed=k) for k in (1, 2)], free)
    assert OFFSET not in fit.estimates.index
    stated = identify(plant, oscillator_log(1.0), free.with_values({OFFSET: 0.9}), throw=False)
    assert stated.parameters.value(OFFSET) == 0.9
    known = oscillator_log(1.0).with_conditions({OFFSET: 1.0})
    fit = identify(plant, [known, oscillator_log(0.0, seed=1)], free)
    assert fit.parameters.value("plant.gain") == pytest.approx(8.0, rel=0.01)


def test_each_log_has_an_offset_of_its_own_where_the_file_says_so() -> None:
    plant = SecondOrder().system()
    free = plant.parameters.freed("plant.gain", "plant.natural_frequency", "plant.damping", OFFSET).per_log(OFFSET)
    fit = identify(plant, [oscillator_log(1.0), oscillator_log(-0.5, seed=1)], free)
    assert fit.estimates["value"][f"{OFFSET}[run0]"] == pytest.approx(1.0, abs=0.01)
    assert fit.estimates["value"][f"{OFFSET}[run1]"] == pytest.approx(-0.5, abs=0.01)


@pytest.mark.parametrize("plant", [FirstOrder(pade_order=3), SecondOrder(), Integrator()])
def test_a_gain_that_is_stated_as_negative_is_no_wrong_sign(plant: Plant) -> None:
    """A check knows what the file says of the gain: a right log was refused, with advice that spoils it."""
    system, t = plant.system(), np.arange(400) * 0.01
    u = np.sin(2.0 * t) + 0.3 * np.sin(5.0 * t)
    truth = system.parameters.with_values({"plant.gain": -2.0})
    y = simulate(system, Trajectory(t, {"valve_voltage": u}), truth)["speed"]
    log = Experiment(Trajectory(t, {"valve_voltage": u, "speed": y + 0.01 * np.random.default_rng(0).normal(size=400)}))
    stated = system.parameters.with_values({"plant.gain": -1.0}).freed("plant.gain")
    fit = identify(system, log, stated)
    assert fit.parameters.value("plant.gain") == pytest.approx(-2.0, rel=0.02)
    if not isinstance(plant, Integrator):  # which follows a swing by a quarter of its period, whatever the sign
        with pytest.raises(LogError, match="against the valve's command"):
            identify(system, log, system.parameters.freed("plant.gain"))


def test_no_piston_is_looked_for_in_newtons() -> None:
    """An output of 129 N was "129 m/s: is its unit mm, and read as m?"."""
    plant, t = FirstOrder(output=Quantity("speed", "N")).system(), np.arange(400) * 0.01
    u = 60.0 + 40.0 * np.sin(2.0 * t)
    y = simulate(plant, Trajectory(t, {"valve_voltage": u}), plant.parameters.with_values({"plant.gain": 2.0}))["speed"]
    noisy = {"valve_voltage": u, "speed": y + np.random.default_rng(0).normal(size=400)}
    log = Experiment(Trajectory(t, noisy), units={"speed": "N"}, name="run")
    fit = identify(plant, log, plant.parameters.freed("plant.gain", "plant.time_constant"))
    assert fit.parameters.value("plant.gain") == pytest.approx(2.0, rel=0.02)
