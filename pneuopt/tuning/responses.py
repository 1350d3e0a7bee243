"""`Responses`: the metrics of simulated candidates, a lane each candidate and case, and their worst over the cases."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pneuopt.evaluation.requirements import larger_is_better, requirement_values
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.tuning.passage import ResponsePoints


class Responses:
    """The metrics of simulated candidates; margins, a frequency response each, are computed only on request.

    Parameters
    ----------
    lanes : ndarray of bool, shape (m, n_cases)
        Which cases of which candidate were run.
    p : ndarray, shape (n_lanes, n_parameters)
    measured : LaneMetrics
    margins : MarginReader

    Attributes
    ----------
    values : dict of str to ndarray, shape (m,)
        The requirements' values without margins, the worst over the cases that were run.
    """

    def __init__(self, lanes: Mask, p: Array, measured: "LaneMetrics", margins: "MarginReader") -> None:
        self._lanes, self._p, self._measured, self._margins = lanes, p, measured, margins
        metrics = {n: self.table(n).max(axis=1) for n in measured.metrics}
        self.values = {**requirement_values(metrics), "Excess": metrics["Excess"]}

    def table(self, metric: str) -> Array:
        """One metric, shape (m, n_cases); minus infinity where a case was not run."""
        return self.to_table(self._measured.metrics[metric])

    def by_case(self) -> dict[str, Array]:
        """The requirements' values in each lane, shape (n_lanes,), candidate by candidate, margins left out."""
        metrics = self._measured.metrics
        return {**requirement_values(metrics), "Excess": metrics["Excess"]}

    def with_margins(self, rows: Mask) -> dict[str, Array]:
        """The requirements' values of some candidates with their margins, the worst over the cases that were run."""
        chosen = {n: value[rows] for n, value in self.values.items()}
        margins = requirement_values(self.margin_metrics(rows))
        ran = self._lanes[rows]
        return chosen | {n: np.max(np.where(ran, table, -np.inf), axis=1) for n, table in margins.items()}

    def margin_metrics(self, rows: Mask) -> dict[str, Array]:
        """Margins and peaks of some candidates, shape (m, n_cases); NaN and infinite where the response runs away."""
        measured, names = self._measured, self._margins.names
        found = {n: np.full(len(measured.sound), np.nan if larger_is_better(n) else np.inf) for n in names}
        row, case = np.nonzero(self._lanes)
        wanted = measured.sound & rows[row]
        if wanted.any():
            for n, value in self._margins.read(self._p[wanted], case[wanted], measured.passage.select(wanted)).items():
                found[n][wanted] = value
        return {n: self.to_table(value)[rows] for n, value in found.items()}

    def to_table(self, lanes: Array) -> Array:
        """Arrange numbers of the lanes as a table, shape (m, n_cases); minus infinity where a case was not run."""
        table = np.full(self._lanes.shape, -np.inf)
        table[self._lanes] = lanes
        return table


@dataclass(frozen=True, eq=False)
class LaneMetrics:
    """The metrics of m lanes and their passage.

    Attributes
    ----------
    metrics : dict of str to ndarray, shape (m,)
        Those of `step_metrics`, and "Excess", the mean error near the end, by which responses that never settle are
        graded; infinite where the response runs away.
    sound : ndarray of bool, shape (m,)
        False where the response runs away.
    passage : ResponsePoints
    """

    metrics: dict[str, Array]
    sound: Mask
    passage: ResponsePoints

    @staticmethod
    def empty(m: int, n: int, n_states: int, read: Sequence[str]) -> "LaneMetrics":
        """Metrics of m lanes of n samples to be filled in; until then they read as running away."""
        passage = ResponsePoints.empty(m, n, n_states)
        return LaneMetrics({name: np.full(m, np.inf) for name in read}, np.zeros(m, dtype=bool), passage)


def to_records(values: Mapping[str, Array]) -> list[dict[str, float]]:
    """Turn a dict of arrays into a dict of numbers for each candidate."""
    rows = zip(*(value.tolist() for value in values.values()), strict=True)
    return [dict(zip(values, row, strict=True)) for row in rows]


def worst_values(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """The largest of each value over the cases; NaN where one of them is NaN."""
    return {n: float(np.max([values[n] for values in found])) for n in found[0]}


@dataclass(frozen=True, eq=False)
class MarginReader:
    """A function that computes margins and peaks of loops, the worst over their operating points.

    Attributes
    ----------
    names : tuple of str
        The metrics that `read` gives.
    read : callable
        Of parameters, shape (m, n_parameters), cases, shape (m,), and the lanes' passage.
    """

    names: tuple[str, ...]
    read: Callable[[Array, Indices, ResponsePoints], Mapping[str, Array]]
