"""A fast simulation of loops on a plant that sticks, for searches: many plants and gains at once, in machine code.

The steps are of fixed length, so a standstill is met within a step, not at its instant; searches bear that, and what
they find is certified on the event-accurate model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

import pneuopt as po
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.integrators import rk4
from problems.shared.arrays import Array
from problems.shared.p32 import PRESSURE_NOISE, SAMPLE_TIME, TOLERANCE
from problems.shared.p32_moves import Outing

SUBSTEPS = 4  # steps of a sample: 8 change a settling time by less than a sample in most cases
NOISY = ("pressure_a", "pressure_b")


@dataclass(frozen=True)
class Lane:
    """An outing on a plant, with the values of the parameters that differ from the loop's own."""

    outing: Outing
    values: Mapping[str, float]


@dataclass(frozen=True)
class Reading:
    """Of each lane and each of its two moves, shape (m, 2): the time to the tolerance [s], inf where it is not kept.

    And how far it passes the end [m], and how far off it is at last [m].
    """

    settling: Array
    overshoot: Array
    error: Array


class FastSimulator:
    """A sampled loop whose plant has Karnopp's friction, in steps of RK4 that stop where the speed changes its sign.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
        Of the loop; what a lane does not say.
    noise : float
        Standard deviation of both pressures as the controller sees them [Pa].
    substeps : int
    """

    def __init__(
        self, loop: po.ClosedLoop, parameters: po.ParameterSet, noise: float = PRESSURE_NOISE, substeps: int = SUBSTEPS
    ) -> None:
        self.loop, self.parameters = loop, loop.complete(parameters)
        self.noise, self.substeps = noise, substeps
        self._names = list(loop.parameters)
        self._base = loop.parameter_vector(self.parameters)
        self._starts: dict[tuple[object, ...], Array] = {}

    @cached_property
    def rollout(self) -> Rollout:
        """The loop in machine code: its inputs are those of the loop, then the noise of both pressures."""
        hold, update = self.loop.hold_system().ode, self.loop.update
        known = [q.name for q in self.loop.states]
        v, own = known.index("speed"), [known.index(n) for n in NOISY]
        direction = self._names.index("friction.direction")
        t, h, x, p = (ca.SX.sym(n, k) for n, k in (("t", 1), ("h", 1), ("x", len(known)), ("p", len(self._names))))
        u = ca.SX.sym("u", len(self.loop.inputs) + len(NOISY))
        given = u[: len(self.loop.inputs)]

        def rates(at: ca.SX, z: ca.SX, sign: ca.SX | float) -> ca.SX:
            directed = ca.SX(p)
            directed[direction] = sign
            return hold(at, z, given, directed)[0]

        forwards, backwards = (rates(t, x, sign)[v] for sign in (1.0, -1.0))
        away = ca.if_else(forwards > 0, 1, ca.if_else(backwards < 0, -1, 0))
        sign = ca.if_else(x[v] > 0, 1, ca.if_else(x[v] < 0, -1, away))
        slides = sign != 0

        def held(at: ca.SX, z: ca.SX) -> ca.SX:
            found = ca.SX(rates(at, z, sign))
            found[v] = ca.if_else(slides, found[v], 0)
            return found

        after = ca.SX(rk4(held, t, h, x))
        after[v] = ca.if_else(after[v] * sign > 0, after[v], 0)
        step = ca.Function("step", [t, h, x, u, p], [after, ca.vertcat(x[known.index("position")], x[v])])
        seen = ca.SX(x)
        for k, column in enumerate(own):
            seen[column] += u[len(self.loop.inputs) + k]
        updated = ca.SX(update(t, seen, given, p))
        plant = len(self.loop.plant.states)
        updated[:plant] = x[:plant]
        return Rollout(Pieces(step, ca.Function("update", [t, x, u, p], [updated])))

    def start(self, outing: Outing, p: Array) -> Array:
        """The state of the loop before an outing; of a cascade it does not depend on the gains, its errors are zero."""
        supply, begin = p[self._names.index("supply.pressure")], outing.trip.begin
        key = (begin, supply)
        if key not in self._starts:
            at = self.parameters.with_values({"supply.pressure": float(supply)})
            self._starts[key] = self.loop.initial(at, reference=begin, start=outing.start)
        x = self._starts[key].copy()
        if self.loop.outer is None:  # the integral holds what the set-point's weight takes away
            value = dict(zip(self._names, p.tolist(), strict=True))
            own = {n.removeprefix("pid."): v for n, v in value.items() if n.startswith("pid.")}
            first = [q.name for q in self.loop.states].index("pid.integral")
            states = self.loop.pid.start(begin, begin, 0.0, own)
            x[first : first + len(states)] = states
        return x

    def run(self, lanes: Sequence[Lane], seed: int = 0) -> tuple[Array, Array]:
        """Positions [m] and speeds [m/s] of all lanes, shape (m, n), a sample a column; short outings end at rest."""
        columns = [q.name for q in self.loop.inputs]
        known = {outing: outing.trajectory().matrix(columns) for outing in {lane.outing for lane in lanes}}
        n = max(len(rows) for rows in known.values())
        u = np.zeros((len(lanes), n, len(columns) + len(NOISY)))
        p = np.tile(self._base, (len(lanes), 1))
        for k, lane in enumerate(lanes):
            rows = known[lane.outing]
            u[k, : len(rows), : len(columns)] = rows
            u[k, len(rows) :, : len(columns)] = rows[-1]
            for name, value in lane.values.items():
                p[k, self._names.index(name)] = value
        u[:, :, len(columns) :] = self.noise * np.random.default_rng(seed).standard_normal((n, len(NOISY)))
        x0 = np.array([self.start(lane.outing, row) for lane, row in zip(lanes, p, strict=True)])
        t = np.tile(SAMPLE_TIME * np.arange(n), (len(lanes), 1))
        y = self.rollout.run(x0, u, p, t, np.full_like(t, SAMPLE_TIME), substeps=self.substeps).y
        return y[..., 0], y[..., 1]


def read(position: Array, outings: Sequence[Outing]) -> Reading:
    """What counts of the runs, shape (m, n) each a row."""
    found = np.empty((3, len(outings), 2))
    for k, outing in enumerate(outings):
        for j, (begin, end, final, distance) in enumerate(outing.moves):
            own = (position[k, begin : end + 1] - final) * np.sign(distance)
            outside = np.flatnonzero(~(np.abs(own) <= TOLERANCE))
            last = outside[-1] + 1 if len(outside) else 0
            found[:, k, j] = last * SAMPLE_TIME if last < len(own) else np.inf, own.max(), abs(own[-1])
    return Reading(*found)
