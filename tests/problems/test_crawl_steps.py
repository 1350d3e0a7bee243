"""Crawl steps are tuned and certified: the script's drives, and the example rig of data/force_rig from the shell."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import pneuopt as po
from pneuopt.cli.app import app
from problems.tune import crawl_steps

FORCE_RIG = Path(__file__).parents[2] / "data" / "force_rig"


def test_the_drives_run_away_without_feedback_at_their_crawl_steps() -> None:
    """Up to the Stribeck velocity their linear plants have a pole right of zero."""
    for name, drive in crawl_steps.DRIVES.items():
        loop, given = crawl_steps.controlled(name, "stribeck")
        for ratio in (0.3, 0.7, 1.0):
            rest = loop.plant.rest_hook(given, {"speed": ratio * drive.stribeck})  # type: ignore[misc]
            x = np.array([rest.states.get(q.name, 0.0) for q in loop.plant.states])
            A = loop.plant.linearise(x, rest.inputs, given).A
            assert np.linalg.eigvals(A).real.max() > 1.0, (name, ratio)


def test_a_force_drive_is_tuned_in_the_falling_part() -> None:
    rows = crawl_steps.main({("force", law, 0.7): crawl_steps.tuned("force", law, 0.7) for law in crawl_steps.LAWS})
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    assert rows.set_index("name")["value"]["karnopp.count"] == 1


@pytest.mark.slow
def test_every_drive_at_every_speed() -> None:
    rows = crawl_steps.main(crawl_steps.run())
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []


@pytest.mark.slow
def test_the_example_rig_is_tuned_for_a_crawl_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(FORCE_RIG, tmp_path / "rig")
    monkeypatch.chdir(tmp_path / "rig")
    text = Path("tuning.toml").read_text("utf-8")
    before, _, after = text.partition('step = "0.05 m/s"\nhorizon = "0.6 s"\n')
    rest = after.partition("[minimise]")
    Path("tuning.toml").write_text(f'{before}step = "0.02 m/s"\nhorizon = "0.6 s"\n\n[minimise]{rest[2]}', "utf-8")
    for line in ("identify drive.toml run_01.csv run_02.csv -o fit.toml", "tune fit.toml tuning.toml -o tuned.toml"):
        assert CliRunner().invoke(app, line.split(), catch_exceptions=False).exit_code == 0
    drive, p = po.read_drive("fit.toml")
    tuning = po.read_tuning("tuned.toml", drive.system())
    found = po.certificate(tuning.loop, tuning.references, p | tuning.parameters)
    assert found.findings == ()
    assert found.metrics.loc["Overshoot"].max() <= 2.0
