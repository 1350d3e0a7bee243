"""Logs that cannot identify a parameter: the fit ends, the rest is identified, and there is no number for that one."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_drive, write_fit
from pneuopt.files.toml import read_toml
from pneuopt.identification.identifiability import prior_dominated, prior_influenced
from pneuopt.identification.identify import identify
from pneuopt.identification.profiles import profile
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import LuGre, Stribeck
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.quantities.trajectories import Trajectory

FILE = """
[drive]
kind = "force"
[load]
mass = { value = "5 kg", free = true }
[friction]
model = "lugre"
coulomb = { value = "30 N", free = true }
viscous = { value = "70 N*s/m", free = true }
bristle_stiffness = { value = "20 N/mm", free = true }  # a guess
bristle_damping = { value = "100 N*s/m", free = true }
"""
TIME = np.arange(0, 1.0, 1e-3)
FORCE = 150 + 60 * np.sin(2 * np.pi * 2 * TIME) + 40 * np.sin(2 * np.pi * 5 * TIME)
BRISTLES = ("friction.bristle_stiffness", "friction.bristle_damping")
SLIDING = ("friction.coulomb", "friction.viscous", "load.mass")
DRIVE = ForceDrive(LuGre())


@cache
def slide(seed: int = 0) -> Experiment:
    """A LuGre drive that slides one way, always fast, with 20 um of noise on its position."""
    run = simulate(
        DRIVE.system(), Trajectory(TIME, {"force": FORCE}), DRIVE.parameters, intersample={"force": Intersample.LINEAR}
    )
    noisy = run["position"] + 2e-5 * np.random.default_rng(seed).standard_normal(TIME.size)
    log = Trajectory(TIME, {"force": FORCE, "position": noisy})
    return Experiment(log.rows(300, TIME.size), {"position": 2e-5}, name="slide")


def given(stiffness: float, damping: float) -> ParameterSet:
    return DRIVE.parameters.with_values(dict(zip(BRISTLES, (stiffness, damping), strict=True)))


@cache
def fitted(stiffness: float = 2e4, damping: float = 100.0, seed: int = 0) -> IdentificationResult:
    return identify(DRIVE.system(), [slide(seed)], given(stiffness, damping).freed(*SLIDING, *BRISTLES))


def test_bristles_without_presliding_are_no_numbers_and_keep_their_given_values() -> None:
    result = fitted()
    assert result.status.code is Code.PARTIAL
    said, held = result.status.sentences[:2]
    assert said == "the logs do not identify friction.bristle_stiffness and friction.bristle_damping"
    assert held.startswith("held: friction.bristle_stiffness at 2e+04 N/m and friction.bristle_damping at 100 N*s/m;")
    rows = result.estimates
    assert rows.index[rows["note"] == "unidentifiable"].tolist() == list(BRISTLES)
    assert np.isnan(rows.loc[[*BRISTLES], ["value", "stderr", "ci_low", "ci_high"]]).all(axis=None)
    assert np.isnan(result.covariance[BRISTLES[0]]).all()
    assert [result.parameters.value(n) for n in BRISTLES] == [2e4, 100.0]
    assert [result.parameters[n].upper for n in BRISTLES] == [DRIVE.parameters[n].upper for n in BRISTLES]
    assert result.verdict is not None
    assert result.verdict.unchanged == BRISTLES
    assert "(2e+04) and friction.bristle_damping (100) keep their given values" in " ".join(result.verdict.sentences)
    assert "the motion never reverses" in result.verdict.reasons[BRISTLES[0]]


@pytest.mark.parametrize("times", [1 / 3, 1.0, 3.0])
def test_identifiable_estimates_do_not_depend_on_unidentifiable_ones(times: float) -> None:
    """Wherever the bristles are fixed, within a decade of the truth, the others stay within their own deviations."""
    rows = fitted().estimates.loc[[*SLIDING]]
    fixed = given(5e4 * times, 300 * times).freed(*SLIDING)
    known = identify(DRIVE.system(), [slide()], fixed).estimates.loc[[*SLIDING]]
    assert ((rows["value"] - known["value"]).abs() < 0.3 * rows["stderr"]).all()
    assert_allclose(rows["stderr"], known["stderr"], rtol=0.1)
    truth = np.array([DRIVE.parameters.value(n) for n in SLIDING])
    assert ((rows["value"] - truth).abs() < 4 * rows["stderr"]).all()


def test_a_profile_of_an_identifiable_parameter_is_its_interval() -> None:
    result = fitted()
    found = profile(DRIVE.system(), [slide()], result, "friction.coulomb")
    row = result.estimates.to_dict(orient="index")["friction.coulomb"]
    ends = np.array([row["ci_low"], row["ci_high"]])
    assert_allclose(np.array([found.low, found.high]), ends, rtol=0, atol=0.2 * row["stderr"])


def test_the_file_of_the_fit_says_why_and_keeps_what_is_unidentifiable(tmp_path: Path) -> None:
    source, fit = tmp_path / "drive.toml", tmp_path / "fit.toml"
    source.write_text(FILE, encoding="utf-8")
    write_fit(fit, source, fitted())
    said, text = read_toml(fit).unwrap(), fit.read_text(encoding="utf-8")
    assert said["status"]["code"] == "converged for a part of the parameters"
    assert said["verdict"]["unidentifiable"] == said["verdict"]["unchanged"] == list(BRISTLES)
    assert "the motion never reverses" in said["verdict"]["reasons"][BRISTLES[0]]
    assert any("keep their given values" in sentence for sentence in said["verdict"]["sentences"])
    assert np.isnan(said["estimates"][BRISTLES[0]]["value"])
    assert 'bristle_stiffness = { value = "20 N/mm", free = true }  # a guess' in text
    _, parameters = read_drive(fit)
    assert [parameters.value(n) for n in BRISTLES] == [2e4, 100.0]
    for name in SLIDING:  # written with nine digits
        assert parameters.value(name) == pytest.approx(fitted().parameters.value(name), rel=1e-8)


@pytest.mark.slow
def test_the_identifiable_ones_are_covered() -> None:
    """Over 40 noise draws 95 % of the intervals hold the truth: binomial, the three of a draw correlated."""
    inside = []
    for seed in range(40):
        rows = fitted(seed=seed).estimates.loc[[*SLIDING]]
        truth = np.array([DRIVE.parameters.value(n) for n in SLIDING])
        inside.append((rows["ci_low"] <= truth) & (truth <= rows["ci_high"]))
    assert 0.88 <= np.mean(inside) <= 1.0, np.mean(inside)


def rubbed(*speeds: float) -> Experiment:
    """A rig at constant speeds, a second each, with 0.2 N of noise on its force."""
    speed = np.repeat(np.asarray(speeds), 100)
    t, rng = np.arange(speed.size) * 1e-2, np.random.default_rng(0)
    force = 30 * np.sign(speed) + 50 * speed + 0.2 * rng.standard_normal(speed.size)
    return Experiment(Trajectory(t, {"speed": speed, "force": force}), {"force": 0.2}, name="rig")


def test_a_curve_that_no_speed_reaches_keeps_its_given_values() -> None:
    """All speeds are ten Stribeck velocities and more: static friction and that velocity are not felt."""
    rig = MotionDrive(Stribeck(), chamber=False)
    curve = ("friction.static", "friction.stribeck_velocity")
    free = rig.parameters.with_values({curve[1]: 0.01}).freed("friction.coulomb", "friction.viscous", *curve)
    result = identify(rig.system(), [rubbed(0.3, -0.3, 0.6, -0.9, 1.5)], free)
    assert result.estimates["note"].to_dict() == {n: "unidentifiable" if n in curve else "" for n in free.free_names}
    assert {n: result.parameters.value(n) for n in curve} == {n: free.value(n) for n in curve}
    rows = result.estimates.drop([*curve])
    assert ((rows["value"] - np.array([30.0, 50.0])).abs() < 4 * rows["stderr"]).all()


def test_what_leans_on_a_held_parameter_and_is_known_well_even_so_is_handed_out() -> None:
    """A true stick-slip log whose Stribeck velocity did not settle: Coulomb within .6 %, static within 200 %."""
    values, deviations = np.array([30.0, 97.0, 80.0]), np.array([0.17, 209.0, 0.01])
    prior = np.diag(np.array([0.99, 0.99, 0.05]) * deviations**2)
    assert prior_influenced(np.diag(deviations**2), prior).tolist() == [True, True, False]
    assert prior_dominated(np.diag(deviations**2), prior, values, [0.01]).tolist() == [False, True, False]
    assert prior_dominated(np.diag(deviations**2), prior, values, [0.0]).tolist() == [True, True, False]


def test_a_log_that_identifies_nothing_does_not_converge() -> None:
    """At one speed there is one level: neither of its two parts is identifiable."""
    rig = MotionDrive(Stribeck(), chamber=False)
    free = rig.parameters.freed("friction.coulomb", "friction.viscous")
    result = identify(rig.system(), [rubbed(0.5)], free, throw=False)
    assert not result.status.converged
    assert "the logs identify none of the free parameters by itself" in result.status.message
