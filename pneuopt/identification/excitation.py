"""What a set of logs excites, and for each parameter that they leave in the dark the run that would show it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

MOVING_SPEED_SHARE = 0.05  # of the largest speed
MIN_SPEED_RATIO = 3.0  # of speeds, below which a friction curve is a point
VISCOUS_SPEED_RATIO = (
    5.0  # times the Stribeck velocity, or the speeds so far: from where viscous friction shows (PHYSICS section 6)
)
MIN_SLOW_SAMPLES = 20  # samples that show a thing only by the way
MIN_DIRECTION_SHARE = 0.05  # share of the rarer direction
MIN_REVERSALS = 2  # that show presliding more than once
MIN_INERTIA_SHARE = 0.02  # of the friction level: inertia below it is lost in the model's own error
DEFAULT_STRIBECK_VELOCITY = 0.02  # [m/s] where none is known


@dataclass(frozen=True)
class Motion:
    """What the logs' speeds look like, all together.

    Attributes
    ----------
    slow, fast : float
        The speed [m/s] that a tenth of the moving samples stay below, and a tenth exceed.
    forward : float
        Share of the moving samples, 0 to 1.
    reversals : int
    acceleration : float
        Root mean square [m/s^2] of slopes over a hundredth of a log.
    below_stribeck : int
        Samples between a tenth of the Stribeck velocity and all of it.
    stribeck : float
        That velocity, as far as it is known [m/s].
    friction : float
        The Coulomb level, as far as it is known [N].
    mass : float
        As far as it is known [kg].
    """

    slow: float
    fast: float
    forward: float
    reversals: int
    acceleration: float
    below_stribeck: int
    stribeck: float
    friction: float
    mass: float


def summarise_motion(
    experiments: Sequence[Experiment], states: Mapping[str, Trajectory], values: ParameterSet, given: ParameterSet
) -> Motion | None:
    """Look at the speeds of all logs.

    Parameters
    ----------
    experiments : sequence of Experiment
    states : mapping of str to Trajectory
        Estimated states of each log, whose speed counts where none is logged.
    values, given : ParameterSet
        As the logs seem to say, and as the user says; of two masses, the larger counts.

    Returns
    -------
    Motion or None
        None where no log has a speed, or nothing moves.
    """
    runs = [r for e in experiments if (r := _speed(e, states.get(e.name))) is not None]
    v = np.concatenate([speed for _, speed in runs]) if runs else np.zeros(0)
    if not np.any(v):
        return None
    v_s = values.value(_STRIBECK_VELOCITY) if _STRIBECK_VELOCITY in values else DEFAULT_STRIBECK_VELOCITY
    moving = v[np.abs(v) > MOVING_SPEED_SHARE * float(np.quantile(np.abs(v), 0.99))]
    low, high = np.quantile(np.abs(moving), [0.1, 0.9])
    rates = np.concatenate([_acceleration(t, speed) for t, speed in runs])
    coulomb, mass = (
        max((known.value(n) for known in sources if n in known), default=math.nan)
        for n, sources in (("friction.coulomb", [values]), ("load.mass", [values, given]))
    )
    return Motion(
        float(low),
        float(high),
        float(np.mean(moving > 0)),
        sum(_count_reversals(speed, MOVING_SPEED_SHARE * float(high)) for _, speed in runs),
        float(np.sqrt(np.mean(rates**2))),
        int(np.count_nonzero((np.abs(v) > 0.1 * v_s) & (np.abs(v) < v_s))),
        v_s,
        coulomb,
        mass,
    )


def missing_excitation(name: str, free: Sequence[str], seen: Motion | None) -> tuple[str, str] | None:
    """What the logs lack to tell a parameter, and what to log; None where they lack nothing that is known of.

    Parameters
    ----------
    name : str
        Of the parameter, "name[log]" for one of a log.
    free : sequence of str
        All that are to be told at once: a rule counts where one of its others is among them.
    seen : Motion or None
    """
    rule, others = _EXCITATION_RULES.get(_base_name(name), (None, set()))
    confused = others & ({_base_name(n) for n in free} - {_base_name(name)}) or not others
    return rule(seen) if rule is not None and seen is not None and confused else None


def remedy(names: Sequence[str]) -> str:
    """What run would tell these apart, in words."""
    bases = {_base_name(n) for n in names}
    for some, others, words in _SEPARATING_RUNS:
        if bases & some and (len(bases) == 1 or bases & others):
            return words
    return f"fix {'it' if len(bases) == 1 else 'one of them'}, or log a run that moves differently"


def _base_name(name: str) -> str:
    return name.partition("[")[0]


def _speed(experiment: Experiment, states: Trajectory | None) -> tuple[Array, Array] | None:
    log = experiment.trajectory
    source = log if "speed" in log else states
    if source is None or "speed" not in source:
        return None
    known = np.isfinite(source["speed"])
    return source.t[known], source["speed"][known]


def _acceleration(t: Array, v: Array) -> Array:
    every = max(1, len(t) // 200)
    return np.asarray(np.diff(v[::every]) / np.diff(t[::every]))


def _count_reversals(v: Array, level: float) -> int:
    """Changes of direction, from beyond a level to beyond it on the other side."""
    side = np.sign(v[np.abs(v) > level])
    return int(np.count_nonzero(np.diff(side)))


def _lacks_stribeck_curve(seen: Motion) -> tuple[str, str] | None:
    """What a Stribeck curve and its two ends need."""
    slowest, fastest = 0.1 * seen.stribeck, VISCOUS_SPEED_RATIO * seen.stribeck
    run = f"constant speeds, or slow ramps, from {slowest:.1g} to {fastest:.1g} m/s"
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        message = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} m/s, where friction is one level"
        return message, f"log {run}"
    if seen.below_stribeck < MIN_SLOW_SAMPLES:
        message = f"only {seen.below_stribeck} samples are slower than the Stribeck velocity, {seen.stribeck:.2g} m/s"
        return message, f"log {run}"
    return None


def _lacks_speed_range(seen: Motion) -> tuple[str, str] | None:
    if seen.fast < MIN_SPEED_RATIO * seen.slow:
        message = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} m/s, too near for a slope"
        return message, f"log speeds from {seen.slow:.2g} to beyond {VISCOUS_SPEED_RATIO * seen.fast:.2g} m/s"
    return None


def _lacks_directions(seen: Motion) -> tuple[str, str] | None:
    if min(seen.forward, 1 - seen.forward) < MIN_DIRECTION_SHARE:
        way = "forwards" if seen.forward > 0.5 else "backwards"
        return f"the drive moves {way} only", "log both directions"
    return None


def _lacks_presliding(seen: Motion) -> tuple[str, str] | None:
    if seen.reversals < MIN_REVERSALS:
        count = f"the motion reverses {seen.reversals} times" if seen.reversals else "the motion never reverses"
        return f"{count}, so that the bristles are hardly seen", (
            "log presliding: reversals, and a force that swings below break-away, sampled at 1 kHz"
        )
    return None


def _lacks_acceleration(seen: Motion) -> tuple[str, str] | None:
    force = seen.mass * seen.acceleration
    if force < MIN_INERTIA_SHARE * seen.friction:
        message = f"inertia takes {force:.2g} N (rms), nothing beside {seen.friction:.2g} N of friction"
        return message, "weigh the load and fix its mass, or log steps of force"
    return None


_STRIBECK_VELOCITY = "friction.stribeck_velocity"
_FRICTION_LEVELS = {"friction.coulomb", "friction.static"}
_STRIBECK_CURVE = {*_FRICTION_LEVELS, _STRIBECK_VELOCITY}
_FORCE_OFFSETS = {"load.force", "rig.force_offset"}
_EXCITATION_RULES: Mapping[str, tuple[Callable[[Motion], tuple[str, str] | None], set[str]]] = {
    _STRIBECK_VELOCITY: (_lacks_stribeck_curve, _FRICTION_LEVELS),
    "friction.static": (_lacks_stribeck_curve, _STRIBECK_CURVE),
    "friction.viscous": (_lacks_speed_range, _FRICTION_LEVELS),
    "friction.coulomb_asymmetry": (_lacks_directions, _FRICTION_LEVELS),
    "friction.viscous_asymmetry": (_lacks_directions, {"friction.viscous"}),
    "load.force": (_lacks_directions, _FRICTION_LEVELS),
    "rig.force_offset": (_lacks_directions, _FRICTION_LEVELS),
    "friction.bristle_stiffness": (_lacks_presliding, set()),
    "friction.bristle_damping": (_lacks_presliding, set()),
    "friction.damping_velocity": (_lacks_presliding, set()),
    "load.mass": (_lacks_acceleration, set()),
}
_BRISTLE_PARAMETERS = {"friction.bristle_stiffness", "friction.bristle_damping", "friction.damping_velocity"}
_FLOW_PARAMETERS = {"valve.conductance", "valve.critical_ratio", "supply.pressure", "valve.leak"}
_SEPARATING_RUNS: Sequence[tuple[set[str], set[str], str]] = (
    (
        _FORCE_OFFSETS,
        {"friction.coulomb_asymmetry"},
        "they act alike at every speed: fix one, measure the offset with the load uncoupled, or turn the axis round",
    ),
    (_FORCE_OFFSETS, _FRICTION_LEVELS, "log both directions"),
    ({"friction.viscous"}, _STRIBECK_CURVE, "log slow speeds, and such beyond five Stribeck velocities"),
    ({_STRIBECK_VELOCITY}, _FRICTION_LEVELS, "log speeds below the Stribeck velocity: slow ramps through zero"),
    (
        _BRISTLE_PARAMETERS,
        _BRISTLE_PARAMETERS | _STRIBECK_CURVE,
        "log presliding: reversals, and a force that swings below break-away",
    ),
    ({"load.mass"}, {"friction.viscous", *_BRISTLE_PARAMETERS}, "log more acceleration: steps of force"),
    (
        _FLOW_PARAMETERS,
        _FLOW_PARAMETERS,
        "log chambers filling up to the supply's pressure and emptying to the ambient's",
    ),
)
