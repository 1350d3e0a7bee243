from types import SimpleNamespace
from typing import Any

import numpy as np

from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.scaling import ParameterScaling


def test_a_held_parameter_is_never_movable() -> None:
    """Its bounds are equal, so no gradient presses it against one where that is zero."""
    parameters = ParameterSet(
        {
            "held": Parameter(2.0, "N", lower=2.0, upper=2.0, free=True),
            "open": Parameter(2.0, "N", lower=0.0, upper=9.0, free=True),
        }
    )
    transcription: Any = SimpleNamespace(parameters=parameters, free=np.array([0, 1]))
    equations: Any = SimpleNamespace(arrow=SimpleNamespace(corner=np.eye(2)))
    scaling = ParameterScaling(transcription)
    for slope in (-1.0, 0.0, 1.0):
        reduced: Any = SimpleNamespace(gradient=np.full(2, slope))
        assert scaling.movable(scaling.start, equations, reduced).tolist() == [False, True]
