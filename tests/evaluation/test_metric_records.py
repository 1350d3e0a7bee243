"""Every metric that a requirement may limit, through one mill: a new one is a row of `ROWS` here."""

import re
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate, metric_units, relevant_units, report_metrics
from pneuopt.evaluation.metric import AtMost, Metric, Requirement, Sense, Source, StepRecord
from pneuopt.evaluation.metrics import BandCentre, batch_metrics
from pneuopt.evaluation.requirements import METRICS, REQUIREMENT_KINDS, SettlingTimeRaw, StepEnvelope, user_limit
from pneuopt.files.tuning import read_tuning
from pneuopt.models.catalog import t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import Integrator
from pneuopt.quantities.errors import InputError

ENVELOPE = ((0.0, -0.5, 1.5),)
AXIS = ClosedLoop(ForceDrive(Viscous()).system(), PID(sample_time=1e-3))


class Row(NamedTuple):
    """A metric by hand, of the response or the linear loop below; a limit as a file writes it, and as a number."""

    value: float
    written: str
    limit: float


ROWS = {
    "SettlingTime": Row(0.78, '{ band = "2 %", max = "300 ms" }', 0.3),
    "SettlingTimeRaw": Row(0.78, '{ band = "2 %", max = "300 ms" }', 0.3),
    "RiseTime": Row(0.8 / 2, '"200 ms"', 0.2),
    "Overshoot": Row(20.0, '"5 %"', 0.05),
    "OvershootDistance": Row(0.2, '"5 mm/s"', 0.005),
    "FollowingError": Row(0.6, '"5 mm/s"', 0.005),
    "FollowingErrorRMS": Row(
        ((0.6**3 + (0.6**3 - 0.18**3) / 2 + 0.18**3 + 0.01**3) / 6 + 5e-5) ** 0.5, '"5 mm/s"', 0.005
    ),
    "Compliance": Row(1.0 / 50, '"5 mm/s/N"', 0.005),
    "SteadyStateError": Row(1.0, '"2 %"', 0.02),
    "StepEnvelope": Row(0.7, '{ bounds = [["0 s", "-50 %", "150 %"]], max = 0.9 }', 0.9),
    "IAE": Row(0.25 + 0.01 + 0.02 + 5e-5 + 0.0119, '"150 ms"', 0.15),
    "ISE": Row(0.5 / 3 + 0.004 / 3 + 0.008 / 3 + 1.19e-4, '"100 ms"', 0.1),
    "ITAE": Row(0.125 / 3 + 0.017 / 3 + 0.04 / 3 + 4.03e-5 + 0.0167195, '"0.03 s^2"', 0.03),
    "PeakControl": Row(4.0, '"150 N"', 150.0),
    "ControlRate": Row(1.0, '"2 kN/s"', 2000.0),
    "Ripple": Row(0.0, '"2 mm/s"', 0.002),
    "AirUse": Row(4e-3 / 1.185e-3, '"2 l(ANR)"', 2.0),
    "EnergyUse": Row(100.0, '"25 J"', 25.0),
    "MaxSensitivity": Row(1.0, "1.6", 1.6),
    "MaxComplementarySensitivity": Row(1.0, "1.3", 1.3),
    "GainMargin": Row(np.inf, "2.5", 2.5),
    "PhaseMargin": Row(90.0, '"50 deg"', 50.0),
    "NoiseGain": Row(5.0, '"400 N*s/m"', 400.0),
}
KINDS = pytest.mark.parametrize("kind", REQUIREMENT_KINDS, ids=lambda kind: kind.__name__)


def check_record(kind: type[Requirement]) -> None:
    """What a record has to say; the message names the metric."""
    metric = kind.metric
    assert metric.name == kind.__name__, f"{kind.__name__}: its record is called {metric.name}"
    assert METRICS.get(metric.name) is metric, f"{metric.name}: no row in REQUIREMENT_KINDS"
    assert isinstance(metric.sense, Sense), f"{metric.name}: at most, or at least?"
    assert isinstance(metric.source, Source), f"{metric.name}: read from what?"
    assert metric.sense is Sense.AT_MOST or metric.cost is not None, f"{metric.name}: at least, but no cost falls"
    assert (metric.source is Source.METER) == bool(metric.channels), f"{metric.name}: which channels of the meter?"
    assert metric.name in ROWS, f"{metric.name}: no row in ROWS of tests/evaluation/test_metric_records.py"


@cache
def response() -> dict[str, float]:
    """Up by 2 a second to 1.2, down by 1 a second to 0.99, which stays; the command falls by 1 a second from 4."""
    t = np.linspace(0.0, 2.0, 4001)
    y = np.interp(t, [0.0, 0.6, 0.81, 2.0], [0.0, 1.2, 0.99, 0.99])
    shown = {"air": np.full((1, len(t)), 2e-3), "power": 50 * t[None], "spool": np.zeros((1, len(t)))}
    found = batch_metrics(
        t,
        y[None],
        1.0,
        0.0,
        band_centre=BandCentre.REFERENCE,
        control=(4 - t)[None],
        envelope=ENVELOPE,
        meter=shown,
        target=np.interp(t, [0.0, 1.0], [0.0, 1.0]),
        push=-50.0,
    )
    return {name: value.item() for name, value in found.items()}


@cache
def linear_loop() -> dict[str, float]:
    """A gain of 5 around an integrator, L = 5/s."""
    loop = ClosedLoop(Integrator().system(), PID(limits=False))
    given = loop.parameters.with_values({"plant.gain": 1.0, "pid.Kp": 5.0, "pid.Ki": 0.0})
    return dict(evaluate(loop, Step(1.0), given)["0 to 1"])


@cache
def certified() -> pd.DataFrame:
    drive, values = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3))
    given = (loop.parameters | values).with_values({"pid.Kp": 2.0, "pid.lower": -5.0, "pid.upper": 5.0})
    return evaluate(loop, Step(0.1, horizon=0.2), given, envelope=ENVELOPE)


def synthetic_record(q: np.ndarray) -> StepRecord:
    """Signals that two unknowns shape, smoothly, with their derivatives."""
    t = np.linspace(0.0, 2.0, 21)
    waves = np.stack([np.sin(3 * t + 0.3), np.cos(5 * t)], axis=-1)
    values, slopes = (np.exp(-t) + waves @ q + 0.3 * q.prod())[None], (waves + 0.3 * q[::-1])[None]
    signal = (values, slopes)
    meter = dict.fromkeys((c for m in METRICS.values() for c in m.channels), signal)
    last = (values[:, -1:], slopes[:, -1:])
    at_nodes = (values[:, ::4], slopes[:, ::4])
    settings: Any = {"size": -0.2, "wanted": np.cos(t[::4]), "push": 50.0}
    return StepRecord(t, at_nodes, last, np.eye(2)[None], signal, meter, stride=4, envelope=ENVELOPE, **settings)


@KINDS
def test_a_record_says_all_that_the_rest_reads(kind: type[Requirement]) -> None:
    check_record(kind)


def test_the_mill_names_what_has_no_unit_or_no_row() -> None:
    with pytest.raises(InputError, match="Speed: a metric needs a unit"):
        Metric("Speed", "", Source.RESPONSE)

    class Haste(AtMost):
        metric = Metric("Haste", "s", Source.RESPONSE)

    with pytest.raises(AssertionError, match="Haste: no row in REQUIREMENT_KINDS"):
        check_record(Haste)


@KINDS
def test_a_metric_is_what_one_computes_by_hand(kind: type[Requirement]) -> None:
    found = linear_loop() if kind.metric.source is Source.LINEAR_LOOP else response()
    assert found[kind.metric.name] == pytest.approx(ROWS[kind.metric.name].value, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("name", [n for n, metric in METRICS.items() if metric.slope and n != "ValveTravel"])
def test_slopes_are_central_differences(name: str) -> None:
    slope = METRICS[name].slope
    assert slope is not None
    q, h = np.array([0.4, 0.25]), 1e-6
    rows, slopes = slope(synthetic_record(q))
    assert slopes.shape == (*rows.shape, 2)
    for k, nudge in enumerate(h * np.eye(2)):
        above, below = (slope(synthetic_record(q + side * nudge))[0] for side in (1, -1))
        np.testing.assert_allclose(slopes[..., k], (above - below) / (2 * h), rtol=1e-6, atol=1e-7)


@KINDS
def test_a_file_asks_for_it_and_limits_it(kind: type[Requirement], tmp_path: Path) -> None:
    key, row = re.sub("(?<=[a-z])(?=[A-Z])", "_", kind.__name__).lower(), ROWS[kind.__name__]
    bounds = ', bounds = [["0 s", "-50 %", "150 %"]]' if kind is StepEnvelope else ""
    text = f"""[pid]
sample_time = "1 ms"
Kp = "300 N*s/m"
[[reference]]
step = "0.2 m/s"
horizon = "1 s"
[minimise]
{key} = {{ weight = 2.0{bounds} }}
[limits]
{key} = {row.written}
"""
    (tmp_path / "tuning.toml").write_text(text)
    task = read_tuning(tmp_path / "tuning.toml", AXIS.plant)
    (term,), (limit,) = task.specification.weights, task.specification.limits
    assert isinstance(term, kind)
    assert isinstance(limit, kind)
    assert (user_limit(term), task.specification.weights[term]) == (None, 2.0)
    assert user_limit(limit) == pytest.approx(row.limit)


@KINDS
def test_the_certificate_has_it_and_the_screen_shows_it_with_its_unit(kind: type[Requirement]) -> None:
    name = kind.metric.name
    assert name in certified().index
    own = (
        kind.metric.unit == "{measured}" or kind is SettlingTimeRaw
    )  # on the screen with a dither, or a position, only
    if own or kind.metric.positions:
        return
    text = report_metrics(certified(), relevant_units(AXIS)).to_text(200)
    line = next(line for line in text.splitlines() if line.split()[:1] == [name])
    assert line.rstrip(" │|").endswith(metric_units(AXIS)[name])
