"""Step responses of closed loops, with reference, band and command, and what goes on inside the drive."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.reference import Reference, Step
from pneuopt.evaluation.band import Band, band_share, describe_band
from pneuopt.plotting.canvas import BLUE, GREY, MAX_PLOT_COLUMNS, ORANGE, axes_grid, finish_columns
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVE_POINTS = 500  # of a reference: fewer show corners in its bends, more make figures larger
DRIVE_SIGNALS = {"valve.spool": ("valve [%]", 100.0), "friction.force": ("friction [{force}]", 1.0)}


@dataclass(frozen=True, eq=False)
class Response:
    """A simulated step response, as `plot_steps` shows it.

    Attributes
    ----------
    run : Trajectory
        With the measured signal and "control"; "valve.spool" [1] and "friction.force" are drawn where it has them.
    reference : Reference
    measured : str
        Column of the signal that follows the reference.
    units : tuple of str
        Of the measured signal and of the command.
    before : Trajectory, optional
        The same step with the gains before tuning.
    dither_period : float, optional
        Time over which the metrics average [s] (`ClosedLoop.dither_period`): the average is drawn, the signal faintly.
    force_unit : str
        Of "friction.force".
    """

    run: Trajectory
    reference: Reference
    measured: str
    units: tuple[str, str]
    before: Trajectory | None = None
    dither_period: float | None = None
    force_unit: str = "N"


def plot_steps(responses: Sequence[Response], *, band: Band = 0.02) -> "Figure":
    """Step responses: signal, reference and band, command, valve and friction below each other.

    Parameters
    ----------
    responses : sequence of Response
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    Figure
    """
    require(len(responses) > 0, "no response to plot")
    shown = responses[:MAX_PLOT_COLUMNS]
    inside = [n for n in DRIVE_SIGNALS if all(n in response.run for response in shown)]
    figure, grid = axes_grid(2 + len(inside), len(shown), [2.6, 1.4, *(1.2 for _ in inside)], sharex="col")
    for (top, *others), response in zip(zip(*grid, strict=True), shown, strict=True):
        _draw_tracking(top, response, band)
        _draw_signal(others[0], response, "control", f"command [{response.units[1]}]", 1.0)
        for axes, name in zip(others[1:], inside, strict=True):
            label, factor = DRIVE_SIGNALS[name]
            _draw_signal(axes, response, name, label.format(force=response.force_unit), factor)
        others[-1].set_xlabel("time [s]")
    return finish_columns(figure, grid, len(responses), "steps")


def _draw_tracking(axes: "Axes", response: Response, band: Band) -> None:
    run, reference, unit = response.run, response.reference, response.units[0]
    width = band_share(band, reference) * abs(reference.nominal_size)
    end = float(run.t[-1])
    axes.fill_between(
        [reference.at, end],
        reference.final - width,
        reference.final + width,
        color=ORANGE,
        alpha=0.2,
        lw=0,
        label=f"± {describe_band(band, unit)}",
    )
    axes.plot(*_reference_curve(reference, end), color=ORANGE, lw=1.0, label="reference")
    signal, before = run[response.measured], response.before
    if before is not None:
        axes.plot(*_dither_mean(before.t, before[response.measured], response), color=GREY, lw=1.0, label="before")
    if response.dither_period is not None:
        axes.plot(run.t, signal, color=BLUE, lw=0.6, alpha=0.35)
    label = ("simulated" if before is None else "tuned") + ("" if response.dither_period is None else ", averaged")
    axes.plot(*_dither_mean(run.t, signal, response), color=BLUE, lw=1.5, label=label)
    axes.set(ylabel=f"{response.measured} [{unit}]", xlim=(0, end))
    axes.set_title(f"{reference.initial:g} to {reference.final:g} {unit}", fontsize=9)
    ends = [reference.initial, reference.final]
    _set_view_limits(axes, signal, ends, ends if before is None else before[response.measured])


def _reference_curve(reference: Reference, end: float) -> tuple[Array, Array]:
    """Points of a reference up to the end of its record; a step stands upright."""
    if isinstance(reference, Step):
        values = [reference.initial, reference.initial, reference.final, reference.final]
        return np.array([0, reference.at, reference.at, end]), np.array(values)
    t = np.linspace(0, end, CURVE_POINTS)
    return t, reference.values(t)


def _draw_signal(axes: "Axes", response: Response, name: str, label: str, factor: float) -> None:
    """One more signal, with what it was before."""
    now, before = factor * response.run[name], response.before
    was = factor * before[name] if before is not None and name in before else None
    if before is not None and was is not None:
        axes.plot(before.t, was, color=GREY, lw=0.8)
    axes.plot(response.run.t, now, color=BLUE, lw=1.0)
    axes.set_ylabel(label)
    _set_view_limits(axes, now, [0.0], [0.0] if was is None else was)


def _dither_mean(t: Array, y: Array, response: Response) -> tuple[Array, Array]:
    """The centred mean over the dither's period, of samples on an even grid."""
    n = 0 if response.dither_period is None else round(response.dither_period / (t[1] - t[0]))
    if n < 2 or n >= len(t):
        return t, y
    mean = np.convolve(y, np.full(n, 1 / n), "valid")
    return t[: len(mean)] + (n - 1) / 2 * (t[1] - t[0]), mean


def _set_view_limits(axes: "Axes", y: Array, others: Sequence[float], before: ArrayLike) -> None:
    """Scale to what counts: an unstable "before" may stretch it by half, but not flatten it."""
    low, high = min(float(y.min()), *others), max(float(y.max()), *others)
    span = high - low or 1.0
    low = max(min(low, float(np.min(before))), low - span / 2)
    high = min(max(high, float(np.max(before))), high + span / 2)
    margin = 0.08 * (high - low or 1.0)
    axes.set_ylim(low - margin, high + margin)
