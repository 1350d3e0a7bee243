"""A search in each cell of a grid: from a neighbour's result, again where a cell breaks with its neighbours, flagged.

A tuning in each cell of a grid ends in a local optimum here and there, three times as bad as beside it. Cells are
computed in waves, by their distance from the one nearest to the given parameters, then the flagged ones again: what
comes out does not depend on the order in which processes finish.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from math import inf, isfinite, nan
from typing import TYPE_CHECKING

from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Progress
from pneuopt.studies.executors import Processes
from pneuopt.studies.journal import Journal
from pneuopt.studies.outcome import INTERRUPTED_CASE, CaseFunction
from pneuopt.studies.sweep import grid, sweep
from pneuopt.studies.tolerances import BREAK_RATIO

if TYPE_CHECKING:
    import pandas as pd

Places = Mapping[str, Mapping[float, int]]


def sweep_from_neighbours(
    fn: CaseFunction,
    parameters: ParameterSet,
    axes: Mapping[str, Sequence[float]],
    *,
    value: str,
    starts: Mapping[str, str],
    executor: Executor | Processes | None = None,
    progress: Callable[[Progress], None] | None = None,
    journal: Journal | None = None,
) -> "pd.DataFrame":
    """Compute a search in every cell of a grid, each from the result of the best neighbour that is known already.

    The cell nearest to the given parameters starts from theirs; then those beside it, and so on. Cells that break with
    their neighbours at the end are computed once more, and flagged if they still do: see `search_again`.

    Parameters
    ----------
    fn, parameters, executor, progress
        As for `sweep`.
    journal : Journal, optional
        As for `sweep`; what is computed again at the end is not in it.
    axes : mapping of str to sequence of float
        As for `grid`.
    value, starts
        As for `search_again`.

    Returns
    -------
    DataFrame
        As from `search_again`, a row a cell in the order of `grid`.

    Raises
    ------
    InputError
        As from `grid` and `sweep`, or if an axis is a parameter that the search finds.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from pneuopt.quantities.parameters import Parameter
    >>> given = ParameterSet({"mass": Parameter(1.0, "kg"), "Kp": Parameter(1.0, "1")})
    >>> def tune(p):  # a local search that gets no further than to twice its start
    ...     gain = min(p.value("mass"), 2 * p.value("Kp"))
    ...     return {"gain": gain, "excess": p.value("mass") - gain}
    >>> table = sweep_from_neighbours(tune, given, {"mass": [1.0, 2.0, 4.0]}, value="excess", starts={"gain": "Kp"},
    ...                               executor=ThreadPoolExecutor())
    >>> table["gain"].tolist()
    [1.0, 2.0, 4.0]
    """
    import pandas as pd

    taken = sorted(set(axes) & set(starts.values()))
    require(
        not taken, f"{', '.join(taken)}: an axis of the study and found by its search; fix it or leave the axis out"
    )
    cases, table = grid(parameters, axes), pd.DataFrame()
    places = {n: _places(axes[n]) for n in axes}
    for wave in _waves(parameters, cases, axes):
        chosen = {}
        for name in wave:  # each starts where its best neighbour ended, if one has ended
            best = _best_beside(table, cases[name], places, value) if value in table else -1
            start = {n: float(table[column].iloc[best]) for column, n in starts.items()} if best >= 0 else {}
            chosen[name] = cases[name] | start
        computed = sweep(fn, parameters, chosen, executor=executor, progress=progress, journal=journal)
        computed = computed.drop(columns=[n for n in starts.values() if n in computed])
        computed = computed.assign(**{n: [cases[name][n] for name in wave] for n in axes})
        table = pd.concat([table, computed], ignore_index=True)
        if (computed["error"] == INTERRUPTED_CASE).any():
            break
    rest = [name for name in cases if name not in set(table["case"])]
    if rest:
        left_out = [{"case": name, **cases[name], "seconds": nan, "error": INTERRUPTED_CASE} for name in rest]
        table = pd.concat([table, pd.DataFrame(left_out)], ignore_index=True)
    columns = ["case", *axes, *(n for n in table if n not in ("case", *axes, "seconds", "error")), "seconds", "error"]
    table = table.set_index("case").loc[list(cases)].reset_index()[columns]
    missing = {value, *starts} - set(table)
    if missing:  # every cell failed: no result to start from
        return table.assign(**dict.fromkeys(sorted(missing), nan), again=False, breaks=True)
    if (table["error"] == INTERRUPTED_CASE).any():
        return table.assign(again=False, breaks=False)
    return search_again(
        fn, parameters, table, axes=list(axes), value=value, starts=starts, executor=executor, progress=progress
    )


def search_again(
    fn: CaseFunction,
    parameters: ParameterSet,
    table: "pd.DataFrame",
    *,
    axes: Sequence[str],
    value: str,
    starts: Mapping[str, str],
    executor: Executor | Processes | None = None,
    progress: Callable[[Progress], None] | None = None,
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
    better = table.copy()
    if cases:
        again = sweep(fn, parameters, cases, executor=executor, progress=progress)
        results = [n for n in table if n in again and n != "case" and n not in axes]
        for place, row in enumerate(flagged):
            if _number(again, value, place) < _number(table, value, row):
                for n in results:
                    better.loc[better.index[row], n] = again[n].iloc[place]
    better["again"] = [row in set(flagged) for row in range(len(table))]
    better["breaks"] = [
        _breaks(better, value, row, _best_neighbour(better, axes, value, row)) or _number(better, value, row) == inf
        for row in range(len(table))
    ]
    return better


def _waves(
    parameters: ParameterSet, cases: Mapping[str, Mapping[str, float]], axes: Mapping[str, Sequence[float]]
) -> list[list[str]]:
    """The names of the cells by their distance, in steps of the grid, from the one nearest to the parameters."""
    distances = dict.fromkeys(cases, 0)
    for n, values in axes.items():
        places, nominal = _places(values), parameters.value(n)
        middle = places[min((abs(v - nominal), v) for v in places)[1]]
        distances = {name: d + abs(places[cases[name][n]] - middle) for name, d in distances.items()}
    waves = [[n for n, d in distances.items() if d == wave] for wave in range(max(distances.values()) + 1)]
    return [wave for wave in waves if wave]


def _places(values: Iterable[float]) -> dict[float, int]:
    """The rank of each value of an axis."""
    return {v: k for k, v in enumerate(sorted(set(map(float, values))))}


def _best_neighbour(table: "pd.DataFrame", axes: Sequence[str], value: str, row: int) -> int:
    """The row with the least value among the neighbours of a row; -1 where none has a value."""
    case = {n: float(table[n].iloc[row]) for n in axes}
    return _best_beside(table, case, {n: _places(table[n]) for n in axes}, value)


def _best_beside(table: "pd.DataFrame", case: Mapping[str, float], places: Places, value: str) -> int:
    """The row with the least value among those one step away from a cell along one axis; -1 where none has a value."""

    def distance(row: int) -> int:
        return sum(abs(places[n][float(table[n].iloc[row])] - places[n][case[n]]) for n in places)

    able = [k for k in range(len(table)) if distance(k) == 1 and isfinite(_number(table, value, k))]
    return min(able, key=lambda k: _number(table, value, k), default=-1)


def _breaks(table: "pd.DataFrame", value: str, row: int, neighbour: int) -> bool:
    """Whether a cell is far worse than a neighbour that has a value."""
    return neighbour >= 0 and _number(table, value, row) > BREAK_RATIO * _number(table, value, neighbour)


def _number(table: "pd.DataFrame", column: str, row: int) -> float:
    """A cell's number; inf where it failed or has none."""
    number = float(table[column].iloc[row]) if column in table else inf
    return number if isfinite(number) and table["error"].iloc[row] == "" else inf
