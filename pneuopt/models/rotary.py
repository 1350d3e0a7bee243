"""`RotaryDrive`: a shaft with inertia and friction, turned by a known torque, as a servo with an encoder logs it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import casadi as ca

from pneuopt.dynamics.hooks import Axis, Log, Start
from pneuopt.dynamics.system import Symbols, System, define
from pneuopt.models.axis_rest import with_rest
from pneuopt.models.declaration import DriveKind, FirstFiles
from pneuopt.models.friction import Coulomb, FrictionModel
from pneuopt.models.friction_section import FRICTION_KEYS, STRIBECK_UNKNOWNS, read_friction
from pneuopt.models.needs import load_excitation
from pneuopt.models.starts.friction import force_starts
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory

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
_LOAD_EXCITATION = load_excitation(
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
        states = (ANGLE, ANGULAR_SPEED, *(_turning_state(q) for q in self.friction.states))

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG001 - no time in it
            inner, own, load = without_prefix(x, "friction"), without_prefix(p, "friction"), {"force": u["torque"]}
            force = self.friction.force(x["speed"], inner, load, own)
            acceleration = (u["torque"] - force.value - p["load.torque"]) / p["load.inertia"]
            rates = {f"friction.{n}": rate for n, rate in force.rates.items()}
            return {"angle": x["speed"], "speed": acceleration, **rates}, {n: x[n] for n in ("angle", "speed")}

        starts = _RotaryStarts(self.friction)
        system = define(states, (TORQUE,), (ANGLE, ANGULAR_SPEED), self.parameters, rhs, starts)
        excitation = self.friction.excitation.with_prefix("friction") | _LOAD_EXCITATION
        axis = Axis("angle", "speed", "load.inertia", "N*m", "axis")
        return with_rest(replace(system, excitation=excitation), TORQUE, axis)


@dataclass(frozen=True)
class _RotaryStarts:
    """Starts from logs, computed as for a mass that slides on a circle of `RADIUS` about the shaft."""

    friction: FrictionModel

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        sliding = {name: Log(_sliding_log(log.measured), self._sliding_parameters(log)) for name, log in logs.items()}
        return [self._turning_start(start) for start in force_starts(self.friction, sliding)]

    def _factors(self) -> dict[str, tuple[str, str, float]]:
        """Name and unit of each parameter for sliding, and the factor that turns its value into that of the shaft."""
        load = {"load.inertia": ("load.mass", "kg", RADIUS**2), "load.torque": ("load.force", "N", RADIUS)}
        friction = self.friction.parameters.items()
        return load | {f"friction.{n}": (f"friction.{n}", p.unit, _turning_unit(p.unit)[1]) for n, p in friction}

    def _sliding_parameters(self, log: Log) -> ParameterSet:
        return ParameterSet(
            {name: _scale(log.parameters[n], unit, 1 / f) for n, (name, unit, f) in self._factors().items()}
        )

    def _turning_start(self, start: Start) -> Start:
        known = {name: (n, f) for n, (name, _, f) in self._factors().items()}
        values = {}
        for whole, value in start.parameters.items():
            base, bracket, log = whole.partition("[")
            name, factor = known[base]
            values[name + bracket + log] = factor * value
        states = {log: _turning_run(run) for log, run in start.states.items()}
        return replace(start, states=states, parameters=values)


def _turning_unit(unit: str) -> tuple[str, float]:
    """Unit of a sliding friction's parameter on a shaft, and the factor on its values.

    Examples
    --------
    >>> _turning_unit("N*s/m"), _turning_unit("m/s")
    (('N*m*s/rad', 0.0001), ('rad/s', 100.0))
    """
    over, slash, under = (part.split("*") for part in unit.partition("/"))
    forces, lengths = over.count("N") - under.count("N"), over.count("m") - under.count("m")
    words = {"N": "N*m", "m": "rad"}
    turned = ("*".join(words.get(word, word) for word in part) for part in (over, slash, under))
    return "".join(turned), RADIUS ** (forces - lengths)


def _turning_state(state: Quantity) -> Quantity:
    unit, factor = _turning_unit(state.unit)
    return Quantity(f"friction.{state.name}", unit, factor * state.nominal, factor * state.lower, factor * state.upper)


def _scale(parameter: Parameter, unit: str, factor: float) -> Parameter:
    value, lower, upper = (factor * number for number in (parameter.value, parameter.lower, parameter.upper))
    return replace(parameter, value=value, lower=lower, upper=upper, unit=unit)


def _sliding_log(measured: Trajectory) -> Trajectory:
    """Log of a shaft as that of the sliding mass."""
    factors = {"torque": ("force", 1 / RADIUS), "angle": ("position", RADIUS), "speed": ("speed", RADIUS)}
    return Trajectory(measured.t, {factors[n][0]: factors[n][1] * measured[n] for n in measured if n in factors})


def _turning_run(run: Trajectory) -> Trajectory:
    """States of the shaft along a log, from those of the sliding mass."""
    names = {"position": "angle"}
    return Trajectory(run.t, {names.get(n, n): run[n] / RADIUS for n in run})


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
