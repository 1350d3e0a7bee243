"""A fit that does not predict its own logs is a misfit; one that drifts away, and predicts over its motion, is not.

What a model lacks is named where it explains the misfit, and only there.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pneuopt.cli.shared import describe_status
from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_fit, write_fit
from pneuopt.identification.free_run import Prediction, predict_logs
from pneuopt.identification.identify import identify
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.identification.tolerances import MAX_PREDICTION_SHARE
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Stribeck, Viscous
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares, solve_least_squares

TIME = np.arange(0, 4.0, 2e-3)
FORCE = 150 * np.sin(2 * np.pi * 1.3 * TIME) + 60 * np.sin(2 * np.pi * 3.1 * TIME + 1)
RANDOM_STEPS = 120 * np.sign(np.random.default_rng(3).standard_normal(40)).repeat(50)
NOISE = {"speed": 1e-3, "position": 1e-5}  # [m/s], [m]
FRICTION = {"friction.coulomb": 30.0, "friction.viscous": 80.0}
FREE = ("load.mass", "friction.viscous", "friction.coulomb")


def late(delay: float) -> Callable[[Array], Array]:
    return lambda force: np.interp(TIME - delay, TIME, force)


def log_of(
    model: FrictionModel | None = None,
    *,
    change: Callable[[Array], Array] = lambda force: force,
    sense: Callable[[Array], Array] = lambda signal: signal,
    force: Array = FORCE,
    output: str = "speed",
    **values: float,
) -> Experiment:
    """The log of a rig on which another force acts than the logged one, or another signal is logged than its own."""
    drive = ForceDrive(model or Coulomb())
    stated = FRICTION | {f"friction.{n}": v for n, v in values.items()}
    truth = drive.parameters.with_values({n: v for n, v in stated.items() if n in drive.parameters})
    driven = Trajectory(TIME, {"force": change(force)})
    run = simulate(drive.system(), driven, truth, intersample={"force": Intersample.LINEAR})
    noisy = sense(run[output]) + NOISE[output] * np.random.default_rng(0).standard_normal(TIME.size)
    return Experiment(Trajectory(TIME, {"force": force, output: noisy}), {output: NOISE[output]}, name="run")


def fit(log: Experiment, model: FrictionModel | None = None, free: tuple[str, ...] = FREE) -> IdentificationResult:
    drive = ForceDrive(model or Coulomb())
    return identify(drive.system(), log, drive.parameters.freed(*free), throw=False)


def explanation(result: IdentificationResult) -> str:
    """What the status says of explanations."""
    return next((s for s in result.status.sentences if "explains" in s), "")


def test_a_right_fit_predicts_its_log_and_stays_converged() -> None:
    result = fit(log_of())
    assert result.status.code is Code.CONVERGED
    assert result.stats["free_run_share"] < 0.01
    assert re.fullmatch(r"a free run misses speed by 0\.\d+% of the motion", result.status.verdict)
    assert not explanation(result)
    assert set(result.estimates["mark"]) <= {Mark.EXACT, Mark.WIDENED}


def test_a_fit_that_does_not_predict_its_log_is_a_misfit_and_says_so_first(tmp_path: Path) -> None:
    """The force acts 150 ms late, for longer than the motion's horizon; the mass that is found is thrice the rig's."""
    result = fit(log_of(change=late(0.15)))
    assert result.status.code is Code.MISFIT
    assert result.status.verdict.startswith("does not predict its own log: the free run misses speed by ")
    assert result.stats["free_run_share"] > MAX_PREDICTION_SHARE
    assert set(result.estimates["mark"]) <= {Mark.BIAS_POSSIBLE, Mark.UNIDENTIFIABLE}
    source, written = tmp_path / "drive.toml", tmp_path / "fit.toml"
    source.write_text('[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\n', encoding="utf-8")
    write_fit(written, source, result)
    (said, *_) = describe_status(read_fit(written))  # before `pneuopt tune --rig fit.toml`
    assert "its fit is converged, but the model misses the logs: does not predict its own log" in said


@pytest.mark.parametrize(
    ("log", "named"),
    [
        (lambda: log_of(Stribeck(), static=60.0, stribeck_velocity=0.05), "static friction above Coulomb's, "),
        (lambda: log_of(sense=lambda speed: speed + 0.1 * TIME - 0.2), "a straight line in time beside the outputs"),
    ],
    ids=["static", "line"],
)
def test_what_the_model_lacks_is_named_with_its_gain(log: Callable[[], Experiment], named: str) -> None:
    sentence = explanation(fit(log()))
    assert sentence.startswith(named)
    assert " of the misfit, the log-likelihood gains " in sentence


def test_an_offset_of_the_force_is_named_as_the_load_that_it_is() -> None:
    """A force that acts 20 N beside its log is a load of -20 N, which the plant has as a fixed value."""
    sentence = explanation(fit(log_of(change=lambda force: force + 20)))
    assert sentence.startswith("freeing load.force explains 100% of the misfit, with -20 N in place of 0 N")


@pytest.mark.parametrize(("delay", "force"), [(0.15, FORCE), (0.04, FORCE), (0.04, RANDOM_STEPS)])
def test_a_dead_time_that_the_model_lacks_is_named_to_a_twentieth(delay: float, force: Array) -> None:
    found = re.match(
        r"a dead time of ([\d.]+) ms explains 100% ", explanation(fit(log_of(change=late(delay), force=force)))
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(1e3 * delay, rel=0.05)


def test_a_drift_is_no_excuse_where_it_is_known_what_the_model_lacks() -> None:
    """A dead time: windows from fitted states hide it, and the mass that is found is 1.7 times the rig's."""
    result = fit(log_of(change=late(0.04), output="position"))
    assert result.status.code is Code.MISFIT
    assert result.status.verdict.startswith("does not predict its own log: the free run misses ")
    assert result.status.sentences[1].startswith("a dead time of ")


def test_friction_that_the_model_lacks_is_named_with_its_size() -> None:
    result = fit(log_of(), Viscous(), ("load.mass", "friction.viscous"))
    assert explanation(result).startswith("Coulomb friction, 30")


def test_a_fixed_value_that_is_wrong_is_named_before_what_looks_like_it() -> None:
    """A mass of 6.5 kg that is stated as 5 kg: a dead time explains four fifths of what that leaves."""
    drive = ForceDrive(Coulomb())
    run = simulate(
        drive.system(),
        Trajectory(TIME, {"force": FORCE}),
        drive.parameters.with_values(FRICTION | {"load.mass": 6.5}),
        intersample={"force": Intersample.LINEAR},
    )
    speed = run["speed"] + NOISE["speed"] * np.random.default_rng(0).standard_normal(TIME.size)
    log = Experiment(Trajectory(TIME, {"force": FORCE, "speed": speed}), {"speed": NOISE["speed"]}, name="run")
    assert "load.mass" in explanation(fit(log, free=FREE[1:]))


def test_nothing_is_named_where_nothing_explains_the_misfit() -> None:
    """A sensor that now and then shows a wave of its own: nothing in the plant does that."""
    wave = 0.1 * np.sin(400 * TIME) * (np.sin(5 * TIME) > 0.5)
    result = fit(log_of(sense=lambda speed: speed + wave))
    assert explanation(result).startswith("tried, but none explains the misfit: ")


def test_what_explains_is_not_tried_where_nobody_wants_it() -> None:
    drive, log = ForceDrive(Coulomb()), log_of(change=late(0.04), force=RANDOM_STEPS)
    result = identify(drive.system(), log, drive.parameters.freed(*FREE), explain=False, throw=False)
    assert not explanation(result)


def test_no_advice_is_given_by_rote() -> None:
    for log in (log_of(change=late(0.04), force=RANDOM_STEPS), log_of(change=late(0.15))):
        words = fit(log).status.message
        assert not [rote for rote in ("log more or longer", "check sensors", "richer model") if rote in words]


def test_a_position_that_drifts_away_is_excused_by_its_motion() -> None:
    """A small force that is not logged: over 4 s the position runs away from the log, and over its motion hardly."""
    drive = ForceDrive(Viscous())
    log = log_of(Viscous(), change=lambda force: force + 4 * np.sin(TIME), output="position", viscous=1.0)
    known = drive.parameters.with_values({"friction.viscous": 1.0})
    result = identify(drive.system(), log, known.freed("load.mass"), throw=False)
    assert result.stats["free_run_share"] > MAX_PREDICTION_SHARE
    assert result.status.code is Code.CONVERGED
    assert "the free run drifts away, " in result.status.message
    assert result.parameters.value("load.mass") == pytest.approx(known.value("load.mass"), rel=0.01)


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (1.65, "speed by 165% of the motion"),
        (32.0, "speed by 32 times the motion"),
        (np.inf, "far more than the motion"),
    ],
)
def test_a_share_is_written_to_scale(share: float, words: str) -> None:
    status = Prediction({"speed": share}, True, 0.1, {"speed": share}).assess(Status(Code.CONVERGED, ("found",)))
    assert words in status.verdict
    assert status.code is Code.MISFIT
    failed = Status(Code.NOT_CONVERGED, ("not found",))
    assert Prediction({"speed": share}, True, 0.1, {"speed": share}).assess(failed).code is Code.NOT_CONVERGED


def test_noise_alone_is_no_misfit() -> None:
    """A log of an axis that stands still: the free run misses all of the motion, which is noise."""
    drive = ForceDrive(Viscous())
    noise = 1e-3 * np.random.default_rng(0).standard_normal(TIME.size)
    log = Experiment(Trajectory(TIME, {"force": 0 * TIME, "speed": noise}), {"speed": 1e-3}, name="run")
    problem = EstimationProblem(drive.system(), (log,), drive.parameters.freed("load.mass"), LeastSquares())
    still = Trajectory(TIME, dict.fromkeys(("position", "speed"), 0 * TIME))
    found = solve_least_squares(problem.transcription(problem.candidates[0]), problem.method)
    predicted = predict_logs(problem, found, [still])
    assert not predicted.is_far
    said = predicted.assess(Status(Code.CONVERGED, ("found",))).sentences
    assert said == ("a free run follows the logs to their noise", "found")
