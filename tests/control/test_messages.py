"""The words of what control refuses: what triggers a message, and what it says; elsewhere tests assert the type."""

from collections.abc import Callable
from math import inf, nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pneuopt.control.averaging import average_dither
from pneuopt.control.compensators import (
    COMPENSATORS,
    Direction,
    FrictionFeedforward,
    ImpulsiveControl,
    Knocker,
    MotionFeedforward,
    PressureFeedback,
)
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.loop import ClosedLoop, add_disturbances, bumpless_transfer
from pneuopt.control.moves import MotionPath, Move, MoveProfile, MoveSequence
from pneuopt.control.pid import (
    PID,
    AntiWindup,
    Form,
    ParallelForm,
    StandardForm,
    proportional_band,
    proportional_gain,
    to_parallel,
    to_series,
    to_standard,
)
from pneuopt.control.reference import Step, as_references
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import System
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.parameters import Parameter, ParameterSet

H = 1e-3
MOVE = Move(0.2, speed=0.5, acceleration=5.0)
FORCE, PNEUMATIC = ForceDrive(Viscous()).system(), PneumaticDrive().system()


def check(loop: ClosedLoop, values: dict[str, float]) -> None:
    """Check a loop with values of parameters, whatever their bounds."""
    loop.check(loop.parameters | ParameterSet({n: Parameter(v, loop.parameters[n].unit) for n, v in values.items()}))


def averaged(
    plant: Any, waveform: Waveform | None = None, amplitude: float = 1.0, hertz: float = 9.0, **own: Any
) -> None:
    """Average a plant, or a loop, under a dither."""
    values = {"dither.amplitude": Parameter(amplitude, "V"), "dither.frequency": Parameter(hertz, "Hz")}
    average_dither(plant, plant.parameters | ParameterSet(values), waveform=waveform, **own)


def move(**fields: Any) -> Move:
    return Move(**({"distance": 0.1, "speed": 1.0, "acceleration": 1.0} | fields))


def path(**fields: Any) -> MotionPath:
    return MotionPath(**({"t": [0.0, 0.1, 0.2, 0.4], "points": [0.0, 0.1, 0.2, 0.3]} | fields))


def start(loop: ClosedLoop, **known: Any) -> None:
    loop.initial(loop.parameters, **known)


SCHEDULE = GainSchedule(("pid.Kp",), 0.0, 0.2, load=5.0)
REFUSED: dict[str, list[tuple[Callable[[Any], object], str]]] = {
    "PID": [
        (lambda _: PID(sample_time=0.0), "sample_time must be positive, got 0.0 s; None is continuous"),
        (lambda _: PID(delay=1), "a delay of 1 sample needs a sample_time"),
        (lambda _: PID(H, delay=2), "delay is 0 or 1, whole samples, got 2"),
        (lambda _: PID(H, delay=0.5), "delay is 0 or 1, whole samples, got 0.5"),  # type: ignore[arg-type]
        (lambda _: PID(H, delay=-1), "delay is 0 or 1, whole samples, got -1"),
        (lambda _: PID(anti_windup=AntiWindup.CLAMPING), "clamping is decided once a sample"),
        (lambda _: PID(H, anti_windup="clamping"), "anti_windup is one of AntiWindup"),  # type: ignore[arg-type]
        (lambda _: PID(reset=True), "a reset is decided once a sample"),
        (
            lambda _: PID(form="standard"),  # type: ignore[arg-type]
            r"PID: form is one of Form\.PARALLEL, Form\.STANDARD, .* got 'standard'",
        ),
    ],
    "values of a PID": [
        (
            lambda s: check(s.loop(PID(H)), {"pid.lower": 2.0, "pid.upper": 1.0}),
            "pid.lower 2 is not below pid.upper 1 V",
        ),
        (lambda s: check(s.loop(PID(2e-3)), {"pid.Tt": 1e-3}), r"pid.Tt = 0.001 s.*one sample \(0.002 s\)"),
        (
            lambda s: check(s.loop(PID()), {"pid.Tf": 0.0}),
            "pid.Tf = 0 s: a continuous derivative needs a filter, Tf > 0",
        ),
        (
            lambda s: check(s.loop(PID(dead_band=True)), {"pid.dead_band": -0.1}),
            r"dead_band must not be negative, got -0\.1",
        ),
        (
            lambda s: check(s.loop(PID(H, reset=True)), {"pid.reset_ratio": 2.0}),
            r"pid.reset_ratio must lie within \[0, 1\]",
        ),
        (lambda s: check(s.loop(PID(H)), {"pid.fault_samples": 0.0}), "pid.fault_samples must be positive and finite"),
        (lambda s: check(s.loop(PID(H)), {"pid.fault_output": inf}), "pid.fault_output must be finite"),
        (
            lambda s: check(s.loop(PID(form=Form.STANDARD)), {"pid.N": 0.0}),
            r"pid\.N = 0 would switch the derivative off; the ISA ratio N is 5 to 20",
        ),
        (
            lambda s: check(s.loop(PID(form=Form.STANDARD)), {"pid.Ti": 0.0}),
            r"pid\.Ti = 0 would be an infinite integral gain; no integral action is Ti = inf",
        ),
        (
            lambda s: check(s.loop(PID(form=Form.STANDARD)), {"pid.Td": 0.1, "pid.N": inf}),
            r"pid\.N = inf: a continuous derivative needs a filter",
        ),
    ],
    "forms": [
        (lambda _: to_standard(ParallelForm(0.0, 1.0)), "needs Kp != 0"),
        (lambda _: to_parallel(StandardForm(1.0, 0.0)), "Ti = inf"),
        (lambda _: to_parallel(StandardForm(1.0, 1.0, 0.1, 0.0)), "N = 0"),
        (
            lambda _: to_series(ParallelForm(2.0, 4.0, 0.5)),
            r"needs Ti >= 4 Td; here Ti = 0.5 s, Td = 0.25 s; use the standard form",
        ),
        (
            lambda _: to_series(to_parallel(StandardForm(2.0, 0.5, 0.1, 0.1 / 0.3))),
            r"\(Ti - Tf\)\^2 >= 4 Ti Td with Ti > Tf, and Tf = 0.3 s",
        ),
        (lambda _: proportional_band(1.0, 0.0, 10.0), "both spans must be positive, got 0"),
        (lambda _: proportional_band(0.0, 1.0, 10.0), "Kp = 0 has no proportional band"),
        (lambda _: proportional_gain(0.0, 1.0, 10.0), "a switch, not a gain"),
    ],
    "dither": [
        (lambda _: Dither(0.0), "frequency must be positive, got 0"),
        (lambda _: Dither(waveform="triangle"), "waveform is one of Waveform.SINE, .* got 'triangle'"),  # type: ignore[arg-type]
        (lambda _: Dither(600.0).parameters("V", H), r"600 Hz .* every 1 ms.* 500 Hz.*analogue = true"),
        (lambda s: s.loop(PID(5e-3), Dither(160.0)), r"160 Hz .* every 5 ms.* 100 Hz"),
    ],
    "averaging": [
        (lambda _: averaged(FirstOrder().system(), amplitude=0.0), "dither.amplitude > 0"),
        (lambda _: averaged(FirstOrder().system(), hertz=0.0), "dither.frequency > 0"),
        (lambda _: averaged(FirstOrder().system(), nodes=4), "nodes must be at least 8, got 4"),
        (
            lambda _: averaged(FirstOrder().system(), actuated="voltage"),
            "unknown input 'voltage'; did you mean 'valve_voltage'",
        ),
        (lambda _: averaged(FirstOrder().system(), at={"sped": 1.0}), "state or input 'sped'; did you mean 'speed'"),
        (lambda s: averaged(s.loop(PID())), "needs a loop with dither"),
        (lambda s: averaged(s.loop(PID(H), Dither())), "the controller is sampled; average the plant"),
        (
            lambda s: averaged(s.loop(PID(), Dither(waveform=Waveform.TRIANGLE)), Waveform.SINE),
            "the loop's dither is a triangle",
        ),
    ],
    "parts of a controller": [
        (lambda _: Feedforward(0.0), "Feedforward: time must be at least 1e-06 s, got 0 s"),
        (
            lambda _: ClosedLoop(PNEUMATIC, PID(), measured="pressure_a", outer=PositionLoop()),
            "a PositionLoop controls the position, this loop 'pressure_a'",
        ),
        (lambda _: ClosedLoop(FORCE, PID(), feedforward=Feedforward(), outer=PositionLoop()), "take MotionFeedforward"),
        (lambda _: GainSchedule(("pid.Tf",), 0.0, 0.2), r"gain 'pid\.Tf'"),
        (lambda _: GainSchedule((), 0.0, 0.2), "no gain to schedule"),
        (lambda _: GainSchedule(("pid.Kp",), 0.3, 0.2), "low must lie below high, got 0.3 and 0.2"),
        (
            lambda _: ClosedLoop(FORCE, PID(), schedule=GainSchedule(("pid.Kp",), 0.0, 0.2, position="angle")),
            "GainSchedule: position",
        ),
        (
            lambda _: check(ClosedLoop(FORCE, PID(), schedule=SCHEDULE), {"schedule.load": 0.0}),
            "load must be positive, got 0",
        ),
        (
            lambda _: check(ClosedLoop(FORCE, PID(), schedule=SCHEDULE), {"schedule.low": 0.3}),
            r"schedule\.low 0\.3 is not below schedule\.high 0\.2",
        ),
    ],
    "compensators": [
        (lambda s: s.loop(PID(), compensators=(Knocker(),)), "give the PID a sample_time"),
        (
            lambda s: s.loop(PID(), compensators=(ImpulsiveControl(),)),
            "an ImpulsiveControl counts samples: give the PID",
        ),
        (lambda s: s.loop(PID(H), compensators=(Knocker(),) * 2), "has Knocker twice"),
        (lambda s: s.loop(PID(H), compensators=Knocker()), "compensators is a tuple of parts"),
        (lambda s: s.loop(PID(H), compensators=(COMPENSATORS["knocker"],)), "is a tuple of parts"),
        (
            lambda _: ClosedLoop(
                ForceDrive(Stribeck()).system(),
                PID(),
                measured="position",
                compensators=(FrictionFeedforward(Direction.MEASURED),),
            ),
            "take Direction.REFERENCE",
        ),
        (
            lambda _: ClosedLoop(PNEUMATIC, PID(), measured="pressure_a", compensators=(MotionFeedforward(),)),
            "neither a position nor a speed",
        ),
        (
            lambda s: s.loop(PID(), compensators=(PressureFeedback(),)),
            "PressureFeedback reads pressure_a, pressure_b, which the plant does not have: the plant's outputs are",
        ),
        (
            lambda _: FrictionFeedforward("measured"),  # type: ignore[arg-type]
            "direction is one of Direction.REFERENCE, Direction.MEASURED",
        ),
        (
            lambda _: check(
                ClosedLoop(
                    FORCE,
                    PID(H),
                    measured="position",
                    sensor=Encoder(1e-5),
                    compensators=(ImpulsiveControl(),),
                    outer=PositionLoop(),
                ),
                {"impulsive_control.tolerance": 1e-5, "impulsive_control.amplitude": 1.0},
            ),
            r"impulsive_control\.tolerance 1e-05 m lies within a count of the sensor, 1e-05: .*; take at least 2e-05",
        ),
    ],
    "sensors": [
        (lambda _: SensorLag(0.0), "leave the sensor out"),
        (lambda _: ClosedLoop(FORCE, PID(), sensor=Encoder(1e-5)), "an Encoder is read once a sample: give the PID"),
        (lambda _: ClosedLoop(FirstOrder().system(), PID(H), sensor=Encoder(1e-5)), "unknown output 'position'"),
        (
            lambda _: ClosedLoop(PNEUMATIC, PID(H), sensor=Encoder(1e-5, position="pressure_a")),
            r"the difference of 'pressure_a' \[Pa\(a\)\] is not 'speed' \[m/s\]",
        ),
        (lambda _: Encoder(-1.0, 0.0), "Encoder: resolution must not be negative"),
        (lambda _: Encoder(0.0, -1.0), "Encoder: filter must not be negative"),
    ],
    "a loop's signals": [
        (
            lambda s: ClosedLoop(s.axis, PID(), actuated="force", measured="acceleration"),
            "algebraic loop: output 'acceleration' depends on input 'force'.*a sensor with a lag",
        ),
        (lambda s: ClosedLoop(s.axis, PID()), "inputs force, pressure; choose actuated="),
        (lambda s: ClosedLoop(s.axis, PID(), actuated="forse"), "unknown input 'forse'; did you mean 'force'"),
        (
            lambda s: ClosedLoop(s.axis, PID(), actuated="force", measured="sped"),
            "unknown output 'sped'; did you mean 'speed'",
        ),
        (lambda s: s.loop(PID(H)).system(), r"use discrete\(\), or hold_system\(\)"),
        (lambda s: s.loop(PID()).hold_system(), r"use system\(\)"),
        (lambda s: s.loop(PID()).update, r"use system\(\)"),
        (
            lambda s: add_disturbances(s.loop(PID()), [Step(0.1, disturbance={"plant.gian": 1.0})]),
            "unknown parameter or input of the plant 'plant.gian'; did you mean",
        ),
    ],
    "a loop's start": [
        (
            lambda s: s.force.initial(
                s.force.parameters.with_values({"pid.Ki": 1.0, "pid.lower": -2.0, "pid.upper": 2.0})
            ),
            r"needs a command of 3 N, the limits are -2 and 2",
        ),
        (lambda s: start(s.force, start={"pressure": 1.0}), "cannot start from pressure, only from position"),
        (lambda s: start(s.force, start={"speed": 1.0}), "'speed' is what the loop controls; give it as initial="),
        (
            lambda s: start(ClosedLoop(s.axis, PID(), actuated="force", measured="position"), start={"speed": 1.0}),
            "cannot start from speed, only from its rest",
        ),
        (lambda s: start(s.force, x_plant=[0.0] * 3), r"x_plant has shape \(3,\)"),
        (
            lambda s: bumpless_transfer(s.loop(PID(H)), np.zeros(3), *[s.loop(PID(H)).parameters] * 2),
            r"x has shape \(3,\), the loop has 8 states",
        ),
    ],
    "steps": [
        (lambda _: Step(0.0), "size must not be zero"),
        (lambda _: Step(nan), "size must be a finite number"),
        (lambda _: Step(1.0, at=-0.1), "at must not be negative"),
        (lambda _: Step(1.0, at=2.0), "horizon 1 s must lie after the step at 2 s"),
        (lambda _: Step(1.0, horizon=inf), "horizon must be a finite"),
        (lambda _: Step(1.0, start={"position": nan}), r"start\['position'\] must be a finite number"),
        (lambda _: Step(0.0, disturbance={"load.force": 1.0}), "a loop that holds 0 needs a scale"),
        (lambda _: Step(0.1, disturbance={"load.force": 0.0}), "must not be zero, nothing would change"),
        (lambda _: Step(0.1, scale=0.1), "scale is for a disturbance alone"),
        (lambda _: Step(0.0, scale=-0.1, disturbance={"load.force": 1.0}), "scale must be positive, got -0.1"),
        (lambda _: Step(1.0, at=0.1049).trajectory(0.01), r"between two samples of 0\.01 s; use 0\.1 s"),
        (lambda _: Step(1.0).trajectory(2.0), "spacing 2 s"),
        (lambda _: as_references([Step(0.1), 0.1]), "references takes a Step or a Move"),  # type: ignore[list-item]
    ],
    "moves": [
        (lambda _: move(distance=0.0), "distance must not be zero"),
        (lambda _: move(speed=-1.0), "speed is a limit on its size and must be positive"),
        (lambda _: move(jerk=0.0), "jerk is a limit"),
        (lambda _: move(acceleration=inf), "acceleration must be a finite number"),
        (lambda _: move(jerk=5.0, profile=MoveProfile.TRAPEZOID), "no limit of jerk allows; leave jerk out"),
        (lambda _: move(dwell=-9.0), "before the move begins; raise dwell"),
        (lambda _: move(at=-1.0), "time starts at zero"),
        (lambda _: MoveSequence([]), "there is no move"),
        (lambda _: MoveSequence([MOVE, move(at=0.1)]), "move 2 begins where the one before ends"),
        (
            lambda _: MoveSequence([move(disturbance={"load.force": 20.0}), MOVE]),
            "only the last move may have a disturbance, move 1 has one",
        ),
        (lambda _: path(points=[0.0, 1.0]), "rows of two or more, got shapes"),
        (lambda _: path(t=[0.0, 1.0, 1.0, 2.0]), "does not at point 3"),
        (lambda _: path(t=[1.0, 2.0, 3.0, 4.0]), "time begins at 0, got 1 s"),
        (lambda _: path(points=[1.0, 1.0, 1.0, 1.0]), "nothing moves"),
        (lambda _: path(points=[1.0, nan, 1.0, 1.0]), "not finite"),
        (lambda _: path(dwell=-2.0), "ends the experiment before it begins"),
    ],
}
ROWS = [pytest.param(*row, id=f"{subject} {k}") for subject, rows in REFUSED.items() for k, row in enumerate(rows)]


@pytest.mark.parametrize(("trigger", "words"), ROWS)
def test_what_is_refused_says_why(
    trigger: Callable[[Any], object], words: str, axis: System, second_order: System
) -> None:
    shared = SimpleNamespace(
        axis=axis,
        force=ClosedLoop(axis, PID(), actuated="force"),
        loop=lambda *parts, **more: ClosedLoop(second_order, *parts, **more),
    )
    with pytest.raises((InputError, ModelError), match=words):
        trigger(shared)
