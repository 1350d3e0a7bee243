"""The main job on the generated rig of data/force_rig: identify from a log, tune PID and dither, certify; one picture.

    python problems/rig_demo.py [--json FILE] [--out DIR]

A known force moves a load against Stribeck friction. Friction, mass and load are identified from run_01 without a
guess, run_02 is only predicted; then a sampled speed PID and the dither's amplitude and offset are tuned for two
steps, beside a plain hand setting and beside the PID alone. Certified figures come from an integration that shares
nothing with the optimiser.
"""

import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from claims import Claim, arguments, design, finish, frame

import pneuopt as po

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DATA = Path(__file__).parents[1] / "data" / "force_rig"
TRUTH = tomllib.loads((DATA / "truth.toml").read_text(encoding="utf-8"))  # the generating values [SI]
STEPS = [po.Step(0.05, horizon=0.6), po.Step(0.25, horizon=0.6)]  # [m/s]
HAND = {"pid.Kp": 400.0, "pid.Ki": 4000.0, "pid.Tf": 0.005, "pid.lower": -250.0, "pid.upper": 250.0}
RANGES = {
    "pid.Kp": (20.0, 2000.0),
    "pid.Ki": (100.0, 1e5),
    "pid.Kd": (0.0, 5.0),
    "pid.Tf": (0.002, 0.05),
    "dither.amplitude": (0.0, 60.0),
    "dither.offset": (-60.0, 60.0),
}
LIMITS = (po.Overshoot(0.02), po.MaxSensitivity(1.4), po.PeakControl(150.0))
BOUNDS = {"settling_time": "<= 0.1", "overshoot": "<= 2", "peak_control": "<= 150", "max_sensitivity": "<= 1.4"}


@dataclass(frozen=True, eq=False)
class Demo:
    """What the steps of the job gave."""

    system: po.System
    log: po.Experiment
    fit: po.IdentificationResult
    held_out: "pd.DataFrame"
    loop: po.ClosedLoop
    given: po.ParameterSet
    before: "pd.DataFrame"
    pid_only: po.TuningResult
    best: po.TuningResult


def run() -> Demo:
    drive = po.ForceDrive(po.Stribeck())
    log, held_out = (po.read_log(DATA / f"{name}.csv") for name in ("run_01", "run_02"))
    system = drive.system()
    fit = po.identify(system, [log], drive.parameters.freed(*TRUTH))
    loop = po.ClosedLoop(system, po.PID(sample_time=1e-3), po.Dither(frequency=100.0))
    own = loop.parameters.select(loop.parameters.matching("pid.*", "dither.*"))
    given = (fit.parameters.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)
    asked = po.SettlingTime(band=0.02)
    pid_only = po.tune(loop, STEPS, given.fixed("dither.*"), minimise=asked, subject_to=LIMITS)
    best = po.tune(loop, STEPS, given, minimise=asked, subject_to=LIMITS)
    before = po.evaluate(loop, STEPS, given)
    return Demo(system, log, fit, po.validate(system, [held_out], fit.parameters), loop, given, before, pid_only, best)


def main(demo: Demo) -> "pd.DataFrame":
    claims = [
        Claim("fit.iterations", demo.fit.stats["iterations"]),
        Claim("fit.seconds", demo.fit.stats["seconds"], "s"),
    ]
    for name, row in demo.fit.estimates.iterrows():
        truth = TRUTH[str(name)]
        within = f"{truth:g} +- {0.01 * truth:g}"
        claims.append(Claim(str(name), row["value"], row["unit"], truth, within))
        claims.append(Claim(f"{name}.half_width", (row["ci_high"] - row["ci_low"]) / 2, row["unit"]))
    claims.append(Claim("held_out.nrmse", demo.held_out["nrmse"].iloc[0], "1", None, "<= 0.01"))
    claims += design("hand", demo.given, demo.before)
    claims += design("pid_only", demo.pid_only.parameters, demo.pid_only.certified)
    claims += design("tuned", demo.best.parameters, demo.best.certified, BOUNDS)
    return frame(claims)


def figure(demo: Demo) -> "Figure":
    import matplotlib.pyplot as plt

    picture, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained")
    _draw_log(axes[0, 0], demo)
    _draw_friction(axes[0, 1], demo)
    _draw_steps(axes[1, 0], axes[1, 1], demo)
    for ax in axes.flat:
        ax.grid(True, alpha=0.25)
        ax.spines[["top", "right"]].set_visible(False)
    return picture


def _draw_log(ax: "Axes", demo: Demo) -> None:
    t, fitted = demo.log.trajectory.t, demo.fit.trajectories[demo.log.name]
    ax.plot(t, 1e3 * demo.log.trajectory["position"], color="0.6", lw=4, label="logged")
    ax.plot(t, 1e3 * fitted["position"], lw=1, label="fitted")
    ax.set(title="1  identify: the log", xlabel="time [s]", ylabel="position [mm]")
    ax.legend(frameon=False)


def _draw_friction(ax: "Axes", demo: Demo) -> None:
    v = np.linspace(-0.3, 0.3, 1201)
    value = demo.fit.parameters.value
    level = value("friction.coulomb") + (value("friction.static") - value("friction.coulomb")) * np.exp(
        -((v / value("friction.stribeck_velocity")) ** 2)
    )
    force = level * np.tanh(v / value("friction.smoothing")) + value("friction.viscous") * v
    ax.plot(v, force)
    ax.set(title="2  what it tells: friction", xlabel="speed [m/s]", ylabel="friction force [N]")


def _draw_steps(left: "Axes", right: "Axes", demo: Demo) -> None:
    for label, parameters, style in (("hand", demo.given, "--"), ("tuned", demo.best.parameters, "-")):
        for number, step in enumerate(STEPS):
            t = np.arange(0, step.horizon + 1e-9, 1e-3)
            grid = po.Trajectory(t, {"reference": np.full_like(t, step.final)})
            response = po.simulate(demo.loop, grid, parameters)
            colour, name = f"C{number}", f"{label}, {step.final:g} m/s"
            left.plot(1e3 * t, response["speed"], style, color=colour, label=name)
            right.plot(1e3 * t, response["control"], style, color=colour, lw=1)
    left.set(title="3  tune and certify: speed", xlabel="time [ms]", ylabel="speed [m/s]", xlim=(0, 300))
    right.set(title="    the force that it takes", xlabel="time [ms]", ylabel="force [N]", xlim=(0, 300))
    left.legend(frameon=False, loc=(0.55, 0.33))


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    demo = run()
    sys.exit(finish(main(demo), options, lambda: {"rig_demo": figure(demo)}))
