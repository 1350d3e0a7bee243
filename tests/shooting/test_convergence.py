"""What a search calls unidentifiable beside a weak prior."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.equations import ParameterScaling
from pneuopt.shooting.least_squares import _least_certain


@pytest.mark.parametrize(
    ("start", "value", "spread", "is_weak"),
    [(1e-14, 150.0, 5.0, False), (1e-14, 150.0, 900.0, True), (150.0, 0.0, 5.0, False), (150.0, 0.0, 900.0, True)],
)
def test_a_start_near_zero_tells_no_size(start: float, value: float, spread: float, is_weak: bool) -> None:
    """Viscous friction that a start had left at rounding was called unidentifiable, and held, though known to 3 %."""
    parameters = ParameterSet({"viscous": Parameter(start, "N*s/m", lower=0.0, upper=1e5, free=True)})
    transcription: Any = SimpleNamespace(parameters=parameters, free=np.array([0]))
    found = _least_certain(np.array([0]), np.array([spread]), ParameterScaling(transcription), np.array([value]))
    assert found.tolist() == ([0] if is_weak else [])
