"""CONTRIBUTING.md: the paths that it names exist, and its example of the lanes' memory is right."""

import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from pneuopt.dynamics.compiled.rollout import Pieces, Rollout

ROOT = Path(__file__).parents[1]
PATHS = re.findall(r"`((?:pneuopt|tests|problems)/[\w/.]*)`", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", sorted(set(PATHS)))
def test_what_it_names_exists(path: str) -> None:
    assert (ROOT / path).exists()


def test_the_example_of_the_memory_layout() -> None:
    """x' = x + h (x1, p0 x0), y = p0 x0: dy/dp0 is x0, and d x1/d x0 after two samples is 2 h p0."""
    t, h, x, u, p = (ca.SX.sym(n, k) for n, k in zip("thxup", (1, 1, 2, 1, 1), strict=True))
    step = ca.Function("one", [t, h, x, u, p], [x + h * ca.vertcat(x[1], p * x[0]), p * x[0]])
    x0 = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    times = np.tile([0.0, 0.1], (3, 1))
    run = Rollout(Pieces(step), wrt=(0,), start=True).run(x0, np.zeros((3, 2, 1)), [0.5], times, np.full((3, 2), 0.1))
    assert run.dy is not None
    assert run.dx_end is not None
    dy, dx_end = (np.ascontiguousarray(np.swapaxes(a, -1, -2)) for a in (run.dy, run.dx_end))
    assert (dy.shape, dx_end.shape) == ((3, 2, 3, 1), (3, 3, 2))
    assert dy.ravel()[8] == x0[1, 0]
    assert dx_end.ravel()[13] == pytest.approx(2 * 0.1 * 0.5)
