"""Random pneumatic rigs, whose size, rate, loop and motion are drawn, and their logs.

A bore of 20 to 63 mm, strokes of 100 to 500 mm, a load that bounces on the air at 3 to 20 Hz, 5 to 8 bar; friction and
valve grow with the area. A sampled position loop follows one of `MOTIONS`; "hunting" has so much gain that it
oscillates, with less of the valve where the piston would leave its cylinder, for it has no stops. Logged at 0.5, 1 or
2 kHz for 5 to 20 s, every third log for 60 s, with noise that the log does not state.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array
from problems.shared.b32 import LOGGED, run_loop

MOTIONS = ("hunting", "staircase", "chirp", "one way", "strokes")
RATES, SECONDS, LONG, EVERY = (500.0, 1000.0, 2000.0), (5.0, 20.0), 60.0, 3  # [Hz], [s], [s], each so many is long
SETTLING = 0.3  # [s] before the log
BORES, STROKES, SUPPLIES = (0.020, 0.063), (0.1, 0.5), (5e5, 8e5)  # [m], [m], [Pa(a)]
BOUNCES = (3.0, 20.0)  # [Hz] of the mass on the air of both chambers at mid stroke
AREA, PRESSURE, EXPONENT = math.pi / 4 * 0.032**2, 3.75e5, 1.2  # of b32, by which friction and valve are scaled
NOISE = {"position": (5e-6, 5e-5), "pressure_a": (300.0, 2000.0), "pressure_b": (300.0, 2000.0)}
STEPS = 1e-5  # [s], of the RK4 that makes the log, halved where a light load makes the rig too stiff for it
MAX_HALVINGS, ERROR_SHARE = 5, 0.1  # of these steps; their error over the least noise of a channel [1]
HUNTING_GAIN = (4.0, 10.0)  # over the gain at which the frictionless loop oscillates


@dataclass(frozen=True)
class Rig:
    """What was drawn: the numbers of the drive and its loop, and what it follows."""

    truth: po.ParameterSet
    motion: str
    lugre: bool
    sample: float
    samples: int


def draw(seed: int, friction: dict[str, float]) -> Rig:
    """Draw a rig; `friction` and valve are numbers of a bore of 32 mm, with bristles where there are any."""
    rng = np.random.default_rng((seed, 4))
    lugre = "friction.bristle_stiffness" in friction
    bore, stroke = _log_uniform(rng, *BORES), _log_uniform(rng, *STROKES)
    rod, area = bore * rng.uniform(0.3, 0.45), math.pi / 4 * bore**2
    stiffness = 4 * EXPONENT * PRESSURE * area / stroke
    size, mass = area / AREA, stiffness / (2 * math.pi * _log_uniform(rng, *BOUNCES)) ** 2
    grown = {n: v * (size if n in GROWS else 1.0) for n, v in friction.items()}
    hardware = {
        "cylinder.bore": bore,
        "cylinder.rod": rod,
        "cylinder.stroke": stroke,
        "cylinder.dead_volume_a": area * stroke * rng.uniform(0.03, 0.1),
        "cylinder.dead_volume_b": area * stroke * rng.uniform(0.03, 0.1),
        "load.mass": mass,
        "supply.pressure": rng.uniform(*SUPPLIES),
    }
    motion, rate = MOTIONS[seed % len(MOTIONS)], float(rng.choice(RATES))
    seconds = LONG if seed % EVERY == 0 else _log_uniform(rng, *SECONDS)
    truth = po.catalog.b32(lugre)[1].with_values(grown | hardware)
    return Rig(truth | _gains(rng, truth, motion), motion, lugre, 1 / rate, round(seconds * rate))


GROWS = (
    "friction.coulomb",
    "friction.static",
    "friction.viscous",
    "friction.bristle_stiffness",
    "friction.bristle_damping",
    "valve.conductance",
)


def _gains(rng: np.random.Generator, truth: po.ParameterSet, motion: str) -> po.ParameterSet:
    """A loop that follows within a tenth of a second or so, or one that hunts."""
    area, supply = math.pi / 4 * truth.value("cylinder.bore") ** 2, truth.value("supply.pressure")
    # speed by volt: the sonic flow, a volume at 1 bar, at the pressure in the chamber and over the area
    by_volt = truth.value("valve.conductance") * supply * 1e5 / (PRESSURE * area)
    critical = max(5.0, truth.value("friction.viscous") / truth.value("load.mass")) / by_volt
    gain = critical * rng.uniform(*HUNTING_GAIN) if motion == "hunting" else min(10.0, 0.8 * critical)
    damping = 0.0 if motion == "hunting" else 0.03 * gain
    limit = rng.uniform(0.1, 0.3) if motion == "hunting" else 0.6
    return po.ParameterSet(
        {
            "loop.gain": po.Parameter(gain, "V/m"),
            "loop.damping": po.Parameter(damping, "V*s/m"),
            "loop.limit": po.Parameter(limit, "V"),
        }
    )


def record(rig: Rig, seed: int) -> po.Experiment:
    """The rig's log, which states no noise."""
    rng = np.random.default_rng((seed, 5))
    run = _run_inside(rig, _reference(rig, rng))
    levels = {n: _log_uniform(rng, *bounds) for n, bounds in NOISE.items()}
    noisy = {n: run[n] + sigma * rng.standard_normal(rig.samples) for n, sigma in levels.items()}
    columns = {n: noisy.get(n, run[n]) for n in LOGGED}
    return po.Experiment(po.Trajectory(np.arange(rig.samples) * rig.sample, columns), name=f"{rig.motion} {seed}")


def _run_inside(rig: Rig, wanted: Array) -> po.Trajectory:
    """The log's run without noise; the loop's limit is halved until the piston stays within its stroke."""
    settling, stroke = round(SETTLING / rig.sample), rig.truth.value("cylinder.stroke")
    given = np.concatenate([np.full(settling, wanted[0]), wanted])
    start = {"position": float(wanted[0]), "pressure_a": 3.5e5, "pressure_b": 4e5}
    for _ in range(MAX_HALVINGS):
        run = _run(rig, given, start)
        if not _leaves(run, stroke):
            return run.rows(settling, len(given))
        limit = rig.truth.value("loop.limit") / 2
        rig = replace(rig, truth=rig.truth.with_values({"loop.limit": limit}))
    raise po.InputError(f"the piston of {rig.motion} leaves its cylinder with {limit:.2g} V of the valve, too")


def _run(rig: Rig, given: Array, start: dict[str, float]) -> po.Trajectory:
    """The loop under a reference, in steps so fine that half of them change no channel beyond `ERROR_SHARE`."""
    substeps = round(rig.sample / STEPS)
    run = run_loop(rig.truth, given, rig.sample, start, rig.lugre, substeps=substeps)
    for _ in range(MAX_HALVINGS):
        substeps *= 2
        finer = run_loop(rig.truth, given, rig.sample, start, rig.lugre, substeps=substeps)
        if all(np.max(np.abs(finer[n] - run[n])) <= ERROR_SHARE * low for n, (low, _) in NOISE.items()):
            break
        run = finer
        if _leaves(run, rig.truth.value("cylinder.stroke")):
            break
    return run


def _leaves(run: po.Trajectory, stroke: float) -> bool:
    """Whether a piston leaves its cylinder."""
    return bool(np.min(run["position"]) <= 0 or np.max(run["position"]) >= stroke)


def _reference(rig: Rig, rng: np.random.Generator) -> Array:
    """The wanted position [m] at each sample."""
    stroke, t = rig.truth.value("cylinder.stroke"), np.arange(rig.samples) * rig.sample
    seconds = float(t[-1])
    if rig.motion == "chirp":
        low, high = 2.0 / seconds, rng.uniform(2.0, 6.0)
        phase = 2 * math.pi * low * seconds / math.log(high / low) * ((high / low) ** (t / seconds) - 1)
        return np.asarray(stroke * (0.5 + rng.uniform(0.05, 0.2) * np.sin(phase)))
    if rig.motion == "hunting":
        slow = rng.uniform(0.1, 0.5)
        return np.asarray(stroke * (0.5 + 0.2 * np.sin(2 * math.pi * slow * t)))
    if rig.motion == "one way":
        knots = np.sort(rng.uniform(0, seconds, round(4 + seconds / 2)))
        shares = np.cumsum(rng.exponential(size=knots.size) * (rng.random(knots.size) < 0.7))
        return np.asarray(stroke * (0.15 + 0.7 * np.interp(t, knots, shares / shares[-1], left=0.0)))
    knots = np.cumsum(rng.uniform(0.3, 1.2, round(4 + seconds / 0.3)))
    levels = stroke * rng.uniform(0.2, 0.8, knots.size)
    if rig.motion == "strokes":
        return np.asarray(np.interp(t, knots, levels))
    return np.asarray(levels[np.searchsorted(knots, t)])


def oscillation(log: po.Experiment) -> float:
    """The frequency at which the logged position moves most, by its speed [Hz]."""
    run = log.trajectory
    speed = np.gradient(run["position"], run.t)
    power = np.abs(np.fft.rfft(speed - speed.mean())) ** 2
    frequencies = np.fft.rfftfreq(len(speed), float(run.t[1] - run.t[0]))
    inside = frequencies < 40.0  # above, the differences of the noise
    return float(frequencies[inside][np.argmax(power[inside])])


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())
