"""The PID blocks of common controllers: what is typed in, by which formula and source, what is refused.

`MakerBlock` says what is known of a maker's block, `BlockNumbers` has the numbers of a controller that it takes. To add
a maker, write its class, and a row in `MAKER_BLOCKS`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, NamedTuple, Protocol

from pneuopt.control.pid import ParallelForm
from pneuopt.export.tolerances import LARGEST_LITERAL, TIME_GRAIN, USUAL_UPDATE
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import difference_unit, write_value

BEHIND_OFFSET = "Behind the block: offset"


BEHIND_FACTOR = "Behind the block: factor"
"""Settings of what the user's own program does with a block's output: ``wire = offset + factor output``."""


class Block(Enum):
    """Whose PID block takes the gains."""

    SIEMENS = "siemens"
    ROCKWELL = "rockwell"
    BECKHOFF = "beckhoff"
    CODESYS = "codesys"
    SIMULINK = "simulink"


@dataclass(frozen=True)
class BlockNumbers:
    """The numbers of a tuned controller that a block takes, in SI units."""

    gains: ParallelForm
    b: float
    c: float
    Tt: float  # [s] of back-calculation; nan where the design has another anti-windup or none
    low: float  # end of the output on the wire [the command's unit]; infinite for none
    high: float  # the other end
    centre: float  # on the wire while the command is zero
    sample_time: float  # [s]
    measured: str
    measured_unit: str
    command_unit: str
    pv_low: float = -0.5  # range of the process value that the block counts on [the measured unit]
    pv_high: float = 0.5
    start: float = 0.0  # process value where the references begin
    is_added_to: bool = False  # whether a feedforward or a dither is added before the limits
    goes: str = "on the wire"  # where the output goes
    zero: str = "the centre"  # what the command zero is
    reach: str = "the references and as far again"  # what the range of the process value holds

    @property
    def span(self) -> float:
        """Of the output [the command's unit]; infinite without limits."""
        return self.high - self.low

    @property
    def pv_span(self) -> float:
        """Of the process value [the measured unit]."""
        return self.pv_high - self.pv_low

    @property
    def rest(self) -> float:
        """The centre as a part of the output's span [%]."""
        return 100.0 * (self.centre - self.low) / self.span

    @property
    def at_rest(self) -> str:
        """The centre as it is on the wire, with its unit."""
        return wire(self.centre, self)

    @property
    def limits(self) -> tuple[float, float]:
        """Of the command about the centre."""
        return self.low - self.centre, self.high - self.centre

    @property
    def integrates(self) -> bool:
        """Whether there is an integral at all."""
        return self.gains.Ki != 0

    @property
    def sum_words(self) -> str:
        """Behind a setting that the sum of the surroundings is added to in the program; "" without one."""
        return "; with the sum above" if self.is_added_to else ""

    @property
    def is_open(self) -> bool:
        """Whether a block that is added to behind its limits leaves them open: without an integral none needs them."""
        return self.is_added_to and not self.integrates

    @property
    def differentiates(self) -> bool:
        """Whether there is a derivative at all."""
        return self.gains.Kd != 0


class Setting(NamedTuple):
    """A field of a block: its name, its value as it is typed in, and by what formula or why."""

    name: str
    value: str
    formula: str


class MakerBlock(Protocol):
    """What is known of a maker's PID block."""

    title: ClassVar[str]
    formula: ClassVar[str]
    sources: ClassVar[tuple[str, ...]]
    manual: ClassVar[str]  # how it is held in manual at the centre
    has_filter: ClassVar[bool] = True  # whether its derivative has a filter of first order that can be set
    clamps: ClassVar[bool] = True  # whether its integral is clamped at a limit, or may be taken to be
    time_grain: ClassVar[float] = 0.0  # what its times are rounded to [s]; 0 for nothing

    def settings(self, d: BlockNumbers) -> list[Setting]:
        """What is typed in; refuses gains that the block cannot have."""

    def states(self, d: BlockNumbers) -> list[str]:
        """What the output is at rest, at a fault and while stopped."""

    def sum_input(self, _d: BlockNumbers) -> str | None:
        """Where a signal in the command's unit is added before the limits; None: there is no such input."""
        return None

    def weights(self, d: BlockNumbers) -> tuple[float, float]:
        """The set-point weights b, c that it has in place of those of the design."""
        return d.b, d.c

    @property
    def maker(self) -> str:
        """The first word of the title."""
        return self.title.partition(" ")[0]

    @property
    def is_inferred(self) -> bool:
        """Whether its formula is read from the parameters' descriptions, and not from the maker's own text."""
        return any(source.startswith("INFERRED: the pages draw") for source in self.sources)


def number(value: float) -> str:
    """A number as it is typed in."""
    return f"{value:.9g}"


def flag(value: bool) -> str:
    """TRUE or FALSE, as IEC 61131-3 writes it."""
    return str(value).upper()


def nearest_weight(value: float) -> float:
    """Of the weights 0 and 1 the nearer one."""
    return 0.0 if value < 0.5 else 1.0


def wire(value: float, design: BlockNumbers) -> str:
    """An output in its unit."""
    return write_value(value, design.command_unit)


def check_limits(design: BlockNumbers, block: str) -> None:
    """Refuse a design without limits where the block counts its output in percent of them."""
    told = f"{block} counts its output in percent of the command's range, and this design has no limits"
    remedy = "state limits under [pid] of tuning.toml and tune again, or use --to st"
    require(math.isfinite(design.span), f"{told}; {remedy}")


def standard_times(design: BlockNumbers, block: str) -> tuple[float, float]:
    """Ti, infinite for no integral, and Td [s] of a block whose gain multiplies all its terms; refuses Kp = 0 there."""
    Kp, Ki, Kd = design.gains.Kp, design.gains.Ki, design.gains.Kd
    told = f"{block} multiplies its integral and its derivative by its gain"
    given = f"this design has Kp = 0, Ki = {Ki:g}, Kd = {Kd:g}"
    require(Kp != 0 or Ki == Kd == 0, f"{told}, and {given}: it cannot have them; use --to st")
    return Kp / Ki if Ki else math.inf, Kd / Kp if Kp else 0.0


def direction(design: BlockNumbers, block: str) -> float:
    """1, or -1 of a design whose gains are negative; refuses gains of both signs."""
    Kp, Ki, Kd = design.gains.Kp, design.gains.Ki, design.gains.Kd
    signs = {math.copysign(1.0, g) for g in (Kp, Ki, Kd) if g}
    told = f"{block} has one sign for all its gains, and this design has Kp = {Kp:g}, Ki = {Ki:g}, Kd = {Kd:g}"
    require(len(signs) < 2, f"{told}; use --to st")
    return signs.pop() if signs else 1.0


PID_COMPACT = "Siemens PID_Compact"


def _counts(d: BlockNumbers) -> str:
    """The same in counts of an analogue output of 10 V, which has 27648 of them."""
    if d.command_unit != "V":
        return "; not Output_PER, which has no offset"
    per_volt = 2764.8
    counts = f"{number(d.centre * per_volt)} + {number(d.span / 100 * per_volt)} Output"
    return f"; at a 10 V output {counts} counts, not Output_PER"


class SiemensBlock(MakerBlock):
    """PID_Compact as of V2: 0 % of its output is made the centre, as it gives 0 % whenever it does not control."""

    title = "Siemens PID_Compact (S7-1200, S7-1500), V2"
    formula = (
        "y = Gain ((b w - x) + 1/(Ti s) (w - x) + Td s/(a Td s + 1) (c w - x)) + Disturbance, w setpoint, x "
        "Input, y in %"
    )
    sources = (
        "S7-1200 Easy Book, A5E02486680-06, 04/2012, section 9.2.2: formula; 'PIDT1 controller with anti-windup'",
        "S7-1200, S7-1500 PID control, A5E35300227-AC, 03/2017, page 248: errors and stops give 0.0 to the actuator",
        "the same, pages 256 to 261: substitute output, limits, cycle, direction, Ti = 0.0 is off; what is delivered",
        "the same, 11/2019, 'IntegralResetMode V2 tag': 0 begins with the output 0.0, for Ti > 0.0 only",
        "'Output value limits V1': an output that shall not be 0 % there takes an offset in the user program.",
        "How it keeps its integral at bay at a limit is not published: taken as clamping.",
    )
    manual = "Mode = 4 with ManualValue = 0.0"

    def settings(self, d: BlockNumbers) -> list[Setting]:
        """See `MakerBlock`."""
        check_limits(d, PID_COMPACT)
        Ti, Td = standard_times(d, PID_COMPACT)
        sign, percent = direction(d, PID_COMPACT), 100.0 / d.span
        low, high = d.limits
        b, c = self.weights(d)
        off = "0.0 switches the integral off" if math.isinf(Ti) else "Kp/Ki [s]"
        pv = f"{d.reach}, or the range of your sensor"
        rows = [
            ("Retain.CtrlParams.Gain", number(abs(d.gains.Kp) * percent), f"Kp 100 %/({wire(d.span, d)})"),
            ("Retain.CtrlParams.Ti", number(Ti) if math.isfinite(Ti) else "0.0", off),
            ("Retain.CtrlParams.Td", number(Td), "Kd/Kp [s]; 0.0 switches the derivative off"),
            ("Retain.CtrlParams.TdFiltRatio", number(d.gains.Tf / Td if Td else 0.0), "a = Tf/Td"),
            ("Retain.CtrlParams.PWeighting", number(b), "b"),
            ("Retain.CtrlParams.DWeighting", number(c), "c"),
            ("Retain.CtrlParams.Cycle", number(d.sample_time), "sample time [s]"),
            ("CycleTime.Value", number(d.sample_time), "[s], period of the cyclic interrupt that calls the block"),
            ("CycleTime.EnEstimation", "FALSE", "so that the value above stays; StartEstimation FALSE, too"),
            ("CycleTime.EnMonitoring", "TRUE", "a cycle that comes late stops the block: 0 %, " + d.zero),
            ("Config.InvertControl", flag(sign < 0), "the sign of Kp; the gain itself is typed in positive"),
            ("Config.InputPerOn", "FALSE", f"Input, the {d.measured} in {d.measured_unit}, in place of Input_PER"),
            ("Config.InputUpperLimit", number(d.pv_high), f"[{d.measured_unit}] {pv}"),
            ("Config.InputLowerLimit", number(d.pv_low), f"[{d.measured_unit}] as delivered: 0.0 and 120.0"),
            ("Config.SetpointUpperLimit", number(d.pv_high), f"[{d.measured_unit}]"),
            ("Config.SetpointLowerLimit", number(d.pv_low), f"[{d.measured_unit}]"),
            ("Config.OutputUpperLimit", number(high * percent), f"% about {d.zero}"),
            ("Config.OutputLowerLimit", number(low * percent), f"% about {d.zero}; as delivered: 0.0"),
            ("Disturbance", "0.0", f"% of precontrol; the offset stands behind the block, where it stays{d.sum_words}"),
            ("ActivateRecoverMode", "FALSE", f"every error gives 0 %, {d.zero}, and stops the block"),
            ("SetSubstituteOutput", "TRUE", "if you let the block recover: the next value, not the last output"),
            ("SubstituteOutput", "0.0", f"% which is {d.zero}"),
            ("IntegralResetMode", "0", f"smooth: it begins with 0 %, {d.zero} (V2.2 and later)"),
            ("RunModeByStartup", "FALSE", f"after a restart of the CPU the block waits for you, at {d.zero}"),
            (BEHIND_OFFSET, number(d.centre), f"{d.command_unit} {d.goes} at 0 %, in your program"),
            (BEHIND_FACTOR, number(d.span / 100.0), f"{d.command_unit} for a percent of Output{_counts(d)}"),
        ]
        return [Setting(*row) for row in rows]

    def states(self, d: BlockNumbers) -> list[str]:
        """See `MakerBlock`."""
        return [
            f"At error 0 from rest: Output = 0 %, {d.at_rest} on the wire.",
            f"Stopped (Inactive, Reset, after a restart): Output = 0 %, {d.at_rest}; what Disturbance adds would "
            "be gone then.",
            f"At an error (Input invalid or beyond its limits, a late cycle): Output = 0 %, {d.at_rest}; a rising "
            "edge at ModeActivate starts it again.",
            f"While the CPU stops: what the output module is set to; its substitute value must be {d.at_rest}.",
        ]

    def sum_input(self, d: BlockNumbers) -> str:
        """See `MakerBlock`."""
        return (
            f"Disturbance = {number(100.0 / d.span)} %/({d.command_unit}) x sum (INFERRED: it is added before the "
            "limits)"
        )

    def weights(self, d: BlockNumbers) -> tuple[float, float]:
        """See `MakerBlock`."""
        return min(max(d.b, 0.0), 1.0), min(max(d.c, 0.0), 1.0)


LOGIX_PID = "Rockwell PID"


def _can_be_enhanced(d: BlockNumbers) -> bool:
    """Whether PIDE runs the design: its velocity form rests at the centre by its integral only."""
    return d.integrates and not d.is_added_to


def _can_be_plain(d: BlockNumbers) -> bool:
    """Whether PID runs it as well as PIDE: its proportional term sees the error."""
    return nearest_weight(d.b) == 1 or not _can_be_enhanced(d)


def _scaled_gains(d: BlockNumbers) -> tuple[float, float, float]:
    scale = direction(d, LOGIX_PID) * d.pv_span / d.span
    return d.gains.Kp * scale, d.gains.Ki * scale, d.gains.Kd * scale


def _plain_settings(d: BlockNumbers) -> list[Setting]:
    Kp, Ki, Kd = _scaled_gains(d)
    inverse = direction(d, LOGIX_PID) < 0
    S, R = write_value(d.pv_span, difference_unit(d.measured_unit)), wire(d.span, d)
    unit, on = d.measured_unit, d.command_unit
    short = "; below the usual 0.01 s: check that it is taken" if d.sample_time < USUAL_UPDATE else ""
    rows = [
        ("PE", "0", "independent gains"),
        ("KP", number(Kp), f"Kp S/R, S the span of PV, here {S}, R that of CV, here {R}"),
        ("KI", number(Ki), "[1/s] Ki S/R; 0 is no integral"),
        ("KD", number(Kd), "[s] Kd S/R; 0 is no derivative"),
        ("DOE", number(nearest_weight(d.c)), "derivative of 0: PV, 1: the error"),
        ("NDF", "0", "no smoothing of the derivative: its time is not published"),
        ("CA", str(int(inverse)), "0: E = SP - PV, 1: E = PV - SP, by the sign of Kp"),
        ("MAXS", number(d.pv_high), f"[{unit}] PV and SP in {unit}; SP beyond them is refused"),
        ("MINS", number(d.pv_low), f"[{unit}]"),
        ("MAXI", number(d.pv_high), f"[{unit}] as MAXS where PV is in {unit} already; else the raw value there"),
        ("MINI", number(d.pv_low), f"[{unit}] as MINS, likewise"),
        ("MAXCV", number(d.high), f"[{on}] {d.goes} at 100 %"),
        ("MINCV", number(d.low), f"[{on}] {d.goes} at 0 %"),
        ("MAXO", "100", "% the limits are the ends of CV"),
        ("MINO", "0", "%"),
        ("BIAS", number(d.rest), f"% {d.at_rest}, {d.zero}{d.sum_words}"),
        ("NOBC", "1", "else a change from manual to auto without an integral moves BIAS"),
        ("DB", "0", "no dead band"),
        ("SO", number(d.rest), f"% the output in software manual: {d.zero}"),
        ("SWM", "1", "begin in software manual; 0 is automatic"),
        ("UPD", number(d.sample_time), f"[s] sample time, the period of its periodic task{short}"),
    ]
    return [Setting(f"PID .{name}", value, formula) for name, value, formula in rows]


def _enhanced_settings(d: BlockNumbers, b: float, c: float) -> list[Setting]:
    Kp, Ki, Kd = _scaled_gains(d)
    inverse = direction(d, LOGIX_PID) < 0
    unit, on = d.measured_unit, d.command_unit
    rows = [
        ("DependIndepend", "false", "independent gains"),
        (
            "PGain",
            number(Kp),
            f"Kp S/R, S the span of PV, here {write_value(d.pv_span, difference_unit(unit))}, R that of CV",
        ),
        ("IGain", number(Ki * 60.0), "[1/min] 60 Ki S/R"),
        ("DGain", number(Kd / 60.0), "[min] Kd/60 S/R; 0 is no derivative"),
        ("PVEProportional", str(b < 1).lower(), "b = 0: of PV; b = 1: of the error"),
        ("PVEDerivative", str(c < 1).lower(), "c = 0: of PV; c = 1: of the error"),
        ("DSmoothing", "false", "its time is not published"),
        ("ControlAction", str(inverse).lower(), "true turns the error round: the sign of Kp"),
        ("PVEUMax", number(d.pv_high), f"[{unit}] PV and SP in {unit}"),
        ("PVEUMin", number(d.pv_low), f"[{unit}]"),
        ("SPHLimit", number(d.pv_high), f"[{unit}]"),
        ("SPLLimit", number(d.pv_low), f"[{unit}]"),
        ("CVEUMax", number(d.high), f"[{on}] CVEU, {d.goes}, at 100 %"),
        ("CVEUMin", number(d.low), f"[{on}] CVEU, {d.goes}, at 0 %"),
        ("CVHLimit", "100", "%"),
        ("CVLLimit", "0", "%"),
        ("FF", "0", "% its changes alone are added, so that it cannot make the centre"),
        ("CVInitValue", number(d.centre), f"[{on}] where it begins: the centre"),
        ("ManualAfterInit", "true", "after a restart it waits for you, at the centre"),
        ("CVProg", number(d.rest), "% in program manual, and at a fault: the centre"),
        ("ProgProgReq", "true", "program control, so that CVProg counts in manual"),
        ("TimingMode", "0", "periodic"),
        ("period of its task", number(d.sample_time), "[s] sample time"),
    ]
    return [Setting(f"PIDE {name}", value, formula) for name, value, formula in rows]


class RockwellBlock(MakerBlock):
    """PID, and PIDE where it can run the design: in percent of the spans of PV and CV."""

    title = "Rockwell PID and PIDE (Logix 5000)"
    formula = (
        "independent CV = KP E + KI int E dt + KD dE/dt + BIAS, E and CV in % of their spans; PIDE adds the "
        "changes of it"
    )
    sources = (
        "Logix5000 General Instructions, 1756-RM003N-EN-P, 10/2011, pages 512, 519: members, forms with BIAS, units",
        "Studio 5000 Logix Designer 37, 'PID Structure': CA = 0 is SP - PV; DOE, PE, NDF, NOBC",
        "'Feedforward or Output Biasing (PID)': a bias is for use without integral.",
        "'Anti-reset Windup and Bumpless Transfer' (PID): with KI = 0 a change from manual to auto moves BIAS.",
        "There, too: its integral is frozen while CV is at a limit, whichever way the error points: taken as clamping.",
        "Process Control Instructions, 1756-RM006K-EN-P, 11/2018, pages 69 to 81: limits, FF, velocity form, units",
        "the same, pages 259 and 500: faults, TimingMode; Studio 5000 37, 'Execution': CVInitValue, ManualAfterInit",
    )
    manual = "PID: SWM = 1; PIDE: ProgManualReq = true"
    has_filter = False

    def settings(self, d: BlockNumbers) -> list[Setting]:
        """See `MakerBlock`."""
        check_limits(d, LOGIX_PID)
        plain = _plain_settings(d) if _can_be_plain(d) else []
        return plain + (_enhanced_settings(d, *self.weights(d)) if _can_be_enhanced(d) else [])

    def states(self, d: BlockNumbers) -> list[str]:
        """See `MakerBlock`."""
        rest = f"{number(d.rest)} %, {d.at_rest} on the wire"
        lines = []
        if _can_be_plain(d):
            lines += [
                f"PID, at error 0 from rest: BIAS, {rest}; in software manual SO, the same.",
                "PID, at a fault of the sensor: it goes on with the last value. Set SWM by the fault bit of your "
                "input.",
            ]
        if _can_be_enhanced(d):
            lines += [
                f"PIDE, at error 0 from rest: where it was in manual, CVProg, {rest}.",
                "PIDE, at a fault of the sensor: wire the fault bit of your input to PVFault; it goes to manual, "
                "CVProg.",
            ]
        else:
            alone = "without an integral its velocity form does not come back to the centre once a limit has cut it off"
            why = "its FF adds changes alone, of which a limit cuts off some" if d.integrates else alone
            lines += [f"PIDE is not for this design: {why}."]
        return [
            *lines,
            f"While the controller stops or is at fault: what the output module is set to; it must be {d.at_rest}.",
        ]

    def sum_input(self, d: BlockNumbers) -> str:
        """See `MakerBlock`."""
        return f"BIAS = {number(d.rest)} + {number(100.0 / d.span)} %/({d.command_unit}) x sum, every scan"

    def weights(self, d: BlockNumbers) -> tuple[float, float]:
        """See `MakerBlock`."""
        return (1.0 if _can_be_plain(d) else 0.0), nearest_weight(d.c)


UTIL_PID = "CODESYS Util.PID_FIXCYCLE"


class CodesysBlock(MakerBlock):
    """PID_FIXCYCLE of the library Util, and PD where there is no integral; their Y_OFFSET is the centre."""

    title = "CODESYS Util.PID_FIXCYCLE, Util.PD without an integral"
    formula = "Y = KP (e + 1/TN int e dt + TV de/dt) + Y_OFFSET; PD: Y = KP (e + TV de/dt) + Y_OFFSET"
    sources = (
        "content.helpme-codesys.com/en/libs/Util/Current/Controller/PID.html and PID_FIXCYCLE.html: names",
        "the same, PD.html: its formula; TV = 0 is a P controller; Y_MIN = Y_MAX = 0 is no limit; RESET gives Y_OFFSET",
        "INFERRED: the pages draw the formula as a picture; this one is by the parameters' descriptions.",
        "INFERRED: that TN = 0 is no setting of PID: the pages give it no meaning.",
        "Compare a step of the block with the design before you rely on it.",
        "Its derivative has no filter that can be set, its setpoint no weights; at a limit: taken as clamping.",
    )
    manual = "MANUAL := TRUE"
    has_filter = False

    def settings(self, d: BlockNumbers) -> list[Setting]:
        """See `MakerBlock`."""
        Ti, Td = standard_times(d, UTIL_PID)
        direction(d, UTIL_PID)  # typed in with their sign, which must be one
        name, unit = ("PID_FIXCYCLE" if d.integrates else "PD"), d.command_unit
        is_open = math.isinf(d.low) and math.isinf(d.high)
        low, high = (0.0, 0.0) if is_open else (max(d.low, -LARGEST_LITERAL), min(d.high, LARGEST_LITERAL))
        limits = "both 0: no limit" if is_open else d.goes
        integral = [("TN", number(Ti), "Kp/Ki [s]")] if d.integrates else []
        clock = [("CYCLE", number(d.sample_time), "sample time [s], the period of the task")]
        rows = [
            ("KP", number(d.gains.Kp), f"Kp [{unit} per {d.measured_unit}], with its sign"),
            *integral,
            ("TV", number(Td), "Kd/Kp [s]; 0 is no derivative"),
            ("Y_OFFSET", number(d.centre), f"[{unit}] {d.goes} at error 0: {d.zero}{d.sum_words}"),
            ("Y_MIN", number(low), f"[{unit}] {limits}"),
            ("Y_MAX", number(high), f"[{unit}] {limits}"),
            ("Y_MANUAL", number(d.centre), f"[{unit}] the output while MANUAL is TRUE: {d.zero}"),
            ("MANUAL", "TRUE", "begin there: new parameters count from a fall of MANUAL or RESET on"),
            ("RESET", "FALSE", f"TRUE gives Y_OFFSET, {d.zero}"),
            *(clock if d.integrates else []),
        ]
        return [Setting(f"{name}.{field}", value, formula) for field, value, formula in rows]

    def states(self, d: BlockNumbers) -> list[str]:
        """See `MakerBlock`."""
        rest = d.at_rest
        block = (
            "Util.PID_FIXCYCLE" if d.integrates else "Util.PD, as there is no integral: TN = 0 has no meaning in PID"
        )
        task = f"it must be called by a task of {number(d.sample_time)} s"
        is_rough = d.differentiates and not d.integrates
        return [
            f"The block is {block}; {task}.",
            *(["PD measures the time itself, in whole ms: its derivative is rough."] if is_rough else []),
            f"At error 0 from rest: Y = Y_OFFSET, {rest}. In manual Y_MANUAL, at RESET Y_OFFSET: the same.",
            "At a fault of the sensor: it goes on with the last value. Set MANUAL by your input's diagnosis"
            + (", and by OVERFLOW." if d.integrates else "."),
            f"While the PLC stops: what the output module is set to; it must be {rest}, not 0.",
        ]

    def sum_input(self, d: BlockNumbers) -> str:
        """See `MakerBlock`."""
        return f"Y_OFFSET = {number(d.centre)} {d.command_unit} + sum, every cycle"

    def weights(self, _: BlockNumbers) -> tuple[float, float]:
        """See `MakerBlock`."""
        return (1.0, 1.0)


FB_CTRL_PID = "Beckhoff FB_CTRL_PID"


def _time(seconds: float) -> str:
    """As IEC 61131-3 writes it; 0 switches a term off."""
    return f"T#{round(seconds / TIME_GRAIN)}ms" if math.isfinite(seconds) else "T#0ms"


class BeckhoffBlock(MakerBlock):
    """FB_CTRL_PID of the Controller Toolbox: its output is 0 whenever it does not control."""

    title = "Beckhoff FB_CTRL_PID (TF4100 Controller Toolbox)"
    formula = "G(s) = fKp (1 + 1/(tTn s) + tTv s/(1 + tTd s))"
    sources = (
        "infosys.beckhoff.com/content/1033/tcplclibcontrollertoolbox/11282668683.html (FB_CTRL_PID): names, modes",
        "INFERRED: the pages draw the formula as a picture; this one is by the parameters' descriptions.",
        "INFERRED: that T#0ms switches a term off; that the output is 0 in the modes PASSIVE and RESET.",
        "Compare a step of the block with the design before you rely on it.",
        "The page draws the anti-reset windup (ARW) as a figure only: taken as clamping. TIME counts in ms.",
    )
    manual = "eMode := eCTRL_MODE_MANUAL with fManSyncValue := 0.0"
    time_grain = TIME_GRAIN

    def settings(self, d: BlockNumbers) -> list[Setting]:
        """See `MakerBlock`."""
        Ti, Td = standard_times(d, FB_CTRL_PID)
        direction(d, FB_CTRL_PID)  # typed in with their sign, which must be one
        shown = write_value(Ti, "s") if math.isfinite(Ti) else ""
        told = f"{FB_CTRL_PID} counts its times in whole milliseconds, and Ti = {shown} would be 0: no integral at all"
        require(math.isinf(Ti) or round(abs(Ti) / TIME_GRAIN) > 0, f"{told}; use --to st")
        low, high = (-LARGEST_LITERAL, LARGEST_LITERAL) if d.is_open else d.limits
        off = "T#0ms switches the integral off"
        behind = "open: the sum behind the block is limited" if d.is_open else f"about {d.zero}"
        return [
            Setting("fKp", number(d.gains.Kp), f"Kp [{d.command_unit} per {d.measured_unit}], with its sign"),
            Setting("tTn", _time(Ti), "Kp/Ki" if math.isfinite(Ti) else off),
            Setting("tTv", _time(Td), "Kd/Kp; T#0ms switches the derivative off"),
            Setting("tTd", _time(d.gains.Tf if d.differentiates else 0.0), "Tf"),
            Setting("fOutMinLimit", number(max(low, -LARGEST_LITERAL)), f"[{d.command_unit}] {behind}"),
            Setting("fOutMaxLimit", number(min(high, LARGEST_LITERAL)), f"[{d.command_unit}] {behind}"),
            Setting("bPInTheFeedbackPath", flag(nearest_weight(d.b) < 1), "b = 0"),
            Setting("bDInTheFeedbackPath", flag(nearest_weight(d.c) < 1), "c = 0"),
            Setting("bARWOnIPartOnly", "FALSE", "the anti-reset windup as delivered"),
            Setting("tCtrlCycleTime", _time(d.sample_time), "sample time"),
            Setting("tTaskCycleTime", _time(d.sample_time), "the period of the task that calls it"),
            Setting("fManSyncValue", "0.0", f"[{d.command_unit}] the output in manual: {d.zero}"),
            Setting("eMode", "eCTRL_MODE_MANUAL", "begin there; eCTRL_MODE_ACTIVE controls"),
            Setting("bHold", "FALSE", "TRUE holds the output where it is"),
            Setting(BEHIND_OFFSET, number(d.centre), f"{d.command_unit} {d.goes} at fOut = 0, in your program"),
            Setting(BEHIND_FACTOR, "1", f"{d.command_unit} {d.goes} for 1 {d.command_unit} of fOut"),
        ]

    def states(self, d: BlockNumbers) -> list[str]:
        """See `MakerBlock`."""
        return [
            f"At error 0 from rest: fOut = 0, {d.at_rest} on the wire.",
            f"Stopped (eCTRL_MODE_PASSIVE, eCTRL_MODE_RESET): fOut = 0, {d.at_rest}. In manual: fManSyncValue, "
            "the same.",
            "At a fault of the sensor: it goes on with the last value. Set eMode := eCTRL_MODE_PASSIVE by your "
            "terminal's WcState and status bits, and where bError is TRUE.",
            "While the task stops: what the terminal's watchdog is set to (a default output value); it must be "
            f"{d.at_rest}.",
        ]

    def weights(self, d: BlockNumbers) -> tuple[float, float]:
        """See `MakerBlock`."""
        return (nearest_weight(d.b), nearest_weight(d.c))


def _limit_settings(low: float, high: float, d: BlockNumbers) -> list[Setting]:
    back = math.isfinite(d.Tt)
    inside = math.isfinite(low) or math.isfinite(high)
    if d.is_open or not inside:
        return [Setting("Limit output", "off", "the sum behind is limited" if inside else "the design has no limits")]
    windup = [
        Setting("Anti-windup method", "back-calculation" if back else "clamping", "as the design has it"),
        *([Setting("Kb", number(1 / d.Tt), "1/Tt")] if back else []),
    ]
    return [
        Setting("Limit output", "on", ""),
        Setting("Lower limit", number(low), f"[{d.command_unit}] about {d.zero}"),
        Setting("Upper limit", number(high), f"[{d.command_unit}] about {d.zero}"),
        *(windup if d.integrates else []),
    ]


class SimulinkBlock(MakerBlock):
    """The block with two degrees of freedom: its output is 0 at rest, and a Bias block behind it adds the centre."""

    title = "Simulink Discrete PID Controller (2DOF), form Parallel"
    formula = "u = P (b r - y) + I Ts z/(z - 1) (r - y) + D N/(1 + N Ts z/(z - 1)) (c r - y)"
    sources = (
        "mathworks.com/help/simulink/slref/discretepidcontroller2dof.html: formula, settings, PID, PI or PD",
        "Its back-calculation acts on the next sample where ours acts on this one: a difference of one sample.",
    )
    manual = "a Manual Switch behind the block at 0"
    clamps = False

    def settings(self, d: BlockNumbers) -> list[Setting]:
        """See `MakerBlock`."""
        Tf, (low, high) = d.gains.Tf, d.limits
        kind = {(True, True): "PID", (True, False): "PI"}.get((d.integrates, d.differentiates), "PD")
        begin = f"where it starts at rest, here y0 = {number(d.start)} {d.measured_unit}"
        method = Setting("Integrator method", "Backward Euler", "as the design is sampled")
        first = number(d.gains.Kp * (1 - d.b) * d.start), f"P (1 - b) y0, {begin}"
        integral = [method, Setting("Integrator initial condition", *first)] if d.integrates else []
        unfiltered = "Tf = 0: no filter; its first sample is a kick where c r - y is not 0"
        lag = [Setting("Use filtered derivative", "off", unfiltered)]
        if Tf:
            lag = [
                Setting("Use filtered derivative", "on", "as the design"),
                Setting("N", number(1 / Tf), "1/Tf, a pole [rad/s], not ISA's ratio"),
                Setting("Filter method", "Backward Euler", "as the design is sampled"),
                Setting("Filter initial condition", number(d.gains.Kd * (d.c - 1) * d.start), f"D (c - 1) y0, {begin}"),
            ]
        bias = f"{d.command_unit}: a Bias block behind the output and its limits" if d.centre else f"{d.command_unit}"
        derivative = [Setting("D", number(d.gains.Kd), "Kd"), Setting("c", number(d.c), "c"), *lag]
        return [
            Setting(
                "Controller", kind, "PD with D = 0 is P alone: the block has no P" if kind == "PD" else "its terms"
            ),
            Setting("Form", "Parallel", ""),
            Setting("Time domain", "Discrete-time", ""),
            Setting("Sample time", number(d.sample_time), "[s]"),
            Setting("P", number(d.gains.Kp), f"Kp [{d.command_unit} per {d.measured_unit}], with its sign"),
            *([Setting("I", number(d.gains.Ki), "Ki")] if d.integrates else []),
            Setting("b", number(d.b), "b"),
            *(derivative if kind != "PI" else []),
            *integral,
            *_limit_settings(low, high, d),
            Setting(BEHIND_OFFSET, number(d.centre), bias),
            Setting(BEHIND_FACTOR, "1", f"{d.command_unit} {d.goes} for 1 {d.command_unit} of the output"),
        ]

    def states(self, d: BlockNumbers) -> list[str]:
        """See `MakerBlock`."""
        return [
            f"At error 0 from rest: the output is 0, {d.at_rest} on the wire behind the Bias block.",
            "At a fault of the sensor: it goes on with the last value. A Switch behind the block takes 0 in its "
            "place, and External reset starts its states anew.",
            "Before the first sample and after the stop of a target: the value of its output block; it must be "
            f"{d.at_rest}.",
        ]


MAKER_BLOCKS: Mapping[Block, MakerBlock] = {
    Block.SIEMENS: SiemensBlock(),
    Block.ROCKWELL: RockwellBlock(),
    Block.BECKHOFF: BeckhoffBlock(),
    Block.CODESYS: CodesysBlock(),
    Block.SIMULINK: SimulinkBlock(),
}
"""What is known of each block."""
