"""The files of an excitation run say the run that was planned."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pneuopt.evaluation.moves import ExcitationRun, excitation_run
from pneuopt.files.first_files import PLAYED_FILE, RUN_FILE, run_files
from pneuopt.files.tuning import read_path, read_tuning
from pneuopt.models.catalog import s25


@cache
def planned() -> ExcitationRun:
    drive, known = s25()
    return excitation_run(drive.system(), drive.parameters | known, between=(0.05, 0.15), speed=0.3)


@pytest.mark.parametrize("centre", [0.0, 5.0])
def test_the_run_reads_back_as_planned(tmp_path: Path, centre: float) -> None:
    run = planned()
    run = replace(run, centre=centre)
    for name, text in run_files(run).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    drive, known = s25()
    given = (drive.parameters | known).with_values({"valve.centre": centre})
    task = read_tuning(tmp_path / RUN_FILE, drive.system(), given)
    t = run.response.t
    np.testing.assert_allclose(task.references[0].values(t), run.moves.values(t), atol=1e-9)
    assert task.loop.feedback.name == "position"
    for name in ("pid.Kp", "pid.lower", "pid.upper"):
        assert task.parameters.value(name) == pytest.approx(run.parameters.value(name)), name


def test_the_played_reference_is_that_of_the_moves(tmp_path: Path) -> None:
    run = planned()
    played = tmp_path / PLAYED_FILE
    played.write_text(run_files(run)[PLAYED_FILE], encoding="utf-8")
    path = read_path(played)
    np.testing.assert_allclose(path.values(run.response.t), run.moves.values(run.response.t), atol=1e-6)


def test_the_file_says_what_the_run_is_for_how_long_it_takes_and_what_to_log() -> None:
    run = planned()
    head = " ".join(line.lstrip("# ") for line in run_files(run)[RUN_FILE].splitlines() if line.startswith("#"))
    assert f"An excitation run of {run.duration:.3g} s" in head
    assert "friction (static, Coulomb, Stribeck, viscous)" in head
    assert "Log valve_voltage, position, pressure_a, pressure_b at the controller's samples" in head
