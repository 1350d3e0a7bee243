"""The block diagram shows every signal of a loop with its unit, and of the options those that it has."""

import io
from dataclasses import replace

import casadi as ca
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, Form
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import System, define
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import LuGre
from pneuopt.models.linear import SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.plotting import plot_loop
from pneuopt.quantities.parameters import Quantity

SAMPLED = {"limits", "hold", "controller, every"}
RIVALS = {"friction feedforward", "knocker", "dead zone inverse"}
OPTIONS = {
    *SAMPLED,
    *RIVALS,
    "dither",
    "generator",
    "computing",
    "feedforward gain",
    "sensor:",
    "encoder",
    "dead band",
    "gains follow",
}
FORCE, VALVE = ForceDrive(LuGre()).system(), PneumaticDrive(friction=LuGre()).system()
BARE = ClosedLoop(FORCE, PID(limits=False))


def pushed() -> System:
    """A plant with an input that the controller does not drive."""
    plant = SecondOrder().system()
    rates = {"speed": ca.SX(0), "drive": ca.SX(0)}
    inputs = (*plant.inputs, Quantity("load_force", "N"))
    return define(
        plant.states, inputs, plant.outputs, plant.parameters, lambda _t, x, _u, _p: (rates, {"speed": x["speed"]})
    )


BY_COUNTS = PID(1e-3, delay=1, dead_band=True)
LAGGING = SensorLag(1e-3)
ANALOGUE = Dither(analogue=True, waveform=Waveform.TRIANGLE)
LOOPS = {
    "bare": (BARE, set()),
    "dither": (ClosedLoop(FORCE, PID(), Dither()), {"dither", "limits"}),
    "sampled": (
        ClosedLoop(VALVE, BY_COUNTS, sensor=Encoder(), measured="speed"),
        {*SAMPLED, "computing", "dead band", "encoder"},
    ),
    "analogue": (ClosedLoop(VALVE, PID(1e-3), ANALOGUE, measured="speed"), {*SAMPLED, "dither", "generator"}),
    "lag": (
        ClosedLoop(VALVE, PID(limits=False), Dither(), None, "position", LAGGING, Feedforward()),
        {"sensor:", "feedforward gain", "dither"},
    ),
    "rivals": (
        ClosedLoop(VALVE, PID(1e-3), measured="speed", compensators=tuple(part() for part in COMPENSATORS.values())),
        {*SAMPLED, *RIVALS},
    ),
    "cascade": (
        ClosedLoop(VALVE, PID(1e-3), sensor=Encoder(), outer=PositionLoop()),
        {*SAMPLED, "encoder"},
    ),
    "scheduled": (
        ClosedLoop(VALVE, PID(1e-3), measured="position", schedule=GainSchedule(("pid.Kp",), 0.0, 0.2)),
        {*SAMPLED, "gains follow"},
    ),
    "other input": (ClosedLoop(pushed(), PID(limits=False), actuated="valve_voltage"), set()),
}


def words(figure: Figure) -> str:
    """All text of a figure, its line breaks and hard spaces as spaces."""
    return " ".join(" ".join(t.get_text() for t in figure.axes[0].texts).split())


@pytest.mark.parametrize("name", LOOPS)
def test_every_signal_appears_with_its_unit(name: str) -> None:
    loop, _ = LOOPS[name]
    text = words(plot_loop(loop))
    for signal in (*loop.inputs, *loop.outputs, *loop.states):
        unit = "" if signal.unit in ("", "1") else f" [{signal.unit}]"
        assert f"{signal.name}{unit}" in text, signal.name


@pytest.mark.parametrize("name", LOOPS)
def test_options_appear_only_where_the_loop_has_them(name: str) -> None:
    loop, present = LOOPS[name]
    assert {option for option in OPTIONS if option in words(plot_loop(loop))} == present


@pytest.mark.parametrize("form", Form)
def test_the_law_is_that_of_the_form(form: Form) -> None:
    text = words(plot_loop(replace(BARE, pid=PID(limits=False, form=form))))
    assert f"PID, {form.value} form" in text
    assert all(gain in text.replace("_", "") for gain in form.gains)


@pytest.mark.parametrize("name", LOOPS)
def test_neither_texts_nor_blocks_overlap(name: str) -> None:
    figure = plot_loop(LOOPS[name][0])
    figure.savefig(io.BytesIO(), format="png", dpi=100)
    (axes,) = figure.axes
    blocks = [q.get_window_extent() for q in axes.patches if isinstance(q, FancyBboxPatch)]
    for drawn in (blocks, [t.get_window_extent() for t in axes.texts if t.get_text()]):
        assert not any(one.overlaps(other) for k, one in enumerate(drawn) for other in drawn[:k])
    inside = figure.bbox
    assert all(inside.x0 <= q.x0 and q.x1 <= inside.x1 for q in (t.get_window_extent() for t in axes.texts))
