"""`GainSchedule`: gains that change with the position and with the load that the controller is told."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

import casadi as ca

from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet

SCHEDULED_GAINS = ("pid.Kp", "pid.Ki", "pid.Kd", "pid.K", "position_loop.Kp", "pressure_feedback.gain")
"""Gains that a schedule may change; Kp of the standard and K of the series form change the whole PID's gain."""
TERMS: Mapping[str, str] = {
    "slope": "logarithm's change from the middle to the upper end of",
    "curve": "logarithm's change from the middle to either end of",
    "load": "exponent of the load in",
}
"""Coefficients of a gain's surface, and what each is of the gain."""


@dataclass(frozen=True)
class GainSchedule:
    """``gain(y, m) = gain exp(slope xi + curve xi^2) (m/m_0)^load``, with ``xi = (2 y - low - high)/(high - low)``.

    y is the position measured, held within [low, high], so that xi is -1 at the lower end and 1 at the upper one, and m
    the load that the controller is told: a surface of low order in the gain's logarithm, positive whatever the
    coefficients. All are zero by default, which is the fixed gain. A piston's stiffness is least in the middle of its
    stroke and its eigenfrequency falls with the load's root: the two reasons for such a schedule.

    The load is the parameter "schedule.load", apart from the plant's mass: a scenario in which the controller knows the
    load sets both, one in which it does not leaves the schedule's as it was. Margins count with the gains frozen at
    each operating point, as W. J. Rugh & J. S. Shamma, Research on gain scheduling, Automatica 36 (2000) 1401-1425,
    section 1, have it: the position must change slowly against the loop.

    Parameters
    ----------
    gains : tuple of str
        Of `SCHEDULED_GAINS`, those that the loop has.
    low, high : float
        Defaults of the parameters "schedule.low" and "schedule.high": ends of the stroke [the position's unit].
    load : float, optional
        m_0, the load for which the gains are those of their sections, and default of "schedule.load" [the unit of the
        plant's load]; without one nothing is scheduled by it.
    position : str
        The plant's output that is the position.

    Raises
    ------
    InputError
        If the ends, the load or a gain's name are out of range.
    """

    gains: tuple[str, ...]
    low: float
    high: float
    load: float | None = None
    position: str = "position"
    section: ClassVar[str] = "schedule"

    def __post_init__(self) -> None:
        require(len(self.gains) > 0, "GainSchedule has no gain to schedule; leave the schedule out")
        check_names("gain", self.gains, SCHEDULED_GAINS, "GainSchedule")
        told = f"GainSchedule: low must lie below high, got {self.low:g} and {self.high:g}"
        require(-inf < self.low < self.high < inf, told)
        told = f"GainSchedule: the load must be positive, got {self.load}; without one leave it out"
        require(self.load is None or 0 < self.load < inf, told)

    @classmethod
    def stated_gains(cls, coefficients: Collection[str]) -> tuple[str, ...]:
        """The gains to which coefficients belong, by the coefficients' names.

        Examples
        --------
        >>> GainSchedule.stated_gains({"low", "Kp_slope", "position_loop_Kp_load"})
        ('pid.Kp', 'position_loop.Kp')
        """
        return tuple(g for g in SCHEDULED_GAINS if any(f"{_short(g)}_{term}" in coefficients for term in TERMS))

    @property
    def terms(self) -> tuple[str, ...]:
        """The coefficients that each gain has."""
        return tuple(n for n in TERMS if n != "load" or self.load is not None)

    def check(self, parameters: ParameterSet) -> None:
        """Refuse gains that the loop does not have."""
        absent = ", ".join(n for n in self.gains if n not in parameters)
        told = f"GainSchedule: the loop has no {absent}; schedule the gains that it has"
        require(not absent, told, ModelError)

    def check_values(self, p: Mapping[str, float]) -> None:
        """Refuse values that no schedule can run with: `InputError` names the parameter."""
        low, high = p["low"], p["high"]
        require(low < high, f"schedule.low {low:g} is not below schedule.high {high:g}")
        for name in ("load", "nominal_load") if self.load is not None else ():
            require(0 < p[name] < inf, f"schedule.{name} must be positive, got {p[name]:g}")

    def parameters(self, position_unit: str, load_unit: str) -> ParameterSet:
        """The ends of the stroke, the load told and the nominal one, and the coefficients of each gain.

        Examples
        --------
        >>> list(GainSchedule(("pid.Kp",), -0.1, 0.1, load=5.0).parameters("m", "kg"))
        ['low', 'high', 'load', 'nominal_load', 'Kp_slope', 'Kp_curve', 'Kp_load']
        """
        found = {
            "low": Parameter(self.low, position_unit, meaning="lower end of the stroke that gains are scheduled over"),
            "high": Parameter(
                self.high, position_unit, meaning="upper end of the stroke that gains are scheduled over"
            ),
        }
        if self.load is not None:
            told = "load that the controller is told; change it with the load"
            nominal = "load for which the gains are those of their sections"
            found["load"] = Parameter(self.load, load_unit, lower=0.0, meaning=told)
            found["nominal_load"] = Parameter(self.load, load_unit, lower=0.0, meaning=nominal)
        for gain in self.gains:
            for term in self.terms:
                found[f"{_short(gain)}_{term}"] = Parameter(0.0, "1", meaning=f"{TERMS[term]} {gain}")
        return ParameterSet(found)

    def set_gains(self, p: Mapping[str, Any], position: Any) -> dict[str, Any]:
        """The loop's parameters with the gains that hold at a position.

        Parameters
        ----------
        p : mapping of str to float, ndarray or casadi.SX
            The loop's parameters by name.
        position : float, ndarray or casadi.SX
            As the controller sees it.

        Examples
        --------
        >>> schedule = GainSchedule(("pid.Kp",), -0.1, 0.1)
        >>> own = {"pid.Kp": 2.0, "schedule.low": -0.1, "schedule.high": 0.1}
        >>> own |= {"schedule.Kp_slope": 0.0, "schedule.Kp_curve": 1.0}
        >>> [round(float(schedule.set_gains(own, y)["pid.Kp"]), 3) for y in (0.0, -0.1, 0.3)]
        [2.0, 5.437, 5.437]
        """
        low, high = p["schedule.low"], p["schedule.high"]
        xi = ca.fmax(-1, ca.fmin(1, (2 * position - low - high) / (high - low)))
        heavier = ca.log(p["schedule.load"] / p["schedule.nominal_load"]) if self.load is not None else 0.0
        found = dict(p)
        for gain in self.gains:
            slope, curve, *load = (p[f"schedule.{_short(gain)}_{term}"] for term in self.terms)
            exponent = (slope + curve * xi) * xi
            found[gain] = p[gain] * ca.exp(exponent + load[0] * heavier if load else exponent)
        return found


def _short(gain: str) -> str:
    """A gain's name in a coefficient's: that of the PID alone, another's with its section."""
    return gain.removeprefix("pid.").replace(".", "_")
