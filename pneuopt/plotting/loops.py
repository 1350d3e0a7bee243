"""Closed loops: step responses with reference, band and command; the Bode plot with its margins."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.control.margins import frequency_grid, frequency_response, margins
from pneuopt.control.reference import Step
from pneuopt.errors import require
from pneuopt.plotting.canvas import BLUE, GREY, MOST_COLUMNS, ORANGE, RED, axes_grid, legend_above, shown_of
from pneuopt.system import Linearisation
from pneuopt.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Response:
    """A simulated step response, as `plot_steps` shows it.

    Attributes
    ----------
    run : Trajectory
        With the measured signal and "control".
    reference : Step
    measured : str
        Column of the signal that follows the reference.
    units : tuple of str
        Of the measured signal and of the command.
    before : Trajectory, optional
        The same step with the gains before tuning.
    dither_period : float, optional
        Time over which the metrics average [s] (`ClosedLoop.dither_period`): the average is drawn, the signal faintly.
    """

    run: Trajectory
    reference: Step
    measured: str
    units: tuple[str, str]
    before: Trajectory | None = None
    dither_period: float | None = None


def plot_steps(responses: Sequence[Response], *, band: float = 0.02) -> "Figure":
    """Step responses: the measured signal with the reference and its band, below it the command; a column a step.

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
    shown = responses[:MOST_COLUMNS]
    figure, grid = axes_grid(2, len(shown), [2.6, 1.4], sharex="col")
    for (top, bottom), response in zip(zip(*grid, strict=True), shown, strict=True):
        _follow(top, response, band)
        _command(bottom, response)
    for row in grid:
        for axes in row[1:]:
            axes.set_ylabel("")
    legend_above(figure, grid[0][0])
    shown_of(figure, len(shown), len(responses), "steps")
    return figure


def plot_bode(open_loop: Linearisation) -> "Figure":
    """Gain and phase of an open loop, the crossovers and margins marked.

    Parameters
    ----------
    open_loop : Linearisation
        Of `ClosedLoop.open_loop`.

    Returns
    -------
    Figure
    """
    from matplotlib.ticker import MultipleLocator

    m = margins(open_loop)
    omega = _shown_frequencies(open_loop, [m.gain_crossover, m.phase_crossover, m.max_sensitivity_frequency])
    L = frequency_response(open_loop, omega)
    phase = np.degrees(np.unwrap(np.angle(L)))
    phase -= 360 * round((phase[0] + 90) / 360)
    figure, ((top,), (bottom,)) = axes_grid(2, 1, [2.2, 2.2], sharex="col", width=7.0)
    top.semilogx(omega, 20 * np.log10(np.abs(L)), color=BLUE)
    bottom.semilogx(omega, phase, color=BLUE)
    top.axhline(0, color=GREY, lw=0.8)
    if math.isfinite(m.gain_crossover):
        at = float(np.interp(m.gain_crossover, omega, phase))
        _mark(top, bottom, m.gain_crossover, ORANGE)
        foot = 360 * round((at + 180 - m.phase_margin) / 360) - 180
        text = f"phase margin {m.phase_margin:.1f}° at {m.gain_crossover:.3g} rad/s"
        bottom.plot([m.gain_crossover] * 2, [foot, at], color=ORANGE, lw=2.5, label=text)
    if math.isfinite(m.phase_crossover):
        _mark(top, bottom, m.phase_crossover, RED)
        decibel = -20 * math.log10(m.gain_margin)
        text = f"gain margin {-decibel:.1f} dB at {m.phase_crossover:.3g} rad/s"
        top.plot([m.phase_crossover] * 2, [0, decibel], color=RED, lw=2.5, label=text)
    for level in (-180 + 360 * k for k in (-2, -1, 0, 1) if np.min(phase) - 45 < -180 + 360 * k < np.max(phase) + 45):
        bottom.axhline(level, color=GREY, lw=0.8)
    bottom.yaxis.set_major_locator(MultipleLocator(45))
    top.set(ylabel="gain [dB]")
    bottom.set(xlabel="frequency [rad/s]", ylabel="phase [deg]")
    stable = "" if m.stable else "  -  the closed loop is UNSTABLE"
    top.set_title(f"maximum sensitivity Ms = {m.max_sensitivity:.4g}{stable}", fontsize=9)
    legend_above(figure, top, bottom)
    return figure


def _follow(axes: "Axes", response: Response, band: float) -> None:
    run, reference, unit = response.run, response.reference, response.units[0]
    width = band * abs(reference.size)
    end = float(run.t[-1])
    axes.fill_between(
        [reference.at, end],
        reference.final - width,
        reference.final + width,
        color=ORANGE,
        alpha=0.2,
        lw=0,
        label=f"± {100 * band:g} % of the step",
    )
    steps = [reference.initial, reference.initial, reference.final, reference.final]
    axes.plot([0, reference.at, reference.at, end], steps, color=ORANGE, lw=1.0, label="reference")
    signal, before = run[response.measured], response.before
    if before is not None:
        axes.plot(*_averaged(before.t, before[response.measured], response), color=GREY, lw=1.0, label="before")
    if response.dither_period is not None:
        axes.plot(run.t, signal, color=BLUE, lw=0.6, alpha=0.35)
    label = ("simulated" if before is None else "tuned") + ("" if response.dither_period is None else ", averaged")
    axes.plot(*_averaged(run.t, signal, response), color=BLUE, lw=1.5, label=label)
    axes.set(ylabel=f"{response.measured} [{unit}]", xlim=(0, end))
    axes.set_title(f"{reference.initial:g} to {reference.final:g} {unit}", fontsize=9)
    ends = [reference.initial, reference.final]
    _keep_in_view(axes, signal, ends, ends if before is None else before[response.measured])


def _command(axes: "Axes", response: Response) -> None:
    if response.before is not None:
        axes.plot(response.before.t, response.before["control"], color=GREY, lw=0.8)
    axes.plot(response.run.t, response.run["control"], color=BLUE, lw=1.0)
    axes.set(xlabel="time [s]", ylabel=f"command [{response.units[1]}]")
    other = [0.0] if response.before is None else response.before["control"]
    _keep_in_view(axes, response.run["control"], [0.0], other)


def _averaged(t: Array, y: Array, response: Response) -> tuple[Array, Array]:
    """The centred mean over the dither's period, of samples on an even grid."""
    n = 0 if response.dither_period is None else round(response.dither_period / (t[1] - t[0]))
    if n < 2 or n >= len(t):
        return t, y
    mean = np.convolve(y, np.full(n, 1 / n), "valid")
    return t[: len(mean)] + (n - 1) / 2 * (t[1] - t[0]), mean


def _keep_in_view(axes: "Axes", y: Array, others: Sequence[float], before: ArrayLike) -> None:
    """Scale to what counts: an unstable "before" may stretch it by half, but not flatten it."""
    low, high = min(float(y.min()), *others), max(float(y.max()), *others)
    span = high - low or 1.0
    low = max(min(low, float(np.min(before))), low - span / 2)
    high = min(max(high, float(np.max(before))), high + span / 2)
    margin = 0.08 * (high - low or 1.0)
    axes.set_ylim(low - margin, high + margin)


def _shown_frequencies(open_loop: Linearisation, marks: Sequence[float]) -> Array:
    """The grid of all features, cut to one and a half decades around the crossovers."""
    omega = frequency_grid(open_loop)
    finite = [w for w in marks if math.isfinite(w) and w > 0]
    if not finite:
        return omega
    return omega[(omega >= min(finite) / 30) & (omega <= max(finite) * 30)]


def _mark(top: "Axes", bottom: "Axes", omega: float, color: str) -> None:
    for axes in (top, bottom):
        axes.axvline(omega, color=color, lw=0.8, ls=":")
