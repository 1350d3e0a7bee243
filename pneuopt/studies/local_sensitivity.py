"""`local_sensitivity`: how a figure of a design changes with each tolerance, from derivatives at the design itself.

The response is run once with its sensitivities to the parameters and to the start, by automatic differentiation of
each integration step. A figure's derivative is that of its reading: the reader takes the response moved along its
sensitivity, a little to either side. Of a settling time this is the implicit derivative of the instant at which the
signal enters the band, ``dt = -(dy/dp) / (dy/dt)``; of an overshoot it is the sensitivity at the peak.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.scenarios import SampleSpreads, axis_labels, values_at
from pneuopt.quantities.arguments import as_tuple, check_parameters
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.shown import Shown
from pneuopt.studies.batch import check_lanes
from pneuopt.studies.fleet import PlantBatch
from pneuopt.tuning.readings import LoopLanes, ReferenceGrid, read_metrics

if TYPE_CHECKING:
    import pandas as pd

LOCAL_METRICS = ("SettlingTime", "Overshoot", "SteadyStateError")
SPREAD_POINTS = 64
"""Quantiles of an axis from which its standard deviation is computed [1]: fewer cut a normal's tails, 2 % here."""
SIDE = 1e-4
"""Part of a standard deviation by which a response is moved along its sensitivity [1]: with a larger one a figure that
bends is off, with a smaller one its digits are lost in the difference."""
START_SIDE = 1e-3
"""The same for the state before the step, which is found by iteration, to fewer digits."""
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
            own = self.table.loc[[figure]].droplevel(0).sort_values("share", ascending=False)
            rows = (
                (str(axis), format_number(r["change"], 3), format_number(100 * r["relative"], 3), f"{r['share']:.2f}")
                for axis, r in own.iterrows()
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
    references : Reference or sequence of Reference
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
    axes, found = axis_labels(parameters, spreads), dict[str, dict[str, float]]()
    shares = (np.arange(SPREAD_POINTS) + 0.5) / SPREAD_POINTS
    for k, axis in enumerate(axes):
        points = np.full((SPREAD_POINTS, len(axes)), 0.5)
        points[:, k] = shares
        rows = values_at(parameters, spreads, points)
        columns = {n: np.array([row[n] for row in rows]) for n in rows[0]}
        found[axis] = {n: float(np.sign(v[-1] - v[0]) * v.std()) for n, v in columns.items() if np.ptp(v)}
        check_names("parameter", found[axis], loop.parameters, "spreads")
        fixed = [n for n in found[axis] if n in GRID_PARAMETERS]
        require(not fixed, f"{', '.join(fixed)}: the samples of a response hang on it; sweep `evaluate` for it")
    return found


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
    found = read_metrics(grid, moved, (batch.band,), period, batch.metrics, (), batch.lanes.channels)
    m = len(along)
    return {n: (float(v[0]), (v[1 : 1 + m] - v[1 + m :]) / (2 * SIDE)) for n, v in found.items()}


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
