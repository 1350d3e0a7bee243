import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import OptimizeResult, least_squares

from pneuopt.dynamics.compiled.rollout import Gram
from pneuopt.dynamics.system import DiscreteSystem, Symbols, define, discretise
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code
from pneuopt.shooting.full_space import solve_full_space
from pneuopt.shooting.least_squares import Fit, LeastSquares, Stage, solve_least_squares
from pneuopt.shooting.segments import IntegrationCorrection, Segments
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

H = 0.02
NOISE, FINE_NOISE = 1e-3, 5e-6
TRUTH = {"stiffness": 30.0, "damping": 2.0, "bias[a]": 0.5, "bias[b]": -1.0}


def spring_mass(extra: bool = False) -> DiscreteSystem:
    """A mass of 1 kg on a spring and a damper, RK4 with two steps a sample."""
    parameters = {
        "stiffness": Parameter(20.0, "N/m", 1.0, 200.0, log=True, free=True),
        "damping": Parameter(3.0, "N*s/m", 0.0, 20.0, free=True),
        "bias": Parameter(0.0, "N", -5.0, 5.0),
    }
    more = {"factor": Parameter(1.0, "1", 0.1, 10.0, free=True), "idle": Parameter(1.0, "1", free=False)}

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        damping = p["damping"] * p["factor"] if extra else p["damping"]
        force = u["force"] + p["bias"] - p["stiffness"] * x["position"] - damping * x["speed"]
        return {"position": x["speed"], "speed": force}, {"position": x["position"]}

    states = [Quantity("position", "m", 0.1), Quantity("speed", "m/s", 0.5)]
    own = ParameterSet({**parameters, **(more if extra else {})})
    return discretise(define(states, [Quantity("force", "N")], states[:1], own, rhs), 2)


def propagate(stiffness: float, damping: float, x: Array, u: Array) -> Array:
    """The same RK4 in NumPy: positions at the samples."""
    A, y = np.array([[0, 1], [-stiffness, -damping]]), np.empty(len(u))
    h = H / 2
    for i, force in enumerate(u):
        y[i], b = x[0], np.array([0, force])
        for _ in range(2):
            k1 = A @ x + b
            k2 = A @ (x + h / 2 * k1) + b
            k3 = A @ (x + h / 2 * k2) + b
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + A @ (x + h * k3) + b)
    return y


def two_logs(seed: int = 0, nodes: int = 7, **toy: bool) -> Transcription:
    """Two noisy logs of 120 and 83 samples, some missing, with a bias each."""
    system, rng = spring_mass(**toy), np.random.default_rng(seed)
    phases, residuals = [], []
    for i, (name, n) in enumerate({"a": 120, "b": 83}.items()):
        force = np.repeat(rng.normal(0, 5, n // 10 + 1), 10)[:n]
        y = propagate(30.0, 2.0, np.array([0.05, 0.0]), force + TRUTH[f"bias[{name}]"]) + rng.normal(0, NOISE, n)
        y[[4, 5, 40]] = math.nan
        t: Array = H * np.arange(n, dtype=float)
        known = np.isfinite(y)
        guess = np.column_stack([np.interp(t, t[known], y[known]), np.zeros(n)])  # as without a start finder
        phases.append(Phase(name, t, np.full(n, H), force[:, None], regular_nodes(n, nodes), guess=guess))
        residuals.append(Residuals(i, ("position",), y[:, None], np.array([NOISE])))
    biases = {f"bias[{n}]": Parameter(0.0, "N", -5, 5, free=True) for n in "ab"}
    return Transcription(system, system.parameters | ParameterSet(biases), tuple(phases), tuple(residuals))


def single_shooting(problem: Transcription) -> OptimizeResult:
    def misfit(theta: Array) -> Array:
        pieces = []
        for k, (phase, residual) in enumerate(zip(problem.phases, problem.residuals, strict=True)):
            start = theta[4 + 2 * k : 6 + 2 * k]
            y = propagate(theta[0], theta[1], start, phase.inputs[:, 0] + theta[2 + k])
            pieces.append((y - residual.measured[:, 0]) / NOISE)
        e = np.concatenate(pieces)
        return e[np.isfinite(e)]

    return least_squares(misfit, [20, 3, 0, 0, 0, 0, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-10, jac="3-point")


def found(fit: Fit) -> Array:
    return np.array([fit.parameters.value(n) for n in TRUTH])


def test_three_solvers_find_one_optimum() -> None:
    """Lifted (soft gaps), full-space (IPOPT, hard) and SciPy's single shooting, on the same numbers."""
    problem = two_logs()
    lifted, full, single = solve_least_squares(problem), solve_full_space(problem), single_shooting(problem)
    assert lifted.status.converged, lifted.status
    hard = np.array([full.parameters.value(n) for n in TRUTH])
    assert_allclose(hard, single.x[:4], rtol=1e-6)
    # gaps of 1e-5 nominal sizes stay open a little: the price is a small part of a standard deviation
    assert lifted.covariance is not None
    spread = np.sqrt(np.diag(lifted.covariance))
    assert np.abs((found(lifted) - hard) / spread).max() < 2e-3
    assert_allclose(found(lifted), hard, rtol=1e-5)
    assert lifted.chi_square == pytest.approx(2 * single.cost, rel=1e-4)
    assert lifted.count == len(single.fun)
    assert_allclose(found(lifted), list(TRUTH.values()), atol=4 * spread.max())


def test_tighter_gaps_come_nearer_by_their_square() -> None:
    problem = two_logs()
    single = single_shooting(problem)
    off = []
    for gap in (1e-3, 1e-4):
        fit = solve_least_squares(problem, LeastSquares(stages=(Stage(1e-2, 20), Stage(gap, 30))))
        off.append(abs(found(fit)[0] - single.x[0]))
    assert off[1] < off[0] / 30


@pytest.mark.parametrize("seed", [1, 2])
def test_the_covariance_is_single_shootings(seed: int) -> None:
    """The sandwich sees the data's noise only, so it is the covariance with hard gaps: (J'J)^-1, dense."""
    problem = two_logs(seed)
    fit, single = solve_least_squares(problem), single_shooting(problem)
    dense = np.linalg.inv(single.jac.T @ single.jac)[:4, :4]
    assert fit.covariance is not None
    assert_allclose(
        fit.covariance, dense, rtol=5e-3, atol=5e-3 * np.sqrt(np.outer(np.diag(dense), np.diag(dense))).max()
    )
    assert_allclose(np.diag(fit.covariance), np.diag(dense), rtol=5e-3)


@pytest.mark.parametrize("time", [0.04, 0.3, math.inf])
def test_the_segments_length_does_not_change_the_answer(time: float) -> None:
    nodes = 200 if math.isinf(time) else round(time / H)
    fit = solve_least_squares(two_logs(nodes=nodes))
    assert fit.status.converged
    assert_allclose(found(fit), found(solve_least_squares(two_logs())), rtol=1e-5)


def test_a_known_start_state_is_kept() -> None:
    problem = two_logs()
    starts = tuple(replace(p, start=np.array([0.05, 0.0])) for p in problem.phases)
    fit = solve_least_squares(replace(problem, phases=starts))
    assert fit.status.converged
    for run in fit.trajectories:
        assert (run["position"][0], run["speed"][0]) == pytest.approx((0.05, 0.0), abs=1e-6)
    free = solve_least_squares(problem)
    assert fit.covariance is not None
    assert free.covariance is not None
    assert (np.diag(fit.covariance) < np.diag(free.covariance)).all()


@pytest.mark.parametrize(("bounds", "value"), [((1.0, 25.0), 25.0), ((40.0, 200.0), 40.0)])
def test_a_bound_stops_it_and_is_marked(bounds: tuple[float, float], value: float) -> None:
    problem = two_logs()
    parameters = problem.parameters.with_values({"stiffness": value}).with_bounds({"stiffness": bounds})
    fit = solve_least_squares(replace(problem, parameters=parameters))
    assert fit.status.converged, fit.status
    assert fit.parameters.value("stiffness") == value
    assert fit.at_bound.tolist() == [True, False, False, False]
    assert fit.covariance is not None
    assert np.isnan(fit.covariance[0]).all()
    assert np.isfinite(fit.covariance[1:, 1:]).all()
    full = solve_full_space(replace(problem, parameters=parameters))
    assert_allclose(found(fit)[1:], [full.parameters.value(n) for n in list(TRUTH)[1:]], rtol=2e-4)


def test_two_parameters_that_only_appear_as_a_product_are_named() -> None:
    fit = solve_least_squares(two_logs(extra=True))
    assert fit.status.code is Code.NOT_CONVERGED
    assert "do not determine damping and factor" in fit.status.message
    assert fit.covariance is None


def test_a_parameter_without_effect_is_named() -> None:
    problem = two_logs(extra=True)
    parameters = problem.parameters.fixed("factor").freed("idle")
    fit = solve_least_squares(replace(problem, parameters=parameters))
    assert fit.status.code is Code.NOT_CONVERGED
    assert "do not depend on idle" in fit.status.message
    assert fit.covariance is not None
    position = list(fit.parameters.free_names).index("idle")
    assert np.isnan(fit.covariance[position]).all()
    assert np.isfinite(np.diag(fit.covariance)).sum() == 4


def test_without_free_parameters_the_states_are_fitted() -> None:
    problem = two_logs()
    fixed = problem.parameters.with_values(TRUTH).fixed("*")
    fit = solve_least_squares(replace(problem, parameters=fixed))
    assert fit.status.converged
    assert fit.trajectories[0]["position"][0] == pytest.approx(0.05, abs=5 * NOISE)
    assert fit.chi_square < 1.3 * fit.count


def test_a_model_that_cannot_follow_does_not_converge() -> None:
    """With a stiffness that is far off and fixed, only open gaps could follow the log."""
    problem = two_logs(nodes=2)
    wrong = problem.parameters.fixed("stiffness").with_values({"stiffness": 150.0})
    fit = solve_least_squares(replace(problem, parameters=wrong), LeastSquares(stages=(Stage(1e-2, 60),)))
    assert fit.status.code is Code.NOT_CONVERGED
    assert "gaps between segments carry" in fit.status.message


def shaken(size: float, seed: int = 0) -> Transcription:
    """The two logs again, with the speed kicked at each node [m/s] by what no model knows."""
    problem, rng = two_logs(seed), np.random.default_rng(100 + seed)
    residuals = []
    for phase, residual in zip(problem.phases, problem.residuals, strict=True):
        force, x, y = phase.inputs[:, 0] + TRUTH[f"bias[{phase.name}]"], np.array([0.05, 0.0]), []
        for piece in np.split(force, phase.nodes[1:]):
            y += propagate(30.0, 2.0, x, piece).tolist()
            x = ahead(30.0, 2.0, x, piece) + np.array([0, rng.normal(0, size)])
        noisy = np.array(y) + rng.normal(0, FINE_NOISE, phase.n)
        residuals.append(replace(residual, measured=noisy[:, None], noise=np.array([FINE_NOISE])))
    return replace(problem, residuals=tuple(residuals))


def ahead(stiffness: float, damping: float, x: Array, u: Array, steps: int = 2) -> Array:
    """The state after the last sample."""
    return march(stiffness, damping, x, u, steps)[-1]


def march(stiffness: float, damping: float, x: Array, u: Array, steps: int = 2) -> list[Array]:
    """The state before each sample and after the last: RK4 as a matrix."""
    A, h = np.array([[0, 1], [-stiffness, -damping]]), H / steps
    powers = np.array([np.linalg.matrix_power(h * A, i) / math.factorial(i) for i in range(5)])
    M, b = powers.sum(axis=0), h * sum(p[:, 1] / (i + 1) for i, p in enumerate(powers[:4]))
    states = [x]
    for force in u:
        for _ in range(steps):
            x = M @ x + b * force
        states.append(x)
    return states


def all_residuals(problem: Transcription, fit: Fit, unknowns: Array) -> Array:
    """Data and gaps as the solver poses them; unknowns are the parameters, then the nodes."""
    steps, pieces, at = int(fit.stats["substeps"]), [], 4
    sigma = fit.stats["gap_deviation"] * np.array([0.1 * 0.01, 0.5])  # the position's rate is known
    for i, (phase, residual) in enumerate(zip(problem.phases, problem.residuals, strict=True)):
        nodes = unknowns[at : at + 2 * len(phase.nodes)].reshape(-1, 2)
        force, at = phase.inputs[:, 0] + unknowns[2 + i], at + nodes.size
        for number, rows in enumerate(np.split(np.arange(phase.n), phase.nodes[1:])):
            states = march(unknowns[0], unknowns[1], nodes[number], force[rows], steps)
            pieces.append((np.array(states)[:-1, 0] - residual.measured[rows, 0]) / residual.noise[0])
            if rows[-1] < phase.n - 1:
                pieces.append((states[-1] - nodes[number + 1]) / sigma)
    return np.concatenate(pieces)


def test_what_a_wrong_model_leaves_counts_as_noise_of_its_states() -> None:
    """An optimum, though not of hard gaps: SciPy finds nothing better. It says so; its intervals hold the truth."""
    problem = shaken(2e-3)
    fit = solve_least_squares(problem)
    assert fit.status.converged
    assert "does not explain the log to its noise" in fit.status.message
    assert "speed jumps by" in fit.status.message
    runs = zip(problem.phases, fit.trajectories, strict=True)
    nodes = [run.matrix(("position", "speed"))[phase.nodes].ravel() for phase, run in runs]
    here = np.concatenate([found(fit), *nodes])
    cost = 0.5 * np.sum(all_residuals(problem, fit, here) ** 2)
    assert cost == pytest.approx(fit.stats["cost"], rel=1e-9)
    best: OptimizeResult = least_squares(partial(all_residuals, problem, fit), here, xtol=1e-13, ftol=1e-13, gtol=1e-10)
    assert fit.covariance is not None
    spread = np.sqrt(np.diag(fit.covariance))
    assert np.abs((best.x[:4] - found(fit)) / spread).max() < 1e-3
    J: Array = np.asarray(best.jac)
    dense = np.linalg.inv(J.T @ J)[:4, :4]
    assert_allclose(np.diag(fit.covariance), np.diag(dense), rtol=1e-3)
    assert np.abs((found(fit) - list(TRUTH.values())) / spread).max() < 4


def test_residuals_beyond_the_noise_are_reported() -> None:
    problem = two_logs()
    proud = tuple(replace(r, noise=r.noise / 3) for r in problem.residuals)
    status = solve_least_squares(replace(problem, residuals=proud)).status
    assert status.converged
    assert "residuals are 2.9 times the noise of position" in status.message
    assert "explain" not in solve_least_squares(problem).status.message


def test_too_few_iterations_are_no_convergence() -> None:
    fit = solve_least_squares(two_logs(), LeastSquares(stages=(Stage(1e-5, 1),)))
    assert fit.status.code is Code.NOT_CONVERGED
    assert "would still move by" in fit.status.message


def test_a_model_too_stiff_to_search_is_refused_at_once() -> None:
    problem = two_logs()
    stiff = problem.parameters.with_bounds({"damping": (0.0, 1e6)}).with_values({"damping": 3e4})
    fit = solve_least_squares(replace(problem, parameters=stiff))
    assert fit.status.code is Code.NOT_CONVERGED
    assert "takes 300 integration steps" in fit.status.message
    assert fit.stats["iterations"] == 0


def test_a_start_that_is_not_finite_is_reported() -> None:
    problem = two_logs()
    guess = np.full((problem.phases[0].n, 2), 1e300)
    phases = (replace(problem.phases[0], guess=guess), problem.phases[1])
    fit = solve_least_squares(replace(problem, phases=phases))
    assert fit.status.code is Code.DIVERGED
    assert "not finite at the start" in fit.status.message
    assert fit.covariance is None


def test_an_interruption_hands_back_the_best_so_far() -> None:
    lines: list[str] = []

    def progress(line: str) -> None:
        lines.append(line)
        if len(lines) == 3:
            raise KeyboardInterrupt

    problem = two_logs()
    fit = solve_least_squares(problem, LeastSquares(progress=progress))
    assert fit.status.code is Code.INTERRUPTED
    assert lines[-1].startswith("stage 1/6  iteration 3  cost ")
    assert f"cost {fit.stats['cost']:.6g} " in lines[-1]
    assert fit.stats["iterations"] == 3


def test_explicit_substeps_are_kept_and_their_error_is_reported() -> None:
    problem = two_logs()
    coarse = solve_least_squares(problem, LeastSquares(substeps=1, stages=(Stage(1e-3, 20), Stage(1e-5, 30))))
    fine = solve_least_squares(problem, LeastSquares(substeps=8, stages=(Stage(1e-3, 20), Stage(1e-5, 30))))
    assert (coarse.stats["substeps"], fine.stats["substeps"]) == (1, 8)
    errors = [f.stats["integration_error"] for f in (coarse, fine)]
    assert errors[0] == pytest.approx(4096 * errors[1], rel=0.2)  # of order four


def held(problem: Transcription, name: str, value: float) -> Fit:
    """A fit with a free parameter held by equal bounds."""
    there = replace(problem.parameters[name], value=value, lower=value, upper=value, free=True)
    return solve_least_squares(replace(problem, parameters=problem.parameters | ParameterSet({name: there})))


def position(fit: Fit, name: str) -> int:
    return list(fit.parameters.free_names).index(name)


def test_a_good_fit_has_no_unidentifiable_parameter() -> None:
    fit = solve_least_squares(two_logs())
    assert fit.status.converged
    assert fit.unidentifiable == ()
    assert fit.prior_covariance is None


def test_a_parameter_without_effect_is_unidentifiable_and_held_it_adds_nothing() -> None:
    problem = two_logs(extra=True)
    problem = replace(problem, parameters=problem.parameters.fixed("factor").freed("idle"))
    assert solve_least_squares(problem).unidentifiable == ("idle",)
    fit = held(problem, "idle", 1.0)
    assert fit.status.converged
    assert fit.unidentifiable == ()
    assert not fit.at_bound.any()
    assert fit.prior_covariance is not None
    assert_allclose(fit.prior_covariance, 0.0, atol=1e-20)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_of_two_that_act_only_together_one_is_unidentifiable_and_the_other_takes_over_its_prior(factor: float) -> None:
    problem = two_logs(extra=True)
    assert set(solve_least_squares(problem).unidentifiable) < {"damping", "factor"}
    fit = held(problem, "factor", factor)
    assert fit.status.converged
    assert fit.parameters.value("damping") * factor == pytest.approx(TRUTH["damping"], rel=0.05)
    assert fit.prior_covariance is not None
    assert fit.covariance is not None
    borrowed, own = np.diag(fit.prior_covariance), np.diag(fit.covariance)
    at = position(fit, "damping")
    # damping times factor is known: ten times the factor, as many times less damping
    assert np.sqrt(borrowed[at]) == pytest.approx(10 * fit.parameters.value("damping"), rel=1e-3)
    others = [position(fit, n) for n in ("stiffness", "bias[a]", "bias[b]")]
    assert (borrowed[others] < 1e-6 * own[others]).all()


def test_the_steps_fall_again_where_a_start_was_stiffer_than_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    original = Segments.gram

    def gram(self: Segments, nodes: Array, q: Array, substeps: int, correction: IntegrationCorrection | None) -> Gram:
        steps.append(substeps)
        return original(self, nodes, q, substeps, correction)

    monkeypatch.setattr(Segments, "gram", gram)
    problem = two_logs()
    stiff = problem.parameters.with_bounds({"damping": (0.0, 1e5)}).with_values({"damping": 2e3})
    fit = solve_least_squares(replace(problem, parameters=stiff))
    assert fit.status.converged
    assert fit.parameters.value("damping") == pytest.approx(TRUTH["damping"], rel=0.05)
    assert steps[0] >= 20
    assert steps[-1] <= 2
    assert fit.stats["substeps"] <= 8
    # the answer's steps are finer, without a derivative at them
    assert fit.stats["substeps"] > steps[-1]


@pytest.mark.parametrize(
    ("make", "option", "allowed"),
    [
        (lambda: LeastSquares(stages=()), "stages=()", "one Stage or more"),
        (lambda: LeastSquares(segment_time=math.nan), "segment_time=nan", "seconds above 0"),
        (lambda: LeastSquares(segment_time=-1.0), "segment_time=-1.0", "seconds above 0"),
        (lambda: LeastSquares(substeps=0), "substeps=0", "a whole number from 1"),
        (lambda: LeastSquares(substeps=2.5), "substeps=2.5", "a whole number from 1"),  # type: ignore[arg-type]
        (lambda: LeastSquares(tolerance=0.0), "tolerance=0.0", "a positive number"),
        (lambda: LeastSquares(kinematic=math.nan), "kinematic=nan", "a positive number"),
        (lambda: Stage(-1e-3, 8), "gap=-0.001", "a positive fraction"),
        (lambda: Stage(math.nan, 8), "gap=nan", "a positive fraction"),
        (lambda: Stage(1e-3, -1), "iterations=-1", "0 or more"),
        (lambda: Stage(1e-3, 8, refine=0), "refine=0", "or more"),
    ],
)
def test_an_option_out_of_its_range_is_refused_by_its_name(
    make: Callable[[], object], option: str, allowed: str
) -> None:
    """They ended in a traceback from inside, or meant another search: a gap of -1e-3 was one of 1e-3."""
    with pytest.raises(ValueError, match=re.escape(option)) as refused:
        make()
    assert allowed in str(refused.value)


def test_options_at_the_ends_of_their_ranges_are_taken() -> None:
    assert LeastSquares(segment_time=math.inf, substeps=1, stages=(Stage(1e-12, 0),)).stages[0].iterations == 0
