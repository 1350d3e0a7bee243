"""`stated_axis`: what a plant and its parameters say of the axis that a log is of, for the log doctor."""

import math
from collections.abc import Mapping

import numpy as np

from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.logs.checks.findings import PISTON, StatedAxis
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet

CHANGE = 1e-3
"""Change of a parameter [of its value, or of its unit] by which forces are seen to depend on it: smaller drowns in
rounding, larger leaves the range in which hardware is possible."""
STOP_DEPTH = 1e-3
"""Depth beyond a limit of the position [m] at which a model's end stop pushes back: less is rounded, more breaks it."""
MIN_FORCE_SHARE = 1e-3
"""Force of a signal over the largest one's [1] from which it counts: lower asks for a position where stops are rounded,
higher forgets soft springs."""
MIN_STOP_FORCE = 10.0
"""Force [N] by which a model's end stop pushes back at that depth at least: lower takes a spring for a stop."""


def stated_axis(plant: System, experiment: Experiment, parameters: ParameterSet) -> StatedAxis:
    """The channels of the plant's axis, and the forces on it; a piston's channels if the plant declares none.

    Parameters
    ----------
    plant : System
    experiment : Experiment
        Its conditions override parameters.
    parameters : ParameterSet
        What is free in it is not stated.

    Returns
    -------
    StatedAxis
    """
    if plant.axis is None:
        return PISTON._replace(forces={})
    known = plant.parameters | parameters.select(n for n in parameters if n in plant.parameters)
    conditions = {n: value for n, value in experiment.conditions.items() if n in known}
    known = known.with_values(conditions).fixed(*conditions)
    body, axis = _Body(plant, plant.axis, known), plant.axis
    pushes = [q.name for q in plant.inputs if q.unit == axis.force]
    weights, constant = body.forces(body.vector)
    for name in known.free_names:
        others, moved = body.forces(body.with_change(name))
        weights = weights if _agree(others, weights) else {}
        constant = constant if _agree({"": moved}, {"": constant}) else math.nan
    if any(abs(body.asymmetry(p)) > 1e-6 for p in (body.vector, *map(body.with_change, known.free_names))):
        constant = math.nan
    if any(n.startswith("sensor.") and n.endswith(".offset") for n in known):
        constant = math.nan
    return StatedAxis(
        axis.position,
        axis.speed,
        pushes[0] if pushes else PISTON.push,
        forces=weights,
        constant=constant,
        inertia=math.nan if known[axis.inertia].free else known.value(axis.inertia),
        inertia_name=axis.inertia,
        inertia_unit=known[axis.inertia].unit,
        force_unit=axis.force,
        offset_parameter=body.offset_parameter(),
        stops=body.stops(),
    )


def _agree(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    return a.keys() == b.keys() and all(math.isclose(a[n], b[n], rel_tol=1e-6, abs_tol=1e-9) for n in a)


class _Body:
    """The body of a plant at rest: which signals push it, and how strongly."""

    def __init__(self, plant: System, axis: Axis, known: ParameterSet) -> None:
        self.plant, self.axis, self.known = plant, axis, known
        self.vector = parameter_vector(plant.parameters, known)
        ends = [limit.limit(known) for limit in plant.validity_limits if limit.state == axis.position]
        self.ends = tuple(ends) if len(ends) == 2 else ()
        middle = {axis.position: sum(self.ends) / 2, axis.speed: 0.0}
        self.x = np.array([middle.get(s.name, s.nominal if s.unit.startswith("Pa") else 0.0) for s in plant.states])

    def force(self, vector: Array, signals: Mapping[str, float]) -> float:
        """The force on the body without friction at values of signals [SI], others at their base."""
        x = [signals.get(n, base) for n, base in zip(names(self.plant.states), self.x, strict=True)]
        u = [signals.get(n, 0.0) for n in names(self.plant.inputs)]
        rate = np.array(self.plant.ode(0, x, u, vector)[0]).ravel()[names(self.plant.states).index(self.axis.speed)]
        return float(rate * vector[list(self.plant.parameters).index(self.axis.inertia)])

    def forces(self, vector: Array) -> tuple[dict[str, float], float]:
        """The force on the body per unit of each signal that pushes it, and what is left without them."""
        states = dict(zip(names(self.plant.states), self.x, strict=True))
        base = {**states, **dict.fromkeys(names(self.plant.inputs), 0.0)}
        at_base, weights = self.force(vector, {}), dict[str, float]()
        for q in (*self.plant.states, *self.plant.inputs):
            if q.name == self.axis.speed or q.name.startswith("friction."):
                continue
            weight = (self.force(vector, {q.name: base[q.name] + CHANGE * q.nominal}) - at_base) / (CHANGE * q.nominal)
            weights[q.name] = weight
        sizes = {q.name: abs(weights.get(q.name, 0.0)) * q.nominal for q in (*self.plant.states, *self.plant.inputs)}
        pushes = {n: weight for n, weight in weights.items() if sizes[n] > MIN_FORCE_SHARE * max(sizes.values())}
        return pushes, float(at_base - sum(weight * base[n] for n, weight in pushes.items()))

    def asymmetry(self, vector: Array) -> float:
        """What friction takes more at the nominal speed one way than the other."""
        fast = next(s.nominal for s in self.plant.states if s.name == self.axis.speed)
        ways = [self.force(vector, {self.axis.speed: speed}) for speed in (fast, -fast)]
        return sum(ways) - 2 * self.force(vector, {})

    def with_change(self, name: str) -> Array:
        """The vector with one parameter changed a little."""
        vector, k = self.vector.copy(), list(self.plant.parameters).index(name)
        vector[k] += CHANGE * (abs(vector[k]) or 1.0)
        return vector

    def offset_parameter(self) -> str:
        """The first parameter that is a constant force on the body."""
        weights, constant = self.forces(self.vector)
        for name in (n for n, p in self.known.items() if p.unit == self.axis.force):
            others, moved = self.forces(self.with_change(name))
            if _agree(others, weights) and not _agree({"": moved}, {"": constant}):
                return name
        return ""

    def stops(self) -> tuple[float, ...]:
        """Both ends of the position at which the model's stops push back; none where it has none."""
        free = self.force(self.vector, {})
        found = []
        for end, other in zip(self.ends, self.ends[::-1], strict=True):
            depth = math.copysign(STOP_DEPTH, end - other)
            found.append(abs(self.force(self.vector, {self.axis.position: end + depth}) - free) > MIN_STOP_FORCE)
        return self.ends if found and all(found) else ()
