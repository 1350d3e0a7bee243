"""The states in which a tuning's cases wait for the step, where they do not depend on the gains."""

from collections.abc import Hashable, Sequence

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.cases import TuningCase
from pneuopt.quantities.arrays import Array
from pneuopt.tuning.space import Space


def starts_before_step(cases: Sequence[TuningCase], loop: ClosedLoop, space: Space) -> list[Array | None]:
    """Of each case the state before the step; references that begin alike share it, as a rest takes milliseconds."""
    found = dict[tuple[Hashable, ...], Array | None]()
    keys = [(case.scenario, case.reference.origin, *sorted(case.reference.start.items())) for case in cases]
    for key, case in zip(keys, cases, strict=True):
        if key not in found:
            found[key] = _gain_independent_rest(case, loop, space)
    return [found[key] for key in keys]


def _gain_independent_rest(case: TuningCase, loop: ClosedLoop, space: Space) -> Array | None:
    """The state before the step, shape (n_states,); None where it depends on the gains."""
    if not space.names:
        return case.initial(loop, space.parameters)
    other = space.from_unit(np.full(len(space.names), 0.7))
    first, second = (case.initial(loop, space.parameters_at(point)) for point in (space.start, other))
    scale = np.array([q.nominal for q in loop.states])
    return first if bool(np.all(np.abs(first - second) <= 1e-9 * scale)) else None
