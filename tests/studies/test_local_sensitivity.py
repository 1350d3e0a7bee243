"""Derivatives of a design's figures: those of central differences of the certificate, and of formulas."""

from collections.abc import Mapping

import numpy as np
import pytest

import pneuopt as po
from problems.shared.t32 import SPREADS, STEP, benchmark
from problems.speed.batched_monte_carlo import GAINS

METRICS = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl")


def central_difference(
    loop: po.ClosedLoop, step: po.Step, design: po.ParameterSet, steps: Mapping[str, float], side: float
) -> dict[str, float]:
    """By metric its change along some parameters, from two evaluations."""
    ends = [
        po.evaluate(loop, step, design.with_values({n: design.value(n) + sign * side * s for n, s in steps.items()}))
        for sign in (1, -1)
    ]
    high, low = (end.iloc[:, 0].to_dict() for end in ends)
    return {n: (high[n] - low[n]) / (2 * side) for n in METRICS}


@pytest.mark.parametrize("amplitude", [0.0, 0.6155])
def test_changes_are_those_of_the_certificate(amplitude: float) -> None:
    loop, given = benchmark()
    design = given.with_values(GAINS | {"dither.amplitude": amplitude})
    found = po.local_sensitivity(loop, STEP, design, SPREADS, metrics=METRICS)
    changes, scales = found.table["change"].to_dict(), found.figures["std"].to_dict()
    for axis, half in SPREADS.items():
        names = (axis,) if isinstance(axis, str) else axis
        deviations = {n: half * design.value(n) / np.sqrt(3.0) for n in names}
        exact = central_difference(loop, STEP, design, deviations, 1e-2)
        for metric in METRICS:
            change = changes[metric, " + ".join(names)]
            assert change == pytest.approx(exact[metric], abs=0.03 * scales[metric]), (metric, names)


def test_a_steady_error_and_its_shares_are_those_of_the_formula() -> None:
    loop = po.ClosedLoop(po.FirstOrder().system(), po.PID())
    design = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 0.0, "plant.gain": 2.0, "plant.time_constant": 0.1})
    spreads = {"plant.gain": 0.1, "plant.time_constant": 0.1}
    found = po.local_sensitivity(loop, po.Step(1.0, horizon=4.0), design, spreads, metrics=["SteadyStateError"])
    error, deviation = 100 / 9, 0.2 / np.sqrt(3.0)  # 1 / (1 + 4 K) in percent
    row = found.table.to_dict("index")["SteadyStateError", "plant.gain"]
    assert row["change"] == pytest.approx(-400 / 81 * deviation, rel=1e-3)
    assert row["relative"] == pytest.approx(row["change"] / error, rel=1e-6)
    assert row["share"] == pytest.approx(1.0, abs=1e-6)
    assert "plant.gain" in found.summary().to_text()


def test_an_axis_that_moves_the_samples_and_a_metric_of_the_linear_loop_are_refused() -> None:
    loop, given = benchmark()
    with pytest.raises(po.InputError, match=r"dither\.frequency: the samples of a response hang on it"):
        po.local_sensitivity(loop, STEP, given, {"dither.frequency": 0.1})
    with pytest.raises(po.InputError, match="MaxSensitivity: not read off"):
        po.local_sensitivity(loop, STEP, given, SPREADS, metrics=["MaxSensitivity"])
