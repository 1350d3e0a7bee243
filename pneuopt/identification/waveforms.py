"""`Block`: a stretch of a planned excitation, a wave about a level; excitations are blocks one behind the other."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.units import write_value

LEVEL_SHARE = 0.15
"""Share of a block [1] in which the excitation moves smoothly to its level: less knocks the axis, more wastes time."""
CHIRP_RATIO = 4.0  # of a chirp's last to its first frequency: less is a sine, more hurries past each
AMPLITUDES = 10  # amplitudes of the library: fewer miss the edge of sticking, which the refinement finds again
FREQUENCIES = 8  # frequencies of the library: as for the amplitudes
LEAST_AMPLITUDE = 3e-4
"""Share of the range [1] of the smallest wave: smaller ones drown in noise, and presliding motion needs this one."""
ONE_BLOCK, ALL_BLOCKS, FRESH_BLOCK, COPIED_BLOCK = 0.6, 0.75, 0.9, 0.95
"""Shares [1], each up to the next, of the kinds of change of a run; the rest moves blocks. The first kind refines, the
others lead out of where it ends."""
ALL_BLOCKS_SPREAD = 0.15
"""By how much less blocks move that move together [1]: as far as one alone, hardly any change is for the better."""
CYCLES_A_SAMPLE = 0.08  # of the highest frequency [1]: a faster wave has corners that the controller cannot play


class Wave(Enum):
    """The form of a block."""

    SINE = "sine"
    TRIANGLE = "triangle"
    SQUARE = "square wave"
    CHIRP = "chirp"


@dataclass(frozen=True)
class Block:
    """A wave about a level.

    Attributes
    ----------
    wave : Wave
    amplitude : float
        Peak [unit of the excitation].
    frequency : float
        [Hz]; a chirp's first one.
    level : float
        About which it goes, counted from the start of the run [unit of the excitation].
    """

    wave: Wave
    amplitude: float
    frequency: float
    level: float = 0.0

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


def join_blocks(blocks: Sequence[Block], t: Array) -> Array:
    """The excitation of equally long blocks, counted from its start, shape (n,); levels are joined smoothly."""
    out = np.empty(len(t))
    edges = np.linspace(0, len(t), len(blocks) + 1).round().astype(int)
    level = 0.0
    for block, (begin, end) in zip(blocks, itertools.pairwise(edges.tolist()), strict=True):
        own = t[begin:end] - t[begin]
        way = np.clip(own / (LEVEL_SHARE * own[-1]), 0, 1) if own[-1] > 0 else np.ones_like(own)
        out[begin:end] = level + (block.level - level) * (1 - np.cos(np.pi * way)) / 2 + block.samples(own)
        level = block.level
    return out


def library(amplitude: float, duration: float, sample_time: float) -> list[Block]:
    """Blocks of every known kind: slow ramps, steps, sines from presliding to full range, chirps.

    Parameters
    ----------
    amplitude : float
        The largest [unit of the excitation].
    duration : float
        Of a block [s].
    sample_time : float
        [s]
    """
    fastest = max(CYCLES_A_SAMPLE / sample_time, 2 / duration)
    sizes = amplitude * np.geomspace(LEAST_AMPLITUDE, 1.0, AMPLITUDES)
    paces = np.geomspace(1 / duration, fastest, FREQUENCIES)
    waves = [Block(w, a, f) for w, a, f in itertools.product(Wave, sizes.tolist(), paces.tolist())]
    return [b for b in waves if b.wave is not Wave.CHIRP or CHIRP_RATIO * b.frequency <= fastest]


def vary(block: Block, rng: np.random.Generator, spread: float, amplitude: float, ends: tuple[float, float]) -> Block:
    """A block near another one, its numbers moved by about `spread` of themselves, its level by that of the range.

    Parameters
    ----------
    block : Block
    rng : numpy.random.Generator
    spread : float
    amplitude : float
        The largest [unit of the excitation].
    ends : (float, float)
        Lowest and highest frequency [Hz].
    """
    size, pace, shift = rng.standard_normal(3) * spread
    level = block.level + shift * amplitude * 0.3 if rng.random() < 0.5 else block.level
    wave = list(Wave)[rng.integers(len(Wave))] if rng.random() < 0.15 else block.wave
    return Block(
        wave,
        min(block.amplitude * math.exp(size), amplitude),
        float(np.clip(block.frequency * math.exp(pace), *ends)),
        float(np.clip(level, -amplitude, amplitude)),
    )


def vary_run(
    run: Sequence[Block],
    rng: np.random.Generator,
    spread: float,
    reach: tuple[float, float],
    ends: tuple[float, float],
    fresh: Sequence[Block],
) -> list[Block]:
    """A run near another one: mostly with one block changed, else with all, with one exchanged, copied or moved.

    Small changes alone stay where the exchange of separate blocks began: what a block tells depends on its neighbours.

    Parameters
    ----------
    run : sequence of Block
    rng : numpy.random.Generator
    spread : float
        As for `vary`.
    reach : (float, float)
        How far the excitation may go down and up from the start [its unit].
    ends : (float, float)
        Lowest and highest frequency [Hz].
    fresh : sequence of Block
        Blocks that one may be exchanged for, at any level.
    """
    changed, amplitude = list(run), max(abs(v) for v in reach)
    k, j = (int(n) for n in rng.integers(len(run), size=2))
    kind, size = rng.random(), spread * rng.random()
    if kind < ONE_BLOCK:
        changed[k] = vary(run[k], rng, size, amplitude, ends)
    elif kind < ALL_BLOCKS:
        changed = [vary(b, rng, ALL_BLOCKS_SPREAD * spread, amplitude, ends) for b in run]
    elif kind < FRESH_BLOCK:
        level = float(rng.uniform(*reach) * rng.random())
        changed[k] = replace(fresh[int(rng.integers(len(fresh)))], level=level)
    elif kind < COPIED_BLOCK:
        changed[k] = vary(run[j], rng, size, amplitude, ends)
    else:
        changed[k], changed[j] = run[j], run[k]
    return changed
