"""The search for gains on P32, the same for every structure: differential evolution on the fast simulation."""

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution

from problems.shared.arrays import Array
from problems.shared.p32 import HARDWARE, MAX_OVERSHOOT, MAX_SENSITIVITY, TOLERANCE, Trip, drive, plants, trips
from problems.shared.p32_margins import Margins
from problems.shared.p32_moves import Outing
from problems.shared.p32_simulator import FastSimulator, Lane, Reading, read
from problems.shared.p32_structures import Structure, gains

# Costs [s] of what breaks a limit: of a tenfold error or overshoot, and of Ms. Smaller ones trade a limit for time.
DECADE, SENSITIVITY = 3.0, 5.0
RESERVE = 0.6  # of the overshoot's limit: a search sees some of the moves, on some of the plants
MEAN = 0.3  # weight of the mean over all moves beside the worst: without it a search sees one move at a time
HOPELESS, UNSTABLE = 3.0, 50.0  # Ms from which on nothing is simulated, and what that costs at least [s]
DWELL = 0.8  # [s] after each move, in a search
COARSE = 32  # frequencies of Ms in a search
BATCH = 24  # candidates that are simulated together: more take memory, fewer time
MEMBERS = 24
SPREAD = 0.08  # standard deviation of the members about the start, in the unit cube
AXES = ("load.mass", "friction.coulomb", "supply.pressure")
NEVER, WORST = 1.5, 1e4  # [s] for a move that does not end, and the largest share of a limit that is told from others
SEARCHED = (0, 1, 2, 4, 8)  # the trips of a search: 10 mm everywhere, 50 mm in the middle, 200 mm
# The plants with the largest Ms where the loop is quick, and where it is slow.
EXTREME = (
    {"load.mass": 3.5, "friction.viscous": 56.0, "supply.pressure": 7.7e5},
    {"load.mass": 3.5, "friction.viscous": 104.0, "supply.pressure": 6.3e5},
)


class OutOfTimeError(Exception):
    """The CPU time of a search is over."""


@dataclass
class Task:
    """A structure on some plants, as a cost of the unit cube.

    Parameters
    ----------
    structure : Structure
    plants : mapping of str to mapping
    seeds : sequence of int
        Of the pressures' noise; the worst counts.
    """

    structure: Structure
    plants: Mapping[str, Mapping[str, float]]
    seeds: Sequence[int] = (0,)
    limit: float = inf
    begun: float = field(default_factory=time.process_time)
    best: float = inf
    point: Array | None = None
    count: int = 0

    def __post_init__(self) -> None:
        loop, parameters = self.structure.loop(), self.structure.parameters()
        self.simulator = FastSimulator(loop, parameters)
        self.coarse = FastSimulator(loop, parameters, substeps=2)
        self.margins = Margins(loop, parameters, EXTREME, points=COARSE)

    def costs(self, points: Array) -> Array:
        """Costs of points of shape (m, n) [s], and the best kept."""
        if time.process_time() - self.begun > self.limit:
            raise OutOfTimeError
        values = [self.structure.values(point) for point in np.clip(points, 0.0, 1.0)]
        peaks = np.nan_to_num(self.margins.peaks_of([gains(v) for v in values]).max(axis=1), nan=inf)
        found = UNSTABLE + np.minimum(peaks, 100.0)
        hopeful = np.flatnonzero(peaks < HOPELESS)
        for part in (hopeful[k : k + BATCH] for k in range(0, len(hopeful), BATCH)):
            found[part] = self._simulated([values[k] for k in part]) + SENSITIVITY * np.maximum(
                0.0, peaks[part] - MAX_SENSITIVITY
            )
        self.count += len(points)
        if found.min() < self.best:
            self.best, self.point = float(found.min()), np.clip(points[int(np.argmin(found))], 0.0, 1.0)
        return np.asarray(found)

    def read(self, values: Mapping[str, float], *, seed: int = 0, dwell: float = DWELL) -> Reading:
        """What each trip on each plant gives with some gains, a lane a pair, trips first."""
        return self._read(self.simulator, list(trips()), [values], seed, dwell)

    def _simulated(self, values: Sequence[Mapping[str, float]]) -> Array:
        ways = [trip for k, trip in enumerate(trips()) if k in SEARCHED]
        read_all = [self._read(self.coarse, ways, values, seed, DWELL) for seed in self.seeds]
        worst = [_cost(found).reshape(len(values), -1) for found in read_all]
        cost = np.max(worst, axis=0)
        return np.asarray(cost.max(axis=1) + MEAN * cost.mean(axis=1))

    def _read(
        self,
        simulator: FastSimulator,
        ways: Sequence[Trip],
        values: Sequence[Mapping[str, float]],
        seed: int,
        dwell: float,
    ) -> Reading:
        lanes = [
            Lane(Outing(trip, self.structure.profile(own), dwell), {**gains(own), **plant})
            for own in values
            for plant in self.plants.values()
            for trip in ways
        ]
        return read(simulator.run(lanes, seed)[0], [lane.outing for lane in lanes])


def _cost(found: Reading) -> Array:
    """Cost of each move [s], shape (m, 2)."""
    late = np.where(np.isfinite(found.settling), found.settling, NEVER)
    shares = (found.error / TOLERANCE, found.overshoot / (RESERVE * MAX_OVERSHOOT))
    decades = sum(np.log10(np.clip(np.nan_to_num(share, nan=WORST), 1.0, WORST)) for share in shares)
    return np.asarray(late + DECADE * decades)


def search(task: Task, seconds: float, start: Mapping[str, float], *, seed: int = 0) -> dict[str, float]:
    """The best values that differential evolution finds in a CPU time [s], from values given and from random points."""
    task.begun, task.limit = time.process_time(), seconds
    drawn = np.random.default_rng(seed)
    n, half, at = len(task.structure.ranges), MEMBERS // 2, task.structure.point(start)
    near = np.clip(at + SPREAD * np.vstack([np.zeros(n), drawn.standard_normal((half - 1, n))]), 0.0, 1.0)
    settings: dict[str, Any] = {"vectorized": True, "updating": "deferred", "maxiter": 10**9, "tol": 0, "atol": 0}
    settings |= {"init": np.vstack([near, drawn.random((MEMBERS - half, n))]), "polish": False, "seed": seed}
    settings |= {"mutation": (0.3, 0.9), "recombination": 0.9, "strategy": "randtobest1bin"}
    solve: Any = differential_evolution
    with suppress(OutOfTimeError):
        solve(lambda unit: task.costs(np.atleast_2d(unit.T)), [(0.0, 1.0)] * n, **settings)
    assert task.point is not None
    return task.structure.values(task.point)


def known_plants() -> dict[str, dict[str, float]]:
    """The nominal plant and the corners."""
    return plants(drive()[1])


def searched_plants() -> dict[str, dict[str, float]]:
    """The nominal plant and every other corner, so that each two axes have all four combinations."""
    nominal, found = HARDWARE, known_plants()
    high = {n: sum(v[k] > nominal.get(k, 7e5) for k in AXES) for n, v in found.items() if v}
    return {n: v for n, v in found.items() if not v or high[n] % 2 == 1}
