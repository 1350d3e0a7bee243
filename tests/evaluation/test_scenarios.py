import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.evaluation.scenarios import corners, draws, samples
from pneuopt.quantities.errors import InputError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet

LOW_HIGH = ("low", "high")
RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 1.0, 20.0),
        "load.force": Parameter(-2.0, "N", -50.0, 50.0),
        "friction.coulomb": Parameter(40.0, "N", 0.0, 1e3),
        "friction.static": Parameter(70.0, "N", 0.0, 1e3),
        "friction.stribeck_velocity": Parameter(0.02, "m/s", 1e-4, 1.0, log=True),
    }
)


def test_corners_are_every_combination_and_an_axis_moves_as_one() -> None:
    spreads: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, ("friction.coulomb", "friction.static"): 0.5}
    cases = corners(RIG, spreads)
    assert len(cases) == 4
    assert list(cases) == [f"load.mass {a}, friction.coulomb + friction.static {b}" for a in LOW_HIGH for b in LOW_HIGH]
    for case in cases.values():
        assert case["friction.static"] / case["friction.coulomb"] == pytest.approx(70 / 40)
    assert {case["load.mass"] for case in cases.values()} == {3.5, 6.5}


def test_a_fraction_of_a_negative_value_still_runs_upwards() -> None:
    low, high = corners(RIG, {"load.force": 0.5}).values()
    assert (low["load.force"], high["load.force"]) == (-3.0, -1.0)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.7))
def test_samples_lie_in_the_box_of_the_corners(seed: int, spread: float) -> None:
    spreads = {"load.mass": spread, "friction.coulomb": spread}
    box = corners(RIG, spreads)
    for case in samples(RIG, spreads, 5, seed=seed).values():
        for name, value in case.items():
            inside = sorted({corner[name] for corner in box.values()})
            assert inside[0] <= value <= inside[1]


def test_samples_fill_the_box_and_repeat_with_the_seed() -> None:
    spreads = {"load.mass": (2.0, 8.0)}
    masses = [case["load.mass"] for case in samples(RIG, spreads, 2000, seed=3).values()]
    assert np.mean(masses) == pytest.approx(5.0, abs=0.15)
    assert np.std(masses) == pytest.approx(6 / math.sqrt(12), rel=0.05)
    assert samples(RIG, spreads, 3, seed=3) == samples(RIG, spreads, 3, seed=3) != samples(RIG, spreads, 3, seed=4)


def test_draws_have_the_covariance_that_was_given() -> None:
    names = ["friction.coulomb", "friction.static", "friction.stribeck_velocity"]
    given = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 4e-6]])  # v_s: 10 % of its value, as a logarithm
    found = draws(RIG, pd.DataFrame(given, names, names), 4000, seed=1)
    table = pd.DataFrame(found.values())
    assert np.cov(table[names[0]], table[names[1]]) == pytest.approx(given[:2, :2], rel=0.1)
    logs = np.log(table[names[2]])
    assert (logs.mean(), logs.std()) == pytest.approx((math.log(0.02), 0.1), rel=0.05)


def test_a_singular_covariance_is_drawn_along_its_line() -> None:
    names = ["friction.coulomb", "friction.static"]
    cases = draws(RIG, pd.DataFrame(np.array([[1.0, 2.0], [2.0, 4.0]]), names, names), 50)
    for case in cases.values():
        assert case["friction.static"] - 70 == pytest.approx(2 * (case["friction.coulomb"] - 40), abs=1e-6)


def test_draws_stay_within_the_bounds() -> None:
    cases = draws(RIG, pd.DataFrame([[100.0]], ["load.mass"], ["load.mass"]), 200)
    assert all(1.0 <= case["load.mass"] <= 20.0 for case in cases.values())


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match=r"no spread"):
        corners(RIG, {})
    with pytest.raises(UnknownNameError, match=r"load\.mas"):
        corners(RIG, {"load.mas": 0.1})
    with pytest.raises(InputError, match=r"friction\.coulomb is on two axes, 'friction\.\*' and 'friction\.coulomb'"):
        corners(RIG, {"friction.*": 0.1, "friction.coulomb": 0.2})
    with pytest.raises(InputError, match=r"load\.mass: 0 to 10 kg leaves its bounds, 1 to 20 kg"):
        corners(RIG, {"load.mass": 1.0})
    with pytest.raises(InputError, match=r"load\.mass: a spread is a positive fraction, got -0\.1"):
        corners(RIG, {"load.mass": -0.1})
    with pytest.raises(InputError, match=r"load\.mass: the spread from 8 to 2 kg is empty"):
        samples(RIG, {"load.mass": (8.0, 2.0)}, 3)
    many = ParameterSet({f"p{k}": Parameter(1.0, "1") for k in range(13)})
    with pytest.raises(InputError, match="13 axes have 8192 corners"):
        corners(many, {f"p{k}": 0.1 for k in range(13)})
    with pytest.raises(InputError, match=r"no covariance of load\.mass"):
        draws(RIG, pd.DataFrame([[math.nan]], ["load.mass"], ["load.mass"]), 3)
    at_edge = RIG.with_bounds({"load.mass": (5.0, 5.0)})
    with pytest.raises(InputError, match="none lies within the bounds"):
        draws(at_edge, pd.DataFrame([[1.0]], ["load.mass"], ["load.mass"]), 3)
