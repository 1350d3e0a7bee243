"""The next experiment: the run that tells most about friction, beside a usual log of the same duration.

    python problems/identify/next_experiment.py [--cpu-seconds 120] [--json FILE] [--out DIR]

Two cases: the bristles of B32 (LuGre; position and pressures logged, sampled position loop, beside the reference of the
benchmark's log), and an axis like the EMPS (published values, force and position logged, position loop within its force
and speed, beside smooth moves to and fro within the same limits). The usual log is identified first; a third of its
standard errors is what the planned run shall reach. That run is simulated tightly, with noise, and identified likewise.
Rows *.achieved.*: standard error by the fit over the predicted one; *.narrower.*: that of the usual log over the
planned run's. Both searches end at the time that is given, and would go on gaining.
"""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from pneuopt.plotting import plot_experiment
from problems.shared.b32 import FREE, NOISE, VALVE, reference
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STEP, SEED = 1e-3, 1
NARROWER, CPU_SECONDS = 3, 120.0  # times that intervals shall shrink [1]; of a search [s]
BRISTLES = ("friction.bristle_stiffness", "friction.bristle_damping")
AXIS = {"load.mass": 95.1, "load.force": -3.16, "friction.coulomb": 20.4, "friction.viscous": 203.5}
B32_GAINS = {"pid.Kp": 4.0, "pid.Kd": 0.15, "pid.Tf": 3e-3, "pid.lower": -0.6, "pid.upper": 0.6, "pid.c": 0.0}
AXIS_GAINS = {"pid.Kp": 9e4, "pid.Kd": 4e3, "pid.Tf": 3e-3, "pid.lower": -150.0, "pid.upper": 150.0, "pid.c": 0.0}


def main(
    duration: float = 10.0, cpu_seconds: float = CPU_SECONDS, drawn: "dict[str, Figure] | None" = None
) -> "pd.DataFrame":
    drawn = {} if drawn is None else drawn
    drive, truth = po.catalog.b32(lugre=True)
    t = STEP * np.arange(round(duration / STEP))
    levels = {n: NOISE[n] for n in ("position", "pressure_a", "pressure_b")}
    usual, limits = np.array([reference(s) for s in t.tolist()]), {"position": (0.03, 0.17)}
    known, free = truth.with_values({}), (*FREE, *BRISTLES, *VALVE)
    claims = _case("b32", drive, known, B32_GAINS, free, BRISTLES, levels, limits, usual, cpu_seconds, drawn)
    axis = po.ForceDrive(po.Coulomb())
    known = axis.parameters.with_values(AXIS)
    limits = {"position": (0.0, 0.25), "speed": (-0.25, 0.25), "force": (-150.0, 150.0)}
    usual = 0.125 - 0.099 * np.cos(2 * np.pi * t / 2.5)
    wanted = ("friction.coulomb", "friction.viscous")
    return frame(
        claims
        + _case(
            "emps", axis, known, AXIS_GAINS, tuple(AXIS), wanted, {"position": 2e-5}, limits, usual, cpu_seconds, drawn
        )
    )


def _case(
    name: str,
    drive: Any,
    known: po.ParameterSet,
    gains: dict[str, float],
    free: tuple[str, ...],
    targets: tuple[str, ...],
    noise: dict[str, float],
    limits: dict[str, tuple[float, float]],
    usual: NDArray[np.float64],
    cpu_seconds: float,
    drawn: "dict[str, Figure]",
) -> list[Claim]:
    """A design, its log and the usual one identified: predicted, achieved, and how much narrower."""
    loop = po.ClosedLoop(drive, po.PID(sample_time=STEP), measured="position")
    asked = known.freed(*free)
    own = (asked | loop.parameters.select(loop.parameters.match_names("pid.*"))).with_values(gains)
    before = po.identify(drive, _log(loop, own, usual, noise), asked, throw=False)
    relative = before.estimates["stderr"] / before.estimates["value"].abs()
    wanted = {n: float(relative[n]) / NARROWER for n in targets}
    began = time.process_time()
    design = po.next_experiment(
        *(loop, own),
        duration=STEP * len(usual),
        limits=limits,
        noise=noise,
        criterion=po.WantedPrecision(wanted),
        plants={},
        cpu_seconds=cpu_seconds,
    )
    seconds = time.process_time() - began
    print(design)
    drawn[f"next_experiment_{name}"] = plot_experiment(design)
    planned = po.identify(drive, _log(loop, own, design.excitation["position_reference"], noise), asked, throw=False)
    compared = design.compare(planned, alone=True)
    narrower = before.estimates["stderr"] / planned.estimates["stderr"]
    rows = [
        Claim(f"{name}.design", seconds, "s"),
        Claim(f"{name}.limits", max(design.room.values()), "1", None, "<= 0"),
    ]
    for n in targets:
        rows.append(Claim(f"{name}.achieved.{n}", compared["ratio"][n], "1", None, "1 +- 0.1"))
        rows.append(Claim(f"{name}.narrower.{n}", narrower[n], "1", None, f">= {NARROWER}"))
    volume = float(np.exp(np.log(narrower[list(targets)].astype(float)).mean()))
    return [*rows, Claim(f"{name}.narrower.mean", volume)]


def _log(
    loop: po.ClosedLoop, parameters: po.ParameterSet, wanted: NDArray[np.float64], noise: dict[str, float]
) -> po.Experiment:
    """The log of a run by the tight simulation: the command, and the outputs with noise."""
    t, draw = STEP * np.arange(len(wanted)), np.random.default_rng(SEED)
    start = loop.initial(parameters, reference=float(wanted[0]))
    run = po.simulate(loop, po.Trajectory(t, {"reference": wanted}), parameters, initial=start)
    read = {n: run[n] + level * draw.standard_normal(len(t)) for n, level in noise.items()}
    log = po.Experiment(po.Trajectory(t, {loop.command.name: run["control"], **read}), noise, name="run")
    return log.with_intersample({loop.command.name: po.Intersample.HELD})


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--cpu-seconds", type=float, default=CPU_SECONDS, help="of each search")
    options = parser.parse_args()
    figures: "dict[str, Figure]" = {}
    rows = main(cpu_seconds=options.cpu_seconds, drawn=figures)
    sys.exit(finish(rows, options, lambda: figures))
