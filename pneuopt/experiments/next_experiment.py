"""`next_experiment`: the excitation that shrinks asked confidence intervals most, within the limits of a drive.

The excitation is a row of equally long blocks, each a wave about a level. The information of separate blocks adds up
nearly, so a library of them, from slow ramps to presliding wiggles, is simulated at once in SIMD lanes, and blocks are
exchanged until no exchange helps (V. V. Fedorov, Theory of Optimal Experiments, 1972). The whole run is then refined
block by block with random changes, since limits, sticking and a run's memory leave no useful gradient of the whole;
only what keeps every limit at every sample, for every plant that is thought possible, is taken.

A short run is simulated in a fraction of the time: the search also begins with a quarter of the duration, whose
information counts four times. Where that does better, it is refined, played twice in a row, and refined again.

The information of a `PlannedRun` is that of the log that it would leave, of the plant's command and its outputs: a loop
only makes the run; it is the plant that is identified.

`predict_loss`: what a tuned loop is worth as its plant drifts, and when it violates a requirement.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.runnable import HasSystem, as_runnable, check_smooth
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.requirements import larger_is_better, metric_name, requirement_values
from pneuopt.evaluation.scenarios import draws as draw_plants
from pneuopt.evaluation.scenarios import further, generator
from pneuopt.evaluation.specification import Objective, Specification, specify
from pneuopt.experiments.design import Criterion, DOptimal, ExperimentDesign, linked_information, tabulate_design
from pneuopt.experiments.tolerances import (
    ALL_BLOCKS_SPREAD,
    BEGIN_SHARE,
    BLOCKS,
    CHANGES,
    CHIRP_RATIO,
    CYCLES_A_SAMPLE,
    LEAST_AMPLITUDE,
    MAX_SAMPLES,
    MAX_WRONG,
    MIN_BLOCK_SAMPLES,
    MIN_GAIN,
    MIN_SUBSTEPS,
    MOST_REPEATS,
    PART_SHARE,
    QUIET_CYCLES,
    QUIET_ROUNDS,
    ROUNDS_A_SPREAD,
    SLACK,
    SPREADS,
    VAGUE,
)
from pneuopt.identification.logged_loop import REFERENCE_CHANNELS
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tracking import Tracking
from pneuopt.identification.widths import count_widths, estimated_widths
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import InputError, ModelError, check_names, require
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.report import Column, Line, Report, Table, Tone, format_number
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import Progress, ProgressReporter
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value
from pneuopt.shooting.least_squares import CpuBudget, LeastSquares
from pneuopt.shooting.segments import Segments, gap_scales, segment, stable_substeps, start_nodes
from pneuopt.shooting.transcription import Phase, Transcription

if TYPE_CHECKING:
    from datetime import datetime

    import pandas as pd


class Wave(Enum):
    """The form of a block."""

    SINE = "sine"
    TRIANGLE = "triangle"
    SQUARE = "square wave"
    CHIRP = "chirp"


@dataclass(frozen=True)
class WaveBlock:
    """A wave about a level."""

    wave: Wave
    amplitude: float  # peak [unit of the excitation]
    frequency: float  # [Hz]; a chirp's first one
    level: float = 0.0  # about which it goes, counted from the start of the run [unit of the excitation]

    def samples(self, t: Array) -> Array:
        """The wave at instants of the block, shape (n,), without its level; it begins at zero, but for a square one."""
        phase = self.frequency * t
        if self.wave is Wave.CHIRP:
            rate = math.log(CHIRP_RATIO) / (t[-1] or 1.0)
            phase = self.frequency * np.expm1(rate * t) / rate
        if self.wave is Wave.TRIANGLE:
            return np.asarray(self.amplitude * (1 - 4 * np.abs((phase + 0.25) % 1.0 - 0.5)))
        sine = np.sin(2 * np.pi * phase)
        return np.asarray(
            self.amplitude * (np.where(phase % 1.0 < 0.5, 1.0, -1.0) if self.wave is Wave.SQUARE else sine)
        )

    def describe(self, unit: str) -> str:
        """The block in words, "sine of 2 mm at 5 Hz"."""
        speed = f", {self.frequency:.3g} to {CHIRP_RATIO * self.frequency:.3g} Hz"
        pace = speed if self.wave is Wave.CHIRP else f" at {self.frequency:.3g} Hz"
        level = f" about {write_value(self.level, unit, 3)}" if self.level else ""
        return f"{self.wave.value} of {write_value(self.amplitude, unit, 3)}{pace}{level}"


def join_blocks(blocks: Sequence[WaveBlock], t: Array, rise: float = 0.15) -> Array:
    """The excitation (n,) of equally long blocks; the level moves smoothly in the share `rise` of one."""
    out = np.empty(len(t))
    edges = np.linspace(0, len(t), len(blocks) + 1).round().astype(int)
    level = 0.0
    for block, (begin, end) in zip(blocks, itertools.pairwise(edges.tolist()), strict=True):
        own = t[begin:end] - t[begin]
        way = np.clip(own / (rise * own[-1]), 0, 1) if own[-1] > 0 else np.ones_like(own)
        out[begin:end] = level + (block.level - level) * (1 - np.cos(np.pi * way)) / 2 + block.samples(own)
        level = block.level
    return out


def library(
    amplitude: float, duration: float, sample_time: float, amplitudes: int = 10, frequencies: int = 8
) -> list[WaveBlock]:
    """Blocks of every kind, of so many amplitudes and frequencies; the refinement finds what lies between."""
    fastest = max(CYCLES_A_SAMPLE / sample_time, 2 / duration)
    sizes = amplitude * np.geomspace(LEAST_AMPLITUDE, 1.0, amplitudes)
    paces = np.geomspace(1 / duration, fastest, frequencies)
    waves = [WaveBlock(w, a, f) for w, a, f in itertools.product(Wave, sizes.tolist(), paces.tolist())]
    return [b for b in waves if b.wave is not Wave.CHIRP or CHIRP_RATIO * b.frequency <= fastest]


def vary(
    block: WaveBlock, rng: np.random.Generator, spread: float, amplitude: float, ends: tuple[float, float]
) -> WaveBlock:
    """A block near another one, its numbers moved by about `spread` of themselves, its level by that of the range."""
    size, pace, shift = rng.standard_normal(3) * spread
    level = block.level + shift * amplitude * 0.3 if rng.random() < 0.5 else block.level
    wave = list(Wave)[rng.integers(len(Wave))] if rng.random() < 0.15 else block.wave
    return WaveBlock(
        wave,
        min(block.amplitude * math.exp(size), amplitude),
        float(np.clip(block.frequency * math.exp(pace), *ends)),
        float(np.clip(level, -amplitude, amplitude)),
    )


def vary_run(
    run: Sequence[WaveBlock],
    rng: np.random.Generator,
    spread: float,
    reach: tuple[float, float],
    ends: tuple[float, float],
    fresh: Sequence[WaveBlock],
) -> list[WaveBlock]:
    """A run near another one: one block changed, exchanged, copied or moved, or all; small changes stay near."""
    changed, amplitude = list(run), max(abs(v) for v in reach)
    k, j = (int(n) for n in rng.integers(len(run), size=2))
    kind, size = rng.random(), spread * rng.random()
    one, every, exchanged, copied = CHANGES
    if kind < one:
        changed[k] = vary(run[k], rng, size, amplitude, ends)
    elif kind < every:
        changed = [vary(b, rng, ALL_BLOCKS_SPREAD * spread, amplitude, ends) for b in run]
    elif kind < exchanged:
        level = float(rng.uniform(*reach) * rng.random())
        changed[k] = replace(fresh[int(rng.integers(len(fresh)))], level=level)
    elif kind < copied:
        changed[k] = vary(run[j], rng, size, amplitude, ends)
    else:
        changed[k], changed[j] = run[j], run[k]
    return changed


Limits = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """The plant, or the loop that moves it, as a planned experiment runs it."""

    plant: System
    loop: ClosedLoop | None
    free: tuple[str, ...]  # parameters of the plant whose information counts
    per_log: tuple[str, ...]  # free ones that each log has for itself, which are eliminated
    noise: Mapping[str, float]  # of the outputs that will be logged [unit]
    limits: Limits  # of outputs, states, the command or the reference
    sample_time: float  # [s]
    start: Mapping[str, float]  # outputs at the rest from which each run begins
    origin: float = 0.0  # the excitation there [its unit]
    batch: int = 400_000  # samples that are simulated at once: each takes 100 bytes a signal

    @cached_property
    def command(self) -> Quantity:
        """The plant's input."""
        require(len(self.plant.inputs) == 1, _SEVERAL_INPUTS.format(", ".join(names(self.plant.inputs))), ModelError)
        return self.plant.inputs[0]

    @cached_property
    def excited_quantity(self) -> Quantity:
        """The excited quantity: the loop's reference as logs name it, or the plant's command."""
        if self.loop is None:
            return self.command
        seen = self.loop.feedback
        name = REFERENCE_CHANNELS.get(seen.name, f"{seen.name}_reference")
        return Quantity(name, seen.unit, seen.nominal)

    @property
    def channels(self) -> tuple[Quantity, ...]:
        """The excitation, the command, the plant's outputs, then states that are no outputs."""
        shown = [self.excited_quantity, self.command, *self.plant.outputs, *self.plant.states]
        return tuple({q.name: q for q in reversed(shown)}[n] for n in dict.fromkeys(names(shown)))

    def rest_excitation(self, parameters: ParameterSet) -> float:
        """The excitation at the start: the reference there, or the command that holds the plant at rest."""
        if self.loop is not None:
            return self.start.get(self.loop.feedback.name, 0.0)
        hook, known = self.plant.rest_hook, self.plant.parameters | parameters
        return 0.0 if hook is None else hook(known, self.start).inputs.get(self.command.name, 0.0)

    def excited_limits(self) -> tuple[float, float]:
        """The range of the excitation; a reference has that of its output if none of its own."""
        name = self.excited_quantity.name
        given = [n for n in (name, self.loop.feedback.name if self.loop else name) if n in self.limits]
        ends = self.limits[given[0]] if given else (-math.inf, math.inf)
        finite = math.isfinite(ends[0]) and math.isfinite(ends[1])
        require(finite, f"limits: give the least and greatest value of {name!r}, which is excited")
        return ends

    def rest(self, parameters: ParameterSet) -> Array:
        """The state from which a run begins, shape (n_states,)."""
        if self.loop is None:
            return self.plant.rest_state(parameters, self.start)
        others = {n: v for n, v in self.start.items() if n != self.loop.feedback.name}
        return self.loop.initial(parameters, reference=self.rest_excitation(parameters), start=others)

    def simulate(self, signals: Array, parameters: ParameterSet, substeps: int) -> Array:
        """Run excitations of shape (m, n), counted from the start; returns all `channels`, shape (m, n, n_channels)."""
        m, n = signals.shape
        size, given = max(1, self.batch // n), signals[:, :, None] + self.origin
        p, x0 = parameter_vector((self.loop or self.plant).parameters, parameters), self.rest(parameters)
        t, h = np.arange(n) * self.sample_time, np.full(n, self.sample_time)
        parts = []
        for u in np.split(given, range(size, m, size)):
            run = self._run.run(np.tile(x0, (len(u), 1)), u, p, t, h, substeps=substeps, states=1)
            assert run.x is not None
            held = run.y[:, :, -1:] if self.loop is not None else u
            columns = {self.excited_quantity.name: u[..., 0], self.command.name: held[..., 0]}
            columns |= {s: run.x[:, :, i] for i, s in enumerate(names(self.plant.states))}
            columns |= {y: run.y[:, :, i] for i, y in enumerate(names(self.plant.outputs))}
            parts.append(np.stack([columns[q.name] for q in self.channels], axis=2))
        return np.concatenate(parts)

    def violations(self, runs: Array, parameters: ParameterSet) -> Mapping[str, Array]:
        """The way of each run beyond each limit, as a share of its width, shape (m,); below zero: the room left."""
        out, position = {}, {q.name: i for i, q in enumerate(self.channels)}
        for name, (low, high) in self.all_limits(parameters).items():
            values = runs[:, :, position[name]]
            with np.errstate(invalid="ignore"):
                beyond = np.maximum(low - values.min(axis=1), values.max(axis=1) - high)
            width = high - low if np.isfinite(high - low) else max(abs(v) for v in (low, high) if np.isfinite(v))
            out[name] = np.where(np.isfinite(values).all(axis=1), beyond / width, np.inf)
        return out

    def all_limits(self, parameters: ParameterSet) -> Limits:
        """The given limits, and those of the plant's equations: the ends of the stroke, a vacuum."""
        out: dict[str, tuple[float, float]] = {n: (float(low), float(high)) for n, (low, high) in self.limits.items()}
        whole = self.plant.parameters | parameters
        for limit in self.plant.validity_limits:
            low, high = out.get(limit.state, (-np.inf, np.inf))
            end = float(limit.limit(whole))
            out[limit.state] = (low, min(high, end)) if limit.side > 0 else (max(low, end), high)
        return out

    def information(self, runs: Array, parameters: ParameterSet, substeps: int) -> Array:
        """The information of each run's log about the free parameters, as in `identify`, in their units; (m, k, k)."""
        m, n = runs.shape[:2]
        size = max(1, self.batch // n)
        if m > size:
            parts = [self.information(runs[i : i + size], parameters, substeps) for i in range(0, m, size)]
            return np.concatenate(parts)
        out = np.zeros((m, len(self.free), len(self.free)))
        if not m:
            return out
        method = LeastSquares()  # as `identify` places its nodes and weighs its gaps in the end
        length = max(2, round(method.segment_time / self.sample_time))
        count = -(-n // length)
        padded = np.pad(runs, ((0, 0), (0, count * length - n), (0, 0)), mode="edge")
        cut = padded.reshape(m * count, length, -1)
        x = cut[:, 0, self._positions(self.plant.states)]
        grid = np.arange(count * length) * self.sample_time
        real = np.tile((np.arange(len(grid)) < n).reshape(count, -1), (m, 1))
        t, h = np.tile(grid.reshape(count, -1), (m, 1)), np.where(real, self.sample_time, 0.0)
        weight = np.array([1 / self.noise[q.name] if q.name in self.noise else 0.0 for q in self.plant.outputs])
        u, p = cut[:, :, self._positions([self.command])], parameter_vector(self.plant.parameters, parameters)
        blank = np.where(real[..., None], 0.0, np.nan) + np.zeros(len(weight))
        found = self._sensitivities.gram(x, u, p, t, h, blank, np.broadcast_to(weight, blank.shape), substeps=substeps)
        grams = found.grams[:, :-1, :-1].reshape(m, count, *found.grams[0, :-1, :-1].shape)
        ends = found.dx_end.reshape(m, count, *found.dx_end.shape[1:])
        good = np.isfinite(grams).all(axis=(1, 2, 3)) & np.isfinite(ends).all(axis=(1, 2, 3))
        known = self.plant.parameters | parameters  # by whose sizes numbers of all units meet in one matrix
        own = np.array([abs(known.value(n)) or 1.0 for n in (*self.per_log, *self.free)])
        nominal = np.array([q.nominal for q in self.plant.states])
        scale = np.concatenate([nominal, own])
        jumps = method.stages[-1].gap * gap_scales(self._segments_about_rest(parameters), method.kinematic)
        kept = own[len(self.per_log) :]
        given = grams[good] * np.outer(scale, scale), ends[good] * scale / nominal[:, None]
        out[good] = linked_information(*given, jumps, len(self.per_log)) / np.outer(kept, kept)
        return out

    def stable_substeps(self, parameters: ParameterSet) -> int:
        """Integration steps a sample that are stable about the rest, at every state's usual size."""
        if not self.plant.states:
            return 1
        segments = self._segments_about_rest(parameters)
        q = np.array([v.value for v in segments.transcription.parameters.values()])
        return max(MIN_SUBSTEPS, 2 * stable_substeps(segments, start_nodes(segments), q, RK4_MAX_H_LAMBDA))

    def _segments_about_rest(self, parameters: ParameterSet) -> Segments:
        x = self.plant.rest_state(self.plant.parameters | parameters, self.start)
        usual = np.diag([q.nominal for q in self.plant.states])
        guess = np.concatenate([[x], x + usual, x - usual])
        n = len(guess)
        t, h = self.sample_time * np.arange(n, dtype=np.float64), np.full(n, self.sample_time)
        phase = Phase("rest", t, h, np.zeros((n, 1)), np.arange(n), guess=guess)
        known = self.plant.parameters | parameters.select(q for q in parameters if q in self.plant.parameters)
        return segment(Transcription(self.plant.discrete(), known, (phase,)))

    @cached_property
    def _run(self) -> Rollout:
        return Rollout((self.loop or self.plant).discrete().pieces)

    @cached_property
    def _sensitivities(self) -> Rollout:
        order = list(self.plant.parameters)
        wrt = [order.index(n) for n in (*self.per_log, *self.free)]
        return Rollout(self.plant.discrete().pieces, wrt=wrt, start=True)

    def _positions(self, quantities: Sequence[Quantity]) -> Indices:
        place = {q.name: i for i, q in enumerate(self.channels)}
        return np.array([place[q.name] for q in quantities], dtype=np.intp)


_SEVERAL_INPUTS = "a planned run excites one input, the plant has {}; plan it with a friction model that needs one"


@dataclass(frozen=True, eq=False)
class Judge:
    """The criterion of information matrices."""

    criterion: Criterion
    free: tuple[str, ...]
    targets: tuple[str, ...]
    parameters: ParameterSet
    worst_case: bool

    @cached_property
    def sizes(self) -> Array:
        """The size that each standard deviation is divided by: the value, or of an offset at zero its range or 1."""
        return np.array([value_size(self.parameters, n) for n in self.free])

    def covariance(self, information: Array) -> Array:
        """The covariance of all free parameters, in units of their sizes."""
        scaled = information * np.outer(self.sizes, self.sizes) + np.eye(len(self.free)) / VAGUE**2
        return np.asarray(np.linalg.inv(scaled))

    def deviation(self, information: Array) -> Array:
        """The criterion's figure, over plants along the first axis; shape (plants, ..., k, k) -> (...)."""
        chosen = [self.free.index(n) for n in self.targets]
        figures = self.criterion.deviation(self.covariance(information)[..., chosen, :][..., :, chosen])
        with np.errstate(divide="ignore"):
            every = np.log(np.where(np.isnan(figures), np.inf, figures))
        return np.asarray(np.exp(every.max(axis=0) if self.worst_case else every.mean(axis=0)))


@dataclass(eq=False)
class DesignSearch:
    """The search for the blocks of all runs."""

    run: PlannedRun
    plants: tuple[ParameterSet, ...]
    known: Array
    judge: Judge
    samples: int
    runs: int
    rng: np.random.Generator
    budget: CpuBudget
    progress: ProgressReporter
    repeats: int = 1  # times that the run's information counts
    _parts: "dict[int, DesignSearch]" = field(default_factory=dict)
    tried: int = 0
    substeps: int = MIN_SUBSTEPS
    variations: int = 12  # of a block at once, in SIMD lanes

    def design(self) -> ExperimentDesign:
        """Choose blocks, refine the runs, and predict what they tell."""
        self.substeps = max(self.run.stable_substeps(p) for p in self.plants)
        chosen = self._find_blocks()
        signals = np.stack([self._signal(blocks) for blocks in chosen])
        nominal, fine = self.plants[0], 2 * self.substeps
        shown = self.run.simulate(signals, nominal, fine)
        gained = self.run.information(shown, nominal, fine).sum(axis=0)
        every = [self.run.violations(self.run.simulate(signals, p, self.substeps), p) for p in self.plants]
        room = {n: float(max(np.max(v[n]) for v in every)) for n in every[0]}
        channels = names(self.run.channels)
        runs = tuple(Trajectory(self._grid, dict(zip(channels, r.T, strict=True))) for r in shown)
        table = tabulate_design(nominal, self.run.free, self.judge.targets, self.known, gained)
        table = table.drop(index=[n for n in estimated_widths(nominal) if n in table.index])
        origin = self.run.origin
        steps = tuple(tuple(b.describe(self.run.excited_quantity.unit) for b in blocks) for blocks in chosen)
        units, tried = {q.name: q.unit for q in self.run.channels}, sum(s.tried for s in (self, *self._parts.values()))
        before, after = (float(self.judge.deviation(f[None])) for f in (self.known, self.known + gained))
        figures = {"before": before, "after": after, "tried": float(tried), "origin": origin}
        figures |= {"plants": float(len(self.plants)), "cpu_seconds": self.budget.seconds}
        return ExperimentDesign(
            self.run.excited_quantity.name,
            runs,
            steps,
            table,
            self.run.all_limits(nominal),
            room,
            repr(self.judge.criterion),
            figures,
            units,
        )

    def _find_blocks(self) -> list[list[WaveBlock]]:
        """The blocks of all runs, found in the whole duration or in a part of it, whichever has begun better."""
        whole = self._begin()
        search, runs = self, whole
        if (part := self._part(MOST_REPEATS)) is not self:
            with suppress(InputError):  # a part may allow no wave, or end where the next one breaks a limit
                begun = part._begin()
                if part._figure(begun) < self._figure(whole):
                    search, runs = part, begun
        try:
            while search is not self:
                runs = search._refine(runs, self.budget.part(PART_SHARE))
                search = self._part(search.repeats // 2)
                runs = search._fit_into_limits([blocks * 2 for blocks in runs])
        except InputError:
            runs = whole
        return self._refine(min(runs, whole, key=self._figure), self.budget)

    def _begin(self) -> list[list[WaveBlock]]:
        """Blocks of the library, refined for a while."""
        return self._refine(self._fit_into_limits(self._choose_blocks()), self.budget.part(BEGIN_SHARE))

    def _part(self, repeats: int) -> "DesignSearch":
        """The search for runs that are so many times shorter; this one where they would be too short."""
        samples = self.samples // repeats
        if repeats == 1 or samples < BLOCKS * MIN_BLOCK_SAMPLES:
            return self
        coarse = -(-self.substeps // 2)
        part = replace(self, samples=samples, repeats=repeats, substeps=coarse, tried=0)
        return self._parts.setdefault(repeats, part)

    @cached_property
    def _grid(self) -> Array:
        return np.asarray(np.arange(self.samples) * self.run.sample_time, dtype=np.float64)

    @property
    def _blocks(self) -> int:
        return max(1, min(BLOCKS, self.samples // MIN_BLOCK_SAMPLES))

    @cached_property
    def _reach(self) -> tuple[float, float]:
        """The range of the excitation, down and up from the start."""
        low, high = self.run.excited_limits()
        return low - self.run.origin, high - self.run.origin

    @cached_property
    def _waves(self) -> list[WaveBlock]:
        """Blocks of every kind."""
        t = self._grid[: self.samples // self._blocks]
        return library(max(abs(v) for v in self._reach), float(t[-1]) or self.run.sample_time, self.run.sample_time)

    def _choose_blocks(self) -> list[list[WaveBlock]]:
        """The blocks of all runs by exchange: their information adds up."""
        t, waves = self._grid[: self.samples // self._blocks], self._waves
        gains, keeps = self._evaluate(np.stack([np.clip(b.samples(t), *self._reach) for b in waves]))
        if not keeps.any():
            raise self._infeasible(waves, t)
        waves = [b for b, good in zip(waves, keeps, strict=True) if good]
        gains = gains[:, keeps]
        picked = list[int]()
        total = np.repeat(self.known[None], len(self.plants), axis=0)
        for _ in range(self._blocks * self.runs):
            best = int(np.argmin(self.judge.deviation(total[:, None] + gains)))
            picked.append(best)
            total = total + gains[:, best]
        for _ in range(QUIET_ROUNDS):
            for k, old in enumerate(picked):
                rest = total - gains[:, old]
                picked[k] = int(np.argmin(self.judge.deviation(rest[:, None] + gains)))
                total = rest + gains[:, picked[k]]
        ordered = sorted(picked, key=lambda i: waves[i].amplitude)
        return [[waves[i] for i in ordered[r :: self.runs]] for r in range(self.runs)]

    def _fit_into_limits(self, runs: list[list[WaveBlock]]) -> list[list[WaveBlock]]:
        """The blocks of each run in a row, all made smaller until the whole run keeps the limits."""
        message, fitted = "the blocks of a run, one behind the other, keep no limits; plan a shorter duration", []
        for blocks in runs:
            sizes = np.geomspace(1.0, 1e-3, 25).tolist()
            rows = [[replace(b, amplitude=b.amplitude * size) for b in blocks] for size in sizes]
            _, keeps = self._evaluate(np.stack([self._signal(row) for row in rows]))
            require(bool(keeps.any()), message)
            fitted.append(rows[int(np.argmax(keeps))])
        return fitted

    def _figure(self, runs: list[list[WaveBlock]]) -> float:
        """The criterion after these runs."""
        gains = self._evaluate(np.stack([self._signal(blocks) for blocks in runs]))[0]
        return float(self.judge.deviation(self.known + gains.sum(axis=1)))

    def _refine(self, runs: list[list[WaveBlock]], budget: CpuBudget) -> list[list[WaveBlock]]:
        """Change the runs by chance, far and near in turn, and keep what is better within the limits."""
        every = self._evaluate(np.stack([self._signal(blocks) for blocks in runs]))[0]
        best = float(self.judge.deviation(self.known + every.sum(axis=1)))
        fastest = max(CYCLES_A_SAMPLE / self.run.sample_time, 2 / self._grid[-1])
        ends, quiet = (1 / float(self._grid[-1]), fastest), 0
        while quiet < QUIET_CYCLES and not budget.is_spent:
            before = best
            for r, spread in itertools.product(list(range(self.runs)) * (ROUNDS_A_SPREAD * len(runs[0])), SPREADS):
                if budget.is_spent:
                    break
                others = self.known + every.sum(axis=1) - every[:, r]
                tried = [
                    vary_run(runs[r], self.rng, spread, self._reach, ends, self._waves) for _ in range(self.variations)
                ]
                gains, keeps = self._evaluate(np.stack([self._signal(row) for row in tried]))
                figures = np.where(keeps, self.judge.deviation(others[:, None] + gains), np.inf)
                winner = int(np.argmin(figures))
                if figures[winner] < best:
                    best, runs[r] = float(figures[winner]), tried[winner]
                    every[:, r] = gains[:, winner]
                self.progress(f"relative standard deviation {best:.3g}, {self.tried} runs tried")
            quiet = quiet + 1 if best > (1 - MIN_GAIN) * before else 0
        return runs

    def _evaluate(self, signals: Array) -> tuple[Array, Array]:
        """Information of excitations, shape (plants, m, k, k), and whether all plants keep the limits under them."""
        (low, high), k = self._reach, len(self.run.free)
        keeps = (signals.min(axis=1) >= low - 1e-12) & (signals.max(axis=1) <= high + 1e-12)
        gains = np.zeros((len(self.plants), len(signals), k, k))
        self.tried += len(signals)
        shown = {}
        for i, plant in enumerate(self.plants):
            rows = np.flatnonzero(keeps)
            if not rows.size:
                break
            found = self.run.simulate(signals[rows], plant, self.substeps)
            shown[i] = rows, found
            for beyond in self.run.violations(found, plant).values():
                keeps[rows] &= beyond <= 0
        for i, (rows, found) in shown.items():
            kept = keeps[rows]
            gains[i, rows[kept]] = self.run.information(found[kept], self.plants[i], self.substeps)
        return self.repeats * gains, keeps

    def _signal(self, blocks: Sequence[WaveBlock]) -> Array:
        return np.clip(join_blocks(blocks, self._grid), *self._reach)

    def _infeasible(self, waves: Sequence[WaveBlock], t: Array) -> InputError:
        """Which limit even the gentlest excitation breaks, and what it would need."""
        gentle = min(waves, key=lambda b: (b.amplitude, b.frequency))
        signal = np.clip(gentle.samples(t), *self._reach)[None]
        worst, name, low, high = -math.inf, "", 0.0, 0.0
        for plant in self.plants:
            shown = self.run.simulate(signal, plant, self.substeps)
            for n, beyond in self.run.violations(shown, plant).items():
                if beyond[0] > worst:
                    values = shown[0, :, names(self.run.channels).index(n)]
                    worst, name, low, high = float(beyond[0]), n, float(values.min()), float(values.max())
        unit = next(q.unit for q in self.run.channels if q.name == name)
        needs = f"it moves from {write_value(low, unit, 3)} to {write_value(high, unit, 3)}"
        remedy = "widen that limit, start elsewhere (start=), or close a loop around a plant that runs away"
        return InputError(f"limits: no excitation keeps {name!r}: under the gentlest one, {needs}; {remedy}")


def value_size(parameters: ParameterSet, name: str) -> float:
    """The size that a standard deviation of a parameter is compared with [its unit]."""
    p = parameters[name]
    width = p.upper - p.lower
    return abs(p.value) or (width if math.isfinite(width) and width > 0 else 1.0)


def next_experiment(
    system: HasSystem | ClosedLoop,
    parameters: ParameterSet,
    *,
    duration: float,
    limits: Mapping[str, tuple[float, float]],
    criterion: Criterion | None = None,
    fit: IdentificationResult | None = None,
    covariance: "pd.DataFrame | None" = None,
    noise: Mapping[str, float] | None = None,
    sample_time: float | None = None,
    start: Mapping[str, float] | None = None,
    runs: int = 1,
    plants: Mapping[str, Mapping[str, float]] | int = 2,
    worst_case: bool = False,
    cpu_seconds: float = 60.0,
    seed: int = 0,
    progress: Callable[[Progress], None] | None = None,
) -> ExperimentDesign:
    """Find the run whose log will shrink the confidence intervals most, together with the logs in hand.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        A loop is excited by its reference, a plant by its command (open loop). The log of either holds the command,
        with which the plant is identified; a force that is a command is held, ``with_intersample``.
    parameters : ParameterSet
        As estimated so far, with the controller's of a loop; the free ones are those that the next `identify` frees.
        It also estimates the widths that are not stated, which therefore count, without a row in the table.
    duration : float
        Of a run [s].
    limits : mapping of str to (float, float)
        Least and greatest value of outputs, states, the command or the reference, kept at every sample. What is excited
        needs one; a reference has that of the output that it is for. The model's own limits, such as the ends of the
        stroke, hold besides.
    criterion : DOptimal, AOptimal or Precision, optional
        What to make small; by default `DOptimal` of all free parameters.
    fit : IdentificationResult, optional
        Of the logs in hand: their information, and the noise of its channels. Without it only the new run counts.
    covariance : DataFrame, optional
        In place of the fit: the covariance of its estimates, as a fit.toml holds it.
    noise : mapping of str to float, optional
        Standard deviation of each output that will be logged [unit]; by default as in the fit.
    sample_time : float, optional
        Of excitation and log [s]; by default the loop's.
    start : mapping of str to float, optional
        Outputs at the rest where each run begins; by default in the middle of the limits on the position.
    runs : int
        Runs that are planned together, each from rest.
    plants : int, or mapping of str to mapping of str to float
        Other plants for which the run must be good and keep the limits: so many draws from the covariance, or the
        changed parameters of each (`corners`, `samples` and `draws` give such).
    worst_case : bool
        Judge by the plant with the worst criterion, not by the geometric mean over the plants.
    cpu_seconds : float
        After which the refinement ends [s].
    seed : int
        The same seed gives the same run, if the time suffices.
    progress : callable, optional
        Receives a `Progress` after each round.

    Returns
    -------
    ExperimentDesign

    Raises
    ------
    InputError
        If a limit, a noise or a name is missing or wrong, or if no excitation keeps the limits: it says what could be.
    """
    budget, seen = CpuBudget(cpu_seconds), ProgressReporter(progress, "next_experiment")
    model = as_runnable(system)
    check_smooth(model)
    if noise is None and fit is not None:
        # of each channel the larger of its noise and what its residuals show, the median over the logs
        inflation = math.sqrt(max(1.0, float(fit.stats.get("variance_inflation", 1.0))))
        channels = fit.fit.reset_index().groupby("channel")
        noise = {str(n): float(own[["noise", "rmse"]].max(axis=1).median()) * inflation for n, own in channels}
    parameters = count_widths(model.plant, parameters)
    run = _plan(model, parameters, duration, limits, noise or {}, sample_time, start, runs)
    whole = run.plant.parameters | (model.parameters | parameters)
    wanted = criterion or DOptimal()
    own = tuple(n for n in run.free if n not in estimated_widths(whole))
    targets = tuple(n for n in whole.match_names(*(wanted.targets or own)) if n in run.free)
    fixed = [n for n in wanted.targets if n in whole and n not in run.free]
    require(not fixed, f"criterion: {', '.join(fixed)} is not free; free what the next identification is to find")
    require(bool(targets), f"criterion: {', '.join(wanted.targets)}: none of these is free")
    known = fit.covariance if fit is not None else covariance
    others = _draw(whole, run.free, known, plants, seed) if isinstance(plants, int) else plants
    search = DesignSearch(
        run,
        (whole, *(whole.with_values(values) for values in others.values())),
        _known_information(run.free, known),
        Judge(wanted, run.free, targets, whole, worst_case=worst_case),
        round(duration / run.sample_time),
        runs,
        generator(seed, "next_experiment"),
        budget,
        seen,
    )
    return search.design()


def _plan(
    model: object,
    parameters: ParameterSet,
    duration: float,
    limits: Limits,
    noise: Mapping[str, float],
    sample_time: float | None,
    start: Mapping[str, float] | None,
    runs: int,
) -> PlannedRun:
    """Check what was asked for, and complete it."""
    loop = model if isinstance(model, ClosedLoop) else None
    plant = model.plant  # type: ignore[attr-defined]
    step = (loop.pid.sample_time if loop else None) if sample_time is None else sample_time
    require(step is not None and 0 < step < math.inf, "sample_time: say at which time [s] the excitation is played")
    assert step is not None
    own = loop.pid.sample_time if loop else step
    require(
        own is not None, "a planned run needs a sampled controller: give the loop's PID its sample_time", ModelError
    )
    require(own == step, f"sample_time: the loop's controller acts every {own:g} s; leave it out")
    fits = 2 * MIN_BLOCK_SAMPLES * step <= duration <= MAX_SAMPLES * step
    room = f"{2 * MIN_BLOCK_SAMPLES * step:g} to {MAX_SAMPLES * step:g} s"
    require(fits, f"duration = {duration:g} s: with a sample every {step:g} s it may be {room}")
    require(runs >= 1, f"runs = {runs}: plan one at least")
    free = tuple(n for n in parameters.free_names if n in plant.parameters)
    shared = tuple(n for n in free if not parameters[n].per_log)
    require(bool(shared), "no parameter of the plant is free; free what the next identification is to find")
    check_names("output", noise, names(plant.outputs), "noise")
    require(bool(noise), "noise: give the standard deviation of each output that will be logged, or a fit")
    wrong = [n for n, sigma in noise.items() if not 0 < sigma < math.inf]
    require(not wrong, f"noise: that of {', '.join(wrong)} must be positive")
    per_log = tuple(n for n in free if parameters[n].per_log)
    run = PlannedRun(plant, loop, shared, per_log, dict(noise), dict(limits), step, {})
    check_names("signal", limits, names(run.channels), "limits")
    empty = [n for n, (low, high) in limits.items() if not low < high]
    require(not empty, f"limits: {', '.join(empty)}: the least value must lie below the greatest")
    run.excited_limits()
    begun = dict(start or {})
    check_names("output", begun, names(plant.outputs), "start")
    for name in ("position", "angle"):
        low, high = limits.get(name, (-math.inf, math.inf))
        if name in names(plant.outputs) and math.isfinite(high - low):
            begun.setdefault(name, (low + high) / 2)  # the middle of its limits
    run = replace(run, start=begun)
    return replace(run, origin=run.rest_excitation(parameters))


def _known_information(free: Sequence[str], covariance: "pd.DataFrame | None") -> Array:
    """The information that a fit has about the free parameters, the others unknown; zero where it has no interval."""
    out = np.zeros((len(free), len(free)))
    if covariance is None:
        return out
    known = _known_names(free, covariance)
    place = [free.index(n) for n in known]
    if known:
        values = covariance.loc[known, known].to_numpy(dtype=float)
        spread = np.sqrt(np.diag(values))
        scale = np.outer(spread, spread)
        out[np.ix_(place, place)] = np.linalg.pinv(values / scale, hermitian=True) / scale
    return out


def _draw(
    parameters: ParameterSet, free: Sequence[str], covariance: "pd.DataFrame | None", count: int, seed: int
) -> Mapping[str, Mapping[str, float]]:
    """Plants as the fit leaves them possible."""
    require(count >= 0, f"plants = {count}: give how many are drawn beside the estimates, or the plants")
    if covariance is None or not count:
        return {}
    known = _known_names(free, covariance)
    spread = np.sqrt(np.diag(covariance.loc[known, known].to_numpy(dtype=float)))
    most = MAX_WRONG * np.array([value_size(parameters, n) for n in known])
    cut = np.minimum(1.0, most / np.maximum(spread, 1e-300))
    shrunk, own = covariance.loc[known, known] * np.outer(cut, cut), further(seed, "next_experiment")
    return draw_plants(parameters, shrunk, count, seed=own) if known else {}


def _known_names(free: Sequence[str], covariance: "pd.DataFrame") -> list[str]:
    """The free parameters that have an interval."""
    variances = dict(zip(map(str, covariance.index), np.diag(covariance.to_numpy(dtype=float)).tolist(), strict=True))
    return [n for n in free if math.isfinite(variances.get(n, math.nan))]


@dataclass(frozen=True, eq=False, repr=False)
class DesignOutlook(Shown):
    """A design over the dates of a history, and beyond.

    Attributes
    ----------
    table : DataFrame
        A row a date: ahead, whether it is extrapolated; each limited or minimised metric, the worst over the
        references; fails, the limits that are violated and the defects, in words, empty where there are none.
    """

    table: pd.DataFrame

    @property
    def fails(self) -> "datetime | None":
        """The first date from which on the design fails at every later one; None: it holds at the last."""
        bad = (self.table["fails"] != "").to_numpy()
        begin = len(bad) - int(np.argmin(bad[::-1])) if not bad.all() else 0
        return None if begin == len(bad) else self.table.index[begin].to_pydatetime()

    def summary(self) -> Report:
        """Whether and when to tune again, then a row a date."""
        last = f"{self.table.index[-1]:%Y-%m-%d}"
        verdict = Line(f"the tuned loop keeps its requirements until {last}", Tone.GOOD)
        if (begin := self.fails) is not None:
            ahead = bool(self.table["ahead"][begin])
            when = "will fail by" if ahead else "fails since"
            why = self.table["fails"][begin]
            verdict = Line(f"tune again: the tuned loop {when} {begin:%Y-%m-%d} ({why})", Tone.BAD)
        names = [str(n) for n in self.table.columns if n not in ("ahead", "fails")]
        columns = (Column("date", is_text=True), *map(Column, names), Column("fails", is_text=True))
        rows = []
        for row in self.table.reset_index().to_dict(orient="records"):
            date = f"{row['date']:%Y-%m-%d}" + (" (ahead)" if row["ahead"] else "")
            rows.append((date, *(format_number(float(row[n]), 4) for n in names), str(row["fails"])))
        return Report((verdict, Table(columns, tuple(rows))))


def predict_loss(
    tracking: Tracking,
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    objective: Objective,
    *,
    ahead: int = 4,
) -> DesignOutlook:
    """Certify a design at the estimates of each log, and along the drift into the future.

    Parameters
    ----------
    tracking : Tracking
        Whose drift moves the plant.
    loop : ClosedLoop
        The loop that was tuned, with its gains among the parameters.
    references : Reference or sequence of Reference
        As of `tune`.
    parameters : ParameterSet
        The design's gains and the plant's other values.
    objective : Specification, Requirement or mapping
        What was tuned for, with its limits.
    ahead : int
        Dates beyond the last log: they reach as far ahead as the logs reach back. Parameters with an alarm go on along
        their line there; the others stay at their line's value at the last log.

    Returns
    -------
    DesignOutlook

    Raises
    ------
    InputError
        If a tracked parameter is none of the loop's.
    """
    spec = objective if isinstance(objective, Specification) else specify(objective)
    unknown = [n for n in tracking.table.index if n not in loop.plant.parameters]
    require(not unknown, f"{', '.join(map(str, unknown))}: no parameter of the loop's plant; track what it has")
    own = {str(n): tracking.history.loc[n].to_dict(orient="list") for n in tracking.table.index}
    dates = [pd.Timestamp(d) for d in tracking.history.loc[tracking.table.index[0]].index]
    plants = [(d, False, {n: float(column["value"][k]) for n, column in own.items()}) for k, d in enumerate(dates)]
    for share in np.arange(1, ahead + 1) / max(ahead, 1):
        moved = {}
        for name, column in own.items():
            first, last = float(column["line"][0]), float(column["line"][-1])
            moved[name] = last + (share * (last - first) if name in tracking.drifting else 0.0)
        plants.append((dates[-1] + share * (dates[-1] - dates[0]), True, moved))
    rows = {}
    for date, is_ahead, values in plants:
        known = parameters.with_values({n: v for n, v in values.items() if np.isfinite(v)})
        rows[date] = {"ahead": is_ahead, **_certify(loop, references, known, spec)}
    return DesignOutlook(pd.DataFrame.from_dict(rows, orient="index").rename_axis("date"))


def _certify(
    loop: ClosedLoop, references: Reference | Sequence[Reference], parameters: ParameterSet, spec: Specification
) -> dict[str, float | str]:
    """The worst metrics of a design, and why it fails."""
    proof = certificate(loop, references, parameters, band=spec.band, envelope=spec.envelope)
    failures = list(dict.fromkeys(finding.defect.value for finding in proof.findings))
    for case in proof.metrics:
        figures = {str(n): float(v) for n, v in proof.metrics[case].items()}
        violated = spec.violations(requirement_values(figures), SLACK)
        failures += [n for n in map(metric_name, violated) if n not in failures]
    row: dict[str, float | str] = {}
    for name in (n for n in spec.metric_names if n in proof.metrics.index):
        worst = np.min if larger_is_better(name) else np.max
        row[name] = float(worst(proof.metrics.loc[name].to_numpy(dtype=float)))
    return {**row, "fails": ", ".join(failures)}
