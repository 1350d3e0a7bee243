"""What a fit says on its way, and when it is printed."""

import re
from itertools import pairwise

import numpy as np
import pytest

from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.select_model import select_model
from pneuopt.logs.experiment import Experiment
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Progress
from pneuopt.quantities.trajectories import Trajectory


def step_log() -> Experiment:
    t = np.arange(0, 0.5, 2e-3)
    noise = np.random.default_rng(0).normal(0, 1e-3, len(t))
    moves = t >= 0.05
    speed = np.where(moves, 2.0 * (1 - np.exp(-(t - 0.05) / 0.08)), 0.0) + noise
    command = moves.astype(float)
    return Experiment(Trajectory(t, {"valve_voltage": command, "speed": speed}), {"speed": 1e-3}, name="step")


@pytest.fixture(scope="module")
def fit() -> IdentificationResult:
    plant = FirstOrder()
    heard: list[Progress] = []
    free = plant.system().parameters.freed("plant.gain", "plant.time_constant")
    found = identify(plant, step_log(), free, progress=heard.append)
    assert heard
    assert {report.job for report in heard} == {"identify"}
    assert all(a.seconds <= b.seconds for a, b in pairwise(heard))
    return found


@pytest.mark.parametrize("columns", ["60", "80"])
def test_a_fit_is_printed_verdict_first_with_intervals_and_marks(
    fit: IdentificationResult, columns: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    text = str(fit)
    assert text == repr(fit) == fit.summary().to_text()
    assert text.startswith("converged: ")
    assert max(map(len, text.splitlines())) <= int(columns)
    (line,) = [line for line in text.splitlines() if line.startswith("plant.gain")]
    assert re.search(r" [\d.]+ to ", line)
    assert line.endswith(str(fit.estimates["mark"]["plant.gain"]))
    page = fit._repr_html_()
    assert page.count("<table>") == 2
    assert "plant.time_constant" in page


def test_predictions_and_selections_tell_how_far_they_are(fit: IdentificationResult) -> None:
    heard: list[Progress] = []
    validate(FirstOrder(), step_log(), fit.parameters, progress=heard.append)
    predict(FirstOrder(), step_log(), fit.parameters, progress=heard.append)
    models: dict[str, FirstOrder | SecondOrder] = {"first": FirstOrder(), "second": SecondOrder()}
    free = ["plant.gain", "plant.time_constant", "plant.damping", "plant.natural_frequency"]
    found = select_model(models, step_log(), ParameterSet(), free=free, progress=heard.append)
    assert list(dict.fromkeys(report.job for report in heard)) == ["validate", "predict", "select_model"]
    assert "fitting first, 1 of 2 candidates" in heard
    text = found.summary().to_text(80)
    assert text.startswith("first, of ")
    assert max(map(len, text.splitlines())) <= 80
