"""The race as a method: the same answer by the same seed, the best so far at Ctrl-C, starts that differ in kind.

A race drops only what has lost: whoever beats its rival comes through with the merit of its whole responses.

Success-history differential evolution: known optima, the same by the same seed, and a race's bounds are enough.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    ROBUSTNESS_REQUIREMENTS,
    MaxSensitivity,
    Overshoot,
    PeakControl,
    Requirement,
    RiseTime,
    SettlingTime,
)
from pneuopt.evaluation.response import cases
from pneuopt.evaluation.specification import Objective, specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder, Integrator
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.feasibility import plant_integrates
from pneuopt.tuning.gradients import Polish
from pneuopt.tuning.method import TuningTask
from pneuopt.tuning.racing import (
    Race,
    Racing,
    RacingResult,
    SuccessHistory,
    _Phase,
    _RacingSearch,
    add_structure,
    compute_merits,
    describe_candidate,
    first_population,
    is_stalled,
    may_be_cut,
    run_racing,
)
from pneuopt.tuning.simulator import Responses, Simulator
from pneuopt.tuning.space import loop_pieces, search_space
from pneuopt.tuning.tolerances import FINE_SHARE, MOST_STARTS, SAME_OBJECTIVE, STALLED_GENERATIONS

BOUNDS = {"pid.Kp": (50.0, 600.0), "pid.Ki": (100.0, 8000.0)}
STEP, SPEC = Step(0.1, horizon=0.2), specify(SettlingTime(), [Overshoot(0.1)])
SMALL = Racing(members=8, trials=60, polish=0)


def posed(dither: Dither | None = None) -> tuple[TuningTask, Simulator]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(), dither)
    values = {"friction.coulomb": 40.0, "friction.static": 50.0, "pid.Kp": 100.0, "pid.Ki": 1000.0}
    values |= {"pid.lower": -300.0, "pid.upper": 300.0} | ({"dither.amplitude": 5.0} if dither else {})
    bounds = BOUNDS | ({"dither.amplitude": (0.0, 30.0)} if dither else {})
    given = loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)
    task = TuningTask(loop, (STEP,), {"heavy": {"load.mass": 9.0}}, search_space(loop, given), SPEC)
    return task, Simulator(loop, task.references, task.space, task.scenarios, SPEC)


def merit(simulator: Simulator, point: np.ndarray) -> float:
    return float(compute_merits(simulator.values(point[None], SPEC), SPEC, STEP.horizon)[0])


def search(method: Racing = SMALL, stop: str = "never", dither: Dither | None = None) -> tuple[RacingResult, list[str]]:
    (task, simulator), heard = posed(dither), list[str]()

    def hear(line: str) -> None:
        heard.append(line)
        if line.startswith(stop) and any("coarse" in earlier for earlier in heard):
            raise KeyboardInterrupt

    return run_racing(task, simulator, SPEC, method, task.space.start, hear), heard


def test_a_seed_decides() -> None:
    first, again, other = (search(m)[0] for m in (SMALL, SMALL, Racing(8, 60, polish=0, seed=1)))
    assert np.array_equal(first.point, again.point)
    assert first.count == again.count
    assert not np.array_equal(first.point, other.point)


def test_the_budget_is_in_trials() -> None:
    """All that it simulates beside them is the populations, once a phase, and each new best on whole responses."""
    found, heard = search()
    assert found.is_complete
    generations = sum("generation" in line for line in heard)
    assert generations * 8 >= 0.8 * 60 * 2
    assert found.count <= 60 * 2 * (MOST_STARTS + FINE_SHARE) + 8 * 12


def test_it_is_never_worse_than_the_given_gains() -> None:
    task, simulator = posed()
    found, _ = search(Racing(members=5, trials=1, polish=0))
    assert merit(simulator, found.point) <= merit(simulator, task.space.start)


def test_ctrl_c_in_a_later_start_gives_the_end_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pneuopt.tuning.racing.REPORT_SECONDS", 0.0)
    found, heard = search(stop="wide bands")
    assert not found.is_complete
    assert found.starts == 1
    ended = [line for line in heard if line.startswith("coarse samples")][-1]
    _, simulator = posed()
    said = float(ended.split("best: SettlingTime ")[1].split()[0])
    assert merit(simulator, found.point) == pytest.approx(said, rel=2e-3)


def test_a_second_start_tries_hardly_any_dither(monkeypatch: pytest.MonkeyPatch) -> None:
    ranked, merits = list[np.ndarray](), Race.merits

    def note(race: Race, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ranked.append(points[:, 2])
        return merits(race, points)

    monkeypatch.setattr(Race, "merits", note)
    found, _ = search(dither=Dither(100.0))
    assert found.starts in (2, 3)
    assert 1 <= found.agreeing <= 2
    populations = [amplitudes.max() for amplitudes in ranked if len(amplitudes) == 8]
    assert populations[0] > 15.0
    assert min(populations) <= 0.02 * 30.0


def test_a_start_that_lags_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """It searches the wide bands and no more, and counts as a start that does not agree."""
    phases = list[list[str]]()
    for lagging in (np.inf, 0.0):
        monkeypatch.setattr("pneuopt.tuning.racing.LAGGING", lagging)
        found, heard = search()
        phases.append([line.split(",")[0] for line in heard])
    begun = [sum(a != b == "coarse samples" for a, b in itertools.pairwise(part)) for part in phases]
    assert begun[0] in (2, 3)
    assert begun[1] == 1
    assert (found.starts, found.agreeing) == (MOST_STARTS, 1)
    assert phases[1][-1] == "fine samples"


def test_gradients_see_whole_responses_on_fine_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse samples are gamed, and a response that is cut ends at another operating point, with other margins."""
    seen = list[tuple[float, float]]()

    def note(_: Polish, unit: np.ndarray, on: Simulator, iterations: int) -> tuple[np.ndarray, int]:
        assert iterations == 3
        seen.append((on.grids[0].t[-1], on.grids[0].spacing))
        return unit, 0

    monkeypatch.setattr(Polish, "improve", note)
    _, simulator = posed(Dither(500.0))
    whole, fine = STEP.horizon, simulator.grids[0].spacing
    assert simulator.coarse(SPEC).grids[0].spacing > 1.5 * fine
    monkeypatch.setattr("pneuopt.tuning.racing.CUT_SETTLING_TIMES", 0.0)  # trials see 15 % of the horizon
    search(Racing(members=8, trials=60, polish=3), dither=Dither(500.0))
    assert len(seen) >= 2
    assert {spacing for _, spacing in seen} == {fine}
    assert [end for end, _ in seen] == pytest.approx([whole] * len(seen), abs=fine)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_best_point_of_responses_that_were_cut_is_proved_on_the_whole(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials see 40 of 2000 ms, and an overshoot that passes through the band just then has settled, as they see it."""
    monkeypatch.setattr("pneuopt.tuning.racing.CUT_SETTLING_TIMES", 0.0)
    monkeypatch.setattr("pneuopt.tuning.racing.LEAST_CUT", 0.02)
    loop, spec = ClosedLoop(FirstOrder().system(), PID(limits=False)), specify(SettlingTime())
    bounds = {"pid.Kp": (0.1, 5.0), "pid.Ki": (1.0, 200.0)}
    given = loop.parameters.with_values({"pid.Ki": 10.0}).with_bounds(bounds).freed(*bounds)
    space = search_space(loop, given)
    simulator = Simulator(loop, (Step(1.0, horizon=2.0),), space, {}, spec)
    draws, told = np.random.default_rng(seed), list[str]()
    monkeypatch.setattr("pneuopt.tuning.racing.REPORT_SECONDS", 0.0)
    search = _RacingSearch(simulator, spec, 2.0, space.to_unit(space.start), draws, told.append)
    population, merits = search.evolve(draws.random((8, 2)), _Phase("fine samples", simulator, 160))
    whole = Race(simulator, spec, 2.0).merits(space.from_unit(population[:1]))[0]
    assert merits[0] == pytest.approx(whole[0])
    assert f"best: SettlingTime {whole[0]:.4g} s, about" in told[-1]


@pytest.mark.parametrize(("last", "ends"), [((1.0, 3.0), True), ((1.0, 2.99), False), ((0.99, 3.0), False)])
def test_a_phase_ends_where_best_and_median_stand(last: tuple[float, float], ends: bool) -> None:
    """A best one that stands alone is waited for: the others have not yet followed it."""
    stand = [(1.0, 3.0)] * STALLED_GENERATIONS + [last]
    assert is_stalled(stand, np.array([1.0, 3.0])) == ends
    assert not is_stalled(stand[1:], np.array([1.0, 3.0]))


def test_the_result_says_how_many_starts_agree() -> None:
    task, simulator = posed()
    found = SMALL.find(task, simulator, SPEC.with_stability(), task.space.start, 0, lambda _: None)
    assert found.status.code is Code.CONVERGED
    assert found.agreement is not None
    agreement = found.agreement
    assert (agreement.agreeing >= 2) == (agreement.spread <= SAME_OBJECTIVE)
    assert agreement.starts == MOST_STARTS or agreement.agreeing == 2


@pytest.mark.parametrize(("ends", "starts"), [((1.0, 1.005), 2), ((1.0, 1.2, 1.1), 3), ((1.0, 1.2, 0.999), 3)])
def test_a_third_start_begins_only_where_two_disagree(
    ends: tuple[float, ...], starts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = list(ends)

    def end(search: _RacingSearch, population: Array, *_: object) -> tuple[Array, Array]:
        search._bests.append(population[0])
        return population, np.full(len(population), left.pop(0))

    monkeypatch.setattr(_RacingSearch, "_search", end)
    found, _ = search()
    best, second = sorted(ends)[:2]
    assert found.starts == starts
    assert found.agreeing == sum(value <= 1.01 * best for value in ends)
    assert found.spread == pytest.approx(second / best - 1)


def position_space(*names: str) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(), Dither(100.0), measured="position")
    bounds = {"pid.Kp": (1.0, 5e3), "pid.Ki": (0.0, 1e3), "pid.Tf": (1e-3, 1e-2), "dither.amplitude": (0.0, 30.0)}
    bounds = {n: bounds[n] for n in names}
    values = {"pid.Kp": 1e3, "pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


def test_a_population_has_designs_of_each_kind_exactly() -> None:
    names = ("pid.Kp", "pid.Ki", "pid.Tf", "dither.amplitude")
    loop, given = position_space(*names)
    step = Step(0.1, horizon=0.5)
    simulator = Simulator(loop, (step,), search_space(loop, given), {}, specify(SettlingTime()))
    drawn = first_population(20, np.full(4, 0.5), np.random.default_rng(0))
    found = simulator.space.from_unit(add_structure(drawn, simulator))
    for n, value in (("pid.Tf", 1e-3), ("pid.Tf", 1e-2), ("dither.amplitude", 0.0), ("dither.amplitude", 30.0)):
        assert (found[:, names.index(n)] == value).sum() == 2
    assert (found[:, 1] == 0).sum() == 11  # half of them, for a position integrates, and one with the given gains
    assert np.array_equal(found[0], simulator.space.from_unit(drawn[0]))
    whole = simulator.space.from_unit(add_structure(drawn, simulator, 1.0))
    assert (whole[:, 1] == 0).all()


def test_what_integrates_is_seen_by_a_pole_at_zero_in_the_measured_signal() -> None:
    loop, given = position_space("pid.Kp")
    linear = {
        n: ClosedLoop(plant.system(), PID(limits=False)) for n, plant in (("lag", FirstOrder()), ("ramp", Integrator()))
    }
    loops = {"position": (loop, given), "speed": posed_loop()} | {n: (x, x.parameters) for n, x in linear.items()}
    found = {}
    for n, (loop, given) in loops.items():
        (case,) = cases([Step(0.1, horizon=0.5)], {}, given)
        found[n] = plant_integrates(
            loop, case, search_space(loop, given.with_bounds({"pid.Kp": (0.1, 9e3)}).freed("pid.Kp"))
        )
    assert found == {"position": True, "speed": False, "lag": False, "ramp": True}


def posed_loop() -> tuple[ClosedLoop, ParameterSet]:
    task, _ = posed()
    return task.loop, task.space.parameters


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"SettlingTime": 0.21, "Overshoot": 0.01, "MaxSensitivity": 1.5}, "best: SettlingTime 0.21 s"),
        ({"SettlingTime": 0.21, "Overshoot": 0.073, "MaxSensitivity": 1.61}, "closest: Overshoot 7.3 of 5 %"),
        ({"SettlingTime": 0.21, "Overshoot": 0.01, "MaxSensitivity": 1.9}, "closest: MaxSensitivity 1.9 of 1.6"),
        ({"SettlingTime": np.nan, "Overshoot": 0.9, "MaxSensitivity": 1.9}, "closest: no SettlingTime yet"),
        ({"SettlingTime": 0.21, "Overshoot": 0.9, "MaxSensitivity": np.inf}, "closest: no MaxSensitivity yet"),
    ],
)
def test_a_search_reports_figures_of_the_user_never_a_penalty(values: dict[str, float], said: str) -> None:
    spec = specify(SettlingTime(), [Overshoot(0.05), MaxSensitivity(1.6)])
    assert describe_candidate(values, spec, posed_loop()[0]) == said


BOUNDS_RACE = {"pid.Kp": (50.0, 600.0), "pid.Ki": (100.0, 8000.0), "pid.Kd": (0.0, 1.0)}
STEPS = [Step(0.1, horizon=0.2), Step(-0.2, at=0.02, initial=0.1, horizon=0.2)]
PUSH = [Step(0.0, initial=0.1, at=0.02, horizon=0.2, disturbance={"load.force": 20.0})]
HEAVY = {"heavy": {"load.mass": 9.0}, "light": {"load.mass": 3.0}}
LIMITS = [Overshoot(0.1), PeakControl(100.0)]
KINDS = {
    "continuous": (PID(), None, STEPS),
    "dither": (PID(), Dither(100.0), STEPS),
    "sampled": (PID(sample_time=2e-3), None, STEPS),
    "sampled dither": (PID(sample_time=2e-3), Dither(100.0), STEPS[:1]),
    "disturbance": (PID(), None, PUSH),
}


def make_simulator(kind: str, minimise: Objective, limits: Sequence[Requirement] = ()) -> Simulator:
    pid, dither, steps = KINDS[kind]
    sensor = Encoder(1e-6) if kind == "sampled" else None
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), pid, dither, sensor=sensor)
    values = {"friction.coulomb": 40.0, "friction.static": 50.0, "pid.Kp": 200.0, "pid.Ki": 2000.0}
    values |= {"pid.lower": -300.0, "pid.upper": 300.0} | ({"dither.amplitude": 5.0} if dither else {})
    bounds = BOUNDS_RACE | ({"dither.amplitude": (0.0, 30.0)} if dither else {})
    given = loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)
    loop = add_disturbances(loop, steps)
    given = loop.parameters | given
    return Simulator(loop, steps, search_space(loop, given), HEAVY, specify(minimise, limits))


def points(simulator: Simulator, m: int = 24) -> np.ndarray:
    found = simulator.space.from_unit(np.random.default_rng(1).random((m, len(simulator.space.names))))
    if "dither.amplitude" in simulator.space.names:
        found[::3, simulator.space.names.index("dither.amplitude")] = 0.0
    return np.asarray(found)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("minimise", "limits"),
    [
        (SettlingTime(0.1), LIMITS),
        (SettlingTime(Tolerance(0.015)), LIMITS),
        ({ITAE(): 1.0, IAE(): 0.1, ISE(): 0.1, PeakControl(): 1e-3}, [MaxSensitivity(1.3), Overshoot(0.2)]),
    ],
    ids=["settling", "tolerance", "integrals"],
)
def test_who_beats_its_rival_comes_through_and_nobody_else(
    kind: str, minimise: Objective, limits: list[Requirement]
) -> None:
    simulator, spec = make_simulator(kind, minimise, limits), specify(minimise, limits)
    race, given = Race(simulator, spec, 0.2), points(simulator)
    merits, worst = race.merits(given)
    values = simulator.values(given, spec)
    assert np.array_equal(merits, compute_merits(values, spec, 0.2))
    rng = np.random.default_rng(0)
    for share in (0.1, 0.4):
        rivals = rng.permutation(np.quantile(merits, np.clip(share + 0.2 * rng.random(len(merits)), 0, 1)))
        raced, loser = race.race(given, rivals, rng.permutation(worst))
        won = merits <= rivals
        assert won.any()
        assert raced[won] == pytest.approx(merits[won], rel=1e-12)
        assert np.array_equal(loser[won], worst[won])
        assert (raced[~won] > rivals[~won]).all()
    assert race.count == 3 * len(given)


def test_the_vm_finds_the_same_winners() -> None:
    spec = specify(SettlingTime(0.1), LIMITS)
    simulator = make_simulator("sampled", SettlingTime(0.1), LIMITS)
    given = points(simulator, 4)
    race = Race(simulator, spec, 0.2)
    merits, worst = race.merits(given)
    rivals = np.full(len(given), np.median(merits))
    quick, _ = race.race(given, rivals, worst)
    simulator.rollout = Rollout(loop_pieces(simulator.loop), lanes=0)
    slow, _ = Race(simulator, spec, 0.2).race(given, rivals, worst)
    assert np.array_equal(quick <= rivals, slow <= rivals)
    assert slow[slow <= rivals] == pytest.approx(quick[quick <= rivals], rel=1e-9)


def test_a_rival_saves_most_of_the_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a good rival only a few responses are run to their end, and read."""
    simulator, spec = make_simulator("dither", SettlingTime(0.1), LIMITS), specify(SettlingTime(0.1), LIMITS)
    race, given, lanes = Race(simulator, spec, 0.2), points(simulator), list[int]()
    merits, worst = race.merits(given)
    read = Simulator.read

    def count(simulator: Simulator, p: np.ndarray, *rest: object) -> object:
        lanes.append(len(p))
        return read(simulator, p, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Simulator, "read", count)
    race.race(given, np.full(len(given), merits.min()), worst)
    assert lanes == [len(simulator.cases)]


def test_margins_are_read_of_those_only_that_can_still_win(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit on a margin can only raise a merit; beside a bound the others get one too."""
    limits = [*LIMITS, MaxSensitivity(1.3)]
    simulator, spec = make_simulator("sampled", SettlingTime(0.1), limits), specify(SettlingTime(0.1), limits)
    race, given, judged = Race(simulator, spec, 0.2), points(simulator), list[int]()
    merits, worst = race.merits(given)
    read = Responses.with_margins

    def count(responses: Responses, rows: np.ndarray) -> dict[str, np.ndarray]:
        judged.append(int(rows.sum()))
        return read(responses, rows)

    monkeypatch.setattr(Responses, "with_margins", count)
    rivals = np.full(len(given), np.quantile(merits, 0.2))
    bounded, raced = race.merits(given, rivals)[0], race.race(given, rivals, worst)[0]
    won = merits <= rivals
    for found in (bounded, raced):
        assert found[won] == pytest.approx(merits[won], rel=1e-12)
        assert (found[~won] > rivals[~won]).all()
    plain = spec.without(ROBUSTNESS_REQUIREMENTS)
    ahead = compute_merits(simulator.values(given, plain), plain, 0.2) <= rivals
    assert judged == [ahead.sum()] * 2
    assert won.sum() <= ahead.sum() < len(given)


def test_a_response_cut_short_settles_when_the_whole_one_does() -> None:
    spec = specify(SettlingTime(0.2))
    for kind in ("dither", "sampled"):
        simulator = make_simulator(kind, SettlingTime(0.2))
        race, given = Race(simulator, spec, 0.2), points(simulator)
        merits, worst = race.merits(given)
        race.cut(0.15)
        assert race.is_cut
        quick = merits < 0.13
        assert quick.any()
        raced, _ = race.race(given[quick], np.full(quick.sum(), np.inf), worst[quick])
        assert raced == pytest.approx(merits[quick], rel=1e-9)


def test_what_grows_after_settling_forbids_a_cut() -> None:
    assert may_be_cut(specify(SettlingTime(), [*LIMITS, MaxSensitivity(2.0)]))
    for minimise, limits in ((SettlingTime(), [RiseTime(0.1)]), ({SettlingTime(): 1.0, ITAE(): 1.0}, LIMITS)):
        assert not may_be_cut(specify(minimise, limits))


def test_many_points_are_raced_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = specify(SettlingTime(0.1), LIMITS)
    simulator = make_simulator("continuous", SettlingTime(0.1), LIMITS)
    given = points(simulator)
    race = Race(simulator, spec, 0.2)
    merits, worst = race.merits(given)
    rivals = np.full(len(given), np.median(merits))
    whole, _ = race.race(given, rivals, worst)
    monkeypatch.setattr("pneuopt.tuning.racing.Race.most_numbers", 50_000)
    parts, _ = race.race(given, rivals, worst)
    assert np.array_equal(whole, parts)


Merit = Callable[[np.ndarray], np.ndarray]


def sphere(x: np.ndarray) -> np.ndarray:
    return np.asarray(((x - 0.3) ** 2).sum(axis=1))


def valley(x: np.ndarray) -> np.ndarray:
    """Rosenbrock's, its optimum at 0.75 of the unit cube in every coordinate."""
    z = 4 * x - 2
    return np.asarray((100 * (z[:, 1:] - z[:, :-1] ** 2) ** 2 + (1 - z[:, :-1]) ** 2).sum(axis=1))


def search_of_shade(merit: Merit, seed: int, generations: int, *, races: bool = False, n: int = 4) -> SuccessHistory:
    rng = np.random.default_rng(seed)
    population = rng.random((30, n))
    history = SuccessHistory(population, merit(population), rng)
    for _ in range(generations):
        trials = history.propose()
        assert trials.min() >= 0
        assert trials.max() <= 1
        merits = merit(trials)
        history.select(trials, np.where(merits > history.merits, np.inf, merits) if races else merits)
    return history


@pytest.mark.parametrize(("merit", "optimum", "generations"), [(sphere, 0.3, 120), (valley, 0.75, 400)])
def test_it_finds_a_known_optimum(merit: Merit, optimum: float, generations: int) -> None:
    for seed in range(3):
        history = search_of_shade(merit, seed, generations)
        best = history.population[np.argmin(history.merits)]
        assert best == pytest.approx(np.full(4, optimum), abs=1e-4)


def test_a_seed_decides_and_a_bound_is_as_good_as_the_merit_of_what_has_lost() -> None:
    plain, raced, other = (
        search_of_shade(valley, 1, 40),
        search_of_shade(valley, 1, 40, races=True),
        search_of_shade(valley, 2, 40),
    )
    assert np.array_equal(plain.population, raced.population)
    assert np.array_equal(plain.merits, raced.merits)
    assert not np.array_equal(plain.population, other.population)


def test_merits_count_by_their_ratio() -> None:
    """Neither the objective's unit nor what never settles, which counts a million, decides what is learned."""
    assert np.array_equal(
        search_of_shade(sphere, 5, 30).population, search_of_shade(lambda x: 4096 * sphere(x), 5, 30).population
    )


def test_a_tie_moves_on() -> None:
    """On a plateau members move, but teach nothing."""
    history = search_of_shade(lambda x: np.zeros(len(x)), 0, 10)
    assert np.ptp(history.population, axis=0).min() > 0
