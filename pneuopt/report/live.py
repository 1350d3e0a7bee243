"""`live_script`: a closed loop in JavaScript with sliders; a page is whole without it.

`RestFinder` prepares how the script finds the rest, or steady motion, that a slider changes.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Reference, Step, disturbance_input
from pneuopt.evaluation.evaluate import relevant_units
from pneuopt.evaluation.metric import Band, band_share
from pneuopt.evaluation.tolerances import EDGE_ROUNDING, MIN_SETTLED_PERIODS, TAIL_SHARE
from pneuopt.export.languages import write_loop_javascript
from pneuopt.models.load import GRAVITY
from pneuopt.plotting.canvas import PLOT_UNITS
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.report.tolerances import (
    INCLINE,
    INDEPENDENT,
    LOG_RANGE,
    RESIDUAL,
    SHRINKAGES,
    SLIDER_RANGE,
    UNCHANGED_LEAST,
    UNCHANGED_RATIO,
)

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class RestFinder:
    """The residuals of a loop that vanish where it rests, or moves steadily, before a reference.

    A page solves them by Newton's method; `is_singular` says when it could not.
    """

    loop: ClosedLoop
    reference: Step
    parameters: ParameterSet  # every parameter of the loop, as designed

    @cached_property
    def start(self) -> Array:
        """The loop's state as designed, shape (n_states,); a `ConvergenceError` or `InputError` where it has none."""
        return self.rest(self.parameters)

    def rest(self, parameters: ParameterSet) -> Array:
        """The loop's state with other parameters, shape (n_states,)."""
        return self.loop.initial(parameters, reference=self.reference.initial, start=self.reference.start)

    def moved_states(self, values: Sequence[tuple[str, float]]) -> set[int]:
        """Places of the states that differ with any of these values, a name and a value each; errors as `start`."""
        moved: set[int] = set()
        for name, value in values:
            found = self.rest(self.parameters.with_values({name: value}))
            moved |= set(np.flatnonzero(~np.isclose(found, self.start, UNCHANGED_RATIO, UNCHANGED_LEAST)).tolist())
        return moved

    def is_singular(self, unknown: Sequence[int]) -> bool:
        """Whether the residuals that vanish at the design leave one of these states undetermined."""
        if not unknown:
            return False
        sizes = np.array([self.loop.states[k].nominal for k in unknown])
        slopes = np.column_stack([self._slope(k, 1e-6 * size) for k, size in zip(unknown, sizes, strict=True)])
        weights = np.abs(slopes).max(axis=1)
        slopes = slopes[weights > 0] / weights[weights > 0, None]
        singular = np.linalg.svd(slopes, compute_uv=False) if len(slopes) >= len(unknown) else np.zeros(1)
        return bool(singular[-1] <= INDEPENDENT * singular[0])

    def data(self, unknown: Sequence[int], places: Sequence[int]) -> dict[str, Any]:
        """What the page's `findRest` reads: the residuals and states, and the parameters that move the rest."""
        return {"rows": self._vanishing, "holds": self._holds, "unknown": list(unknown), "places": list(places)}

    @cached_property
    def _vanishing(self) -> list[int]:
        """Places of the residuals that are zero at the design: rates, then what a sample changes."""
        nominal = np.array([q.nominal for q in self.loop.states])
        found, count = self._residuals(self.start)[0], len(nominal)
        sizes = np.tile(nominal, len(found) // count)
        return np.flatnonzero(np.abs(found) <= RESIDUAL * sizes).tolist()

    @cached_property
    def _holds(self) -> bool:
        """Whether the measured signal is the reference there; a controller without an integral leaves an error."""
        return abs(self._residuals(self.start)[1]) <= RESIDUAL * self.loop.feedback.nominal

    def _residuals(self, x: Array) -> tuple[Array, float]:
        """Rates and what a sample changes, one after the other; the error of the measured signal."""
        loop = self.loop
        still = {n: 0.0 for n in (DITHER_AMPLITUDE, DITHER_OFFSET) if n in self.parameters}  # a rest is before dither
        p = loop.parameter_vector(self.parameters.with_values(still))
        u = [self.reference.initial, *([0.0] * (len(loop.inputs) - 1))]
        motion = loop.motion()
        rates, y = (found.full().ravel() for found in motion.system.ode(0, x, u, p))
        parts = [rates] if motion.update is None else [rates, motion.update(0, x, u, p).full().ravel() - x]
        place = [q.name for q in loop.outputs].index(loop.feedback.name)
        return np.concatenate(parts), float(y[place]) - self.reference.initial

    def _slope(self, k: int, h: float) -> Array:
        """Of the residuals that vanish, by a state [their units a nominal size]."""
        moved = self.start + h * (np.arange(len(self.start)) == k)
        now, then = (self._residuals(x) for x in (self.start, moved))
        own = (then[0] - now[0])[self._vanishing]
        return np.append(own, then[1] - now[1] if self._holds else 0.0) / h * self.loop.states[k].nominal


def is_refused(finder: RestFinder, name: str, value: float) -> bool:
    """Whether the loop cannot rest, or move steadily, with this value."""
    try:
        finder.moved_states([(name, value)])
    except (InputError, ConvergenceError):
        return True
    return False


LIVE_METRICS = ("SettlingTime", "Overshoot", "PeakControl")
"""Metrics that the script reads off a response."""
PLANT_SECTIONS = ("load", "supply", "friction")
"""Sections of a plant's parameters that have sliders."""
NOT_MOVED = ("pid.Tt", "pid.lower", "pid.upper", "pid.fault_samples", "pid.fault_output", "friction.smoothing")
"""Parameters without a slider: limits of hardware, what only a fault shows, and what makes a loop too stiff here."""
RANGES = {"supply.pressure": 1.5}
"""`SLIDER_RANGE` where hardware varies less: no shop's air has three times its pressure."""


def live_script(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    *,
    band: Band = 0.02,
    limits: Mapping[str, float] | None = None,
    certified: "pd.DataFrame | None" = None,
) -> str:
    """The script of a loop, which fills the page's element "live"; empty where the loop cannot move in a page.

    Where a parameter moves the rest, or steady motion, at which a response begins (a load's force, a supply's
    pressure), the script finds it anew; it has no slider where the script could not. A limit is watched only where the
    script's metrics agree with `certified`, a column a reference.
    """
    loop = add_disturbances(loop, references)
    steps = {k: r for k, r in enumerate(references) if isinstance(r, Step)}
    if not steps:
        return ""
    finders = [RestFinder(loop, r, parameters) for r in steps.values()]
    try:
        code = write_loop_javascript(loop)
        starts = [finder.start.tolist() for finder in finders]
    except (NotImplementedError, ConvergenceError, InputError):
        return ""
    units = relevant_units(loop)
    sliders, rests = _sliders(finders)
    places = {q.name: k for k, q in enumerate(loop.inputs)}
    data = {
        "values": loop.parameter_vector(parameters).tolist(),
        "sliders": sliders,
        "references": [
            _reference(r, places, loop.feedback.unit)
            | {"x0": x0, "rest": rest, "band": band_share(band, r), "certified": _figures(certified, k)}
            for (k, r), x0, rest in zip(steps.items(), starts, rests, strict=True)
        ],
        "limits": {n: limit for n, limit in (limits or {}).items() if n in LIVE_METRICS},
        "units": {n: units.get(n, "") for n in LIVE_METRICS},
        "rule": {"edge": 1 + EDGE_ROUNDING, "tail": TAIL_SHARE, "periods": MIN_SETTLED_PERIODS},
        "measured": [q.name for q in loop.outputs].index(loop.feedback.name),
        "labels": [f"{q.name} [{q.unit}]" for q in (loop.feedback, loop.outputs[-1])],
        "controller": list(loop.controller.tunable_sections),
    }
    rest, page = (resources.files(__package__).joinpath(n).read_text("utf-8") for n in ("live_rest.js", "live.js"))
    return f"{code}\nconst DATA = {to_script(data)};\n{rest}{page}"


def to_script(value: Any) -> str:
    """A value as JavaScript that no page can take for markup: ASCII without "<", infinities by their name."""
    return json.dumps(value, ensure_ascii=True).replace("<", "\\u003c")


def _figures(certified: "pd.DataFrame | None", column: int) -> dict[str, float]:
    """The metrics of a reference that the script reads, too; a settling time of NaN is none."""
    if certified is None or column >= len(certified.columns):
        return {}
    own = certified.iloc[:, column].astype(float).to_dict()
    return {n: own[n] for n in LIVE_METRICS if n in own and not math.isnan(own[n])}


def _reference(reference: Step, places: Mapping[str, int], unit: str) -> dict[str, Any]:
    """What the page's `simulateLoop` and `readMetrics` read of a reference; `places` are those of the inputs."""
    return {
        "at": reference.at,
        "initial": reference.initial,
        "final": reference.final,
        "inputs": [[places[disturbance_input(n)], value] for n, value in reference.disturbance.items()],
        "size": reference.nominal_size,
        "isStep": reference.changes,
        "horizon": reference.horizon,
        "label": f"{reference.label} {unit}",
    }


def _sliders(finders: Sequence[RestFinder]) -> tuple[list[dict[str, Any]], list[dict[str, Any] | None]]:
    """The sliders, and of each reference what its rest is found from; None of those of which no slider moves it."""
    loop, parameters = finders[0].loop, finders[0].parameters
    every = {n: s for n in loop.parameters if (s := _slider(finders, parameters, n))}
    ends = {n: [(n, s["low"]), (n, s["high"])] for n, s in every.items()}
    moved = [{n: finder.moved_states(pair) for n, pair in ends.items()} for finder in finders]
    unknown = [sorted({k for states in own.values() for k in states}) for own in moved]
    if any(finder.is_singular(states) for finder, states in zip(finders, unknown, strict=True)):
        every = {n: s for n, s in every.items() if not any(own[n] for own in moved)}
        return list(every.values()), [None] * len(finders)
    places = [[every[n]["place"] for n, states in own.items() if states] for own in moved]
    found = zip(finders, unknown, places, strict=True)
    return list(every.values()), [f.data(states, own) if states else None for f, states, own in found]


def _slider(finders: Sequence[RestFinder], parameters: ParameterSet, name: str) -> dict[str, Any] | None:
    """Of a parameter that may move; None where its ends cannot run."""
    loop = finders[0].loop
    sections = (*PLANT_SECTIONS, *loop.controller.tunable_sections)
    if name in NOT_MOVED or name.partition(".")[0] not in sections:
        return None
    p = parameters[name]
    low, high = (_runnable_end(finders, name, p.value, end) for end in _ends(parameters, name))
    if not low < high:
        return None
    is_log = low > 0 and high / low > LOG_RANGE
    place = list(loop.parameters).index(name)
    scale, unit = PLOT_UNITS.get(p.unit, (1.0, p.unit))  # a pressure in bar, as everywhere on the page
    return {"name": name, "place": place, "scale": scale, "unit": unit, "low": low, "high": high, "isLog": is_log}


def _runnable_end(finders: Sequence[RestFinder], name: str, value: float, end: float) -> float:
    """The end, or one nearer to the value where the loop cannot rest at it."""
    for _ in range(SHRINKAGES):
        if not any(is_refused(finder, name, end) for finder in finders):
            return end
        end = (value + end) / 2
    return value


def _ends(parameters: ParameterSet, name: str) -> tuple[float, float]:
    """From where to where a slider goes: the bounds of what is tuned, else around its value."""
    p = parameters[name]
    if p.free and math.isfinite(p.lower) and math.isfinite(p.upper):
        return p.lower, p.upper
    ends = sorted((p.value / (ratio := RANGES.get(name, SLIDER_RANGE)), p.value * ratio))
    if name == "load.force" and "load.mass" in parameters:
        reach = INCLINE * GRAVITY * parameters.value("load.mass")
        ends = [p.value - reach, p.value + reach]
    return max(ends[0], p.lower), min(ends[1], p.upper)
