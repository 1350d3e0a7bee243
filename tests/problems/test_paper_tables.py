"""The paper's figures: those that hold, and what the loop as printed gives instead."""

import matplotlib as mpl
import numpy as np
import pytest

from problems.paper import paper_tables
from problems.shared.claims import Claim
from problems.shared.paper_loop import PID_1, PID_2, PLAIN


@pytest.fixture(scope="module")
def rows() -> dict[str, Claim]:
    parts = ("_bode", "_table1", "_table2", "_printed", "_dither")
    return {claim.name: claim for part in parts for claim in getattr(paper_tables, part)()}


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
        ("table2.1.settling_0.5", 0.428, 5e-4),
        ("table2.1.settling_0.2", 0.4724, 5e-4),
        ("table2.2.overshoot", 0.0793, 5e-4),
        ("table2.2.settling_0.5", 0.7945, 5e-4),
        ("table2.2.settling_0.2", 0.828, 5e-4),
        ("table2.2.settling_0.1", 1.2149, 5e-4),
        ("table2.1.max_sensitivity", 1.0643, 1e-4),
        ("printed.table1.1.band", 0.1146, 1e-4),
        ("printed.table1.2.band", 0.1146, 1e-4),
        ("printed.table2.1.band", 0.0615, 1e-4),
        ("printed.table2.2.band", 0.3187, 5e-4),
        ("printed.table1.none.band", 0.0992, 1e-4),
        ("printed.table1.none.settling_narrower", 0.7903, 5e-4),
        ("printed.table1.none.settling_wider", 0.7352, 5e-4),
        ("dither.steady_change", 1.27e-6, 1e-8),
    ],
)
def test_golden(rows: dict[str, Claim], name: str, value: float, accuracy: float) -> None:
    assert rows[name].value == pytest.approx(value, abs=accuracy)


def test_the_chatter_itself_changes_nothing(rows: dict[str, Claim]) -> None:
    for name in ("overshoot", "error"):
        assert rows[f"table1.1.full_gain.{name}"].value == pytest.approx(rows[f"table1.none.{name}"].value, abs=0.003)


def test_every_row_of_table_2_has_its_own_gains() -> None:
    first, second = (case.pid for case in (PID_1, PID_2))
    assert (first.Kp, first.Ki, first.Kd) == (0.225, 1.23, 0.01)
    assert (second.Kp, second.Ki, second.Kd) == (0.235, 1.64, 0.0)


@pytest.mark.parametrize("name", paper_tables.PRINTED)
def test_the_band_of_a_printed_settling_time_by_scipy(name: str) -> None:
    """Its largest deviation after the printed instant is the band, by a simulation that shares nothing with ours."""
    case, printed = paper_tables.PRINTED[name]
    t, y = paper_tables._run(case).t, paper_tables._by_scipy(case)
    late = np.abs(y[t >= printed] / paper_tables._final(case) - 1).max()
    assert paper_tables._printed_band(case, printed) == pytest.approx(late, rel=5e-3)


@pytest.mark.slow
def test_the_whole_script_and_its_figures() -> None:
    mpl.use("Agg")
    frame = paper_tables.main().set_index("name")
    assert frame["holds"].all()
    assert frame.loc["gain_from_table1.factor", "value"] == pytest.approx(0.5, abs=0.005)
    assert set(paper_tables.figures()) == {"paper_tables_steps", "paper_tables_bode", "paper_tables_loop"}


def test_scipy_agrees_on_the_plain_step() -> None:
    deviation = paper_tables._run(PLAIN)["speed"] - paper_tables._by_scipy(PLAIN)
    assert np.abs(deviation).max() < 1e-7
