"""Transfer-function plants with named signals: first order, second order, integrator; dead time; their starts.

Each reads its input u as ``u - input_offset``, the input that holds its output at zero: a log's signals rarely count
from there. A constant on the output is the same as one on the input of ``-1 / gain`` of it, so one number holds both.

Below the plants and their files' section stand the dead time as states, a Padé approximant of order 1 to 5, and the
starts from logs without a user's guess (`LinearStarts`): gain, offset, start states and Coulomb friction enter the
response linearly, so each point of a grid over the few other values (time constants, damping, dead time) costs one
small linear least squares; the best of them are refined.
"""

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca
import numpy as np
from scipy import optimize, signal

from pneuopt.dynamics.dead_time import check_pade_order, delay_line, pade_delay, pade_matrices
from pneuopt.dynamics.hooks import Log, Start
from pneuopt.dynamics.system import DeadTime, Symbols, System, define, names
from pneuopt.logs.columns import CHANNELS
from pneuopt.models.declaration import DriveKind, DriveSections, FirstFiles
from pneuopt.models.drives import FORCE, POSITION, SPEED
from pneuopt.models.friction import FRICTION_KEYS, FrictionModel, read_friction
from pneuopt.models.tolerances import (
    DAMPING_GRID,
    MAX_GRID_SAMPLES,
    MAX_REFINEMENT_SAMPLES,
    MAX_STARTS,
    MIN_DEAD_TIME,
    MIN_FIT_SAMPLES,
    USUAL_PADE_ORDER,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, ModelError, check_names, require
from pneuopt.quantities.keys import Key, Takes, choice
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import difference_unit, read_si

VALVE_VOLTAGE = Quantity("valve_voltage", "V", nominal=5.0)
PLANT_DAMPING, PLANT_DEAD_TIME, PLANT_GAIN, COULOMB_LEVEL, INPUT_OFFSET = (
    "plant.damping",
    "plant.dead_time",
    "plant.gain",
    "friction.coulomb",
    "plant.input_offset",
)
Dynamics = Callable[[ca.SX, Symbols, Symbols], dict[str, ca.SX]]


@dataclass(frozen=True)
class FirstOrder:
    """``time_constant dy/dt + y = gain u(t - dead_time)``.

    Parameters
    ----------
    pade_order : int
        Order of the dead time's approximant; 0: no dead time.
    input, output : Quantity
        The signals u and y; the parameters' units follow from theirs.

    Examples
    --------
    >>> plant = FirstOrder().system()
    >>> plant.linearise([0.0], {}, plant.parameters.with_values({"plant.time_constant": 0.5})).A.item()
    -2.0
    """

    kind: ClassVar[str] = "linear"
    pade_order: int = 0
    input: Quantity = VALVE_VOLTAGE
    output: Quantity = SPEED

    def system(self) -> System:
        """The plant as an ODE."""
        y = self.output.name

        def dynamics(u: ca.SX, x: Symbols, p: Symbols) -> dict[str, ca.SX]:
            return {y: (p["plant.gain"] * u - x[y]) / p["plant.time_constant"]}

        constant = Parameter(0.1, "s", 1e-5, 1e4, log=True, meaning="time constant")
        shape = ResponseShape(("plant.time_constant",), _first_order_polynomials)
        shaping = ParameterSet({"plant.time_constant": constant})
        return _assemble_plant(self, (self.output,), shaping, dynamics, shape)


@dataclass(frozen=True)
class SecondOrder:
    r"""``y'' + 2 damping w y' + w² y = gain w² u(t - dead_time)``, w the natural frequency; friction is optional.

    Friction is an equivalent input: in steady motion the speed y needs the voltage ``y / gain + F(y)``. It acts where
    the force does, after the drive's lag, so that the drive can stick. With d, the acceleration without friction::

        y' = d - gain w F(y) / (2 damping)        d' = w² (gain u(t - dead_time) - y) - 2 damping w d

    Without friction, d is y' and the two equations are the transfer function above. All damping counts as the drive's
    (of a motor's winding or a valve's leakage). F is smooth and in the input's unit. Its viscous part is zero by
    default, because the gain includes it.

    Parameters
    ----------
    pade_order : int
        Order of the dead time's approximant; 0: no dead time.
    friction : FrictionModel, optional
        Its forces are in the unit of the input; its speed is the output.
    input, output : Quantity
        The signals u and y; the parameters' units follow from theirs.

    Examples
    --------
    >>> plant = SecondOrder().system()
    >>> rest = plant.equilibrium({"valve_voltage": 2.0}, plant.parameters.with_values({"plant.gain": 0.5}))
    >>> round(float(rest[0]), 9)
    1.0
    """

    kind: ClassVar[str] = "linear"
    pade_order: int = 0
    friction: FrictionModel | None = None
    input: Quantity = VALVE_VOLTAGE
    output: Quantity = SPEED

    def __post_init__(self) -> None:
        require(
            self.friction is None or not self.friction.inputs,
            f"{type(self.friction).__name__} needs pressures or a force, which this plant lacks; choose another law",
            ModelError,
        )

    def system(self) -> System:
        """Build the equations; the states are the output, "drive" (d above), then those of friction and dead time."""
        y, friction = self.output.name, self.friction

        def dynamics(u: ca.SX, x: Symbols, p: Symbols) -> dict[str, ca.SX]:
            gain, w, zeta = (p[f"plant.{n}"] for n in ("gain", "natural_frequency", "damping"))
            rates = {y: x["drive"], "drive": w**2 * (gain * u - x[y]) - 2 * zeta * w * x["drive"]}
            if friction is None:
                return rates
            force = friction.force(x[y], without_prefix(x, "friction"), {}, without_prefix(p, "friction"))
            rates[y] -= gain * w / (2 * zeta) * force.value
            return rates | {f"friction.{n}": rate for n, rate in force.rates.items()}

        frequency = Parameter(10.0, "rad/s", 1e-3, 1e5, log=True, meaning="natural frequency without damping")
        damping = Parameter(0.7, "1", 1e-3, 1e3, log=True, meaning="damping ratio")
        shaping = ParameterSet({"plant.natural_frequency": frequency, "plant.damping": damping})
        if friction is not None:
            shaping |= _in_input_unit(friction.parameters, self.input).with_prefix("friction")
        inner = friction.states if friction is not None else ()
        drive = Quantity("drive", _quotient_unit(self.output, "s"), 10 * self.output.nominal)
        states = (self.output, drive, *(replace(s, name=f"friction.{s.name}") for s in inner))
        shape = ResponseShape(
            tuple(shaping)[:2], _second_order_polynomials, None if friction is None else _friction_polynomials
        )
        plant = _assemble_plant(self, states, shaping, dynamics, shape)
        if friction is None:
            return plant
        return replace(plant, identification_hints=friction.identification_hints.with_prefix("friction"))


@dataclass(frozen=True)
class Integrator:
    """``dy/dt = gain u(t - dead_time)``: from a valve's opening to a position, for example.

    Parameters
    ----------
    pade_order : int
        Order of the dead time's approximant; 0: no dead time.
    input, output : Quantity
        The signals u and y; the gain's unit follows from theirs.

    Examples
    --------
    >>> Integrator(output=Quantity("position", "m")).system().parameters["plant.gain"].unit
    'm/(V*s)'
    """

    kind: ClassVar[str] = "linear"
    pade_order: int = 0
    input: Quantity = VALVE_VOLTAGE
    output: Quantity = SPEED

    def system(self) -> System:
        """The plant as an ODE."""
        y = self.output.name

        def dynamics(u: ca.SX, _: Symbols, p: Symbols) -> dict[str, ca.SX]:
            return {y: p["plant.gain"] * u}

        shape = ResponseShape((), _integrator_polynomials)
        return _assemble_plant(self, (self.output,), ParameterSet(), dynamics, shape, per="*s")


Plant = FirstOrder | SecondOrder | Integrator


def _build_plant(sections: DriveSections) -> Plant:
    options = sections.options("plant")
    signals = [options["input"], options["output"]]
    check_names("channel", signals, CHANNELS, f"{sections.location('plant', '')}: [plant]")
    quantities = []
    for key, name in zip(("input", "output"), signals, strict=True):
        unit = options[f"{key}_unit"]
        if unit is None:
            usual = {q.name: q for q in (VALVE_VOLTAGE, SPEED, POSITION, FORCE)}
            quantities.append(usual.get(name, Quantity(name, CHANNELS[name])))
        else:  # in another unit than the channel's: that of a transducer, say
            where = sections.place("plant", f"{key}_unit")
            message = f'{where}: {unit!r} is no SI unit without a prefix, such as "V"'
            require(read_si(f"1 {unit}", where=where) == 1.0, message)
            quantities.append(Quantity(name, unit))
    u, y = quantities
    order = options["pade_order"]
    if order is None:
        order = USUAL_PADE_ORDER if sections.has("plant", "dead_time") else 0
    if options["model"] is SecondOrder:
        return SecondOrder(order, read_friction(sections) if sections.has("friction") else None, u, y)
    plant: Plant = options["model"](order, u, y)
    return plant


_OWN_UNIT = "parameters then count in it"
LINEAR_KIND = DriveKind(
    FirstOrder.kind,
    {
        "plant": {
            "model": choice(
                "transfer function",
                {"first_order": FirstOrder, "second_order": SecondOrder, "integrator": Integrator},
            ),
            "input": Key("channel that drives the plant", Takes.TEXT, usual=VALVE_VOLTAGE.name),
            "output": Key("channel that answers", Takes.TEXT, usual=SPEED.name),
            "input_unit": Key(
                "unit of the input, of a transducer, say", Takes.TEXT, example='"V"', condition=_OWN_UNIT
            ),
            "output_unit": Key(
                "unit of the output, of a transducer, say", Takes.TEXT, example='"V"', condition=_OWN_UNIT
            ),
            "pade_order": Key(
                "order of the dead time's approximant, 0 to 5; 3 with a dead time",
                Takes.COUNT,
                example="3",
                least=0,
                most=5,
            ),
        },
        "friction": FRICTION_KEYS,
    },
    _build_plant,
    any_friction=False,
    first=FirstFiles(
        options={"plant": {"model": "second_order"}},
        unknowns=("plant.gain", "plant.natural_frequency", "plant.damping"),
        gains={"Kp": (1, 0.1, 20), "Ki": (5, 0.5, 200), "Kd": (0, 0, 2), "Tf": (0.01, 5e-3, 0.1)},
        limit=5.0,
        dither=None,
        steps=(0.1, 0.25),
        horizon=1.5,
        swept="plant.gain",
    ),
)


Polynomials = tuple[list[float], list[float]]


@dataclass(frozen=True)
class ResponseShape:
    """Transfer function of a plant at unit gain, without its dead time."""

    names: tuple[str, ...]  # of its parameters
    polynomials: Callable[..., Polynomials]  # their values -> numerator and denominator, highest power first
    friction_polynomials: Callable[..., Polynomials] | None = None  # the same for the response to friction


def _assemble_plant(
    plant: Plant,
    states: tuple[Quantity, ...],
    shaping: ParameterSet,
    dynamics: Dynamics,
    shape: ResponseShape,
    per: str = "",
) -> System:
    """Assemble a plant from its dynamics, its gain, whose unit is also per `per`, and its dead time."""
    check_pade_order(plant.pade_order)
    order, source, unit = plant.pade_order, plant.input, difference_unit(plant.input.unit)
    line, gain_unit = delay_line(source, order), _quotient_unit(plant.output, f"({unit}{per})" if per else unit)
    gain = Parameter(1.0, gain_unit, meaning="steady output, or of an integrator its rate, per input")
    zero = Parameter(0.0, unit, meaning="input that holds the output at zero; estimated where logs show another than 0")
    parameters = ParameterSet({PLANT_GAIN: gain, INPUT_OFFSET: zero}) | shaping
    if order:
        meaning = "delay from the input to its effect; none where it is left out"
        parameters |= ParameterSet({"plant.dead_time": Parameter(0.01, "s", 1e-3, 10.0, log=True, meaning=meaning)})

    def rhs(_: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        counted = u[source.name] - p[INPUT_OFFSET]
        late, rates = pade_delay(counted, [x[q.name] for q in line], p.get(PLANT_DEAD_TIME, ca.SX(0)))
        moving = dynamics(late, x, p) | {q.name: r for q, r in zip(line, rates, strict=True)}
        return moving, {plant.output.name: x[plant.output.name]}

    others = tuple(n for n in names(states) if n not in {plant.output.name, "drive"})
    find = LinearStarts(shape, source.name, plant.output.name, names(line), others)
    system = define(states + line, (source,), (plant.output,), parameters, rhs, find)
    late = DeadTime(PLANT_DEAD_TIME, source.name, names(line), replace(plant, pade_order=0).system()) if order else None
    return replace(system, centre=INPUT_OFFSET, dead_time=late)


# These polynomials are functions of the module, not lambdas: a system goes to other processes (pickle).
def _first_order_polynomials(time_constant: float) -> Polynomials:
    return [1.0], [time_constant, 1.0]


def _second_order_polynomials(w: float, damping: float) -> Polynomials:
    return [w**2], [1.0, 2 * damping * w, w**2]


def _friction_polynomials(w: float, damping: float) -> Polynomials:
    """Response to friction at unit gain: ``w² (s / (2 damping w) + 1)`` over the plant's denominator."""
    return [w / (2 * damping), w**2], [1.0, 2 * damping * w, w**2]


def _integrator_polynomials() -> Polynomials:
    return [1.0], [1.0, 0.0]


def _quotient_unit(output: Quantity, unit: str) -> str:
    return f"{difference_unit(output.unit)}/{unit if unit.isalnum() or unit.startswith('(') else f'({unit})'}"


def _in_input_unit(parameters: ParameterSet, source: Quantity) -> ParameterSet:
    """Parameters of friction in the unit of the input instead of newtons, with values and bounds over 100."""
    shrunk = dict(parameters)
    for n, q in parameters.items():
        if re.search(r"\bN\b", q.unit):
            low, value, high = (0.01 * number for number in (q.lower, 0.0 if n == "viscous" else q.value, q.upper))
            unit = re.sub(r"\bN\b", difference_unit(source.unit), q.unit)
            shrunk[n] = replace(q, value=value, lower=low, upper=high, unit=unit)
    return ParameterSet(shrunk)


def delay_states(u: Array, step: float, order: int, dead_time: float) -> Array:
    """The states (n, order) along an input u (n,) that is held over each step [s], from rest at its first value."""
    unit = pade_matrices(order)
    A, B, *_ = signal.cont2discrete((unit[0] / dead_time, unit[1] / dead_time, *unit[2:]), step)
    rest = np.linalg.solve(np.eye(order) - A, B[:, 0]) * u[0]
    states = np.empty((len(u), order))
    states[0] = rest
    for k in range(1, len(u)):
        states[k] = A @ states[k - 1] + B[:, 0] * u[k - 1]
    return states


@dataclass(frozen=True)
class LinearStarts:
    """Start hook of a linear plant; `LogError` for a log that is too short, or logs whose input never changes."""

    shape: ResponseShape
    source: str
    output: str
    delay_line: tuple[str, ...] = ()  # the states of its dead time
    zero_states: tuple[str, ...] = ()  # states that no log shows; they start at zero

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return up to four distinct candidates, the best fit first."""
        searched = (*self.shape.names, *((PLANT_DEAD_TIME,) if self.delay_line else ()))
        parameters = next(iter(logs.values())).parameters
        records = [_resample_log(name, log, self.source, self.output) for name, log in logs.items()]
        moves = any(np.ptp(r.u) > 0 for r in records)
        require(moves, f"{self.source} never changes, so the plant is unidentifiable; log a step of it", LogError)
        coarse, fine = (
            [_thin_log(r, n // len(records)) for r in records] for n in (MAX_GRID_SAMPLES, MAX_REFINEMENT_SAMPLES)
        )
        grids = [_trial_values(n, records, parameters) for n in searched]
        fits = []
        for shaping in itertools.product(*grids[: len(self.shape.names)]):
            responses = [_unit_responses(self.shape, r, shaping) for r in coarse]
            dead_times = itertools.product(*grids[len(self.shape.names) :])
            fits += [_solve_linear_part(responses, coarse, shaping, dead) for dead in dead_times]
        fits = _distinct_fits(sorted(fits, key=lambda fit: fit.misfit))
        refined = [_refine_fit(self.shape, fine, fit, searched, parameters) for fit in fits]
        best = _distinct_fits(sorted(refined, key=lambda fit: fit.misfit))
        return [self._build_start(fit, fine, logs, searched) for fit in best]

    def _build_start(
        self, fit: "_Fit", records: Sequence["_EvenLog"], logs: Mapping[str, Log], searched: Sequence[str]
    ) -> Start:
        estimates = dict(zip(searched, fit.values, strict=True)) | {
            PLANT_GAIN: fit.gain,
            COULOMB_LEVEL: max(fit.coulomb, 0.0),
        }
        parameters = next(iter(logs.values())).parameters
        values: dict[str, float] = {}
        for n in (n for n in estimates if n in parameters and parameters[n].free):
            value = float(np.clip(estimates[n], parameters[n].lower, parameters[n].upper))
            values |= {f"{n}[{log}]": value for log in logs} if parameters[n].per_log else {n: value}
        offset, states = parameters[INPUT_OFFSET], {}
        zeros = [
            float(np.clip(r.zero + moved, offset.lower, offset.upper))
            for r, moved in zip(records, fit.offsets, strict=True)
        ]
        named = {n: z for n, z, r in zip(logs, zeros, records, strict=True) if r.group is not None}
        values |= {f"{INPUT_OFFSET}[{n}]" if offset.per_log else INPUT_OFFSET: zero for n, zero in named.items()}
        for (name, log), record, error, moved in zip(logs.items(), records, fit.errors, fit.offsets, strict=True):
            response = record.y - error
            drive = np.gradient(response, record.t)
            if self.shape.friction_polynomials is not None:
                lead = self.shape.friction_polynomials(*fit.values[: len(self.shape.names)])[0][0]
                drive = drive + lead * fit.gain * fit.coulomb * record.sign
            columns = {n: np.zeros(len(record.t)) for n in (*self.zero_states, *self.delay_line)}
            if self.delay_line:
                dead_time = fit.values[len(self.shape.names)]
                line = delay_states(record.u - moved, float(record.t[1] - record.t[0]), len(self.delay_line), dead_time)
                columns |= dict(zip(self.delay_line, line.T, strict=True))
            run = Trajectory(record.t + record.start_time, columns | {self.output: response, "drive": drive})
            states[name] = run.interpolate(log.measured.t)
        return Start(states, values, ", ".join(f"{n.removeprefix('plant.')} {v:.3g}" for n, v in estimates.items()))


@dataclass(frozen=True, eq=False)
class _EvenLog:
    """A log on an even grid from zero: held input over `zero`, output, its smooth sign, and the gain if it is fixed."""

    t: Array
    u: Array
    y: Array
    sign: Array
    gain: float | None
    start_time: float
    zero: float  # the given offset of the input
    group: str | None  # the logs with which it shares an offset that is free; None where that is known


@dataclass(frozen=True, eq=False)
class _UnitResponses:
    """Responses of unit gain on one log: to a constant input, to its changes, to friction, and free responses."""

    constant_input: Array
    input_changes: Array
    friction_responses: tuple[Array, ...]
    free: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """A point of the search: shaping values (dead time last), linear parameters, and errors by log."""

    values: tuple[float, ...]
    misfit: float
    gain: float
    coulomb: float
    errors: tuple[Array, ...]
    offsets: tuple[float, ...]  # of the input, over the given one, by log


def _resample_log(name: str, log: Log, source: str, output: str) -> _EvenLog:
    measured, gain, offset = log.measured, log.parameters[PLANT_GAIN], log.parameters[INPUT_OFFSET]
    finite = np.isfinite(measured[source]) & np.isfinite(measured[output])
    t, u, y = (a[finite] for a in (measured.t, measured[source], measured[output]))
    few = f"{name}: {len(t)} samples of {source} and {output} are too few to start from; give {MIN_FIT_SAMPLES} or more"
    require(len(t) >= MIN_FIT_SAMPLES, few, LogError)
    step = float(np.median(np.diff(t)))
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    linear = log.intersample.get(source) is Intersample.LINEAR
    # the mean over a sample stands for a line, to the second order
    held = np.interp(grid + step / 2, t, u) if linear else u[np.searchsorted(t, grid + 1e-3 * step, side="right") - 1]
    even = np.interp(grid, t, y)
    noise = 1.4826 * np.median(np.abs(np.diff(even))) + 1e-3 * np.ptp(even) + 1e-300
    known_gain = None if gain.free else gain.value
    sign, group = np.tanh(even / (3 * noise)), (name if offset.per_log else "") if offset.free else None
    return _EvenLog(grid - grid[0], held - offset.value, even, sign, known_gain, float(grid[0]), offset.value, group)


def _thin_log(record: _EvenLog, most: int) -> _EvenLog:
    every = max(1, len(record.t) // max(most, 5 * MIN_FIT_SAMPLES))
    starts = np.arange(0, len(record.u), every)
    u = np.add.reduceat(record.u, starts) / np.diff(starts, append=len(record.u))
    return replace(record, t=record.t[::every], u=u, y=record.y[::every], sign=record.sign[::every])


def _trial_values(name: str, records: Sequence[_EvenLog], parameters: ParameterSet) -> Array:
    """Values to try: one if the parameter is fixed, else the range that the logs can show, within the bounds."""
    parameter = parameters[name]
    if not parameter.free:
        return np.array([parameter.value])
    fast, slow = 2 * min(float(r.t[1]) for r in records), max(float(r.t[-1]) for r in records)
    if name == PLANT_DAMPING:
        values = np.array(DAMPING_GRID)
    elif name == PLANT_DEAD_TIME:
        least = _least_value(name, records, parameters)
        values = np.append(least, np.geomspace(max(fast / 2, least), max(slow / 4, least), 12))
    else:
        values = np.geomspace(fast, slow, 24) if name.endswith("constant") else np.geomspace(1 / slow, 1 / fast, 24)
    return np.unique(np.clip(values, parameter.lower, parameter.upper))


def _least_value(name: str, records: Sequence[_EvenLog], parameters: ParameterSet) -> float:
    """The least value of a parameter that is tried: its lower bound, but never 0."""
    fast = 2 * min(float(r.t[1]) for r in records)
    return max(parameters[name].lower, MIN_DEAD_TIME * fast if name == PLANT_DEAD_TIME else 1e-9)


def _refine_fit(
    shape: ResponseShape, records: Sequence[_EvenLog], fit: _Fit, searched: Sequence[str], parameters: ParameterSet
) -> _Fit:
    """Minimise the misfit over the logarithms of the free shaping values."""

    def fit_at(logs: Array) -> _Fit:
        values = list(fit.values)
        for i, value in zip(free, np.exp(logs), strict=True):
            values[i] = float(value)
        shaping, dead = values[: len(shape.names)], values[len(shape.names) :]
        return _solve_linear_part([_unit_responses(shape, r, shaping) for r in records], records, shaping, dead)

    def residuals(logs: Array) -> Array:
        return np.concatenate(fit_at(logs).errors)

    free = [i for i, n in enumerate(searched) if parameters[n].free]
    if not free:
        return fit_at(np.empty(0))
    named = [(searched[i], parameters[searched[i]]) for i in free]
    bounds = [(_least_value(n, records, parameters), min(known.upper, 1e9)) for n, known in named]
    low, high = np.log(np.array(bounds)).T
    start = np.clip(np.log([fit.values[i] for i in free]), low + 1e-6, high - 1e-6)
    return fit_at(optimize.least_squares(residuals, start, bounds=(low, high), max_nfev=40).x)


def _distinct_fits(fits: Sequence[_Fit]) -> list[_Fit]:
    """Best few fits that differ by more than a fifth in one of their values."""
    kept: list[_Fit] = []
    for fit in fits:
        apart = all(np.max(np.abs(np.log(np.divide(fit.values, k.values))), initial=0.0) > 0.2 for k in kept)
        if len(kept) < MAX_STARTS and apart:
            kept.append(fit)
    return kept


def _unit_responses(shape: ResponseShape, record: _EvenLog, shaping: Sequence[float]) -> _UnitResponses:
    t, u = record.t, record.u
    numerator, denominator = shape.polynomials(*shaping)
    b, a = _zero_order_hold_filter((numerator, denominator), float(t[1]))
    constant: Array = np.full(len(t), numerator[-1] / denominator[-1]) if denominator[-1] else t
    decays = np.column_stack([_apply_filter(np.ones(1), a, pulse) for pulse in np.eye(len(a) - 1, len(t))])
    free = np.linalg.qr(decays / np.abs(decays).max(axis=0))[0]
    friction = (
        ()
        if shape.friction_polynomials is None
        else (_apply_filter(*_zero_order_hold_filter(shape.friction_polynomials(*shaping), float(t[1])), record.sign),)
    )
    return _UnitResponses(constant, _apply_filter(b, a, u - u[0]), friction, free)


def _solve_linear_part(
    responses: Sequence[_UnitResponses], records: Sequence[_EvenLog], shaping: Sequence[float], dead: Sequence[float]
) -> _Fit:
    """Least squares for the linear parameters: gain, gain times Coulomb voltage and offsets, and free responses."""
    blocks, targets = [], []
    groups = list(dict.fromkeys(r.group for r in records if r.group is not None))
    for q, r in zip(responses, records, strict=True):
        forced = r.u[0] * q.constant_input + np.interp(r.t - sum(dead), r.t, q.input_changes, left=0.0)
        offsets = [-(g == r.group) * q.constant_input for g in groups]
        columns = np.column_stack(
            [*([forced] if r.gain is None else []), *(-f for f in q.friction_responses), *offsets, np.zeros(len(r.t))]
        )
        target = r.y if r.gain is None else r.y - r.gain * forced
        blocks.append(columns - q.free @ (q.free.T @ columns))
        targets.append(target - q.free @ (q.free.T @ target))
    matrix, target = np.vstack(blocks), np.concatenate(targets)
    size = np.abs(matrix).max(axis=0) + 1e-300
    weights = np.linalg.lstsq(matrix / size, target, rcond=1e-9)[0] / size
    errors = target - matrix @ weights
    fixed_gain, misfit = records[0].gain, float(np.mean(errors**2))
    gain = float(weights[0]) if fixed_gain is None else fixed_gain
    coulomb = (
        float(weights[0 if fixed_gain is not None else 1]) / gain if responses[0].friction_responses and gain else 0.0
    )
    shifts: dict[str | None, float] = dict(
        zip(groups, weights[len(weights) - 1 - len(groups) : -1] / (gain or 1.0), strict=True)
    )
    moved = tuple(float(shifts.get(r.group, 0.0)) for r in records)
    ends = np.cumsum([len(r.t) for r in records])[:-1]
    split = tuple(np.split(errors, ends))
    return _Fit((*shaping, *dead), misfit if np.isfinite(misfit) else np.inf, gain, coulomb, split, moved)


def _zero_order_hold_filter(polynomials: Polynomials, step: float) -> tuple[Array, Array]:
    """Digital filter with the exact response at samples to an input that is held between them."""
    numerator, denominator = polynomials
    n = len(denominator) - 1
    joint = np.eye(n + 1, k=-1)
    joint[0, :n], joint[0, n], joint[n] = -np.array(denominator[1:]) / denominator[0], 1 / denominator[0], 0.0
    moved = _matrix_exponential(step * joint)
    A, B, C = moved[:n, :n], moved[:n, n], np.pad(numerator, (n - len(numerator), 0))
    a = np.asarray(np.poly(A), dtype=np.float64)
    markov = [0.0, *(float(C @ np.linalg.matrix_power(A, k) @ B) for k in range(n))]
    return np.asarray(np.convolve(a, markov)[: n + 1], dtype=np.float64), a


def _matrix_exponential(matrix: Array) -> Array:
    """Exponential of a small matrix by scaling, Taylor series and squaring, far faster than scipy's."""
    halvings = max(0, int(np.ceil(np.log2(np.abs(matrix).sum(axis=1).max() + 1e-300))) + 2)
    term = total = np.eye(len(matrix))
    for k in range(1, 14):
        term = term @ matrix / (k * 2.0**halvings)
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def _apply_filter(b: Array, a: Array, u: Array) -> Array:
    return np.asarray(signal.lfilter(b, a, u), dtype=np.float64)
