"""Friction of seals, guides, bearings and gears, from viscous to LuGre; wrappers add asymmetry, pressure and load.

Signs: the force opposes positive speed when positive. Every map is smooth in the speed; `smoothing` is the speed over
which the Coulomb force turns round. Such a map creeps under a load F < F_c, at ``v = smoothing * atanh(F/F_c)``; LuGre
holds it.

`Karnopp` is dry friction for simulations: `simulate` switches its "friction.direction" and locates each break-away and
standstill; a solver that leaves the direction at zero simulates no dry friction at all. The registry of the laws, a row
each, stands at the end.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol

import casadi as ca
import numpy as np

from pneuopt.dynamics.hooks import DEFAULT_WIDTH, IdentificationHints, Lack, LoggedMotion, Need, SeparatingRun, Width
from pneuopt.dynamics.system import Symbols
from pneuopt.models.declaration import DriveSections
from pneuopt.models.tolerances import (
    BRISTLE_STIFFNESS_RANGE,
    MIN_COULOMB_SHARE,
    MIN_DIRECTION_SHARE,
    MIN_FIT_SAMPLES,
    MIN_INERTIA_SHARE,
    MIN_REVERSALS,
    MIN_SPEED_RATIO,
    STICKING_SPEED,
    STRIBECK_VELOCITIES,
    VISCOUS_SPEED_RATIO,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.keys import Key, Takes, choice, flag
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity


@dataclass(frozen=True, eq=False)
class FrictionSamples:
    """Samples of a log for a friction law; arrays of shape (n,), parameters and inputs by the law's names."""

    speed: Array  # filtered [m/s]
    side: Array  # sign of the speed, smooth over `smoothing`; just before break-away, that of the force that pulls
    level_speed: Array  # at which the friction level applies [m/s]: zero just before break-away
    inputs: Mapping[str, Array]
    values: Mapping[str, float]  # the law's parameters as given; of a scanned one, the value that is tried


@dataclass(frozen=True)
class Bristles:
    """Start of bristle deflections: their stiffness is the slope of the force over travel in presliding."""

    stiffness: str  # parameter for that slope [N/m]
    level: str  # parameter for the sliding force [N], well below which bristles only bend
    range: tuple[float, float]  # least and greatest stiffness of a start [N/m]
    # (friction force [N], speed [m/s], the law's parameters) -> the law's states
    deflections: Callable[[Array, Array, Mapping[str, float]], dict[str, Array]]


@dataclass(frozen=True)
class FrictionStart:
    """A friction law as a linear regression: ``force = sum(column * parameter)`` at given scanned parameters."""

    columns: Callable[[FrictionSamples], dict[str, Array]]  # the regression column of each parameter, by name
    unknowns: tuple[str, ...]  # parameters that are estimated unless the user frees others
    # least value as a share of the median force [1], which keeps friction from driving the load
    floors: Mapping[str, float] = field(default_factory=dict)
    # parameters whose column multiplies their excess over another one: static friction over Coulomb friction
    above: Mapping[str, str] = field(default_factory=dict)
    # parameters on which the force does not depend linearly: the values to try, the most promising first
    scanned: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    bristles: Bristles | None = None  # of a law with internal states


FRICTION_LEVELS = frozenset({"coulomb", "static"})
STRIBECK_CURVE = FRICTION_LEVELS | {"stribeck_velocity"}
BRISTLES = frozenset({"bristle_stiffness", "bristle_damping", "damping_velocity"})
CONSTANT_FORCES = frozenset({"load.force", "rig.force_offset"})
"""Parameters of drives for a force that is constant, whatever the speed."""
ALIKE_AT_EVERY_SPEED = (
    "they act alike at every speed: fix one, measure the offset with the load uncoupled, or turn the axis round"
)


def lacks_stribeck_curve(seen: LoggedMotion) -> Lack | None:
    """Lack of the slow and fast speeds that a Stribeck curve needs, if any."""
    stribeck = _largest_known(
        "friction.stribeck_velocity", _STRIBECK_PARAMETERS["stribeck_velocity"].value, seen.values
    )
    speed = np.abs(seen.speed)
    below = int(np.count_nonzero((speed > 0.1 * stribeck) & (speed < stribeck)))
    slowest, fastest = 0.1 * stribeck, VISCOUS_SPEED_RATIO * stribeck
    unit = _speed_unit(seen)
    run = f"constant speeds, or slow ramps, from {slowest:.1g} to {fastest:.1g} {unit}"
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        speeds = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} {unit}"
        return Lack(f"{speeds}, where friction is one level", f"log {run}")
    if below < MIN_FIT_SAMPLES:
        message = f"only {below} samples are slower than the Stribeck velocity, {stribeck:.2g} {unit}"
        return Lack(message, f"log {run}")
    return None


def lacks_speed_range(seen: LoggedMotion) -> Lack | None:
    """Lack of the different speeds that a slope over speed needs, if any."""
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        unit, beyond = _speed_unit(seen), VISCOUS_SPEED_RATIO * seen.fast
        message = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} {unit}, too near for a slope"
        return Lack(message, f"log speeds from {seen.slow:.2g} to beyond {beyond:.2g} {unit}")
    return None


def lacks_directions(seen: LoggedMotion) -> Lack | None:
    """Lack of the motion in both directions that asymmetric or constant forces need, if any."""
    if min(seen.forward, 1 - seen.forward) < MIN_DIRECTION_SHARE:
        way = "forwards" if seen.forward > 0.5 else "backwards"
        return Lack(f"the drive moves {way} only", "log both directions", is_strict=True)
    return None


def lacks_presliding(seen: LoggedMotion) -> Lack | None:
    """Lack of the reversals that bristles need, if any."""
    if seen.reversals < MIN_REVERSALS:
        count = f"the motion reverses {seen.reversals} times" if seen.reversals else "the motion never reverses"
        return Lack(
            f"{count}, so that the bristles are hardly seen",
            "log presliding: reversals, and a force that swings below break-away, sampled at 1 kHz",
        )
    return None


def lacks_acceleration(inertia: str, remedy: str, seen: LoggedMotion) -> Lack | None:
    """Lack of the acceleration that `inertia` needs beside friction, if any; the larger of two known values counts."""
    force = _largest_known(inertia, math.nan, seen.values, seen.given) * seen.acceleration
    friction = _largest_known("friction.coulomb", math.nan, seen.values)
    if force < MIN_INERTIA_SHARE * friction:
        unit = _known_unit(seen, "friction.coulomb")
        return Lack(f"inertia takes {force:.2g} {unit} (rms), nothing beside {friction:.2g} {unit} of friction", remedy)
    return None


VISCOUS_HINTS = IdentificationHints(
    {"viscous": Need(lacks_speed_range, FRICTION_LEVELS)},
    (
        SeparatingRun(
            frozenset({"viscous"}),
            STRIBECK_CURVE,
            "log speeds below <stribeck_velocity>, and such beyond <5 stribeck_velocity>",
        ),
    ),
)
COULOMB_HINTS = (
    IdentificationHints(
        {},
        (SeparatingRun(CONSTANT_FORCES, FRICTION_LEVELS, "log both directions"),),
        (Width("smoothing"),),
    )
    | VISCOUS_HINTS
)
STRIBECK_HINTS = COULOMB_HINTS | IdentificationHints(
    {
        "stribeck_velocity": Need(lacks_stribeck_curve, FRICTION_LEVELS),
        "static": Need(lacks_stribeck_curve, STRIBECK_CURVE),
    },
    (
        SeparatingRun(
            frozenset({"stribeck_velocity"}),
            FRICTION_LEVELS,
            "log speeds below <stribeck_velocity>: slow ramps through zero",
        ),
    ),
    at_least={"static": "coulomb"},
)
BRISTLE_HINTS = STRIBECK_HINTS | IdentificationHints(
    dict.fromkeys(sorted(BRISTLES), Need(lacks_presliding)),
    (
        SeparatingRun(
            BRISTLES,
            BRISTLES | STRIBECK_CURVE,
            "log presliding: reversals, and a force that swings below break-away, <static>",
        ),
    ),
)
ASYMMETRY_HINTS = IdentificationHints(
    {
        "coulomb_asymmetry": Need(lacks_directions, FRICTION_LEVELS),
        "viscous_asymmetry": Need(lacks_directions, frozenset({"viscous"})),
    },
    (
        SeparatingRun(
            CONSTANT_FORCES,
            frozenset({"coulomb_asymmetry"}),
            ALIKE_AT_EVERY_SPEED,
        ),
    ),
    (Width("smoothing"), Width("asymmetry_width")),
)
_LEVELS = frozenset(f"friction.{n}" for n in FRICTION_LEVELS)


def load_hints(inertia: str, force: str, push: str, remedy: str) -> IdentificationHints:
    """What a log must show for a load's inertia and constant force; `push` and `remedy` are words of the advice."""
    lacks = partial(lacks_acceleration, inertia, f"{remedy}, or log steps of {push}")
    asymmetry, slope = (
        frozenset({"friction.coulomb_asymmetry"}),
        {"friction.viscous", *(f"friction.{n}" for n in BRISTLES)},
    )
    runs = (
        SeparatingRun(frozenset({inertia}), frozenset(slope), f"log more acceleration: steps of {push}"),
        SeparatingRun(frozenset({force}), asymmetry, ALIKE_AT_EVERY_SPEED),
        SeparatingRun(frozenset({force}), _LEVELS, "log both directions"),
    )
    return IdentificationHints({force: Need(lacks_directions, _LEVELS), inertia: Need(lacks)}, runs)


LOAD_HINTS = load_hints("load.mass", "load.force", "force", "weigh the load and fix its mass")
RIG_HINTS = IdentificationHints({"rig.force_offset": Need(lacks_directions, _LEVELS)})


def _largest_known(name: str, default: float, *known: ParameterSet) -> float:
    return max((values.value(name) for values in known if name in values), default=default)


def _speed_unit(seen: LoggedMotion) -> str:
    return _known_unit(seen, "friction.stribeck_velocity", "friction.smoothing") or "m/s"


def _known_unit(seen: LoggedMotion, *names: str) -> str:
    """Unit of the first parameter that is known; empty where none is."""
    return next((known[n].unit for n in names for known in (seen.given, seen.values) if n in known), "")


CHAMBER_PRESSURES = ("pressure_a", "pressure_b")


class Force(NamedTuple):
    """A friction force [N] and the rate of each internal state, by name."""

    value: ca.SX
    rates: Symbols


class FrictionModel(Protocol):
    """Interface of a friction law for drives, starts, files and advice; one level, no inheritance."""

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Internal states; none for a static map."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Signals that friction depends on beside the speed: gauge pressures [Pa(g)], the driving force [N]."""

    @property
    def parameters(self) -> ParameterSet:
        """Defaults, with units and bounds."""

    @property
    def identification_hints(self) -> IdentificationHints:
        """Motion that a log must show for each parameter to be identifiable, by the law's parameter names."""

    @property
    def start(self) -> FrictionStart:
        """How an identification of its parameters starts from logs."""

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Force at speed v [m/s] with internal states z, inputs u and parameters p."""


@dataclass(frozen=True)
class Viscous:
    """F = viscous * v."""

    identification_hints: ClassVar[IdentificationHints] = VISCOUS_HINTS
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

    identification_hints: ClassVar[IdentificationHints] = COULOMB_HINTS
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: coulomb [N], viscous [N*s/m], smoothing [m/s]."""
        return ParameterSet(
            {"coulomb": _COULOMB_PARAMETER, "viscous": _VISCOUS_PARAMETER, "smoothing": SMOOTHING_PARAMETER}
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

    identification_hints: ClassVar[IdentificationHints] = STRIBECK_HINTS
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: coulomb, static [N], stribeck_velocity [m/s], viscous [N*s/m], smoothing [m/s]."""
        return ParameterSet({**_STRIBECK_PARAMETERS, "viscous": _VISCOUS_PARAMETER, "smoothing": SMOOTHING_PARAMETER})

    @property
    def start(self) -> FrictionStart:
        """Regression that is linear in all parameters but the Stribeck velocity, which is scanned."""

        def columns(s: FrictionSamples) -> dict[str, Array]:
            peak = np.exp(-((s.level_speed / s.values["stribeck_velocity"]) ** 2))
            return {"coulomb": s.side, "static": s.side * peak, "viscous": s.speed}

        unknowns = ("coulomb", "viscous", "static", "stribeck_velocity")
        return FrictionStart(columns, unknowns, _FLOORS, {"static": "coulomb"}, _STRIBECK_SCAN)

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

    identification_hints: ClassVar[IdentificationHints] = BRISTLE_HINTS
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

        def deflection(force: Array, speed: Array, values: Mapping[str, float]) -> dict[str, Array]:
            limit = values["static"] / values["bristle_stiffness"]  # the deflection at break-away
            bent = (force - values["viscous"] * speed) / values["bristle_stiffness"]
            return {"bristle": np.clip(bent, -limit, limit)}

        bristles = Bristles("bristle_stiffness", "coulomb", BRISTLE_STIFFNESS_RANGE, deflection)
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
        width = replace(SMOOTHING_PARAMETER, meaning="speed over which one direction's levels become the other's")
        added = {"viscous_asymmetry": slope, "asymmetry_width": width}
        coulomb = {"coulomb_asymmetry": levels} if "coulomb" in self.base.parameters else {}
        return self.base.parameters | ParameterSet({**coulomb, **added})

    @property
    def identification_hints(self) -> IdentificationHints:
        """Those of the base model, and motion in both directions."""
        return ASYMMETRY_HINTS | self.base.identification_hints

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
    def identification_hints(self) -> IdentificationHints:
        """Those of the base model."""
        return self.base.identification_hints

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
    """Sliding friction level g(v) = F_c + (F_s - F_c) exp(-(v/v_s)^2) [N] at speed v [m/s].

    Source: Armstrong-Helouvry et al., Automatica 30(7), 1994, with the Gaussian exponent 2.

    Examples
    --------
    >>> round(float(stribeck_curve(0.02, 40.0, 70.0, 0.02)), 4)
    51.0364
    """
    return coulomb + (static - coulomb) * ca.exp(-((v / stribeck_velocity) ** 2))


_FLOORS = {"coulomb": MIN_COULOMB_SHARE, "viscous": 0.0}
_STRIBECK_SCAN = {"stribeck_velocity": STRIBECK_VELOCITIES}
_VISCOUS_PARAMETER = Parameter(70.0, "N*s/m", lower=0.0, upper=1e5, meaning="friction per speed")
_COULOMB_PARAMETER = Parameter(30.0, "N", lower=0.0, upper=1e5, meaning="Coulomb friction: the level while sliding")
SMOOTHING_PARAMETER = Parameter(
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
        0.02,
        "m/s",
        lower=1e-4,
        upper=1.0,
        log=True,
        meaning="speed over which friction falls from static to Coulomb",
    ),
}


SLOW_REVERSALS = SeparatingRun(
    frozenset({"presliding_speed"}),
    frozenset({"static", "stribeck_velocity", "bristle_stiffness", "bristle_damping", "coulomb", "viscous"}),
    "log slow reversals, with many samples while the speed changes its sign",
)
PRESLIDING_HINTS = replace(COULOMB_HINTS, runs=(SLOW_REVERSALS, *COULOMB_HINTS.runs), widths=())


@dataclass(frozen=True)
class Presliding:
    """F = coulomb * tanh(v / presliding_speed) + viscous * v.

    The speed over which friction builds up is a property of the drive, and estimated: bristles that yield, a belt, a
    sensor beside the contact. In `Coulomb` it is a means of integration, and as small as that allows.
    """

    identification_hints: ClassVar[IdentificationHints] = PRESLIDING_HINTS
    states: tuple[Quantity, ...] = ()
    inputs: tuple[Quantity, ...] = ()

    @property
    def parameters(self) -> ParameterSet:
        """Parameters: coulomb [N], viscous [N*s/m], presliding_speed [m/s]."""
        base = Coulomb().parameters
        # below the least one friction is as sharp as that of `Coulomb`, and takes many integration steps; above it the
        # yielding of stiff drives is missed
        speed = Parameter(3e-3, "m/s", lower=3e-4, upper=0.1, log=True, meaning="speed over which friction builds up")
        return base.select(n for n in base if n != "smoothing") | ParameterSet({"presliding_speed": speed})

    @property
    def start(self) -> FrictionStart:
        """Regression of `Coulomb`; the presliding speed begins at its given value."""
        base = Coulomb().start
        return FrictionStart(base.columns, (*base.unknowns, "presliding_speed"), base.floors)

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force and the rates of the states; see the class."""
        return Coulomb().force(v, z, u, {**p, "smoothing": p["presliding_speed"]})


@dataclass(frozen=True)
class LoadDependent:
    """A base model whose Coulomb and static levels rise with the transmitted force F: + coulomb_load |F|.

    F drives the load: the input of a `ForceDrive`, the torque of a `RotaryDrive`. For gears of servos coulomb_load is
    0.01 to 0.2. The size |F| is exact: a rounding would be a force that is large for a small axis and nothing for a
    large one, and no integration needs it, since friction has a kink there and no step.

    Source: Hamon, Gautier, Garrec, Dynamic identification of robots with a dry friction model depending on load and
    velocity, IROS 2010.
    """

    base: FrictionModel

    def __post_init__(self) -> None:
        check_coulomb_level(self.base, "load")

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States of the base model."""
        return self.base.states

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Inputs of the base model, and the transmitted force [N]."""
        return (*self.base.inputs, Quantity("force", "N", nominal=100.0))

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the base model, and coulomb_load [1]."""
        slope = Parameter(0.0, "1", lower=0.0, upper=0.9, meaning="Coulomb friction per transmitted force")
        return self.base.parameters | ParameterSet({"coulomb_load": slope})

    @property
    def identification_hints(self) -> IdentificationHints:
        """Those of the base model, and loads that differ."""
        words = "log sliding under a load that is known and large: a weight lifted and lowered, or a spring"
        others = FRICTION_LEVELS | {"viscous", "load.mass", "load.inertia"}
        loads_differ = SeparatingRun(frozenset({"coulomb_load"}), others, words)
        return IdentificationHints(runs=(loads_differ,)) | self.base.identification_hints

    @property
    def start(self) -> FrictionStart:
        """Start of the base model, with levels that are linear in the absolute force."""
        base = self.base.start

        def columns(s: FrictionSamples) -> dict[str, Array]:
            return base.columns(s) | {"coulomb_load": s.side * np.abs(s.inputs["force"])}

        return replace(base, columns=columns, unknowns=(*base.unknowns, "coulomb_load"))

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force of the base model with raised levels; see the class."""
        return self.base.force(v, z, u, raise_levels(p, p["coulomb_load"] * ca.fabs(u["force"])))


@dataclass(frozen=True)
class Karnopp:
    r"""A static friction map without smoothing: the parameter `direction` is sgn(v), and 0 where the piston sticks.

    .. math:: F = g(v) \, d + \sigma_2 v, \quad d = \pm 1; \qquad |F| \le F_s \text{ at rest}

    Asymmetry and pressure dependence use the direction likewise. Source: Karnopp, J. Dyn. Sys. Meas. Control 107(1),
    1985, but with events in place of his zone of small speeds.

    Parameters
    ----------
    base : FrictionModel
        Coulomb() or Stribeck(), wrapped or not; its parameters, except the smoothing widths, are those of this model.

    Raises
    ------
    ModelError
        If the base has internal states (LuGre has no standstill to locate) or no Coulomb level.
    """

    states: ClassVar[tuple[Quantity, ...]] = ()
    base: FrictionModel

    def __post_init__(self) -> None:
        suited = not self.base.states and "smoothing" in self.base.parameters
        message = f"Karnopp needs a static map with a Coulomb level, Coulomb() or Stribeck(); {self.base} is not one"
        require(suited, message, ModelError)

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Inputs of the base model."""
        return self.base.inputs

    @property
    def parameters(self) -> ParameterSet:
        """Parameters of the base without smoothing widths, and direction [1], which only a simulation sets."""
        kept = {n: p for n, p in self.base.parameters.items() if n not in ("smoothing", "asymmetry_width")}
        return ParameterSet({**kept, "direction": Parameter(0.0, "1", -1.0, 1.0, source="switched by simulate")})

    @property
    def identification_hints(self) -> IdentificationHints:
        """Those of the base model."""
        return self.base.identification_hints

    @property
    def start(self) -> FrictionStart:
        """Start of the base model."""
        return self.base.start

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:
        """Return the force of the base model with this direction; see the class."""
        return self.base.force(v, z, u, p)


@dataclass(frozen=True)
class Wrapper:
    """A law that wraps another law."""

    wrap: Callable[..., FrictionModel]  # (inner law) or, with options, (inner law, tuple of options) -> law
    meaning: str
    option: str = ""  # an option's name in messages, "chamber"
    options: tuple[str, ...] = ()  # those it takes; all of them where none is given


FRICTION_LAWS: Mapping[str, Callable[[], FrictionModel]] = {
    "viscous": Viscous,
    "coulomb": Coulomb,
    "presliding": Presliding,
    "stribeck": Stribeck,
    "lugre": LuGre,
}
"""Basic laws from the simplest to the richest: `model = "coulomb"` in a file."""

FRICTION_WRAPPERS: Mapping[str, Wrapper] = {
    "asymmetric": Wrapper(Asymmetric, "whether friction differs between the directions"),
    "load_dependent": Wrapper(LoadDependent, "whether friction rises with the transmitted force, as a gear's does"),
    "pressure_dependent": Wrapper(
        PressureDependent, "whether friction rises with both pressures, or a list of them", "chamber", CHAMBER_PRESSURES
    ),
}
"""Laws that wrap another law, the innermost first: `asymmetric = true` in a file."""


def friction_ladder() -> dict[str, FrictionModel]:
    """Friction laws by name, from the simplest to the richest: candidates for `select_model`.

    Static laws with a Coulomb level are there also with each wrapper that needs no further signal.
    """
    ladder: dict[str, FrictionModel] = {}
    for name, law in FRICTION_LAWS.items():
        ladder[name] = law()
        if "coulomb" in law().parameters and not law().states:
            wrapped = {f"{how} {name}": wrapper.wrap(law()) for how, wrapper in FRICTION_WRAPPERS.items()}
            ladder |= {n: model for n, model in wrapped.items() if not model.inputs}
    return ladder


def usual_unknowns() -> tuple[str, ...]:
    """Parameters that a comparison of these laws estimates, as a drive names them."""
    unknowns = (f"friction.{n}" for law in friction_ladder().values() for n in law.start.unknowns)
    return tuple(dict.fromkeys(unknowns))


FRICTION_KEYS: Mapping[str, Key] = {
    "model": choice("friction law", FRICTION_LAWS),
    **{
        name: replace(flag(wrapper.meaning), takes=Takes.FLAG_OR_LIST if wrapper.options else Takes.FLAG)
        for name, wrapper in FRICTION_WRAPPERS.items()
    },
}
STRIBECK_UNKNOWNS = tuple(f"friction.{n}" for n in Stribeck().start.unknowns)
"""Parameters of the usual law that logs give, as a drive names them."""


def read_friction(sections: DriveSections) -> FrictionModel:
    """Build the friction law that [friction] describes."""
    options = sections.options("friction")
    law: FrictionModel = options["model"]()
    for name, wrapper in FRICTION_WRAPPERS.items():
        if isinstance(options[name], list) and options[name]:
            check_names(wrapper.option, options[name], wrapper.options, sections.place("friction", name))
            law = wrapper.wrap(law, tuple(options[name]))
        elif options[name]:
            law = wrapper.wrap(law)
    return law
