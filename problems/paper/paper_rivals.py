"""The rivals that the paper names, each with a PID of its own on the paper's drive: what each gives, at which price.

    python problems/paper/paper_rivals.py [--json FILE] [--out DIR]

Ye, Wang, Chen (IJRES 3(7), 2015) call their dither as good as other friction compensation at a lower cost, and compare
none. Here are four: T. Hägglund's knocker pulses, which the paper names, friction feedforward by the reference's and by
the measured direction, and a valve's dead zone added back. The drive is R25 behind a spool of 100 Hz with a dead zone
of 3 %, LuGre friction 25/40 N, an encoder's difference filtered over 5 ms, a controller at 1 kHz. Two tasks: 10 mm/s,
where friction falls with speed and the drive crawls, and 50 mm/s, the paper's step of 1 V.

All are tuned in the same way: PID and the rival's parameters together, by the same differential evolution with the same
number of simulations, from the best PID alone on, so that none can be worse than that. What is minimised is the
integral of the absolute error, of the mean under dither; overshoot at most 10 %, ripple at most a fifth of the step,
and Kp + Kd/Tf, the gain from noise to command, 100 V s/m: beyond it the encoder's counts rattle the valve by more than
4 %. The step keeps a sensitivity of 2, the crawl, which no such PID makes robust, one of 8; a dither none.

Rows <task>.<rival>.*: error integral, settling time of the signal as it is, error in the end, overshoot, hunting; the
price in ripple, air and valve travel; and gain, how often the error integral is smaller than that of the PID alone.
What they say: at 10 mm/s the dead-zone inverse gives most and costs nothing, the dither nearly as much on average, for
dozens of times the air and hundreds of times the travel; feedforward by the reference's direction takes a quarter off
the error integral; and the search finds no use for pulses or feedforward by the measured direction: behind a valve,
which sets a speed, Coulomb friction is no voltage. At 50 mm/s dither and pulses help, feedforward little, the inverse
not at all. Row bare_sensitivity: of the knocker's gains without its pulses, beyond the limit of 2 that it keeps only
because it is read in the middle of them. Rows verdict: of `judge_dither` and `judge_compensators` against the PID
alone, 1 useful, 0 useless, -1 harmful: both count the ripple, with which the dither never settles, and follow the
response beyond the step's second. The pulses at 50 mm/s settle a sixth sooner, at five times the valve's travel; they
leave a larger error of the mean in the end, which swings inside the settling band, and that is no hunting.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy import optimize

import pneuopt as po
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, search_space
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.r25 import CLIP, lagging

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame, Series

SAMPLE, LAG = 1e-3, 5.5e-3  # [s] of the controller; of the encoder's filter and half a sample
DEAD_ZONE = {"valve.dead_zone": 0.03, "valve.rounding": 0.01}  # [half travels]
TASKS = {"crawl": po.Step(0.01, horizon=2.0), "step": po.Step(0.05, horizon=1.0)}  # [m/s]
BAND, OVERSHOOT, RIPPLE = 0.05, 0.1, 0.2
SENSITIVITY = {"crawl": 8.0, "step": 2.0}
MAX_NOISE_GAIN = 100.0  # [V s/m]: a count of 10 um is 1.8 mm/s behind the filter and then 0.18 of the valve's 5 V
GIVEN = {"pid.Kp": 5.0, "pid.Ki": 25.0, "pid.Tf": 0.01, "pid.lower": -CLIP, "pid.upper": CLIP}
GAINS = {"pid.Kp": (0.5, 40.0), "pid.Ki": (2.0, 300.0), "pid.Kd": (0.0, 1.0), "pid.Tf": (2e-3, 2e-2)}
MEMBERS, GENERATIONS = 24, 30
NEARBY = 0.1  # spread of the first gains, a share of their ranges
REFUSED = 1e3  # [s] the merit of a design that cannot be simulated


@dataclass(frozen=True)
class Rival:
    """A dither or a compensator, and its free parameters with their bounds."""

    label: str
    colour: str
    free: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    dither: po.Dither | None = None
    compensators: tuple[Any, ...] = ()

    @property
    def loop(self) -> po.ClosedLoop:
        """The loop around the drive with this rival alone."""
        drive, _ = lagging(po.LuGre())
        pid, sensor = po.PID(sample_time=SAMPLE), po.SensorLag(LAG)
        parts: dict[str, Any] = {"sensor": sensor, "compensators": self.compensators, "measured": "speed"}
        return po.ClosedLoop(drive.system(), pid, self.dither, **parts)


KNOCKS = {"knocker.amplitude": (0.0, 3.0), "knocker.width": (1e-3, 2e-2), "knocker.period": (1e-2, 0.2)}
PUSHES = {"friction_feedforward.level": (0.0, 1.5), "friction_feedforward.smoothing": (5e-4, 2e-2)}
INVERTS = {"dead_zone_inverse.width": (0.0, 0.5), "dead_zone_inverse.smoothing": (5e-3, 0.2)}
WAVES = {"dither.amplitude": (0.0, 3.0), "dither.frequency": (5.0, 100.0)}
BY_SPEED = po.FrictionFeedforward(po.Direction.MEASURED)
RIVALS = {
    "pid": Rival("PID alone", "black"),
    "dither": Rival("dither", ORANGE, WAVES, po.Dither(20.0)),
    "knocker": Rival("knocker pulses", RED, KNOCKS, None, (po.Knocker(),)),
    "reference": Rival("feedforward, reference", "#7a5195", PUSHES, None, (po.FrictionFeedforward(),)),
    "measured": Rival("feedforward, measured", "#2f9e77", PUSHES, None, (BY_SPEED,)),
    "inverse": Rival("dead-zone inverse", BLUE, INVERTS, None, (po.DeadZoneInverse(),)),
}


SCORES = {po.Usefulness.USEFUL: 1.0, po.Usefulness.USELESS: 0.0, po.Usefulness.HARMFUL: -1.0}
SHOWN = {  # row: metric, factor, unit
    "error_integral": ("IAE", 1e3, "ms"),
    "settling": ("SettlingTimeRaw", 1.0, "s"),
    "error": ("SteadyStateError", 1.0, "%"),
    "overshoot": ("Overshoot", 1.0, "%"),
    "hunting": ("LimitCycleAmplitude", 1e3, "mm/s"),
    "ripple": ("Ripple", 1e3, "mm/s"),
    "air": ("AirUse", 1.0, "l(ANR)"),
    "travel": ("ValveTravel", 1.0, "1"),
    "sensitivity": ("MaxSensitivity", 1.0, "1"),
}
BOUNDS = {
    "crawl.dither.gain": ">= 2", "crawl.inverse.gain": ">= 2", "crawl.knocker.gain": "<= 1.2",
    "crawl.reference.gain": ">= 1.2", "crawl.measured.gain": "<= 1.3",
    "crawl.dither.air": ">= 2", "crawl.dither.ripple": ">= 1", "crawl.dither.travel": ">= 50",
    "crawl.inverse.air": "<= 0.25", "crawl.inverse.ripple": "<= 0.2",
    "step.dither.gain": ">= 1.5", "step.knocker.gain": ">= 1.1", "step.reference.gain": "<= 1.4",
    "step.measured.gain": "<= 1.4", "step.inverse.gain": "<= 1.4",
    "step.dither.air": ">= 1", "step.dither.ripple": ">= 5", "step.knocker.air": "<= 0.3",
    "step.knocker.bare_sensitivity": ">= 2", "none_worse": ">= 0.99",
    "crawl.dither.verdict": "-1 +- 0", "crawl.inverse.verdict": "1 +- 0", "crawl.knocker.verdict": "0 +- 0",
    "crawl.reference.verdict": "1 +- 0",
    "step.dither.verdict": "-1 +- 0", "step.knocker.verdict": "1 +- 0",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Design:
    """A rival tuned for a task: its loop, its values, its certified metrics, and simulations spent."""

    loop: po.ClosedLoop
    parameters: po.ParameterSet
    metrics: "Series"
    simulations: int


def run() -> "Mapping[tuple[str, str], Design]":
    designs: dict[tuple[str, str], Design] = {}
    for task in TASKS:
        for name in RIVALS:
            designs[task, name] = tuned(name, task, designs.get((task, "pid")))
    return designs


def tuned(name: str, task: str, first: Design | None) -> Design:
    """PID and rival together, from the best PID alone with a rival of size zero on."""
    loop, step = RIVALS[name].loop, TASKS[task]
    given = free_parameters(name, loop)
    space, spec = search_space(loop, given), specification(task, dithered=loop.dither is not None)
    simulator, population = Simulator(loop, [step], space, spec=spec), np.random.default_rng(0)
    start = population.random((MEMBERS, len(space.names)))
    if first is not None:  # half the members about its gains, the rival's own anywhere
        known = [first.parameters.value(n) if n in GAINS else given[n].lower for n in space.names]
        start[0], half, gains = space.to_unit(np.array(known)), MEMBERS // 2, len(GAINS)
        start[1:half, :gains] = start[0, :gains] + NEARBY * population.standard_normal((half - 1, gains))
    search: Any = optimize.differential_evolution  # its types know no vectorised merit
    found = search(
        lambda unit: merits(simulator, space, spec, unit.T),
        [(0.0, 1.0)] * len(space.names),
        maxiter=GENERATIONS, init=np.clip(start, 0.0, 1.0), seed=0, mutation=(0.4, 0.9), recombination=0.9,
        tol=0.0, polish=False, vectorized=True, updating="deferred",
    )  # fmt: skip
    best = space.round_point(space.from_unit(found.x[None])[0], 4)
    values = given.with_values(dict(zip(space.names, best.tolist(), strict=True)))
    metrics = po.evaluate(loop, step, values, band=BAND).iloc[:, 0]
    return Design(loop, values, metrics, MEMBERS * (GENERATIONS + 1))


def free_parameters(name: str, loop: po.ClosedLoop) -> po.ParameterSet:
    """The drive's values, and a rival's and the PID's free ones."""
    _, hardware = lagging(po.LuGre())
    own = loop.parameters.select(n for n in loop.parameters if n not in hardware)
    free = {**GAINS, **RIVALS[name].free}
    return (hardware.fixed("*") | own).with_values({**DEAD_ZONE, **GIVEN}).with_bounds(free).freed(*free)


def specification(task: str, *, dithered: bool) -> Specification:
    """What is minimised, and the limits; no sensitivity under dither, whose ripple a linearisation does not see."""
    limits = [po.Overshoot(OVERSHOOT), po.Ripple(RIPPLE * TASKS[task].size)]
    return specify(po.IAE(), limits if dithered else [*limits, po.MaxSensitivity(SENSITIVITY[task])])


def merits(simulator: Simulator, space: Space, spec: Specification, unit: Array) -> Array:
    """The error integral [s], raised in proportion to what exceeds a limit, for each row of unknowns."""
    points = space.from_unit(unit)
    Kp, Kd, Tf = (points[:, space.names.index(f"pid.{n}")] for n in ("Kp", "Kd", "Tf"))
    values = simulator.values(points, spec)
    beyond = np.maximum((Kp + Kd / Tf) / MAX_NOISE_GAIN - 1, 0.0)
    for limit in spec.limits:
        beyond = beyond + np.maximum(values[type(limit).__name__] / spec.limit(type(limit)) - 1, 0.0)
    found: Array = np.nan_to_num(values["IAE"] * (1 + 10 * beyond), nan=REFUSED, posinf=REFUSED)
    return found


def main(designs: "Mapping[tuple[str, str], Design]", seconds: float) -> "DataFrame":
    rows, gains = [], {}
    for (task, name), found in designs.items():
        plain = designs[task, "pid"]
        for row, (metric, factor, unit) in SHOWN.items():
            rows.append(Claim(f"{task}.{name}.{row}", factor * float(found.metrics[metric]), unit))
        for parameter in found.parameters.free_names:
            q = found.parameters[parameter]
            rows.append(Claim(f"{task}.{name}.{parameter.split('.')[-1]}", q.value, q.unit))
        gains[task, name] = float(plain.metrics["IAE"] / found.metrics["IAE"])
        rows.append(Claim(f"{task}.{name}.gain", gains[task, name]))
        if name != "pid":
            rows.append(Claim(f"{task}.{name}.verdict", verdict(task, found, plain)))
        if name == "knocker":
            bare = RIVALS["pid"].loop
            alone = po.evaluate(bare, TASKS[task], found.parameters.select(bare.parameters), band=BAND)
            rows.append(
                Claim(
                    f"{task}.{name}.bare_sensitivity",
                    float(alone.to_dict("index")["MaxSensitivity"][TASKS[task].label]),
                )
            )
    rows += [Claim("none_worse", min(gains.values())), Claim("seconds", seconds, "s")]
    return frame([replace(c, bound=BOUNDS.get(c.name, "")) for c in rows])


def verdict(task: str, found: Design, plain: Design) -> float:
    """1 useful, 0 useless, -1 harmful, against the PID alone with the gains tuned for that."""
    judge: Any = po.judge_dither if found.loop.dither else po.judge_compensators
    told = judge(found.loop, TASKS[task], found.parameters, without=plain.parameters, band=BAND)
    return SCORES[told.usefulness]


def figure(designs: "Mapping[tuple[str, str], Design]") -> "Figure":
    picture, grid = axes_grid(3, 2, (2.6, 1.7, 1.9))
    for column, (task, step) in enumerate(TASKS.items()):
        speed, command, price = (row[column] for row in grid)
        for name, rival in RIVALS.items():
            found = designs[task, name]
            run_ = po.respond(found.loop, step, found.parameters)
            faint = 0.45 if name == "dither" else 1.0
            style: dict[str, Any] = (
                {"ls": (0, (4, 3)), "zorder": 3} if name == "pid" else {}
            )  # seen where others lie on it
            speed.plot(run_.t, 1e3 * run_["speed"], color=rival.colour, lw=1.1, alpha=faint, label=rival.label, **style)
            command.plot(run_.t, run_["control"], color=rival.colour, lw=0.8, alpha=faint)
        speed.axhline(1e3 * step.size, color=GREY, lw=0.8, ls="--")
        seen = (0, 1.2 if task == "crawl" else 0.4)
        speed.set(title=f"{1e3 * step.size:g} mm/s", xlim=seen, ylabel="speed [mm/s]" if column == 0 else "")
        command.set(xlim=seen, xlabel="time [s]", ylabel="valve [V]" if column == 0 else "")
        _draw_prices(price, designs, task)
    legend_above(picture, grid[0][0], columns=3)
    return picture


def _draw_prices(axes: "Axes", designs: "Mapping[tuple[str, str], Design]", task: str) -> None:
    """Error integral, and the price, as multiples of those of the PID alone."""
    shown = {"error integral": "IAE", "air": "AirUse", "valve travel": "ValveTravel"}
    plain = designs[task, "pid"].metrics
    for k, (name, rival) in enumerate(RIVALS.items()):
        ratios = [float(designs[task, name].metrics[m] / plain[m]) for m in shown.values()]
        axes.bar(np.arange(len(shown)) + 0.13 * (k - 2.5), ratios, 0.12, color=rival.colour)
    axes.set(yscale="log", xticks=range(len(shown)), xticklabels=list(shown))
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.set_ylabel("times PID alone" if task == "crawl" else "")


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    began = time.perf_counter()
    done = run()
    sys.exit(finish(main(done, time.perf_counter() - began), options, lambda: {"paper_rivals": figure(done)}))
