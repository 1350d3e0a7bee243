"""`PneumaticDrive`: supply, proportional valve, cylinder and load in one ODE."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from pneuopt.dynamics.excitation import Excitation, SeparatingRun, Width
from pneuopt.dynamics.hooks import Axis, FinalElement, Log, LogWarningHook, Rest
from pneuopt.dynamics.system import Symbols, System, define, names, parameter_vector, stack, symbols
from pneuopt.models.drive import AMBIENT_PARAMETERS, POSITION, SPEED, rename_quantity
from pneuopt.models.friction import FrictionModel, Stribeck, law_inputs
from pneuopt.models.linear import VALVE_VOLTAGE
from pneuopt.models.load import LOAD_FORCE, Load
from pneuopt.models.needs import LOAD_EXCITATION
from pneuopt.models.pneumatic.chamber import ChamberModel, Inflow, Polytropic, Surroundings
from pneuopt.models.pneumatic.cylinder import Cylinder, areas, piston_leak, volumes
from pneuopt.models.pneumatic.gas import GAS_CONSTANT
from pneuopt.models.pneumatic.limits import check_hardware, check_start, cylinder_limits, position_warning
from pneuopt.models.pneumatic.line_pressure import LinePressureCheck
from pneuopt.models.pneumatic.pressure_zero import PressureZeroCheck
from pneuopt.models.pneumatic.rest import BALANCE_RATES, MotionBalance, solve_steady_motion
from pneuopt.models.pneumatic.starts import PneumaticStarts
from pneuopt.models.pneumatic.valve import Flows, Port, ProportionalValve
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory

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
        air = tuple(rename_quantity(q, f"{q.name}_{side}") for q in self.chamber.states for side in SIDES)
        spool = tuple(rename_quantity(q, f"valve.{q.name}") for q in self.valve.states)
        return POSITION, SPEED, *air, *spool, *(rename_quantity(q, f"friction.{q.name}") for q in self.friction.states)

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

        Raises
        ------
        InputError
            Names parameter, value, source and possible values.
        """
        defaults = self.parameters
        used = defaults | parameters.select(n for n in parameters if n in defaults)
        check_hardware(used)
        if start is not None:
            check_start(used, start)

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
        own = self.parameters
        used = own | parameters.select(n for n in parameters if n in own)
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
        own = self.parameters
        used = own | parameters.select(n for n in parameters if n in own)
        numbers = {n: q.value for n, q in used.items()}
        return np.asarray(_air_force(numbers, *(measured[q.name] for q in PRESSURE_SIGNALS)))

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
            excitation=self.friction.excitation.with_prefix("friction") | LOAD_EXCITATION | _FLOW_EXCITATION,
            axis=_AXIS,
        )
        return replace(declared, meter=self._meter_function())

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
        swept = dict(zip(SIDES, (_piston_areas(p)[0] * x["speed"], -_piston_areas(p)[1] * x["speed"]), strict=True))
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

    def _meter_function(self) -> ca.Function:
        """Function ``(t, x, u, p)`` for air from the supply [kg/s], spool position [half travels], air power [W].

        Air power is the work that this air could do in an isothermal expansion to ambient pressure: the integral of
        p dV of an ideal gas, p V = m R T, per unit time, ``m' R T ln(p_s/p_o)``; its flow exergy at ambient
        temperature.
        """
        x, u, p = symbols(self.states), symbols((VALVE_VOLTAGE,)), {n: ca.SX.sym(n) for n in self.parameters}
        through = self._edge_flows(x, u, p)
        air, expansion = through.supply_a + through.supply_b, ca.log(p["supply.pressure"] / p["ambient.pressure"])
        power = air * p["gas.constant"] * p["ambient.temperature"] * expansion
        drawn = [air, self._spool_position(x, u, p), power]
        given = [ca.SX.sym("t"), *map(stack, (x, u, p))]
        return ca.Function("meter", given, drawn, ["t", "x", "u", "p"], ["air", "spool", "power"])

    @cached_property
    def _balance_function(self) -> ca.Function:
        """``(y, v, spool, a, b, p) -> (rates of pressure_a, pressure_b, speed; states)``, friction states steady.

        The bristles' rates are linear in their deflections, so one Newton step from zero gives the steady ones.
        """
        given = {n: ca.SX.sym(n) for n in ("position", "speed", "valve.spool", "pressure_a", "pressure_b")}
        p = {n: ca.SX.sym(n) for n in self.parameters}
        warm = dict.fromkeys(("temperature_a", "temperature_b"), p["ambient.temperature"])
        inner = {f"friction.{q.name}": ca.SX.sym(q.name) for q in self.friction.states}
        known = {**given, **warm, **inner}
        x = {n: known.get(n, ca.SX(0)) for n in names(self.states)}
        rates, _ = self._rhs(
            ca.SX(0), x, {VALVE_VOLTAGE.name: p["valve.centre"] + given["valve.spool"] * p["valve.span"]}, p
        )
        z, zdot = stack(inner), stack({n: rates[n] for n in inner})
        steady = ca.substitute(-ca.solve(ca.jacobian(zdot, z), zdot), z, 0) if inner else z
        found = [ca.vertcat(*(rates[n] for n in BALANCE_RATES)), stack(x)]
        found = ca.substitute(found, [z], [steady]) if inner else found
        return ca.Function("glide", [*given.values(), stack(p)], [ca.densify(v) for v in found])

    def _find_rest(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        known = ("position", "speed", "pressure_b", *names(self.load.outputs))
        others = ", ".join(sorted(outputs.keys() - set(known)))
        told = f"a cylinder starts from {', '.join(known[:-1])} and {known[-1]}, not from {others}; leave {others} out"
        require(not others, told)
        start = dict(outputs)
        if LOAD_FORCE.name in start:
            start["position"] = self._pressed_position(parameters, start.pop(LOAD_FORCE.name), "position" in start)
        return self.rest(parameters, **start)

    def _pressed_position(self, parameters: ParameterSet, force: float, stated: bool) -> float:
        """Position at which the spring on the load is pressed with a force [N]."""
        require(not stated, "a spring's force says where the piston is; start from load_force or position, not both")
        used = self.parameters | parameters.select(n for n in parameters if n in self.parameters)
        stiffness = used.value("load.stiffness")
        require(stiffness > 0, f"load.stiffness is {stiffness:g} N/m: without a spring there is no force to control")
        return used.value("load.rest_position") + force / stiffness


# factor of a search over the rounding of the valve's edges [1]: a smaller one takes more trials, a larger one leaves
# out the rounding of a worn valve
_ROUNDING_FACTOR = 4.0
_FLOW_PARAMETERS = frozenset({"valve.conductance", "valve.critical_ratio", "supply.pressure", "valve.leak"})
_FLOW_EXCITATION = Excitation(
    runs=(
        SeparatingRun(
            _FLOW_PARAMETERS,
            _FLOW_PARAMETERS,
            "log chambers filling up to the supply's pressure and emptying to the ambient's",
        ),
    ),
    widths=(Width("valve.rounding", _ROUNDING_FACTOR, hides="valve.dead_zone"),),
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
    """Warnings of impossible positions or, where there are none, of pressures: wrong zero points, or before a line.

    A wrong position gives wrong chamber volumes, from which no zero point of a pressure can be judged.
    """
    moved = {name: log for name, log in logs.items() if "position" in log.measured}
    found = {name: position_warning(log.parameters, log.measured["position"]) for name, log in moved.items()}
    outside = [f"{name}: {sentence}" for name, sentence in found.items() if sentence]
    return outside or zeros(logs) or lines(logs)


def _air_force(p: Mapping[str, Any], a: Any, b: Any) -> Any:
    """Force of the air on the piston [N], from symbols or numbers."""
    area_a, area_b = areas(p["cylinder.bore"], p["cylinder.rod"])
    return area_a * (a - p["ambient.pressure"]) - area_b * (b - p["ambient.pressure"])


def _piston_areas(p: Symbols) -> tuple[ca.SX, ca.SX]:
    return areas(p["cylinder.bore"], p["cylinder.rod"])
