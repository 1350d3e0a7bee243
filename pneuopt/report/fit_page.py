"""The pages of a fit, of a log that was refused, and of a prediction of logs that no fit has seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem, as_runnable
from pneuopt.dynamics.system import System
from pneuopt.identification.forecast import predict_logs
from pneuopt.identification.result import (
    IdentificationResult,
    Mark,
    join_names,
    report_agreement,
    report_band,
    report_estimates,
)
from pneuopt.logs.doctor import LogFinding
from pneuopt.logs.experiment import Experiment
from pneuopt.plotting import (
    has_friction_map,
    plot_correlation,
    plot_finding,
    plot_friction,
    plot_logs,
    plot_prediction,
    plot_residuals,
)
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.report import Line, Report, Table, Tone, number_columns, text_columns
from pneuopt.quantities.status import report_status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value
from pneuopt.report.page import Page, Picture, Section, data_section, log_hashes, provenance_section

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class PageHead:
    """What a page says beside its result."""

    title: str
    # of the files that the provenance does not name, "sha256[drive.toml]"
    hashes: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # what was said before or beside the result


def fit_page(
    head: PageHead,
    result: IdentificationResult,
    experiments: Sequence[Experiment] = (),
    model: HasSystem | ClosedLoop | None = None,
    *,
    held_out: Sequence[Experiment] = (),
    findings: Sequence[LogFinding] = (),
    trial: Report | None = None,
) -> Page:
    """The page of a fit: its logs are drawn, `held_out` ones predicted by the model; `trial` is of simulated logs."""
    system = None if model is None else as_runnable(model)
    marks = result.estimates["mark"]
    biased = [str(n) for n, mark in marks.items() if mark == Mark.BIAS_POSSIBLE]
    said = f"an error of the model may have moved {join_names(biased)}: the intervals are as wide as that"
    doubts = [said] if biased else []
    unknown = result.verdict.sentences if result.verdict else ()
    runs = list(result.trajectories.values())
    compared = (_comparison(runs, experiments, "fitted"),) if experiments and runs else ()
    friction: tuple[Picture, ...] = ()
    if isinstance(system, System) and compared and has_friction_map(system):
        alt = "Friction force over speed: points that the logs imply, the fitted curve through them and its 95 % band."
        caption = "Friction over speed: what the logs imply (points), the fitted curve and its 95 % band."
        friction = (Picture(partial(plot_friction, system, result, experiments), alt, caption),)
    evidence: list[Report | Picture] = []
    for finding in findings:
        place = f"{finding.log}: " if finding.log else ""
        evidence.append(Report((Line(f"{place}{finding.message}"),)))
        evidence += [_finding_picture(finding)] if finding.evidence is not None else []
    rows = result.fit.reset_index().to_dict(orient="records")
    counted = {(str(row["log"]), str(row["channel"])): float(row["noise"]) for row in rows}
    sections = (
        _estimate_section(result),
        Section("Agreement with the logs", (report_agreement(result.fit), *compared)),
        _held_out_section(result, system, held_out),
        Section("Friction", friction),
        Section("Residuals", (_residual_picture(runs, experiments),) if compared else ()),
        Section("Simulated and fitted again", () if trial is None else (trial,)),
        Section("Found in the logs", tuple(evidence)),
        _known_section(result),
        data_section((*experiments, *held_out), noise=counted),
        provenance_section(result.provenance, {**head.hashes, **log_hashes(held_out)}),
    )
    warnings = tuple(dict.fromkeys((*unknown, *doubts, *head.warnings)))
    return Page(head.title, report_status(result.status), sections, warnings)


def refusal_page(
    head: PageHead, reason: str, experiments: Sequence[Experiment], finding: LogFinding | None = None
) -> Page:
    """The page of logs that no fit takes: why, what shows it, and the logs as they were read."""
    pictures = []
    if finding is not None and finding.evidence is not None:
        pictures.append(_finding_picture(finding))
    if experiments:
        pictures.append(
            Picture(partial(plot_logs, experiments), f"Every channel of {_names(experiments)} over time.", "The logs.")
        )
    verdict = Report((Line("refused: nothing was identified", Tone.BAD), Line(reason, indent=2)))
    sections = (
        Section("What shows it", tuple(pictures)),
        data_section(experiments),
        provenance_section({}, {**log_hashes(experiments), **head.hashes}),
    )
    return Page(head.title, verdict, sections, head.warnings)


def prediction_page(
    head: PageHead, table: "pd.DataFrame", runs: Sequence[Trajectory], experiments: Sequence[Experiment]
) -> Page:
    """The page of logs that are predicted in open loop."""
    verdict = Line("the prediction diverges, or there is nothing to compare it with", Tone.BAD)
    if len(table) and table["nrmse"].notna().all():
        worst = table.reset_index().sort_values("nrmse").iloc[-1]
        place = f"{worst['channel']} of {worst['log']}"
        verdict = Line(f"predicted in open loop: NRMSE at most {100 * worst['nrmse']:.3g} %, {place}")
    sections = (
        Section(
            "Agreement with the logs",
            (report_agreement(table), report_band(table), _comparison(runs, experiments, "predicted")),
        ),
        Section("Residuals", (_residual_picture(runs, experiments),)),
        data_section(experiments),
        provenance_section({}, {**log_hashes(experiments), **head.hashes}),
    )
    return Page(head.title, Report((verdict,)), sections, head.warnings)


def _estimate_section(result: IdentificationResult) -> Section:
    parts: list[Report | Picture] = [report_estimates(result.estimates)]
    if result.window is not None:
        parts.append(Report((Line(str(result.window)),)))
    if int(result.estimates["stderr"].notna().sum()) > 1:
        alt = "A cell for each pair of estimates with their correlation, from -1 to 1."
        caption = "Correlation of the estimates; near 1 or -1 the logs tell little more than a combination of two."
        parts.append(Picture(partial(plot_correlation, result), alt, caption))
    return Section("Estimates", tuple(parts))


def _known_section(result: IdentificationResult) -> Section:
    """What the estimates stand on: the values that were given."""
    given = {n: q for n, q in result.parameters.items() if n not in result.estimates.index}
    rows = tuple((n, write_value(q.value, q.unit, 6), q.source) for n, q in given.items())
    lead = Line("not estimated: as the files state them, or by default")
    heads = *text_columns("parameter"), *number_columns("value"), *text_columns("source")
    return Section("Known values", (Report((lead, Table(heads, rows))),) if rows else ())


def _held_out_section(
    result: IdentificationResult, system: System | ClosedLoop | None, held_out: Sequence[Experiment]
) -> Section:
    if system is None or not held_out:
        return Section("Held-out runs", ())
    try:
        table, runs = predict_logs(system, held_out, result)
    except (ConvergenceError, InputError) as error:
        return Section("Held-out runs", (Report((Line(f"not predicted: {error}", Tone.BAD),)),))
    lead = Report((Line("logs that the fit has not seen, predicted from their first tenth, or 10 s, on"),))
    parts = (lead, report_agreement(table), report_band(table), _comparison(runs, held_out, "predicted"))
    return Section("Held-out runs", parts)


def _residual_picture(runs: Sequence[Trajectory], experiments: Sequence[Experiment]) -> Picture:
    alt = (
        "For each channel four plots: residuals over time, their autocorrelation, their correlation with the inputs, "
        "and their distribution beside the normal one."
    )
    caption = (
        "Residuals over time, their autocorrelation and correlation with the inputs (grey: what 95 % of white "
        "residuals stay in), and their distribution beside the normal one."
    )
    return Picture(partial(plot_residuals, list(runs), list(experiments)), alt, caption)


def _comparison(runs: Sequence[Trajectory], experiments: Sequence[Experiment], label: str) -> Picture:
    alt = f"Measured and {label} signals of {_names(experiments)} over time, and below each what remains between them."
    caption = f"Measured and {label}, and what remains between them."
    return Picture(partial(plot_prediction, list(runs), list(experiments), label=label), alt, caption)


def _finding_picture(finding: LogFinding) -> Picture:
    alt = f"The signals of {finding.log or 'the log'} that show it: {finding.message}"
    return Picture(partial(plot_finding, finding), alt, f"What shows it: {finding.message}.")


def _names(experiments: Sequence[Experiment]) -> str:
    return join_names([e.name or "log" for e in experiments])
