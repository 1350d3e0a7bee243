"""A rig of the size of b32 with hardware that its model does not have, in small explicit steps of machine code.

Friction is set-valued, as of a body that truly sticks: after each step of 4 us the speed falls towards zero by what
friction can take, and stays there if that is enough. It needs no width and no events, and shares nothing with the
library's friction and simulators; valve and chambers are the library's. The sampled position loop of b32.py drives it.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

import pneuopt as po
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.models.pneumatic.chamber import Inflow, Polytropic, Surroundings, Thermal
from pneuopt.models.pneumatic.cylinder import areas, volumes
from pneuopt.models.pneumatic.valve import Flows, Port
from problems.shared.arrays import Array
from problems.shared.b32 import GAINS, LOGGED, SAMPLE, SETTLING, START

STEPS = 250  # a sample: of 4 us, the error of which is a shift in time as long
WALL = 0.5  # [W/K] through the wall of a chamber
RESERVOIR, REGULATOR = 1e-3, 1e-7  # [m^3] of the supply; [kg/(s*Pa)] of its regulator: .1 bar at 1 g/s
BUMP = 0.06  # [m], the period of friction over position


@dataclass(frozen=True)
class Hardware:
    """What the rig has that the model has not; nothing by default, but that it truly sticks.

    Attributes
    ----------
    hysteresis : float
        Of the valve's command, full width [V].
    encoder : float
        Step of the position [m] in place of its noise; 0 for noise.
    tube : float
        Volume [m^3] of each line between valve and chamber, taken from the dead volume; the sensor sits at the valve.
    tube_conductance : float
        Of each line [kg/(s*Pa)].
    dead_time : int
        Samples by which the valve hears the command late.
    pressure_lag, position_lag : float
        Time constants of the sensors [s].
    heat, sag : bool
        Air that exchanges heat with the wall; a supply that sinks with the draw.
    bump : float
        Share by which friction varies over the position [1].
    """

    hysteresis: float = 0.0
    encoder: float = 0.0
    tube: float = 0.0
    tube_conductance: float = 6e-8
    dead_time: int = 0
    pressure_lag: float = 0.0
    position_lag: float = 0.0
    heat: bool = False
    sag: bool = False
    bump: float = 0.0


def record(hardware: Hardware, truth: po.ParameterSet, wanted: Array) -> po.Trajectory:
    """Commands, position and pressures at 1 kHz without noise, after the settling that begins the reference."""
    order, states, rollout = _compile(hardware)
    p = np.array([truth.value(n) if n in truth else GAINS.value(n) for n in order])
    begin = dict.fromkeys(states, 0.0) | _start(truth)
    h = np.full((1, len(wanted)), SAMPLE)
    run = rollout.run(
        np.array([[begin[n] for n in states]]),
        wanted[None, :, None],
        p,
        np.arange(len(wanted))[None] * SAMPLE,
        h,
        substeps=STEPS,
    )
    t = np.arange(len(wanted) - SETTLING) * SAMPLE
    columns = dict(zip(LOGGED, run.y[0, SETTLING:].T.copy(), strict=True))
    if hardware.encoder:
        columns["position"] = hardware.encoder * np.round(columns["position"] / hardware.encoder)
    return po.Trajectory(t, columns)


def _start(truth: po.ParameterSet) -> dict[str, float]:
    pressures = {
        f"{kind}_{side}": START[f"pressure_{side}"] for side in "ab" for kind in ("pressure", "line", "sensed")
    }
    warm = truth.value("ambient.temperature")
    inside = {"position": START["position"], "sensed_position": START["position"], "temperature_a": warm}
    return pressures | inside | {"temperature_b": warm, "supply": truth.value("supply.pressure")}


@functools.cache
def _compile(hardware: Hardware) -> tuple[tuple[str, ...], tuple[str, ...], Rollout]:
    """The order of parameters and states, and the machine code of a rig."""
    own = po.catalog.b32()[0].parameters | po.catalog.b32()[1] | GAINS
    order, p = tuple(own), {n: ca.SX.sym(n) for n in own}
    held = ("command", "play", *(f"late_{k}" for k in range(hardware.dead_time)))
    moving = ("position", "speed", "spool", "supply", "sensed_position")
    sides = tuple(f"{kind}_{side}" for side in "ab" for kind in ("pressure", "temperature", "line", "sensed"))
    states = (*moving, *sides, *held)
    x, u, t, h = {n: ca.SX.sym(n) for n in states}, ca.SX.sym("u"), ca.SX.sym("t"), ca.SX.sym("h")
    x_next = {n: x[n] + h * rate for n, rate in _rates(hardware, x, p).items()}
    x_next["speed"] = _stick(x_next["speed"], x, p, h, hardware.bump)
    x_next["position"] = x["position"] + h * x_next["speed"]
    measured = "sensed" if hardware.pressure_lag else "line" if hardware.tube else "pressure"
    place = "sensed_position" if hardware.position_lag else "position"
    seen = ("command", place, f"{measured}_a", f"{measured}_b")
    vectors = [ca.vertcat(*x.values()), u, ca.vertcat(*p.values())]
    after, logged = ca.vertcat(*(x_next.get(n, x[n]) for n in states)), ca.vertcat(*(x[n] for n in seen))
    step = ca.Function("step", [t, h, *vectors], [after, logged])
    commanded = {**x, **_command(hardware, x, u, p)}
    update = ca.Function("update", [t, *vectors], [ca.vertcat(*commanded.values())])
    return order, states, Rollout(Pieces(step, update))


def _command(hardware: Hardware, x: Mapping[str, ca.SX], wanted: ca.SX, p: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """The controller at an instant: its command, and what the valve hears of it."""
    raw = p["loop.gain"] * (wanted - x["position"]) - p["loop.damping"] * x["speed"]
    command = ca.fmax(-p["loop.limit"], ca.fmin(p["loop.limit"], raw))
    line = [command, *(x[f"late_{k}"] for k in range(hardware.dead_time))]
    heard, half = line[-1], hardware.hysteresis / 2
    play = ca.fmin(ca.fmax(x["play"], heard - half), heard + half)
    return {"command": command, "play": play, **{f"late_{k}": line[k] for k in range(hardware.dead_time)}}


def _stick(v: ca.SX, x: Mapping[str, ca.SX], p: Mapping[str, ca.SX], h: ca.SX, bump: float) -> ca.SX:
    """The speed after dry friction has taken what it can of it."""
    own = {n.removeprefix("friction."): q for n, q in p.items()}
    fall = (own["static"] - own["coulomb"]) * ca.exp(-((v / own["stribeck_velocity"]) ** 2))
    level = (own["coulomb"] + fall) * (1 + bump * ca.sin(2 * math.pi * x["position"] / BUMP))
    return ca.sign(v) * ca.fmax(ca.fabs(v) - h * level / p["load.mass"], 0)


def _rates(hardware: Hardware, x: Mapping[str, ca.SX], p: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """Rates of all that moves, without dry friction."""
    A_a, A_b = areas(p["cylinder.bore"], p["cylinder.rod"])
    push = A_a * (x["pressure_a"] - p["ambient.pressure"]) - A_b * (x["pressure_b"] - p["ambient.pressure"])
    valve = {n.removeprefix("valve."): q for n, q in p.items()}
    spool_rate = 2 * math.pi * valve["bandwidth"] * (ca.fmax(-1, ca.fmin(1, x["play"] / valve["span"])) - x["spool"])
    through = _edge_flows(hardware, x, p, valve)
    rates = {"speed": (push - p["friction.viscous"] * x["speed"]) / p["load.mass"], "spool": spool_rate}
    swept = {"a": A_a * x["speed"], "b": -A_b * x["speed"]}
    fed = {
        "a": [through.supply_a, -through.a_exhaust],
        "b": [through.supply_b, -through.b_exhaust],
    }
    spaces = dict(
        zip("ab", volumes(x["position"], {n.removeprefix("cylinder."): q for n, q in p.items()}), strict=True)
    )
    for side in "ab":
        rates |= _side_rates(hardware, side, fed[side], spaces[side], swept[side], x, p)
    if hardware.sag:
        inflow = REGULATOR * (p["supply.pressure"] - x["supply"]) - through.supply_a - through.supply_b
        rates["supply"] = p["gas.constant"] * p["ambient.temperature"] / RESERVOIR * inflow
    if hardware.position_lag:
        rates["sensed_position"] = (x["position"] - x["sensed_position"]) / hardware.position_lag
    return rates


def _edge_flows(hardware: Hardware, x: Mapping[str, ca.SX], p: Mapping[str, ca.SX], valve: dict[str, ca.SX]) -> Flows:
    """Mass flows through the valve's edges, which see the lines where there are any."""
    outside, kind = p["ambient.temperature"], "line" if hardware.tube else "pressure"
    warm = {side: x[f"temperature_{side}"] if hardware.heat and not hardware.tube else outside for side in "ab"}
    supply = Port(x["supply"] if hardware.sag else p["supply.pressure"], outside)
    ports = {side: Port(x[f"{kind}_{side}"], warm[side]) for side in "ab"}
    exhaust = Port(p["ambient.pressure"], outside)
    return po.catalog.b32()[0].valve.flows(x["spool"], supply, exhaust, ports["a"], ports["b"], valve)


def _side_rates(
    hardware: Hardware,
    side: str,
    fed: list[ca.SX],
    volume: ca.SX,
    swept: ca.SX,
    x: Mapping[str, ca.SX],
    p: Mapping[str, ca.SX],
) -> dict[str, ca.SX]:
    """Rates of one chamber, its line and its sensor."""
    R, outside, rates = p["gas.constant"], p["ambient.temperature"], {}
    if hardware.tube:
        through = hardware.tube_conductance * (x[f"line_{side}"] - x[f"pressure_{side}"])
        rates[f"line_{side}"] = R * outside / hardware.tube * (sum(fed, start=ca.SX(0)) - through)
        fed, volume = [through], volume - hardware.tube
    chamber: Any = Thermal() if hardware.heat else Polytropic()
    inside = {"pressure": x[f"pressure_{side}"], "temperature": x[f"temperature_{side}"]}
    numbers = {"exponent": p["chamber.exponent"], "wall_conductance": ca.SX(WALL)}
    flows = [Inflow(w, outside) for w in fed]
    found = chamber.rates(inside, flows, Surroundings(volume, swept, outside, R), numbers)
    rates |= {f"{n}_{side}": rate for n, rate in found.items()}
    if hardware.pressure_lag:
        seen = x[f"line_{side}"] if hardware.tube else x[f"pressure_{side}"]
        rates[f"sensed_{side}"] = (seen - x[f"sensed_{side}"]) / hardware.pressure_lag
    return rates
