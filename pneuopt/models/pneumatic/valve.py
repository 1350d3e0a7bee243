"""A 5/3 proportional directional valve: spool, four metering edges, leak."""

from dataclasses import dataclass, field
from enum import Enum
from math import pi
from typing import NamedTuple

import casadi as ca

from pneuopt.dynamics.hooks import DEFAULT_WIDTH
from pneuopt.dynamics.system import Symbols
from pneuopt.models.pneumatic.gas import REFERENCE_TEMPERATURE, FlowLaw, Iso6358, Smoothing
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.units import ANR_DENSITY


class Spool(Enum):
    """Order of the lag with which the spool follows its command."""

    RIGID = 0
    FIRST_ORDER = 1
    SECOND_ORDER = 2


class Port(NamedTuple):
    """The air at one of the valve's ports: absolute pressure [Pa] and temperature [K]."""

    pressure: ca.SX
    temperature: ca.SX


class Flows(NamedTuple):
    """Mass flows through the four edges [kg/s], each positive from the first port to the second."""

    supply_a: ca.SX
    a_exhaust: ca.SX
    supply_b: ca.SX
    b_exhaust: ca.SX


@dataclass(frozen=True)
class ProportionalValve:
    r"""A 5/3 proportional valve: positive voltage opens supply to port a and port b to exhaust.

    The spool's position x is a fraction of its half travel: 0 at the voltage `centre`, 1 at `span` above it, where it
    stops. Each edge opens by

    .. math:: o(x) = \tfrac12 \left[(x - x_0) + \sqrt{(x - x_0)^2 + \delta^2}\right] + leak

    with x_0 the overlap (a dead zone; negative for underlap) and delta the edge's rounding, and passes
    C o(x) rho_0 sqrt(T_0/T) times the law's pressure. The command is clipped hard at the stops.
    """

    law: FlowLaw = field(default_factory=Iso6358)
    spool: Spool = Spool.SECOND_ORDER
    smoothing: Smoothing = field(default_factory=Smoothing)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of the lag: spool [1] and spool_rate [1/s], as many as its order."""
        lagging = (Quantity("spool", "1", nominal=0.3), Quantity("spool_rate", "1/s", nominal=50.0))
        return lagging[: self.spool.value]

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: conductance of an open edge, flow law, spool's geometry and lag, command's centre and span."""
        lag = {
            "bandwidth": Parameter(80.0, "Hz", 1.0, 2000.0, log=True, meaning="corner frequency of the spool's lag"),
            "damping": Parameter(0.7, "1", 0.1, 5.0, log=True, meaning="damping ratio of the spool's lag"),
        }
        geometry = {
            "dead_zone": Parameter(
                0.0, "1", -0.5, 0.5, meaning="overlap of the edges, a fraction of half the spool's travel"
            ),
            "rounding": Parameter(
                0.04,
                "1",
                1e-6,
                0.5,
                log=True,
                source=DEFAULT_WIDTH,
                meaning="rounding of the edges, a fraction of half the travel",
            ),
            "leak": Parameter(0.0, "1", 0.0, 0.2, meaning="opening of a closed edge, a fraction of the full one"),
            "centre": Parameter(0.0, "V", -100.0, 100.0, meaning="command at which the valve is closed, 5 V of 0-10 V"),
            "span": Parameter(5.0, "V", 0.1, 100.0, meaning="command from the centre to full opening"),
        }
        conductance = Parameter(
            2e-8, "m^3/(s*Pa)", 1e-12, 1e-4, log=True, meaning="ISO 6358 sonic conductance C of an open edge"
        )
        moving = dict(list(lag.items())[: self.spool.value])
        return ParameterSet({"conductance": conductance}) | self.law.parameters | ParameterSet({**geometry, **moving})

    def position(self, voltage: ca.SX, z: Symbols, p: Symbols) -> ca.SX:
        """Spool position [1] at a command [V] and the states z."""
        return _spool_command(voltage, p) if self.spool is Spool.RIGID else z["spool"]

    def rates(self, voltage: ca.SX, z: Symbols, p: Symbols) -> dict[str, ca.SX]:
        """Rates of the spool's states: a lag of first or second order, corner frequency `bandwidth`."""
        if self.spool is Spool.RIGID:
            return {}
        w = 2 * pi * p["bandwidth"]
        error = _spool_command(voltage, p) - z["spool"]
        if self.spool is Spool.FIRST_ORDER:
            return {"spool": w * error}
        return {"spool": z["spool_rate"], "spool_rate": w**2 * error - 2 * p["damping"] * w * z["spool_rate"]}

    def flows(self, spool: ca.SX, supply: Port, exhaust: Port, a: Port, b: Port, p: Symbols) -> Flows:
        """Mass flows [kg/s] at a spool position [1]."""

        def edge_flow(upstream: Port, downstream: Port, x: ca.SX) -> ca.SX:
            # the air has the temperature of the port with the higher pressure, smooth in between
            fall = upstream.pressure - downstream.pressure
            share = (1 + fall / ca.sqrt(fall**2 + self.smoothing.pressure**2)) / 2
            temperature = downstream.temperature + (upstream.temperature - downstream.temperature) * share
            scale = p["conductance"] * ANR_DENSITY * opening(x, p) * ca.sqrt(REFERENCE_TEMPERATURE / temperature)
            return scale * self.law.flow(upstream.pressure, downstream.pressure, p, self.smoothing)

        return Flows(
            edge_flow(supply, a, spool),
            edge_flow(a, exhaust, -spool),
            edge_flow(supply, b, -spool),
            edge_flow(b, exhaust, spool),
        )


def opening(x: ca.SX, p: Symbols) -> ca.SX:
    """Opening of one edge, a positive fraction of the full one, at a spool position x [1] towards it.

    Examples
    --------
    >>> round(float(opening(0.0, {"dead_zone": 0.0, "rounding": 0.04, "leak": 0.01})), 4)
    0.03
    """
    beyond = x - p["dead_zone"]
    return (beyond + ca.sqrt(beyond**2 + p["rounding"] ** 2)) / 2 + p["leak"]


def _spool_command(voltage: ca.SX, p: Symbols) -> ca.SX:
    return ca.fmax(-1, ca.fmin(1, (voltage - p["centre"]) / p["span"]))
