"""Friction of seals, guides and bearings, from viscous to LuGre; wrappers add asymmetry and pressure dependence.

Signs: the force opposes positive speed when positive. Every map is smooth; `smoothing` is the speed over which the
Coulomb force turns round. Such a map creeps under a load F < F_c, at ``v = smoothing * atanh(F/F_c)``; LuGre holds it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol

import casadi as ca
import numpy as np

from pneuopt.dynamics.excitation import DEFAULT_WIDTH, Excitation
from pneuopt.dynamics.system import Symbols
from pneuopt.models.friction_start import Bristles, FrictionSamples, FrictionStart
from pneuopt.models.needs import (
    ASYMMETRY_EXCITATION,
    BRISTLE_EXCITATION,
    COULOMB_EXCITATION,
    STRIBECK_EXCITATION,
    VISCOUS_EXCITATION,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

STICKING_SPEED = 1e-6  # rounding of |v| in LuGre [m/s]: a larger one creeps visibly, a smaller one needs finer steps
STRIBECK_VELOCITIES = (0.025, 0.012, 0.05, 0.006, 0.1, 0.003)  # values that a start tries [m/s], most successful first
MIN_COULOMB_SHARE = 0.05  # least Coulomb level of a start as a share of the median force [1]; a search sticks at zero
# Least and greatest bristle stiffness of a start [N/m]: softer bristles bend for millimetres, stiffer ones need steps
# below 1 us.
BRISTLE_STIFFNESS_RANGE = (1e4, 1e6)
CHAMBER_PRESSURES = ("pressure_a", "pressure_b")


class Force(NamedTuple):
    """A friction force and the rates of its internal states.

    Attributes
    ----------
    value : SX
        [N]
    rates : mapping of str to SX
        Rate of each internal state, by name.
    """

    value: ca.SX
    rates: Symbols


class FrictionModel(Protocol):
    """Interface of a friction law for drives, starts, files and advice; one level, no inheritance."""

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Internal states; none for a static map."""
        ...

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Signals that friction depends on beside the speed: gauge pressures [Pa(g)], the driving force [N]."""
        ...

    @property
    def parameters(self) -> ParameterSet:
        """Defaults, with units and bounds."""
        ...

    @property
    def excitation(self) -> Excitation:
        """Motion that a log must show for each parameter to be identifiable, by the law's parameter names."""
        ...

    @property
    def start(self) -> FrictionStart:
        """How an identification of its parameters starts from logs."""
        ...

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Force at speed v [m/s] with internal states z, inputs u and parameters p."""
        ...


@dataclass(frozen=True)
class Viscous:
    """F = viscous * v."""

    excitation: ClassVar[Excitation] = VISCOUS_EXCITATION
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """One parameter: viscous [N*s/m]."""
        return ParameterSet({"viscous": _VISCOUS_PARAMETER})

    @property
    def start(self) -> FrictionStart:
        """Regression with a force proportional to the speed."""
        return FrictionStart(lambda s: {"viscous": s.speed}, ("viscous",), floors={"viscous": 0.0})

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002 - the protocol's arguments
        """Return the force and the rates of the states; see the class."""
        return Force(p["viscous"] * v, {})


@dataclass(frozen=True)
class Coulomb:
    """F = coulomb * tanh(v / smoothing) + viscous * v."""

    excitation: ClassVar[Excitation] = COULOMB_EXCITATION
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: coulomb [N], viscous [N*s/m], smoothing [m/s]."""
        return ParameterSet(
            {"coulomb": _COULOMB_PARAMETER, "viscous": _VISCOUS_PARAMETER, "smoothing": _SMOOTHING_PARAMETER}
        )

    @property
    def start(self) -> FrictionStart:
        """Regression with a level in the direction of motion, and a slope."""
        unknowns = ("coulomb", "viscous")
        return FrictionStart(lambda s: {"coulomb": s.side, "viscous": s.speed}, unknowns, floors=_FLOORS)

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002 - the protocol's arguments
        """Return the force and the rates of the states; see the class."""
        return Force(p["coulomb"] * smooth_sign(v, p) + p["viscous"] * v, {})


@dataclass(frozen=True)
class Stribeck:
    """F = g(v) tanh(v / smoothing) + viscous * v, with `stribeck_curve` g."""

    excitation: ClassVar[Excitation] = STRIBECK_EXCITATION
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: coulomb, static [N], stribeck_velocity [m/s], viscous [N*s/m], smoothing [m/s]."""
        return ParameterSet({**_STRIBECK_PARAMETERS, "viscous": _VISCOUS_PARAMETER, "smoothing": _SMOOTHING_PARAMETER})

    @property
    def start(self) -> FrictionStart:
        """Regression that is linear in all parameters but the Stribeck velocity, which is scanned."""
        unknowns = ("coulomb", "viscous", "static", "stribeck_velocity")
        return FrictionStart(_stribeck_columns, unknowns, _FLOORS, {"static": "coulomb"}, _STRIBECK_SCAN)

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002 - the protocol's arguments
        """Return the force and the rates of the states; see the class."""
        g = stribeck_curve(v, p["coulomb"], p["static"], p["stribeck_velocity"])
        return Force(g * smooth_sign(v, p) + p["viscous"] * v, {})


@dataclass(frozen=True)
class LuGre:
    r"""Bristle deflection z with the Stribeck curve g (Canudas de Wit et al., IEEE TAC 40(3), 1995).

    .. math:: \dot z = v - \sigma_0 |v| z / g(v), \qquad F = \sigma_0 z + \sigma_1 e^{-(v/v_d)^2} \dot z + \sigma_2 v

    The damping fades with speed (v_d). A constant one is passive only with sigma_2 >= sigma_1 (F_s/F_c - 1), because in
    ``v zdot = v^2 - sigma_0 |v| v z/g`` the deflection may reach F_s/sigma_0 while g has fallen to F_c.
    """

    excitation: ClassVar[Excitation] = BRISTLE_EXCITATION
    inputs: tuple[Quantity, ...] = ()

    @property
    def states(self) -> tuple[Quantity, ...]:
        """One state: bristle [m], the mean deflection of the bristles."""
        return (Quantity("bristle", "m", nominal=4e-4),)

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the Stribeck curve, viscous friction, and the bristles' stiffness and damping."""
        bristles = {
            "bristle_stiffness": Parameter(
                5e4, "N/m", lower=1e3, upper=1e7, log=True, meaning="stiffness of the bristles: force per presliding"
            ),
            "bristle_damping": Parameter(
                300.0, "N*s/m", lower=1.0, upper=1e4, log=True, meaning="damping of the bristles at rest"
            ),
            "damping_velocity": Parameter(
                0.05, "m/s", lower=1e-4, upper=1e3, log=True, meaning="speed beyond which bristles are no longer damped"
            ),
        }
        return ParameterSet({**_STRIBECK_PARAMETERS, "viscous": _VISCOUS_PARAMETER, **bristles})

    @property
    def start(self) -> FrictionStart:
        """Regression on a Stribeck curve while sliding, and on a spring in presliding."""
        sliding = Stribeck().start
        bristles = Bristles("bristle_stiffness", "coulomb", BRISTLE_STIFFNESS_RANGE, _bristle_deflection)
        return replace(sliding, unknowns=(*sliding.unknowns, "bristle_stiffness", "bristle_damping"), bristles=bristles)

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002 - the protocol's arguments
        """Return the force and the rates of the states; see the class."""
        g = stribeck_curve(v, p["coulomb"], p["static"], p["stribeck_velocity"])
        rate = v - p["bristle_stiffness"] * ca.sqrt(v**2 + STICKING_SPEED**2) * z["bristle"] / g
        damping = p["bristle_damping"] * ca.exp(-((v / p["damping_velocity"]) ** 2))
        force = p["bristle_stiffness"] * z["bristle"] + damping * rate + p["viscous"] * v
        return Force(force, {"bristle": rate})


@dataclass(frozen=True)
class Asymmetric:
    """A base model with levels that differ by direction: scaled by ``1 + asymmetry * tanh(v / asymmetry_width)``.

    Coulomb friction is ``coulomb * (1 + coulomb_asymmetry)`` forwards, ``coulomb * (1 - coulomb_asymmetry)`` backwards.
    """

    base: FrictionModel

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of the base model."""
        return self.base.states

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Inputs of the base model."""
        return self.base.inputs

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the base, coulomb_asymmetry (also of static), viscous_asymmetry [1], asymmetry_width [m/s]."""
        levels, slope = (
            Parameter(0.0, "1", lower=-0.95, upper=0.95, meaning=f"{what} more forwards, less backwards, a fraction")
            for what in ("Coulomb and static friction", "viscous friction")
        )
        width = replace(_SMOOTHING_PARAMETER, meaning="speed over which one direction's levels become the other's")
        added = {"viscous_asymmetry": slope, "asymmetry_width": width}
        coulomb = {"coulomb_asymmetry": levels} if "coulomb" in self.base.parameters else {}
        return self.base.parameters | ParameterSet({**coulomb, **added})

    @property
    def excitation(self) -> Excitation:
        """Excitation of the base model, and motion in both directions."""
        return ASYMMETRY_EXCITATION | self.base.excitation

    @property
    def start(self) -> FrictionStart:
        """Start of the base model, with equal levels in both directions."""
        base = self.base.start
        asymmetries = tuple(n for n in ("coulomb_asymmetry", "viscous_asymmetry") if n in self.parameters)
        return replace(base, unknowns=(*base.unknowns, *asymmetries))

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force and the rates of the states; see the class."""
        side = smooth_sign(v, p, "asymmetry_width")
        levels = {"coulomb": "coulomb_asymmetry", "static": "coulomb_asymmetry", "viscous": "viscous_asymmetry"}
        scaled = {n: p[n] * (1 + p[a] * side) for n, a in levels.items() if n in p}
        return self.base.force(v, z, u, {**p, **scaled})


@dataclass(frozen=True)
class PressureDependent:
    """A base model whose Coulomb and static levels rise with both chambers' gauge pressures: + c_a p_a + c_b p_b.

    Coefficients of 0.5e-5 to 3e-5 m^2 are plausible for seals of 25 to 40 mm bore.
    """

    base: FrictionModel
    chambers: tuple[str, ...] = CHAMBER_PRESSURES

    def __post_init__(self) -> None:
        check_coulomb_level(self.base, "pressure")

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of the base model."""
        return self.base.states

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Inputs of the base model, and gauge pressures of the chambers [Pa(g)]."""
        return (*self.base.inputs, *(Quantity(name, "Pa(g)", nominal=1e5) for name in self.chambers))

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the base model, and a coefficient [N/Pa] for each chamber."""
        slope = Parameter(
            0.0, "N/Pa", lower=-1e-3, upper=1e-3, meaning="Coulomb friction per gauge pressure in that chamber"
        )
        return self.base.parameters | ParameterSet({f"coulomb_{name}": slope for name in self.chambers})

    @property
    def excitation(self) -> Excitation:
        """Excitation that the base model needs."""
        return self.base.excitation

    @property
    def start(self) -> FrictionStart:
        """Start of the base model, with levels that are linear in the pressures."""
        base, slopes = self.base.start, tuple(f"coulomb_{name}" for name in self.chambers)

        def columns(s: FrictionSamples) -> dict[str, Array]:
            return base.columns(s) | {n: s.side * s.inputs[c] for n, c in zip(slopes, self.chambers, strict=True)}

        return replace(base, columns=columns, unknowns=(*base.unknowns, *slopes))

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force and the rates of the states; see the class."""
        rise = sum((p[f"coulomb_{name}"] * u[name] for name in self.chambers), start=ca.SX(0))
        return self.base.force(v, z, u, raise_levels(p, rise))


def law_inputs(law: FrictionModel, signals: Mapping[str, Any], p: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs of a law from a drive's signals, symbols or arrays; absolute pressures become gauge pressures."""
    return {
        q.name: signals[q.name] - p["ambient.pressure"] if q.unit == "Pa(g)" else signals[q.name] for q in law.inputs
    }


def check_coulomb_level(base: FrictionModel, cause: str) -> None:
    """Refuse a base model without the level that rises with `cause`."""
    message = f"{base} has no Coulomb level that could rise with {cause}; take Coulomb(), Stribeck() or LuGre()"
    require("coulomb" in base.parameters, message, ModelError)


def raise_levels(p: Symbols, rise: ca.SX) -> dict[str, ca.SX]:
    """Parameters of a law whose Coulomb and static levels are higher by `rise` [N]."""
    return {**p, **{n: p[n] + rise for n in ("coulomb", "static") if n in p}}


def smooth_sign(v: ca.SX, p: Symbols, width: str = "smoothing") -> ca.SX:
    """Sign of the speed, smooth over the parameter `width`; where p has a `direction` (`Karnopp`), that one."""
    return p["direction"] if "direction" in p else ca.tanh(v / p[width])


def stribeck_curve(v: ca.SX, coulomb: ca.SX, static: ca.SX, stribeck_velocity: ca.SX) -> ca.SX:
    """Sliding friction level g(v) = F_c + (F_s - F_c) exp(-(v/v_s)^2).

    Parameters
    ----------
    v : SX or float
        Speed [m/s].
    coulomb, static : SX or float
        F_c and F_s [N].
    stribeck_velocity : SX or float
        v_s [m/s], positive.

    Returns
    -------
    SX or float
        [N], between F_c and F_s.

    Notes
    -----
    Source: Armstrong-Helouvry et al., Automatica 30(7), 1994, with the Gaussian exponent 2.

    Examples
    --------
    >>> round(float(stribeck_curve(0.02, 40.0, 70.0, 0.02)), 4)
    51.0364
    """
    return coulomb + (static - coulomb) * ca.exp(-((v / stribeck_velocity) ** 2))


def _stribeck_columns(s: FrictionSamples) -> dict[str, Array]:
    peak = np.exp(-((s.level_speed / s.values["stribeck_velocity"]) ** 2))
    return {"coulomb": s.side, "static": s.side * peak, "viscous": s.speed}


def _bristle_deflection(force: Array, speed: Array, values: Mapping[str, float]) -> dict[str, Array]:
    """Bristle deflection that gives the force, at most that at break-away."""
    limit = values["static"] / values["bristle_stiffness"]
    deflection = (force - values["viscous"] * speed) / values["bristle_stiffness"]
    return {"bristle": np.clip(deflection, -limit, limit)}


_FLOORS = {"coulomb": MIN_COULOMB_SHARE, "viscous": 0.0}
_STRIBECK_SCAN = {"stribeck_velocity": STRIBECK_VELOCITIES}
_VISCOUS_PARAMETER = Parameter(70.0, "N*s/m", lower=0.0, upper=1e5, meaning="friction per speed")
_COULOMB_PARAMETER = Parameter(30.0, "N", lower=0.0, upper=1e5, meaning="Coulomb friction: the level while sliding")
_SMOOTHING_PARAMETER = Parameter(
    1e-3,
    "m/s",
    lower=1e-6,
    upper=1.0,
    log=True,
    source=DEFAULT_WIDTH,
    meaning="speed over which friction turns its sign",
)
_STRIBECK_PARAMETERS = {
    "coulomb": _COULOMB_PARAMETER,
    "static": Parameter(45.0, "N", lower=0.0, upper=1e5, meaning="static friction: the level at break-away"),
    "stribeck_velocity": Parameter(
        0.02, "m/s", lower=1e-4, upper=1.0, log=True, meaning="speed over which friction falls from static to Coulomb"
    ),
}
