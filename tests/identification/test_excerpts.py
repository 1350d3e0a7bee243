"""Long logs: the part that is searched first, and the whole that begins with its answer."""

import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pneuopt.dynamics.hooks import Start
from pneuopt.identification import long_logs, multistart
from pneuopt.identification.checks import check_logs
from pneuopt.identification.excerpts import EXCERPT_SEGMENTS, cut_excerpts, filter_states, liveliest_part
from pneuopt.identification.fit_order import is_in_order
from pneuopt.identification.problem import EstimationProblem
from pneuopt.logs.experiments import Experiment
from pneuopt.models.catalog import b32
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares, SearchEnd, solve_least_squares
from pneuopt.shooting.transcription import Transcription
from problems.shared.b32 import GAINS, run_loop

SAMPLE, NOISE = 2e-3, {"position": 2e-5, "pressure_a": 1e3, "pressure_b": 1e3}  # [s], [m], [Pa]
FREE = ("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")
LIVELY = (12.0, 22.0)  # [s], when the drive moves most


def posed(seconds: float = 26.0, method: LeastSquares | None = None) -> tuple[EstimationProblem, Trajectory]:
    """A pneumatic drive in a loop, which moves farther for ten seconds than before and after; and the exact log."""
    drive, truth = b32()
    t = np.arange(round(seconds / SAMPLE)) * SAMPLE
    wanted = 0.1 + np.where((t >= LIVELY[0]) & (t < LIVELY[1]), 0.05, 0.02) * np.sign(np.sin(2 * np.pi * 0.8 * t))
    exact = run_loop(
        truth | GAINS, wanted, SAMPLE, {"position": 0.1, "pressure_a": 3.5e5, "pressure_b": 4e5}, substeps=40
    )
    rng = np.random.default_rng(3)
    noisy = {n: exact[n] + sigma * rng.standard_normal(len(t)) for n, sigma in NOISE.items()}
    log = Experiment(Trajectory(t, {"valve_voltage": exact["valve_voltage"], **noisy}), NOISE, name="run")
    parameters = truth.with_values({n: drive.parameters.value(n) for n in FREE}).freed(*FREE)
    logs = tuple(check_logs(drive.system(), [log], parameters))
    return EstimationProblem(drive.system(), logs, parameters, method or LeastSquares()), exact


def test_the_excerpt_is_the_liveliest_part() -> None:
    parts = cut_excerpts(posed()[0])
    assert parts is not None
    t = parts.experiments[0].trajectory.t
    assert len(t) == pytest.approx(EXCERPT_SEGMENTS * 0.01 / SAMPLE, abs=1)
    assert t[0] == pytest.approx(LIVELY[0], abs=1.1)


@example(450, 12, 0.3, False)
@given(st.integers(0, 999), st.integers(12, 60), st.sampled_from([0.0, 0.3]), st.booleans())
def test_the_liveliest_part_has_the_largest_product_of_variances(
    seed: int, count: int, missing: float, is_wide: bool
) -> None:
    rng = np.random.default_rng(seed)
    columns = 1e5 + rng.standard_normal((80, 2, 3)) * np.repeat(rng.uniform(0.1, 9, (8, 1, 3)), 10, axis=0)
    columns[rng.random(columns.shape) < missing] = np.nan
    columns[..., 2] = np.nan  # an output that is not logged
    columns = columns if is_wide else columns[:, 0]

    def score(first: int) -> float:
        part = columns[first : first + count, ..., :2].reshape(-1, 2)
        return float(np.sum(np.log(np.maximum(np.nanvar(part, axis=0), 1e-12))))  # a lone sample has no variance

    found = liveliest_part(columns, count)
    assert score(found) >= max(map(score, range(0, 81 - count, max(1, count // 10)))) - 1e-6


def test_short_logs_and_windows_have_no_excerpt() -> None:
    problem, _ = posed(20.0)
    assert cut_excerpts(problem) is None
    assert cut_excerpts(replace(posed()[0], window=0.5)) is None


def test_filtered_states_fit_the_parameters() -> None:
    """The speed along the log comes four times nearer to the truth than that of a filter of the position alone."""
    problem, states = posed(6.0)
    rough = problem.candidates()[0]
    true = {n: b32()[1].value(n) for n in FREE}
    filtered = filter_states(problem, replace(rough, parameters=true))
    error, before = (
        np.sqrt(np.mean((each.states["run"]["speed"] - states["speed"])[100:] ** 2)) for each in (filtered, rough)
    )
    assert error < before / 4


def test_a_long_log_begins_with_the_answer_of_its_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the searches of the whole log do not come to an end, only the part is searched from rough states."""
    lengths: list[tuple[int, int]] = []

    def spied(transcription: Transcription, method: LeastSquares) -> Fit:
        lengths.append((transcription.phases[0].n, len(method.stages)))
        return solve_least_squares(transcription, method)

    deviations: list[float] = []

    def filtered(problem: EstimationProblem, start: Start, gathered: float) -> Start:
        deviations.append(gathered)
        return filter_states(problem, start, gathered)

    monkeypatch.setattr(long_logs, "SHORT_ITERATIONS", 0)
    monkeypatch.setattr(long_logs, "_fit_filtered", lambda *_, **__: None)
    monkeypatch.setattr(long_logs, "filter_states", filtered)
    for module in (long_logs, multistart):
        monkeypatch.setattr(module, "solve_least_squares", spied)
    problem, _ = posed()
    held, fit, label = long_logs.fit_logs(problem, multistart.fit_from_starts)
    # known from a part, the parameters leave the filter as little as a gap: with ten times that, eight places of a
    # minute's log that sticks and slips were lost, and the search did not find back
    assert deviations == [problem.method.stages[-1].gap]
    assert label.endswith("of a part")
    assert fit.status.converged
    assert held.method == problem.method
    searched = [n for n, stages in lengths if stages == len(problem.method.stages)]
    assert searched == [pytest.approx(EXCERPT_SEGMENTS * 0.01 / SAMPLE, abs=1)]
    for name in FREE:
        assert fit.parameters.value(name) == pytest.approx(b32()[1].value(name), rel=0.01)


def test_a_long_log_that_wide_gaps_explain_is_filtered_before_tight_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes that wide gaps had let go apart took 80 s to close, where filtered ones took two."""
    gaps: list[tuple[float, ...]] = []

    def spied(transcription: Transcription, method: LeastSquares) -> Fit:
        gaps.append(tuple(stage.gap for stage in method.stages))
        return solve_least_squares(transcription, method)

    monkeypatch.setattr(long_logs, "SHORT_ITERATIONS", 0)
    for module in (long_logs, multistart):
        monkeypatch.setattr(module, "solve_least_squares", spied)
    problem, _ = posed()
    held, fit, label = long_logs.fit_logs(problem, multistart.fit_from_starts)
    assert gaps == [(1e-2, 1e-5), (1e-2, 1e-3), (1e-5,)]
    assert not label.endswith("of a part")
    assert fit.status.converged
    assert held.method == problem.method
    for name in FREE:
        assert fit.parameters.value(name) == pytest.approx(b32()[1].value(name), rel=0.01)


@pytest.mark.parametrize(("is_far", "filtered"), [(False, 1), (True, 2)])
def test_states_that_are_far_off_are_filtered_before_wide_gaps_too(
    is_far: bool, filtered: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rough states of fast slips left 1115 times the noise at the right parameters, filtered ones 33 times."""
    runs: list[Start] = []

    def spied(problem: EstimationProblem, start: Start) -> Start:
        runs.append(start)
        return filter_states(problem, start)

    monkeypatch.setattr(long_logs, "filter_states", spied)
    problem, _ = posed()
    assert long_logs._fit_filtered(problem, problem.candidates()[0], is_far=is_far) is not None
    assert len(runs) == filtered


def test_wide_gaps_that_do_not_explain_a_long_log_lead_to_no_tight_ones() -> None:
    problem, _ = posed()
    (log,) = problem.experiments
    precise = replace(problem, experiments=(replace(log, noise={n: v / 3 for n, v in log.noise.items()}),))
    assert long_logs._fit_filtered(precise, problem.candidates()[0], is_far=False) is None


def explain_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every fit explain its logs to their noise."""
    monkeypatch.setattr(long_logs, "is_at_noise", lambda *_: True)
    monkeypatch.setattr(long_logs, "explains_to_noise", lambda _, fit: fit.status.converged)


@pytest.mark.parametrize(("tries", "ended"), [(1, None), (2, "1"), (3, "1")])
def test_what_a_second_try_of_a_long_log_holds_needs_no_third(
    tries: int, ended: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = posed()
    held = replace(problem, held={FREE[0]: 30.0})
    fit: Fit = Mock(unidentifiable=(), status=Status(Code.CONVERGED, ("",)), parameters=problem.parameters)
    explain_all(monkeypatch)
    monkeypatch.setattr(long_logs, "_tries_of_long_logs", lambda _: iter([(held, fit, str(k)) for k in range(tries)]))
    found = long_logs._fit_long_logs(problem, [])
    assert (found and found[2]) == ended


def test_a_whole_log_at_the_noise_that_leaves_one_parameter_unsettled_holds_that_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The search of the whole log from other starts, which took the rest of a CPU budget, is then left out."""
    problem, _ = posed()
    unsettled: Fit = Mock(status=Status(Code.NOT_CONVERGED, ("",)), parameters=problem.parameters)
    settled: Fit = Mock(unidentifiable=(), status=Status(Code.CONVERGED, ("",)), parameters=problem.parameters)
    held = replace(problem, held={FREE[0]: 30.0})
    explain_all(monkeypatch)
    monkeypatch.setattr(long_logs, "fit_a_part", lambda *_: (held, settled))
    monkeypatch.setattr(long_logs, "_tries_of_long_logs", lambda _: iter(2 * [(problem, unsettled, "")]))
    assert long_logs._fit_long_logs(problem, []) == (held, settled, "")


@pytest.mark.parametrize("static", [20.0, 30.1])
def test_an_answer_that_has_lost_static_friction_is_no_answer(static: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another basin, at the noise, too, whose intervals missed the truth by forty deviations."""
    problem, _ = posed()
    below = problem.parameters.with_values({"friction.static": static, "friction.coulomb": 30.0})
    fit, *others = (
        Mock(unidentifiable=(), unsettled=(), jumps=None, status=Status(Code.CONVERGED, ("",)), parameters=below)
        for _ in range(3)
    )
    for cost, each in enumerate((fit, *others), 1):
        each.stats = {"cost": float(cost)}
    explain_all(monkeypatch)
    monkeypatch.setattr(long_logs, "_tries_of_long_logs", lambda _: iter([(problem, f, "") for f in (fit, *others)]))
    assert long_logs._fit_long_logs(problem, []) is None
    same: Fit = Mock(
        unidentifiable=(), unsettled=(), jumps=None, stats={"cost": 1.0}, status=fit.status, parameters=below
    )
    monkeypatch.setattr(long_logs, "_tries_of_long_logs", lambda _: iter(3 * [(problem, same, "")]))
    assert long_logs._fit_long_logs(problem, []) is not None  # what two starts lead to is what the logs show
    known = replace(problem, held={"friction.static": static})
    assert is_in_order(known, fit)
    assert not is_in_order(problem, fit)


def test_a_short_search_that_is_cut_near_the_noise_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is cut so near its end has no need of a part, whose search begins anew."""
    lengths: list[int] = []

    def cut(transcription: Transcription, method: LeastSquares) -> Fit:
        fit = solve_least_squares(transcription, method)
        lengths.append(transcription.phases[0].n)
        return fit if lengths[1:] else replace(fit, status=Status(Code.NOT_CONVERGED, ("cut",)))

    for module in (long_logs, multistart):
        monkeypatch.setattr(module, "solve_least_squares", cut)
    problem, _ = posed()
    held, fit, label = long_logs.fit_logs(problem, multistart.fit_from_starts)
    assert lengths == 2 * [len(problem.experiments[0].trajectory)]
    assert fit.status.converged
    assert held.method == problem.method
    assert not label.endswith("of a part")


def test_a_short_search_ends_where_it_leads_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is for easy logs: neither a hopeless start nor noise of the states is followed there, which took a minute."""
    methods: list[LeastSquares] = []

    def spied(transcription: Transcription, method: LeastSquares) -> Fit:
        methods.append(method)
        return solve_least_squares(transcription, method)

    for module in (long_logs, multistart):
        monkeypatch.setattr(module, "solve_least_squares", spied)
    problem, _ = posed()
    (log,) = problem.experiments
    precise = replace(problem, experiments=(replace(log, noise={n: v / 30 for n, v in log.noise.items()}),))
    _, short, _ = next(long_logs._tries_of_long_logs(precise))
    assert not short.status.converged
    assert short.stats["iterations"] <= problem.method.stages[0].iterations
    assert [method.allows_state_noise for method in methods] == [False]


def test_the_whole_log_is_left_where_the_answer_of_its_part_does_not_explain_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From states that do not fit together a search crept for half of a CPU budget, at a hundred times the noise."""
    problem, _ = posed()
    parts, (log,) = cut_excerpts(problem), problem.experiments
    monkeypatch.setattr(long_logs, "cut_excerpts", lambda _: parts)
    precise = replace(problem, experiments=(replace(log, noise={n: v / 30 for n, v in log.noise.items()}),))
    *_, (_, whole, label) = long_logs._tries_of_long_logs(precise)
    assert label.endswith("of a part")
    assert whole.end is SearchEnd.ABANDONED
    assert whole.stats["iterations"] <= problem.method.stages[-1].iterations


def test_ctrl_c_in_the_short_search_ends_all() -> None:
    def interrupt(_: str) -> None:
        raise KeyboardInterrupt

    problem, _ = posed(method=LeastSquares(progress=interrupt))
    held, fit, _ = long_logs.fit_logs(problem, multistart.fit_from_starts)
    assert fit.status.code is Code.INTERRUPTED
    assert not held.held
    assert math.isfinite(fit.stats["cost"])


def test_an_interruption_hands_back_the_best_of_all_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """A budget that ended in the search from rough states handed back those, at 17 times the noise."""
    problem, _ = posed(1.0)
    near, rough = (
        Mock(stats={"cost": cost, "gap_deviation": 1e-5}, count=100, jumps=None, status=Status(code, ("",)))
        for cost, code in ((50.0, Code.NOT_CONVERGED), (900.0, Code.INTERRUPTED))
    )

    def tries(problem: EstimationProblem, tried: list[multistart.Candidate]) -> None:
        tried.append((problem, near, "near"))

    monkeypatch.setattr(long_logs, "_fit_long_logs", tries)
    monkeypatch.setattr(long_logs, "replace", lambda fit, **_: fit)
    assert long_logs.fit_logs(problem, lambda _: (problem, rough, "rough")) == (problem, near, "near")

    def interrupt(problem: EstimationProblem) -> multistart.Candidate:
        raise KeyboardInterrupt

    assert long_logs.fit_logs(problem, interrupt) == (problem, near, "near")
    monkeypatch.setattr(long_logs, "_fit_long_logs", lambda *_: None)
    with pytest.raises(KeyboardInterrupt):
        long_logs.fit_logs(problem, interrupt)


@pytest.mark.parametrize("stage", [0, 1])
def test_ctrl_c_between_the_tries_ends_all(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the search with wide gaps, or in the tight one after it, for which the next try was taken up."""
    problem, _ = posed()
    rough, runs = problem.candidates()[0], list[int]()

    def cut(transcription: Transcription, method: LeastSquares) -> Fit:
        fit = solve_least_squares(transcription, method)
        runs.append(len(runs))
        return replace(fit, status=SearchEnd.INTERRUPTED.status) if runs[-1] == stage else fit

    for module in (long_logs, multistart):
        monkeypatch.setattr(module, "solve_least_squares", cut)
    found = long_logs._fit_filtered(problem, rough, is_far=False)
    assert found is not None
    assert found[1].status.code is Code.INTERRUPTED
    assert runs == list(range(stage + 1))
