"""Random tuning problems: they are what their seed says, feasible, and judged as the docstring says."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.shared import random_problems
from problems.shared.rows import rows_by_seed
from problems.tune import random_tuning

ROW = {"kind": "s32", "redrawn": 0, "known": 0.2, "sample_time": 0.0, "claimed": 0.1, "certified": 0.1, "cpu": 1.0}


def rows(*outcomes: tuple[str, float]) -> pd.DataFrame:
    found = [ROW | {"seed": k, "outcome": o, "deviation": d, "repaired": k == 0} for k, (o, d) in enumerate(outcomes)]
    return pd.DataFrame(found)


def test_a_claim_that_is_off_fails_and_so_do_too_few_solved() -> None:
    good, off, lost = ("solved", 1e-5), ("solved", 2e-3), ("rejected", 0.5)
    claims = random_tuning.main(rows(*9 * [good], lost)).set_index("name")
    assert claims.loc["solved", "value"] == 90
    assert claims.loc[["solved", "deviation.worst"], "holds"].all()
    assert claims.loc[["rejected", "solved.repaired"], "value"].tolist() == [1, 1]
    claims = random_tuning.main(rows(*8 * [good], off, lost, lost)).set_index("name")
    assert not claims.loc[["solved", "deviation.worst"], "holds"].any()


@pytest.mark.parametrize("seed", [0, 2])
def test_a_problem_is_its_seeds_and_its_limits_leave_the_margin(seed: int) -> None:
    first, again = random_problems.problem(seed), random_problems.problem(seed)
    assert first.known == again.known
    assert first.steps == again.steps
    limits = {type(q).__name__: q for q in first.subject_to}
    settling = limits["SettlingTime"]
    assert isinstance(settling, po.SettlingTime)
    assert settling.max == pytest.approx(1.1 * first.known["SettlingTime"])
    assert set(limits) == set(first.known)


@pytest.mark.slow
def test_one_is_solved_and_drawn(tmp_path: Path) -> None:
    found = rows_by_seed(random_tuning.tuned, [2], 1, tmp_path / "rows.csv")
    assert found["outcome"].tolist() == ["solved"]
    assert found["certified"].item() <= 1.1 * found["known"].item()
    assert found["deviation"].item() <= 1e-3
    kept = rows_by_seed(random_tuning.tuned, [2], 1, tmp_path / "rows.csv")
    assert np.allclose(kept["certified"], found["certified"])
    random_tuning.figure(found).savefig(tmp_path / "picture.png")
