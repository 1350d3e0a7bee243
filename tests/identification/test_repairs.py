import math
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.identification.repairs import MAX_BRIDGE, MIN_RUN, known_runs, repair_log
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.trajectories import Trajectory

DRIVE = ForceDrive(Coulomb()).system()
TRUTH = {"load.mass": 5.0, "friction.coulomb": 20.0, "friction.viscous": 60.0}
KNOWN = DRIVE.parameters.with_values(TRUTH)
FREE = KNOWN.with_values({"load.mass": 3.0}).freed(*TRUTH)
NOISE, LINEAR = 1e-5, {"force": Intersample.LINEAR}


def logged(t: Array) -> Experiment:
    force = 60 * np.sin(9 * t) + 40 * np.sin(21 * t)
    run = simulate(DRIVE, Trajectory(t, {"force": force}), KNOWN, rtol=1e-8, intersample=LINEAR)
    noisy = run["position"] + NOISE * np.random.default_rng(0).standard_normal(t.size)
    return Experiment(Trajectory(t, {"force": force, "position": noisy}), {"position": NOISE}, name="run")


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
    fit = identify(DRIVE, log, FREE)
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
    mended, (said,) = repair_log(DRIVE, without(part, slice(700, 701)))
    assert "5 samples lack an input, 4 in a row" in said
    np.testing.assert_allclose(mended.trajectory["force"][part], WHOLE.trajectory["force"][part], atol=0.2)
    assert mended.holes == ()


def test_a_command_holds_its_last_value_over_a_hole() -> None:
    held = without(slice(500, 505)).with_intersample({"force": Intersample.HELD})
    mended = repair_log(DRIVE, held)[0].trajectory["force"]
    assert set(mended[499:505]) == {WHOLE.trajectory["force"][499]}


@pytest.mark.parametrize("where", [(800, 900), (0, 300), (1700, 2000)])
def test_a_long_hole_of_an_input_cuts_the_log(where: tuple[int, int]) -> None:
    log = without(slice(*where))
    t = log.trajectory.t
    said = f"from {t[max(where[0] - 1, 0)]:g} s to {t[min(where[1], 1999)]:g} s; the log is cut there"
    assert_recovered(log, f"run: inputs are unknown {said}")
    mended = repair_log(DRIVE, log)[0]
    assert mended.holes == (where,)
    assert not np.isfinite(mended.trajectory["position"][slice(*where)]).any()


def test_a_pause_cuts_the_log() -> None:
    assert_recovered(pausing(800, 1100), "run: inputs are unknown from 1.598 s to 2.2 s; the log is cut there")
    assert repair_log(DRIVE, pausing(800, 1100))[0].holes == ((800, 800),)
    assert repair_log(DRIVE, pausing(800, 800 + MAX_BRIDGE))[0].holes == ()


def test_ten_samples_are_bridged_and_eleven_are_cut() -> None:
    for count, holes in ((10, False), (11, True)):
        for log in (without(slice(800, 800 + count)), pausing(800, 800 + count)):
            assert bool(repair_log(DRIVE, log)[0].holes) is holes


def test_a_logger_that_polls_one_sensor_after_the_other_is_read_without_a_cut() -> None:
    """No row holds an input and an output; the position is logged where the force is not.

    What lines between samples 4 ms apart leave out of a sine of 21 rad/s is (21 * .004)^2 / 12 of it, .06 %.
    """
    force, position = (WHOLE.trajectory[n].copy() for n in ("force", "position"))
    force[1::2], position[::2] = math.nan, math.nan
    log = replace(WHOLE, trajectory=WHOLE.trajectory.with_columns({"force": force, "position": position}))
    fit = identify(DRIVE, log, FREE)
    assert "999 samples lack an input, 1 in a row at most; they are bridged" in fit.status.message
    assert fit.estimates["value"].to_dict() == pytest.approx(TRUTH, rel=2e-3)


def test_what_is_left_between_two_holes_has_to_hold_some_samples() -> None:
    few = without(slice(800, 900), slice(900 + MIN_RUN - 1, 1000))
    assert repair_log(DRIVE, few)[0].holes == ((800, 1000),)
    enough = without(slice(800, 900), slice(900 + MIN_RUN, 1000))
    assert known_runs(repair_log(DRIVE, enough)[0]) == [(0, 800), (900, 900 + MIN_RUN), (1000, 2000)]
    assert_recovered(enough)


def test_a_prediction_begins_anew_behind_a_hole() -> None:
    log = without(slice(200, 300))
    log = replace(log, trajectory=log.trajectory.rows(0, 500))
    run = predict(DRIVE, log, KNOWN)
    off = run["position"] - WHOLE.trajectory["position"][:500]
    assert np.isnan(off[200:300]).all()
    assert np.isfinite(np.delete(off, range(200, 300))).all()
    assert float(np.nanmax(np.abs(off))) < 6 * NOISE
    assert validate(DRIVE, log, KNOWN)["samples"].tolist() == [400]


def test_a_static_map_needs_no_cut() -> None:
    rig = MotionDrive(Coulomb(), chamber=False).system()
    t = np.arange(400) * 1e-2
    speed = np.where(np.arange(400) % 50 < 20, math.nan, 0.1 * np.sin(t))
    log = Experiment(Trajectory(np.where(t > 2, t + 5, t), {"speed": speed, "force": np.ones(400)}), name="map")
    mended, said = repair_log(rig, log)
    assert (mended.holes, said) == ((), ())
    np.testing.assert_array_equal(np.isfinite(mended.trajectory["force"]), np.isfinite(speed))


def test_a_sampled_loop_goes_on_over_a_hole() -> None:
    loop = LoggedLoop(ClosedLoop(DRIVE, PID(sample_time=2e-3), measured="position"))
    reference = np.where(np.arange(2000) // 100 == 3, math.nan, 0.1)
    log = Experiment(WHOLE.trajectory.select(["position"]).with_columns({"position_reference": reference}), name="run")
    with pytest.raises(LogError, match=r"unknown from 0\.598 s to 0\.8 s, and a sampled controller goes on meanwhile"):
        repair_log(loop, log)


def test_a_stated_noise_is_checked_against_the_log() -> None:
    for stated, told in ((NOISE, False), (10 * NOISE, True), (NOISE / 10, True)):
        fit = identify(DRIVE, WHOLE.with_noise({"position": stated}), FREE, throw=False)
        assert ("leave it out to have it estimated" in fit.status.message) is told
    assert "noise of position is stated as 1e-06 m" in fit.status.message
