"""How fast a drive is simulated: CasADi's VM, machine code, SIMD lanes, and other solvers on the same record, one run.

    python problems/speed/simulation_speed.py [--json FILE] [--out DIR]

The B32 drive (5 states), 10 s at 1 kHz, 10 RK4 steps a sample, one core; with and without the 11 sensitivities that its
identification takes. The lanes run the record as 1000 segments of 10 ms, as multiple shooting does. scipy's solve_ivp
(on the same machine code as its right-hand side) and CasADi's cvodes (in its VM) run the first second, at a tolerance
that comes near to RK4's error, which is shown; their time is given by RK4 step as well. The claims are ratios: the
nanoseconds are the machine's.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import pneuopt as po
from pneuopt.dynamics.compiled.compiler import find_compiler
from pneuopt.dynamics.compiled.functions import compile_function
from pneuopt.dynamics.compiled.rollout import Rollout, RolloutResult
from pneuopt.quantities.errors import require
from problems.shared.arrays import Array, names, parameter_vector
from problems.shared.b32 import FREE, VALVE, generate
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

SAMPLE, SUBSTEPS, SEGMENT, FINE = 1e-3, 10, 10, 80
SHORT = 1000  # samples that the other solvers run
WAYS = {"vm": 0, "scalar": 1, "lanes": None}  # the lanes of a Rollout
TOLERANCES = {"LSODA": 2e-6, "RK45": 1e-7, "cvodes": 1e-7}


@dataclass(frozen=True, eq=False)
class Record:
    """The drive, the commands of its log, and its states at each sample, integrated with fine steps."""

    system: po.System
    numbers: Array
    commands: Array
    states: Array

    def error(self, states: Array) -> float:
        """The largest one along a run from the record's start, in nominal sizes of the states."""
        return float(np.max(np.abs(states - self.states[: len(states)]) / _nominal(self.system)))


def main() -> "pd.DataFrame":
    require(find_compiler() is not None, "no C compiler found, so there is nothing to compare; install gcc or clang")
    record = _record()
    lanes = Rollout(po.discretise(record.system).pieces).lanes
    claims = [Claim("lanes", lanes)]
    for name, sensitivities in (("simulation", False), ("sensitivities", True)):
        ns, difference = _rollouts(record, sensitivities)
        claims += [Claim(f"{name}.{way}", ns[way], "ns") for way in WAYS]
        claims.append(Claim(f"{name}.vm_over_scalar", ns["vm"] / ns["scalar"], "1", None, ">= 2"))
        held = f">= {0.7 * lanes:g}" if lanes > 1 else ""
        claims.append(Claim(f"{name}.scalar_over_lanes", ns["scalar"] / ns["lanes"], "1", None, held))
        claims.append(Claim(f"{name}.difference", difference, "1", None, "<= 1e-9"))
        if not sensitivities:
            others = _others(record, ns)
    error = record.error(_simulated(record.system, record.numbers, record.commands[:SHORT], record.states[0], SUBSTEPS))
    return frame([*claims, Claim("rk4.error", error, "1", None, "<= 1e-4"), *others])


def _record() -> Record:
    drive, truth = po.catalog.b32()
    system, numbers = drive.system(), parameter_vector(drive.system().parameters, truth)
    log = generate(drive, truth).trajectory
    start = np.array([log[n][0] if n in log else 0.0 for n in names(system.states)])
    commands = np.asarray(log["valve_voltage"])
    states = _simulated(system, numbers, commands, start, FINE)
    return Record(system, numbers, commands, states)


def _simulated(system: po.System, numbers: Array, commands: Array, start: Array, substeps: int) -> Array:
    """States at each sample, by RK4."""
    n = len(commands)
    t, h = np.arange(n)[None] * SAMPLE, np.full((1, n), SAMPLE)
    rollout = Rollout(po.discretise(system).pieces)
    x = rollout.run(start[None], commands[None, :, None], numbers, t, h, substeps=substeps, states=True).x
    assert x is not None
    return np.asarray(x[0])


def _rollouts(record: Record, sensitivities: bool) -> tuple[dict[str, float], float]:
    """Nanoseconds a step each way, and how far the answers differ, relative to the largest value."""
    parameters = list(record.system.parameters)
    wrt = [parameters.index(n) for n in (*FREE, *VALVE)] if sensitivities else []
    samples = len(record.commands)
    grid = (samples // SEGMENT, SEGMENT)
    t, h = (np.arange(samples) * SAMPLE).reshape(grid), np.full(grid, SAMPLE)
    given: Any = (record.states[::SEGMENT], record.commands.reshape(*grid, 1), record.numbers, t, h)
    ns, found = {}, {}
    for way, lanes in WAYS.items():
        rollout = Rollout(po.discretise(record.system).pieces, wrt, start=sensitivities, threads=1, lanes=lanes)
        run: Callable[[], RolloutResult] = partial(rollout.run, *given, substeps=SUBSTEPS)
        result = run()
        found[way] = result.dx_end if result.dx_end is not None else result.x_end
        ns[way] = 1e9 * _fastest(run, 2 if way == "vm" else 7) / (samples * SUBSTEPS)
    size = np.abs(found["vm"]).max(axis=0)
    size[size == 0] = 1.0
    return ns, max(float(np.max(np.abs(found[way] - found["vm"]) / size)) for way in ("scalar", "lanes"))


def _others(record: Record, ns: dict[str, float]) -> list[Claim]:
    """solve_ivp and cvodes on the record's first second."""
    ways = {method: partial(_scipy, record, method) for method in ("LSODA", "RK45")} | {"cvodes": _cvodes(record)}
    claims = []
    for name, way in ways.items():
        each = 1e9 * _fastest(way, 2) / (SHORT * SUBSTEPS)
        bound = ">= 5" if name == "cvodes" else ">= 30"
        claims += [
            Claim(f"{name}.error", record.error(way())),
            Claim(f"{name}.simulation", each, "ns"),
            Claim(f"{name}.over_scalar", each / ns["scalar"], "1", None, bound),
            Claim(f"{name}.over_lanes", each / ns["lanes"]),
        ]
    return claims


def _scipy(record: Record, method: Any) -> Array:
    ode, u, numbers = compile_function(record.system.ode), record.commands[:SHORT], record.numbers

    def rate(t: float, x: Array) -> Array:
        return ode(t, x, u[min(int(t / SAMPLE + 1e-9), SHORT - 1)], numbers)[0]

    rtol, instants = TOLERANCES[method], np.arange(SHORT) * SAMPLE
    # without a largest step it would step over commands
    settings: Any = {"rtol": rtol, "atol": 1e-2 * rtol * _nominal(record.system), "max_step": SAMPLE}
    found = solve_ivp(rate, (0.0, instants[-1]), record.states[0], method=method, t_eval=instants, **settings)
    return np.asarray(found.y.T)


def _cvodes(record: Record) -> Callable[[], Array]:
    """A run sample by sample, states in nominal sizes; cvodes has one absolute tolerance for all."""
    nominal, u, t = _nominal(record.system), ca.SX.sym("u"), ca.SX.sym("t")
    z = ca.SX.sym("z", len(nominal))
    rate = record.system.ode(t, z * nominal, u, record.numbers)[0] / nominal
    options: Any = {"reltol": TOLERANCES["cvodes"], "abstol": 1e-2 * TOLERANCES["cvodes"]}
    sample = ca.integrator("sample", "cvodes", {"t": t, "x": z, "p": u, "ode": rate}, 0.0, SAMPLE, options)
    z0, command = ca.MX.sym("z0", len(nominal)), ca.MX.sym("command")
    run = ca.Function("one", [z0, command], [sample(x0=z0, p=command)["xf"]]).mapaccum(SHORT - 1)
    start = record.states[0] / nominal

    def states() -> Array:
        return np.vstack([start, np.array(run(start, record.commands[None, : SHORT - 1])).T]) * nominal

    return states


def _nominal(system: po.System) -> Array:
    return np.array([q.nominal for q in system.states])


def _fastest(run: Callable[[], object], times: int) -> float:
    """CPU seconds of the fastest of several runs."""
    found = []
    for _ in range(times):
        began = time.process_time()
        run()
        found.append(time.process_time() - began)
    return min(found)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(), options))
