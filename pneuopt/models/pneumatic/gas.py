"""Air and its flow through an orifice, by ISO 6358 or as an isentropic nozzle, both smooth.

Both laws have a choked plateau and a falling branch. They are written in z, the pressure ratio's distance from 1 over
that of the critical ratio, clipped smoothly at -1 and 1, so that flow passes zero without a kink. Errors of the
smoothing, as a fraction of the choked flow, for zero = 1e-3: 5e-5 where choked, 2e-4 below a pressure ratio of 0.99,
1.1 % at worst (above 0.9998); for zero = 1e-2: 1.6 % below 0.99.
"""

from dataclasses import dataclass
from math import sqrt
from typing import Protocol

import casadi as ca

from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.units import ANR_DENSITY

GAS_CONSTANT = 287.05  # specific gas constant of dry air [J/(kg K)]
ISENTROPIC_EXPONENT = 1.4  # ratio of specific heats of air [-]
REFERENCE_TEMPERATURE = 293.15  # temperature at ANR [K]
REFERENCE_PRESSURE = 1e5  # pressure at ANR [Pa]
_TEMPERATURE_EXPONENT = (ISENTROPIC_EXPONENT - 1) / ISENTROPIC_EXPONENT
# Critical pressure ratio of the isentropic nozzle, 0.528282 [-].
CRITICAL_RATIO = (2 / (ISENTROPIC_EXPONENT + 1)) ** (ISENTROPIC_EXPONENT / (ISENTROPIC_EXPONENT - 1))


@dataclass(frozen=True)
class Smoothing:
    """Rounding widths of the flow laws."""

    corner: float = 0.02  # of the corner to the choked plateau [-]
    zero: float = 1e-3  # of the square root at zero flow [-]; a chamber's decay rate grows with its power -1/2
    pressure: float = 100.0  # of the maximum of the two pressures [Pa]


class FlowLaw(Protocol):
    """Interface of a flow law: flow through an orifice of unit conductance between two pressures."""

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the law beside the conductance."""

    def flow(self, upstream: ca.SX, downstream: ca.SX, p: Symbols, smoothing: Smoothing) -> ca.SX:
        """Mass flow over conductance, reference density and sqrt(T0/T) [Pa]; it changes sign with the pressures."""


@dataclass(frozen=True)
class Iso6358:
    """Ellipse of ISO 6358-1:2013: choked up to the critical ratio b, then ``(1 - ((r - b)/(1 - b))^2)^m``.

    Parameters
    ----------
    exponent : float
        m, the subsonic index; 0.5 unless measured.
    """

    exponent: float = 0.5

    @property
    def parameters(self) -> ParameterSet:
        """Parameter: critical_ratio, b [1]."""
        ratio = Parameter(0.3, "1", 0.05, 0.6, meaning="ISO 6358 critical pressure ratio b of the valve")
        return ParameterSet({"critical_ratio": ratio})

    def flow(self, upstream: ca.SX, downstream: ca.SX, p: Symbols, smoothing: Smoothing) -> ca.SX:
        """See `FlowLaw`."""
        high, z, s = clip_pressure_ratio(upstream, downstream, p["critical_ratio"], smoothing)
        flow: ca.SX = high * z / s * (s * (2 - s)) ** self.exponent
        return flow


@dataclass(frozen=True)
class IsentropicNozzle:
    """Isentropic nozzle (Saint-Venant, Wantzel), scaled to 1 where choked.

    Eq. (1) and (2) of Ye, Wang, Chen (IJRES 3(7), 2015).

    Its critical ratio is 0.5283; the ellipse of ISO 6358 with b = 0.5283 differs by 0.15 % of the choked flow.
    """

    @property
    def parameters(self) -> ParameterSet:
        """No parameters."""
        return ParameterSet()

    def flow(self, upstream: ca.SX, downstream: ca.SX, p: Symbols, smoothing: Smoothing) -> ca.SX:  # noqa: ARG002 - the protocol's arguments
        """See `FlowLaw`."""
        high, z, s = clip_pressure_ratio(upstream, downstream, CRITICAL_RATIO, smoothing)
        # r^(2/k) - r^((k+1)/k) with one power: k = 1.4 makes 2/(k-1) the whole number 5
        chill = (1 - (1 - CRITICAL_RATIO) * s) ** _TEMPERATURE_EXPONENT
        least = CRITICAL_RATIO**_TEMPERATURE_EXPONENT
        flow: ca.SX = high * z / s * ca.sqrt(chill**5 * (1 - chill) / (least**5 * (1 - least)))
        return flow


def clip_pressure_ratio(p1: ca.SX, p2: ca.SX, b: ca.SX | float, smoothing: Smoothing) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Higher pressure [Pa], clipped ratio z in (-1, 1), s = sqrt(z^2 + zero^2), from absolute pressures [Pa].

    Flow from 1 to 2 is positive; b is the critical pressure ratio.

    Examples
    --------
    >>> high, z, s = clip_pressure_ratio(6e5, 5e5, 0.3, Smoothing())
    >>> round(float(high)), round(float(z), 4)
    (600000, 0.238)
    """
    high = (p1 + p2 + ca.sqrt((p1 - p2) ** 2 + smoothing.pressure**2)) / 2
    raw = (p1 - p2) / (high * (1 - b))
    z = (ca.sqrt((raw + 1) ** 2 + smoothing.corner**2) - ca.sqrt((raw - 1) ** 2 + smoothing.corner**2)) / 2
    return high, z, ca.sqrt(z**2 + smoothing.zero**2)


def conductance_of_area(area: float) -> float:
    """ISO 6358 conductance C [m^3/(s Pa)] of an isentropic orifice with the effective area C_d A [m^2].

    Same choked flow at 293.15 K: w = C_d A p sqrt(k/(R T)) (2/(k+1))^((k+1)/(2(k-1))) = C rho_0 p sqrt(T_0/T).

    Examples
    --------
    >>> round(conductance_of_area(5.02e-6) * 1e8, 3)
    1.0
    """
    k = ISENTROPIC_EXPONENT
    choked = sqrt(k / (GAS_CONSTANT * REFERENCE_TEMPERATURE)) * (2 / (k + 1)) ** ((k + 1) / (2 * (k - 1)))
    return float(area * choked / ANR_DENSITY)


def conductance_of_nominal_flow(flow: float, b: float = 0.3) -> float:
    """ISO 6358 conductance C [m^3/(s Pa)] of a catalogue's nominal flow Q [m^3/s, ANR], 6 to 5 bar gauge.

    Q = C p_1 sqrt(1 - ((r - b)/(1 - b))^2) at p_1 = 7.013 bar, r = 6.013/7.013; b is the critical pressure ratio.

    Examples
    --------
    >>> round(conductance_of_nominal_flow(700 / 60e3) * 1e8, 2)
    2.75
    """
    p1, p2 = 7.01325e5, 6.01325e5
    return flow / (p1 * sqrt(1 - ((p2 / p1 - b) / (1 - b)) ** 2))
