"""`write_report`, and the pages of loops: tuned, simulated, studied; and of results that have no page of their own.

`live_script`: a closed loop in JavaScript with sliders; a page is whole without it.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import resources
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Reference, Step, as_references, disturbance_input
from pneuopt.dynamics.runnable import HasSystem
from pneuopt.evaluation.certificate import Certificate, report_notes
from pneuopt.evaluation.evaluate import metric_cell, relevant_units, report_metrics
from pneuopt.evaluation.metric import Band, band_share
from pneuopt.evaluation.requirements import larger_is_better
from pneuopt.evaluation.tolerances import EDGE_ROUNDING, MIN_SETTLED_PERIODS, TAIL_SHARE
from pneuopt.export.languages import write_loop_javascript
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tracking import Tracking
from pneuopt.logs.experiment import Experiment
from pneuopt.models.load import GRAVITY
from pneuopt.plotting import plot_sensitivity, plot_tracking
from pneuopt.plotting.canvas import PLOT_UNITS
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.parameters import ParameterSet, as_tuple
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Shown
from pneuopt.report.fit_page import PageHead, fit_page
from pneuopt.report.page import (
    Page,
    Picture,
    Section,
    data_section,
    diagram_picture,
    log_hashes,
    loop_figures,
    loop_pictures,
    provenance_section,
    report_forms,
    report_settings,
    write_page,
)
from pneuopt.studies.sensitivity import Sensitivity
from pneuopt.tuning.result import TuningResult, report_active, report_gains, report_outcome, report_refusal
from pneuopt.tuning.validation import report_validation

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.plotting.canvas import Figure


LOGS = "an Experiment or several, as read_log(path) gives them"


_TITLES: dict[type, str] = {IdentificationResult: "Identification", TuningResult: "Tuning", Certificate: "Certificate"}


def write_report(
    result: Shown,
    path: str | Path,
    *,
    title: str = "",
    model: HasSystem | ClosedLoop | None = None,
    experiments: Experiment | Sequence[Experiment] = (),
    held_out: Experiment | Sequence[Experiment] = (),
    references: Reference | Sequence[Reference] = (),
    parameters: ParameterSet | None = None,
    band: Band = 0.02,
) -> None:
    """Write a result as one page of HTML that needs no network: verdict first, figures where they belong, hashes.

    The same result gives the same page, to the letter. A result that did not converge gets its page, too, which says
    so first. Results hold no models and no logs: what is to be drawn of these is given here. The page of a loop ends
    with sliders, which a script within it follows by simulating the loop; without scripts only they are missing.

    Parameters
    ----------
    result : Shown
        Whatever `identify`, `tune`, `certificate`, `bootstrap`, `track` or another verb returns.
    path : str or Path
    title : str
        By default the kind of the result.
    model : drive, System or ClosedLoop, optional
        Of a fit: draws its friction, and predicts held-out logs. Of a tuning or a certificate the loop: draws steps,
        the Bode plot and the diagram, and gives the gains in every form.
    experiments : Experiment or sequence of Experiment
        Of a fit: the logs that it was made from, in their order.
    held_out : Experiment or sequence of Experiment
        Logs that the fit has not seen.
    references : Reference or sequence of Reference
        Those of the loop.
    parameters : ParameterSet, optional
        Of a certificate: every parameter of its loop. Of a tuning: those before, to be drawn beside.
    band : float
        Half width of the settling band, a fraction of the step.

    Raises
    ------
    InputError
        If the result is no such object, a figure lacks what it is drawn from, or the file cannot be written; no file is
        left then.

    Examples
    --------
    >>> import tempfile
    >>> from pneuopt.quantities.report import Line, Report
    >>> class Found(Shown):
    ...     def summary(self):
    ...         return Report((Line("nothing is wrong"),))
    >>> place = Path(tempfile.mkdtemp()) / "found.html"
    >>> write_report(Found(), place)
    >>> "nothing is wrong" in place.read_text("utf-8")
    True
    """
    require(isinstance(result, Shown), f"a report is written of a result, got {type(result).__name__}")
    steps = as_references(references)
    logs, others = (
        as_tuple(n, given, Experiment, LOGS) for n, given in (("experiments", experiments), ("held_out", held_out))
    )
    require(not others or model is not None, "held-out logs are predicted with the model: give both")
    head = PageHead(title or _TITLES.get(type(result), type(result).__name__))
    if isinstance(result, IdentificationResult):
        page = fit_page(head, result, logs, model, held_out=others)
    elif isinstance(result, TuningResult):
        page = tuning_page(head, result, _view(model, steps, result.parameters, parameters, band))
    elif isinstance(result, Certificate):
        require(model is None or parameters is not None, "a certificate holds no gains: give parameters with the loop")
        page = simulation_page(head, result, _view(model, steps, parameters, None, band))
    else:
        pictures = (tracking_picture(result),) if isinstance(result, Tracking) else ()
        if isinstance(result, Sensitivity):
            alt = "For each figure the share of its variance that each parameter brings, with its 95 % interval."
            pictures = (Picture(partial(plot_sensitivity, result), alt, "Shares of the variance."),)
        page = summary_page(head, result.summary(), pictures, (), getattr(result, "provenance", {}))
    write_page(path, page)


MARGINS = {
    "MaxSensitivity": "Ms",
    "MaxComplementarySensitivity": "Mt",
    "PhaseMargin": "phase margin\n[deg]",
    "GainMargin": "gain margin\n[1]",
}
"""What a page shows of an operating point's linear loop, and how it is called there."""


DOUBTS = (Tone.DOUBTFUL, Tone.BAD)
"""Tones of a verdict on a dither that belongs beside the verdict on the design."""


@dataclass(frozen=True, eq=False)
class LoopView:
    """What figures, forms and the diagram of a loop are made from."""

    loop: ClosedLoop
    references: Sequence[Reference]
    parameters: ParameterSet  # every parameter of the loop
    before: ParameterSet | None = None  # with the gains before tuning
    band: Band = 0.02  # half width of the settling band, a fraction of the step

    def figures(self) -> dict[str, "Figure"]:
        """The steps and the Bode plot, see `loop_figures`."""
        return loop_figures(self.loop, self.references, self.parameters, self.before, band=self.band)

    def pictures(self) -> tuple[Picture, Picture]:
        """The steps and the Bode plot for a page."""
        return loop_pictures(self.figures, compared=self.before is not None)

    def script(self, limits: Mapping[str, float], certified: "pd.DataFrame | None") -> str:
        """What moves the page's last part, see `live_script`."""
        return live_script(
            self.loop, self.references, self.parameters, band=self.band, limits=limits, certified=certified
        )


def _view(
    model: object, steps: Sequence[Reference], parameters: ParameterSet | None, before: ParameterSet | None, band: Band
) -> LoopView | None:
    """What a loop's figures are drawn from; None without a loop."""
    if model is None or parameters is None:
        return None
    require(isinstance(model, ClosedLoop), f"the model of this result is a ClosedLoop, got {type(model).__name__}")
    assert isinstance(model, ClosedLoop)
    require(bool(steps), "a loop is drawn with its references: give both")
    earlier = None if before is None else model.complete(before)
    return LoopView(model, steps, model.complete(parameters), earlier, band)


def tuning_page(
    head: PageHead,
    result: TuningResult,
    view: LoopView | None = None,
    *,
    stands: str = "the given gains",
    was: "pd.DataFrame | None" = None,
    dither: Report | None = None,
    exports: Report | None = None,
) -> Page:
    """The page of a tuning: of a design, or of the gains that stand; of certified given ones `stands` is empty."""
    found, certificate, tried = result.status.converged, result.certificate, result.validation
    verdict = report_outcome(result, is_sought=bool(stands))
    if dither:
        verdict += Report(tuple(p for p in dither.parts[:1] if isinstance(p, Line) and p.tone in DOUBTS))
    steps, bode = view.pictures() if view is not None else (None, None)
    outcome = (
        Section("What was tried" if stands else "Figures", (report_refusal(result, stands),)),
        Section("The gains that stand" if stands else "The response", _some(steps)),
    )
    if found:
        beside = ("was", was) if result.on_rig is None else ("on rig", result.on_rig)
        metrics = report_metrics(result.certified, result.units, beside=beside, limits=result.limits)
        held = report_active(result.requirements, result.active, result.parameters)
        notes = report_notes(certificate.notes) if certificate is not None else Report()
        outcome = (
            Section("Gains", (report_gains(result.given, result.parameters),)),
            Section("Before and after", (metrics, held, notes, *_some(steps))),
        )
    sections = (
        *outcome,
        _form_section(view),
        Section("To the controller", (exports,) if exports else ()),
        _margin_section(certificate, bode),
        Section("Other plants", (report_validation(tried),) if tried is not None and found else ()),
        Section("Dither", (dither,) if dither else ()),
        _loop_section(view),
        provenance_section(result.provenance, head.hashes),
    )
    defects = tuple(f.sentence for f in certificate.findings) if certificate is not None else ()
    script = None if view is None else partial(view.script, result.limits, result.certified if found else None)
    return Page(head.title, verdict, sections, (*defects, *head.warnings), script)


def simulation_page(
    head: PageHead,
    found: Certificate,
    view: LoopView | None = None,
    limits: Mapping[str, float] | None = None,
    *,
    standing: Report | None = None,
) -> Page:
    """The page of a loop with the gains it has."""
    count, cases = len(found.findings), len(found.metrics.columns)
    word = f"{count} defect{'s' if count > 1 else ''}" if count else "no defect"
    lead = Line(f"simulated: {word} in {cases} case{'s' if cases > 1 else ''}", Tone.BAD if count else Tone.GOOD)
    broken = []
    for name, limit in (n for n in (limits or {}).items() if n[0] in found.metrics.index):  # by the worst case
        least = larger_is_better(name)
        nothing = -math.inf if least else math.inf  # a case without a figure keeps no limit
        row = found.metrics.T[name].astype(float).to_dict()
        values = {str(case): nothing if math.isnan(v) else v for case, v in row.items()}
        case = (min if least else max)(values, key=lambda c: values[c])
        if values[case] < limit if least else values[case] > limit:
            text = f"{name} {metric_cell(name, row[case])} breaks its limit of {limit:.4g} at {case}"
            broken.append(Line(text, Tone.BAD, 2))
    verdict = (standing or Report()) + Report((lead, *(Line(f.sentence, indent=2) for f in found.findings), *broken))
    steps, bode = view.pictures() if view is not None else (None, None)
    figures = report_metrics(found.metrics, found.units, title="simulated", limits=limits)
    sections = (
        Section("Metrics", (figures, report_notes(found.notes), *_some(steps))),
        _form_section(view),
        _margin_section(found, bode),
        _loop_section(view),
        provenance_section({}, head.hashes),
    )
    script = None if view is None else partial(view.script, limits or {}, found.metrics)
    return Page(head.title, verdict, sections, head.warnings, script)


def _form_section(view: LoopView | None) -> Section:
    parts = () if view is None else (report_forms(view.loop.controller, view.parameters),)
    return Section("Gains in every form", parts)


def _margin_section(found: Certificate | None, bode: Picture | None) -> Section:
    """The worst case of each operating point, and the Bode plot."""
    if found is None or found.margins.empty:
        return Section("Margins", _some(bode))
    rows = []
    for point, own in found.margins.groupby("point", sort=False):
        worst = own.fillna({"MaxSensitivity": math.inf}).sort_values("MaxSensitivity").iloc[-1]
        figures = (format_number(float(worst.get(n, math.nan)), 4) for n in MARGINS)
        rows.append((str(point), str(worst["case"]), *figures, "" if worst["stable"] else "unstable"))
    columns = *text_columns("operating point", "worst case"), *number_columns(*MARGINS.values()), *text_columns("")
    return Section("Margins", (Report((Table(columns, tuple(rows)),)), *_some(bode)))


def _loop_section(view: LoopView | None) -> Section:
    if view is None:
        return Section("The loop", ())
    return Section("The loop", (diagram_picture(view.loop), report_settings(view.loop.controller, view.parameters)))


def _some(picture: Picture | None) -> tuple[Picture, ...]:
    return () if picture is None else (picture,)


def study_page(
    head: PageHead,
    report: Report,
    draw: "Callable[[], Figure] | None",
    *,
    what: str,
    alt: str,
    design: tuple[ClosedLoop, ParameterSet] | None = None,
) -> Page:
    """The page of a study: its verdict, a map or a front, its tables, and the design that all cases share."""
    verdict, table = Report(report.parts[:1]), Report(report.parts[1:])
    pictures = () if draw is None else (Picture(draw, alt, alt),)
    settings = () if design is None else (report_settings(design[0].controller, design[1].fixed("*")),)
    sections = Section(what, (*pictures, table)), Section("The design", settings)
    return Page(head.title, verdict, (*sections, provenance_section({}, head.hashes)), head.warnings)


def summary_page(
    head: PageHead,
    found: Report,
    pictures: Sequence[Picture] = (),
    experiments: Sequence[Experiment] = (),
    provenance: Mapping[str, str] | None = None,
) -> Page:
    """The page of a summary, whose first line is the verdict."""
    first, *others = found.parts or (Line(""),)
    is_line = isinstance(first, Line)
    details = Report(tuple(others) if is_line else (first, *others))
    sections = (
        Section("Figures", tuple(pictures)),
        Section("Result", (details,)),
        *((data_section(experiments),) if experiments else ()),
        provenance_section(dict(provenance or {}), {**head.hashes, **log_hashes(experiments)}),
    )
    return Page(head.title, Report((first,) if is_line else ()), sections, head.warnings)


def tracking_picture(found: Tracking) -> Picture:
    """Of a drive's parameters over dated logs."""
    alt = "Estimates with their intervals over dates, the line through them and its band."
    return Picture(partial(plot_tracking, found), alt, "Estimates over time.")


def title_of(what: str, file: Path, logs: Sequence[Path], most: int = 3) -> str:
    """What a page is of: "Check of drive.toml with run_01.csv"; of many logs their number."""
    names = ", ".join(log.name for log in logs) if len(logs) <= most else f"{len(logs)} logs"
    return f"{what} of {file.name}" + (f" with {names}" if logs else "")


@dataclass(frozen=True, eq=False)
class RestFinder:
    """The residuals of a loop that vanish where it rests, or moves steadily, before a reference.

    A page solves them by Newton's method; `is_singular` says when it could not.
    """

    loop: ClosedLoop
    reference: Step
    parameters: ParameterSet  # every parameter of the loop, as designed
    # share of a state's nominal size, a second, that counts as zero: what a rest's own root searches leave is below
    residual: float = 1e-6
    # when two rests are one, as a share and in SI: below these a response cannot be told from the other
    unchanged: tuple[float, float] = (1e-9, 1e-12)
    # least share of the largest singular value of the residuals' slopes: below it a direction is undetermined
    independent: float = 1e-9

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
            moved |= set(np.flatnonzero(~np.isclose(found, self.start, *self.unchanged)).tolist())
        return moved

    def is_singular(self, unknown: Sequence[int]) -> bool:
        """Whether the residuals that vanish at the design leave one of these states undetermined."""
        if not unknown:
            return False
        sizes = np.array([self.loop.states[k].nominal for k in unknown])
        (rates, error), columns = self._residuals(self.start), []
        for k, size in zip(unknown, sizes, strict=True):  # differences of the residuals that vanish, a column a state
            moved, off = self._residuals(self.start + 1e-6 * size * (np.arange(len(self.start)) == k))
            change = np.append((moved - rates)[self._vanishing], off - error if self._holds else 0.0)
            columns.append(change / (1e-6 * size) * size)
        slopes = np.column_stack(columns)
        weights = np.abs(slopes).max(axis=1)
        slopes = slopes[weights > 0] / weights[weights > 0, None]
        singular = np.linalg.svd(slopes, compute_uv=False) if len(slopes) >= len(unknown) else np.zeros(1)
        return bool(singular[-1] <= self.independent * singular[0])

    def data(self, unknown: Sequence[int], places: Sequence[int]) -> dict[str, Any]:
        """What the page's `findRest` reads: the residuals and states, and the parameters that move the rest."""
        return {"rows": self._vanishing, "holds": self._holds, "unknown": list(unknown), "places": list(places)}

    @cached_property
    def _vanishing(self) -> list[int]:
        """Places of the residuals that are zero at the design: rates, then what a sample changes."""
        nominal = np.array([q.nominal for q in self.loop.states])
        found, count = self._residuals(self.start)[0], len(nominal)
        sizes = np.tile(nominal, len(found) // count)
        return np.flatnonzero(np.abs(found) <= self.residual * sizes).tolist()

    @cached_property
    def _holds(self) -> bool:
        """Whether the measured signal is the reference there; a controller without an integral leaves an error."""
        return abs(self._residuals(self.start)[1]) <= self.residual * self.loop.feedback.nominal

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
"""Ratio of a slider's ends to its value where hardware varies less: no shop's air has three times its pressure."""


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

    A limit is watched only where the script's metrics agree with `certified`, a column a reference.
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
    columns = [] if certified is None else [own.astype(float).to_dict() for _, own in certified.items()]
    # the metrics that the script reads, too; a settling time of NaN is none
    shown = [{n: own[n] for n in LIVE_METRICS if not math.isnan(own.get(n, math.nan))} for own in columns]
    data = {
        "values": loop.parameter_vector(parameters).tolist(),
        "sliders": sliders,
        "references": [
            _reference(r, places, loop.feedback.unit)
            | {"x0": x0, "rest": rest, "band": band_share(band, r), "certified": shown[k] if k < len(shown) else {}}
            for (k, r), x0, rest in zip(steps.items(), starts, rests, strict=True)
        ],
        "limits": {n: limit for n, limit in (limits or {}).items() if n in LIVE_METRICS},
        "units": {n: units.get(n, "") for n in LIVE_METRICS},
        "rule": {"edge": 1 + EDGE_ROUNDING, "tail": TAIL_SHARE, "periods": MIN_SETTLED_PERIODS},
        "measured": [q.name for q in loop.outputs].index(loop.feedback.name),
        "labels": [f"{q.name} [{q.unit}]" for q in (loop.feedback, loop.outputs[-1])],
        "controller": list(loop.controller.tunable_sections),
    }
    live, page = (resources.files(__package__).joinpath(n).read_text("utf-8") for n in ("live_rest.js", "live.js"))
    return f"{code}\nconst DATA = {to_script(data)};\n{live}{page}"


def to_script(value: Any) -> str:
    """A value as JavaScript that no page can take for markup: ASCII without "<", infinities by their name."""
    return json.dumps(value, ensure_ascii=True).replace("<", "\\u003c")


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


def _slider(
    finders: Sequence[RestFinder],
    parameters: ParameterSet,
    name: str,
    *,
    ratio: float = 3.0,  # of the ends to the value where no bounds say more: less hides what changes
    incline: float = 0.5,  # share of its weight that a load's force is moved by: an axis tilted by 30 degrees
    halvings: int = 4,  # of the way to an end where the loop cannot rest; beyond it is hardly a way
    log_ratio: float = 20.0,  # of the ends from which it is logarithmic: else most of its way is one value
) -> dict[str, Any] | None:
    """Of a parameter that may move, within its bounds if it is tuned; None where its ends cannot run."""
    loop = finders[0].loop
    sections = (*PLANT_SECTIONS, *loop.controller.tunable_sections)
    if name in NOT_MOVED or name.partition(".")[0] not in sections:
        return None
    p = parameters[name]
    low, high = sorted((p.value / (ratio := RANGES.get(name, ratio)), p.value * ratio))
    if name == "load.force" and "load.mass" in parameters:
        reach = incline * GRAVITY * parameters.value("load.mass")
        low, high = p.value - reach, p.value + reach
    low, high = max(low, p.lower), min(high, p.upper)
    if p.free and math.isfinite(p.lower) and math.isfinite(p.upper):
        low, high = p.lower, p.upper
    ends = []
    for end in (low, high):  # or one nearer to the value, where the loop cannot rest at it
        nearer = accumulate(range(halvings - 1), lambda last, _: (p.value + last) / 2, initial=end)
        ends.append(next((e for e in nearer if not any(is_refused(f, name, e) for f in finders)), p.value))
    low, high = ends
    if not low < high:
        return None
    is_log = low > 0 and high / low > log_ratio
    place = list(loop.parameters).index(name)
    scale, unit = PLOT_UNITS.get(p.unit, (1.0, p.unit))  # a pressure in bar, as everywhere on the page
    return {"name": name, "place": place, "scale": scale, "unit": unit, "low": low, "high": high, "isLog": is_log}
