"""Operating points of a step response, and a loop's margins at each of them; the worst one counts.

A nonlinear loop has as many margins as it has operating points. Three count here, since a loop stays near each of them
for long enough to oscillate there:

* where it waits for the step, "at rest", or "at the start" where it moves: bristles or a steep Coulomb curve stiffen a
  resting drive, a dead zone or an overlap opens its loop;
* "sliding", at the response's largest speed: the friction's slope is small there, a hundredth of that at rest, and with
  it the damping of a position loop. The body neither accelerates nor brakes there, so the point is as good as steady;
* "at the end" of the response.

A passage through the friction's falling branch on the way is no such point: it lasts for milliseconds, in which nothing
can grow. Under dither the points are those of the response without its ripple, and the loop is averaged over the ripple
there. A mean over the dither's period alone would smooth a fast command, even under a dither of a picovolt. A plant
whose Jacobian is the same everywhere has one point, its end.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import inf, isnan, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.averaging import is_affine
from pneuopt.control.linear_controller import operating_gains
from pneuopt.control.linear_loop import noise_path, open_loop
from pneuopt.control.loop import ClosedLoop, find_rest, set_sliding_direction
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.dynamics.system import Linearisation, names
from pneuopt.evaluation.dither_mean import period_mean
from pneuopt.evaluation.dither_ripple import remove_ripple
from pneuopt.evaluation.margins import GridResponse, lowest_noise_frequency, margins, noise_gain
from pneuopt.evaluation.metric import Source
from pneuopt.evaluation.requirements import METRICS
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd

AT_REST, AT_THE_START, SLIDING, AT_THE_END = "at rest", "at the start", "sliding", "at the end"
FRICTION_SLOPE, NOISE_GAIN = "FrictionSlope", "NoiseGain"
MARGIN_METRICS = tuple(metric.name for metric in METRICS.values() if metric.source is Source.LINEAR_LOOP)
# Speed below which a body counts as resting, a share of its state's nominal value; a rest's own rounding lies below.
RESTING_SPEED = 1e-9


# Share of the largest speed by which a speed may miss it and count as the largest: below, rounding chooses between the
# instants of a steady motion; above, the body still accelerates.
SPEED_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A point at which a loop is linearised.

    Attributes
    ----------
    name : str
        "at rest", "at the start", "sliding" or "at the end".
    t : float
        When the response passes it [s].
    x : ndarray, shape (n_plant_states,)
    inputs : mapping of str to float
        The plant's inputs there, the command and the disturbances; absent ones are zero.
    """

    name: str
    t: float
    x: Array
    inputs: Mapping[str, float]


def operating_points(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> tuple[OperatingPoint, ...]:
    """The operating points that a step response passes; see the module.

    Parameters
    ----------
    loop : ClosedLoop
        With inputs for the reference's disturbances (`add_disturbances`).
    parameters : ParameterSet
        Every parameter of the loop.
    reference : Reference
    response : Trajectory
        The loop's states and outputs.
    """
    return tuple(_find_points(loop, parameters, reference, response))


def operating_point_margins(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> "pd.DataFrame":
    """A row for each of the `operating_points`: "point", "t" [s], the metrics of the linear loop, and "stable".

    Parameters as for `operating_points`; the metrics as in `evaluate`.
    """
    import pandas as pd

    return pd.DataFrame(margin_rows(loop, parameters, reference, response))


def margin_rows(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> tuple[dict[str, Any], ...]:
    """The rows of `operating_point_margins`."""
    return tuple(
        _margin_row(loop, parameters, point, reference.horizon)
        for point in operating_points(loop, parameters, reference, response)
    )


def without_ripple(t: Array, y: Array, period: float) -> Array:
    """Signals without their dither's ripple (`remove_ripple`), as they are where the record is shorter than a period.

    Parameters
    ----------
    t : ndarray, shape (n,)
        [s]
    y : ndarray, shape (m, n)
    period : float
        [s]; 0: no dither.

    Returns
    -------
    ndarray, shape (m, n)
    """
    if not 0 < period <= t[-1] - t[0]:
        return y
    first, averaged = y[:, :1], t[t <= t[-1] - period / 2]
    return remove_ripple(t, y, first + period_mean(t, y - first, 0.0, period, averaged), period).signal


def first_largest(speeds: Array) -> Indices:
    """Index of the first entry of each row that is as large as its largest magnitude, but for `SPEED_TOLERANCE`."""
    sizes = np.abs(speeds)
    return np.asarray(np.argmax(sizes >= (1 - SPEED_TOLERANCE) * sizes.max(axis=1, keepdims=True), axis=1))


def worst_margins(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """The worst of each metric over operating points: NaN and infinite where the loop is unstable at one of them.

    Of a gain margin that is the closest to one, of a phase margin the smallest magnitude, of a friction's slope the
    smallest value. A noise gain does not count before the step: a body that sticks answers a constant error of its
    speed's measurement by a command that grows without bound.
    """
    given = list(rows)
    named = [n for n in MARGIN_METRICS if given and n in given[0]]
    return {n: _worst(n, [row[n] for row in given[-counted_points(n, len(given)) :]]) for n in named}


def counted_points(metric: str, count: int) -> int:
    """How many of the last of so many operating points count for a metric; see `worst_margins`."""
    return max(1, count - 1) if metric == NOISE_GAIN else count


def worst_open_loop(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> tuple[str, Linearisation]:
    """The open loop at the operating point where its sensitivity peak is the largest, and the point's name."""
    points = operating_points(loop, parameters, reference, response)
    loops = [(point.name, open_loop(loop, parameters, point.x, point.inputs)) for point in points]
    peaks = [m.max_sensitivity if m.stable else inf for m in (margins(linear) for _, linear in loops)]
    return loops[int(np.argmax(peaks))]


def friction_slope(loop: ClosedLoop, parameters: ParameterSet, linear: Linearisation) -> dict[str, float]:
    """FrictionSlope: derivative of the steady friction force to speed [N s/m]; for drives with a load.

    This is the viscous friction of the linearised plant, or open loop, at low frequencies, where the bristles follow
    the speed. A negative slope makes crawl likely.
    """
    states, axis = names(loop.plant.states), loop.plant.axis
    if axis is None or not any(n.startswith("friction.") for n in loop.plant.parameters):
        return {}
    A = linear.A
    v, z = states.index(axis.speed), [k for k, n in enumerate(states) if n.startswith("friction.")]
    bristles = A[v, z] @ np.linalg.solve(A[np.ix_(z, z)], A[z, v]) if z else 0.0
    return {FRICTION_SLOPE: float(-parameters.value(axis.inertia) * (A[v, v] - bristles))}


def _find_points(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> Iterator[OperatingPoint]:
    disturbed = {disturbance_input(n): v for n, v in reference.disturbance.items()}
    t, signals = response.t, response.matrix([*names(loop.plant.states), "control"]).T
    signals = without_ripple(t, signals, loop.dither_period(parameters) or 0.0)

    def point(name: str, k: int) -> OperatingPoint:
        inputs = {loop.command.name: float(signals[-1, k]), **disturbed}
        return OperatingPoint(name, float(t[k]), signals[:-1, k], inputs)

    if not is_affine(loop.plant):
        axis = loop.plant.axis
        at_rest = set_sliding_direction(loop, parameters, reference.origin)
        x, command = find_rest(loop, at_rest, reference.origin, reference.start)
        v = None if axis is None else names(loop.plant.states).index(axis.speed)
        moves = v is not None and abs(x[v]) > RESTING_SPEED * loop.plant.states[v].nominal
        yield OperatingPoint(AT_THE_START if moves else AT_REST, float(t[0]), x, {loop.command.name: command})
        if v is not None:
            first = int(np.searchsorted(t, reference.at))
            yield point(SLIDING, first + int(first_largest(signals[v, None, first:])[0]))
    yield point(AT_THE_END, -1)


def _margin_row(loop: ClosedLoop, parameters: ParameterSet, point: OperatingPoint, horizon: float) -> dict[str, Any]:
    linear, lowest = open_loop(loop, parameters, point.x, point.inputs), lowest_noise_frequency(horizon)
    on_grid = GridResponse.of(linear)
    robust, at = margins(linear, on_grid), (loop, parameters, point.x, point.inputs)
    controller = noise_path(*at) if loop.is_composed else operating_gains(*at)
    found = {
        "MaxSensitivity": robust.max_sensitivity,
        "MaxComplementarySensitivity": robust.max_complementary_sensitivity,
        "GainMargin": robust.gain_margin,
        "PhaseMargin": robust.phase_margin,
        NOISE_GAIN: noise_gain(linear, controller, lowest, on_grid),
    }
    if not robust.stable:
        found = {n: nan if n.endswith("Margin") else inf for n in found}
    slope = friction_slope(loop, parameters, linear)
    return {"point": point.name, "t": point.t, **found, **slope, "stable": robust.stable}


def _worst(metric: str, values: list[float]) -> float:
    if any(isnan(v) for v in values):
        return nan
    if metric == FRICTION_SLOPE:
        return min(values)
    return max(values, key=lambda v: float(METRICS[metric].requirement_value(v)))
