"""`Responses`: the metrics of simulated candidates, a lane each candidate and case, and their worst over the cases."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pneuopt.evaluation.requirements import larger_is_better, requirement_values
from pneuopt.quantities.arrays import Array, Indices, Mask

RUNAWAY_LEVEL = 1e12


class Responses:
    """Simulated candidates; their margins, a frequency response each, are computed only where asked for.

    Attributes
    ----------
    values : dict of str to ndarray, shape (m,)
        What the requirements read but for margins, the worst over the cases that were run.
    """

    def __init__(self, lanes: Mask, p: Array, measured: "LaneMetrics", margins: "MarginReader") -> None:
        self._lanes, self._p, self._measured, self._margins = lanes, p, measured, margins
        metrics = {n: self.table(n).max(axis=1) for n in measured.metrics}
        self.values = {**requirement_values(metrics), "Excess": metrics["Excess"]}

    def table(self, metric: str) -> Array:
        """One metric, shape (m, n_cases); minus infinity where a case was not run."""
        return self.to_table(self._measured.metrics[metric])

    def by_case(self) -> dict[str, Array]:
        """The values of each case that was run, shape (n_lanes,), as `lanes` lists them row by row."""
        metrics = self._measured.metrics
        return {**requirement_values(metrics), "Excess": metrics["Excess"]}

    def with_margins(self, rows: Mask) -> dict[str, Array]:
        """The values of some candidates, with their margins."""
        chosen = {n: value[rows] for n, value in self.values.items()}
        margins = requirement_values(self.margin_metrics(rows))
        ran = self._lanes[rows]
        return chosen | {n: np.max(np.where(ran, table, -np.inf), axis=1) for n, table in margins.items()}

    def margin_metrics(self, rows: Mask) -> dict[str, Array]:
        """Margins and peaks of some candidates, a column a case; NaN and infinite where the response runs away."""
        measured, names = self._measured, self._margins.names
        found = {n: np.full(len(measured.sound), np.nan if larger_is_better(n) else np.inf) for n in names}
        row, case = np.nonzero(self._lanes)
        wanted = measured.sound & rows[row]
        if wanted.any():
            ends = measured.x_end[wanted], measured.command[wanted]
            for n, value in self._margins.read(self._p[wanted], case[wanted], *ends).items():
                found[n][wanted] = value
        return {n: self.to_table(value)[rows] for n, value in found.items()}

    def to_table(self, lanes: Array) -> Array:
        """Numbers of the lanes as a table, shape (m, n_cases); minus infinity where a case was not run."""
        table = np.full(self._lanes.shape, -np.inf)
        table[self._lanes] = lanes
        return table


@dataclass(frozen=True, eq=False)
class LaneMetrics:
    """What m lanes showed.

    Attributes
    ----------
    metrics : dict of str to ndarray, shape (m,)
        Of `step_metrics`, and "Excess", the mean error near the end, for what never settles; infinite where the
        response runs away.
    sound : ndarray of bool, shape (m,)
        False where the response runs away.
    x_end : ndarray, shape (m, n_states)
    command : ndarray, shape (m,)
        Where the responses end.
    """

    metrics: dict[str, Array]
    sound: Mask
    x_end: Array
    command: Array

    @staticmethod
    def empty(m: int, n_states: int, read: Sequence[str]) -> "LaneMetrics":
        """For m lanes, to be filled."""
        return LaneMetrics(
            {n: np.full(m, np.inf) for n in read}, np.zeros(m, dtype=bool), np.empty((m, n_states)), np.empty(m)
        )


def to_records(values: Mapping[str, Array]) -> list[dict[str, float]]:
    """The values of one candidate after another."""
    rows = zip(*(value.tolist() for value in values.values()), strict=True)
    return [dict(zip(values, row, strict=True)) for row in rows]


def worst_values(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """The largest of each value over the cases; NaN wins."""
    return {n: float(np.max([values[n] for values in found])) for n in found[0]}


def is_sound(y: Array, x_end: Array) -> Mask:
    """Which lanes did not run away."""
    with np.errstate(all="ignore"):
        tame = np.all(np.abs(y) < RUNAWAY_LEVEL, axis=(1, 2))
    return np.asarray(tame & np.isfinite(x_end).all(axis=1))


@dataclass(frozen=True, eq=False)
class MarginReader:
    """Margins and peaks of loops linearised about the end of their responses.

    Attributes
    ----------
    names : tuple of str
        The metrics that `read` gives.
    read : callable
        From parameters, shape (m, n_parameters), cases, shape (m,), and the states and commands in which the lanes end.
    """

    names: tuple[str, ...]
    read: Callable[[Array, Indices, Array, Array], Mapping[str, Array]]
