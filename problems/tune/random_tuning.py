"""Random tuning problems, each known to be feasible: how many `tune` solves, and whether its claims can be believed.

    python problems/tune/random_tuning.py [--count N] [--first SEED] [--jobs J] [--resume] [--json FILE] [--out DIR]

The problems are those of random_problems.py: linear plants and drives with friction, sampled and continuous, with
dither and without, one to three steps; the limits are what a design found by brute force keeps, loosened by a tenth.
`tune` has its default method and start, and is told nothing of that design. Solved is what is handed out as converged:
its limits are kept by the independent simulation at the gains as printed. "repaired" are those of them that took a
wider margin than the first; "rejected" is what the certificate refused, "relaxed" what the search called infeasible,
"refused" what ended in an error. "deviation" is the largest |claimed - certified| settling time of the designs handed
out. --out keeps a row a problem in random_tuning.csv as they come; --resume goes on from there. The whole study is
--count 100.
"""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from problems.shared.claims import Claim, finish, frame
from problems.shared.random_problems import problem
from problems.shared.rows import row_arguments, study_rows

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COUNT, FIRST = 9, 0
WHOLE = 100  # problems of the study
OUTCOMES = {po.Code.CONVERGED: "solved", po.Code.NOT_CERTIFIED: "rejected", po.Code.INFEASIBLE: "relaxed"}


def main(rows: "pd.DataFrame") -> "pd.DataFrame":
    solved = rows[rows["outcome"] == "solved"]
    share = 100 * len(solved) / len(rows)
    ended = rows["outcome"].value_counts()
    gained = solved["certified"] / solved["known"]
    claims = [
        Claim("problems", len(rows)),
        Claim("problems.redrawn", int(rows["redrawn"].sum())),
        Claim("solved", share, "%", None, ">= 90"),
        Claim("solved.repaired", int(solved["repaired"].sum())),
        *(Claim(n, int(ended.get(n, 0))) for n in ("rejected", "relaxed", "refused", "other")),
        Claim("deviation.worst", float(solved["deviation"].max()), "s", None, "<= 1e-3"),
        Claim("deviation.median", float(solved["deviation"].median()), "s"),
        Claim("settling.over_brute_force", float(gained.median())),
        Claim("cpu.median", float(rows["cpu"].median()), "s"),
        Claim("cpu.worst", float(rows["cpu"].max()), "s"),
    ]
    kinds = rows.groupby("kind")["outcome"]
    claims += [Claim(f"{kind}.solved", 100 * float((o == "solved").mean()), "%") for kind, o in kinds]
    return frame(claims)


def tuned(seed: int) -> dict[str, Any]:
    """The row of one problem."""
    given = problem(seed)
    free, sample = given.parameters.free_names, given.loop.pid.sample_time
    row: dict[str, Any] = {"seed": seed, "kind": given.kind, "redrawn": given.redrawn, "known": _known(given.known)}
    row |= {"sample_time": sample or 0.0, "dither": given.loop.dither is not None, "free": len(free)}
    row |= {"steps": len(given.steps), "limits": " ".join(type(q).__name__ for q in given.subject_to)}
    begun = time.process_time()
    try:
        found = po.tune(
            given.loop,
            given.steps,
            given.parameters,
            minimise=given.minimise,
            subject_to=given.subject_to,
            plants={},  # brute force had none either
            throw=False,
        )
    except po.PneuoptError as error:
        row |= {"outcome": "refused", "status": str(error), "repaired": False}
        return row | {"claimed": np.nan, "certified": np.nan, "deviation": np.nan, "cpu": time.process_time() - begun}
    outcome = OUTCOMES.get(found.status.code, "other")
    row |= {"outcome": outcome, "status": str(found.status), "cpu": time.process_time() - begun}
    row["repaired"] = outcome == "solved" and found.stats.get("margin", np.inf) > 1.01 * _first_margin(found)
    row |= {n: _worst(getattr(found, n)) for n in ("claimed", "certified")}
    return row | {"deviation": found.stats["deviation.SettlingTime"]}


def _known(figures: dict[str, float]) -> float:
    return figures["SettlingTime"]


def _first_margin(found: po.TuningResult) -> float:
    """What the first attempt tightens the limits by."""
    return (po.Racing if "simulations" in found.stats else po.TwoPhase)().margin


def _worst(metrics: "pd.DataFrame") -> float:
    return float(np.max(metrics.loc["SettlingTime"].to_numpy(dtype=float)))


def figure(rows: "pd.DataFrame") -> "Figure":
    """Each solved problem: certified settling time over brute force's, and how far the claim was off."""
    from matplotlib.ticker import LogLocator, NullFormatter

    picture, ((left, right),) = axes_grid(1, 2, (3.4,), width=9.0)
    solved = rows[rows["outcome"] == "solved"]
    ends = np.array([0.8 * solved["known"].min(), 1.25 * solved["known"].max()])
    left.loglog(ends, ends, color=GREY, lw=0.8, ls="--", label="as good as brute force")
    for is_sampled, colour in ((False, BLUE), (True, ORANGE)):
        part = solved[(solved["sample_time"] > 0) == is_sampled]
        name = "sampled" if is_sampled else "continuous"
        left.loglog(part["known"], part["certified"], "o", ms=4, color=colour, label=name)
        right.loglog(part["certified"], np.maximum(part["deviation"], 1e-8), "o", ms=4, color=colour)
    right.axhline(1e-3, color=GREY, lw=0.8, ls="--")
    left.set(xlabel="brute force [s]", ylabel="tuned, certified [s]", title="settling time")
    right.set(xlabel="settling time, certified [s]", ylabel="|claimed - certified| [s]", title="the claim")
    for axis in (left.xaxis, left.yaxis, right.xaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    legend_above(picture, left)
    return picture


if __name__ == "__main__":
    parser = row_arguments(__doc__, COUNT)
    parser.add_argument("--first", type=int, default=FIRST, metavar="SEED", help="seed of the first problem")
    options = parser.parse_args()
    rows = study_rows(tuned, range(options.first, options.first + options.count), options, "random_tuning")
    sys.exit(finish(main(rows), options, lambda: {"random_tuning": figure(rows)}))
