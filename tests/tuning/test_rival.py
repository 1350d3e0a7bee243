"""The choice between a design with dither and its rival without: what is handed out is worth its ripple."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.dither import Usefulness, judge_dither
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import IAE, Overshoot, PeakControl, SettlingTime, SettlingTimeRaw
from pneuopt.evaluation.specification import specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning import rival
from pneuopt.tuning.racing import Racing, compute_merits
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.rival import weigh_dither
from pneuopt.tuning.search import Search
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, search_space
from pneuopt.tuning.tune import prepare_search, prepare_task, tune

STEP, QUICK = Step(0.1, horizon=0.4), Racing(members=8, trials=40)
BOUNDS = {"pid.Kp": (10.0, 1000.0), "pid.Ki": (1.0, 10000.0), "dither.amplitude": (0.0, 50.0)}


def shaken(amplitude: float = 0.0) -> tuple[ClosedLoop, ParameterSet]:
    """A force drive with friction, whose dither of 50 N swings the speed by three times the settling band."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=1e-3), Dither(80.0))
    values = {"friction.coulomb": 40.0, "friction.static": 70.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 80.0, "pid.Kp": 200.0, "pid.Ki": 500.0, "pid.lower": -300.0, "pid.upper": 300.0}
    given = loop.parameters.with_values(values | {"dither.amplitude": amplitude}).with_bounds(BOUNDS)
    return loop, given.freed(*BOUNDS)


@cache
def found(*, mean: bool = False) -> TuningResult:
    loop, given = shaken()
    return tune(loop, STEP, given, minimise=SettlingTime(mean=mean or None), method=QUICK, plants={})


def dithered_search() -> tuple[Search, TuningResult]:
    """A search for a small IAE, and its certified design with a dither of 20 N, which gains nothing."""
    loop, given = shaken()
    search = prepare_search(prepare_task(loop, STEP, given, specify(IAE())), QUICK)
    design = search.certify_point(np.array([500.0, 9000.0, 20.0]))
    assert design.status.converged
    return search, design


def test_a_dither_that_is_not_useful_is_left_out_for_the_rival() -> None:
    """The rival is tuned without, certified, and better; the verdict and the dithered design stand beside."""
    search, design = dithered_search()
    choice = weigh_dither(search, design, search.spec)
    assert choice.verdict is not None
    assert choice.verdict.usefulness is not Usefulness.USEFUL
    assert choice.result.status.converged
    assert choice.result.parameters.value("dither.amplitude") == 0
    assert choice.rival == {n: design.parameters.value(n) for n in BOUNDS}
    assert choice.words.startswith("left out: the dither of 20 N at 80 Hz is ")
    before, after = (float(r.requirements["certified"]["IAE"]) for r in (design, choice.result))
    assert after < before


def test_a_dither_that_is_useful_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    search, design = dithered_search()
    verdict = judge_dither(search.task.loop, STEP, design.parameters)
    useful = replace(verdict, usefulness=Usefulness.USEFUL)
    monkeypatch.setattr(rival, "judge_dither", lambda *_, **__: useful)
    choice = weigh_dither(search, design, search.spec)
    assert (choice.result, choice.verdict) == (design, useful)
    assert choice.rival["dither.amplitude"] == 0


def test_a_dither_that_must_be_is_not_weighed() -> None:
    search, design = dithered_search()
    bounded = design.parameters.with_bounds({"dither.amplitude": (1.0, 50.0)})
    kept = replace(search, task=replace(search.task, space=Space(bounded, search.space.names)))
    assert weigh_dither(kept, design, search.spec).verdict is None


def test_what_is_handed_out_settles_with_its_ripple() -> None:
    loop, _ = shaken()
    proof = evaluate(loop, STEP, found().parameters)[STEP.label]
    assert math.isfinite(proof["SettlingTimeRaw"])


def test_the_mean_counts_where_it_is_asked_for_by_name() -> None:
    best = found(mean=True)
    assert best.dither is None
    assert "SettlingTimeRaw" not in best.requirements.index


def test_a_signal_that_leaves_the_band_by_its_ripple_ranks_behind_one_that_stays() -> None:
    """Its mean settles, sooner even: for a search of the signal it counts as one that never does."""
    loop, given = shaken()
    space, spec = search_space(loop, given), specify(SettlingTime())
    points = np.array([[200.0, 9000.0, 0.0], [200.0, 9000.0, 50.0]])
    values = Simulator(loop, [STEP], space, spec=spec.on_signal()).values(points, spec.on_signal())
    assert values["SettlingTime"][1] < values["SettlingTime"][0]
    assert not math.isfinite(values["SettlingTimeRaw"][1])
    still, shaking = compute_merits(values, spec.on_signal(), 0.4)
    assert still < 1 < shaking
    by_mean = compute_merits(values, spec, 0.4)
    assert by_mean.max() < 1


@pytest.mark.parametrize("limit", [None, 0.3])
def test_the_signal_counts_beside_a_limit_on_the_mean(limit: float | None) -> None:
    asked = specify(SettlingTime(max=limit), [Overshoot(0.05)])
    spec = asked.on_signal()
    assert [type(q) for q in spec.weights] == [SettlingTimeRaw]
    assert spec.settling is SettlingTimeRaw
    assert spec.limit(SettlingTimeRaw) == spec.limit(SettlingTime) == asked.limit(SettlingTime)
    assert spec.limit(Overshoot) == 0.05
    assert spec.on_signal().weights == spec.weights
    named = specify(SettlingTime(mean=True))
    assert named.on_signal().weights == named.weights


def test_a_rival_that_lags_behind_is_given_up() -> None:
    """With nothing in sight that could beat it a search takes a fraction of the simulations."""
    loop, given = shaken()
    plain = given.fixed("dither.amplitude")
    task = prepare_task(loop, STEP, plain, specify(SettlingTime(), [PeakControl(200.0)]))
    method = Racing(members=8, trials=200)
    whole, given_up = (prepare_search(replace(task, to_beat=b), method).run() for b in (math.inf, 1e-3))
    assert whole.status.code is given_up.status.code is Code.CONVERGED
    assert given_up.stats["simulations"] < 0.7 * whole.stats["simulations"]
