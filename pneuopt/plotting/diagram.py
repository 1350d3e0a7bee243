"""`Sheet`: boxes, sums, arrows and labels of a block diagram, along a forward path."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pneuopt.plotting.canvas import BLUE, GREY
from pneuopt.quantities.parameters import Quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLOCK_HEIGHT, CIRCLE_RADIUS, ARROW_LENGTH = 0.62, 0.12, 0.3  # [inch]; the arrow's where it has no label
BLOCK_TEXT, SMALL_TEXT = 9.0, 8.0  # [points] inside a block, and beside an arrow or below a block
LETTER_WIDTH = 0.064  # [inch] of a letter beside an arrow: with less, labels overlap; with more, arrows are long
LEGEND_LETTER_WIDTH = 0.055  # [inch] of a letter in running text: with less, lines run off the figure
MARGIN = 0.15  # [inch] around the diagram
BLOCK_COLOUR = "#eef4fa"


class Sheet:
    """The paper, in inches, and a pen on the forward path, which lies at height 0.

    Attributes
    ----------
    x : float
        Where the next part of the forward path begins.
    above : float
        Where the last block above the forward path ends.
    right, low, high : float
        The edges of what is drawn so far; the left one is 0.
    """

    def __init__(self, axes: "Axes") -> None:
        self.axes = axes
        self.x = self.above = self.right = self.low = self.high = 0.0

    def draw_arrow(self, name: str = "", unit: str = "", *, least: float = ARROW_LENGTH) -> None:
        """Go on along the forward path, as far as the label needs, which stands above the arrow."""
        lines = [line for line in (name, f"[{unit}]" if unit else "") if line]
        length = max(least, LETTER_WIDTH * max(map(len, lines), default=0) + 0.16)
        self.draw_line([(self.x, 0.0), (self.x + length, 0.0)])
        self.write(self.x + length / 2 - 0.03, 0.05, "\n".join(lines), va="bottom")
        self.x += length

    def draw_block(self, text: str, width: float, *, low: float = -BLOCK_HEIGHT / 2, high: float = 0.0) -> float:
        """Draw a block on the forward path, by default one as high as the others; returns its centre."""
        centre, high = self.x + width / 2, high or -low
        self.draw_box(centre, (low + high) / 2, width, text, height=high - low)
        self.x += width
        return centre

    def draw_sum(self, sign_below: str = "") -> float:
        """Draw a sum on the forward path, with the sign of what comes from below; returns its centre."""
        from matplotlib.patches import Circle

        centre = self.x + CIRCLE_RADIUS
        self.axes.add_patch(Circle((centre, 0.0), CIRCLE_RADIUS, fc="white", ec="black", lw=1.0, zorder=3))
        self.axes.text(centre, -0.005, "+", ha="center", va="center_baseline", fontsize=BLOCK_TEXT, zorder=4)
        self.write(centre + 0.12, -CIRCLE_RADIUS - 0.1, sign_below)
        self.x += 2 * CIRCLE_RADIUS
        return centre

    def draw_source(self, text: str, width: float, height: float) -> float:
        """Draw a sum on the forward path and a block that feeds it, at a height above; returns the centre of both."""
        self.draw_arrow(least=max(ARROW_LENGTH, self.above + 0.15 + width / 2 - self.x - CIRCLE_RADIUS))
        centre = self.draw_sum()
        self.draw_box(centre, height, width, text)
        self.draw_line([(centre, height - BLOCK_HEIGHT / 2), (centre, CIRCLE_RADIUS)])
        self.above = centre + width / 2
        return centre

    def draw_box(self, x: float, y: float, width: float, text: str, *, height: float = BLOCK_HEIGHT) -> None:
        """Draw a block about a point."""
        from matplotlib.patches import FancyBboxPatch

        left, bottom = x - width / 2, y - height / 2
        style = "round,pad=0,rounding_size=0.04"
        self.axes.add_patch(
            FancyBboxPatch((left, bottom), width, height, boxstyle=style, fc=BLOCK_COLOUR, ec=BLUE, lw=1.2, zorder=2)
        )
        self.axes.text(x, y, text, ha="center", va="center", fontsize=BLOCK_TEXT, linespacing=1.4, zorder=4)
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
        self.axes.text(x, y, text, ha=ha, va=va, fontsize=SMALL_TEXT, color=color, linespacing=1.2)
        lines, up = text.count("\n") + 1, 0.0 if va == "top" else 0.15
        self._include(self.right, y - 0.15 * lines * (va == "top"), y + up * lines)

    def write_below(self, centre: float, text: str) -> None:
        """Write below a block on the forward path."""
        self.write(centre, -BLOCK_HEIGHT / 2 - 0.06, text, va="top", color="0.35")

    def fit(self, figure: "Figure") -> None:
        """Make the figure as large as what is on it."""
        ends = (-MARGIN, self.right + MARGIN, self.low - MARGIN, self.high + MARGIN)
        figure.set_size_inches(ends[1] - ends[0], ends[3] - ends[2])
        self.axes.set(xlim=ends[:2], ylim=ends[2:])
        self.axes.axis("off")

    def _include(self, right: float, low: float, high: float) -> None:
        self.right, self.low, self.high = max(self.right, right), min(self.low, low), max(self.high, high)


def signal_lines(signal: Quantity) -> list[str]:
    """A signal's name, and its unit where it has one."""
    return [signal.name] if signal.unit in ("", "1") else [signal.name, f"[{signal.unit}]"]
