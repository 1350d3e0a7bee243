"""A step of many segments, its sensitivities' columns together, is the one of each segment alone."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.system import System, discretise
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck

SEGMENTS = 400


@pytest.mark.parametrize("start", [True, False])
def test_many_segments_as_arrays_are_each_of_them_in_casadi_s_machine(axis: System, start: bool) -> None:
    for system, wrt in ((axis, [0, 2]), (ForceDrive(Stribeck()).system(), [0, 1, 3])):
        rng, n = np.random.default_rng(0), 5
        x0, u = rng.normal(0, 0.1, (SEGMENTS, len(system.states))), rng.normal(0, 20, (SEGMENTS, n, len(system.inputs)))
        t, h = np.tile(np.arange(n) * 1e-3, (SEGMENTS, 1)), np.full((SEGMENTS, n), 1e-3)
        h[::7, -2:] = 0.0  # short segments
        p = np.array([system.parameters.value(name) for name in system.parameters])
        rollout = Rollout(discretise(system).pieces, wrt, start, threads=1, lanes=0)
        together = rollout.run(x0, u, p, t, h, substeps=3)
        alone = [rollout.run(x0[[i]], u[[i]], p, t[:1], h[[i]], substeps=3) for i in range(15)]
        assert together.dy is not None
        assert together.dx_end is not None
        assert_allclose(together.x_end[:15], np.concatenate([r.x_end for r in alone]), rtol=1e-12, atol=1e-14)
        for name in ("dy", "dx_end"):
            expected = np.concatenate([getattr(r, name) for r in alone])
            scale = np.abs(expected).max()
            assert_allclose(getattr(together, name)[:15] / scale, expected / scale, rtol=1e-10, atol=1e-13)
