"""The reset of a PID's integral where the error changes sign, and where the motion then stops: against hunting."""

from typing import Any

import casadi as ca

from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.units import difference_unit

SIDE, EXCURSION = "side", "excursion"


RESET_STATES = (SIDE, EXCURSION)


def reset_integral(x: Symbols, error: Any, p: Symbols) -> dict[str, ca.SX]:
    """The integral and the own states before the law of a sample, from the error of what the loop is judged by.

    With the error e, the side s_ on which it was (-1 or 1; 0 at the start) and the excursion m_, of the sample before::

        s_ e < 0 and |e| > reset_band:  I = -reset_ratio I_,  s = sign(e),  m = |e|     the error has changed sides
        m_ > 0 and |e| > m_:            I = I_,               s = s_,       m = |e|     it still goes away
        m_ > 0 otherwise:               I = 0,                s = s_,       m = 0       it has stopped, or turned
        otherwise:                      I = I_,               s = s_ or, beyond the band at the start, sign(e)

    So the integral that broke the body away brakes it beyond the reference, and where it then sticks nothing pushes it
    on: it is pulled back from there by a new integral, over ever shorter ways. A constant load must be held otherwise,
    as the second reset takes away what held it.

    After R. Beerens, A. Bisoffi, L. Zaccarian, H. Nijmeijer, M. Heemels & N. van de Wouw, Reset PID design for motion
    systems with Stribeck friction, IEEE Trans. Control Syst. Technol. 30 (2022) 294-310: resets at zero crossings of
    the position error and of the speed, in continuous time. Their rules are here those of a sampled controller that
    sees the error alone: a stop is a sample at which the error no longer grows.
    """
    size, armed = ca.fabs(error), x[EXCURSION] > 0
    beyond = size > p["reset_band"]
    crosses = ca.logic_and(x[SIDE] * error < 0, beyond)
    stops = ca.logic_and(armed, size <= x[EXCURSION])
    begins = ca.logic_and(x[SIDE] == 0, beyond)
    integral = ca.if_else(crosses, -p["reset_ratio"] * x["integral"], ca.if_else(stops, 0, x["integral"]))
    excursion = ca.if_else(crosses, size, ca.if_else(armed, ca.if_else(stops, 0, size), 0))
    side = ca.if_else(ca.logic_or(crosses, begins), ca.if_else(error < 0, -1, 1), x[SIDE])
    return {"integral": integral, SIDE: side, EXCURSION: excursion}


def reset_parameters(unit: str) -> ParameterSet:
    """The ratio [1], and the error within which no change of sign counts, of a signal of this unit."""
    kept = "part of the integral that is kept, its sign turned"
    still = Parameter(0.0, difference_unit(unit), 0.0, meaning="error within which no change of its sign counts")
    return ParameterSet({"reset_ratio": Parameter(1.0, "1", 0.0, 1.0, meaning=kept), "reset_band": still})


def reset_quantities(measured: Quantity) -> tuple[Quantity, ...]:
    """The states: the side on which the error was last, and how far it has gone since it changed sides."""
    return Quantity(SIDE, "1"), Quantity(EXCURSION, difference_unit(measured.unit), measured.nominal)
