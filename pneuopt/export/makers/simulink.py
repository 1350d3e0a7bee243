"""Simulink's Discrete PID Controller (2DOF): its output is 0 at rest, and a Bias block behind it adds the centre."""

import math

from pneuopt.export.makers.block_form import BEHIND_FACTOR, BEHIND_OFFSET, BlockForm, Design, Setting, number, wire


def _settings(d: Design) -> list[Setting]:
    Tf, (low, high) = d.gains.Tf, d.limits
    kind = {(True, True): "PID", (True, False): "PI"}.get((d.integrates, d.differentiates), "PD")
    begin = f"where it starts at rest, here y0 = {number(d.start)} {d.measured_unit}"
    derivative = [
        Setting("D", number(d.gains.Kd), "Kd"),
        Setting("c", number(d.c), "c"),
        *(
            _filter_settings(d, begin)
            if Tf
            else [
                Setting(
                    "Use filtered derivative",
                    "off",
                    "Tf = 0: no filter; its first sample is a kick where c r - y is not 0",
                )
            ]
        ),
    ]
    return [
        Setting("Controller", kind, "PD with D = 0 is P alone: the block has no P" if kind == "PD" else "its terms"),
        Setting("Form", "Parallel", ""),
        Setting("Time domain", "Discrete-time", ""),
        Setting("Sample time", number(d.sample_time), "[s]"),
        Setting("P", number(d.gains.Kp), f"Kp [{d.command_unit} per {d.measured_unit}], with its sign"),
        *([Setting("I", number(d.gains.Ki), "Ki")] if d.integrates else []),
        Setting("b", number(d.b), "b"),
        *(derivative if kind != "PI" else []),
        *(_integral_settings(d, begin) if d.integrates else []),
        *_limit_settings(low, high, d),
        Setting(
            BEHIND_OFFSET,
            number(d.centre),
            f"{d.command_unit}: a Bias block behind the output and its limits" if d.centre else f"{d.command_unit}",
        ),
        Setting(BEHIND_FACTOR, "1", f"{d.command_unit} {d.goes} for 1 {d.command_unit} of the output"),
    ]


def _filter_settings(d: Design, begin: str) -> list[Setting]:
    return [
        Setting("Use filtered derivative", "on", "as the design"),
        Setting("N", number(1 / d.gains.Tf), "1/Tf, a pole [rad/s], not ISA's ratio"),
        Setting("Filter method", "Backward Euler", "as the design is sampled"),
        Setting("Filter initial condition", number(d.gains.Kd * (d.c - 1) * d.start), f"D (c - 1) y0, {begin}"),
    ]


def _integral_settings(d: Design, begin: str) -> list[Setting]:
    return [
        Setting("Integrator method", "Backward Euler", "as the design is sampled"),
        Setting("Integrator initial condition", number(d.gains.Kp * (1 - d.b) * d.start), f"P (1 - b) y0, {begin}"),
    ]


def _limit_settings(low: float, high: float, d: Design) -> list[Setting]:
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


def _states(d: Design) -> list[str]:
    rest = wire(d.centre, d)
    return [
        f"At error 0 from rest: the output is 0, {rest} on the wire behind the Bias block.",
        "At a fault of the sensor: it goes on with the last value. A Switch behind the block takes 0 in its place, and "
        "External reset starts its states anew.",
        f"Before the first sample and after the stop of a target: the value of its output block; it must be {rest}.",
    ]


SIMULINK_FORM = BlockForm(
    "Simulink Discrete PID Controller (2DOF), form Parallel",
    "u = P (b r - y) + I Ts z/(z - 1) (r - y) + D N/(1 + N Ts z/(z - 1)) (c r - y)",
    (
        "mathworks.com/help/simulink/slref/discretepidcontroller2dof.html: formula, settings, PID, PI or PD",
        "Its back-calculation acts on the next sample where ours acts on this one: a difference of one sample.",
    ),
    _settings,
    _states,
    "a Manual Switch behind the block at 0",
    clamps=False,
)
"""The block with two degrees of freedom."""
