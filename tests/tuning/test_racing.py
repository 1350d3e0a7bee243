"""The race as a method: the same answer by the same seed, the best so far at Ctrl-C, starts that differ in kind."""

import itertools

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.status import Code
from pneuopt.tuning.merit import compute_merits
from pneuopt.tuning.method import TuningTask
from pneuopt.tuning.polish import Polish
from pneuopt.tuning.race import Race
from pneuopt.tuning.racing import PATIENCE, Racing, RacingResult, _is_done, _Phase, _RacingSearch, run_racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space

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
    assert found.count <= 2 * 60 * 2 + 8 * 8


def test_it_is_never_worse_than_the_given_gains() -> None:
    task, simulator = posed()
    found, _ = search(Racing(members=5, trials=1, polish=0))
    assert merit(simulator, found.point) <= merit(simulator, task.space.start)


def test_ctrl_c_in_a_later_start_gives_the_end_of_the_first() -> None:
    found, heard = search(stop="wide bands")
    assert not found.is_complete
    assert found.starts == 1
    ended = [line for line in heard if line.startswith("coarse samples")][-1]
    _, simulator = posed()
    assert merit(simulator, found.point) == pytest.approx(float(ended.split("best ")[1]), rel=2e-3)


def test_a_second_start_tries_hardly_any_dither(monkeypatch: pytest.MonkeyPatch) -> None:
    ranked, merits = list[np.ndarray](), Race.merits

    def note(race: Race, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ranked.append(points[:, 2])
        return merits(race, points)

    monkeypatch.setattr(Race, "merits", note)
    found, _ = search(dither=Dither(100.0))
    assert found.starts == 2
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
    assert begun == [2, 1]
    assert (found.starts, found.agreeing) == (2, 1)
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
    search = _RacingSearch(simulator, spec, 2.0, space.to_unit(space.start), draws, told.append)
    population, merits = search.evolve(draws.random((8, 2)), _Phase("fine samples", simulator, 160))
    whole = Race(simulator, spec, 2.0).merits(space.from_unit(population[:1]))[0]
    assert merits[0] == pytest.approx(whole[0])
    assert told[-1].endswith(f"best {whole[0]:.4g}")


@pytest.mark.parametrize(("last", "ends"), [((1.0, 3.0), True), ((1.0, 2.99), False), ((0.99, 3.0), False)])
def test_a_phase_ends_where_best_and_median_stand(last: tuple[float, float], ends: bool) -> None:
    """A best one that stands alone is waited for: the others have not yet followed it."""
    stand = [(1.0, 3.0)] * PATIENCE + [last]
    assert _is_done(stand, np.array([1.0, 3.0])) == ends
    assert not _is_done(stand[1:], np.array([1.0, 3.0]))


def test_the_result_says_how_many_starts_agree() -> None:
    task, simulator = posed()
    found = SMALL.find(task, simulator, SPEC.with_stability(), task.space.start, 0, lambda _: None)
    assert found.status.code is Code.CONVERGED
    assert found.stats["starts"] == 2
    assert found.stats["starts_agreeing"] in (1, 2)
