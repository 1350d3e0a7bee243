"""The air in a cylinder's chamber: its pressure, and optionally its temperature, from flows and motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import casadi as ca

from pneuopt.dynamics.system import Symbols
from pneuopt.models.pneumatic.gas import ISENTROPIC_EXPONENT
from pneuopt.models.tolerances import MIN_CHAMBER_PRESSURE
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

PRESSURE = Quantity("pressure", "Pa(a)", nominal=5e5, lower=MIN_CHAMBER_PRESSURE)


class Inflow(NamedTuple):
    """A mass flow into the chamber [kg/s], negative outwards, and the temperature of the air it brings [K]."""

    rate: ca.SX
    temperature: ca.SX


class Surroundings(NamedTuple):
    """Quantities outside the air: volume [m^3], its rate [m^3/s], temperature of supply and wall [K], gas constant."""

    volume: ca.SX
    volume_rate: ca.SX
    temperature: ca.SX
    gas_constant: ca.SX


class ChamberModel(Protocol):
    """Interface of a chamber for a drive; one level, no inheritance."""

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of the air: the pressure, and others if the model has them."""

    @property
    def parameters(self) -> ParameterSet:
        """Parameters, which a drive's chambers share."""

    def temperature(self, z: Symbols, outside: ca.SX) -> ca.SX:
        """Temperature of the air inside [K]."""

    def rates(self, z: Symbols, flows: Sequence[Inflow], around: Surroundings, p: Symbols) -> dict[str, ca.SX]:
        """Rates of the states."""


@dataclass(frozen=True)
class Polytropic:
    r"""A polytropic chamber without temperature state: its exponent lies between isothermal (1) and adiabatic (1.4).

    .. math:: \dot p = \frac{1}{V} \left( \alpha(w) R T w - \alpha_V p \dot V \right), \qquad w = \sum_j w_j

    With all three exponents 1 mass is conserved exactly; all 1.4 is eq. (7) and (8) of Ye, Wang, Chen (IJRES 3(7),
    2015). The net flow decides between the exponents of inflow and outflow. If each flow had its own, a valve that
    leaks at its null would be at rest where more air leaves than enters.

    Parameters
    ----------
    mixed : bool
        Whether inflow, outflow and volume have separate exponents; Richer & Hurmuzlu, J. Dyn. Sys. Meas. Control
        122(3), 2000, found 1.4, 1 and 1.2 to agree with experiment.
    """

    mixed: bool = False

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Pressure [Pa(a)]."""
        return (PRESSURE,)

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: exponent [1], or if mixed inflow_exponent, outflow_exponent, volume_exponent."""
        if not self.mixed:
            exponent = Parameter(1.2, "1", 0.9, 1.5, meaning="polytropic exponent: 1 isothermal, 1.4 adiabatic")
            return ParameterSet({"exponent": exponent})
        values = {"inflow_exponent": 1.4, "outflow_exponent": 1.0, "volume_exponent": 1.2}
        source = "Richer & Hurmuzlu 2000"
        return ParameterSet(
            {
                n: Parameter(
                    v, "1", 0.9, 1.5, source=source, meaning=f"polytropic exponent of the {n.partition('_')[0]}"
                )
                for n, v in values.items()
            }
        )

    def temperature(self, z: Symbols, outside: ca.SX) -> ca.SX:  # noqa: ARG002 - the protocol's arguments
        """Temperature of the surroundings."""
        return outside

    def rates(self, z: Symbols, flows: Sequence[Inflow], around: Surroundings, p: Symbols) -> dict[str, ca.SX]:
        """Return the rates of the states; see the class."""
        w = sum((flow.rate for flow in flows), start=ca.SX(0))
        inward, outward, swept = (
            p[f"{n}_exponent" if self.mixed else "exponent"] for n in ("inflow", "outflow", "volume")
        )
        fed = convection(w, inward, outward) * around.gas_constant * around.temperature
        return {"pressure": (fed - swept * z["pressure"] * around.volume_rate) / around.volume}


@dataclass(frozen=True)
class Thermal:
    r"""Energy balance with a temperature state and heat through the wall; mass and energy close exactly.

    .. math::
        \dot p = \frac{\kappa R}{V} \sum_j T_j w_j - \kappa \frac{p \dot V}{V} + \frac{\kappa - 1}{V} h A (T_w - T)
        \qquad \dot T = T \left( \frac{\dot p}{p} + \frac{\dot V}{V} - \frac{R T}{p V} \sum_j w_j \right)

    T_j is the source's temperature for inflow, the chamber's for outflow; the wall has the surroundings' temperature.
    """

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Pressure [Pa(a)], temperature [K]."""
        return (PRESSURE, Quantity("temperature", "K", nominal=300.0, lower=10.0))

    @property
    def parameters(self) -> ParameterSet:
        """Parameter: wall_conductance [W/K], heat transfer coefficient times wall area."""
        wall = Parameter(0.5, "W/K", 0.0, 1e3, meaning="heat transfer coefficient times area of the chamber's wall")
        return ParameterSet({"wall_conductance": wall})

    def temperature(self, z: Symbols, outside: ca.SX) -> ca.SX:  # noqa: ARG002 - the protocol's arguments
        """Temperature of the air, a state."""
        return z["temperature"]

    def rates(self, z: Symbols, flows: Sequence[Inflow], around: Surroundings, p: Symbols) -> dict[str, ca.SX]:
        """Return the rates of the states; see the class."""
        pressure, temperature, k = z["pressure"], z["temperature"], ISENTROPIC_EXPONENT
        enthalpy = sum((convection(w, source, temperature) for w, source in flows), start=ca.SX(0))
        heat = p["wall_conductance"] * (around.temperature - temperature)
        rate = (k * around.gas_constant * enthalpy - k * pressure * around.volume_rate + (k - 1) * heat) / around.volume
        mass = pressure * around.volume / (around.gas_constant * temperature)
        growth = sum((flow.rate for flow in flows), start=ca.SX(0)) / mass
        return {
            "pressure": rate,
            "temperature": temperature * (rate / pressure + around.volume_rate / around.volume - growth),
        }


def convection(flow: ca.SX, inward: ca.SX, outward: ca.SX) -> ca.SX:
    """Rate at which a mass flow [kg/s] carries a property: `inward` per mass into the chamber, `outward` out of it.

    It has a kink at zero flow, and no step, so that nothing is rounded: a width in kg/s that is nothing for a large
    drive is the flow of slow motion for a small one.

    Examples
    --------
    >>> [round(float(convection(w, 1.4, 1.0)), 6) for w in (1e-2, -1e-2)]
    [0.014, -0.01]
    """
    return outward * flow + (inward - outward) * ca.fmax(flow, 0)
