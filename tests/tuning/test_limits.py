"""One answer to which limit is broken: certificate, plants, search and relaxation read it of the same figures."""

import math

import numpy as np
import pytest

from pneuopt.evaluation.requirements import (
    GainMargin,
    MaxSensitivity,
    Overshoot,
    PhaseMargin,
    SettlingTime,
    requirement_values,
)
from pneuopt.evaluation.specification import specify
from pneuopt.tuning.racing import compute_merits
from pneuopt.tuning.relaxation import limit_excess
from pneuopt.tuning.tolerances import WORST_MERIT
from pneuopt.tuning.validation import find_breaks

SPEC = specify(SettlingTime(max=0.5), [Overshoot(0.1), MaxSensitivity(1.6), GainMargin(2.0), PhaseMargin(40.0)])
KEPT = {"SettlingTime": 0.4, "Overshoot": 5.0, "MaxSensitivity": 1.4, "GainMargin": 3.0, "PhaseMargin": 60.0}


@pytest.mark.parametrize(
    ("changed", "broken", "share"),
    [
        ({}, None, -0.125),
        ({"Overshoot": 10.0}, None, 0.0),
        ({"Overshoot": 12.0}, "Overshoot", 0.2),
        ({"SettlingTime": 0.6}, "SettlingTime", 0.2),
        ({"GainMargin": 1.6}, "GainMargin", 0.25),
        # a loop that may lose two thirds of its gain and a phase margin of either sign: plants counted these as broken,
        # or let them through, by other rules than the certificate's
        ({"GainMargin": 0.3}, None, -0.125),
        ({"GainMargin": 0.8}, "GainMargin", 0.6),
        ({"PhaseMargin": -60.0}, None, -0.125),
        ({"PhaseMargin": -32.0}, "PhaseMargin", 0.25),
    ],
)
def test_every_reader_says_which_limit_is_broken(changed: dict[str, float], broken: str | None, share: float) -> None:
    metrics = {**KEPT, **changed}
    values = requirement_values(metrics)
    names = () if broken is None else (broken,)
    assert tuple(type(q).__name__ for q in SPEC.violations(values)) == names
    assert max(SPEC.excess(values).values()) == pytest.approx(share)
    assert find_breaks(metrics, SPEC) == names
    lanes = {n: np.array([v]) for n, v in {**values, "Excess": 0.0}.items()}
    assert limit_excess(lanes, SPEC)[0] == pytest.approx(share)
    assert (compute_merits(lanes, SPEC, 1.0)[0] > WORST_MERIT) == (broken is not None)


def test_what_has_no_figure_breaks_its_limit() -> None:
    values = requirement_values({**KEPT, "Overshoot": math.nan})
    assert [type(q) for q in SPEC.violations(values)] == [Overshoot]
    assert find_breaks({**KEPT, "Overshoot": math.nan}, SPEC) == ("Overshoot",)
