"""`SuccessHistory`: differential evolution that learns its step lengths and crossover rates from what succeeded.

R. Tanabe, A. Fukunaga, Success-history based parameter adaptation for differential evolution (SHADE), IEEE Congress on
Evolutionary Computation 2013, 71-78. It knows no merit function: `propose` gives trial points of the unit cube and
`select` takes their merits, so that a race may answer with a bound where a trial has lost.
"""

import numpy as np

from pneuopt.quantities.arrays import Array, Indices, Mask

# Entries of the memory of successful step lengths and crossover rates. Fewer follow chance; more forget too slowly.
MEMORY_SIZE = 6
# Share of the population that counts as its best, towards which every trial moves: a smaller one draws the population
# into the first basin, a larger one slows it down.
BEST_SHARE = 0.15
# Spread of the step lengths (Cauchy) and the crossover rates (normal) about their memory, as published.
LENGTH_SPREAD, RATE_SPREAD = 0.1, 0.1


class SuccessHistory:
    """A population of points of the unit cube with their merits, and what its trials have taught it.

    Parameters
    ----------
    population : ndarray, shape (m, n)
    merits : ndarray, shape (m,)
        Small is good.
    rng : numpy.random.Generator

    Attributes
    ----------
    population, merits
    """

    def __init__(self, population: Array, merits: Array, rng: np.random.Generator) -> None:
        self.population, self.merits, self._rng = population.copy(), merits.copy(), rng
        self._archive = np.empty((0, population.shape[1]))
        self._lengths, self._rates, self._entry = np.full(MEMORY_SIZE, 0.5), np.full(MEMORY_SIZE, 0.5), 0
        self._drawn = (np.empty(0), np.empty(0))

    def propose(self) -> Array:
        """Draw a trial point for each member, shape (m, n), towards one of the best."""
        rng, x = self._rng, self.population
        m, n = x.shape
        entry: Indices = rng.integers(0, MEMORY_SIZE, len(x))
        F, rates = self._draw_lengths(entry), np.clip(rng.normal(self._rates[entry], RATE_SPREAD), 0.0, 1.0)
        best = np.argsort(self.merits, kind="stable")[: max(2, round(BEST_SHARE * m))]
        towards = x[rng.choice(best, m)]
        one, other = _others(m, m + len(self._archive), rng)
        pool = np.vstack([x, self._archive])
        mutant = x + F[:, None] * (towards - x) + F[:, None] * (x[one] - pool[other])
        mutant = np.where(mutant < 0, x / 2, np.where(mutant > 1, (1 + x) / 2, mutant))
        taken = rng.random((m, n)) < rates[:, None]
        taken[np.arange(m), rng.integers(n, size=m)] = True
        self._drawn = F, rates
        return np.where(taken, mutant, x)

    def select(self, trials: Array, merits: Array) -> Mask:
        """Put trials that are no worse in the place of their parents, and learn from those that are better.

        Parameters
        ----------
        trials : ndarray, shape (m, n)
            Of `propose`.
        merits : ndarray, shape (m,)
            A bound above the parent's merit is enough for a trial that has lost.

        Returns
        -------
        ndarray of bool, shape (m,)
            Which members were replaced.
        """
        replaced, better = merits <= self.merits, merits < self.merits
        if better.any():
            self._learn(better, merits)
            archive = np.vstack([self._archive, self.population[better]])
            kept = self._rng.permutation(len(archive))[: len(trials)]
            self._archive = archive[np.sort(kept)]
        self.population[replaced], self.merits[replaced] = trials[replaced], merits[replaced]
        return np.asarray(replaced)

    def _draw_lengths(self, entry: Indices) -> Array:
        """Step lengths from a Cauchy distribution about the memory, drawn again where not positive, at most 1."""
        F = np.zeros(len(entry))
        while (none := F <= 0).any():
            F[none] = self._lengths[entry[none]] + LENGTH_SPREAD * self._rng.standard_cauchy(int(none.sum()))
        return np.minimum(F, 1.0)

    def _learn(self, better: Mask, merits: Array) -> None:
        """Put the successful lengths and rates into the memory, weighted by relative improvement, free of its unit."""
        F, rates = (drawn[better] for drawn in self._drawn)
        old, new = self.merits[better], merits[better]
        with np.errstate(invalid="ignore"):
            gain = np.where(np.isfinite(old), (old - new) / (np.abs(old) + np.abs(new)), 1.0)
        weights = gain / gain.sum()
        self._lengths[self._entry] = (weights @ F**2) / (weights @ F)
        self._rates[self._entry] = weights @ rates
        self._entry = (self._entry + 1) % MEMORY_SIZE


def first_population(members: int, start: Array, rng: np.random.Generator) -> Array:
    """Draw a Latin hypercube of the unit cube, with the start as its first point, shape (members, n)."""
    cells = np.array([rng.permutation(members) for _ in start]).T
    found: Array = (cells + rng.random(cells.shape)) / members
    found[0] = np.clip(start, 0.0, 1.0)
    return found


def _others(m: int, size: int, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """For each of m members another one, and a third out of `size`, shapes (m,): neither is the member itself."""
    own = np.arange(m)
    one = (own + rng.integers(1, m, size=m)) % m
    third: Indices = rng.integers(0, size - 2, size=m)
    low, high = np.minimum(own, one), np.maximum(own, one)
    third += third >= low
    return one, third + (third >= high)
