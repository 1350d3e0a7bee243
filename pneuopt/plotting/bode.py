"""The Bode plot of an open loop with its margins, and the sensitivities that they come from."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.margins import Margins, frequency_grid, frequency_response, margins
from pneuopt.plotting.canvas import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from pneuopt.quantities.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MIN_PLOTTED_SENSITIVITY = 0.03
"""The lowest sensitivity that is drawn [1]: lower flattens the peak, which matters; higher cuts the slope off."""


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
    omega = _plot_frequencies(open_loop, [m.gain_crossover, m.phase_crossover, m.max_sensitivity_frequency])
    figure, ((top,), (middle,), (bottom,)) = axes_grid(3, 1, [2.0, 2.0, 1.8], sharex="col", width=7.0)
    if before is not None:
        _draw_curves((top, middle, bottom), before, omega, GREY, "before")
    phase = _draw_curves((top, middle, bottom), open_loop, omega, BLUE, "" if before is None else "tuned")
    _mark_margins(top, middle, m, omega, phase)
    _mark_peak(bottom, m)
    for axes, name in ((top, "gain [dB]"), (middle, "phase [deg]"), (bottom, "|S|, dashed |T|")):
        axes.set_ylabel(name)
    bottom.set_xlabel("frequency [rad/s]")
    bottom.set_ylim(bottom=MIN_PLOTTED_SENSITIVITY)
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


def _mark_peak(axes: "Axes", m: Margins) -> None:
    """Where feedback makes things worse the most."""
    axes.axhline(1, color=GREY, lw=0.8)
    if math.isfinite(m.max_sensitivity_frequency) and math.isfinite(m.max_sensitivity):
        axes.plot([m.max_sensitivity_frequency], [m.max_sensitivity], "o", color=BLUE, ms=4)


def _plot_frequencies(open_loop: Linearisation, marks: Sequence[float]) -> Array:
    """The grid of all features, cut to one and a half decades around the crossovers."""
    omega = frequency_grid(open_loop)
    finite = [w for w in marks if math.isfinite(w) and w > 0]
    if not finite:
        return omega
    return omega[(omega >= min(finite) / 30) & (omega <= max(finite) * 30)]


def _mark_frequency(rows: tuple["Axes", "Axes"], omega: float, color: str) -> None:
    for axes in rows:
        axes.axvline(omega, color=color, lw=0.8, ls=":")
