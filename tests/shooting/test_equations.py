"""The parameters as they are searched."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.arrow import ArrowEquations
from pneuopt.shooting.equations import NormalEquations, ParameterScaling


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


def test_a_prior_draws_log_parameters_to_their_start() -> None:
    """Its cost is half of a squared e-fold, with the gradient and the curvature of that; others are left alone."""
    parameters = ParameterSet(
        {
            "stiffness": Parameter(2.0, "N/m", lower=0.1, upper=90.0, free=True, log=True),
            "force": Parameter(2.0, "N", lower=0.0, upper=9.0, free=True),
            "held": Parameter(2.0, "N", lower=2.0, upper=2.0, free=True, log=True),
        }
    )
    transcription: Any = SimpleNamespace(parameters=parameters, free=np.arange(3))
    scaling = ParameterScaling(transcription)
    none = np.zeros((0, 1, 1))
    arrow = ArrowEquations(none, none, np.zeros((0, 1, 3)), np.eye(3), np.zeros((0, 1)), np.ones(3))
    equations = NormalEquations(cast(Any, None), cast(Any, None), arrow, 4.0, 2.0)
    drawn = scaling.add_start_prior(equations, scaling.start + 0.5)
    assert drawn.cost == pytest.approx(2.0 + 0.125)
    assert drawn.chi_square == 4.0
    assert drawn.arrow.gradient.tolist() == [1.5, 1.0, 1.0]
    assert drawn.arrow.corner.tolist() == np.diag([2.0, 1.0, 1.0]).tolist()
