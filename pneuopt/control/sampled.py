"""`controller_update`: what a sampled controller computes at a sample, without a plant around it.

A `ClosedLoop` joins it to its plant, an export writes it for another machine: there is one law.
"""

from typing import NamedTuple, Protocol

import casadi as ca

from pneuopt.control.command import CommandParts, added_command, added_terms, pid_reference
from pneuopt.control.gain_schedule import GainSchedule, schedule_gains
from pneuopt.control.reset_integral import reset_integral
from pneuopt.control.sensor import Encoder, SensedSignal, SensorLag
from pneuopt.control.wiring import Signals
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import Quantity, with_prefix, without_prefix


class ControllerParts(CommandParts, Protocol):
    """The parts of a `ClosedLoop` that are computed at a sample."""

    @property
    def sensor(self) -> SensorLag | Encoder | None:
        """Through which the controller sees the measured signal."""
        ...

    @property
    def feedback(self) -> Quantity:
        """The plant's output that the loop is judged by, and an outer loop controls."""
        ...

    @property
    def schedule(self) -> GainSchedule | None:
        """Gains that change with the position."""
        ...

    @property
    def sensed_signal(self) -> SensedSignal:
        """What the sensor reads."""
        ...


class ControllerUpdate(NamedTuple):
    """What is computed at a sample, by name.

    Attributes
    ----------
    states : dict of str to casadi.SX
        The states of sensor, PID, feedforward and compensators after the sample, by the loop's names.
    terms : dict of str to casadi.SX
        What the command is made of: "error", "proportional", "integral" (before back-calculation), "derivative",
        "feedforward", "compensation", "dither", and their sum before the clip, "unlimited".
    """

    states: Signals
    terms: Signals


def controller_update(
    loop: ControllerParts, t: ca.SX, x: Symbols, u: Symbols, y: Symbols, p: Symbols
) -> ControllerUpdate:
    """What a sampled controller computes at a sample.

    Parameters
    ----------
    loop : ClosedLoop
        With a sample time.
    t : casadi.SX
        [s]
    x, u, p : mapping of str to casadi.SX
        The loop's states, inputs (the "reference", and its rates where a part uses them) and parameters.
    y : mapping of str to casadi.SX
        The plant's outputs: the measured one, or what an `Encoder` counts, and those that compensators read.
    """
    seen = (
        loop.sensor.update(without_prefix(x, "sensor"), y, loop.sensed_signal, without_prefix(p, "sensor"))
        if loop.sensor
        else {}
    )
    measured = seen["reading"] if seen else y[loop.sensed_signal.measured.name]
    p = dict(schedule_gains(loop, p, measured, seen, y))
    position = measured if loop.outer is None else seen["count"] if "count" in seen else y[loop.feedback.name]
    x = {**x, **_reset(loop, without_prefix(x, "pid"), u["reference"] - position, without_prefix(p, "pid"))}
    if loop.outer is not None:
        u = pid_reference(loop, u, position, p)
    moved, added = added_command(loop, t, x, u, measured, y, p)
    arguments = without_prefix(x, "pid"), u["reference"], measured
    own = without_prefix(p, "pid")
    after = with_prefix(seen, "sensor") | with_prefix(loop.pid.update(*arguments, added, own), "pid") | moved
    terms = loop.pid.terms(*arguments, own) | added_terms(loop, t, x, u, measured, y, p)[1]
    sum_before_clip = loop.pid.output(*arguments, own) + added
    return ControllerUpdate(after, {"error": u["reference"] - measured, **terms, "unlimited": sum_before_clip})


def _reset(loop: ControllerParts, x: Symbols, error: ca.SX, p: Symbols) -> Signals:
    """The PID's states that a reset changes before its law is computed."""
    return with_prefix(reset_integral(x, error, p), "pid") if loop.pid.reset else {}
