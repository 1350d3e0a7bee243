"""Rigs that share nothing with pneuopt, as strangers log them: `plain_rigs.c` moves them, a drive.toml names them.

Drives and servos of every size. Friction is a smooth Stribeck curve whose width is drawn and stated nowhere, true
stiction, or bristles; a valve has sharp edges, a dead zone, and its centre or span as the maker wires it. Encoders have
their own ratio of counts, logs their own rate, unit and decimals. Some logs go one way, some hold a position only. What
a log leaves open stands in `Rig.confounded`: a fit that names it is right.

A seed is a rig. Even seeds are there to be looked at while something is developed, odd ones to be judged by.
"""

import csv
import ctypes
import functools
import math
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from problems.shared.arrays import Array

SOURCE = Path(__file__).with_name("plain_rigs.c")
SMOOTH, STICKING, LUGRE = range(3)  # kinds of friction, as in the C code
FORCE_DRIVE, CYLINDER = range(2)
FIELDS = (  # in the order of the C code
    *("kind", "friction"),
    *("mass", "load", "coulomb", "static", "stribeck", "viscous", "smoothing"),
    *("bristle", "bristle_damping", "damping_velocity"),
    *("area_a", "area_b", "stroke", "dead_a", "dead_b", "supply", "ambient", "temperature", "gas", "exponent"),
    *("conductance", "ratio", "dead_zone", "leak", "span", "corner", "order", "spool_damping"),
    *("gain", "damping", "limit", "sample", "step"),
)
AMBIENT, TEMPERATURE, GAS = 101325.0, 293.15, 287.05
STEP = {FORCE_DRIVE: 1e-5, CYLINDER: 5e-6}  # [s]
ENCODERS = {  # steps of position sensors as they are sold [m or rad]
    FORCE_DRIVE: (1e-5, 5e-6, 1e-6, 5e-3 / 8192, 1e-2 / 4096, 2e-3 / 1024),
    CYLINDER: (1e-5, 1e-6, 5e-6, 0.5 / 65536, 0.3 / 16384, 5e-3 / 8192),
}
TURN = (2 * math.pi / 4096, 2 * math.pi / 10000, 2 * math.pi / 65536, 2 * math.pi / 2**20)
VALVE = ("valve.conductance", "valve.dead_zone")
STRIBECK = ("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")


@dataclass(frozen=True)
class Rig:
    """A rig that was drawn: the numbers of the simulation, what is to be found, and what its log leaves open."""

    seed: int
    numbers: dict[str, float]
    truth: dict[str, float]
    motion: str
    rotary: bool
    samples: int
    encoder: float
    pressure_noise: float = 0.0
    centre: float = 0.0
    position_only: bool = True
    confounded: tuple[str, ...] = ()
    files: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What it is, in words."""
        kind = "cylinder" if self.numbers["kind"] == CYLINDER else "rotary" if self.rotary else "servo"
        friction = ("smooth", "sticking", "lugre")[int(self.numbers["friction"])]
        return f"{kind} {self.seed} {friction}, {self.motion}"


def write_rig(rig: Rig, folder: Path) -> tuple[Path, Path]:
    """Write a rig's drive.toml and log.csv into a folder, as its owner would."""
    drive, log = folder / "drive.toml", folder / "log.csv"
    drive.write_text(rig.files["drive.toml"], encoding="utf-8")
    if "log.toml" in rig.files:
        (folder / "log.toml").write_text(rig.files["log.toml"], encoding="utf-8")
    columns = record(rig)
    with log.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    return drive, log


def draw_servo(seed: int) -> Rig:
    """Draw a force or torque drive, linear or rotary."""
    rng = np.random.default_rng((seed, 38))
    rotary = bool(rng.random() < 0.35)
    speed = _log_uniform(rng, 5.0, 60.0) if rotary else _log_uniform(rng, 0.1, 1.5)
    mass = _log_uniform(rng, 3e-5, 3e-3) if rotary else _log_uniform(rng, 0.5, 40.0)
    rate = float(rng.choice([500.0, 1000.0, 2000.0]))
    seconds = _log_uniform(rng, 4.0, 12.0)
    coulomb = mass * speed * _log_uniform(rng, 1.5, 12.0)
    friction = int(rng.choice([SMOOTH, SMOOTH, STICKING, LUGRE]))
    numbers = _friction(rng, friction, coulomb, speed, mass)
    motion = str(rng.choice(["steps", "sines", "strokes", "one way"], p=[0.35, 0.3, 0.25, 0.1]))
    encoder = float(rng.choice(TURN if rotary else ENCODERS[FORCE_DRIVE]))
    bandwidth = _log_uniform(rng, 8.0, 25.0)
    load = coulomb * rng.uniform(-0.4, 0.4) if rng.random() < 0.6 else 0.0
    numbers |= {
        "kind": FORCE_DRIVE,
        "mass": mass,
        "load": load,
        "gain": mass * bandwidth**2 * 3,
        "damping": mass * bandwidth * 2,
        "limit": 3 * coulomb + mass * speed * 10,
        "sample": 1 / rate,
        "step": STEP[FORCE_DRIVE],
    }
    m, f = ("inertia", "torque") if rotary else ("mass", "force")
    truth = {f"load.{m}": mass, f"load.{f}": load} | _friction_truth(numbers)
    confounded = ("load.force", "load.torque", *STRIBECK) if motion == "one way" else ()
    name = {"lugre": LUGRE}
    text = _servo_toml(rng, truth, rotary, "lugre" if friction == name["lugre"] else "stribeck")
    rig = Rig(seed, numbers, truth, motion, rotary, round(seconds * rate), encoder, confounded=confounded)
    return Rig(**{**vars(rig), "files": {"drive.toml": text, "log.toml": f'[intersample]\n{f} = "held"\n'}})


def draw_cylinder(seed: int) -> Rig:
    """Draw a cylinder with a proportional valve."""
    rng = np.random.default_rng((seed, 39))
    bore = float(rng.choice([0.016, 0.02, 0.025, 0.032, 0.04, 0.05, 0.063, 0.08, 0.1]))
    rod, stroke = bore * rng.uniform(0.28, 0.45), _log_uniform(rng, 0.08, 0.5)
    area = math.pi / 4 * bore**2
    supply = rng.uniform(5e5, 9e5)
    mass = 3.75e5 * 4.8 * area / stroke / (2 * math.pi * _log_uniform(rng, 2.5, 12.0)) ** 2
    coulomb = supply * area * _log_uniform(rng, 0.02, 0.09)
    friction = int(rng.choice([SMOOTH, SMOOTH, STICKING, LUGRE]))
    rate = float(rng.choice([200.0, 500.0, 1000.0, 2000.0]))
    seconds = _log_uniform(rng, 5.0, 14.0)
    speed = _log_uniform(rng, 0.1, 0.6)
    numbers = _friction(rng, friction, coulomb, speed, mass)
    conductance = speed * 4e5 * area / supply / 1e5 * rng.uniform(1.2, 3.0)
    span = float(rng.choice([5.0, 5.0, 10.0]))
    centre = 5.0 + rng.uniform(-0.15, 0.15) if span == 5.0 and rng.random() < 0.5 else 0.0
    order = int(rng.choice([0, 1, 2]))
    motion = str(rng.choice(["steps", "sines", "strokes", "one way"], p=[0.4, 0.25, 0.25, 0.1]))
    by_volt = conductance * supply * 1e5 / (3.75e5 * area) / span  # [m/s/V]
    gain = rng.uniform(2.0, 7.0) / by_volt
    numbers |= {
        "kind": CYLINDER,
        "mass": mass,
        "load": mass * 9.80665 * 0.0,
        "area_a": area,
        "area_b": area - math.pi / 4 * rod**2,
        "stroke": stroke,
        "dead_a": area * stroke * rng.uniform(0.04, 0.2),
        "dead_b": area * stroke * rng.uniform(0.04, 0.2),
        "supply": supply,
        "ambient": AMBIENT,
        "temperature": TEMPERATURE,
        "gas": GAS,
        "exponent": float(rng.choice([1.0, 1.2, 1.4])),
        "conductance": conductance,
        "ratio": float(rng.choice([0.25, 0.3, 0.4])),
        "dead_zone": float(rng.choice([0.0, 0.02, 0.05, 0.08])),
        "leak": 0.0 if rng.random() < 0.5 else rng.uniform(0.003, 0.02),
        "span": span,
        "corner": 2 * math.pi * _log_uniform(rng, 30.0, 150.0),
        "order": order,
        "spool_damping": 0.7,
        "gain": gain,
        "damping": 0.02 * gain,
        "limit": span * rng.uniform(0.5, 1.0),
        "sample": 1 / rate,
        "step": STEP[CYLINDER],
    }
    free_mass = bool(rng.random() < 0.4)
    truth = {"valve.conductance": conductance, "valve.dead_zone": numbers["dead_zone"]}
    truth |= _friction_truth(numbers) | ({"load.mass": mass} if free_mass else {})
    position_only = bool(rng.random() < 0.15)
    confounded = ("valve.dead_zone", *STRIBECK, "load.mass") if motion == "one way" else ()
    encoder, noise = float(rng.choice(ENCODERS[CYLINDER])), _log_uniform(rng, 200.0, 1500.0)
    rig = Rig(seed, numbers, truth, motion, False, round(seconds * rate), encoder, noise, centre, position_only)
    text = _cylinder_toml(rng, rig, bore, rod)
    return Rig(**{**vars(rig), "files": {"drive.toml": text}, "confounded": confounded})


def _friction(rng: np.random.Generator, kind: int, coulomb: float, speed: float, mass: float) -> dict[str, float]:
    """Numbers of a friction law; the width of a smooth one, or the bristles' stiffness, is drawn, too."""
    static = coulomb * rng.uniform(1.1, 2.0)
    width = speed * _log_uniform(rng, 3e-4, 6e-3)
    bristle = static / (speed * _log_uniform(rng, 2e-4, 2e-3))
    return {
        "friction": kind,
        "coulomb": coulomb,
        "static": static,
        "stribeck": speed * _log_uniform(rng, 0.015, 0.08),
        "viscous": coulomb / speed * _log_uniform(rng, 0.15, 1.2),
        "smoothing": width,
        "bristle": bristle,
        "bristle_damping": min(9e3, 2 * rng.uniform(0.2, 0.6) * math.sqrt(bristle * mass)),
        "damping_velocity": 0.05 if speed < 2 else 2.0,
    }


def _friction_truth(numbers: dict[str, float]) -> dict[str, float]:
    shown = dict(zip(STRIBECK, (numbers[n] for n in ("coulomb", "static", "stribeck", "viscous")), strict=True))
    if numbers["friction"] == LUGRE:
        shown |= {
            "friction.bristle_stiffness": numbers["bristle"],
            "friction.bristle_damping": numbers["bristle_damping"],
        }
    return shown


def record(rig: Rig) -> dict[str, list[str]]:
    """The columns of a rig's log as text, header to cells."""
    rng = np.random.default_rng((rig.seed, 40))
    run = simulate(rig, wanted(rig, rng))
    t = np.arange(len(run)) * rig.numbers["sample"]
    counted = np.round(run[:, 0] / rig.encoder) * rig.encoder
    decimals = int(rng.choice([6, 9, 15]))
    if rig.numbers["kind"] == FORCE_DRIVE:
        effort, motion = ("torque [N*m]", "angle [rad]") if rig.rotary else ("force [N]", "position [m]")
        columns = {effort: [f"{v:.9g}" for v in run[:, 4]], motion: [f"{v:.{decimals}g}" for v in counted]}
    else:
        columns = {"valve_voltage [V]": [f"{v:.5f}" for v in run[:, 4] + rig.centre]}
        columns["position [mm]"] = [f"{1e3 * v:.{decimals}g}" for v in counted]
        for side, k in () if rig.position_only else (("a", 2), ("b", 3)):
            noisy = run[:, k] + rig.pressure_noise * rng.standard_normal(len(run))
            columns[f"pressure_{side} [bar(a)]"] = [f"{v:.5f}" for v in noisy * 1e-5]
    return {"time [s]": [f"{v:.6f}" for v in t]} | columns


def wanted(rig: Rig, rng: np.random.Generator) -> Array:
    """The reference of the rig's position loop at each sample [m or rad]."""
    q, t = rig.numbers, np.arange(rig.samples) * rig.numbers["sample"]
    is_cylinder = q["kind"] == CYLINDER
    speed = q["stribeck"] / 0.035  # about the size of its fast motion
    reach = 0.3 * q["stroke"] if is_cylinder else speed * rng.uniform(0.3, 1.0)
    middle = 0.5 * q["stroke"] if is_cylinder else 0.0
    if rig.motion == "sines":
        base = rng.uniform(0.15, 0.4)
        waves = sum(np.sin(2 * math.pi * base * k * t + rng.uniform(0, 2 * math.pi)) / k for k in (1.0, 2.3, 4.1))
        return np.asarray(middle + reach * waves / 1.8)
    count = round(3 + t[-1] / 0.4)
    knots = np.cumsum(rng.uniform(0.25, 1.1, count))
    levels = middle + reach * rng.uniform(-1, 1, count)
    if rig.motion == "one way":
        levels = middle - reach + 2 * reach * np.linspace(0, 1, np.searchsorted(knots, t[-1]) + 1)
        levels = np.concatenate([levels, np.full(count, levels[-1])])[:count]
    if rig.motion == "strokes":
        return np.asarray(np.interp(t, np.concatenate([[0.0], knots]), np.concatenate([[middle], levels])))
    return np.asarray(
        np.concatenate([[middle if rig.motion != "one way" else levels[0]], levels])[np.searchsorted(knots, t)]
    )


def simulate(rig: Rig, references: Array) -> Array:
    """Rows of position, speed, both pressures and the command, after half a second of rest."""
    q = rig.numbers
    settling = round(0.5 / q["sample"])
    given = np.ascontiguousarray(np.concatenate([np.full(settling, references[0]), references]))
    numbers = np.array([float(q.get(n, 0.0)) for n in FIELDS])
    start, out = np.zeros(7), np.zeros((len(given), 5))
    start[0] = references[0]
    if q["kind"] == CYLINDER:
        start[2] = 0.6 * q["supply"]
        start[3] = AMBIENT + (start[2] - AMBIENT) * q["area_a"] / q["area_b"]
    for _ in range(12):
        pointer = ctypes.POINTER(ctypes.c_double)
        rows = _library().simulate(
            *(a.ctypes.data_as(pointer) for a in (numbers, start)),
            len(given),
            *(a.ctypes.data_as(pointer) for a in (given, out)),
        )
        if rows == len(given):
            return out[settling:]
        given[:] = given[0] + 0.8 * (given - given[0])  # the piston came to a cover: less of the stroke
    raise RuntimeError(f"{rig.name}: the piston comes to its covers")


@functools.cache
def _library() -> ctypes.CDLL:
    """The compiled simulation."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("foreign rigs are moved by a C program: install a C compiler, cc or gcc")
    target = Path(tempfile.mkdtemp()) / "plain_rigs.so"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", str(SOURCE), "-o", str(target), "-lm"], check=True)
    return ctypes.CDLL(str(target))


def _servo_toml(rng: np.random.Generator, truth: dict[str, float], rotary: bool, law: str) -> str:
    m, f = ("inertia", "torque") if rotary else ("mass", "force")
    units = ("kg*m^2", "N*m", "rad") if rotary else ("kg", "N", "m")
    guess = functools.partial(_guess, rng)
    lines = [
        "[drive]",
        f'kind = "{"rotary" if rotary else "force"}"',
        "[load]",
        f'{m} = {{ value = "{guess(truth[f"load.{m}"])} {units[0]}", free = true }}',
        f'{f} = {{ value = "0 {units[1]}", free = true }}',
        *_friction_lines(guess, truth, law, units[1], units[2]),
    ]
    return "\n".join(lines) + "\n"


def _cylinder_toml(rng: np.random.Generator, rig: Rig, bore: float, rod: float) -> str:
    q, truth, guess = rig.numbers, rig.truth, functools.partial(_guess, rng)
    mass = f'{{ value = "{guess(q["mass"])} kg", free = true }}' if "load.mass" in truth else f'"{q["mass"]:.7g} kg"'
    spool = ("rigid", "first_order", "second_order")[int(q["order"])]
    lag = [f'bandwidth = "{q["corner"] / 2 / math.pi:.7g} Hz"'] if q["order"] else []
    lag += ["damping = 0.7"] if q["order"] == 2 else []
    law = "lugre" if q["friction"] == LUGRE else "stribeck"
    lines = [
        "[drive]",
        'kind = "pneumatic"',
        "[cylinder]",
        f'bore = "{1e3 * bore:.7g} mm"',
        f'rod = "{1e3 * rod:.7g} mm"',
        f'stroke = "{1e3 * q["stroke"]:.8g} mm"',
        f'dead_volume_a = "{1e6 * q["dead_a"]:.7g} cm^3"',
        f'dead_volume_b = "{1e6 * q["dead_b"]:.7g} cm^3"',
        "[valve]",
        f'conductance = {{ value = "{guess(q["conductance"])} m^3/(s*Pa)", free = true }}',
        f"critical_ratio = {q['ratio']}",
        "dead_zone = { value = 0, free = true }",
        f"leak = {q['leak']:.7g}",
        f'spool = "{spool}"',
        f'span = "{q["span"]:g} V"',
        *lag,
        "[supply]",
        f'pressure = "{1e-5 * q["supply"]:.8g} bar(a)"',
        "[chamber]",
        f"exponent = {q['exponent']}",
        "[load]",
        f"mass = {mass}",
        'force = "0 N"',
        *_friction_lines(guess, truth, law, "N", "m"),
    ]
    return "\n".join(lines) + "\n"


def _friction_lines(
    guess: "functools.partial[str]", truth: dict[str, float], law: str, effort: str, way: str
) -> list[str]:
    units = {
        "coulomb": effort,
        "static": effort,
        "stribeck_velocity": f"{way}/s",
        "viscous": f"{effort}*s/{way}",
        "bristle_stiffness": f"{effort}/{way}",
        "bristle_damping": f"{effort}*s/{way}",
    }
    known = {n: truth[f"friction.{n}"] for n in units if f"friction.{n}" in truth}
    free = [f'{n} = {{ value = "{guess(v)} {units[n]}", free = true }}' for n, v in known.items()]
    extra = [f'damping_velocity = "{0.05 if way == "m" else 2.0} {way}/s"'] if law == "lugre" else []
    return ["[friction]", f'model = "{law}"', *free, *extra]


def _guess(rng: np.random.Generator, true: float) -> str:
    """What an owner would write: within a factor of two."""
    return f"{true * 2 ** rng.uniform(-1, 1):.3g}"


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())
