"""What a set of logs excites, and for each parameter that they leave in the dark the run that would show it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

Array = NDArray[np.float64]
MOVING = 0.05  # of the largest speed
SPAN = 3.0  # of speeds, below which a friction curve is a point
FAR = 5.0  # times the Stribeck velocity, or the speeds so far: from where viscous friction shows (PHYSICS section 6)
FEW = 20  # samples that show a thing only by the way
ONE_WAY = 0.05  # share of the rarer direction
REVERSALS = 2  # that show presliding more than once
INERT = 0.02  # of the friction level: inertia below it is lost in the model's own error
USUAL_STRIBECK = 0.02  # [m/s] where none is known


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


def motion(
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
    v_s = values.value(_STRIBECK) if _STRIBECK in values else USUAL_STRIBECK
    moving = v[np.abs(v) > MOVING * float(np.quantile(np.abs(v), 0.99))]
    low, high = np.quantile(np.abs(moving), [0.1, 0.9])
    rates = np.concatenate([_rate(t, speed) for t, speed in runs])
    coulomb, mass = (
        max((known.value(n) for known in sources if n in known), default=math.nan)
        for n, sources in (("friction.coulomb", [values]), ("load.mass", [values, given]))
    )
    return Motion(
        float(low),
        float(high),
        float(np.mean(moving > 0)),
        sum(_reversals(speed, MOVING * float(high)) for _, speed in runs),
        float(np.sqrt(np.mean(rates**2))),
        int(np.count_nonzero((np.abs(v) > 0.1 * v_s) & (np.abs(v) < v_s))),
        v_s,
        coulomb,
        mass,
    )


def missing(name: str, free: Sequence[str], seen: Motion | None) -> tuple[str, str] | None:
    """What the logs lack to tell a parameter, and what to log; None where they lack nothing that is known of.

    Parameters
    ----------
    name : str
        Of the parameter, "name[log]" for one of a log.
    free : sequence of str
        All that are to be told at once: a rule counts where one of its others is among them.
    seen : Motion or None
    """
    rule, others = _RULES.get(_base(name), (None, set()))
    confused = others & ({_base(n) for n in free} - {_base(name)}) or not others
    return rule(seen) if rule is not None and seen is not None and confused else None


def remedy(names: Sequence[str]) -> str:
    """What run would tell these apart, in words."""
    bases = {_base(n) for n in names}
    for some, others, words in _APART:
        if bases & some and (len(bases) == 1 or bases & others):
            return words
    return f"fix {'it' if len(bases) == 1 else 'one of them'}, or log a run that moves differently"


def _base(name: str) -> str:
    return name.partition("[")[0]


def _speed(experiment: Experiment, states: Trajectory | None) -> tuple[Array, Array] | None:
    log = experiment.trajectory
    source = log if "speed" in log else states
    if source is None or "speed" not in source:
        return None
    known = np.isfinite(source["speed"])
    return source.t[known], source["speed"][known]


def _rate(t: Array, v: Array) -> Array:
    every = max(1, len(t) // 200)
    return np.asarray(np.diff(v[::every]) / np.diff(t[::every]))


def _reversals(v: Array, level: float) -> int:
    """Changes of direction, from beyond a level to beyond it on the other side."""
    side = np.sign(v[np.abs(v) > level])
    return int(np.count_nonzero(np.diff(side)))


def _curve(seen: Motion) -> tuple[str, str] | None:
    """What a Stribeck curve and its two ends need."""
    run = f"constant speeds, or slow ramps, from {0.1 * seen.stribeck:.1g} to {FAR * seen.stribeck:.1g} m/s"
    if seen.fast < SPAN * seen.slow:
        told = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} m/s, where friction is one level"
        return told, f"log {run}"
    if seen.below_stribeck < FEW:
        told = f"only {seen.below_stribeck} samples are slower than the Stribeck velocity, {seen.stribeck:.2g} m/s"
        return told, f"log {run}"
    return None


def _slope(seen: Motion) -> tuple[str, str] | None:
    if seen.fast < SPAN * seen.slow:
        told = f"nearly all speeds lie between {seen.slow:.2g} and {seen.fast:.2g} m/s, too near for a slope"
        return told, f"log speeds from {seen.slow:.2g} to beyond {FAR * seen.fast:.2g} m/s"
    return None


def _directions(seen: Motion) -> tuple[str, str] | None:
    if min(seen.forward, 1 - seen.forward) < ONE_WAY:
        way = "forwards" if seen.forward > 0.5 else "backwards"
        return f"the drive moves {way} only", "log both directions"
    return None


def _presliding(seen: Motion) -> tuple[str, str] | None:
    if seen.reversals < REVERSALS:
        count = f"the motion reverses {seen.reversals} times" if seen.reversals else "the motion never reverses"
        return f"{count}, so that the bristles are hardly seen", (
            "log presliding: reversals, and a force that swings below break-away, sampled at 1 kHz"
        )
    return None


def _inertia(seen: Motion) -> tuple[str, str] | None:
    force = seen.mass * seen.acceleration
    if force < INERT * seen.friction:
        told = f"inertia takes {force:.2g} N (rms), nothing beside {seen.friction:.2g} N of friction"
        return told, "weigh the load and fix its mass, or log steps of force"
    return None


_STRIBECK = "friction.stribeck_velocity"
_LEVELS = {"friction.coulomb", "friction.static"}
_CURVE = {*_LEVELS, _STRIBECK}
_OFFSETS = {"load.force", "rig.force_offset"}
_RULES: Mapping[str, tuple[Callable[[Motion], tuple[str, str] | None], set[str]]] = {
    _STRIBECK: (_curve, _LEVELS),
    "friction.static": (_curve, _CURVE),
    "friction.viscous": (_slope, _LEVELS),
    "friction.coulomb_asymmetry": (_directions, _LEVELS),
    "friction.viscous_asymmetry": (_directions, {"friction.viscous"}),
    "load.force": (_directions, _LEVELS),
    "rig.force_offset": (_directions, _LEVELS),
    "friction.bristle_stiffness": (_presliding, set()),
    "friction.bristle_damping": (_presliding, set()),
    "friction.damping_velocity": (_presliding, set()),
    "load.mass": (_inertia, set()),
}
_BRISTLES = {"friction.bristle_stiffness", "friction.bristle_damping", "friction.damping_velocity"}
_FLOW = {"valve.conductance", "valve.critical_ratio", "supply.pressure", "valve.leak"}
_APART: Sequence[tuple[set[str], set[str], str]] = (
    (
        _OFFSETS,
        {"friction.coulomb_asymmetry"},
        "they act alike at every speed: fix one, measure the offset with the load uncoupled, or turn the axis round",
    ),
    (_OFFSETS, _LEVELS, "log both directions"),
    ({"friction.viscous"}, _CURVE, "log slow speeds, and such beyond five Stribeck velocities"),
    ({_STRIBECK}, _LEVELS, "log speeds below the Stribeck velocity: slow ramps through zero"),
    (_BRISTLES, _BRISTLES | _CURVE, "log presliding: reversals, and a force that swings below break-away"),
    ({"load.mass"}, {"friction.viscous", *_BRISTLES}, "log more acceleration: steps of force"),
    (_FLOW, _FLOW, "log chambers filling up to the supply's pressure and emptying to the ambient's"),
)
