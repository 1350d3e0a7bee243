"""No two draws of plants share random numbers: kinds, axes, searches and validations, whatever seeds they are given."""

import ast
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import rankdata
from scipy.stats import t as student

import pneuopt
from pneuopt.evaluation.plants import expected_plants, monte_carlo
from pneuopt.evaluation.scenarios import Factor, Sampling, Seed, draws, further, generator, samples, tolerances
from pneuopt.files.tuning import read_scenarios, read_validation_scenarios
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet

COUNT = 100
FALSE_ALARM = 1e-3
"""Chance that draws which are independent fail the test, over all of its pairs (Bonferroni)."""
NAMES = ("load.mass", "load.inertia", "supply.pressure", "friction.coulomb", "friction.viscous", "plant.gain")
GAINS = ("pid.Kp", "pid.Ki", "pid.Kd")
RIG = ParameterSet(
    {n: Parameter(5.0, "1", 0.0, 1e3) for n in NAMES} | {n: Parameter(2.0, "1", 0.0, 1e3, free=True) for n in GAINS}
)
FITTED = ("friction.coulomb", "friction.viscous")
COVARIANCE = pd.DataFrame(np.diag([0.04, 0.09]), FITTED, FITTED)
RANGES = pd.DataFrame({"stderr": [np.nan] * 2, "bias": [1.0, 3.0]}, ["load.mass", "plant.gain"])
BOX = dict.fromkeys(NAMES, "30 %")
Plants = Mapping[str, Mapping[str, float | Factor]]


def in_files(kind: str, seed: int | None, sampling: Sampling | None = None) -> dict[str, object]:
    """A tuning's [scenarios.KIND]."""
    own: dict[str, object] = dict.fromkeys(GAINS, "1 %") if kind == "tolerances" else dict(BOX)
    if kind == "samples":
        own |= {"count": COUNT} | ({} if seed is None else {"seed": seed})
        own |= {} if sampling is None else {"sampling": sampling.value}
    return {kind: own}


def in_halves(kind: str, given: dict[str, object]) -> Iterator[tuple[str, Plants]]:
    """The plants that judge a design, and those by which it is chosen, from a file's boxes."""
    rows = list(read_validation_scenarios(given, "t", RIG).items())
    yield f"validation {kind}", dict(rows[:COUNT])
    yield f"vetting {kind}", dict(rows[COUNT:])


def drawn(seed: int | None) -> Iterator[tuple[str, Plants]]:
    """Every kind of draw with one seed for all, None for what each has by default."""
    own: dict[str, Seed] = {} if seed is None else {"seed": seed}
    spreads = dict.fromkeys(NAMES, 0.3)
    for way in Sampling:
        yield f"samples {way.value}", samples(RIG, spreads, COUNT, sampling=way, **own)
        yield f"monte carlo {way.value}", monte_carlo(RIG, COUNT, spreads=spreads, sampling=way, **own)  # type: ignore[arg-type]
        given = in_files("samples", seed, way)
        yield from in_halves(f"samples {way.value}", given)
    yield "tolerances", tolerances(RIG, dict.fromkeys(GAINS, 0.01), COUNT, **own)
    yield "draws", draws(RIG, COVARIANCE, COUNT, **own)  # type: ignore[arg-type]
    yield "fit", monte_carlo(RIG, COUNT, covariance=COVARIANCE, estimates=RANGES, **own)  # type: ignore[arg-type]
    expected = expected_plants(RIG, COVARIANCE, estimates=RANGES, **own)  # type: ignore[arg-type]
    yield from {"expected of a fit": expected.scenarios, "vetting of a fit": expected.vetting}.items()
    for kind in ("corners", "tolerances"):
        yield from in_halves(kind, in_files(kind, seed))


def axes_of(plants: Plants) -> dict[str, Array]:
    """The values of each parameter, by its name."""
    rows = [{n: v.share if isinstance(v, Factor) else v for n, v in own.items()} for own in plants.values()]
    return {n: np.array([row[n] for row in rows]) for n in rows[0]}


def correlations(columns: Mapping[str, Array]) -> pd.Series:
    """Spearman's, of every pair."""
    ranks = np.array([rankdata(v) for v in columns.values()])
    found = np.corrcoef(ranks)
    pairs = itertools.combinations(range(len(ranks)), 2)
    names = list(columns)
    return pd.Series({f"{names[i]} | {names[k]}": float(found[i, k]) for i, k in pairs})


def bound(pairs: int) -> float:
    """The correlation that the largest of some pairs of independent columns passes with a chance of `FALSE_ALARM`."""
    t = float(student.ppf(1 - FALSE_ALARM / pairs / 2, COUNT - 2))
    return t / math.sqrt(COUNT - 2 + t**2)


@pytest.mark.parametrize("seed", [None, 0, 1, 2])
def test_no_two_axes_of_any_draws_go_along_with_each_other(seed: int | None) -> None:
    columns = {f"{kind}: {n}": v for kind, plants in drawn(seed) for n, v in axes_of(plants).items()}
    assert {len(v) for v in columns.values()} == {COUNT}
    found = correlations(columns).abs()
    assert len(columns) > 80
    assert found.max() < bound(len(found)), found.nlargest(5)


def test_neighbouring_seeds_share_nothing() -> None:
    spreads = dict.fromkeys(NAMES, 0.3)
    columns = {
        f"{seed} {way.value} {n}": v
        for seed in range(6)
        for way in Sampling
        for n, v in axes_of(samples(RIG, spreads, COUNT, seed=seed, sampling=way)).items()
    }
    found = correlations(columns).abs()
    assert found.max() < bound(len(found)), found.nlargest(5)


def test_a_search_and_its_validation_share_no_plant_with_any_seeds() -> None:
    searched = [axes_of(read_scenarios(in_files("samples", seed), "t", RIG)) for seed in range(4)]
    tried = [axes_of(read_validation_scenarios(in_files("samples", seed), "t", RIG)) for seed in range(4)]
    for one, other in itertools.product(searched, tried):
        assert not any(np.intersect1d(one[n], other[n]).size for n in NAMES)


def test_kinds_of_one_file_vary_apart_from_each_other() -> None:
    box = {"corners": {"load.mass": "30 %"}, "samples": {"friction.coulomb": "30 %"}, "tolerances": {"pid.*": "1 %"}}
    columns = axes_of(read_validation_scenarios(box, "t", RIG))
    del columns["pid.Ki"], columns["pid.Kd"]  # which vary together with Kp, as stated
    assert correlations(columns).abs().max() < bound(3)


DRAWS: tuple[Callable[[Seed], Plants], ...] = (
    lambda seed: samples(RIG, {"load.mass": 0.3}, 3, seed=seed),
    lambda seed: samples(RIG, {"load.mass": 0.3}, 3, seed=seed, sampling=Sampling.SOBOL),
    lambda seed: draws(RIG, COVARIANCE, 3, seed=seed),
    lambda seed: tolerances(RIG, {"pid.Kp": 0.01}, 3, seed=seed),
)


@pytest.mark.parametrize("draw", DRAWS)
def test_a_seed_gives_the_same_plants_and_another_others(draw: Callable[[Seed], Plants]) -> None:
    assert draw(3) == draw(3) == draw(np.int64(3))  # type: ignore[arg-type]
    seeds: list[Seed] = [0, 1, (0, 1), (0, "a"), (0, "b"), (0, "a", "b"), (0, "ab"), further(0, "validation")]
    plants = [draw(seed) for seed in seeds]
    assert all(a != b for a, b in itertools.combinations(plants, 2))


def test_an_axis_more_leaves_the_numbers_of_the_others() -> None:
    one, two = (samples(RIG, dict.fromkeys(names, 0.3), 5) for names in (NAMES[:1], NAMES[:2]))
    assert [v["load.mass"] for v in one.values()] == [v["load.mass"] for v in two.values()]


def test_the_numbers_are_the_same_on_every_machine() -> None:
    assert generator(0, "samples", "load.mass").integers(1 << 30, size=3).tolist() == [762120542, 964219822, 282015948]


@pytest.mark.parametrize("seed", [-1, 0.5, True, (0, -1), None])
def test_a_seed_is_a_whole_number(seed: Seed) -> None:
    with pytest.raises(InputError, match="a seed is a whole number, not below 0"):
        samples(RIG, {"load.mass": 0.3}, 3, seed=seed)


OTHER_GENERATORS = {  # what else is seeded by a number that is no constant, and draws no plant
    "evaluation/rig.py": "the noise of one log",
    "evaluation/scenarios.py": "makes them",
    "studies/bootstrap.py": "a number a log, by the draw and the log, of which its noise is drawn",
    "tuning/racing.py": "the candidates of a search",
    "tuning/two_phase.py": "the candidates of a search",
}


def test_whoever_draws_by_a_users_seed_names_the_stream() -> None:
    root = Path(pneuopt.__file__).parent
    found = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            if node.func.attr in ("default_rng", "SeedSequence") and not isinstance(node.args[0], ast.Constant):
                found.add(path.relative_to(root).as_posix())
    assert found == set(OTHER_GENERATORS)
