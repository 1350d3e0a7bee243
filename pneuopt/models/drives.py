"""Drives wired from parts, each pushed or moved by one known signal, with the sections of their files.

`ForceDrive`: a load that a known force pushes; `MotionDrive`: a rig that measures friction; `RotaryDrive`: a shaft that
a known torque turns. Below them, how a body that a known push drives rests or moves steadily (`with_rest`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar

import casadi as ca

from pneuopt.dynamics.hooks import Axis, Log, Rest, Start
from pneuopt.dynamics.system import Symbols, System, define, names, stack
from pneuopt.models.declaration import DriveKind, FirstFiles
from pneuopt.models.friction import (
    FRICTION_KEYS,
    LOAD_HINTS,
    RIG_HINTS,
    STRIBECK_UNKNOWNS,
    Coulomb,
    FrictionModel,
    law_inputs,
    load_hints,
    read_friction,
)
from pneuopt.models.load import LOAD_KEYS, Load
from pneuopt.models.starts import force_starts, motion_starts
from pneuopt.quantities.errors import ConvergenceError, ModelError, require
from pneuopt.quantities.keys import flag
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE

POSITION = Quantity("position", "m", nominal=0.1)
SPEED = Quantity("speed", "m/s", nominal=0.5)
FORCE = Quantity("force", "N", nominal=100.0)


@dataclass(frozen=True)
class ForceDrive:
    """A load with friction, pushed by a known force: any servo axis, or a cylinder whose chamber pressures are logged.

    M dv/dt = F - F_f(v) - F_L. Inputs: force [N], and the chambers' absolute pressures where friction depends on them.
    """

    kind: ClassVar[str] = "force"
    friction: FrictionModel
    load: Load = field(default_factory=Load)

    @property
    def parameters(self) -> ParameterSet:
        """load.*, friction.*, and ambient.pressure where friction depends on pressure."""
        parts = self.load.parameters.with_prefix("load") | self.friction.parameters.with_prefix("friction")
        return parts | _ambient_parameters(self.friction)

    def system(self) -> System:
        """Build the equations: states position, speed and those of friction; outputs position, speed."""
        inner = tuple(replace(q, name=f"friction.{q.name}") for q in self.friction.states)

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG001 - no time in it
            v, y = x["speed"], x["position"]
            inputs = law_inputs(self.friction, u, p)
            force = self.friction.force(v, without_prefix(x, "friction"), inputs, without_prefix(p, "friction"))
            acceleration = self.load.acceleration(u["force"] - force.value, y, without_prefix(p, "load"))
            rates = {f"friction.{n}": rate for n, rate in force.rates.items()}
            return {"position": v, "speed": acceleration, **rates}, {"position": y, "speed": v}

        inputs = (FORCE, *_pressure_inputs(self.friction))
        starts = partial(force_starts, self.friction)
        system = define((POSITION, SPEED, *inner), inputs, (POSITION, SPEED), self.parameters, rhs, starts)
        hints = self.friction.identification_hints.with_prefix("friction") | LOAD_HINTS
        # the power that the motor draws [W], zero where it brakes: it cannot feed back
        arguments = [ca.SX.sym(n, system.ode.size1_in(i)) for i, n in enumerate("txup")]
        force = arguments[2][names(system.inputs).index("force")]
        speed = arguments[1][names(system.states).index("speed")]
        meter = ca.Function("meter", arguments, [ca.fmax(force * speed, 0)], [*"txup"], ["power"])
        return with_rest(replace(system, identification_hints=hints, meter=meter), FORCE, Axis())


@dataclass(frozen=True)
class MotionDrive:
    """A friction rig: it moves a piston at a known speed and measures the force on it.

    force = area * (1 + area_bias) * (p_a - p_ambient) + F_f(v, p) + force_offset, with pressure in one chamber and the
    other one open. Without a chamber: force = F_f(v) + force_offset.

    Parameters
    ----------
    chamber : bool
        Whether the pressure of a chamber acts on the piston; input pressure_a [Pa(a)].
    """

    kind: ClassVar[str] = "motion"
    friction: FrictionModel
    chamber: bool = True

    def __post_init__(self) -> None:
        message = f"{self.friction} depends on the force, which this drive measures; take a ForceDrive"
        require(FORCE.name not in (q.name for q in self.friction.inputs), message, ModelError)

    @property
    def parameters(self) -> ParameterSet:
        """rig.*, friction.*, and ambient.pressure where a pressure acts."""
        area = Parameter(
            4.908738521e-4,
            "m^2",
            lower=1e-7,
            upper=10.0,
            source="bore 25 mm",
            meaning="piston area on which the chamber's pressure acts",
        )
        bias = Parameter(0.0, "1", lower=-0.5, upper=0.5, meaning="error of the area, a fraction of it")
        rig = {"rig.area": area, "rig.area_bias": bias} if self.chamber else {}
        offset = Parameter(0.0, "N", lower=-1e4, upper=1e4, meaning="reading of the force sensor without force")
        ambient = AMBIENT_PARAMETERS if self.chamber else _ambient_parameters(self.friction)
        return (
            ParameterSet({**rig, "rig.force_offset": offset})
            | self.friction.parameters.with_prefix("friction")
            | ambient
        )

    def system(self) -> System:
        """Build the equations: the states are those of friction; output force."""
        inner = tuple(replace(q, name=f"friction.{q.name}") for q in self.friction.states)

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG001 - no time in it
            force = self.friction.force(
                u["speed"],
                without_prefix(x, "friction"),
                law_inputs(self.friction, u, p),
                without_prefix(p, "friction"),
            )
            push = p["rig.force_offset"] + force.value
            if self.chamber:
                push += p["rig.area"] * (1 + p["rig.area_bias"]) * (u["pressure_a"] - p["ambient.pressure"])
            return {f"friction.{n}": rate for n, rate in force.rates.items()}, {"force": push}

        pressures = _pressure_inputs(self.friction)
        if self.chamber and "pressure_a" not in (q.name for q in pressures):
            pressures = (_PRESSURE_A, *pressures)
        starts = partial(motion_starts, self.friction)
        system = define(inner, (SPEED, *pressures), (FORCE,), self.parameters, rhs, starts)
        hints = self.friction.identification_hints.with_prefix("friction") | RIG_HINTS
        return replace(system, identification_hints=hints)


FORCE_KIND = DriveKind(
    ForceDrive.kind,
    {"load": LOAD_KEYS, "friction": FRICTION_KEYS, "ambient": {}},
    lambda sections: ForceDrive(read_friction(sections), Load(**sections.options("load"))),
    first=FirstFiles(
        options={"friction": {"model": "stribeck"}},
        unknowns=("load.mass", "load.force", *STRIBECK_UNKNOWNS),
        gains={"Kp": (400, 20, 2000), "Ki": (4000, 100, 1e5), "Kd": (0, 0, 5), "Tf": (5e-3, 2e-3, 0.05)},
        limit=250.0,
        dither=(100.0, 60.0),
        steps=(0.05, 0.25),
        horizon=0.6,
        swept="load.mass",
    ),
)
MOTION_KIND = DriveKind(
    MotionDrive.kind,
    {
        "rig": {"chamber": flag("whether the pressure of a chamber acts on the piston", usual=True)},
        "friction": FRICTION_KEYS,
        "ambient": {},
    },
    lambda sections: MotionDrive(read_friction(sections), **sections.options("rig")),
)

AMBIENT_PARAMETERS = ParameterSet(
    {
        "ambient.pressure": Parameter(
            ATMOSPHERE,
            "Pa(a)",
            lower=1e4,
            upper=2e5,
            source="ISO 2533 standard atmosphere",
            meaning="pressure of the surroundings, from which gauge pressures count",
        )
    }
)
_PRESSURE_A = Quantity("pressure_a", "Pa(a)", nominal=5e5)


def _ambient_parameters(friction: FrictionModel) -> ParameterSet:
    return AMBIENT_PARAMETERS if _pressure_inputs(friction) else ParameterSet()


def _pressure_inputs(friction: FrictionModel) -> tuple[Quantity, ...]:
    """Absolute pressures that pressure-dependent friction needs as inputs."""
    return tuple(Quantity(q.name, "Pa(a)", nominal=5e5) for q in friction.inputs if q.unit == "Pa(g)")


# Radius [m] on which a friction law's defaults, bounds and slow speeds, made for sliding, are those of a turning shaft:
# 30 N become 0.3 N*m, 1 mm/s becomes 0.1 rad/s. With ten times more, 1 rad/s of a geared motor counts as standstill;
# with ten times less, a motor's first revolutions count as sliding fast.
RADIUS = 0.01
ANGLE = Quantity("angle", "rad", nominal=0.1 / RADIUS)
ANGULAR_SPEED = Quantity("speed", "rad/s", nominal=0.5 / RADIUS)
TORQUE = Quantity("torque", "N*m", nominal=100.0 * RADIUS)
INERTIA = Parameter(
    5.0 * RADIUS**2,
    "kg*m^2",
    lower=1e-9,
    upper=1e5,
    log=True,
    meaning="moment of inertia that turns, the motor's included",
)
LOAD_TORQUE = Parameter(0.0, "N*m", lower=-1e5, upper=1e5, meaning="constant torque against positive motion")
_LOAD_HINTS = load_hints(
    "load.inertia", "load.torque", "torque", "take the inertia from drawings or data sheets and fix it"
)


@dataclass(frozen=True)
class RotaryDrive:
    """An inertia and friction turned by a known torque: J dw/dt = T - T_f(w) - T_L.

    Input: torque [N*m]. States and outputs: angle [rad] and speed [rad/s]; a friction law's states follow. Friction
    laws are those of sliding with newtons read as newton metres and metres as radians; the force that a law depends on
    (`LoadDependent`) is the torque.

    Raises
    ------
    ModelError
        If the friction depends on signals that an axis lacks, such as a cylinder's pressures.

    Examples
    --------
    >>> RotaryDrive().system().parameters["friction.viscous"].unit
    'N*m*s/rad'
    """

    kind: ClassVar[str] = "rotary"
    friction: FrictionModel = field(default_factory=Coulomb)

    def __post_init__(self) -> None:
        needed = ", ".join(q.name for q in self.friction.inputs if q.name != "force")
        message = f"{type(self.friction).__name__} needs {needed}, which a rotary axis lacks; choose another law"
        require(not needed, message, ModelError)

    @property
    def parameters(self) -> ParameterSet:
        """load.inertia, load.torque, friction.*."""
        friction = {n: _scale(p, *_turning_unit(p.unit)) for n, p in self.friction.parameters.items()}
        load = {"load.inertia": INERTIA, "load.torque": LOAD_TORQUE}
        return ParameterSet(load) | ParameterSet(friction).with_prefix("friction")

    def system(self) -> System:
        """Build the equations; states and outputs as in the class."""
        units = [_turning_unit(q.unit) for q in self.friction.states]
        inner_states = [
            Quantity(f"friction.{q.name}", unit, *(factor * size for size in (q.nominal, q.lower, q.upper)))
            for q, (unit, factor) in zip(self.friction.states, units, strict=True)
        ]
        states = (ANGLE, ANGULAR_SPEED, *inner_states)

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG001 - no time in it
            inner, own, load = without_prefix(x, "friction"), without_prefix(p, "friction"), {"force": u["torque"]}
            force = self.friction.force(x["speed"], inner, load, own)
            acceleration = (u["torque"] - force.value - p["load.torque"]) / p["load.inertia"]
            rates = {f"friction.{n}": rate for n, rate in force.rates.items()}
            return {"angle": x["speed"], "speed": acceleration, **rates}, {n: x[n] for n in ("angle", "speed")}

        starts = _RotaryStarts(self.friction)
        system = define(states, (TORQUE,), (ANGLE, ANGULAR_SPEED), self.parameters, rhs, starts)
        hints = self.friction.identification_hints.with_prefix("friction") | _LOAD_HINTS
        axis = Axis("angle", "speed", "load.inertia", "N*m", "axis")
        return with_rest(replace(system, identification_hints=hints), TORQUE, axis)


@dataclass(frozen=True)
class _RotaryStarts:
    """Starts from logs, computed as for a mass that slides on a circle of `RADIUS` about the shaft."""

    friction: FrictionModel

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        # name and unit of each parameter for sliding, and the factor that turns its value into that of the shaft
        factors = {"load.inertia": ("load.mass", "kg", RADIUS**2), "load.torque": ("load.force", "N", RADIUS)}
        for n, p in self.friction.parameters.items():
            factors[f"friction.{n}"] = (f"friction.{n}", p.unit, _turning_unit(p.unit)[1])
        signals = {"torque": ("force", 1 / RADIUS), "angle": ("position", RADIUS), "speed": ("speed", RADIUS)}
        sliding = {}
        for name, (measured, known, *_) in logs.items():
            columns = {signals[n][0]: signals[n][1] * measured[n] for n in measured if n in signals}
            parameters = ParameterSet({n: _scale(known[own], unit, 1 / f) for own, (n, unit, f) in factors.items()})
            sliding[name] = Log(Trajectory(measured.t, columns), parameters)
        turning = {n: (own, f) for own, (n, _, f) in factors.items()}
        turned = []
        for start in force_starts(self.friction, sliding):
            values = {}
            for whole, value in start.parameters.items():
                base, bracket, log = whole.partition("[")
                name, factor = turning[base]
                values[name + bracket + log] = factor * value
            states = {
                log: Trajectory(run.t, {"angle" if n == "position" else n: run[n] / RADIUS for n in run})
                for log, run in start.states.items()
            }
            turned.append(replace(start, states=states, parameters=values))
        return turned


def _turning_unit(unit: str) -> tuple[str, float]:
    """Unit of a sliding friction's parameter on a shaft, and the factor on its values."""
    over, slash, under = (part.split("*") for part in unit.partition("/"))
    forces, lengths = over.count("N") - under.count("N"), over.count("m") - under.count("m")
    words = {"N": "N*m", "m": "rad"}
    turned = ("*".join(words.get(word, word) for word in part) for part in (over, slash, under))
    return "".join(turned), RADIUS ** (forces - lengths)


def _scale(parameter: Parameter, unit: str, factor: float) -> Parameter:
    value, lower, upper = (factor * number for number in (parameter.value, parameter.lower, parameter.upper))
    return replace(parameter, value=value, lower=lower, upper=upper, unit=unit)


ROTARY_KIND = DriveKind(
    RotaryDrive.kind,
    {"load": {}, "friction": FRICTION_KEYS},
    lambda sections: RotaryDrive(read_friction(sections)),
    first=FirstFiles(
        options={"friction": {"model": "stribeck"}},
        unknowns=("load.inertia", "load.torque", *STRIBECK_UNKNOWNS),
        gains={"Kp": (0.04, 2e-3, 0.2), "Ki": (0.4, 0.01, 10), "Kd": (0, 0, 5e-4), "Tf": (5e-3, 2e-3, 0.05)},
        limit=2.5,
        dither=(100.0, 0.6),
        steps=(5.0, 25.0),
        horizon=0.6,
        swept="load.inertia",
    ),
)


def with_rest(system: System, push: Quantity, axis: Axis) -> System:
    """The system with its axis and a `rest_hook`: the push that balances friction and load, at a speed too."""
    return replace(system, axis=axis, rest_hook=_PushedBodyRest(system, push, axis))


@dataclass(frozen=True, eq=False)
class _PushedBodyRest:
    """The rest hook of a body whose push is an input."""

    system: System
    push: Quantity
    axis: Axis

    def __call__(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        """Return the rest; `ConvergenceError` where a motion changes the push that it needs, that of a spring say."""
        axis_names = (self.axis.position, self.axis.speed)
        others = ", ".join(sorted(outputs.keys() - set(axis_names)))
        require(not others, f"this drive starts from {' and '.join(axis_names)}, not from {others}; leave {others} out")
        y, v = (outputs.get(n, 0.0) for n in axis_names)
        at = dict(zip(axis_names, (y, v), strict=True))
        balance_states = self._balance.equilibrium(at, parameters)
        if v and self._balance.linearise(balance_states, at, parameters).B[0, 0]:
            moving = f"a motion at {self.axis.speed} {v:g} changes the {self.push.name} that {self.axis.position} needs"
            raise ConvergenceError(f"{moving}; start at rest", balance_states)
        push, *inner = balance_states.tolist()
        return Rest({**at, **dict(zip(names(self._balance.states[1:]), inner, strict=True))}, {self.push.name: push})

    @cached_property
    def _balance(self) -> System:
        """Push and friction as states whose rates vanish in a steady motion; position and speed are its inputs."""
        inner = [q for q in self.system.states if q.name not in (self.axis.position, self.axis.speed)]

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
            state = stack({n: {**x, **u}[n] for n in names(self.system.states)})
            inputs = stack({n: x.get(n, ca.SX(0)) for n in names(self.system.inputs)})
            xdot, _ = self.system.ode(t, state, inputs, stack(p))
            rates = dict(zip(names(self.system.states), ca.vertsplit(xdot), strict=True))
            return {self.push.name: rates[self.axis.speed], **{q.name: rates[q.name] for q in inner}}, {}

        imposed = [q for q in self.system.states if q not in inner]
        return define([self.push, *inner], imposed, [], self.system.parameters, rhs)
