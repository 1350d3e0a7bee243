"""NUMERICS' benchmark log B32, made and identified: six parameters of a pneumatic drive, without a guess; then LuGre.

    python problems/b32.py [--json FILE] [--out DIR]

A 32/12 mm cylinder under a sampled position loop sticks, slips and moves fast both ways for 10 s at 1 kHz. The truth
is integrated to 1e-10; position (20 um noise) and both pressures (1 kPa noise) are used. Free: Coulomb and static
friction, Stribeck velocity, viscous friction, conductance and leak of the valve, started from the log alone. What
fewer channels still tell: b32_partial.py.
"""

import functools
import math
import os
import sys
import time
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from claims import Claim, arguments, finish, frame
from scipy import integrate

import pneuopt as po
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout, compile_function
from pneuopt.dynamics.system import Symbols, System, define, discretise, names, parameter_vector, stack
from pneuopt.models.catalog import b32
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.parameters import Quantity

if TYPE_CHECKING:
    import pandas as pd

SEED = 1
LEVELS = (0.15, 0.05, 0.12, 0.04, 0.16, 0.10, 0.06, 0.14, 0.08, 0.10)  # [m] for 0.5 s each
NOISE = {"position": 20e-6, "pressure_a": 1e3, "pressure_b": 1e3, "speed": 2e-3}
LOGGED = ("valve_voltage", "position", "pressure_a", "pressure_b")
FREE = ("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")
VALVE = ("valve.conductance", "valve.leak")
SAMPLE, SETTLING, PERIOD = 1e-3, 300, 10.0  # [s], samples before the log, [s] of reference until it repeats
FINE, COARSE = 100, 10  # RK4 steps a sample: of an exact log, and of the simulation that is the unit of cost
START = {"position": 0.1, "pressure_a": 3.5e5, "pressure_b": 4e5}


def main() -> "pd.DataFrame":
    drive, truth = b32()
    claims = _identified("stribeck", drive, truth, (*FREE, *VALVE))
    drive, truth = b32(lugre=True)
    bristles = ("friction.bristle_stiffness", "friction.bristle_damping")
    return frame(claims + _identified("lugre", drive, truth, (*FREE, *bristles, *VALVE)))


def _identified(name: str, drive: PneumaticDrive, truth: po.ParameterSet, free: tuple[str, ...]) -> list[Claim]:
    log = generate(drive, truth).select(LOGGED)
    blind = truth.with_values({n: drive.parameters.value(n) for n in free}).freed(*free)
    began = time.perf_counter()
    fit = po.identify(drive.system(), [log], blind)
    seconds = time.perf_counter() - began
    claims = [Claim(f"{name}.seconds", seconds, "s"), Claim(f"{name}.iterations", fit.stats["iterations"])]
    for n, row in fit.estimates.iterrows():
        true = truth.value(str(n))
        inside = abs(row["value"] - true) / ((row["ci_high"] - row["ci_low"]) / 2)
        claims.append(Claim(f"{name}.{n}", row["value"], row["unit"], true, f"{true:g} +- {0.01 * true:.6g}"))
        claims.append(Claim(f"{name}.{n}.off", inside, "1", None, "<= 1" if name == "stribeck" else ""))
    return claims


def generate(drive: PneumaticDrive, truth: po.ParameterSet, seed: int = SEED, seconds: float = 10.0) -> po.Experiment:
    """The log, at 1 kHz after 0.3 s of settling, with u = clip(4 e - 0.15 v, +-0.6) held over each sample."""
    system, h, samples = drive.system(), 1e-3, round(1000 * seconds)
    p, state = parameter_vector(system.parameters, truth), names(system.states)
    ode = compile_function(system.ode)
    u = np.zeros(1)
    solver = integrate.ode(lambda t, x: ode(t, x, u, p)[0])
    scale = np.array([q.nominal for q in system.states])
    tolerances: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12 * scale, "nsteps": 100_000}
    solver.set_integrator("lsoda", **tolerances)
    x = np.array([START.get(n, 0.0) for n in state])
    rows, commands = [], []
    for k in range(-300, samples):
        u[0] = float(np.clip(4 * (reference(k * h) - x[0]) - 0.15 * x[1], -0.6, 0.6))
        rows.append(x)
        commands.append(u[0])
        solver.set_initial_value(x, 0.0)
        x = solver.integrate(h)
    columns = dict(zip(state, np.array(rows[300:]).T, strict=True))
    rng = np.random.default_rng(seed)
    logged = {n: columns[n] + sigma * rng.standard_normal(samples) for n, sigma in NOISE.items()}
    t = np.arange(samples) * h
    return po.Experiment(po.Trajectory(t, {"valve_voltage": commands[300:], **logged}), NOISE, name="b32")


def reference(t: float) -> float:
    """Ten levels, then a triangle of 0.085 to 0.115 m with a period of 2.5 s [m]."""
    if t < 5.0:
        return LEVELS[max(0, int(t / 0.5 + 1e-9))]
    phase = ((t - 5.0) / 2.5) % 1.0
    return 0.1 + 0.015 * (1 - 4 * abs(((phase + 0.25) % 1.0) - 0.5))


def exact(truth: po.ParameterSet, lugre: bool = False, *, seconds: float = 10.0, substeps: int = FINE) -> po.Trajectory:
    """The log without noise, and with speed, in fine RK4 steps: as exact as `generate`, and far faster (a test)."""
    loop, rollout = sampled_loop(lugre)
    samples = round(seconds / SAMPLE)
    instants = np.arange(-SETTLING, samples) * SAMPLE
    given = np.array([reference(t % PERIOD if t > 0 else 0.0) for t in instants.tolist()])[None, :, None]
    start = np.array([[START.get(n, 0.0) for n in names(loop.states)]])
    h = np.full((1, len(instants)), SAMPLE)
    run = rollout.run(start, given, parameter_vector(loop.parameters, truth), instants[None], h, substeps=substeps)
    columns = dict(zip(names(loop.outputs), run.y[0, SETTLING:].T.copy(), strict=True))
    return po.Trajectory(np.arange(samples) * SAMPLE, columns)


@functools.cache
def sampled_loop(lugre: bool = False) -> tuple[System, Rollout]:
    """The drive with its command as a state, which the sampled loop sets at each instant."""
    drive = b32(lugre)[0].system()
    command, wanted = Quantity("valve_voltage", "V"), Quantity("position_reference", "m", nominal=0.1)

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:  # noqa: ARG001 - a right-hand side's
        inside = ca.vertcat(*(x[n] for n in names(drive.states)))
        rates, y = drive.ode(t, inside, x["valve_voltage"], stack(p))
        found = dict(zip(names(drive.states), ca.vertsplit(rates), strict=True))
        shown = dict(zip(names(drive.outputs), ca.vertsplit(y), strict=True))
        return {**found, "valve_voltage": ca.SX(0)}, {**shown, "valve_voltage": x["valve_voltage"]}

    states, outputs = (*drive.states, command), (*drive.outputs, command)
    loop = define(states, (wanted,), outputs, drive.parameters, rhs)
    t, x, u, p = (ca.SX.sym(n, loop.ode.size1_in(i)) for i, n in enumerate("txup"))
    position, speed = (x[names(states).index(n)] for n in ("position", "speed"))
    u_next = ca.fmax(-0.6, ca.fmin(0.6, 4 * (u - position) - 0.15 * speed))
    update = ca.Function("update", [t, x, u, p], [ca.vertcat(x[:-1], u_next)])
    return loop, Rollout(Pieces(discretise(loop).step, update))


def simulation_seconds(log: po.Experiment, lugre: bool = False) -> float:
    """CPU seconds of one compiled scalar simulation of a record, the unit of cost."""
    drive, truth = b32(lugre)
    system, data = drive.system(), log.trajectory
    rollout = Rollout(discretise(system).pieces, threads=1, lanes=1 if os.environ.get("PNEUOPT_CC") != "" else 0)
    start = np.array([[data[n][0] if n in data else 0.0 for n in names(system.states)]])
    t, u = data.t[None], data["valve_voltage"][None, :, None]
    best = math.inf
    for _ in range(5):
        began = time.process_time()
        rollout.run(start, u, parameter_vector(system.parameters, truth), t, np.full_like(t, SAMPLE), substeps=COARSE)
        best = min(best, time.process_time() - began)
    return best


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(), options))
