"""Other structures of the controller: what a certificate holds is named, the best adopted, the rest said to fail."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pneuopt.control.compensators import DeadZoneInverse
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID, Form
from pneuopt.control.reference import Reference, Step
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.files.drive import read_fit
from pneuopt.files.tuned import check_certificate, write_tuned
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.structure import STRUCTURES, Ground, try_structures
from pneuopt.tuning.tune import certify, prepare_search, prepare_task, tune

QUICK = Racing(members=8, trials=40)
STEP = Step(0.1, initial=0.05, horizon=1.2)
ASKED: dict[str, Any] = {"minimise": SettlingTime(0.02), "subject_to": [Overshoot(0.05)]}
DRIVE = """
[drive]
kind = "pneumatic"
[valve]
dead_zone = 0.1
rounding = 0.005
[friction]
model = "stribeck"
coulomb = "2 N"
static = "2 N"
"""
TUNING = """
[loop]
measured = "position"
[pid]
sample_time = "2 ms"
limits = ["-5 V", "5 V"]
Kp = { value = "10 V/m", lower = "1 V/m", upper = "100 V/m", free = true }   # of the position
[[reference]]
step = "0.1 m"
initial = "0.05 m"
horizon = "1.2 s"
[minimise]
settling_time = { band = "2 %" }
[limits]
overshoot = "5 %"
"""


def closed_valve() -> tuple[ClosedLoop, ParameterSet]:
    """A position loop whose valve is closed within 0.5 V: at 100 V/m within 5 mm of the reference, a band is 1 mm."""
    loop = ClosedLoop(PneumaticDrive().system(), PID(sample_time=2e-3), measured="position")
    values = {"valve.dead_zone": 0.1, "valve.rounding": 0.005, "friction.coulomb": 2.0, "friction.static": 2.0}
    values |= {"pid.Kp": 10.0, "pid.lower": -5.0, "pid.upper": 5.0}
    given = loop.parameters.with_values(values).with_bounds({"pid.Kp": (1.0, 100.0)}).freed("pid.Kp")
    return loop, given


@cache
def found(*, structure: bool) -> TuningResult:
    loop, given = closed_valve()
    return tune(loop, STEP, given, **ASKED, method=QUICK, plants={}, throw=False, structure=structure)


def test_what_a_dead_zone_forbids_is_proposed_with_its_inverse() -> None:
    """No gain keeps the limits, and nothing is adopted unasked; the status says what would."""
    best = found(structure=False)
    assert best.status.code is Code.INFEASIBLE
    assert best.loop is None
    assert best.structure == ()
    assert best.parameters == closed_valve()[1]
    assert best.structures is not None
    assert best.structures.loc["dead-zone inverse", "status"] == "certified"
    named = [sentence for sentence in best.status.sentences if "(certified)" in sentence]
    assert [sentence.partition(":")[0] for sentence in named] == ["dead-zone inverse of 0.5 V"]


def test_the_proposed_design_is_certified_by_itself() -> None:
    """The row's gains in a loop that a user builds hold; without the inverse the same gains do not."""
    table, (loop, given) = found(structure=False).structures, closed_valve()
    assert table is not None
    plain = given.with_values({"pid.Kp": table["pid.Kp"].to_dict()["dead-zone inverse"]})
    inverse = replace(loop, compensators=(DeadZoneInverse(),))
    full = (inverse.parameters | plain).with_values({"dead_zone_inverse.width": 0.1 * given.value("valve.span")})
    proof = certify(inverse, STEP, full, **ASKED, plants={})
    assert proof.status.converged
    assert proof.certified.loc["SettlingTime"].max() == pytest.approx(
        table["objective"].to_dict()["dead-zone inverse"], rel=1e-6
    )
    assert not certify(loop, STEP, plain, **ASKED, plants={}, throw=False).status.converged


def test_the_best_structure_is_adopted_where_it_is_asked_for() -> None:
    best = found(structure=True)
    assert best.status.converged
    assert best.loop is not None
    assert [part.section for part in best.loop.compensators] == ["dead_zone_inverse"]
    assert set(best.structure) == {"dead_zone_inverse.width", "dead_zone_inverse.smoothing"}
    assert best.given == {"pid.Kp": 10.0}
    assert certify(best.loop, STEP, best.parameters, **ASKED, plants={}).status.converged
    assert any("adopted" in sentence for sentence in best.status.sentences)


def test_a_tuned_file_has_the_adopted_structure(tmp_path: Path) -> None:
    """Its section stands in the file, whose certificate holds for what it says."""
    drive, tuning, tuned = (tmp_path / n for n in ("drive.toml", "tuning.toml", "tuned.toml"))
    drive.write_text(DRIVE, "utf-8")
    tuning.write_text(TUNING, "utf-8")
    stored = read_fit(drive)
    task = read_tuning(tuning, stored.drive.system(), stored.parameters)
    given = stored.parameters | task.parameters
    own: dict[str, Any] = {"minimise": task.specification, "plants": {}, "throw": False}
    best = tune(task.loop, task.references, given, **own, method=QUICK, structure=True)
    assert best.structure
    write_tuned(tuned, tuning, best, fit=stored)
    again = read_tuning(tuned, stored.drive.system(), stored.parameters)
    assert again.loop.compensators == (DeadZoneInverse(),)
    assert again.parameters.value("dead_zone_inverse.width") == pytest.approx(0.5)
    assert again.parameters["pid.Kp"].free
    check = check_certificate(stored, tuned)
    assert check is not None
    assert check.holds
    proof = certify(again.loop, again.references, stored.parameters | again.parameters, **own)
    assert proof.status.converged


def test_no_more_time_is_taken_than_the_tuning_took() -> None:
    """With no CPU time to spend nothing is tried, and that is said of each."""
    loop, given = closed_valve()
    search = prepare_search(prepare_task(loop, STEP, given, specify(**ASKED)), QUICK)
    tried = try_structures(search, found(structure=False), 0.0)
    assert tried.table is None
    assert not tried.better
    assert set(tried.endings) == {"dead-zone inverse", "pressure feedback", "acceleration feedback"}
    assert all(ending.startswith("not tried") for ending in tried.endings.values())


def test_an_interrupted_trial_says_so() -> None:
    def interrupt(_text: str) -> None:
        raise KeyboardInterrupt

    loop, given = closed_valve()
    search = prepare_search(prepare_task(loop, STEP, given, specify(**ASKED)), QUICK, interrupt)
    tried = try_structures(search, found(structure=False), np.inf)
    assert tried.stopped
    assert not tried.better


def ground(loop: ClosedLoop, reference: Reference, form: Form = Form.PARALLEL) -> Ground:
    values = {"pid.Kp": 20.0, "pid.Ki": 10.0} if form is Form.PARALLEL else {"pid.Kp": 20.0, "pid.Ti": 2.0}
    if "valve.dead_zone" in loop.parameters:
        values["valve.dead_zone"] = 0.1
    given = loop.parameters.with_values(values).with_bounds({"pid.Kp": (1.0, 100.0)}).freed("pid.Kp")
    task = prepare_task(loop, reference, given, specify(SettlingTime(0.02), ()))
    search = prepare_search(task, QUICK)
    return Ground(search, search.space.parameters)


STEPS_TO, MOVES_TO = STEP, Move(0.05, speed=0.2, acceleration=2.0, initial=0.05)
PNEUMATIC, FORCE, LINEAR = PneumaticDrive().system(), ForceDrive(Stribeck()).system(), FirstOrder().system()
POSITION_PARTS = {"dead-zone inverse", "no integral", "reset integral", "pressure feedback", "acceleration feedback"}
SETTINGS: dict[str, tuple[Any, ...]] = {
    "position, valve": (PNEUMATIC, "position", PID(sample_time=2e-3), STEPS_TO, POSITION_PARTS),
    "moves, valve": (PNEUMATIC, "position", PID(sample_time=2e-3), MOVES_TO, {*POSITION_PARTS, "friction feedforward"}),
    "position, continuous": (FORCE, "position", PID(), STEPS_TO, {"no integral"}),
    "position, Ti": (FORCE, "position", PID(form=Form.STANDARD), STEPS_TO, {"no integral"}),
    "speed, force": (FORCE, "speed", PID(sample_time=2e-3), Step(0.1), {"friction feedforward"}),
    "no axis": (LINEAR, None, PID(sample_time=2e-3), Step(1.0), set()),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_only_what_the_plant_admits_is_tried(name: str) -> None:
    """And each loop with a part more can run, its free parameters within finite bounds, the rest as it was."""
    plant, measured, pid, reference, wanted = SETTINGS[name]
    state = ground(ClosedLoop(plant, pid, measured=measured), reference, pid.form)
    suiting = [structure for structure in STRUCTURES if structure.suits(state)]
    assert {structure.name for structure in suiting} == wanted
    for structure in suiting:
        change = structure.make(state)
        full = change.loop.complete(state.parameters) | change.parameters
        change.loop.check(full)
        assert all(full[n] == p for n, p in state.parameters.items() if n not in change.parameters)
        bounds = [(p.lower, p.upper) for p in change.parameters.values() if p.free]
        assert np.isfinite(bounds).all()
        assert structure.size in ("", *change.parameters)
