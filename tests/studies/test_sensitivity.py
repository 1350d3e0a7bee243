"""`sensitivity`: Sobol's indices against functions whose indices are known in closed form."""

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from pneuopt.evaluation.distributions import Normal
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.outcome import CaseFunction
from pneuopt.studies.sensitivity import Sensitivity, sensitivity

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


def fails(_: ParameterSet) -> float:
    raise InputError("no plant")


@pytest.mark.parametrize(
    ("fn", "options", "said"),
    [
        (ishigami, {"count": 100}, "count = 100: give a power of two, 16 or more"),
        (ishigami, {"count": 16, "figures": ["speed"]}, "speed"),
        (fails, {"count": 16}, "no case of the study gave a figure: InputError: no plant"),
        (ishigami, {"count": 16, "spreads": {"d": 0.1}}, "'d'"),
    ],
)
def test_what_tells_nothing_is_refused(fn: CaseFunction, options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        told(fn, **options)
