"""`sensitivity`: which tolerances matter: the shares of a figure's variance that parameters bring, Sobol's indices.

The design is Saltelli's, on a scrambled Sobol sequence, the estimate SciPy's: I. M. Sobol, Mathematics and Computers in
Simulation 55, 2001; A. Saltelli and others, Computer Physics Communications 181(2), 2010.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.sampling import Sampling, unit_points
from pneuopt.evaluation.scenarios import SampleSpreads, axis_labels, values_at
from pneuopt.quantities.arguments import as_tuple
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import Progress
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.shown import Shown
from pneuopt.studies.journal import Journal
from pneuopt.studies.outcome import CaseFunction
from pneuopt.studies.processes import Processes
from pneuopt.studies.sweep import sweep

if TYPE_CHECKING:
    import pandas as pd

MAX_LOST = 0.1
"""Share of points [1] without a figure, beyond which its indices are not given: they would tell of other plants."""
RESAMPLES = 400
"""Bootstrap samples of an index: fewer make its ends jump, more only take time."""
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
            own = self.table.loc[[figure]].droplevel(0).sort_values("total", ascending=False)
            parts.append(Table(columns, tuple(_row(str(axis), row) for axis, row in own.iterrows())))
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
    known = [str(n) for n in cases.columns if n not in (*parameters, "case", "seconds", "error")]
    numbers = [n for n in known if cases[n].dtype.kind in "fiub"]
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
        kept = _fill(np.flatnonzero(whole), count) if enough else np.arange(0)
        for axis, row in zip(axes, _indices(blocks[:, kept], len(axes)), strict=True):
            rows[figure, axis] = row
    index = pd.MultiIndex.from_tuples(rows, names=["figure", "axis"])
    table = WideFrame(list(rows.values()), index=index)
    return Sensitivity(table, WideFrame.from_dict(about, orient="index"), cases)


def _fill(points: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """As many points as there were: SciPy takes a power of two, so in place of those that are lost some count twice."""
    return points[np.linspace(0, points.size - 1, count).round().astype(np.intp)]


def _indices(blocks: Array, axes: int) -> Iterator[dict[str, float]]:
    """First and total index of each axis, with their intervals; NaN where there are no points."""
    if not blocks.size:
        yield from (dict.fromkeys(_COLUMNS, nan) for _ in range(axes))
        return
    if not np.ptp(blocks):  # a constant has no variance to share
        yield from (dict.fromkeys(_COLUMNS, 0.0) for _ in range(axes))
        return
    found = _estimate(blocks)
    low, high = _interval(blocks)
    for k in range(axes):
        ends = zip(found[:, k], low[:, k], high[:, k], strict=True)
        yield dict(zip(_COLUMNS, (float(v) for index in ends for v in index), strict=True))


def _estimate(blocks: Array) -> Array:
    """First and total indices, shape (2, axes), from figures at A, B, and A with each axis of B."""
    from scipy.stats import sobol_indices

    given: Any = {"f_A": blocks[:1], "f_B": blocks[1:2], "f_AB": blocks[2:, None]}
    found = sobol_indices(func=given, n=blocks.shape[1])
    return np.vstack([found.first_order, found.total_order])


def _interval(blocks: Array) -> tuple[Array, Array]:
    """Ends of 95 % intervals, by drawing the points again; the same for the same figures."""
    from scipy.stats import bootstrap

    drawn: Any = bootstrap(
        [np.arange(blocks.shape[1])],
        lambda points: _estimate(blocks[:, points]),
        n_resamples=RESAMPLES,
        vectorized=False,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return drawn.confidence_interval.low, drawn.confidence_interval.high


def _row(axis: str, row: "pd.Series[Any]") -> tuple[str, ...]:
    cells = [axis]
    for name in ("total", "first"):
        low, high = row[f"{name}_low"], row[f"{name}_high"]
        cells += [f"{row[name]:.2f}", f"{low:.2f} to {high:.2f}"] if np.isfinite(low) else ["-", "-"]
    return tuple(cells)
