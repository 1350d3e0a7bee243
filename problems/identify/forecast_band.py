"""A forecast with a band: how much of held-out logs lies in the 95 % band that is given before they are looked at.

    python problems/identify/forecast_band.py [--datasets DIR] [--json FILE]

Each rig is identified from some of its logs, and the others are forecast from their first tenth on. Generated: the
example rigs (`data/`), of which the pneumatic one sticks, slips and has a hysteresis that no model here has, one log
for the other and back; an integrating axis under an unknown force or with friction along the way (`windows.py`),
identified from three logs and forecast in windows of 1 s. With --datasets also measured ones: each half of the EMPS log
from the other, by default settings, and each of Zillen's O-ring logs from the other three. By rig the share of the
samples inside, its least in a log, and half the band's width over the error, root mean squares over the rig's logs.
Rows *.inside: at least 90 % for each rig, 90 to 99 % over all; rows *.width: at most three times the error.
"""

import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
import pandas as pd

import pneuopt as po
from problems.identify import seal_friction, windows
from problems.shared.claims import Claim, arguments, finish, frame

DATA = Path(__file__).parents[2] / "data"
RIGS = {"force_rig": "run_*.csv", "step_rig": "step_*.csv", "pneumatic_rig": "run_*.csv"}
WINDOW = 1.0  # [s] of forecasts of axes that integrate what no model has
EMPS: dict[str, str | dict[str, str | float]] = {
    "time": "time_s",
    "position": "position_m",
    "force": {"column": "drive_force_N", "unit": "N"},
}
EMPS_FREE = "load.mass", "load.force", "friction.coulomb", "friction.viscous"
Forecasts = Iterator[tuple[str, "pd.DataFrame"]]


def main(datasets: Path | None = None, seeds: int = 2) -> "pd.DataFrame":
    warnings.simplefilter("ignore", po.PhysicsWarning)
    found = [*example_rigs(), *integrating_axes(seeds), *(measured(datasets) if datasets else ())]
    tables: dict[str, list[pd.DataFrame]] = {}
    for rig, table in found:
        print(rig, table[["inside", "half_band", "forecast_rmse", "nrmse"]], sep="\n")
        tables.setdefault(rig, []).append(table)
    rigs = {rig: scale(own) for rig, own in tables.items()}
    claims = [claim for rig, own in rigs.items() for claim in read_off(rig, own, ">= 90")]
    return frame([*claims, *read_off("all", pd.concat(rigs.values()), "94.5 +- 4.5")])


def scale(tables: "list[pd.DataFrame]") -> "pd.DataFrame":
    """The forecasts of one rig, widths and errors over the error of their channel in all its logs."""
    table = pd.concat(tables)
    error = (table["forecast_rmse"] ** 2).groupby(level="channel").transform("mean") ** 0.5
    return table.assign(half_band=table["half_band"] / error, forecast_rmse=table["forecast_rmse"] / error)


def read_off(rig: str, table: "pd.DataFrame", bound: str) -> list[Claim]:
    """Share inside, its least, and half the width over the error."""
    width = float(np.sqrt(np.mean(table["half_band"] ** 2) / np.mean(table["forecast_rmse"] ** 2)))
    return [
        Claim(f"{rig}.inside", 100 * float(table["inside"].mean()), "%", None, bound),
        Claim(f"{rig}.inside_least", 100 * float(table["inside"].min()), "%"),
        Claim(f"{rig}.width", width, "1", None, "<= 3"),
    ]


def example_rigs() -> Forecasts:
    """Each log of an example rig from each other one."""
    for rig, pattern in RIGS.items():
        drive, given = po.read_drive(DATA / rig / "drive.toml")
        logs = [po.read_log(path, plant=drive.system()) for path in sorted((DATA / rig).glob(pattern))[:2]]
        for own, other in permutations(logs, 2):
            fit = po.identify(drive, own, given, throw=False)
            yield rig, by_channel(po.validate(drive, other, fit))


def integrating_axes(seeds: int) -> Forecasts:
    """Logs of an axis with what no model has, in windows."""
    drive = po.ForceDrive(po.Coulomb())
    for kind in ("drift", "ripple"):
        for seed in range(seeds):
            logs = [windows.make_log(kind, 10 * seed + k) for k in range(1, 6)]
            fit = po.identify(drive, logs[:3], drive.parameters.freed(*windows.TRUTH), throw=False)
            yield kind, by_channel(po.validate(drive, logs[3:], fit, window=WINDOW))


def measured(folder: Path) -> Forecasts:
    """The EMPS axis and Zillen's seals."""
    log, axis = (
        po.read_log(folder / "emps" / "emps_identification_200hz.csv", columns=EMPS),
        po.ForceDrive(po.Coulomb()),
    )
    middle = len(log.trajectory) // 2
    halves = [
        replace(log, trajectory=log.trajectory.rows(a, b), name=name, source=None)
        for a, b, name in ((0, middle, "first half"), (middle, len(log.trajectory), "second half"))
    ]
    for own, other in permutations(halves):
        fit = po.identify(axis, own, axis.parameters.freed(*EMPS_FREE), throw=False)
        yield "emps", by_channel(po.validate(axis, other, fit))
    seals = [seal_friction.read(folder / "zillen_seal_friction" / f"{n}.csv") for n in seal_friction.PUBLISHED]
    rig = po.MotionDrive(po.PressureDependent(po.Coulomb(), chambers=("pressure_a",)))
    for other in seals:
        fit = seal_friction.fit([seal for seal in seals if seal is not other])
        yield "seals", by_channel(po.validate(rig, other, fit))


def by_channel(table: "pd.DataFrame") -> "pd.DataFrame":
    """Rows of what was forecast."""
    return table.dropna(subset="inside")


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--datasets", type=Path, metavar="DIR", help="the folder with emps and zillen_seal_friction")
    options = parser.parse_args()
    sys.exit(finish(main(options.datasets), options))
