"""Limits of a pneumatic drive: impossible hardware, and where its model ends: end stops, empty chambers."""

from collections.abc import Mapping
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneuopt.dynamics.hooks import ValidityLimit
from pneuopt.models.pneumatic.chamber import MIN_CHAMBER_PRESSURE
from pneuopt.models.pneumatic.cylinder import STOP_ROUNDING
from pneuopt.quantities.errors import HardwareError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value

# Chamber pressure over ambient pressure [1] below which a chamber counts as empty: lip seals let air in well above it;
# a larger ratio warns of chambers that just exhaust.
EMPTY_CHAMBER_RATIO = 0.5
MAX_STOP_TRAVEL = 0.01  # share of the stroke by which a piston that presses on a stop may be outside
# Share of the stroke by which a position sensor's zero may be off: a smaller one warns of usual mounting errors, a
# larger one overlooks a wrong unit or stroke.
MAX_POSITION_ZERO_ERROR = 0.05
_END_NAMES = {"a": "rear", "b": "front"}


def check_hardware(p: ParameterSet) -> None:
    """Refuse impossible hardware, whatever its bounds.

    Parameters
    ----------
    p : ParameterSet
        All parameters of a `PneumaticDrive`.

    Raises
    ------
    HardwareError
        Names parameter, value, source and possible values.
    """
    for name, limit in _hardware_limits(p).items():
        if name in p and not limit.allows(p.value(name)):
            source = f" (source: {p[name].source})" if p[name].source else ""
            shown = write_value(p.value(name), p[name].unit)
            raise HardwareError(f"{name} = {shown}{source} is impossible; {limit.remedy}", name, limit.remedy)


def check_start(p: ParameterSet, start: Mapping[str, float]) -> None:
    """Refuse a start outside the stroke; a piston that presses on a stop is slightly outside.

    Raises
    ------
    InputError
    """
    stroke, y = p.value("cylinder.stroke"), start.get("position", 0.0)
    inside = -MAX_STOP_TRAVEL * stroke <= y <= (1 + MAX_STOP_TRAVEL) * stroke
    shown = write_value(y, "m"), write_value(stroke, "m")
    require(inside, f"a start at position = {shown[0]} lies outside the stroke, 0 to {shown[1]}")


def position_warning(p: ParameterSet, position: NDArray[np.float64]) -> str:
    """Warning of a logged position that is outside the stroke by more than a sensor's zero error.

    Parameters
    ----------
    position : ndarray
        [m]; NaN where it is missing.

    Returns
    -------
    str
        A sentence; empty without an objection.
    """
    stroke = p.value("cylinder.stroke")
    low, high = (float(np.nanpercentile(position, q)) for q in (1, 99))
    if -MAX_POSITION_ZERO_ERROR * stroke <= low and high <= (1 + MAX_POSITION_ZERO_ERROR) * stroke:
        return ""
    where = f"position runs from {write_value(low, 'm')} to {write_value(high, 'm')}"
    remedy = "check its sign, unit and zero, and cylinder.stroke"
    return f"{where}, outside the stroke, 0 to {write_value(stroke, 'm')}: {remedy}"


def cylinder_limits(stops: bool) -> tuple[ValidityLimit, ...]:
    """Validity limits that a simulation of a cylinder watches.

    Parameters
    ----------
    stops : bool
        Whether the covers stop the piston.

    Returns
    -------
    tuple of ValidityLimit
        Both ends of the stroke, and both chambers at half the ambient pressure.
    """
    return (*(_end_limit(side, stops) for side in _END_NAMES), *(_empty_chamber_limit(side) for side in _END_NAMES))


def _end_limit(side: str, stops: bool) -> ValidityLimit:
    what = f"reached the {_END_NAMES[side]} end stop" if stops else f"left the stroke at the {_END_NAMES[side]}"
    meaning = "the response is the stop's" if stops else "the model, which has no stops, means nothing"
    limit, margin = (_front_limit if side == "b" else _rear_limit), (STOP_ROUNDING if stops else 0.0)
    return ValidityLimit("position", partial(limit, margin), 1 if side == "b" else -1, f"the piston {what}", meaning)


def _empty_chamber_limit(side: str) -> ValidityLimit:
    meaning = "real seals let air in, the model does not"
    return ValidityLimit(f"pressure_{side}", _empty_chamber_pressure, -1, f"chamber {side} was emptied", meaning)


def _front_limit(margin: float, p: ParameterSet) -> float:
    return p.value("cylinder.stroke") - margin


def _rear_limit(margin: float, p: ParameterSet) -> float:  # noqa: ARG001 - as `_front_limit`
    return margin


def _empty_chamber_pressure(p: ParameterSet) -> float:
    return EMPTY_CHAMBER_RATIO * p.value("ambient.pressure")


class _Limit(NamedTuple):
    """Possible range of a parameter, with the remedy for a value outside."""

    remedy: str
    lower: float = -inf
    upper: float = inf
    exclusive: bool = True

    def allows(self, value: float) -> bool:
        return self.lower < value < self.upper or (not self.exclusive and value in (self.lower, self.upper))


_POSITIVE_REMEDIES = {
    "cylinder.bore": "a bore is positive",
    "cylinder.stroke": "a stroke is positive",
    "cylinder.dead_volume_a": "ports and hoses always hold some air: a few percent of the swept volume are usual",
    "cylinder.dead_volume_b": "ports and hoses always hold some air: a few percent of the swept volume are usual",
    "valve.conductance": "a conductance is positive, about 2e-8 m^3/(s*Pa) for 500 l/min(ANR)",
    "valve.rounding": "edges are round: 1e-4 is very sharp",
    "valve.span": "give the voltage of full opening, 5 V for a 0-10 V valve",
    "valve.bandwidth": "a bandwidth is positive, or take a valve without a lag",
    "valve.damping": "a damping ratio is positive, 0.5 to 0.8 for most valves",
    "ambient.temperature": "an absolute temperature is positive",
    "gas.constant": "air has 287.05 J/(kg*K)",
    "load.mass": "the piston alone weighs something",
}
_NON_NEGATIVE_REMEDIES = {
    "cylinder.leak": "no leakage is 0",
    "cylinder.stop_stiffness": "no stop is 0, or Cylinder(stops=False)",
    "cylinder.stop_damping": "no damping is 0",
    "valve.leak": "no leakage is 0",
    "chamber.wall_conductance": "no heat transfer is 0",
}


def _hardware_limits(p: ParameterSet) -> dict[str, _Limit]:
    bore, ambient = (write_value(p.value(n), p[n].unit) for n in ("cylinder.bore", "ambient.pressure"))
    exponents = {
        n: _Limit("1 is isothermal, 1.4 adiabatic", 0.0) for n in p if n.startswith("chamber.") and "exponent" in n
    }
    return {
        **{n: _Limit(remedy, 0.0) for n, remedy in _POSITIVE_REMEDIES.items()},
        **{n: _Limit(remedy, 0.0, exclusive=False) for n, remedy in _NON_NEGATIVE_REMEDIES.items()},
        **exponents,
        "cylinder.rod": _Limit(
            f"a rod is thinner than the bore, {bore}; rodless is 0", -1e-300, p.value("cylinder.bore")
        ),
        "cylinder.start": _Limit("a start lies within the stroke, 0 to 1", 0.0, 1.0, exclusive=False),
        "valve.critical_ratio": _Limit(
            "a critical pressure ratio lies between 0 and 1, 0.2 to 0.5 for most valves", -1e-300, 1.0
        ),
        "ambient.pressure": _Limit("an absolute pressure is positive; sea level is 101325 Pa(a)", MIN_CHAMBER_PRESSURE),
        "supply.pressure": _Limit(
            f"the supply lies above the ambient pressure, {ambient}", p.value("ambient.pressure")
        ),
    }
