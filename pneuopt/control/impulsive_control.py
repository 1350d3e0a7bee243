"""`ImpulsiveControl`: pulses that bring a body to its reference where friction has stopped it short."""

from dataclasses import dataclass, replace
from math import inf
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import Instant
from pneuopt.control.sensor import REFERENCE_SPEED, SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

PULSE_WIDTH, PAUSE = 0.018, 0.016  # [s] defaults: a valve's spool cannot follow shorter pulses, longer ones go too far
LEAST_LIMIT, LEAST_TOLERANCE = 1e-9, 1e-12  # [command's unit, error's unit] by which is divided
PULSE_TOLERANCE = 1e-4  # [error's unit] default: a tenth of a millimetre
GROWTH, BRAKE = 1.1, 0.6  # [1] defaults: a larger growth arrives sooner, or beyond the reference; see `brake`
SHARE = 0.5  # part of the error that a pulse shall take away: a larger one overshoots, a smaller one needs more pulses
# Exponents of the ratio of the way wanted to that of the last pulse, where the peak rises and where it falls. A force
# that rises and falls at a given rate moves a body over (P - F)^3, F being the breakaway force: a peak of 1.2 F has a
# slope of 18 in logarithms, one of 1.6 F of 8. With larger ones the body is thrown to and fro, with smaller ones the
# peak learns slowly.
RISE, FALL = 0.05, 0.15
STILL = 0.2  # of the tolerance: changes of the error below count as standstill; an encoder's count must lie below
# Factor by which the peak rises at least towards one that has gone too far, and beyond it, should it no longer move the
# body: a larger one throws it, a smaller one takes more pulses.
LEAST_RISE = 1.02
LEAST_PEAK = 1e-9  # [command's unit] by which is divided
LEAST_WAY = 0.06  # of the tolerance: a pulse that has moved less counts as one that has moved this far


@dataclass(frozen=True)
class ImpulsiveControl:
    """Short pulses towards the reference while the error stands still outside a tolerance, and nothing within it.

    A body that sticks outside the tolerance breaks away under an integral with the whole fall from static to Coulomb
    friction to spare, and goes too far. A pulse ends by itself, whatever the body does: its way goes to zero as its
    peak comes down to the breakaway force. When the reference has come to rest and the error e has stood still for
    `pause`, pulse k begins, with the peak ::

        P_1 = amplitude,    P_k = P_(k-1) min(most, (|e|/(2 way))^g)

    where way is that of the pulse before, towards its target and at least .06 tolerance, and g is .05 where the peak
    rises and .15 where it falls: the peak grows until the body moves, and then so that a pulse takes away half of the
    error. It grows by `growth` at most, and where a pulse with the peak C has moved the body further than that, to the
    same side of the reference, by ``max(1.02, sqrt(C/P_(k-1)))`` from then on: half of the gap to C, since near the
    breakaway force a slightly higher peak moves the body many times as far. At sample j of the
    ``n = width/h max(1, P/limit)`` samples of a pulse, the command is changed by ``sign(e) min(P, limit) s`` with
    ``s = sin(2 pi (j + 1/2)/n)``, the half below zero times `brake`: a valve's command is the rate of the force, which
    so rises and falls again. Where the command is a force, brake has to be 0. A reference that moves ends a pulse, and
    the next rest begins with `amplitude` again.

    Standstill is an error that changes by less than a fifth of the tolerance. It is counted in samples, so the PID has
    to be a sampled one. The pulses are left out of the loop's rest and of its margins, as a knocker's are.

    S. Yang & M. Tomizuka, Adaptive pulse width control for precise positioning under the influence of stiction and
    Coulomb friction, ASME J. Dyn. Syst. Meas. Control 110 (1988) 221-227, adapt the width of pulses to their way.
    R. Kased & T. Singh, High precision point-to-point maneuvering of an experimental structure subject to friction via
    adaptive impulsive control, State University of New York at Buffalo, compare it with a height that adapts.
    """

    section: ClassVar[str] = "impulsive_control"
    size: ClassVar[str] = "amplitude"
    acts_always: ClassVar[bool] = False
    without_gradient: ClassVar[tuple[str, ...]] = ("width", "pause", "tolerance", "limit")

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a continuous controller."""
        told = "an ImpulsiveControl counts samples: give the PID a sample_time, such as PID(sample_time=1e-3)"
        require(on.sample_time is not None, told, ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """Amplitude, zero by default, and limit [unit], times [s], the tolerance [error's unit], and ratios.

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, 1e-3, cascade=True)
        >>> [(n, p.unit) for n, p in ImpulsiveControl().parameters(on, "V").items()][:5]
        [('amplitude', 'V'), ('limit', 'V'), ('width', 's'), ('pause', 's'), ('tolerance', 'm')]
        """

        def above(least: float, value: float, unit: str, meaning: str) -> Parameter:
            return Parameter(value, unit, lower=least, meaning=meaning)

        return ParameterSet(
            {
                "amplitude": above(0.0, 0.0, unit, "peak of the first pulse"),
                "limit": above(LEAST_LIMIT, inf, unit, "peak beyond which pulses grow longer, not higher"),
                "width": above(on.h, PULSE_WIDTH, "s", "length of a pulse"),
                "pause": above(on.h, PAUSE, "s", "standstill before a pulse"),
                "tolerance": above(LEAST_TOLERANCE, PULSE_TOLERANCE, on.error_unit, "error within which none comes"),
                "growth": above(1.0, GROWTH, "1", "factor by which the peak grows from pulse to pulse at most"),
                "brake": above(0.0, BRAKE, "1", "height of a pulse's second half over that of its first"),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """The speed of a position's reference, which tells whether it rests."""
        return on.speed_input

    def states(self, on: SensedSignal, command: Quantity) -> tuple[Quantity, ...]:
        """The error that has stood, for how many samples; the pulse, its length, peak, error before; the ceiling."""
        error = Quantity("error", on.error_unit)
        return (
            error,
            *(Quantity(n, "1") for n in ("standing", "phase", "length")),
            replace(command, name="peak"),
            replace(error, name="before"),
            replace(command, name="ceiling"),
        )

    def start(self, _on: SensedSignal, _seen: Instant) -> list[Any]:
        """No pulse so far."""
        return [0.0] * 7

    def act(self, seen: Instant, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states after a sample, and the pulse [the command's unit]."""
        h, e = seen.sample_time or 1.0, seen.error
        width, pause = (ca.fmax(1.0, ca.floor(p[n] / h + 0.5)) for n in ("width", "pause"))
        rests = ca.fabs(seen.rates.get(REFERENCE_SPEED, 0.0)) <= 0
        quiet = ca.logic_and(rests, x["phase"] + 1 >= x["length"])
        stays = ca.logic_and(quiet, ca.fabs(e - x["error"]) < STILL * p["tolerance"])
        standing = ca.if_else(stays, x["standing"] + 1, 0)
        fires = ca.logic_and(standing >= pause, ca.fabs(e) > p["tolerance"])
        last = ca.if_else(rests, x["peak"], 0)
        known = ca.if_else(rests, x["ceiling"], 0)
        next_peak, ceiling = _next_peak(e, last, x["before"], known, p)
        peak = ca.if_else(fires, next_peak, last)
        longer = ca.fmax(1.0, ca.fabs(peak) / p["limit"])
        length = ca.if_else(fires, ca.floor(width * longer + 0.5), ca.if_else(rests, x["length"], 0))
        phase = ca.if_else(fires, 0, ca.fmin(x["phase"] + 1, length))
        wave = ca.sin(2 * ca.pi * (phase + 0.5) / ca.fmax(length, 1.0))
        now = {
            "error": ca.if_else(stays, x["error"], e),
            "standing": ca.if_else(fires, 0, standing),
            "phase": phase,
            "length": length,
            "peak": peak,
            "before": ca.if_else(fires, e, x["before"]),
            "ceiling": ca.if_else(fires, ceiling, known),
        }
        acts = ca.logic_and(phase < length, p["amplitude"] > 0)
        return now, ca.if_else(acts, peak / longer * ca.fmax(wave, p["brake"] * wave), 0)


def _next_peak(e: Any, last: Any, before: Any, ceiling: Any, p: Symbols) -> tuple[ca.SX, ca.SX]:
    """The signed peak of a pulse that begins at the error e, and the ceiling from then on.

    Known are the last peak (0: none), the error before it, and the ceiling, the last peak that went too far (0: none).
    """
    way = ca.fmax((before - e) * ca.if_else(last < 0, -1, 1), LEAST_WAY * p["tolerance"])
    ratio = ca.fmax(SHARE * ca.fabs(e), LEAST_WAY * p["tolerance"]) / way
    size, turns = ca.fabs(last), last * e < 0
    known = ca.if_else(turns, 0, ca.if_else(ratio < 1, size, ceiling))
    halfway = ca.fmax(ca.sqrt(known / ca.fmax(size, LEAST_PEAK)), LEAST_RISE)
    most = ca.if_else(known > 0, ca.fmin(p["growth"], halfway), p["growth"])
    factor = ca.fmin(most, ca.exp(ca.if_else(ratio > 1, RISE, FALL) * ca.log(ratio)))
    found = ca.if_else(size <= 0, p["amplitude"], size * factor)
    return ca.if_else(e < 0, -found, found), known
