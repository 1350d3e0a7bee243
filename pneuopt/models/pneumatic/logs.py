"""Starts of the identification of a `PneumaticDrive` without a guess from the user: equation error on the logs.

States that are not logged (a pressure, the spool, a temperature) are integrated along the logged motion: with position,
speed and command known, the air follows an ODE of its own (`AirSimulator`). It is stable, because a chamber forgets its
initial pressure through the open edges, and it does not depend on friction. A logged pressure's rate is linear in the
valve's conductance and in conductance times leak. Where no pressure is logged, a search finds the valve with the best
balance of forces. Friction is then the same regression as for a known force (see `models.starts`).

Checks of a log's pressures by the mass balance of the chambers: the chambers' or a line's, gauge or absolute.

`LinePressureCheck`: a sensor at the valve reads the chamber's pressure plus what the line drops, which grows with the
flow: it leads the chamber. The flow is the valve's in the mass balance itself, so that a drop is tried by taking it off
the readings, the flow from the corrected pressures again. A sensor's lag has the opposite sign; a valve that is faster
than stated, or a command that is logged late, looks alike.

`PressureZeroCheck`: by Boyle's law a moving piston changes a pressure in proportion to its absolute value, and the
valve's flow depends on the ratio of absolute pressures. A gauge pressure that is read as absolute violates this,
whatever the valve's conductance and leak. If sensors and supply are all off by an atmosphere, nearly every ratio stays
the same; a wrong exponent looks alike, so this case is not detected.
"""

import functools
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.hooks import Log, Start, Starts
from pneuopt.dynamics.system import Symbols, System, define, discretise, names, parameter_vector, stack
from pneuopt.logs.tolerances import MAX_REGRESSION_ROWS
from pneuopt.models.friction import FrictionModel
from pneuopt.models.pneumatic.cylinder import volumes
from pneuopt.models.starts import (
    RegressionRows,
    choose_filter_time,
    filter_channel,
    filter_motion,
    force_misfit,
    friction_candidates,
    load_columns,
    per_log_values,
)
from pneuopt.models.tolerances import (
    CONDUCTANCE_FACTORS,
    FILTER_TIMES,
    GRID_REFINEMENTS,
    LEADS,
    LEAK_GRID,
    MAX_INTEGRATION_STEP,
    MAX_LINE_RESIDUAL_SHARE,
    MAX_RESIDUAL_SHARE,
    MAX_UNQUESTIONED_SHARE,
    MAX_USUAL_STEPS,
    MAX_WORSE_LEADS,
    MIN_LEAK,
    MIN_LOG_DURATION,
    MIN_RESIDUAL_RATIO,
    PASSES,
    REFINEMENT_STEPS,
    VALVE_SHAPE_GRID,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet, Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ANR_DENSITY, ATMOSPHERE

PRESSURE_NAMES = ("pressure_a", "pressure_b")


class AirSimulator:
    """Compiled integration of a pneumatic drive along given states, position and speed at least, without friction's."""

    def __init__(self, system: System, given_states: Sequence[str]) -> None:
        self.given_states = tuple(given_states)
        self.states = tuple(
            q for q in system.states if q.name not in given_states and not q.name.startswith("friction.")
        )
        inputs = (*system.inputs, *(q for q in system.states if q.name in given_states))
        rates = tuple(Quantity(f"rate_of_{n}", "Pa/s", 1e6) for n in PRESSURE_NAMES)

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
            every = ca.vertcat(*({**x, **u}.get(n, ca.SX(0)) for n in names(system.states)))
            given = ca.vertcat(*(u[n] for n in names(system.inputs)))
            rate = dict(zip(names(system.states), ca.vertsplit(system.ode(t, every, given, stack(p))[0]), strict=True))
            return {q.name: rate[q.name] for q in self.states}, {f"rate_of_{n}": rate[n] for n in PRESSURE_NAMES}

        self._inputs, self._parameters = names(inputs), system.parameters
        inner = define(self.states, inputs, rates, system.parameters, rhs)
        self._rollout = Rollout(Pieces(discretise(inner).step))

    def simulate_states(self, given: Trajectory, sets: Sequence[ParameterSet]) -> list[dict[str, Array]]:
        """States that are not given, arrays (n,) by name, by parameter set; pressures start amid ambient and supply."""
        u = given.matrix(self._inputs)
        inner = [i for i, n in enumerate(self._inputs) if n in self.given_states]
        u[:-1, inner] = (u[:-1, inner] + u[1:, inner]) / 2
        h = np.append(np.diff(given.t), 0.0)
        h = np.minimum(h, MAX_USUAL_STEPS * np.median(h))  # behind a hole of the log the air soon forgets its start
        x0 = np.zeros((len(sets), len(self.states)))
        for row, p in zip(x0, sets, strict=True):
            for k, name in enumerate(names(self.states)):
                if name in PRESSURE_NAMES:
                    row[k] = (p.value("supply.pressure") + p.value("ambient.pressure")) / 2
                elif name.startswith("temperature"):
                    row[k] = p.value("ambient.temperature")
        substeps = max(1, math.ceil(float(h.max()) / MAX_INTEGRATION_STEP))
        x = self._roll_out(x0, u, sets, (given.t, h), substeps, states=True)
        return [dict(zip(names(self.states), columns.T, strict=True)) for columns in x]

    def pressure_rates(self, given: Trajectory, sets: Sequence[ParameterSet]) -> Array:
        """Rates of both pressures at every sample [Pa/s], shape (len(sets), n, 2); every state is given."""
        still = (given.t, np.zeros_like(given.t))
        return self._roll_out(np.empty((len(sets), 0)), given.matrix(self._inputs), sets, still, 1, states=False)

    def _roll_out(
        self,
        x0: Array,
        u: Array,
        sets: Sequence[ParameterSet],
        grid: tuple[Array, Array],
        substeps: int,
        *,
        states: bool,
    ) -> Array:
        m = len(sets)
        p = np.array([parameter_vector(self._parameters, one) for one in sets])
        inputs, (t, h) = np.tile(u, (m, 1, 1)), (np.tile(a, (m, 1)) for a in grid)
        with np.errstate(all="ignore"):  # absurd parameters may overflow; the caller then gets no finite number
            run = self._rollout.run(x0, inputs, p, t, h, substeps=substeps, states=states)
        return run.y if run.x is None else run.x


_KNOWN_AIR = functools.lru_cache(maxsize=32)(AirSimulator)  # which the checks of a log and its starts ask for in turn
ValveValues = Mapping[str, float]
AirForce = Callable[[Mapping[str, Any], Any, Any], Any]
VALVE_CONDUCTANCE, VALVE_LEAK = "valve.conductance", "valve.leak"
CENTRE, SPAN = "valve.centre", "valve.span"


@dataclass(frozen=True, eq=False)
class PneumaticStarts:
    """Start hook of a pneumatic drive.

    For a log without position, the position is the integral of the speed from cylinder.start of the stroke. The fit
    corrects that start, which the air in both chambers determines (from 20 mm off in 200 mm it did).
    """

    system: Callable[[], System]  # the drive's, which holds this hook and is therefore not held here
    friction: FrictionModel
    air_force: AirForce  # (parameters, both pressures [Pa]) -> force of the air on the piston [N]

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return candidates with one valve, and with friction for each scanned Stribeck velocity."""
        filtered = functools.cache(functools.partial(self.prepare_logs, logs))
        runs = filtered(FILTER_TIMES[0])
        if all(set(PRESSURE_NAMES) <= set(run.logged_pressures) for run in runs.values()):
            window = choose_filter_time(
                self.friction, lambda window: {n: run.balance_of_pressures() for n, run in filtered(window).items()}
            )
            runs = filtered(window)
        valve = _estimate_valve(self.friction, runs)
        starts = friction_candidates(self.friction, {name: run.force_balance(valve) for name, run in runs.items()})
        valve_values: dict[str, float] = {}
        for name, value in valve.items():
            valve_values |= per_log_values(name, value, {n: log.parameters for n, log in logs.items()})

        def with_valve(index: int) -> Start:
            start = starts[index]
            return replace(start, parameters={**start.parameters, **valve_values})

        return Starts([functools.partial(with_valve, i) for i in range(len(starts))])

    def prepare_logs(self, logs: Mapping[str, Log], window: float = FILTER_TIMES[0]) -> dict[str, "PneumaticLog"]:
        """Logs with the motion and the air of this drive, filtered with a window [s]."""
        simulator_for = functools.partial(_KNOWN_AIR, self.system())
        return {name: PneumaticLog(log, simulator_for, self.air_force, window) for name, log in logs.items()}


class PneumaticLog:
    """A log with its filtered motion and pressures, and the states that follow from them for a given valve."""

    def __init__(
        self, log: Log, simulator_for: Callable[[tuple[str, ...]], AirSimulator], push: AirForce, window: float
    ) -> None:
        self.measured, self.parameters, self._window = log.measured, log.parameters, window
        self._simulator_for, self._air_force = simulator_for, push
        self._air_by_centre: dict[float, dict[str, Array]] = {}
        position, speed, self._acceleration = filter_motion(self.measured, window)
        if "position" not in self.measured:
            # from cylinder.start, or the nearest position that keeps the travel within the stroke
            stroke = self.parameters.value("cylinder.stroke")
            lowest, highest = -float(position.min()), stroke - float(position.max())
            start = max(self.parameters.value("cylinder.start") * stroke, lowest)
            position = position + min(start, max(lowest, highest))
        self.logged_pressures = tuple(n for n in PRESSURE_NAMES if n in self.measured)
        self.known_states = {
            "position": position,
            "speed": speed,
            **{n: filter_channel(self.measured, n, 0, window) for n in self.logged_pressures},
        }
        self._known_signals = self.measured.select(["valve_voltage"]).with_columns(self.known_states)

    @functools.cached_property
    def _pressure_rates(self) -> Array:
        """Rates of the logged pressures [Pa/s], shape (n, m), which every shape of the valve has to explain."""
        return np.column_stack([filter_channel(self.measured, n, 1, self._window) for n in self.logged_pressures])

    def force_balance(self, valve: ValveValues) -> RegressionRows:
        """Rows for the regression of friction, with this valve."""
        return self.force_balances([valve])[0]

    def force_balances(self, valves: Sequence[ValveValues]) -> list[RegressionRows]:
        """Rows for the regression of friction, with each of several valves."""
        return [self._rows({**self.known_states, **air}) for air in self._simulate_air(valves)]

    def balance_of_pressures(self) -> RegressionRows:
        """Rows of a log of both pressures, in which no valve counts; without the states that are not logged."""
        return self._rows(self.known_states)

    def _rows(self, states: dict[str, Array]) -> RegressionRows:
        columns = load_columns(self.parameters, states["position"], self._acceleration)
        pressures = {n: states[n] for n in PRESSURE_NAMES}
        force = self._air_force({n: q.value for n, q in self.parameters.items()}, *pressures.values())
        measured = self.measured.with_columns(pressures)
        return RegressionRows(measured, self.parameters, states["speed"], force, columns, states)

    def valve_columns(self, shape: ValveValues) -> tuple[Array, Array]:
        """Columns (n, m, 2) of conductance and its product with leak in a regression on m pressures' rates (n, m)."""
        unit, leak = 1e-8, 0.01  # the rates are linear in both, so any two values give the columns
        probes = [{**shape, VALVE_CONDUCTANCE: c, VALVE_LEAK: x} for c, x in ((1e-12, 0.0), (unit, 0.0), (unit, leak))]
        # the states that are not logged, with the other given values, depend on the centre, which the spool follows
        centre = shape.get(CENTRE, self.parameters.value(CENTRE))
        if centre not in self._air_by_centre:
            self._air_by_centre[centre] = self._simulate_air([{CENTRE: centre}])[0]
        air = self._air_by_centre[centre]
        signals = self._known_signals.with_columns(air)
        simulator = self._simulator_for((*self.known_states, *air))
        which = [PRESSURE_NAMES.index(n) for n in self.logged_pressures]
        closed, edges, leaking = simulator.pressure_rates(signals, self._with_valves(probes))[:, :, which]
        columns = np.stack([edges - closed, (leaking - edges) / leak], axis=-1) / unit
        return columns, self._pressure_rates - closed

    def min_conductance(self) -> float:
        """Conductance of a choked edge that feeds the fastest motion at half the supply pressure [m^3/(s*Pa)]."""
        fastest = float(np.quantile(np.abs(self.known_states["speed"]), 0.99))
        gas = self.parameters.value("gas.constant") * self.parameters.value("ambient.temperature")
        area = math.pi / 4 * self.parameters.value("cylinder.bore") ** 2
        return max(area * fastest * 0.5 / (ANR_DENSITY * gas), 1e-10)

    def _simulate_air(self, valves: Sequence[ValveValues]) -> list[dict[str, Array]]:
        return self._simulator_for(tuple(self.known_states)).simulate_states(
            self._known_signals, self._with_valves(valves)
        )

    def _with_valves(self, valves: Iterable[ValveValues]) -> list[ParameterSet]:
        """Parameters of the log with each of several valves, whose values have no bounds."""
        return [
            self.parameters.with_bounds(dict.fromkeys(valve, (-np.inf, np.inf))).with_values(valve) for valve in valves
        ]


def valve_shapes(parameters: ParameterSet, free: Collection[str]) -> dict[str, tuple[float, ...]]:
    """Values to try of what is free of the valve's shape: critical ratio, dead zone and centre."""
    tried = {n: values for n, values in VALVE_SHAPE_GRID.items() if n in free}
    if CENTRE in tried:
        tried[CENTRE] = tuple(parameters.value(CENTRE) + shift * parameters.value(SPAN) for shift in tried[CENTRE])
    return tried


def _estimate_valve(friction: FrictionModel, runs: Mapping[str, PneumaticLog]) -> dict[str, float]:
    """Estimates of the free parameters among conductance, leak, critical ratio and dead zone."""
    parameters = next(iter(runs.values())).parameters
    free = [
        n
        for n in (VALVE_CONDUCTANCE, VALVE_LEAK, *VALVE_SHAPE_GRID)
        if any(n in run.parameters.free_names for run in runs.values())
    ]
    if not free:
        return {}
    if any(run.logged_pressures for run in runs.values()):
        shapes = valve_shapes(parameters, free)
        best = _search_values(
            shapes, parameters, lambda values: [_fit_valve_to_pressures(runs, free, v)[1] for v in values]
        )
        return best | _fit_valve_to_pressures(runs, free, best)[0]
    needed = max(run.min_conductance() for run in runs.values())
    tried = {VALVE_CONDUCTANCE: tuple(needed * factor for factor in CONDUCTANCE_FACTORS), VALVE_LEAK: LEAK_GRID}
    tried = {n: tried.get(n, (parameters.value(n),)) for n in free}

    def force_misfits(valves: Sequence[ValveValues]) -> list[float]:
        balances = {name: run.force_balances(valves) for name, run in runs.items()}
        return [force_misfit(friction, {name: rows[k] for name, rows in balances.items()}) for k in range(len(valves))]

    return _search_values(tried, parameters, force_misfits)


def _search_values(
    tried: Mapping[str, Sequence[float]],
    parameters: ParameterSet,
    misfits: Callable[[Sequence[ValveValues]], Sequence[float]],
) -> dict[str, float]:
    """Values of least misfit: the best of a grid, then of ever finer ones around it."""
    if not tried:
        return {}
    names = list(tried)
    logarithmic = np.array([n in (VALVE_CONDUCTANCE, VALVE_LEAK) for n in names])
    lower, upper = (np.array([getattr(parameters[n], b) for n in names]) for b in ("lower", "upper"))

    def best_of(grid: Array) -> Array:
        grid = np.clip(grid, lower, upper)
        misfit_of = misfits([dict(zip(names, point, strict=True)) for point in grid.tolist()])
        return np.asarray(grid[np.argmin(np.nan_to_num(misfit_of, nan=np.inf))])

    point = best_of(np.array(list(itertools.product(*tried.values()))))
    step = np.array([REFINEMENT_STEPS[n] for n in names])
    moves = np.array([m for m in itertools.product((0, -1, 1), repeat=len(names)) if np.count_nonzero(m) <= 2])
    for k in range(GRID_REFINEMENTS):
        near = moves * 0.5**k
        point = best_of(np.where(logarithmic, point * step**near, point + step * near))
    return dict(zip(names, point.tolist(), strict=True))


def _fit_valve_to_pressures(
    runs: Mapping[str, PneumaticLog], free: Sequence[str], shape: ValveValues
) -> tuple[dict[str, float], float]:
    """Free ones of conductance and leak by linear regression, and the sum of squared residuals [Pa^2/s^2]."""
    parameters = next(iter(runs.values())).parameters
    parts = [run.valve_columns(shape) for run in runs.values() if run.logged_pressures]
    A = np.concatenate([columns.reshape(-1, 2) for columns, _ in parts])
    y = np.concatenate([rates.ravel() for _, rates in parts])
    conductance, leak = parameters.value(VALVE_CONDUCTANCE), parameters.value(VALVE_LEAK)
    # the vector (C, C * leak) as a known part and a basis for the free part
    if VALVE_CONDUCTANCE in free:
        solution, basis = np.zeros(2), np.eye(2) if VALVE_LEAK in free else np.array([[1.0], [leak]])
    elif VALVE_LEAK in free:
        solution, basis = np.array([conductance, 0.0]), np.array([[0.0], [conductance]])
    else:
        solution, basis = np.array([conductance, conductance * leak]), np.empty((2, 0))
    solution = solution + basis @ np.linalg.lstsq(A @ basis, y - A @ solution, rcond=None)[0]
    leak = float(solution[1] / solution[0]) if solution[0] > 0 else 0.0
    estimates = {VALVE_CONDUCTANCE: float(solution[0]), VALVE_LEAK: max(leak, MIN_LEAK)}
    values = {n: float(np.clip(v, parameters[n].lower, parameters[n].upper)) for n, v in estimates.items() if n in free}
    return values, float(np.sum((y - A @ solution) ** 2))


PrepareLogs = Callable[[Mapping[str, Log]], Mapping[str, PneumaticLog]]


@dataclass(frozen=True, eq=False)
class LinePressureCheck:
    """Log warning hook of a pneumatic drive; `prepare` is `PneumaticStarts.prepare_logs`."""

    prepare: PrepareLogs

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each log whose chambers' equations hold better behind a line's drop."""
        active = {name: most_active_part(log) for name, log in logs.items() if is_informative(log)}
        sentences = []
        for name, log in active.items():
            run = self.prepare({"": log})[""]
            measured = min((_balance(run, shape) for shape in trial_shapes(log)), key=lambda each: each.residual)
            if measured.residual < MAX_UNQUESTIONED_SHARE * measured.total:
                continue
            lead, best, worse = 0.0, measured, 0
            for tried in LEADS:
                balance = self._behind_line(log, measured, tried)
                lead, best, worse = (tried, balance, 0) if balance.residual < best.residual else (lead, best, worse + 1)
                if worse == MAX_WORSE_LEADS:
                    break
            if best.residual > min(measured.residual / MIN_RESIDUAL_RATIO**2, MAX_LINE_RESIDUAL_SHARE * best.total):
                continue
            drop = lead * max(float(np.quantile(np.abs(flow), 0.999)) for flow in best.flows)
            ratio = np.sqrt(measured.residual / best.residual)
            message = (
                f"{name}: the pressures lead the chambers by {1e3 * lead:.2g} ms, as before a line that drops up to "
            )
            message += f"{drop / 1e5:.2g} bar (their mass balance then leaves {ratio:.1f} times smaller residuals)"
            sentences.append(
                f"{message}: put the sensors at the cylinder, or leave them out; else raise valve.bandwidth"
            )
        return sentences

    def _behind_line(self, log: Log, uncorrected: "Balance", lead: float) -> "Balance":
        """The balance of the pressures behind a line that leads so much, with its own flow."""
        balance, flows = uncorrected, uncorrected.flows
        for _ in range(PASSES):
            behind = {n: log.measured[n] - lead * flow for n, flow in zip(uncorrected.channels, flows, strict=True)}
            if min(float(np.nanmin(p)) for p in behind.values()) <= 0:
                return uncorrected
            moved = log._replace(measured=log.measured.with_columns(behind))
            balance = _balance(self.prepare({"": moved})[""], uncorrected.shape)
            flows = [(old + new) / 2 for old, new in zip(flows, balance.flows, strict=True)]
        return balance


def _balance(run: PneumaticLog, shape: Mapping[str, float]) -> "Balance":
    """The balance of a log with a valve of this shape."""
    columns, rates = run.valve_columns(shape)
    geometry: Any = without_prefix({n: p.value for n, p in run.parameters.items()}, "cylinder")
    position: Any = run.known_states["position"]
    size: dict[str, Any] = dict(zip(PRESSURE_NAMES, volumes(position, geometry), strict=True))
    residual, flows = 0.0, []
    for k, channel in enumerate(run.logged_pressures):
        model = columns[:, k] @ np.linalg.lstsq(columns[:, k], rates[:, k])[0]
        residual += float(np.sum((rates[:, k] - model) ** 2))
        flows.append(np.asarray(model * size[channel] / float(np.mean(size[channel]))))
    return Balance(shape, run.logged_pressures, residual, float(np.sum(rates**2)), flows)


class Balance(NamedTuple):
    """What the chambers' mass balance leaves of the pressures' rates."""

    shape: Mapping[str, float]  # of the valve
    channels: tuple[str, ...]  # the logged pressures
    residual: float  # squared residuals, summed [Pa^2/s^2]
    total: float  # squared rates, summed [Pa^2/s^2]
    flows: list[Array]  # the valve's flow into each chamber, as the rate of its pressure at its mean volume [Pa/s]


SUPPLY_PRESSURE = "supply.pressure"
ATMOSPHERE_ADDED, ATMOSPHERE_TAKEN_OFF = f"{ATMOSPHERE / 1e5:.3f} bar added", f"{ATMOSPHERE / 1e5:.3f} bar taken off"


class ZeroShift(NamedTuple):
    """Shift of the logged pressures and of the supply pressure [atmospheres], and the advice if it fits better."""

    sensors: int
    supply: int
    advice: str = ""


ZERO_SHIFTS = (
    ZeroShift(0, 0),
    ZeroShift(1, 0, f"{ATMOSPHERE_ADDED}: is it a gauge sensor? Then write its unit as bar(g)"),
    ZeroShift(-1, 0, f"{ATMOSPHERE_TAKEN_OFF}: is an absolute sensor read as bar(g)? Then write its unit as bar(a)"),
    ZeroShift(
        0, 1, f"{ATMOSPHERE_ADDED} to {SUPPLY_PRESSURE}: is that too low, or a gauge pressure? Then write it in bar(g)"
    ),
)


@dataclass(frozen=True, eq=False)
class PressureZeroCheck:
    """Log warning hook of a pneumatic drive; `prepare` is `PneumaticStarts.prepare_logs`."""

    prepare: PrepareLogs

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each pressure whose chamber's equation holds better from another zero point."""
        active = {name: most_active_part(log) for name, log in logs.items() if is_informative(log)}
        left = self._doubtful_residuals(active) if active else {}
        together = left.values() if len(left) == len(active) else ()
        warnings = list(_warning_sentences("".join(logs) if len(logs) == 1 else "", together))
        long = [] if warnings else [n for n in left if float(np.ptp(active[n].measured.t)) >= MIN_LOG_DURATION]
        return warnings + [sentence for name in long for sentence in _warning_sentences(name, [left[name]])]

    def _doubtful_residuals(self, logs: Mapping[str, Log]) -> dict[str, dict[str, Array]]:
        """Squared rates of each pressure of doubtful logs, and the squared residuals with each shift [Pa^2/s^2]."""
        spread: dict[str, dict[str, float]] = {}
        for name, log in logs.items():
            rates = {n: filter_channel(log.measured, n, 1) for n in _pressure_channels(log)}
            spread[name] = {n: float(np.sum((rate - rate.mean()) ** 2)) for n, rate in rates.items()}
        by_shift = [self._shift_residuals(logs, ZERO_SHIFTS[0])]
        doubtful = {
            name: log
            for name, log in logs.items()
            if any(left > MAX_UNQUESTIONED_SHARE * spread[name][n] for n, left in by_shift[0][name].items())
        }
        by_shift += [self._shift_residuals(doubtful, remedy) for remedy in ZERO_SHIFTS[1:]] if doubtful else []
        return {
            name: {n: np.array([spread[name][n], *(each[name][n] for each in by_shift)]) for n in spread[name]}
            for name in doubtful
        }

    def _shift_residuals(self, logs: Mapping[str, Log], remedy: ZeroShift) -> dict[str, dict[str, float]]:
        """Squared residuals of each log's pressure rates with shifted zero points [Pa^2/s^2]."""
        shifted: dict[str, Log] = {}
        for name, log in logs.items():
            p, readings = log.parameters, {n: log.measured[n] for n in _pressure_channels(log)}
            measured = log.measured.with_columns({n: v + remedy.sensors * ATMOSPHERE for n, v in readings.items()})
            moved = {SUPPLY_PRESSURE: p.value(SUPPLY_PRESSURE) + remedy.supply * ATMOSPHERE}
            shifted[name] = Log(measured, p.with_bounds(dict.fromkeys(moved, (0.0, math.inf))).with_values(moved))
        left: dict[str, dict[str, float]] = {}
        for name, run in self.prepare(shifted).items():
            parts = [run.valve_columns(shape) for shape in trial_shapes(logs[name])]
            left[name] = {
                n: min(_regression_residual(columns[:, k], wanted[:, k]) for columns, wanted in parts)
                if run.known_states[n].min() > 0
                else math.inf
                for k, n in enumerate(run.logged_pressures)
            }
        return left


def is_informative(log: Log) -> bool:
    """Whether a log has motion and a pressure, and the supply pressure is known, without which no ratio is."""
    supply_known = SUPPLY_PRESSURE not in log.parameters.free_names
    return supply_known and any(n in log.measured for n in ("position", "speed")) and bool(_pressure_channels(log))


def most_active_part(log: Log) -> Log:
    """Part of a long log in which the pressures change most, which is enough for the check and cheap."""
    data = log.measured
    if len(data) <= MAX_REGRESSION_ROWS:
        return log
    path = np.sum(
        [np.abs(filter_channel(data, n, 1)) / float(np.nanmean(data[n])) for n in _pressure_channels(log)], axis=0
    )
    within = np.convolve(path, np.ones(MAX_REGRESSION_ROWS), "valid")
    first = int(np.argmax(within))
    return log._replace(measured=data.rows(first, first + MAX_REGRESSION_ROWS))


def _pressure_channels(log: Log) -> list[str]:
    return [n for n in PRESSURE_NAMES if n in log.measured]


def trial_shapes(log: Log) -> Iterator[dict[str, float]]:
    """Values of the valve's shape parameters to try, where they are free."""
    tried = valve_shapes(log.parameters, log.parameters.free_names)
    for values in itertools.product(*tried.values()):
        yield dict(zip(tried, values, strict=True))


def _regression_residual(columns: Array, wanted: Array) -> float:
    """Sum of squared residuals of a regression; infinite where a shift has made numbers overflow."""
    if not np.isfinite(columns).all() or not np.isfinite(wanted).all():
        return math.inf
    return float(np.sum((wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]) ** 2))


def _warning_sentences(name: str, logs: Collection[Mapping[str, Array]]) -> Iterator[str]:
    """Sentences, one for each pressure for which another zero point fits better in these logs together."""
    for channel in PRESSURE_NAMES:
        rows = [left[channel] for left in logs if channel in left]
        total, unshifted, *shifted = np.sum(rows, axis=0) if rows else np.zeros(1 + len(ZERO_SHIFTS))
        best = int(np.argmin(shifted))
        if 0 < shifted[best] < min(unshifted / MIN_RESIDUAL_RATIO**2, MAX_RESIDUAL_SHARE * total):
            better = f"leaves {math.sqrt(unshifted / shifted[best]):.1f} times smaller residuals"
            where = f"{channel} of {name}" if name else channel
            yield f"{where}: its chamber's mass balance {better} with {ZERO_SHIFTS[1 + best].advice}"
