"""The PID blocks of common controllers: their settings, formula and source, and in what they differ from our law.

What a maker has not published, how the block keeps its integral at bay at a limit above all, is taken as clamping and
said so.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from pneuopt.control.forms import ParallelForm, to_standard
from pneuopt.quantities.units import write_value

MINUTE = 60.0  # [s], the unit of times in Rockwell's dependent form and PIDE
TIME_GRAIN = 1e-3
"""What IEC 61131-3's TIME counts in on most controllers [s]: times of a block are rounded to it."""


class Block(Enum):
    """Whose PID block takes the gains."""

    SIEMENS = "siemens"
    ROCKWELL = "rockwell"
    BECKHOFF = "beckhoff"
    CODESYS = "codesys"
    SIMULINK = "simulink"


@dataclass(frozen=True)
class Design:
    """The numbers of a tuned controller that a block takes, in SI units.

    Parameters
    ----------
    gains : ParallelForm
    b, c : float
    Tt : float
        Of back-calculation [s]; nan where the design has another anti-windup or none.
    low, high : float
        Ends of the output on the wire [the command's unit]; infinite for none.
    centre : float
    sample_time : float
    measured_unit, command_unit : str
    measured_span : float
        From the least to the largest process value as the block scales it [the measured unit].
    """

    gains: ParallelForm
    b: float
    c: float
    Tt: float
    low: float
    high: float
    centre: float
    sample_time: float
    measured_unit: str
    command_unit: str
    measured_span: float = 1.0

    @property
    def times(self) -> tuple[float, float]:
        """Ti and Td of the standard form [s]."""
        standard = to_standard(self.gains)
        return standard.Ti, standard.Td

    @property
    def limits(self) -> str:
        """Of the command about the valve's centre."""
        return f"{_limit(self.low - self.centre)}, {_limit(self.high - self.centre)}"

    @property
    def span(self) -> float:
        """Of the output [the command's unit]; infinite without limits."""
        return self.high - self.low


class Setting(NamedTuple):
    """A field of a block: its name, its value as it is typed in, and by what formula."""

    name: str
    value: str
    formula: str


@dataclass(frozen=True)
class BlockForm:
    """What is known of a block.

    Attributes
    ----------
    title, formula : str
    sources : tuple of str
    settings : callable
        From a `Design`.
    weights : tuple of float
        The set-point weights b and c that it can have; empty for any.
    has_filter : bool
        Whether its derivative has a filter of first order that can be set.
    clamps : bool
        Whether its integral is clamped at a limit, or may be taken to be.
    time_grain : float
        What its times are rounded to [s]; 0 for nothing.
    """

    title: str
    formula: str
    sources: tuple[str, ...]
    settings: Callable[[Design], list[Setting]]
    weights: tuple[float, ...] = ()
    has_filter: bool = True
    clamps: bool = True
    time_grain: float = 0.0

    @property
    def maker(self) -> str:
        """The first word of the title."""
        return self.title.partition(" ")[0]


def _number(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else "0 (switches it off)"


def _time(seconds: float) -> str:
    """As IEC 61131-3 writes it; 0 switches a term off."""
    return f"T#{round(seconds / TIME_GRAIN)}ms" if math.isfinite(seconds) else "T#0ms (switches it off)"


def _siemens(d: Design) -> list[Setting]:
    Ti, Td = d.times
    percent = 100.0 / d.span if math.isfinite(d.span) else 1.0
    formula = (
        f"Kp 100 %/({write_value(d.span, d.command_unit)})" if math.isfinite(d.span) else "Kp: no limits to scale by"
    )
    rest = 100.0 * (d.centre - d.low) / d.span if math.isfinite(d.span) else d.centre
    lag = d.gains.Tf / Td if Td else 0.0
    return [
        Setting("Retain.CtrlParams.Gain", _number(d.gains.Kp * percent), formula),
        Setting("Retain.CtrlParams.Ti", _number(Ti), "Kp/Ki [s]"),
        Setting("Retain.CtrlParams.Td", _number(Td), "Kd/Kp [s]"),
        Setting("Retain.CtrlParams.TdFiltRatio", _number(lag), "a = Tf/Td"),
        Setting("Retain.CtrlParams.PWeighting", _number(d.b), "b"),
        Setting("Retain.CtrlParams.DWeighting", _number(d.c), "c"),
        Setting("Retain.CtrlParams.Cycle", _number(d.sample_time), "sample time [s]; call it in a cyclic interrupt"),
        Setting("(output at rest)", _number(rest), "% while the command is zero: begin there"),
    ]


def _rockwell(d: Design) -> list[Setting]:
    Ti, Td = d.times
    scale = d.measured_span / d.span if math.isfinite(d.span) else d.measured_span
    Kp, Ki, Kd = (g * scale for g in (d.gains.Kp, d.gains.Ki, d.gains.Kd))
    per = f"S/R, S the span of PV, here {write_value(d.measured_span, d.measured_unit)}, R that of CV"
    return [
        Setting("PID independent: Kp", _number(Kp), f"Kp {per}"),
        Setting("PID independent: Ki [1/s]", _number(Ki), f"Ki {per}"),
        Setting("PID independent: Kd [s]", _number(Kd), f"Kd {per}"),
        Setting("PID dependent: Kc", _number(Kp), f"Kp {per}"),
        Setting("PID dependent: Ti [min/repeat]", _number(Ti / MINUTE), "Kp/Ki/60"),
        Setting("PID dependent: Td [min]", _number(Td / MINUTE), "Kd/Kp/60"),
        Setting("PIDE independent: PGain", _number(Kp), f"Kp {per}"),
        Setting("PIDE independent: IGain [1/min]", _number(Ki * MINUTE), f"60 Ki {per}"),
        Setting("PIDE independent: DGain [min]", _number(Kd / MINUTE), f"Kd/60 {per}"),
        Setting("PVEProportional", str(d.b < 0.5).lower(), "b = 0: of PV; b = 1: of the error"),
        Setting("PVEDerivative", str(d.c < 0.5).lower(), "c = 0: of PV; c = 1: of the error"),
        Setting("UPD, or the task's period [s]", _number(d.sample_time), "sample time"),
    ]


def _beckhoff(d: Design) -> list[Setting]:
    Ti, Td = d.times
    return [
        Setting("FB_CTRL_PID: fKp", _number(d.gains.Kp), "Kp"),
        Setting("FB_CTRL_PID: tTn", _time(Ti), "Kp/Ki"),
        Setting("FB_CTRL_PID: tTv", _time(Td), "Kd/Kp"),
        Setting("FB_CTRL_PID: tTd", _time(d.gains.Tf), "Tf"),
        Setting(
            "FB_CTRL_PID: fOutMinLimit, fOutMaxLimit", d.limits, "about the valve's centre, added behind the block"
        ),
        Setting("FB_CTRL_PID: bPInTheFeedbackPath", str(d.b < 0.5).upper(), "b = 0"),
        Setting("FB_CTRL_PID: bDInTheFeedbackPath", str(d.c < 0.5).upper(), "c = 0"),
        Setting("FB_CTRL_PID: tCtrlCycleTime, tTaskCycleTime", _time(d.sample_time), "sample time"),
        Setting(
            "FB_BasicPID: fKp, fTn, fTv, fTd",
            ", ".join(map(_number, (d.gains.Kp, Ti, Td, d.gains.Tf))),
            "LREAL in seconds, not rounded; it has no limits",
        ),
    ]


def _codesys(d: Design) -> list[Setting]:
    Ti, Td = d.times
    return [
        Setting("KP", _number(d.gains.Kp), "Kp"),
        Setting("TN", _number(Ti), "Kp/Ki [s]"),
        Setting("TV", _number(Td), "Kd/Kp [s]"),
        Setting("Y_OFFSET", _number(d.centre), "output while the command is zero"),
        Setting("Y_MIN", _limit(d.low), "on the wire"),
        Setting("Y_MAX", _limit(d.high), "on the wire"),
        Setting("CYCLE", _number(d.sample_time), "sample time [s]; PID itself measures whole milliseconds"),
    ]


def _simulink(d: Design) -> list[Setting]:
    Tf = d.gains.Tf
    back = math.isfinite(d.Tt)
    return [
        Setting("P", _number(d.gains.Kp), "Kp"),
        Setting("I", _number(d.gains.Ki), "Ki"),
        Setting("D", _number(d.gains.Kd), "Kd"),
        Setting(
            "N", _number(1 / Tf) if Tf else "clear Use filtered derivative", "1/Tf, a pole [rad/s], not ISA's ratio"
        ),
        Setting("b", _number(d.b), "b"),
        Setting("c", _number(d.c), "c"),
        Setting("Sample time", _number(d.sample_time), "[s]"),
        Setting("Integrator method, Filter method", "Backward Euler", "as the design is sampled"),
        Setting("Lower limit, Upper limit", d.limits, "about the valve's centre"),
        Setting("Anti-windup method", "back-calculation" if back else "clamping", "as the design has it"),
        *([Setting("Kb", _number(1 / d.Tt), "1/Tt")] if back else []),
    ]


def _limit(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else "none"


BLOCK_FORMS: Mapping[Block, BlockForm] = {
    Block.SIEMENS: BlockForm(
        "Siemens PID_Compact (S7-1200, S7-1500)",
        "y = Gain ((b w - x) + 1/(Ti s) (w - x) + Td s/(a Td s + 1) (c w - x)), w setpoint, x process value, y in %",
        (
            "S7-1200 Easy Book, A5E02486680-06, 04/2012, section 9.2.2: formula; 'PIDT1 controller with anti-windup'",
            "S7-1200 System Manual, A5E02486680-AK, V4.2, 09/2016, section 10.2: names, ranges",
            "How it keeps its integral at bay at a limit is not published: taken as clamping.",
            "These manuals name a dead zone for PID_Temp only (Heat.DeadZone), of the whole error.",
        ),
        _siemens,
    ),
    Block.ROCKWELL: BlockForm(
        "Rockwell PID and PIDE (Logix 5000)",
        "independent CV = Kp E + Ki int E dt + Kd dE/dt; dependent CV = Kc (E + 1/Ti int E dt + Td dE/dt); in %",
        (
            "Logix5000 General Instructions, 1756-RM003I-EN-P, 01/2007, pages 509, 510: forms, units, Ki = Kc/(60 Ti), "
            "Kd = 60 Kc Td",
            "It freezes its integral while CV is at a limit, whichever way the error points: taken as clamping.",
            "Process Control Instructions, 1756-RM006K-EN-P, 11/2018, pages 80, 81: PIDE's units, 1/min and min",
            "PIDE's derivative smoothing has no published time: taken as off.",
        ),
        _rockwell,
        weights=(0.0, 1.0),
        has_filter=False,
    ),
    Block.BECKHOFF: BlockForm(
        "Beckhoff FB_CTRL_PID (TF4100) and FB_BasicPID (Tc2_Utilities)",
        "G(s) = fKp (1 + 1/(tTn s) + tTv s/(1 + tTd s))",
        (
            "infosys.beckhoff.com/content/1033/tcplclibcontrollertoolbox/11282668683.html (FB_CTRL_PID)",
            "infosys.beckhoff.com/content/1033/tcplclib_tc2_utilities/34976395.html (FB_BasicPID)",
            "INFERRED: the pages draw the formula as a picture; this one is by the parameters' descriptions.",
            "Compare a step of the block with the design before you rely on it.",
            "The page draws the anti-reset windup (ARW) as a figure only: taken as clamping. TIME counts in ms.",
        ),
        _beckhoff,
        weights=(0.0, 1.0),
        time_grain=TIME_GRAIN,
    ),
    Block.CODESYS: BlockForm(
        "CODESYS Util.PID_FIXCYCLE",
        "Y = KP (e + 1/TN int e dt + TV de/dt) + Y_OFFSET",
        (
            "content.helpme-codesys.com/en/libs/Util/Current/Controller/PID.html and PID_FIXCYCLE.html",
            "INFERRED: the pages draw the formula as a picture; this one is by the parameters' descriptions.",
            "Compare a step of the block with the design before you rely on it.",
            "Its derivative has no filter that can be set, its setpoint no weights; at a limit: taken as clamping.",
        ),
        _codesys,
        weights=(1.0,),
        has_filter=False,
    ),
    Block.SIMULINK: BlockForm(
        "Simulink Discrete PID Controller (2DOF), form Parallel",
        "u = P (b r - y) + I Ts z/(z - 1) (r - y) + D N/(1 + N Ts z/(z - 1)) (c r - y)",
        (
            "mathworks.com/help/simulink/slref/discretepidcontroller2dof.html",
            "Its back-calculation acts on the next sample where ours acts on this one: a difference of one sample.",
        ),
        _simulink,
        clamps=False,
    ),
}
"""What is known of each block."""
