"""`pneuopt study`: a loop certified over a grid of parameters, or tuned along a Pareto front."""

import math
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.cli.shared import (
    GOOD,
    INTERRUPTED,
    NOT_GOOD,
    Outputs,
    Writers,
    band_of,
    figure_writers,
    finish,
    hashes,
    read_loop,
    warn_of,
)
from pneuopt.cli.show_loops import SMALLEST_IS_WORST, metric_units, show_cases, show_front
from pneuopt.cli.terminal import progress, screen
from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import (
    AT_LEAST,
    PERCENT,
    Requirement,
    SettlingTime,
    StepEnvelope,
    bound,
    bounded,
    most,
    name,
)
from pneuopt.files.loop import checked
from pneuopt.files.requirements import KEYS, bound_units
from pneuopt.files.study import Axis, Pareto, Study, read_axes, read_pareto, read_study
from pneuopt.files.tuning import Tuning
from pneuopt.plotting import plot_front, plot_map
from pneuopt.quantities.errors import InputError, check_known, require
from pneuopt.quantities.output import records, write_text
from pneuopt.quantities.units import write_value
from pneuopt.studies.sweep import INTERRUPTED as CUT_SHORT
from pneuopt.studies.sweep import grid, sweep
from pneuopt.tuning.pareto import pareto_front

if TYPE_CHECKING:
    import pandas as pd


def run_study(file: Path, outputs: Outputs, quiet: bool) -> int:
    """What a study.toml asks for, a grid or a front; returns the exit status."""
    study = read_study(file)
    outputs.check([file, study.drive, study.tuning])
    run = run_grid if study.pareto is None else run_front
    return run(study, outputs, quiet)


def run_grid(study: Study, outputs: Outputs, quiet: bool) -> int:
    """Certify a loop over a grid of parameters; returns the exit status."""
    file, count = study.path, len(study.axes)
    require(
        outputs.plot is None or count <= 2, f"{file}: --plot draws one or two axes, there are {count}; leave it out"
    )
    asked, parameters = read_loop(study.drive, study.tuning)
    warn_of(study.tuning, "tuning")
    axes, units = read_axes(study, parameters), metric_units(asked.loop)
    check_known("metric", study.show, units, f"{file}: [metrics] show")
    try:
        cases = grid(parameters, {axis.name: axis.points for axis in axes})
    except InputError as error:
        raise InputError(f"{file}: [axes] {error}") from None
    certify = partial(evaluate, asked.loop, asked.references, band=study.band or band_of(asked))
    with progress("certifying", quiet=quiet) as tell:
        table = sweep(certify, parameters, cases, progress=tell)
    verdict, status = _verdict(table, len(asked.references))
    screen().print(verdict, style="bold red" if status else "bold green", soft_wrap=True)
    seen = _worst_of_references(table, axes, study.show)
    written, metrics = {axis.name: axis.unit for axis in axes}, {name: units[name] for name in study.show}
    show_cases(screen(), seen, written, metrics)
    writers: Writers = {}
    if outputs.output is not None:
        text = _in_si(table, {n: parameters[n].unit for n in written}, asked.loop)
        writers[outputs.output] = partial(write_text, outputs.output, text)
    if outputs.plot is not None:
        writers |= figure_writers(outputs.plot, {"": plot_map(seen, written, metrics)})
    tables = {"verdict": verdict, "cases": records(table), "provenance": hashes(file, study.drive, study.tuning)}
    finish(outputs, writers, tables, None)
    return status


def run_front(study: Study, outputs: Outputs, quiet: bool) -> int:
    """Tune a loop along a front between two requirements; returns the exit status."""
    asked, parameters = read_loop(study.drive, study.tuning)
    warn_of(study.tuning, "tuning")
    said = read_pareto(study, bound_units(asked.loop))
    first, second, until = _between(study, said, asked)
    free = asked.parameters.free_names
    require(len(free) > 0, f"{study.tuning}: no gain is free; mark what to tune with free = true")
    with progress("finding the front's ends", quiet=quiet) as tell:
        front = pareto_front(
            asked.loop,
            asked.references,
            parameters,
            minimise=(first, second),
            subject_to=[q for q in asked.subject_to if name(q) != name(second)],
            scenarios=asked.scenarios(parameters),
            points=said.points,
            until=until,
            progress=tell,
        )
    front, known = _in_percent(front, first, second), metric_units(asked.loop)
    pair, gains = (
        {name(q): known[name(q)] for q in (first, second)},
        {n: parameters[n].unit for n in front if n in free},
    )
    verdict, status = _front_verdict(front, pair)
    screen().print(verdict, style="bold red" if status else "bold green", soft_wrap=True)
    show_front(screen(), front, pair, gains)
    writers: Writers = {}
    if outputs.output is not None:
        claimed = {f"claimed {n}": unit for n, unit in pair.items()}
        units = {**pair, **claimed, "limit": pair[name(second)], **gains, "solver_seconds": "s", "seconds": "s"}
        writers[outputs.output] = partial(write_text, outputs.output, _as_csv(front, units))
    if outputs.plot is not None:
        writers |= figure_writers(outputs.plot, {"": plot_front(front, pair)})
    tables = {"verdict": verdict, "designs": records(front), "units": {**pair, **gains}}
    finish(outputs, writers, tables | {"provenance": hashes(study.path, study.drive, study.tuning)}, None)
    return status


def _between(study: Study, said: Pareto, asked: Tuning) -> tuple[Requirement, Requirement, float | None]:
    """The two requirements, the second one bounded where the front begins, and its bound where the front ends."""
    where = f"{study.path}: [pareto]"
    given = {name(q): q for q in (*asked.minimise, *asked.subject_to)}
    first, second = (_requirement(key, given, asked, f"{where} between") for key in said.between)
    ends = {"lower": said.lower, "upper": said.upper}
    begin, end = ("lower", "upper") if isinstance(second, AT_LEAST) else ("upper", "lower")
    start, until = ends[begin], ends[end]
    loosest = second if start is None else checked(lambda: bounded(second, start), f"{where} {begin}")
    if until is not None:
        tightest = checked(lambda: bounded(second, until), f"{where} {end}")
        side, unit = "below" if end == "lower" else "above", bound_units(asked.loop)[said.between[1]]
        ends_at, begins_at = (write_value(bound(q) or math.inf, unit) for q in (tightest, loosest))
        told = f"{where} {end}, {ends_at}, is not {side} the {begins_at} that {study.tuning} allows under [limits]"
        require(most(tightest) < most(loosest), told)
    return first, loosest, until


def _requirement(key: str, given: Mapping[str, Requirement], asked: Tuning, where: str) -> Requirement:
    """As the tuning has it, its bound included; else a plain one."""
    kind: Any = KEYS[key]
    if kind.__name__ in given:
        return given[kind.__name__]
    require(kind is not StepEnvelope, f"{where}: the tuning says no bounds for step_envelope; add them under [limits]")
    plain: Requirement = SettlingTime(band_of(asked)) if kind is SettlingTime else kind()
    return plain


def _front_verdict(front: "pd.DataFrame", pair: Mapping[str, str]) -> tuple[str, int]:
    """How many designs are not certified, and the exit status."""
    interrupted = int((front["error"] == CUT_SHORT).sum())
    failed = int((front["error"] != "").sum()) - interrupted
    parts = [f"{count} {what}" for count, what in ((interrupted, "interrupted"), (failed, "not certified")) if count]
    status = INTERRUPTED if interrupted else NOT_GOOD if failed else GOOD
    one = " (one is best by both)" if len(front) == 1 and not parts else ""
    what = f"{len(front)} design{'s' if len(front) > 1 else ''} between {' and '.join(pair)}"
    return f"{what}: {', '.join(parts) or 'all certified'}{one}", status


def _in_percent(front: "pd.DataFrame", first: Requirement, second: Requirement) -> "pd.DataFrame":
    """The front with figures as the metrics are shown, overshoot in percent."""
    columns = [c for q in (first, second) if name(q) in PERCENT for c in (name(q), f"claimed {name(q)}")]
    columns += ["limit"] if name(second) in PERCENT else []
    return front.assign(**{c: 100 * front[c] for c in columns})


def _verdict(table: "pd.DataFrame", references: int) -> tuple[str, int]:
    """How a study went, and the exit status."""
    settling = table[[c for c in table if _metric_of(c) == "SettlingTime"]]
    good = table["error"] == ""
    counts = {
        "interrupted": int((table["error"] == CUT_SHORT).sum()),
        "failed": int((~good & (table["error"] != CUT_SHORT)).sum()),
        "never settle": int((good & settling.isna().any(axis=1)).sum()),
    }
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    status = INTERRUPTED if counts["interrupted"] else NOT_GOOD if parts else GOOD
    each = f", each the worst of {references} references" if references > 1 else ""
    return f"{len(table)} cases{each}: {', '.join(parts) or 'all settle'}", status


def _worst_of_references(table: "pd.DataFrame", axes: Sequence[Axis], metrics: Sequence[str]) -> "pd.DataFrame":
    """What is shown of a study: the axes in the units of the file, each metric at its worst."""
    seen = table[["error"]].copy()
    for axis in axes:
        seen[axis.name] = axis.shown(table[axis.name])
    for metric in metrics:
        own = table[[c for c in table if _metric_of(c) == metric]]
        worst = own.min if metric in SMALLEST_IS_WORST else own.max
        seen[metric] = worst(axis=1, skipna=False) if len(own.columns) else math.nan
    return seen


def _metric_of(column: Hashable) -> str:
    """What "Overshoot[0 to 0.2]" is, as it is called where there are several references."""
    return str(column).partition("[")[0]


def _in_si(table: "pd.DataFrame", axes: Mapping[str, str], loop: ClosedLoop) -> str:
    """As CSV, each column with its unit."""
    known = {**axes, **metric_units(loop), "PeakTime": "s", "OvershootFinal": "%", "Undershoot": "%", "seconds": "s"}
    known |= dict.fromkeys(("SettlingMin", "SettlingMax", "Peak", "SteadyStateValue"), loop.feedback.unit)
    return _as_csv(table, {str(c): known.get(_metric_of(c), "") for c in table})


def _as_csv(table: "pd.DataFrame", units: Mapping[str, str]) -> str:
    """As CSV, the units in the header."""
    header = {n: f"{n} [{unit}]" for n, unit in units.items() if unit}
    return str(table.rename(columns=header).to_csv(index=False, float_format="%.9g", lineterminator="\n"))
