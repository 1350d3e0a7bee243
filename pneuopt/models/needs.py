"""Motion that a log must show for the parameters of drives and friction laws, and runs that separate them."""

import math
from functools import partial

import numpy as np

from pneuopt.dynamics.excitation import Excitation, Lack, LoggedMotion, Need, SeparatingRun, Width
from pneuopt.quantities.parameters import ParameterSet

MIN_SPEED_RATIO = 3.0  # fast over slow speed [1]: less shows one point of the curve, a larger bound refuses good logs
VISCOUS_SPEED_RATIO = 5.0  # speed over the Stribeck velocity [1] beyond which the static peak hides no viscous friction
MIN_SLOW_SAMPLES = 20  # samples below the Stribeck velocity: fewer are noise, a larger bound refuses good logs
MIN_DIRECTION_SHARE = 0.05  # share of the moving samples in the rarer direction [1]: fewer are accidental
MIN_REVERSALS = 2  # reversals of the motion: one alone does not show that presliding repeats
MIN_INERTIA_SHARE = 0.02  # inertia force over the friction level [1]: less is lost in the model's error
DEFAULT_STRIBECK_VELOCITY = 0.02  # for laws without a Stribeck velocity [m/s]
FRICTION_LEVELS = frozenset({"coulomb", "static"})
STRIBECK_CURVE = FRICTION_LEVELS | {"stribeck_velocity"}
# factor of a search over the width of dry friction's sign [1]: a smaller one takes more trials, a larger one leaves out
# widths at which a log that slides is followed best
SMOOTHING_FACTOR = 10.0
BRISTLES = frozenset({"bristle_stiffness", "bristle_damping", "damping_velocity"})
CONSTANT_FORCES = frozenset({"load.force", "rig.force_offset"})
"""Parameters of drives for a force that is constant, whatever the speed."""
ALIKE_AT_EVERY_SPEED = (
    "they act alike at every speed: fix one, measure the offset with the load uncoupled, or turn the axis round"
)


def lacks_stribeck_curve(seen: LoggedMotion) -> Lack | None:
    """Lack of the slow and fast speeds that a Stribeck curve needs, if any."""
    stribeck = _largest_known("friction.stribeck_velocity", DEFAULT_STRIBECK_VELOCITY, seen.values)
    speed = np.abs(seen.speed)
    below = int(np.count_nonzero((speed > 0.1 * stribeck) & (speed < stribeck)))
    slowest, fastest = 0.1 * stribeck, VISCOUS_SPEED_RATIO * stribeck
    unit = _speed_unit(seen)
    run = f"constant speeds, or slow ramps, from {slowest:.1g} to {fastest:.1g} {unit}"
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        speeds = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} {unit}"
        return Lack(f"{speeds}, where friction is one level", f"log {run}")
    if below < MIN_SLOW_SAMPLES:
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
        return Lack(f"the drive moves {way} only", "log both directions")
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


VISCOUS_EXCITATION = Excitation(
    {"viscous": Need(lacks_speed_range, FRICTION_LEVELS)},
    (
        SeparatingRun(
            frozenset({"viscous"}),
            STRIBECK_CURVE,
            "log speeds below <stribeck_velocity>, and such beyond <5 stribeck_velocity>",
        ),
    ),
)
COULOMB_EXCITATION = (
    Excitation(
        {},
        (SeparatingRun(CONSTANT_FORCES, FRICTION_LEVELS, "log both directions"),),
        (Width("smoothing", SMOOTHING_FACTOR),),
    )
    | VISCOUS_EXCITATION
)
STRIBECK_EXCITATION = COULOMB_EXCITATION | Excitation(
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
BRISTLE_EXCITATION = STRIBECK_EXCITATION | Excitation(
    dict.fromkeys(sorted(BRISTLES), Need(lacks_presliding)),
    (
        SeparatingRun(
            BRISTLES,
            BRISTLES | STRIBECK_CURVE,
            "log presliding: reversals, and a force that swings below break-away, <static>",
        ),
    ),
)
ASYMMETRY_EXCITATION = Excitation(
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
    (Width("smoothing", SMOOTHING_FACTOR, follows=("asymmetry_width",)),),
)
_LEVELS = frozenset(f"friction.{n}" for n in FRICTION_LEVELS)


def load_excitation(inertia: str, force: str, push: str, remedy: str) -> Excitation:
    """Excitation that the load of a drive needs.

    Parameters
    ----------
    inertia, force : str
        Names of the load's parameters: its inertia, and its constant force.
    push : str
        The drive's input in words: "force", "torque".
    remedy : str
        How the inertia is found without a log, in words.
    """
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
    return Excitation({force: Need(lacks_directions, _LEVELS), inertia: Need(lacks)}, runs)


LOAD_EXCITATION = load_excitation("load.mass", "load.force", "force", "weigh the load and fix its mass")
RIG_EXCITATION = Excitation({"rig.force_offset": Need(lacks_directions, _LEVELS)})


def _largest_known(name: str, default: float, *known: ParameterSet) -> float:
    return max((values.value(name) for values in known if name in values), default=default)


def _speed_unit(seen: LoggedMotion) -> str:
    return _known_unit(seen, "friction.stribeck_velocity", "friction.smoothing") or "m/s"


def _known_unit(seen: LoggedMotion, *names: str) -> str:
    """Unit of the first parameter that is known; empty where none is."""
    return next((known[n].unit for n in names for known in (seen.given, seen.values) if n in known), "")
