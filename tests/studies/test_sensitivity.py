"""`sensitivity`: Sobol's indices against functions whose indices are known in closed form.

Derivatives of a design's figures: those of central differences of the certificate, and of formulas.

Cells of a study that break with their neighbours.
"""

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import pneuopt as po
from pneuopt.evaluation.scenarios import Normal
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.executors import CaseFunction
from pneuopt.studies.sensitivity import Sensitivity, search_again, sensitivity, sweep_from_neighbours
from pneuopt.studies.sweep import grid, sweep
from problems.shared.t32 import SPREADS, STEP, benchmark
from problems.speed.batched_monte_carlo import GAINS

CUBE = ParameterSet(dict.fromkeys("abc", Parameter(0.0, "1")))
BOX = dict.fromkeys(CUBE, (-math.pi, math.pi))


def told(fn: CaseFunction, spreads: Any = BOX, **options: Any) -> Sensitivity:
    with ThreadPoolExecutor(1) as executor:
        return sensitivity(fn, CUBE, spreads, executor=executor, **options)


def ishigami(p: ParameterSet) -> float:
    """Ishigami and Homma's function (Proc. ISUMA 1990), of which the third axis acts by way of the first alone."""
    a, b, c = (p.value(n) for n in "abc")
    return math.sin(a) + 7 * math.sin(b) ** 2 + 0.1 * c**4 * math.sin(a)


def test_the_indices_are_those_of_a_function_that_is_known() -> None:
    """Variances by the integrals over the cube."""
    found = told(ishigami, count=2048)
    pi4, pi8 = math.pi**4, math.pi**8
    first = np.array([0.5 * (1 + 0.1 * pi4 / 5) ** 2, 7**2 / 8, 0.0])
    mixed = 0.1**2 * pi8 * (1 / 18 - 1 / 50)
    whole = first.sum() + mixed
    total = first + np.array([mixed, 0.0, mixed])
    assert found.table["first"].to_numpy() == pytest.approx(first / whole, abs=0.03)
    assert found.table["total"].to_numpy() == pytest.approx(total / whole, abs=0.03)
    assert (found.table["total_low"] <= found.table["total"]).all()
    assert found.figures["std"].to_numpy() == pytest.approx([math.sqrt(whole)], rel=0.05)
    lines = found.summary().to_text(80).splitlines()
    assert [line.split()[0] for line in lines if line[:2] in ("a ", "b ", "c ")] == ["a", "b", "c"]
    assert max(map(len, lines)) <= 80


def test_axes_that_vary_together_and_distributions_share_the_variance() -> None:
    """Normal axes of a sum: the variances add."""
    given = {"a": Normal((0.0, 2.0)), ("b", "c"): Normal((0.0, 1.0))}
    found = told(lambda p: p.value("a") + p.value("b"), given, count=512)
    assert found.table.loc["value"].index.tolist() == ["a", "b + c"]
    assert found.table["first"].to_numpy() == pytest.approx([0.8, 0.2], abs=0.03)


def test_points_without_a_figure_are_left_out_and_many_of_them_leave_no_index() -> None:
    def sometimes(p: ParameterSet) -> dict[str, float]:
        a = p.value("a")
        return {"few": math.nan if a > 3.1 else a, "many": math.nan if a > 0 else a, "none": 2.0}

    found = told(sometimes, count=128)
    assert found.table["total"]["few"].to_numpy() == pytest.approx([1, 0, 0], abs=0.15)
    assert 0 < found.figures["lost"]["few"] < 0.1
    assert found.table["total"]["many"].isna().all()
    assert (found.table["total"]["none"] == 0).all()
    assert "% of the points have none" in repr(found)
    assert list(told(sometimes, count=16, figures=["few"]).figures.index) == ["few"]


def test_the_points_are_those_of_the_seed_in_any_executor() -> None:
    once, twice, other = (told(ishigami, count=16, seed=s).cases["value"].tolist() for s in (1, 1, 2))
    assert once == twice
    assert told(ishigami, count=16).table.equals(told(ishigami, count=16).table)
    assert once != other


METRICS = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl")


def central_difference(
    loop: po.ClosedLoop, step: po.Step, design: po.ParameterSet, steps: Mapping[str, float], side: float
) -> dict[str, float]:
    """By metric its change along some parameters, from two evaluations."""
    ends = [
        po.evaluate(loop, step, design.with_values({n: design.value(n) + sign * side * s for n, s in steps.items()}))
        for sign in (1, -1)
    ]
    high, low = (end.iloc[:, 0].to_dict() for end in ends)
    return {n: (high[n] - low[n]) / (2 * side) for n in METRICS}


@pytest.mark.parametrize("amplitude", [0.0, 0.6155])
def test_changes_are_those_of_the_certificate(amplitude: float) -> None:
    loop, given = benchmark()
    design = given.with_values(GAINS | {"dither.amplitude": amplitude})
    found = po.local_sensitivity(loop, STEP, design, SPREADS, metrics=METRICS)
    changes, scales = found.table["change"].to_dict(), found.figures["std"].to_dict()
    for axis, half in SPREADS.items():
        names = (axis,) if isinstance(axis, str) else axis
        deviations = {n: half * design.value(n) / np.sqrt(3.0) for n in names}
        exact = central_difference(loop, STEP, design, deviations, 1e-2)
        for metric in METRICS:
            change = changes[metric, " + ".join(names)]
            assert change == pytest.approx(exact[metric], abs=0.03 * scales[metric]), (metric, names)


def test_a_steady_error_and_its_shares_are_those_of_the_formula() -> None:
    loop = po.ClosedLoop(po.FirstOrder().system(), po.PID())
    design = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 0.0, "plant.gain": 2.0, "plant.time_constant": 0.1})
    spreads = {"plant.gain": 0.1, "plant.time_constant": 0.1}
    found = po.local_sensitivity(loop, po.Step(1.0, horizon=4.0), design, spreads, metrics=["SteadyStateError"])
    error, deviation = 100 / 9, 0.2 / np.sqrt(3.0)  # 1 / (1 + 4 K) in percent
    row = found.table.to_dict("index")["SteadyStateError", "plant.gain"]
    assert row["change"] == pytest.approx(-400 / 81 * deviation, rel=1e-3)
    assert row["relative"] == pytest.approx(row["change"] / error, rel=1e-6)
    assert row["share"] == pytest.approx(1.0, abs=1e-6)
    assert "plant.gain" in found.summary().to_text()


GIVEN = ParameterSet({"a": Parameter(0.0, "1"), "b": Parameter(0.0, "1"), "gain": Parameter(0.0, "1", 0.0, 9.0)})
PLACES = grid(GIVEN, {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]})
STARTS = {"found": "gain"}


def search(p: ParameterSet) -> dict[str, float]:
    """A local search that ends far away in the middle cell, and fails in a corner, unless it starts near by."""
    a, b, start = (p.value(n) for n in ("a", "b", "gain"))
    if (a, b) == (2.0, 2.0) and start == 0:
        raise ConvergenceError("nothing settles")
    lost = (a, b) == (1.0, 1.0) and start == 0
    return {"found": 1.0 if lost else 5.0 + a, "settling": 4.0 if lost else 1.0 + 0.1 * b}


def test_they_are_computed_again_from_the_best_neighbour_and_flagged() -> None:
    with ThreadPoolExecutor(3) as pool:
        first = sweep(search, GIVEN, PLACES, executor=pool)
        table = search_again(search, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS, executor=pool)
        again = search_again(search, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS, executor=pool)
    assert first["settling"].max() == 4.0
    assert table["again"].tolist() == [False] * 4 + [True] + [False] * 3 + [True]
    assert not table["breaks"].any()
    np.testing.assert_allclose(table["settling"], 1.0 + 0.1 * table["b"])
    assert (table["error"] == "").all()
    assert table["found"].iloc[4] == 6.0
    assert list(table)[:-2] == list(first)
    assert again.drop(columns="seconds").equals(table.drop(columns="seconds"))


def test_a_cell_that_stays_bad_is_flagged() -> None:
    def stubborn(p: ParameterSet) -> dict[str, float]:
        return {"found": 1.0, "settling": 9.0 if p.value("a") == p.value("b") == 1.0 else 1.0}

    with ThreadPoolExecutor(3) as pool:
        first = sweep(stubborn, GIVEN, PLACES, executor=pool)
        table = search_again(stubborn, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS, executor=pool)
    assert table["breaks"].tolist() == [k == 4 for k in range(9)]
    assert table["settling"].iloc[4] == 9.0


def test_smooth_studies_are_left_alone_and_missing_columns_are_named() -> None:
    def calm(p: ParameterSet) -> dict[str, float]:
        return {"found": 1.0, "settling": 2.0 ** p.value("a")}

    with ThreadPoolExecutor(3) as pool:
        first = sweep(calm, GIVEN, PLACES, executor=pool)
    table = search_again(calm, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS)  # no process is started
    assert not table[["again", "breaks"]].to_numpy().any()
    with pytest.raises(InputError, match="Ts"):
        search_again(calm, GIVEN, first, axes=["a", "b"], value="Ts", starts=STARTS)


def nearsighted(p: ParameterSet) -> dict[str, float]:
    """A search that gets from its start no further than 1, towards 3 + a + b."""
    start, best = p.value("gain"), 3.0 + p.value("a") + p.value("b")
    found = min(best, start + 1.0)
    return {"found": found, "settling": 1.0 + best - found}


def test_each_cell_starts_from_its_best_neighbour_nearest_to_the_given_parameters_first() -> None:
    given = GIVEN.with_values({"a": 1.0, "b": 2.0, "gain": 5.5})
    axes = {"b": [0.0, 1.0, 2.0], "a": [2.0, 1.0, 0.0]}
    with ThreadPoolExecutor(3) as pool:
        table = sweep_from_neighbours(nearsighted, given, axes, value="settling", starts=STARTS, executor=pool)
        alone = sweep(nearsighted, given, grid(given, axes), executor=pool)
    np.testing.assert_allclose(table["settling"], 1.0)
    assert alone["settling"].max() == 1.5  # from the given start the farthest cell is out of reach
    assert list(table) == ["case", "b", "a", "found", "settling", "seconds", "error", "again", "breaks"]
    assert table["case"].tolist() == list(grid(given, axes))
    assert not table["breaks"].any()


def test_cells_that_fail_are_searched_again_from_a_neighbour_and_flagged_if_they_fail_again() -> None:
    with ThreadPoolExecutor(3) as pool:
        kinds = {"axes": {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]}, "value": "settling", "starts": STARTS}
        table = sweep_from_neighbours(search, GIVEN, executor=pool, **kinds)  # type: ignore[arg-type]
        dead = sweep_from_neighbours(fails, GIVEN, executor=pool, **kinds)  # type: ignore[arg-type]
    assert not table["breaks"].any()  # the corner and the middle start from a neighbour's 5, not from 0
    np.testing.assert_allclose(table["settling"], 1.0 + 0.1 * table["b"])
    assert dead["breaks"].all()
    assert dead[["found", "settling"]].isna().all().all()


def fails(p: ParameterSet) -> dict[str, float]:
    raise ConvergenceError(f"nothing settles at {p.value('a'):g}")
