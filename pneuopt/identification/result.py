"""`IdentificationResult`: estimates with intervals and marks; `Verdict`: which parameters the logs identify, how well.

Below: their tables and words, the motion that a set of logs shows, what it lacks to identify a parameter
(`System.identification_hints`), and the run that would identify it.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

import numpy as np

from pneuopt.dynamics.hooks import IdentificationHints, Lack, LoggedMotion
from pneuopt.identification.tolerances import MOVING_SPEED_SHARE
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import TIED, Line, Report, Table, format_number, number_columns, text_columns
from pneuopt.quantities.results import NOT_SAVED, Result, Shown
from pneuopt.quantities.status import Status, report_status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import difference_unit, write_value

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class Verdict(Shown):
    """The identifiability of the free parameters from a set of logs, and the runs that would identify the others.

    Attributes
    ----------
    table : DataFrame
        A row a free parameter, an `IdentifiableRow`.
    indistinguishable : tuple of tuple of str
        Groups of parameters of which the logs identify only a combination.
    reasons : mapping of str to str
        By parameter: why the logs do not identify it, or only roughly, and which run would.
    unchanged : tuple of str
        Parameters that a fit left at their given values.
    unseen : tuple of str
        Parameters that act only together with others in all that the logs show: a fit holds them at their given values.
    identification_hints : IdentificationHints
        The model's: which runs would show or separate its parameters.
    """

    table: "pd.DataFrame"
    indistinguishable: tuple[tuple[str, ...], ...]
    reasons: Mapping[str, str]
    unchanged: tuple[str, ...] = ()
    identification_hints: IdentificationHints = field(default_factory=IdentificationHints)
    unseen: tuple[str, ...] = ()

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """The parameters that the logs do not identify."""
        return tuple(str(n) for n, identifiable in self.table["identifiable"].items() if not identifiable)

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each parameter or group that is not identified well; empty if all are."""
        by_reason: dict[tuple[bool, str], list[str]] = {}
        for name, reason in self.reasons.items():
            by_reason.setdefault((name in self.unidentifiable, reason), []).append(name)
        single = [
            f"the logs {'do not identify' if is_unknown else 'identify only roughly'} {join_names(names)}: {reason}"
            for (is_unknown, reason), names in by_reason.items()
        ]
        hints, inflation = self.identification_hints, self.table["inflation"]
        groups = []
        for group in self.indistinguishable:
            times = float(inflation[list(group)].max())
            known = f"each {times:.0f} times better known if the others are fixed"
            known = known if times < 1e5 else "nothing separates them"  # beyond it the figure is rounding
            groups.append(f"{join_names(group)} act only together ({known}): {remedy(hints, group)}")
        if not self.unchanged:
            return (*single, *groups)
        values = join_names([f"{n} ({self.table['value'][n]:.4g})" for n in self.unchanged])
        verb = "keep their given values" if len(self.unchanged) > 1 else "keeps its given value"
        return (*single, *groups, f"{values} {verb}, on which the other intervals do not rest")

    def to_dict(self) -> dict[str, Any]:
        """The verdict without its table, for a file."""
        return {
            "sentences": list(self.sentences),
            "unidentifiable": list(self.unidentifiable),
            "unchanged": list(self.unchanged),
            "indistinguishable": [list(group) for group in self.indistinguishable],
            "reasons": {str(n): reason for n, reason in self.reasons.items()},
        }

    def summary(self) -> Report:
        """Sentences on what the logs do not identify, and why."""
        return Report(tuple(map(Line, self.sentences or ("the logs identify every free parameter",))))


@dataclass(frozen=True)
class ChosenWindow:
    """The windows in which logs were fitted, each with a start state of its own, and why.

    Attributes
    ----------
    duration : float
        Of a window [s].
    shortest, longest : float
        Of the windows that were tried [s]; both the same where the user has given one.
    gap_share : float
        Share of the cost that the gaps carried in a fit of whole logs [1].
    """

    duration: float
    shortest: float
    longest: float
    gap_share: float

    def __str__(self) -> str:
        start = f"windows of {self.duration:.3g} s are fitted, each with a start of its own"
        if self.shortest == self.longest:
            return f"{start}, as given"
        why = f"over whole logs the gaps between segments carry {self.gap_share:.0%} of the cost"
        tried = f"windows of {self.shortest:.3g} to {self.longest:.3g} s"
        return f"{start}: {why}, and of {tried} these are the longest that predict unseen parts as well as any"


class TrailRow(NamedTuple):
    """A row of `IdentificationResult.trail`: one try of the search.

    Attributes
    ----------
    attempt : str
        The way to a fit, a row of the search's table.
    start : str
        Where it began.
    iterations : int
        Of the least squares.
    chi_square_ratio : float
        Squares of residuals and gaps over the number of samples, in noise variances; noise alone has 1.
    cpu_seconds : float
        CPU time of it [s].
    end : str
        "converged", or why it was left.
    """

    attempt: str
    start: str
    iterations: int
    chi_square_ratio: float
    cpu_seconds: float
    end: str


class EstimateRow(TypedDict):
    """A row of `IdentificationResult.estimates`.

    Attributes
    ----------
    value : float
        The estimate; NaN where it is unidentifiable [unit].
    ci_low, ci_high : float
        Ends of the 95 % interval, of noise and of the `bias` [unit].
    unit : str
        SI unit.
    mark : str
        How far the estimate can be trusted, a `Mark`.
    stderr : float
        Standard deviation [unit].
    dof : float
        Degrees of freedom of the standard deviation, for Student's t.
    bias : float
        How far errors of the model may have moved it: nine truths in ten are no farther; 0 where residuals show none
        [unit].
    lower, upper : float
        Bounds [unit].
    at_bound : bool
        Whether it is at a bound.
    source : str
        Source of the given value.
    note : str
        Why it has no interval.
    """

    value: float
    ci_low: float
    ci_high: float
    unit: str
    mark: str
    stderr: float
    dof: float
    bias: float
    lower: float
    upper: float
    at_bound: bool
    source: str
    note: str


class AgreementRow(TypedDict):
    """A row of `IdentificationResult.fit`, by log and channel.

    Attributes
    ----------
    rmse : float
        Root mean square of the residuals [unit].
    nrmse : float
        Root mean square over the channel's variation [1].
    fit_percent : float
        Share of the variation that is explained [%].
    samples : float
        Number that was compared.
    free_run_rmse, free_run_nrmse : float
        The same of a simulation from the log's start to its end.
    noise : float
        Standard deviation of the channel's noise [unit].
    unit : str
        SI unit of the channel.
    """

    rmse: float
    nrmse: float
    fit_percent: float
    samples: float
    free_run_rmse: float
    free_run_nrmse: float
    noise: float
    unit: str


class IdentifiableRow(TypedDict):
    """A row of `Verdict.table`.

    Attributes
    ----------
    value : float
        Value for which it holds [unit].
    stderr : float
        Standard deviation that the logs promise [unit].
    relative : float
        Standard deviation over the value [1].
    alone : float
        Standard deviation if all others were known [unit].
    inflation : float
        Ratio of the two [1].
    identifiable : bool
        Whether the logs identify it.
    """

    value: float
    stderr: float
    relative: float
    alone: float
    inflation: float
    identifiable: bool


@dataclass(frozen=True, eq=False, repr=False)
class IdentificationResult(Result):
    """The result of `identify`: estimates, intervals, fitted trajectories and status; printed, it is its `summary()`.

    Attributes
    ----------
    parameters : ParameterSet
        The system's, with the given values and the estimates; a `per_log` parameter keeps its given value here, and so
        does an unidentifiable one, unless the logs reject that value or identify it only together with another: then
        it has the value that belongs to the other estimates.
    estimates : DataFrame
        A row a free parameter ("name[log]" for one of a log), an `EstimateRow`. The value is NaN where the mark is
        "unidentifiable". No interval there, at a bound, without convergence, or with a status of `Code.MISFIT`. Where a
        linear interval would be wrong it is the profile likelihood's, infinite at an open end. An unidentifiable
        parameter may lie a factor of ten from where it is held: the other intervals allow for that.
    covariance : DataFrame
        Of the estimates, as wide as their intervals count the residuals (`stderr`); NaN for what has no interval.
    fit : DataFrame
        A row a log and channel, an `AgreementRow`; free_run_rmse and free_run_nrmse are of a simulation from the log's
        fitted start to its end, which gaps or windows do not help (NaN where it diverges).
    trajectories : mapping of str to Trajectory
        Fitted states and outputs of each log.
    status : Status
        How the fit ended, and the remedies.
    stats : mapping of str to float
        Figures of the search: iterations, cost, gaps, chi_square_ratio, variance_inflation; free_run_share and
        horizon_share, the largest error of a free run, and of runs over the motion's horizon where that is far off,
        over the motion of an output [1].
    provenance : mapping of str to str
        Versions, options, start, and the logs' sha256.
    verdict : Verdict
        What the logs do not identify, why, and which run would: ``print(result.verdict)``.
    window : ChosenWindow or None
        The windows in which the logs were fitted; None where they were fitted whole.
    trail : DataFrame or None
        What the search has tried, in its order, a row a try, a `TrailRow`; None for a fit from a given one.
    forecast_error : DataFrame or None
        A column an output, by the time since the start of a free run [s]: what the fit must expect of its forecasts
        beyond the uncertainty of parameters and start, noise included, root mean square [unit]. None of a fit that was
        cut off.
    """

    parameters: ParameterSet
    estimates: "pd.DataFrame"
    covariance: "pd.DataFrame"
    fit: "pd.DataFrame"
    trajectories: Mapping[str, Trajectory]
    status: Status
    stats: Mapping[str, float]
    provenance: Mapping[str, str]
    verdict: Verdict | None = None
    window: ChosenWindow | None = None
    trail: "pd.DataFrame | None" = field(default=None, metadata=NOT_SAVED)
    forecast_error: "pd.DataFrame | None" = None

    def summary(self) -> Report:
        """The end of the fit, estimates with intervals and marks, what is unidentifiable, agreement with the logs."""
        sentences = tuple(map(Line, self.verdict.sentences if self.verdict else ()))
        estimates = report_estimates(self.estimates)
        return report_status(self.status) + estimates + Report(sentences) + report_agreement(self.fit)


def report_trail(trail: "pd.DataFrame") -> Report:
    """What a search has tried."""
    rows = list[tuple[str, ...]]()
    for row in (TrailRow(*each) for each in trail.itertuples(index=False)):
        figures = f"{row.iterations}", f"{row.chi_square_ratio:.3g}", f"{row.cpu_seconds:.2f}"
        rows.append((row.attempt, *figures, row.end))
    columns = *text_columns("tried"), *number_columns("iterations", "squares a sample", "CPU [s]")
    return Report((Table((*columns, *text_columns("end")), tuple(rows)),))


def report_estimates(estimates: "pd.DataFrame") -> Report:
    """Value, interval and doubt of each free parameter."""
    rows = []
    for name, row in estimates.to_dict(orient="index").items():
        estimate, spread, low, high = (float(row[k]) for k in ("value", "stderr", "ci_low", "ci_high"))
        value = format_number(estimate, 4)
        if math.isfinite(low) and math.isinf(high):
            interval = f"above{TIED}{format_number(low, 4)}"
        elif math.isinf(low) and math.isfinite(high):
            interval = f"below{TIED}{format_number(high, 4)}"
        elif not math.isfinite(spread) or high - low > 1e3 * abs(estimate) > 0:
            interval = "not determined"
        else:
            value = _format_to_stderr(estimate, spread)
            interval = f"{_format_to_stderr(low, spread)}{TIED}to {_format_to_stderr(high, spread)}"
        value = "-" if row["mark"] == Mark.UNIDENTIFIABLE else value
        rows.append((str(name), value, interval, str(row["unit"]), _doubt(row)))
    words = ["unit", *["doubt"] * any(row[-1] for row in rows)]
    columns = *text_columns("parameter"), *number_columns("value", f"95{TIED}% interval"), *text_columns(*words)
    table = (Table(columns, tuple(row[: len(columns)] for row in rows)),) if rows else ()
    return Report(table)


def _doubt(row: Mapping[Any, Any]) -> str:
    """What a reader should know of an estimate beyond its interval; nothing of most."""
    if row["mark"] == Mark.UNIDENTIFIABLE or row["note"] == AT_BOUND_NOTE:
        return str(row["note"] or row["mark"])
    if row["mark"] != Mark.BIAS_POSSIBLE:
        return ""
    share = row["bias"] / abs(row["value"]) if row["value"] else math.inf
    return f"bias <={TIED}{format_number(100 * share, 2)}{TIED}%" if share < 1 else str(row["mark"])


def report_agreement(fit: "pd.DataFrame", most_rows: int = 12) -> Report:
    """Agreement of each log and channel; of more than so many the median and the worst."""
    if fit.empty:  # no channel was compared
        return Report()
    rows, flat = list[tuple[str, ...]](), fit.reset_index()
    if len(fit) > most_rows:
        for channel in flat["channel"].unique():
            own = flat[flat["channel"] == channel].sort_values("nrmse", na_position="first")
            worst, middle = own.iloc[-1], own[["nrmse", "rmse"]].median()
            figures = [format_number(100 * v, 4) for v in (middle["nrmse"], worst["nrmse"], worst["free_run_nrmse"])]
            rmse = format_number(middle["rmse"], 4)
            rows.append((str(channel), str(len(own)), *figures, str(worst["log"]), rmse, str(worst["unit"])))
        figures_heads = number_columns("logs", "NRMSE [%]: median", "worst", "free")
        rest = *text_columns("in log"), *number_columns("RMSE: median"), *text_columns("unit")
        return Report((Table((*text_columns("channel"), *figures_heads, *rest), tuple(rows)),))
    for row in flat.to_dict(orient="records"):
        shares = [format_number(100 * row[n], 4) for n in ("nrmse", "free_run_nrmse")]
        figures = [*shares, *(format_number(row[n], 4) for n in ("rmse", "free_run_rmse"))]
        rows.append((str(row["log"]), str(row["channel"]), *figures, str(row["unit"])))
    figures_heads = number_columns("NRMSE [%]", "free run", "RMSE", "free run")
    return Report((Table((*text_columns("log", "channel"), *figures_heads, *text_columns("unit")), tuple(rows)),))


def report_band(fit: "pd.DataFrame") -> Report:
    """How much of the forecast samples of each channel lies in the 95 % band of `validate`; nothing without one."""
    lines = list[Line]()
    for channel, own in fit.dropna(subset="inside").groupby(level="channel", sort=False):
        worst, share = own["inside"].droplevel("channel").idxmin(), own["inside"].mean()
        unit = difference_unit(str(own["unit"].iloc[0]))
        sizes = [write_value(float(np.sqrt(np.mean(own[n] ** 2))), unit, 3) for n in ("half_band", "forecast_rmse")]
        lead = f"{channel}: {share:.0%} of the forecast samples are inside the 95 % band"
        lead += f" ({own['inside'].min():.0%} in {worst})" if len(own) > 1 else ""
        lines.append(Line(f"{lead}, +-{sizes[0]} on average; the error is {sizes[1]}"))
    return Report(tuple(lines))


def join_names(names: Sequence[str]) -> str:
    """Names in a sentence: "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _format_to_stderr(value: float, spread: float) -> str:
    """The value with the digits that show two of its standard error."""
    if not 0 < spread < math.inf or value == 0 or not spread < abs(value):
        return format_number(value, 4)
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(spread)) + 2
    return f"{value:#.{min(digits, 12)}g}".rstrip(".")


AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE = "at its bound", "unidentifiable"


class Mark(StrEnum):
    """The trust in an estimate and its interval.

    Attributes
    ----------
    EXACT
        The residuals look like noise; the interval is that of white residuals.
    WIDENED
        The residuals exceed the noise, are correlated, or differ from log to log; the interval counts that.
    BIAS_POSSIBLE
        Errors of the model, or what a factor of ten in an unidentifiable parameter does, may have moved the estimate by
        more than 2 % (`EstimateRow.bias`); or it is at its bound, or the fit did not converge.
    UNIDENTIFIABLE
        The logs do not determine the parameter.
    """

    EXACT = "exact"
    WIDENED = "widened"
    BIAS_POSSIBLE = "bias possible"
    UNIDENTIFIABLE = "unidentifiable"


_VALUE_IN_WORDS = re.compile(r"<(?:([\d.]+) )?(\w+)>")


def summarise_motion(
    experiments: Sequence[Experiment], states: Mapping[str, Trajectory], values: ParameterSet, given: ParameterSet
) -> LoggedMotion | None:
    """The speeds and accelerations of all logs, of estimated states where none is logged; None where nothing moves."""
    sources = [e.trajectory if "speed" in e.trajectory else states.get(e.name) for e in experiments]
    speeds = [(s.t, s["speed"]) for s in sources if s is not None and "speed" in s]
    runs = [(t[np.isfinite(speed)], speed[np.isfinite(speed)]) for t, speed in speeds]
    v = np.concatenate([speed for _, speed in runs]) if runs else np.zeros(0)
    if not np.any(v):
        return None
    moving = v[np.abs(v) > MOVING_SPEED_SHARE * float(np.quantile(np.abs(v), 0.99))]
    low, high = np.quantile(np.abs(moving), [0.1, 0.9])
    strides = [(t, speed, max(1, len(t) // 200)) for t, speed in runs]
    rates = np.concatenate([np.diff(speed[::k]) / np.diff(t[::k]) for t, speed, k in strides])
    sides = [np.sign(speed[np.abs(speed) > MOVING_SPEED_SHARE * float(high)]) for _, speed in runs]
    return LoggedMotion(
        float(low),
        float(high),
        float(np.mean(moving > 0)),
        sum(int(np.count_nonzero(np.diff(side))) for side in sides),
        float(np.sqrt(np.mean(rates**2))),
        v,
        values,
        given,
    )


def missing_excitation(
    hints: IdentificationHints, name: str, free: Sequence[str], seen: LoggedMotion | None
) -> Lack | None:
    """The motion that the logs lack to identify a parameter, and the run to log; None if nothing known is lacking."""
    need = hints.needs.get(_base_name(name))
    if need is None or seen is None:
        return None
    return need.lack(seen) if find_partners(hints, name, free) or not need.confused_with else None


def find_partners(hints: IdentificationHints, name: str, free: Sequence[str]) -> tuple[str, ...]:
    """The free parameters with which one is confused where the logs lack the motion that it needs."""
    need, own = hints.needs.get(_base_name(name)), _base_name(name)
    return tuple(n for n in free if need is not None and own != _base_name(n) in need.confused_with)


def remedy(hints: IdentificationHints, names: Sequence[str]) -> str:
    """The run that would separate these parameters, in words."""
    bases = {_base_name(n) for n in names}
    for run in hints.runs:
        if bases & run.some and (len(bases) == 1 or bases & run.others):
            return _write_values(run.words, ParameterSet())
    return f"fix {'it' if len(bases) == 1 else 'one of them'}, or log a run that moves differently"


def with_values_in_words(hints: IdentificationHints, values: ParameterSet) -> IdentificationHints:
    """The hints with values in their runs' words: "<5 stribeck_velocity>" becomes five times that parameter's value."""
    runs = tuple(replace(run, words=_write_values(run.words, values)) for run in hints.runs)
    return replace(hints, runs=runs)


def _write_values(words: str, values: ParameterSet) -> str:
    """The words with values in place of "<5 stribeck_velocity>"; its name where there is no such parameter."""

    def write(found: re.Match[str]) -> str:
        name = next((n for n in values if n.rpartition(".")[2] == found[2]), None)
        factor = float(found[1] or 1)
        if name is not None:
            return write_value(factor * values.value(name), values[name].unit, 2)
        times = "" if factor == 1 else f"{factor:g} times "
        return f"{times}the {found[2].replace('_', ' ')}"

    return _VALUE_IN_WORDS.sub(write, words)


def _base_name(name: str) -> str:
    return name.partition("[")[0]
