"""A measured voltage-to-speed step without pressures: fit the plant, predict a held-out step, tune the loop.

    python problems/identify/step_response.py [PATH ...] [--json FILE] [--out DIR]

Fitted are gain, natural frequency, damping and dead time, and Coulomb friction where the log shows it: kept if it
lowers the Bayesian information criterion. The last path is held out and only predicted. Without a path: the generated
steps of data/step_rig, whose generating values stand in its truth.toml (exact dead time, noise 1 mm/s, quantised to
0.5 mm/s).
"""

import math
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, design, finish, frame

if TYPE_CHECKING:
    import pandas as pd

DATA = Path(__file__).parents[2] / "data" / "step_rig"
GENERATED = [DATA / f"{name}.csv" for name in ("step_up_and_back", "step_through_zero", "step_held_out")]
TRUTH = tomllib.loads((DATA / "truth.toml").read_text(encoding="utf-8"))  # the generating values [SI]
SMOOTHING = 2e-3  # [m/s]
PADE_ORDER = 3
STEPS = [po.Step(0.1, horizon=1.0), po.Step(0.3, horizon=1.0)]  # [m/s]
HAND = {"pid.Kp": 4.0, "pid.Ki": 60.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}
RANGES = {
    "pid.Kp": (0.1, 60.0),
    "pid.Ki": (1.0, 1000.0),
    "pid.Kd": (0.0, 3.0),
    "pid.Tf": (0.004, 0.05),
    "dither.amplitude": (0.0, 1.0),
    "dither.offset": (-1.0, 1.0),
}
LIMITS = {"overshoot": "<= 2", "max_sensitivity": "<= 1.6"}


def main(paths: list[Path]) -> "pd.DataFrame":
    truth = TRUTH if paths == GENERATED else {}
    *fitted, held_out = (po.read_log(path) for path in paths)
    plant, result, better = choose(fitted)
    claims = [Claim("friction.bic_gain", better), Claim("fit.iterations", result.stats["iterations"])]
    for name, row in result.estimates.iterrows():
        claims += _beside_truth(str(name), row, truth.get(str(name)))
    held = po.validate(plant, [held_out], result.parameters).iloc[0]
    claims.append(Claim("held_out.nrmse", held["nrmse"], "1", None, "<= 0.02"))
    before, best = tuned(plant, result.parameters)
    claims += design("hand", before[0], before[1]) + design("tuned", best.parameters, best.certified, LIMITS)
    return frame(claims)


def tuned(plant: po.System, fitted: po.ParameterSet) -> "tuple[tuple[po.ParameterSet, pd.DataFrame], po.TuningResult]":
    """A plain hand setting (a PI of moderate gain), and gains with dither tuned for the fitted plant."""
    loop = po.ClosedLoop(plant, po.PID(sample_time=0.002), po.Dither(frequency=100.0))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    given = (fitted.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)
    limits = (po.Overshoot(0.02), po.MaxSensitivity(1.6))
    best = po.tune(loop, STEPS, given, minimise=po.SettlingTime(band=0.02), subject_to=limits, plants={})
    return (given, po.evaluate(loop, STEPS, given)), best


def choose(logs: list[po.Experiment]) -> tuple[po.System, po.IdentificationResult, float]:
    """The plant with or without Coulomb friction, its fit, and by how much friction lowers the BIC."""
    plain = po.SecondOrder(pade_order=PADE_ORDER).system()
    rubbing = po.SecondOrder(pade_order=PADE_ORDER, friction=po.Coulomb()).system()
    without = po.identify(plain, logs, plain.parameters.freed("plant.*"), throw=False)  # it may just not fit
    start = rubbing.parameters.with_values({"friction.smoothing": SMOOTHING})
    with_friction = po.identify(rubbing, logs, start.freed("plant.*", "friction.coulomb"))
    better = information(without) - information(with_friction)
    return (rubbing, with_friction, better) if better > 0 else (plain, without, better)


def information(result: po.IdentificationResult) -> float:
    """Bayesian information criterion, n log(mean square) + k log(n), of a fit to one channel (Schwarz, 1978)."""
    n = result.fit["samples"].sum()
    square = (result.fit["rmse"] ** 2 * result.fit["samples"]).sum() / n
    return float(n * math.log(square) + len(result.estimates) * math.log(n))


def _beside_truth(name: str, row: "pd.Series[float]", truth: float | None) -> list[Claim]:
    """The estimate, and how far the generating value is off in half widths of the 95 % interval."""
    rows = [Claim(name, row["value"], str(row["unit"]), truth)]
    if truth is not None:
        off = abs(truth - row["value"]) / ((row["ci_high"] - row["ci_low"]) / 2)
        rows.append(Claim(f"{name}.off", off, "1", None, "<= 1"))
    return rows


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("paths", type=Path, nargs="*", default=GENERATED, help="logs; the last is held out")
    options = parser.parse_args()
    sys.exit(finish(main(options.paths), options))
