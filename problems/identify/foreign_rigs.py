"""Rigs of a simulator that shares nothing with pneuopt, identified by defaults: how many are right, refused, or false.

    python problems/identify/foreign_rigs.py [--drives N] [--servos N] [--first SEED] [--step N]
                                             [--json FILE] [--out DIR]

`problems/shared/foreign_rigs.py` draws each rig and writes its drive.toml and its log; `plain_rigs.c` moves it. The
widths of the kinks are drawn, too, and stated nowhere; friction is a smooth curve, true stiction, or bristles.

    right     converged, and each estimate that is not called unidentifiable lies within 2 % of the truth, or within
              4 of its own standard deviations
    refused   not converged, or all that is wrong is called unidentifiable, for a reason that is true of the rig
    marked    converged, and what is wrong is marked as possibly biased
    false     converged, and wrong without a mark
    stopped   no answer after 20 CPU s

Even seeds are for development, odd ones for the judgement (`--first 1 --step 2`). Rows are by seed in --out.
"""

import math
import shutil
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared import foreign_rigs
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

DRIVES, SERVOS, LONGEST = 100, 40, 20.0  # rigs, rigs, [CPU s]
PERCENT, DEVIATIONS = 2.0, 4.0
OUTCOMES = ("right", "refused", "marked", "false", "stopped", "failed")
KINDS = {"cylinder": foreign_rigs.draw_cylinder, "servo": foreign_rigs.draw_servo}


def main(
    drives: int = DRIVES, servos: int = SERVOS, first: int = 1, step: int = 2, out: Path | None = None
) -> "pd.DataFrame":
    import pandas as pd

    tables = {
        kind: study(kind, range(first, first + step * n, step)) for kind, n in zip(KINDS, (drives, servos), strict=True)
    }
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        pd.concat(tables.values()).to_csv(out / "foreign_rigs.csv", index=False)
    return frame([claim for kind, rows in tables.items() if len(rows) for claim in _claims(kind, rows)])


def study(kind: str, seeds: range) -> "pd.DataFrame":
    """A row a rig."""
    import pandas as pd

    if not len(seeds):
        return pd.DataFrame()
    truth = po.ParameterSet({"seed": po.Parameter(-1.0, "1")})
    cases = {f"{kind} {seed}": {"seed": float(seed)} for seed in seeds}
    return pd.DataFrame(po.sweep(partial(identify_rig, kind), truth, cases))


def identify_rig(kind: str, given: po.ParameterSet) -> dict[str, Any]:
    """What `identify` makes of a rig's files, by defaults."""
    rig = KINDS[kind](round(given.value("seed")))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        drive_file, log_file = foreign_rigs.write_rig(rig, Path(folder))
        began = time.process_time()
        try:
            drive, parameters = po.read_drive(drive_file)
            fit = po.identify(
                drive.system(),
                [po.read_log(log_file, plant=drive.system())],
                parameters,
                cpu_seconds=LONGEST,
                throw=False,
            )
        except po.PneuoptError as error:
            row = {"outcome": "failed", "cpu": time.process_time() - began, "status": str(error)}
            print(f"{rig.name}: failed: {error}", file=sys.stderr)
            return {"rig": rig.name} | row
    seconds = time.process_time() - began
    row = judge(rig, fit) | {"cpu": seconds, "status": str(fit.status), "free_run": free_run_error(fit)}
    worst = f"worst {row['worst']} {row['percent']:.3g} %, {row['sigmas']:.3g} sd, {row['marked']:.0%} marked"
    said = "; ".join(fit.status.sentences)[:160]
    print(f"{rig.name}, {rig.samples}: {row['outcome']}, {worst}, {seconds:.1f} s, {said}", file=sys.stderr)
    return {"rig": rig.name} | row


def judge(rig: foreign_rigs.Rig, fit: po.IdentificationResult) -> dict[str, Any]:
    """The outcome of a fit, its worst estimate, and the share of its lines that carry a mark."""
    names = [n for n in fit.estimates.index if n in rig.truth]
    table = fit.estimates.loc[names]
    true = np.array([rig.truth[n] for n in names])
    error = np.abs(table["value"].to_numpy(dtype=float) - true)
    percent = 100 * error / np.where(true == 0, np.inf, np.abs(true))
    percent = np.where(true == 0, np.where(error == 0, 0.0, np.inf), percent)
    deviations = np.nan_to_num(error / table["stderr"].to_numpy(dtype=float), nan=math.inf)
    marks = table["mark"].astype(str).to_numpy()
    named = marks == str(po.Mark.UNIDENTIFIABLE)
    outside = np.where(named, 0.0, np.minimum(percent / PERCENT, deviations / DEVIATIONS))
    worst = int(np.argmax(outside))
    doubted = marks == str(po.Mark.BIAS_POSSIBLE)
    if fit.status.code is po.Code.BUDGET:
        outcome = "stopped"
    elif not fit.status.converged:
        outcome = "refused"
    elif outside[worst] <= 1:
        outcome = "right"
    else:
        outcome = "marked" if doubted[outside > 1].all() else "false"
    untrue = outcome == "refused" and not rig.confounded
    return {
        "outcome": "failed" if untrue else outcome,
        "worst": names[worst],
        "percent": float(percent[worst]),
        "sigmas": float(deviations[worst]),
        "marked": float(doubted.mean()),
        "named": float(named.mean()),
        "confounded": bool(rig.confounded),
    }


def free_run_error(fit: po.IdentificationResult) -> float:
    """The free run's largest error over the motion's size, of all channels."""
    return float(fit.fit["free_run_nrmse"].max())


def _claims(kind: str, rows: "pd.DataFrame") -> list[Claim]:
    counts = {o: int((rows["outcome"] == o).sum()) for o in OUTCOMES}
    good = 100 * (counts["right"] + counts["refused"]) / len(rows)
    right = rows[rows["outcome"] == "right"]
    return [
        Claim(f"{kind}.rigs", len(rows)),
        *(Claim(f"{kind}.{o}", n, "1", None, "<= 0" if o == "false" else "") for o, n in counts.items()),
        Claim(f"{kind}.right_or_refused", good, "%", None, ">= 95"),
        Claim(
            f"{kind}.marked_lines", 100 * float(right["marked"].mean()) if len(right) else math.nan, "%", None, "<= 50"
        ),
        Claim(f"{kind}.median_cpu", float(rows["cpu"].median()), "s", None, "<= 1"),
        Claim(f"{kind}.worst_cpu", float(rows["cpu"].max()), "s", None, "<= 20"),
    ]


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--drives", type=int, default=DRIVES)
    parser.add_argument("--servos", type=int, default=SERVOS)
    parser.add_argument("--first", type=int, default=1, metavar="SEED")
    parser.add_argument("--step", type=int, default=2)
    options = parser.parse_args()
    if not (shutil.which("cc") or shutil.which("gcc")):
        sys.exit("foreign rigs are moved by a C program: install a C compiler, cc or gcc")
    sys.exit(finish(main(options.drives, options.servos, options.first, options.step, options.out), options))
