"""P32, the positioning benchmark: controllers on the same simulator, each with gains from the same search.

    python problems/tune/p32.py [--search NAME ... --seconds S] [--plants N] [--certify] [--json FILE] [--out DIR]

The drive, its moves, its corners and what is asked for are those of problems/shared/p32.py. Compared are a PID of the
position that gets the end of a move as a step ("pid"), the usual cascade of a position's P and a speed's PI with the
feedforward of the speed ("cascade"), state feedback of position, speed and differential pressure with feedforward of
motion and friction ("state_feedback"), the exact linearisation of J. Wang, Ü. Kotta and J. Ke, 2007 ("linearisation"),
and, with pulses of `ImpulsiveControl` where the piston has stopped outside the tolerance, this with friction and mass
that are learned while the reference moves ("impulsive"), and the state feedback ("impulsive_feedback"). All but the PID
have the inverse of the dead zone, and choose the limits of their reference. --search finds gains by SciPy's
differential evolution for S CPU seconds each, from the designs in problems/shared/p32_designs.toml and random points,
and prints them for that file, from which all other runs read them; its head says how each was found.

A piston that sticks outside the tolerance lets go with 20 N too much, on air of 5.5 N/mm, and an integral or a gain so
moves it further than .1 mm before the valve answers. A pulse ends whatever the piston does, and moves it the less the
nearer its peak comes to the breakaway force, which the next pulses learn. With them all 162 moves of the nominal plant
and the corners, and all moves on 400 of 400 drawn plants, keep all limits within 1.26 s.

Rows NAME.kept: of the 162 moves of nine plants, the share that comes to +-.1 mm, stays there, passes the end by no
more and then stands; NAME.worst_time: the longest time to that, infinite where a move never does; NAME.slower: that
time over the winner's; NAME.within: the tolerance that all moves keep; NAME.max_sensitivity over all plants. Row
impulsive.kept_over_noise: the share under 20 further draws of the pressures' noise. Rows cascade_by_RULE: the cascade
with gains by published rules (problems/shared/p32_rules.py), its reference that of the searched one. Rows fresh.*:
drawn plants (a quarter of them for a rival), which share of them keeps all limits, Ms among them, on all moves, and
the longest time. Rows that begin
with "without" show a design without one of its parts, and those that begin with "with" one with a part more, its other
gains unchanged: the integral's reset of Beerens et al., which here changes little, and a dither, which brings the
winner nothing and lets the state feedback stand less. --certify runs a trip of the winner on three plants on the
event-accurate model, behind the rig's sensors, with 10 s of standing. Bounds are the limits of the statement, and a
share of 95 % of the drawn plants.
"""

import argparse
import itertools
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, RED, axes_grid, legend_above
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.p32 import (
    COUNT,
    DISTANCES,
    DWELL,
    MAX_OVERSHOOT,
    MAX_SENSITIVITY,
    PRESSURE_NOISE,
    SAMPLE_TIME,
    STANDING,
    TOLERANCE,
    drive,
    fresh_plants,
    plants,
    trips,
)
from problems.shared.p32_margins import Margins
from problems.shared.p32_moves import Outing
from problems.shared.p32_rules import RULED_GAINS, RULES, cascade_by_rule
from problems.shared.p32_search import Task, search, searched_plants
from problems.shared.p32_simulator import FastSimulator, Lane, Reading, read
from problems.shared.p32_structures import STRUCTURES, Structure, gains

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

Plants = Mapping[str, Mapping[str, float]]
DESIGNS = Path(__file__).parents[1] / "shared" / "p32_designs.toml"
WINNER, RIVALS = "impulsive", ("pid", "cascade", "state_feedback", "linearisation")
RULED = {rule: f"cascade_by_{rule}" for rule in RULES}
SEED = 7  # of the pressures' noise; the search has seen another one
SECONDS, FRESH, SHARE = 70.0, 400, 4  # drawn plants, and which part of them the rivals get
SHOWN, STRIDE = 1.8, 3  # [s] of a move that the figure has, and its samples
NOISES = range(1000, 1020)  # further seeds, under which the winner runs the nominal plant and the corners
NONE = 1e-6  # in place of a zero that has no logarithm
# What is taken from a design: values that leave a part without effect.
WITHOUT: Mapping[str, tuple[str, dict[str, float]]] = {
    "pulses": (WINNER, {"impulsive_control.amplitude": 0.0}),
    "dead_zone_inverse": (WINNER, {"dead_zone_inverse.width": 0.0}),
    "friction_feedforward": (WINNER, {"exact_linearisation.friction": 0.0, "exact_linearisation.adaptation": 0.0}),
    "learning": (WINNER, {"exact_linearisation.adaptation": 0.0, "exact_linearisation.mass_adaptation": 0.0}),
    "creep": (WINNER, {"move.creep_distance": NONE}),
    "short_end": (WINNER, {"move.short": 0.0}),
    "pressures": ("impulsive_feedback", {"pressure_feedback.gain": 0.0}),
}
# What is added to a design, at defaults: a reset of the integral that lies in the PID, and a dither of the command.
DITHER_FREQUENCY, DITHER_AMPLITUDES = 100.0, (0.2, 0.8)  # [Hz, V], beyond the dead zone
RESET, DITHERED = ("pid", "cascade"), (WINNER, "state_feedback")
# Among the plants: the nominal one, the light one with little friction and a high supply, and the contrary.
CERTIFIED = {"nominal": 0, "light": 2, "heavy": 7}
BOUNDS: Mapping[str, str] = {
    f"{WINNER}.kept": ">= 100",
    f"{WINNER}.standing": ">= 100",
    f"{WINNER}.max_sensitivity": "<= 2",
    f"{WINNER}.sticking_sensitivity": "<= 2",
    f"fresh.{WINNER}.plants": ">= 95",
    **{f"{name}.slower": ">= 1" for name in (*RIVALS, *RULED.values())},
}


@dataclass(frozen=True, eq=False)
class Result:
    """A design on some plants: its moves, what they give, and each plant's largest Ms of sliding and of sticking."""

    values: Mapping[str, float]
    outings: Sequence[Outing]
    position: Array
    reading: Reading
    stands: Array
    peaks: Array

    @property
    def kept(self) -> Array:
        """Which moves keep tolerance and overshoot, and after which the piston stands, shape (plants, moves)."""
        return np.asarray((_keeps(self.reading) * self.stands[:, None]).reshape(-1, 2 * len(list(trips()))))

    @property
    def sound(self) -> Array:
        """Which plants keep all limits on all moves."""
        return np.asarray(self.kept.all(axis=1) * (self.peaks.max(axis=1) <= MAX_SENSITIVITY))


def designs() -> dict[str, dict[str, float]]:
    """The gains of each structure that has been searched."""
    return dict(tomllib.loads(DESIGNS.read_text(encoding="utf-8")))


def evaluate(structure: Structure, values: Mapping[str, float], known: Plants, last: float = STANDING) -> Result:
    """Every trip on every plant, with `last` seconds of standing, a lane a trip, plant by plant."""
    loop, parameters = structure.loop(), structure.parameters()
    lanes = _lanes(structure, values, known, last)
    outings = [lane.outing for lane in lanes]
    position, speed = FastSimulator(loop, parameters).run(lanes, SEED)
    stands = np.array([_stands(v, outing, last) for v, outing in zip(speed, outings, strict=True)])
    peaks = Margins(loop, parameters, list(known.values())).plant_peaks(gains(values))
    return Result(values, outings, position, read(position, outings), stands, peaks)


def kept_over_noise(structure: Structure, values: Mapping[str, float], known: Plants) -> float:
    """Share of the moves that keep tolerance and overshoot over `NOISES`, watched for a dwell [%]."""
    lanes, simulator = _lanes(structure, values, known, DWELL), FastSimulator(structure.loop(), structure.parameters())
    readings = [read(simulator.run(lanes, seed)[0], [lane.outing for lane in lanes]) for seed in NOISES]
    return 100 * float(np.mean([_keeps(reading) for reading in readings]))


def _lanes(structure: Structure, values: Mapping[str, float], known: Plants, last: float) -> list[Lane]:
    profile = structure.profile(values)
    return [Lane(Outing(t, profile, last=last), {**gains(values), **p}) for p in known.values() for t in trips()]


def _keeps(reading: Reading) -> Array:
    """Which moves keep tolerance and overshoot."""
    return np.asarray(np.isfinite(reading.settling) * (reading.overshoot <= MAX_OVERSHOOT))


def _stands(speed: Array, outing: Outing, last: float) -> bool:
    """Whether the piston does not move over the second half of the standing."""
    end = outing.moves[1][1]
    return not np.any(speed[end - round(last / 2 / SAMPLE_TIME) : end])


def rows(name: str, found: Result) -> Iterator[Claim]:
    """The rows of a design."""
    reading, (sliding, sticking) = found.reading, found.peaks.max(axis=0).tolist()
    yield Claim(f"{name}.kept", 100 * float(found.kept.mean()), "%")
    yield Claim(f"{name}.worst_time", float(reading.settling.max()), "s")
    yield Claim(f"{name}.median_time", float(np.median(reading.settling)), "s")
    yield Claim(f"{name}.within", 1e3 * float(np.nanmax(np.maximum(reading.error, reading.overshoot))), "mm")
    yield Claim(f"{name}.median_error", 1e3 * float(np.median(reading.error)), "mm")
    yield Claim(f"{name}.standing", 100 * float(found.stands.mean()), "%")
    yield Claim(f"{name}.max_sensitivity", sliding, "1")
    yield Claim(f"{name}.sticking_sensitivity", sticking, "1")
    yield Claim(f"{name}.longest_move", max(o.duration for o in found.outings), "s")


def certified(structure: Structure, values: Mapping[str, float], known: Plants) -> Iterator[Claim]:
    """The shortest trip in the middle of the stroke, event-accurate and behind the rig's sensors."""
    loop = structure.loop()
    sensors = {"position": po.Sensor()} | dict.fromkeys(("pressure_a", "pressure_b"), po.Sensor(noise=PRESSURE_NOISE))
    rig = po.Rig(loop, sensors, encoder=po.Encoder(COUNT, values["sensor.filter"]))
    for plant, differs in known.items():
        p = structure.parameters().with_values({**gains(values), **differs})
        for trip in list(trips())[1:2]:
            outing = Outing(trip, structure.profile(values), last=STANDING)
            start = loop.initial(p, reference=trip.begin, start=outing.start)
            run = po.record(rig, outing.trajectory(), p, seed=SEED, initial=start, rtol=1e-7)
            found = read(run.truth["position"][None], [outing])
            late = [e for e in run.events if e.t > run.truth.t[-1] - STANDING / 2]
            name = f"certified.{plant}.{1e3 * trip.distance:.0f}_mm"
            yield Claim(f"{name}.error", 1e3 * float(found.error.max()), "mm", None, f"<= {1e3 * TOLERANCE:g}")
            yield Claim(f"{name}.passed", 1e3 * float(found.overshoot.max()), "mm", None, f"<= {1e3 * MAX_OVERSHOOT:g}")
            yield Claim(f"{name}.time", float(found.settling.max()), "s")
            yield Claim(f"{name}.late_events", len(late), "1", None, "<= 0")


@dataclass(frozen=True, eq=False)
class Job:
    """Results of the structures, of drawn plants, and of designs without their parts, and with further ones."""

    found: Mapping[str, Result]
    fresh: Mapping[str, Result]
    without: Mapping[str, Result]
    added: Mapping[str, Result]
    claims: Sequence[Claim] = ()


def run(count: int = FRESH, certify: bool = False) -> Job:
    given, known = drive()[1], designs()
    corners, drawn = plants(given), fresh_plants(given, count) if count else {}
    ruled = {own: cascade_by_rule(rule, known["cascade"]) for rule, own in RULED.items()}
    found = {n: evaluate(STRUCTURES[n], values, corners) for n, values in known.items()}
    found |= {n: evaluate(STRUCTURES["cascade"], values, corners) for n, values in ruled.items()}
    few = dict(itertools.islice(drawn.items(), -(-count // SHARE)))
    fresh = {n: evaluate(STRUCTURES[n], known[n], drawn if n == WINNER else few) for n in known} if count else {}
    without = {part: evaluate(STRUCTURES[n], {**known[n], **change}, corners) for part, (n, change) in WITHOUT.items()}
    added = {own: evaluate(*changed, corners) for own, changed in with_parts(known).items()}
    units = STRUCTURES["cascade"].parameters()
    claims = [Claim(f"{own}.{n}", ruled[own][n], units[n].unit) for own in ruled for n in RULED_GAINS]
    claims.append(Claim(f"{WINNER}.kept_over_noise", kept_over_noise(STRUCTURES[WINNER], known[WINNER], corners), "%"))
    three = {own: list(corners.values())[k] for own, k in CERTIFIED.items()}
    claims += certified(STRUCTURES[WINNER], known[WINNER], three) if certify else ()
    return Job(found, fresh, without, added, claims)


def with_parts(known: Mapping[str, Mapping[str, float]]) -> dict[str, tuple[Structure, dict[str, float]]]:
    """Designs with a part more, their gains unchanged."""

    def reset(loop: po.ClosedLoop) -> po.ClosedLoop:
        return replace(loop, pid=replace(loop.pid, reset=True))

    def dithered(loop: po.ClosedLoop) -> po.ClosedLoop:
        return replace(loop, dither=po.Dither(DITHER_FREQUENCY))

    found = {f"reset_{n}": (STRUCTURES[n].changed(reset), dict(known[n])) for n in RESET}
    for n in DITHERED:
        for volts in DITHER_AMPLITUDES:
            values = {**known[n], "dither.amplitude": volts}
            found[f"dither_{volts:g}_V_{n}"] = STRUCTURES[n].changed(dithered), values
    return found


def main(job: Job) -> "DataFrame":
    claims = [claim for name, result in job.found.items() for claim in rows(name, result)]
    longest = {name: float(result.reading.settling.max()) for name, result in job.found.items()}
    claims += [Claim(f"{n}.slower", longest[n] / longest[WINNER], "1") for n in longest if n != WINNER]
    for name, result in job.fresh.items():
        claims.append(Claim(f"fresh.{name}.plants", 100 * float(result.sound.mean()), "%"))
        claims.append(Claim(f"fresh.{name}.moves", 100 * float(result.kept.mean()), "%"))
        claims.append(Claim(f"fresh.{name}.worst_time", float(result.reading.settling.max()), "s"))
    for word, changed in (("without", job.without), ("with", job.added)):
        for name, result in changed.items():
            claims += [replace(claim, name=f"{word}.{claim.name}") for claim in rows(name, result)]
    claims += job.claims
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def figure(job: Job) -> "Figure":
    """The error about the end of every move on every plant, of the winner and of the exact linearisation."""
    shown = (WINNER, "linearisation")
    picture, panels = axes_grid(len(DISTANCES), len(shown), (1.6,) * len(DISTANCES), sharex=True)
    for column, name in enumerate(shown):
        for row, distance in enumerate(DISTANCES):
            panel = panels[row][column]
            _draw_moves(panel, job.found[name], distance)
            panel.set_yscale("symlog", linthresh=1e3 * TOLERANCE)
            panel.set(ylim=(-10.0, 1.0))
            panel.set_yticks((-10.0, -1.0, -0.1, 0.0, 0.1, 1.0), ("-10", "-1", "-0.1", "0", "0.1", "1"))
            if not column:
                panel.set(ylabel=f"{1e3 * distance:.0f} mm:\nerror [mm]")
        panels[0][column].set_title(name)
        panels[-1][column].set(xlabel="time since each move's beginning [s]")
    for colour, label in ((BLUE, "nominal plant"), (GREY, "corners"), (RED, "tolerance")):
        panels[0][0].plot([], [], color=colour, label=label)
    legend_above(picture, panels[0][0], columns=3)
    return picture


def _draw_moves(panel: "Axes", result: Result, distance: float) -> None:
    """The moves of one distance."""
    for k, outing in enumerate(result.outings):
        if outing.trip.distance == distance:
            colour = BLUE if k < len(list(trips())) else GREY
            for begin, end, final, way in outing.moves:
                at = np.arange(begin, min(begin + round(SHOWN / SAMPLE_TIME), end), STRIDE)
                own = 1e3 * np.sign(way) * (result.position[k, at] - final)
                panel.plot(SAMPLE_TIME * (at - begin), own, color=colour, lw=0.6)
    for edge in (-1e3 * TOLERANCE, 1e3 * TOLERANCE):
        panel.axhline(edge, color=RED, lw=0.7)


def search_designs(chosen: Sequence[str], seconds: float) -> None:
    """Search, and print what is found as TOML."""
    known = designs()
    for name in chosen:
        structure = STRUCTURES[name]
        task = Task(structure, searched_plants())
        values = search(task, seconds, known[name])
        print(f"[{name}]  # cost {task.best:.4f} s, {task.count} candidates in {seconds:g} CPU s")
        print("\n".join(f'"{n}" = {v:.5g}' for n, v in values.items()), flush=True)


def options() -> argparse.Namespace:
    parser = arguments(__doc__)
    parser.add_argument("--search", nargs="*", metavar="NAME", help=f"search gains of {', '.join(STRUCTURES)}")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="CPU seconds of each search")
    parser.add_argument("--plants", type=int, default=FRESH, help="drawn plants; 0: none")
    parser.add_argument("--certify", action="store_true", help="run trips on the event-accurate model")
    return parser.parse_args()


if __name__ == "__main__":
    chosen = options()
    if chosen.search is not None:
        search_designs(chosen.search or list(STRUCTURES), chosen.seconds)
        sys.exit(0)
    job = run(chosen.plants, chosen.certify)
    sys.exit(finish(main(job), chosen, lambda: {"p32": figure(job)}))
