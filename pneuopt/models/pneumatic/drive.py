"""`PneumaticDrive`: supply, proportional valve, cylinder and load in one ODE, its file, its rest and its limits."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import inf
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from pneuopt.dynamics.hooks import (
    Axis,
    FinalElement,
    IdentificationHints,
    Log,
    LogWarningHook,
    Rest,
    SeparatingRun,
    ValidityLimit,
    Width,
)
from pneuopt.dynamics.system import Symbols, System, define, names, parameter_vector, stack, symbols
from pneuopt.logs.tolerances import MAX_POSITION_ZERO_ERROR
from pneuopt.models.declaration import Alias, DriveKind, DriveSections, FirstFiles
from pneuopt.models.drives import AMBIENT_PARAMETERS, POSITION, SPEED
from pneuopt.models.friction import (
    FRICTION_KEYS,
    LOAD_HINTS,
    STRIBECK_UNKNOWNS,
    FrictionModel,
    Stribeck,
    law_inputs,
    read_friction,
)
from pneuopt.models.linear import VALVE_VOLTAGE
from pneuopt.models.load import LOAD_FORCE, LOAD_KEYS, Load
from pneuopt.models.pneumatic.chamber import ChamberModel, Inflow, Polytropic, Surroundings, Thermal
from pneuopt.models.pneumatic.cylinder import Cylinder, areas, piston_leak, volumes
from pneuopt.models.pneumatic.gas import (
    CRITICAL_RATIO,
    GAS_CONSTANT,
    IsentropicNozzle,
    Iso6358,
    Smoothing,
    conductance_of_nominal_flow,
)
from pneuopt.models.pneumatic.logs import LinePressureCheck, PneumaticStarts, PressureZeroCheck
from pneuopt.models.pneumatic.valve import Flows, Port, ProportionalValve, Spool
from pneuopt.models.tolerances import (
    EMPTY_CHAMBER_RATIO,
    MAX_COMPRESSION_RATIO,
    MAX_STOP_TRAVEL,
    MIN_CHAMBER_PRESSURE,
    ROUNDING_START,
    STOP_ROUNDING,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import HardwareError, UnitError, require
from pneuopt.quantities.keys import Key, choice, flag, table
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import read_value, write_value

SIDES = ("a", "b")
PRESSURE_SIGNALS = tuple(Quantity(f"pressure_{side}", "Pa(a)", nominal=5e5) for side in SIDES)
_VALVE = FinalElement(
    name="valve",
    moving_part="spool",
    medium="air",
    limit="valve.span",
    dead_zone="valve.dead_zone",
    bandwidth="valve.bandwidth",
    stroke="valve.spool",
    pushing=names(PRESSURE_SIGNALS),
    centre="valve.centre",
)
_AXIS = Axis(noun="piston", final_element=_VALVE)


@dataclass(frozen=True)
class PneumaticDrive:
    r"""A double-acting cylinder behind a 5/3 proportional valve.

    .. math:: M \dot v = A_a p_a - A_b p_b - (A_a - A_b) p_o - F_f - F_L + F_{stop}

    States: position [m] from the end where chamber a is smallest, speed, pressure_a and pressure_b (absolute), with
    `Thermal` chambers temperature_a and temperature_b, then the valve's and the friction's. Input: valve_voltage [V],
    which drives forwards above valve.centre (0 V by default). Outputs: position, speed, pressure_a, pressure_b, and
    with a spring on the load load_force, with which the piston presses on it.

    Parameters
    ----------
    friction : FrictionModel
        A law that depends on pressure gets both chambers' gauge pressures.
    chamber : ChamberModel
        Model of both chambers.
    """

    kind: ClassVar[str] = "pneumatic"
    valve: ProportionalValve = field(default_factory=ProportionalValve)
    friction: FrictionModel = field(default_factory=Stribeck)
    load: Load = field(default_factory=Load)
    chamber: ChamberModel = field(default_factory=Polytropic)
    cylinder: Cylinder = field(default_factory=Cylinder)

    @cached_property
    def parameters(self) -> ParameterSet:
        """Parameters cylinder.*, valve.*, supply.pressure, ambient.*, gas.constant, chamber.*, load.*, friction.*."""
        parts = {
            "cylinder": self.cylinder.parameters,
            "valve": self.valve.parameters,
            "supply": ParameterSet(
                {"pressure": Parameter(7.01325e5, "Pa(a)", 1e4, 2.1e6, meaning="pressure before the valve")}
            ),
            "chamber": self.chamber.parameters,
            "load": self.load.parameters,
            "friction": self.friction.parameters,
        }
        joined = ParameterSet()
        for name, parameters in parts.items():
            joined |= parameters.with_prefix(name)
        return joined | AMBIENT_PARAMETERS | _AIR_PARAMETERS

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of load, chambers, valve and friction, in this order."""
        air = tuple(replace(q, name=f"{q.name}_{side}") for q in self.chamber.states for side in SIDES)
        spool = tuple(replace(q, name=f"valve.{q.name}") for q in self.valve.states)
        return POSITION, SPEED, *air, *spool, *(replace(q, name=f"friction.{q.name}") for q in self.friction.states)

    def system(self) -> System:
        """Build the equations; states, input and outputs as in the class."""
        return self._system

    def check(self, parameters: ParameterSet, start: Mapping[str, float] | None = None) -> None:
        """Refuse impossible hardware, whatever its bounds, and a start outside the stroke.

        Parameters
        ----------
        parameters : ParameterSet
            Missing parameters have their defaults.
        start : mapping of state to value, optional
            State from which a run begins, if its position is to be checked too.

        Raises
        ------
        InputError
            Names parameter, value, source and possible values.
        """
        used = self._complete(parameters)
        for name, limit in _hardware_limits(used).items():
            if name in used and not limit.allows(used.value(name)):
                source = f" (source: {used[name].source})" if used[name].source else ""
                shown = write_value(used.value(name), used[name].unit)
                raise HardwareError(f"{name} = {shown}{source} is impossible; {limit.remedy}", name, limit.remedy)
        if start is not None:
            stroke, y = used.value("cylinder.stroke"), start.get("position", 0.0)
            room = MAX_STOP_TRAVEL * stroke  # a piston that presses on a stop is slightly outside
            shown, end = write_value(y, "m"), write_value(stroke, "m")
            require(-room <= y <= stroke + room, f"a start at position = {shown} lies outside the stroke, 0 to {end}")

    def rest(
        self,
        parameters: ParameterSet,
        *,
        position: float | None = None,
        speed: float = 0.0,
        pressure_b: float | None = None,
    ) -> Rest:
        """State in which the drive is at rest with unloaded friction, or moves steadily.

        At rest the net flow into each chamber is zero and the forces balance; with a rod, or under load, the spool is
        then slightly off centre. This is an equilibrium of the ODE, whatever the friction. In steady motion every rate
        but that of the position is zero: the valve feeds and drains what the piston sweeps, and the bristles keep their
        deflection. The end stops have the force that they have at the given position.

        Parameters
        ----------
        position : float, optional
            [m]; by default cylinder.start of the stroke.
        speed : float
            [m/s]
        pressure_b : float, optional
            Absolute pressure that a closed valve has trapped [Pa]: the spool is centred, and chamber a balances the
            forces. Leakage past the edges ends this rest after a while.

        Returns
        -------
        Rest
            All states, and valve_voltage.

        Raises
        ------
        InputError
            If the hardware is impossible, the position lies outside the stroke, or no spool position balances the load,
            at this speed.
        """
        self.check(parameters)
        used = self._complete(parameters)
        stroke = used.value("cylinder.stroke")
        y = used.value("cylinder.start") * stroke if position is None else position
        require(0 <= y <= stroke, f"a start at position = {y:g} m lies outside the stroke, 0 to {stroke:g} m")
        states, voltage = solve_steady_motion(
            MotionBalance(self._balance_function, parameter_vector(self.parameters, used), y, speed), used, pressure_b
        )
        return Rest(dict(zip(names(self.states), states, strict=True)), {VALVE_VOLTAGE.name: voltage})

    def air_force(self, measured: Trajectory, parameters: ParameterSet) -> Array:
        """Force of the air on the piston from both logged pressures, which is the input "force" of a `ForceDrive`.

        Parameters
        ----------
        measured : Trajectory
            pressure_a and pressure_b, absolute [Pa].
        parameters : ParameterSet
            Missing parameters have their defaults.

        Returns
        -------
        ndarray, shape (n,)
            A_a (p_a - p_o) - A_b (p_b - p_o) [N], with the noise of the pressures.
        """
        self.check(parameters)
        used = self._complete(parameters)
        numbers = {n: q.value for n, q in used.items()}
        return np.asarray(_air_force(numbers, *(measured[q.name] for q in PRESSURE_SIGNALS)))

    def _complete(self, parameters: ParameterSet) -> ParameterSet:
        """The drive's own parameters, with defaults for those that are missing."""
        return self.parameters | parameters.select(n for n in parameters if n in self.parameters)

    @cached_property
    def _system(self) -> System:
        outputs = (POSITION, SPEED, *PRESSURE_SIGNALS, *self.load.outputs)
        starts = PneumaticStarts(self.system, self.friction, _air_force)
        system = define(self.states, (VALVE_VOLTAGE,), outputs, self.parameters, self._rhs, starts, self._find_rest)
        warnings = partial(
            _log_warnings, PressureZeroCheck(starts.prepare_logs), LinePressureCheck(starts.prepare_logs)
        )
        declared = replace(
            system,
            hardware_check_hook=self.check,
            validity_limits=cylinder_limits(self.cylinder.stops),
            log_warning_hook=warnings,
            identification_hints=self.friction.identification_hints.with_prefix("friction") | LOAD_HINTS | _FLOW_HINTS,
            axis=_AXIS,
        )
        # air from the supply [kg/s], spool position [half travels], and air power [W]: the work of this air in an
        # isothermal expansion to ambient pressure, m' R T ln(p_s/p_o)
        x, u, p = symbols(self.states), symbols((VALVE_VOLTAGE,)), {n: ca.SX.sym(n) for n in self.parameters}
        through = self._edge_flows(x, u, p)
        air, expansion = through.supply_a + through.supply_b, ca.log(p["supply.pressure"] / p["ambient.pressure"])
        power = air * p["gas.constant"] * p["ambient.temperature"] * expansion
        drawn = [air, self._spool_position(x, u, p), power]
        arguments = [ca.SX.sym("t"), *map(stack, (x, u, p))]
        meter = ca.Function("meter", arguments, drawn, ["t", "x", "u", "p"], ["air", "spool", "power"])
        return replace(declared, meter=meter)

    def _rhs(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG002 - no time in it
        y, v, a, b = (x[n] for n in ("position", "speed", "pressure_a", "pressure_b"))
        push = _air_force(p, a, b)
        inputs = law_inputs(self.friction, {**x, "force": push}, p)
        friction = self.friction.force(v, without_prefix(x, "friction"), inputs, without_prefix(p, "friction"))
        stop = self.cylinder.stop_force(y, v, without_prefix(p, "cylinder"))
        acceleration = self.load.acceleration(push - friction.value + stop, y, without_prefix(p, "load"))
        spool = self.valve.rates(u["valve_voltage"], without_prefix(x, "valve"), without_prefix(p, "valve"))
        rates = {"position": v, "speed": acceleration, **self._chamber_rates(x, u, p)}
        rates |= {f"valve.{n}": rate for n, rate in spool.items()}
        rates |= {f"friction.{n}": rate for n, rate in friction.rates.items()}
        pressed = {q.name: self.load.spring_force(y, without_prefix(p, "load")) for q in self.load.outputs}
        return rates, {q.name: x[q.name] for q in (POSITION, SPEED, *PRESSURE_SIGNALS)} | pressed

    def _chamber_rates(self, x: Symbols, u: Symbols, p: Symbols) -> dict[str, ca.SX]:
        """Rates of the chambers' states."""
        outside, R = p["ambient.temperature"], p["gas.constant"]
        inside, ports = self._chambers_and_ports(x, p)
        through = self._edge_flows(x, u, p)
        leak = piston_leak(x["pressure_a"], x["pressure_b"], p["cylinder.leak"])
        flows = {
            "a": [(through.supply_a, outside), (-through.a_exhaust, outside), (leak, ports["b"].temperature)],
            "b": [(through.supply_b, outside), (-through.b_exhaust, outside), (-leak, ports["a"].temperature)],
        }
        area_a, area_b = areas(p["cylinder.bore"], p["cylinder.rod"])
        swept = {"a": area_a * x["speed"], "b": -area_b * x["speed"]}
        rates: dict[str, ca.SX] = {}
        for side, volume in zip(SIDES, volumes(x["position"], without_prefix(p, "cylinder")), strict=True):
            around = Surroundings(volume, swept[side], outside, R)
            chamber_rates = self.chamber.rates(
                inside[side], [Inflow(*flow) for flow in flows[side]], around, without_prefix(p, "chamber")
            )
            rates |= {f"{name}_{side}": rate for name, rate in chamber_rates.items()}
        return rates

    def _chambers_and_ports(self, x: Symbols, p: Symbols) -> tuple[dict[str, dict[str, ca.SX]], dict[str, Port]]:
        """States of the chambers, and the valve's ports to them, by side."""
        inside = {side: {q.name: x[f"{q.name}_{side}"] for q in self.chamber.states} for side in SIDES}
        outside = p["ambient.temperature"]
        return inside, {side: Port(z["pressure"], self.chamber.temperature(z, outside)) for side, z in inside.items()}

    def _edge_flows(self, x: Symbols, u: Symbols, p: Symbols) -> Flows:
        """Mass flows through the valve's edges."""
        outside, ports = p["ambient.temperature"], self._chambers_and_ports(x, p)[1]
        supply, exhaust = Port(p["supply.pressure"], outside), Port(p["ambient.pressure"], outside)
        return self.valve.flows(
            self._spool_position(x, u, p), supply, exhaust, ports["a"], ports["b"], without_prefix(p, "valve")
        )

    def _spool_position(self, x: Symbols, u: Symbols, p: Symbols) -> ca.SX:
        return self.valve.position(u["valve_voltage"], without_prefix(x, "valve"), without_prefix(p, "valve"))

    @cached_property
    def _balance_function(self) -> ca.Function:
        """``(y, v, spool, a, b, p) -> (rates of pressure_a, pressure_b, speed; states)``, friction states steady.

        The bristles' rates are linear in their deflections, so one Newton step from zero gives the steady ones.
        """
        arguments = {n: ca.SX.sym(n) for n in ("position", "speed", "valve.spool", "pressure_a", "pressure_b")}
        p = {n: ca.SX.sym(n) for n in self.parameters}
        warm = dict.fromkeys(("temperature_a", "temperature_b"), p["ambient.temperature"])
        inner = {f"friction.{q.name}": ca.SX.sym(q.name) for q in self.friction.states}
        signals = {**arguments, **warm, **inner}
        x = {n: signals.get(n, ca.SX(0)) for n in names(self.states)}
        rates, _ = self._rhs(
            ca.SX(0), x, {VALVE_VOLTAGE.name: p["valve.centre"] + arguments["valve.spool"] * p["valve.span"]}, p
        )
        z, zdot = stack(inner), stack({n: rates[n] for n in inner})
        steady = ca.substitute(-ca.solve(ca.jacobian(zdot, z), zdot), z, 0) if inner else z
        results = [ca.vertcat(*(rates[n] for n in BALANCE_RATES)), stack(x)]
        results = ca.substitute(results, [z], [steady]) if inner else results
        return ca.Function("glide", [*arguments.values(), stack(p)], [ca.densify(v) for v in results])

    def _find_rest(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        allowed = ("position", "speed", "pressure_b", *names(self.load.outputs))
        others = ", ".join(sorted(outputs.keys() - set(allowed)))
        message = (
            f"a cylinder starts from {', '.join(allowed[:-1])} and {allowed[-1]}, not from {others}; leave {others} out"
        )
        require(not others, message)
        start = dict(outputs)
        if LOAD_FORCE.name in start:
            force, alone = start.pop(LOAD_FORCE.name), "position" not in start
            require(alone, "a spring's force says where the piston is; start from load_force or position, not both")
            used = self._complete(parameters)
            stiffness = used.value("load.stiffness")
            require(
                stiffness > 0, f"load.stiffness is {stiffness:g} N/m: without a spring there is no force to control"
            )
            start["position"] = used.value("load.rest_position") + force / stiffness
        return self.rest(parameters, **start)


_FLOW_PARAMETERS = frozenset({"valve.conductance", "valve.critical_ratio", "supply.pressure", "valve.leak"})
_FLOW_HINTS = IdentificationHints(
    runs=(
        SeparatingRun(
            _FLOW_PARAMETERS,
            _FLOW_PARAMETERS,
            "log chambers filling up to the supply's pressure and emptying to the ambient's",
        ),
    ),
    widths=(Width("valve.rounding", start=ROUNDING_START),),
)
_AIR_PARAMETERS = ParameterSet(
    {
        "ambient.temperature": Parameter(
            293.15,
            "K",
            200.0,
            400.0,
            source="ISO 8778 standard atmosphere (ANR)",
            meaning="temperature of the supply and the surroundings",
        ),
        "gas.constant": Parameter(
            GAS_CONSTANT, "J/(kg*K)", 250.0, 320.0, source="dry air", meaning="specific gas constant"
        ),
    }
)


def _log_warnings(zeros: LogWarningHook, lines: LogWarningHook, logs: Mapping[str, Log]) -> Sequence[str]:
    """Warnings of impossible positions; where there are none, of wrong pressures, which a wrong position would hide."""
    moved = {name: log for name, log in logs.items() if "position" in log.measured}
    warnings = {name: position_warning(log.parameters, log.measured["position"]) for name, log in moved.items()}
    outside = [f"{name}: {sentence}" for name, sentence in warnings.items() if sentence]
    return outside or zeros(logs) or lines(logs)


def _air_force(p: Mapping[str, Any], a: Any, b: Any) -> Any:
    """Force of the air on the piston [N], from symbols or numbers."""
    area_a, area_b = areas(p["cylinder.bore"], p["cylinder.rod"])
    return area_a * (a - p["ambient.pressure"]) - area_b * (b - p["ambient.pressure"])


_CRITICAL_RATIO = "valve.critical_ratio"
_SMOOTHING_KEYS = {
    "corner": Key("rounding of the corner where the flow chokes", usual=Smoothing.corner, least=0.0, is_open=True),
    "zero": Key("rounding of the flow law at no flow", usual=Smoothing.zero, least=0.0, is_open=True),
    "pressure": Key(
        "rounding of the larger of two pressures", unit="Pa", usual=Smoothing.pressure, least=0.0, is_open=True
    ),
}
_SECTIONS: Mapping[str, Mapping[str, Key]] = {
    "cylinder": {"stops": flag("whether the covers stop the piston", usual=True)},
    "valve": {
        "law": choice("flow law of the edges", {"iso6358": Iso6358, "isentropic": IsentropicNozzle}, "iso6358"),
        "spool": choice("lag of the spool", {spool.name.lower(): spool for spool in Spool}, "second_order"),
        "smoothing": table("widths over which the flow law is rounded", _SMOOTHING_KEYS),
    },
    "supply": {},
    "gas": {},
    "chamber": {
        "model": choice("change of state of the air", {"polytropic": Polytropic, "thermal": Thermal}, "polytropic"),
        "mixed": flag("whether inflow, outflow and volume have an exponent each"),
    },
    "ambient": {},
    "load": LOAD_KEYS,
    "friction": FRICTION_KEYS,
}


def _build_drive(sections: DriveSections) -> PneumaticDrive:
    options = sections.options("valve")
    valve = ProportionalValve(options["law"](), options["spool"], Smoothing(**options["smoothing"]))
    cylinder, load = Cylinder(**sections.options("cylinder")), Load(**sections.options("load"))
    air = sections.options("chamber")
    is_polytropic = air["model"] is Polytropic
    message = f"{sections.place('chamber', 'mixed')}: a thermal chamber has no exponents; leave it out"
    require(is_polytropic or not sections.has("chamber", "mixed"), message)
    chamber = Polytropic(air["mixed"]) if is_polytropic else Thermal()
    return PneumaticDrive(valve, read_friction(sections), load, chamber, cylinder)


def _read_nominal_flow(entry: Any, values: Mapping[str, float], where: str) -> float:
    """Conductance [m^3/(s*Pa)] of a nominal flow in l/min(ANR), 6 to 5 bar(g), at the critical ratio in `values`."""
    is_anr = isinstance(entry, str) and entry.strip().endswith("(ANR)")
    advice = 'a nominal flow, 6 to 5 bar(g), is written at ANR (20 degC, 100 kPa): "700 l/min(ANR)"'
    require(is_anr, f"{where}: {entry!r}: {advice}", UnitError)
    flow = read_value(entry.strip().removesuffix("(ANR)"), "m^3/s", where=where)
    require(flow > 0, f"{where}: a flow is positive, got {entry!r}")
    return conductance_of_nominal_flow(flow, values.get(_CRITICAL_RATIO, CRITICAL_RATIO))


PNEUMATIC_KIND = DriveKind(
    PneumaticDrive.kind,
    _SECTIONS,
    _build_drive,
    aliases=(
        Alias(
            "valve",
            "nominal_flow",
            "valve.conductance",
            (_CRITICAL_RATIO,),
            _read_nominal_flow,
            "nominal flow of a catalogue, from 6 to 5 bar(g)",
            "l/min(ANR)",
            '"700 l/min(ANR)"',
        ),
    ),
    first=FirstFiles(
        options={"friction": {"model": "stribeck"}},
        unknowns=("valve.conductance", "valve.dead_zone", *STRIBECK_UNKNOWNS),
        gains={"Kp": (0.5, 0.05, 4), "Ki": (5, 0.5, 60), "Kd": (0, 0, 0.15), "Tf": (5e-3, 2e-3, 0.02)},
        limit=5.0,
        dither=(100.0, 1.5),
        steps=(0.1, 0.25),
        horizon=0.45,
        swept="load.mass",
        values={"cylinder.start": 0.25},
    ),
)


BALANCE_RATES = ("pressure_a", "pressure_b", "speed")


@dataclass(frozen=True, eq=False)
class MotionBalance:
    """Rates of a drive at a position [m] and speed [m/s] as functions of spool position and pressures."""

    function: ca.Function  # (position, speed, spool, pressure_a, pressure_b, p) -> (BALANCE_RATES; states)
    p: Array
    position: float
    speed: float

    def rates(self, spool: float, a: float, b: float) -> tuple[float, float, float]:
        """Rates of both pressures [Pa/s] and of the speed [m/s^2]."""
        rate_a, rate_b, acceleration = self._evaluate(spool, a, b)[0].tolist()
        return rate_a, rate_b, acceleration

    def states(self, spool: float, a: float, b: float) -> list[float]:
        """States of the drive."""
        found: list[float] = self._evaluate(spool, a, b)[1].tolist()
        return found

    @cached_property
    def _evaluate(self) -> Callable[[float, float, float], list[Array]]:
        """The function on buffers of its own: a call costs 6 us instead of 70, and a rest takes hundreds of them."""
        buffer, run = self.function.buffer()
        inputs: list[Array] = [np.array([v]) for v in (self.position, self.speed, 0.0, 0.0, 0.0)]
        inputs.append(np.array(self.p, dtype=float))
        results: list[Array] = [np.zeros(self.function.size1_out(i)) for i in range(2)]
        setters: tuple[tuple[Any, list[Array]], ...] = ((buffer.set_arg, inputs), (buffer.set_res, results))
        for setter, arrays in setters:
            for i, array in enumerate(arrays):
                setter(i, array.data)

        def evaluate(spool: float, a: float, b: float) -> list[Array]:
            inputs[2][0], inputs[3][0], inputs[4][0] = spool, a, b
            run()
            return results

        evaluate.keep_alive = buffer  # type: ignore[attr-defined]
        return evaluate


def solve_steady_motion(glide: MotionBalance, p: ParameterSet, pressure_b: float | None) -> tuple[list[float], float]:
    """States and voltage at which only the position changes; pressure_b [Pa(a)], where given, is trapped."""
    if glide.speed:
        verdict = f"no steady motion at speed = {glide.speed:g} m/s: "
        require(pressure_b is None, verdict + "trapped air (pressure_b) holds a drive still; give only one of the two")
        spring = p.value("load.stiffness") if "load.stiffness" in p else 0.0
        require(spring == 0, verdict + f"load.stiffness = {spring:g} N/m pulls more the farther it goes; start at rest")
    if pressure_b is None:
        spool, a, b = _solve_balance(glide, p)
    else:
        spool, b = 0.0, pressure_b
        require(
            b > MIN_CHAMBER_PRESSURE,
            f"pressure_b = {b:g} Pa is no absolute pressure of a chamber; give more than {MIN_CHAMBER_PRESSURE:g} Pa",
        )
        low, high = p.value("ambient.pressure"), p.value("supply.pressure")
        at_low, at_high = (glide.rates(spool, a, b)[2] for a in (low, high))
        a = low - at_low * (high - low) / (at_high - at_low)  # the force is linear in the pressure
        require(
            a > MIN_CHAMBER_PRESSURE,
            f"no equilibrium exists: beside pressure_b = {b:g} Pa chamber a would need {a:g} Pa; give more",
        )
    return glide.states(spool, a, b), p.value("valve.centre") + spool * p.value("valve.span")


def _solve_balance(glide: MotionBalance, p: ParameterSet) -> tuple[float, float, float]:
    """Spool position and pressures at which nothing changes, by nested root searches on functions with one zero each.

    In motion a chamber may exceed the supply pressure: the piston compresses the air that the spool throttles.
    """
    low, high, rates = p.value("ambient.pressure"), p.value("supply.pressure"), glide.rates
    if glide.speed:
        low, high = MIN_CHAMBER_PRESSURE, MAX_COMPRESSION_RATIO * high

    def pressures(spool: float) -> tuple[float, float]:
        def pressure_b_at(a: float) -> float:
            return _zero_crossing_or_end(lambda b: rates(spool, a, b)[1], low, high)

        if p.value("cylinder.leak") == 0:
            return _zero_crossing_or_end(lambda a: rates(spool, a, low)[0], low, high), pressure_b_at(low)
        a = _zero_crossing_or_end(lambda a: rates(spool, a, pressure_b_at(a))[0], low, high)
        return a, pressure_b_at(a)

    def acceleration_at(spool: float) -> float:
        return rates(spool, *pressures(spool))[2]

    mass = p.value("load.mass")
    ends = [acceleration_at(end) * mass for end in (-1.0, 1.0)]
    what = f"no steady motion at speed = {glide.speed:g} m/s" if glide.speed else "no equilibrium exists"
    require(
        ends[0] <= 0 <= ends[1],
        f"{what}: beyond {'friction and ' if glide.speed else ''}load the cylinder pushes with {ends[0]:.4g} to "
        f"{ends[1]:.4g} N at supply.pressure = {p.value('supply.pressure'):g} Pa(a), never with 0; "
        f"lower the {'speed or the ' if glide.speed else ''}load, raise the supply or the bore",
    )
    spool = 0.0 if abs(acceleration_at(0.0)) * mass < 1e-9 else _brent_root(acceleration_at, -1.0, 1.0)
    a, b = pressures(spool)
    inside = not glide.speed or (low < min(a, b) and max(a, b) < high)
    require(inside, f"{what}: a chamber would need {a if low < b < high else b:g} Pa(a); lower the speed")
    return spool, a, b


def _zero_crossing_or_end(rate: Callable[[float], float], low: float, high: float) -> float:
    """Pressure at which its rate falls through zero; an end of the range where it does not."""
    if rate(high) >= 0:
        return high
    return low if rate(low) <= 0 else _brent_root(rate, low, high)


def _brent_root(function: Callable[[float], float], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-14 * (high - low), rtol=1e-15))


def position_warning(p: ParameterSet, position: Array) -> str:
    """A sentence on a logged position [m] that is outside the stroke by more than a zero error; else empty."""
    stroke = p.value("cylinder.stroke")
    low, high = (float(np.nanpercentile(position, q)) for q in (1, 99))
    if -MAX_POSITION_ZERO_ERROR * stroke <= low and high <= (1 + MAX_POSITION_ZERO_ERROR) * stroke:
        return ""
    where = f"position runs from {write_value(low, 'm')} to {write_value(high, 'm')}"
    remedy = "check its sign, unit and zero, and cylinder.stroke"
    return f"{where}, outside the stroke, 0 to {write_value(stroke, 'm')}: {remedy}"


def cylinder_limits(stops: bool) -> tuple[ValidityLimit, ...]:
    """Validity limits that a simulation watches: the ends of the stroke, with stops or not, and empty chambers."""
    what = "reached the {} end stop" if stops else "left the stroke at the {}"
    meaning = "the response is the stop's" if stops else "the model, which has no stops, means nothing"
    margin = STOP_ROUNDING if stops else 0.0
    ends = [
        ValidityLimit("position", partial(_stroke_limit, margin, way), way, f"the piston {what.format(end)}", meaning)
        for way, end in ((-1, "rear"), (1, "front"))
    ]
    meaning = "real seals let air in, the model does not"
    chambers = [
        ValidityLimit(f"pressure_{side}", _empty_chamber_pressure, -1, f"chamber {side} was emptied", meaning)
        for side in SIDES
    ]
    return *ends, *chambers


# These limits are functions of the module, not lambdas: a system goes to other processes (pickle).
def _stroke_limit(margin: float, way: int, p: ParameterSet) -> float:
    return p.value("cylinder.stroke") - margin if way > 0 else margin


def _empty_chamber_pressure(p: ParameterSet) -> float:
    return EMPTY_CHAMBER_RATIO * p.value("ambient.pressure")


class _Limit(NamedTuple):
    """Possible range of a parameter, with the remedy for a value outside."""

    remedy: str
    lower: float = -inf
    upper: float = inf
    exclusive: bool = True

    def allows(self, value: float) -> bool:
        return self.lower < value < self.upper or (not self.exclusive and value in (self.lower, self.upper))


_POSITIVE_REMEDIES = {
    "cylinder.bore": "a bore is positive",
    "cylinder.stroke": "a stroke is positive",
    "cylinder.dead_volume_a": "ports and hoses always hold some air: a few percent of the swept volume are usual",
    "cylinder.dead_volume_b": "ports and hoses always hold some air: a few percent of the swept volume are usual",
    "valve.conductance": "a conductance is positive, about 2e-8 m^3/(s*Pa) for 500 l/min(ANR)",
    "valve.rounding": "edges are round: 1e-4 is very sharp",
    "valve.span": "give the voltage of full opening, 5 V for a 0-10 V valve",
    "valve.bandwidth": "a bandwidth is positive, or take a valve without a lag",
    "valve.damping": "a damping ratio is positive, 0.5 to 0.8 for most valves",
    "ambient.temperature": "an absolute temperature is positive",
    "gas.constant": "air has 287.05 J/(kg*K)",
    "load.mass": "the piston alone weighs something",
}
_NON_NEGATIVE_REMEDIES = {
    "cylinder.leak": "no leakage is 0",
    "cylinder.stop_stiffness": "no stop is 0, or Cylinder(stops=False)",
    "cylinder.stop_damping": "no damping is 0",
    "valve.leak": "no leakage is 0",
    "chamber.wall_conductance": "no heat transfer is 0",
}


def _hardware_limits(p: ParameterSet) -> dict[str, _Limit]:
    bore, ambient = (write_value(p.value(n), p[n].unit) for n in ("cylinder.bore", "ambient.pressure"))
    exponents = {
        n: _Limit("1 is isothermal, 1.4 adiabatic", 0.0) for n in p if n.startswith("chamber.") and "exponent" in n
    }
    return {
        **{n: _Limit(remedy, 0.0) for n, remedy in _POSITIVE_REMEDIES.items()},
        **{n: _Limit(remedy, 0.0, exclusive=False) for n, remedy in _NON_NEGATIVE_REMEDIES.items()},
        **exponents,
        "cylinder.rod": _Limit(
            f"a rod is thinner than the bore, {bore}; rodless is 0", -1e-300, p.value("cylinder.bore")
        ),
        "cylinder.start": _Limit("a start lies within the stroke, 0 to 1", 0.0, 1.0, exclusive=False),
        "valve.critical_ratio": _Limit(
            "a critical pressure ratio lies between 0 and 1, 0.2 to 0.5 for most valves", -1e-300, 1.0
        ),
        "ambient.pressure": _Limit("an absolute pressure is positive; sea level is 101325 Pa(a)", MIN_CHAMBER_PRESSURE),
        "supply.pressure": _Limit(
            f"the supply lies above the ambient pressure, {ambient}", p.value("ambient.pressure")
        ),
    }
