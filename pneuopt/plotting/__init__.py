"""Results as matplotlib figures: a fit beside its logs, its residuals, friction, step responses, a Bode plot, studies.

No window is opened and no global state is touched: each function returns a `Figure`, `save_figure` writes it. This is
the only room that imports matplotlib; `cli` may import it. A newcomer adds a figure as a function ``result ->
Figure`` in a file of its subject, with what `canvas` shares.
"""

from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    axes_grid,
    check_figure_path,
    legend_above,
    replace_unprintable,
    save_figure,
    to_svg,
)
from pneuopt.plotting.diagram import plot_loop
from pneuopt.plotting.fits import (
    friction_force,
    has_friction_map,
    plot_correlation,
    plot_fit,
    plot_friction,
    plot_prediction,
    plot_residuals,
)
from pneuopt.plotting.logs import plot_finding, plot_logs
from pneuopt.plotting.loops import Response, plot_bode, plot_steps
from pneuopt.plotting.studies import (
    plot_distribution,
    plot_experiment,
    plot_front,
    plot_map,
    plot_sensitivity,
    plot_tracking,
)

__all__ = [
    "BLUE",
    "GREY",
    "ORANGE",
    "RED",
    "Response",
    "axes_grid",
    "check_figure_path",
    "friction_force",
    "has_friction_map",
    "legend_above",
    "plot_bode",
    "plot_correlation",
    "plot_distribution",
    "plot_experiment",
    "plot_finding",
    "plot_fit",
    "plot_friction",
    "plot_front",
    "plot_logs",
    "plot_loop",
    "plot_map",
    "plot_prediction",
    "plot_residuals",
    "plot_sensitivity",
    "plot_steps",
    "plot_tracking",
    "replace_unprintable",
    "save_figure",
    "to_svg",
]
