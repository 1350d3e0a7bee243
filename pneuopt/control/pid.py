"""PID with filtered derivative, set-point weights, saturation and back-calculation; continuous or sampled.

The parallel form is what runs, ``Tf`` its derivative filter's time constant [s]. Two things are called N elsewhere: in
the ISA standard form N is a ratio, ``Tf = Td/N``; in Simulink's block N is a pole [rad/s], ``Tf = 1/N``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

import casadi as ca

from pneuopt.errors import UnitError, require
from pneuopt.parameters import Parameter, ParameterSet, Quantity

Symbols = Mapping[str, ca.SX]


@dataclass(frozen=True)
class PID:
    """A PID controller in parallel form.

    ``v = Kp (b r - y) + I + D``, ``D = Kd s/(Tf s + 1) (c r - y)``, ``dI/dt = Ki (r - y) + (u - w)/Tt``, where
    ``w = v + dither`` and ``u = min(max(w, lower), upper)``: a hard clip, because that is what runs. The integral is
    kept in the unit of the command, so that ``Ki = 0`` needs no special case.

    A sampled controller computes once a sample, h = `sample_time`, and holds u until the next one (backward Euler,
    PHYSICS section 5); the suffix _ marks the previous sample::

        D = Tf/(Tf + h) D_ + Kd/(Tf + h) ((c r - y) - (c r - y)_)
        I = I_ + Ki h (r - y)
        w = Kp (b r - y) + I + D + dither,  u = min(max(w, lower), upper)
        I = I + h/Tt (u - w)

    Parameters
    ----------
    sample_time : float, optional
        h [s]; None is a continuous controller.
    limits : bool
        Whether the command saturates; without limits there are no parameters lower, upper and Tt.
    """

    sample_time: float | None = None
    limits: bool = True

    def __post_init__(self) -> None:
        h = self.sample_time
        require(h is None or 0 < h < inf, f"PID: sample_time must be positive, got {h} s; None is continuous")

    def parameters(self, input_unit: str, output_unit: str) -> ParameterSet:
        """Defaults: ``Kp = 1``, no I, no D, ``Tf = 10 ms``, ``b = c = 1``, no limit.

        Parameters
        ----------
        input_unit, output_unit : str
            Units of the measured signal and of the command; the gains' units follow.

        Returns
        -------
        ParameterSet
            Kp, Ki, Kd, Tf [s], b, c [1], and with limits Tt [s], lower and upper [output_unit].

        Examples
        --------
        >>> [p.unit for p in PID(limits=False).parameters("m/s", "V").values()]
        ['V*s/m', 'V/m', 'V*s^2/m', 's', '1', '1']
        """
        h = self.sample_time or 0.0
        shortest = h or 1e-6
        core = {
            "Kp": Parameter(1.0, ratio(output_unit, input_unit)),
            "Ki": Parameter(0.0, ratio(output_unit, f"{_difference(input_unit)}*s")),
            "Kd": Parameter(0.0, ratio(f"{_difference(output_unit)}*s", input_unit)),
            "Tf": Parameter(0.01, "s", lower=0.0 if h else shortest),
            "b": Parameter(1.0, "1", lower=0.0),
            "c": Parameter(1.0, "1", lower=0.0),
        }
        saturation = {
            "Tt": Parameter(max(0.1, 10 * h), "s", lower=shortest),
            "lower": Parameter(-inf, output_unit),
            "upper": Parameter(inf, output_unit),
        }
        return ParameterSet(core | saturation if self.limits else core)

    def states(self, measured: Quantity, command: Quantity) -> tuple[Quantity, ...]:
        """What the controller remembers: integral and filter, or with sampling also what it holds."""
        integral = Quantity("integral", command.unit, command.nominal)
        if self.sample_time is None:
            return integral, Quantity("filter", measured.unit, measured.nominal)
        return (
            integral,
            Quantity("derivative", command.unit, command.nominal),
            Quantity("previous_error", measured.unit, measured.nominal),
            Quantity("command", command.unit, command.nominal),
        )

    def rates(self, x: Symbols, r: ca.SX, y: ca.SX, dither: ca.SX, p: Symbols) -> tuple[dict[str, ca.SX], ca.SX]:
        """The continuous law.

        Parameters
        ----------
        x, p : mapping of str to casadi.SX
            States ("integral", "filter") and parameters.
        r, y, dither : casadi.SX
            Reference and measured signal [input unit], dither [output unit].

        Returns
        -------
        rates : dict
            Time derivative of each state.
        u : casadi.SX
            What the actuator gets [output unit].
        """
        error = p["c"] * r - y
        v = p["Kp"] * (p["b"] * r - y) + x["integral"] + p["Kd"] / p["Tf"] * (error - x["filter"])
        u = self.clip(v + dither, p)
        windup = (u - v - dither) / p["Tt"] if self.limits else 0.0
        return {"integral": p["Ki"] * (r - y) + windup, "filter": (error - x["filter"]) / p["Tf"]}, u

    def update(self, x: Symbols, r: ca.SX, y: ca.SX, dither: ca.SX, p: Symbols) -> dict[str, ca.SX]:
        """The sampled law at a sample: the next value of each state, "command" being what is held.

        Parameters as for `rates`; the states are "integral", "derivative", "previous_error" and "command".
        """
        h = self.sample_time or 0.0
        error = p["c"] * r - y
        derivative = (p["Tf"] * x["derivative"] + p["Kd"] * (error - x["previous_error"])) / (p["Tf"] + h)
        integral = x["integral"] + p["Ki"] * h * (r - y)
        w = p["Kp"] * (p["b"] * r - y) + integral + derivative + dither
        u = self.clip(w, p)
        windup = h / p["Tt"] * (u - w) if self.limits else 0.0
        return {"integral": integral + windup, "derivative": derivative, "previous_error": error, "command": u}

    def clip(self, w: ca.SX, p: Symbols) -> ca.SX:
        """The saturated command: hard, as in a real controller; exact derivatives on either side of the corner."""
        return ca.fmin(ca.fmax(w, p["lower"]), p["upper"]) if self.limits else w


@dataclass(frozen=True)
class StandardForm:
    """ISA standard form ``Kp ((b r - y) + e/(Ti s) + Td s/(1 + s Td/N) (c r - y))``.

    Parameters
    ----------
    Kp : float
        Gain [command/measured].
    Ti : float
        Integral time [s]; inf is no integral action.
    Td : float
        Derivative time [s].
    N : float
        Derivative filter as the ISA ratio ``Tf = Td/N``, not Simulink's pole; inf is no filter.
    """

    Kp: float
    Ti: float = inf
    Td: float = 0.0
    N: float = 10.0


@dataclass(frozen=True)
class ParallelForm:
    """Parallel form ``Kp (b r - y) + Ki e/s + Kd s/(Tf s + 1) (c r - y)``; Simulink's pole N is ``1/Tf``.

    Parameters
    ----------
    Kp, Ki, Kd : float
        Gains [command/measured], [command/(measured s)], [command s/measured].
    Tf : float
        Time constant of the derivative's filter [s].
    """

    Kp: float
    Ki: float = 0.0
    Kd: float = 0.0
    Tf: float = 0.0


def to_standard(gains: ParallelForm) -> StandardForm:
    """Convert parallel gains: ``Ti = Kp/Ki``, ``Td = Kd/Kp``, ``N = Td/Tf`` (the ISA ratio, not Simulink's pole).

    Raises
    ------
    InputError
        If ``Kp = 0`` while Ki or Kd is not: the standard form cannot express it.

    Examples
    --------
    >>> to_standard(ParallelForm(Kp=2.0, Ki=4.0, Kd=0.5, Tf=0.025))
    StandardForm(Kp=2.0, Ti=0.5, Td=0.25, N=10.0)
    """
    Kp, Ki, Kd, Tf = gains.Kp, gains.Ki, gains.Kd, gains.Tf
    require(Kp != 0 or Ki == Kd == 0, f"the standard form needs Kp != 0; here Kp = 0, Ki = {Ki:g}, Kd = {Kd:g}")
    Td = Kd / Kp if Kp else 0.0
    return StandardForm(Kp, Kp / Ki if Ki else inf, Td, Td / Tf if Tf else inf)


def to_parallel(gains: StandardForm) -> ParallelForm:
    """Convert ISA standard gains: ``Ki = Kp/Ti``, ``Kd = Kp Td``, ``Tf = Td/N`` (the ISA ratio, not Simulink's pole).

    Raises
    ------
    InputError
        If ``Ti = 0`` or ``N = 0``.

    Examples
    --------
    >>> to_parallel(StandardForm(Kp=2.0, Ti=0.5, Td=0.25, N=10.0))
    ParallelForm(Kp=2.0, Ki=4.0, Kd=0.5, Tf=0.025)
    """
    require(gains.Ti != 0, "Ti = 0 would be an infinite integral gain; no integral action is Ti = inf")
    require(
        gains.N != 0 or gains.Td == 0,
        "N = 0 would switch the derivative off; the ISA ratio N is 5 to 20, inf unfiltered",
    )
    return ParallelForm(gains.Kp, gains.Kp / gains.Ti, gains.Kp * gains.Td, gains.Td / gains.N if gains.Td else 0.0)


def ratio(numerator: str, denominator: str) -> str:
    """Divide two unit texts and simplify; a level such as "Pa(a)" counts as a difference.

    Examples
    --------
    >>> ratio("V", "m/s"), ratio("V*s", "m/s"), ratio("V", "m/s*s"), ratio("N", "N"), ratio("1", "Pa(g)")
    ('V*s/m', 'V*s^2/m', 'V/m', '1', '1/Pa')
    """
    powers = _powers(_difference(numerator))
    for name, power in _powers(_difference(denominator)).items():
        powers[name] = powers.get(name, 0) - power
    above = [_factor(n, k) for n, k in powers.items() if k > 0]
    below = [_factor(n, -k) for n, k in powers.items() if k < 0]
    divisor = "*".join(below) if len(below) < 2 else f"({'*'.join(below)})"
    return ("*".join(above) or "1") + (f"/{divisor}" if below else "")


def _difference(unit: str) -> str:
    return re.sub(r"\([ag]\)", "", unit)


def _factor(name: str, power: int) -> str:
    return name if power == 1 else f"{name}^{power}"


def _powers(unit: str) -> dict[str, int]:
    powers: dict[str, int] = {}
    rest = "*" + unit.replace(" ", "")
    while rest:
        match = re.match(r"([*/])(?:\(([^()]*)\)|([^\W\d_]+|%|1)(?:\^(-?\d+))?)", rest)
        if match is None:
            raise UnitError(f"cannot read the unit {unit!r}; write it like 'V*s/m' or 'm^3/(s*Pa)'")
        sign = 1 if match[1] == "*" else -1
        factors = _powers(match[2]) if match[2] else {match[3]: int(match[4] or 1)}
        for name, power in factors.items():
            if name != "1":
                powers[name] = powers.get(name, 0) + sign * power
        rest = rest[match.end() :]
    return powers
