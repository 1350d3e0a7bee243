"""Coulomb friction of cylinder seals against pressure, from measured logs: one joint fit over four pressures.

    python problems/identify/seal_friction.py DIR/zillen_seal_friction [--json FILE] [--out DIR]

Data: E. Zillen, "3D-printed-pneumatic-actuator", TU Delft thesis data, 2021, CC0-1.0. A piston of 25 mm is moved to
and fro at 5-15 mm/s with a constant pressure behind it. The published half-ranges of the O-ring's friction (author's
method: force less pressure x area) stand beside ours, which share one level and one slope against pressure, with a
sensor offset a log. Speeds are so few that viscous and Stribeck terms, and a mass, cannot be identified;
`identifiability` refuses them in words, before anything is fitted, and they are left out. The interval
counts how the four logs scatter about the line, with hardly more than one degree of freedom; how far the slope moves
when one of the four logs is left out stands beside it.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

PUBLISHED = {"oring_1bar": 3.92, "oring_3bar": 5.44, "oring_5bar": 6.92, "oring_7bar": 7.81}  # [N]
COLUMNS: dict[str, str | dict[str, str | float]] = {
    "time": "time_s",
    "position": "position_m",
    "pressure_a": {"column": "pressure_gauge_Pa", "unit": "Pa(g)"},
    "force": "force_N",
}
SLOPE = "friction.coulomb_pressure_a"
LEVEL, TERMS = "friction.coulomb", ("friction.viscous", "friction.static", "friction.stribeck_velocity")
FILTER_TIME = 0.5  # [s] the speed is a smoothed derivative of the position


def main(folder: Path) -> "pd.DataFrame":
    logs = [read(folder / f"{name}.csv") for name in PUBLISHED]
    result = fit(logs)
    value = result.estimates["value"]
    claims = []
    for log in logs:
        gauge = float(log.trajectory["pressure_a"].mean()) - result.parameters.value("ambient.pressure")
        level = value["friction.coulomb"] + value[SLOPE] * gauge
        published = PUBLISHED[log.name]
        claims.append(Claim(f"{log.name}.half_range", level, "N", published, f"{published} +- {0.1 * published:.4g}"))
        claims.append(Claim(f"{log.name}.offset", value[f"rig.force_offset[{log.name}]"], "N"))
    claims += _slope(result) + _refused(logs)
    others = [fit([log for log in logs if log is not left_out]).estimates["value"][SLOPE] for left_out in logs]
    claims.append(Claim("slope.without_one.low", 1e5 * min(others), "N/bar"))
    claims.append(Claim("slope.without_one.high", 1e5 * max(others), "N/bar"))
    return frame(claims)


def read(path: Path) -> po.Experiment:
    """A log with the speed that the rig imposed."""
    log = po.differentiate(po.read_log(path, columns=COLUMNS), window=FILTER_TIME)
    return log.select(["speed", "pressure_a", "force"])


def fit(logs: list[po.Experiment]) -> po.IdentificationResult:
    """One level and slope for all logs, an offset for each."""
    rig = po.MotionDrive(po.PressureDependent(po.Coulomb(), chambers=("pressure_a",)))
    p = rig.parameters.with_values({"friction.viscous": 0.0, "friction.smoothing": 1e-3})
    p = p.freed("friction.coulomb", "friction.coulomb_pressure_a", "rig.force_offset")
    return po.identify(rig.system(), logs, p.per_log("rig.force_offset"))


def _refused(logs: list[po.Experiment]) -> list[Claim]:
    """What the tool says it cannot tell from these logs if it is asked for: 1 where it refuses."""
    rig = po.MotionDrive(po.PressureDependent(po.Stribeck(), chambers=("pressure_a",)))
    asked = rig.parameters.freed(LEVEL, SLOPE, *TERMS, "rig.force_offset").per_log("rig.force_offset")
    axis = po.ForceDrive(po.Coulomb())
    verdicts = {
        TERMS: po.identifiability(rig.system(), logs, asked),
        ("load.mass",): po.identifiability(
            axis.system(), [_pushed(log) for log in logs], axis.parameters.freed("load.mass", LEVEL)
        ),
    }
    for verdict in verdicts.values():
        print(verdict)
    return [
        Claim(f"refused.{name}", float(name in verdict.unidentifiable), bound=">= 1")
        for names, verdict in verdicts.items()
        for name in names
    ]


def _pushed(log: po.Experiment) -> po.Experiment:
    """The piston as an axis, pushed by the measured force less the pressure's."""
    rig = po.MotionDrive(po.Coulomb()).parameters
    gauge = log.trajectory["pressure_a"] - rig.value("ambient.pressure")
    force = log.trajectory["force"] - rig.value("rig.area") * gauge
    return po.Experiment(log.trajectory.with_columns({"force": force}), name=log.name).select(["speed", "force"])


def _slope(result: po.IdentificationResult) -> list[Claim]:
    figures = {name: 1e5 * result.estimates[name][SLOPE] for name in ("value", "ci_low", "ci_high")}
    return [Claim(f"slope.{name}", figure, "N/bar") for name, figure in figures.items()]


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("folder", type=Path, help="the folder zillen_seal_friction")
    options = parser.parse_args()
    sys.exit(finish(main(options.folder), options))
