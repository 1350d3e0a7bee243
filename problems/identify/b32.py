"""The benchmark log of the drive B32 identified without a guess: six parameters of a pneumatic drive; then LuGre.

    python problems/identify/b32.py [--json FILE] [--out DIR]

A 32/12 mm cylinder under a sampled position loop sticks, slips and moves fast both ways for 10 s at 1 kHz. The truth
is integrated to 1e-10; position (20 um noise) and both pressures (1 kPa noise) are used. Free: Coulomb and static
friction, Stribeck velocity, viscous friction, conductance and leak of the valve, started from the log alone. What
is identifiable from fewer channels: b32_partial.py.
"""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.b32 import FREE, LOGGED, VALVE, generate
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd


def main() -> "pd.DataFrame":
    drive, truth = po.catalog.b32()
    claims = _identified("stribeck", drive, truth, (*FREE, *VALVE))
    drive, truth = po.catalog.b32(lugre=True)
    bristles = ("friction.bristle_stiffness", "friction.bristle_damping")
    return frame(claims + _identified("lugre", drive, truth, (*FREE, *bristles, *VALVE)))


def _identified(name: str, drive: po.PneumaticDrive, truth: po.ParameterSet, free: tuple[str, ...]) -> list[Claim]:
    log = generate(drive, truth).select(LOGGED)
    blind = truth.with_values({n: drive.parameters.value(n) for n in free}).freed(*free)
    began = time.perf_counter()
    fit = po.identify(drive.system(), [log], blind)
    seconds = time.perf_counter() - began
    claims = [Claim(f"{name}.seconds", seconds, "s"), Claim(f"{name}.iterations", fit.stats["iterations"])]
    for n, row in fit.estimates.iterrows():
        true = truth.value(str(n))
        inside = abs(row["value"] - true) / ((row["ci_high"] - row["ci_low"]) / 2)
        claims.append(Claim(f"{name}.{n}", row["value"], row["unit"], true, f"{true:g} +- {0.01 * true:.6g}"))
        claims.append(Claim(f"{name}.{n}.off", inside, "1", None, "<= 1" if name == "stribeck" else ""))
    return claims


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(), options))
