import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares

from pneuopt.dynamics.system import DiscreteSystem, Symbols, define, discretise
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code
from pneuopt.shooting.full_space import FullSpace, prepare_full_space, solve_from, solve_full_space
from pneuopt.shooting.transcription import Cost, Limit, Phase, Residuals, Transcription, Where, regular_nodes

H = 0.02


def spring_mass() -> DiscreteSystem:
    """A mass of 1 kg on a spring and a damper, pushed by a force; a second-order reference with a known answer."""
    parameters = ParameterSet(
        {
            "stiffness": Parameter(20.0, "N/m", 1.0, 200.0, log=True, free=True),
            "damping": Parameter(3.0, "N*s/m", 0.0, 20.0, free=True),
            "bias": Parameter(0.0, "N", -5.0, 5.0),
        }
    )

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        force = u["force"] + p["bias"] - p["stiffness"] * x["position"] - p["damping"] * x["speed"]
        return {"position": x["speed"], "speed": force}, {"position": x["position"]}

    states = [Quantity("position", "m", 0.1), Quantity("speed", "m/s", 0.5)]
    return discretise(define(states, [Quantity("force", "N")], states[:1], parameters, rhs), 2)


def measured(n: int, bias: float, seed: int) -> tuple[Array, Array]:
    """A force and the noisy position of the true plant, sampled exactly."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.normal(0, 5, n // 10 + 1), 10)[:n]
    exact = expm(H * np.array([[0, 1, 0], [-30, -2, 1], [0, 0, 0]]))
    x, found = np.array([0.05, 0.0]), np.empty(n)
    for k in range(n):
        found[k] = x[0]
        x = (exact @ [*x, force[k] + bias])[:2]
    return force, found + rng.normal(0, 1e-3, n)


def phase(name: str, force: Array, nodes: int, **fields: object) -> Phase:
    n = len(force)
    return Phase(name, H * np.arange(n), np.full(n, H), force[:, None], regular_nodes(n, nodes), **fields)  # type: ignore[arg-type]


def two_logs(nodes: int = 7) -> Transcription:
    system = spring_mass()
    parameters = system.parameters | ParameterSet(
        {"bias[a]": Parameter(0.0, "N", -5, 5, free=True), "bias[b]": Parameter(0.0, "N", -5, 5, free=True)}
    )
    logs = [measured(100, 0.5, 1), measured(83, -1.0, 2)]
    logs[1][1][[4, 5, 40]] = math.nan
    phases = tuple(phase(n, log[0], nodes) for n, log in zip("ab", logs, strict=True))
    residuals = tuple(Residuals(i, ("position",), log[1][:, None], np.array([1e-3])) for i, log in enumerate(logs))
    return Transcription(system, parameters, phases, residuals)


def single_shooting(transcription: Transcription) -> tuple[Array, float]:
    """The same estimate by scipy on a simulation without any nodes."""

    def misfit(theta: Array) -> Array:
        stiffness, damping, *rest = theta
        pieces = []
        for k, residual in enumerate(transcription.residuals):
            bias, x = rest[k], np.array(rest[2 + 2 * k : 4 + 2 * k])
            A = np.array([[0, 1], [-stiffness, -damping]])
            y = np.empty(transcription.phases[k].n)
            for i, u in enumerate(transcription.phases[k].inputs[:, 0]):
                y[i] = x[0]
                for _ in range(2):
                    h, b = H / 2, np.array([0, u + bias])
                    k1 = A @ x + b
                    k2 = A @ (x + h / 2 * k1) + b
                    k3 = A @ (x + h / 2 * k2) + b
                    x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + A @ (x + h * k3) + b)
            error = (y - residual.measured[:, 0]) / residual.noise[0]
            pieces.append(error[np.isfinite(error)])
        return np.concatenate(pieces)

    found = least_squares(misfit, [20, 3, 0, 0, 0, 0, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-10)
    return found.x[:4], found.cost


def test_identification_agrees_with_single_shooting() -> None:
    problem = two_logs()
    solution = solve_full_space(problem)
    assert solution.status.converged, solution.status
    expected, cost = single_shooting(problem)
    found = [solution.parameters.value(n) for n in ("stiffness", "damping", "bias[a]", "bias[b]")]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert solution.cost == pytest.approx(cost, rel=1e-8)
    assert found == pytest.approx([30, 2, 0.5, -1.0], rel=0.05)
    assert solution.stats["largest_gap"] < 1e-8
    assert solution.multipliers == {}


@pytest.mark.parametrize("nodes", [1, 4, 100])
def test_the_nodes_do_not_change_the_optimum(nodes: int) -> None:
    few = solve_full_space(two_logs(nodes))
    assert few.status.converged, few.status
    assert few.parameters.value("stiffness") == pytest.approx(
        solve_full_space(two_logs()).parameters.value("stiffness")
    )


def test_active_bounds_are_named() -> None:
    problem = two_logs()
    tight = problem.parameters.with_bounds({"stiffness": (10.0, 25.0)})
    solution = solve_full_space(replace(problem, parameters=tight))
    assert solution.status.converged
    assert solution.parameters.value("stiffness") == pytest.approx(25.0, rel=1e-6)
    assert set(solution.multipliers) == {"stiffness"}


def test_a_known_start_and_a_following_phase_are_kept() -> None:
    problem = two_logs()
    first = replace(problem.phases[0], start=np.array([0.05, 0.0]))
    second = replace(problem.phases[1], follows=True)
    solution = solve_full_space(replace(problem, phases=(first, second), residuals=problem.residuals[:1]))
    a, b = solution.trajectories
    assert (a["position"][0], a["speed"][0]) == pytest.approx((0.05, 0.0))
    assert abs(b["position"][0] - a["position"][-1]) < 2 * H * np.max(np.abs(a["speed"]))
    assert len(solution.trajectories) == 2


def settling(band: float, gain: float = 4.0, least: float = 0.0) -> Transcription:
    """Two phases with a free duration; the first-order lag with gain k settles after log(1/band)/k."""
    gains = ParameterSet({"gain": Parameter(gain, "1/s", 0.1, 100.0, log=True)})

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {"speed": p["gain"] * (u["reference"] - x["speed"])}, {"speed": x["speed"]}

    system = discretise(
        define([Quantity("speed", "m/s")], [Quantity("reference", "m/s")], [Quantity("speed", "m/s")], gains, rhs)
    )
    times = ParameterSet({"Ts": Parameter(1.0, "s", 0.01, 3.0, free=True), "rest": Parameter(1.0, "s")})
    grid, ones = np.arange(40) / 40, np.ones((40, 1))
    phases = (
        Phase("transient", grid, np.full(40, 1 / 40), ones, regular_nodes(40, 1), start=np.zeros(1), duration="Ts"),
        Phase("settled", grid, np.full(40, 1 / 40), ones, regular_nodes(40, 1), follows=True, duration="rest"),
    )
    t, x, u, p = (ca.SX.sym(k) for k in "txup")
    speed = ca.Function("speed", [t, x, u, p], [x])
    q = ca.SX.sym("q", 3)
    limits = (
        Limit("settling band", speed, 1 - band, 1 + band, Where.NODES, (1,)),
        Limit("speed at the end", speed, least, math.inf, Where.END, (1,)),
    )
    cost = Cost("settling time", ca.Function("Ts", [q], [q[1]]), Where.PARAMETERS)
    return Transcription(system, gains | times, phases, (), (cost,), limits)


@pytest.mark.parametrize("band", [0.05, 0.02, 0.001])
def test_a_free_duration_gives_the_exact_settling_time(band: float) -> None:
    solution = solve_full_space(settling(band))
    assert solution.status.converged
    assert solution.parameters.value("Ts") == pytest.approx(math.log(1 / band) / 4, rel=1e-5)
    assert set(solution.multipliers) == {"settling band"}
    assert solution.multipliers["settling band"] == pytest.approx(1 / (4 * band), rel=1e-3)
    assert solution.trajectories[1].duration == pytest.approx(39 / 40)


def test_a_prepared_problem_takes_other_values_of_fixed_parameters() -> None:
    problem = settling(0.02)
    again = solve_from(prepare_full_space(problem), problem.parameters.with_values({"gain": 8.0}))
    assert again.parameters.value("Ts") == pytest.approx(math.log(50) / 8, rel=1e-5)


def test_an_infeasible_limit_is_named() -> None:
    status = solve_full_space(settling(0.02, least=1.5)).status
    assert status.code is Code.INFEASIBLE
    assert "'speed at the end'" in status.message
    assert "'settled'" in status.message


def test_the_iteration_limit_is_no_convergence() -> None:
    status = solve_full_space(settling(0.02), FullSpace(max_iterations=1)).status
    assert status.code is Code.ITERATION_LIMIT


def test_nan_is_named_by_state_and_phase() -> None:
    parameters = ParameterSet({"exponent": Parameter(0.5, "1", free=True)})

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        rates = {"position": ca.SX(1.0), "pressure": ca.sqrt(x["pressure"] - 1) ** p["exponent"]}
        return rates, {"pressure": x["pressure"]}

    states = [Quantity("position", "m"), Quantity("pressure", "Pa(a)")]
    system = discretise(define(states, [], states[1:], parameters, rhs))
    run = Phase("run 7", np.arange(3.0), np.ones(3), np.zeros((3, 0)), regular_nodes(3, 1), guess=np.zeros((3, 2)))
    status = solve_full_space(Transcription(system, parameters, (run,))).status
    assert status.code is Code.DIVERGED
    assert "'pressure'" in status.message
    assert "'run 7'" in status.message


def test_a_nan_cost_is_named() -> None:
    problem = settling(0.02)
    bad = Cost("energy", ca.Function("f", [q := ca.SX.sym("q", 3)], [ca.log(q[2] - 1.5)]), Where.PARAMETERS)
    solution = solve_full_space(replace(problem, costs=(bad,)))
    assert solution.status.code is Code.DIVERGED
    assert "'energy'" in solution.status.message
    assert np.isnan(solution.cost)
    assert np.isinf(solution.largest_violation)


@pytest.mark.parametrize("fields", [{"max_iterations": 0}, {"tolerance": 0.0}, {"max_seconds": -1.0}])
def test_bad_options_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(fields))):
        FullSpace(**fields)  # type: ignore[arg-type]
