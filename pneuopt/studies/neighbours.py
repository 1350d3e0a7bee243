"""Cells of a study that break with their neighbours: found, computed again from a neighbour's result, and flagged.

A tuning in each cell of a grid ends in a local optimum here and there, three times as bad as beside it. All cells are
computed first, then the flagged ones again: what comes out does not depend on the order in which processes finish.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from math import inf, isfinite
from typing import TYPE_CHECKING

from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import ProgressCallback
from pneuopt.studies.outcome import CaseFunction
from pneuopt.studies.sweep import sweep

if TYPE_CHECKING:
    import pandas as pd

# Ratio to the best neighbour from which a cell breaks with it. A smaller one computes cells again on a steep slope; a
# larger one leaves local optima in the table.
BREAK_RATIO = 3.0


def search_again(
    fn: CaseFunction,
    parameters: ParameterSet,
    table: "pd.DataFrame",
    *,
    axes: Sequence[str],
    value: str,
    starts: Mapping[str, str],
    executor: Executor | None = None,
    progress: ProgressCallback | None = None,
) -> "pd.DataFrame":
    """Compute cells of a grid again that are three times worse than a neighbour, or failed, from that one's result.

    Parameters
    ----------
    fn, parameters, executor, progress
        As for `sweep`, which made the table.
    table : DataFrame
        Of `sweep` over a `grid`.
    axes : sequence of str
        The columns of the grid's parameters.
    value : str
        The column that shall be small, a settling time for example.
    starts : mapping of str to str
        Columns of results to the parameters that they are starts of: ``{"Kp": "pid.Kp"}``.

    Returns
    -------
    DataFrame
        The table, the better of both results in each row, with two columns more: "again", whether the cell was computed
        again, and "breaks", whether it still is three times worse than a neighbour, or has no value.

    Raises
    ------
    InputError
        If a column is missing.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from pneuopt.quantities.parameters import Parameter
    >>> from pneuopt.studies.sweep import grid
    >>> given = ParameterSet({"mass": Parameter(1.0, "kg"), "Kp": Parameter(0.0, "1")})
    >>> def tune(p):  # a good start is 2; from 0 the heavy cell ends far away
    ...     return {"gain": 2.0, "error": 9.0 if p.value("mass") > 2 and p.value("Kp") == 0 else 1.0}
    >>> def cell(p):
    ...     found = tune(p)
    ...     return {"gain": found["gain"], "settling": found["error"]}
    >>> first = sweep(cell, given, grid(given, {"mass": [1.0, 2.0, 3.0]}), executor=ThreadPoolExecutor())
    >>> table = search_again(cell, given, first, axes=["mass"], value="settling", starts={"gain": "Kp"},
    ...                      executor=ThreadPoolExecutor())
    >>> table[["settling", "again", "breaks"]].values.tolist()
    [[1.0, False, False], [1.0, False, False], [1.0, True, False]]
    """
    missing = [n for n in (*axes, value, *starts) if n not in table]
    require(not missing, f"the study has no column {', '.join(missing)}; its columns: {', '.join(map(str, table))}")
    best = {row: _best_neighbour(table, axes, value, row) for row in range(len(table))}
    flagged = [row for row in range(len(table)) if _breaks(table, value, row, best[row])]
    cases = {
        str(table["case"].iloc[row]): {
            **{n: float(table[n].iloc[row]) for n in axes},
            **{parameter: float(table[column].iloc[best[row]]) for column, parameter in starts.items()},
        }
        for row in flagged
    }
    found = table.copy()
    if cases:
        again = sweep(fn, parameters, cases, executor=executor, progress=progress)
        results = [n for n in table if n in again and n != "case" and n not in axes]
        for place, row in enumerate(flagged):
            if _number(again, value, place) < _number(table, value, row):
                for n in results:
                    found.loc[found.index[row], n] = again[n].iloc[place]
    found["again"] = [row in set(flagged) for row in range(len(table))]
    found["breaks"] = [
        _breaks(found, value, row, _best_neighbour(found, axes, value, row)) or _number(found, value, row) == inf
        for row in range(len(table))
    ]
    return found


def _best_neighbour(table: "pd.DataFrame", axes: Sequence[str], value: str, row: int) -> int:
    """The row with the least value among those one step away along one axis; -1 where none has a value."""
    places = {n: {v: k for k, v in enumerate(sorted(set(table[n])))} for n in axes}
    at = [[places[n][table[n].iloc[k]] for n in axes] for k in range(len(table))]
    beside = [k for k in range(len(table)) if sum(abs(a - b) for a, b in zip(at[k], at[row], strict=True)) == 1]
    able = [k for k in beside if isfinite(_number(table, value, k))]
    return min(able, key=lambda k: _number(table, value, k), default=-1)


def _breaks(table: "pd.DataFrame", value: str, row: int, neighbour: int) -> bool:
    """Whether a cell is far worse than a neighbour that has a value."""
    return neighbour >= 0 and _number(table, value, row) > BREAK_RATIO * _number(table, value, neighbour)


def _number(table: "pd.DataFrame", column: str, row: int) -> float:
    """A cell's number; inf where it failed or has none."""
    number = float(table[column].iloc[row]) if column in table else inf
    return number if isfinite(number) and table["error"].iloc[row] == "" else inf
