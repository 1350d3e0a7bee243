"""Identification without a guess, on random plants: how many converge, and whether "converged" can be believed.

    python problems/identify/random_plants.py [--count N] [--first SEED] [--kind stribeck|lugre|other]
                                     [--encoder METRES] [--outliers FRACTION] [--json FILE] [--out DIR]

The rig, loop and log of b32.py, with friction and valve drawn anew for each seed (`RANGES`); all that is drawn is free,
and starts from the log alone. A parameter is found if it lies within 2 % of the truth or within 4 of its own standard
deviations; a lie is a fit that says converged with a parameter outside both. Cost is CPU time, also in compiled scalar
simulations of the record (10 RK4 steps a sample), on a warm cache. --out keeps a row a plant in random_plants.csv. The
whole study is --count 200.

`other` are rigs of other sizes and loops (problems/shared/random_rig.py): hunting, staircases, chirps, one-way motion,
strokes, up to 60 s at 0.5 to 2 kHz, noise not stated; every other five with bristles. Their logs need not identify
every parameter: a parameter that is named unidentifiable is no lie, and `.named` is the share of these. A search ends
after 60 CPU s, which counts as not converged. Each rig's line is printed to stderr as it ends. Its whole study is
--count 100.

--encoder logs the position in steps of that size in place of its noise, --outliers puts that fraction of the samples of
each channel 20 standard deviations off; the figures are then shown, and nothing is claimed.
"""

import functools
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared import random_rig
from problems.shared.arrays import Array
from problems.shared.b32 import FREE, LOGGED, NOISE, SAMPLE, VALVE, completed, exact, simulation_seconds
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

COUNT, FIRST, KINDS, OTHER = 15, 1000, ("stribeck", "lugre"), "other"
SAMPLES = 10_000
HUNTING = (3.0, 20.0)  # [Hz]: a rig hunts whose speed has most of its power there at one frequency
EXCESS = (1.1, 2.2)  # static friction over Coulomb's
RANGES = {  # lower, upper; all but Coulomb friction and leak are uniform in the logarithm
    "friction.coulomb": (15.0, 80.0),
    "friction.stribeck_velocity": (5e-3, 5e-2),
    "friction.viscous": (20.0, 250.0),
    "valve.conductance": (1e-8, 4e-8),
    "valve.leak": (2e-3, 3e-2),
    "friction.bristle_stiffness": (3e4, 3e5),
    "friction.bristle_damping": (100.0, 1000.0),
}
UNIFORM = ("friction.coulomb", "valve.leak")
BRISTLES = ("friction.bristle_stiffness", "friction.bristle_damping")
PERCENT, DEVIATIONS, OUTLYING = 2.0, 4.0, 20.0
LONGEST = 60.0  # [CPU s] after which a rig's search ends: three times what is claimed of the worst


def main(
    count: int = COUNT,
    first: int = FIRST,
    kinds: tuple[str, ...] = (*KINDS, OTHER),
    encoder: float = 0.0,
    outliers: float = 0.0,
    out: Path | None = None,
) -> "pd.DataFrame":
    import pandas as pd

    held = not encoder and not outliers
    plants = {kind: study(kind, range(first, first + count), encoder, outliers) for kind in kinds}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        pd.concat(plants.values()).to_csv(out / "random_plants.csv", index=False)
    return frame([claim for kind, rows in plants.items() for claim in _claims(kind, rows, held)])


def study(kind: str, seeds: range, encoder: float = 0.0, outliers: float = 0.0) -> "pd.DataFrame":
    """A row a plant: what was drawn, whether it converged, how far its worst parameter is off, and the cost."""
    if kind == OTHER:
        truth = po.ParameterSet({"seed": po.Parameter(-1.0, "1")})
        cases = {f"{kind} {seed}": {"seed": float(seed)} for seed in seeds}
        fn = identified_rig
    else:
        truth = po.catalog.b32(kind == "lugre")[1] | po.ParameterSet({"seed": po.Parameter(-1.0, "1")})
        cases = {f"{kind} {seed}": {**drawn(kind, seed), "seed": float(seed)} for seed in seeds}
        fn = functools.partial(identified, kind, encoder, outliers)
    rows = po.sweep(fn, truth, cases, progress=lambda line: print(f"{kind}: {line}", end="\r", file=sys.stderr))
    return completed(rows)


def drawn(kind: str, seed: int) -> dict[str, float]:
    """A plant's numbers."""
    rng = np.random.default_rng(seed)
    values = {}
    for name, (low, high) in RANGES.items():
        share = rng.random()
        values[name] = low + share * (high - low) if name in UNIFORM else low * (high / low) ** share
    values["friction.static"] = values["friction.coulomb"] * rng.uniform(*EXCESS)
    return {n: values[n] for n in _free(kind)}


def generate(
    kind: str, truth: po.ParameterSet, seed: int, encoder: float = 0.0, outliers: float = 0.0
) -> po.Experiment:
    """The plant's log: b32's loop, in fine RK4 steps (a test holds them against b32's LSODA)."""
    true = exact(truth, kind == "lugre", seconds=SAMPLES * SAMPLE)
    rng = np.random.default_rng((seed, 1))
    noise = {n: NOISE[n] for n in LOGGED if n in NOISE}
    columns = {n: true[n] + sigma * rng.standard_normal(SAMPLES) for n, sigma in noise.items()}
    if encoder:
        columns["position"] = encoder * np.round(true["position"] / encoder)
        noise["position"] = encoder / math.sqrt(12)
    for n, sigma in noise.items():
        off = (rng.random(SAMPLES) < outliers) * rng.choice((-OUTLYING, OUTLYING), SAMPLES)
        columns[n] = columns[n] + off * sigma
    log = po.Trajectory(np.arange(SAMPLES) * SAMPLE, {"valve_voltage": true["valve_voltage"], **columns})
    return po.Experiment(log, noise, name=f"{kind} {seed}")


def identified(kind: str, encoder: float, outliers: float, truth: po.ParameterSet) -> dict[str, Any]:
    """One plant's row."""
    log = generate(kind, truth, round(truth.value("seed")), encoder, outliers)
    return _row(kind, log, po.catalog.b32(kind == "lugre")[1], truth)


def identified_rig(given: po.ParameterSet) -> dict[str, Any]:
    """The row of a rig of another kind."""
    seed = round(given.value("seed"))
    kind = KINDS[seed // len(random_rig.MOTIONS) % len(KINDS)]
    rig = random_rig.draw(seed, drawn(kind, seed))
    log = random_rig.record(rig, seed)
    own = {"motion": rig.motion, "seconds_logged": rig.samples * rig.sample, "rate": 1 / rig.sample}
    known = rig.truth.select(po.catalog.b32(rig.lugre)[1])
    row = _row(kind, log, known, rig.truth, LONGEST)
    shown = {n: row[n] for n in ("converged", "outside_unnamed", "worst", "cpu", "misfit")}
    print(f"{rig.motion} {seed} {kind} {rig.samples}: {shown}", file=sys.stderr)
    return row | own | {"oscillation": random_rig.oscillation(log)}


def _row(
    kind: str, log: po.Experiment, given: po.ParameterSet, truth: po.ParameterSet, longest: float = math.inf
) -> dict[str, Any]:
    """What an identification without a guess makes of a log."""
    unit, free, drive = _unit(kind), _free(kind), po.catalog.b32(kind == "lugre")[0]
    blind = given.with_values({n: drive.parameters.value(n) for n in free}).freed(*free)
    began = time.process_time()
    fit = po.identify(drive.system(), [log], blind, cpu_seconds=longest, throw=False)
    seconds = time.process_time() - began
    percent, sigmas = _off(fit.estimates, truth)
    outside = np.minimum(percent / PERCENT, np.where(np.isnan(sigmas), np.inf, sigmas) / DEVIATIONS)
    named = (fit.estimates["mark"] == str(po.Mark.UNIDENTIFIABLE)).to_numpy()
    worst = int(np.argmax(outside))
    return {
        "converged": float(fit.status.converged),
        "percent": float(percent.max()),
        "sigmas": float(sigmas.max()),
        "outside": float(outside[worst]),
        "worst": str(fit.estimates.index[worst]),
        "outside_unnamed": float(np.where(named, 0.0, outside).max()),
        "named": float(named.mean()),
        "cpu": seconds,
        "simulations": seconds / unit,
        "iterations": fit.stats["iterations"],
        "misfit": fit.stats["chi_square_ratio"],
        **{f"found {n}": float(v) for n, v in fit.estimates["value"].items()},
        "start": fit.provenance["start"],
        "status": str(fit.status),
    }


def _off(estimates: "pd.DataFrame", truth: po.ParameterSet) -> tuple[Array, Array]:
    """How far each estimate is off: in percent of the truth, and in its own standard deviations."""
    true = np.array([truth.value(str(n)) for n in estimates.index])
    error = np.abs(estimates["value"].to_numpy(dtype=float) - true)
    return 100 * error / true, error / estimates["stderr"].to_numpy(dtype=float)


def _claims(kind: str, plants: "pd.DataFrame", held: bool) -> list[Claim]:
    if kind == OTHER:
        return _rig_claims(plants)
    done = plants["converged"] == 1
    found = plants[done]
    share = 100 * float(done.mean())
    lies = int((found["outside"] > 1).sum())
    near = 100 * float((found["percent"] <= PERCENT).mean()) if len(found) else math.nan
    sure = 100 * float((found["outside"] <= 1).mean()) if len(found) else math.nan
    costs = plants[["simulations", "cpu"]]
    return [
        Claim(f"{kind}.plants", len(plants)),
        Claim(f"{kind}.converged", share, "%", None, ">= 98" if held else ""),
        Claim(f"{kind}.within_2_percent", near, "%"),
        Claim(f"{kind}.within_2_or_4_sigma", sure, "%", None, ">= 100" if held else ""),
        Claim(f"{kind}.lies", lies, "1", 0.0, "<= 0" if held else ""),
        Claim(f"{kind}.median_cost", float(costs["simulations"].median()), "runs"),
        Claim(f"{kind}.worst_cost", float(costs["simulations"].max()), "runs"),
        Claim(f"{kind}.median_seconds", float(costs["cpu"].median()), "s"),
        Claim(f"{kind}.worst_seconds", float(costs["cpu"].max()), "s"),
    ]


def _rig_claims(rigs: "pd.DataFrame") -> list[Claim]:
    """Of rigs of another kind: right are those that converge to parameters within their bounds, or name the others."""
    done, wrong = rigs["converged"] == 1, rigs["outside_unnamed"] > 1
    by_motion = (done & ~wrong).groupby(rigs["motion"]).mean()
    return [
        Claim("other.rigs", len(rigs)),
        Claim("other.right", 100 * float((done & ~wrong).mean()), "%", None, ">= 95"),
        Claim("other.lies", int((done & wrong).sum()), "1", 0.0, "<= 0"),
        Claim("other.named", 100 * float(rigs["named"][done].mean()), "%"),
        *[
            Claim(f"other.{str(motion).replace(' ', '_')}", 100 * float(share), "%")
            for motion, share in by_motion.items()
        ],
        Claim("other.that_hunt", 100 * float(rigs["oscillation"].between(*HUNTING).mean()), "%"),
        Claim("other.median_seconds", float(rigs["cpu"].median()), "s", None, "<= 2"),
        Claim("other.worst_seconds", float(rigs["cpu"].max()), "s", None, "<= 20"),
    ]


def _free(kind: str) -> tuple[str, ...]:
    return (*FREE, *VALVE, *(BRISTLES if kind == "lugre" else ()))


@functools.cache
def _unit(kind: str) -> float:
    """The unit of cost [CPU s]; and loads what an identification runs."""
    lugre = kind == "lugre"
    drive, truth = po.catalog.b32(lugre)
    log = generate(kind, truth, 0)
    short = replace(log, trajectory=log.trajectory.rows(0, 1000))
    po.identify(drive.system(), [short], truth.freed(*_free(kind)), throw=False)
    return simulation_seconds(log, lugre)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="plants of each kind")
    parser.add_argument("--first", type=int, default=FIRST, metavar="SEED", help="seed of the first plant")
    parser.add_argument("--kind", choices=(*KINDS, OTHER), action="append", help="all by default")
    parser.add_argument("--encoder", type=float, default=0.0, metavar="METRES", help="the encoder's step")
    parser.add_argument("--outliers", type=float, default=0.0, metavar="FRACTION", help="of the samples")
    options = parser.parse_args()
    kinds = tuple(options.kind or (*KINDS, OTHER))
    rows = main(options.count, options.first, kinds, options.encoder, options.outliers, options.out)
    sys.exit(finish(rows, options))
