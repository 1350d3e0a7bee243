"""The words of what export refuses: what triggers a message, and what it says; elsewhere tests assert the type."""

from collections.abc import Callable
from math import inf

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.export.blocks import export_settings
from pneuopt.export.fmu import export_fmu
from pneuopt.export.languages import Language, export_controller
from pneuopt.export.makers import Block
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Karnopp, Stribeck
from pneuopt.quantities.errors import InputError, ModelError

PLANT, SAMPLED = ForceDrive(Stribeck()).system(), PID(2e-3)
GAINS = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.Kd": 0.8, "pid.lower": -46.0, "pid.upper": 46.0}
STEPS = (Step(0.4, horizon=0.02), Step(-0.1, horizon=0.02))


def sheet(block: Block, pid: PID = SAMPLED, measured_span: float | None = None, **values: float) -> None:
    """A block's sheet of `GAINS`, or of others by their names in [pid]."""
    loop = ClosedLoop(PLANT, pid)
    given = loop.parameters.with_values(GAINS | {f"pid.{n}": v for n, v in values.items()})
    export_settings(loop, given, block, STEPS, measured_span=measured_span)


def block(name: str = "controller", pid: PID = SAMPLED, language: Language = Language.C, **values: float) -> None:
    """A function block of default gains, or of others."""
    loop = ClosedLoop(PLANT, pid)
    export_controller(
        loop, loop.parameters.with_values({f"pid.{n}": v for n, v in values.items()}), language, name=name
    )


ROWS: dict[str, tuple[Callable[[], object], str]] = {
    "no name": (lambda: block("a b"), "--name 'a b': a block's name has letters, digits and single underscores"),
    "taken name": (lambda: block("pid"), "--name pid: is a function block of IEC 61131-3; take another, as --name "),
    "own number": (lambda: block("Kp"), "--name Kp: is Kp, a number of the block; take another, as --name "),
    "continuous": (lambda: block(pid=PID()), "give it a sample time, sample_time under"),
    "too large": (lambda: block(language=Language.STRUCTURED_TEXT, upper=1e39), r"pid\.upper of 1e\+39 cannot be"),
    "FMU's name": (lambda: export_fmu(PLANT, PLANT.parameters, name="a b"), "a block's name"),
    "FMU's friction": (
        lambda: export_fmu(ForceDrive(Karnopp(Stribeck())).system(), PLANT.parameters),
        "friction that sticks",
    ),
    "FMU's state": (lambda: export_fmu(PLANT, PLANT.parameters, np.zeros(3)), "x has 3 entries, the plant 2 states"),
    "span": (lambda: sheet(Block.ROCKWELL, measured_span=0.0), "measured_span must be positive"),
    "span of references": (
        lambda: sheet(Block.ROCKWELL, measured_span=0.4),
        "does not hold the references, from -0.1 m/s to 0.4 m/s",
    ),
    "no gain": (
        lambda: sheet(Block.SIEMENS, Kp=0.0),
        "Kp = 0, Ki = 4000, Kd = 0.8: it cannot have them; use --to st",
    ),
    "signs": (lambda: sheet(Block.SIEMENS, Ki=-4000.0), r"one sign for all its gains.*--to st"),
    "no limits": (lambda: sheet(Block.SIEMENS, upper=inf), r"in percent of the command's range.*no limits.*--to st"),
    "centre": (
        lambda: sheet(Block.BECKHOFF, lower=1.0),
        "0 N, lies beyond the limits of the output: no setting",
    ),
    "short time": (lambda: sheet(Block.BECKHOFF, Kp=1.0), r"Ti = 0.25 ms would be 0.*--to st"),
    "dead band": (
        lambda: sheet(Block.BECKHOFF, PID(2e-3, dead_band=True), dead_band=0.01),
        r"Beckhoff FB_CTRL_PID cannot hold this design: the integral's dead band .*; use --to st",
    ),
}


@pytest.mark.parametrize(("trigger", "words"), ROWS.values(), ids=ROWS)
def test_what_is_refused_says_why(trigger: Callable[[], object], words: str) -> None:
    with pytest.raises((InputError, ModelError), match=words):
        trigger()
