"""A design that holds on other plants: P control of an integrator, whose answer in the face of tolerances is known."""

import math

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.plants import ExpectedPlants, expected_plants
from pneuopt.evaluation.requirements import IAE, Overshoot, PeakControl, SettlingTime
from pneuopt.evaluation.scenarios import apply_scenario
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import FirstOrder, Integrator
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.robust import Hardening
from pneuopt.tuning.search import certified_objective
from pneuopt.tuning.simulator import to_records
from pneuopt.tuning.tolerances import NEARBY
from pneuopt.tuning.tune import prepare_search, prepare_task, tune

STEP, MOST = Step(1.0, horizon=2.0), 10.0  # a command of Kp V at the step: half of the gains off by 1 % exceed MOST


def integrator() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(Integrator().system(), PID(limits=False))
    given = loop.parameters.with_values({"plant.gain": 1.0, "pid.Kp": 5.0, "pid.b": 1.0})
    return loop, given.with_bounds({"pid.Kp": (0.1, 20.0)}).freed("pid.Kp")


def tuned(*, robust: bool = True, **options: object) -> TuningResult:
    loop, given = integrator()
    limits = [PeakControl(MOST)]
    return tune(loop, STEP, given, minimise=SettlingTime(), subject_to=limits, robust=robust, **options)  # type: ignore[arg-type]


def test_the_design_backs_off_by_what_the_plants_add_and_says_the_price() -> None:
    """Kp may be 1 % off, so that 10/1.01 V is kept by all; settling takes ln 50/Kp, 1 % longer."""
    nominal, best = tuned(robust=False), tuned()
    assert best.validation is not None
    assert best.validation.held >= 99
    assert best.parameters.value("pid.Kp") == pytest.approx(MOST / 1.01, rel=5e-3)  # of which the search leaves 0.3 %
    time, high = math.log(50) / best.parameters.value("pid.Kp"), float(best.validation.figures["p95"]["SettlingTime"])
    assert best.status.verdict == (
        f"settles in {time:.3g} s, {high:.3g} s on 95 of 100 plants; keeps all limits on {best.validation.held}"
    )
    price = best.parameters.value("pid.Kp") / nominal.parameters.value("pid.Kp")
    words = f"{100 * (1 / price - 1):.2g} % slower than the fastest nominal design, which holds on "
    assert any(sentence.startswith(words) for sentence in best.status.sentences), best.status.sentences


def test_the_plants_that_choose_are_not_those_that_judge() -> None:
    _, given = integrator()
    plants = expected_plants(given)
    assert len(plants.vetting) == len(plants.scenarios)
    gains, others = (
        [apply_scenario(given, values).value("plant.gain") for values in rows.values()]
        for rows in (plants.scenarios, plants.vetting)
    )
    assert not set(gains) & set(others)
    assert abs(np.corrcoef(gains, others)[0, 1]) < 0.3


def test_plants_without_others_to_choose_by_leave_the_design_nominal() -> None:
    _, given = integrator()
    plants = expected_plants(given, count=20)
    nominal = tuned(robust=False).parameters.value("pid.Kp")
    assert tuned(plants=plants.scenarios).parameters.value("pid.Kp") == nominal
    assert tuned(plants={}).parameters.value("pid.Kp") == nominal
    assert tuned(plants={}).status.verdict == f"settles in {math.log(50) / nominal:.3g} s; keeps all limits"
    assert tuned(plants=plants).parameters.value("pid.Kp") < nominal


def test_where_no_design_holds_the_verdict_says_so_first_and_it_stays_certified() -> None:
    """Half of the plants are too slow for the limit, whatever the gain that the bounds allow."""
    loop, given = integrator()
    slow = {f"vetting plant {k}": {"plant.gain": 0.2 if k % 2 else 1.0} for k in range(20)}
    plants = ExpectedPlants({f"plant {k}": values for k, values in enumerate(slow.values())}, (), vetting=slow)
    most = SettlingTime(max=2 * math.log(50) / 20)
    best = tune(loop, STEP, given, minimise=IAE(), subject_to=[most], plants=plants)
    assert best.status.code is Code.CONVERGED
    lead = "holds on 10 of 20 plants: SettlingTime breaks on 10; no design found holds on 19"
    assert best.status.verdict == lead
    assert best.status.sentences[1].startswith("IAE ")
    assert lead in " ".join(repr(best).split())


def test_a_plant_on_which_the_last_design_fails_or_is_worst_becomes_a_case() -> None:
    loop, given = integrator()
    gains = {"slow": 0.8, "usual": 1.0, "quick": 1.2, "dead": 0.01}
    vetting = {n: {"plant.gain": k} for n, k in gains.items()}
    plants = ExpectedPlants({"plant": {"plant.gain": 1.0}}, (), vetting=vetting)
    chosen = list[set[str]]()
    worst = Hardening.worst_plants

    def record(state: Hardening) -> set[str]:
        chosen.append(worst(state))
        return chosen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hardening, "worst_plants", record)
        found = tune(loop, STEP, given, minimise=SettlingTime(), subject_to=[PeakControl(MOST)], plants=plants)
    assert chosen == [{"dead"}] * 2, "no gain allowed moves it in time, and no other plant breaks anything"
    assert found.trail is not None
    assert found.trail["best"].max() == 3


def test_finalists_that_hold_on_more_plants_make_a_search_needless() -> None:
    """PI on a lag: all that settle alike keep the overshoot by more or less room."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    ranges = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}
    given = loop.parameters.with_bounds(ranges).freed(*ranges)
    asked = {"minimise": SettlingTime(), "subject_to": [Overshoot(0.05), PeakControl(4.0)]}
    best = tune(loop, Step(1.0), given, method=Racing(trials=100), **asked)  # type: ignore[arg-type]
    assert best.trail is not None
    assert list(best.trail.index[:2]) == ["nominal", "finalists"]
    assert (np.diff(best.trail["best"]) >= 0).all()
    assert best.validation is not None
    assert best.validation.is_robust


def test_finalists_are_hardly_worse_than_the_best_and_lie_apart() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    ranges = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}
    given = loop.parameters.with_bounds(ranges).freed(*ranges)
    task = prepare_task(loop, Step(1.0), given, specify(IAE(), [Overshoot(0.05), PeakControl(4.0)]))
    search = prepare_search(task, Racing(trials=40))
    found = search.run()
    values = search.simulator.values(found.finalists, search.spec)
    best = certified_objective(search.spec, found)
    assert len(found.finalists) > 1
    assert (values["IAE"] <= 1.06 * best).all()
    assert all(not search.spec.violations(row) for row in to_records(values))
    unit = np.array([search.space.to_unit(point) for point in found.finalists])
    apart = np.abs(unit[:, None] - unit).max(axis=2)
    assert apart[~np.eye(len(unit), dtype=bool)].min() > NEARBY


def test_ctrl_c_in_the_search_for_a_robust_design_leaves_the_nominal_one_as_the_best(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Hardening, "worst_plants", interrupt)
    _, given = integrator()
    found = tuned(throw=False)
    assert (found.status.code, found.validation) == (Code.INTERRUPTED, None)
    assert found.parameters == given
    assert found.best["pid.Kp"] == tuned(robust=False).parameters.value("pid.Kp")
    assert "interrupted" in str(found.status)
