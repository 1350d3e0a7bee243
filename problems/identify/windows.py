"""Logs of an integrating axis whose slow disturbances no model has: windows, chosen by the logs, against the truth.

    python problems/identify/windows.py [--json FILE] [--out DIR]

An axis under a position controller, 12 s at 1 kHz, integrated here by code of its own. A force that no log holds
wanders over a second ("drift"), or friction varies along the way ("ripple"), three draws each. Mass, Coulomb and
viscous friction are identified by defaults from force and position; the free run over the whole log shows why windows
are needed, and the error of the worst parameter what they give.
"""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

MASS, COULOMB, VISCOUS = 20.0, 15.0, 60.0  # [kg], [N], [N*s/m]
TRUTH = {"load.mass": MASS, "friction.coulomb": COULOMB, "friction.viscous": VISCOUS}
STEP, SUBSTEPS, DURATION = 1e-3, 4, 12.0  # of the log [s], integration steps a sample, of the log [s]
DRIFT = 1.5  # force that no log holds, root mean square [N]
RIPPLE, PITCH = 0.15, 0.06  # of the Coulomb friction along the way [1], its length [m]
NOISE = 2e-7  # of the position [m]
SEEDS = (1, 2, 3)


def main() -> "pd.DataFrame":
    drive, claims, held = po.ForceDrive(po.Coulomb()), [], []
    for kind in ("drift", "ripple"):
        for seed in SEEDS:
            began = time.process_time()
            fit = po.identify(drive, make_log(kind, seed), drive.parameters.freed(*TRUTH), throw=False)
            seconds, rows, name = time.process_time() - began, fit.estimates.to_dict(orient="index"), f"{kind}.{seed}"
            agreement = fit.fit.to_dict(orient="records")[0]
            off = max(abs(fit.parameters.value(n) / v - 1) for n, v in TRUTH.items())
            held += [rows[n]["ci_low"] <= v <= rows[n]["ci_high"] for n, v in TRUTH.items()]
            print(name, fit.status, sep=": ")
            claims += [
                Claim(f"{name}.converged", float(fit.status.converged), bound=">= 1"),
                Claim(f"{name}.window", fit.window.duration if fit.window else float("nan"), "s"),
                Claim(f"{name}.worst_error", 100 * off, "%", bound="<= 5"),
                Claim(
                    f"{name}.unmarked",
                    float(sum(row["mark"] == po.Mark.EXACT for row in rows.values())),
                    "1",
                    None,
                    "<= 0",
                ),
                Claim(f"{name}.nrmse", 100 * agreement["nrmse"], "%"),
                Claim(f"{name}.free_run_nrmse", 100 * agreement["free_run_nrmse"], "%"),
                Claim(f"{name}.cpu", seconds, "s"),
            ]
    return frame([*claims, Claim("coverage", 100 * float(np.mean(held)), "%", bound=">= 85")])


def make_log(kind: str, seed: int) -> po.Experiment:
    """The force of the controller and the position of the axis."""
    rng, n, h = np.random.default_rng(seed), round(DURATION / STEP), STEP / SUBSTEPS
    t = np.arange(n) * STEP
    frequency, amplitude, phase = rng.uniform(0.2, 1.5, 5), rng.uniform(0.3, 1, 5), rng.uniform(0, 2 * np.pi, 5)
    wanted = 0.05 * np.sin(2 * np.pi * np.outer(t, frequency) + phase) @ (amplitude / frequency)
    speed_wanted = np.gradient(wanted, STEP)
    unknown, normal = 0.0, DRIFT * np.sqrt(2 * STEP) * rng.standard_normal(n) * (kind == "drift")
    x, v, position, force = wanted[0], 0.0, np.zeros(n), np.zeros(n)
    for k in range(n):
        unknown += -STEP * unknown + normal[k]
        position[k], force[k] = x, 3000 * (wanted[k] - x) + 400 * (speed_wanted[k] - v)
        for _ in range(SUBSTEPS):
            level = COULOMB * (1 + RIPPLE * np.sin(2 * np.pi * x / PITCH) * (kind == "ripple"))
            v += h * (force[k] + unknown - level * np.tanh(v / 2e-3) - VISCOUS * v) / MASS
            x += h * v
    log = po.Trajectory(t, {"position": position + NOISE * rng.standard_normal(n), "force": force})
    return po.Experiment(log, name=f"{kind} {seed}").with_intersample({"force": po.Intersample.HELD})


if __name__ == "__main__":
    sys.exit(finish(main(), arguments(__doc__).parse_args()))
