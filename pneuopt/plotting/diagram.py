"""`plot_loop`: the block diagram of a closed loop, drawn from its parts on a `Sheet`, a pen on the forward path."""

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.dither import Waveform
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.pid import AntiWindup, Form
from pneuopt.control.sensor import Encoder
from pneuopt.plotting.canvas import BLUE, GREY, STYLE
from pneuopt.quantities.parameters import Quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BLOCK_COLOUR = "#eef4fa"


class Sheet:
    """The paper, in inches, and a pen on the forward path, which lies at height 0."""

    def __init__(self, axes: "Axes") -> None:
        self.axes = axes
        self.x = self.above = 0.0  # where the next part of the forward path begins, and the last block above it ends
        self.right = self.low = self.high = 0.0  # the edges of what is drawn so far; the left one is 0

    def draw_arrow(self, name: str = "", unit: str = "", *, least: float = STYLE.arrow_length) -> None:
        """Go on along the forward path, as far as the label needs, which stands above the arrow."""
        lines = [line for line in (name, f"[{unit}]" if unit else "") if line]
        length = max(least, STYLE.letter_width * max(map(len, lines), default=0) + 0.16)
        self.draw_line([(self.x, 0.0), (self.x + length, 0.0)])
        self.write(self.x + length / 2 - 0.03, 0.05, "\n".join(lines), va="bottom")
        self.x += length

    def draw_block(self, text: str, width: float, *, low: float = -STYLE.block_height / 2, high: float = 0.0) -> float:
        """Draw a block on the forward path, by default one as high as the others; returns its centre."""
        centre, high = self.x + width / 2, high or -low
        self.draw_box(centre, (low + high) / 2, width, text, height=high - low)
        self.x += width
        return centre

    def draw_sum(self, sign_below: str = "") -> float:
        """Draw a sum on the forward path, with the sign of what comes from below; returns its centre."""
        from matplotlib.patches import Circle

        centre = self.x + STYLE.circle_radius
        self.axes.add_patch(Circle((centre, 0.0), STYLE.circle_radius, fc="white", ec="black", lw=1.0, zorder=3))
        self.axes.text(centre, -0.005, "+", ha="center", va="center_baseline", fontsize=STYLE.block_text, zorder=4)
        self.write(centre + 0.12, -STYLE.circle_radius - 0.1, sign_below)
        self.x += 2 * STYLE.circle_radius
        return centre

    def draw_source(self, text: str, width: float, height: float) -> float:
        """Draw a sum on the forward path and a block that feeds it, at a height above; returns the centre of both."""
        self.draw_arrow(least=max(STYLE.arrow_length, self.above + 0.15 + width / 2 - self.x - STYLE.circle_radius))
        centre = self.draw_sum()
        self.draw_box(centre, height, width, text)
        self.draw_line([(centre, height - STYLE.block_height / 2), (centre, STYLE.circle_radius)])
        self.above = centre + width / 2
        return centre

    def draw_box(self, x: float, y: float, width: float, text: str, *, height: float = STYLE.block_height) -> None:
        """Draw a block about a point."""
        from matplotlib.patches import FancyBboxPatch

        left, bottom = x - width / 2, y - height / 2
        style = "round,pad=0,rounding_size=0.04"
        self.axes.add_patch(
            FancyBboxPatch((left, bottom), width, height, boxstyle=style, fc=BLOCK_COLOUR, ec=BLUE, lw=1.2, zorder=2)
        )
        self.axes.text(x, y, text, ha="center", va="center", fontsize=STYLE.block_text, linespacing=1.4, zorder=4)
        self._include(left + width, bottom, bottom + height)

    def draw_curve(self, x: float, y: float, points: Sequence[tuple[float, float]]) -> None:
        """Draw a curve into a block, about a point [inch]."""
        across, up = zip(*points, strict=True)
        self.axes.plot([x + v for v in across], [y + v for v in up], color="black", lw=1.2, zorder=4)

    def draw_line(self, points: Sequence[tuple[float, float]], *, head: bool = True) -> None:
        """Draw a connection through points, with an arrow's head at its end."""
        x, y = zip(*points, strict=True)
        self.axes.plot(x, y, color="black", lw=1.0, solid_joinstyle="miter", zorder=1)
        if head:
            arrow = {"arrowstyle": "-|>,head_width=0.2,head_length=0.4", "color": "black", "lw": 1.0}
            self.axes.annotate("", points[-1], points[-2], arrowprops=arrow | {"shrinkA": 0.0, "shrinkB": 0.0})
        self._include(max(x), min(y), max(y))

    def draw_branch(self, x: float, y: float) -> None:
        """Draw the point where a line divides."""
        self.axes.plot([x], [y], "o", color="black", ms=3.5, zorder=3)

    def draw_frame(self, left: float, right: float, low: float, high: float, text: str) -> None:
        """Draw a dashed frame around parts that belong together, with their name in its upper left corner."""
        from matplotlib.patches import Rectangle

        self.axes.add_patch(
            Rectangle((left, low), right - left, high - low, fill=False, ec=GREY, lw=0.9, ls=(0, (4, 3)))
        )
        self.write(left + 0.06, high - 0.05, text, ha="left", va="top", color="0.35")
        self._include(right, low, high)

    def write(
        self, x: float, y: float, text: str, *, ha: str = "center", va: str = "center", color: str = "black"
    ) -> None:
        """Write beside what is drawn."""
        self.axes.text(x, y, text, ha=ha, va=va, fontsize=STYLE.small_text, color=color, linespacing=1.2)
        lines, up = text.count("\n") + 1, 0.0 if va == "top" else 0.15
        self._include(self.right, y - 0.15 * lines * (va == "top"), y + up * lines)

    def write_below(self, centre: float, text: str) -> None:
        """Write below a block on the forward path."""
        self.write(centre, -STYLE.block_height / 2 - 0.06, text, va="top", color="0.35")

    def fit(self, figure: "Figure") -> None:
        """Make the figure as large as what is on it."""
        ends = (-STYLE.margin, self.right + STYLE.margin, self.low - STYLE.margin, self.high + STYLE.margin)
        figure.set_size_inches(ends[1] - ends[0], ends[3] - ends[2])
        self.axes.set(xlim=ends[:2], ylim=ends[2:])
        self.axes.axis("off")

    def _include(self, right: float, low: float, high: float) -> None:
        self.right, self.low, self.high = max(self.right, right), min(self.low, low), max(self.high, high)


def signal_lines(signal: Quantity) -> list[str]:
    """A signal's name, and its unit where it has one."""
    return [signal.name] if signal.unit in ("", "1") else [signal.name, f"[{signal.unit}]"]


LAWS = {
    Form.PARALLEL: r"$K_p + \dfrac{K_i}{s} + \dfrac{K_d\,s}{T_f\,s + 1}$",
    Form.STANDARD: r"$K_p\,\left(1 + \dfrac{1}{T_i\,s} + \dfrac{T_d\,s}{1 + s\,T_d/N}\right)$",
    Form.SERIES: r"$K\,\left(1 + \dfrac{1}{T_i\,s}\right)\,\dfrac{T_d\,s + 1}{T_f\,s + 1}$",
}


def plot_loop(loop: ClosedLoop) -> "Figure":
    """Draw the block diagram of a loop: its parts, and its signals with their units; only what the loop has.

    Returns
    -------
    Figure
        As large as the diagram needs.

    Raises
    ------
    InputError
        If it is no `ClosedLoop`.
    """
    from matplotlib.figure import Figure

    check_closed_loop(loop)
    figure = Figure()
    sheet = Sheet(figure.add_axes((0.0, 0.0, 1.0, 1.0)))
    sheet.draw_arrow("reference", loop.feedback.unit, least=1.2 if loop.feedforward else 0.9)
    begin, error = sheet.x, sheet.draw_sum("−")
    sheet.draw_arrow("error", loop.feedback.unit)
    _draw_controller(sheet, loop)
    _draw_sampling(sheet, loop, begin)
    sheet.draw_arrow("control", loop.command.unit, least=sheet.above + 0.15 - sheet.x)
    outlet = _draw_plant(sheet, loop)
    _draw_feedback(sheet, loop, outlet, error)
    # all states in small print below, and what else the controller gets
    outputs = {q.name: q for q in loop.plant.outputs}
    seen = [*loop.motion_inputs, *(outputs[n] for n in loop.readings)]
    listed = {"States": loop.states, "The controller also gets": seen}
    letters = max(40, int(sheet.right / STYLE.legend_letter_width))
    lines = []
    for title, own in ((title, own) for title, own in listed.items() if own):
        signals = ", ".join(" ".join(signal_lines(q)).replace(" [", "\u00a0[") for q in own)
        lines.append(fill(f"{title}: {signals}", letters, break_on_hyphens=False))
    sheet.write(0.0, sheet.low - 0.12, "\n".join(lines), ha="left", va="top", color="0.35")
    sheet.fit(figure)
    return figure


def _draw_controller(sheet: Sheet, loop: ClosedLoop) -> None:
    """Position loop, PID, and what is added to its command, in the order in which the controller computes them."""
    if loop.outer is not None:  # of a cascade; what the PID is fed back itself is said in words
        sheet.write_below(sheet.draw_block("$K_p$", STYLE.small_width), "position\nloop")
        sheet.draw_arrow(f"{loop.pid_signal.name} wanted", loop.pid_signal.unit)
        sheet.draw_sum(f"− {loop.pid_signal.name}")
        sheet.draw_arrow()
    notes = [f"PID, {loop.pid.form.value} form;", "P sees b r − y, D sees c r − y"]
    notes += ["gains follow position and load"] if loop.schedule else []
    notes += ["the integral has a dead band"] if loop.pid.dead_band else []
    notes += ["the error's change of sign resets it"] if loop.pid.reset else []
    notes += ["it is clamped at a limit"] if loop.pid.limits and loop.pid.anti_windup is AntiWindup.CLAMPING else []
    sheet.write_below(sheet.draw_block(LAWS[loop.pid.form], STYLE.pid_width), "\n".join(notes))
    if loop.feedforward:
        width, height, begin = STYLE.source_width, STYLE.source_height, STYLE.branch
        centre = sheet.draw_source("feedforward\n" + r"gain $\frac{time\;s}{time\;s + 1}$", width, height)
        sheet.draw_branch(begin, 0.0)
        sheet.draw_line([(begin, 0.0), (begin, height), (centre - width / 2, height)])
    for part in loop.compensators:  # each adds to the command that it gets
        sheet.draw_arrow()
        centre = sheet.draw_block(fill(part.section.replace("_", " "), 14), STYLE.compensator_width)
        sheet.write_below(centre, "adds to the\ncommand")
    if loop.dither and not _has_generator(loop):
        _draw_dither(sheet, loop.dither.waveform, "dither: offset +")
    elif loop.dither:
        sheet.draw_source("dither: offset", STYLE.source_width, STYLE.source_height)
    _draw_limits(sheet, loop)


def _draw_sampling(sheet: Sheet, loop: ClosedLoop, begin: float) -> None:
    """What a sampled controller does to its command, the frame around it, and an analogue dither behind it."""
    h = loop.pid.sample_time
    if h is None:
        return
    if loop.pid.delay:
        sheet.draw_arrow()
        sheet.write_below(sheet.draw_block("$z^{-1}$", 0.6), "computing\ndelay")
    sheet.draw_arrow()
    centre = sheet.draw_block("", 0.6)
    steps = [(-0.22, -0.16), (-0.08, -0.16), (-0.08, 0.04), (0.07, 0.04), (0.07, 0.16), (0.22, 0.16)]
    sheet.draw_curve(centre, 0.0, steps)
    sheet.write_below(centre, "hold")
    top = sheet.high + 0.3
    sheet.draw_frame(begin - STYLE.frame, sheet.x + STYLE.frame, -0.98, top, f"controller, every {1e3 * h:g} ms")
    sheet.draw_line([(sheet.x, 0.0), (sheet.x + STYLE.frame, 0.0)], head=False)
    sheet.x += STYLE.frame
    sheet.above = sheet.x
    if loop.dither and _has_generator(loop):
        _draw_dither(sheet, loop.dither.waveform, "dither generator:")
        _draw_limits(sheet, loop)


def _draw_dither(sheet: Sheet, waveform: Waveform, title: str) -> None:
    centre = sheet.draw_source(f"{title}\namplitude ·" + 9 * " ", STYLE.source_width, STYLE.source_height)
    phases = np.linspace(0, 3 * np.pi, 61)
    sheet.draw_curve(
        centre + 0.28, STYLE.source_height - 0.1, list(zip(0.035 * phases, 0.09 * waveform.at(phases), strict=True))
    )


def _draw_limits(sheet: Sheet, loop: ClosedLoop) -> None:
    if loop.pid.limits:
        sheet.draw_arrow(least=0.45)
        centre = sheet.draw_block("", STYLE.small_width)
        sheet.draw_curve(centre, 0.0, [(-0.28, -0.18), (-0.12, -0.18), (0.12, 0.18), (0.28, 0.18)])
        sheet.write_below(centre, "limits lower,\nupper")


def _draw_plant(sheet: Sheet, loop: ClosedLoop) -> float:
    """The plant, its parts, its other inputs from above, its outputs to the right; returns where feedback branches."""
    parts = dict.fromkeys(n.removeprefix("plant.").partition(".")[0] for n in loop.plant.parameters)
    fed_back = loop.sensor.position if isinstance(loop.sensor, Encoder) else loop.feedback.name
    outputs = sorted(loop.plant.outputs, key=lambda q: q.name != fed_back)
    high = max(STYLE.block_height / 2, STYLE.output_spacing * (len(outputs) - 1) + 0.2)
    text = fill(f"plant: {', '.join(parts)}", 23, break_long_words=False)
    centre = sheet.draw_block(text, STYLE.plant_width, low=-STYLE.block_height / 2, high=high)
    driven = loop.inputs[1 + len(loop.motion_inputs) :]
    for k, signal in enumerate(driven):
        x = centre + 0.7 * (k - (len(driven) - 1) / 2)
        sheet.draw_line([(x, high + 0.45), (x, high)])
        sheet.write(x, high + 0.48, "\n".join(signal_lines(signal)), va="bottom")
    # the output that is fed back lies on the forward path, the others above it
    labels = [" ".join(signal_lines(q)) for q in outputs]
    length = STYLE.letter_width * max(map(len, labels)) + 0.3
    for k, label in enumerate(labels):
        y = STYLE.output_spacing * k
        sheet.draw_line([(sheet.x, y), (sheet.x + length + 0.3 * (k == 0), y)])
        sheet.write(sheet.x + 0.08, y + 0.03, label, ha="left", va="bottom")
    return sheet.x + length


def _draw_feedback(sheet: Sheet, loop: ClosedLoop, outlet: float, error: float) -> None:
    """From the plant's output, through the sensor where there is one, to the sum."""
    sheet.draw_branch(outlet, 0.0)
    height = STYLE.wire_height if loop.sensor is None else STYLE.sensor_height
    path = [(outlet, 0.0), (outlet, height), (error, height), (error, -STYLE.circle_radius)]
    if loop.sensor is None:
        sheet.draw_line(path)
        return
    width, place = 2.3, (error + outlet) / 2
    text = r"sensor: $\dfrac{1}{lag\;s + 1}$"
    if isinstance(loop.sensor, Encoder):
        text = "encoder: counts" + ("" if loop.sensor.position == loop.feedback.name else ", difference, filter")
    sheet.draw_line([*path[:2], (place + width / 2, STYLE.sensor_height)])
    sheet.draw_box(place, STYLE.sensor_height, width, text)
    sheet.draw_line([(place - width / 2, STYLE.sensor_height), *path[2:]])
    shown = "sensor.count" if loop.outer and isinstance(loop.sensor, Encoder) else "sensor.reading"
    for q in (q for q in loop.states if q.name == shown):
        sheet.write(
            place - width / 2 - 0.1, STYLE.sensor_height + 0.04, " ".join(signal_lines(q)), ha="right", va="bottom"
        )


def _has_generator(loop: ClosedLoop) -> bool:
    """Whether the dither is added behind a sampled controller."""
    return loop.dither is not None and loop.dither.analogue and loop.pid.sample_time is not None
