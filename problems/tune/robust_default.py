"""What `tune` hands out by default holds on other plants: how many, and at what price, against the nominal design.

    python problems/tune/robust_default.py [--count N] [--jobs J] [--resume] [--json FILE] [--out DIR]

The rigs of data/force_rig (README's), data/own_rig (the tutorial's) and data/pneumatic_rig, each identified from its
first log and tuned by its file, then --count problems drawn as in random_designs.py, of which those count that have a
certified nominal design. Each is tuned twice with the same seed, `robust=False` and by default. Both designs are tried
on 200 fresh plants, from a stream that neither `tune` nor its verdict has drawn from.

"held" are the fresh plants on which every limit holds, in per cent; "high" is what 95 of 100 of them reach of the
objective, "median" the half; "price" is how much worse the objective is on the model than the nominal design's;
"cpu" the seconds of the whole `tune`, with its verdict. "ended by" counts the problems by the last way to find a design
that was tried: a way that never is the last is needless. "false" are designs whose verdict claims 95 of 100 plants
while fewer than 90 of 100 fresh ones hold.

Rows *.robust.held: a design by default holds on more fresh plants than the nominal one; "held.share" is the share of
problems in which it holds on 95 of 100, or its verdict begins with the number on which it does.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.evaluation.specification import Specification
from pneuopt.files.drive import read_fit
from pneuopt.files.tuning import read_tuning
from problems.shared.claims import Claim, finish, frame
from problems.shared.rows import row_arguments, study_rows
from problems.tune import random_designs

if TYPE_CHECKING:
    import pandas as pd

ROOT = Path(__file__).parents[2]
RIGS = ("force_rig", "own_rig", "pneumatic_rig")
COUNT, FRESH, FRESH_SEED = 8, 200, 999
CLAIMED, LEAST = 95, 90.0  # plants of 100 that a verdict claims, and fresh ones [%] below which that is false
EDITS = {  # of the tutorial: gauges, and a carriage that was weighed
    "run_01.toml": {"pressure_a": '{ column = "pA [bar]", unit = "bar(g)" }'},
    "drive.toml": {"mass": '"6 kg"'},
}
EDITS["run_01.toml"]["pressure_b"] = EDITS["run_01.toml"]["pressure_a"].replace("pA", "pB")


@dataclass(frozen=True, eq=False)
class Problem:
    """What `tune` is given, and how its plants are drawn from a seed."""

    name: str
    loop: po.ClosedLoop
    references: tuple[po.Step, ...]
    parameters: po.ParameterSet
    specification: Specification
    plants: Callable[..., po.ExpectedPlants]


def main(rows: "pd.DataFrame") -> "pd.DataFrame":
    rows = rows[rows["outcome"] == "certified"]
    claims = list[Claim]()
    for row in rows.to_dict("records"):
        name = str(row["kind"])
        for label in ("nominal", "robust"):
            least = f">= {row['nominal.held']:g}" if label == "robust" else ""
            claims.append(Claim(f"{name}.{label}.held", row[f"{label}.held"], "%", None, least))
            claims += [Claim(f"{name}.{label}.{n}", row[f"{label}.{n}"], "") for n in ("median", "high")]
            claims.append(Claim(f"{name}.{label}.cpu", row[f"{label}.cpu"], "s"))
        claims.append(Claim(f"{name}.price", row["price"], "%"))
    honest = (rows["robust.held"] >= CLAIMED) | (rows["robust.claims"] == 0)
    claims += [
        Claim("problems", len(rows), "1", None, ">= 3"),
        Claim("held.share", 100 * float((rows["robust.held"] >= CLAIMED).mean()), "%", None, ">= 75"),
        Claim("honest.share", 100 * float(honest.mean()), "%"),
        Claim("false", int(((rows["robust.claims"] == 1) & (rows["robust.held"] < LEAST)).sum()), "1", None, "<= 0"),
        *(Claim(f"{n}.held.median", float(rows[f"{n}.held"].median()), "%") for n in ("nominal", "robust")),
        Claim("price.median", float(rows["price"].median()), "%"),
        Claim("cpu.ratio.median", float((rows["robust.cpu"] / rows["nominal.cpu"]).median()), "1"),
    ]
    claims += [Claim(f"ended by {way}", int(count)) for way, count in rows["way"].value_counts().items()]
    return frame(claims)


def make_row(number: int) -> dict[str, Any]:
    """The row of a rig, or of a drawn problem, tuned twice."""
    row: dict[str, Any] = {"seed": number, "kind": RIGS[number] if number < len(RIGS) else f"drawn_{number}"}
    try:
        problem = read_rig(row["kind"]) if number < len(RIGS) else draw_problem(number)
        designs = dict[str, po.TuningResult]()
        for label in ("nominal", "robust"):
            begun = time.process_time()
            designs[label] = design(problem, robust=label == "robust")
            row[f"{label}.cpu"] = time.process_time() - begun
    except po.PneuoptError as error:
        return row | {"outcome": "refused", "status": str(error).splitlines()[0]}
    fresh = problem.plants(seed=FRESH_SEED, count=FRESH)
    for label, found in designs.items():
        given = problem.loop, problem.references, found.parameters
        tried = po.validate_design(*given, minimise=problem.specification, scenarios=fresh)
        row[f"{label}.held"] = 100 * tried.held / tried.count
        term = type(next(iter(problem.specification.weights))).__name__
        row[f"{label}.median"], row[f"{label}.high"] = (float(tried.figures[n][term]) for n in ("median", "p95"))
        row[f"{label}.claims"] = int(found.validation is not None and found.validation.held >= CLAIMED)
    before, after = (float(designs[n].requirements["certified"].iloc[0]) for n in ("nominal", "robust"))
    trail = designs["robust"].trail
    row["way"] = "none" if trail is None else str(trail.index[-1])
    row["price"] = 100 * (after / before - 1)
    return row | {"outcome": "certified", "status": designs["robust"].status.verdict}


def design(problem: Problem, *, robust: bool) -> po.TuningResult:
    """The certified design, tried on 100 plants."""
    given = problem.loop, problem.references, problem.parameters
    return po.tune(*given, minimise=problem.specification, plants=problem.plants(), robust=robust)


def draw_problem(seed: int) -> Problem:
    """A problem of random_designs.py, on the usual tolerances."""
    rng = np.random.default_rng((seed, 12))
    plant = random_designs.draw_plant(random_designs.KINDS[seed % len(random_designs.KINDS)], rng)
    steps, spec = random_designs.draw_steps(plant, rng), random_designs.draw_specification(rng)

    def plants(seed: int = 0, count: int = 100) -> po.ExpectedPlants:
        return po.expected_plants(plant.loop.complete(plant.parameters), seed=seed, count=count)

    return Problem(f"drawn_{seed}", plant.loop, tuple(steps), plant.parameters, spec, plants)


def read_rig(name: str) -> Problem:
    """A rig of data, identified by the commands that its user would type."""
    data = ROOT / "data" / name
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        log, tuning, drive = data / "run_01.csv", data / "tuning.toml", data / "drive.toml"
        if name == "own_rig":
            log, tuning, drive = (folder / n for n in ("run_01.csv", "tuning.toml", "drive.toml"))
            log.write_bytes((data / "run_01.csv").read_bytes())
            call("init", "--from", log.name, "--cylinder", "32", "--valve", "700", cwd=folder)
            for file, values in EDITS.items():
                lines = (folder / file).read_text(encoding="utf-8").splitlines()
                kept = (next((f"{k} = {v}" for k, v in values.items() if n.startswith(f"{k} = ")), n) for n in lines)
                (folder / file).write_text("\n".join(kept), encoding="utf-8")
        call("identify", str(drive), str(log), "-o", "fit.toml", cwd=folder)
        stored = read_fit(folder / "fit.toml")
        task = read_tuning(tuning, stored.drive.system(), stored.parameters)
    loop, parameters = task.loop, stored.parameters.fixed("*") | task.parameters

    def plants(seed: int = 0, count: int = 100) -> po.ExpectedPlants:
        own = loop.complete(parameters)
        return po.expected_plants(own, stored.covariance, estimates=stored.estimates, seed=seed, count=count)

    return Problem(name, loop, task.references, parameters, task.specification, plants)  # type: ignore[arg-type]


def call(*words: str, cwd: Path) -> None:
    """Run a command of pneuopt, whose doubts change nothing here."""
    subprocess.run([sys.executable, "-m", "pneuopt", *words], cwd=cwd, capture_output=True, check=False)


if __name__ == "__main__":
    options = row_arguments(__doc__, COUNT).parse_args()
    # odd seeds: by even ones the default was developed
    chosen = [*range(len(RIGS)), *(len(RIGS) + 2 * k for k in range(options.count))]
    sys.exit(finish(main(study_rows(make_row, chosen, options, "robust_default")), options))
