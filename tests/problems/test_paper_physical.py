"""The paper's drive: every equation has its row, and each holds; the slow part simulates."""

import re

import numpy as np
import pytest

import pneuopt as po
from pneuopt.models.friction import Viscous
from problems.paper import paper_dither, paper_physical, paper_stroke
from problems.shared.claims import Claim
from problems.shared.r25 import averaged, lagging, linearised

CHAIN = ("_orifices", "_coefficients", "_balances", "_linear_chambers", "_one_pressure", "_equation_15", "_equation_16")


@pytest.fixture(scope="module")
def chain() -> dict[str, Claim]:
    found = (claim for part in (*CHAIN, "_alternatives") for claim in getattr(paper_physical, part)())
    return {claim.name: claim for claim in found}


def test_the_chain_holds(chain: dict[str, Claim]) -> None:
    assert [claim for claim in chain.values() if not claim.holds] == []


def test_every_equation_has_a_row(chain: dict[str, Claim]) -> None:
    numbers = {int(n) for name in chain if name.startswith("eq") for n in re.findall(r"\d+", name.split(".")[0])}
    assert numbers == set(range(1, 17))


def test_what_a_volt_moves_holds() -> None:
    assert [claim for claim in paper_dither._table() if not claim.holds] == []


def test_mid_stroke_is_slowest_and_for_the_papers_loop_best() -> None:
    assert [paper_stroke.frequency(k) for k in (0.1, 0.5)] == pytest.approx([11.15, 9.292], abs=5e-3)
    assert [paper_stroke.phase_margin(k) for k in (0.1, 0.5)] == pytest.approx([25.35, 28.54], abs=0.01)


def test_the_stiffness_of_two_isentropic_air_springs_by_hand() -> None:
    """1.4 p A^2 (1/V_a + 1/V_b) over the mass, beside the linearised drive without leak and friction."""
    for place in (0.1, 0.5):
        drive, p = paper_stroke.at(place)
        area, dead = np.pi / 4 * p.value("cylinder.bore") ** 2, p.value("cylinder.dead_volume_a")
        volumes = dead + area * np.array([place, 1 - place]) * p.value("cylinder.stroke")
        by_hand = np.sqrt(1.4 * drive.rest(p).states["pressure_a"] * area**2 * np.sum(1 / volumes) / 12.0)
        A = linearised((drive, p)).A.copy()
        np.fill_diagonal(A, 0.0)
        assert np.abs(np.linalg.eigvals(A)).max() == pytest.approx(by_hand, rel=1e-6)


def test_a_lagging_spool_moves_less_above_its_bandwidth() -> None:
    slow = linearised(lagging(Viscous()))
    rigid = linearised(po.catalog.r25())
    at = {w: [paper_dither.moved(found, w, 12.0).force for found in (rigid, slow)] for w in (10.0, 1000.0)}
    assert at[10.0][1] == pytest.approx(at[10.0][0], rel=1e-2)
    assert at[1000.0][1] < 0.5 * at[1000.0][0]


def test_averaging_leaves_a_ramp_and_takes_whole_periods() -> None:
    t = np.linspace(0, 2, 2001)
    mean = averaged(t, 3 * t + np.sin(2 * np.pi * 10 * t), 0.1)
    inner = (t > 0.05) & (t < 1.95)
    assert mean[inner] == pytest.approx(3 * t[inner], abs=1e-4)


@pytest.mark.slow
def test_the_whole_script_and_its_figures() -> None:
    rows = paper_physical.main()
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    names = {f"paper_physical_{n}" for n in ("steps", "friction", "dither", "stroke")}
    assert set(paper_physical.figures()) == names
