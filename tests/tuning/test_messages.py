"""What is said of input that cannot be tuned: what triggers each message, and its words."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System
from pneuopt.evaluation.limit_cycle import NoHunting
from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.requirements import (
    IAE,
    ControlRate,
    MaxSensitivity,
    Overshoot,
    SettlingTime,
)
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.evaluation.scenarios import Factor, tolerances
from pneuopt.evaluation.specification import specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Karnopp, Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import ConvergenceError, InputError, PneuoptError, UnknownNameError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.front import pareto_front
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import certify, tune, tune_without_dither
from pneuopt.tuning.two_phase import TwoPhase
from pneuopt.tuning.validation import validate_design

Edit = Callable[[ParameterSet], ParameterSet]
STEP, PAIR = Step(1.0), (SettlingTime(), MaxSensitivity())
GAINS = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}


def lag(dither: Dither | None = None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False), dither)
    return loop, loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 20.0}).with_bounds(GAINS).freed(*GAINS)


def drive(plant: System | None = None, **pid: Any) -> tuple[ClosedLoop, ParameterSet]:
    """A force-driven axis with friction; its command is limited to +-300 N."""
    loop = ClosedLoop(plant or ForceDrive(Stribeck()).system(), PID(1e-3, **pid), Dither(80.0))
    return loop, loop.parameters.with_values({"pid.Kp": 100.0, "pid.lower": -300.0, "pid.upper": 300.0}).with_bounds(
        {"pid.Kp": (10.0, 600.0)}
    ).freed("pid.Kp")


def asked(edit: Edit = lambda p: p, dither: Dither | None = None, **options: Any) -> None:
    """A tuning of the lag with edited parameters."""
    loop, given = lag(dither)
    tune(loop, **{"references": STEP, "parameters": edit(given), "minimise": SettlingTime(), **options})


def spanned(n: str, low: float, high: float) -> None:
    loop, given = drive()
    search_space(loop, given.with_bounds({n: (low, high)}).freed(n))


def wide_valve() -> None:
    loop = ClosedLoop(PneumaticDrive().system(), PID(1e-3), Dither(80.0), measured="speed")
    search_space(loop, loop.parameters.with_bounds({"dither.amplitude": (0.0, 8.0)}).freed("dither.amplitude"))


def on_rig(wanted: NoHunting | None = None, **pid: Any) -> None:
    (loop, given), rig = drive(), Rig(drive(ForceDrive(Karnopp(Stribeck())).system(), **pid)[0], {"speed": Sensor()})
    limits = [] if wanted is None else [wanted]
    tune(loop, Step(0.2, horizon=0.4), given, minimise=SettlingTime(), subject_to=limits, rig=rig)


def rough_exact() -> None:
    loop, given = drive()
    tune(loop, Step(0.2, horizon=0.4), given, minimise=SettlingTime(), method=TwoPhase())


def lag_and_step() -> tuple[ClosedLoop, Step, ParameterSet]:
    loop, given = lag()
    return loop, STEP, given


def dithered_alone() -> tuple[ClosedLoop, Step, ParameterSet]:
    loop, given = lag(Dither(50.0))
    return loop, STEP, given.fixed("*").with_bounds({"dither.amplitude": (0.0, 1.0)}).freed("dither.amplitude")


def fronted(minimise: Any, **options: Any) -> None:
    pareto_front(*lag_and_step(), minimise=minimise, **options)


MESSAGES: dict[str, tuple[Callable[[], object], type[PneuoptError], str]] = {
    "nothing free": (partial(asked, lambda p: p.fixed(*GAINS)), InputError, "nothing is free"),
    "a plant's parameter": (partial(asked, lambda p: p.freed("plant.gain")), InputError, "plant.gain is free"),
    "an endless range": (
        partial(asked, lambda p: p.with_bounds({"pid.Kd": (0.0, math.inf)}).freed("pid.Kd")),
        InputError,
        "pid.Kd is free .* finite bounds",
    ),
    "dither alone": (
        partial(
            asked, lambda p: p.fixed(*GAINS).with_bounds({"dither.amplitude": (0, 1)}).freed("dither.*e"), Dither(50.0)
        ),
        InputError,
        "without effect",
    ),
    "no reference": (partial(asked, references=[]), InputError, "no reference"),
    "a mode too fast": (
        partial(asked, lambda p: p.with_bounds({"pid.Tf": (1e-7, 0.05)}).freed("pid.Tf"), method=TwoPhase()),
        InputError,
        r"raise the lower one of pid\.Tf",
    ),
    "no equation": (
        partial(asked, minimise=IAE(), subject_to=[ControlRate(30.0)], method=TwoPhase()),
        InputError,
        r"TwoPhase has no equation for IAE, ControlRate; use method=Racing\(\)",
    ),
    "friction": (rough_exact, InputError, "TwoPhase needs a linear loop .*Racing"),
    "exact scenarios": (
        partial(asked, scenarios={"a": {"plant.gain": 2.0}}, method=TwoPhase()),
        InputError,
        "one plant, not for scenarios",
    ),
    "a scenario of a gain": (
        partial(asked, scenarios={"stiff": {"pid.Kp": 3.0}}),
        InputError,
        r"'stiff': pid\.Kp is tuned.*tolerances",
    ),
    "a mistyped scenario": (partial(asked, scenarios={"odd": {"plant.gian": 3.0}}), UnknownNameError, r"plant\.gian"),
    "a nameless scenario": (partial(asked, scenarios={"": {"plant.gain": 3.0}}), InputError, "needs a name"),
    "a wide tolerance": (lambda: tolerances(lag()[1], {"pid.Kp": 1.5}), InputError, r"between 0 and 1, got 1\.5"),
    "a factor of 0": (lambda: Factor(0.0), InputError, "share must be positive"),
    "no defect": (partial(asked, accept="hunts"), InputError, "accept"),
    "a band as wide as the step": (
        partial(asked, minimise=SettlingTime(Tolerance(2.0))),
        InputError,
        r"its size of 1 lies within the tolerance of \+-2; narrow",
    ),
    "a frequency of 0": (
        partial(spanned, "dither.frequency", 0.0, 100.0),
        InputError,
        "dither.frequency: its lower bound must be positive, got 0 Hz",
    ),
    "a wide amplitude": (
        partial(spanned, "dither.amplitude", 0.0, 400.0),
        InputError,
        "dither.amplitude may reach 400 N, but the command ends at -300 and 300 N",
    ),
    "a valve's range": (
        wide_valve,
        InputError,
        "may reach 8 V, but the valve ends at -5 and 5 V.*lower its upper bound",
    ),
    "limits twice": (
        lambda: certify(*lag_and_step(), minimise=specify(SettlingTime()), subject_to=[Overshoot(0.05)]),
        InputError,
        "holds its limits",
    ),
    "hunting without a rig": (
        partial(asked, subject_to=[NoHunting()]),
        InputError,
        "NoHunting is read on the event-accurate model .*; give rig=",
    ),
    "certified without a rig": (
        lambda: certify(*lag_and_step(), subject_to=[NoHunting()]),
        InputError,
        "give rig=",
    ),
    "no time to watch": (lambda: NoHunting(0.0), InputError, "NoHunting: duration must be positive"),
    "no repeatability": (
        lambda: NoHunting(repeatability=0.0),
        InputError,
        "NoHunting: repeatability must be positive",
    ),
    "one reference to repeat": (
        partial(on_rig, NoHunting(repeatability=1e-4)),
        InputError,
        "repeatability is a range over references, and there is one; give more",
    ),
    "another loop's rig": (
        partial(on_rig, dead_band=True),
        InputError,
        "another PID; make the rig of the same loop",
    ),
    "one kind of a front": (
        partial(fronted, (Overshoot(), Overshoot(0.1))),
        InputError,
        "both requirements are Overshoot; a front needs two kinds",
    ),
    "a front of a point": (partial(fronted, PAIR, points=1), InputError, "at least 2 points, got 1"),
    "a front without length": (
        partial(fronted, (SettlingTime(), MaxSensitivity(1.4)), until=1.5),
        InputError,
        r"a front from MaxSensitivity 1\.4 until 1\.5 ends before it begins",
    ),
    "a front without an end": (
        partial(fronted, PAIR, subject_to=[IAE(1e-9)], method=Racing(8, 20)),
        ConvergenceError,
        "no front: its end, SettlingTime as good as the limits allow, is NOT",
    ),
    "no plants": (
        lambda: validate_design(*lag_and_step(), minimise=SettlingTime(), scenarios={}),
        InputError,
        "no new plants",
    ),
    "no dither": (
        lambda: tune_without_dither(*lag_and_step(), minimise=SettlingTime()),
        InputError,
        "no dither to leave out",
    ),
    "no gain beside the dither": (
        lambda: tune_without_dither(*dithered_alone(), minimise=SettlingTime()),
        InputError,
        "nothing is free",
    ),
    "few members": (lambda: Racing(members=4), InputError, "members must be at least 5, got 4"),
    "no trials": (lambda: Racing(trials=0), InputError, "trials must be at least 1, got 0"),
    "negative polish": (lambda: Racing(polish=-1), InputError, "polish must not be negative, got -1"),
    "narrower bands": (
        lambda: Racing(bands=(0.5,)),
        InputError,
        r"bands are multiples of the one asked for, got \(0.5,\)",
    ),
}


@pytest.mark.parametrize("case", MESSAGES)
def test_what_cannot_be_tuned_is_said(case: str) -> None:
    trigger, error, words = MESSAGES[case]
    with pytest.raises(error, match=words):
        trigger()
