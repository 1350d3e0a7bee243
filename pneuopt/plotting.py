"""Results as matplotlib figures: a fit beside its logs, a friction map, step responses, a Bode plot with its margins.

No window is opened and no global state is touched: each function returns a `Figure`, `save_figure` writes it.
"""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.margins import frequency_grid, frequency_response, margins
from pneuopt.control.reference import Step
from pneuopt.errors import require
from pneuopt.experiments import CHANNELS, Experiment, differentiate
from pneuopt.output import write_bytes
from pneuopt.parameters import ParameterSet
from pneuopt.system import Linearisation, System, names, vector
from pneuopt.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
SUFFIXES = ("png", "pdf", "svg")
GREY, BLUE, ORANGE, RED = "0.55", "#1f6fb2", "#e07b00", "#c0392b"
MOST_LOGS = 3  # columns that can still be read at 1000 pixels
MOST_POINTS = 4000  # of a measured line or cloud
SCALED = {"m": (1e3, "mm"), "Pa(a)": (1e-5, "bar(a)")}  # SI units are too coarse or too fine for these


class Fitted(Protocol):
    """What a figure needs of an identification's result."""

    @property
    def parameters(self) -> ParameterSet:
        """All parameters, the free ones as found."""
        ...

    @property
    def trajectories(self) -> Mapping[str, Trajectory]:
        """Fitted states and outputs of each log."""
        ...


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
    """

    run: Trajectory
    reference: Step
    measured: str
    units: tuple[str, str]
    before: Trajectory | None = None


def plot_fit(result: Fitted, experiments: Sequence[Experiment]) -> "Figure":
    """Measured beside fitted, and the residuals, a column a log.

    Parameters
    ----------
    result : Fitted
        An `IdentificationResult`, say.
    experiments : sequence of Experiment
        Those that it was made from, in the same order. Windows of one log (`split`) share a column.

    Returns
    -------
    Figure
    """
    return plot_prediction(list(result.trajectories.values()), experiments, label="fitted")


def plot_prediction(runs: Sequence[Trajectory], experiments: Sequence[Experiment], *, label: str) -> "Figure":
    """Measured beside fitted or predicted, and the residuals, a column a log; at most three, spread over all.

    Parameters
    ----------
    runs : sequence of Trajectory
        One an experiment.
    experiments : sequence of Experiment
    label : str
        What the runs are: "fitted", "predicted".

    Returns
    -------
    Figure
    """
    require(len(runs) == len(experiments) > 0, f"{len(runs)} runs do not match {len(experiments)} experiments")
    logs = _by_log(runs, experiments)
    shown = [list(logs)[k] for k in sorted({round(k) for k in np.linspace(0, len(logs) - 1, MOST_LOGS)})]
    channels = [
        n for n in CHANNELS if any(n in e.trajectory and n in r for r, e in zip(runs, experiments, strict=True))
    ]
    require(bool(channels), "the runs and the logs have no channel in common")
    figure, grid = _grid(2 * len(channels), len(shown), [2.2, 1.0] * len(channels), sharex="col")
    for column, name in enumerate(shown):
        for row, channel in enumerate(channels):
            _compare(grid[2 * row][column], grid[2 * row + 1][column], logs[name], channel, label)
        grid[0][column].set_title(name, fontsize=9)
        grid[-1][column].set_xlabel("time [s]")
    for row in grid:
        for axes in row[1:]:
            axes.set_ylabel("")
    _legend_above(figure, grid[0][0])
    if len(shown) < len(logs):
        figure.text(0.995, 0.005, f"{len(shown)} of {len(logs)} logs", ha="right", fontsize=8, color=GREY)
    return figure


def plot_friction(system: System, result: Fitted, experiments: Sequence[Experiment]) -> "Figure":
    """The friction force that the logs imply against speed, with the fitted curve on top.

    For a `MotionDrive` the force as measured, offset and pressure and all. For a `ForceDrive` the force less load and
    mass times acceleration, each derivative a local slope of the log: of the fit, only the load is in the points.

    Parameters
    ----------
    system : System
        Without internal friction states: the curve is that of steady motion.
    result : Fitted
    experiments : sequence of Experiment
        Those that it was made from, in the same order.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If the system is neither (`has_friction_map`).
    """
    require(has_friction_map(system), "a friction map is drawn for a ForceDrive or a MotionDrive without bristles")
    imposed = not system.states
    figure, ((axes,),) = _grid(1, 1, [4.2], width=7.0)
    clouds = [_imposed(e) if imposed else _implied(e, result.parameters) for e in experiments]
    speed, force = (np.concatenate(part) for part in zip(*clouds, strict=True))
    every = max(1, len(speed) // MOST_POINTS)
    axes.plot(speed[::every], force[::every], ".", color=GREY, ms=2.5, alpha=0.6, label="from the logs")
    if imposed:
        fitted = np.concatenate([run["force"] for run in result.trajectories.values()])
        axes.plot(speed[::every], fitted[::every], ".", color=BLUE, ms=2.5, label="fitted")
    else:
        grid = _speeds(speed)
        axes.plot(grid, _steady_friction(system, result.parameters, grid), color=BLUE, lw=1.6, label="fitted")
    low, high = np.nanpercentile(force, [0.5, 99.5])
    axes.set_ylim(low - 0.25 * (high - low), high + 0.25 * (high - low))
    axes.set(xlabel="speed [m/s]", ylabel="force [N]" if imposed else "friction force [N]")
    _legend_above(figure, axes)
    return figure


def has_friction_map(system: System) -> bool:
    """Whether `plot_friction` can draw it: speed in and force out, or force in and a speed without other states."""
    states, inputs = names(system.states), names(system.inputs)
    imposed = not states and "speed" in inputs and names(system.outputs) == ("force",)
    return imposed or (set(states) == {"position", "speed"} and inputs == ("force",))


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
    shown = responses[:MOST_LOGS]
    figure, grid = _grid(2, len(shown), [2.6, 1.4], sharex="col")
    for (top, bottom), response in zip(zip(*grid, strict=True), shown, strict=True):
        _follow(top, response, band)
        _command(bottom, response)
    for row in grid:
        for axes in row[1:]:
            axes.set_ylabel("")
    _legend_above(figure, grid[0][0])
    if len(shown) < len(responses):
        figure.text(0.995, 0.005, f"{len(shown)} of {len(responses)} steps", ha="right", fontsize=8, color=GREY)
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
    figure, ((top,), (bottom,)) = _grid(2, 1, [2.2, 2.2], sharex="col", width=7.0)
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
    _legend_above(figure, top, bottom)
    return figure


def check_figure_path(path: str | Path) -> None:
    """Raise `InputError` unless the file's suffix is one that a figure can be written as."""
    suffix = Path(path).suffix.lower().removeprefix(".")
    require(suffix in SUFFIXES, f"{path}: a figure is written as {', '.join('.' + s for s in SUFFIXES)}; name it so")


def save_figure(figure: "Figure", path: str | Path, *, dpi: int = 150) -> None:
    """Write a figure whole or not at all, in the format of the file's suffix.

    Parameters
    ----------
    figure : Figure
    path : str or Path
        Ends in .png, .pdf or .svg.
    dpi : int
        Pixels an inch of a .png.

    Raises
    ------
    InputError
        If the suffix is another one, or the file cannot be written.
    """
    check_figure_path(path)
    content = io.BytesIO()
    figure.savefig(content, format=Path(path).suffix.lower().removeprefix("."), dpi=dpi)
    write_bytes(path, content.getvalue())


def _grid(
    rows: int, columns: int, heights: Sequence[float], *, sharex: Literal["col"] | bool = False, width: float = 10.0
) -> tuple["Figure", list[list["Axes"]]]:
    """A figure of so many inches, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, 0.9 + sum(heights)), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=sharex, squeeze=False, height_ratios=heights)
    for axes in grid.flat:
        axes.grid(True, alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, [list(row) for row in grid]


def _legend_above(figure: "Figure", *sources: "Axes") -> None:
    """One legend for all axes, outside of them: it hides nothing."""
    pairs = [pair for axes in sources for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles, labels = zip(*pairs, strict=True)
    legend = figure.legend(handles, labels, loc="outside upper center", ncols=min(4, len(labels)), frameon=False)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)


def _by_log(
    runs: Sequence[Trajectory], experiments: Sequence[Experiment]
) -> dict[str, list[tuple[Trajectory, Trajectory]]]:
    """Pairs of measured and computed, by log; windows "name@0", "name@1" belong to "name"."""
    logs: dict[str, list[tuple[Trajectory, Trajectory]]] = {}
    for number, (run, experiment) in enumerate(zip(runs, experiments, strict=True), 1):
        name = experiment.name.partition("@")[0] or f"log {number}"
        logs.setdefault(name, []).append((experiment.trajectory, run))
    return logs


def _compare(
    top: "Axes", bottom: "Axes", pairs: Sequence[tuple[Trajectory, Trajectory]], channel: str, label: str
) -> None:
    factor, unit = SCALED.get(CHANNELS[channel], (1.0, CHANNELS[channel]))
    for number, (measured, run) in enumerate(pairs):
        if channel not in measured or channel not in run:
            continue
        first = number == 0
        every = max(1, len(measured) * len(pairs) // MOST_POINTS)
        t, y = measured.t[::every], factor * measured[channel][::every]
        top.plot(t, y, ".", color=GREY, ms=3, label="measured" if first else None)
        top.plot(run.t, factor * run[channel], color=BLUE, lw=1.2, label=label if first else None)
        bottom.plot(t, y - factor * run[channel][::every], ".", color=ORANGE, ms=1.5)
    top.set_ylabel(f"{channel} [{unit}]")
    bottom.set_ylabel(f"measured\n- {label} [{unit}]", fontsize=8)
    bottom.axhline(0, color=GREY, lw=0.8)


def _imposed(experiment: Experiment) -> tuple[Array, Array]:
    return experiment.trajectory["speed"], experiment.trajectory["force"]


def _implied(experiment: Experiment, parameters: ParameterSet) -> tuple[Array, Array]:
    """Speed and the force that neither load nor acceleration explain."""
    log = experiment.trajectory
    p = parameters.with_values({n: v for n, v in experiment.conditions.items() if n in parameters})
    speed = log["speed"] if "speed" in log else _slope(log.t, log["position"])
    force = log["force"] - p.value("load.force") - p.value("load.mass") * _slope(log.t, speed)
    if "load.stiffness" in p:
        force = force - p.value("load.stiffness") * (log["position"] - p.value("load.rest_position"))
    return speed, force


def _slope(t: Array, y: Array) -> Array:
    """The local slope over twenty samples."""
    window = 20 * float(np.median(np.diff(t)))
    return differentiate(Experiment(Trajectory(t, {"position": y})), window=window).trajectory["speed"]


def _speeds(speed: Array) -> Array:
    """A grid over the range, dense around zero."""
    low, high = float(np.nanmin(speed)), float(np.nanmax(speed))
    near = np.geomspace(1e-4, 1.0, 120) * max(-low, high)
    grid = np.unique(np.concatenate([np.linspace(low, high, 200), near, -near]))
    return grid[(grid >= low) & (grid <= high)]


def _steady_friction(system: System, parameters: ParameterSet, speeds: Array) -> Array:
    """The force that the equations lose at each speed: without a driving force, friction alone brakes the mass."""
    p, state = vector(system.parameters, parameters), names(system.states)
    rest = parameters.value("load.rest_position") if "load.rest_position" in parameters else 0.0
    rates = [system.ode(0, [v if n == "speed" else rest for n in state], [0.0], p)[0] for v in speeds]
    acceleration = np.array([float(rate[state.index("speed")]) for rate in rates])
    return -parameters.value("load.mass") * acceleration - parameters.value("load.force")


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
    if response.before is not None:
        axes.plot(response.before.t, response.before[response.measured], color=GREY, lw=1.0, label="before")
    axes.plot(run.t, run[response.measured], color=BLUE, lw=1.5, label="tuned" if response.before else "simulated")
    axes.set(ylabel=f"{response.measured} [{unit}]", xlim=(0, end))
    axes.set_title(f"{reference.initial:g} to {reference.final:g} {unit}", fontsize=9)
    _keep_in_view(axes, run[response.measured], [reference.initial, reference.final])


def _command(axes: "Axes", response: Response) -> None:
    if response.before is not None:
        axes.plot(response.before.t, response.before["control"], color=GREY, lw=0.8)
    axes.plot(response.run.t, response.run["control"], color=BLUE, lw=1.0)
    axes.set(xlabel="time [s]", ylabel=f"command [{response.units[1]}]")
    _keep_in_view(axes, response.run["control"], [0.0])


def _keep_in_view(axes: "Axes", y: Array, others: Sequence[float]) -> None:
    """Scale to what counts, so that an unstable "before" does not flatten it."""
    low, high = min(float(y.min()), *others), max(float(y.max()), *others)
    margin = 0.15 * (high - low or 1.0)
    axes.set_ylim(low - margin, high + 2 * margin)


def _shown_frequencies(open_loop: Linearisation, marks: Sequence[float]) -> Array:
    """The grid of all features, cut to two decades around the crossovers."""
    omega = frequency_grid(open_loop)
    finite = [w for w in marks if math.isfinite(w) and w > 0]
    if not finite:
        return omega
    return omega[(omega >= min(finite) / 100) & (omega <= max(finite) * 100)]


def _mark(top: "Axes", bottom: "Axes", omega: float, color: str) -> None:
    for axes in (top, bottom):
        axes.axvline(omega, color=color, lw=0.8, ls=":")
