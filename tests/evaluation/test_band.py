"""One answer to "is it in the band": every reader of a record says the same, and so does the page."""

import functools
import json
import shutil
import subprocess
from collections.abc import Callable, Mapping
from math import inf, isnan, nan
from typing import Any

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation import dithered_ending
from pneuopt.evaluation.band import band_share
from pneuopt.evaluation.cases import TuningCase
from pneuopt.evaluation.certificate import judge_evaluations
from pneuopt.evaluation.continuation import ContinuedResponse
from pneuopt.evaluation.defects import Defect, Ending, correct_metrics
from pneuopt.evaluation.evaluate import CaseEvaluation
from pneuopt.evaluation.metrics import BandCentre, step_metrics
from pneuopt.evaluation.response import measure
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.report.live import live_script, to_script
from pneuopt.tuning.linearised import _band_entry_times
from pneuopt.tuning.readings import ReferenceGrid, is_sound, read_metrics

SIZE, BAND, PERIOD = 0.2, 0.02, 0.02  # .2 + .02 * .2 - .2 > .02 * .2 in floating point: the edge itself
T = np.linspace(0.0, 2.0, 2001)
STEP = Step(SIZE, horizon=2.0)
LOOP = ClosedLoop(FirstOrder().system(), PID(limits=False), Dither(1 / PERIOD))
ARRIVES = 1 - np.exp(-T / 0.1)  # in the band after .1 ln 50 = .3912 s
WAVE = np.sin(2 * np.pi * T / PERIOD)
RECORDS: Mapping[str, tuple[Array, float | None, float]] = {  # shares of the step, the dither's period, settling time
    "settles": (ARRIVES, None, 0.3912),
    "leaves for a moment": (np.where((T > 0.8) & (T < 0.9), 1.03, ARRIVES), None, 0.8997),
    "leaves at the end": (np.where((T > 1.96) & (T < 1.98), 1.03, ARRIVES), None, inf),
    "hunts": (1 + 0.05 * np.sin(2 * np.pi * 3 * T), None, inf),
    "swings inside the band": (ARRIVES + 0.01 * np.sin(2 * np.pi * 3 * T) * (T > 1), None, 0.3912),
    "ripples inside the band": (ARRIVES + 0.005 * WAVE, PERIOD, 0.39),
    "ripples out of the band": (ARRIVES + 0.1 * WAVE, PERIOD, 0.39),
    "ends outside": (0.97 * ARRIVES, None, inf),
    "ends on the edge": (np.where(T < 0.5, 0.0, 1 + BAND), None, 0.5),
    "ends on the edge below": (np.where(T < 0.5, 0.0, 1 - BAND), None, 0.5),
    "ends a hair outside": (np.where(T < 0.5, 0.0, 1 + 1.0005 * BAND), None, inf),
    "comes in at the end": (np.where(T < 1.95, 0.5, 1.0), None, inf),
    "is not a number": (np.where(T < 1.0, ARRIVES, nan), None, inf),
}


def parameters(period: float | None) -> ParameterSet:
    return LOOP.parameters.with_values({"dither.amplitude": 0.1 if period else 0.0})


def by_metrics(y: Array, period: float | None, band: float) -> float:
    found = step_metrics(T, y, SIZE, 0.0, band=band, band_centre=BandCentre.REFERENCE, dither_period=period)
    return found["SettlingTime"]


def continued(y: Array, period: float | None) -> ContinuedResponse:
    return ContinuedResponse(LOOP, STEP, period, T, y, np.zeros_like(T), contact="")


def by_certificate(y: Array, period: float | None, band: float) -> float:
    """The figure that it shows, of a response that it calls settled."""
    ending = Ending(continued(y, period), band_share(band, STEP), "a")
    known = {"SettlingTime": by_metrics(y, period, band), "Overshoot": 1e3} if np.isfinite(y).all() else {}
    return correct_metrics(ending, known)["SettlingTime"] if known and ending.is_settled else ending.settling_time


def by_rig(y: Array, period: float | None, band: float) -> float:
    """As `evaluate` reads a rig's truth."""
    run = Trajectory(T, {LOOP.feedback.name: y, "control": np.zeros_like(T)})
    return measure(LOOP, parameters(period), STEP, run, band)["SettlingTime"]


def by_verdict(y: Array, period: float | None, band: float) -> float:
    """With a response that is continued already."""
    run = Trajectory(T, {LOOP.feedback.name: y, "control": np.zeros_like(T)})
    metrics = measure(LOOP, parameters(period), STEP, run, band)
    found = CaseEvaluation(LOOP, TuningCase(STEP), parameters(period), metrics, run)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dithered_ending, "continue_response", lambda *_: continued(y, period))
        return dithered_ending.read_ending(found, band).metrics["SettlingTime"]


def by_search(y: Array, period: float | None, band: float) -> float:
    grid = ReferenceGrid(STEP, T, np.full((len(T), 1), SIZE), float(T[1]))
    whole = np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * np.diff(T))])
    outputs = np.stack([y, np.zeros_like(T), whole], axis=-1)[None]
    if not is_sound(outputs, np.zeros((1, 1)))[0]:
        return inf
    found = read_metrics(grid, outputs, (band,), period, ("SettlingTime",), ())
    return float(found["SettlingTime"][0])


READERS: Mapping[str, Callable[[Array, float | None, float], float]] = {
    "metrics": by_metrics,
    "certificate": by_certificate,
    "verdict": by_verdict,
    "rig": by_rig,
    "search": by_search,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", RECORDS)
def test_every_reader_says_since_when_it_is_in_the_band(name: str, reader: str) -> None:
    shares, period, expected = RECORDS[name]
    try:
        found = READERS[reader](SIZE * shares, period, BAND)
    except InputError:
        assert not np.isfinite(shares).all(), "only what is no number is refused"
        return
    assert (inf if isnan(found) else found) == pytest.approx(expected, abs=3e-3)


@functools.cache
def page_answers() -> dict[str, float]:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node runs the script")
    runs = [[LOOP.parameter_vector(parameters(p)).tolist(), (SIZE * s).tolist()] for s, p, _ in RECORDS.values()]
    outputs = len(LOOP.outputs)
    script = live_script(LOOP, [STEP], LOOP.complete(parameters(None)), band=BAND)
    script += f"const t = {T.tolist()}; const still = t.map(() => 0);\n"
    script += (
        f"const told = {to_script(runs)}.map(([p, y]) => readMetrics({{t, outputs: Array.from({{length: {outputs}}}"
    )
    script += ", (_, k) => (k === DATA.measured ? y : still))}, p, DATA.references[0]).SettlingTime);"
    script += "console.log(JSON.stringify(told));"
    done = subprocess.run([node, "-"], input=script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {n: inf if v is None else v for n, v in zip(RECORDS, json.loads(done.stdout), strict=True)}


@pytest.mark.parametrize("name", RECORDS)
def test_the_page_says_the_same(name: str) -> None:
    """The page cannot share the code: the rule's numbers come with its data, the answers are compared here."""
    shares, period, expected = RECORDS[name]
    assert page_answers()[name] == pytest.approx(expected, abs=3e-3)
    if np.isfinite(expected) and period is None:
        assert page_answers()[name] == pytest.approx(by_metrics(SIZE * shares, period, BAND), rel=1e-9)


@pytest.mark.parametrize("band", [0.0, 1.0, -0.02])
def test_a_band_without_width_is_refused_by_all(band: float) -> None:
    for read in READERS.values():
        with pytest.raises(InputError, match="a fraction between 0 and 1"):
            read(SIZE * ARRIVES, None, band)
    with pytest.raises(InputError, match="a fraction between 0 and 1"):
        live_script(LOOP, [STEP], LOOP.complete(parameters(None)), band=band)


def test_a_gradient_search_enters_the_band_where_metrics_say() -> None:
    """Of |error| at its nodes, the last segment that enters; the edge is inside."""
    for name in ("settles", "leaves for a moment", "ends on the edge"):
        shares, _, expected = RECORDS[name]
        size = np.abs((SIZE * shares - SIZE) / SIZE)[None]
        entries = _band_entry_times(T, size, BAND)
        last = np.flatnonzero(size[0] > BAND * (1 + 1e-6))[-1]
        assert entries[last + 1] == pytest.approx(expected, abs=3e-3), name


HUNTING = RECORDS["hunts"][0]


@pytest.mark.parametrize(
    ("shares", "defect"),
    [
        (ARRIVES, None),
        (HUNTING, Defect.HUNTS),
        (RECORDS["swings inside the band"][0], None),
        (RECORDS["ends outside"][0], Defect.MISSES_REFERENCE),
        (1 - np.exp(-T / 5.0), Defect.CREEPS),
    ],
    ids=["settles", "hunts", "swings inside the band", "ends outside", "creeps"],
)
def test_certificate_and_verdict_say_how_it_ends_alike(shares: Array, defect: Defect | None, monkeypatch: Any) -> None:
    """A swing inside the band is no hunting: the verdict called it that, and judged such a loop by other criteria."""
    y = SIZE * shares
    run = Trajectory(T, {LOOP.feedback.name: y, "control": np.zeros_like(T)})
    metrics = measure(LOOP, parameters(None), STEP, run, BAND)
    found = CaseEvaluation(LOOP, TuningCase(STEP), parameters(None), metrics, run)
    for module in ("dithered_ending", "certificate"):
        monkeypatch.setattr(f"pneuopt.evaluation.{module}.continue_response", lambda *_: continued(y, None))
    (proof, verdict) = judge_evaluations([found], BAND), dithered_ending.read_ending(found, BAND)
    assert [f.defect for f in proof.findings] == ([] if defect is None else [defect])
    assert verdict.ending.defect is defect
    assert verdict.ending.hunts == (defect is Defect.HUNTS)
