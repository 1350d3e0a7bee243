"""The paper's figures: those that hold, and what the loop as printed gives instead."""

import matplotlib as mpl
import numpy as np
import pytest

from problems.paper import paper_tables
from problems.shared.claims import Claim
from problems.shared.paper_loop import PLAIN


@pytest.fixture(scope="module")
def rows() -> dict[str, Claim]:
    parts = (paper_tables._bode, paper_tables._table1, paper_tables._table2, paper_tables._dither)
    return {claim.name: claim for part in parts for claim in part()}


def test_every_claim_holds(rows: dict[str, Claim]) -> None:
    assert [claim for claim in rows.values() if not claim.holds] == []


@pytest.mark.parametrize(
    ("name", "value", "accuracy"),
    [
        ("bode.phase_margin", 28.54, 0.005),
        ("bode.gain_crossover", 34.67, 0.005),
        ("table1.none.overshoot", 37.06, 0.005),
        ("table1.none.error", 6.3651, 1e-4),
        ("table1.none.settling_2", 0.4494, 1e-4),
        ("table1.none.settling_0.1", 0.7350, 1e-4),
        ("table1.1.overshoot", 17.85, 0.005),
        ("table1.1.error", 11.97, 0.005),
        ("table1.1.settling_2", 0.4148, 1e-4),
        ("table1.2.overshoot", 0.17, 0.005),
        ("table1.2.error", 25.173, 0.001),
        ("table1.2.full_gain.overshoot", 16.50, 0.005),
        ("table1.2.full_gain.error", 20.41, 0.005),
        ("table2.1.settling_2", 0.348, 5e-4),
        ("table2.1.settling_0.1", 0.503, 5e-4),
        ("table2.1.full_gain.overshoot", 1.31, 0.005),
        ("table2.1.full_gain.settling_2", 0.1575, 1e-4),
        ("table2.max_sensitivity", 1.0643, 1e-4),
        ("dither.steady_change", 1.27e-6, 1e-8),
    ],
)
def test_golden(rows: dict[str, Claim], name: str, value: float, accuracy: float) -> None:
    assert rows[name].value == pytest.approx(value, abs=accuracy)


def test_the_chatter_itself_changes_nothing(rows: dict[str, Claim]) -> None:
    for name in ("overshoot", "error"):
        assert rows[f"table1.1.full_gain.{name}"].value == pytest.approx(rows[f"table1.none.{name}"].value, abs=0.003)


@pytest.mark.slow
def test_the_whole_script_and_its_figures() -> None:
    mpl.use("Agg")
    frame = paper_tables.main().set_index("name")
    assert frame["holds"].all()
    assert frame.loc["gain_from_table1.factor", "value"] == pytest.approx(0.5, abs=0.005)
    assert set(paper_tables.figures()) == {"paper_steps", "paper_bode"}


def test_scipy_agrees_on_the_plain_step() -> None:
    deviation = paper_tables._run(PLAIN)["speed"] - paper_tables._by_scipy(PLAIN)
    assert np.abs(deviation).max() < 1e-7
