"""The PID, and the forms in which its gains are given, of which the parallel one runs.

Two things are called N elsewhere: in the ISA standard form N is a ratio, ``Tf = Td/N``; in Simulink's block N is a pole
[rad/s], ``Tf = 1/N``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from math import inf, sqrt
from typing import Any

import casadi as ca

from pneuopt.control.reset_integral import RESET_STATES, reset_parameters, reset_quantities
from pneuopt.control.tolerances import FAULT_SAMPLES, LEAST_KI, MOST_EMPTYING, SHORTEST_TIME, UNUSED_FILTER_TIME
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.units import difference_unit, unit_ratio

BAD_SAMPLES = "bad_samples"  # the state that counts them


class Form(Enum):
    """Which numbers a PID is set by: those of `ParallelForm`, `StandardForm` or `SeriesForm`."""

    PARALLEL = "parallel"
    STANDARD = "standard"
    SERIES = "series"

    @property
    def gains(self) -> tuple[str, ...]:
        """The names of its parameters, which are the fields of the form."""
        return _GAIN_NAMES[self]


_GAIN_NAMES = {
    Form.PARALLEL: ("Kp", "Ki", "Kd", "Tf"),
    Form.STANDARD: ("Kp", "Ti", "Td", "N"),
    Form.SERIES: ("K", "Ti", "Td", "Tf"),
}


class AntiWindup(Enum):
    """What keeps the integral from growing while the command is at a limit."""

    BACK_CALCULATION = "back-calculation"
    CLAMPING = "clamping"


@dataclass(frozen=True)
class PID:
    """A PID controller; the law in parallel gains, which `form` turns its own into.

    ``v = Kp (b r - y) + I + D``, ``D = Kd s/(Tf s + 1) (c r - y)``, ``dI/dt = Ki (r - y) + (u - w)/Tt``, where
    ``w = v + added`` (feedforward and dither) and ``u = min(max(w, lower), upper)``: a hard clip, because that is what
    runs. The integral is kept in the unit of the command.

    A sampled controller computes once a sample, h = `sample_time`, and holds u until the next one (backward Euler:
    s becomes ``(1 - 1/z)/h``); the suffix _ marks the previous sample::

        D = Tf/(Tf + h) D_ + Kd/(Tf + h) ((c r - y) - (c r - y)_)
        I = I_ + Ki h (r - y)
        w = Kp (b r - y) + I + D + T_ + added,  u = min(max(w, lower), upper)
        I = I + h/Tt (u - w),  T = T_/(1 + h/Tt)

    T is the transfer, zero but after a start without a bump far from the set point: there the integral begins with the
    command of a set point that equals the measurement, and T with what the distance takes from it,
    ``-Kp b (r - y)``. So the output does not jump, and its proportional term follows as if the set point went from the
    measurement to its value with the time constant Tt; a slow integral alone would hold the loop while it moves on.

    Where Ki = 0, nothing fills the integral, and nothing would empty it: it takes nothing back at a limit, and what it
    holds, of a start or of earlier gains, goes with Tt, ``I = I_/(1 + h/Tt)``. Without a Tt, the time of both is its
    default; a Tt that switches back-calculation off counts as ten times that at most.

    After samples that were no numbers (`Controller.update`), the h of the derivative is the time since the last good
    one.

    With a dead band, what is integrated is ``e - min(max(e, -dead_band), dead_band)`` instead of e = r - y: nothing
    while |e| < dead_band, and beyond it what exceeds it, so that nothing jumps at its edge. That is against windup by
    stiction: a mass that sticks within the band is left there, instead of being pushed off by a growing integral,
    over and over. Back-calculation goes on inside the band: a clipped command still unwinds the integral.

    Clamping (conditional integration) stands in for the last line where that is asked for: where w is beyond a limit,
    of the step ``Ki h (r - y)`` that drives it there I takes only what the limit leaves, mostly nothing; there is no
    Tt. Many controllers' own blocks do so, all or nothing, which differs by less than one step and chatters along the
    limit. K. J. Åström and T. Hägglund, Advanced PID Control, ISA 2006, section 3.5, compare the two kinds.

    Parameters
    ----------
    sample_time : float, optional
        h [s]; None is a continuous controller.
    limits : bool
        Whether the command saturates; without limits there are no parameters lower, upper and Tt.
    form : Form
        Which gains are the parameters: Kp, Ki, Kd, Tf; of the ISA standard form Kp, Ti, Td, N; of the series form K,
        Ti, Td, Tf. Weights, limits and the rest are the same in all.
    delay : int
        Samples, 0 or 1, from computing a command to its acting: with 1 the actuator gets at a sample what was computed
        at the one before.
    dead_band : bool
        Whether the integral has one; its half width is the parameter dead_band [measured unit].
    anti_windup : AntiWindup
        Back-calculation, or of a sampled controller clamping. Without limits it is without effect.
    reset : bool
        Whether a sampled controller's integral is reset where the error changes sign, and where the motion then stops
        (`reset_integral`): against hunting. The parameters are reset_ratio [1] and reset_band [the reference's unit].

    Raises
    ------
    InputError
        If an option is out of range, or a continuous controller has a delay.
    """

    sample_time: float | None = None
    limits: bool = True
    form: Form = Form.PARALLEL
    delay: int = 0
    dead_band: bool = False
    anti_windup: AntiWindup = AntiWindup.BACK_CALCULATION
    reset: bool = False

    def __post_init__(self) -> None:
        h, delay = self.sample_time, self.delay
        require(h is None or 0 < h < inf, f"PID: sample_time must be positive, got {h} s; None is continuous")
        told = f"PID: delay is 0 or 1, whole samples, got {delay}; a longer one belongs to the plant (pade_order=)"
        require(delay in (0, 1), told)
        require(not delay or h is not None, "PID: a delay of 1 sample needs a sample_time; without one, leave it out")
        names = ", ".join(f"Form.{f.name}" for f in Form)
        require(isinstance(self.form, Form), f"PID: form is one of {names}, got {self.form!r}")
        kinds, kind = ", ".join(f"AntiWindup.{k.name}" for k in AntiWindup), self.anti_windup
        require(isinstance(kind, AntiWindup), f"PID: anti_windup is one of {kinds}, got {kind!r}")
        told = "PID: clamping is decided once a sample: give a sample_time, or take back-calculation"
        require(h is not None or kind is AntiWindup.BACK_CALCULATION, told)
        require(h is not None or not self.reset, "PID: a reset is decided once a sample: give a sample_time")

    def parameters(self, input_unit: str, output_unit: str, reference_unit: str = "") -> ParameterSet:
        """Defaults: a gain of 1, no I, no D, ``Tf = 10 ms`` or ``N = 10``, ``b = c = 1``, no limit, no dead band.

        Parameters
        ----------
        input_unit, output_unit : str
            Units of the measured signal and of the command; the gains' units follow.
        reference_unit : str
            Unit of what the loop is judged by; by default the measured signal's.

        Returns
        -------
        ParameterSet
            The form's gains, b, c [1], with a dead band dead_band [input_unit], with limits lower and upper
            [output_unit] and, for back-calculation, Tt [s], and sampled fault_samples [1], fault_output [output_unit].

        Examples
        --------
        >>> [p.unit for p in PID(limits=False).parameters("m/s", "V").values()]
        ['V*s/m', 'V/m', 'V*s^2/m', 's', '1', '1']
        >>> list(PID(limits=False, form=Form.STANDARD).parameters("m/s", "V"))
        ['Kp', 'Ti', 'Td', 'N', 'b', 'c']
        """
        h, gain = self.sample_time or 0.0, unit_ratio(output_unit, input_unit)
        shortest, integral = h or SHORTEST_TIME, unit_ratio(output_unit, f"{difference_unit(input_unit)}*s")
        derivative = unit_ratio(f"{difference_unit(output_unit)}*s", input_unit)
        known = {
            "Kp": Parameter(1.0, gain, meaning="proportional gain"),
            "K": Parameter(1.0, gain, meaning="gain of the series form"),
            "Ki": Parameter(0.0, integral, meaning="integral gain"),
            "Kd": Parameter(0.0, derivative, meaning="derivative gain"),
            "Tf": Parameter(0.01, "s", 0.0 if h else shortest, meaning="time constant of the derivative's filter"),
            "Ti": Parameter(inf, "s", lower=0.0, meaning="integral time; inf: no integral action"),
            "Td": Parameter(0.0, "s", lower=0.0, meaning="derivative time"),
            "N": Parameter(10.0, "1", 0.0, meaning="derivative filter as the ISA ratio, Tf = Td/N; inf: no filter"),
        }
        core = {n: known[n] for n in self.form.gains}
        weights = {
            "b": "weight of the reference in the proportional term",
            "c": "weight of the reference in the derivative",
        }
        core |= {n: Parameter(1.0, "1", lower=0.0, meaning=what) for n, what in weights.items()}
        band = "half width of the error within which nothing is integrated"
        if self.dead_band:
            core["dead_band"] = Parameter(0.0, difference_unit(input_unit), lower=0.0, meaning=band)
        saturation = {
            "Tt": Parameter(_default_Tt(h), "s", shortest, meaning="time in which the integral unwinds at a limit"),
            "lower": Parameter(-inf, output_unit, meaning="least command"),
            "upper": Parameter(inf, output_unit, meaning="largest command"),
        }
        if self.anti_windup is AntiWindup.CLAMPING:
            del saturation["Tt"]
        found = ParameterSet(core | saturation if self.limits else core)
        if h:
            bad = "samples in a row that are no numbers, after which the output goes to its safe value"
            safe = "output after that many, as the command counts: 0 is the centre"
            faults = {"fault_samples": Parameter(FAULT_SAMPLES, "1", lower=0.0, meaning=bad)}
            found |= ParameterSet(faults | {"fault_output": Parameter(0.0, output_unit, meaning=safe)})
        return found | reset_parameters(reference_unit or input_unit) if self.reset else found

    @property
    def fixed_parameters(self) -> tuple[str, ...]:
        """Parameters that nothing tunes: what a fault makes of the output is decided by who knows the machine."""
        return ("fault_samples", "fault_output") if self.sample_time else ()

    @property
    def positive_parameters(self) -> tuple[str, ...]:
        """Parameters that a search must keep above zero: what is divided by."""
        needed = {"Ti", "N"} | (set() if self.sample_time else {"Td"} if self.form is Form.STANDARD else set())
        return tuple(n for n in self.form.gains if n in needed)

    def check(self, p: Mapping[str, float], unit: str) -> None:
        """Refuse values that no controller can run with: `InputError` names the parameter.

        Parameters
        ----------
        p : mapping of str to float
            Its parameters and, of the parallel form, "Tf".
        unit : str
            The command's.
        """
        h = self.sample_time
        require(p.get("Ti", inf) != 0, f"pid.{ZERO_TI_MESSAGE}")
        require(p.get("N", inf) != 0, f"pid.{ZERO_N_MESSAGE}")
        filtered = "pid.N = inf" if self.form is Form.STANDARD else f"pid.Tf = {p['Tf']:g} s"
        require(p["Tf"] > 0 or h is not None, f"{filtered}: a continuous derivative needs a filter, Tf > 0")
        for name, most in (("reset_ratio", 1.0), ("reset_band", inf)):
            told = f"pid.{name} must lie within [0, {most:g}], got {p.get(name, 0.0):g}"
            require(0 <= p.get(name, 0.0) <= most, told)
        band = p.get("dead_band", 0.0)
        require(band >= 0, f"pid.dead_band must not be negative, got {band:g}; 0 is none")
        if self.limits:
            require(p["lower"] < p["upper"], f"pid.lower {p['lower']:g} is not below pid.upper {p['upper']:g} {unit}")
        if self.limits and self.anti_windup is AntiWindup.BACK_CALCULATION:
            Tt, least = p["Tt"], h or 0.0
            told = f"anti-windup needs Tt > 0, and with sampling at least one sample ({least:g} s)"
            require(Tt > 0 and Tt >= least, f"pid.Tt = {Tt:g} s: {told}")
        if h is not None:
            count, safe = p["fault_samples"], p["fault_output"]
            require(0 < count < inf, f"pid.fault_samples must be positive and finite, got {count:g}")
            require(abs(safe) < inf, f"pid.fault_output must be finite, got {safe:g} {unit}")

    def states(self, measured: Quantity, command: Quantity) -> tuple[Quantity, ...]:
        """The controller's states: integral and filter; sampled, what the law and the handling of faults remember."""
        integral = Quantity("integral", command.unit, command.nominal)
        if self.sample_time is None:
            return integral, Quantity("filter", measured.unit, measured.nominal)
        pending = Quantity("pending", command.unit, command.nominal)
        return (
            integral,
            Quantity("derivative", command.unit, command.nominal),
            Quantity("previous_error", measured.unit, measured.nominal),
            Quantity("command", command.unit, command.nominal),
            *(pending for _ in range(self.delay)),
            *(reset_quantities(measured) if self.reset else ()),
            Quantity("transfer", command.unit, command.nominal),
            Quantity(BAD_SAMPLES, "1"),
        )

    def start(self, r: Any, y: Any, command: Any, p: Mapping[str, Any]) -> list[Any]:
        """The states with which the controller goes on from a command without a bump.

        Parameters
        ----------
        r, y, command : float or casadi.SX
            So far [input unit], [output unit].
        p : mapping of str to float or casadi.SX
            The form's gains, b and c.
        """
        Kp, Ki, _, _ = parallel_gains(self.form, p)
        integral, error = command - Kp * (p["b"] * r - y), p["c"] * r - y
        if self.sample_time is None:
            return [integral, error]
        transfer = Kp * p["b"] * (y - r) * integrates(Ki)
        reset = [0.0] * (len(RESET_STATES) * self.reset)
        return [integral - transfer, 0.0, error, *[command] * (1 + self.delay), *reset, transfer, 0.0]

    def rates(self, x: Symbols, r: ca.SX, y: ca.SX, added: ca.SX, p: Symbols) -> tuple[dict[str, ca.SX], ca.SX]:
        """The continuous law.

        Parameters
        ----------
        x, p : mapping of str to casadi.SX
            States ("integral", "filter") and parameters.
        r, y, added : casadi.SX
            Reference and measured signal [input unit]; what feedforward and dither add [output unit].

        Returns
        -------
        rates : dict
            Time derivative of each state.
        u : casadi.SX
            What the actuator gets [output unit].
        """
        _, Ki, _, Tf = parallel_gains(self.form, p)
        v = self.output(x, r, y, p)
        u = self.clip(v + added, p)
        windup = (u - v - added) / p["Tt"] if self.limits else ca.SX(0)
        windup = ca.if_else(integrates(Ki), windup, -x["integral"] / self.emptying_time(p))
        return {"integral": Ki * self._integrand(r - y, p) + windup, "filter": (p["c"] * r - y - x["filter"]) / Tf}, u

    def update(self, x: Symbols, r: ca.SX, y: ca.SX, added: ca.SX, p: Symbols) -> dict[str, ca.SX]:
        """The sampled law at a sample: the next value of each state, "command" being what is held.

        Parameters as for `rates`; the states are those of `states`, with a reset as `reset_integral` leaves them.
        """
        terms = self.terms(x, r, y, p)
        w = self.output(x, r, y, p) + added
        u = self.clip(w, p)
        sent = {"command": x["pending"], "pending": u} if self.delay else {"command": u}
        remembered = {"derivative": terms["derivative"], "previous_error": p["c"] * r - y}
        own = {n: x[n] for n in RESET_STATES if self.reset}
        transfer = x["transfer"] / (1 + (self.sample_time or 0.0) / self.emptying_time(p))
        # what the clip has taken from the command unwinds the integral; where Ki = 0, its time empties it
        h, integral = self.sample_time or 0.0, terms["integral"]
        kept, emptied = integral, integral - x["integral"] * (h / (h + self.emptying_time(p)))
        if self.limits and self.anti_windup is AntiWindup.BACK_CALCULATION:
            kept = integral + h / p["Tt"] * (u - w)
        elif self.limits:
            step, excess = integral - x["integral"], w - u
            kept = integral - ca.fmax(0, ca.fmin(step, excess)) - ca.fmin(0, ca.fmax(step, excess))
        after = ca.if_else(integrates(parallel_gains(self.form, p)[1]), kept, emptied)
        return {"integral": after, **remembered, **sent, **own, "transfer": transfer, BAD_SAMPLES: ca.SX(0)}

    def hold(self, x: Symbols, count: ca.SX, p: Symbols) -> dict[str, ca.SX]:
        """The next value of each state at a bad sample, the `count`-th in a row: as it was, and the output's own."""
        safe = self.clip(p["fault_output"], p)
        sent = ca.if_else(count >= p["fault_samples"], safe, self.sent(x))
        moved = {"command": x["pending"], "pending": sent} if self.delay else {"command": sent}
        return {**x, **moved, BAD_SAMPLES: count}

    def sent(self, x: Symbols) -> ca.SX:
        """What was computed last, whether it acts at once or at the next sample [output unit]."""
        return x["pending" if self.delay else "command"]

    def elapsed_time(self, x: Symbols) -> ca.SX | float:
        """The time since the last good sample [s]: a sample's, and those of the bad ones in between."""
        return (self.sample_time or 0.0) * (1 + x[BAD_SAMPLES])

    def terms(self, x: Symbols, r: ca.SX, y: ca.SX, p: Symbols) -> dict[str, ca.SX]:
        """The sampled law's terms at a sample: "proportional", "integral" before back-calculation, "derivative"."""
        h, (Kp, Ki, Kd, Tf) = self.sample_time or 0.0, parallel_gains(self.form, p)
        return {
            "proportional": Kp * (p["b"] * r - y),
            "integral": x["integral"] + Ki * h * self._integrand(r - y, p),
            "derivative": (Tf * x["derivative"] + Kd * (p["c"] * r - y - x["previous_error"]))
            / (Tf + self.elapsed_time(x)),
        }

    def output(self, x: Symbols, r: ca.SX, y: ca.SX, p: Symbols) -> ca.SX:
        """The command v of the law itself, before anything is added to it; at a sample that of a sampled one."""
        if self.sample_time is not None:
            terms = self.terms(x, r, y, p)
            return terms["proportional"] + terms["integral"] + terms["derivative"] + x["transfer"]
        Kp, _, Kd, Tf = parallel_gains(self.form, p)
        return Kp * (p["b"] * r - y) + x["integral"] + Kd / Tf * (p["c"] * r - y - x["filter"])

    def clip(self, w: ca.SX, p: Symbols) -> ca.SX:
        """The saturated command: hard, as in a real controller; exact derivatives on either side of the corner."""
        return ca.fmin(ca.fmax(w, p["lower"]), p["upper"]) if self.limits else w

    def emptying_time(self, p: Mapping[str, Any]) -> Any:
        """In which a transfer goes, and an integral that nothing fills [s]."""
        usual = _default_Tt(self.sample_time or 0.0)
        unwinds = self.limits and self.anti_windup is AntiWindup.BACK_CALCULATION
        return ca.fmin(p["Tt"], MOST_EMPTYING * usual) if unwinds else usual

    def _integrand(self, error: ca.SX, p: Symbols) -> ca.SX:
        if not self.dead_band:
            return error
        return error - ca.fmin(ca.fmax(error, -p["dead_band"]), p["dead_band"])


def integrates(Ki: Any) -> Any:
    """Whether there is an integral action."""
    return abs(Ki) > LEAST_KI


def _default_Tt(h: float) -> float:
    return max(0.1, 10 * h)


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
class SeriesForm:
    """Series (interacting) form ``K (1 + 1/(Ti s)) (1 + Td s/(Tf s + 1)) e``, as pneumatic controllers had it.

    Parameters
    ----------
    K : float
        Gain [command/measured].
    Ti, Td : float
        Times of the two factors [s], in books Ti' and Td'; ``Ti = inf`` is no integral action.
    Tf : float
        Time constant of the derivative's filter [s].
    """

    K: float
    Ti: float = inf
    Td: float = 0.0
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


def to_series(gains: ParallelForm) -> SeriesForm:
    """Convert parallel gains to the series form, whose two factors have real zeros only.

    `to_parallel` solved for them: with ``Ti = Kp/Ki`` and ``Td = Kd/Kp`` of the standard form, Td' is the smaller root
    of ``Td'^2 - (Ti - Tf) Td' + Ti Td = 0``, then ``Ti' = Ti - Td'`` and ``K = Ki Ti'``. K. J. Åström and T. Hägglund,
    Advanced PID Control, ISA 2006, section 3.2, have it without the filter.

    Raises
    ------
    InputError
        If ``Ti < 4 Td``, with a filter ``(Ti - Tf)^2 < 4 Ti Td`` or ``Ti <= Tf``; or if Kp = 0.

    Examples
    --------
    >>> to_series(ParallelForm(Kp=3.0, Ki=4.0, Kd=0.5))
    SeriesForm(K=2.0, Ti=0.5, Td=0.25, Tf=0.0)
    """
    standard, Tf = to_standard(gains), gains.Tf
    Ti, Td = standard.Ti, standard.Td
    if Ti == inf or gains.Kd == 0:
        return SeriesForm(gains.Kp, Ti, Td, Tf)
    rest = (Ti - Tf) ** 2 - 4 * Ti * Td
    limit = "Ti >= 4 Td" if Tf == 0 else f"(Ti - Tf)^2 >= 4 Ti Td with Ti > Tf, and Tf = {Tf:g} s"
    told = f"no series form has these gains: it needs {limit}; here Ti = {Ti:g} s, Td = {Td:g} s; use the standard form"
    require(Ti > Tf and rest >= 0, told)
    own = 2 * Ti * Td / (Ti - Tf + sqrt(rest))
    return SeriesForm(gains.Ki * (Ti - own), Ti - own, own, Tf)


def to_parallel(gains: StandardForm | SeriesForm) -> ParallelForm:
    """Convert to parallel gains, exactly.

    From the standard form ``Ki = Kp/Ti``, ``Kd = Kp Td``, ``Tf = Td/N`` (the ISA ratio, not Simulink's pole); from the
    series form ``Kp = K (1 + Td/Ti)``, ``Ki = K/Ti``, ``Kd = K Td (1 - Tf/Ti)`` and the same Tf, its product multiplied
    out. Sampled by backward Euler the two are one controller, too.

    Raises
    ------
    InputError
        If ``Ti = 0`` or ``N = 0``.

    Examples
    --------
    >>> to_parallel(StandardForm(Kp=2.0, Ti=0.5, Td=0.25, N=10.0))
    ParallelForm(Kp=2.0, Ki=4.0, Kd=0.5, Tf=0.025)
    >>> to_parallel(SeriesForm(K=2.0, Ti=0.5, Td=0.25))
    ParallelForm(Kp=3.0, Ki=4.0, Kd=0.5, Tf=0.0)
    """
    require(gains.Ti != 0, ZERO_TI_MESSAGE)
    if isinstance(gains, SeriesForm):
        return ParallelForm(*_series_to_parallel(gains.K, gains.Ti, gains.Td, gains.Tf))
    require(gains.N != 0 or gains.Td == 0, ZERO_N_MESSAGE)
    return ParallelForm(*_standard_to_parallel(gains.Kp, gains.Ti, gains.Td, gains.N or inf))


ZERO_TI_MESSAGE = "Ti = 0 would be an infinite integral gain; no integral action is Ti = inf"


ZERO_N_MESSAGE = "N = 0 would switch the derivative off; the ISA ratio N is 5 to 20, inf unfiltered"


def parallel_gains(form: Form, p: Mapping[str, ca.SX]) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Kp, Ki, Kd, Tf of the parallel form, which is what runs; p by the names of the form's own gains."""
    own = [p[n] for n in form.gains]
    if form is Form.STANDARD:
        Kp, Ki, Kd, Tf = _standard_to_parallel(*own)
        return Kp, Ki, Kd, ca.if_else(p["Td"] > 0, Tf, UNUSED_FILTER_TIME)
    Kp, Ki, Kd, Tf = own if form is Form.PARALLEL else _series_to_parallel(*own)
    return Kp, Ki, Kd, Tf


def proportional_band(Kp: float, measured_span: float, command_span: float) -> float:
    """``PB = 100 % / Kp`` with both signals as fractions of their spans: the error that drives the full command.

    Parameters
    ----------
    Kp : float
        [command's unit/measured unit], not zero.
    measured_span, command_span : float
        From the lowest to the highest value of each signal [its unit].

    Returns
    -------
    float
        [%]

    Raises
    ------
    InputError
        If Kp or a span is zero.

    Examples
    --------
    Speeds from 0 to 2 m/s, a command from -5 to 5 V; 2 V for 1 m/s:

    >>> proportional_band(2.0, 2.0, 10.0)
    250.0
    """
    _check_spans(measured_span, command_span)
    require(Kp != 0, "Kp = 0 has no proportional band")
    return 100.0 * command_span / (Kp * measured_span)


def proportional_gain(band: float, measured_span: float, command_span: float) -> float:
    """Kp [command's unit/measured unit] of a proportional band [%]: the inverse of `proportional_band`.

    Raises
    ------
    InputError
        If the band or a span is zero.

    Examples
    --------
    >>> proportional_gain(250.0, 2.0, 10.0)
    2.0
    """
    _check_spans(measured_span, command_span)
    require(band != 0, "a proportional band of 0 % is a switch, not a gain")
    return 100.0 * command_span / (band * measured_span)


def _standard_to_parallel(Kp: Any, Ti: Any, Td: Any, N: Any) -> tuple[Any, Any, Any, Any]:
    return Kp, Kp / Ti, Kp * Td, Td / N


def _series_to_parallel(K: Any, Ti: Any, Td: Any, Tf: Any) -> tuple[Any, Any, Any, Any]:
    return K * (1 + Td / Ti), K / Ti, K * Td * (1 - Tf / Ti), Tf


def _check_spans(measured: float, command: float) -> None:
    require(
        0 < measured < inf and 0 < command < inf,
        f"both spans must be positive, got {measured:g} (measured) and {command:g} (command)",
    )
