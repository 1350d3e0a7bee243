"""Geometry of a double-acting cylinder: areas, volumes, end stops, leakage past the piston.

Position counts from the end at which chamber a is smallest; the rod is on side b.
"""

from dataclasses import dataclass
from math import pi

import casadi as ca

from pneuopt.dynamics.system import Symbols
from pneuopt.models.pneumatic.gas import REFERENCE_PRESSURE
from pneuopt.models.tolerances import STOP_ROUNDING
from pneuopt.quantities.parameters import Parameter, ParameterSet


@dataclass(frozen=True)
class Cylinder:
    """A double-acting cylinder: bore, rod, stroke, dead volumes, leakage and end stops.

    Parameters
    ----------
    stops : bool
        Whether the covers stop the piston; otherwise it runs on beyond the stroke, for optimisers that bound the
        position themselves.
    """

    stops: bool = True

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: geometry, leak, the rest position `start`, and with stops their stiffness and damping."""
        always = {
            "bore": Parameter(0.032, "m", 1e-3, 1.0, meaning="diameter of the piston"),
            "rod": Parameter(0.012, "m", 0.0, 1.0, meaning="diameter of the rod, on side b; 0: rodless"),
            "stroke": Parameter(0.2, "m", 1e-3, 20.0, meaning="travel from cover to cover"),
            "dead_volume_a": Parameter(
                8e-6, "m^3", 1e-9, 1.0, log=True, meaning="volume of chamber a, hose and port at position 0"
            ),
            "dead_volume_b": Parameter(
                8e-6, "m^3", 1e-9, 1.0, log=True, meaning="volume of chamber b, hose and port at the stroke's end"
            ),
            "leak": Parameter(0.0, "kg/(s*Pa)", 0.0, 1e-6, meaning="laminar leakage past the piston, at 100 kPa"),
            "start": Parameter(0.5, "1", 0.0, 1.0, meaning="where a step starts, as a fraction of the stroke"),
        }
        stops = {
            "stop_stiffness": Parameter(1e6, "N/m", 0.0, 1e9, meaning="stiffness of the covers"),
            "stop_damping": Parameter(1.0, "s/m", 0.0, 100.0, meaning="damping of the covers, per speed"),
        }
        return ParameterSet({**always, **(stops if self.stops else {})})

    def stop_force(self, y: ca.SX, v: ca.SX, p: Symbols) -> ca.SX:
        r"""Force of the covers on the piston [N] at position y [m] and speed v [m/s].

        .. math:: -K \sigma(y - L)(1 + c v) + K \sigma(-y)(1 - c v)

        A cover's compression sigma(d) is exactly 0 up to delta before it and exactly d from delta beyond it, with two
        continuous derivatives in between. A rounding with a tail, such as a hyperbola, would push inside the stroke,
        and by its damping act as viscous friction there: 0.01 N*s/m in a cylinder of 1 m, 3 % of a light drive's.
        """
        if not self.stops:
            return ca.SX(0)
        front, rear = (_compression(d) for d in (y - p["stroke"], -y))
        return p["stop_stiffness"] * (rear * (1 - p["stop_damping"] * v) - front * (1 + p["stop_damping"] * v))


def _compression(d: ca.SX) -> ca.SX:
    """Compression [m] of a cover that the piston is d [m] beyond."""
    w = ca.fmax(-1, ca.fmin(1, d / STOP_ROUNDING))
    return ca.fmax(d - STOP_ROUNDING, 0) + STOP_ROUNDING / 16 * (w + 1) ** 3 * (3 - w)


def areas(bore: ca.SX, rod: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Piston areas [m^2] towards chamber a and towards chamber b, where the rod is, from diameters [m]; rodless: 0.

    Examples
    --------
    >>> [round(float(area) * 1e6, 1) for area in areas(0.032, 0.012)]
    [804.2, 691.2]
    """
    a = pi / 4 * bore**2
    return a, a - pi / 4 * rod**2


def volumes(y: ca.SX, p: Symbols) -> tuple[ca.SX, ca.SX]:
    """Volumes of chambers a and b [m^3] at position y [m], with the dead volumes in the cylinder's parameters p.

    Examples
    --------
    >>> hardware = {"bore": 0.032, "rod": 0.012, "stroke": 0.2, "dead_volume_a": 8e-6, "dead_volume_b": 8e-6}
    >>> [round(float(volume) * 1e6, 2) for volume in volumes(0.1, hardware)]
    [88.42, 77.12]
    """
    a, b = areas(p["bore"], p["rod"])
    return p["dead_volume_a"] + a * y, p["dead_volume_b"] + b * (p["stroke"] - y)


def piston_leak(pressure_a: ca.SX, pressure_b: ca.SX, leak: ca.SX) -> ca.SX:
    """Laminar leakage past the piston [kg/s] from b to a, ``G (p_b - p_a)(p_a + p_b) / (2 p_0)``.

    Pressures are absolute [Pa]; the leak G [kg/(s Pa)] is that at a mean pressure p_0 of 100 kPa.

    Examples
    --------
    >>> round(float(piston_leak(2e5, 4e5, 1e-11)) * 1e6, 6)
    6.0
    """
    return leak * (pressure_b - pressure_a) * (pressure_a + pressure_b) / (2 * REFERENCE_PRESSURE)
