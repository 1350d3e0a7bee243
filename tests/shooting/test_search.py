"""The shortcuts of a search: the last stage right after the first, and finer integration steps without derivatives."""

import math
import re
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled.rollout import RolloutResult
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting import least_squares
from pneuopt.shooting.arrow import GaussNewtonStep, ReducedEquations
from pneuopt.shooting.equations import ParameterScaling, correct_residuals, normal_equations, weigh_gaps
from pneuopt.shooting.least_squares import (
    ConvergenceTest,
    CpuBudget,
    Fit,
    Iterate,
    LeastSquares,
    Objective,
    Repeat,
    SearchEnd,
    SearchState,
    Shortcut,
    Stage,
    StageEnd,
    apply_finer_steps,
    choose_finer_steps,
    choose_repeat,
    choose_shortcut,
    correct_residuals_by,
    end_search,
    enter_stage,
    is_negligible_step,
    jump_to_last_stage,
    loosen,
    refine_steps,
    run_search,
    run_stage,
    run_stages,
    solve_least_squares,
    stages_to_loosen,
    start_search,
    tighten,
)
from pneuopt.shooting.segments import IntegrationCorrection, Segments, segment, start_nodes
from pneuopt.shooting.tolerances import FINE_TOLERANCE, MAX_CHI_SQUARE_RATIO
from tests.shooting.test_least_squares import TRUTH, found, shaken, two_logs

FIRST, *OTHERS = LeastSquares().stages


def fit_by_stages(method: LeastSquares) -> tuple[Fit, list[str]]:
    """The fit of the two logs, and the number of the stage of each iteration."""
    lines: list[str] = []
    fit = solve_least_squares(two_logs(), replace(method, progress=lines.append))
    return fit, [line.split()[1] for line in lines]


def steps_of_runs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The integration steps a sample of each run without sensitivities, as they come."""
    steps, run = list[int](), Segments.run

    def count(segments: Segments, nodes: Array, q: Array, substeps: int, **options: Any) -> RolloutResult:
        steps.append(substeps)
        return run(segments, nodes, q, substeps, **options)

    monkeypatch.setattr(Segments, "run", count)
    return steps


def test_a_first_stage_that_explains_the_logs_is_followed_by_the_last() -> None:
    short, stages = fit_by_stages(LeastSquares())
    assert set(stages) == {"1/6", "6/6"}
    # a first stage that ends before it explains the logs is followed by all others
    long, all_stages = fit_by_stages(LeastSquares(stages=(replace(FIRST, iterations=1), *OTHERS)))
    assert set(all_stages) > {"1/6", "2/6", "6/6"}
    assert short.covariance is not None
    deviations = np.sqrt(np.diag(short.covariance))
    moved = [short.parameters.value(n) - long.parameters.value(n) for n in short.parameters.free_names]
    assert (np.abs(moved) < 1e-3 * deviations).all()


def test_a_last_stage_that_does_not_soon_converge_is_left_for_the_stages_between(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("pneuopt.shooting.least_squares.TRIAL_ITERATIONS", 1)
    fit, stages = fit_by_stages(LeastSquares())
    assert stages.index("6/6") < stages.index("2/6")
    assert fit.status.converged
    assert fit.stats["gap_deviation"] == OTHERS[-1].gap


def test_a_budget_that_ends_in_refinement_leaves_coarse_runs_only(monkeypatch: pytest.MonkeyPatch) -> None:
    budget, steps, refined = CpuBudget(1e9), steps_of_runs(monkeypatch), list[RolloutResult]()

    def spend(state: SearchState) -> SearchState:
        assert state.end is SearchEnd.OPTIMUM
        assert state.correction is not None
        refined.append(state.run(state.output_substeps))
        budget._end = 0.0
        steps.clear()
        return refine_steps(state)

    monkeypatch.setattr("pneuopt.shooting.least_squares.refine_steps", spend)
    state = run_search(start_search(segment(two_logs()), LeastSquares(budget=budget)))
    fit = end_search(state, 0.0)
    assert (fit.end, fit.status.code) == (SearchEnd.INTERRUPTED, Code.INTERRUPTED)
    assert steps[1:] == [state.substeps]  # the first one has not begun
    assert state.substeps < state.output_substeps
    assert math.isnan(fit.stats["integration_error"])
    assert fit.optimum is not None
    assert state.largest_change(fit.optimum.run.y - refined[0].y) < 0.1


def test_an_answer_does_not_overrun_its_budget_for_its_integration_error() -> None:
    """A fit of a minute's log took 8 s more than its 60 s, for the run that halves the steps of the answer."""
    budget = CpuBudget(1e9)
    state = run_stages(start_search(segment(two_logs()), LeastSquares(budget=budget)))
    assert state.end is SearchEnd.OPTIMUM
    assert math.isnan(state.integration_change)
    assert math.isfinite(end_search(state, 0.0).stats["integration_error"])
    budget._end = 0.0
    fit = end_search(state, 0.0)
    assert fit.status.converged
    assert fit.covariance is not None
    assert math.isnan(fit.stats["integration_error"])


def test_corrected_residuals_have_the_cost_of_a_run_with_the_correction() -> None:
    segments, gaps = segment(two_logs()), np.array([1e-3, 1e-3])
    scaling, nodes = ParameterScaling(segments.transcription), start_nodes(segments)
    z = scaling.start
    given = segments, nodes, scaling.values(z), scaling.chain(z), gaps, 2
    plain = normal_equations(*given)
    change = np.random.default_rng(0).normal(0.0, 1e-3, plain.linearisation.y.shape)
    fine = segments.run(nodes, scaling.values(z), 4)
    correction = IntegrationCorrection(change, fine.x_end - plain.linearisation.x_end, fine)
    cheap, whole = correct_residuals(plain, nodes, correction, gaps), normal_equations(*given, correction)
    assert cheap.cost == pytest.approx(whole.cost, rel=1e-12)
    assert cheap.cost != pytest.approx(plain.cost, rel=1e-6)
    assert_allclose(cheap.gaps, whole.gaps, rtol=1e-12)
    assert cheap.chi_square == pytest.approx(whole.chi_square, rel=1e-12)


@pytest.mark.parametrize(("limit", "runs"), [(1e9, 0), (0.0, 1)])
def test_derivatives_are_computed_anew_only_where_finer_steps_change_much(
    limit: float, runs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, evaluate = start_search(segment(two_logs()), LeastSquares()), Mock(wraps=Objective.evaluate)
    monkeypatch.setattr("pneuopt.shooting.least_squares.MAX_GRADIENT_ERROR", limit)
    monkeypatch.setattr(Objective, "evaluate", lambda *given: evaluate(*given))  # noqa: PLW0108 - binds the objective
    corrected = correct_residuals_by(state, 4)
    assert evaluate.call_count == runs
    assert corrected.output_substeps == 4


def test_a_last_stage_that_stays_above_the_noise_is_not_integrated_by_finer_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A log with hysteresis in the valve lost two thirds of its search to that."""
    monkeypatch.setattr("pneuopt.shooting.least_squares.TRIAL_ITERATIONS", 1)
    jumps = list[bool]()

    def jumped(state: SearchState) -> SearchState:
        with monkeypatch.context() as patch:
            patch.setattr(SearchState, "is_at_noise", property(lambda at: at.stage is FIRST))
            patch.setattr("pneuopt.shooting.least_squares.apply_finer_steps", lambda *_: pytest.fail("finer steps"))
            back = jump_to_last_stage(state)
        jumps.append(back.end is None and back.iterate is state.iterate)
        return back

    monkeypatch.setattr("pneuopt.shooting.least_squares.jump_to_last_stage", jumped)
    assert solve_least_squares(two_logs(), LeastSquares()).status.converged
    assert jumps == [True]


def test_a_wrong_model_is_not_searched_with_tight_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first stage's linearised equations foresee what tight gaps leave; the optimum is that of all stages."""
    problem, entered = shaken(2e-3), list[float]()

    def record(state: SearchState, stage: Stage, nodes: Array, z: Array) -> SearchState:
        entered.append(stage.gap)
        return enter_stage(state, stage, nodes, z)

    monkeypatch.setattr("pneuopt.shooting.least_squares.enter_stage", record)
    fit = solve_least_squares(problem, LeastSquares())
    assert min(entered) == fit.stats["gap_deviation"] > LeastSquares().stages[-1].gap
    monkeypatch.setattr("pneuopt.shooting.least_squares.MAX_JUMP_MISFIT", math.inf)
    whole = solve_least_squares(problem, LeastSquares())
    assert min(entered) == LeastSquares().stages[-1].gap
    assert fit.covariance is not None
    spread = np.sqrt(np.diag(fit.covariance))
    assert np.abs((found(fit) - found(whole)) / spread).max() < 1e-2
    assert fit.stats["iterations"] < 0.7 * whole.stats["iterations"]


def test_a_search_without_noise_of_the_states_keeps_its_tight_gaps() -> None:
    """A trial of another value ended with such noise, which names nothing, and took five seconds for it."""
    problem, method = shaken(2e-3), LeastSquares()
    loose, tight = (solve_least_squares(problem, replace(method, allows_state_noise=a)) for a in (True, False))
    assert loose.jumps is not None
    assert tight.jumps is None
    assert tight.stats["gap_deviation"] == method.stages[-1].gap


def test_foreseen_squares_are_those_that_tight_gaps_leave() -> None:
    begun = start_search(segment(shaken(2e-3)), LeastSquares(stages=(Stage(1e-2, 12), Stage(3e-4, 30))))
    first, last = begun.method.stages
    loose = run_stage(begun, first)
    assert loose.promised_squares(last) == pytest.approx(2 * run_stage(loose, last).iterate.cost, rel=0.05)


def test_nothing_is_iterated_to_the_end_before_finer_steps_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the model misses the log, the coarse steps of the last stage end as soon as the parameters do not move."""
    problem = shaken(2e-3)
    fit = solve_least_squares(problem)
    monkeypatch.setattr("pneuopt.shooting.least_squares.COARSE_TOLERANCE", FINE_TOLERANCE)
    fine = solve_least_squares(problem)
    assert fit.covariance is not None
    assert np.abs((found(fit) - found(fine)) / np.sqrt(np.diag(fit.covariance))).max() < 1e-2
    assert fit.stats["iterations"] < fine.stats["iterations"]


@pytest.mark.parametrize(("limit", "is_refined"), [(3.0, False), (math.inf, True)])
def test_a_search_that_is_far_off_takes_no_finer_steps(
    limit: float, is_refined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The short search of a minute's log went on in finer steps at 160 times the noise, for half of a CPU budget."""
    steps = list[int]()

    def record(state: SearchState, fine: int) -> SearchState:
        steps.append(fine)
        return apply_finer_steps(state, fine)

    monkeypatch.setattr("pneuopt.shooting.least_squares.apply_finer_steps", record)
    stages = FIRST, OTHERS[-1]
    method = LeastSquares(stages=stages, allows_state_noise=False, max_misfit=limit)
    fit = solve_least_squares(shaken(2e-3), method)
    assert fit.stats["gap_deviation"] == stages[-1].gap
    assert 2 * fit.stats["cost"] > 3 * fit.count
    assert bool(steps) == is_refined


@pytest.mark.parametrize(("share", "is_left"), [(0.5, True), (2.0, False)])
def test_a_search_that_is_far_off_before_its_last_stage_is_left(share: float, is_left: bool) -> None:
    """The last stage took a Stribeck log's first start 60 iterations, and led nowhere."""
    lines, unsettled = list[str](), Stage(1e-5, 0)  # gaps that nothing has tightened yet
    method = LeastSquares(stages=(replace(FIRST, iterations=1), unsettled, OTHERS[-1]))
    ends: list[float] = [2 * e.cost for e in _stage_ends(method)]
    assert ends[1] > 2 * ends[0]
    limit = share * ends[1] / solve_least_squares(two_logs()).count
    fit = solve_least_squares(two_logs(), replace(method, max_misfit=limit, progress=lines.append))
    assert (fit.end is SearchEnd.ABANDONED) == is_left
    assert any(line.startswith("stage 3/3") for line in lines) != is_left


def _stage_ends(method: LeastSquares) -> tuple[StageEnd, ...]:
    return run_search(start_search(segment(two_logs()), method)).stage_ends


def test_a_search_that_comes_to_where_another_one_was_ends_there() -> None:
    """From there on both would go the same way: the second start of a wrong model took as long as the first."""
    problem, method = shaken(2e-3), LeastSquares()
    fit = solve_least_squares(problem, method)
    again = solve_least_squares(problem, replace(method, known_costs=fit.stage_costs))
    assert again.end is SearchEnd.DUPLICATE
    gap, cost = fit.stage_costs[-1]
    assert (gap, cost) == (fit.stats["gap_deviation"], fit.stats["cost"])
    assert again.stats["gap_deviation"] == gap
    assert again.stats["cost"] == pytest.approx(cost, rel=1e-3)
    other = solve_least_squares(problem, replace(method, known_costs=((gap, 1.01 * cost),)))
    assert other.end is not SearchEnd.DUPLICATE
    tight = solve_least_squares(two_logs(), LeastSquares(known_costs=((FIRST.gap, 0.0),)))
    assert [gap for gap, _ in tight.stage_costs] == [stage.gap for stage in (*OTHERS[1:], OTHERS[-1])]


def test_states_are_searched_to_the_end_where_no_parameter_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """A prediction starts from them; no parameter's step says that they have settled."""
    problem, left = two_logs(), dict[float, float]()

    def record(state: SearchState, current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> bool:
        found = is_negligible_step(state, current, reduced, step)
        if found:
            left[state.stage.gap] = 0.5 * current.equations.arrow.descent_rate(step)
        return found

    monkeypatch.setattr("pneuopt.shooting.least_squares.is_negligible_step", record)
    fixed = problem.parameters.with_values(TRUTH).fixed("*")
    assert solve_least_squares(replace(problem, parameters=fixed)).status.converged
    assert left[LeastSquares().stages[-1].gap] < 1e-6


def test_noise_of_the_states_that_has_not_settled_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve seconds of a search went by in the steps that had failed before."""
    tried = list[float]()

    def never(state: SearchState, stage: Stage, nodes: Array, z: Array) -> SearchState:
        tried.append(stage.gap)
        with monkeypatch.context() as patch:
            patch.setattr("pneuopt.shooting.least_squares.finish_stage", lambda at, _: at)
            end = SearchEnd.UNSETTLED
            patch.setattr("pneuopt.shooting.least_squares.repeat_last_stage", lambda at: replace(at, end=end))
            return loosen(state, stage, nodes, z)

    monkeypatch.setattr("pneuopt.shooting.least_squares.loosen", never)
    fit = solve_least_squares(shaken(2e-3), LeastSquares())
    assert fit.jumps is None
    assert len(tried) == len(set(tried)) > 0


def test_a_search_that_is_cut_names_the_parameter_that_would_still_move() -> None:
    fit = solve_least_squares(two_logs(), LeastSquares(stages=(Stage(1e-3, 1), Stage(1e-5, 1))))
    assert fit.status.code is Code.NOT_CONVERGED
    assert len(fit.unsettled) == 1
    assert fit.unsettled[0] in fit.status.verdict
    assert solve_least_squares(two_logs()).unsettled == ()


def test_log_parameters_are_drawn_to_their_start_by_wide_gaps_alone() -> None:
    """Where gaps hide a parameter it drifted to its bound, and tight gaps could not tell it any more."""
    state = start_search(segment(two_logs()), LeastSquares())
    z, drawn = state.iterate.z + 0.3, []
    for stage in LeastSquares().stages:
        state = enter_stage(state, stage, state.iterate.nodes.copy(), z)
        alone = weigh_gaps(state.segments, state.iterate.equations.linearisation, state.gap_deviations)
        assert state.cost == pytest.approx(alone.cost)
        drawn.append(state.iterate.cost > alone.cost)
    assert drawn == [True, True, True, True, False, False]
    assert not replace(FIRST, refine=2).has_prior  # as noise of the states, whose stage decides


def test_finer_steps_that_move_no_estimate_are_not_halved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, steps = two_logs(), steps_of_runs(monkeypatch)
    fit = solve_least_squares(problem, LeastSquares())
    assert set(steps) == {fit.stats["substeps"]}  # no run by still finer ones
    assert fit.optimum is not None
    at, segments = fit.optimum, fit.optimum.equations.segments
    change = np.abs(at.run.y - segments.run(at.nodes, at.values, steps[0] // 2).y) * segments.weights
    # what the halving has changed, not the little that it would change once more
    assert fit.stats["integration_error"] == pytest.approx(change[np.isfinite(segments.measured)].max(), rel=1e-6)
    assert fit.stats["integration_error"] < 0.01
    exact = solve_least_squares(problem, LeastSquares(substeps=16))
    assert fit.covariance is not None
    moved = [fit.parameters.value(n) - exact.parameters.value(n) for n in fit.parameters.free_names]
    assert (np.abs(moved) < 0.01 * np.sqrt(np.diag(fit.covariance))).all()


def test_a_refit_keeps_steps_that_were_tried_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs of finer steps were a quarter of a refit of a profile, and all for a figure that nobody reads."""
    problem, steps = two_logs(), steps_of_runs(monkeypatch)
    stages = (Stage(1e-3, 20), Stage(1e-5, 30, refine=4))
    checked = solve_least_squares(problem, LeastSquares(substeps=1, stages=stages))
    assert max(steps) == 8
    steps.clear()
    kept = solve_least_squares(problem, LeastSquares(substeps=1, stages=stages, checks_steps=False))
    assert max(steps) == 4
    assert kept.status.converged
    assert math.isnan(kept.stats["integration_error"])
    assert kept.stats["cost"] == pytest.approx(checked.stats["cost"], rel=1e-6)


def begun(stages: tuple[Stage, ...] = LeastSquares().stages, **options: Any) -> SearchState:
    """The state in which a search of the two logs begins."""
    return start_search(segment(two_logs()), LeastSquares(stages=stages, **options))


def with_cost(state: SearchState, share: float) -> SearchState:
    """The state at so many times the largest cost of the noise alone."""
    cost = 0.5 * share * MAX_CHI_SQUARE_RATIO * state.iterate.equations.count
    return replace(state, iterate=replace(state.iterate, equations=replace(state.iterate.equations, cost=cost)))


@pytest.mark.parametrize(
    ("squares", "allows", "shortcut", "gap"),
    [
        ({1e-5: 9.0}, True, Shortcut.LAST_STAGE, 1e-5),
        ({1e-5: 11.0}, False, Shortcut.NONE, 1e-2),
        ({1e-5: 11.0, 3e-3: 1.0, 1e-3: 1.1, 3e-4: 5.0, 1e-4: 8.0}, True, Shortcut.STATE_NOISE, 1e-3),
        ({1e-5: 11.0, 3e-3: 2.0, 1e-3: 3.0, 3e-4: 5.0, 1e-4: 8.0}, True, Shortcut.STATE_NOISE, 1e-2),
    ],
)
def test_the_shortcut_after_a_first_stage_is_chosen_by_what_other_gaps_promise(
    squares: dict[float, float], allows: bool, shortcut: Shortcut, gap: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Squares by gap, over their number: tight gaps where they promise little, else the tightest at the noise."""
    state = begun(allows_state_noise=allows)
    count = state.iterate.equations.count
    monkeypatch.setattr(SearchState, "promised_squares", lambda _, stage: squares[stage.gap] * count)
    chosen, stage = choose_shortcut(state)
    assert (chosen, stage.gap) == (shortcut, gap)


@pytest.mark.parametrize(
    ("cost", "fall", "noisy", "trapped", "repeat"),
    [
        (5.0, 0.05, False, False, Repeat.STOP),  # above the noise, and the cost hardly falls
        (5.0, 0.2, False, False, Repeat.GO_ON),
        (5.0, 0.2, False, True, Repeat.FREE_NODES),
        (0.9, 0.0, False, False, Repeat.GO_ON),
        (0.9, 0.0, False, True, Repeat.FREE_NODES),
        (5.0, 0.0, True, True, Repeat.GO_ON),  # gaps as noise of the states free no node
    ],
)
def test_a_last_stage_is_repeated_as_its_state_says(
    cost: float, fall: float, noisy: bool, trapped: bool, repeat: Repeat
) -> None:
    state = with_cost(begun(stages=(Stage(1e-5, 30, refine=2),)), cost)
    damping = np.where(np.arange(state.segments.count) == 2, 5.0 * trapped, 0.0)
    state = replace(state, last_decrease=fall, noisy_gaps=noisy, node_damping=damping)
    moving = ConvergenceTest(Status(Code.NOT_CONVERGED))
    assert choose_repeat(state, moving) is repeat
    assert choose_repeat(state, ConvergenceTest(Status(Code.CONVERGED))) is Repeat.STOP
    assert choose_repeat(state, moving._replace(unidentifiable=np.array([0]))) is Repeat.STOP


def test_stages_that_explained_the_logs_are_loosened_the_tightest_first() -> None:
    state, method = begun(), LeastSquares()
    noise = 0.5 * MAX_CHI_SQUARE_RATIO * state.iterate.equations.count
    nodes, z = state.iterate.nodes, state.iterate.z
    ends = tuple(StageEnd(nodes, z, noise * share) for share in (0.5, 0.8, 0.9, 1.1, 4.0))
    state = replace(state, stage_ends=ends)
    assert [stage.gap for stage, _ in stages_to_loosen(state)] == [1e-3, 3e-3]
    assert [end for _, end in stages_to_loosen(state)] == [ends[2], ends[1]]
    assert [s.gap for s, _ in stages_to_loosen(replace(state, unsettled_gaps=frozenset({1e-3})))] == [3e-3]
    assert method.stages[2].gap == 1e-3


@pytest.mark.parametrize(
    ("end", "options", "change", "factor"),
    [
        (SearchEnd.UNSETTLED, {}, None, 0),
        (SearchEnd.OPTIMUM, {"checks_steps": False}, None, 0),
        (SearchEnd.OPTIMUM, {}, None, 2),
        (SearchEnd.OPTIMUM, {}, 1e-9, 1),  # the finer steps of the last stage have moved no estimate
        (SearchEnd.OPTIMUM, {}, 1.0, 2),
        (SearchEnd.OPTIMUM, {"substeps": 3}, None, 1),
    ],
)
def test_finer_steps_are_tried_at_an_optimum_that_they_may_move(
    end: SearchEnd, options: dict[str, Any], change: float | None, factor: int
) -> None:
    state = begun(**options).end_with(end)
    if change is not None:
        run = state.run(state.substeps)
        state = replace(state, correction=IntegrationCorrection(run.y * 0 + change, run.x_end * 0, run))
    assert choose_finer_steps(state) == factor * state.output_substeps


def test_a_move_leaves_the_state_before_it_as_it_was() -> None:
    state = begun()
    nodes, z, damping = state.iterate.nodes.copy(), state.iterate.z.copy(), state.node_damping.copy()
    ended = run_search(state)
    assert (state.iterations, state.end, state.stage_ends) == (0, None, ())
    assert ended.end is SearchEnd.OPTIMUM
    for before, after in zip(
        (nodes, z, damping), (state.iterate.nodes, state.iterate.z, state.node_damping), strict=True
    ):
        assert_allclose(after, before, rtol=0, atol=0)


def test_an_interruption_leaves_the_last_iterate() -> None:
    """Wherever Ctrl-C comes: in a trial of the last stage after the first, it is that trial's iterate."""
    costs = list[str]()

    def stop(line: str) -> None:
        costs.append(line)
        if line.startswith("stage 6/6"):
            raise KeyboardInterrupt

    state = run_search(begun(progress=stop))
    assert state.end is SearchEnd.INTERRUPTED
    assert state.status.code is Code.INTERRUPTED
    assert state.iterations == len(costs)
    assert state.stage.gap == LeastSquares().stages[-1].gap


def loosened(monkeypatch: pytest.MonkeyPatch) -> tuple[SearchState, list[float]]:
    """An optimum of the two logs, which the model explains, with noise of the states; and the gaps entered since."""
    entered, (_, stage, *_, last) = list[float](), LeastSquares().stages

    def record(state: SearchState, into: Stage, nodes: Array, z: Array) -> SearchState:
        entered.append(into.gap)
        return enter_stage(state, into, nodes, z)

    state = run_stage(replace(begun(), noisy_gaps=True), replace(stage, iterations=last.iterations, refine=2))
    state = state.conclude()
    assert state.end is SearchEnd.OPTIMUM
    monkeypatch.setattr("pneuopt.shooting.least_squares.enter_stage", record)
    return state, entered


def test_loosened_gaps_are_tightened_again_where_that_leads_to_an_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of a first stage across kinks let its equations foresee a misfit that a right model has not."""
    state, entered = loosened(monkeypatch)
    tight = tighten(state)
    assert entered == [1e-3, 3e-4, 1e-4, 1e-5]
    assert (tight.end, tight.noisy_gaps, tight.stage) == (SearchEnd.OPTIMUM, False, LeastSquares().stages[-1])
    assert tight.iterations > state.iterations
    fit, whole = end_search(tight, 0.0), solve_least_squares(two_logs())
    assert fit.jumps is None
    assert whole.covariance is not None
    assert (np.abs(found(fit) - found(whole)) < 1e-2 * np.sqrt(np.diag(whole.covariance))).all()


def test_loosened_gaps_stay_where_tight_ones_lead_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    state, entered = loosened(monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(SearchState, "is_at_noise", property(lambda at: at.stage.gap > 1e-4))
        back = tighten(state)
    assert entered == [1e-3, 3e-4, 1e-4]
    assert (back.end, back.noisy_gaps, back.stage) == (SearchEnd.OPTIMUM, True, state.stage)
    assert back.iterate is state.iterate
    assert back.iterations > state.iterations
    entered.clear()
    monkeypatch.setattr(SearchState, "promised_squares", lambda *_: math.inf)
    assert tighten(state) is state
    assert entered == []


def test_the_head_of_the_file_lists_every_stage_and_end() -> None:
    page = least_squares.__doc__ or ""
    assert [float(gap) for gap in re.findall(r"\de-\d", page)] == [stage.gap for stage in LeastSquares().stages]
    assert set(re.findall(r"^    ([A-Z_]+) ", page, re.MULTILINE)) == set(SearchEnd.__members__)
