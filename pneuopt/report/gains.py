"""`report_forms`: a controller's gains in every form that controllers take, and its settings that are not tuned."""

import math
from collections.abc import Sequence
from pathlib import Path

from pneuopt.control.controller import Controller
from pneuopt.control.pid import ParallelForm, to_series, to_standard
from pneuopt.control.reference import Reference
from pneuopt.export.blocks import describe_refusal
from pneuopt.export.makers import BLOCK_FORMS, Block
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import TIED, Line, Report, Table, text_columns
from pneuopt.quantities.unit_algebra import unit_ratio
from pneuopt.quantities.units import write_value

GAIN_DIGITS = 6
"""Significant digits of converted gains: fewer change the loop that was certified, more are of no controller."""
LAW_TEXTS = {
    "parallel": "Kp~(b~r~−~y) + Ki~e/s + Kd~s/(Tf~s~+~1)~(c~r~−~y)",
    "standard (ISA)": "Kp~((b~r~−~y) + e/(Ti~s) + Td~s/(1~+~s~Td/N)~(c~r~−~y))",
    "series": "K (1~+~1/(Ti~s)) (1~+~Td~s/(Tf~s~+~1))~e",
}
"""The forms and their laws; no line ends at a tilde."""
EXPORTS = {
    "st": "a PLC (IEC 61131-3 structured text)",
    "c": "a microcontroller (C99, with a test)",
    "python": "a Python program",
    **{block.value: f"the PID block of {BLOCK_FORMS[block].maker}" for block in Block},
    "fmu": "a simulation tool (the plant as FMU)",
}
"""The forms of `pneuopt export`, and who takes them."""
N_NOTE = "N of the standard form is ISA's ratio Td/Tf. Simulink's N is the filter's pole in rad/s, 1/Tf."


def report_forms(controller: Controller, parameters: ParameterSet) -> Report:
    """The gains in the parallel, the standard and the series form; why one of them has none.

    Parameters
    ----------
    controller : Controller
    parameters : ParameterSet
        Every parameter of the controller.
    """
    parallel = controller.parallel_form(parameters)
    unit = unit_ratio(controller.command.unit, controller.pid_signal.unit)
    units = {"Kp": unit, "K": unit, "Ki": unit_ratio(unit, "s"), "Kd": unit_ratio(f"({unit})*s", "1"), "N": "1"}
    rows, refused = [], []
    for (name, law), convert in zip(LAW_TEXTS.items(), (_as_given, to_standard, to_series), strict=True):
        try:
            gains = vars(convert(parallel))
        except InputError as error:
            refused.append(Line(str(error)))
            continue
        if gains.get("Td") == 0:
            gains = {**gains, "N": math.nan} if "N" in gains else gains  # of no derivative there is no ratio
        rows.append((name, *(_cell(n, value, units.get(n, "s")) for n, value in gains.items()), law.replace("~", TIED)))
    return Report((Table(text_columns("form", "", "", "", "", "law"), tuple(rows)), *refused, Line(N_NOTE)))


def report_exports(
    controller: Controller,
    parameters: ParameterSet,
    references: Sequence[Reference],
    centre: float,
    fit: Path,
    tuned: Path,
) -> Report:
    """The commands that take a design to a controller, and the makers whose block cannot hold it.

    Parameters
    ----------
    controller : Controller
    parameters : ParameterSet
        Of the design.
    references : sequence of Reference
    centre : float
        On the wire while the command is zero [the command's unit].
    fit, tuned : Path
        The files of the plant and of the design.
    """
    if controller.pid.sample_time is None:
        return Report((Line("A continuous controller has no export: give it a sample_time, and tune it so."),))
    refused = [block for block in Block if describe_refusal(controller, parameters, block, references, centre)]
    taken = {form: what for form, what in EXPORTS.items() if form not in {block.value for block in refused}}
    rows = tuple((what, f"pneuopt export {fit} {tuned} --to {form}") for form, what in taken.items())
    makers = ", ".join(BLOCK_FORMS[block].maker for block in refused)
    told = f"The PID block of these makers cannot hold this design: {makers}. The structured text holds it whole."
    return Report((Table(text_columns("what it takes", "command"), rows), *([Line(told)] if refused else [])))


def report_settings(controller: Controller, parameters: ParameterSet) -> Report:
    """What else a controller is set to, the numbers that are not tuned, and how it computes."""
    full = controller.complete(parameters)
    rows = tuple((n, write_value(full.value(n), full[n].unit)) for n in controller.parameters if not full[n].free)
    pid, lines = controller.pid, []
    if pid.sample_time is None:
        lines.append("a continuous controller")
    else:
        late = f", its command acts {pid.delay} sample late" if pid.delay else ""
        lines.append(f"computes every {write_value(pid.sample_time, 's')} by backward Euler{late}")
    return Report((Line("; ".join(lines)), *([Table(text_columns("setting", "value"), rows)] if rows else [])))


def _cell(name: str, value: float, unit: str) -> str:
    return f"{name} -" if math.isnan(value) else f"{name} {write_value(value, unit, GAIN_DIGITS)}"


def _as_given(gains: ParallelForm) -> ParallelForm:
    return gains
