"""Verbs take a drive as well as its system, one log or step as well as several; a mix-up is named. A row a verb."""

from collections.abc import Callable, Mapping
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import pneuopt as po

H = 1e-3  # [s]
T = H * np.arange(60)
DRIVE = po.FirstOrder()
SYSTEM = DRIVE.system()
FREED = SYSTEM.parameters.freed("plant.gain")
DRIVEN = po.Trajectory(T, {"valve_voltage": np.sign(np.sin(200 * T))})
READ = po.simulate(SYSTEM, DRIVEN, SYSTEM.parameters)["speed"] + np.random.default_rng(1).normal(0, 1e-3, len(T))
LOG = po.Experiment(DRIVEN.with_columns({"speed": READ}), {"speed": 1e-3}, name="run")
STEP = po.Step(1.0, horizon=0.3)
LOOP = po.ClosedLoop(SYSTEM, po.PID())
GAINS = LOOP.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 20.0})
RANGES = {"pid.Kp": (0.1, 5.0), "pid.Ki": (0.0, 50.0)}
TUNED = GAINS.with_bounds(RANGES).freed(*RANGES)


def select(model: Any, logs: Any, parameters: Any) -> pd.DataFrame:
    known = parameters.fixed("*") if isinstance(parameters, po.ParameterSet) else parameters
    found = po.select_model({"one": model, "same": model}, logs, known, free=["plant.gain"], held_out=logs)
    return found.table.drop(columns="message")


def tune(model: Any, steps: Any, parameters: Any) -> pd.DataFrame:
    method = po.Racing(members=5, trials=1, polish=0)
    loop = po.ClosedLoop(model, po.PID())
    return po.tune(loop, steps, parameters, minimise=po.IAE(), method=method, throw=False, plants={}).certified


def simulate(model: Any, inputs: Any, parameters: Any) -> pd.DataFrame:
    return po.simulate(model, inputs, parameters).to_frame()


Verb = Callable[[Any, Any, Any], pd.DataFrame]
VERBS: Mapping[str, tuple[Verb, Any, po.ParameterSet, str]] = {  # verb, what it is given, parameters, argument
    "identify": (lambda m, x, p: po.identify(m, x, p).estimates, LOG, FREED, "experiments"),
    "validate": (po.validate, LOG, FREED, "experiments"),
    "identifiability": (lambda m, x, p: po.identifiability(m, x, p).table, LOG, FREED, "experiments"),
    "select_model": (select, LOG, FREED, "experiments"),
    "predict": (lambda m, x, p: po.predict(m, x, p).to_frame(), LOG, FREED, "experiment"),
    "simulate": (simulate, DRIVEN, FREED, "inputs"),
    "tune": (tune, STEP, TUNED, "references"),
    "evaluate": (lambda m, x, p: po.evaluate(po.ClosedLoop(m, po.PID()), x, p), STEP, GAINS, "references"),
}
TAKE_ONE = ("predict", "simulate")
every_verb = pytest.mark.parametrize("name", VERBS)


@every_verb
def test_a_verb_takes_a_drive_as_well_as_its_system(name: str) -> None:
    verb, given, parameters, _ = VERBS[name]
    pd.testing.assert_frame_equal(verb(DRIVE, given, parameters), verb(SYSTEM, given, parameters))


@pytest.mark.parametrize("name", [n for n in VERBS if n not in TAKE_ONE])
def test_a_verb_takes_one_as_well_as_several(name: str) -> None:
    verb, given, parameters, _ = VERBS[name]
    pd.testing.assert_frame_equal(verb(SYSTEM, given, parameters), verb(SYSTEM, [given], parameters))


@every_verb
@pytest.mark.parametrize("model", ["drive.toml", Path("drive.toml"), po.ForceDrive, (DRIVE, FREED), None, LOG])
def test_what_is_no_drive_is_named(name: str, model: Any) -> None:
    verb, given, parameters, _ = VERBS[name]
    with pytest.raises(
        po.InputError, match=r"^(system|model|plant|candidates\['one'\]) takes a drive .* got .*"
    ) as told:
        verb(model, given, parameters)
    came = "'drive.toml'" if isinstance(model, str | Path) else getattr(model, "__name__", type(model).__name__)
    assert came in str(told.value)


@every_verb
@pytest.mark.parametrize("given", ["run_01.csv", Path("run_01.csv"), ["run_01.csv"], FREED, SYSTEM, None])
def test_what_is_no_log_or_step_is_named(name: str, given: Any) -> None:
    verb, _, parameters, argument = VERBS[name]
    with pytest.raises(po.InputError, match=rf"^{argument} takes an? .*; got "):
        verb(SYSTEM, given, parameters)


@every_verb
@pytest.mark.parametrize("parameters", [{"plant.gain": 1.0}, LOG, [STEP], None])
def test_what_are_no_parameters_is_named(name: str, parameters: Any) -> None:
    verb, given, _, _ = VERBS[name]
    with pytest.raises(po.InputError, match=r"^parameters takes a ParameterSet, .*; got an object of type"):
        verb(SYSTEM, given, parameters)


@pytest.mark.parametrize("loop", [DRIVE, SYSTEM, "tuning.toml", GAINS])
def test_what_is_no_loop_is_named(loop: Any) -> None:
    for verb in (
        lambda: po.evaluate(loop, STEP, GAINS),
        lambda: po.tune(loop, STEP, TUNED, minimise=po.IAE(), plants={}),
        lambda: po.validate_design(loop, STEP, GAINS, minimise=po.IAE(), scenarios={"same": {}}),
        lambda: po.judge_dither(loop, STEP, GAINS),
    ):
        with pytest.raises(
            po.InputError, match=r"^loop takes a ClosedLoop, such as ClosedLoop\(drive, PID\(\)\).*; got "
        ):
            verb()


def test_swapped_arguments_of_a_loop_are_named() -> None:
    with pytest.raises(po.InputError, match=r"^plant takes a drive .* got an object of type PID"):
        po.ClosedLoop(po.PID(), DRIVE)  # type: ignore[arg-type]


def test_a_loop_holds_the_system_of_its_drive_and_is_edited_by_copy() -> None:
    loop = po.ClosedLoop(DRIVE, po.PID())
    assert isinstance(loop.plant, po.System)
    assert replace(loop, pid=po.PID(sample_time=H)).plant is loop.plant
    with pytest.raises(FrozenInstanceError):
        loop.plant = SYSTEM  # type: ignore[misc]
    with pytest.raises(TypeError, match="plant"):
        po.ClosedLoop(pid=po.PID())
