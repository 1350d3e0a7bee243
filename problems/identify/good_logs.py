"""Right logs that no check may refuse, and the same logs with a fault that one has to.

    python problems/identify/good_logs.py [--count N] [--first SEED] [--json FILE]

Logs of 1 s to 1000 s, 50 Hz to 10 kHz (100,000 samples at most), of motion that goes one way or swings at up to 20 Hz:
sines, several at once, strokes at a constant speed with and without rests, and fast hunting about slow motion; with a
logged force or with pressures and a valve's command, with and without speed; noise or an encoder's steps, sensors that
lag by up to 3 ms, a speed filtered over up to 8 ms. The motion is given, and what drives it is computed from it: mass,
friction, weight. Then the force's, command's or position's sign is turned, pressures are exchanged, and the speed is
logged a thousand times too large; the stated mass is three times the true one, the force or a pressure reads off by
half the friction, the position jumps by 50 mm for .1 s, and the body runs into a stop that nobody stated: caught is the
share of these in which the fault is named, of logs that come back at below 2 Hz.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.logs.doctor import CHECKS, StatedAxis, examine
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

COUNT, MAX_SAMPLES = 100, 100_000
DURATIONS, RATES, FREQUENCIES = (1.0, 1000.0), (50.0, 10_000.0), (0.05, 20.0)  # [s], [Hz], [Hz]
SLOW = 2.0  # [Hz] up to which a wrong sign has to be seen
KINDS = ("one way", "sine", "sines", "strokes", "rests", "hunting")
Motion = Callable[[Array], Array]


@dataclass(frozen=True)
class GoodLog:
    """A log, what moved, how fast, what is stated of it, and its Coulomb friction [N]."""

    experiment: po.Experiment
    kind: str
    frequency: float
    axis: StatedAxis
    friction: float


def main(count: int = COUNT, first: int = 0) -> "pd.DataFrame":
    logs = [draw_log(seed) for seed in range(first, first + count)]
    began = time.process_time()
    found = [(log, f) for log in logs for f in examine(log.experiment, log.axis)]
    seconds = time.process_time() - began
    refused = [(log, f) for log, f in found if f.fault]
    doubted = [(log, f) for log, f in found if f.check == "offset"]
    for log, finding in refused + doubted:
        print(f"{log.experiment.name} ({log.kind}, {log.frequency:.3g} Hz): {finding.message}")
    false = len({log.experiment.name for log, _ in refused})
    samples = sum(len(log.experiment.trajectory) for log in logs)
    claims = [Claim("logs", count), Claim("false_alarms", false, "1", 0.0, "<= 0")]
    claims.append(Claim("false_doubts", len(doubted), "1", 0.0, "<= 0"))
    claims.append(Claim("cpu_a_million_samples", 1e6 * seconds / samples, "s"))
    for name, spoil in SPOILERS.items():
        spoilt = [bad for log in logs if log.kind != "one way" and log.frequency < SLOW and (bad := spoil(log))]
        caught = sum(is_caught(name, bad) for bad in spoilt)
        claims += [Claim(f"{name}.logs", len(spoilt)), Claim(f"{name}.caught", 100 * caught / max(1, len(spoilt)), "%")]
    return frame(claims)


def is_caught(name: str, bad: GoodLog) -> bool:
    """Whether a bad log is refused or, by the name of its fault where it has a check of its own, doubted."""
    found = examine(bad.experiment, bad.axis)
    return any(f.check == name if name in CHECKS else f.fault for f in found)


def draw_log(seed: int) -> GoodLog:
    """A right log: the motion is drawn, and what drives it follows from it."""
    rng = np.random.default_rng(seed)
    rate = _log_uniform(rng, *RATES)
    duration = min(_log_uniform(rng, *DURATIONS), MAX_SAMPLES / rate)
    kind = KINDS[seed % len(KINDS)]
    frequency = max(min(_log_uniform(rng, *FREQUENCIES), 0.4 * rate), 2.0 / duration)
    where = _motion(kind, frequency, duration, rng)
    t = np.arange(round(duration * rate)) / rate
    late, filtered = rng.uniform(0, 3e-3), rng.uniform(0, 8e-3)
    load = _draw_load(rng)
    speed, push = _speed(where, t), load.push(where, t)
    columns = {"position": _sensed(where(t - late), rng, 1e-5)}
    if seed % 2:
        columns["speed"] = _speed(where, t - late - filtered) + 2e-3 * rng.standard_normal(t.size)
    if seed % 4 < 2:
        columns["force"] = push + 0.3 * rng.standard_normal(t.size)
        forces, constant = {"force": 1.0}, 0.0
    else:
        pressures, forces, constant = _pneumatic(push, speed, t, rng)
        columns |= pressures
    axis = StatedAxis(forces=forces, constant=constant - load.weight, inertia=load.mass, inertia_name="load.mass")
    return GoodLog(po.Experiment(po.Trajectory(t, columns), name=f"log {seed}"), kind, frequency, axis, load.coulomb)


def _motion(kind: str, frequency: float, duration: float, rng: np.random.Generator) -> Motion:
    """The position over time [m]."""
    w, phase = 2 * math.pi * frequency, rng.uniform(0, 6)
    size = min(0.1, rng.uniform(0.1, 0.6) / w)
    if kind == "one way":
        return lambda t: 0.02 + 0.3 * t / duration + min(0.02, 0.15 / duration / w) * np.sin(w * t)
    if kind == "sine":
        return lambda t: 0.1 + size * np.sin(w * t + phase)
    if kind == "sines":
        return lambda t: 0.1 + size * (0.6 * np.sin(w * t) + 0.3 * np.sin(0.37 * w * t + phase))
    if kind == "hunting":
        slow = 2 * math.pi * max(1.5 / duration, frequency / 40)
        return lambda t: 0.1 + min(0.08, 0.2 / slow) * np.sin(slow * t) + 0.3 * size * np.sin(w * t + phase)
    sharp = 0.97 if kind == "strokes" else 0.6  # at constant speed between its ends, or at rest there
    if kind == "strokes":
        return lambda t: 0.1 + size * np.arcsin(sharp * np.sin(w * t + phase))
    return lambda t: 0.1 + size * np.tanh(3 * np.sin(w * t + phase))


def _speed(where: Motion, t: Array) -> Array:
    step = 1e-5
    return np.asarray((where(t + step) - where(t - step)) / (2 * step))


@dataclass(frozen=True)
class Load:
    """A mass with friction and, at times, a weight."""

    mass: float
    coulomb: float
    viscous: float
    weight: float

    def push(self, where: Motion, t: Array) -> Array:
        """The force that moves it so [N]."""
        v, step = _speed(where, t), 1e-4
        a = (_speed(where, t + step) - _speed(where, t - step)) / (2 * step)
        return np.asarray(self.mass * a + self.coulomb * np.tanh(v / 1e-3) + self.viscous * v + self.weight)


def _draw_load(rng: np.random.Generator) -> Load:
    mass, coulomb, viscous = _log_uniform(rng, 0.5, 50), rng.uniform(5, 60), rng.uniform(0, 150)
    return Load(mass, coulomb, viscous, float(rng.choice([0.0, 0.0, 9.81 * mass])))


def _pneumatic(
    push: Array, speed: Array, t: Array, rng: np.random.Generator
) -> tuple[dict[str, Array], dict[str, float], float]:
    """Pressures that push so on unequal areas, a command for a valve with a dead zone; areas, and a constant."""
    span, ratio = max(1.0, float(np.ptp(push))), rng.uniform(0.8, 1.0)
    scale = rng.uniform(0.5, 1.0) * 2.5e5 / span  # [Pa/N]
    p_b = 3.5e5 - 0.5 * scale * (push - push.mean())
    columns = {"pressure_a": ratio * p_b + scale * (push - push.mean()) + 0.3e5, "pressure_b": p_b}
    columns = {n: p + 500 * rng.standard_normal(t.size) for n, p in columns.items()}
    lag = rng.uniform(5e-3, 5e-2)
    wanted = speed + lag * np.gradient(speed, t)
    command = 3.0 * wanted + rng.uniform(0, 0.3) * np.tanh(wanted / 0.01)
    columns["valve_voltage"] = command + 1e-3 * rng.standard_normal(t.size)
    areas = {"pressure_a": 1 / scale, "pressure_b": -ratio / scale}
    return columns, areas, float(push.mean()) - 0.3e5 / scale


def _sensed(x: Array, rng: np.random.Generator, size: float) -> Array:
    """With white noise, or in steps of an encoder."""
    return x + size * rng.standard_normal(x.size) if rng.random() < 0.5 else np.round(x / size) * size


Spoiler = Callable[[GoodLog], GoodLog | None]


def _turned(channel: str) -> Spoiler:
    return _changed(channel, lambda log: {channel: -log[channel]})


def _changed(channel: str, change: Callable[[po.Trajectory], dict[str, Array]]) -> Spoiler:
    """A log with some columns changed; None where it lacks the channel."""

    def spoil(log: GoodLog) -> GoodLog | None:
        run = log.experiment.trajectory
        return _replaced(log, change(run)) if channel in run else None

    return spoil


def _replaced(log: GoodLog, columns: dict[str, Array]) -> GoodLog:
    return replace(log, experiment=replace(log.experiment, trajectory=log.experiment.trajectory.with_columns(columns)))


def _off(log: GoodLog) -> GoodLog:
    """The first channel that pushes reads off by half the friction."""
    channel, area = next(iter(log.axis.forces.items()))
    return _replaced(log, {channel: log.experiment.trajectory[channel] + 0.5 * log.friction / area})


def _stopped(log: GoodLog) -> GoodLog:
    """A stop at four fifths of the way, at which the drive pushes with four times what it needs elsewhere."""
    run = log.experiment.trajectory
    x, (channel, area) = run["position"], next(iter(log.axis.forces.items()))
    end = float(x.min() + 0.8 * np.ptp(x))
    push = log.axis.net_force({n: run[n] for n in log.axis.forces})
    more = np.where(x > end, 4 * float(np.quantile(np.abs(push), 0.9)) - push, 0.0)
    noise = 1e-5 * np.random.default_rng(0).standard_normal(x.size)
    columns = {"position": np.minimum(x, end) + noise, channel: run[channel] + more / area}
    return _replaced(log, columns | ({"speed": np.where(x > end, 0.0, run["speed"])} if "speed" in run else {}))


def _jumped(log: GoodLog) -> GoodLog:
    run = log.experiment.trajectory
    begin = 0.5 * run.t[-1]
    return _replaced(log, {"position": run["position"] + 0.05 * ((run.t > begin) & (run.t < begin + 0.1))})


SPOILERS: dict[str, Spoiler] = {
    "wrong_force": _turned("force"),
    "wrong_command": _turned("valve_voltage"),
    "wrong_position": _changed("speed", lambda log: {"position": -log["position"]}),
    "exchanged": _changed("pressure_a", lambda log: {"pressure_a": log["pressure_b"], "pressure_b": log["pressure_a"]}),
    "thousandfold": _changed("speed", lambda log: {"speed": 1e3 * log["speed"]}),
    "mass": lambda log: replace(log, axis=log.axis._replace(inertia=3 * log.axis.inertia)),
    "offset": _off,
    "stops": _stopped,
    "jumps": _jumped,
}


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    options = parser.parse_args()
    sys.exit(finish(main(options.count, options.first), options))
