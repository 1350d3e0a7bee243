""""""

import itertools
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from pneuopt.dynamics.compiled.rollout import Rollout, RolloutResult
from pneuopt.dynamics.integrators import solve_scalar
from pneuopt.dynamics.system import System, discretise, names, parameter_vector
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.arrays import Array

LIGHT = {"load.mass": 0.3, "friction.coulomb": 50.0, "friction.static": 65.0, "friction.stribeck_velocity": 0.02}
SAMPLE, SAMPLES = 1e-3, 60
FREE = ("friction.coulomb", "friction.static", "friction.viscous", "load.mass")


class Run(NamedTuple):
    """A light load pushed to and fro: it sticks, breaks away, slides and turns."""

    system: System
    p: Array
    start: Array
    force: Array

    def by_steps(
        self, substeps: int, *, implicit: int | None, free: tuple[str, ...] = (), lanes: int | None = None
    ) -> RolloutResult:
        """The run by compiled steps; with sensitivities where parameters are free."""
        pieces = replace(discretise(self.system).pieces, implicit=implicit)
        wrt = [list(self.system.parameters).index(n) for n in free]
        rollout = Rollout(pieces, wrt, start=bool(free), lanes=lanes)
        t, h = SAMPLE * np.arange(SAMPLES)[None], np.full((1, SAMPLES), SAMPLE)
        return rollout.run(self.start[None], self.force[None, :, None], self.p, t, h, substeps=substeps, states=1)


def states(run: RolloutResult) -> Array:
    assert run.x is not None
    return np.asarray(run.x[0])


@pytest.fixture(scope="module")
def light() -> Run:
    system = ForceDrive(Stribeck()).system()
    p = parameter_vector(system.parameters, system.parameters.with_values(LIGHT))
    force = 80.0 * np.sin(2 * np.pi * 25.0 * SAMPLE * np.arange(SAMPLES))
    return Run(system, p, np.array([0.1, 0.0]), force)


@pytest.fixture(scope="module")
def exact(light: Run) -> Array:
    """States at each sample by SciPy's Radau method at tight tolerance: independent code."""
    x, rows = light.start, []

    def rate(t: float, x: Array, u: float) -> Array:
        return np.array(light.system.ode(t, x, u, light.p)[0]).ravel()

    for u in light.force:
        rows.append(x)
        x = solve_ivp(rate, (0.0, SAMPLE), x, args=(u,), method="Radau", rtol=1e-9, atol=1e-12).y[:, -1]
    return np.array(rows)


def test_it_follows_friction_that_an_explicit_step_cannot_and_is_of_second_order(light: Run, exact: Array) -> None:
    speed = names(light.system.states).index("speed")
    with np.errstate(all="ignore"):
        explicit = np.abs(states(light.by_steps(8, implicit=None)) - exact)
    errors = [np.abs(states(light.by_steps(k, implicit=speed)) - exact).max(axis=0) for k in (8, 16, 32, 64)]
    assert np.ptp(exact[:, 0]) > 1e-3  # it moves
    assert not explicit[:, 1].max() < 0.05  # 150 steps of RK4 a sample are stable
    assert errors[0][0] < 5e-6
    assert errors[3][0] < 2e-7
    falls = [before[0] / after[0] for before, after in itertools.pairwise(errors)]
    assert np.exp(np.mean(np.log(falls))) == pytest.approx(4.0, rel=0.4)


def test_its_sensitivities_are_those_of_its_own_run(light: Run) -> None:
    speed = names(light.system.states).index("speed")
    dy = light.by_steps(8, implicit=speed, free=FREE).dy
    assert dy is not None
    for column, name in enumerate(FREE):
        k, h = list(light.system.parameters).index(name), 1e-6 * LIGHT.get(name, 50.0)
        ahead, behind = (
            light._replace(p=light.p + sign * h * np.eye(len(light.p))[k]).by_steps(8, implicit=speed)
            for sign in (1, -1)
        )
        expected = (ahead.y[0] - behind.y[0]) / (2 * h)
        found = dy[0, :, :, len(light.start) + column]
        assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_machine_code_and_vm_agree(light: Run) -> None:
    speed = names(light.system.states).index("speed")
    native, vm = (light.by_steps(8, implicit=speed, free=FREE, lanes=lanes) for lanes in (None, 0))
    assert_allclose(native.y, vm.y, rtol=1e-9, atol=1e-12)
    assert native.dy is not None
    assert vm.dy is not None
    assert_allclose(native.dy, vm.dy, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("guess", [-1.0, -1e-3, 0.0, 1e-3, 0.3])
@pytest.mark.parametrize("push", [-2.0, -0.5, 0.0, 0.1, 0.999, 3.0])
def test_a_stage_is_solved_from_far_off(width: float, guess: float, push: float) -> None:
    """v - c + k tanh(v/width) = 0, whose slope changes by orders of magnitude at rest."""
    v, k = ca.SX.sym("v"), 0.05

    def residual(value: ca.SX) -> tuple[ca.SX, ca.SX]:
        bend = ca.tanh(value / width)
        return value - push * k + k * bend, 1 + k / width * (1 - bend**2)

    root = float(ca.Function("root", [v], [solve_scalar(residual, v)])(guess))
    left = root - push * k + k * np.tanh(root / width)
    assert abs(left) < 1e-3 * k
