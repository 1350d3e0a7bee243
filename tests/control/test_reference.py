import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.control.reference import Reference, Step


@given(size=st.floats(-5, 5).filter(lambda s: abs(s) > 1e-6), first=st.integers(0, 90), initial=st.floats(-5, 5))
def test_the_step_comes_at_its_sample(size: float, first: int, initial: float) -> None:
    h = 0.01
    step = Step(size, at=first * h, initial=initial)
    run = step.trajectory(h)
    assert len(run) == 101
    np.testing.assert_array_equal(run["reference"], np.where(np.arange(101) >= first, initial + size, initial))
    assert step.final == initial + size


def test_the_grid_reaches_the_horizon() -> None:
    assert Step(1.0, horizon=1.0).trajectory(0.3).t[-1] == pytest.approx(1.2)


def test_labels_tell_steps_apart() -> None:
    steps = [Step(-0.2), Step(-0.2, initial=0.2), Step(-0.2, start={"position": 0.25, "pressure_b": 4e5})]
    assert [s.label for s in steps] == ["0 to -0.2", "0.2 to 0", "0 to -0.2, position 0.25, pressure_b 400000"]
    assert len({hash(s) for s in steps}) == 2
    assert steps[0] != steps[2]


def test_a_step_is_a_reference() -> None:
    step = Step(0.2, at=0.1, initial=0.1)
    assert isinstance(step, Reference)
    assert step.with_horizon(2.0) == Step(0.2, at=0.1, initial=0.1, horizon=2.0)
    assert step.values(np.array([0.0, 0.1, 5.0])).tolist() == [0.1, step.final, step.final]
