"""Slopes of compensators in margins, and what does not fit a loop."""

import numpy as np
import pytest

from pneuopt.control.compensators import COMPENSATORS, Direction, FrictionFeedforward
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.system import System
from pneuopt.evaluation.margins import batch_margin_function, margins, sensitivity_terms
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.two_phase import is_linear


def closed_poles(loop: ClosedLoop, p: ParameterSet, reference: float) -> np.ndarray:
    """Of the whole loop's own Jacobian at its equilibrium, by AD through the compensators."""
    system, x = loop.system(), loop.initial(p, reference=reference)
    linear = system.linearise(x, {"reference": reference}, p)
    return np.sort_complex(np.linalg.eigvals(linear.A))


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("reference", [0.0, 0.02])
def test_margins_count_slopes_at_the_operating_point(
    second_order: System, direction: Direction, reference: float
) -> None:
    """The loop's poles by `open_loop` are those of the whole system's Jacobian."""
    parts = (FrictionFeedforward(direction), COMPENSATORS["dead_zone_inverse"]())
    loop = ClosedLoop(second_order, PID(), compensators=parts)
    values = {"pid.Kp": 0.2, "pid.Ki": 1.2, "pid.Kd": 0.01}
    values |= {"friction_feedforward.level": 2e-3, "friction_feedforward.smoothing": 0.03}
    values |= {"dead_zone_inverse.width": 2e-3, "dead_zone_inverse.smoothing": 4e-3}
    p = loop.parameters.with_values(values)
    command = reference * 86.34 / 1270.12
    opened = open_loop(loop, p, np.array([reference, 0.0]), {"valve_voltage": command})
    closed = np.sort_complex(np.linalg.eigvals(opened.A - opened.B @ opened.C / (1 + opened.D[0, 0])))
    np.testing.assert_allclose(closed, closed_poles(loop, p, reference), rtol=1e-6)
    at = loop.parameter_vector(p)[None], np.array([[[reference, 0.0]]]), np.array([[[command]]])
    found, batch = margins(opened), batch_margin_function(loop, np.geomspace(0.01, 1e5, 400))
    in_search = batch(*at, ["MaxSensitivity", "PhaseMargin"])
    assert in_search["MaxSensitivity"][0] == pytest.approx(found.max_sensitivity, rel=1e-3)
    assert in_search["PhaseMargin"][0] == pytest.approx(found.phase_margin, abs=0.1)
    bare = closed_poles(ClosedLoop(second_order, PID()), p, reference)
    assert np.abs(closed - bare).max() > 0.1
    assert not is_linear(loop)
    with pytest.raises(ModelError, match="FrictionFeedforward, DeadZoneInverse: its slope"):
        sensitivity_terms(loop, [1.0], p)
