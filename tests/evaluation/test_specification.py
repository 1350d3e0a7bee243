import math

import pytest

from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.requirements import (
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Requirement,
    SettlingTime,
    StepEnvelope,
)
from pneuopt.evaluation.specification import specify, specify_limits
from pneuopt.evaluation.tolerances import STABILITY_SENSITIVITY
from pneuopt.quantities.errors import InputError

TUBE, OTHER = ((0.0, -0.1, 1.1), (0.5, 0.9, 1.1)), ((0.0, -0.2, 1.2),)


def test_a_term_with_a_limit_is_both() -> None:
    spec = specify(SettlingTime(band=0.05, max=0.4), [Overshoot(0.1)])
    assert spec.band == 0.05
    assert spec.weight(SettlingTime) == 1.0
    assert (spec.limit(SettlingTime), spec.limit(Overshoot), spec.limit(PeakControl)) == (0.4, 0.1, math.inf)
    assert not spec.concerns(PeakControl)
    assert spec.metric_names == ("SettlingTime", "Overshoot")


def test_the_tightest_limit_counts() -> None:
    spec = specify(SettlingTime(), [Overshoot(0.1), Overshoot(0.02), Overshoot(0.05)])
    assert spec.limit(Overshoot) == 0.02
    margins = specify(SettlingTime(), [PhaseMargin(30.0), PhaseMargin(60.0), PhaseMargin(45.0)])
    assert margins.limits == (PhaseMargin(60.0),)


def test_a_search_asks_for_a_stable_loop_whatever_was_asked_for() -> None:
    asked = specify(SettlingTime(), [Overshoot(0.1)])
    inside = asked.with_stability()
    assert inside.limit(MaxSensitivity) == STABILITY_SENSITIVITY
    assert inside.violations({"SettlingTime": 1.0, "Overshoot": 0.0, "MaxSensitivity": math.inf})
    assert asked.limit(MaxSensitivity) == math.inf
    own = specify(SettlingTime(), [MaxSensitivity(20.0)])
    assert own.with_stability() is own


def test_a_search_may_ask_for_a_rest_within_the_record_whatever_was_asked_for() -> None:
    asked = specify(PeakControl(), [Overshoot(0.1), SettlingTime(band=0.05, max=3.0)])
    rests = asked.with_rest(2.0)
    assert (rests.limit(SettlingTime), rests.band, rests.limit(Overshoot)) == (1.9, 0.05, 0.1)
    assert rests.violations({"PeakControl": 0.0, "Overshoot": 0.0, "SettlingTime": math.nan})
    assert rests.with_rest(2.0) is rests


def test_violated_names_what_is_not_kept_nan_included() -> None:
    spec = specify(SettlingTime(max=1.0), [Overshoot(0.1), MaxSensitivity(1.6), GainMargin(2.0), PhaseMargin(45.0)])
    values = {"SettlingTime": math.nan, "Overshoot": 0.1, "MaxSensitivity": 1.7, "GainMargin": 0.6, "PhaseMargin": 0.02}
    assert [type(q) for q in spec.violations(values)] == [SettlingTime, MaxSensitivity, GainMargin]


def test_tightening_leaves_room_inside() -> None:
    limits: list[Requirement] = [
        Overshoot(0.1),
        MaxSensitivity(1.6),
        MaxComplementarySensitivity(1.3),
        GainMargin(3.0),
        StepEnvelope(TUBE),
    ]
    spec = specify(SettlingTime(band=0.02, max=1.0), limits).tighten(0.03, 1e-4)
    assert spec.band == pytest.approx(0.0194)
    assert spec.limit(Overshoot) == pytest.approx(0.097)
    assert spec.limit(MaxSensitivity) == pytest.approx(1.6 * (1 - 1e-4))
    assert spec.limit(MaxComplementarySensitivity) == pytest.approx(1.3 * (1 - 1e-4))
    assert spec.limit(SettlingTime) == 1.0
    assert spec.limit(StepEnvelope) == pytest.approx(0.97)
    assert next(q.min for q in spec.limits if isinstance(q, GainMargin)) == pytest.approx(3.0 / 0.97)


def test_a_tolerance_is_tightened_as_a_band_is() -> None:
    spec = specify(SettlingTime(Tolerance(1e-4)), [Overshoot(0.1)])
    assert spec.band == Tolerance(1e-4)
    tightened = spec.tighten(0.1, 0.1).band
    assert isinstance(tightened, Tolerance)
    assert tightened.half_width == pytest.approx(0.9e-4)


def test_several_kinds_are_asked_about_at_once() -> None:
    spec = specify(SettlingTime(), [PhaseMargin(45.0), Overshoot(0.1)])
    assert spec.concerns((MaxSensitivity, PhaseMargin))
    assert not spec.concerns((MaxSensitivity, GainMargin))
    assert spec.without((MaxSensitivity, PhaseMargin)).limits == (Overshoot(0.1),)


def test_the_envelope_is_that_of_a_term_or_limit() -> None:
    assert specify(SettlingTime()).envelope == ()
    assert specify(SettlingTime(), [StepEnvelope(TUBE)]).envelope == TUBE
    assert specify(StepEnvelope(TUBE, max=None)).limits == ()


def test_a_checked_specification_stands_for_objective_and_limits() -> None:
    spec = specify({SettlingTime(0.05): 1.0}, [Overshoot(0.1)])
    assert specify(spec) is spec


def test_limits_without_an_objective_describe_a_loop_but_tune_nothing() -> None:
    spec = specify_limits([SettlingTime(0.05, max=0.5)])
    assert (spec.weights, spec.band) == ({}, 0.05)
    with pytest.raises(InputError):
        specify(spec)
