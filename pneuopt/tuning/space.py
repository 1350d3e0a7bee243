"""`Space`: the box in which the candidates of a tuning lie, and their rounding.

`LoopLanes`: the loop as it is run for many candidates, on `ReferenceGrid`s of samples that `refine_grids` makes closer
where a response is fast; `read_metrics` reads it. `starts_before_step` finds the states in which its cases wait.
"""

import itertools
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import Any

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout, RolloutResult
from pneuopt.dynamics.integrators import rk4
from pneuopt.dynamics.system import names
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.metric import Band, DitherPeriodMean, band_share
from pneuopt.evaluation.metrics import (
    BandCentre,
    Envelope,
    batch_metrics,
    meter_outputs,
    needed_channels,
    refine_instants,
    spread_instants,
)
from pneuopt.evaluation.requirements import FOLLOWING_METRICS, PUSH
from pneuopt.evaluation.response import (
    TuningCase,
    command_range,
    highest_dither_frequency,
    loop_inputs,
    readings_a_sample,
    sample_spacing,
)
from pneuopt.evaluation.tolerances import MAX_READINGS_A_SAMPLE, MAX_REFINEMENTS, SAMPLES_A_DITHER_PERIOD
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.tolerances import (
    BOUND_DISTANCE,
    MAX_LOOP_SUBSTEPS,
    RUNAWAY_LEVEL,
    SEARCH_TOLERANCE,
    WORST_MERIT,
)


@dataclass(frozen=True, eq=False)
class Space:
    """The free parameters that have an effect, as a box, among all parameters of the loop."""

    parameters: ParameterSet
    names: tuple[str, ...]

    @cached_property
    def bounds(self) -> Array:
        """Lower and upper bounds, shape (n, 2)."""
        return np.array([[self.parameters[n].lower, self.parameters[n].upper] for n in self.names]).reshape(-1, 2)

    @cached_property
    def start(self) -> Array:
        """The given values, shape (n,)."""
        return np.array([self.parameters.value(n) for n in self.names])

    @cached_property
    def structure(self) -> list[tuple[int, float]]:
        """Gains, and where they lie in the unit cube, of controllers of another kind: no integral, no dither and so on.

        A search by small steps reaches none of them.
        """
        off = {"pid.Ki": (0.0,), "dither.amplitude": (0.0, inf), "pid.Tf": (-inf, inf), "pid.N": (-inf, inf)}
        found = list[tuple[int, float]]()
        for k, n in enumerate(self.names):
            for value in off.get(n, ()):
                point = self.start.copy()
                point[k] = np.clip(value, *self.bounds[k])
                found.append((k, float(self.to_unit(point)[k])))
        return found

    def parameters_at(self, point: Array) -> ParameterSet:
        """The loop's parameters with the free ones at `point`."""
        return self.parameters.with_values(dict(zip(self.names, np.clip(point, *self.bounds.T).tolist(), strict=True)))

    def from_unit(self, unit: Array) -> Array:
        """Map numbers between 0 and 1 to points, shape (..., n): along the range, or its logarithm where flagged."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        tiny = np.where(log, low, 1.0)
        drawn: Array = np.where(log, tiny * (np.where(log, up, 1.0) / tiny) ** unit, low + (up - low) * unit)
        return np.clip(drawn, low, up)

    def to_unit(self, point: Array) -> Array:
        """Map points to numbers between 0 and 1: the inverse of `from_unit`."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        safe = np.where(log, [low, up, point], 1.0)
        share: Array = np.where(
            log, np.log(safe[2] / safe[0]) / np.log(safe[1] / safe[0] + ~log), (point - low) / (up - low)
        )
        return share

    def from_unit_slope(self, points: Array) -> Array:
        """The derivative of `from_unit` at points, shape (..., n)."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        ratio = np.where(log, up, 1.0) / np.where(log, low, 1.0)
        return np.asarray(np.where(log, points * np.log(ratio), up - low))

    def corners(self) -> Array:
        """Every corner of the box and the start, shape (2**n + 1, n)."""
        return np.array([*itertools.product(*self.bounds), self.start])

    def vectors(self, points: Array) -> Array:
        """Every parameter's value at each point, shape (m, n_parameters)."""
        rows = np.tile([p.value for p in self.parameters.values()], (len(points), 1))
        rows[:, [list(self.parameters).index(n) for n in self.names]] = np.clip(points, *self.bounds.T)
        return rows

    def round_point(self, point: Array, digits: int) -> Array:
        """Round a point to so many significant digits, within the bounds, shape (n,); near a bound it is the bound."""
        found = np.array(point)
        for k, (value, (low, up)) in enumerate(zip(point.tolist(), self.bounds.tolist(), strict=True)):
            at = next((b for b in (low, up) if abs(value - b) <= BOUND_DISTANCE * (up - low)), None)
            if at is not None and not self.parameters[self.names[k]].log:
                found[k] = at
                continue
            rounded = (_round_digits(value + n * _last_place(value, digits), digits) for n in (0, -1, 1))
            found[k] = next((v for v in rounded if low <= v <= up), value)
        return found

    def neighbours(self, rounded: Array, digits: int) -> Array:
        """The points that differ from a rounded one by a last place in one coordinate, shape (m, n) with m <= 2 n."""
        found = []
        for k, (value, (low, up)) in enumerate(zip(rounded.tolist(), self.bounds, strict=True)):
            sides = (_round_digits(value + n * _last_place(value, digits), digits) for n in (-1, 1)) if value else ()
            found += [np.where(np.arange(len(rounded)) == k, v, rounded) for v in sides if low <= v <= up]
        return np.reshape(found, (-1, len(rounded)))

    def lattice(self, rounded: Array, digits: int, most: int = 20_000, reach: int = 40) -> Array:
        """The points that differ from a rounded one by some last places in every coordinate, shape (m, n).

        By up to `reach` places; where these are more than `most` points by fewer, and of many gains some at random.

        Examples
        --------
        >>> from pneuopt.quantities.parameters import Parameter
        >>> space = Space(ParameterSet({"pid.Kp": Parameter(0.4, "1", 0.0, 0.4001, free=True)}), ("pid.Kp",))
        >>> space.lattice(space.start, 4, reach=2).ravel().round(4).tolist()
        [0.3998, 0.3999, 0.4, 0.4001]
        """
        places = np.array([_last_place(value, digits) for value in rounded.tolist()])
        n = int(np.count_nonzero(places))
        reach = max(1, min(reach, int((float(most) ** (1.0 / max(1, n)) - 1) / 2)))
        sides = np.arange(-reach, reach + 1)
        if len(sides) ** n > most:
            offsets = np.random.default_rng(0).integers(-reach, reach + 1, (most, n))
        else:
            offsets = np.array(list(itertools.product(sides, repeat=n)))
        points = np.tile(rounded, (len(offsets), 1))
        points[:, places > 0] += offsets * places[places > 0]
        low, up = self.bounds.T
        slack = 1e-3 * places
        return np.asarray(points[((points >= low - slack) & (points <= up + slack)).all(axis=1)])


def _last_place(value: float, digits: int) -> float:
    """The value of a one in the last of so many significant digits; 0 for a value of 0."""
    return float(10.0 ** (np.floor(np.log10(abs(value))) - digits + 1)) if value else 0.0


def _round_digits(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def search_space(loop: ClosedLoop, parameters: ParameterSet) -> Space:
    """Span a `Space` by the free parameters; an `InputError` unless all are the controller's and have finite bounds."""
    full = loop.complete(parameters).select(loop.parameters)
    free = tuple(n for n in parameters.free_names if n in loop.parameters)
    require(len(free) > 0, 'nothing is free; mark what may be tuned: parameters.freed("pid.K*", "dither.offset")')
    divisors = {"dither.frequency", *(f"pid.{n}" for n in loop.pid.positive_parameters)}
    for n in free:
        require(
            n.partition(".")[0] in loop.controller.tunable_sections,
            f"{n} is free, but tune changes the controller and the dither only; use parameters.fixed({n!r})",
        )
        message = f"{n} is free, but it says what a machine does in a fault; use parameters.fixed({n!r})"
        require(n.removeprefix("pid.") not in loop.pid.fixed_parameters, message)
        p = full[n]
        require(
            bool(np.isfinite([p.lower, p.upper]).all()) and p.lower < p.upper,
            f"{n} is free within [{p.lower:g}, {p.upper:g}] {p.unit}: it needs two finite bounds, "
            f"parameters.with_bounds({{{n!r}: (lower, upper)}}), or fix it",
        )
        require(n not in divisors or p.lower > 0, f"{n}: its lower bound must be positive, got {p.lower:g} {p.unit}")
        if n == "dither.amplitude":
            low, high, whose = command_range(loop, full)
            message = (
                f"dither.amplitude may reach {p.upper:g} {p.unit}, but {whose} ends at {low:g} and {high:g} {p.unit}"
            )
            peaks = f"which cuts the peaks of more than {(high - low) / 2:g} {p.unit}; lower its upper bound"
            require(2 * p.upper <= high - low, f"{message}, {peaks}")
        require(
            not p.log or p.lower > 0, f"{n}: a log parameter needs a positive lower bound, got {p.lower:g} {p.unit}"
        )
    return Space(full, free)


def whole_space(loop: ClosedLoop, parameters: ParameterSet) -> Space:
    """Every parameter of the loop, none of them to be changed."""
    return Space(loop.complete(parameters).select(loop.parameters), ())


def shapes_linear_loop(loop: ClosedLoop, n: str) -> bool:
    """Whether the linearised loop depends on a parameter of the controller."""
    section, _, name = n.partition(".")
    acting = {"dither", "position_loop", "schedule", *(part.section for part in loop.controller.acting_always)}
    return section in acting or (section == "pid" and name in loop.pid.form.gains)


def clip_level(loop: ClosedLoop, p: ParameterSet) -> float:
    """The largest size of a command that the controller's own limits let through [its unit]; inf without limits."""
    return max(abs(p.value("pid.lower")), abs(p.value("pid.upper"))) if loop.pid.limits else float("inf")


def dither_resolution_rate(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """The rate [1/s] at which RK4 steps resolve an analogue dither between two samples; 0 for any other dither."""
    between = loop.dither is not None and loop.dither.analogue and loop.pid.sample_time is not None
    return RK4_MAX_H_LAMBDA * SAMPLES_A_DITHER_PERIOD * highest_dither_frequency(loop, parameters) if between else 0.0


def fastest_eigenvalue(loop: ClosedLoop, p: Array, states: Sequence[Array]) -> Array:
    """The size of the loop's largest eigenvalue over some states [1/s], for each row of parameters, shape (m,)."""
    system = loop.system() if loop.pid.sample_time is None else loop.hold_system()
    x, q = ca.SX.sym("x", len(system.states)), ca.SX.sym("p", len(system.parameters))
    rates = system.ode(0, x, np.zeros(len(system.inputs)), q)[0]
    slope = ca.Function("slope", [x, q], [ca.densify(ca.jacobian(rates, x))])
    rows, n = len(states) * len(p), x.numel()
    found = slope.map(rows)(np.tile(np.array(states), (len(p), 1)).T, np.repeat(p, len(states), axis=0).T)
    A = found.full().reshape(n, rows, n).transpose(1, 0, 2)
    sizes = np.abs(np.linalg.eigvals(A)).max(axis=1, initial=0.0)
    return np.asarray(sizes.reshape(len(p), len(states)).max(axis=1))


def rk4_substeps(rate: float, h: float) -> int:
    """RK4 steps in a sample of h [s] for a stable mode of this rate [1/s]; an `InputError` where they are too many."""
    k = int(np.ceil(rate * h / RK4_MAX_H_LAMBDA))
    require(
        k <= MAX_LOOP_SUBSTEPS,
        f"within the bounds the loop has a mode as fast as {rate:.3g} 1/s, which takes {k} steps in {h:.3g} s, at most "
        f"{MAX_LOOP_SUBSTEPS}; narrow the gains' bounds (raise the lower one of pid.Tf), smooth the friction, "
        "or shorten h",
    )
    return max(1, k)


def starts_before_step(cases: Sequence[TuningCase], loop: ClosedLoop, space: Space) -> list[Array | None]:
    """Of each case the state before the step (n_states,), None where it depends on the gains.

    References that begin alike share it, as a rest takes milliseconds.
    """
    found, scale = dict[tuple[Hashable, ...], Array | None](), np.array([q.nominal for q in loop.states])
    keys = [(case.scenario, case.reference.origin, *sorted(case.reference.start.items())) for case in cases]
    for key, case in zip(keys, cases, strict=True):
        if key not in found:
            other = [space.from_unit(np.full(len(space.names), 0.7))] if space.names else []
            first, *moved = (case.initial(loop, space.parameters_at(point)) for point in (space.start, *other))
            found[key] = first if all(np.all(np.abs(first - x) <= 1e-9 * scale) for x in moved) else None
    return [found[key] for key in keys]


# Indices of the outputs that are run: the measured signal, the command, then the meter's channels one after another;
# under dither the signal's integral is the last output and the last state.
SIGNAL_OUTPUT, CONTROL_OUTPUT, METER_OUTPUT, INTEGRAL_OUTPUT = [*range(3), -1]


@dataclass(frozen=True, eq=False)
class ReferenceGrid:
    """Samples t (n,) and inputs u (n, n_inputs) at which the response to one reference is run and read.

    `spacing` [s] is the largest distance of two samples, `sample_time` [s] the controller's, None for a continuous one.
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
    """The loop's sampled step, with the measured signal, the command and channels of the meter as its outputs.

    The axis's speed follows (`speed_output`); under dither the signal's integral is one more state and the last output.
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
    update = None
    if loop.pid.sample_time is not None:  # the controller acts where the instant t is one of its samples
        near = 0.25 / MAX_READINGS_A_SAMPLE
        acts = ca.fmod(t / loop.pid.sample_time + near, 1.0) < 2 * near
        updated = ca.if_else(acts, loop.update(t, x, u, p), x)
        update = ca.Function("update", [t, z, u, p], [ca.vertcat(updated, total)])
    return Pieces(step, update, ca.Function("ode", [t, z, u, p], [rates(t, z)[0], y]))


def speed_output(loop: ClosedLoop, channels: Sequence[str]) -> int | None:
    """Index of the axis's speed among the outputs of `loop_pieces`; None without an axis."""
    return None if loop.plant.axis is None else METER_OUTPUT + len(channels)


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
    """The metrics `only`, shape (m,), of outputs y (m, n, n_outputs) of `loop_pieces` that do not run away.

    Over several bands the settling time is the mean (`penalty_settling_time`), of the signal where that is asked for;
    `period` [s] is the averaging time.
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
        settling = "SettlingTimeRaw" if "SettlingTimeRaw" in only else "SettlingTime"
        times = np.column_stack([found[settling], found["SettlingTimes"]])
        most = penalty_settling_time(reference.horizon - reference.at, excess)[:, None]
        found[settling] = np.where(np.isnan(times), most, times).mean(axis=1)
    found["Excess"] = excess
    return {n: found[n] for n in only}


def meter_values(y: Array, channels: Sequence[str]) -> dict[str, Array]:
    """The meter's channels by name, from outputs that are the last axis of y."""
    return {channel: y[..., METER_OUTPUT + k] for k, channel in enumerate(channels)}


def penalty_settling_time(scale: float, excess: Array) -> Array:
    """The settling time that a search assigns to a response that never settles [s], larger for a larger error."""
    return np.asarray(scale * (2 + np.minimum(excess, WORST_MERIT)))


def reference_grids(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    samples_a_period: int = SAMPLES_A_DITHER_PERIOD,
) -> list[ReferenceGrid]:
    """The samples of each reference, with so many samples in the period of a continuous dither."""
    found = []
    for reference in references:
        h = sample_spacing(loop, reference, parameters, samples_a_period)
        run, k = loop_inputs(loop, reference, h), readings_a_sample(loop, reference)
        number = np.arange(k * (len(run) - 1) + 1)
        t: Array = np.asarray(number * (h / k), dtype=np.float64)
        found.append(
            ReferenceGrid(reference, t, run.matrix(names(loop.inputs))[number // k], h / k, loop.pid.sample_time)
        )
    return found


def refine_grids(
    grids: list[ReferenceGrid], cases: Sequence[Mask], read: Callable[[int, ReferenceGrid], Array | None]
) -> list[ReferenceGrid]:
    """Grids close enough for the responses that `read` gives, None where one runs away; the same list where they are.

    Each grid comes with the cases (n_cases,) that run on it.
    """
    finer = []
    for grid, own in zip(grids, cases, strict=True):
        reference, found = grid.reference, list[Array]()
        change = reference.final, reference.nominal_size, reference.at
        for case in np.flatnonzero(own).tolist():
            closer = grid
            for _ in range(MAX_REFINEMENTS):
                signal = read(case, closer)
                instants = signal if signal is None else refine_instants(closer.t, signal, *change, SEARCH_TOLERANCE)
                if instants is None:
                    break
                closer = closer.at(instants)
            found.append(closer.t)
        t = np.unique(np.concatenate(found))
        least = 1e-6 * grid.spacing  # the same instant, but for rounding
        finer.append(grid.at(spread_instants(grid.t, t[np.append(True, np.diff(t) > least)], grid.reference.at)))
    more = any(len(new.t) > len(old.t) for new, old in zip(finer, grids, strict=True))
    return finer if more else grids
