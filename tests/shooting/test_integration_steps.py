from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.system import discretise, names
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.arrays import Array
from pneuopt.shooting.segments import Segments, choose_integration, fine_steps, segment, stable_substeps, start_nodes
from pneuopt.shooting.tolerances import MIN_IMPLICIT_SUBSTEPS
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes


def sliding(mass: float, stribeck_velocity: float = 0.02) -> tuple[Segments, Array, Array]:
    """Segments of a mass at .2 m/s on 50 N of friction, smooth over 1 mm/s; their nodes, and the parameters' values."""
    system, n = ForceDrive(Stribeck()).system(), 40
    guess = np.tile([0.1, 0.2], (n, 1))
    t: Array = 1e-3 * np.arange(n, dtype=float)
    phase = Phase("a", t, np.full(n, 1e-3), np.zeros((n, 1)), regular_nodes(n, 10), guess=guess)
    values = {"load.mass": mass, "friction.coulomb": 50.0, "friction.static": 70.0}
    values |= {"friction.stribeck_velocity": stribeck_velocity, "friction.smoothing": 1e-3}
    parameters = system.parameters.freed("friction.coulomb").with_values(values)
    residuals = Residuals(0, ("position",), np.full((n, 1), 0.1), np.array([1e-5]))
    segments = segment(Transcription(discretise(system), parameters, (phase,), (residuals,)))
    q = np.array([p.value for p in segments.transcription.parameters.values()])
    return segments, start_nodes(segments), q


def test_a_light_load_is_integrated_implicitly_in_its_speed_by_few_steps() -> None:
    segments, nodes, q = sliding(0.3)
    chosen, steps = choose_integration(segments, nodes, q)
    assert names(segments.system.states)[chosen.implicit_state or 0] == "speed"
    assert MIN_IMPLICIT_SUBSTEPS <= steps < stable_substeps(segments, nodes, q, RK4_MAX_H_LAMBDA) / 4
    assert fine_steps(chosen, steps, 2) > fine_steps(segments, steps, 2) == 2 * steps
    run, exact = (s.run(nodes, q, k, states=True) for s, k in ((chosen, 8 * steps), (segments, 800)))
    np.testing.assert_allclose(run.y[..., 0], exact.y[..., 0], rtol=0, atol=1e-7)


def test_a_steep_fall_of_friction_takes_more_steps() -> None:
    assert choose_integration(*sliding(0.3, 0.005))[1] > choose_integration(*sliding(0.3, 0.02))[1]


def test_a_heavy_load_stays_with_runge_kutta() -> None:
    segments, nodes, q = sliding(10.0)
    chosen, steps = choose_integration(segments, nodes, q)
    assert chosen is segments
    assert steps == stable_substeps(segments, nodes, q, RK4_MAX_H_LAMBDA)


@pytest.mark.parametrize(("given", "is_implicit"), [(8, True), (300, False)])
def test_steps_that_are_given_stay_and_choose_what_is_stable(given: int, is_implicit: bool) -> None:
    segments, nodes, q = sliding(0.3)
    chosen, steps = choose_integration(segments, nodes, q, given)
    assert steps == given
    assert (chosen.implicit_state is not None) == is_implicit


def test_a_sampled_step_without_a_right_hand_side_stays_as_it_is() -> None:
    segments, nodes, q = sliding(0.3)
    system = replace(segments.system, ode=None)
    bare = replace(segments, transcription=replace(segments.transcription, system=system))
    assert choose_integration(bare, nodes, q)[0].implicit_state is None
