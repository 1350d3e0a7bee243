"""What is left where no design found keeps all limits: how close one comes, and by how much limits have to give way.

`LimitSearch` is one search, success-history differential evolution on the largest relative excess over a limit, that
keeps every point it simulates. It shares its merit with no other search: a sum of excesses can have a local minimum
where a design far away keeps every limit. From its record come the closest point, the least common share by which
limits widen, for each limit alone the least value among points that keep the others, and designs that keep all limits
and lie apart.
"""

from collections.abc import Callable, Mapping, Sequence
from math import ceil, floor, inf, isfinite, log10, nan

import numpy as np

from pneuopt.control.reference import Reference
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import SettlingTime, user_limit
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import TAIL_SHARE
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.racing import (
    SuccessHistory,
    add_structure,
    distinct_points,
    first_population,
    is_stalled,
)
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.tolerances import (
    LEAST_LIMIT_MEMBERS,
    LOCAL_TRIALS_A_GAIN,
    MAX_CANDIDATES,
    MEMBERS_A_GAIN,
    NEARBY,
    SAME_OBJECTIVE,
    TRIALS_A_GAIN,
    UNSETTLED_EXCESS,
    WORST_MERIT,
)


class LimitSearch:
    """The minimax search over a simulator's space, and its record of points in the unit cube with their excesses.

    `read` gives the shares (m, k) by which points (m, n) exceed k limits, `report` gets the least largest one.
    """

    def __init__(
        self,
        simulator: Simulator,
        read: Callable[[Array], Array],
        starts: Sequence[Array],
        report: Callable[[float], None],
    ) -> None:
        self._simulator, self._space, self._read, self._report = simulator, simulator.space, read, report
        self._starts, self._rng = [self._space.to_unit(point) for point in starts], np.random.default_rng(0)
        n = len(self._space.names)
        self._members, self._trials = max(LEAST_LIMIT_MEMBERS, MEMBERS_A_GAIN * n), TRIALS_A_GAIN * n
        self.unit, self.excess = np.empty((0, n)), np.empty((0, 0))

    @property
    def count(self) -> int:
        """How many points were simulated."""
        return len(self.unit)

    def minimise(self, room: float = inf) -> float:
        """Minimise the largest excess until a point has so much room to all limits; the least excess that was found.

        Populations follow each other until two end alike, or the trials are used up.
        """
        ends = list[float]()
        while self.count < self._trials and not (ends and ends[0] <= -room):
            given = self._rng.random(self.unit.shape[1]) if ends else self._starts[0]
            drawn = add_structure(first_population(self._members, given, self._rng), self._simulator)
            if not ends:
                drawn[-len(self._starts) :] = np.clip(self._starts, 0.0, 1.0)
            ends = sorted([*ends, self._evolve(drawn, self._trials - self.count, None, 0.0, room)])
            if len(ends) > 1 and ends[1] - ends[0] <= SAME_OBJECTIVE * max(1.0, abs(ends[0])):
                break
        return ends[0]

    def relax(self, limit: int, margin: float) -> None:
        """Minimise one limit's excess among points that keep the others with a margin, from the best ones recorded."""
        order = np.argsort(self.merits(limit, margin), kind="stable")
        trials = LOCAL_TRIALS_A_GAIN * self.unit.shape[1]
        self._evolve(self.unit[order[: self._members]], trials, limit, margin, inf)

    def merits(self, limit: int | None = None, margin: float = 0.0, rows: slice = slice(None)) -> Array:
        """The largest excess of recorded points; that of one limit alone where the others are kept with a margin."""
        if limit is None:
            return np.asarray(self.excess[rows].max(axis=1))
        others = np.delete(self.excess[rows], limit, axis=1).max(axis=1, initial=-inf) + margin
        return np.where(others <= 0, self.excess[rows, limit], WORST_MERIT * (1 + np.maximum(others, 0.0)))

    def candidates(self, limit: int | None = None, margin: float = 0.0, most: float = 0.0) -> list[Array]:
        """Points (n,) that lie apart, those with the least merit first, of those with a merit of at most `most`."""
        merits = self.merits(limit, margin)
        order = np.argsort(merits, kind="stable")
        good = self.unit[order[merits[order] <= most]]
        return list(self._space.from_unit(good[distinct_points(good, NEARBY, MAX_CANDIDATES)]))

    def _evolve(self, population: Array, trials: int, limit: int | None, margin: float, room: float) -> float:
        """Evolve a population until it stalls, its trials are used up, or it has room; its least merit."""
        history = SuccessHistory(population, self._record(population, limit, margin), self._rng)
        stand = list[tuple[float, float]]()
        for _ in range(max(1, trials // len(population))):
            stand.append((float(history.merits.min()), float(np.median(history.merits))))
            self._report(float(self.merits(limit, margin).min()))
            if stand[-1][0] <= -room or is_stalled(stand, history.merits):
                break
            points = history.propose()
            history.select(points, self._record(points, limit, margin))
        return float(history.merits.min())

    def _record(self, unit: Array, limit: int | None, margin: float) -> Array:
        """Simulate points and keep them; their merits."""
        excess = self._read(self._space.from_unit(unit))
        self.unit = np.vstack([self.unit, unit])
        self.excess = np.vstack([self.excess.reshape(-1, excess.shape[1]), excess])
        return self.merits(limit, margin, slice(len(self.unit) - len(unit), None))


def limits_with_settling(
    spec: Specification, references: Sequence[Reference], *, always: bool = False
) -> tuple[Requirement, ...]:
    """The limits, and one that the response settles at all where a settling time is minimised without a limit.

    With `always` it has to settle whatever is minimised.
    """
    horizon = min(r.horizon - r.at for r in references)
    if not (always or spec.weight(SettlingTime)) or any(isinstance(q, SettlingTime) for q in spec.limits):
        return spec.limits
    return (*spec.limits, spec.settling(spec.band, max=(1 - TAIL_SHARE) * horizon))


def limit_excesses(values: Mapping[str, Array], spec: Specification) -> Array:
    """The share by which each limit has to widen for points to keep it, shape (m, k); graded where none settles."""
    unsettled = UNSETTLED_EXCESS + np.minimum(values["Excess"], UNSETTLED_EXCESS)
    return np.column_stack([np.where(np.isfinite(share), share, unsettled) for share in spec.excess(values).values()])


def relaxation_row(
    requirement: Requirement | None, value: float, point: Array, names: Sequence[str]
) -> dict[str, float]:
    """A row of `TuningResult.relaxations`: a requirement with its least value, or (None) all with their least share.

    The value is on the user's scale, NaN where no design was found.
    """
    gains = dict(zip(names, point.tolist(), strict=True)) if np.isfinite(value) else dict.fromkeys(names, nan)
    if requirement is None:
        return {"asked": nan, "needed": nan, "share": round_outwards(value, upwards=True), **gains}
    asked, least = user_limit(requirement), requirement.metric.sense is Sense.AT_LEAST
    assert asked is not None
    needed = round_outwards(value, upwards=not least)
    return {"asked": asked, "needed": needed, "share": (asked - needed if least else needed - asked) / asked, **gains}


def describe_relaxations(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Say in words which limits would have to be relaxed, and by how much."""
    able = {n: r for n, r in rows.items() if n != "all" and isfinite(r["needed"])}
    each = ", or ".join(f"{n} relaxed to {r['needed']:.6g} ({r['asked']:.6g} asked)" for n, r in able.items())
    share = rows["all"]["share"] if "all" in rows else nan
    alone = "one alone would do" if "all" in rows else "this would do"
    parts = [f"{alone}: {each}" if each else "no limit relaxed alone would do"]
    parts += [f"all limits relaxed by {100 * share:.3g} %"] if isfinite(share) else []
    return "; or ".join(parts)


def round_outwards(value: float, *, upwards: bool, digits: int = 3) -> float:
    """Round a limit so that the design that was found keeps it.

    Examples
    --------
    >>> round_outwards(0.08112, upwards=True), round_outwards(1.8467, upwards=False)
    (0.0812, 1.84)
    """
    if not 0 < abs(value) < inf:
        return value
    place = 10.0 ** (floor(log10(abs(value))) - digits + 1)
    steps = (ceil if upwards else floor)(value / place * (1 - 1e-12 if upwards else 1 + 1e-12))
    return float(f"{steps * place:.{digits}g}")
