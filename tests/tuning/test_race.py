"""A race drops only what has lost: whoever beats its rival comes through with the merit of its whole responses."""

from collections.abc import Sequence

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.evaluation.band import Tolerance
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
from pneuopt.evaluation.specification import Objective, specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.tuning.merit import compute_merits
from pneuopt.tuning.race import Race, may_be_cut
from pneuopt.tuning.readings import loop_pieces
from pneuopt.tuning.responses import Responses
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space

BOUNDS = {"pid.Kp": (50.0, 600.0), "pid.Ki": (100.0, 8000.0), "pid.Kd": (0.0, 1.0)}
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
    bounds = BOUNDS | ({"dither.amplitude": (0.0, 30.0)} if dither else {})
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
    monkeypatch.setattr("pneuopt.tuning.race.MAX_RECORDED_NUMBERS", 50_000)
    parts, _ = race.race(given, rivals, worst)
    assert np.array_equal(whole, parts)
