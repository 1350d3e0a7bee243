"""Random tuning problems that are known to be feasible: plants, controllers, steps, and limits that a design keeps.

A seed gives a plant of one of `KINDS`, a PID that is continuous or sampled, with dither or without, one to three
steps, and what is free. A brute-force search, which shares its compiled simulator but no idea with `tune`, then looks
for a design: `GLOBAL` points of the box at random, `LOCAL` more about the ten best. The certified figures of the best,
as printed, loosened by `MARGIN`, are the limits. Where nothing settles, robustly and without a contact, the seed goes
on to its next problem.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

import pneuopt as po
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from problems.shared.arrays import Array

Ranges = dict[str, tuple[float, float]]
MARGIN = 0.1  # of the design's figures: what the limits leave
FLOORS = {"Overshoot": 0.005, "SteadyStateError": 0.002, "MaxSensitivity": 0.01}  # where there is next to nothing
GLOBAL, LOCAL, TOP, DIGITS = 800, 400, 10, 4
ROBUST, OVERSHOOT = 2.0, 0.3  # a design that is more nervous than that is none
MOST_DRAWS = 60
SPREAD = 0.3  # of a catalogue's mass, friction, conductance and supply
FRICTION = ("coulomb", "static", "viscous")


@dataclass(frozen=True, eq=False)
class Plant:
    """A loop, its parameters, how fast and how large steps may be, and where in the stroke they may start."""

    loop: po.ClosedLoop
    parameters: po.ParameterSet
    speed: float
    horizon: float
    ends: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """What `tune` is given, and the design that shows it to be feasible.

    Attributes
    ----------
    redrawn : int
        Problems before it for which brute force found nothing.
    known : dict of str to float
        The certified figures of that design, as requirements read them, the worst over the steps.
    """

    kind: str
    loop: po.ClosedLoop
    steps: list[po.Step]
    parameters: po.ParameterSet
    minimise: dict[Any, float]
    subject_to: list[Any]
    redrawn: int
    known: dict[str, float]


def problem(seed: int) -> Problem:
    """The problem of a seed."""
    rng = np.random.default_rng((seed, 5))
    kind = list(KINDS)[seed % len(KINDS)]
    for redrawn in range(MOST_DRAWS):
        plant = KINDS[kind](rng)
        steps, minimise = random_steps(plant, rng), _objective(rng)
        kinds = _limited(plant.loop, rng)
        try:
            known = _brute_force(plant, steps, kinds, rng)
        except (po.ConvergenceError, po.InputError):
            continue
        if known:
            limits = [_limit(name, known[name]) for name in ("SettlingTime", *kinds)]
            return Problem(kind, plant.loop, steps, plant.parameters, minimise, limits, redrawn, known)
    raise po.InputError(f"seed {seed}: {MOST_DRAWS} problems of kind {kind}, and brute force solved none")


def _linear(rng: np.random.Generator, plant: Any, values: dict[str, float], rate: float, sampled: bool) -> Plant:
    """About a plant whose steps take about 1/rate [s]."""
    gain = values["plant.gain"]
    pid = po.PID(sample_time=rng.uniform(0.02, 0.1) / rate if sampled else None, limits=rng.random() < 0.5)
    loop = po.ClosedLoop(plant.system(), pid)
    ranges = {"pid.Kp": (0.02 / gain, 20 / gain), "pid.Ki": (0.02 * rate / gain, 20 * rate / gain)}
    ranges |= {"pid.Kd": (0.0, 2 / (gain * rate)), "pid.Tf": (0.02 / rate, 0.5 / rate)}
    speed, reach = rng.uniform(0.1, 1.0) * gain, rng.uniform(1.5, 4.0)
    clip = {"pid.lower": -reach * speed / gain, "pid.upper": reach * speed / gain} if pid.limits else {}
    given = values | clip | {"pid.Kp": 0.5 / gain, "pid.Ki": 0.5 * rate / gain, "pid.Tf": 0.1 / rate}
    return Plant(loop, _freed(loop, loop.parameters.with_values(given), ranges, rng), speed, 25 / rate)


def second_order(rng: np.random.Generator, sampled: bool = False) -> Plant:
    rate = _log(rng, 3.0, 60.0)
    values = {"plant.gain": _log(rng, 0.05, 20.0), "plant.natural_frequency": rate}
    return _linear(rng, po.SecondOrder(), values | {"plant.damping": rng.uniform(0.3, 1.5)}, rate, sampled)


def sampled_second_order(rng: np.random.Generator) -> Plant:
    return second_order(rng, sampled=True)


def dead_time(rng: np.random.Generator) -> Plant:
    lag = _log(rng, 0.02, 0.5)
    values = {"plant.gain": _log(rng, 0.05, 20.0), "plant.time_constant": lag}
    values["plant.dead_time"] = lag * rng.uniform(0.1, 0.8)
    return _linear(rng, po.FirstOrder(pade_order=2), values, 1 / lag, bool(rng.random() < 0.5))


def friction_lag(rng: np.random.Generator) -> Plant:
    """A lag of second order that sticks."""
    rate, gain, coulomb = _log(rng, 8.0, 40.0), rng.uniform(0.05, 0.3), rng.uniform(0.1, 0.6)
    values = {"plant.gain": gain, "plant.natural_frequency": rate, "plant.damping": rng.uniform(0.5, 1.5)}
    values |= {"friction.coulomb": coulomb, "friction.static": coulomb * rng.uniform(1.1, 1.6)}
    plant = po.SecondOrder(friction=po.Stribeck()).system()
    loop = po.ClosedLoop(plant, _sampled(rng), _dither(rng))
    ranges = {"pid.Kp": (0.05 / gain, 20 / gain), "pid.Ki": (0.05 * rate / gain, 20 * rate / gain)}
    ranges |= {"pid.Kd": (0.0, 1 / (gain * rate)), "dither.amplitude": (0.0, 3 * coulomb)}
    ranges["dither.offset"] = (-coulomb, coulomb)
    given = values | {"pid.Kp": 1 / gain, "pid.Ki": rate / gain, "pid.lower": -5.0, "pid.upper": 5.0}
    return Plant(loop, _freed(loop, loop.parameters.with_values(given), ranges, rng), 2.5 * gain, 12 / rate)


def force_drive(rng: np.random.Generator) -> Plant:
    """A mass with friction, pushed by a known force."""
    friction = po.LuGre() if rng.random() < 0.3 else po.Stribeck()
    mass, coulomb = _log(rng, 1.0, 20.0), rng.uniform(10.0, 60.0)
    values = {"load.mass": mass, "friction.coulomb": coulomb, "friction.static": coulomb * rng.uniform(1.1, 1.8)}
    values |= {"friction.viscous": rng.uniform(30.0, 200.0), "friction.stribeck_velocity": rng.uniform(0.01, 0.05)}
    loop = po.ClosedLoop(po.ForceDrive(friction).system(), _sampled(rng), _dither(rng))
    ranges = {"pid.Kp": (5.0, 60 * mass), "pid.Ki": (5.0, 1200 * mass), "pid.Kd": (0.0, 0.5 * mass)}
    ranges |= {"dither.amplitude": (0.0, 2 * coulomb), "dither.offset": (-coulomb, coulomb)}
    given = values | {"pid.Kp": 15 * mass, "pid.Ki": 100 * mass, "pid.lower": -400.0, "pid.upper": 400.0}
    return Plant(loop, _freed(loop, loop.parameters.with_values(given), ranges, rng), 0.4, rng.uniform(0.4, 0.8))


def _pneumatic(make: Callable[[], po.catalog.DriveSet]) -> Callable[[np.random.Generator], Plant]:
    def drawn(rng: np.random.Generator) -> Plant:
        drive, rig = make()
        spread = ("load.mass", "valve.conductance", *(f"friction.{n}" for n in FRICTION))
        values = {n: rig.value(n) * rng.uniform(1 - SPREAD, 1 + SPREAD) for n in spread}
        values["friction.static"] = max(values["friction.static"], 1.05 * values["friction.coulomb"])
        values |= {"supply.pressure": rng.uniform(5e5, 9e5), "valve.dead_zone": rng.uniform(0.0, 0.05)}
        loop = po.ClosedLoop(drive.system(), _sampled(rng), _dither(rng), measured="speed")
        own = loop.parameters.select(n for n in loop.parameters if n.startswith(("pid.", "dither.")))
        given = {"pid.Kp": 5.0, "pid.Ki": 30.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}
        parameters = _freed(loop, (rig.fixed("*") | own).with_values(values | given), VALVE_RANGES, rng)
        stroke, horizon = rig.value("cylinder.stroke"), rng.uniform(0.5, 0.9)
        return Plant(loop, parameters, 0.6 * stroke / horizon, horizon, (0.15 * stroke, 0.85 * stroke))

    return drawn


VALVE_RANGES: Ranges = {
    "pid.Kp": (0.2, 60.0),
    "pid.Ki": (0.5, 400.0),
    "pid.Kd": (0.0, 0.5),
    "pid.Tf": (0.002, 0.05),
    "dither.amplitude": (0.0, 2.0),
    "dither.offset": (-1.5, 1.5),
}
KINDS: dict[str, Callable[[np.random.Generator], Plant]] = {
    "second_order": second_order,
    "dead_time": dead_time,
    "sampled_second_order": sampled_second_order,
    "friction_lag": friction_lag,
    "force_drive": force_drive,
    "s25": _pneumatic(po.catalog.s25),
    "s32": _pneumatic(po.catalog.s32),
    "s40": _pneumatic(po.catalog.s40),
    "t32": _pneumatic(po.catalog.t32),
}


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def _sampled(rng: np.random.Generator) -> po.PID:
    return po.PID(sample_time=float(rng.choice((1e-3, 2e-3))) if rng.random() < 0.7 else None)


def _dither(rng: np.random.Generator) -> po.Dither | None:
    return po.Dither(frequency=float(rng.choice((62.5, 100.0, 125.0)))) if rng.random() < 0.5 else None


def _freed(loop: po.ClosedLoop, given: po.ParameterSet, ranges: Ranges, rng: np.random.Generator) -> po.ParameterSet:
    """Kp and Ki are free, the rest of the ranges by chance."""
    always = ("pid.Kp", "pid.Ki")
    free = {n: r for n, r in ranges.items() if n in loop.parameters and (n in always or rng.random() < 0.6)}
    return given.with_bounds(free).freed(*free)


def random_steps(plant: Plant, rng: np.random.Generator) -> list[po.Step]:
    """One to three, either direction, some from motion; labels tell them apart."""
    found: dict[str, po.Step] = {}
    for _ in range(int(rng.integers(1, 4))):
        size = float(rng.uniform(0.25, 1.0) * plant.speed * rng.choice((-1, 1)))
        initial = float(rng.uniform(0.2, 0.6)) * size if rng.random() < 0.25 else 0.0
        start = {} if plant.ends is None else {"position": plant.ends[0 if size > 0 else 1]}
        step = po.Step(size - initial, initial=initial, horizon=plant.horizon, start=start)
        found[step.label] = step
    return list(found.values())


def _objective(rng: np.random.Generator) -> dict[Any, float]:
    choices: list[dict[Any, float]] = [
        {po.SettlingTime(): 1.0},
        {po.SettlingTime(): 1.0, po.Overshoot(): 1.0},
        {po.ITAE(): 1.0},
    ]
    return choices[int(rng.choice(3, p=(0.7, 0.15, 0.15)))]


def _limited(loop: po.ClosedLoop, rng: np.random.Generator) -> list[str]:
    """Names of what is limited beside the settling time."""
    odds = {"MaxSensitivity": 0.6, "SteadyStateError": 0.2, "PeakControl": 0.3, "NoiseGain": 0.1, "RiseTime": 0.1}
    odds |= {"Ripple": 0.3} if loop.dither else {}
    return ["Overshoot", *(n for n, share in odds.items() if rng.random() < share)]


def _limit(name: str, value: float) -> Any:
    least = 1.0 if name == "MaxSensitivity" else 0.0
    allowed = least + (value - least) * (1 + MARGIN) + FLOORS.get(name, 0.0)
    return getattr(po, name)(max=allowed)


def _brute_force(plant: Plant, steps: list[po.Step], kinds: list[str], rng: np.random.Generator) -> dict[str, float]:
    """The best design's certified figures; empty where nothing is good enough."""
    space = search_space(plant.loop, plant.parameters)
    asked = [getattr(po, n)(max=1e9 if n not in ("Overshoot", "SteadyStateError") else 0.9) for n in kinds]
    spec = specify(po.SettlingTime(), [*asked, *([] if "MaxSensitivity" in kinds else [po.MaxSensitivity(1e9)])])
    simulator = Simulator(plant.loop, steps, space, spec=spec)
    # about a mean state in the dead zone, which dither smooths, the sensitivity tells nothing: only where it is asked
    robust = inf if plant.loop.dither and "MaxSensitivity" not in kinds else ROBUST
    unit = rng.random((GLOBAL, len(space.names)))
    best, times = _best(simulator, spec, unit, robust)
    if np.isfinite(times).any():
        near = best[rng.integers(len(best), size=LOCAL)] + 0.05 * rng.standard_normal((LOCAL, len(space.names)))
        best, times = _best(simulator, spec, np.vstack([best, np.clip(near, 0.0, 1.0)]), robust)
    if not np.isfinite(times[0]):
        return {}
    return _certified(
        plant, steps, space.parameters_at(space.round_point(space.from_unit(best[0]), DIGITS)), ["SettlingTime", *kinds]
    )


def _best(simulator: Simulator, spec: Specification, unit: Array, robust: float) -> tuple[Array, Array]:
    """The ten best by settling time, those that are nervous last."""
    points = simulator.space.from_unit(unit)
    quick = simulator.respond(points, spec.band).values
    order = np.argsort(np.where(quick["Overshoot"] <= OVERSHOOT, _finite(quick["SettlingTime"]), inf))[: 3 * TOP]
    values = simulator.values(points[order], spec)
    times = np.where(values["MaxSensitivity"] <= robust, _finite(values["SettlingTime"]), inf)
    times = np.where(values["Overshoot"] <= OVERSHOOT, times, inf)
    chosen = np.argsort(times)[:TOP]
    return unit[order[chosen]], times[chosen]


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, inf)


def _certified(plant: Plant, steps: list[po.Step], design: po.ParameterSet, kinds: list[str]) -> dict[str, float]:
    """The worst over the steps, by the independent simulation; empty if it meets an end stop, or never settles."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", po.PhysicsWarning)
        try:
            found = po.evaluate(plant.loop, steps, design)
        except po.PhysicsWarning:
            return {}
    worst = {n: float(np.max(found.loc[n].to_numpy(dtype=float))) for n in kinds}
    worst = {n: v / 100 if n in ("Overshoot", "SteadyStateError") else v for n, v in worst.items()}
    return worst if all(np.isfinite(v) for v in worst.values()) else {}
