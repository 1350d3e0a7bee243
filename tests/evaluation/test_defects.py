"""How a response ends, read off records that are made by hand."""

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.band import longest_stay
from pneuopt.evaluation.continuation import ContinuedResponse
from pneuopt.evaluation.defects import Defect, Ending, find_defects
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.arrays import Array

STEP, BAND = Step(1.0, horizon=1.0), 0.02


def ending(t: Array, error: Array) -> Ending:
    """The ending of a response with this error that the end of the stroke cuts."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    return Ending(
        ContinuedResponse(loop, STEP, None, t, 1.0 + error, np.ones_like(t), "the piston left the stroke"), BAND, "a"
    )


def decay(t: Array, dip: float) -> Array:
    """A decay into the band that touches its edge at .8 s, is outside once more until .9 s, and then dies out."""
    error = -np.exp(-t / 0.2)
    return np.asarray(np.where((t > 0.84) & (t < 0.9), -dip, error))


@pytest.mark.parametrize(("dip", "settled"), [(0.01, 0.78), (0.0205, 0.9)])
def test_a_response_that_leaves_the_band_for_a_moment_has_settled(dip: float, settled: float) -> None:
    """The record ends at 1.5 s; this was "creeps: 1.1 s after the step it is .3 % of the step away"."""
    t = np.linspace(0.0, 1.5, 3001)
    found = ending(t, decay(t, dip))
    assert found.is_settled
    assert found.settling_time == pytest.approx(settled, abs=5e-3)
    assert list(find_defects(found)) == []


def test_a_response_that_is_inside_as_long_as_ever_hunts_on() -> None:
    """Of 1 s: .3 s inside, .3 s outside, and .25 s inside again, as in slow hunting."""
    t = np.linspace(0.0, 1.0, 2001)
    error = np.where(t < 0.15, -1.0, np.where((t < 0.45) | (t > 0.75), 0.01, 0.03 + 0.01 * t))
    found = ending(t, np.asarray(error))
    assert longest_stay(t, found.is_inside(error)) == pytest.approx(0.3, abs=2e-3)
    assert not found.is_settled
    assert [f.defect for f in find_defects(found)] != []
    assert found.returns(0.0) == 1


@pytest.mark.parametrize(("share", "inside"), [(1.0, True), (1.0005, False), (1.01, False)])
def test_a_response_that_rests_beyond_the_band_is_outside(share: float, inside: bool) -> None:
    """Exactly on the edge is inside; half a thousandth of the band beyond it is outside, as in the metrics."""
    t = np.linspace(0.0, 1.5, 3001)
    found = ending(t, -np.maximum(np.exp(-t / 0.1), share * BAND))
    assert found.is_settled == inside
    assert ([f.defect for f in find_defects(found)] == []) == inside
    late = ending(t, np.where(t > 1.2, share * BAND, 0.0))  # the horizon is 1 s
    assert late.refutes(0.5) != inside


@pytest.mark.parametrize(("horizons", "refused"), [(0.9, False), (3.0, False), (5.0, True), (9.0, True)])
def test_a_response_must_be_in_its_band_for_good_within_a_few_horizons(horizons: float, refused: bool) -> None:
    """Three horizons are a user's who underrated the settling; five are none that a user would wait for."""
    t = np.linspace(0.0, 30.0, 30001)
    found = ending(t, np.where(t < horizons * STEP.horizon, -0.05, -0.5 * BAND))
    assert found.is_settled
    assert [f.defect for f in find_defects(found)] == [Defect.CREEPS] * refused


def test_a_response_that_never_was_in_the_band_has_no_stay() -> None:
    t = np.linspace(0.0, 1.0, 1001)
    error = -0.5 * np.exp(-t / 5.0)
    found = ending(t, error)
    assert longest_stay(t, found.is_inside(error)) == 0.0
    assert [f.defect for f in find_defects(found)] == [Defect.CREEPS]


@pytest.mark.parametrize(("settled", "defects"), [(3.9, []), (4.1, [Defect.CREEPS])])
def test_who_needs_more_than_four_horizons_creeps(settled: float, defects: list[Defect]) -> None:
    """The step's horizon is 1 s; what comes in within four is settled, later than its user thought."""
    t = np.linspace(0.0, 16.0, 8001)
    found = ending(t, np.where(t < settled, -0.05, 0.0))
    assert found.settling_time == pytest.approx(settled, abs=5e-3)
    assert [f.defect for f in find_defects(found)] == defects


@pytest.mark.parametrize(("ratio", "settles"), [(1.8, False), (2.2, True)])
def test_who_came_in_late_must_stay_twice_as_long_as_before(ratio: float, settles: bool) -> None:
    """Of the 1 s that is judged: .15 s inside, then outside until the last stay, which lasts a multiple of that."""
    t = np.linspace(0.0, 1 / 0.9, 4001)
    inside = ((t > 0.3) & (t < 0.45)) | (t > 1 - ratio * 0.15)
    assert ending(t, np.where(inside, 0.01, 0.05)).is_settled == settles
