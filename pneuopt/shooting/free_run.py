"""`close_gaps`: the run of a fit from its start to its end without gaps, by Newton steps on all segments at once.

Segment after segment, such a run would use one SIMD lane; here each step is one run of all segments. The gaps of a fit
that explains its log are so small that one or two steps close them.
"""

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.shooting.equations import propagate_shifts, segment_gaps
from pneuopt.shooting.solution import Optimum

# Newton steps: fewer leave gaps that another would close, more cost as much as a run from end to end
MAX_STEPS = 3
# shift of a node that open gaps still cause, in nominal sizes: higher shows in the errors of the run, lower is rounding
MAX_SHIFT = 1e-6


def close_gaps(optimum: Optimum) -> Array | None:
    """The outputs of a fit's run without gaps between linked segments, shape (m, n, n_outputs).

    Parameters
    ----------
    optimum : Optimum

    Returns
    -------
    ndarray or None
        None where the gaps do not close in a few steps, as those of a model that runs away from its log.
    """
    segments, linear = optimum.equations.segments, optimum.equations.linearisation
    slopes = np.where(segments.linked[:, None, None], linear.end_sensitivities[:, :, : optimum.nodes.shape[1]], 0.0)
    nodes, y, x_end = optimum.nodes, optimum.run.y, optimum.run.x_end
    for _ in range(MAX_STEPS):
        with np.errstate(all="ignore"):  # a run that leaves the model's range has no number, and is not taken
            shift = propagate_shifts(slopes, segment_gaps(segments, nodes, x_end))
            if not np.abs(shift).max(initial=0.0) > MAX_SHIFT:
                return y
            nodes = nodes + shift * segments.nominal
        if not np.isfinite(nodes).all():
            return None
        # by coarse steps, as the sensitivities: what finer ones change is the same beside the old nodes
        run = segments.run(nodes, optimum.values, optimum.substeps)
        y, x_end = optimum.run.y + run.y - linear.y, optimum.run.x_end + run.x_end - linear.x_end
    return None
