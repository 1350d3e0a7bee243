"""A simulation frees its memory: LSODA restarts at each sample of a sampled loop, with the arrays that it had."""

import gc
import tracemalloc

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.models.drive import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, FrictionModel
from pneuopt.models.karnopp import Karnopp
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
