"""The words of each refusal of the room: what triggers it, the error's type, and what it says."""

import math
import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.dither import judge_compensators, judge_dither
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.limit_cycle import check_rest, find_limit_cycle
from pneuopt.evaluation.margins import frequency_response, sensitivity_terms
from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.metrics import step_metrics
from pneuopt.evaluation.moves import excitation_run
from pneuopt.evaluation.plants import monte_carlo
from pneuopt.evaluation.requirements import (
    IAE,
    ControlRate,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    PhaseMargin,
    SettlingTime,
    SteadyStateError,
    StepEnvelope,
)
from pneuopt.evaluation.rig import Actuator, Rig, Sensor, record
from pneuopt.evaluation.scenarios import Normal, corners, draws, samples
from pneuopt.evaluation.specification import specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError, ModelError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory

Row = tuple[type[Exception], str, Callable[[], object]]
T = np.linspace(0.0, 4.0, 401)
STEP, TUBE = Step(0.1), ((0.0, -0.1, 1.1),)
POSITION = {"position": Sensor(lag=5e-4, noise=1e-6, resolution=1e-5)}
PARAMETERS = ParameterSet({"load.mass": Parameter(5.0, "kg", 1.0, 20.0), "friction.coulomb": Parameter(40.0, "N")})
MANY = ParameterSet({f"p{k}": Parameter(1.0, "1") for k in range(13)})
WIDE = Linearisation(-np.eye(1), np.ones((1, 2)), np.eye(1), np.zeros((1, 2)), ("x",), ("u", "w"), ("y",))
LAG = Linearisation(-np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1)), ("x",), ("u",), ("y",))
LINEAR = ClosedLoop(SecondOrder().system(), PID())


@cache
def sticking(sample_time: float | None = 1e-3, dither: bool = False) -> ClosedLoop:
    plant = ForceDrive(Karnopp(Stribeck())).system()
    return ClosedLoop(plant, PID(sample_time), Dither(80.0, analogue=True) if dither else None)


@cache
def pneumatic() -> ClosedLoop:
    return ClosedLoop(PneumaticDrive(friction=Stribeck()).system(), PID(1e-3), Dither(100.0), measured="speed")


def measure(**change: Any) -> object:
    return step_metrics(**{"t": T, "y": 1 - np.exp(-T), "reference_final": 1.0, "initial": 0.0, **change})


def find_cycle(**change: Any) -> object:
    return find_limit_cycle(**{"t": T, "y": np.sin(20 * T), **change})


def covariance(name: str, value: float) -> pd.DataFrame:
    return pd.DataFrame([[value]], [name], [name])


def plan(**change: Any) -> object:
    plant = pneumatic().plant
    given = change.pop("values", {})
    return excitation_run(plant, plant.parameters.with_values(given), **change)


def weaken() -> dict[str, float]:
    return {"valve.conductance": pneumatic().plant.parameters.value("valve.conductance") / 100}


A_FRACTION = "2 % is 0.02"
LIMITS: dict[str, Row] = {
    f"{kind.__name__}({value})": (InputError, words, lambda kind=kind, value=value: kind(value))  # type: ignore[misc]
    for kind, value, words in (
        (Overshoot, 5.0, "5 % is 0.05"),
        (Overshoot, -0.1, "above 0"),
        (Overshoot, "5 %", "Overshoot: max takes a number, as 0.05 for 5 %; got "),
        (Overshoot, [], "Overshoot: max takes a number, as 0.05 for 5 %; got "),
        (Overshoot, Overshoot, "Overshoot: max takes a number, as 0.05 for 5 %; got "),
        (SteadyStateError, 2.0, A_FRACTION),
        (MaxSensitivity, 0.9, "above 1"),
        (MaxComplementarySensitivity, 0.0, "above 0"),
        (PeakControl, math.inf, "finite"),
        (PeakControl, math.nan, "finite"),
        (ControlRate, -1.0, "ControlRate: max must be above 0"),
        (NoiseGain, 0.0, "NoiseGain: max must be above 0"),
        (IAE, math.nan, "IAE: max"),
        (GainMargin, 0.5, "GainMargin: min must be above 1 and finite, got 0.5; it is a factor"),
        (GainMargin, math.inf, "above 1 and finite"),
        (GainMargin, "5 %", "GainMargin: min takes a number"),
        (GainMargin, [], "GainMargin: min takes a number"),
        (GainMargin, Overshoot, "GainMargin: min takes a number"),
        (PhaseMargin, -10.0, "above 0 deg"),
        (PhaseMargin, math.nan, "above 0 deg"),
        (SettlingTime, 2.0, A_FRACTION),
        (StepEnvelope, (), "times count from the step and increase"),
        (StepEnvelope, ((-0.1, 0.0, 1.0),), "times count from the step"),
        (StepEnvelope, ((0.0, 0.0, 1.0), (0.0, 0.5, 1.0)), "increase, got"),
        (StepEnvelope, ((0.0, 1.1, 0.9),), "at 0 s the bounds must be finite and in order"),
        (StepEnvelope, ((0.0, -math.inf, 1.1),), "finite"),
        (StepEnvelope, ((0.0, 0.0, math.nan),), "finite"),
    )
}
SPECIFICATIONS: dict[str, Row] = {
    f"specify {words}": (InputError, words, lambda terms=terms, limits=limits: specify(terms, limits))  # type: ignore[misc]
    for terms, limits, words in (
        (SettlingTime(), [Overshoot()], "Overshoot(max="),
        (SettlingTime(), [PhaseMargin()], "PhaseMargin(min="),
        (SettlingTime(), [StepEnvelope(TUBE), StepEnvelope(((0.0, -0.2, 1.2),))], "two StepEnvelopes differ"),
        ({}, [], "minimise is empty"),
        ({SettlingTime(): 0.0}, [], "weight of SettlingTime"),
        ({Overshoot(): 1.0, Overshoot(0.1): 1.0}, [], "twice"),
        (SettlingTime(band=0.02), [SettlingTime(band=0.05, max=1.0)], "bands differ"),
        (SettlingTime(Tolerance(1e-4)), [SettlingTime(0.02, max=1.0)], "settling bands differ"),
        (specify(SettlingTime()), [Overshoot(0.2)], "leave subject_to out"),
        ("settling_time", [], "is no requirement"),
    )
}
RECORDS: dict[str, Row] = {
    "a response with NaN": (InputError, "NaN", lambda: measure(y=np.where(T > 3, np.nan, 1.0))),
    "a response of another length": (InputError, "differ in shape", lambda: measure(y=T[:-1])),
    "time that runs backwards": (InputError, "increase strictly", lambda: measure(t=T[::-1])),
    "no step": (InputError, "no step", lambda: measure(initial=1.0)),
    "a band of 200 %": (InputError, A_FRACTION, lambda: measure(band=2.0)),
    "a step after the record": (InputError, "fewer than three samples", lambda: measure(start=12.0)),
    "a period of 11 s": (InputError, "too short to average over 11 s", lambda: measure(dither_period=11.0)),
    "a command of another length": (InputError, "t and control differ", lambda: measure(control=T[:-1])),
    "a cycle of another length": (InputError, "differ in shape", lambda: find_cycle(y=np.zeros(3))),
    "a cycle backwards": (InputError, "increase strictly", lambda: find_cycle(t=T[::-1])),
    "a cycle with NaN": (InputError, "holds NaN", lambda: find_cycle(y=np.full(len(T), np.nan))),
    "a late start": (InputError, "start = 5 s lies behind the record's end, 4 s", lambda: find_cycle(start=5.0)),
    "a period of 9 s": (InputError, "too short to average over 9 s", lambda: find_cycle(dither_period=9.0)),
    "two inputs": (ModelError, "shape (1, 2)", lambda: frequency_response(WIDE, [1.0])),
    "no frequency": (ValueError, "must be positive", lambda: frequency_response(LAG, [0.0])),
    "a free plant": (
        ModelError,
        "plant.gain: free, but the sensitivity needs a fixed plant",
        lambda: sensitivity_terms(LINEAR, [1.0], LINEAR.parameters.freed("plant.gain")),
    ),
}
SCENARIOS: dict[str, Row] = {
    "no spread": (InputError, "no spread", lambda: corners(PARAMETERS, {})),
    "an unknown name": (UnknownNameError, "load.mas", lambda: corners(PARAMETERS, {"load.mas": 0.1})),
    "two axes": (
        InputError,
        "friction.coulomb is on two axes, 'friction.*' and 'friction.coulomb'",
        lambda: corners(PARAMETERS, {"friction.*": 0.1, "friction.coulomb": 0.2}),
    ),
    "beyond the bounds": (
        InputError,
        "load.mass: 0 to 10 kg leaves its bounds, 1 to 20 kg",
        lambda: corners(PARAMETERS, {"load.mass": 1.0}),
    ),
    "a negative spread": (
        InputError,
        "load.mass: a spread is a positive fraction, got -0.1",
        lambda: corners(PARAMETERS, {"load.mass": -0.1}),
    ),
    "an empty spread": (
        InputError,
        "load.mass: the spread from 8 to 2 kg is empty",
        lambda: samples(PARAMETERS, {"load.mass": (8.0, 2.0)}, 3),
    ),
    "many corners": (InputError, "13 axes have 8192 corners", lambda: corners(MANY, dict.fromkeys(MANY, 0.1))),
    "a distribution's corners": (
        InputError,
        "load.mass: Normal(spread=0.1) has no corners; draw samples",
        lambda: corners(PARAMETERS, {"load.mass": Normal(0.1)}),  # type: ignore[arg-type]
    ),
    "no covariance": (
        InputError,
        "no covariance of load.mass",
        lambda: draws(PARAMETERS, covariance("load.mass", math.nan), 3),
    ),
    "no room for a draw": (
        InputError,
        "none lies within the bounds",
        lambda: draws(PARAMETERS.with_bounds({"load.mass": (5.0, 5.0)}), covariance("load.mass", 1.0), 3),
    ),
    "nothing that varies": (
        InputError,
        "nothing varies: state how a parameter spreads, or give a fit",
        lambda: monte_carlo(PARAMETERS, 5),
    ),
    "a fit of something else": (
        InputError,
        "nothing varies: state how a parameter spreads, or give a fit",
        lambda: monte_carlo(PARAMETERS, 5, covariance=covariance("valve.gain", 1.0)),
    ),
    "no plant": (
        InputError,
        "count must be at least 1, got 0",
        lambda: monte_carlo(PARAMETERS, 0, covariance=covariance("load.mass", 1.0)),
    ),
    "an unknown spread": (UnknownNameError, "load.mas", lambda: monte_carlo(PARAMETERS, 5, spreads={"load.mas": 0.1})),
}
LOOPS: dict[str, Row] = {
    "a rig without controller": (
        ModelError,
        "follows no reference",
        lambda: evaluate(Rig(sticking().plant, {"speed": Sensor()}), STEP, sticking().parameters),
    ),
    "two references alike": (
        InputError,
        "two references are '0 to 0.1'",
        lambda: evaluate(LINEAR, [STEP, Step(0.1, horizon=0.5)], LINEAR.parameters),
    ),
    "a start of the valve": (
        InputError,
        "starts from position, speed and pressure_b, not from valve",
        lambda: evaluate(pneumatic(), Step(0.1, start={"valve": 0.0}), pneumatic().parameters),
    ),
    "smooth friction at rest": (
        ModelError,
        "has no Karnopp friction",
        lambda: check_rest(LINEAR, Step(0.1), LINEAR.parameters),
    ),
    "a short rest": (
        InputError,
        "duration 0.5 s ends before the horizon of 0 to 0.1, 1 s",
        lambda: check_rest(sticking(), STEP, sticking().parameters, duration=0.5),
    ),
    "a rest without controller": (
        ModelError,
        "this rig has no controller",
        lambda: check_rest(Rig(sticking().plant, {}), STEP, sticking().parameters),
    ),
    "a dither of nothing": (
        InputError,
        "no dither to judge: dither.amplitude is 0",
        lambda: judge_dither(pneumatic(), STEP, pneumatic().parameters.with_values({"dither.amplitude": 0.0})),
    ),
    "no dither": (InputError, "no dither to judge: ClosedLoop", lambda: judge_dither(LINEAR, STEP, LINEAR.parameters)),
    "no compensator": (
        InputError,
        "there is nothing to judge: ClosedLoop(plant, pid, compensators=(Knocker(),))",
        lambda: judge_compensators(LINEAR, STEP, LINEAR.parameters),
    ),
    "a slow run": (
        InputError,
        "with a speed of 10 mm/s at most does not tell viscous friction from Coulomb's; allow 50 mm/s or more",
        lambda: plan(speed=0.01),
    ),
    "a short run": (
        InputError,
        "needs a way of 30 mm, there are 10 mm from 100 mm to 110 mm",
        lambda: plan(between=(0.1, 0.11)),
    ),
    "a run to the stop": (InputError, "from 0 m to 100 mm, and the end stops are at", lambda: plan(between=(0.0, 0.1))),
    "a short stroke": (
        InputError,
        "correct [cylinder] stroke",
        lambda: plan(values={"cylinder.stroke": 0.04, "cylinder.start": 0.02}),
    ),
    "a weak drive": (
        InputError,
        "mm/s at most, by its file, and an excitation run needs 0.1 m/s",
        lambda: plan(values=weaken()),
    ),
    "a run without valve": (
        ModelError,
        "needs a drive whose valve moves an axis between two end stops",
        lambda: excitation_run(ForceDrive(Coulomb()).system(), ParameterSet()),
    ),
}
RIGS: dict[str, Row] = {
    **{
        f"a sensor's {name}": (
            InputError,
            f"Sensor: {name} must not be negative, got -1",
            lambda name=name: Sensor(**{name: -1.0}),  # type: ignore[misc]
        )
        for name in ("lag", "noise", "resolution")
    },
    "an actuator": (InputError, "Actuator: hysteresis must not be negative", lambda: Actuator(hysteresis=-0.1)),
    "an encoder": (InputError, "Encoder: filter must not be negative", lambda: Encoder(filter=-1.0)),
    "a sensor of nothing": (
        UnknownNameError,
        "Rig: sensors: unknown output 'positon'; did you mean 'position'",
        lambda: Rig(sticking(), {"positon": Sensor()}),
    ),
    "no sensor": (
        ModelError,
        "the controller needs 'position', which no sensor measures",
        lambda: Rig(sticking(), {}),
    ),
    "a continuous controller": (
        ModelError,
        "a rig's controller is sampled",
        lambda: Rig(sticking(None), {"speed": Sensor()}),
    ),
    "an analogue dither": (
        ModelError,
        "a rig's dither comes from its controller",
        lambda: Rig(sticking(dither=True), {"speed": Sensor()}),
    ),
    "an input with NaN": (
        InputError,
        "'reference' is nan at t = 0.001 s",
        lambda: record(
            Rig(sticking(), POSITION),
            Trajectory([0.0, 1e-3], {"reference": [0.0, np.nan]}),
            sticking().parameters,
        ),
    ),
    "an unknown input": (
        UnknownNameError,
        "Rig: actuated: unknown input 'voltage'",
        lambda: Rig(sticking().plant, POSITION, actuated="voltage"),
    ),
}
MESSAGES = {**LIMITS, **SPECIFICATIONS, **RECORDS, **SCENARIOS, **LOOPS, **RIGS}


@pytest.mark.parametrize("case", MESSAGES)
def test_what_cannot_be_is_refused_in_words(case: str) -> None:
    kind, words, call = MESSAGES[case]
    with pytest.raises(kind, match=re.escape(words)):
        call()
