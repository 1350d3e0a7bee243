"""`PneumaticDrive`: supply, proportional valve, cylinder and load, wired by hand into one ODE."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from pneuopt.errors import InputError, require
from pneuopt.models.chamber import VACUUM, ChamberModel, Inflow, Polytropic, Surroundings
from pneuopt.models.cylinder import Cylinder, areas, piston_leak, volumes
from pneuopt.models.drive import AMBIENT, POSITION, SPEED, gauge, part, renamed
from pneuopt.models.friction import FrictionModel, Stribeck
from pneuopt.models.gas import GAS_CONSTANT
from pneuopt.models.linear import VALVE_VOLTAGE
from pneuopt.models.load import Load
from pneuopt.models.pneumatic_start import PneumaticStarts
from pneuopt.models.valve import Port, ProportionalValve
from pneuopt.parameters import Parameter, ParameterSet, Quantity
from pneuopt.system import Rest, System, define, names, vector

Symbols = Mapping[str, ca.SX]
Residual = Callable[[float, float, float], tuple[float, float, float]]
SIDES = ("a", "b")
PRESSURES = tuple(Quantity(f"pressure_{side}", "Pa(a)", nominal=5e5) for side in SIDES)


@dataclass(frozen=True)
class PneumaticDrive:
    r"""A double-acting cylinder behind a 5/3 proportional valve.

    .. math:: M \dot v = A_a p_a - A_b p_b - (A_a - A_b) p_o - F_f - F_L + F_{stop}

    States: position [m] from the end where chamber a is smallest, speed, pressure_a and pressure_b (absolute), with
    `Thermal` chambers temperature_a and temperature_b, then the valve's and the friction's. Input: valve_voltage [V], a
    deviation from the valve's centre; positive drives forwards. Outputs: position, speed, pressure_a, pressure_b.

    Parameters
    ----------
    valve : ProportionalValve
    friction : FrictionModel
        One that depends on pressure gets both chambers' gauge pressures.
    load : Load
    chamber : ChamberModel
        Of both chambers.
    cylinder : Cylinder
    """

    valve: ProportionalValve = field(default_factory=ProportionalValve)
    friction: FrictionModel = field(default_factory=Stribeck)
    load: Load = field(default_factory=Load)
    chamber: ChamberModel = field(default_factory=Polytropic)
    cylinder: Cylinder = field(default_factory=Cylinder)

    @property
    def parameters(self) -> ParameterSet:
        """cylinder.*, valve.*, supply.pressure, ambient.*, gas.constant, chamber.*, load.*, friction.*."""
        parts = {
            "cylinder": self.cylinder.parameters,
            "valve": self.valve.parameters,
            "supply": ParameterSet({"pressure": Parameter(7.01325e5, "Pa(a)", 1e4, 2.1e6)}),
            "chamber": self.chamber.parameters,
            "load": self.load.parameters,
            "friction": self.friction.parameters,
        }
        joined = ParameterSet()
        for name, own in parts.items():
            joined |= own.prefixed(name)
        return joined | AMBIENT | _AIR

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The load's, the chambers', the valve's, the friction's."""
        air = tuple(renamed(q, f"{q.name}_{side}") for q in self.chamber.states for side in SIDES)
        spool = tuple(renamed(q, f"valve.{q.name}") for q in self.valve.states)
        return POSITION, SPEED, *air, *spool, *(renamed(q, f"friction.{q.name}") for q in self.friction.states)

    def system(self) -> System:
        """Wire the parts."""
        return self._system

    def check(self, parameters: ParameterSet) -> None:
        """Refuse impossible hardware, whatever its bounds.

        Parameters
        ----------
        parameters : ParameterSet
            A missing one counts with its default.

        Raises
        ------
        InputError
            Naming parameter, value, source and what would be possible.
        """
        used = self.parameters | parameters.select(n for n in parameters if n in self.parameters)
        for name, limit in _limits(used).items():
            if name in used and not limit.allows(used.value(name)):
                shown, source = used[name], f" (source: {used[name].source})" if used[name].source else ""
                raise InputError(f"{name} = {shown.value:g} {shown.unit}{source} is impossible; {limit.remedy}")

    def rest(self, parameters: ParameterSet, *, position: float | None = None, pressure_b: float | None = None) -> Rest:
        """Where the drive stands still, friction unloaded.

        No air flows on balance and the forces cancel: a cylinder with a rod, or under load, needs a spool a little off
        its centre for that. It is an equilibrium of the ODE, whatever the friction.

        Parameters
        ----------
        parameters : ParameterSet
        position : float, optional
            [m]; by default cylinder.start of the stroke.
        pressure_b : float, optional
            The air that a closed valve has trapped, absolute [Pa]: the spool stays centred, chamber a balances the
            forces, and what leaks past the edges makes this a rest for a while only.

        Returns
        -------
        Rest
            All states, and valve_voltage.

        Raises
        ------
        InputError
            If the hardware is impossible, the position lies outside the stroke, or no spool position balances the load.
        """
        self.check(parameters)
        used = self.parameters | parameters.select(n for n in parameters if n in self.parameters)
        stroke = used.value("cylinder.stroke")
        y = used.value("cylinder.start") * stroke if position is None else position
        require(0 <= y <= stroke, f"a start at position = {y:g} m lies outside the stroke, 0 to {stroke:g} m")
        rates = self._standing(used, y)
        if pressure_b is None:
            spool, *pressures = _balanced(rates, used)
        else:
            spool, pressures = 0.0, [_balancing(rates, used, pressure_b), pressure_b]
        return Rest(self._state(used, y, spool, *pressures), {VALVE_VOLTAGE.name: spool * used.value("valve.span")})

    @cached_property
    def _system(self) -> System:
        outputs = (POSITION, SPEED, *PRESSURES)
        starts = PneumaticStarts(self.system, _areas)
        return define(self.states, (VALVE_VOLTAGE,), outputs, self.parameters, self._rhs, starts, self._rest_for_loop)

    def _rhs(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG002 - no time in it
        y, v, a, b = (x[n] for n in ("position", "speed", "pressure_a", "pressure_b"))
        friction = self.friction.force(v, part(x, "friction"), gauge(self.friction, x, p), part(p, "friction"))
        push_a, push_b = (area * (q - p["ambient.pressure"]) for area, q in zip(_areas(p), (a, b), strict=True))
        stop = self.cylinder.stop_force(y, v, part(p, "cylinder"))
        acceleration = self.load.acceleration(push_a - push_b - friction.value + stop, y, part(p, "load"))
        spool = self.valve.rates(u["valve_voltage"], part(x, "valve"), part(p, "valve"))
        rates = {"position": v, "speed": acceleration, **self._air(x, u, p)}
        rates |= {f"valve.{n}": rate for n, rate in spool.items()}
        rates |= {f"friction.{n}": rate for n, rate in friction.rates.items()}
        return rates, {q.name: x[q.name] for q in (POSITION, SPEED, *PRESSURES)}

    def _air(self, x: Symbols, u: Symbols, p: Symbols) -> dict[str, ca.SX]:
        """Rates of the chambers' states."""
        outside, R = p["ambient.temperature"], p["gas.constant"]
        inside = {side: {q.name: x[f"{q.name}_{side}"] for q in self.chamber.states} for side in SIDES}
        ports = {side: Port(z["pressure"], self.chamber.temperature(z, outside)) for side, z in inside.items()}
        spool = self.valve.position(u["valve_voltage"], part(x, "valve"), part(p, "valve"))
        supply, exhaust = Port(p["supply.pressure"], outside), Port(p["ambient.pressure"], outside)
        through = self.valve.flows(spool, supply, exhaust, ports["a"], ports["b"], part(p, "valve"))
        leak = piston_leak(x["pressure_a"], x["pressure_b"], p["cylinder.leak"])
        flows = {
            "a": [(through.supply_a, outside), (-through.a_exhaust, outside), (leak, ports["b"].temperature)],
            "b": [(through.supply_b, outside), (-through.b_exhaust, outside), (-leak, ports["a"].temperature)],
        }
        swept = dict(zip(SIDES, (_areas(p)[0] * x["speed"], -_areas(p)[1] * x["speed"]), strict=True))
        rates: dict[str, ca.SX] = {}
        for side, volume in zip(SIDES, volumes(x["position"], part(p, "cylinder")), strict=True):
            around = Surroundings(volume, swept[side], outside, R)
            own = self.chamber.rates(inside[side], [Inflow(*flow) for flow in flows[side]], around, part(p, "chamber"))
            rates |= {f"{name}_{side}": rate for name, rate in own.items()}
        return rates

    def _state(self, p: ParameterSet, y: float, spool: float, a: float, b: float) -> dict[str, float]:
        """All states of the drive standing still."""
        state = dict.fromkeys(names(self.states), 0.0)
        known = {"position": y, "pressure_a": a, "pressure_b": b, "valve.spool": spool}
        known |= dict.fromkeys(("temperature_a", "temperature_b"), p.value("ambient.temperature"))
        return state | {n: value for n, value in known.items() if n in state}

    def _standing(self, p: ParameterSet, y: float) -> Residual:
        """Rates of both pressures [Pa/s] and of the speed [m/s^2] at a spool position and two pressures."""
        system, values, span = self.system(), vector(self.parameters, p), p.value("valve.span")
        rows = [names(system.states).index(n) for n in ("pressure_a", "pressure_b", "speed")]

        def rates(spool: float, a: float, b: float) -> tuple[float, float, float]:
            x = list(self._state(p, y, spool, a, b).values())
            found = np.array(system.ode(0, x, [spool * span], values)[0]).ravel()[rows]
            return float(found[0]), float(found[1]), float(found[2])

        return rates

    def _rest_for_loop(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        if outputs.keys() <= {"position"}:
            return self.rest(parameters, position=outputs.get("position"))
        require(
            outputs == {"speed": 0.0},
            f"a cylinder does not rest at {dict(outputs)}; start a loop at speed 0, or give x_plant",
        )
        return self.rest(parameters)


class _Limit(NamedTuple):
    """What a parameter may be at all."""

    remedy: str
    lower: float = -inf
    upper: float = inf
    open: bool = True

    def allows(self, value: float) -> bool:
        return self.lower < value < self.upper or (not self.open and value in (self.lower, self.upper))


_AIR = ParameterSet(
    {
        "ambient.temperature": Parameter(293.15, "K", 200.0, 400.0, source="ISO 8778 standard atmosphere (ANR)"),
        "gas.constant": Parameter(GAS_CONSTANT, "J/(kg*K)", 250.0, 320.0, source="dry air"),
    }
)
_POSITIVE = {
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
_NOT_NEGATIVE = {
    "cylinder.leak": "no leakage is 0",
    "cylinder.stop_stiffness": "no stop is 0, or Cylinder(stops=False)",
    "cylinder.stop_damping": "no damping is 0",
    "valve.leak": "no leakage is 0",
    "chamber.wall_conductance": "no heat transfer is 0",
}


def _limits(p: ParameterSet) -> dict[str, _Limit]:
    bore, ambient = p.value("cylinder.bore"), p.value("ambient.pressure")
    exponents = {
        n: _Limit("1 is isothermal, 1.4 adiabatic", 0.0) for n in p if n.startswith("chamber.") and "exponent" in n
    }
    return {
        **{n: _Limit(remedy, 0.0) for n, remedy in _POSITIVE.items()},
        **{n: _Limit(remedy, 0.0, open=False) for n, remedy in _NOT_NEGATIVE.items()},
        **exponents,
        "cylinder.rod": _Limit(f"a rod is thinner than the bore, {bore:g} m; rodless is 0", -1e-300, bore),
        "cylinder.start": _Limit("a start lies within the stroke, 0 to 1", 0.0, 1.0, open=False),
        "valve.critical_ratio": _Limit(
            "a critical pressure ratio lies between 0 and 1, 0.2 to 0.5 for most valves", -1e-300, 1.0
        ),
        "ambient.pressure": _Limit("an absolute pressure is positive; sea level is 101325 Pa(a)", VACUUM),
        "supply.pressure": _Limit(f"the supply lies above the ambient pressure, {ambient:g} Pa(a)", ambient),
    }


def _balanced(rates: Residual, p: ParameterSet) -> tuple[float, float, float]:
    """Spool and pressures at which nothing changes: nested bisections, each on a monotone function."""
    low, high = p.value("ambient.pressure"), p.value("supply.pressure")

    def pressures(spool: float) -> tuple[float, float]:
        def b(a: float) -> float:
            return _root(lambda b: rates(spool, a, b)[1], low, high)

        if p.value("cylinder.leak") == 0:
            return _root(lambda a: rates(spool, a, low)[0], low, high), b(low)
        a = _root(lambda a: rates(spool, a, b(a))[0], low, high)
        return a, b(a)

    def push(spool: float) -> float:
        return rates(spool, *pressures(spool))[2]

    mass = p.value("load.mass")
    ends = [push(end) * mass for end in (-1.0, 1.0)]
    message = (
        f"no equilibrium exists: beyond the load the cylinder pushes with {ends[0]:.4g} to {ends[1]:.4g} N "
        f"at supply.pressure = {high:g} Pa(a), never with 0; lower the load, raise the supply or the bore"
    )
    require(ends[0] <= 0 <= ends[1], message)
    spool = 0.0 if abs(push(0.0)) * mass < 1e-9 else _root(push, -1.0, 1.0)
    return spool, *pressures(spool)


def _balancing(rates: Residual, p: ParameterSet, b: float) -> float:
    """The pressure in chamber a that balances pressure b; the force is linear in it."""
    require(b > VACUUM, f"pressure_b = {b:g} Pa is no absolute pressure of a chamber; give more than {VACUUM:g} Pa")
    low, high = p.value("ambient.pressure"), p.value("supply.pressure")
    at_low, at_high = (rates(0.0, a, b)[2] for a in (low, high))
    a = low - at_low * (high - low) / (at_high - at_low)
    require(a > VACUUM, f"no equilibrium exists: beside pressure_b = {b:g} Pa chamber a would need {a:g} Pa; give more")
    return a


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-14 * (high - low), rtol=1e-15))


def _areas(p: Symbols) -> tuple[ca.SX, ca.SX]:
    return areas(p["cylinder.bore"], p["cylinder.rod"])
