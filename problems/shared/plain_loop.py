"""A closed loop simulated by plain C, which shares no line with pneuopt: what a tuned design does, however long.

`plain_loop.c` holds the equations of the plants and of the controller, written once more from the references that the
models cite; here the parameters are handed over, the rest before the step is solved for, and the response is read.
Fixed steps of classical Runge-Kutta, so short that halving them changes nothing that is printed.
"""

import ctypes
import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import fsolve

import pneuopt as po
from problems.shared.arrays import Array

SOURCE = Path(__file__).with_name("plain_loop.c")
STRIBECK = ("coulomb", "static", "stribeck_velocity", "viscous", "smoothing")
LUGRE = (*STRIBECK[:4], "bristle_stiffness", "bristle_damping", "damping_velocity")
PLANT = ("gain", "natural_frequency", "damping")
CYLINDER = ("bore", "rod", "stroke", "dead_volume_a", "dead_volume_b")
VALVE = ("conductance", "critical_ratio", "dead_zone", "rounding", "leak", "span", "bandwidth", "damping")
AIR = ("supply.pressure", "ambient.pressure", "ambient.temperature", "gas.constant", "chamber.exponent")
NONLINEAR_STEP = 1e-5  # [s]: twice as much changes the fifth digit of settling times, half as much nothing
LINEAR_STEPS = 40_000  # steps over a horizon
KEPT_STROKE = 0.03  # share of the stroke at either end that counts as the cover: beyond it the plain model has no stop
STROKE, SPAN, SUPPLY, AMBIENT = 11, 19, 22, 23  # indices of the cylinder's parameters in the C code
SAMPLES = 2000  # recorded over a horizon, at least
SAMPLES_A_PERIOD = 40  # recorded in a dither period, at least


@dataclass(frozen=True, eq=False)
class Kind:
    """Which plant of the C code stands for a loop's: its number, its parameters, its rest at a value so far."""

    number: int
    parameters: tuple[str, ...]
    rest: Callable[[Array, float, dict[str, float]], tuple[list[float], float]]
    extra: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class PlainResponse:
    """What the plain simulation gives: time [s], measured signal, command; `ended` where the stroke did first."""

    t: Array
    y: Array
    u: Array
    ended: bool


def simulate_plainly(
    kind: Kind, loop: po.ClosedLoop, parameters: po.ParameterSet, step: po.Step, horizons: float
) -> PlainResponse:
    """The response of a tuned loop over so many horizons; a piston that comes to its covers ends it.

    Parameters
    ----------
    kind : Kind
        `KINDS` has them by plant.
    loop, parameters : ClosedLoop, ParameterSet
        Only the parameters' numbers are taken, and which options the controller has.
    step : Step
        It begins at time 0.
    horizons : float
        How long to go on, in horizons of the step.
    """
    p = np.array([*(parameters.value(n) for n in kind.parameters), *kind.extra])
    position = loop.feedback.name == "position"
    x0, u0 = kind.rest(p, *((0.0, {"position": step.initial}) if position else (step.initial, dict(step.start))))
    c, sample = _controller(loop, parameters)
    h, every, per_sample = _grid(kind, step, c, sample, float(p[2]) if kind.number == 1 else 0.0)
    count = int(horizons * step.horizon / (h * every)) + 1
    t, y, u = (np.empty(count) for _ in range(3))
    stroke = p[STROKE] if kind.number == 5 else inf
    ends = (KEPT_STROKE * stroke, (1 - KEPT_STROKE) * stroke) if stroke < inf else (-inf, inf)
    pointers = [np.ascontiguousarray(a, dtype=float).ctypes.data_as(ctypes.c_void_p) for a in (p, c, x0)]
    outs = [a.ctypes.data_as(ctypes.c_void_p) for a in (t, y, u)]
    settings = [ctypes.c_double(v) for v in (step.initial, step.final)]
    sizes = [ctypes.c_long(v) for v in (count, every, per_sample)]
    n = _library().run_loop(
        kind.number,
        int(position),
        pointers[0],
        pointers[1],
        *settings,
        pointers[2],
        ctypes.c_double(u0),
        ctypes.c_double(h),
        *sizes,
        *(ctypes.c_double(v) for v in ends),
        *outs,
    )
    return PlainResponse(t[:n], y[:n], u[:n], n < count)


def _grid(kind: Kind, step: po.Step, c: Array, sample: float, late: float) -> tuple[float, int, int]:
    """Runge-Kutta step [s], steps a recorded sample and steps a sample of the controller."""
    h = NONLINEAR_STEP if kind.number >= 2 else step.horizon / LINEAR_STEPS
    if not sample:
        h = min(h, c[3] / 5)  # the derivative's filter
        h = late / np.ceil(late / h) if late else h  # a kick arrives at a step's end
    per_sample = int(np.ceil(sample / h - 1e-9)) if sample else 1
    h = sample / per_sample if sample else h
    spacing = step.horizon / SAMPLES
    if c[11] > 0:
        spacing = min(spacing, 1 / (SAMPLES_A_PERIOD * c[13]))
    return h, max(1, int(spacing / h)), per_sample


def _controller(loop: po.ClosedLoop, given: po.ParameterSet) -> tuple[Array, float]:
    """The controller's numbers in the order of the C code, and its sample time [s], 0 where it is continuous."""
    pid = loop.pid
    assert (pid.delay, pid.dead_band, loop.sensor, loop.feedforward) == (0, False, None, None)
    sample = pid.sample_time or 0.0
    limits = [given.value(f"pid.{n}") for n in ("lower", "upper")] if pid.limits else [-inf, inf]
    dither = (
        [given.value(f"dither.{n}") for n in ("amplitude", "offset", "frequency")] if loop.dither else [0.0, 0.0, 1.0]
    )
    gains = [given.value(f"pid.{n}") for n in ("Kp", "Ki", "Kd", "Tf", "b", "c")]
    usual = max(0.1, 10 * sample)
    Tt = given.value("pid.Tt") if pid.limits else usual
    Tt = Tt if given.value("pid.Ki") else min(Tt, 10 * usual)  # in which an integral empties that nothing fills
    analogue = float(loop.dither is not None and loop.dither.analogue)
    return np.array([*gains, *limits, float(pid.limits), Tt, sample, *dither, analogue]), sample


def _level(p: Array, v: float) -> float:
    """The Stribeck curve, from Coulomb and static friction and the Stribeck velocity."""
    return float(p[0] + (p[1] - p[0]) * np.exp(-((v / p[2]) ** 2)))


def _lag_rest(p: Array, y: float, _: dict[str, float]) -> tuple[list[float], float]:
    return [y, 0.0], y / p[0]


def _delay_rest(p: Array, y: float, _: dict[str, float]) -> tuple[list[float], float]:
    return [y], y / p[0]


def _sticking_lag_rest(p: Array, y: float, _: dict[str, float]) -> tuple[list[float], float]:
    friction = _level(p[3:], y) * np.tanh(y / p[7]) + p[6] * y
    return [y, p[0] * p[1] / (2 * p[2]) * friction], y / p[0] + friction


def _mass_rest(p: Array, v: float, start: dict[str, float]) -> tuple[list[float], float]:
    return [start.get("position", 0.0), v], p[1] + _level(p[2:], v) * np.tanh(v / p[6]) + p[5] * v


def _bristle(p: Array, v: float, stiffness: float) -> float:
    return float(v / np.sqrt(v * v + 1e-12)) * _level(p, v) / stiffness


def _bristle_mass_rest(p: Array, v: float, start: dict[str, float]) -> tuple[list[float], float]:
    z = _bristle(p[2:], v, p[6])
    return [start.get("position", 0.0), v, z], p[1] + p[6] * z + p[5] * v


def _cylinder_rest(p: Array, v: float, start: dict[str, float]) -> tuple[list[float], float]:
    """Spool and pressures at which the piston stands, or moves steadily: three equations for three unknowns."""
    x, z = start["position"], _bristle(p[2:], v, p[6])

    def residuals(unknown: Array) -> list[float]:
        state = np.array([x, v, unknown[1] * 1e5, unknown[2] * 1e5, unknown[0], 0.0, z])
        rates = np.zeros(7)
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (state, rates, p)]
        _library().plant_rates(5, pointers[0], ctypes.c_double(0.0), pointers[2], pointers[1])
        return [rates[1], rates[2] / 1e6, rates[3] / 1e6]

    for spool, pressure in itertools.product((0.05, 0.1, 0.2, 0.4), (4.0, 5.0, 6.0)):
        found, info, _, _ = fsolve(residuals, [spool * np.sign(v), pressure, pressure], full_output=True, xtol=1e-13)
        inside = p[AMBIENT] < 1e5 * min(found[1:]) and 1e5 * max(found[1:]) < p[SUPPLY]
        if inside and np.max(np.abs(info["fvec"])) <= 1e-8:
            return [x, v, found[1] * 1e5, found[2] * 1e5, found[0], 0.0, z], found[0] * p[SPAN]
    raise po.ConvergenceError(f"no steady motion found at {v:g} m/s", None)


@cache
def _library() -> Any:
    """The C code as a library; it is compiled once a process."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise po.InputError("the plain simulation needs a C compiler: install gcc or clang")
    built = Path(tempfile.mkdtemp(prefix="plain_loop")) / "plain_loop.so"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", str(built), str(SOURCE), "-lm"], check=True)
    library = ctypes.CDLL(str(built))
    library.run_loop.restype = ctypes.c_long
    return library


def _friction_names(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"friction.{n}" for n in names)


def _cylinder(smoothing: tuple[float, float, float], stops: tuple[float, float]) -> Kind:
    """A pneumatic drive: widths of its flow law, corner, zero [-], pressure [Pa]; its covers [N/m], [s/m]."""
    names = ("load.mass", "load.force", *_friction_names(LUGRE), *(f"cylinder.{n}" for n in CYLINDER))
    return Kind(5, (*names, *(f"valve.{n}" for n in VALVE), *AIR), _cylinder_rest, (*smoothing, *stops))


_CATALOGUE = _cylinder((0.02, 1e-3, 100.0), (1e6, 1.0))
KINDS = {
    "second_order": Kind(0, tuple(f"plant.{n}" for n in PLANT), _lag_rest),
    "dead_time": Kind(1, ("plant.gain", "plant.time_constant", "plant.dead_time"), _delay_rest),
    "friction_lag": Kind(2, (*(f"plant.{n}" for n in PLANT), *_friction_names(STRIBECK)), _sticking_lag_rest),
    "force_drive": Kind(3, ("load.mass", "load.force", *_friction_names(STRIBECK)), _mass_rest),
    "bristle_drive": Kind(4, ("load.mass", "load.force", *_friction_names(LUGRE)), _bristle_mass_rest),
    "s25": _CATALOGUE,
    "s32": _CATALOGUE,
    "s40": _CATALOGUE,
    "t32": _cylinder((1e-3, 0.005, 1.0), (0.0, 0.0)),
}
"""The plain plant for each kind of problem; a drive with bristles is "bristle_drive"."""


def plain_kind(kind: str, loop: po.ClosedLoop) -> Kind:
    """The plain plant for a problem's kind and loop."""
    if kind.startswith("force_drive") and "friction.bristle_stiffness" in loop.parameters:
        return KINDS["bristle_drive"]
    return KINDS[kind.removeprefix("sampled_").removesuffix("_position")]
