import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.evaluation.requirements import (
    IAE,
    REQUIREMENT_KINDS,
    ControlRate,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Requirement,
    SettlingTime,
    SteadyStateError,
    StepEnvelope,
    describe_value,
    metric_name,
    requirement_values,
    upper_limit,
)
from pneuopt.quantities.errors import InputError


def test_metrics_in_percent_become_fractions() -> None:
    metrics = {"SettlingTime": 0.3, "Overshoot": 5.0, "SteadyStateError": 2.0, "PeakControl": 4.0, "Undershoot": 0.1}
    assert requirement_values(metrics) == {
        "SettlingTime": 0.3,
        "Overshoot": 0.05,
        "SteadyStateError": 0.02,
        "PeakControl": 4.0,
    }


def test_a_margin_counts_by_its_reciprocal() -> None:
    """A gain margin below one is the factor down that makes a loop oscillate: 0.5 is as good as 2."""
    values = requirement_values(
        {"GainMargin": np.array([2.0, 0.5, 4.0, math.inf]), "PhaseMargin": np.array([50.0, -50.0, 0.0, math.inf])}
    )
    np.testing.assert_allclose(values["GainMargin"], [0.5, 0.5, 0.25, 0.0])
    np.testing.assert_allclose(values["PhaseMargin"], [0.02, 0.02, math.inf, 0.0])
    assert math.isnan(requirement_values({"PhaseMargin": math.nan})["PhaseMargin"])


@given(st.floats(1.001, 100.0), st.floats(1.001, 100.0))
def test_a_margin_is_kept_where_it_is_large_enough(least: float, margin: float) -> None:
    for requirement, metric in ((GainMargin(least), "GainMargin"), (PhaseMargin(least), "PhaseMargin")):
        kept = requirement_values({metric: margin})[metric] <= upper_limit(requirement) * (1 + 1e-12)
        assert kept == (margin >= least * (1 - 1e-12)) or margin == pytest.approx(least, rel=1e-9)


def test_limits_are_told_as_they_were_written() -> None:
    assert describe_value(PhaseMargin(45.0), 1 / 30) == ("30", "at least 45")
    assert describe_value(GainMargin(2.0), 0.0) == ("inf", "at least 2")
    assert describe_value(IAE(0.1), 0.125) == ("0.125", "allowed 0.1")


@pytest.mark.parametrize("kind", [k for k in REQUIREMENT_KINDS if k is not StepEnvelope])
def test_without_a_bound_nothing_is_forbidden(kind: type[Requirement]) -> None:
    assert upper_limit(kind()) == math.inf
    assert metric_name(kind()) == kind.__name__


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        (Overshoot, 5.0, "5 % is 0.05"),
        (Overshoot, -0.1, "above 0"),
        (SteadyStateError, 2.0, "2 % is 0.02"),
        (MaxSensitivity, 0.9, "above 1"),
        (MaxComplementarySensitivity, 0.0, "above 0"),
        (PeakControl, math.inf, "finite"),
        (PeakControl, math.nan, "finite"),
        (ControlRate, -1.0, "ControlRate: max must be above 0"),
        (NoiseGain, 0.0, "NoiseGain: max must be above 0"),
        (IAE, math.nan, "IAE: max"),
        (GainMargin, 0.5, "GainMargin: min must be above 1 and finite, got 0.5; it is a factor"),
        (GainMargin, math.inf, "above 1 and finite"),
        (PhaseMargin, -10.0, "above 0 deg"),
        (PhaseMargin, math.nan, "above 0 deg"),
    ],
)
def test_a_bad_limit_is_refused(kind: type[Overshoot], value: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        kind(value)


def test_a_band_is_a_fraction() -> None:
    with pytest.raises(InputError, match=r"2 % is 0\.02"):
        SettlingTime(band=2.0)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ((), "times count from the step and increase"),
        (((-0.1, 0.0, 1.0),), "times count from the step"),
        (((0.0, 0.0, 1.0), (0.0, 0.5, 1.0)), "increase, got"),
        (((0.0, 1.1, 0.9),), "at 0 s the bounds must be finite and in order"),
        (((0.0, -math.inf, 1.1),), "finite"),
        (((0.0, 0.0, math.nan),), "finite"),
    ],
)
def test_a_bad_envelope_is_refused(bounds: tuple[tuple[float, float, float], ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        StepEnvelope(bounds)


@pytest.mark.parametrize("value", ["5 %", [], Overshoot])
def test_a_limit_that_is_no_number_is_named(value: object) -> None:
    with pytest.raises(InputError, match=r"^Overshoot: max takes a number, as 0\.05 for 5 %; got "):
        Overshoot(value)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^GainMargin: min takes a number"):
        GainMargin(value)  # type: ignore[arg-type]
