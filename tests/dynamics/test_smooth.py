"""A simulation frees its memory: LSODA restarts at each sample of a sampled loop, with the arrays that it had."""

import gc
import tracemalloc
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.smooth import WorkArrays
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Karnopp
from pneuopt.quantities.trajectories import Trajectory

SAMPLES = 400


@pytest.mark.parametrize("friction", [Coulomb(), Karnopp(Coulomb())])
def test_a_sampled_loop_leaves_no_arrays_behind(friction: FrictionModel) -> None:
    """Each restart left 1.3 kB for ever; what an integration needs once is some ten kB."""
    loop = ClosedLoop(ForceDrive(friction), PID(sample_time=1e-3))
    given = loop.parameters.with_values({"pid.Kp": 400.0, "pid.Ki": 4000.0})
    steps = Trajectory(np.array([0.0, SAMPLES * 1e-3]), {"reference": np.array([0.05, 0.05])})
    simulate(loop, steps, given)  # compiles, imports and caches
    gc.collect()
    tracemalloc.start()
    try:
        for _ in range(2):
            simulate(loop, steps, given)
        gc.collect()
        left = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert left < 2 * SAMPLES * 400


def test_a_model_without_states_restarts_too() -> None:
    drive = MotionDrive(Coulomb(), chamber=False).system()
    t = np.array([0.0, 0.1, 0.2])
    inputs = Trajectory(t, {q.name: np.array([0.1, -0.1, 0.1]) for q in drive.inputs})
    force = simulate(drive, inputs, drive.parameters)["force"]
    assert force == pytest.approx([force[0], -force[0], force[0]])


class Public:
    """An integrator of SciPy's without its private names, which another version of SciPy may not have."""

    def __init__(self, own: Any) -> None:
        self.own = own

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.own, name)

    def set_integrator(self, **options: Any) -> "Public":
        self.own.set_integrator(**options)
        return self


@pytest.mark.parametrize("friction", [Coulomb(), Karnopp(Coulomb())])
def test_where_scipy_hides_its_arrays_the_answer_is_the_same(
    friction: FrictionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each restart then has arrays of its own."""
    loop, made = ClosedLoop(ForceDrive(friction), PID(sample_time=1e-3)), list[Public]()
    given = loop.parameters.with_values({"pid.Kp": 400.0, "pid.Ki": 4000.0})
    steps = Trajectory(np.linspace(0.0, 0.05, 101), {"reference": np.full(101, 0.05)})
    usual = simulate(loop, steps, given)
    own = {name: getattr(integrate, name) for name in ("ode", "LSODA")}

    def make(name: str, *args: Any, **options: Any) -> Public:
        made.append(Public(own[name](*args, **options)))
        return made[-1]

    for name in own:
        monkeypatch.setattr(integrate, name, partial(make, name))
    hidden = simulate(loop, steps, given)
    assert made
    assert set(hidden) == set(usual)
    assert all(np.array_equal(hidden[name], usual[name]) for name in usual)


def test_arrays_that_stand_elsewhere_are_left_alone() -> None:
    rwork, iwork = np.zeros(3), np.ones(2, dtype=np.int32)
    for handed in ([1e-6, 1e-9, rwork, iwork, 1, 1, 2], [rwork], [1e-6, 1e-9, 1, 1, rwork.copy(), iwork, 2]):
        integrator = SimpleNamespace(rwork=rwork, iwork=iwork, call_args=list(handed))
        for _ in range(2):
            WorkArrays().give_to(SimpleNamespace(_integrator=integrator))
        assert all(a is b for a, b in zip(integrator.call_args, handed, strict=True))
        assert integrator.rwork is rwork
