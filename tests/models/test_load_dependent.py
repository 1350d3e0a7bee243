"""Friction of a gear: what its docstring promises of the load's share."""

import casadi as ca
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.models.friction import Coulomb
from pneuopt.models.load_dependent import LoadDependent

LAW = LoadDependent(Coulomb())
VALUES = {"coulomb": 30.0, "viscous": 0.0, "smoothing": 1e-3, "coulomb_load": 0.1, "load_rounding": 1.0}


def force(load: float) -> float:
    """The friction force at 1 m/s, where the sign's smoothing has ended."""
    p = {n: ca.SX(v) for n, v in VALUES.items()}
    return float(ca.evalf(LAW.force(ca.SX(1.0), {}, {"force": ca.SX(load)}, p).value))


def test_without_load_it_is_the_base_model() -> None:
    assert force(0.0) == pytest.approx(30.0, rel=1e-12)


@given(load=st.floats(-1e4, 1e4))
def test_the_rise_is_the_coefficient_times_the_load_less_at_most_the_rounding(load: float) -> None:
    rise = force(load) - 30.0
    assert rise <= 0.1 * abs(load) + 1e-9
    assert rise >= 0.1 * (abs(load) - VALUES["load_rounding"]) - 1e-9
