"""The outputs that a search runs, the grid on which it samples a reference, and the metrics that it reads there."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout, RolloutResult
from pneuopt.dynamics.runge_kutta import rk4
from pneuopt.dynamics.system import names
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.dither_mean import DitherPeriodMean
from pneuopt.evaluation.meter import meter_outputs, needed_channels
from pneuopt.evaluation.metrics import BandCentre, Envelope, batch_metrics
from pneuopt.evaluation.motion_requirements import FOLLOWING_METRICS, PUSH
from pneuopt.evaluation.response import MAX_READINGS_A_SAMPLE
from pneuopt.quantities.arrays import Array, Mask

# Indices of the outputs that are run: the measured signal, the command, then the meter's channels one after another.
SIGNAL_OUTPUT, CONTROL_OUTPUT, METER_OUTPUT = range(3)
INTEGRAL_OUTPUT = -1  # index of the signal's integral, under dither the last output and the last state
# Size of an output [its unit] from which a response counts as running away. A lower level may be reached by sound
# signals in small units (pressures in Pa); beyond a higher one the metrics of a diverging response lose their digits.
RUNAWAY_LEVEL = 1e12
# The largest objective that a search tells apart, in place of infinity. Below what objectives reach (seconds, percent,
# volts) good designs would tie; far above it the grading of broken limits, which is multiplied by it, loses digits.
WORST_MERIT = 1e6


@dataclass(frozen=True, eq=False)
class ReferenceGrid:
    """The samples at which the response to one reference is run and read.

    Attributes
    ----------
    reference : Reference
    t : ndarray, shape (n,)
    u : ndarray, shape (n, n_inputs)
    spacing : float
        The largest distance between two samples [s]; under dither and of sampled loops it is that of all.
    sample_time : float or None
        The controller's, if it is sampled [s].
    """

    reference: Reference
    t: Array
    u: Array
    spacing: float
    sample_time: float | None = None

    @property
    def step_index(self) -> int:
        """The index of the first sample at or after the step."""
        return int(np.searchsorted(self.t, self.reference.at - 1e-12))

    def cut(self, duration: float) -> "ReferenceGrid":
        """The samples up to so long after the step [s]; of a sampled loop up to a sample of its controller."""
        last = int(np.searchsorted(self.t, self.reference.at + duration - 1e-12))
        if self.sample_time is not None:
            readings = round(self.sample_time / self.spacing)
            last = -(-last // readings) * readings
        if last >= len(self.t) - 1:
            return self
        reference = self.reference.with_horizon(float(self.t[last]))
        return replace(self, reference=reference, t=self.t[: last + 1], u=self.u[: last + 1])

    def pad(self, n: int) -> tuple[Array, Array, Array]:
        """Inputs, instants and steps, the last sample repeated up to n samples with steps of 0: there a run ends.

        A held controller would act again at each of them: they lie between two of its samples.
        """
        k, added = np.minimum(np.arange(n), len(self.t) - 1), np.arange(n) >= len(self.t)
        later = 0.0 if self.sample_time is None else 0.5 * self.spacing * added
        return self.u[k], self.t[k] + later, np.append(np.diff(self.t), 0.0)[k]

    def at(self, t: Array) -> "ReferenceGrid":
        """The same inputs, held as before, at other instants between the first and the last."""
        return replace(self, t=t, u=self.u[np.searchsorted(self.t, t, side="right") - 1])


class LoopLanes:
    """The one simulator of a loop in SIMD lanes: searches, batches of plants and sensitivities run and read it.

    `compile_pieces` makes the `Rollout` of `loop_pieces`, with the meter's `channels` that the metrics need.
    """

    def __init__(
        self, loop: ClosedLoop, metrics: Collection[str], compile_pieces: Callable[[Pieces], Rollout] = Rollout
    ) -> None:
        self.loop, self.channels = loop, needed_channels(metrics)
        self.rollout = compile_pieces(loop_pieces(loop, self.channels))
        self._order = list(loop.parameters)

    def with_integral(self, states: Array) -> Array:
        """The loop's states, shape (m, n), with those that `loop_pieces` adds, zero before the step."""
        return np.pad(states, ((0, 0), (0, int(has_integral(self.loop)))))

    def run(
        self, grid: ReferenceGrid, x0: Array, p: Array, substeps: int, states: int = 0
    ) -> tuple[RolloutResult, Mask]:
        """Run lanes of start states, shape (m, n_states), on one grid; and which of them do not run away."""
        u, t, h = grid.pad(len(grid.t))
        with np.errstate(all="ignore"):
            found = self.rollout.run(x0, u, p, t, h, substeps=substeps, states=states)
        return found, is_sound(found.y, found.x_end)

    def states_along(self, grid: ReferenceGrid, x0: Array, p: Array, substeps: int) -> list[Array]:
        """The loop's states along one response, its start first, as far as they are finite."""
        found = self.run(grid, x0[None], p, substeps, max(1, len(grid.t) // 10))[0].x
        assert found is not None
        rows = np.vstack([x0, found[0]])[:, : len(self.loop.states)]
        return list(rows[np.isfinite(rows).all(axis=1)])

    def periods(self, p: Array) -> Array:
        """The time over which each lane is averaged, shape (m,) [s]; 0: it is not."""
        dither, found = self.loop.dither, np.zeros(len(p))
        if dither is not None:
            amplitude, frequency = (p[:, self._order.index(f"dither.{n}")] for n in ("amplitude", "frequency"))
            for rate in np.unique(frequency[amplitude != 0]).tolist():
                found[(amplitude != 0) & (frequency == rate)] = dither.period(rate, self.loop.pid.sample_time)
        return found

    def read(
        self,
        grid: ReferenceGrid,
        y: Array,
        p: Array,
        sound: Mask,
        bands: Sequence[Band],
        only: Collection[str],
        envelope: Envelope = (),
    ) -> Iterator[tuple[float, Mask, dict[str, Array]]]:
        """The metrics of the sound lanes, by their averaging time: that, a mask of its lanes, and `read_metrics`."""
        planes = np.ascontiguousarray(np.moveaxis(y, 2, 0))  # reading is over time, several times faster so
        periods = self.periods(p)
        for period in np.unique(periods[sound]).tolist():
            rows = sound & (periods == period)
            seen = np.moveaxis(planes if rows.all() else planes[:, rows], 0, 2)
            yield period, rows, read_metrics(grid, seen, bands, period or None, only, envelope, self.channels)


def is_sound(y: Array, x_end: Array) -> Mask:
    """Which lanes did not run away, shape (m,)."""
    with np.errstate(all="ignore"):
        tame = (y.max(axis=(1, 2)) < RUNAWAY_LEVEL) & (y.min(axis=(1, 2)) > -RUNAWAY_LEVEL)  # NaN is neither
    return np.asarray(tame & np.isfinite(x_end).all(axis=1))


def loop_pieces(loop: ClosedLoop, channels: Sequence[str] = ()) -> Pieces:
    """Build the loop's sampled step with the measured signal, the command and channels of the meter as its outputs.

    The axis's speed follows, where there is an axis (`speed_output`); under dither the signal's integral, zero at the
    start, is one more state and the last output.
    """
    discrete, outputs = loop.discrete(), names(loop.outputs)
    ode = (loop.system() if loop.pid.sample_time is None else loop.hold_system()).ode
    kept = [outputs.index(loop.feedback.name), outputs.index("control")]
    t, h, x, u, p = (ca.SX.sym(n, discrete.step.size1_in(i)) for i, n in enumerate("thxup"))
    total = ca.SX.sym("integral", int(has_integral(loop)))
    z = ca.vertcat(x, total)

    def rates(t: ca.SX, z: ca.SX) -> tuple[ca.SX, ca.SX]:
        x = z[: len(loop.states)]
        xdot, y = ode(t, x, u, p)
        shown = y[kept]
        if channels:
            shown = ca.vertcat(shown, *meter_outputs(loop, channels, x, u, p, shown[CONTROL_OUTPUT]))
        grown = [] if total.is_empty() else [shown[SIGNAL_OUTPUT]]
        if loop.plant.axis is not None:
            shown = ca.vertcat(shown, x[names(loop.states).index(loop.plant.axis.speed)])
        return ca.vertcat(xdot, *grown), ca.vertcat(shown, z[len(loop.states) :])

    y = rates(t, z)[1]
    after = rk4(lambda at, z: rates(at, z)[0], t, h, z)
    step = ca.Function("step", [t, h, z, u, p], [after, y], {"cse": True})
    update = discrete.update and ca.Function(
        "update", [t, z, u, p], [ca.vertcat(_update_at_sample(loop, t, x, u, p), total)]
    )
    return Pieces(step, update, ca.Function("ode", [t, z, u, p], [rates(t, z)[0], y]))


def speed_output(loop: ClosedLoop, channels: Sequence[str]) -> int | None:
    """Index of the axis's speed among the outputs of `loop_pieces`; None without an axis."""
    return None if loop.plant.axis is None else METER_OUTPUT + len(channels)


def _update_at_sample(loop: ClosedLoop, t: ca.SX, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """The state after the controller's update, if the instant t is one of its samples; otherwise the state itself."""
    h = loop.pid.sample_time
    assert h is not None
    near = 0.25 / MAX_READINGS_A_SAMPLE
    return ca.if_else(ca.fmod(t / h + near, 1.0) < 2 * near, loop.update(t, x, u, p), x)


def has_integral(loop: ClosedLoop) -> bool:
    """Whether `loop_pieces` has the signal's integral as a state: under dither."""
    return loop.dither is not None


def read_metrics(
    grid: ReferenceGrid,
    y: Array,
    bands: Sequence[Band],
    period: float | None,
    only: Collection[str],
    envelope: Envelope,
    channels: Sequence[str] = (),
) -> dict[str, Array]:
    """Read the metrics `only` off responses that do not run away.

    Parameters
    ----------
    grid : ReferenceGrid
    y : ndarray, shape (m, n, n_outputs)
        The outputs of `loop_pieces`.
    bands : sequence of float or Tolerance
        Settling bands. Over several SettlingTime is the mean; a response that does not settle
        counts as `penalty_settling_time`.
    period : float or None
        The time over which the signal is averaged [s].
    only : collection of str
    envelope : sequence of (float, float, float)
    channels : sequence of str
        The meter's, in the order of the outputs.

    Returns
    -------
    dict of str to ndarray, shape (m,)
    """
    reference, signal, since = grid.reference, y[:, :, SIGNAL_OUTPUT], slice(grid.step_index, None)
    late = slice(int(np.searchsorted(grid.t, 0.8 * reference.horizon + 0.2 * reference.at)), None)
    excess = np.abs(signal[:, late] - reference.final).mean(axis=1) / abs(reference.nominal_size)
    averaged = None
    if period is not None:
        averaged = DitherPeriodMean(period, grid.spacing).means(
            signal[:, since], y[:, since, INTEGRAL_OUTPUT], reference.initial
        )
    settings: Any = {
        "start": reference.at,
        "band_centre": BandCentre.REFERENCE,
        "dither_period": period,
        "averaged": averaged,
    }
    settings["sample_time"] = grid.sample_time
    settings["scale"] = None if reference.changes else reference.nominal_size
    given = (grid.t, signal, reference.final, reference.initial)
    settings["control"], meter = y[:, :, CONTROL_OUTPUT], meter_values(y, channels)
    if FOLLOWING_METRICS & set(only):
        settings["target"] = reference.values(grid.t)
    settings["push"] = reference.disturbance.get(PUSH, 0.0)
    shares = [band_share(band, reference) for band in bands]
    settings["wider"] = shares[1:]
    found = batch_metrics(*given, band=shares[0], envelope=envelope, only=only, meter=meter, **settings)
    if len(bands) > 1:
        times = np.column_stack([found["SettlingTime"], found["SettlingTimes"]])
        most = penalty_settling_time(reference.horizon - reference.at, excess)[:, None]
        found["SettlingTime"] = np.where(np.isnan(times), most, times).mean(axis=1)
    found["Excess"] = excess
    return {n: found[n] for n in only}


def meter_values(y: Array, channels: Sequence[str]) -> dict[str, Array]:
    """The meter's channels by name, from outputs that are the last axis of y."""
    return {channel: y[..., METER_OUTPUT + k] for k, channel in enumerate(channels)}


def penalty_settling_time(scale: float, excess: Array) -> Array:
    """The settling time that a search assigns to a response that never settles [s], larger for a larger error."""
    return np.asarray(scale * (2 + np.minimum(excess, WORST_MERIT)))
