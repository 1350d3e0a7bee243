"""Friction of a real servo axis from its log: the EMPS benchmark, beside the published values; then a speed loop on it.

    python problems/identify/emps.py PATH/emps_identification_1khz.csv [--json FILE] [--out DIR]

Data and published values (IDIM-LS): A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS",
Workshop on Nonlinear System Identification Benchmarks, 2019. The position is fitted freely over windows of 250 ms
that do not overlap, their start states estimated too; so RMSEs compare with those of the published parameters under
the same rule. Before any fit the tool is asked whether offset and Coulomb asymmetry can be told apart, and afterwards
which static friction model the log supports.
"""

import sys
import time
from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, design, finish, frame

if TYPE_CHECKING:
    import pandas as pd

WINDOW = 0.25  # [s]
SMOOTHING = 1e-3  # [m/s] over which Coulomb friction turns round
COLUMNS: dict[str, str | dict[str, str | float]] = {
    "time": "time_s",
    "position": "position_m",
    "force": {"column": "drive_voltage_V", "unit": "V", "scale": "35.15065 N/V"},
}
SYMMETRIC = {"load.mass": 95.1089, "load.force": -3.1648, "friction.coulomb": 20.3935, "friction.viscous": 203.5034}
LEVELS = ("friction.coulomb", "friction.viscous", "friction.static", "friction.stribeck_velocity")
SELECTED = ("load.mass", "load.force", *LEVELS, "friction.viscous_asymmetry")
DRIVE_LIMIT = 351.5065  # [N] 10 V at 35.15065 N/V
STEPS = [po.Step(0.02, horizon=1.5), po.Step(0.2, horizon=1.5)]  # [m/s]
HAND = {"pid.Kp": 1000.0, "pid.Ki": 5000.0, "pid.Tf": 0.005, "pid.lower": -DRIVE_LIMIT, "pid.upper": DRIVE_LIMIT}
RANGES = {
    "pid.Kp": (100.0, 1e4),
    "pid.Ki": (100.0, 2e5),
    "pid.Kd": (0.0, 50.0),
    "pid.Tf": (0.002, 0.05),
    "dither.amplitude": (0.0, 20.0),
    "dither.offset": (-20.0, 20.0),
}
LIMITS = {"overshoot": "<= 2", "max_sensitivity": "<= 1.4"}
RMSE_PUBLISHED = {"symmetric": 4.03e-5, "asymmetric": 2.18e-5}


@dataclass(frozen=True)
class Fitted:
    """A fit, its RMSE over all windows [m] and the seconds it took."""

    result: po.IdentificationResult
    rmse: float
    seconds: float


def main(path: Path) -> "pd.DataFrame":
    log = po.read_log(path, columns=COLUMNS)
    windows = po.split(log.with_intersample({"force": po.Intersample.HELD}), WINDOW)  # the drive's command
    claims = [
        Claim("windows", len(windows)),
        Claim("smoothing", SMOOTHING, "m/s", bound="<= 1e-3"),
    ]
    symmetric, asymmetric = po.ForceDrive(po.Coulomb()), po.ForceDrive(po.Asymmetric(po.Coulomb()))
    fit = _fit(symmetric, windows, ("load.*", "friction.coulomb", "friction.viscous"))
    claims += _beside_published("symmetric", fit, SYMMETRIC) + _quality("symmetric", fit, "<= 3.9e-5")
    fit = _fit(asymmetric, windows, ("load.mass", "friction.coulomb", "friction.viscous", "friction.*_asymmetry"))
    claims += _directions(fit) + _quality("asymmetric", fit, "<= 1.90e-5")
    claims += _inseparable(asymmetric, windows, fit.rmse) + _selected(windows)
    return frame(claims + _tuned(asymmetric, fit.result.parameters))


def _fit(drive: po.ForceDrive, windows: tuple[po.Experiment, ...], free: tuple[str, ...]) -> Fitted:
    parameters = drive.parameters.freed(*free)
    began = time.perf_counter()
    result = po.identify(drive.system(), windows, parameters, method=po.LeastSquares(segment_time=WINDOW))
    seconds = time.perf_counter() - began
    squares, samples = (result.fit["rmse"] ** 2 * result.fit["samples"]).sum(), result.fit["samples"].sum()
    return Fitted(result, sqrt(squares / samples), seconds)


def _inseparable(drive: po.ForceDrive, windows: tuple[po.Experiment, ...], level: float) -> list[Claim]:
    """What the tool says of offset and Coulomb asymmetry together, at the level of a fit's residuals [m].

    The encoder's noise is 400 times lower: with a model that were right down to it the log would separate the two.
    """
    windows = tuple(window.with_noise({"position": level}) for window in windows)
    asked = drive.parameters.freed("load.*", "friction.coulomb", "friction.viscous", "friction.*_asymmetry")
    verdict = po.identifiability(drive.system(), windows, asked, method=po.LeastSquares(segment_time=WINDOW))
    print(verdict)
    pair = ("load.force", "friction.coulomb_asymmetry")
    return [
        Claim("inseparable.offset_and_asymmetry", float(pair in verdict.indistinguishable), bound=">= 1"),
        Claim("inseparable.others", float(len(verdict.indistinguishable) - 1), bound="<= 0"),
        *(Claim(f"inseparable.inflation.{name}", verdict.table["inflation"][name]) for name in pair),
    ]


def _selected(windows: tuple[po.Experiment, ...]) -> list[Claim]:
    """`select_model` over the static friction models; every fourth window is held out."""
    drives = {n: po.ForceDrive(f).system() for n, f in po.friction_ladder().items() if not f.states}
    held_out = windows[3::4]
    chosen = po.select_model(
        drives,
        [w for w in windows if w not in held_out],
        po.ParameterSet(),
        free=SELECTED,
        held_out=held_out,
        method=po.LeastSquares(segment_time=WINDOW),
    )
    print(chosen.reason)
    rows = []
    for name, row in chosen.table.to_dict(orient="index").items():
        rows.append(Claim(f"selected.{name}.bic_above", row["bic_above"]))
        rows.append(Claim(f"selected.{name}.held_out_nrmse", row["held_out_nrmse"]))
    at_bound = chosen.fits[chosen.recommended].estimates["at_bound"].sum()
    return [*rows, Claim(f"selected.{chosen.recommended}.at_bound", float(at_bound))]


def _tuned(drive: po.ForceDrive, fitted: po.ParameterSet) -> list[Claim]:
    """A sampled speed loop on the fitted axis (ideal speed sensing), a plain PI beside it."""
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), po.Dither(frequency=100.0))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    given = (fitted.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)
    limits = (po.Overshoot(0.02), po.MaxSensitivity(1.4))
    best = po.tune(loop, STEPS, given, minimise=po.SettlingTime(band=0.02), subject_to=limits, plants={})
    rows = design("hand", given, po.evaluate(loop, STEPS, given))
    return rows + design("tuned", best.parameters, best.certified, LIMITS)


def _beside_published(model: str, fit: Fitted, published: dict[str, float]) -> list[Claim]:
    estimates = fit.result.estimates
    rows = []
    for name, value in published.items():
        within = f"{value} +- {0.06 * abs(value):.6g}"
        rows.append(Claim(f"{model}.{name}", estimates["value"][name], estimates["unit"][name], value, within))
    return rows


def _directions(fit: Fitted) -> list[Claim]:
    """Forward and backward levels; published: Janot et al., asymmetric IDIM-LS."""
    value = fit.result.parameters.value
    rows = [Claim("asymmetric.load.mass", value("load.mass"), "kg", 95.1540)]
    for level, unit, published in (("viscous", "N*s/m", (166.7061, 240.4236)), ("coulomb", "N", (20.1440, 20.6277))):
        for side, sign, reference in (("forward", 1, published[0]), ("backward", -1, published[1])):
            found = value(f"friction.{level}") * (1 + sign * value(f"friction.{level}_asymmetry"))
            rows.append(Claim(f"asymmetric.{level}.{side}", found, unit, reference))
    return rows


def _quality(model: str, fit: Fitted, bound: str) -> list[Claim]:
    return [
        Claim(f"{model}.rmse", fit.rmse, "m", RMSE_PUBLISHED[model], bound),
        Claim(f"{model}.iterations", fit.result.stats["iterations"]),
        Claim(f"{model}.seconds", fit.seconds, "s"),
    ]


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("path", type=Path, help="emps_identification_1khz.csv")
    options = parser.parse_args()
    sys.exit(finish(main(options.path), options))
