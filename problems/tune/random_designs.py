"""Random tuning problems, feasible or not: is a returned design what it claims, and is a refusal right?

    python problems/tune/random_designs.py [--count N] [--first SEED] [--jobs J] [--resume] [--json FILE] [--out DIR]

Plants are drawn as in random_problems.py (lags, dead times, drives with friction, pneumatic drives; continuous and
sampled, with dither and without), and position loops beside them; objectives and limits are drawn at random, so some
problems have no answer. `tune` has its default method. Each design that it returns is simulated by plain C
(plain_loop.c), which shares nothing with pneuopt, over five horizons or until the piston reaches a cover:

"violations" are designs that break a limit, or leave the settling band after the certified settling time (one that
settles beyond its horizon, where that was not asked for, has four horizons for it); "unstable"
are those whose motion grows from one horizon to the next; "standing" those that end nearer to where they began than to
the reference. Of refusals, "confirmed" is the share for which a brute-force search on compiled simulations (random
points, then Gaussian steps about the best, and the certificate of those with the most room to the limits) finds no
design that keeps all limits, settles within the horizon and is certified, either. The whole study is --count 200.
"""

import sys
import time
import warnings
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.evaluation.requirements import requirement_values
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.plotting import BLUE, GREY, RED, axes_grid, legend_above
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from problems.shared import random_problems
from problems.shared.arrays import Array
from problems.shared.claims import Claim, finish, frame
from problems.shared.plain_loop import PlainResponse, plain_kind, simulate_plainly
from problems.shared.random_problems import Plant, random_steps
from problems.shared.rows import row_arguments, study_rows

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COUNT, FIRST, WHOLE = 12, 0, 200
HORIZONS = 5
BAND = 0.02
SLACK = 2e-3  # of the step: what fixed steps, readings and the mean over a period differ by
LATE = 2e-3  # of the horizon: the same, of settling times
STAYS = 0.8  # of the record: what comes into the band later than that has not been seen to stay
GROWTH = 1.5  # of the swing from one horizon to the next
POINTS, ROUNDS, NEAR, CERTIFIED = 1500, 4, 300, 6  # of the brute-force search; designs certified a round
KINDS = (*random_problems.KINDS, "force_drive_position", "t32_position")


def main(rows: "pd.DataFrame") -> "pd.DataFrame":
    solved, refused = rows[rows["outcome"] == "solved"], rows[rows["outcome"] != "solved"]
    share = 100 * float((refused["feasible"] == 0).mean()) if len(refused) else 100.0
    claims = [
        Claim("problems", len(rows)),
        Claim("solved", len(solved)),
        *(Claim(n, int(solved[n].sum()), "1", None, "<= 0") for n in ("violations", "unstable", "standing")),
        Claim("refused", len(refused)),
        Claim("refused.confirmed", share, "%", None, ">= 100"),
        Claim("settling.deviation.worst", float(solved["deviation"].max()), "1", None, f"<= {LATE:g}"),
        Claim("cpu.median", float(rows["cpu"].median()), "s"),
        Claim("cpu.worst", float(rows["cpu"].max()), "s"),
    ]
    return frame(claims)


def design_row(seed: int) -> dict[str, Any]:
    """The row of one problem."""
    rng = np.random.default_rng((seed, 12))
    kind = KINDS[seed % len(KINDS)]
    plant = draw_plant(kind, rng)
    steps, spec = draw_steps(plant, rng), draw_specification(rng)
    row: dict[str, Any] = {"seed": seed, "kind": kind, "limits": " ".join(type(q).__name__ for q in spec.limits)}
    row |= {"objective": " ".join(type(q).__name__ for q in spec.weights), "dither": plant.loop.dither is not None}
    begun = time.process_time()
    try:
        found = po.tune(plant.loop, steps, plant.parameters, minimise=spec, plants={}, throw=False)
        outcome, status = "solved" if found.status.converged else "refused", str(found.status)
    except po.PneuoptError as error:
        found, outcome, status = None, "error", str(error)
    row |= {"outcome": outcome, "status": status, "cpu": time.process_time() - begun}
    row |= {"violations": 0, "unstable": 0, "standing": 0, "deviation": np.nan, "feasible": 0, "reasons": ""}
    if found is not None and found.status.converged:
        return row | check_design(kind, plant.loop, steps, found, spec)
    return row | {"feasible": int(is_feasible(plant, steps, spec, rng))}


def draw_plant(kind: str, rng: np.random.Generator) -> Plant:
    """A plant of a kind; for a position loop the drive's, with the position fed back and gains to match."""
    drive = random_problems.KINDS[kind.removesuffix("_position")](rng)
    if not kind.endswith("_position"):
        return drive
    loop = po.ClosedLoop(drive.loop.plant, drive.loop.pid, drive.loop.dither, measured="position")
    given = drive.parameters.select([n for n in drive.parameters if n not in loop.parameters or n.startswith("dither")])
    own = loop.parameters | drive.parameters.select([n for n in drive.parameters if not n.startswith("pid.")]) | given
    reach, force = 0.5 * drive.speed * drive.horizon, kind.startswith("force")
    mass = drive.parameters.value("load.mass")
    ranges = {"pid.Kp": (50.0, 4000.0 * mass), "pid.Ki": (0.0, 2e4 * mass), "pid.Kd": (5.0, 200.0 * mass)}
    if not force:
        ranges = {"pid.Kp": (1.0, 200.0), "pid.Ki": (0.0, 200.0), "pid.Kd": (0.0, 10.0)}
    clip = 400.0 if force else 5.0
    values = {"pid.Kp": ranges["pid.Kp"][1] / 10, "pid.Kd": ranges["pid.Kd"][1] / 10, "pid.Tf": 0.003}
    values |= {"pid.lower": -clip, "pid.upper": clip}
    dithers = {n: (q.lower, q.upper) for n, q in drive.parameters.items() if n.startswith("dither.") and q.free}
    free = ranges | dithers
    parameters = own.fixed("*").with_values(values).with_bounds(free).freed(*free)
    return Plant(loop, parameters, reach, 2 * drive.horizon, drive.ends)


def draw_steps(plant: Plant, rng: np.random.Generator) -> list[po.Step]:
    """One step or two; of a position loop from a rest within the stroke."""
    if plant.loop.feedback.name != "position":
        return random_steps(plant, rng)[:2]
    low, high = plant.ends or (-1.0, 1.0)
    size = float(rng.uniform(0.1, 1.0) * plant.speed * rng.choice((-1, 1)))
    initial = float(rng.uniform(low, high - abs(size))) + max(0.0, -size)
    return [po.Step(size, initial=initial, horizon=plant.horizon)]


def draw_specification(rng: np.random.Generator) -> Specification:
    """An objective and limits at random; some contradict each other, some are kept by a loop that stands still."""
    objectives: list[Any] = [po.SettlingTime(), po.ITAE(), po.IAE(), po.RiseTime(), po.PeakControl(), po.NoiseGain()]
    objective = objectives[int(rng.choice(6, p=(0.5, 0.1, 0.1, 0.1, 0.1, 0.1)))]
    limits: list[Any] = [po.Overshoot(float(rng.choice((0.005, 0.02, 0.05, 0.2))))]
    limits += [po.MaxSensitivity(float(rng.uniform(1.3, 2.5)))] if rng.random() < 0.5 else []
    limits += [po.SteadyStateError(float(rng.choice((0.005, 0.02))))] if rng.random() < 0.2 else []
    limits += [po.PhaseMargin(float(rng.uniform(30, 70)))] if rng.random() < 0.1 else []
    return specify(objective, limits)


def check_design(
    kind: str, loop: po.ClosedLoop, steps: list[po.Step], found: po.TuningResult, spec: Specification
) -> dict[str, Any]:
    """What the plain simulation finds wrong with a design: counts, and the reasons in words."""
    reasons, worst = list[str](), 0.0
    for step in steps:
        run = simulate_plainly(plain_kind(kind, loop), loop, found.parameters, step, HORIZONS)
        mean = period_mean(run, loop.dither_period(found.parameters), step.initial)
        settled = float(found.certified[step.label]["SettlingTime"])
        wrong, deviation = find_faults(run, mean, step, settled, spec)
        reasons += [f"{step.label}: {why}" for why in wrong]
        worst = max(worst, deviation)
    kinds = {n: int(any(n in why for why in reasons)) for n in ("unstable", "standing")}
    return {**kinds, "violations": int(bool(reasons)), "deviation": worst, "reasons": "; ".join(reasons)}


def find_faults(
    run: PlainResponse, mean: Array, step: po.Step, settled: float, spec: Specification
) -> tuple[list[str], float]:
    """The faults of one response, and by how much its settling time differs from the certified, over the horizon."""
    t, error, horizon = run.t, (mean - step.final) / abs(step.size), step.horizon
    wrong = list[str]()
    if abs(error[-1]) > 0.5:
        wrong.append("standing")
    swings = [np.ptp(error[(t >= k * horizon) & (t <= (k + 1) * horizon)]) for k in range(1, int(t[-1] / horizon))]
    if any(b > max(GROWTH * a, BAND) for a, b in pairwise(swings)):
        wrong.append("unstable: the swing grows")
    outside = np.flatnonzero(np.abs(error) > BAND + SLACK)
    last = t[outside[-1]] if len(outside) else 0.0
    asked = np.isfinite(settled)
    if not asked:  # not asked for: the design comes to rest beyond its horizon, and its certificate says so
        settled = STAYS * t[-1]
    if not last <= settled + LATE * horizon:
        wrong.append(f"leaves the band at {last:.4g} s, certified {settled:.4g} s")
    within = np.flatnonzero(np.abs(error[t <= horizon]) > BAND)
    deviation = abs(t[within[-1]] - settled) / horizon if len(within) and asked else 0.0
    first = t <= horizon
    most = float(np.max(np.sign(step.size) * (mean[first] - step.final))) / abs(step.size)
    if most > spec.limit(po.Overshoot) + SLACK:
        wrong.append(f"overshoot {100 * most:.3g} %")
    if abs(error[first][-1]) > spec.limit(po.SteadyStateError) + SLACK:
        wrong.append(f"error {100 * abs(error[first][-1]):.3g} %")
    return wrong, deviation


def period_mean(run: PlainResponse, period: float | None, before: float) -> Array:
    """The centred mean over a period, by the trapezoidal rule; the signal itself without dither."""
    if period is None:
        return run.y
    h = run.t[1] - run.t[0]
    total = np.concatenate([[0.0], np.cumsum(0.5 * h * (run.y[1:] + run.y[:-1]))])
    ends = run.t + period / 2, run.t - period / 2
    after = np.interp(np.minimum(ends[0], run.t[-1]), run.t, total)
    earlier = np.where(ends[1] < 0, before * ends[1], np.interp(ends[1], run.t, total))
    mean = (after - earlier) / period
    late = ends[0] > run.t[-1]
    return np.where(late, mean[~late][-1] if (~late).any() else run.y, mean)


def is_feasible(plant: Plant, steps: list[po.Step], spec: Specification, rng: np.random.Generator) -> bool:
    """Whether brute force finds a design that keeps all limits, settles, and is certified."""
    asked = {type(q) for q in (*spec.weights, *spec.limits)}
    stable = [] if po.MaxSensitivity in asked else [po.MaxSensitivity(50.0)]
    spec = specify({po.SettlingTime(): 1.0}, [*spec.limits, *stable])
    try:
        space = search_space(plant.loop, plant.parameters)
        simulator = Simulator(plant.loop, steps, space, spec=spec)
        unit = rng.random((POINTS, len(space.names)))
        for _ in range(ROUNDS):
            costs = _violations(simulator, spec, unit)
            order = np.argsort(costs, kind="stable")
            few = [k for k in order[:CERTIFIED].tolist() if costs[k] <= 0]
            if any(holds(plant, steps, space.parameters_at(space.from_unit(unit[k])), spec) for k in few):
                return True
            best = unit[order[:10]]
            near = best[rng.integers(len(best), size=NEAR)] + 0.05 * rng.standard_normal((NEAR, unit.shape[1]))
            unit = np.vstack([best, np.clip(near, 0.0, 1.0)])
    except po.PneuoptError:
        return False
    return False


def holds(plant: Plant, steps: list[po.Step], design: po.ParameterSet, spec: Specification) -> bool:
    """Whether the certificate of a design has no finding, and its figures keep all limits."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", po.PhysicsWarning)
        try:
            found = po.certificate(plant.loop, steps, design)
        except (po.PneuoptError, po.PhysicsWarning):
            return False
    values = [requirement_values(dict(column)) for _, column in found.metrics.items()]
    return not found.findings and not any(spec.violations(row) for row in values)


def _violations(simulator: Simulator, spec: Specification, unit: Array) -> Array:
    """By how much each point breaks its limits, relative to them, in all; of one that keeps them all, less its room.

    A response that never settles counts 10 more.
    """
    values = simulator.values(simulator.space.from_unit(unit), spec)
    total, room = np.where(np.isfinite(values["SettlingTime"]), 0.0, 10.0), np.full(len(unit), np.inf)
    for q in spec.limits:
        excess = np.nan_to_num(values[type(q).__name__] / spec.limit(type(q)) - 1, nan=10.0, posinf=10.0)
        total, room = total + np.maximum(excess, 0.0), np.minimum(room, -excess)
    return np.where(total > 0, total, -room)


def figure(rows: "pd.DataFrame") -> "Figure":
    """By kind, how many problems were solved and refused, and how many refusals brute force contradicts."""
    from matplotlib.ticker import MaxNLocator

    picture, ((axes,),) = axes_grid(1, 1, (3.4,), width=9.0)
    kinds = list(dict.fromkeys(rows["kind"]))
    solved = [int(((rows["kind"] == k) & (rows["outcome"] == "solved")).sum()) for k in kinds]
    refused = [int(((rows["kind"] == k) & (rows["outcome"] != "solved")).sum()) for k in kinds]
    wrong = [int(((rows["kind"] == k) & (rows["feasible"] == 1)).sum()) for k in kinds]
    labels = [k.replace("_", "\n") for k in kinds]
    axes.bar(labels, solved, color=BLUE, label="solved")
    axes.bar(labels, refused, bottom=solved, color=GREY, label="refused")
    axes.bar(labels, wrong, bottom=solved, color=RED, label="refused, though brute force finds a design")
    axes.set(ylabel="problems")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(False, axis="x")
    legend_above(picture, axes)
    return picture


if __name__ == "__main__":
    parser = row_arguments(__doc__, COUNT)
    parser.add_argument("--first", type=int, default=FIRST, metavar="SEED", help="seed of the first problem")
    options = parser.parse_args()
    rows = study_rows(design_row, range(options.first, options.first + options.count), options, "random_designs")
    sys.exit(finish(main(rows), options, lambda: {"random_designs": figure(rows)}))
