"""The order of starts: the model's first, then all, settled with their guesses held."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.system import discretise, parameter_vector
from pneuopt.identification import multistart as starting
from pneuopt.identification.checks import check_logs
from pneuopt.identification.identify import identify
from pneuopt.identification.multistart import fit_holding_unidentifiable
from pneuopt.identification.problem import EstimationProblem
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Stribeck
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares, SearchEnd, Stage, solve_least_squares
from pneuopt.shooting.transcription import Transcription

VELOCITY = "friction.stribeck_velocity"
TRUTH = {"friction.coulomb": 30.0, "friction.static": 42.0, VELOCITY: 0.012, "friction.viscous": 60.0}


def free(friction: FrictionModel) -> ParameterSet:
    own = ForceDrive(friction).parameters
    return own.freed(*(n for n in TRUTH if n in own))


def posed(friction: FrictionModel) -> EstimationProblem:
    """Half a second of a pushed drive that turns, sticks and slips."""
    system, t = ForceDrive(friction).system(), np.arange(500) * 1e-3
    force = 60 * np.sin(2 * np.pi * 4 * t)
    p = parameter_vector(
        system.parameters, system.parameters.with_values({n: v for n, v in TRUTH.items() if n in free(friction)})
    )
    run = Rollout(discretise(system).pieces).run(
        np.zeros((1, 2)), force[None, :, None], p, t[None], np.full((1, 500), 1e-3), substeps=40
    )
    position = run.y[0, :, 0] + 1e-5 * np.random.default_rng(3).standard_normal(500)
    log = Experiment(Trajectory(t, {"force": force, "position": position}), {"position": 1e-5}, name="run")
    return EstimationProblem(system, tuple(check_logs(system, [log], free(friction))), free(friction), LeastSquares())


def test_the_first_start_costs_nothing_more() -> None:
    problem = posed(Stribeck())
    first = next(starting.starts_by_cost(problem))
    assert first.label == problem.candidates()[0].label
    assert first.trial_parameters == (VELOCITY,)


def test_the_others_settle_with_their_guess_held_and_come_by_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    reached: list[tuple[float, float]] = []  # wider gaps lower the cost of any start

    def spied(transcription: Transcription, method: LeastSquares) -> Fit:
        fit = solve_least_squares(transcription, method)
        reached.append((fit.stats["gap_deviation"], fit.stats["cost"]))
        return fit

    monkeypatch.setattr(starting, "solve_least_squares", spied)
    problem = posed(Stribeck())
    candidates = problem.candidates()
    _, *settled = starting.starts_by_cost(problem)
    order = [candidates[i].parameters[VELOCITY] for i in sorted(range(len(reached)), key=reached.__getitem__)]
    assert [s.parameters[VELOCITY] for s in settled] == order
    assert all(s.label.endswith("settled") for s in settled)
    assert settled[0].parameters["friction.coulomb"] == pytest.approx(30, rel=0.05)


def test_a_start_that_explains_the_log_as_it_settles_comes_before_the_others_settle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, settled = posed(Stribeck()), list[str]()
    first, second, third, *others = problem.candidates()

    def settle(problem: EstimationProblem, start: Start, stages: int) -> tuple[tuple[float, float], Start, bool]:
        settled.append(start.label)
        return (1e-3, -float(len(settled))), start, start.label == third.label

    monkeypatch.setattr(starting, "_settle_start", settle)
    starts = starting.starts_by_cost(problem)
    labels = [next(starts).label, next(starts).label]
    assert labels == [first.label, third.label]
    assert settled == [first.label, second.label, third.label]
    assert [s.label for s in starts] == [*(s.label for s in reversed(others)), second.label, first.label]


@pytest.mark.parametrize(
    ("candidate", "stages", "accepted", "explains"),
    [
        (-1, starting.GUESS_STAGES, 1.5, True),  # 1.13 squares a sample
        (-1, starting.GUESS_STAGES, 1.05, False),
        (-1, 1, 1.5, False),  # with wide gaps all starts explain the log
        (1, starting.GUESS_STAGES, 1.05, True),  # 1.006; noise of the states would have left .92 by wide gaps
    ],
)
def test_a_start_explains_the_log_by_tight_gaps_only(
    candidate: int, stages: int, accepted: float, explains: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = posed(Stribeck())
    monkeypatch.setattr(starting, "ACCEPTED_CHI_SQUARE_RATIO", accepted)
    assert starting._settle_start(problem, problem.candidates()[candidate], stages)[2] == explains


def test_the_others_settle_by_no_more_stages_than_the_first_start_had() -> None:
    problem = posed(Stribeck())
    fit = solve_least_squares(problem.transcription(problem.candidates()[0]), problem.method)
    left = [
        replace(
            fit, end=SearchEnd.ABANDONED, status=SearchEnd.ABANDONED.status, stats={**fit.stats, "gap_deviation": gap}
        )
        for gap in (1e-2, 1e-4)
    ]
    assert [starting._stages_before_left(problem, each) for each in (*left, fit)] == [1, 5, 0]


def test_without_guesses_the_candidates_are_tried_as_they_are() -> None:
    assert [s.label for s in starting.starts_by_cost(posed(Coulomb()))] == ["equation error"]


def test_an_interruption_keeps_the_best_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(problem: EstimationProblem, *_: Callable[[], bool]) -> Iterator[Start]:
        wrong = problem.candidates()[0]
        yield Start(wrong.states, {**wrong.parameters, "friction.coulomb": 3.0})
        raise KeyboardInterrupt

    monkeypatch.setattr(starting, "starts_by_cost", interrupted)
    problem = posed(Stribeck())
    hasty = LeastSquares(stages=(Stage(1e-2, 1),))
    result = identify(
        ForceDrive(Stribeck()).system(), problem.experiments, problem.parameters, method=hasty, throw=False
    )
    assert result.status.code is Code.INTERRUPTED
    assert "best of 1 starts" in result.status.message


def test_an_interruption_keeps_an_earlier_and_better_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second start, far off, is interrupted with its gaps still loose: its cost is low, but says nothing."""
    armed: list[bool] = []

    def progress(line: str) -> None:
        if armed:
            raise KeyboardInterrupt

    def two(problem: EstimationProblem, *_: Callable[[], bool]) -> Iterator[Start]:
        good = problem.candidates()[0]
        yield good
        armed.append(True)
        yield Start(good.states, {**good.parameters, "friction.coulomb": 3.0}, "far off")

    monkeypatch.setattr(starting, "starts_by_cost", two)
    monkeypatch.setattr(starting, "explains_to_noise", lambda *_: False)
    problem, method = posed(Coulomb()), LeastSquares(progress=progress)
    system = ForceDrive(Coulomb()).system()
    result = identify(system, problem.experiments, problem.parameters, method=method, throw=False)
    assert result.status.code is Code.INTERRUPTED
    assert "the best of 2 starts so far" in result.status.message
    assert result.provenance["start"] != "far off"
    assert result.fit["nrmse"].max() < 0.01


def test_a_refit_is_taken_only_where_the_logs_do_not_reject_its_held_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the given value the sum of squares rises by 20; where the search had left the parameter, it does not."""
    problem = posed(Coulomb())
    start = problem.candidates()[0]
    good = solve_least_squares(problem.transcription(start), problem.method)
    first = replace(good, unidentifiable=("friction.viscous",))
    worse = replace(good, chi_square=good.chi_square + 20, stats={**good.stats, "cost": good.stats["cost"] + 10})
    refits = {True: worse, False: good}

    def hold(problem: EstimationProblem, label: str, first: Fit, *, is_given: bool) -> tuple[EstimationProblem, Fit]:
        return replace(problem, held={"friction.viscous": float(is_given)}), refits[is_given]

    status = Status(Code.NOT_CONVERGED, ("the data do not determine friction.viscous",))
    monkeypatch.setattr(starting, "solve_least_squares", lambda *_: replace(first, status=status))
    monkeypatch.setattr(starting, "_hold_unidentifiable", hold)
    held, fit = starting.fit_holding_unidentifiable(problem, start)
    assert fit is good
    assert held.held == {"friction.viscous": 0.0}
    refits[False] = worse
    held, fit = starting.fit_holding_unidentifiable(problem, start)
    assert held.held == {}
    assert fit.status == status


def test_a_start_that_is_too_stiff_to_be_searched_holds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A one-way log has proposed a static friction of a hundred times Coulomb's: the holding never ended."""
    calls = 0

    def counted(transcription: Transcription, method: LeastSquares) -> Fit:
        nonlocal calls
        calls += 1
        assert calls < 5
        return solve_least_squares(transcription, method)

    monkeypatch.setattr(starting, "solve_least_squares", counted)
    problem = posed(Stribeck())
    start = problem.candidates()[0]
    stiff = replace(start, parameters={**start.parameters, "friction.static": 5e4, VELOCITY: 0.004})
    held, fit = starting.fit_holding_unidentifiable(problem, stiff)
    assert "so stiff that a sample takes" in fit.status.verdict
    assert (dict(held.held), fit.unidentifiable, calls) == ({}, (), 1)


def test_a_start_that_converged_is_confirmed_before_the_others_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a model that misses its log a little two starts agree; settling the others costs six times as much."""
    problem, labels = posed(Stribeck()), list[str]()

    def noted(
        problem: EstimationProblem, start: Start, most: float, known: tuple[tuple[float, float], ...]
    ) -> tuple[EstimationProblem, Fit]:
        labels.append(start.label)
        return fit_holding_unidentifiable(problem, start, most, known)

    monkeypatch.setattr(starting, "explains_to_noise", lambda *_: False)
    monkeypatch.setattr(starting, "fit_holding_unidentifiable", noted)
    monkeypatch.setattr(starting, "_settle_start", lambda *_: pytest.fail("settled"))
    assert starting.fit_from_starts(problem)[1].status.converged
    assert labels == [c.label for c in problem.candidates()[:2]]


@pytest.mark.parametrize(("window", "segment", "stages"), [(math.inf, 0.01, starting.GUESS_STAGES), (0.1, 0.1, 1)])
def test_guesses_are_settled_once_where_no_gap_tightens(
    window: float, segment: float, stages: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, run = posed(Stribeck()), list[int]()

    def counted(transcription: Transcription, method: LeastSquares) -> Fit:
        run.append(len(method.stages))
        return solve_least_squares(transcription, method)

    monkeypatch.setattr(starting, "solve_least_squares", counted)
    method = replace(problem.method, segment_time=segment)
    found = list(starting.starts_by_cost(replace(problem, window=window, method=method)))
    assert len(found) > 1
    assert set(run) == {stages}


def test_a_first_start_that_is_far_off_waits_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a rig that hunts, the search from the first of six starts went on for a minute; another one had the answer."""
    problem, stages = posed(Stribeck()), list[int]()
    good = problem.candidates()
    far = {"friction.coulomb": 4.0, "friction.static": 4.0, "friction.viscous": 500.0, VELOCITY: 0.5}

    def counted(transcription: Transcription, method: LeastSquares) -> Fit:
        fit = solve_least_squares(transcription, method)
        stages.append(1 if fit.end is SearchEnd.ABANDONED else len(method.stages))
        return fit

    monkeypatch.setattr(starting, "solve_least_squares", counted)
    monkeypatch.setattr(EstimationProblem, "candidates", lambda _: [replace(good[0], parameters=far), *good[1:]])
    monkeypatch.setattr(starting, "HOPELESS_MISFIT", 0.0)
    _, fit, label = starting.fit_from_starts(problem)
    assert fit.status.converged
    right = solve_least_squares(problem.transcription(good[0]), problem.method)
    assert fit.stats["cost"] == pytest.approx(right.stats["cost"], rel=1e-3)
    assert label.endswith("settled")
    assert stages[: len(good) + 1] == [1] * (len(good) + 1)
    assert len(stages) > len(good) + 1


def test_a_lone_start_that_is_far_off_is_searched_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, tried = posed(Stribeck()), list[str]()
    first = problem.candidates()[0]

    def noted(transcription: Transcription, method: LeastSquares) -> Fit:
        fit = solve_least_squares(transcription, method)
        tried.append(fit.status.verdict)
        return fit

    monkeypatch.setattr(starting, "solve_least_squares", noted)
    monkeypatch.setattr(EstimationProblem, "candidates", lambda _: [first])
    monkeypatch.setattr(starting, "HOPELESS_MISFIT", 0.0)
    _, fit, _ = starting.fit_from_starts(problem)
    assert fit.status.converged
    assert tried == [SearchEnd.ABANDONED.status.verdict, fit.status.verdict]


def test_a_fit_at_the_noise_that_leaves_one_parameter_unsettled_takes_one_more_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All starts used to be settled and searched, for minutes, before that parameter was held."""
    problem, labels = posed(Stribeck()), list[str]()

    def unsettled(problem: EstimationProblem, start: Start, *_: object) -> tuple[EstimationProblem, Fit]:
        labels.append(start.label)
        fit = solve_least_squares(problem.transcription(start), problem.method)
        status = Status(Code.NOT_CONVERGED, (f"{VELOCITY} would still move by 14 standard deviations",))
        return problem, replace(fit, status=status, unsettled=(VELOCITY,))

    monkeypatch.setattr(starting, "fit_holding_unidentifiable", unsettled)
    monkeypatch.setattr(starting, "ACCEPTED_CHI_SQUARE_RATIO", 2.0)  # this log has 1.6
    monkeypatch.setattr(starting, "_settle_start", lambda *_: pytest.fail("settled"))
    held, fit, _ = starting.fit_from_starts(problem)
    assert fit.status.converged
    assert set(held.held) == {VELOCITY}
    assert labels == [c.label for c in problem.candidates()[:2]]


def test_a_start_that_joins_the_best_confirms_it(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, known = posed(Stribeck()), list[object]()

    def joined(
        problem: EstimationProblem, start: Start, most: float, costs: tuple[tuple[float, float], ...]
    ) -> tuple[EstimationProblem, Fit]:
        known.append(costs)
        held, fit = fit_holding_unidentifiable(problem, start, most)
        return held, replace(fit, end=SearchEnd.DUPLICATE) if costs else fit

    monkeypatch.setattr(starting, "explains_to_noise", lambda *_: False)
    monkeypatch.setattr(starting, "fit_holding_unidentifiable", joined)
    monkeypatch.setattr(starting, "_settle_start", lambda *_: pytest.fail("settled"))
    _, fit, label = starting.fit_from_starts(problem)
    assert fit.status.converged
    assert label == problem.candidates()[0].label
    assert known == [(), fit.stage_costs]


@pytest.mark.parametrize("settled", [True, False])
def test_a_confirming_start_looks_for_no_noise_of_the_states_where_the_best_found_none(
    settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sensor with a lag: the second start took 18 seconds to end where the first one was, 13 of them so."""
    problem, allowed = posed(Stribeck()), list[bool]()
    missed = Status(Code.NOT_CONVERGED, ("gaps carry the cost",))

    def fitted(problem: EstimationProblem, start: Start, *given: object) -> tuple[EstimationProblem, Fit]:
        allowed.append(problem.method.allows_state_noise)
        held, fit = fit_holding_unidentifiable(problem, start)
        return held, fit if settled else replace(fit, status=missed, stats={**fit.stats, "gap_share": 0.12})

    monkeypatch.setattr(starting, "explains_to_noise", lambda *_: False)
    monkeypatch.setattr(starting, "is_at_noise", lambda *_: False)
    monkeypatch.setattr(starting, "fit_holding_unidentifiable", fitted)
    held, *_ = starting.fit_from_starts(problem)
    assert allowed == [True, settled]
    assert held.method == problem.method


@pytest.mark.parametrize(
    ("jumps", "cost", "enough"),
    [(True, 2.0, True), (False, 2.0, False), (False, 1.0005, True), (True, math.inf, False)],
)
def test_noise_of_the_states_asks_for_no_second_equal_optimum(jumps: bool, cost: float, enough: bool) -> None:
    """Every estimate is marked with it; an infinite cost stands for a second start that did not converge."""
    problem = posed(Stribeck())
    fit = solve_least_squares(problem.transcription(problem.candidates()[0]), problem.method)
    best = replace(fit, chi_square=1e9, jumps=np.zeros((1, 2)) if jumps else None)
    failed = Status(Code.NOT_CONVERGED, ("friction.static would still move",))
    status, share = (fit.status, cost) if cost < math.inf else (failed, 1.0)
    second = replace(best, status=status, stats={**best.stats, "cost": share * best.stats["cost"]})
    fits = [(problem, best, "first"), (problem, second, "second")]
    assert starting._are_enough(fits) is enough


@pytest.mark.parametrize(("cost", "settles"), [(101.0, 1), (103.0, 6)])
def test_no_more_guesses_settle_where_another_one_costs_the_same(
    cost: float, settles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log with sensor lag lost 14 of 25 CPU s to six guesses, of which none was what is wrong."""
    problem, settled = posed(Stribeck()), list[str]()
    gap = problem.method.stages[starting.GUESS_STAGES - 1].gap

    def settle(problem: EstimationProblem, start: Start, stages: int) -> tuple[tuple[float, float], Start, bool]:
        settled.append(start.label)
        return (gap, cost), start, False

    monkeypatch.setattr(starting, "_settle_start", settle)
    starts = list(starting.starts_by_cost(problem, left_after=lambda: 5, left_cost=lambda: 100.0))
    assert len(settled) == settles
    assert {s.label for s in starts} == {s.label for s in problem.candidates()}  # the others are tried as they are


def test_the_cost_that_others_are_held_to_is_that_after_as_many_stages() -> None:
    problem = posed(Stribeck())
    fit = solve_least_squares(problem.transcription(problem.candidates()[0]), problem.method)
    costs = tuple((stage.gap, float(i)) for i, stage in enumerate(problem.method.stages))
    found = [starting._cost_after_guesses(problem, [(problem, replace(fit, stage_costs=c), "")]) for c in (costs, ())]
    assert found[0] == starting.GUESS_STAGES - 1
    assert math.isnan(found[1])
