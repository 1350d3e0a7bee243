"""Results as matplotlib figures: a fit beside its logs, its residuals, friction, step responses, a Bode plot, studies.

No window is opened and no global state is touched: each function returns a `Figure`, `save_figure` writes it. This is
the only room that imports matplotlib; `cli` may import it. A newcomer adds a figure as a function ``result ->
Figure`` in a file of its subject, with what `canvas` shares.
"""

from pneuopt.plotting.bode import plot_bode
from pneuopt.plotting.canvas import BLUE, GREY, ORANGE, RED, axes_grid, check_figure_path, legend_above, save_figure
from pneuopt.plotting.diagnostics import plot_correlation, plot_residuals
from pneuopt.plotting.distributions import plot_distribution
from pneuopt.plotting.experiment_designs import plot_experiment
from pneuopt.plotting.findings import plot_finding
from pneuopt.plotting.fits import plot_fit, plot_prediction
from pneuopt.plotting.friction_map import friction_force, has_friction_map, plot_friction
from pneuopt.plotting.fronts import plot_front
from pneuopt.plotting.logs import plot_logs
from pneuopt.plotting.loop_diagram import plot_loop
from pneuopt.plotting.loops import Response, plot_steps
from pneuopt.plotting.maps import plot_map
from pneuopt.plotting.sensitivities import plot_sensitivity
from pneuopt.plotting.svg import to_svg
from pneuopt.plotting.texts import replace_unprintable
from pneuopt.plotting.trackings import plot_tracking

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
