"""The rivals of the paper's dither: their loops and the search's merit; the slow part tunes and judges them."""

from pathlib import Path

import numpy as np
import pytest

import pneuopt as po
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from problems.paper import paper_rivals


def test_each_rival_alone_is_in_its_loop() -> None:
    for name, rival in paper_rivals.RIVALS.items():
        loop = rival.loop
        assert len(loop.compensators) + (loop.dither is not None) == (name != "pid")
        assert set(rival.free) <= set(loop.parameters)


def test_a_limit_that_is_broken_costs_ten_times_its_share() -> None:
    loop = paper_rivals.RIVALS["pid"].loop
    given = paper_rivals.free_parameters("pid", loop)
    space, spec = search_space(loop, given), paper_rivals.specification("step", dithered=True)
    step = po.Step(0.05, horizon=0.2)
    simulator = Simulator(loop, [step], space, spec=spec)
    points = np.array([[16.0, 70.0, 0.5, 0.0125], [16.0, 70.0, 0.5, 0.005]])  # 56 and 116 V s/m
    found = paper_rivals.merits(simulator, space, spec, np.array([space.to_unit(point) for point in points]))
    values = simulator.values(points, spec)
    over = np.maximum(values["Overshoot"] / 0.1 - 1, 0) + np.maximum(values["Ripple"] / 0.01 - 1, 0)
    np.testing.assert_allclose(found, values["IAE"] * (1 + 10 * (over + np.array([0.0, 0.16]))), rtol=1e-9)
    assert not spec.concerns(SettlingTime)


@pytest.mark.slow
def test_paper_rivals(tmp_path: Path) -> None:
    designs = paper_rivals.run()
    rows = paper_rivals.main(designs, 0.0)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    assert set(paper_rivals.BOUNDS) <= set(rows["name"])
    paper_rivals.figure(designs).savefig(tmp_path / "rivals.png")
    assert (tmp_path / "rivals.png").stat().st_size > 10_000
