"""Siemens PID_Compact: 0 % of its output is made the centre, as it gives 0 % whenever it does not control."""

import math

from pneuopt.export.makers.block_form import (
    BEHIND_FACTOR,
    BEHIND_OFFSET,
    BlockForm,
    Design,
    Setting,
    check_limits,
    direction,
    flag,
    number,
    standard_times,
    wire,
)

PID_COMPACT = "Siemens PID_Compact"


def _settings(d: Design) -> list[Setting]:
    check_limits(d, PID_COMPACT)
    Ti, Td = standard_times(d, PID_COMPACT)
    sign, percent = direction(d, PID_COMPACT), 100.0 / d.span
    low, high = d.limits
    b, c = _weights(d)
    off = "0.0 switches the integral off" if math.isinf(Ti) else "Kp/Ki [s]"
    pv = f"{d.reach}, or the range of your sensor"
    return [
        Setting("Retain.CtrlParams.Gain", number(abs(d.gains.Kp) * percent), f"Kp 100 %/({wire(d.span, d)})"),
        Setting("Retain.CtrlParams.Ti", number(Ti) if math.isfinite(Ti) else "0.0", off),
        Setting("Retain.CtrlParams.Td", number(Td), "Kd/Kp [s]; 0.0 switches the derivative off"),
        Setting("Retain.CtrlParams.TdFiltRatio", number(d.gains.Tf / Td if Td else 0.0), "a = Tf/Td"),
        Setting("Retain.CtrlParams.PWeighting", number(b), "b"),
        Setting("Retain.CtrlParams.DWeighting", number(c), "c"),
        Setting("Retain.CtrlParams.Cycle", number(d.sample_time), "sample time [s]"),
        Setting("CycleTime.Value", number(d.sample_time), "[s], period of the cyclic interrupt that calls the block"),
        Setting("CycleTime.EnEstimation", "FALSE", "so that the value above stays; StartEstimation FALSE, too"),
        Setting("CycleTime.EnMonitoring", "TRUE", "a cycle that comes late stops the block: 0 %, " + d.zero),
        Setting("Config.InvertControl", flag(sign < 0), "the sign of Kp; the gain itself is typed in positive"),
        Setting("Config.InputPerOn", "FALSE", f"Input, the {d.measured} in {d.measured_unit}, in place of Input_PER"),
        Setting("Config.InputUpperLimit", number(d.pv_high), f"[{d.measured_unit}] {pv}"),
        Setting("Config.InputLowerLimit", number(d.pv_low), f"[{d.measured_unit}] as delivered: 0.0 and 120.0"),
        Setting("Config.SetpointUpperLimit", number(d.pv_high), f"[{d.measured_unit}]"),
        Setting("Config.SetpointLowerLimit", number(d.pv_low), f"[{d.measured_unit}]"),
        Setting("Config.OutputUpperLimit", number(high * percent), f"% about {d.zero}"),
        Setting("Config.OutputLowerLimit", number(low * percent), f"% about {d.zero}; as delivered: 0.0"),
        Setting(
            "Disturbance", "0.0", f"% of precontrol; the offset stands behind the block, where it stays{d.sum_words}"
        ),
        Setting("ActivateRecoverMode", "FALSE", f"every error gives 0 %, {d.zero}, and stops the block"),
        Setting("SetSubstituteOutput", "TRUE", "if you let the block recover: the next value, not the last output"),
        Setting("SubstituteOutput", "0.0", f"% which is {d.zero}"),
        Setting("IntegralResetMode", "0", f"smooth: it begins with 0 %, {d.zero} (V2.2 and later)"),
        Setting("RunModeByStartup", "FALSE", f"after a restart of the CPU the block waits for you, at {d.zero}"),
        Setting(BEHIND_OFFSET, number(d.centre), f"{d.command_unit} {d.goes} at 0 %, in your program"),
        Setting(BEHIND_FACTOR, number(d.span / 100.0), f"{d.command_unit} for a percent of Output{_counts(d)}"),
    ]


def _states(d: Design) -> list[str]:
    rest = wire(d.centre, d)
    return [
        f"At error 0 from rest: Output = 0 %, {rest} on the wire.",
        f"Stopped (Inactive, Reset, after a restart): Output = 0 %, {rest}; what Disturbance adds would be gone then.",
        f"At an error (Input invalid or beyond its limits, a late cycle): Output = 0 %, {rest}; a rising edge at "
        "ModeActivate starts it again.",
        f"While the CPU stops: what the output module is set to; its substitute value must be {rest}.",
    ]


def _counts(d: Design) -> str:
    """The same in counts of an analogue output of 10 V, which has 27648 of them."""
    if d.command_unit != "V":
        return "; not Output_PER, which has no offset"
    per_volt = 2764.8
    counts = f"{number(d.centre * per_volt)} + {number(d.span / 100 * per_volt)} Output"
    return f"; at a 10 V output {counts} counts, not Output_PER"


def _weights(d: Design) -> tuple[float, float]:
    return min(max(d.b, 0.0), 1.0), min(max(d.c, 0.0), 1.0)


def _sum_input(d: Design) -> str:
    return (
        f"Disturbance = {number(100.0 / d.span)} %/({d.command_unit}) x sum (INFERRED: it is added before the limits)"
    )


SIEMENS_FORM = BlockForm(
    "Siemens PID_Compact (S7-1200, S7-1500), V2",
    "y = Gain ((b w - x) + 1/(Ti s) (w - x) + Td s/(a Td s + 1) (c w - x)) + Disturbance, w setpoint, x Input, y in %",
    (
        "S7-1200 Easy Book, A5E02486680-06, 04/2012, section 9.2.2: formula; 'PIDT1 controller with anti-windup'",
        "S7-1200, S7-1500 PID control, A5E35300227-AC, 03/2017, page 248: errors and stops give 0.0 to the actuator",
        "the same, pages 256 to 261: substitute output, limits, cycle, direction, Ti = 0.0 is off; what is delivered",
        "the same, 11/2019, 'IntegralResetMode V2 tag': 0 begins with the output 0.0, for Ti > 0.0 only",
        "'Output value limits V1': an output that shall not be 0 % there takes an offset in the user program.",
        "How it keeps its integral at bay at a limit is not published: taken as clamping.",
    ),
    _settings,
    _states,
    "Mode = 4 with ManualValue = 0.0",
    _sum_input,
    _weights,
)
"""PID_Compact as of V2."""
