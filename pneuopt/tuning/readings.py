"""The outputs that a search runs, the grid on which it samples a reference, and the metrics that it reads there."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.compiled.rollout import Pieces
from pneuopt.dynamics.runge_kutta import rk4
from pneuopt.dynamics.system import names
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.dither_mean import DitherPeriodMean
from pneuopt.evaluation.meter import meter_outputs
from pneuopt.evaluation.metrics import BandCentre, Envelope, batch_metrics
from pneuopt.evaluation.motion_requirements import FOLLOWING_METRICS, PUSH
from pneuopt.evaluation.response import MAX_READINGS_A_SAMPLE
from pneuopt.quantities.arrays import Array

# Indices of the outputs that are run: the measured signal, the command, then the meter's channels one after another.
SIGNAL_OUTPUT, CONTROL_OUTPUT, METER_OUTPUT = range(3)
INTEGRAL_OUTPUT = -1  # index of the signal's integral, under dither the last output and the last state
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
