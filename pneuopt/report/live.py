"""`live_script`: what moves in a page, a closed loop in JavaScript with sliders; a page is whole without it."""

import json
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.evaluation.report import relevant_units
from pneuopt.export.javascript import write_loop_javascript
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.unit_algebra import difference_unit

if TYPE_CHECKING:
    import pandas as pd

LIVE_METRICS = ("SettlingTime", "Overshoot", "PeakControl")
"""Metrics that the script reads off a response."""
PLANT_SECTIONS = ("load", "supply", "friction")
"""Sections of a plant's parameters that have sliders."""
NOT_MOVED = ("pid.Tt", "pid.lower", "pid.upper", "friction.smoothing")
"""Parameters without a slider: limits of hardware, and what makes a loop too stiff for a page."""
RANGE = 3.0
"""A slider goes from a third to three times its value where no bounds say more: less hides what changes."""
LOG_RANGE = 20.0
"""Ratio of a slider's ends from which it is logarithmic: else most of its way is one value."""


def live_script(
    loop: ClosedLoop,
    references: Sequence[Step],
    parameters: ParameterSet,
    *,
    band: float = 0.02,
    limits: Mapping[str, float] | None = None,
    certified: "pd.DataFrame | None" = None,
) -> str:
    """The script of a loop, which fills the page's element "live"; empty where the loop cannot move in a page.

    It begins each response at the rest that the design has: a parameter on which that depends, a load's force or a
    supply's pressure, has no slider.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Step
        Those that are steps from rest without a disturbance are offered.
    parameters : ParameterSet
        Every parameter of the loop.
    band : float
        Half width of the settling band, a fraction of the step.
    limits : mapping of str to float, optional
        Of `metric_limits`.
    certified : DataFrame, optional
        Metrics of the references, one a column, in their order; a limit is watched where the script agrees with them.
    """
    steps = [r for r in references if r.is_step and r.initial == 0 and not r.disturbance]
    if not steps:
        return ""
    try:
        code = write_loop_javascript(loop)
        starts = [loop.initial(parameters, reference=r.initial, start=r.start) for r in steps]
    except (NotImplementedError, ConvergenceError, InputError):
        return ""
    units = relevant_units(loop)
    data = {
        "values": loop.parameter_vector(parameters).tolist(),
        "sliders": [s for n in loop.parameters if (s := _slider(loop, steps, starts, parameters, n))],
        "references": [
            _reference(r, x0.tolist(), loop.feedback.unit) | {"certified": _figures(certified, references.index(r))}
            for r, x0 in zip(steps, starts, strict=True)
        ],
        "limits": {n: limit for n, limit in (limits or {}).items() if n in LIVE_METRICS},
        "units": {n: units.get(n, "") for n in LIVE_METRICS},
        "band": band,
        "measured": [q.name for q in loop.outputs].index(loop.feedback.name),
        "labels": [f"{q.name} [{q.unit}]" for q in (loop.feedback, loop.outputs[-1])],
        "controller": list(loop.tunable_sections),
    }
    own = resources.files(__package__).joinpath("live.js").read_text("utf-8")
    return f"{code}\nconst DATA = {to_script(data)};\n{own}"


def to_script(value: Any) -> str:
    """A value as JavaScript that no page can take for markup: ASCII without "<", infinities by their name."""
    return json.dumps(value, ensure_ascii=True).replace("<", "\\u003c")


def _figures(certified: "pd.DataFrame | None", column: int) -> dict[str, float]:
    """The metrics of a reference that the script reads, too; a settling time of NaN is none."""
    if certified is None or column >= len(certified.columns):
        return {}
    own = certified.iloc[:, column].astype(float).to_dict()
    return {n: own[n] for n in LIVE_METRICS if n in own and not math.isnan(own[n])}


def _reference(reference: Step, x0: list[float], unit: str) -> dict[str, Any]:
    ends = {"at": reference.at, "initial": reference.initial, "final": reference.final}
    label = f"{reference.initial:g} to {reference.final:g} {unit}"
    return {**ends, "horizon": reference.horizon, "x0": x0, "label": label}


def _slider(
    loop: ClosedLoop, references: Sequence[Step], starts: Sequence[Any], parameters: ParameterSet, name: str
) -> dict[str, Any] | None:
    """Of a parameter that may move; None where the rest depends on it, or where its ends cannot run."""
    sections = (*PLANT_SECTIONS, *loop.tunable_sections)
    if name in NOT_MOVED or name.partition(".")[0] not in sections:
        return None
    p = parameters[name]
    low, high = _ends(p)
    if not low < high:
        return None
    for value in (low, high):
        try:
            moved = parameters.with_values({name: value})
            begun = [loop.initial(moved, reference=r.initial, start=r.start) for r in references]
        except (InputError, ConvergenceError):
            return None
        if not all(np.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in zip(begun, starts, strict=True)):
            return None
    is_log = low > 0 and high / low > LOG_RANGE
    place = list(loop.parameters).index(name)
    return {"name": name, "place": place, "unit": difference_unit(p.unit), "low": low, "high": high, "isLog": is_log}


def _ends(p: Parameter) -> tuple[float, float]:
    """From where to where a slider goes: the bounds of what is tuned, else around its value."""
    if p.free and math.isfinite(p.lower) and math.isfinite(p.upper):
        return p.lower, p.upper
    ends = sorted((p.value / RANGE, p.value * RANGE))
    return max(ends[0], p.lower), min(ends[1], p.upper)
