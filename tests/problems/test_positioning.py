"""From log to certificate: what the rows make of a rig that is late, far off or hunts; and the whole job."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.demo import positioning
from problems.demo.positioning import RANGES, STANDING, TRUTH, Job, Played


def played(settled: float, shift: float = 0.0) -> Played:
    """Moves of which the last one settles then, all `shift` [m] beside the ramp to their ends."""
    figures = {"OvershootDistance": 1e-4, "FollowingError": 3e-3, "MaxSensitivity": 1.8}
    metrics = pd.DataFrame({str(k): {"SettlingTime": 0.3, **figures} for k in range(len(positioning.MOVES))})
    metrics.loc["SettlingTime", metrics.columns[-1]] = settled
    t = np.linspace(0.0, 0.5, 11)
    run = [po.Trajectory(t, {"position": m.initial + m.distance * t / 0.5 + shift}) for m in positioning.MOVES]
    return Played(metrics, run)


def job(achieved: Played) -> Job:
    """A job whose estimates are true, and whose rig comes to rest within .1 mm."""
    truth = {n: value for n, (value, _) in TRUTH.items()}
    fit = SimpleNamespace(parameters=po.ParameterSet({n: po.Parameter(value, "1") for n, value in truth.items()}))
    given = po.ParameterSet({n: po.Parameter(1.0, "1") for n in RANGES})
    best = SimpleNamespace(status=SimpleNamespace(converged=True), parameters=given)
    rest = po.RestCase("a move", po.RestKind.RESTS, 1e-4, 0.0, np.nan, 0, 0.4, 0.0, "it rests")
    plants = {"before": played(np.nan), "predicted": played(0.35), "achieved": achieved}
    fitted, tuned = cast(po.IdentificationResult, fit), cast(po.TuningResult, best)
    return Job(fitted, truth, tuned, plants, [rest] * len(STANDING), {"tune": 1.0})


def failed(found: Job) -> list[str]:
    rows = positioning.main(found)
    return [str(n) for n in rows.loc[~rows["holds"].astype(bool), "name"]]


def test_a_rig_that_does_what_was_predicted_keeps_every_claim() -> None:
    assert failed(job(played(0.34, 1e-4))) == []
    rows = positioning.main(job(played(0.34, 1e-4))).set_index("name")
    assert rows["value"]["achieved.apart"] == pytest.approx(0.1)
    assert (rows["value"]["achieved.settling_time"], rows["reference"]["achieved.settling_time"]) == (0.34, 0.35)


@pytest.mark.parametrize("settled", [0.36, np.nan])
def test_a_rig_that_settles_late_or_never_breaks_its_claim(settled: float) -> None:
    assert failed(job(played(settled))) == ["achieved.settling_time"]


def test_a_motion_beside_the_predicted_one_and_hunting_beyond_the_tolerance_break_theirs() -> None:
    found = job(played(0.34, -6e-4))
    hunts = replace(found.rests[0], kind=po.RestKind.HUNTS, error=-2e-3, slips=9, amplitude=1e-3)
    assert failed(replace(found, rests=[hunts, *found.rests[1:]])) == [
        "achieved.apart",
        "achieved.error",
    ]


@pytest.mark.slow
def test_positioning(tmp_path: Path) -> None:
    found = positioning.run()
    assert failed(found) == []
    positioning.figure(found).savefig(tmp_path / "moves.png")
    assert (tmp_path / "moves.png").stat().st_size > 10_000
