import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System
from pneuopt.identification.identify import identify
from pneuopt.identification.select_model import ModelSelection, _CandidateRow, _choose, select_model, try_candidate
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import FrictionModel, friction_ladder, usual_unknowns
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, UnknownNameError
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares

FREE = ("friction.coulomb", "friction.viscous", "friction.static", "friction.stribeck_velocity", "friction.*_asymmetry")
PAIR = ("friction.coulomb", "friction.viscous", "friction.*_asymmetry")
STATIC = {name: model for name, model in friction_ladder().items() if not model.states}


def systems() -> dict[str, System]:
    return {name: MotionDrive(model, chamber=False).system() for name, model in STATIC.items()}


def moved(model: FrictionModel, seed: int, n: int = 1500, values: Mapping[str, float] | None = None) -> Experiment:
    """Speeds of both directions, slow and fast, and the friction force with 0.5 N of noise."""
    rng = np.random.default_rng(seed)
    v = np.sign(np.sin(np.arange(n) / 40)) * np.exp(rng.uniform(np.log(1e-3), np.log(0.3), n))
    drive = MotionDrive(model, chamber=False)
    truth = drive.parameters.with_values(values or {})
    system = drive.system()
    p = [truth.value(name) for name in system.parameters]
    force = np.array([float(system.ode(0, [], [speed], p)[1]) for speed in v])
    t = np.arange(n) * 1e-3
    return Experiment(Trajectory(t, {"speed": v, "force": force + 0.5 * rng.standard_normal(n)}), {"force": 0.5})


def chosen(model: FrictionModel, values: Mapping[str, float] | None = None, held_out: bool = False) -> ModelSelection:
    runs = [moved(model, seed, values=values) for seed in (1, 2)]
    others = [moved(model, 3, values=values)] if held_out else []
    return select_model(systems(), runs, ParameterSet(), free=FREE, held_out=others)


@pytest.mark.parametrize(
    ("truth", "values"),
    [
        ("coulomb", {}),
        ("asymmetric coulomb", {"friction.coulomb_asymmetry": 0.1}),
        ("stribeck", {}),
        ("asymmetric stribeck", {"friction.coulomb_asymmetry": 0.1, "friction.viscous_asymmetry": -0.2}),
    ],
)
def test_the_model_that_made_the_log_is_recommended(truth: str, values: dict[str, float]) -> None:
    found = chosen(STATIC[truth], values, held_out=True)
    assert found.recommended == truth
    assert found.reason.startswith(f"{truth}, of ")
    columns = found.table.to_dict()
    assert columns["converged"][truth]
    assert columns["bic_above"][truth] == 0
    # its residuals are noise: as many squares as independent samples
    assert columns["deviance"][truth] == pytest.approx(3000, rel=0.1)


def test_what_is_left_out_is_rejected_in_numbers() -> None:
    found = chosen(STATIC["stribeck"])
    columns = found.table.to_dict()
    assert columns["contains"]["stribeck"] == "coulomb"
    assert columns["p_value"]["stribeck"] < 1e-6
    assert "the simpler coulomb is rejected" in found.reason
    assert columns["deviance"]["coulomb"] > 2 * columns["deviance"]["stribeck"]


def test_idle_terms_are_rarely_believed() -> None:
    """On Coulomb data the test of nested models errs about as rarely as its level says."""
    drives = {n: MotionDrive(STATIC[n], chamber=False).system() for n in ("coulomb", "asymmetric coulomb")}
    picked = [
        select_model(drives, [moved(STATIC["coulomb"], seed, 300)], ParameterSet(), free=PAIR).recommended
        for seed in range(20)
    ]
    assert picked.count("coulomb") >= 18  # at 1 %, three errors in 20 have a probability of 0.1 %


def test_a_richer_model_that_predicts_worse_is_passed_over() -> None:
    made, other = STATIC["asymmetric coulomb"], {"friction.coulomb_asymmetry": -0.2}
    pair = {n: MotionDrive(STATIC[n], chamber=False).system() for n in ("coulomb", "asymmetric coulomb")}
    run = moved(made, 1, values={"friction.coulomb_asymmetry": 0.2})
    found = select_model(pair, [run], ParameterSet(), free=PAIR, held_out=[moved(made, 2, values=other)])
    assert found.recommended == "coulomb"
    assert "predict the held-out runs worse" in found.reason


ANTI = {"friction.static": 20.0, "friction.coulomb": 30.0}


def test_static_friction_below_coulomb_friction_is_not_recommended() -> None:
    """Friction that rises with the speed at first, as presliding does: an anti-Stribeck curve fits it best."""
    run = moved(STATIC["stribeck"], 1, values=ANTI)
    pair = {n: systems()[n] for n in ("coulomb", "stribeck")}
    limitless = {
        n: replace(s, identification_hints=replace(s.identification_hints, at_least={})) for n, s in pair.items()
    }
    assert select_model(limitless, run, ParameterSet(), free=FREE[:4]).recommended == "stribeck"
    found = select_model(pair, run, ParameterSet(), free=FREE[:4])
    assert found.recommended == "coulomb"
    said = found.table["unphysical"]["stribeck"]
    assert said.startswith("friction.static (2")
    assert "below friction.coulomb (" in said
    assert f"refuted: stribeck ({said})" in found.reason


def test_presliding_is_coulomb_friction_whose_width_is_estimated() -> None:
    """Friction that builds up over 4 mm/s: a tie, which the law with fewer parameters decides for itself."""
    run = moved(STATIC["presliding"], 1, values={"friction.presliding_speed": 4e-3, "friction.coulomb": 30.0})
    free = (*FREE, "friction.presliding_speed")
    found = select_model(systems(), run, ParameterSet(), free=free)
    assert found.recommended == "coulomb", found
    assert found.table["bic"]["presliding"] == pytest.approx(found.table["bic"]["coulomb"], abs=6.0)
    assert found.fits["coulomb"].parameters.value("friction.smoothing") == pytest.approx(4e-3, rel=0.1)


def test_a_candidate_at_its_bound_is_not_recommended() -> None:
    pair = {n: systems()[n] for n in ("viscous", "coulomb")}
    own = pair["coulomb"].parameters.select(FREE[:2])
    own = own.with_values({"friction.coulomb": 20.0}).with_bounds({"friction.coulomb": (0.0, 25.0)})
    found = select_model(pair, moved(STATIC["coulomb"], 1), own, free=FREE[:2])
    assert found.table["at_bound"]["coulomb"] == "friction.coulomb"
    assert found.recommended == "viscous"
    assert "refuted: coulomb (friction.coulomb at a bound)" in found.reason
    twice = dict.fromkeys(("coulomb", "again"), pair["coulomb"])
    only = select_model(twice, moved(STATIC["coulomb"], 1), own, free=FREE[:2])
    assert "no candidate is without a defect, nor is this one: friction.coulomb at a bound" in only.reason


def test_a_tie_is_decided_by_held_out_runs_and_the_reason_says_what_would_separate_the_two() -> None:
    rows = {
        "rich": row(free=4, deviance=1000.0, bic=1030.0, held_out=0.20),
        "simple": row(free=3, deviance=1010.0, bic=1033.0, held_out=0.10),
    }
    assert _choose(rows) == ("simple", "as held-out runs decide between it and rich, whose BIC is within 6")
    level = {n: replace(r, held_out_nrmse=0.1) for n, r in rows.items()}
    assert _choose(level) == ("simple", "as rich, whose BIC is within 6, has more parameters and predicts no better")
    apart = {**level, "simple": replace(level["simple"], bic=1040.0)}
    assert _choose(apart) == ("rich", "")
    run = moved(STATIC["coulomb"], 1, 300)
    pair = {n: systems()[n] for n in ("coulomb", "presliding")}
    found = select_model(pair, run, ParameterSet(), free=(*FREE[:2], "friction.presliding_speed"))
    assert found.recommended == "coulomb"


def row(*, free: int, deviance: float, bic: float, held_out: float) -> _CandidateRow:
    return _CandidateRow(True, False, free, deviance, bic, "", math.nan, held_out, "", "", "", "")


FORCED = {"load.mass": 5.0, "load.force": 0.0}


def stick_slip(model: FrictionModel, seconds: float = 1.5) -> Experiment:
    """A load that slides, sticks and turns under a known force, at 500 Hz, with 20 um of noise."""
    drive = ForceDrive(model)
    t = np.arange(0, seconds, 2e-3)
    force = 60 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t)
    held = {"force": Intersample.HELD}
    run = simulate(
        drive.system(), Trajectory(t, {"force": force}), drive.parameters.with_values(FORCED), intersample=held
    )
    noisy = run["position"] + 2e-5 * np.random.default_rng(0).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"force": force, "position": noisy}), {"position": 2e-5}, name="stick-slip")
    return log.with_intersample(held)


def selected(truth: str, *others: str) -> ModelSelection:
    """The choice among some laws by a log that the first one has made, with the mass known."""
    ladder = friction_ladder()
    systems = {n: ForceDrive(ladder[n]).system() for n in (truth, *others)}
    free = [n for n in usual_unknowns() if any(n in s.parameters for s in systems.values())]
    return select_model(systems, stick_slip(ladder[truth]), ParameterSet(), free=free)


def test_hopeless_models_are_refuted_by_short_searches_and_do_not_cut_the_logs() -> None:
    """Viscous friction alone follows windows of 20 ms at most, in which nothing tells the others apart."""
    found = selected("stribeck", "viscous", "coulomb", "asymmetric stribeck")
    assert found.recommended == "stribeck"
    assert set(found.fits) == {"stribeck", "asymmetric stribeck"}
    assert all(fit.window is None for fit in found.fits.values())
    assert found.fits["asymmetric stribeck"].provenance["start"] == "a given fit"
    columns = found.table.to_dict()
    for name in ("viscous", "coulomb"):
        assert not columns["converged"][name]
        assert columns["deviance"][name] > 4 * columns["deviance"]["stribeck"]
        assert "short searches with loose gaps leave" in columns["message"][name]
        assert columns["refuted"][name]
    shown = " ".join(str(found.summary()).split())
    assert "refuted: short searches" in shown
    assert "not converged" not in shown
    assert columns["contains"]["stribeck"] == "coulomb"
    assert columns["p_value"]["stribeck"] < 1e-6
    assert "refuted: " in found.reason


def test_bristles_that_made_the_log_are_recommended() -> None:
    found = selected("lugre", "coulomb", "stribeck")
    assert found.recommended == "lugre"
    assert set(found.fits) == {"lugre"}


def test_a_short_search_leaves_no_more_squares_than_the_whole_one() -> None:
    """So what it leaves is a bound: gaps only relax a fit."""
    ladder = friction_ladder()
    log, free = stick_slip(ladder["stribeck"]), ("friction.coulomb", "friction.viscous")
    for name in ("coulomb", "stribeck"):
        drive = ForceDrive(ladder[name])
        given = drive.parameters.with_values(FORCED).freed(*free)
        trial = try_candidate(drive.system(), [log], given, LeastSquares())
        whole = identify(drive.system(), log, given, window=math.inf, throw=False)
        assert whole.window is None
        assert trial.least <= trial.squares <= 2 * whole.stats["cost"] * (1 + 1e-6), name


def test_bad_input_is_named() -> None:
    run, two = (
        moved(STATIC["coulomb"], 1, 100),
        {n: MotionDrive(STATIC[n], chamber=False).system() for n in ("viscous", "coulomb")},
    )
    with pytest.raises(InputError, match="1 candidate leaves nothing to select"):
        select_model({"coulomb": two["coulomb"]}, [run], ParameterSet(), free=FREE[:2])
    with pytest.raises(UnknownNameError, match=r"friction\.colomb"):
        select_model(two, [run], ParameterSet(), free=["friction.colomb"])


def test_none_converged_is_an_error_with_every_result() -> None:
    """At one speed no level can be separated from a slope."""
    pair = {n: MotionDrive(STATIC[n], chamber=False).system() for n in ("coulomb", "stribeck")}
    run = moved(STATIC["coulomb"], 1, 100)
    steady = Experiment(Trajectory(run.trajectory.t, {**run.trajectory.values, "speed": np.full(100, 0.1)}), run.noise)
    with pytest.raises(ConvergenceError, match="none of the candidates converged: coulomb: ") as caught:
        select_model(pair, [steady], ParameterSet(), free=PAIR[:2])
    assert set(caught.value.solution) == {"coulomb", "stribeck"}


def test_a_candidate_with_unidentifiable_parameters_gives_way_to_a_simpler_one_that_fits_as_well() -> None:
    """All speeds are far beyond the Stribeck velocity; the reason and the table name what is unidentifiable."""
    pair = {n: MotionDrive(STATIC[n], chamber=False).system() for n in ("stribeck", "coulomb")}
    run = moved(STATIC["coulomb"], 1, 300)
    fast = Experiment(Trajectory(run.trajectory.t, fast_channels(run)), run.noise)
    found = select_model(pair, [fast], ParameterSet(), free=FREE[:4])
    assert found.recommended == "coulomb"
    columns = found.table.to_dict()
    assert columns["converged"]["stribeck"]
    assert columns["unidentifiable"]["stribeck"] == "friction.static, friction.stribeck_velocity"
    assert columns["unidentifiable"]["coulomb"] == columns["at_bound"]["coulomb"] == ""
    assert found.reason.startswith("coulomb, of 2 converged candidates, has the lowest BIC")
    assert "not tell" not in found.reason
    only = select_model({"stribeck": pair["stribeck"], "also": pair["stribeck"]}, [fast], ParameterSet(), free=FREE[:4])
    assert only.reason.endswith("; the logs do not identify its friction.static, friction.stribeck_velocity")


def fast_channels(run: Experiment) -> dict[str, Array]:
    """Speeds of 0.3 to 0.6 m/s, both ways, and the Coulomb drive's friction there."""
    rng = np.random.default_rng(0)
    v = np.sign(run.trajectory["speed"]) * rng.uniform(0.3, 0.9, len(run.trajectory.t))
    drive = MotionDrive(STATIC["coulomb"], chamber=False)
    system = drive.system()
    p = [drive.parameters.value(name) for name in system.parameters]
    force = np.array([float(system.ode(0, [], [speed], p)[1]) for speed in v])
    return {"speed": v, "force": force + 0.5 * rng.standard_normal(v.size)}
