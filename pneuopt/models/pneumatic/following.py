"""`AirSimulator`: states of a drive that a log lacks, integrated along the logged ones.

With position, speed and command known, the chambers' pressures follow an ODE of their own. It is stable, because a
chamber forgets its initial pressure through the open edges, and it does not depend on friction.
"""

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.system import Symbols, System, define, discretise, names, parameter_vector, stack
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

PRESSURE_NAMES = ("pressure_a", "pressure_b")
# Largest step [s]: a chamber of a few cm^3 at the end of its stroke has a time constant of 1e-4 s, which a larger step
# makes unstable; smaller ones cost time in proportion.
MAX_INTEGRATION_STEP = 5e-5
# Usual steps [1] of a log that the air is followed over from sample to sample: more cost a hole of seconds thousands of
# integration steps at every sample, fewer cut short a log that lost some samples.
MAX_USUAL_STEPS = 20


class AirSimulator:
    """Compiled integration of a pneumatic drive along given states.

    Friction's states stay at zero, since the air does not depend on them.

    Parameters
    ----------
    system : System
        A pneumatic drive's system.
    given_states : sequence of str
        Names of the states that are given; position and speed at least.
    """

    def __init__(self, system: System, given_states: Sequence[str]) -> None:
        self.given_states = tuple(given_states)
        self.states = tuple(
            q for q in system.states if q.name not in given_states and not q.name.startswith("friction.")
        )
        inputs = (*system.inputs, *(q for q in system.states if q.name in given_states))
        rates = tuple(Quantity(f"rate_of_{n}", "Pa/s", 1e6) for n in PRESSURE_NAMES)

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
            every = ca.vertcat(*({**x, **u}.get(n, ca.SX(0)) for n in names(system.states)))
            given = ca.vertcat(*(u[n] for n in names(system.inputs)))
            rate = dict(zip(names(system.states), ca.vertsplit(system.ode(t, every, given, stack(p))[0]), strict=True))
            return {q.name: rate[q.name] for q in self.states}, {f"rate_of_{n}": rate[n] for n in PRESSURE_NAMES}

        self._inputs, self._parameters = names(inputs), system.parameters
        inner = define(self.states, inputs, rates, system.parameters, rhs)
        self._rollout = Rollout(Pieces(discretise(inner).step))

    def simulate_states(self, given: Trajectory, sets: Sequence[ParameterSet]) -> list[dict[str, Array]]:
        """States that are not given, for each of several parameter sets; pressures start between ambient and supply.

        Parameters
        ----------
        given : Trajectory
            The drive's inputs, held over each sample, and the given states, linear in between.

        Returns
        -------
        list of dict
            Arrays of shape (n,) by state, for each parameter set.
        """
        u = given.matrix(self._inputs)
        inner = [i for i, n in enumerate(self._inputs) if n in self.given_states]
        u[:-1, inner] = (u[:-1, inner] + u[1:, inner]) / 2
        h = np.append(np.diff(given.t), 0.0)
        h = np.minimum(h, MAX_USUAL_STEPS * np.median(h))  # behind a hole of the log the air soon forgets its start
        x0 = np.array([[self._initial_value(q.name, p) for q in self.states] for p in sets]).reshape(len(sets), -1)
        substeps = max(1, math.ceil(float(h.max()) / MAX_INTEGRATION_STEP))
        x = self._roll_out(x0, u, sets, (given.t, h), substeps, states=True)
        return [dict(zip(names(self.states), columns.T, strict=True)) for columns in x]

    def pressure_rates(self, given: Trajectory, sets: Sequence[ParameterSet]) -> Array:
        """Rates of both pressures at every sample [Pa/s], for each of several parameter sets; every state is given.

        Returns
        -------
        ndarray, shape (len(sets), n, 2)
        """
        still = (given.t, np.zeros_like(given.t))
        return self._roll_out(np.empty((len(sets), 0)), given.matrix(self._inputs), sets, still, 1, states=False)

    def _roll_out(
        self,
        x0: Array,
        u: Array,
        sets: Sequence[ParameterSet],
        grid: tuple[Array, Array],
        substeps: int,
        *,
        states: bool,
    ) -> Array:
        m = len(sets)
        p = np.array([parameter_vector(self._parameters, one) for one in sets])
        inputs, (t, h) = np.tile(u, (m, 1, 1)), (np.tile(a, (m, 1)) for a in grid)
        with np.errstate(all="ignore"):  # absurd parameters may overflow; the caller then gets no finite number
            run = self._rollout.run(x0, inputs, p, t, h, substeps=substeps, states=states)
        return run.y if run.x is None else run.x

    def _initial_value(self, name: str, p: ParameterSet) -> float:
        if name in PRESSURE_NAMES:
            return (p.value("supply.pressure") + p.value("ambient.pressure")) / 2
        return p.value("ambient.temperature") if name.startswith("temperature") else 0.0
