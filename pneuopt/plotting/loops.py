"""Step responses of closed loops, with what goes on inside the drive, and the Bode plot of an open loop."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.reference import Reference, Step
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.margins import Margins, frequency_grid, frequency_response, margins
from pneuopt.evaluation.metric import Band, band_share, describe_band
from pneuopt.plotting.canvas import BLUE, GREY, ORANGE, RED, STYLE, axes_grid, finish_columns, legend_above
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


DRIVE_SIGNALS = {"valve.spool": ("valve [%]", 100.0), "friction.force": ("friction [{force}]", 1.0)}


@dataclass(frozen=True, eq=False)
class Response:
    """A simulated step response, as `plot_steps` shows it.

    Attributes
    ----------
    run : Trajectory
        With the measured signal and "control"; "valve.spool" [1] and "friction.force" are drawn where it has them.
    reference : Reference
        Drawn with its settling band.
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
        Beside each other; the first three are drawn.
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    Figure
    """
    require(len(responses) > 0, "no response to plot")
    shown = responses[: STYLE.columns]
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
    low, high, label = reference.final - width, reference.final + width, f"± {describe_band(band, unit)}"
    axes.fill_between([reference.at, end], low, high, color=ORANGE, alpha=0.2, lw=0, label=label)
    t = np.array([0, reference.at, reference.at, end]) if isinstance(reference, Step) else np.linspace(0, end, 500)
    # a step stands upright
    upright = np.repeat([reference.initial, reference.final], 2)
    values = upright if isinstance(reference, Step) else reference.values(t)
    axes.plot(t, values, color=ORANGE, lw=1.0, label="reference")
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


def plot_bode(open_loop: Linearisation, before: Linearisation | None = None) -> "Figure":
    """Gain and phase of an open loop, crossovers and margins marked; below them its sensitivities.

    ``S = 1/(1 + L)`` is what feedback leaves of a disturbance, ``T = L/(1 + L)`` what of the reference arrives where
    the PID weights reference and signal alike.

    Parameters
    ----------
    open_loop : Linearisation
        Of `open_loop`.
    before : Linearisation, optional
        With the gains before tuning.

    Returns
    -------
    Figure
    """
    m = margins(open_loop)
    omega, marks = frequency_grid(open_loop), (m.gain_crossover, m.phase_crossover, m.max_sensitivity_frequency)
    finite = [w for w in marks if math.isfinite(w) and w > 0]
    if finite:  # the grid of all features is cut to one and a half decades around the crossovers
        omega = omega[(omega >= min(finite) / 30) & (omega <= max(finite) * 30)]
    figure, ((top,), (middle,), (bottom,)) = axes_grid(3, 1, [2.0, 2.0, 1.8], sharex="col", width=7.0)
    if before is not None:
        _draw_curves((top, middle, bottom), before, omega, GREY, "before")
    phase = _draw_curves((top, middle, bottom), open_loop, omega, BLUE, "" if before is None else "tuned")
    _mark_margins(top, middle, m, omega, phase)
    bottom.axhline(1, color=GREY, lw=0.8)
    if math.isfinite(m.max_sensitivity_frequency) and math.isfinite(m.max_sensitivity):
        bottom.plot([m.max_sensitivity_frequency], [m.max_sensitivity], "o", color=BLUE, ms=4)
    for axes, name in ((top, "gain [dB]"), (middle, "phase [deg]"), (bottom, "|S|, dashed |T|")):
        axes.set_ylabel(name)
    bottom.set_xlabel("frequency [rad/s]")
    bottom.set_ylim(bottom=STYLE.least_sensitivity)
    stable = "" if m.stable else "  -  the closed loop is UNSTABLE"
    peaks = f"Ms = {m.max_sensitivity:.4g}, Mt = {m.max_complementary_sensitivity:.4g}"
    top.set_title(f"peaks of the sensitivities: {peaks}{stable}", fontsize=9)
    legend_above(figure, top, middle, columns=2)
    return figure


def _draw_curves(
    axes: tuple["Axes", "Axes", "Axes"], open_loop: Linearisation, omega: Array, color: str, label: str
) -> Array:
    """Gain, phase and sensitivities; returns the phase."""
    top, middle, bottom = axes
    L = frequency_response(open_loop, omega)
    phase = np.degrees(np.unwrap(np.angle(L)))
    phase -= 360 * round((phase[0] + 90) / 360)
    top.semilogx(omega, 20 * np.log10(np.abs(L)), color=color, label=label or None)
    middle.semilogx(omega, phase, color=color)
    for values, style in ((1 / (1 + L), "-"), (L / (1 + L), "--")):
        bottom.loglog(omega, np.abs(values), color=color, ls=style, lw=1.2)
    return np.asarray(phase)


def _mark_margins(top: "Axes", middle: "Axes", m: Margins, omega: Array, phase: Array) -> None:
    from matplotlib.ticker import MultipleLocator

    top.axhline(0, color=GREY, lw=0.8)
    if math.isfinite(m.gain_crossover):
        at = float(np.interp(m.gain_crossover, omega, phase))
        foot = 360 * round((at + 180 - m.phase_margin) / 360) - 180
        text = f"phase margin {m.phase_margin:.1f}° at {m.gain_crossover:.3g} rad/s"
        _mark_frequency((top, middle), m.gain_crossover, ORANGE)
        middle.plot([m.gain_crossover] * 2, [foot, at], color=ORANGE, lw=2.5, label=text)
    if m.phase_crossover > 0:  # a logarithmic axis has no frequency 0
        decibel = -20 * math.log10(m.gain_margin)
        text = f"gain margin {-decibel:.1f} dB at {m.phase_crossover:.3g} rad/s"
        _mark_frequency((top, middle), m.phase_crossover, RED)
        top.plot([m.phase_crossover] * 2, [0, decibel], color=RED, lw=2.5, label=text)
    for level in (-180 + 360 * k for k in (-2, -1, 0, 1) if np.min(phase) - 45 < -180 + 360 * k < np.max(phase) + 45):
        middle.axhline(level, color=GREY, lw=0.8)
    middle.yaxis.set_major_locator(MultipleLocator(90))


def _mark_frequency(rows: tuple["Axes", "Axes"], omega: float, color: str) -> None:
    for axes in rows:
        axes.axvline(omega, color=color, lw=0.8, ls=":")
