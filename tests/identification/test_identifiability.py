"""Verdicts before and after a fit, in words."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.identifiability import identifiability
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Asymmetric, Coulomb, FrictionModel, LuGre, Stribeck
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares, Stage

TIME = np.arange(0, 1.5, 1e-3)
SWING = 60 * np.sin(2 * np.pi * 2 * TIME) + 40 * np.sin(2 * np.pi * 5 * TIME)


def pushed(friction: FrictionModel, force: Array = SWING, **values: float) -> tuple[ParameterSet, Experiment]:
    """A drive under a known force, 20 um of noise on its position."""
    drive = ForceDrive(friction)
    truth = drive.parameters.with_values({n.replace("__", "."): v for n, v in values.items()})
    run = simulate(drive.system(), Trajectory(TIME, {"force": force}), truth, intersample={"force": Intersample.LINEAR})
    noisy = run["position"] + 2e-5 * np.random.default_rng(0).standard_normal(TIME.size)
    return truth, Experiment(Trajectory(TIME, {"force": force, "position": noisy}), {"position": 2e-5}, name="run")


def rubbed(speeds: Sequence[float], noise: float = 0.2) -> Experiment:
    """A rig moved at constant speeds, both ways, a second each; its force is measured."""
    speed = np.repeat(np.asarray(speeds), 100)
    t, rng = np.arange(speed.size) * 1e-2, np.random.default_rng(0)
    force = 4.0 * np.tanh(speed / 1e-3) + 50 * speed + noise * rng.standard_normal(speed.size)
    return Experiment(Trajectory(t, {"speed": speed, "force": force}), {"force": noise}, name="rig")


def test_what_a_rich_log_identifies_is_foreseen() -> None:
    """The expected deviations are those of the fit, and nothing is amiss."""
    truth, log = pushed(Coulomb(), load__mass=3.0)
    free = truth.freed("load.mass", "load.force", "friction.coulomb", "friction.viscous")
    system = ForceDrive(Coulomb()).system()
    verdict, result = identifiability(system, [log], free), identify(system, [log], free)
    assert str(verdict) == str(result.verdict) == "the logs identify every free parameter"
    assert verdict.unidentifiable == ()
    assert verdict.indistinguishable == ()
    ratio = verdict.table["stderr"] / result.estimates["stderr"]
    assert ratio.between(0.8, 1.25).all(), ratio
    assert (verdict.table["inflation"] >= 1).all()
    assert (result.estimates["note"] == "").all()


def test_offset_and_coulomb_asymmetry_only_count_together() -> None:
    truth, log = pushed(Asymmetric(Coulomb()), friction__coulomb_asymmetry=0.1)
    system = ForceDrive(Asymmetric(Coulomb())).system()
    free = ("load.mass", "load.force", "friction.coulomb", "friction.viscous", "friction.coulomb_asymmetry")
    sharp = truth.with_values({"friction.smoothing": 1e-4, "friction.asymmetry_width": 1e-4})
    verdict = identifiability(system, [log], sharp.freed(*free))
    assert verdict.indistinguishable == (("load.force", "friction.coulomb_asymmetry"),)
    assert "load.force and friction.coulomb_asymmetry act only together" in " ".join(verdict.sentences)
    assert "turn the axis round" in " ".join(verdict.sentences)


def test_speeds_that_hardly_differ_refuse_slope_and_curve() -> None:
    """Twice a speed is no curve; ten times is one."""
    rig = MotionDrive(Stribeck(), chamber=False)
    free = rig.parameters.freed("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")
    poor = identifiability(rig.system(), [rubbed([0.005, -0.005, 0.01, -0.01])], free)
    assert {"friction.static", "friction.stribeck_velocity", "friction.viscous"} <= set(poor.unidentifiable)
    assert "nearly all speeds lie between 0.005 and 0.01 m/s" in " ".join(poor.sentences)
    assert "log speeds from 0.005 to beyond 0.05 m/s" in " ".join(poor.sentences)
    rich = identifiability(rig.system(), [rubbed([0.001, -0.002, 0.01, -0.02, 0.1, -0.2])], free)
    assert "friction.viscous" not in rich.unidentifiable
    alone = rig.parameters.freed("friction.viscous")
    assert identifiability(rig.system(), [rubbed([0.005, -0.01])], alone).unidentifiable == ()


def test_without_reversals_bristles_are_refused_and_never_a_number() -> None:
    truth, log = pushed(LuGre(), 100 + 0.3 * SWING)
    late = Experiment(log.trajectory.rows(400, 1500), log.noise, name="slide")
    free = truth.freed("friction.coulomb", "friction.viscous", "friction.bristle_stiffness", "friction.bristle_damping")
    system = ForceDrive(LuGre()).system()
    verdict = identifiability(system, [late], free)
    bristles = {"friction.bristle_stiffness", "friction.bristle_damping"}
    assert bristles <= set(verdict.unidentifiable)
    assert "the motion never reverses, so that the bristles are hardly seen; log presliding" in " ".join(
        verdict.sentences
    )
    result = identify(system, [late], free)
    rows = result.estimates.loc[sorted(bristles)]
    assert np.isnan(rows[["value", "stderr", "ci_low", "ci_high"]]).all(axis=None)
    assert (rows["note"] == "unidentifiable").all()
    assert result.verdict is not None
    assert "the motion never reverses" in result.verdict.to_dict()["reasons"]["friction.bristle_stiffness"]


def test_a_mass_that_hardly_accelerates_is_refused() -> None:
    t = np.arange(0, 20, 1e-2)
    position = np.where(t < 10, 0.01 * t, 0.2 - 0.01 * t)
    speed, force = np.where(t < 10, 0.01, -0.01), np.where(t < 10, 20.0, -20.0)
    rng = np.random.default_rng(0)
    channels = {"position": position + 1e-5 * rng.standard_normal(t.size), "force": force, "speed": speed}
    log = Experiment(Trajectory(t, channels), {"position": 1e-5, "speed": 1e-4})
    free = ForceDrive(Coulomb()).parameters.with_values({"load.mass": 1.0}).freed("load.mass", "friction.coulomb")
    verdict = identifiability(ForceDrive(Coulomb()).system(), [log], free)
    assert "load.mass" in verdict.unidentifiable
    assert "weigh the load and fix its mass" in " ".join(verdict.sentences)


def test_a_parameter_without_effect_is_named() -> None:
    truth, log = pushed(Coulomb())
    still = Experiment(log.trajectory.with_columns({"force": np.zeros(TIME.size)}), log.noise)
    with pytest.raises(InputError):
        identifiability(ForceDrive(Coulomb()).system(), [still], truth)
    rig = MotionDrive(Stribeck(), chamber=False)
    fast = rubbed([0.3, -0.3, 0.5, -0.5])
    verdict = identifiability(rig.system(), [fast], rig.parameters.freed("friction.coulomb", "friction.static"))
    assert "friction.static" in verdict.unidentifiable


def test_a_failure_names_the_worst_place() -> None:
    truth, log = pushed(Coulomb())
    jumped = log.trajectory["position"] + np.where((TIME > 0.7) & (TIME < 0.8), 0.05, 0.0)
    bad = Experiment(log.trajectory.with_columns({"position": jumped}), log.noise, name="bad")
    free = truth.freed("load.mass", "friction.coulomb", "friction.viscous")
    few = LeastSquares(stages=(Stage(1e-2, 2), Stage(1e-5, 2)))
    with pytest.raises(
        ConvergenceError, match=r"the worst residuals, .* are position of bad from 0\.\d+ to 0\.\d+ s"
    ) as caught:
        # windows would leave the jump out
        identify(ForceDrive(Coulomb()).system(), [bad.accepting("jumps")], free, method=few, window=math.inf)
    result = caught.value.solution
    assert isinstance(result, IdentificationResult)
    assert result.estimates[["stderr", "ci_low", "ci_high"]].isna().all(axis=None)
    assert math.isfinite(result.estimates["value"].iloc[0])
