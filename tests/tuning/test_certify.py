"""Gains certified as they stand, by the proof of `tune` without its search."""

import re

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.rest_check import NoHunting
from pneuopt.evaluation.scenarios import corners
from pneuopt.evaluation.specification import specify
from pneuopt.files.results import load_result
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.tune import certify, tune

STEP = Step(1.0)
LIMITS = [Overshoot(0.05), MaxSensitivity(1.6)]


def first_order(Kp: float = 2.0, Ki: float = 20.0) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    return loop, loop.parameters.with_values({"pid.Kp": Kp, "pid.Ki": Ki})


def test_a_tuned_design_gets_the_figures_that_tune_has_certified() -> None:
    loop, given = first_order()
    given = given.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    best = tune(loop, STEP, given, minimise=SettlingTime(), subject_to=LIMITS)
    again = certify(loop, STEP, best.parameters, minimise=SettlingTime(), subject_to=LIMITS)
    assert again.status.code is Code.CONVERGED
    assert again.parameters == best.parameters
    assert again.certified.equals(best.certified)
    assert again.claimed.isna().all(axis=None)
    assert again.validation is not None
    assert best.validation is not None
    assert again.validation.held == best.validation.held
    assert (again.best, again.limits) == ({}, best.limits)


def test_every_broken_limit_is_named_with_its_excess_and_its_worst_plant() -> None:
    loop, gains = first_order(Kp=0.1)
    plants = corners(gains, {"plant.gain": 0.5})
    with pytest.raises(ConvergenceError, match="the gains are NOT converged") as caught:
        certify(loop, STEP, gains, subject_to=LIMITS, scenarios=plants)
    result = caught.value.solution
    assert result.status.code is Code.NOT_CERTIFIED
    (told,) = re.findall(r"^Overshoot is (\S+) at (.*), allowed 0.05: off by (\S+) %$", result.status.verdict)
    worst = result.certified.loc["Overshoot"].max() / 100
    assert float(told[0]) == pytest.approx(worst, rel=1e-4)
    assert float(told[2]) == pytest.approx(100 * (worst / 0.05 - 1), rel=1e-2)
    assert told[1] == result.certified.loc["Overshoot"].idxmax() == "0 to 1 [plant.gain high]"
    assert result.candidate is None
    assert result.parameters == gains


def test_a_defect_is_refused_unless_it_is_accepted() -> None:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    gains = loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 30.0})
    found = certify(loop, STEP, gains, throw=False)
    assert (found.status.code, found.validation) == (Code.NOT_CERTIFIED, None)
    assert "unstable" in found.status.verdict
    assert found.certificate is not None
    accepted = certify(loop, STEP, gains, accept=tuple(Defect), plants={}, throw=False)
    assert accepted.status.converged


def test_a_metric_that_was_minimised_must_have_a_value() -> None:
    loop, gains = first_order(Kp=0.1, Ki=0.5)
    found = certify(loop, STEP, gains, minimise=SettlingTime(), throw=False)
    assert "the loop does not settle within its horizon" in found.status.sentences
    assert certify(loop, Step(1.0, horizon=20.0), gains, minimise=SettlingTime(), plants={}).status.converged


def test_what_cannot_be_certified_is_refused() -> None:
    loop, gains = first_order()
    with pytest.raises(InputError, match="holds its limits"):
        certify(loop, STEP, gains, minimise=specify(SettlingTime()), subject_to=LIMITS)
    with pytest.raises(InputError, match="give rig="):
        certify(loop, STEP, gains, subject_to=[NoHunting()])


def test_ctrl_c_while_the_plants_are_tried_certifies_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pneuopt.tuning.tune.validate_design", interrupt)
    loop, gains = first_order()
    found = certify(loop, STEP, gains, subject_to=LIMITS, throw=False)
    assert (found.status.code, found.candidate, found.parameters) == (Code.INTERRUPTED, None, gains)
    assert "not tried on other plants" in str(found.status)


def test_its_result_is_saved_and_read_again(tmp_path: object) -> None:
    loop, gains = first_order()
    found = certify(loop, STEP, gains, subject_to=LIMITS, plants={})
    found.save(f"{tmp_path}/found.json")
    again = load_result(f"{tmp_path}/found.json")
    assert again.certified.equals(found.certified)
    assert np.isnan(again.claimed.to_numpy(dtype=float)).all()
    assert again.status == found.status
