"""What motion the parameters of drives and friction laws need in a log, and the runs that separate them from others."""

import math

import numpy as np

from pneuopt.dynamics.excitation import Excitation, Lack, LoggedMotion, Need, SeparatingRun
from pneuopt.quantities.parameters import ParameterSet

MIN_SPEED_RATIO = 3.0  # fast over slow speed [1]; below it a friction curve is a point, above it more logs are refused
VISCOUS_SPEED_RATIO = 5.0  # speed over the Stribeck velocity [1] from which viscous friction shows beside its peak
MIN_SLOW_SAMPLES = 20  # samples below the Stribeck velocity; fewer are noise, more would refuse logs that show it
MIN_DIRECTION_SHARE = 0.05  # of the moving samples; below it the rarer direction is an accident
MIN_REVERSALS = 2  # reversals that show presliding more than once
MIN_INERTIA_SHARE = 0.02  # of the friction level [1]; inertia below it is lost in the model's own error
DEFAULT_STRIBECK_VELOCITY = 0.02  # [m/s] where a model has none
FRICTION_LEVELS = frozenset({"coulomb", "static"})
STRIBECK_CURVE = FRICTION_LEVELS | {"stribeck_velocity"}
BRISTLES = frozenset({"bristle_stiffness", "bristle_damping", "damping_velocity"})
CONSTANT_FORCES = frozenset({"load.force", "rig.force_offset"})
"""Parameters of drives that push one way whatever the speed."""


def lacks_stribeck_curve(seen: LoggedMotion) -> Lack | None:
    """What a Stribeck curve and its two ends need: slow speeds and fast ones."""
    stribeck = _largest("friction.stribeck_velocity", DEFAULT_STRIBECK_VELOCITY, seen.values)
    speed = np.abs(seen.speed)
    below = int(np.count_nonzero((speed > 0.1 * stribeck) & (speed < stribeck)))
    slowest, fastest = 0.1 * stribeck, VISCOUS_SPEED_RATIO * stribeck
    run = f"constant speeds, or slow ramps, from {slowest:.1g} to {fastest:.1g} m/s"
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        message = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} m/s, where friction is one level"
        return Lack(message, f"log {run}")
    if below < MIN_SLOW_SAMPLES:
        message = f"only {below} samples are slower than the Stribeck velocity, {stribeck:.2g} m/s"
        return Lack(message, f"log {run}")
    return None


def lacks_speed_range(seen: LoggedMotion) -> Lack | None:
    """What a slope over speed needs: speeds that differ."""
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        message = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} m/s, too near for a slope"
        return Lack(message, f"log speeds from {seen.slow:.2g} to beyond {VISCOUS_SPEED_RATIO * seen.fast:.2g} m/s")
    return None


def lacks_directions(seen: LoggedMotion) -> Lack | None:
    """What a force that depends on the direction, or does not, needs: motion both ways."""
    if min(seen.forward, 1 - seen.forward) < MIN_DIRECTION_SHARE:
        way = "forwards" if seen.forward > 0.5 else "backwards"
        return Lack(f"the drive moves {way} only", "log both directions")
    return None


def lacks_presliding(seen: LoggedMotion) -> Lack | None:
    """What bristles need: reversals."""
    if seen.reversals < MIN_REVERSALS:
        count = f"the motion reverses {seen.reversals} times" if seen.reversals else "the motion never reverses"
        return Lack(
            f"{count}, so that the bristles are hardly seen",
            "log presliding: reversals, and a force that swings below break-away, sampled at 1 kHz",
        )
    return None


def lacks_acceleration(seen: LoggedMotion) -> Lack | None:
    """What a mass needs: inertia that shows beside friction; of two masses known, the larger counts."""
    force = _largest("load.mass", math.nan, seen.values, seen.given) * seen.acceleration
    friction = _largest("friction.coulomb", math.nan, seen.values)
    if force < MIN_INERTIA_SHARE * friction:
        message = f"inertia takes {force:.2g} N (rms), nothing beside {friction:.2g} N of friction"
        return Lack(message, "weigh the load and fix its mass, or log steps of force")
    return None


VISCOUS_EXCITATION = Excitation(
    {"viscous": Need(lacks_speed_range, FRICTION_LEVELS)},
    (
        SeparatingRun(
            frozenset({"viscous"}), STRIBECK_CURVE, "log slow speeds, and such beyond five Stribeck velocities"
        ),
    ),
)
COULOMB_EXCITATION = (
    Excitation({}, (SeparatingRun(CONSTANT_FORCES, FRICTION_LEVELS, "log both directions"),)) | VISCOUS_EXCITATION
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
            "log speeds below the Stribeck velocity: slow ramps through zero",
        ),
    ),
)
BRISTLE_EXCITATION = STRIBECK_EXCITATION | Excitation(
    dict.fromkeys(sorted(BRISTLES), Need(lacks_presliding)),
    (
        SeparatingRun(
            BRISTLES, BRISTLES | STRIBECK_CURVE, "log presliding: reversals, and a force that swings below break-away"
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
            "they act alike at every speed: "
            "fix one, measure the offset with the load uncoupled, or turn the axis round",
        ),
    ),
)
_LEVELS = frozenset(f"friction.{n}" for n in FRICTION_LEVELS)
LOAD_EXCITATION = Excitation(
    {"load.force": Need(lacks_directions, _LEVELS), "load.mass": Need(lacks_acceleration)},
    (
        SeparatingRun(
            frozenset({"load.mass"}),
            frozenset(f"friction.{n}" for n in {"viscous", *BRISTLES}),
            "log more acceleration: steps of force",
        ),
    ),
)
RIG_EXCITATION = Excitation({"rig.force_offset": Need(lacks_directions, _LEVELS)})


def _largest(name: str, default: float, *known: ParameterSet) -> float:
    return max((values.value(name) for values in known if name in values), default=default)
