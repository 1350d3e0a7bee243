"""The script of exported controllers: its rows hold what was measured, and one controller goes through."""

import shutil
from pathlib import Path

import pandas as pd
import pytest

from problems.demo.export_controllers import Job, compare_languages, files_of, main, run_c
from problems.shared.random_controllers import run_library

METRICS = pd.Series({"SettlingTime": 0.16, "Overshoot": 1.0, "MaxSensitivity": 1.2})


def job(difference: float = 1e-15, unclean: int = 0, factor: float = 2.0) -> Job:
    designs = {"tuned": METRICS, "as_it_runs": factor * METRICS, "tuned_for_it": METRICS}
    return Job({"c": difference}, unclean, {"pid": (34.0, 505.0)}, designs)


def test_the_rows_hold_what_is_claimed() -> None:
    assert main(job())["holds"].all()
    for broken, row in (
        (job(1e-9), "difference.c"),
        (job(unclean=1), "c.not_clean"),
        (job(factor=1.1), "price.as_it_runs"),
    ):
        rows = main(broken).set_index("name")
        assert not rows.loc[row, "holds"]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler on the path")
def test_a_controller_is_compared_and_a_wrong_one_found(tmp_path: Path) -> None:
    c, _, _ = files_of(run_library(3))
    difference, clean = run_c(c, tmp_path)
    assert clean
    assert difference <= 1e-12
    wrong = {
        **c,
        "pid_x.c": c["pid_x.c"]
        .replace("integral_term +", "integral_term -", 1)
        .replace("proportional_term +", "proportional_term -", 1),
    }
    assert wrong != c
    difference, clean = run_c(wrong, tmp_path)
    assert not clean
    assert difference > 1e-6


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler on the path")
def test_a_controller_of_many_inputs_goes_through_all_languages() -> None:
    """The fourth is given the reference's rates and both pressures besides."""
    assert run_library(4).inputs.shape[1] > 4
    worst, unclean = compare_languages([4])
    assert (max(worst.values()) <= 1e-12, unclean) == (True, 0)
