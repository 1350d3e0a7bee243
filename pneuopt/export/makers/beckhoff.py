"""Beckhoff FB_CTRL_PID: its output is 0 whenever it does not control, so that the centre is added behind it."""

import math

from pneuopt.export.makers.block_form import (
    BEHIND_FACTOR,
    BEHIND_OFFSET,
    BlockForm,
    Design,
    Setting,
    direction,
    flag,
    nearest_weight,
    number,
    standard_times,
    wire,
)
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import write_value

TIME_GRAIN = 1e-3
"""What IEC 61131-3's TIME counts in on most controllers [s]: times of a block are rounded to it."""
OPEN_LIMIT = 1e38  # what the block is delivered with: no limit
FB_CTRL_PID = "Beckhoff FB_CTRL_PID"


def _time(seconds: float) -> str:
    """As IEC 61131-3 writes it; 0 switches a term off."""
    return f"T#{round(seconds / TIME_GRAIN)}ms" if math.isfinite(seconds) else "T#0ms"


def _settings(d: Design) -> list[Setting]:
    Ti, Td = standard_times(d, FB_CTRL_PID)
    direction(d, FB_CTRL_PID)  # typed in with their sign, which must be one
    shown = write_value(Ti, "s") if math.isfinite(Ti) else ""
    told = f"{FB_CTRL_PID} counts its times in whole milliseconds, and Ti = {shown} would be 0: no integral at all"
    require(math.isinf(Ti) or round(abs(Ti) / TIME_GRAIN) > 0, f"{told}; use --to st")
    low, high = (-OPEN_LIMIT, OPEN_LIMIT) if d.is_open else d.limits
    off = "T#0ms switches the integral off"
    behind = "open: the sum behind the block is limited" if d.is_open else f"about {d.zero}"
    return [
        Setting("fKp", number(d.gains.Kp), f"Kp [{d.command_unit} per {d.measured_unit}], with its sign"),
        Setting("tTn", _time(Ti), "Kp/Ki" if math.isfinite(Ti) else off),
        Setting("tTv", _time(Td), "Kd/Kp; T#0ms switches the derivative off"),
        Setting("tTd", _time(d.gains.Tf if d.differentiates else 0.0), "Tf"),
        Setting("fOutMinLimit", number(max(low, -OPEN_LIMIT)), f"[{d.command_unit}] {behind}"),
        Setting("fOutMaxLimit", number(min(high, OPEN_LIMIT)), f"[{d.command_unit}] {behind}"),
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


def _states(d: Design) -> list[str]:
    rest = wire(d.centre, d)
    return [
        f"At error 0 from rest: fOut = 0, {rest} on the wire.",
        f"Stopped (eCTRL_MODE_PASSIVE, eCTRL_MODE_RESET): fOut = 0, {rest}. In manual: fManSyncValue, the same.",
        "At a fault of the sensor: it goes on with the last value. Set eMode := eCTRL_MODE_PASSIVE by your terminal's "
        "WcState and status bits, and where bError is TRUE.",
        f"While the task stops: what the terminal's watchdog is set to (a default output value); it must be {rest}.",
    ]


BECKHOFF_FORM = BlockForm(
    "Beckhoff FB_CTRL_PID (TF4100 Controller Toolbox)",
    "G(s) = fKp (1 + 1/(tTn s) + tTv s/(1 + tTd s))",
    (
        "infosys.beckhoff.com/content/1033/tcplclibcontrollertoolbox/11282668683.html (FB_CTRL_PID): names, modes",
        "INFERRED: the pages draw the formula as a picture; this one is by the parameters' descriptions.",
        "INFERRED: that T#0ms switches a term off; that the output is 0 in the modes PASSIVE and RESET.",
        "Compare a step of the block with the design before you rely on it.",
        "The page draws the anti-reset windup (ARW) as a figure only: taken as clamping. TIME counts in ms.",
    ),
    _settings,
    _states,
    "eMode := eCTRL_MODE_MANUAL with fManSyncValue := 0.0",
    weights=lambda d: (nearest_weight(d.b), nearest_weight(d.c)),
    time_grain=TIME_GRAIN,
)
"""FB_CTRL_PID of the Controller Toolbox."""
