"""The drive B32 and its log, which many scripts identify: made tightly, made fast, and the cost of one simulation.

A 32/12 mm cylinder under a sampled position loop sticks, slips and moves fast both ways for 10 s at 1 kHz. `generate`
integrates it to 1e-10 and adds the noise; `exact` is the same without noise, in fine steps of machine code.
"""

import functools
import math
import os
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import integrate

import pneuopt as po
from pneuopt.dynamics.compiled.functions import compile_function
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from problems.shared.arrays import names, parameter_vector

if TYPE_CHECKING:
    import pandas as pd

Symbols = Mapping[str, ca.SX]
SEED = 1
LEVELS = (0.15, 0.05, 0.12, 0.04, 0.16, 0.10, 0.06, 0.14, 0.08, 0.10)  # [m] for 0.5 s each
NOISE = {"position": 20e-6, "pressure_a": 1e3, "pressure_b": 1e3, "speed": 2e-3}
LOGGED = ("valve_voltage", "position", "pressure_a", "pressure_b")
FREE = ("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")
VALVE = ("valve.conductance", "valve.leak")
SAMPLE, SETTLING, PERIOD = 1e-3, 300, 10.0  # [s], samples before the log, [s] of reference until it repeats
FINE, COARSE = 100, 10  # RK4 steps a sample: of an exact log, and of the simulation that is the unit of cost
GAINS = po.ParameterSet(
    {
        "loop.gain": po.Parameter(4.0, "V/m"),
        "loop.damping": po.Parameter(0.15, "V*s/m"),
        "loop.limit": po.Parameter(0.6, "V"),
    }
)
START = {"position": 0.1, "pressure_a": 3.5e5, "pressure_b": 4e5}


def generate(
    drive: po.PneumaticDrive, truth: po.ParameterSet, seed: int = SEED, seconds: float = 10.0
) -> po.Experiment:
    """The log at 1 kHz, after 0.3 s of settling that it leaves out."""
    samples = round(seconds / SAMPLE)
    run = integrate_loop(drive.system(), np.arange(-SETTLING, samples) * SAMPLE, truth, rtol=1e-10).rows(
        SETTLING, SETTLING + samples
    )
    rng = np.random.default_rng(seed)
    logged = {n: run[n] + sigma * rng.standard_normal(samples) for n, sigma in NOISE.items()}
    columns = {"valve_voltage": run["valve_voltage"], **logged}
    return po.Experiment(po.Trajectory(np.arange(samples) * SAMPLE, columns), NOISE, name="b32")


def integrate_loop(
    system: po.System, t: NDArray[np.floating[Any]], truth: po.ParameterSet, *, rtol: float = 1e-9, late: float = 0.0
) -> po.Trajectory:
    """Outputs under u = clip(4 e - 0.15 v, +-0.6), held over each sample; the position is read `late` [s]."""
    p, state, ode = parameter_vector(system.parameters, truth), names(system.states), compile_function(system.ode)
    u, scale = np.zeros(1), np.array([q.nominal for q in system.states])
    solver = integrate.ode(lambda s, x: ode(s, x, u, p)[0])
    tolerances: dict[str, Any] = {"rtol": rtol, "atol": 1e-2 * rtol * scale, "nsteps": 100_000}
    solver.set_integrator("lsoda", **tolerances)
    x, rows, commands, read = np.array([START.get(n, 0.0) for n in state]), [], [], []
    steps = np.append(np.diff(t), SAMPLE)
    held = [x[0]] * round(late / steps[0])
    for now, step in zip(t, steps, strict=True):
        u[0] = float(np.clip(4 * (reference(now) - x[0]) - 0.15 * x[1], -0.6, 0.6))
        rows.append(x)
        commands.append(u[0])
        held.append(x[0])
        read.append(held.pop(0))
        solver.set_initial_value(x, 0.0)
        x = solver.integrate(step)
    columns = dict(zip(state, np.array(rows).T, strict=True)) | {"position": np.array(read)}
    return po.Trajectory(t, {"valve_voltage": commands, **{n: columns[n] for n in NOISE}})


def reference(t: float) -> float:
    """Ten levels, then a triangle of 0.085 to 0.115 m with a period of 2.5 s [m]."""
    if t < 5.0:
        return LEVELS[max(0, int(t / 0.5 + 1e-9))]
    phase = ((t - 5.0) / 2.5) % 1.0
    return 0.1 + 0.015 * (1 - 4 * abs(((phase + 0.25) % 1.0) - 0.5))


def exact(truth: po.ParameterSet, lugre: bool = False, *, seconds: float = 10.0, substeps: int = FINE) -> po.Trajectory:
    """The log without noise, and with speed, in fine RK4 steps: as exact as `generate`, and far faster (a test)."""
    samples = round(seconds / SAMPLE)
    instants = np.arange(-SETTLING, samples) * SAMPLE
    given = np.array([reference(t % PERIOD if t > 0 else 0.0) for t in instants.tolist()])
    run = run_loop(truth, given, SAMPLE, START, lugre, substeps=substeps).rows(SETTLING, SETTLING + samples)
    return po.Trajectory(np.arange(samples) * SAMPLE, run.values)


def run_loop(
    truth: po.ParameterSet,
    wanted: NDArray[np.float64],
    sample: float,
    start: Mapping[str, float],
    lugre: bool = False,
    *,
    substeps: int = FINE,
) -> po.Trajectory:
    """Outputs of the sampled loop under a reference [m], in fine RK4 steps; `truth` may set the loop's gains."""
    loop, rollout = sampled_loop(lugre)
    instants = np.arange(len(wanted)) * sample
    begin = np.array([[start.get(n, 0.0) for n in names(loop.states)]])
    p, h = parameter_vector(loop.parameters, truth), np.full((1, len(wanted)), sample)
    run = rollout.run(begin, wanted[None, :, None], p, instants[None], h, substeps=substeps)
    return po.Trajectory(instants, dict(zip(names(loop.outputs), run.y[0].T.copy(), strict=True)))


@functools.cache
def sampled_loop(lugre: bool = False) -> tuple[po.System, Rollout]:
    """The drive with its command as a state, which the sampled loop sets at each instant."""
    drive = po.catalog.b32(lugre)[0].system()
    command, wanted = po.Quantity("valve_voltage", "V"), po.Quantity("position_reference", "m", nominal=0.1)

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        del u  # the reference moves only the command
        inside = ca.vertcat(*(x[n] for n in names(drive.states)))
        own = ca.vertcat(*(p[n] for n in drive.parameters))
        rates, y = drive.ode(t, inside, x["valve_voltage"], own)
        found = dict(zip(names(drive.states), ca.vertsplit(rates), strict=True))
        shown = dict(zip(names(drive.outputs), ca.vertsplit(y), strict=True))
        return {**found, "valve_voltage": ca.SX(0)}, {**shown, "valve_voltage": x["valve_voltage"]}

    states, outputs = (*drive.states, command), (*drive.outputs, command)
    loop = po.define(states, (wanted,), outputs, drive.parameters | GAINS, rhs)
    t, x, u, p = (ca.SX.sym(n, loop.ode.size1_in(i)) for i, n in enumerate("txup"))
    position, speed = (x[names(states).index(n)] for n in ("position", "speed"))
    gain, damping, limit = (p[list(loop.parameters).index(n)] for n in GAINS)
    u_next = ca.fmax(-limit, ca.fmin(limit, gain * (u - position) - damping * speed))
    update = ca.Function("update", [t, x, u, p], [ca.vertcat(x[:-1], u_next)])
    return loop, Rollout(Pieces(po.discretise(loop).step, update))


def completed(rows: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of a study that were identified before Ctrl-C; raises `InputError` if there is none."""
    if "converged" not in rows:
        raise po.InputError(f"nothing was identified: {rows['error'].iloc[0]}")
    return rows[rows["error"] != "interrupted"]


def simulation_seconds(log: po.Experiment, lugre: bool = False) -> float:
    """CPU seconds of one compiled scalar simulation of a record, the unit of cost."""
    drive, truth = po.catalog.b32(lugre)
    system, data = drive.system(), log.trajectory
    rollout = Rollout(po.discretise(system).pieces, threads=1, lanes=1 if os.environ.get("PNEUOPT_CC") != "" else 0)
    start = np.array([[data[n][0] if n in data else 0.0 for n in names(system.states)]])
    t, u = data.t[None], data["valve_voltage"][None, :, None]
    best = math.inf
    for _ in range(5):
        began = time.process_time()
        rollout.run(start, u, parameter_vector(system.parameters, truth), t, np.full_like(t, SAMPLE), substeps=COARSE)
        best = min(best, time.process_time() - began)
    return best
