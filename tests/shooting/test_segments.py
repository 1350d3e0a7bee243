"""Segments of phases, and by which steps they are integrated."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pneuopt.dynamics.system import System, discretise, names
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, FrictionModel, LuGre, Stribeck
from pneuopt.models.load import Load
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.equations import normal_equations
from pneuopt.shooting.segments import (
    IntegrationCorrection,
    Segments,
    choose_integration,
    fine_steps,
    gap_scales,
    segment,
    stable_substeps,
    start_nodes,
)
from pneuopt.shooting.tolerances import MIN_IMPLICIT_SUBSTEPS
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

FREE = ("friction.coulomb", "load.mass")


def phase(name: str, n: int, **fields: object) -> Phase:
    rng = np.random.default_rng(n)
    t: Array = 1e-3 * np.arange(n, dtype=float)
    guess = 0.1 * rng.standard_normal((n, 2))
    made = Phase(name, t, np.full(n, 1e-3), 30 * rng.standard_normal((n, 1)), regular_nodes(n, 4), guess=guess)
    return replace(made, **fields)  # type: ignore[arg-type]


def posed(
    *phases: Phase, system: System | None = None, free: tuple[str, ...] = FREE, outputs: tuple[str, ...] = ("position",)
) -> Transcription:
    system = system or ForceDrive(Coulomb()).system()
    parameters = system.parameters.freed(*free) | ParameterSet({"load.mass[b]": Parameter(2.0, "kg", free=True)})
    residuals = tuple(
        Residuals(i, outputs, np.full((p.n, len(outputs)), float(i)), np.full(len(outputs), 0.1 + i))
        for i, p in enumerate(phases)
    )
    return Transcription(discretise(system, 3), parameters, phases, residuals)


def both() -> Segments:
    return segment(posed(phase("a", 10), phase("b", 7)))


def test_phases_are_cut_padded_and_linked() -> None:
    segments = both()
    assert segments.count == 5
    assert segments.lengths.tolist() == [4, 4, 2, 4, 3]
    assert segments.phase.tolist() == [0, 0, 0, 1, 1]
    assert segments.linked.tolist() == [True, True, False, True, False]
    assert segments.h[2].tolist() == [1e-3, 1e-3, 0, 0]
    assert np.isnan(segments.measured[2, 2:]).all()
    assert segments.measured[4, :3, 0].tolist() == [1, 1, 1]
    assert np.isnan(segments.measured[:, :, 1]).all()  # the speed was not logged
    assert (segments.noise[3:, :, 0] == 1.1).all()
    assert segments.t[4].tolist() == pytest.approx([4e-3, 5e-3, 6e-3, 6e-3])


def test_each_segment_knows_its_parameters() -> None:
    segments = both()
    names = [list(segments.system.parameters)[i] for i in segments.columns]
    assert set(names) == set(FREE)
    free = segments.transcription.parameters.free_names
    found = [[free[i] for i in block.unknowns] for block in segments.blocks]
    assert found[0] == names
    assert [block.rows for block in segments.blocks] == [slice(0, 3), slice(3, 5)]
    assert found[1] == [n if n != "load.mass" else "load.mass[b]" for n in names]


def test_segments_from_one_trajectory_join_to_it() -> None:
    """From the states of one long run, the segments give that run again: gaps of zero, the same outputs."""
    whole = segment(posed(phase("a", 21, nodes=regular_nodes(21, 21))))
    q = np.array([p.value for p in whole.transcription.parameters.values()])
    (run,) = whole.trajectories(whole.run(start_nodes(whole), q, 5, states=True))
    states = run.matrix(["position", "speed"])
    parts = segment(posed(phase("a", 21, guess=states)))
    nodes = start_nodes(parts)
    pieces = parts.run(nodes, q, 5, sensitivities=True)
    assert_allclose(pieces.x_end[:-1], nodes[1:], rtol=1e-12)
    (again,) = parts.trajectories(parts.run(nodes, q, 5, states=True))
    assert_allclose(again["speed"], run["speed"], rtol=1e-12)
    assert_array_equal(again.t, run.t)


def test_a_following_phase_is_linked_and_a_known_start_is_kept() -> None:
    segments = segment(posed(phase("a", 8, start=np.array([0.5, 0.0])), phase("b", 8, follows=True)))
    assert segments.linked.tolist() == [True, True, True, False]
    assert segments.fixed_start[0].tolist() == [0.5, 0.0]
    assert np.isnan(segments.fixed_start[1:]).all()
    assert start_nodes(segments)[0].tolist() == [0.5, 0.0]


@pytest.mark.parametrize(
    ("load", "outputs", "held"),
    [
        (Load(), ("speed",), [True, False]),
        (Load(), ("position",), [False, False]),
        (Load(spring=True), ("speed",), [False, False]),
        (Load(), (), [True, True]),
    ],
)
def test_a_state_that_no_output_feels_is_held(load: Load, outputs: tuple[str, ...], held: list[bool]) -> None:
    run = phase("a", 8)
    segments = segment(posed(run, system=ForceDrive(Coulomb(), load).system(), outputs=outputs))
    assert np.isfinite(segments.fixed_start[0]).tolist() == held
    assert np.isnan(segments.fixed_start[1:]).all()
    assert run.guess is not None
    assert segments.fixed_start[0][held].tolist() == run.guess[0][held].tolist()


def test_a_state_is_felt_through_a_phase_that_follows() -> None:
    problem = posed(phase("a", 8), phase("b", 8, follows=True), outputs=("speed",))
    position = Residuals(1, ("position",), np.zeros((8, 1)), np.ones(1))
    segments = segment(replace(problem, residuals=(problem.residuals[0], position)))
    assert np.isnan(segments.fixed_start).all()


def test_a_free_duration_is_refused() -> None:
    with pytest.raises(ModelError, match=r"a: .*duration"):
        segment(posed(phase("a", 8, duration="load.mass")))


def test_kinematic_states_are_kept_tighter() -> None:
    assert gap_scales(both(), 0.01).tolist() == [0.01, 1.0]
    assert gap_scales(segment(posed(phase("a", 8), free=("load.force",))), 0.1).tolist() == [0.1, 1.0]


@pytest.mark.parametrize("friction", [Coulomb(), LuGre()])
def test_substeps_follow_the_stiffness(friction: FrictionModel) -> None:
    system = ForceDrive(friction).system()
    n = len(system.states)
    guess = np.zeros((8, n))
    guess[:, 1] = 0.4
    problem = posed(phase("a", 8, guess=guess), system=system)
    segments = segment(problem)
    p = {name: q.value for name, q in problem.parameters.items()}
    p |= {"load.mass": 1.0, "friction.coulomb": 50.0, "friction.viscous": 0.0}
    if isinstance(friction, LuGre):
        fastest = p["bristle"] = p["friction.bristle_stiffness"] * 0.4 / 50.0  # sliding: sigma_0 v / F_c
    else:
        fastest = 50.0 / p["friction.smoothing"]  # at rest
    q = np.array([p[name] for name in problem.parameters])
    assert stable_substeps(segments, start_nodes(segments), q) == pytest.approx(1e-3 * fastest / 1.4, abs=1.01)


def test_a_static_map_needs_one_step_and_has_no_states() -> None:
    system = MotionDrive(Coulomb(), chamber=False).system()
    made = Phase("a", np.arange(5.0), np.ones(5), np.ones((5, 1)), regular_nodes(5, 2))
    problem = Transcription(discretise(system), system.parameters.freed("friction.coulomb"), (made,))
    segments = segment(problem)
    assert stable_substeps(segments, start_nodes(segments), np.zeros(len(problem.parameters))) == 1
    assert gap_scales(segments, 0.01).shape == (0,)
    assert segments.nominal.shape == (0,)


def test_a_correction_stands_for_finer_steps() -> None:
    """What finer steps add, added to coarse ones: the same residuals and gaps."""
    segments = both()
    q = np.array([p.value for p in segments.transcription.parameters.values()])
    nodes, free = start_nodes(segments), len(segments.transcription.free)
    coarse, fine = (segments.run(nodes, q, k) for k in (2, 20))
    correction = IntegrationCorrection(fine.y - coarse.y, fine.x_end - coarse.x_end, fine)
    given = (segments, nodes, q, np.ones(free), np.full(2, 1e-3))
    corrected, exact = normal_equations(*given, 2, correction), normal_equations(*given, 20)
    assert corrected.cost == pytest.approx(exact.cost, rel=1e-9)
    assert_allclose(corrected.gaps, exact.gaps, atol=1e-12)


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
