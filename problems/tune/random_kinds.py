"""Ten random tuning problems of each of nine kinds: is each design that `tune` hands out what it claims?

    python problems/tune/random_kinds.py [--count N] [--first SEED] [--jobs J] [--resume] [--json FILE] [--out DIR]

Beside the drives and lags of random_tuning.py: "dead_time" (a lag with dead time), "integrator" (with dead time),
"light_damping" (a second-order plant with damping 0.05 to 0.3), "load" (a volt at the input of a lag with dead time),
"sampled_delay" (a second-order plant, its controller sampled and a sample late), "position" (a position loop on a drive
with friction), "dither" (a speed loop with friction and dither), "unstable" (a plant with a pole on the right, behind a
lag) and "crawl" (a mass with friction at 5 to 30 mm/s, where friction falls with speed). The settling time, the IAE or
the ITAE is least, with a limit on overshoot, or the load's peak, and on Ms.

Each design is simulated over five horizons by code that shares no line with pneuopt: linear loops by the matrix
exponential (plain_linear.py), drives by plain C (plain_loop.c). Rows *.violations: the designs that break a limit,
grow, or leave the settling band after their certified settling time. Rows *.refused_wrongly: the refusals for which a
brute-force search finds a design. The whole study is --count 90.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.evaluation.specification import Specification, specify
from problems.shared.arrays import Array
from problems.shared.claims import Claim, finish, frame
from problems.shared.plain_linear import PlainPlant, respond_plainly
from problems.shared.random_problems import Plant, force_drive, friction_lag
from problems.shared.rows import row_arguments, study_rows
from problems.tune.random_designs import check_design, draw_plant, draw_steps, is_feasible

if TYPE_CHECKING:
    import pandas as pd

COUNT = 9
HORIZONS = 5
BAND, SLACK, LATE = 0.02, 2e-3, 4e-3  # the band; what samples blur of a step, and of the horizon
OVERSHOOT, SENSITIVITY, PEAK = 0.2, 2.0, 0.9  # limits; a load's peak is a fraction of what it does without a controller


@dataclass(frozen=True, eq=False)
class Problem:
    """What `tune` is given; `plain` is the transfer function of a linear plant, None of others."""

    kind: str
    plant: Plant
    steps: list[po.Step]
    spec: Specification
    plain: PlainPlant | None = None


def main(rows: "pd.DataFrame") -> "pd.DataFrame":
    claims = []
    for kind, part in rows.groupby("kind", sort=False):
        solved = part[part["outcome"] == "solved"]
        claims += [
            Claim(f"{kind}.problems", len(part)),
            Claim(f"{kind}.solved", len(solved)),
            Claim(f"{kind}.violations", int(solved["violations"].sum()), "1", None, "<= 0"),
            Claim(f"{kind}.refused_wrongly", int(part["feasible"].sum()), "1", None, "<= 0"),
            Claim(f"{kind}.deviation", float(solved["deviation"].max()), "1", None, f"<= {LATE:g}"),
            Claim(f"{kind}.cpu", float(part["cpu"].median()), "s"),
        ]
    return frame(claims)


def row_of(seed: int) -> dict[str, Any]:
    """The row of one problem."""
    rng = np.random.default_rng((seed, 34))
    given = KINDS[list(KINDS)[seed % len(KINDS)]](rng)
    plant, begun = given.plant, time.process_time()
    found = po.tune(plant.loop, given.steps, plant.parameters, minimise=given.spec, plants={}, throw=False)
    outcome = "solved" if found.status.converged else "refused"
    row: dict[str, Any] = {"seed": seed, "kind": given.kind, "outcome": outcome, "status": str(found.status)}
    row |= {"objective": " ".join(type(q).__name__ for q in given.spec.weights), "cpu": time.process_time() - begun}
    row |= {"violations": 0, "deviation": np.nan, "feasible": 0, "reasons": ""}
    if outcome == "refused":
        return row | {"feasible": int(is_feasible(plant, given.steps, given.spec, rng))}
    if given.plain is not None:
        return row | check_linear(given, given.plain, found)
    checked = check_design(plain_name(given), plant.loop, given.steps, found, given.spec)
    return row | {n: checked[n] for n in ("violations", "deviation", "reasons")}


def plain_name(given: Problem) -> str:
    """The plain C's name of a drive's kind."""
    return {"position": "force_drive_position", "crawl": "force_drive"}.get(given.kind, "friction_lag")


def check_linear(given: Problem, plain: PlainPlant, found: po.TuningResult) -> dict[str, Any]:
    """What the matrix exponential finds wrong with a design."""
    (step,), pid = given.steps, given.plant.loop.pid
    gains = {n: found.parameters.value(f"pid.{n}") for n in ("Kp", "Ki", "Kd", "Tf", "b", "c")}
    load = step.disturbance.get("valve_voltage", 0.0)
    t, y = respond_plainly(
        plain, gains, step.final, load, (step.horizon, HORIZONS), (pid.sample_time or 0.0, pid.delay)
    )
    settled = float(found.certified[step.label]["SettlingTime"])
    reasons, deviation = find_faults(t, (y - step.final) / step.nominal_size, step, settled)
    return {"violations": int(bool(reasons)), "deviation": deviation, "reasons": "; ".join(reasons)}


def find_faults(t: Array, error: Array, step: po.Step, settled: float) -> tuple[list[str], float]:
    """The faults of one response, and by how much its settling time differs from the certified, over the horizon."""
    wrong, first = list[str](), t <= step.horizon
    outside = t[np.abs(error) > BAND + SLACK]
    late = outside[-1] if len(outside) else 0.0
    latest = settled if np.isfinite(settled) else 4 * step.horizon
    if late > latest + LATE * step.horizon:
        wrong.append(f"leaves the band at {late:.4g} s, certified {settled:.4g} s")
    if np.abs(error[t > (HORIZONS - 1) * step.horizon]).max() > BAND + SLACK:
        wrong.append("does not stay at the reference")
    peak = float((error if step.changes else np.abs(error))[first].max())
    if peak > (OVERSHOOT if step.changes else PEAK) + SLACK:
        wrong.append(f"peak {100 * peak:.3g} %")
    within = t[first & (np.abs(error) > BAND)]
    return wrong, abs(within[-1] - settled) / step.horizon if len(within) and np.isfinite(settled) else 0.0


def dead_time(rng: np.random.Generator) -> Problem:
    gain, lag, late = _log(rng, 0.05, 20.0), _log(rng, 0.02, 0.5), rng.uniform(0.1, 0.8)
    values = {"plant.gain": gain, "plant.time_constant": lag, "plant.dead_time": late * lag}
    plain = PlainPlant((gain,), (lag, 1.0), late * lag)
    return _linear("dead_time", po.FirstOrder(pade_order=2), values, plain, (gain, 1 / lag), rng)


def integrator(rng: np.random.Generator) -> Problem:
    gain, late = _log(rng, 0.05, 20.0), _log(rng, 0.005, 0.5)
    values = {"plant.gain": gain, "plant.dead_time": late}
    plain = PlainPlant((gain,), (1.0, 0.0), late)
    return _linear("integrator", po.Integrator(pade_order=2), values, plain, (3 * gain * late, 0.3 / late), rng)


def light_damping(rng: np.random.Generator) -> Problem:
    return _second_order("light_damping", rng.uniform(0.05, 0.3), rng)


def sampled_delay(rng: np.random.Generator) -> Problem:
    return _second_order("sampled_delay", rng.uniform(0.3, 1.5), rng, sampled=True)


def load(rng: np.random.Generator) -> Problem:
    given = replace(dead_time(rng), kind="load")
    gain, limits = given.plant.parameters.value("plant.gain"), [po.Overshoot(PEAK), po.MaxSensitivity(SENSITIVITY)]
    step = po.Step(0.0, horizon=given.plant.horizon, disturbance={"valve_voltage": 1.0}, scale=gain)
    return replace(given, steps=[step], spec=specify(_aim(rng), limits))


def position(rng: np.random.Generator) -> Problem:
    plant = draw_plant("force_drive_position", rng)
    return Problem("position", plant, draw_steps(plant, rng), _specification(rng))


def dither(rng: np.random.Generator) -> Problem:
    plant = friction_lag(rng)
    while plant.loop.dither is None:
        plant = friction_lag(rng)
    return Problem("dither", plant, draw_steps(plant, rng), _specification(rng))


def crawl(rng: np.random.Generator) -> Problem:
    plant = force_drive(rng)
    return Problem("crawl", plant, [po.Step(_log(rng, 5e-3, 0.03), horizon=plant.horizon)], _specification(rng))


def unstable(rng: np.random.Generator) -> Problem:
    gain, rate, share = _log(rng, 0.05, 20.0), _log(rng, 2.0, 30.0), rng.uniform(0.02, 0.1)
    speed, drive, command = po.Quantity("speed", "m/s"), po.Quantity("drive", "V"), po.Quantity("valve_voltage", "V")

    def rhs(_: Any, x: Any, u: Any, __: Any) -> Any:
        slopes = {"speed": rate * (x["speed"] + gain * x["drive"])}
        slopes["drive"] = rate / share * (u["valve_voltage"] - x["drive"])
        return slopes, {"speed": x["speed"]}

    loop = po.ClosedLoop(po.define([speed, drive], [command], [speed], po.ParameterSet(), rhs), po.PID(limits=False))
    ranges = {"pid.Kp": (1.1 / gain, 40 / gain), "pid.Ki": (0.0, 20 * rate / gain), "pid.Kd": (0.0, 1 / (gain * rate))}
    ranges |= {"pid.Tf": (0.005 / rate, 0.1 / rate), "pid.b": (0.0, 1.0)}
    given = {"pid.Kp": 5 / gain, "pid.Ki": 2 * rate / gain, "pid.Tf": 0.02 / rate, "pid.b": 0.5}
    parameters = loop.parameters.fixed("*").with_values(given).with_bounds(ranges).freed(*ranges)
    plain = PlainPlant((gain,), (share / rate**2, (1 - share) / rate, -1.0))
    step = po.Step(float(rng.uniform(0.1, 1.0)) * gain, horizon=10 / rate)
    return Problem("unstable", Plant(loop, parameters, gain, 10 / rate), [step], _specification(rng), plain)


KINDS: dict[str, Callable[[np.random.Generator], Problem]] = {
    "dead_time": dead_time,
    "integrator": integrator,
    "light_damping": light_damping,
    "load": load,
    "position": position,
    "sampled_delay": sampled_delay,
    "dither": dither,
    "unstable": unstable,
    "crawl": crawl,
}


def _second_order(kind: str, damping: float, rng: np.random.Generator, *, sampled: bool = False) -> Problem:
    gain, rate = _log(rng, 0.05, 20.0), _log(rng, 3.0, 60.0)
    values = {"plant.gain": gain, "plant.natural_frequency": rate, "plant.damping": damping}
    plain = PlainPlant((gain * rate**2,), (1.0, 2 * damping * rate, rate**2))
    return _linear(kind, po.SecondOrder(), values, plain, (gain, rate), rng, sampled=sampled)


def _linear(
    kind: str,
    plant: Any,
    values: dict[str, float],
    plain: PlainPlant,
    scale: tuple[float, float],
    rng: np.random.Generator,
    *,
    sampled: bool = False,
) -> Problem:
    """A step of a plant that has a gain [unit/V] and takes about 1/rate [s], scale = (gain, rate)."""
    gain, rate = scale
    pid = po.PID(sample_time=rng.uniform(0.02, 0.1) / rate, delay=1, limits=False) if sampled else po.PID(limits=False)
    loop = po.ClosedLoop(plant.system(), pid)
    ranges = {"pid.Kp": (0.0, 20 / gain), "pid.Ki": (0.0, 20 * rate / gain), "pid.Kd": (0.0, 2 / (gain * rate))}
    ranges["pid.Tf"] = (0.02 / rate, 0.5 / rate)
    given = values | {"pid.Kp": 0.3 / gain, "pid.Ki": 0.3 * rate / gain, "pid.Tf": 0.1 / rate}
    parameters = loop.parameters.fixed("*").with_values(given).with_bounds(ranges).freed(*ranges)
    step = po.Step(float(rng.uniform(0.1, 1.0)) * gain, horizon=25 / rate)
    return Problem(kind, Plant(loop, parameters, gain, 25 / rate), [step], _specification(rng), plain)


def _specification(rng: np.random.Generator) -> Specification:
    return specify(_aim(rng), [po.Overshoot(OVERSHOOT), po.MaxSensitivity(SENSITIVITY)])


def _aim(rng: np.random.Generator) -> po.SettlingTime | po.IAE | po.ITAE:
    return (po.SettlingTime(), po.IAE(), po.ITAE())[int(rng.choice(3, p=(0.5, 0.25, 0.25)))]


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


if __name__ == "__main__":
    parser = row_arguments(__doc__, COUNT)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first problem")
    options = parser.parse_args()
    rows = study_rows(row_of, range(options.first, options.first + options.count), options, "random_kinds")
    sys.exit(finish(main(rows), options))
