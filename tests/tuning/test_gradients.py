"""Max-type problems with known answers.

Gradients of a search: exact slopes, known optima, and every limit certified in every scenario.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    ControlRate,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Requirement,
    Ripple,
    RiseTime,
    SettlingTime,
    SteadyStateError,
    StepEnvelope,
)
from pneuopt.evaluation.scenarios import Scenarios, corners, tolerances
from pneuopt.evaluation.specification import specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.linear import Integrator
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.gradients import (
    SQP,
    LinearisedPoint,
    LinearisedProblem,
    RowGroups,
    descend,
    nonsmooth_terms,
    sensitivity_rollout,
    solve_quadratic_program,
)
from pneuopt.tuning.method import TuningTask
from pneuopt.tuning.racing import Racing, run_racing
from pneuopt.tuning.simulator import Simulator, to_records
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import TuningResult, choose_method, tune

Index = NDArray[np.intp]


class Analytic:
    """Rows and slopes as functions of z; a linear objective."""

    def __init__(self, rows: Callable[[Array], tuple[Array, Array]], gradient: Array, groups: RowGroups, group: Index):
        self.rows, self.gradient, self.groups, self.group = rows, gradient, groups, group
        self.bounds, self.scales = np.tile([-5.0, 5.0], (len(gradient), 1)), np.ones(len(gradient))
        self.evaluations = 0

    def evaluate(self, z: Array) -> Sequence[LinearisedPoint]:
        self.evaluations += len(z)
        return [
            LinearisedPoint(x, float(self.gradient @ x), self.gradient, *self.rows(x), self.group, self.groups)
            for x in z
        ]

    def improve(self, point: LinearisedPoint) -> LinearisedPoint:
        return point


MINIMAX = RowGroups(np.ones(1), np.array([-np.inf]))
PENALTY = RowGroups(np.array([20.0]), np.zeros(1))


def cb2(x: Array) -> tuple[Array, Array]:
    """Charalambous and Conn 1978: the minimum of the largest is 1.95222 at (1.13904, 0.89956)."""
    e = 2 * np.exp(x[1] - x[0])
    values = np.array([x[0] ** 2 + x[1] ** 4, (2 - x[0]) ** 2 + (2 - x[1]) ** 2, e])
    return values, np.array([[2 * x[0], 4 * x[1] ** 3], [-2 * (2 - x[0]), -2 * (2 - x[1])], [-e, e]])


@pytest.mark.parametrize("start", [(1.0, -0.1), (3.0, 2.0), (-2.0, 1.0)])
def test_the_largest_of_three_functions(start: tuple[float, float]) -> None:
    problem = Analytic(cb2, np.zeros(2), MINIMAX, np.zeros(3, dtype=np.intp))
    (found,) = descend(problem, np.array([start]), 60)
    assert found.merit == pytest.approx(1.9522245, abs=2e-4)
    assert found.z == pytest.approx([1.13904, 0.89956], abs=0.03)


def test_a_linear_objective_on_a_circle() -> None:
    """Minimise x + y within the unit circle: -sqrt 2; the penalty is exact."""

    def circle(x: Array) -> tuple[Array, Array]:
        return np.array([x @ x - 1]), 2 * x[None]

    problem = Analytic(circle, np.ones(2), PENALTY, np.zeros(1, dtype=np.intp))
    for found in descend(problem, np.array([[2.0, 1.0], [-3.0, 0.5], [0.1, 0.2]]), 60):
        assert found.merit == pytest.approx(-np.sqrt(2), abs=1e-3)
        assert found.values.max() < 1e-4


def test_a_step_that_makes_it_worse_is_refused() -> None:
    """Slopes of the wrong sign: every step of the program leads uphill, so the start stands, and the descent ends."""

    def misleading(x: Array) -> tuple[Array, Array]:
        return np.array([x @ x]), -2 * x[None]

    problem = Analytic(misleading, np.zeros(2), MINIMAX, np.zeros(1, dtype=np.intp))
    (found,) = descend(problem, np.array([[1.0, 2.0]]), 40)
    assert found.z.tolist() == [1.0, 2.0]
    assert found.merit == 5.0
    assert problem.evaluations < 60


def test_the_best_line_through_a_parabola_has_the_known_error() -> None:
    """Chebyshev: x^2 on [-1, 1] is a line within 1/2 and no less, the rows 2 x 201; a vertex, found in few steps."""
    t = np.linspace(-1, 1, 201)
    A = np.column_stack([np.ones_like(t), t])

    def rows(z: Array) -> tuple[Array, Array]:
        e = A @ z - t**2
        return np.concatenate([e, -e]), np.concatenate([A, -A])

    problem = Analytic(rows, np.zeros(2), MINIMAX, np.zeros(402, dtype=np.intp))
    (found,) = descend(problem, np.array([[3.0, -2.0]]), 20)
    assert found.merit == pytest.approx(0.5, abs=1e-6)
    assert problem.evaluations < 20


def test_a_program_solves_the_linear_program_that_scipy_solves() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        n, m, g = 4, 120, 3
        groups = RowGroups(np.array([1.0, 5.0, 3.0]), np.array([-np.inf, 0.0, 0.0]))
        group, slopes, values = rng.integers(g, size=m), rng.normal(size=(m, n)), rng.normal(size=m)
        point = LinearisedPoint(rng.uniform(0, 1, n), 0.0, rng.normal(size=n), values, slopes, group, groups)
        step = solve_quadratic_program(point, np.tile([0.0, 1.0, 0.3], (n, 1)))
        A = np.hstack([slopes, -np.eye(g)[group]])
        box = [(max(-0.3, -z), min(0.3, 1 - z)) for z in point.z] + [(None, None), (0, None), (0, None)]
        exact = linprog(np.concatenate([point.gradient, groups.weights]), A, -values, bounds=box)
        assert point.predict_merit(step) == pytest.approx(exact.fun, abs=1e-3)


def test_a_point_that_is_no_number_is_left() -> None:
    def rows(z: Array) -> tuple[Array, Array]:
        bad = z[0] > 0.5
        return np.array([np.nan if bad else -z[0]]), np.array([[-1.0]])

    problem = Analytic(rows, np.zeros(1), MINIMAX, np.zeros(1, dtype=np.intp))
    (found,) = descend(problem, np.zeros((1, 1)), 40, SQP(radius=1.0))
    assert 0.45 < found.z[0] <= 0.5
    assert np.isfinite(found.merit)


STEP = Step(1.0, horizon=2.0)
QUICK = Racing(members=8, trials=40, polish=16)
SPEC = specify(SettlingTime(), [Overshoot(0.1), SteadyStateError(0.05), PeakControl(200.0), MaxSensitivity(1.6)])


def integrator(sample_time: float | None = None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(Integrator().system(), PID(sample_time=sample_time, limits=False))
    given = loop.parameters.with_values({"plant.gain": 1.0, "pid.Kp": 5.0})
    return loop, given.with_bounds({"pid.Kp": (2.0, 20.0)}).freed("pid.Kp")


def friction_loop(dither: Dither | None = None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=1e-3), dither)
    values = {"friction.coulomb": 40.0, "friction.static": 70.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 80.0, "pid.Kp": 200.0, "pid.Ki": 500.0, "pid.lower": -300.0, "pid.upper": 300.0}
    bounds = {"pid.Kp": (10.0, 1000.0), "pid.Ki": (1.0, 10000.0), "pid.Kd": (0.0, 1.0)}
    bounds |= {"dither.amplitude": (1.0, 50.0)} if dither else {}
    values |= {"dither.amplitude": 5.0} if dither else {}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


def problem(loop: ClosedLoop, given: ParameterSet, steps: list[Step], scenarios: Scenarios) -> LinearisedProblem:
    simulator = Simulator(loop, steps, search_space(loop, given), scenarios)
    return LinearisedProblem(simulator, sensitivity_rollout(simulator), SPEC, 60, 1.0)


@pytest.mark.parametrize("dither", [None, Dither(80.0)])
def test_slopes_are_those_of_finite_differences(dither: Dither | None) -> None:
    """From rest and from motion, where the rest itself moves with the gains; a plant and a tolerance beside."""
    loop, given = friction_loop(dither)
    scenarios = {"heavy": {"load.mass": 1.3 * given.value("load.mass")}, **tolerances(given, {"pid.Kp": 0.1})}
    posed = problem(loop, given, [Step(0.1, horizon=0.3), Step(0.1, at=0.05, initial=0.05, horizon=0.3)], scenarios)
    rng = np.random.default_rng(2)
    n = len(posed.bounds) - 1
    z = np.append(rng.uniform(0.3, 0.6, n), 0.2037)
    (point,) = posed.evaluate(z[None])
    for k in range(n + 1):
        nudge = 1e-6 * (np.arange(n + 1) == k)
        above, below = posed.evaluate(np.array([z + nudge, z - nudge]))
        slopes = (above.values - below.values) / 2e-6
        scale = np.abs(point.slopes[:, k]).max() + 1e-3
        off = np.abs(slopes - point.slopes[:, k])
        assert np.quantile(off, 0.99) < 2e-3 * scale, k
        assert np.median(off) < 1e-5 * scale, k


def test_a_peak_has_slopes_near_its_limit_and_none_far_below() -> None:
    """Far below it no step reaches the limit, and a frequency response a gain is saved."""
    loop, given = friction_loop(Dither(80.0))
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, given))
    rollout = sensitivity_rollout(simulator)
    peak = float(simulator.values(simulator.space.start[None], SPEC)["MaxSensitivity"][0])
    unit, found = simulator.space.to_unit(simulator.space.start)[None], []
    for share in (0.5, 0.8, 0.95):
        spec = specify(SettlingTime(), [MaxSensitivity(peak / share)])
        posed = LinearisedProblem(simulator, rollout, spec, 60, 1.0)
        (point,) = posed.evaluate(posed.start(unit))
        row = int(np.argmax(point.group))
        assert point.values[row] == pytest.approx(share - 1, abs=0.02)
        found.append(point.slopes[row] / share)
    assert not found[0].any()
    assert np.abs(found[1]).max() > 0.01
    assert found[1] == pytest.approx(found[2], rel=1e-6)


TUBE = StepEnvelope(((0.0, -0.2, 1.3), (0.1, 0.7, 1.2)), max=1.0)
FURTHER: list[Requirement] = [IAE(), ISE(), ITAE(), TUBE, ControlRate(), MaxComplementarySensitivity(), NoiseGain()]
FURTHER += [GainMargin(), PhaseMargin()]


@pytest.mark.parametrize("requirement", FURTHER, ids=lambda q: type(q).__name__)
def test_further_kinds_are_read_as_the_metrics_and_have_their_slopes(requirement: Requirement) -> None:
    loop, given = friction_loop(Dither(80.0))
    spec = specify({requirement: 1.0})
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, given), {}, spec)
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 1000, 1.0)
    n = len(posed.bounds) - 1
    z = np.append(np.full(n, 0.45), 0.5)
    (point,) = posed.evaluate(z[None])
    measured = simulator.values(simulator.space.from_unit(z[None, :-1]), spec)[type(requirement).__name__]
    assert point.merit == pytest.approx(float(measured[0]), rel=5e-3)
    k = int(np.argmax(np.where(point.group == 0, point.values, -np.inf)))
    for i in range(n):
        nudge = 1e-5 * (np.arange(n + 1) == i)
        above, below = posed.evaluate(np.array([z + nudge, z - nudge]))
        slope = (above.values[k] - below.values[k]) / 2e-5
        assert point.slopes[k, i] == pytest.approx(slope, rel=2e-2, abs=2e-3 * np.abs(point.slopes[k]).max() + 1e-9), i


def test_an_integral_is_minimised_within_limits() -> None:
    loop, given = friction_loop()
    best = tune(
        loop,
        Step(0.1, horizon=0.4),
        given,
        minimise=ITAE(),
        subject_to=[ControlRate(4e4), TUBE],
        method=QUICK,
        plants={},
    )
    assert best.status.converged
    assert best.certified.loc["ControlRate"].max() <= 4e4
    assert best.certified.loc["StepEnvelope"].max() <= 1.0


def test_what_has_no_gradient_is_named() -> None:
    loop, given = friction_loop(Dither(80.0))
    free = given.with_bounds({"dither.frequency": (40.0, 100.0)}).freed("dither.frequency")
    spec = specify({RiseTime(): 1.0, IAE(): 1.0}, [Ripple(0.1)])
    assert nonsmooth_terms(loop, search_space(loop, free), spec) == ["RiseTime", "Ripple", "dither.frequency"]


@pytest.mark.parametrize("requirement", [RiseTime(), Ripple()])
def test_what_has_no_gradient_is_searched_without(requirement: Requirement) -> None:
    loop, given = friction_loop(Dither(80.0))
    best = tune(
        loop,
        Step(0.1, horizon=0.3),
        given,
        minimise=requirement,
        subject_to=[SteadyStateError(0.05)],
        method=QUICK,
        plants={},
    )
    assert best.status.converged


def test_gradients_find_what_an_evolution_leaves() -> None:
    """Few trials end away from the optimum; gradients lead there, whatever the seed."""
    loop, given = friction_loop()
    step, spec = Step(0.1, horizon=0.3), specify(SettlingTime(), [Overshoot(0.05), PeakControl(100.0)])
    task = TuningTask(loop, (step,), {}, search_space(loop, given), spec)
    simulator, times = Simulator(loop, [step], task.space, {}, spec), dict[int, list[float]]()
    for polish in (0, 16):
        methods = [Racing(8, 30, polish=polish, seed=seed) for seed in range(3)]
        runs = [run_racing(task, simulator, spec, m, task.space.start, lambda _: None).point for m in methods]
        values = simulator.values(np.array(runs), spec)
        assert not any(spec.violations(row) for row in to_records(values))
        times[polish] = sorted(values["SettlingTime"].tolist())
    assert times[16][-1] <= times[0][0]
    assert times[16][-1] <= 1.02 * times[16][0]


def test_the_best_settling_time_is_the_one_that_is_measured() -> None:
    loop, given = friction_loop()
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, given), corners(given, {"load.mass": 0.3}))
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), specify(SettlingTime()), 1000, 1.0)
    unit = np.array([[0.3, 0.95, 0.0], [0.6, 0.9, 0.0]])
    measured = simulator.values(simulator.space.from_unit(unit), specify(SettlingTime()))["SettlingTime"]
    found = [posed.improve(point) for point in posed.evaluate(posed.start(unit))]
    assert np.isfinite(measured).all()
    for point, expected in zip(found, measured, strict=True):
        assert point.z[-1] * posed.horizon == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("sample_time", "share"), [(None, 0.01), (1e-3, 0.015)])
def test_a_tolerance_spreads_the_candidate_not_the_start(sample_time: float | None, share: float) -> None:
    """The peak 1.1 Kp is held to 11, wherever the search began; the slowest is 10 % below the gain found."""
    loop, given = integrator(sample_time)
    best = tune(
        loop,
        STEP,
        given,
        minimise=SettlingTime(),
        subject_to=[PeakControl(11.0)],
        scenarios=tolerances(given, {"pid.Kp": 0.1}),
        method=QUICK,
        plants={},
    )
    assert best.parameters.value("pid.Kp") == pytest.approx(10.0, rel=0.01)
    assert best.certified["0 to 1 [pid.Kp high]"]["PeakControl"] <= 11.0
    assert best.certified["0 to 1 [pid.Kp low]"]["SettlingTime"] == pytest.approx(math.log(50) / 9.0, rel=share)


IN_CORNERS = (Overshoot(0.05), MaxSensitivity(1.5), SteadyStateError(0.02))


@cache
def on_corners(*limits: Requirement) -> TuningResult:
    loop, given = friction_loop(Dither(80.0))
    spreads: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, ("friction.coulomb", "friction.static"): 0.2}
    scenarios, step = corners(given, spreads), Step(0.1, horizon=0.3)
    aim = SettlingTime(mean=True)
    return tune(loop, step, given, minimise=aim, subject_to=limits, scenarios=scenarios, method=QUICK, plants={})


def test_limits_are_kept_in_every_corner() -> None:
    best = on_corners(*IN_CORNERS)
    assert best.status.converged
    assert best.certified.shape[1] == 5
    assert bool((best.certified.loc["Overshoot"] <= 5.0).all())
    assert bool((best.certified.loc["MaxSensitivity"] <= 1.5).all())
    assert bool((best.certified.loc["SteadyStateError"] <= 2.0).all())
    assert best.stats["deviation.SettlingTime"] < 2e-3


def test_a_limit_holds_the_answer_back() -> None:
    free = on_corners(*IN_CORNERS).certified
    most = 0.85 * free.loc["PeakControl"].to_numpy(dtype=float).max()
    held = on_corners(*IN_CORNERS, PeakControl(most))
    assert held.certified.loc["PeakControl"].max() <= most
    assert held.certified.loc["SettlingTime"].max() > 1.02 * free.loc["SettlingTime"].max()
    assert "PeakControl" in held.active


def test_ctrl_c_keeps_the_given_gains() -> None:
    loop, given = friction_loop()

    def stop(_: str) -> None:
        raise KeyboardInterrupt

    result = tune(loop, Step(0.1), given, minimise=SettlingTime(), method=QUICK, throw=False, progress=stop, plants={})
    assert result.status.code is Code.INTERRUPTED
    assert result.parameters.value("pid.Kp") == given.value("pid.Kp")


@pytest.mark.parametrize(("friction", "kind"), [(Viscous(), "TwoPhase"), (Stribeck(), "Racing")])
def test_a_race_is_chosen_for_all_that_has_no_exact_problem(friction: Viscous | Stribeck, kind: str) -> None:
    loop = ClosedLoop(ForceDrive(friction).system(), PID())
    given = loop.parameters.with_bounds({"pid.Kp": (1.0, 10.0)}).freed("pid.Kp")
    space, spec = search_space(loop, given), specify(SettlingTime())
    assert type(choose_method(TuningTask(loop, (STEP,), {}, space, spec))).__name__ == kind
    heavy: Scenarios = {"heavy": {"load.mass": 9.0}}
    assert type(choose_method(TuningTask(loop, (STEP,), heavy, space, spec))).__name__ == "Racing"
