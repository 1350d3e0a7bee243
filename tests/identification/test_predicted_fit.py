"""The fit that begins where the prediction errors of a filter lead."""

import math
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.simulate import simulate
from pneuopt.identification import multistart, predicted_fit
from pneuopt.identification.checks import check_logs
from pneuopt.identification.excerpts import filter_states
from pneuopt.identification.losses import Huber
from pneuopt.identification.multistart import fit_from_starts
from pneuopt.identification.predicted_fit import fit_from_predictions
from pneuopt.identification.problem import EstimationProblem
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Stribeck
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.equations import ParameterScaling
from pneuopt.shooting.least_squares import CpuBudget, Fit, LeastSquares, SearchEnd
from pneuopt.shooting.segments import segment

STATIC, VELOCITY = "friction.static", "friction.stribeck_velocity"
TRUTH = {"friction.coulomb": 30.0, STATIC: 50.0, VELOCITY: 0.01, "friction.viscous": 60.0}
NOISE = 2e-6  # [m]

END = SearchEnd.ABANDONED


def posed(friction: FrictionModel, *, disturbance: float = 0.0) -> EstimationProblem:
    """A second of a drive that sticks and slips, at 1 kHz; a disturbance [N] is in no model."""
    drive, t = ForceDrive(friction), np.arange(1000) * 1e-3
    free = [n for n in TRUTH if n in drive.parameters]
    truth = drive.parameters.with_values({"load.mass": 3.0} | {n: TRUTH[n] for n in free})
    force = 60 * np.sin(2 * np.pi * 1.3 * t) + 15 * np.sin(2 * np.pi * 4.1 * t)
    unknown = force + disturbance * np.sign(np.sin(2 * np.pi * 7 * t))
    run = simulate(drive.system(), Trajectory(t, {"force": unknown}), truth, intersample={"force": Intersample.LINEAR})
    position = run["position"] + NOISE * np.random.default_rng(0).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"force": force, "position": position}), {"position": NOISE}, name="run")
    given = truth.with_values({n: drive.parameters.value(n) for n in free}).freed(*free)
    return EstimationProblem(drive.system(), tuple(check_logs(drive.system(), [log], given)), given, LeastSquares())


def spoil(problem: EstimationProblem) -> None:
    """Give all starts less static friction and other velocities than the logs show, as too long a filter does."""
    guesses = [c for c in problem.candidates() if c.trial_parameters]
    assert len(guesses) > 2
    spoilt = [replace(c, parameters={**c.parameters, STATIC: 1.05 * c.parameters["friction.coulomb"]}) for c in guesses]
    problem.__dict__["_candidates"] = spoilt


def test_it_finds_what_the_starts_miss(monkeypatch: pytest.MonkeyPatch) -> None:
    lines, deviations = list[str](), list[float]()

    def filtered(problem: EstimationProblem, start: Start, gathered: float) -> Start:
        deviations.append(gathered)
        return filter_states(problem, start, gathered)

    monkeypatch.setattr(predicted_fit, "filter_states", filtered)
    problem = replace(posed(Stribeck()), method=LeastSquares(progress=lines.append))
    spoil(problem)
    fit = fit_from_predictions(problem, 3.0)
    assert len([line for line in lines if line.startswith("prediction errors")]) == len(predicted_fit.LEVELS)
    assert fit is not None
    assert fit.status.converged
    assert deviations == [problem.method.stages[-1].gap]  # with ten times that, a slip was lost, and the search with it
    assert fit.chi_square < 1.05 * fit.count
    for name, value in TRUTH.items():
        assert fit.parameters.value(name) == pytest.approx(value, rel=5e-3)


def test_a_model_that_cannot_predict_the_log_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six seconds of filters, and the search would show only that the model is wrong."""
    problem = posed(Stribeck(), disturbance=40.0)
    monkeypatch.setattr(predicted_fit, "filter_states", lambda *_: pytest.fail("the search would begin"))
    assert fit_from_predictions(problem, 3.0) is None


@pytest.mark.parametrize("case", ["no guesses", "a hole", "windows", "weights"])
def test_what_a_filter_cannot_follow_is_left_to_the_starts(case: str) -> None:
    problem = posed(Coulomb() if case == "no guesses" else Stribeck())
    (log,) = problem.experiments
    if case == "a hole":
        problem = replace(problem, experiments=(replace(log, holes=((300, 500),)),))
        problem.__dict__["_candidates"] = posed(Stribeck()).candidates()
    elif case == "windows":
        problem = replace(problem, window=0.2)
    elif case == "weights":
        problem = replace(problem, weights={"run": np.ones((1000, 1))})
    assert fit_from_predictions(problem, 3.0) is None


def test_the_end_of_the_budget_ends_the_filter() -> None:
    problem = posed(Stribeck())
    spent = CpuBudget(1e9)
    spent._end = -math.inf
    problem = replace(problem, method=replace(problem.method, budget=spent))
    with pytest.raises(KeyboardInterrupt):
        fit_from_predictions(problem, 3.0)


def test_each_guess_is_tried_with_each_ratio_and_no_two_neighbours_descend() -> None:
    problem = posed(Stribeck())
    guesses = [c for c in problem.candidates() if c.trial_parameters]
    found = dict(predicted_fit._hypotheses(guesses, {STATIC: "friction.coulomb"}))
    assert len(found) == len(guesses) * len(predicted_fit.RATIOS)
    velocities = [found[i, 0].parameters[VELOCITY] for i in range(len(guesses))]
    assert velocities == sorted(velocities)
    for (_, j), start in found.items():
        ratio = start.parameters[STATIC] / start.parameters["friction.coulomb"]
        assert ratio == pytest.approx(predicted_fit.RATIOS[j])
    places, target = list(found), (1, 2)
    costs = np.array([math.dist(place, target) for place in places])
    errors = SimpleNamespace(evaluate=lambda *_: SimpleNamespace(costs=costs))
    best = predicted_fit._best_sets(errors, list(found.items()), problem)  # type: ignore[arg-type]
    own = [ParameterScaling(problem.transcription(start)).start.tolist() for start in found.values()]
    chosen = [places[own.index(z.tolist())] for z in best]
    assert len(chosen) == predicted_fit.BEST
    assert chosen[0] == target
    assert all(max(abs(i - k), abs(j - m)) > 1 for (i, j), (k, m) in combinations(chosen, 2))


def test_the_part_is_the_liveliest() -> None:
    problem, before = posed(Stribeck()), predicted_fit.PART_SEGMENTS
    (log,) = problem.experiments
    position = log.trajectory["position"].copy()
    position[:600] = position[600]
    still = replace(log, trajectory=log.trajectory.with_columns({"position": position}))
    problem = replace(problem, experiments=(still,))
    segments = segment(problem.transcription(posed(Stribeck()).candidates()[0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(predicted_fit, "PART_SEGMENTS", 30)
        part = predicted_fit._liveliest(segments, problem)
    assert len(part) == 30
    assert part[0] >= 45
    assert (np.diff(part) == 1).all()
    assert len(predicted_fit._liveliest(segments, problem)) == min(before, segments.count)


@pytest.mark.parametrize("fault", ["residuals", "order", "status"])
def test_a_fit_that_is_no_answer_is_left_for_the_other_starts(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ended at the noise with static friction next to Coulomb's, which the logs showed to be far above."""
    problem, search = posed(Stribeck()), multistart.fit_holding_unidentifiable
    _, fit = search(problem, problem.candidates()[0])
    wrong = {
        "residuals": replace(fit, chi_square=2.0 * fit.count),
        "order": replace(fit, parameters=fit.parameters.with_values({STATIC: 1.02 * TRUTH["friction.coulomb"]})),
        "status": replace(fit, status=Status(Code.NOT_CONVERGED)),
    }[fault]
    left = replace(fit, end=END, status=END.status)
    monkeypatch.setattr(multistart, "fit_from_predictions", lambda *_: fit)
    assert multistart._fit_predicted(problem, left) is not None
    assert multistart._fit_predicted(problem, fit) is None
    monkeypatch.setattr(multistart, "fit_from_predictions", lambda *_: wrong)
    assert multistart._fit_predicted(problem, left) is None


def test_ctrl_c_ends_all_with_the_first_start(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, search = posed(Stribeck()), multistart.fit_holding_unidentifiable
    _, fit = search(problem, problem.candidates()[0])
    left, cut = (
        replace(fit, end=END, status=END.status),
        replace(fit, status=Status(Code.INTERRUPTED)),
    )
    monkeypatch.setattr(multistart, "fit_holding_unidentifiable", lambda *_: (problem, left))
    monkeypatch.setattr(multistart, "fit_from_predictions", lambda *_: cut)
    _, best, label = fit_from_starts(problem)
    assert best.status.code is Code.INTERRUPTED
    assert "the best of 1 starts so far" in best.status.message
    assert "prediction" not in label


@pytest.mark.parametrize(("left", "robust", "tried"), [(True, False, True), (False, False, False), (True, True, False)])
def test_it_is_tried_where_the_first_start_is_left(
    left: bool, robust: bool, tried: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the other starts settle, of which none explains a log that sticks and slips."""
    problem, calls, search = posed(Stribeck()), list[float](), multistart.fit_holding_unidentifiable

    def first(posed: EstimationProblem, start: Start, *given: float) -> tuple[EstimationProblem, Fit]:
        held, fit = search(posed, start)
        left_now = left and not calls
        return held, replace(fit, end=END, status=END.status) if left_now else fit

    def predicted(posed: EstimationProblem, max_misfit: float) -> Fit:
        calls.append(max_misfit)
        return search(posed, posed.candidates()[0])[1]

    monkeypatch.setattr(multistart, "fit_holding_unidentifiable", first)
    monkeypatch.setattr(multistart, "fit_from_predictions", predicted)
    held, fit, label = fit_from_starts(problem, Huber() if robust else None)
    assert bool(calls) == tried
    assert ("by prediction errors" in label) == tried
    if tried:
        assert fit.status.code is Code.CONVERGED
        assert not held.held
