"""Where dither helps: a valve with a dead zone and an encoder, over the dither's amplitude and frequency.

    python problems/dither/dither_map.py [--json FILE] [--out DIR]

A 32 mm cylinder with low-friction seals (10/14 N) and 5 kg behind a valve of 80 Hz with a dead zone of 5 %, under a PID
at 1 kHz whose derivative is filtered over 10 ms. The speed is an encoder's difference: a count of 10 um is 10 mm/s, a
fifth of the set speed, and a filter of 10 ms makes 0.9 mm/s of it. Steps from rest to 50 mm/s, and from there to
-50 mm/s through the dead zone, with 4, 5 and 6 kg; what is minimised is the worst settling time to 5 %, overshoot at
most 5 %.

Rows with.*: gains, amplitude and frequency of a sine together; triangle.* those of a triangle at the sine's frequency.
Both are certified on all plants. Rows without.*: the gains alone, of which no certified design was found; the rows are
those of the best that the certificate refused. "gain" is how many times sooner the dithered design settles than the
design without, for which the horizon stands: a lower bound. Rows quiet.*: the search again with half of the dither's
extra air allowed; no design that settles was found. Rows map.* are of the nominal plant: the settling time over
amplitude and frequency, at the gains of either design; a cell is useful where it settles at least 5 % sooner than the
same gains without dither. Rows verdict.*: what `judge_dither` says, 1 useful, .5 useful with these gains, 0 useless, -1
harmful: useful, the gains of each design its own, and at the same gains at least with these; its price is air and valve
travel.
"""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from numpy.typing import NDArray

import pneuopt as po
from pneuopt.evaluation.specification import specify
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from problems.shared.arrays import Array
from problems.shared.claims import VERDICT_SCORES, Claim, arguments, design, finish, frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

SPEED, HORIZON, BAND = 0.05, 0.8, 0.05  # [m/s], [s], of the step
UP = po.Step(SPEED, horizon=HORIZON, start={"position": 0.25, "pressure_b": 3.5e5})
BACK = po.Step(-2 * SPEED, initial=SPEED, horizon=HORIZON, start={"position": 0.25})
STEPS = [UP, BACK]
PLANTS = {"heavy": {"load.mass": 6.0}, "light": {"load.mass": 4.0}}
HARDWARE = {"valve.dead_zone": 0.05, "friction.coulomb": 10.0, "friction.static": 14.0}
RESOLUTION, FILTER, SAMPLE = 1e-5, 0.01, 1e-3  # [m], [s], [s]
GIVEN = {"pid.Kp": 2.0, "pid.Ki": 20.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}
GAINS = {"pid.Kp": (0.2, 30.0), "pid.Ki": (0.5, 300.0), "pid.Kd": (0.0, 0.5)}
DITHER = {"dither.amplitude": (0.0, 1.5), "dither.frequency": (20.0, 120.0)}
FIRST = {"dither.amplitude": 1.0}
SEARCH = po.Racing(members=30, trials=200)
LONGER = po.Racing(seed=1)  # for the rival: more members and trials, for fewer gains
AMPLITUDES, FREQUENCIES = np.linspace(0.0, 1.2, 13), np.geomspace(20.0, 250.0, 12)  # [V], [Hz]
SOONER = 0.95
BOUNDS = {
    "gain": ">= 2", "with.ripple": "<= 0.005", "verdict.retuned": "1 +- 0", "verdict.same": ">= 0.5",
    "map.with.useful": ">= 0.05", "map.without.useful": ">= 0.05",
    **{f"{name}.settling_time": "<= 0.36" for name in ("with", "triangle")},
    "with.overshoot": "<= 5", "triangle.overshoot": "<= 5",
    **{f"{name}.certified": "1 +- 0" for name in ("with", "triangle")},
    **{f"{name}.certified": "0 +- 0" for name in ("without", "quiet")},
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Job:
    """Designs, verdicts; settling times [s] and air [l(ANR)] over amplitude and frequency; CPU seconds."""

    designs: Mapping[str, po.TuningResult]
    verdicts: Mapping[str, po.DitherVerdict]
    maps: Mapping[str, Array]
    air: Mapping[str, Array]
    seconds: float


def run() -> Job:
    began = time.process_time()
    designs = {"without": tuned(GAINS, {}), "with": tuned({**GAINS, **DITHER}, FIRST)}
    own, found = (best(designs[n]) for n in ("without", "with"))
    loop = controlled()
    verdicts = {
        "retuned": po.judge_dither(loop, STEPS, found, without=own, band=BAND),
        "same": po.judge_dither(loop, STEPS, found, band=BAND),
    }
    start = {n: found.value(n) for n in (*GAINS, "dither.amplitude", "dither.frequency")}
    amplitude = {"dither.amplitude": DITHER["dither.amplitude"]}
    designs["triangle"] = tuned({**GAINS, **amplitude}, start, shape=po.Waveform.TRIANGLE)
    designs["quiet"] = tuned({**GAINS, **DITHER}, start, limits=[po.AirUse(air_limit(verdicts["retuned"]))])
    maps = {name: mapped(loop, given) for name, given in {"without": own, "with": found}.items()}
    settled, air = ({name: both[k] for name, both in maps.items()} for k in (0, 1))
    return Job(designs, verdicts, settled, air, time.process_time() - began)


def air_limit(verdict: po.DitherVerdict) -> float:
    """Half-way between the air without and with dither [l(ANR)]."""
    return float(np.mean([float(verdict.table[n]["AirUse"]) for n in ("without", "with")]))


def controlled(shape: po.Waveform = po.Waveform.SINE) -> po.ClosedLoop:
    drive, _ = po.catalog.t32()
    sensor = po.Encoder(RESOLUTION, FILTER)
    return po.ClosedLoop(drive.system(), po.PID(sample_time=SAMPLE), po.Dither(60.0, waveform=shape), sensor=sensor)


def filled(loop: po.ClosedLoop) -> po.ParameterSet:
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*", "sensor.*"))
    return (po.catalog.t32()[1].with_values(HARDWARE).fixed("*") | own).with_values(GIVEN)


def tuned(
    ranges: Mapping[str, tuple[float, float]],
    start: Mapping[str, float],
    shape: po.Waveform = po.Waveform.SINE,
    limits: Sequence[Any] = (),
) -> po.TuningResult:
    """Minimises the worst settling time over the steps and plants."""
    loop = controlled(shape)
    given = filled(loop).with_values(start).with_bounds(ranges).freed(*ranges)
    method = SEARCH if "dither.amplitude" in ranges else LONGER
    limits, asked = [po.Overshoot(0.05), *limits], po.SettlingTime(BAND)
    return po.tune(
        loop, STEPS, given, minimise=asked, subject_to=limits, scenarios=PLANTS, method=method, plants={}, throw=False
    )


def best(found: po.TuningResult) -> po.ParameterSet:
    """Its values, those of the last candidate where the certificate did not hold."""
    return found.parameters.with_values(found.best)


def worst(found: po.TuningResult, metric: str) -> float:
    """The largest over steps and plants, as certified; infinite where one is never reached."""
    return float(np.max(found.certified.loc[metric].fillna(np.inf).to_numpy(dtype=float)))


def mapped(loop: po.ClosedLoop, gains: po.ParameterSet) -> tuple[Array, Array]:
    """Settling time [s], the worse of both steps, and air [l(ANR)], the mean, over frequency and amplitude."""
    bounds = {
        "dither.amplitude": (0.0, float(AMPLITUDES[-1])),
        "dither.frequency": (float(FREQUENCIES[0]), float(FREQUENCIES[-1])),
    }
    given = gains.fixed("*").with_bounds(bounds).freed(*bounds)
    spec = specify({po.SettlingTime(BAND): 1.0, po.AirUse(): 1.0})
    space = search_space(loop, given)
    grid = np.stack(np.meshgrid(AMPLITUDES, FREQUENCIES), axis=-1).reshape(-1, 2)
    responses = Simulator(loop, STEPS, space, spec=spec).respond(grid, BAND)
    size = len(FREQUENCIES), len(AMPLITUDES)
    return responses.table("SettlingTime").max(axis=1).reshape(size), responses.table("AirUse").mean(axis=1).reshape(
        size
    )


def main(job: Job) -> "DataFrame":
    claims = []
    for name, found in job.designs.items():
        certified = found.certified.drop("MaxSensitivity")
        claims += design(name, best(found), certified)
        claims.append(Claim(f"{name}.dither_frequency", best(found).value("dither.frequency"), "Hz"))
        claims.append(Claim(f"{name}.certified", float(found.status.converged)))
        if "AirUse" in certified.index:
            allowed = f"<= {air_limit(job.verdicts['retuned']):.6g}"
            claims.append(Claim(f"{name}.air", worst(found, "AirUse"), "l", None, allowed if name == "quiet" else ""))
    alone, dithered = (min(worst(job.designs[n], "SettlingTime"), HORIZON) for n in ("without", "with"))
    claims.append(Claim("gain", alone / dithered))
    for name, verdict in job.verdicts.items():
        claims.append(Claim(f"verdict.{name}", VERDICT_SCORES[verdict.usefulness.name]))
        for row, unit in {"AirUse": "l", "ValveTravel": "1", "Ripple": "m/s"}.items():
            before, after = (float(verdict.table[c][row]) for c in ("without", "with"))
            bound = "" if row == "Ripple" else f">= {before:.4g}"
            claims.append(Claim(f"verdict.{name}.{row}", after, unit, before, bound))
    effect = job.verdicts["retuned"].effect
    claims += [Claim("moved.spool", effect.spool), Claim("moved.passed", effect.valve_gain)]
    for name, settled in job.maps.items():
        claims.append(Claim(f"map.{name}.useful", float(np.mean(useful(settled)))))
        claims.append(Claim(f"map.{name}.best", float(np.nanmin(settled)), "s", undithered(settled)))
        air = job.air[name]
        claims.append(
            Claim(f"map.{name}.air", float(np.min(air, where=useful(settled), initial=np.inf)), "l", air[0, 0])
        )
    claims.append(Claim("seconds", job.seconds, "s"))
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def undithered(settled: Array) -> float:
    """The settling time at amplitude 0, which is the same at every frequency [s]; infinite where there is none."""
    return float(np.nan_to_num(settled[0, 0], nan=np.inf))


def useful(settled: Array) -> NDArray[np.bool_]:
    """Cells that settle sooner than the same gains do without dither."""
    return np.asarray(settled <= SOONER * min(undithered(settled), HORIZON))


def figure(job: Job) -> "Figure":
    import matplotlib.pyplot as plt

    picture, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
    titles = {"without": "gains tuned without dither; dots: useful", "with": "tuned with it; star: the design"}
    colours = plt.get_cmap("viridis_r").copy()
    colours.set_bad("0.85")
    for plot, (name, settled) in zip(axes, job.maps.items(), strict=False):
        mesh = plot.pcolormesh(AMPLITUDES, FREQUENCIES, settled, cmap=colours, vmin=0.1, vmax=0.6, shading="nearest")
        row, column = np.nonzero(useful(settled))
        plot.plot(AMPLITUDES[column], FREQUENCIES[row], ".w", ms=3)
        plot.set_title(titles[name], fontsize=10)
    picture.colorbar(mesh, ax=axes[:2], label="settling time [s]; grey: never", extend="max")
    found = best(job.designs["with"])
    axes[1].plot(found.value("dither.amplitude"), found.value("dither.frequency"), "*", color=ORANGE, ms=12)
    air = axes[2].pcolormesh(AMPLITUDES, FREQUENCIES, job.air["with"], cmap="magma_r", shading="nearest")
    axes[2].set_title("its price: air, gains tuned with it", fontsize=10)
    picture.colorbar(air, ax=axes[2], label="air in 0.8 s [l(ANR)]")
    dead = HARDWARE["valve.dead_zone"] * po.catalog.t32()[1].value("valve.span")
    for plot, colour in zip(axes, ("w", "w", GREY), strict=True):
        plot.axvline(dead, color=colour, lw=1, ls="--")
        plot.axhline(po.catalog.t32()[1].value("valve.bandwidth"), color=colour, lw=1, ls=":")
        plot.set(xlabel="amplitude [V]", yscale="log")
        plot.set_yticks([20, 50, 100, 200], ["20", "50", "100", "200"])
        plot.minorticks_off()
    axes[2].text(dead + 0.02, 210, "dead zone", fontsize=8, color=GREY)
    axes[2].text(dead + 0.02, 91, "bandwidth of the valve", fontsize=8, color=GREY)
    axes[0].set_ylabel("frequency [Hz]")
    return picture


def responses(job: Job) -> "Figure":
    loop, picture_axes = controlled(), axes_grid(2, 2, (2.4, 1.8), sharex="col")
    picture, grid = picture_axes
    for column, step in enumerate(STEPS):
        for name, colour in {"with": BLUE, "without": GREY}.items():
            given = best(job.designs[name])
            run_ = po.respond(loop, step, given)
            label = f"tuned {name} dither"
            grid[0][column].plot(run_.t, 1e3 * run_["speed"], color=colour, lw=1.0, label=label)
            grid[1][column].plot(run_.t, run_["control"], color=colour, lw=0.6)
        grid[0][column].axhline(1e3 * step.final, color="k", lw=0.6, ls="--")
        grid[0][column].set_title(f"{1e3 * step.initial:g} to {1e3 * step.final:g} mm/s")
        grid[1][column].set(xlabel="time [s]", xlim=(0, HORIZON))
    grid[0][0].set_ylabel("speed [mm/s]")
    grid[1][0].set_ylabel("valve [V]")
    legend_above(picture, grid[0][0])
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    for verdict in job.verdicts.values():
        print(verdict)
    sys.exit(finish(main(job), options, lambda: {"dither_map": figure(job), "dither_map_responses": responses(job)}))
