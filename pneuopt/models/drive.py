"""Drives wired from parts: `ForceDrive`, pushed by a known force, and `MotionDrive`, a rig that measures friction."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import casadi as ca

from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols, System, define, names
from pneuopt.models.axis_rest import with_rest
from pneuopt.models.declaration import DriveKind, FirstFiles
from pneuopt.models.friction import FrictionModel, law_inputs
from pneuopt.models.friction_section import FRICTION_KEYS, STRIBECK_UNKNOWNS, read_friction
from pneuopt.models.load import LOAD_KEYS, Load
from pneuopt.models.needs import LOAD_EXCITATION, RIG_EXCITATION
from pneuopt.models.starts.friction import force_starts, motion_starts
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.keys import flag
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
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
        inner = tuple(rename_quantity(q, f"friction.{q.name}") for q in self.friction.states)

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
        excitation = self.friction.excitation.with_prefix("friction") | LOAD_EXCITATION
        return with_rest(replace(system, excitation=excitation, meter=_power_meter(system)), FORCE, Axis())


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
        offset = ParameterSet(
            {
                **rig,
                "rig.force_offset": Parameter(
                    0.0, "N", lower=-1e4, upper=1e4, meaning="reading of the force sensor without force"
                ),
            }
        )
        ambient = AMBIENT_PARAMETERS if self.chamber else _ambient_parameters(self.friction)
        return offset | self.friction.parameters.with_prefix("friction") | ambient

    def system(self) -> System:
        """Build the equations: the states are those of friction; output force."""
        inner = tuple(rename_quantity(q, f"friction.{q.name}") for q in self.friction.states)

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
        return replace(system, excitation=self.friction.excitation.with_prefix("friction") | RIG_EXCITATION)


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


def _power_meter(system: System) -> ca.Function:
    """Function ``(t, x, u, p)`` for the power that the motor draws [W]: that of the force where it drives, else zero.

    A servo drive that cannot feed back turns braking power into heat in its brake resistor.
    """
    t, x, u, p = (ca.SX.sym(n, system.ode.size1_in(i)) for i, n in enumerate("txup"))
    force, speed = (u[names(system.inputs).index("force")], x[names(system.states).index("speed")])
    return ca.Function("meter", [t, x, u, p], [ca.fmax(force * speed, 0)], ["t", "x", "u", "p"], ["power"])


def _ambient_parameters(friction: FrictionModel) -> ParameterSet:
    return AMBIENT_PARAMETERS if _pressure_inputs(friction) else ParameterSet()


def _pressure_inputs(friction: FrictionModel) -> tuple[Quantity, ...]:
    """Absolute pressures that pressure-dependent friction needs as inputs."""
    return tuple(Quantity(q.name, "Pa(a)", nominal=5e5) for q in friction.inputs if q.unit == "Pa(g)")


def rename_quantity(quantity: Quantity, name: str) -> Quantity:
    """Copy of a signal with another name."""
    return Quantity(name, quantity.unit, quantity.nominal, quantity.lower, quantity.upper)
