"""A search reads responses under dither as the certificate does: the same signal, with the same history."""

from math import pi

import numpy as np
import pytest

from pneuopt.control.reference import Step
from pneuopt.evaluation.metrics import BandCentre, step_metrics
from pneuopt.tuning.readings import ReferenceGrid, read_metrics
from pneuopt.tuning.rows import Lanes

PERIOD, SPACING = 0.05, 2.5e-3
METRICS = ("SettlingTime", "SettlingTimeRaw", "Undershoot", "RiseTime", "IAE", "Overshoot", "SteadyStateError")


def response(reference: Step) -> tuple[ReferenceGrid, np.ndarray]:
    """A lag of .1 s under a ripple of 10 % of the step: signal, command, and the signal's integral."""
    t = np.linspace(0.0, reference.horizon, round(reference.horizon / SPACING) + 1, dtype=np.float64)
    lag, rate = 0.1, 2 * pi / PERIOD
    y = reference.final - reference.size * np.exp(-t / lag) + 0.1 * np.sin(rate * t)
    whole = reference.final * t - reference.size * lag * (1 - np.exp(-t / lag)) + 0.1 * (1 - np.cos(rate * t)) / rate
    grid = ReferenceGrid(reference, t, np.full((len(t), 1), reference.final), SPACING)
    return grid, np.stack([y, np.zeros_like(t), whole], axis=-1)[None]


@pytest.mark.parametrize("reference", [Step(1.0, horizon=1.0), Step(1.0, initial=3.0, horizon=1.0)])
def test_search_and_certificate_read_a_dithered_step_alike(reference: Step) -> None:
    """From motion too: a history of zeros before the step would move the mean in the first half period."""
    grid, y = response(reference)
    given = (grid.t, y[0, :, 0], reference.final, reference.initial)
    proof = step_metrics(*given, band_centre=BandCentre.REFERENCE, dither_period=PERIOD)
    found = read_metrics(grid, y, (0.02,), PERIOD, METRICS, ())
    for name in METRICS:
        assert found[name][0] == pytest.approx(proof[name], rel=5e-3, abs=5e-3, nan_ok=True), name
    still = np.zeros((*y.shape, 1))
    lanes = Lanes(grid, y, still, np.zeros((1, 1, 1)), [PERIOD], 2)
    error, slopes = lanes.record.error
    assert 100 * error.max() == pytest.approx(proof["Overshoot"], abs=5e-3)
    assert proof["Undershoot"] == 0
    assert error.min() >= -1
    assert not slopes.any()
