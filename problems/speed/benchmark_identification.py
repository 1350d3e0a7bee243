"""What the identification of B32 costs: ours, what a user would write with SciPy, and our full-space IPOPT; one run.

    python problems/speed/benchmark_identification.py [--rival-seconds 200] [--longest 1000] [--json FILE] [--out DIR]

b32.py's log, six parameters, started from the log alone, on a warm cache and one core; CPU seconds. "x" is one
compiled scalar simulation of the record (10 RK4 steps a sample), timed in the same process. The rivals start from our
equation-error start: SciPy's least_squares around solve_ivp (LSODA), single shooting with a right-hand side in Python,
until its time is up: if `scipy.converged` is 0 by then, `scipy.over_ours` is a lower bound of what an answer costs; and
the full-space IPOPT on the log's first second, for the whole log is beyond it. Then the same
without a compiler, and the cost against the record's length: the same loop, its ten seconds of reference repeated.
"exact" is the same log without noise: what is left there is the method's own error, for noise alone moves the Stribeck
velocity by 0.14 % (one standard deviation) on this log.
"""

import json
import math
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import pneuopt as po
from pneuopt.dynamics.hooks import Log, Start
from pneuopt.identification.problem import EstimationProblem
from pneuopt.shooting.full_space import solve_full_space
from problems.shared.arrays import Array
from problems.shared.b32 import COARSE, FREE, LOGGED, NOISE, SAMPLE, VALVE, exact, generate, simulation_seconds
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

WANTED = (*FREE, *VALVE)
FINE = 50  # RK4 steps a sample of a long record
LENGTHS = (10, 100, 1000)  # [s] of log
SHORT = 1000  # samples for the full-space IPOPT
RIVAL_SECONDS, LONGEST = 200.0, 1000.0
ONE_CORE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main(rival_seconds: float = RIVAL_SECONDS, longest: float = LONGEST) -> "pd.DataFrame":
    ours = _part("ours")
    vm = _part("ours", PNEUOPT_CC="")
    rival, full = _part(f"rival {rival_seconds}"), _part(f"full {rival_seconds}")
    lengths = {n: _part(f"length {n}") for n in LENGTHS if n <= longest}
    claims = [
        Claim("unit", 1e3 * ours["unit"], "ms"),
        Claim("ours.seconds", ours["seconds"], "s"),
        Claim("ours.x", ours["seconds"] / ours["unit"], "x", None, "<= 15"),
        Claim("ours.iterations", ours["iterations"]),
        Claim("ours.error", ours["error"], "%"),
        Claim("ours.sigmas", ours["sigmas"], "1", None, "<= 4"),
        Claim("exact.error", ours["exact"], "%", None, "<= 0.1"),
        Claim("no_compiler.seconds", vm["seconds"], "s"),
        Claim("no_compiler.x", vm["seconds"] / ours["unit"], "x"),
        Claim("no_compiler.differs", vm["error"] - ours["error"], "%", None, "0 +- 0.01"),
        Claim("scipy.seconds", rival["seconds"], "s"),
        Claim("scipy.converged", rival["converged"]),
        Claim("scipy.error", rival["error"], "%"),
        Claim("scipy.over_ours", rival["seconds"] / ours["seconds"], "1", None, ">= 300"),
        Claim("full_space.seconds", full["seconds"], "s"),
        Claim("full_space.log", SHORT * SAMPLE, "s"),
        Claim("full_space.converged", full["converged"]),
        Claim("full_space.error", full["error"], "%"),
    ]
    first = lengths[LENGTHS[0]]
    for n, found in lengths.items():
        share = found["seconds"] / n / (first["seconds"] / LENGTHS[0])
        claims += [
            Claim(f"length_{n}.seconds", found["seconds"], "s"),
            Claim(f"length_{n}.per_sample", share, "1", None, "<= 1.2" if n != LENGTHS[0] else ""),
            Claim(f"length_{n}.memory", found["memory"], "GB", None, "<= 4"),
            Claim(f"length_{n}.error", found["error"], "%"),
        ]
    return frame(claims)


def _part(name: str, **environment: str) -> dict[str, float]:
    """One part in a process of its own, on one core: its memory is then its own, too."""
    command = [sys.executable, __file__, "--part", name]
    done = subprocess.run(
        command, env={**os.environ, **ONE_CORE, **environment}, check=True, stdout=subprocess.PIPE, text=True
    )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _run_part(name: str) -> dict[str, float]:
    kind, _, figure = name.partition(" ")
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    parts: dict[str, Callable[[], dict[str, float]]] = {
        "ours": ours,
        "rival": lambda: rival(float(figure)),
        "full": lambda: full_space(float(figure)),
        "length": lambda: length(float(figure)),
    }
    return parts[kind]()


def ours() -> dict[str, float]:
    """CPU seconds of the fastest of five (one in the VM), beside the unit; and how far the answer is off."""
    system, truth, blind = _blind()
    log = generate(*po.catalog.b32()).select(LOGGED)
    fit, seconds, unit = po.identify(system, [log], blind), math.inf, math.inf
    for _ in range(5 if os.environ.get("PNEUOPT_CC") != "" else 1):
        unit = min(unit, simulation_seconds(log))
        began = time.process_time()
        fit = po.identify(system, [log], blind)
        seconds = min(seconds, time.process_time() - began)
    value, stderr = (fit.estimates.loc[list(WANTED), c].to_numpy(dtype=float) for c in ("value", "stderr"))
    sigmas = np.abs(value - [truth.value(n) for n in WANTED]) / stderr
    noiseless = po.identify(system, [_record(10.0, noisy=False)], blind)
    return {
        "unit": unit,
        "seconds": seconds,
        "iterations": fit.stats["iterations"],
        "error": _off(fit.parameters, truth),
        "sigmas": float(sigmas.max()),
        "exact": _off(noiseless.parameters, truth),
    }


def length(seconds: float) -> dict[str, float]:
    """CPU seconds and peak memory of one identification from a record of this length."""
    system, truth, blind = _blind()
    po.identify(system, [_record(1.0)], blind, throw=False)
    log = _record(seconds)
    began = time.process_time()
    fit = po.identify(system, [log], blind)
    spent = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    return {"seconds": spent, "memory": peak, "error": _off(fit.parameters, truth)}


def rival(limit: float) -> dict[str, float]:
    """SciPy, as a user would write it: a right-hand side in Python, the record in one shot, finite differences."""
    _, truth, blind = _blind()
    log = generate(*po.catalog.b32()).select(LOGGED)
    data, u = log.trajectory, np.asarray(log.trajectory["valve_voltage"])
    channels = [n for n in LOGGED if n in NOISE]
    measured = np.column_stack([data[n] / NOISE[n] for n in channels])
    columns = [("valve", "position", "speed", "pressure_a", "pressure_b").index(n) for n in channels]
    x0 = [float(u[0]), float(data["position"][0]), 0.0, float(data["pressure_a"][0]), float(data["pressure_b"][0])]
    began, best = time.process_time(), (math.inf, np.zeros(len(WANTED)))

    def residuals(z: Array) -> Array:
        nonlocal best
        if time.process_time() - began > limit:
            raise TimeoutError
        rate = partial(_rate, u=u, p=np.exp(z).tolist())
        settings: Any = {"method": "LSODA", "t_eval": data.t, "rtol": 1e-6, "atol": 1e-8, "max_step": SAMPLE}
        run = solve_ivp(rate, (0.0, float(data.t[-1])), x0, **settings)
        off = (run.y[columns].T / np.array([NOISE[n] for n in channels]) - measured).ravel()
        best = min(best, (float(off @ off), z), key=lambda pair: pair[0])
        return np.asarray(off)

    start, converged = _start(log, blind), 1.0
    try:
        z0 = np.log([max(start.parameters[n], 1e-12) for n in WANTED])
        least_squares(residuals, z0, x_scale="jac", method="trf")
    except TimeoutError:
        converged = 0.0
    seconds = time.process_time() - began
    found = truth.with_values(dict(zip(WANTED, np.exp(best[1]).tolist(), strict=True)))
    return {"seconds": seconds, "converged": converged, "error": _off(found, truth)}


def _rate(t: float, x: Array, u: Array, p: list[float]) -> list[float]:
    """The equations of B32 (`catalog.b32`) by hand: spool, position, speed, pressures; p in the order of `WANTED`."""
    coulomb, static, stribeck, viscous, conductance, leak = p
    spool, s, v, a, b = x.tolist()
    area_a, area_b = math.pi / 4 * 0.032**2, math.pi / 4 * (0.032**2 - 0.012**2)
    supply, ambient, stroke, mass = 7e5, 1e5, 0.2, 5.0
    smooth = math.sqrt(spool * spool + 1e-4)
    fill, vent = 0.5 * (spool + smooth) + leak, 0.5 * (smooth - spool) + leak
    flow_a = _flow(conductance * fill, supply, a) - _flow(conductance * vent, a, ambient)
    flow_b = _flow(conductance * vent, supply, b) - _flow(conductance * fill, b, ambient)
    friction = (coulomb + (static - coulomb) * math.exp(-((v / stribeck) ** 2))) * math.tanh(v / 1e-3) + viscous * v
    gas, n = 287.0 * 293.15, 1.2
    return [
        (u[min(int(t / SAMPLE + 1e-9), len(u) - 1)] - spool) * 2 * math.pi * 50,
        v,
        (area_a * (a - ambient) - area_b * (b - ambient) - friction) / mass,
        n / (area_a * (s + 0.05 * stroke)) * (gas * flow_a - a * area_a * v),
        n / (area_b * (stroke - s + 0.05 * stroke)) * (gas * flow_b + b * area_b * v),
    ]


def _flow(conductance: float, upstream: float, downstream: float) -> float:
    """ISO 6358 with critical ratio 0.3, smooth about zero [kg/s]."""
    high = max(upstream, downstream)
    s = max(-1.0, min(1.0, (upstream - downstream) / (high * 0.7)))
    q = math.sqrt(s * s + 0.005**2)
    return conductance * 1.185 * high * s * math.sqrt(2 - q) / math.sqrt(q)


def full_space(limit: float) -> dict[str, float]:
    """Our IPOPT path on the first second of the log, from the same start."""
    system, truth, blind = _blind()
    whole = generate(*po.catalog.b32()).select(LOGGED)
    log = po.Experiment(whole.trajectory.rows(0, SHORT), whole.noise, name="b32")
    problem = EstimationProblem(system, (log,), system.parameters | blind, po.LeastSquares())
    posed = problem.transcription(_start(log, blind))
    transcription = type(posed)(posed.system.with_substeps(COARSE), posed.parameters, posed.phases, posed.residuals)
    began = time.process_time()
    found = solve_full_space(transcription, po.FullSpace(max_seconds=limit))
    seconds = time.process_time() - began
    return {
        "seconds": seconds,
        "converged": float(found.status.converged),
        "error": _off(found.parameters, truth),
    }


def _start(log: po.Experiment, blind: po.ParameterSet) -> Start:
    system = po.catalog.b32()[0].system()
    return system.starts({log.name: Log(log.trajectory, system.parameters | blind)})[0]


def _blind() -> tuple[Any, po.ParameterSet, po.ParameterSet]:
    drive, truth = po.catalog.b32()
    return drive.system(), truth, truth.with_values({n: drive.parameters.value(n) for n in WANTED}).freed(*WANTED)


def _off(found: po.ParameterSet, truth: po.ParameterSet) -> float:
    """The largest error of a parameter [%]."""
    return max(100 * abs(found.value(n) / truth.value(n) - 1) for n in WANTED)


def _record(seconds: float, *, noisy: bool = True) -> po.Experiment:
    """B32's log of any length."""
    true, noise = (
        exact(po.catalog.b32()[1], seconds=seconds, substeps=FINE),
        {n: NOISE[n] for n in LOGGED if n in NOISE},
    )
    rng = np.random.default_rng(1)
    logged = {n: true[n] + noisy * sigma * rng.standard_normal(len(true)) for n, sigma in noise.items()}
    return po.Experiment(true.select(LOGGED).with_columns(logged), noise, name="b32")


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--rival-seconds", type=float, default=RIVAL_SECONDS, help="CPU time that SciPy is given")
    parser.add_argument("--longest", type=float, default=LONGEST, metavar="SECONDS", help="of the logs by length")
    parser.add_argument("--part", help="one part alone, its figures as JSON")
    options = parser.parse_args()
    if options.part:
        print(json.dumps(_run_part(options.part)))
        sys.exit()
    sys.exit(finish(main(options.rival_seconds, options.longest), options))
