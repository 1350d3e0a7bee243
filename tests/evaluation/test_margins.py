"""Margins at the operating points that a step passes; what mutants of them would leave out.

The sensitivity peak from poles is that of python-control's frequency response, resonances included.
"""

from dataclasses import replace

import casadi as ca
import control
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm

from pneuopt.control.averaging import operating_gains
from pneuopt.control.dither import Dither
from pneuopt.control.linear_loop import noise_path, open_loop
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import Linearisation, System, define
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.margins import (
    SensitivityReader,
    _partial_fraction_response,
    are_stable,
    batch_frequency_response,
    batch_margin_function,
    frequency_grid,
    frequency_response,
    margin_rows,
    margins,
    noise_gain,
    operating_points,
    sensitivity_terms,
    worst_margins,
)
from pneuopt.models.catalog import s32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import LuGre, Stribeck
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity


def linearised(numerator: list[float], denominator: list[float]) -> Linearisation:
    s = control.tf2ss(control.tf(numerator, denominator))
    states = tuple(f"x{k}" for k in range(s.nstates))
    return Linearisation(s.A, s.B, s.C, s.D, states, ("u",), ("y",))


def test_the_papers_loop(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    m = margins(open_loop(loop, loop.parameters))
    assert m.phase_margin == pytest.approx(28.54, abs=0.005)
    assert m.gain_crossover == pytest.approx(34.67, abs=0.005)
    assert m.gain_margin == np.inf
    assert np.isnan(m.phase_crossover)
    assert m.stable


@pytest.mark.parametrize(
    ("numerator", "denominator"),
    [
        ([1270.12], [1, 17.5, 86.34]),
        ([2.0], [1, 3, 3, 1]),
        ([9.0], [1, 3, 3, 1]),
        ([5.0, 5.0], [1, 2, 10, 0, 0]),
        ([-1.0, 4.0], [1, 5, 4]),
        ([100.0, 20.0, 1.0], [1, 30, 100, 0, 0, 0]),
        ([0.5], [1, 1]),
        ([40.0, 4.0, 4000.0], [1, 0.02, 100, 0]),
        ([3.0], [1, 0.004, 4, 0.001]),
        ([1e-3, 1e-9], [1, 0.01, 0]),
        ([3.0], [1, -2]),
        ([20.0, 20.0], [1, 3, -4]),
        ([30.0, 90.0, 60.0], [1, -3, 2, 0]),
    ],
)
def test_agreement_with_python_control(numerator: list[float], denominator: list[float]) -> None:
    m = margins(linearised(numerator, denominator))
    gm, pm, sm, wpc, wgc, wms = control.stability_margins(control.tf(numerator, denominator))
    expected = [gm, pm, wpc, wgc]
    ours = [m.gain_margin, m.phase_margin, m.phase_crossover, m.gain_crossover]
    np.testing.assert_allclose(ours, expected, rtol=1e-6)
    if np.isfinite(m.max_sensitivity_frequency) and np.isfinite(sm):  # it has none for a largest value at rest
        assert m.max_sensitivity == pytest.approx(1 / sm, rel=1e-6)
        assert m.max_sensitivity_frequency == pytest.approx(wms, rel=1e-3)
    closed = control.feedback(control.tf(numerator, denominator), 1)
    assert m.stable == bool(np.all(np.real(closed.poles()) < 0))


@settings(max_examples=40, deadline=None)
@given(Kp=st.floats(0.02, 2.0), Ki=st.floats(0.01, 20.0), Kd=st.floats(0.0, 0.05), Tf=st.floats(1e-3, 0.1))
def test_no_frequency_beats_the_maximum_sensitivity(Kp: float, Ki: float, Kd: float, Tf: float) -> None:
    s = control.tf("s")
    L = 1270.12 / (s**2 + 17.5 * s + 86.34) * (Kp + Ki / s + Kd * s / (Tf * s + 1))
    m = margins(linearised(list(L.num[0][0]), list(L.den[0][0])))
    w = np.geomspace(1e-3, 1e5, 5000)
    assert m.max_sensitivity >= np.max(1 / np.abs(1 + L(1j * w))) * (1 - 1e-9)
    assert m.max_sensitivity >= 1 / (2 * np.sin(np.radians(abs(m.phase_margin)) / 2)) * (1 - 1e-9)


@pytest.mark.parametrize("gain", [0.05, 1.0, 40.0])
def test_a_crossing_of_the_positive_real_axis_is_no_gain_margin(gain: float) -> None:
    """``k s/(s^2 + 0.2 s + 1)`` is real and positive at its resonance, and stable with any gain: ``0.2 + k > 0``."""
    for factor in (1e-3, 1.0, 1e3):
        found = margins(linearised([factor * gain, 0.0], [1.0, 0.2, 1.0]))
        assert found.stable
        assert found.gain_margin == np.inf
        assert np.isnan(found.phase_crossover)


def test_a_loop_that_only_approaches_its_maximum() -> None:
    m = margins(linearised([0.5], [1, 1]))
    assert (m.max_sensitivity, m.max_sensitivity_frequency) == (1.0, np.inf)


def test_an_unseen_position_does_not_make_a_speed_loop_unstable(axis: System) -> None:
    loop = ClosedLoop(axis, PID(), actuated="force")
    m = margins(open_loop(loop, loop.parameters.with_values({"pid.Ki": 2.0})))
    assert m.stable
    assert not margins(open_loop(loop, loop.parameters.with_values({"pid.Kp": -20.0, "pid.Ki": 2.0}))).stable


@pytest.mark.parametrize("Tf", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("time_constant", [0.01, 10.0, 1e3])
@pytest.mark.parametrize(("Kp", "Ki"), [(-1.001, 0.0), (-1.5, 0.0), (-0.99, 0.0), (0.5, -0.01), (0.5, 0.01)])
def test_no_fast_pole_excuses_a_slow_unstable_one(Tf: float, time_constant: float, Kp: float, Ki: float) -> None:
    """A lag of gain 1 under P control has its pole at -(1 + Kp)/T; an integral of the wrong sign another beyond 0."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    gains = {"plant.time_constant": time_constant, "pid.Kp": Kp, "pid.Ki": Ki, "pid.Tf": Tf}
    given = loop.parameters.with_values(gains)
    stable = Kp > -1 and Ki >= 0
    assert margins(open_loop(loop, given)).stable == stable
    found = batch_margin_function(loop, np.geomspace(1e-4, 1e4, 200))(
        loop.parameter_vector(given)[None], np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), ("MaxSensitivity",)
    )
    assert np.isfinite(found["MaxSensitivity"][0]) == stable


@pytest.mark.parametrize("fastest", [1.0, 1e4, 1e8])
def test_poles_at_zero_are_stable_and_those_just_beyond_are_not(fastest: float) -> None:
    """A zero that no zeros of the matrix show, and the same with the pole moved by more than rounding can."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        basis = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        at, beyond = (
            basis @ np.diag([-fastest, -0.3 * fastest, -1e-3 * fastest, s]) @ basis.T for s in (0.0, 1e-9 * fastest)
        )
        assert are_stable(np.array([at, beyond])).tolist() == [True, False]


def test_a_gain_margin_at_rest_counts_on_a_grid_as_well() -> None:
    """``3/(s - 2)`` runs away where its gain is cut to two thirds; with an integral it swings there."""
    unstable = define(
        [Quantity("y", "1")],
        [Quantity("u", "1")],
        [Quantity("y", "1")],
        ParameterSet(),
        lambda _t, x, u, _p: ({"y": 2 * x["y"] + u["u"]}, {"y": x["y"]}),
    )
    loop = ClosedLoop(unstable, PID(limits=False))
    for Ki in (0.0, 1.0):
        given = loop.parameters.with_values({"pid.Kp": 3.0, "pid.Ki": Ki})
        assert margins(open_loop(loop, given)).gain_margin == pytest.approx(2 / 3, rel=1e-5)
        found = batch_margin_function(loop, np.geomspace(1e-2, 1e3, 500))(
            loop.parameter_vector(given)[None], np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), ("GainMargin",)
        )
        assert found["GainMargin"] == pytest.approx(2 / 3, rel=1e-3)


def test_a_sampled_loop_has_less_phase(second_order: System) -> None:
    reference = ClosedLoop(second_order, PID())
    sampled = ClosedLoop(second_order, PID(sample_time=4e-3))
    m = [margins(open_loop(loop, loop.parameters)) for loop in (reference, sampled)]
    lost = np.degrees(m[0].gain_crossover * 4e-3 / 2)
    # but for the aliases of what the plant passes beyond half the sampling frequency
    assert m[0].phase_margin - m[1].phase_margin == pytest.approx(lost, rel=5e-3)


EXACT = ("MaxSensitivity", "MaxComplementarySensitivity")


def late_gains(dead_time: float) -> dict[str, float]:
    return {"pid.Kp": 0.35, "pid.Ki": 2.0 if dead_time < 1 else 0.4, "pid.Kd": 0.012, "pid.Tf": 0.02}


def late_loop(dead_time: float, sample_time: float | None, delay: int = 0) -> tuple[ClosedLoop, ParameterSet]:
    """``exp(-s dead_time)/(0.1 s + 1)^2`` under a PID."""
    loop = ClosedLoop(SecondOrder(3 if dead_time else 0).system(), PID(sample_time=sample_time, delay=delay))
    values = late_gains(dead_time) | {"plant.natural_frequency": 10.0, "plant.damping": 1.0}
    return loop, loop.parameters.with_values(values | ({"plant.dead_time": dead_time} if dead_time else {}))


def late_open_loop(w: np.ndarray, dead_time: float, h: float | None, delay: int) -> np.ndarray:
    """Its L by hand: of a sampled one from sample to sample, by the matrix exponential."""
    Kp, Ki, Kd, Tf = late_gains(dead_time).values()
    A, B, C = np.array([[0.0, 1.0], [-100.0, -20.0]]), np.array([[0.0], [100.0]]), np.array([[1.0, 0.0]])
    if h is None:
        s = 1j * w
        return np.asarray((Kp + Ki / s + Kd * s / (Tf * s + 1)) * np.exp(-s * dead_time) / (0.1 * s + 1) ** 2)

    def driven(t: float) -> tuple[np.ndarray, np.ndarray]:
        whole = expm(np.block([[A, B], [np.zeros((1, 3))]]) * t)
        return whole[:2, :2], whole[:2, 2:]

    whole = int(dead_time / h + 1e-9)
    (first, old), (last, new) = driven(dead_time - whole * h), driven(h - (dead_time - whole * h))
    z = np.exp(1j * w * h)
    slope = (1 - 1 / z) / h
    controller = Kp + Ki / slope + Kd * slope / (Tf * slope + 1)
    driving = new + (last @ old) / z[:, None, None]
    plant = C @ np.linalg.solve(z[:, None, None] * np.eye(2) - last @ first, driving)
    return np.asarray(controller * plant[:, 0, 0] / z ** (whole + delay))


@pytest.mark.parametrize(
    ("dead_time", "sample_time", "delay"),
    [
        *[(0.0, h, delay) for h in (0.01, 0.05) for delay in (0, 1)],
        *[(late, None, 0) for late in (0.02, 0.3, 1.5)],
        *[(late, h, 0) for late in (0.004, 0.03, 0.3, 1.5) for h in (0.01, 0.04)],
    ],
)
def test_margins_are_exact_whatever_the_sampling_and_the_dead_time(
    dead_time: float, sample_time: float | None, delay: int
) -> None:
    loop, values = late_loop(dead_time, sample_time, delay)
    w = np.geomspace(1e-3, 0.9999 * np.pi / sample_time if sample_time else 1e3, 40001)
    L = late_open_loop(w, dead_time, sample_time, delay)
    linear = open_loop(loop, values)
    assert_allclose(frequency_response(linear, w[::100]), L[::100], rtol=1e-6)
    exact = [np.abs(1 / (1 + L)).max(), np.abs(L / (1 + L)).max()]
    found = margins(linear)
    assert found.stable
    assert_allclose([found.max_sensitivity, found.max_complementary_sensitivity], exact, rtol=1e-5)
    numbers, n = loop.parameter_vector(values), len(loop.plant.states)
    many = batch_margin_function(loop, np.geomspace(1e-3, 1e4, 210))
    for only in (EXACT, (*EXACT, "PhaseMargin")):
        read = many(numbers[None], np.zeros((1, 1, n)), np.zeros((1, 1, 1)), only)
        assert_allclose([read[metric][0] for metric in EXACT], exact, rtol=1e-5)
    assert read["PhaseMargin"][0] == pytest.approx(found.phase_margin, abs=0.2)


@pytest.mark.parametrize("sample_time", [None, 0.1])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_dead_time_is_stable_up_to_the_gain_of_the_delay_itself(sample_time: float | None, share: float) -> None:
    """Under an integral ``exp(-3 s)`` oscillates at Ki = pi/6 1/s; sampled ten times a second at a little less."""
    loop = ClosedLoop(FirstOrder(pade_order=1).system(), PID(sample_time=sample_time))
    values = loop.parameters.with_values({"plant.time_constant": 1e-4, "plant.dead_time": 3.0, "pid.Kp": 0.0})
    h = sample_time or 0.0  # the integral has acted at once: its phase is that of h/2 less, the hold's of h/2 more
    values = values.with_values({"pid.Ki": share * np.pi / 6 / (1 + h / 3)})
    found = margins(open_loop(loop, values))
    read = batch_margin_function(loop, np.geomspace(1e-3, 1e4, 210))(
        loop.parameter_vector(values)[None], np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), EXACT
    )
    assert found.stable == np.isfinite(read["MaxSensitivity"][0]) == (share < 1)


@pytest.mark.parametrize("order", [0, 2])
def test_sensitivity_terms_are_the_loops_sensitivity(order: int) -> None:
    loop = ClosedLoop(SecondOrder(order).system(), PID())
    w = np.geomspace(0.1, 1e3, 50)
    terms = sensitivity_terms(loop, w, loop.parameters)
    tuned = loop.parameters.with_values({"pid.Kp": 0.2, "pid.Ki": 1.1, "pid.Kd": 0.009, "pid.Tf": 0.02})
    L = frequency_response(open_loop(loop, tuned), w)
    np.testing.assert_allclose(np.array(terms(loop.parameter_vector(tuned))).ravel(), np.abs(1 + L) ** 2, rtol=1e-10)


def test_sensitivity_terms_have_exact_derivatives(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    f = sensitivity_terms(loop, [1.0, 30.0, 300.0], loop.parameters)
    p = loop.parameter_vector(
        loop.parameters.with_values({"pid.Kp": 0.2, "pid.Ki": 1.1, "pid.Kd": 0.009, "pid.Tf": 0.02})
    )
    z = ca.SX.sym("p", len(p))
    jacobian = np.array(ca.Function("J", [z], [ca.jacobian(f(z), z)])(p))
    steps = 1e-5 * np.diag(np.where(np.isinf(p), 0.0, p))
    for k, name in enumerate(loop.parameters):
        if name not in ("pid.Kp", "pid.Ki", "pid.Kd", "pid.Tf"):
            np.testing.assert_array_equal(jacobian[:, k], 0.0)
            continue
        difference = (np.array(f(p + steps[k])) - np.array(f(p - steps[k]))).ravel() / (2 * steps[k, k])
        np.testing.assert_allclose(jacobian[:, k], difference, rtol=1e-6, atol=1e-9)


def test_the_grid_sees_a_sharp_resonance() -> None:
    grid = frequency_grid(linearised([3.0], [1, 1e-5, 4, 0.001]), 20)
    assert np.min(np.abs(grid - 2.0)) < 1e-5


@pytest.mark.parametrize("measured", ["speed", "position"])
@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_many_sensitivities_are_those_of_one_loop_after_another(measured: str, sample_time: float | None) -> None:
    drive, rig = s32()
    loop = ClosedLoop(drive.system(), PID(sample_time=sample_time), measured=measured)
    rng, omega = np.random.default_rng(0), np.geomspace(1, 1e4, 600)
    rest = drive.rest(rig)
    states = np.array([rest.states.get(q.name, 0.0) for q in loop.plant.states])
    points = states * (1 + 0.1 * rng.random((5, len(states))))
    commands = rng.uniform(-0.5, 0.5, 5)
    sets = [
        (loop.parameters | rig.fixed("*")).with_values({"pid.Kp": Kp, "pid.Ki": 40.0, "pid.Kd": 0.1, "pid.Tf": 0.01})
        for Kp in (1.0, 3.0, 10.0, 20.0, 60.0)
    ]
    numbers = np.array([loop.parameter_vector(p) for p in sets])
    found = batch_margin_function(loop, omega)(numbers, points[None], commands[None, :, None], ("MaxSensitivity",))[
        "MaxSensitivity"
    ]
    fine = np.geomspace(1, 1e4 if sample_time is None else 0.9999 * np.pi / sample_time, 20001)
    for p, x, command, Ms in zip(sets, points, commands, found, strict=True):
        L = open_loop(loop, p, x, {loop.command.name: command})
        is_stable = np.linalg.eigvals(L.A - L.B @ L.C / (1 + L.D)).real.max() < 1e-6
        assert_allclose(Ms, 1 / np.abs(1 + frequency_response(L, fine)).min() if is_stable else np.inf, rtol=1e-5)
    assert np.isfinite(found).any()


@pytest.mark.parametrize(("sample_time", "most"), [(None, 1.0), (0.02, 0.1)])
def test_the_margins_of_unstable_loops_are_none(second_order: System, sample_time: float | None, most: float) -> None:
    """Ms on a grid is finite for an unstable loop as well: its curve encircles -1 at a distance."""
    loop = ClosedLoop(second_order, PID(sample_time=sample_time))
    rows = np.random.default_rng(1).uniform((0.0, -60.0, 0.0, 0.005), (8.0, 60.0, 0.3, 0.05), (60, 4))
    rows = (rows * [most, most, most, 1.0]).tolist()
    gains = ("pid.Kp", "pid.Ki", "pid.Kd", "pid.Tf")
    sets = [loop.parameters.with_values(dict(zip(gains, row, strict=True))) for row in rows]
    loops = [open_loop(loop, p) for p in sets]
    stable = np.array([np.all(control.feedback(control.ss(L.A, L.B, L.C, L.D), 1).poles().real < 0) for L in loops])
    p, only = np.array([loop.parameter_vector(s) for s in sets]), ("MaxSensitivity", "PhaseMargin", "NoiseGain")
    found = batch_margin_function(loop, np.geomspace(0.1, 1e4, 500))(
        p, np.zeros((1, 60, 2)), np.zeros((1, 60, 1)), only
    )
    assert 10 < stable.sum() < 50
    assert (np.isfinite(found["MaxSensitivity"]) == stable).all()
    assert (np.isnan(found["PhaseMargin"]) == ~stable).all()
    assert (np.isfinite(found["NoiseGain"]) == stable).all()


def test_systems_without_a_basis_of_modes_are_solved_instead() -> None:
    chain = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    omega = np.array([0.1, 1.0, 10.0])
    found = _partial_fraction_response(
        np.stack([chain, chain - np.eye(3)]), np.eye(3)[[2, 2]], np.eye(3)[[0, 0]], omega
    )(omega)
    assert_allclose(found, [1 / (1j * omega) ** 3, 1 / (1j * omega + 1) ** 3], rtol=1e-9)


@pytest.mark.parametrize("damping", [0.1, 0.3, 0.6, 0.9])
def test_the_resonance_peak_of_a_second_order_lag(damping: float) -> None:
    """L = w0^2/(s^2 + 2 z w0 s) closes to a second-order lag: Mt = 1/(2 z sqrt(1 - z^2)), or 1 without a resonance."""
    m = margins(linearised([25.0], [1.0, 10.0 * damping, 0.0]))
    peak = 1 / (2 * damping * np.sqrt(1 - damping**2)) if damping < np.sqrt(0.5) else 1.0
    assert m.max_complementary_sensitivity == pytest.approx(peak, rel=1e-6)


def test_the_resonance_peak_is_python_controls(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    L = open_loop(loop, loop.parameters)
    T = control.feedback(control.ss(L.A, L.B, L.C, L.D), 1)
    w = np.geomspace(1.0, 1e3, 20001)
    assert margins(L).max_complementary_sensitivity == pytest.approx(np.abs(T(1j * w)).max(), rel=1e-6)


@settings(max_examples=30, deadline=None)
@given(Kp=st.floats(0.02, 2.0), Ki=st.floats(0.01, 20.0), Kd=st.floats(0.0, 0.05), Tf=st.floats(1e-3, 0.1))
def test_no_frequency_beats_the_noise_gain(Kp: float, Ki: float, Kd: float, Tf: float) -> None:
    s = control.tf("s")
    C = Kp + Ki / s + Kd * s / (Tf * s + 1)
    L = 1270.12 / (s**2 + 17.5 * s + 86.34) * C
    open_loop = linearised(list(L.num[0][0]), list(L.den[0][0]))
    w = np.union1d(np.geomspace(1e-6, 1e6, 4000), frequency_grid(open_loop))
    largest = np.abs(C(1j * w) / (1 + L(1j * w))).max()
    found = noise_gain(open_loop, (Kp, Ki, Kd, Tf))
    assert found >= largest * (1 - 1e-6)  # at rest it is approached only
    assert found <= max(largest, Kp + Kd / Tf) * (1 + 1e-2)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_margins_on_a_grid_are_those_of_one_loop_after_another(second_order: System, sample_time: float | None) -> None:
    loop = ClosedLoop(second_order, PID(sample_time=sample_time))
    gains = [(0.05, 0.2, 0.0, 0.02), (0.2, 1.1, 0.009, 0.02), (0.05, 1.0, 0.0, 0.01), (4.0, 1.0, 0.2, 0.05)]
    sets = [
        loop.parameters.with_values(dict(zip(("pid.Kp", "pid.Ki", "pid.Kd", "pid.Tf"), g, strict=True))) for g in gains
    ]
    only = ("MaxSensitivity", "MaxComplementarySensitivity", "GainMargin", "PhaseMargin", "NoiseGain")
    p, x = np.array([loop.parameter_vector(s) for s in sets]), np.zeros((len(sets), 2))
    found = batch_margin_function(loop, np.geomspace(0.1, 1e4, 2000))(p, x[None], np.zeros((1, len(sets), 1)), only)
    exact = [margins(open_loop(loop, s)) for s in sets]
    stable = np.array([m.stable for m in exact])
    assert stable.sum() >= 3
    assert np.isfinite([m.gain_margin for m in exact if m.stable]).any()
    exact, found, p = [m for m in exact if m.stable], {n: v[stable] for n, v in found.items()}, p[stable]
    sets = [s for s, is_stable in zip(sets, stable.tolist(), strict=True) if is_stable]
    assert_allclose(found["GainMargin"], [m.gain_margin for m in exact], rtol=1e-3)
    assert_allclose(found["PhaseMargin"], [m.phase_margin for m in exact], atol=0.02)
    peaks = [[m.max_sensitivity, m.max_complementary_sensitivity] for m in exact]
    on_grid = np.column_stack([found["MaxSensitivity"], found["MaxComplementarySensitivity"]])
    assert_allclose(on_grid, peaks, rtol=5e-3)
    assert np.all(on_grid <= np.array(peaks) * (1 + 1e-9))
    gained = [noise_gain(open_loop(loop, s), own_controller(loop, s)) for s in sets]
    assert_allclose(found["NoiseGain"], gained, rtol=1e-3)


def own_controller(loop: ClosedLoop, values: ParameterSet) -> tuple[float, float, float, float] | Linearisation:
    return operating_gains(loop, values) if loop.pid.sample_time is None else noise_path(loop, values)


def test_a_peak_that_the_grid_shows_second_is_refined_like_the_first() -> None:
    """The noise gain's resonance lies between two frequencies of the grid, lower there than its broad maximum."""
    loop = ClosedLoop(SecondOrder().system(), PID(sample_time=1e-3))
    values = loop.parameters.with_values(
        {
            "plant.gain": 6.574292932,
            "plant.natural_frequency": 0.446343801,
            "plant.damping": 1.812996164,
            "pid.Kp": 3.341621765,
            "pid.Ki": 8.615545149,
            "pid.Kd": 0.738914248,
            "pid.Tf": 5.657951729e-3,
        }
    )
    found = batch_margin_function(loop, np.geomspace(1e-2, 1e5, 300))(
        loop.parameter_vector(values)[None], np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), ("NoiseGain",)
    )
    exact = noise_gain(open_loop(loop, values), noise_path(loop, values))
    assert found["NoiseGain"][0] == pytest.approx(exact, rel=1e-6)


def test_without_gain_there_is_no_crossing(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    p = loop.parameter_vector(loop.parameters.with_values({"pid.Kp": 0.0, "pid.Ki": 0.0, "pid.Kd": 0.0, "pid.Tf": 0.1}))
    found = batch_margin_function(loop, [1.0, 10.0, 100.0])(
        p[None], np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), ("GainMargin", "PhaseMargin", "NoiseGain")
    )
    assert {n: v.tolist() for n, v in found.items()} == {
        "GainMargin": [np.inf],
        "PhaseMargin": [np.inf],
        "NoiseGain": [0.0],
    }


@pytest.mark.parametrize("damping", [0.01, 0.1])
def test_the_grids_peaks_are_refined_where_the_loop_rings(damping: float) -> None:
    """A grid as coarse as a search's and a lightly damped plant: within 0.5 % up to peaks of twenty."""
    loop = ClosedLoop(SecondOrder().system(), PID())
    plant = {"plant.gain": 1.0, "plant.natural_frequency": 20.0, "plant.damping": damping}
    rng, names = np.random.default_rng(0), ("pid.Kp", "pid.Ki", "pid.Kd", "pid.Tf")
    rows = rng.uniform((0.01, 0.01, 0.0, 0.005), (3.0, 20.0, 0.05, 0.05), (40, 4)).tolist()
    sets = [loop.parameters.with_values({**plant, **dict(zip(names, row, strict=True))}) for row in rows]
    p, x = np.array([loop.parameter_vector(s) for s in sets]), np.zeros((len(sets), 2))
    only = ("MaxSensitivity", "MaxComplementarySensitivity")
    found = batch_margin_function(loop, np.geomspace(0.1, 1e3, 150))(p, x[None], np.zeros((1, len(sets), 1)), only)
    exact = [margins(open_loop(loop, s)) for s in sets]
    calm = np.array([m.stable and m.max_sensitivity < 20 for m in exact])
    assert calm.sum() >= 20
    assert_allclose(found[only[0]][calm], [m.max_sensitivity for m in np.array(exact)[calm]], rtol=5e-3)
    assert_allclose(found[only[1]][calm], [m.max_complementary_sensitivity for m in np.array(exact)[calm]], rtol=5e-3)


@pytest.mark.parametrize("only", [("MaxSensitivity",), ("MaxSensitivity", "MaxComplementarySensitivity")])
def test_the_sensitivity_is_1_where_the_loop_rolls_off_beyond_the_grid(only: tuple[str, ...]) -> None:
    """S = (1 + s T)/(1 + K + s T) is below 1 at every frequency."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    p = loop.parameter_vector(loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 0.0}))
    found = batch_margin_function(loop, [0.01, 0.1, 1.0])(p[None], np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), only)
    assert found["MaxSensitivity"].tolist() == [1.0]


def test_a_system_at_its_undamped_pole_takes_no_other_response_with_it() -> None:
    """A search met one among its candidates, and stopped."""
    swings, lags = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.diag([-1.0, -2.0])
    B, C, w = np.ones((2, 2)), np.ones((2, 2)), np.array([0.5, 1.0, 2.0])
    found = batch_frequency_response(np.stack([swings, lags]), B, C, w)
    assert np.isnan(found).tolist() == [[False, True, False], [False] * 3]
    assert_allclose(found[1], 1 / (1j * w + 1) + 1 / (1j * w + 2), rtol=1e-12)
    assert_allclose(found[0, [0, 2]], 2j * w[[0, 2]] / (1 - w[[0, 2]] ** 2), rtol=1e-12)


MARGINS = ["MaxSensitivity", "MaxComplementarySensitivity", "GainMargin", "PhaseMargin"]
GAINS = {"pid.Kp": 4000.0, "pid.Ki": 300.0, "pid.Kd": 20.0, "pid.Tf": 2e-3}


def positioner() -> tuple[ClosedLoop, ParameterSet, Step]:
    """A position loop that is well damped where friction is steep and rings where it slides (80 N s/m, 5 kg)."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(1e-3), measured="position")
    return loop, loop.parameters.with_values({"friction.viscous": 80.0, **GAINS}), Step(0.05, horizon=0.5)


def test_the_margins_of_a_position_loop_are_those_of_its_sliding_body() -> None:
    """At its end, where it sticks, nothing seems wrong; sliding it has the phase margin of P = 1/(5 s^2 + 80 s)."""
    loop, p, step = positioner()
    response = respond(loop, step, p)
    table = pd.DataFrame(margin_rows(loop, p, step, response)).set_index("point")
    assert list(table.index) == ["at rest", "sliding", "at the end"]
    assert table["FrictionSlope"]["at rest"] > 1e4
    assert 70 < table["FrictionSlope"]["sliding"] < 90
    s, (Kp, Ki, Kd, Tf) = control.tf("s"), GAINS.values()
    numerator, denominator = control.pade(5e-4, 2)
    C = Kp + Ki * 5e-4 + Ki / s + Kd * s / ((Tf + 5e-4) * s + 1)
    L = C * control.tf(numerator, denominator) / (5 * s**2 + table["FrictionSlope"]["sliding"] * s)
    assert table["PhaseMargin"]["sliding"] == pytest.approx(control.stability_margins(L)[1], rel=1e-3)
    assert table["MaxSensitivity"]["sliding"] > 1.5 * table["MaxSensitivity"]["at the end"]
    found = evaluate(loop, step, p)[step.label]
    assert found["MaxSensitivity"] == table["MaxSensitivity"].max()
    assert found["PhaseMargin"] == table["PhaseMargin"].min()
    assert found["FrictionSlope"] == table["FrictionSlope"].min()


def test_the_points_are_those_of_the_response() -> None:
    loop, p, step = positioner()
    response = respond(loop, step, p)
    rest, sliding, end = operating_points(loop, p, step, response)
    assert (rest.x.tolist(), rest.inputs["force"]) == ([0.0, 0.0], 0.0)
    fastest = np.argmax(np.abs(response["speed"]))
    assert sliding.x[1] == pytest.approx(response["speed"][fastest], rel=1e-3)
    assert sliding.t == pytest.approx(response.t[fastest], abs=2e-3)
    assert end.x.tolist() == [response["position"][-1], response["speed"][-1]]
    moving = Step(0.1, at=0.02, initial=0.05, horizon=0.4)
    speed = ClosedLoop(ForceDrive(Stribeck()).system(), PID(1e-3))
    q = speed.parameters.with_values({"pid.Kp": 200.0, "pid.Ki": 2000.0})
    names = [point.name for point in operating_points(speed, q, moving, respond(speed, moving, q))]
    assert names == ["at the start", "sliding", "at the end"]


def test_a_linear_plant_has_one_point() -> None:
    loop = ClosedLoop(SecondOrder().system(), PID())
    p = loop.parameters.with_values({"pid.Kp": 0.2, "pid.Ki": 1.0})
    assert len(operating_points(loop, p, Step(1.0), respond(loop, Step(1.0), p))) == 1


def test_under_dither_the_points_are_means() -> None:
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID(), Dither(100.0))
    p = loop.parameters.with_values({"pid.Kp": 200.0, "pid.Ki": 2000.0, "dither.amplitude": 30.0})
    step = Step(0.2, horizon=0.5)
    response = respond(loop, step, p)
    points = operating_points(loop, p, step, response)
    period = response.t > 0.49 - 1e-9
    last, speed = response.t[period], response["speed"][period]
    mean = np.trapezoid(speed, last) / 0.01 + 0.5 * (speed[-1] - speed[0])  # of the period around the end
    assert points[-1].x[1] == pytest.approx(mean, rel=1e-6)
    assert np.ptp(speed) > 0.01
    assert 0.999 * mean <= points[1].x[1] < response["speed"].max()


def test_margins_do_not_jump_where_a_dither_begins(light_cylinder: tuple[ClosedLoop, ParameterSet, Step]) -> None:
    loop, p, step = light_cylinder
    step = replace(step, horizon=0.2)
    found = [
        pd.DataFrame(margin_rows(loop, q, step, respond(loop, step, q))).set_index("point")[["t", *MARGINS]]
        for q in (p.with_values({"dither.amplitude": a}) for a in (0.0, 1e-12, 1e-3))
    ]
    assert 3 < found[0]["MaxSensitivity"]["sliding"] < 5
    for table in found[1:]:
        np.testing.assert_allclose(table, found[0], rtol=1e-3)


def test_unstable_at_one_point_is_unstable() -> None:
    rows = [
        {"MaxSensitivity": 1.5, "GainMargin": 0.3, "PhaseMargin": -50.0, "NoiseGain": 9.0, "FrictionSlope": 5.0},
        {"MaxSensitivity": 1.2, "GainMargin": 4.0, "PhaseMargin": 40.0, "NoiseGain": 3.0, "FrictionSlope": -2.0},
    ]
    worst = worst_margins(rows)
    assert worst == {
        "MaxSensitivity": 1.5,
        "GainMargin": 0.3,
        "PhaseMargin": 40.0,
        "NoiseGain": 3.0,
        "FrictionSlope": -2.0,
    }
    broken = worst_margins([*rows, {n: np.inf if n in ("MaxSensitivity", "NoiseGain") else np.nan for n in rows[0]}])
    assert broken["MaxSensitivity"] == np.inf
    assert np.isnan(broken["PhaseMargin"])


def gained() -> System:
    """A lag whose gain is an input of its own, and rises with it."""
    x, u, gain = Quantity("x", "1"), Quantity("u", "1"), Parameter(1.0, "1")
    return define(
        [x], [u], [x], ParameterSet({"gain": gain}), lambda _t, x, u, p: ({"x": p["gain"] * u["u"] - x["x"]}, dict(x))
    )


def test_margins_are_those_of_the_disturbed_plant() -> None:
    """A gain that rises tenfold with the step: the loop rings afterwards, not before."""
    loop, step = ClosedLoop(gained(), PID(0.05)), Step(1.0, horizon=4.0, disturbance={"gain": 9.0})
    p = loop.parameters.with_values({"pid.Kp": 0.0, "pid.Ki": 2.0, "pid.Kd": 0.0, "pid.Tf": 0.01, "gain": 1.0})
    disturbed = ClosedLoop(gained(), PID(0.05))
    before, after = (margins(open_loop(disturbed, p.with_values({"gain": g}))).max_sensitivity for g in (1.0, 10.0))
    assert after > 2 * before
    assert evaluate(loop, step, p).iloc[:, 0]["MaxSensitivity"] == pytest.approx(after, rel=1e-6)
    whole = add_disturbances(loop, [step])
    response = respond(loop, step, p)
    table = pd.DataFrame(margin_rows(whole, whole.complete(p), step, response)).set_index("point")
    assert table["MaxSensitivity"].tolist() == pytest.approx([before, after], rel=1e-6)


def test_the_friction_slope_is_that_of_bristles_that_follow() -> None:
    """LuGre's steady force falls by Stribeck's curve; at a fixed deflection of the bristles it would only rise."""
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID())
    p = loop.parameters.with_values({"pid.Kp": 3000.0, "pid.Ki": 10000.0})
    step = Step(0.01, initial=0.01, horizon=0.2)
    start = margin_rows(loop, p, step, respond(loop, step, p))[0]
    coulomb, static, v_s, viscous = (
        p.value(f"friction.{n}") for n in ("coulomb", "static", "stribeck_velocity", "viscous")
    )
    v = 0.01
    slope = viscous - 2 * v / v_s**2 * (static - coulomb) * np.exp(-((v / v_s) ** 2))
    assert start["FrictionSlope"] == pytest.approx(slope, rel=1e-3)
    assert slope < 0


@pytest.mark.parametrize("growth", [1e-4, -1e-4])
def test_a_slow_growth_is_instability(growth: float) -> None:
    """One part in ten thousand of the fastest pole: it doubles in seven seconds."""
    x, y, u = Quantity("x", "1"), Quantity("y", "1"), Quantity("u", "1")
    signals = ([x, y], [u], [x], ParameterSet())
    plant = define(
        *signals,
        lambda _t, x, u, _p: ({"x": 0.1 * x["x"] + x["y"], "y": 1e3 * (u["u"] - x["y"])}, {"x": x["x"]}),
    )
    loop = ClosedLoop(plant, PID())
    p = loop.parameters.with_values({"pid.Kp": 0.1 - 1e3 * growth, "pid.Ki": 0.0, "pid.Kd": 0.0, "pid.Tf": 1e-3})
    assert margins(open_loop(loop, p)).stable == (growth < 0)


@pytest.mark.parametrize("damping", [0.003, 0.05, 0.5])
def test_peaks_are_those_of_a_dense_frequency_response(damping: float) -> None:
    rng, s, plants = np.random.default_rng(3), control.tf("s"), []
    for _ in range(12):
        w, lag, gain = rng.uniform(5, 80), rng.uniform(0.001, 0.05), damping * 10 ** rng.uniform(-1, 0.5)
        L = gain * w**2 / (s**2 + 2 * damping * w * s + w**2) / (lag * s + 1) * (1 + damping * rng.uniform(0.1, 20) / s)
        closed = control.feedback(L, 1).poles()
        if closed.real.max() < 0:
            plants.append((L, closed))
    assert len(plants) >= 6
    still = np.zeros(len(plants))
    reader = SensitivityReader(np.array([L.poles() for L, _ in plants]), np.array([q for _, q in plants]), still, still)
    found = reader.peaks(["MaxSensitivity"], 1e-3, 1e5)[0]["MaxSensitivity"]
    grid = np.geomspace(1e-3, 1e5, 20000)
    for (L, closed), peak in zip(plants, found.tolist(), strict=True):
        near = np.concatenate([abs(q) * np.geomspace(0.9, 1.1, 40001) for q in closed])
        exact = max(float(np.abs(1 / (1 + L(1j * w))).max()) for w in (grid, near))
        assert peak == pytest.approx(exact, rel=1e-6)


def test_every_loop_has_its_own_peak_however_many_there_are() -> None:
    """``L = w0^2/(s (s + w0))`` peaks at the same height for every w0, which lies at another frequency."""
    w0 = np.geomspace(0.1, 1e3, 263)[:, None]
    opened, closed = w0 * np.array([0j, -1.0]), w0 * np.roots([1.0, 1.0, 1.0]).astype(complex)
    still = np.zeros(len(w0))
    only = ["MaxSensitivity", "MaxComplementarySensitivity"]
    peaks = SensitivityReader(opened, closed, still, still).peaks(only, 1e-4, 1e6, at_a_time=128)[0]
    w = np.geomspace(0.01, 100, 200001)
    exact = np.abs(1j * w * (1j * w + 1) / ((1j * w) ** 2 + 1j * w + 1)).max()
    assert_allclose(peaks["MaxSensitivity"], exact, rtol=1e-8)
    assert_allclose(peaks["MaxComplementarySensitivity"], 2 / np.sqrt(3), rtol=1e-8)
