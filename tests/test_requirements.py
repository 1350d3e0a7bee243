import math

import pytest

from pneuopt.errors import InputError
from pneuopt.requirements import (
    MaxSensitivity,
    Overshoot,
    PeakControl,
    Requirement,
    SettlingTime,
    SteadyStateError,
    read,
    specify,
)


def test_a_term_with_a_limit_is_both() -> None:
    spec = specify(SettlingTime(band=0.05, max=0.4), [Overshoot(0.1)])
    assert spec.band == 0.05
    assert spec.weight(SettlingTime) == 1.0
    assert (spec.limit(SettlingTime), spec.limit(Overshoot), spec.limit(PeakControl)) == (0.4, 0.1, math.inf)
    assert not spec.concerns(PeakControl)


def test_the_tightest_limit_counts() -> None:
    spec = specify(SettlingTime(), [Overshoot(0.1), Overshoot(0.02), Overshoot(0.05)])
    assert spec.limit(Overshoot) == 0.02


def test_violated_names_what_is_not_kept_nan_included() -> None:
    spec = specify(SettlingTime(max=1.0), [Overshoot(0.1), MaxSensitivity(1.6)])
    values = {"SettlingTime": math.nan, "Overshoot": 0.1, "MaxSensitivity": 1.7}
    assert [type(q) for q in spec.violated(values)] == [SettlingTime, MaxSensitivity]


def test_metrics_in_percent_become_fractions() -> None:
    metrics = {"SettlingTime": 0.3, "Overshoot": 5.0, "SteadyStateError": 2.0, "PeakControl": 4.0, "RiseTime": 0.1}
    assert read(metrics) == {"SettlingTime": 0.3, "Overshoot": 0.05, "SteadyStateError": 0.02, "PeakControl": 4.0}


def test_tightening_leaves_room_inside() -> None:
    spec = specify(SettlingTime(band=0.02, max=1.0), [Overshoot(0.1), MaxSensitivity(1.6)]).tightened(0.03, 1e-4)
    assert spec.band == pytest.approx(0.0194)
    assert spec.limit(Overshoot) == pytest.approx(0.097)
    assert spec.limit(MaxSensitivity) == pytest.approx(1.6 * (1 - 1e-4))
    assert spec.limit(SettlingTime) == 1.0


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        (Overshoot, 5.0, "5 % is 0.05"),
        (Overshoot, -0.1, "above 0"),
        (SteadyStateError, 2.0, "2 % is 0.02"),
        (MaxSensitivity, 0.9, "above 1"),
        (PeakControl, math.inf, "finite"),
        (PeakControl, math.nan, "finite"),
    ],
)
def test_a_bad_limit_is_refused(kind: type[Overshoot], value: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        kind(value)


def test_a_band_is_a_fraction() -> None:
    with pytest.raises(InputError, match=r"2 % is 0\.02"):
        SettlingTime(band=2.0)


@pytest.mark.parametrize(
    ("minimise", "subject_to", "words"),
    [
        (SettlingTime(), [Overshoot()], r"Overshoot\(max="),
        ({}, [], "minimise is empty"),
        ({SettlingTime(): 0.0}, [], "weight of SettlingTime"),
        ({Overshoot(): 1.0, Overshoot(0.1): 1.0}, [], "twice"),
        (SettlingTime(band=0.02), [SettlingTime(band=0.05, max=1.0)], "bands differ"),
        ("settling_time", [], "is no requirement"),
    ],
)
def test_a_bad_specification_is_refused(minimise: Requirement, subject_to: list[Requirement], words: str) -> None:
    with pytest.raises(InputError, match=words):
        specify(minimise, subject_to)
