"""Rockwell's PID and PIDE: in percent of the spans of PV and CV; they rest where a bias or their start puts them."""

from pneuopt.export.makers.block_form import (
    BlockForm,
    Design,
    Setting,
    check_limits,
    direction,
    nearest_weight,
    number,
    wire,
)
from pneuopt.quantities.unit_algebra import difference_unit
from pneuopt.quantities.units import write_value

MINUTE = 60.0  # [s], the unit of times of PIDE
USUAL_UPDATE = 0.01  # [s], where the update times of PID begin that are usual
LOGIX_PID = "Rockwell PID"


def _can_be_enhanced(d: Design) -> bool:
    """Whether PIDE runs the design: its velocity form rests at the centre by its integral only."""
    return d.integrates and not d.is_added_to


def _can_be_plain(d: Design) -> bool:
    """Whether PID runs it as well as PIDE: its proportional term sees the error."""
    return nearest_weight(d.b) == 1 or not _can_be_enhanced(d)


def _weights(d: Design) -> tuple[float, float]:
    return (1.0 if _can_be_plain(d) else 0.0), nearest_weight(d.c)


def _settings(d: Design) -> list[Setting]:
    check_limits(d, LOGIX_PID)
    plain = _plain_settings(d) if _can_be_plain(d) else []
    return plain + (_enhanced_settings(d) if _can_be_enhanced(d) else [])


def _scaled_gains(d: Design) -> tuple[float, float, float]:
    scale = direction(d, LOGIX_PID) * d.pv_span / d.span
    return d.gains.Kp * scale, d.gains.Ki * scale, d.gains.Kd * scale


def _plain_settings(d: Design) -> list[Setting]:
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
        ("BIAS", number(d.rest), f"% {wire(d.centre, d)}, {d.zero}{d.sum_words}"),
        ("NOBC", "1", "else a change from manual to auto without an integral moves BIAS"),
        ("DB", "0", "no dead band"),
        ("SO", number(d.rest), f"% the output in software manual: {d.zero}"),
        ("SWM", "1", "begin in software manual; 0 is automatic"),
        ("UPD", number(d.sample_time), f"[s] sample time, the period of its periodic task{short}"),
    ]
    return [Setting(f"PID .{name}", value, formula) for name, value, formula in rows]


def _enhanced_settings(d: Design) -> list[Setting]:
    Kp, Ki, Kd = _scaled_gains(d)
    inverse = direction(d, LOGIX_PID) < 0
    unit, on = d.measured_unit, d.command_unit
    b, c = _weights(d)
    rows = [
        ("DependIndepend", "false", "independent gains"),
        (
            "PGain",
            number(Kp),
            f"Kp S/R, S the span of PV, here {write_value(d.pv_span, difference_unit(unit))}, R that of CV",
        ),
        ("IGain", number(Ki * MINUTE), "[1/min] 60 Ki S/R"),
        ("DGain", number(Kd / MINUTE), "[min] Kd/60 S/R; 0 is no derivative"),
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


def _states(d: Design) -> list[str]:
    rest = f"{number(d.rest)} %, {wire(d.centre, d)} on the wire"
    lines = []
    if _can_be_plain(d):
        lines += [
            f"PID, at error 0 from rest: BIAS, {rest}; in software manual SO, the same.",
            "PID, at a fault of the sensor: it goes on with the last value. Set SWM by the fault bit of your input.",
        ]
    if _can_be_enhanced(d):
        lines += [
            f"PIDE, at error 0 from rest: where it was in manual, CVProg, {rest}.",
            "PIDE, at a fault of the sensor: wire the fault bit of your input to PVFault; it goes to manual, CVProg.",
        ]
    else:
        alone = "without an integral its velocity form does not come back to the centre once a limit has cut it off"
        why = "its FF adds changes alone, of which a limit cuts off some" if d.integrates else alone
        lines += [f"PIDE is not for this design: {why}."]
    return [
        *lines,
        f"While the controller stops or is at fault: what the output module is set to; it must be {wire(d.centre, d)}.",
    ]


def _sum_input(d: Design) -> str:
    return f"BIAS = {number(d.rest)} + {number(100.0 / d.span)} %/({d.command_unit}) x sum, every scan"


ROCKWELL_FORM = BlockForm(
    "Rockwell PID and PIDE (Logix 5000)",
    "independent CV = KP E + KI int E dt + KD dE/dt + BIAS, E and CV in % of their spans; PIDE adds the changes of it",
    (
        "Logix5000 General Instructions, 1756-RM003N-EN-P, 10/2011, pages 512, 519: members, forms with BIAS, units",
        "Studio 5000 Logix Designer 37, 'PID Structure': CA = 0 is SP - PV; DOE, PE, NDF, NOBC",
        "'Feedforward or Output Biasing (PID)': a bias is for use without integral.",
        "'Anti-reset Windup and Bumpless Transfer' (PID): with KI = 0 a change from manual to auto moves BIAS.",
        "There, too: its integral is frozen while CV is at a limit, whichever way the error points: taken as clamping.",
        "Process Control Instructions, 1756-RM006K-EN-P, 11/2018, pages 69 to 81: limits, FF, velocity form, units",
        "the same, pages 259 and 500: faults, TimingMode; Studio 5000 37, 'Execution': CVInitValue, ManualAfterInit",
    ),
    _settings,
    _states,
    "PID: SWM = 1; PIDE: ProgManualReq = true",
    _sum_input,
    _weights,
    has_filter=False,
)
"""PID, and PIDE where it can run the design."""
