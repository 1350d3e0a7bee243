"""The equations of a loop: the rates of a continuous one, and of a sampled one between two samples."""

from typing import TYPE_CHECKING

import casadi as ca

from pneuopt.control.command import added_command, pid_reference
from pneuopt.control.gain_schedule import schedule_gains
from pneuopt.control.sensor import Signals
from pneuopt.control.wiring import evaluate_plant
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import with_prefix, without_prefix

if TYPE_CHECKING:
    from pneuopt.control.loop import ClosedLoop


def continuous_rates(loop: "ClosedLoop", t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
    """Rates and outputs of a loop with a continuous PID."""
    shown = evaluate_plant(loop.plant, loop.command.name, t, x, u, p, ca.SX(0))[1]
    seen = x["sensor.reading"] if loop.sensor else shown[loop.pid_signal.name]
    p = schedule_gains(loop, p, seen, {}, shown)
    u = pid_reference(loop, u, shown[loop.feedback.name], p)
    moved, added = added_command(loop, t, x, u, seen, shown, p)
    rates, command = loop.pid.rates(without_prefix(x, "pid"), u["reference"], seen, added, without_prefix(p, "pid"))
    xdot, y = evaluate_plant(loop.plant, loop.command.name, t, x, u, p, command)
    own = with_prefix(rates, "pid") | moved | _sensor_rates(loop, x, y, p)
    return xdot | own, y | {"control": command}


def held_rates(loop: "ClosedLoop", t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
    """Rates and outputs of a loop with a sampled PID while its command is held."""
    command = x["pid.command"]
    if loop.dither and loop.dither.analogue:
        command = loop.pid.clip(command + loop.dither.wave(t, without_prefix(p, "dither")), without_prefix(p, "pid"))
    xdot, y = evaluate_plant(loop.plant, loop.command.name, t, x, u, p, command)
    held = tuple(f"{n}." for n in loop.tunable_sections)
    own = {n: ca.SX(0) for n in x if n.startswith(held)} | _sensor_rates(loop, x, y, p)
    return xdot | own, y | {"control": command}


def _sensor_rates(loop: "ClosedLoop", x: Symbols, y: Symbols, p: Symbols) -> Signals:
    if loop.sensor is None:
        return {}
    own = without_prefix(x, "sensor"), y, loop.sensed_signal, without_prefix(p, "sensor")
    return with_prefix(loop.sensor.rates(*own), "sensor")
