"""The air in a cylinder's chamber: pressure, and where wanted temperature, from flows and motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from pneuopt.models.gas import GAS_CONSTANT, ISENTROPIC
from pneuopt.parameters import Parameter, ParameterSet, Quantity

Symbols = Mapping[str, ca.SX]
TURNING_FLOW = 1e-5  # [kg/s] over which a flow's exponent or temperature changes from outflow's to inflow's
PRESSURE = Quantity("pressure", "Pa(a)", nominal=5e5, lower=0.0)


class ChamberModel(Protocol):
    """What a drive needs of a chamber; one level, no inheritance."""

    @property
    def states(self) -> tuple[Quantity, ...]:
        """pressure, and what else the air needs."""
        ...

    @property
    def parameters(self) -> ParameterSet:
        """Shared by a drive's chambers."""
        ...

    def rates(
        self, z: Symbols, flows: Sequence[ca.SX], volume: ca.SX, swept: ca.SX, source: ca.SX, p: Symbols
    ) -> dict[str, ca.SX]:
        """Rates of the states under mass flows into the chamber [kg/s] from air at `source` [K].

        volume [m^3] and swept, its rate [m^3/s], are those of the chamber now.
        """
        ...


@dataclass(frozen=True)
class Polytropic:
    r"""No temperature state: exponents between isothermal (1) and adiabatic (1.4), for inflow, outflow and volume.

    .. math:: \dot p = \frac{R T}{V} \sum_j \alpha(w_j) w_j - \alpha_V \frac{p \dot V}{V}

    Source: Richer & Hurmuzlu, J. Dyn. Sys. Meas. Control 122(3), 2000, who found 1.4, 1 and 1.2 to agree with experiment.
    All three 1.4 is the paper's eq. (7) and (8).
    """

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Pressure [Pa(a)]."""
        return (PRESSURE,)

    @property
    def parameters(self) -> ParameterSet:
        """Exponents [1]: inflow, outflow, volume."""
        exponent = Parameter(1.4, "1", 0.9, 1.5)
        volume = Parameter(1.2, "1", 0.9, 1.5)
        outflow = Parameter(1.0, "1", 0.9, 1.5)
        return ParameterSet({"inflow_exponent": exponent, "outflow_exponent": outflow, "volume_exponent": volume})

    def rates(
        self, z: Symbols, flows: Sequence[ca.SX], volume: ca.SX, swept: ca.SX, source: ca.SX, p: Symbols
    ) -> dict[str, ca.SX]:
        """See `ChamberModel`."""
        fed = sum((w * blend(w, p["inflow_exponent"], p["outflow_exponent"]) for w in flows), start=ca.SX(0))
        return {"pressure": (GAS_CONSTANT * source * fed - p["volume_exponent"] * z["pressure"] * swept) / volume}


@dataclass(frozen=True)
class Thermal:
    r"""Energy balance with a temperature state and heat through the wall; mass and energy close exactly.

    .. math:: \dot p = \frac{\kappa R}{V} \sum_j T_j w_j - \kappa \frac{p \dot V}{V} + \frac{\kappa - 1}{V} h A (T_w - T)
        \qquad \dot T = T \left( \frac{\dot p}{p} + \frac{\dot V}{V} - \frac{R T}{p V} \sum_j w_j \right)

    T_j is the source's temperature for inflow, the chamber's for outflow; the wall keeps the source's.
    """

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Pressure [Pa(a)], temperature [K]."""
        return (PRESSURE, Quantity("temperature", "K", nominal=300.0, lower=0.0))

    @property
    def parameters(self) -> ParameterSet:
        """wall_conductance [W/K], heat transfer coefficient times wall area."""
        return ParameterSet({"wall_conductance": Parameter(0.5, "W/K", 0.0, 1e3)})

    def rates(
        self, z: Symbols, flows: Sequence[ca.SX], volume: ca.SX, swept: ca.SX, source: ca.SX, p: Symbols
    ) -> dict[str, ca.SX]:
        """See `ChamberModel`."""
        pressure, temperature = z["pressure"], z["temperature"]
        enthalpy = sum((w * blend(w, source, temperature) for w in flows), start=ca.SX(0))
        heat = p["wall_conductance"] * (source - temperature)
        k = ISENTROPIC
        rate = (k * GAS_CONSTANT * enthalpy - k * pressure * swept + (k - 1) * heat) / volume
        mass_rate = sum(flows, start=ca.SX(0))
        relative = rate / pressure + swept / volume - GAS_CONSTANT * temperature * mass_rate / (pressure * volume)
        return {"pressure": rate, "temperature": temperature * relative}


def blend(flow: ca.SX, inward: ca.SX, outward: ca.SX) -> ca.SX:
    """A property of the air that passes: `inward` for flow into the chamber, `outward` for flow out, smooth between.

    Examples
    --------
    >>> round(float(blend(1e-2, 1.4, 1.0)), 6), round(float(blend(0.0, 1.4, 1.0)), 6)
    (1.4, 1.2)
    """
    return outward + (inward - outward) * (1 + flow / ca.sqrt(flow**2 + TURNING_FLOW**2)) / 2
