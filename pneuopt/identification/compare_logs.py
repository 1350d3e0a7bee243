"""`compare_logs`: a test whether several logs are of one drive, from fits of each log alone."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem
from pneuopt.identification.identify import identify
from pneuopt.identification.misfit import t_quantile
from pneuopt.identification.problem import as_estimation_model, as_experiments, check_logs
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tolerances import CLEAR_DEVIATIONS, MIN_RELATIVE_DIFFERENCE
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Result
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    import pandas as pd


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
    experiments = as_experiments(experiments)
    require(len(experiments) > 1, f"{len(experiments)} log leaves nothing to compare; give at least two", LogError)
    logs = check_logs(as_estimation_model(system), experiments, parameters)
    fits = {}
    for log in logs:
        own = parameters.fixed(*(n for n in log.conditions if n in parameters))
        if own.free_names:
            fits[log.name] = identify(system, [log], own, method=method, throw=False)
    shared = [n for n in parameters.free_names if not parameters[n].per_log]
    table = _comparison_table(shared, fits, parameters)
    differing = _disagreements(table)
    return LogComparison(table, not len(differing), _comparison_reason(table, differing, len(fits)), fits)


def _comparison_table(
    shared: Sequence[str], fits: Mapping[str, IdentificationResult], known: ParameterSet
) -> "pd.DataFrame":
    import pandas as pd

    rows = []
    for name in shared:
        own = {log: _estimate(fit, name) for log, fit in fits.items()}
        for log, (value, stderr) in own.items():
            others, spread = _inverse_variance_mean([e for n, e in own.items() if n != log])
            deviation = (value - others) / math.hypot(stderr, spread)
            figures = {"value": value, "stderr": stderr, "others": others, "deviation": deviation}
            rows.append({"parameter": name, "log": log, **figures, "unit": known[name].unit})
    return pd.DataFrame(rows).set_index(["parameter", "log"])


def _estimate(fit: IdentificationResult, name: str) -> tuple[float, float]:
    """Value and standard deviation of a parameter; NaN where the log alone does not identify it.

    With few degrees of freedom it is that of a normal distribution with the same interval.
    """
    if not fit.status.converged or name not in fit.estimates.index:
        return math.nan, math.nan
    value, stderr, dof = (float(fit.estimates[column][name]) for column in ("value", "stderr", "dof"))
    width = stderr * float(t_quantile(dof) / t_quantile(math.inf))
    return (value, width) if math.isfinite(width) else (math.nan, math.nan)


def _inverse_variance_mean(estimates: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Inverse-variance mean of the finite estimates, and its standard deviation."""
    finite = np.array([e for e in estimates if math.isfinite(e[1])]).reshape(-1, 2)
    if not len(finite):
        return math.nan, math.nan
    weight = 1 / np.maximum(finite[:, 1], 1e-300) ** 2
    return float(np.average(finite[:, 0], weights=weight)), float(1 / math.sqrt(weight.sum()))


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
