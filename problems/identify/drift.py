"""Condition tracking: is a drift seen when the power calculation says, and how often does chance raise an alarm?

    python problems/identify/drift.py [--json FILE] [--out DIR]

Weekly logs of a force-driven axis for half a year. Coulomb friction scatters by 3 % from log to log (temperature,
grease) and each estimate has an error of 1 to 3 % beside, as its log's length has it. Rows stable.*: 200 histories
without a drift, which may raise an alarm in 1 %. Rows rising.*: 200 with 1 % a week, seen in at least the share that
the power calculation says for that week, less twice the error of a share of 200. Rows logs.*: one history of real
identifications, of 2 s logs that are simulated with friction that rises by 3 % a week.
"""

import datetime as dt
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

NAME, LEVEL = "friction.coulomb", 30.0  # [N]
SCATTER, ERRORS = 0.03, (0.01, 0.03)  # from log to log, of an estimate [1]
WEEKS, HISTORIES = 26, 200
FAST, RUNS = 0.03, 10  # drift of the real identifications [1/week], their logs
FIRST = dt.date(2026, 1, 5)


def main(histories: int = HISTORIES, runs: int = RUNS) -> "tuple[pd.DataFrame, po.Tracking]":
    stable = [track_history(seed, 0.0) for seed in range(histories)]
    rising = [track_history(1000 + seed, 0.01) for seed in range(histories)]
    alarms = sum(bool(h.drifting) for h in stable)
    claims = [Claim("stable.alarms", alarms, "1", None, f"<= {0.03 * histories:g}")]
    for share in (80, 90):
        # the median of what the histories themselves say, each by its own scatter
        due = float(np.median([h.table[f"logs_{share}"].iloc[0] for h in rising]))
        seen = 100 * float(np.mean([bool(h.drifting) and flag_week(h) <= due for h in rising]))
        slack = 200 * np.sqrt(share / 100 * (1 - share / 100) / histories)
        claims += [
            Claim(f"rising.logs_{share}", due, "1"),
            Claim(f"rising.seen_by_then_{share}", seen, "%", share, f">= {share - slack:.3g}"),
        ]
    rates = np.array([h.table.iloc[0][["percent_a_week_low", "percent_a_week_high"]].astype(float) for h in rising])
    true = 100 * 0.01  # of the value at the first log
    held = 100 * float(np.mean((rates[:, 0] <= true) & (true <= rates[:, 1])))
    claims.append(Claim("rising.coverage", held, "%", 95.0, ">= 90"))
    found = track_logs(runs)
    row = found.table.to_dict(orient="index")[NAME]
    claims += [
        Claim("logs.drifts", float(NAME in found.drifting), "1", None, ">= 1"),
        Claim("logs.seen_after", flag_week(found), "1", row["logs_90"]),
        Claim("logs.rate", row["percent_a_week"], "%/week", 100 * FAST),
        Claim("logs.rate_error", abs(row["percent_a_week"] - 100 * FAST), "%/week", None, "<= 0.9"),
    ]
    return frame(claims), found


def track_history(seed: int, drift: float) -> po.Tracking:
    """One drawn history of estimates [N]."""
    import pandas as pd

    rng, fits = np.random.default_rng(seed), []
    for week in range(WEEKS):
        error = LEVEL * float(rng.uniform(*ERRORS))
        level = LEVEL * (1 + drift * week + SCATTER * rng.standard_normal())
        row = {"value": level + error * rng.standard_normal(), "stderr": error, "dof": np.inf, "unit": "N"}
        fits.append(pd.DataFrame([row], index=[NAME]))
    return po.track(fits, dates(WEEKS), horizon=WEEKS)


def dates(count: int) -> list[dt.date]:
    return [FIRST + dt.timedelta(weeks=k) for k in range(count)]


def flag_week(found: po.Tracking) -> float:
    """After how many logs the drift was seen; NaN: never."""
    if not found.drifting:
        return math.nan
    return float(found.history.loc[NAME].index.tolist().index(found.table["alarm"].iloc[0]) + 1)


def track_logs(count: int) -> po.Tracking:
    """One history of real identifications, of short simulated logs."""
    drive, fits, rng = po.ForceDrive(po.Coulomb()), [], np.random.default_rng(7)
    system = drive.system()
    t = np.arange(2000) * 1e-3
    for week in range(count):
        level = LEVEL * (1 + FAST * week) * (1 + SCATTER * float(rng.standard_normal()))
        truth = drive.parameters.with_values({NAME: level, "friction.viscous": 50.0, "load.mass": 5.0})
        push = 90 * np.sin(2 * np.pi * 1.5 * t) + 25 * np.sin(2 * np.pi * 4.1 * t + week)
        run = po.simulate(system, po.Trajectory(t, {"force": push}), truth, initial={})
        position = run["position"] + 2e-5 * rng.standard_normal(len(t))
        log = po.Experiment(po.Trajectory(t, {"force": push, "position": position}), name=f"week {week + 1}")
        known = drive.parameters.with_values({"load.mass": 5.0})
        fits.append(po.identify(system, [log], known.freed(NAME, "friction.viscous"), throw=False))
        print(log.name, f"{level:.4g} N", fits[-1].status.verdict, sep=": ")
    return po.track(fits, dates(count), parameters=[NAME], horizon=WEEKS, drift=FAST)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    rows, tracked = main()
    print(tracked)
    sys.exit(finish(rows, options, lambda: {"drift": po.plot_tracking(tracked)}))
