"""Search by compiled simulation: differential evolution over ever narrower bands, then a local refinement.

For any loop, friction, clip and sampling included. Directly at a narrow band a search stalls where nothing settles yet;
what settles within 10 % leads to what settles within 2 %.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pneuopt.control.reference import Step
from pneuopt.errors import require
from pneuopt.requirements import MaxSensitivity, Specification, name
from pneuopt.tuning.candidates import Space, Tell
from pneuopt.tuning.simulator import Simulator

Array = NDArray[np.float64]
PENALTY = 20.0  # weight of a limit's relative violation, in units of the objective's scale
LOST = 1e6


@dataclass(frozen=True)
class Screening:
    """Differential evolution on compiled simulations, then Nelder-Mead from the best.

    Parameters
    ----------
    members : int
        Of the population.
    generations : int
        In each stage; there is one for each of `bands`, and two for the band asked for.
    bands : tuple of float
        Settling bands of the first stages, as far as they are wider than the one asked for.
    refinements : int
        Simulations of the local search.
    margin : float
        How much tighter the search's limits are than those asked for.
    seed : int
    digits : int, optional
        Significant digits of the gains handed out; None: all.
    """

    members: int = 40
    generations: int = 15
    bands: tuple[float, ...] = (0.1, 0.05)
    refinements: int = 300
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4

    def __post_init__(self) -> None:
        require(self.members >= 5, f"Screening: members must be at least 5, got {self.members}")
        require(self.generations >= 1, f"Screening: generations must be at least 1, got {self.generations}")
        require(self.refinements >= 0, f"Screening: refinements must not be negative, got {self.refinements}")
        require(0 <= self.margin < 1, f"Screening: margin is a fraction below 1, got {self.margin}")
        require(self.digits is None or self.digits >= 2, f"Screening: digits must be at least 2, got {self.digits}")


@dataclass(frozen=True, eq=False)
class Screened:
    """What `screen` found.

    Attributes
    ----------
    point : ndarray, shape (n,)
        The best by merit.
    count : int
        Candidates simulated.
    is_complete : bool
        False where Ctrl-C cut the search short.
    """

    point: Array
    count: int
    is_complete: bool


def screen(
    simulator: Simulator,
    references: Sequence[Step],
    space: Space,
    spec: Specification,
    method: Screening,
    start: Array,
    tell: Tell,
) -> Screened:
    """The best point found; Ctrl-C ends the search with the best so far.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
        Already tightened.
    start : ndarray, shape (n,)
        A member of the first population.
    tell : callable
        Hears of each generation.
    """
    judge = _Judge(simulator, space, spec, min(r.horizon - r.at for r in references), space.unit(start))
    try:
        _search(judge, spec, method, tell)
    except KeyboardInterrupt:
        return Screened(space.draw(judge.best), judge.count, is_complete=False)
    return Screened(space.draw(judge.best), judge.count, is_complete=True)


def _search(judge: "_Judge", spec: Specification, method: Screening, tell: Tell) -> None:
    rng = np.random.default_rng(method.seed)
    population = _first_population(method.members, judge.best, rng)
    for band in [*(b for b in method.bands if b > spec.band), spec.band, spec.band]:
        judge.ask(spec.with_band(band))
        merits = judge(population)
        for number in range(method.generations):
            population, merits = _generation(population, merits, judge, rng)
            tell(f"band {band:.3g}, generation {number + 1} of {method.generations}: best {merits.min():.4g}")
    if method.refinements:
        _refine(judge.best, judge, method.refinements)


class _Judge:
    """Merit of points of the unit cube, one a row; counts them, and keeps the best under what was asked last."""

    def __init__(self, simulator: Simulator, space: Space, spec: Specification, scale: float, start: Array) -> None:
        self._simulator, self._space, self._spec, self._scale = simulator, space, spec, scale
        self.best, self._least, self.count = start, np.inf, 0

    def ask(self, spec: Specification) -> None:
        """Judge by another specification from now on."""
        self._spec, self._least = spec, np.inf

    def __call__(self, unit: Array) -> Array:
        return self.race(unit, np.full(len(unit), np.inf))

    def race(self, unit: Array, rivals: Array) -> Array:
        """The merit of each point that may beat its rival, and of the others a lower bound that does not.

        The sensitivity, a frequency response a point, costs as much as a simulation; as a limit it only adds.
        """
        self.count += len(unit)
        responses = self._simulator.respond(self._space.draw(np.clip(unit, 0.0, 1.0)), self._spec.band)
        merits = np.full(len(unit), -np.inf)
        if not self._spec.weight(MaxSensitivity):
            merits = merit(responses.values, self._spec.without(MaxSensitivity), self._scale)
        if self._spec.concerns(MaxSensitivity):
            ahead = merits <= rivals
            merits[ahead] = merit(responses.robust(ahead), self._spec, self._scale)
        k = int(np.argmin(merits))
        if merits[k] < self._least:
            self.best, self._least = unit[k], float(merits[k])
        return merits


def _generation(population: Array, merits: Array, judge: _Judge, rng: np.random.Generator) -> tuple[Array, Array]:
    """One generation of differential evolution: half of the members search about themselves and the best."""
    m, n = population.shape
    a, b, c = (rng.permutation(m) for _ in range(3))
    factor = rng.uniform(0.4, 0.9, (m, 1))
    best = population[np.argmin(merits)]
    towards = population + factor * (best - population) + factor * (population[a] - population[b])
    away = population[c] + factor * (population[a] - population[b])
    mutant = np.where(rng.random((m, 1)) < 0.5, towards, away)
    mutant = np.where((mutant < 0) | (mutant > 1), rng.random((m, n)) * 0.5 + 0.5 * population, mutant)
    kept = rng.random((m, n)) < 0.1
    kept[np.arange(m), rng.integers(n, size=m)] = False
    trial = np.where(kept, population, mutant)
    found = judge.race(trial, merits)
    better = found <= merits
    return np.where(better[:, None], trial, population), np.where(better, found, merits)


def _refine(best: Array, judge: _Judge, most: int) -> None:
    """Nelder-Mead from a small simplex; the judge keeps the best."""
    steps = np.where(best < 0.5, 0.03, -0.03) * np.eye(len(best))
    options = {"maxfev": most, "initial_simplex": np.vstack([best, best + steps]), "xatol": 1e-5, "fatol": 1e-7}
    settings: Any = {"method": "Nelder-Mead", "bounds": [(0.0, 1.0)] * len(best), "options": options}

    def cost(unit: Array) -> float:
        return float(judge(unit[None])[0])

    minimize(cost, best, **settings)


def merit(values: Mapping[str, Array], spec: Specification, scale: float) -> Array:
    """The objective and a penalty on what the limits forbid; graded where nothing settles, so that a search can start.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (m,)
        As `Responses` has them.
    scale : float
        The horizon, which stands for the settling time of what never settles [s].
    """
    filled = {n: np.where(np.isfinite(value), value, LOST) for n, value in values.items()}
    unsettled = scale * (2 + np.minimum(filled["Excess"], LOST))
    filled["SettlingTime"] = np.where(np.isfinite(values["SettlingTime"]), filled["SettlingTime"], unsettled)
    total = np.zeros_like(unsettled)
    for q, weight in spec.weights.items():
        total += weight * filled[name(q)]
    for q in spec.limits:
        total += PENALTY * scale * np.maximum(0.0, filled[name(q)] / (q.max or 1.0) - 1)
    return np.minimum(total, LOST)


def _first_population(members: int, start: Array, rng: np.random.Generator) -> Array:
    """A Latin hypercube with the start in it."""
    cells = np.array([rng.permutation(members) for _ in start]).T
    found: Array = (cells + rng.random(cells.shape)) / members
    found[0] = np.clip(start, 0.0, 1.0)
    return found
