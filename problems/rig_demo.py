"""The main job on the rig of data/pneumatic_rig: identify from a log, tune PID and dither, certify; one picture.

    python problems/rig_demo.py [--json FILE] [--out DIR]

A hand-tuned speed loop hunts. From its log alone, friction and valve are identified without a guess; then a sampled PID
and the dither's amplitude and offset are tuned for a slow step, a fast one and a fast one back, beside the hand setting
and the same tuning without dither. Certified figures come from an integration that shares nothing with the optimiser:
on the smooth model, and on the rig model (Karnopp's friction, valve hysteresis, encoder steps), which no step of the
job has seen.
"""

import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from claims import Claim, arguments, design, finish, frame
from numpy.typing import NDArray

import pneuopt as po
from pneuopt.plotting.canvas import BLUE, GREY, ORANGE, axes_grid, legend_above
from pneuopt.system import Rest, RestFinder

Array = NDArray[np.float64]

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DATA = Path(__file__).parents[1] / "data" / "pneumatic_rig"
TRUTH: dict[str, Any] = tomllib.loads((DATA / "truth.toml").read_text(encoding="utf-8"))  # the generating values [SI]
RIG = TRUTH.pop("rig")
SAMPLE = 1e-3  # [s]
STEPS = [
    po.Step(0.1, horizon=0.6),  # [m/s], from 120 mm of 300 mm
    po.Step(0.25, horizon=0.45),
    po.Step(-0.25, horizon=0.45, start={"position": 0.18}),
]
HAND = {"pid.Kp": 1.0, "pid.Ki": 15.0, "pid.Tf": 0.002, "pid.lower": -5.0, "pid.upper": 5.0}
RANGES = {
    "pid.Kp": (0.1, 4.0),
    "pid.Ki": (2.0, 60.0),
    "pid.Kd": (0.0, 0.15),
    "dither.amplitude": (0.0, 1.5),
    "dither.offset": (-0.5, 0.5),
}
LIMITS = (po.Overshoot(0.04), po.MaxSensitivity(1.6))
SEARCH = po.Screening(members=32, generations=6, refinements=100)
WITHIN = {  # relative distance of the estimates from the generating values: what the rig has and the model has not
    "valve.conductance": 0.02,
    "valve.dead_zone": 0.15,
    "friction.coulomb": 0.03,
    "friction.static": 0.03,
    "friction.stribeck_velocity": 0.2,
    "friction.viscous": 0.1,
}
BOUNDS = {"settling_time": "<= 0.2", "overshoot": "<= 4", "steady_state_error": "<= 1", "max_sensitivity": "<= 1.6"}
RIG_BOUNDS = {"settling_time": "<= 0.2", "overshoot": "<= 8", "steady_state_error": "<= 1"}
SHOWN = {
    "hand": (ORANGE, "before: set by hand"),
    "pid_only": (GREY, "PID tuned, without dither"),
    "tuned": (BLUE, "after: PID and dither tuned"),
}


@dataclass(frozen=True, eq=False)
class Design:
    """One setting of the controller, and its certificates: a row a metric, a column a step."""

    parameters: po.ParameterSet
    smooth: "pd.DataFrame"
    rig: "pd.DataFrame"


@dataclass(frozen=True, eq=False)
class Demo:
    """What the steps of the job gave."""

    log: po.Experiment
    fit: po.IdentificationResult
    held_out: "pd.DataFrame"
    designs: dict[str, Design]
    seconds: dict[str, float]


def run() -> Demo:
    drive, given = po.read_drive(DATA / "drive.toml")
    log, held_out = (po.read_log(DATA / f"{name}.csv") for name in ("run_01", "run_02"))
    began = perf_counter()
    fit = po.identify(drive.system(), [log], given)
    seconds = {"identify": perf_counter() - began}
    loop = speed_loop(drive.system())
    own = loop.parameters.select(loop.parameters.matching("pid.*", "dither.*"))
    free = (fit.parameters.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)
    designs = {"hand": Design(free, po.evaluate(loop, STEPS, free), on_rig(free))}
    for name, start in {"pid_only": free.fixed("dither.*"), "tuned": free}.items():
        began = perf_counter()
        best = po.tune(loop, STEPS, start, minimise=po.SettlingTime(0.02), subject_to=LIMITS, method=SEARCH)
        seconds[name] = perf_counter() - began
        designs[name] = Design(best.parameters, best.certified, on_rig(best.parameters))
    return Demo(log, fit, po.validate(drive.system(), [held_out], fit.parameters), designs, seconds)


def speed_loop(system: po.System) -> po.ClosedLoop:
    """The loop as tuned: the controller sees the speed through the lag of the encoder's filter and differences."""
    sensor = po.Sensor(lag=RIG["speed_filter"] + SAMPLE / 2)
    sensed = po.Rig(system, {"speed": sensor}).sensed
    plant = replace(sensed, rest_finder=_resting(system), checker=system.checker, guards=system.guards)
    return po.ClosedLoop(plant, po.PID(sample_time=SAMPLE), po.Dither(frequency=100.0), measured="sensor.speed")


def the_rig() -> po.Rig:
    """The rig model that the logs come from, under the controller to be proven."""
    drive = po.PneumaticDrive(friction=po.Karnopp(po.Stribeck()))
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=SAMPLE), po.Dither(frequency=100.0))
    pressure = po.Sensor(RIG["pressure_lag"], RIG["pressure_noise"], RIG["pressure_resolution"])
    sensors = {"position": po.Sensor(resolution=RIG["position_resolution"]), "pressure_a": pressure}
    actuator, encoder = po.Actuator(RIG["valve_hysteresis"]), po.Encoder(filter_time=RIG["speed_filter"])
    return po.Rig(loop, sensors | {"pressure_b": pressure}, actuator, encoder)


def rig_parameters(design: po.ParameterSet) -> po.ParameterSet:
    """The hardware that generated the logs, under a design's controller: nothing that was identified is left."""
    full = the_rig().model.parameters
    return full.with_values({n: design.value(n) for n in full if n in design} | TRUTH)


def on_rig(design: po.ParameterSet) -> "pd.DataFrame":
    """The certificate of a design's controller on the rig model."""
    return po.evaluate(the_rig(), STEPS, rig_parameters(design))


def main(demo: Demo) -> "pd.DataFrame":
    claims = [Claim(f"{name}.seconds", value, "s") for name, value in demo.seconds.items()]
    claims.append(Claim("fit.gap_share", demo.fit.stats["gap_share"], "1"))
    for name, row in demo.fit.estimates.iterrows():
        true, value = TRUTH[str(name)], row["value"]
        within = f"{true:g} +- {WITHIN[str(name)] * true:.6g}"
        claims.append(Claim(str(name), value, row["unit"], true, within))
        claims.append(Claim(f"{name}.bias", 100 * (value / true - 1), "%"))
        claims.append(Claim(f"{name}.deviations", (value - true) / row["stderr"]))
    unseen = demo.held_out.reset_index().to_dict("records")
    claims += [Claim(f"held_out.{r['channel']}.nrmse", r["nrmse"]) for r in unseen]
    for name, found in demo.designs.items():
        bounds, rig_bounds = (BOUNDS, RIG_BOUNDS) if name == "tuned" else ({}, {})
        claims += design(name, found.parameters, found.smooth, bounds)
        claims += design(f"{name}.rig", po.ParameterSet(), found.rig, rig_bounds)
    return frame(claims)


def figure(demo: Demo) -> "Figure":
    picture, grid = axes_grid(5, 2, (1.5, 2.2, 1.3, 1.5, 1.3))
    _draw_log(grid[0][0], demo)
    _draw_friction(grid[0][1], demo)
    rig = the_rig()
    for column, step in enumerate((STEPS[0], STEPS[2])):
        rows = [row[column] for row in grid[1:]]
        for name, (colour, label) in SHOWN.items():
            parameters = rig_parameters(demo.designs[name].parameters)
            _draw_response(rows, po.respond(rig, step, parameters), parameters, colour, label)
        rows[0].axhline(step.final, color="k", lw=0.8, ls="--", label="set")
        rows[0].set_title(f"step of {step.final:g} m/s on the rig model", fontsize=9)
        for ax in rows:
            ax.set_xlim(0, step.horizon)
            ax.sharex(rows[-1])
            ax.tick_params(labelbottom=ax is rows[-1])
        rows[-1].set_xlabel("time [s]")
    for ax, label in zip(
        [row[0] for row in grid[1:]],
        ("speed [m/s]", "valve [V]", "pressure [bar(a)]\na solid, b dotted", "friction [N]"),
        strict=True,
    ):
        ax.set_ylabel(label)
    legend_above(picture, grid[1][0])
    return picture


def _draw_response(
    rows: "list[Axes]", run: po.Trajectory, parameters: po.ParameterSet, colour: str, label: str
) -> None:
    speed, control, pressures, friction = rows
    speed.plot(run.t, run["speed"], color=colour, lw=1.4, label=label)
    control.plot(run.t, run["control"], color=colour, lw=0.9)
    pressures.plot(run.t, 1e-5 * run["pressure_a"], color=colour, lw=1.1)
    pressures.plot(run.t, 1e-5 * run["pressure_b"], color=colour, lw=1.1, ls=":")
    friction.plot(run.t, _friction_force(run, parameters), color=colour, lw=1.0)


def _friction_force(run: po.Trajectory, parameters: po.ParameterSet) -> Array:
    """Where the piston sticks, what the pressures push with; else the friction law."""
    value, v, ambient = parameters.value, run["speed"], parameters.value("ambient.pressure")
    bore, rod = value("cylinder.bore") ** 2, value("cylinder.rod") ** 2
    push = np.pi / 4 * (bore * (run["pressure_a"] - ambient) - (bore - rod) * (run["pressure_b"] - ambient))
    return np.where(run["stuck"] > 0, push, _law(v, value, np.sign(v)))


def _law(v: Array, value: Callable[[str], float], side: Array) -> Array:
    fall = np.exp(-((v / value("friction.stribeck_velocity")) ** 2))
    level = value("friction.coulomb") + (value("friction.static") - value("friction.coulomb")) * fall
    return np.asarray(level * side + value("friction.viscous") * v)


def _draw_log(ax: "Axes", demo: Demo) -> None:
    t, fitted = demo.log.trajectory.t, demo.fit.trajectories[demo.log.name]
    ax.plot(t, 1e3 * demo.log.trajectory["position"], color=GREY, lw=4, alpha=0.6, label="logged")
    ax.plot(t, 1e3 * fitted["position"], color=BLUE, lw=1, label="fitted")
    ax.set(xlabel="time [s]", ylabel="position [mm]")
    ax.set_title("the log, and its fit", fontsize=9)
    ax.legend(frameon=False, fontsize=8, ncols=2)


def _draw_friction(ax: "Axes", demo: Demo) -> None:
    v = np.linspace(-0.3, 0.3, 2401)
    side = np.tanh(v / demo.fit.parameters.value("friction.smoothing"))
    ax.plot(v, _law(v, TRUTH.__getitem__, np.sign(v)), color=GREY, lw=4, alpha=0.6, label="of the rig")
    ax.plot(v, _law(v, demo.fit.parameters.value, side), color=BLUE, lw=1, label="identified")
    ax.set(xlabel="speed [m/s]", ylabel="friction [N]")
    ax.set_title("the friction that it tells", fontsize=9)
    ax.legend(frameon=False, fontsize=8)


def _resting(system: po.System) -> RestFinder:
    """The plant's own rest, asked for by what its sensor shows."""
    own = system.rest_finder
    assert own is not None

    def rest(parameters: po.ParameterSet, outputs: Mapping[str, float]) -> Rest:
        return own(parameters, {n.removeprefix("sensor."): value for n, value in outputs.items()})

    return rest


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    demo = run()
    sys.exit(finish(main(demo), options, lambda: {"rig_demo": figure(demo)}))
