"""`track`: estimates over dated logs of one drive, and whether they drift, with alarms that chance seldom raises.

The line through the estimates is that of a random-effects meta-regression: an estimate differs from it by its own
error, whose deviation its log states, and by a scatter from log to log, which all share. The scatter's variance is
Paule and Mandel's (J. Res. NBS 87(5), 1982): the one with which the weighted squares are as large as their degrees of
freedom. The test is Student's, and its deviation never less than what the logs' own errors give (Knapp, Hartung,
Statistics in Medicine 22, 2003, with the lower limit of Roever, Knapp, Friede, BMC Medical Research Methodology 15:99,
2015).

Whoever looks after each log would meet chance sooner or later. So each look has the same, smaller level (Pocock,
Biometrika 64(2), 1977), with which chance raises an alarm in the asked share of whole histories. It is found by drawing
histories: where errors are equally large the test's distribution depends on the dates alone, not on error or scatter.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem
from pneuopt.identification.identify import identify
from pneuopt.identification.misfit import t_quantile
from pneuopt.identification.problem import as_estimation_model, as_experiments, check_logs
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tolerances import CLEAR_DEVIATIONS, MIN_LOGS, MIN_RELATIVE_DIFFERENCE
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, check_names, require
from pneuopt.quantities.parameters import ParameterSet, as_tuple
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Result, Shown
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class Tracking(Shown):
    """The estimates of a drive's parameters log by log, and their drift.

    Attributes
    ----------
    table : DataFrame
        A row a parameter: value, that of the line at the last log, and the ends of its 95 % interval; unit;
        percent_a_week, the line's slope over its value at the first log, and its ends; p, of the last look; scatter,
        from log to log [unit]; alarm, the date of the first look at `look_level` or below (NaT: none); logs_80 and
        logs_90, after how many logs the drift asked for is seen with these probabilities (NaN: not within the horizon).
    history : DataFrame
        A row a parameter and date: value, stderr, ci_low, ci_high (95 %), p of the look after it; line, line_low,
        line_high: the last line and its band.
    look_level : float
        The p-value of a look at which an alarm is raised [1].
    level : float
        Share of histories without a drift that have an alarm [1], over all parameters.
    horizon : int
        Logs of a history for which this level holds.
    asked : float
        The drift of the power calculation [1/week].
    """

    table: "pd.DataFrame"
    history: "pd.DataFrame"
    look_level: float
    level: float
    horizon: int
    asked: float

    @property
    def drifting(self) -> tuple[str, ...]:
        """The parameters with an alarm."""
        return tuple(str(n) for n in self.table.index[self.table["alarm"].notna()])

    def summary(self) -> Report:
        """Which parameters drift, since when, and how fast; then a row a parameter."""
        calm = f"no parameter drifts: no look has p <= {self.look_level:.2g}"
        head = [Line(f"drift of {', '.join(self.drifting)}: identify and tune again", Tone.DOUBTFUL)]
        parts: list[Line | Table] = [*(head if self.drifting else [Line(calm, Tone.GOOD)])]
        rows = []
        for name, row in self.table.iterrows():
            share = f"{row['percent_a_week']:.2g}"
            low, high = f"{row['percent_a_week_low']:.2g}", f"{row['percent_a_week_high']:.2g}"
            if str(name) in self.drifting:
                seen = f"seen since {row['alarm']:%Y-%m-%d}"
                parts.append(Line(f"{name} changes by {share} % a week ({low} to {high}), {seen}", indent=2))
            value, ends = format_number(row["value"], 4), f"{row['ci_low']:.4g} to {row['ci_high']:.4g}"
            numbers = (format_number(float(row[n]), 2) for n in ("p", "scatter", "logs_90"))
            rows.append((str(name), value, ends, share, f"{low} to {high}", *numbers, str(row["unit"])))
        level = f"without a drift, {100 * self.level:.2g} % of histories of {self.horizon} logs have an alarm"
        parts.append(Line(level, indent=2))
        seen = f"logs until\n{100 * self.asked:.2g} % a week"
        heads = ("value", "95 % interval", "% a week", "95 % interval", "p", "scatter", f"{seen}\nseen in 90 %")
        columns = (*text_columns("parameter"), *number_columns(*heads), *text_columns("unit"))
        return Report((*parts, Table(columns, tuple(rows))))


def track(
    fits: "Sequence[IdentificationResult | pd.DataFrame]",
    dates: Sequence[str | date],
    *,
    parameters: Sequence[str] = (),
    level: float = 0.01,
    horizon: int = 52,
    drift: float = 0.01,
) -> Tracking:
    """Tell whether a drive's parameters drift, from fits of dated logs, each log fitted alone.

    Parameters
    ----------
    fits : sequence of IdentificationResult or DataFrame
        Or their `estimates` with the columns value, stderr, dof and unit. What has no interval does not count.
    dates : sequence of str, date or datetime
        When each log was taken, as "2026-03-12" or "2026-03-12T10:00"; in any order.
    parameters : sequence of str
        Which to track; by default all with intervals in at least four fits.
    level : float
        Probability that a drive without a drift has an alarm within the horizon, over all its parameters [1].
    horizon : int
        Logs up to which the drive is watched. More allow for more looks, and see a drift a little later.
    drift : float
        What the power calculation is for: relative change of a parameter by week [1].

    Returns
    -------
    Tracking

    Raises
    ------
    InputError
        If there are fewer than four dated fits, fits of one date, or a date or name is unknown.

    Examples
    --------
    >>> import pandas as pd
    >>> rows = [{"value": f, "stderr": 0.2, "dof": 90.0, "unit": "N"} for f in (30.1, 31.2, 31.8, 33.1, 33.9, 35.1)]
    >>> fits = [pd.DataFrame([row], index=["friction.coulomb"]) for row in rows]
    >>> track(fits, [f"2026-03-{day:02}" for day in (1, 6, 11, 16, 21, 26)], horizon=12).drifting
    ('friction.coulomb',)
    """
    import pandas as pd

    from pneuopt.quantities.frames import WideFrame

    require(len(fits) == len(dates), f"{len(fits)} fits have {len(dates)} dates; give one each")
    require(len(fits) >= MIN_LOGS, f"{len(fits)} logs show no drift; give {MIN_LOGS} at least")
    require(0 < level < 1, f"level = {level:g}: give a probability, such as 0.01")
    stamps = [_read_date(d) for d in dates]
    order = sorted(range(len(fits)), key=lambda k: stamps[k])
    stamps = [stamps[k] for k in order]
    frames = [f.estimates if isinstance(f, IdentificationResult) else f for f in (fits[k] for k in order)]
    wanted = as_tuple("parameters", parameters, str, 'names of parameters, as ["friction.coulomb"]')
    known = list(dict.fromkeys(str(n) for frame in frames for n in frame.index))
    check_names("parameter", wanted, known, "the fits")
    counts = {n: sum(np.isfinite(_estimate(frame, n)[1]) for frame in frames) for n in wanted or known}
    enough = [n for n, count in counts.items() if count >= MIN_LOGS]
    missing = [n for n in wanted if n not in enough]
    remedy = f"{MIN_LOGS} logs with an interval are needed; log longer runs, or free fewer parameters"
    require(not missing and bool(enough), f"{', '.join(missing or counts)} cannot be tracked: {remedy}")
    weeks = np.array([(s - stamps[0]) / timedelta(weeks=1) for s in stamps])
    require(weeks[MIN_LOGS - 2] > 0, f"the first {MIN_LOGS - 1} logs are of one moment, {stamps[0]}; give their dates")
    usual = float(np.median(np.diff(weeks))) or float(weeks[-1]) / (len(weeks) - 1)
    to_come = weeks[-1] + usual * np.arange(1, max(horizon - len(weeks), 0) + 1)
    planned = tuple(float(w) for w in (*weeks, *to_come))
    look = look_level(planned, level / len(enough))
    rows, histories = {}, {}
    for name in enough:
        rows[name], histories[name] = _track_one(name, frames, stamps, weeks, planned, look, drift)
    table = WideFrame(pd.DataFrame.from_dict(rows, orient="index").astype({"alarm": "datetime64[us]"}))
    history = WideFrame(pd.concat(histories, names=["parameter", "date"]))
    return Tracking(table, history, look, level, len(planned), drift)


@dataclass(frozen=True)
class DriftLine:
    """A weighted line through estimates."""

    mean: float  # at the weighted mean of the times [unit]
    slope: float  # [unit/time]
    centre: float  # weighted mean of the times
    mean_error: float  # standard error, independent of the slope's
    slope_error: float  # [unit/time]
    scatter: float  # standard deviation from log to log [unit]
    dof: int  # degrees of freedom of Student's t
    p: float  # probability of so steep a line without a drift, two-sided

    def at(self, times: Array, level: float = 0.95) -> tuple[Array, Array]:
        """The line at given times, and the half width of its confidence band there."""
        shift = np.asarray(times, dtype=float) - self.centre
        error = np.hypot(self.mean_error, self.slope_error * shift)
        return self.mean + self.slope * shift, float(student.ppf(0.5 + level / 2, self.dof)) * error


def fit_line(times: Array, values: Array, errors: Array) -> DriftLine:
    """Fit the line.

    Examples
    --------
    >>> line = fit_line([0, 1, 2, 3], [1.0, 2.1, 2.9, 4.0], [1e-3] * 4)  # errors far below the scatter: least squares
    >>> round(line.slope, 3), round(line.slope_error, 4), line.dof
    (0.98, 0.0424, 2)
    """
    x, y, s = (np.asarray(v, dtype=float) for v in (times, values, errors))
    dof = len(x) - 2

    def excess(variance: float) -> float:
        """Weighted squares of the residuals of a line over their degrees of freedom."""
        w = 1 / (s**2 + variance)
        dx, dy = x - np.average(x, weights=w), y - np.average(y, weights=w)
        slope = (w @ (dx * dy)) / (w @ dx**2)
        return float(w @ (dy - slope * dx) ** 2) - dof

    top = float(np.ptp(y)) ** 2 + 1e-300
    while excess(top) > 0:
        top *= 4
    variance = float(brentq(excess, 0.0, top)) if excess(0.0) > 0 else 0.0
    w = 1 / (s**2 + variance)
    centre, mean = float(np.average(x, weights=w)), float(np.average(y, weights=w))
    spread = float(w @ (x - centre) ** 2)
    slope, error = float(w @ ((x - centre) * y)) / spread, spread**-0.5
    p = 2 * float(student.sf(abs(slope) / error, dof))
    return DriftLine(mean, slope, centre, float(w.sum()) ** -0.5, error, variance**0.5, dof, p)


@lru_cache(maxsize=32)
def look_level(times: tuple[float, ...], level: float, histories: int = 40_000) -> float:
    """The p-value of a look that raises an alarm, so that a history of such logs has one by chance at `level`.

    That many are drawn, which give the level to a tenth.
    """
    return float(np.quantile(_p_values(times, 0.0, histories).min(axis=1), level))


def power(times: tuple[float, ...], drift: float, level: float, histories: int = 10_000) -> Array:
    """The probability (n,) that a drift is seen with each log or an earlier one, with looks at `level`.

    The drift is by time, in standard deviations of an estimate about its line: its error and the scatter together.
    """
    seen = np.minimum.accumulate(_p_values(times, drift, histories), axis=1) <= level
    return np.asarray(np.concatenate([np.zeros(MIN_LOGS - 1), seen.mean(axis=0)]))


def _p_values(times: tuple[float, ...], drift: float, count: int) -> Array:
    """The p-values of each look of drawn histories, shape (count, n - 3), by running sums."""
    x = np.asarray(times) - times[0]
    y = drift * x + np.random.default_rng(0).standard_normal((count, len(x)))
    n = np.arange(1, len(x) + 1)
    sx, sy = np.cumsum(x), np.cumsum(y, axis=1)
    xx = np.cumsum(x**2) - sx**2 / n
    xy, yy = np.cumsum(x * y, axis=1) - sx * sy / n, np.cumsum(y**2, axis=1) - sy**2 / n
    late = slice(MIN_LOGS - 1, None)
    slope = xy[:, late] / xx[late]
    left = np.maximum(yy[:, late] - slope * xy[:, late], 0) / (n[late] - 2)
    return np.asarray(2 * student.sf(np.abs(slope) / np.sqrt(left / xx[late]), n[late] - 2))


def _read_date(given: "str | date") -> datetime:
    """A moment, without its zone."""
    if isinstance(given, str):
        try:
            given = datetime.fromisoformat(given)
        except ValueError:
            raise InputError(f"{given!r} is no date; write it as 2026-03-12 or 2026-03-12T10:00") from None
    moment = given if isinstance(given, datetime) else datetime(given.year, given.month, given.day)
    return moment.replace(tzinfo=None)


def _estimate(frame: "pd.DataFrame", name: str) -> tuple[float, float]:
    """Value and deviation of a normal distribution with the same interval; NaN where there is none."""
    if name not in frame.index:
        return math.nan, math.nan
    value, stderr = (float(frame[column].to_dict()[name]) for column in ("value", "stderr"))
    dof = float(frame["dof"].to_dict()[name]) if "dof" in frame.columns else math.inf
    width = stderr * float(t_quantile(dof) / t_quantile(math.inf))
    return (value, width) if math.isfinite(width) and width > 0 else (math.nan, math.nan)


def _track_one(
    name: str,
    frames: "Sequence[pd.DataFrame]",
    stamps: Sequence[datetime],
    weeks: Array,
    planned: tuple[float, ...],
    look: float,
    asked: float,
) -> "tuple[dict[str, object], pd.DataFrame]":
    """A parameter's row and its history."""
    import pandas as pd

    found = np.array([_estimate(frame, name) for frame in frames])
    known = np.flatnonzero(np.isfinite(found[:, 1]))
    p, line = np.full(len(frames), np.nan), None
    for count in range(MIN_LOGS, len(known) + 1):
        k = known[:count]
        if np.ptp(weeks[k]) > 0:
            line = fit_line(weeks[k], *found[k].T)
            p[k[-1]] = line.p
    require(line is not None, f"{name}: its logs with an interval are of one moment; give their dates")
    assert line is not None  # for mypy
    alarms = np.flatnonzero(p <= look)
    (middle, half), half_width = line.at(weeks), t_quantile(math.inf) * found[:, 1]
    columns = {"value": found[:, 0], "stderr": found[:, 1], "ci_low": found[:, 0] - half_width}
    columns |= {"ci_high": found[:, 0] + half_width, "p": p}
    columns |= {"line": middle, "line_low": middle - half, "line_high": middle + half}
    row: dict[str, object] = {"value": middle[-1], "ci_low": middle[-1] - half[-1], "ci_high": middle[-1] + half[-1]}
    units = [str(f.loc[name, "unit"]) for f in frames if name in f.index and "unit" in f.columns]
    row["unit"], first = units[0] if units else "", abs(float(line.at(np.zeros(1))[0][0]))
    width = float(t_quantile(line.dof)) * line.slope_error
    for end, change in (("", 0.0), ("_low", -width), ("_high", width)):
        row[f"percent_a_week{end}"] = 100 * (line.slope + change) / first
    row |= {"p": line.p, "scatter": line.scatter}
    row["alarm"] = stamps[alarms[0]] if len(alarms) else pd.NaT
    error = math.hypot(line.scatter, float(np.sqrt(np.mean(found[known, 1] ** 2))))
    seen = power(planned, asked * first / error, look)
    for percent in (80, 90):
        is_seen = seen >= percent / 100
        row[f"logs_{percent}"] = float(np.argmax(is_seen) + 1) if is_seen[-1] else math.nan
    return row, pd.DataFrame(columns, index=pd.DatetimeIndex(list(stamps), name="date"))


@dataclass(frozen=True, eq=False, repr=False)
class LogComparison(Result):
    """The estimates of several logs, each fitted alone, and whether they agree; prints its `summary()`.

    Attributes
    ----------
    table : DataFrame
        A row a parameter and log: value, stderr, others (weighted mean of the other logs' values), deviation (of the
        one from the other, in standard deviations of the difference), unit. NaN where the parameter is unidentifiable
        from one log alone.
    agree : bool
        Whether no parameter is 4 standard deviations and 2 % apart; also where nothing could be compared.
    reason, fits
        As of a `ModelSelection`; the fits are of each log alone.
    """

    table: "pd.DataFrame"
    agree: bool
    reason: str
    fits: Mapping[str, IdentificationResult]

    def summary(self) -> Report:
        """Whether the logs agree, and each log's estimates."""
        rows = []
        for row in self.table.reset_index().to_dict(orient="records"):
            figures = format_number(row["value"], 5), format_number(row["stderr"], 2), format_number(row["others"], 5)
            name, log = str(row["parameter"]), str(row["log"])
            rows.append((name, log, *figures, format_number(row["deviation"], 3), str(row["unit"])))
        heads = number_columns("value", "stderr", "others", "deviation")
        table = Table((*text_columns("parameter", "log"), *heads, *text_columns("unit")), tuple(rows))
        return Report((Line(self.reason, Tone.GOOD if self.agree else Tone.DOUBTFUL), *([table] if rows else [])))


def compare_logs(
    system: HasSystem | ClosedLoop,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
) -> LogComparison:
    """Fit every log alone and compare the estimates of the parameters that the logs share.

    This is worth its time where a joint fit does not explain its logs: the parameter and the log that disagree point to
    another drive, load or supply than the conditions of that log state.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        The model that all logs are fitted with, as of `identify`.
    experiments : sequence of Experiment
        At least two.
    parameters : ParameterSet
        As for `identify`; `per_log` parameters and conditions may differ and are not compared.
    method : LeastSquares, optional
        As of `identify`.

    Returns
    -------
    LogComparison

    Raises
    ------
    InputError
        If there is one log only, or logs, system and parameters do not fit together.
    """
    import pandas as pd

    experiments = as_experiments(experiments)
    require(len(experiments) > 1, f"{len(experiments)} log leaves nothing to compare; give at least two", LogError)
    logs = check_logs(as_estimation_model(system), experiments, parameters)
    fits = {}
    for log in logs:
        own = parameters.fixed(*(n for n in log.conditions if n in parameters))
        if own.free_names:
            fits[log.name] = identify(system, [log], own, method=method, explain=False, throw=False)
    shared = [n for n in parameters.free_names if not parameters[n].per_log]
    rows = []
    for name in shared:
        found = {log: _estimate(fit.estimates, name) for log, fit in fits.items() if fit.status.converged}
        for source in fits:
            value, stderr = found.get(source, (math.nan, math.nan))
            known = np.array([e for n, e in found.items() if n != source and math.isfinite(e[1])]).reshape(-1, 2)
            weight = known[:, 1] ** -2.0  # mean of the others by their variances
            others = float(np.average(known[:, 0], weights=weight)) if len(known) else math.nan
            spread = float(weight.sum()) ** -0.5 if len(known) else math.nan
            deviation = (value - others) / math.hypot(stderr, spread)
            figures = {"value": value, "stderr": stderr, "others": others, "deviation": deviation}
            rows.append({"parameter": name, "log": source, **figures, "unit": parameters[name].unit})
    table = pd.DataFrame(rows).set_index(["parameter", "log"])
    differing = _disagreements(table)
    return LogComparison(table, not len(differing), _comparison_reason(table, differing, len(fits)), fits)


def _disagreements(table: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of estimates that disagree, the worst first."""
    far = (table["deviation"].abs() > CLEAR_DEVIATIONS) & (
        (table["value"] - table["others"]).abs() > MIN_RELATIVE_DIFFERENCE * table["others"].abs()
    )
    return table[far].sort_values("deviation", key=abs, ascending=False)


def _comparison_reason(table: "pd.DataFrame", differing: "pd.DataFrame", logs: int) -> str:
    """The verdict, the largest difference, and the remedy."""
    compared = list(dict.fromkeys(str(n) for n, _ in table.index[np.isfinite(table["deviation"])]))
    if not compared:
        return (
            "nothing could be compared: no parameter is identifiable from two logs alone; fit fewer, or log longer runs"
        )
    if not len(differing):
        return f"the {logs} logs agree in {', '.join(compared)}"
    name, log = differing.index[0]
    row = differing.iloc[0]
    others = "the other log" if logs == 2 else "the other logs"
    verdict = f"the logs disagree in {name}, by {abs(row['deviation']):.0f} standard deviations"
    value = f"{row['value']:.4g} +- {row['stderr']:.2g} {row['unit']}"
    more = [str(n) for n in dict.fromkeys(n for n, _ in differing.index) if n != name]
    tail = f"; they disagree in {', '.join(more)}, too" if more else ""
    ask = "check that they are of one drive, and their conditions"
    return f"{verdict}: it is {value} in {log} alone, and {row['others']:.4g} in {others}{tail}; {ask}"
