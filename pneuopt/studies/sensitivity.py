"""`sensitivity`: which tolerances matter: the shares of a figure's variance that parameters bring, Sobol's indices.

The design is Saltelli's, on a scrambled Sobol sequence, the estimate SciPy's: I. M. Sobol, Mathematics and Computers in
Simulation 55, 2001; A. Saltelli and others, Computer Physics Communications 181(2), 2010.

`local_sensitivity` tells the same from derivatives at the design itself. The response is run once with its
sensitivities to the parameters and to the start, by automatic differentiation of each integration step. A figure's
derivative is that of its reading: the reader takes the response moved along its sensitivity, a little to either side.
Of a settling time this is the implicit derivative of the instant at which the signal enters the band,
``dt = -(dy/dp) / (dy/dt)``; of an overshoot it is the sensitivity at the peak.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from math import nan
from typing import TYPE_CHECKING, Any

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
from pneuopt.studies.executors import Processes
from pneuopt.studies.journal import Journal
from pneuopt.studies.outcome import CaseFunction
from pneuopt.studies.sweep import sweep
from pneuopt.studies.tolerances import MAX_LOST, RESAMPLES, SIDE, SPREAD_POINTS, START_SIDE
from pneuopt.tuning.space import LoopLanes, ReferenceGrid, read_metrics

if TYPE_CHECKING:
    import pandas as pd


_COLUMNS = tuple(f"{index}{end}" for index in ("first", "total") for end in ("", "_low", "_high"))


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Shown):
    """Which axes of a box a figure depends on.

    Attributes
    ----------
    table : DataFrame
        A row a figure and axis: first, the share of the figure's variance that the axis brings by itself; total, its
        share together with what it does by way of the others; the ends of their 95 % intervals by the sampling (NaN
        where too many points have no figure).
    figures : DataFrame
        A row a figure: mean and standard deviation over the box, and lost, the share of points without one.
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
    cases = sweep(
        fn,
        parameters,
        {f"point {k}": row for k, row in enumerate(values, 1)},
        executor=executor,
        progress=progress,
        journal=journal,
    )
    return _tabulate(cases, _chosen(cases, parameters, figures), axes, count)


def _chosen(cases: "pd.DataFrame", parameters: ParameterSet, figures: Sequence[str] | None) -> list[str]:
    """The columns of results to tell about."""
    results = [str(n) for n in cases.columns if n not in (*parameters, "case", "seconds", "error")]
    numbers = [n for n in results if cases[n].dtype.kind in "fiub"]
    why = next((str(e) for e in cases["error"] if e), "it returns no number")
    require(len(numbers) > 0, f"no case of the study gave a figure: {why}")
    wanted = as_tuple("figures", figures or (), str, 'names of figures, as ["SettlingTime"]')
    check_names("figure", wanted, numbers, "sensitivity")
    return list(wanted) or numbers


def _tabulate(cases: "pd.DataFrame", figures: Sequence[str], axes: Sequence[str], count: int) -> Sensitivity:
    import pandas as pd

    from pneuopt.quantities.frames import WideFrame

    rows, about = {}, {}
    for figure in figures:
        blocks = cases[figure].to_numpy(dtype=float).reshape(len(axes) + 2, count)
        whole = np.isfinite(blocks).all(axis=0)
        about[figure] = {
            "mean": float(np.nanmean(blocks[:2])) if whole.any() else nan,
            "std": float(np.nanstd(blocks[:2])) if whole.any() else nan,
            "lost": 1 - float(whole.mean()),
        }
        enough = about[figure]["lost"] <= MAX_LOST
        kept = np.flatnonzero(whole) if enough else np.arange(0)
        if kept.size:  # SciPy takes a power of two, so in place of the points that are lost some count twice
            kept = kept[np.linspace(0, kept.size - 1, count).round().astype(np.intp)]
        for axis, row in zip(axes, _indices(blocks[:, kept], len(axes)), strict=True):
            rows[figure, axis] = row
    index = pd.MultiIndex.from_tuples(rows, names=["figure", "axis"])
    table = WideFrame(list(rows.values()), index=index)
    return Sensitivity(table, WideFrame.from_dict(about, orient="index"), cases)


def _indices(blocks: Array, axes: int) -> Iterator[dict[str, float]]:
    """First and total index of each axis, with their intervals; NaN where there are no points."""
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
        n_resamples=RESAMPLES,
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


@dataclass(frozen=True, eq=False, repr=False)
class LocalSensitivity(Shown):
    """How the figures of a design change with the tolerances.

    Attributes
    ----------
    table : DataFrame
        A row a figure and axis, as of `Sensitivity`: change, of the figure for one standard deviation of the axis [its
        unit]; relative, that change over the figure (infinite where that is 0); share, its square over the sum of the
        squares, the share of the variance that the axis would bring were the figure linear, beside which the first
        index of a `Sensitivity` belongs. NaN where the design has no such figure.
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
    rows, about = dict[tuple[str, str], dict[str, float]](), dict[str, dict[str, float]]()
    for grid, substeps in zip(batch.grids, batch.substeps, strict=True):
        for metric, (value, changes) in _measure(full_loop, parameters, batch, grid, substeps, axes).items():
            figure, squares = batch.column(metric, grid), changes**2
            about[figure] = {"value": value, "std": float(np.sqrt(squares.sum()))}
            with np.errstate(divide="ignore", invalid="ignore"):
                relative, shares = changes / abs(value), squares / squares.sum() if squares.any() else squares
            for k, axis in enumerate(axes):
                rows[figure, axis] = {"change": changes[k], "relative": relative[k], "share": shares[k]}
    index = pd.MultiIndex.from_tuples(rows, names=["figure", "axis"])
    return LocalSensitivity(WideFrame(list(rows.values()), index=index), WideFrame.from_dict(about, orient="index"))


def _axis_steps(loop: ClosedLoop, parameters: ParameterSet, spreads: SampleSpreads) -> dict[str, dict[str, float]]:
    """By axis the standard deviation of each of its parameters [SI], of one sign where they rise together."""
    axes, steps = axis_labels(parameters, spreads), dict[str, dict[str, float]]()
    shares = (np.arange(SPREAD_POINTS) + 0.5) / SPREAD_POINTS
    for k, axis in enumerate(axes):
        points = np.full((SPREAD_POINTS, len(axes)), 0.5)
        points[:, k] = shares
        rows = values_at(parameters, spreads, points)
        columns = {n: np.array([row[n] for row in rows]) for n in rows[0]}
        steps[axis] = {n: float(np.sign(v[-1] - v[0]) * v.std()) for n, v in columns.items() if np.ptp(v)}
        check_names("parameter", steps[axis], loop.parameters, "spreads")
        fixed = [n for n in steps[axis] if n in GRID_PARAMETERS]
        require(not fixed, f"{', '.join(fixed)}: the samples of a response hang on it; sweep `evaluate` for it")
    return steps


def _measure(
    loop: ClosedLoop,
    parameters: ParameterSet,
    batch: PlantBatch,
    grid: ReferenceGrid,
    substeps: int,
    axes: Mapping[str, Mapping[str, float]],
) -> dict[str, tuple[float, Array]]:
    """By metric its value and its change for one standard deviation of each axis."""
    y, along = _run_with_sensitivities(loop, batch, grid, substeps, axes)
    moved = np.concatenate([y[None], y + SIDE * along, y - SIDE * along])
    period = loop.dither_period(loop.complete(parameters))
    figures = read_metrics(grid, moved, (batch.band,), period, batch.metrics, (), batch.lanes.channels)
    m = len(along)
    return {n: (float(v[0]), (v[1 : 1 + m] - v[1 + m :]) / (2 * SIDE)) for n, v in figures.items()}


def _run_with_sensitivities(
    loop: ClosedLoop,
    batch: PlantBatch,
    grid: ReferenceGrid,
    substeps: int,
    axes: Mapping[str, Mapping[str, float]],
) -> tuple[Array, Array]:
    """The outputs, shape (n, n_outputs), and their change along each axis, shape (axes, n, n_outputs)."""
    order = list(loop.parameters)
    names = list(dict.fromkeys(n for steps in axes.values() for n in steps))
    lanes = LoopLanes(loop, batch.metrics, partial(Rollout, wrt=[order.index(n) for n in names], start=True))
    x0 = lanes.with_integral(batch.start({}, grid.reference)[None])
    run, sound = lanes.run(grid, x0, batch.nominal, substeps)
    require(bool(sound[0]), "the response runs away; no figure of it has a slope", ConvergenceError)
    assert run.dy is not None
    along = [
        run.dy[0] @ np.concatenate([_start_change(batch, grid.reference, s), [s.get(n, 0.0) for n in names]])
        for s in axes.values()
    ]
    return run.y[0], np.array(along)


def _start_change(batch: PlantBatch, reference: Reference, steps: Mapping[str, float]) -> Array:
    """How the state before the step changes with an axis."""
    ends = [
        batch.start({n: batch.nominal_value(n) + side * START_SIDE * s for n, s in steps.items()}, reference)
        for side in (1, -1)
    ]
    return np.asarray(batch.lanes.with_integral((ends[0] - ends[1])[None] / (2 * START_SIDE))[0])
