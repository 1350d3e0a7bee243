"""Numbers in the order of their names, as arrays."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import pneuopt as po

Array = NDArray[np.float64]


def names(quantities: Sequence[po.Quantity]) -> tuple[str, ...]:
    """Of states, inputs or outputs."""
    return tuple(q.name for q in quantities)


def parameter_vector(order: po.ParameterSet, values: po.ParameterSet) -> Array:
    """The numbers of `values` in the order of `order`; a missing one keeps the default of `order`."""
    return np.array([values.value(n) if n in values else order.value(n) for n in order], dtype=float)
