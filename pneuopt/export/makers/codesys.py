"""CODESYS Util: PID_FIXCYCLE, and PD where there is no integral; their Y_OFFSET is the centre."""

import math

from pneuopt.export.makers.block_form import BlockForm, Design, Setting, direction, number, standard_times, wire

OPEN_END = 1e38  # an end of the output that is never reached, where the other end is a limit
UTIL_PID = "CODESYS Util.PID_FIXCYCLE"


def _settings(d: Design) -> list[Setting]:
    Ti, Td = standard_times(d, UTIL_PID)
    direction(d, UTIL_PID)  # typed in with their sign, which must be one
    name, unit = ("PID_FIXCYCLE" if d.integrates else "PD"), d.command_unit
    is_open = math.isinf(d.low) and math.isinf(d.high)
    low, high = (0.0, 0.0) if is_open else (max(d.low, -OPEN_END), min(d.high, OPEN_END))
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


def _states(d: Design) -> list[str]:
    rest = wire(d.centre, d)
    block = "Util.PID_FIXCYCLE" if d.integrates else "Util.PD, as there is no integral: TN = 0 has no meaning in PID"
    task = f"it must be called by a task of {number(d.sample_time)} s"
    return [
        f"The block is {block}; {task}.",
        *(["PD measures the time itself, in whole ms: its derivative is rough."] if _is_rough(d) else []),
        f"At error 0 from rest: Y = Y_OFFSET, {rest}. In manual Y_MANUAL, at RESET Y_OFFSET: the same.",
        "At a fault of the sensor: it goes on with the last value. Set MANUAL by your input's diagnosis"
        + (", and by OVERFLOW." if d.integrates else "."),
        f"While the PLC stops: what the output module is set to; it must be {rest}, not 0.",
    ]


def _is_rough(d: Design) -> bool:
    return d.differentiates and not d.integrates


def _sum_input(d: Design) -> str:
    return f"Y_OFFSET = {number(d.centre)} {d.command_unit} + sum, every cycle"


CODESYS_FORM = BlockForm(
    "CODESYS Util.PID_FIXCYCLE, Util.PD without an integral",
    "Y = KP (e + 1/TN int e dt + TV de/dt) + Y_OFFSET; PD: Y = KP (e + TV de/dt) + Y_OFFSET",
    (
        "content.helpme-codesys.com/en/libs/Util/Current/Controller/PID.html and PID_FIXCYCLE.html: names",
        "the same, PD.html: its formula; TV = 0 is a P controller; Y_MIN = Y_MAX = 0 is no limit; RESET gives Y_OFFSET",
        "INFERRED: the pages draw the formula as a picture; this one is by the parameters' descriptions.",
        "INFERRED: that TN = 0 is no setting of PID: the pages give it no meaning.",
        "Compare a step of the block with the design before you rely on it.",
        "Its derivative has no filter that can be set, its setpoint no weights; at a limit: taken as clamping.",
    ),
    _settings,
    _states,
    "MANUAL := TRUE",
    _sum_input,
    weights=lambda _: (1.0, 1.0),
    has_filter=False,
)
"""PID_FIXCYCLE and PD of the library Util."""
