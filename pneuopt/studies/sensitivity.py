"""`sensitivity`: which tolerances matter: the shares of a figure's variance that parameters bring, Sobol's indices.

The design is Saltelli's, on a scrambled Sobol sequence, the estimate SciPy's: I. M. Sobol, Mathematics and Computers in
Simulation 55, 2001; A. Saltelli and others, Computer Physics Communications 181(2), 2010.

`local_sensitivity` tells the same from derivatives at the design itself. The response is run once with its
sensitivities to the parameters and to the start, by automatic differentiation of each integration step. A figure's
derivative is that of its reading: the reader takes the response moved along its sensitivity, a little to either side.
Of a settling time this is the implicit derivative of the instant at which the signal enters the band,
``dt = -(dy/dp) / (dy/dt)``; of an overshoot it is the sensitivity at the peak.

A tuning in each cell of a grid ends in a local optimum here and there, three times as bad as beside it. Cells are
computed in waves, by their distance from the one nearest to the given parameters, then the flagged ones again: what
comes out does not depend on the order in which processes finish.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from math import inf, isfinite, nan
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.evaluation.metric import Band
from pneuopt.evaluation.scenarios import SampleSpreads, Sampling, axis_labels, unit_points, values_at
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, check_names, require
from pneuopt.quantities.parameters import ParameterSet, as_tuple, check_parameters
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import Progress
from pneuopt.studies.batch import PlantBatch, check_lanes
from pneuopt.studies.executors import INTERRUPTED_CASE, CaseFunction, Processes
from pneuopt.studies.journal import Journal
from pneuopt.studies.sweep import grid, sweep
from pneuopt.studies.tolerances import BREAK_RATIO, MAX_LOST, SIDE, START_SIDE
from pneuopt.tuning.space import LoopLanes, ReferenceGrid, read_metrics

if TYPE_CHECKING:
    import pandas as pd


class ShareRow(TypedDict):
    """A row of `Sensitivity.table`: shares of a figure's variance [1], and the ends of their 95 % intervals.

    The intervals are by the sampling; all is NaN where too many points have no figure.

    Attributes
    ----------
    first : float
        What the axis brings by itself.
    first_low, first_high : float
        Ends of its interval.
    total : float
        With what the axis does by way of the others.
    total_low, total_high : float
        Ends of its interval.
    """

    first: float
    first_low: float
    first_high: float
    total: float
    total_low: float
    total_high: float


class SpreadRow(TypedDict):
    """A row of `Sensitivity.figures`, in the figure's unit.

    Attributes
    ----------
    mean : float
        Mean over the box [unit].
    std : float
        Standard deviation over the box [unit].
    lost : float
        Share of the points without the figure [1].
    """

    mean: float
    std: float
    lost: float


_COLUMNS = tuple(ShareRow.__annotations__)


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Shown):
    """Which axes of a box a figure depends on.

    Attributes
    ----------
    table : DataFrame
        A row a figure and axis, a `ShareRow`.
    figures : DataFrame
        A row a figure, a `SpreadRow`.
    cases : DataFrame
        As `sweep` returns them.
    """

    table: "pd.DataFrame"
    figures: "pd.DataFrame"
    cases: "pd.DataFrame"

    def summary(self) -> Report:
        """A table a figure, the axis that matters most first."""
        parts: list[Line | Table] = []
        columns = *text_columns("axis"), *number_columns("total", "95 % interval", "first", "95 % interval")
        for figure, about in self.figures.iterrows():
            lost = f"; {100 * about['lost']:.2g} % of the points have none" if about["lost"] else ""
            mean, spread = (format_number(float(about[n]), 4) for n in ("mean", "std"))
            parts.append(Line(f"{figure}: mean {mean}, standard deviation {spread}{lost}", Tone.HEADING))
            of_figure = self.table.loc[[figure]].droplevel(0).sort_values("total", ascending=False)
            rows = []
            for axis, row in of_figure.iterrows():
                cells = [str(axis)]
                for name in ("total", "first"):
                    low, high = row[f"{name}_low"], row[f"{name}_high"]
                    cells += [f"{row[name]:.2f}", f"{low:.2f} to {high:.2f}"] if np.isfinite(low) else ["-", "-"]
                rows.append(tuple(cells))
            parts.append(Table(columns, tuple(rows)))
        return Report(tuple(parts))


def sensitivity(
    fn: CaseFunction,
    parameters: ParameterSet,
    spreads: SampleSpreads,
    *,
    figures: Sequence[str] | None = None,
    count: int = 128,
    seed: int = 0,
    executor: Executor | Processes | None = None,
    progress: Callable[[Progress], None] | None = None,
    journal: Journal | None = None,
) -> Sensitivity:
    """Tell which tolerances matter for the figures that a function returns, over their whole ranges.

    Parameters
    ----------
    fn : callable
        As for `sweep`; it is called ``count * (axes + 2)`` times.
    parameters : ParameterSet
        The nominal values, about which the axes vary.
    spreads : mapping
        As for `samples`: the axes vary independently of each other.
    figures : sequence of str, optional
        Results of `fn` to tell about; by default all numbers among them.
    count : int
        Points, a power of two, at least 16: the intervals of the indices shrink with its root.
    seed : int
        The same seed gives the same points, whatever the executor.
    executor, progress, journal
        As for `sweep`.

    Returns
    -------
    Sensitivity

    Raises
    ------
    InputError
        If the count is no power of two, a spread does not fit the parameters, a figure is unknown, or no case gave one.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"mass": Parameter(5.0, "kg"), "force": Parameter(10.0, "N")})
    >>> found = sensitivity(lambda p: p.value("force") + 0.1 * p.value("mass"), rig, {"mass": 0.1, "force": 0.1},
    ...                     executor=ThreadPoolExecutor())
    >>> found.table["total"].round(2).tolist()
    [0.0, 1.0]
    """
    axes = axis_labels(parameters, spreads)
    require(count >= 16 and count & (count - 1) == 0, f"count = {count}: give a power of two, 16 or more")
    shares = unit_points(Sampling.SOBOL, count, [*axes, *(f"{n} again" for n in axes)], seed, "sensitivity")
    A, B = shares[:, : len(axes)], shares[:, len(axes) :]
    points = [A, B, *(np.column_stack([*A.T[:k], B[:, k], *A.T[k + 1 :]]) for k in range(len(axes)))]
    values = (row for block in points for row in values_at(parameters, spreads, block))
    chosen = {f"point {k}": row for k, row in enumerate(values, 1)}
    cases = sweep(fn, parameters, chosen, executor=executor, progress=progress, journal=journal)
    results = [str(n) for n in cases.columns if n not in (*parameters, "case", "seconds", "error")]
    numbers = [n for n in results if cases[n].dtype.kind in "fiub"]
    why = next((str(e) for e in cases["error"] if e), "it returns no number")
    require(len(numbers) > 0, f"no case of the study gave a figure: {why}")
    wanted = as_tuple("figures", figures or (), str, 'names of figures, as ["SettlingTime"]')
    check_names("figure", wanted, numbers, "sensitivity")
    return _tabulate(cases, wanted or numbers, axes, count)


def _tabulate(cases: "pd.DataFrame", figures: Sequence[str], axes: Sequence[str], count: int) -> Sensitivity:
    import pandas as pd

    from pneuopt.quantities.frames import WideFrame

    rows, about = {}, {}
    for figure in figures:
        blocks = cases[figure].to_numpy(dtype=float).reshape(len(axes) + 2, count)
        whole = np.isfinite(blocks).all(axis=0)
        mean, std = (float(f(blocks[:2])) if whole.any() else nan for f in (np.nanmean, np.nanstd))
        about[figure] = SpreadRow(mean=mean, std=std, lost=1 - float(whole.mean()))
        enough = about[figure]["lost"] <= MAX_LOST
        kept = np.flatnonzero(whole) if enough else np.arange(0)
        if kept.size:  # SciPy takes a power of two, so in place of the points that are lost some count twice
            kept = kept[np.linspace(0, kept.size - 1, count).round().astype(np.intp)]
        for axis, row in zip(axes, _indices(blocks[:, kept], len(axes)), strict=True):
            rows[figure, axis] = row
    index = pd.MultiIndex.from_tuples(rows, names=["figure", "axis"])
    table = WideFrame(list(rows.values()), index=index)
    return Sensitivity(table, WideFrame.from_dict(about, orient="index"), cases)


def _indices(blocks: Array, axes: int, resamples: int = 400) -> Iterator[dict[str, float]]:
    """First and total index of each axis, with their intervals, which jump with fewer resamples; NaN without points."""
    if not blocks.size:
        yield from (dict.fromkeys(_COLUMNS, nan) for _ in range(axes))
        return
    if not np.ptp(blocks):  # a constant has no variance to share
        yield from (dict.fromkeys(_COLUMNS, 0.0) for _ in range(axes))
        return
    from scipy.stats import bootstrap

    indices = _estimate(blocks)
    # ends of 95 % intervals, by drawing the points again; the same for the same figures
    drawn: Any = bootstrap(
        [np.arange(blocks.shape[1])],
        lambda points: _estimate(blocks[:, points]),
        n_resamples=resamples,
        vectorized=False,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    low, high = drawn.confidence_interval.low, drawn.confidence_interval.high
    for k in range(axes):
        ends = zip(indices[:, k], low[:, k], high[:, k], strict=True)
        yield dict(zip(_COLUMNS, (float(v) for index in ends for v in index), strict=True))


def _estimate(blocks: Array) -> Array:
    """First and total indices, shape (2, axes), from figures at A, B, and A with each axis of B."""
    from scipy.stats import sobol_indices

    values: Any = {"f_A": blocks[:1], "f_B": blocks[1:2], "f_AB": blocks[2:, None]}
    indices = sobol_indices(func=values, n=blocks.shape[1])
    return np.vstack([indices.first_order, indices.total_order])


LOCAL_METRICS = ("SettlingTime", "Overshoot", "SteadyStateError")
GRID_PARAMETERS = ("dither.frequency",)
"""Parameters with which the samples of a response move: its derivative at samples that stay is not the figure's."""


class SlopeRow(TypedDict):
    """A row of `LocalSensitivity.table`; NaN where the design has no such figure.

    Attributes
    ----------
    change : float
        Change of the figure for one standard deviation of the axis [unit].
    relative : float
        That change over the figure, infinite where that is 0 [1].
    share : float
        Share of the variance that the axis would bring were the figure linear [1]: the change's square over the sum of
        the squares, beside which `ShareRow` has first.
    """

    change: float
    relative: float
    share: float


@dataclass(frozen=True, eq=False, repr=False)
class LocalSensitivity(Shown):
    """Change of a design's figures with the tolerances.

    Attributes
    ----------
    table : DataFrame
        A row a figure and axis, as of `Sensitivity`: a `SlopeRow`.
    figures : DataFrame
        A row a figure: value at the design, and std, the standard deviation that the changes make together.
    """

    table: "pd.DataFrame"
    figures: "pd.DataFrame"

    def summary(self) -> Report:
        """A table a figure, the axis that matters most first."""
        parts: list[Line | Table] = []
        columns = *text_columns("axis"), *number_columns("change", "relative [%]", "share")
        for figure, about in self.figures.iterrows():
            value, spread = (format_number(float(about[n]), 4) for n in ("value", "std"))
            parts.append(Line(f"{figure}: {value}, standard deviation {spread} if it were linear", Tone.HEADING))
            of_figure = self.table.loc[[figure]].droplevel(0).sort_values("share", ascending=False)
            rows = (
                (str(axis), format_number(r["change"], 3), format_number(100 * r["relative"], 3), f"{r['share']:.2f}")
                for axis, r in of_figure.iterrows()
            )
            parts.append(Table(columns, tuple(rows)))
        return Report(tuple(parts))


def local_sensitivity(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    spreads: SampleSpreads,
    *,
    metrics: Sequence[str] = LOCAL_METRICS,
    band: Band = 0.02,
) -> LocalSensitivity:
    """Derivatives of a design's figures to the tolerances, times these, from one simulation with its sensitivities.

    Parameters
    ----------
    loop : ClosedLoop
        With a plant without Karnopp's friction.
    references : Reference or sequence of Reference
        A figure of each metric for each.
    parameters : ParameterSet
        The design, at which the derivatives are taken.
    spreads : mapping
        As for `sensitivity`, whose axes these are; those that vary together move together.
    metrics : sequence of str
        Of the response, the command or the meter, as `evaluate` names them.
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    LocalSensitivity

    Raises
    ------
    InputError
        If a spread does not fit, an axis is no parameter of the loop or the dither's frequency, a metric is unknown or
        not read off responses, or the plant has Karnopp's friction.
    ConvergenceError
        If the response runs away.

    Examples
    --------
    The error of a first-order lag under a proportional gain, 1/(1 + Kp K), falls with the plant's gain K:

    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import FirstOrder
    >>> loop = ClosedLoop(FirstOrder().system(), PID())
    >>> design = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 0.0})
    >>> found = local_sensitivity(loop, Step(1.0, horizon=4.0), design, {"plant.gain": 0.1},
    ...                           metrics=["SteadyStateError"])
    >>> bool(found.table["change"].item() < 0)
    True
    """
    import pandas as pd

    from pneuopt.quantities.frames import WideFrame

    metrics = as_tuple("metrics", metrics, str, 'names of metrics, as ["SettlingTime"]')
    steps, chosen = as_references(references), tuple(dict.fromkeys(metrics))
    check_parameters(parameters)
    check_closed_loop(loop)
    check_smooth(loop.plant)
    check_lanes(loop, chosen)
    full_loop = add_disturbances(loop, steps)
    axes = _axis_steps(full_loop, parameters, spreads)
    batch = PlantBatch(full_loop, steps, parameters, {"design": {}}, chosen, band)
    rows, about = dict[tuple[str, str], SlopeRow](), dict[str, dict[str, float]]()
    for spacing, substeps in zip(batch.grids, batch.substeps, strict=True):
        y, along = _run_with_sensitivities(full_loop, batch, spacing, substeps, axes)
        moved = np.concatenate([y[None], y + SIDE * along, y - SIDE * along])
        period, m = full_loop.dither_period(full_loop.complete(parameters)), len(along)
        read = read_metrics(spacing, moved, (batch.band,), period, batch.metrics, (), batch.lanes.channels)
        for metric, values in read.items():
            value, changes = float(values[0]), (values[1 : 1 + m] - values[1 + m :]) / (2 * SIDE)
            figure, squares = batch.column(metric, spacing), changes**2
            about[figure] = {"value": value, "std": float(np.sqrt(squares.sum()))}
            with np.errstate(divide="ignore", invalid="ignore"):
                relative, shares = changes / abs(value), squares / squares.sum() if squares.any() else squares
            for k, axis in enumerate(axes):
                rows[figure, axis] = SlopeRow(change=changes[k], relative=relative[k], share=shares[k])
    index = pd.MultiIndex.from_tuples(rows, names=["figure", "axis"])
    return LocalSensitivity(WideFrame(list(rows.values()), index=index), WideFrame.from_dict(about, orient="index"))


def _axis_steps(
    loop: ClosedLoop, parameters: ParameterSet, spreads: SampleSpreads, quantiles: int = 64
) -> dict[str, dict[str, float]]:
    """By axis the standard deviation of each of its parameters [SI], of one sign where they rise together.

    It is that of so many quantiles of the axis: fewer cut a normal's tails, 64 of them by 2 %.
    """
    axes, steps = axis_labels(parameters, spreads), dict[str, dict[str, float]]()
    shares = (np.arange(quantiles) + 0.5) / quantiles
    for k, axis in enumerate(axes):
        points = np.full((quantiles, len(axes)), 0.5)
        points[:, k] = shares
        rows = values_at(parameters, spreads, points)
        columns = {n: np.array([row[n] for row in rows]) for n in rows[0]}
        steps[axis] = {n: float(np.sign(v[-1] - v[0]) * v.std()) for n, v in columns.items() if np.ptp(v)}
        check_names("parameter", steps[axis], loop.parameters, "spreads")
        fixed = [n for n in steps[axis] if n in GRID_PARAMETERS]
        require(not fixed, f"{', '.join(fixed)}: the samples of a response hang on it; sweep `evaluate` for it")
    return steps


def _run_with_sensitivities(
    loop: ClosedLoop,
    batch: PlantBatch,
    grid: ReferenceGrid,
    substeps: int,
    axes: Mapping[str, Mapping[str, float]],
) -> tuple[Array, Array]:
    """The outputs, shape (n, n_outputs), and their change along each axis, shape (axes, n, n_outputs)."""
    order, nominal = list(loop.parameters), dict(zip(loop.parameters, batch.nominal.tolist(), strict=True))
    names = list(dict.fromkeys(n for steps in axes.values() for n in steps))
    lanes = LoopLanes(loop, batch.metrics, partial(Rollout, wrt=[order.index(n) for n in names], start=True))
    x0 = lanes.with_integral(batch.start({}, grid.reference)[None])
    run, sound = lanes.run(grid, x0, batch.nominal, substeps)
    require(bool(sound[0]), "the response runs away; no figure of it has a slope", ConvergenceError)
    assert run.dy is not None
    along = list[Array]()
    for steps in axes.values():
        before, after = (
            batch.start({n: nominal[n] + side * START_SIDE * s for n, s in steps.items()}, grid.reference)
            for side in (-1, 1)
        )
        start_change = lanes.with_integral((after - before)[None] / (2 * START_SIDE))[0]
        along.append(run.dy[0] @ np.concatenate([start_change, [steps.get(n, 0.0) for n in names]]))
    return run.y[0], np.array(along)


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
