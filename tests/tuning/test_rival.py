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
from pneuopt.evaluation.requirements import Overshoot, PeakControl, SettlingTime, SettlingTimeRaw
from pneuopt.evaluation.specification import specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.racing import Racing, compute_merits
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
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


def test_a_dither_is_handed_out_only_where_its_own_verdict_is_useful() -> None:
    """By the verdict against the rival that the result names, either way round."""
    best, (loop, given) = found(), shaken()
    assert best.status.converged
    assert best.dither is not None
    assert set(best.rival) == set(BOUNDS)
    other = given.with_values(best.rival)
    dithered, plain = (other, best.parameters) if best.rival["dither.amplitude"] > 0 else (best.parameters, other)
    verdict = judge_dither(loop, STEP, dithered, without=plain)
    assert verdict.usefulness is best.dither.usefulness
    assert (verdict.usefulness is Usefulness.USEFUL) == (best.parameters.value("dither.amplitude") > 0)


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
