"""Transient feedforward: what a change of the reference adds to the command at once, and then takes back."""

from dataclasses import dataclass
from math import inf

import casadi as ca

from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.unit_algebra import unit_ratio

MIN_FEEDFORWARD_TIME = 1e-6  # [s]; below, the loop is too stiff to integrate; above, fast leads are refused


@dataclass(frozen=True)
class Feedforward:
    """A set-point lead: ``u_ff = gain (r - r_f)``, ``d(r_f)/dt = (r - r_f)/time``, added to the PID's command.

    A step R of the reference adds ``gain R e^(-t/time)``: a push that the controller need not wait for its error's
    integral to give. It sees the reference alone, so the loop's margins do not change, and at rest it adds nothing.

    With a sampled PID it is computed with it, h = `PID.sample_time` (backward Euler, the suffix _ marks the previous
    sample): ``r_f = (time r_f_ + h r)/(time + h)``.

    Parameters
    ----------
    time : float
        Default of the parameter "feedforward.time" [s].
    """

    time: float = 0.05

    def __post_init__(self) -> None:
        require(
            MIN_FEEDFORWARD_TIME <= self.time < inf,
            f"Feedforward: time must be at least {MIN_FEEDFORWARD_TIME:g} s, got {self.time:g} s",
        )

    def parameters(self, input_unit: str, output_unit: str) -> ParameterSet:
        """The gain [output_unit/input_unit], zero by default, and the time [s].

        Examples
        --------
        >>> [(n, p.unit) for n, p in Feedforward().parameters("m/s", "V").items()]
        [('gain', 'V*s/m'), ('time', 's')]
        """
        gain = Parameter(
            0.0, unit_ratio(output_unit, input_unit), meaning="command per jump of the reference, which decays again"
        )
        return ParameterSet(
            {
                "gain": gain,
                "time": Parameter(self.time, "s", lower=MIN_FEEDFORWARD_TIME, meaning="time constant of that decay"),
            }
        )

    def states(self, measured: Quantity) -> tuple[Quantity, ...]:
        """The filtered reference r_f, as "filter"."""
        return (Quantity("filter", measured.unit, measured.nominal),)

    def rates(self, x: Symbols, r: ca.SX, p: Symbols) -> tuple[dict[str, ca.SX], ca.SX]:
        """The continuous law: d(r_f)/dt, and u_ff [output unit]."""
        lead = r - x["filter"]
        return {"filter": lead / p["time"]}, p["gain"] * lead

    def update(self, x: Symbols, r: ca.SX, p: Symbols, elapsed: ca.SX | float) -> tuple[dict[str, ca.SX], ca.SX]:
        """The sampled law at a sample, `elapsed` [s] after the last good one: the next r_f, and u_ff [output unit]."""
        slow = (p["time"] * x["filter"] + elapsed * r) / (p["time"] + elapsed)
        return {"filter": slow}, p["gain"] * (r - slow)
