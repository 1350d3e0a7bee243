"""The forms in which a PID's gains are given, and the parallel one, which is what runs.

Two things are called N elsewhere: in the ISA standard form N is a ratio, ``Tf = Td/N``; in Simulink's block N is a pole
[rad/s], ``Tf = 1/N``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from math import inf, sqrt
from typing import Any

import casadi as ca

from pneuopt.quantities.errors import require

UNUSED_FILTER_TIME = 0.01  # [s], the filter of a standard form's derivative that is switched off, Td = 0


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
