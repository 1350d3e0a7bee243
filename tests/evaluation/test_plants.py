"""The plants that a model may stand for: drawn from a fit where there is one, within stated tolerances elsewhere."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.evaluation.plants import TOLERANCES, expected_plants, monte_carlo
from pneuopt.evaluation.scenarios import Normal, Sampling, apply_scenario, corners
from pneuopt.evaluation.tolerances import GAIN_TOLERANCE, PLANT_COUNT
from pneuopt.models.drives import ForceDrive, RotaryDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.parameters import Parameter, ParameterSet

RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 1.0, 20.0),
        "friction.coulomb": Parameter(40.0, "N", 0.0, 1e3, free=True),
        "friction.viscous": Parameter(30.0, "N*s/m", 0.0, 1e3, log=True, free=True),
        "friction.static": Parameter(70.0, "N", 60.0, 80.0),
    }
)
FITTED = ["friction.coulomb", "friction.viscous"]
COVARIANCE = pd.DataFrame([[4.0, 3.0], [3.0, 9.0]], FITTED, FITTED)
ESTIMATES = pd.DataFrame(
    {
        "stderr": [2.0, 3.0, math.nan],
        "dof": [4.0, math.inf, math.nan],
        "bias": [math.nan, math.nan, 12.5],
    },
    [*FITTED, "friction.static"],
)


def frame(plants: dict[str, dict[str, float]]) -> pd.DataFrame:
    return pd.DataFrame(list(plants.values()))


@pytest.mark.parametrize("sampling", Sampling)
def test_plants_have_the_fits_covariance_and_the_stated_distributions_apart(sampling: Sampling) -> None:
    spreads = {"load.mass": Normal(0.05)}
    plants = frame(monte_carlo(RIG, 4000, covariance=COVARIANCE, spreads=spreads, seed=3, sampling=sampling))
    assert plants["friction.coulomb"].std() == pytest.approx(2.0, rel=0.05)
    logs = plants.assign(**{"friction.viscous": 30 * np.log(plants["friction.viscous"])})
    assert logs[FITTED].corr().iloc[0, 1] == pytest.approx(0.5, abs=0.05)
    assert plants["load.mass"].std() == pytest.approx(0.25, rel=0.05)
    # random numbers of one stream would show here: the size of a deviation would go with the other's place
    assert stats.spearmanr((plants["friction.coulomb"] - 40).abs(), plants["load.mass"])[0] == pytest.approx(
        0, abs=0.06
    )


def test_few_degrees_of_freedom_widen_and_ranges_are_drawn_from() -> None:
    plants = frame(monte_carlo(RIG, 4000, covariance=COVARIANCE, estimates=ESTIMATES, seed=1))
    assert np.quantile((plants["friction.coulomb"] - 40).abs(), 0.95) == pytest.approx(
        2 * stats.t.ppf(0.975, 4), rel=0.1
    )
    assert plants["friction.static"].min() == pytest.approx(60, abs=0.1)
    assert plants["friction.static"].max() == pytest.approx(80, abs=0.1)


def test_what_is_stated_goes_before_the_fit() -> None:
    spreads = {"friction.*": (65.0, 66.0)}
    plants = frame(monte_carlo(RIG, 50, covariance=COVARIANCE, estimates=ESTIMATES, spreads=spreads))
    assert plants.to_numpy().min() >= 65
    assert plants.to_numpy().max() <= 66


def test_the_first_plants_are_those_of_a_shorter_draw() -> None:
    given = {"covariance": COVARIANCE, "estimates": ESTIMATES, "seed": 4}
    long, short = monte_carlo(RIG, 20, **given), monte_carlo(RIG, 5, **given)  # type: ignore[arg-type]
    assert list(long.items())[:5] == list(short.items())


def parameters() -> ParameterSet:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=1e-3))
    return loop.parameters.with_bounds({"pid.Kp": (1, 1e3)}).with_values({"pid.Kp": 200.0}).freed("pid.Kp")


def test_without_a_fit_the_stated_tolerances_hold() -> None:
    given = parameters()
    plants = expected_plants(given)
    assert len(plants.scenarios) == PLANT_COUNT
    table = pd.DataFrame(
        [
            apply_scenario(given, v).to_frame()["value"] / given.to_frame()["value"] - 1
            for v in plants.scenarios.values()
        ]
    )
    for names, share in {**TOLERANCES, ("pid.Kp",): GAIN_TOLERANCE}.items():
        for n in (n for n in names if n in given):
            spread = table[n].astype(float)
            assert 0.9 * share < spread.abs().max() <= share * (1 + 1e-12)
            assert abs(spread.mean()) < 0.3 * share
    assert (table["friction.coulomb"] - table["friction.static"]).abs().max() < 1e-12, "they vary together"
    assert (table[["friction.smoothing", "friction.stribeck_velocity", "load.force"]].fillna(0) == 0).all(axis=None)
    assert plants.sentences[0].startswith("assumed tolerances: load.mass +-5 %")
    lines = repr(plants).splitlines()
    assert lines[:1] == [f"{PLANT_COUNT} plants that the model may stand for"]
    assert lines[1].startswith("  assumed tolerances: load.mass +-5 %")
    assert "load.mass +-5 %" in plants._repr_html_()


def test_a_fit_replaces_the_tolerances_of_what_it_identified() -> None:
    """Correlations count: two estimates of which the logs know only the sum vary against each other."""
    given = parameters()
    names = ["friction.coulomb", "load.force", "friction.viscous"]
    matrix = np.array([[4.0, -3.9, 0.0], [-3.9, 4.0, 0.0], [0.0, 0.0, np.nan]])
    covariance = pd.DataFrame(matrix, index=names, columns=names)
    plants = expected_plants(given, covariance, count=400)
    frame = pd.DataFrame(list(plants.scenarios.values()))
    drawn = frame[["friction.coulomb", "load.force"]].astype(float)
    assert drawn["friction.coulomb"].std() == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(drawn.to_numpy().T)[0, 1] == pytest.approx(-3.9 / 4, abs=0.02)
    assert plants.from_fit == ("friction.coulomb", "load.force")
    assert "friction.viscous" in frame, "what the logs could not identify varies by its tolerance"
    assert "friction.coulomb and" not in " ".join(plants.sentences)
    assert any(s.startswith("as the fit leaves them: friction.coulomb +-13 %") for s in plants.sentences)


def test_few_degrees_of_freedom_widen_the_draws_to_the_interval_and_keep_the_correlation() -> None:
    """With two of them, 95 % lie within 4.30 deviations (t table), not 1.96; the axis ends there."""
    given, names = parameters(), ["friction.coulomb", "load.force"]
    covariance = pd.DataFrame(np.array([[0.04, -0.039], [-0.039, 0.04]]), index=names, columns=names)
    estimates = pd.DataFrame({"stderr": [0.2, 0.2], "dof": [2.0, np.inf]}, index=names)
    plants = expected_plants(given, covariance, estimates=estimates, count=2000)
    frame = pd.DataFrame(list(plants.scenarios.values()))
    few = (frame["friction.coulomb"].astype(float) - given.value("friction.coulomb")) / 0.2
    many = (frame["load.force"].astype(float) - given.value("load.force")) / 0.2
    assert np.quantile(np.abs(few), 0.95) == pytest.approx(4.303, rel=0.12)
    assert np.quantile(np.abs(many), 0.95) == pytest.approx(1.96, rel=0.06)
    assert few.rank().corr(many.rank()) < -0.95
    axis = next(a for a in plants.axes if a.names == ("friction.coulomb",))
    assert axis.high["friction.coulomb"] == pytest.approx(given.value("friction.coulomb") + 4.303 * 0.2, rel=1e-3)


def test_a_range_in_place_of_an_interval_is_drawn_from_end_to_end() -> None:
    given, name = parameters(), "friction.coulomb"
    low, high = given.value(name) * (1 + np.array([-0.3, 0.3]))
    columns = {"stderr": [np.nan], "dof": [5.0], "bias": [0.3 * given.value(name)]}
    plants = expected_plants(given, estimates=pd.DataFrame(columns, index=[name]), count=400)
    drawn = np.array([v[name] for v in plants.scenarios.values()], dtype=float)
    assert low <= drawn.min() < low + 0.02 * (high - low)
    assert high - 0.02 * (high - low) < drawn.max() <= high
    assert plants.from_fit == (name,)
    assert any(s.startswith("as the fit leaves them: friction.coulomb +-30 %") for s in plants.sentences)


def test_scenarios_of_the_tuning_are_kept_and_the_rest_still_varies() -> None:
    given = parameters()
    asked = corners(given, {"load.mass": 0.3})
    plants = expected_plants(given, scenarios=asked, count=10)
    masses = [v["load.mass"] for v in plants.scenarios.values()]
    assert masses == [3.5, 6.5] * 5
    assert all("pid.Kp" in v for v in plants.scenarios.values())
    assert plants.known == ("load.mass",)
    assert not any("load.mass" in a.names for a in plants.axes)


def test_the_seed_makes_them_repeatable() -> None:
    given = parameters()
    assert expected_plants(given, count=3).scenarios == expected_plants(given, count=3).scenarios
    assert expected_plants(given, count=3, seed=2).scenarios != expected_plants(given, count=3).scenarios


def test_nothing_that_varies_gives_no_plants() -> None:
    assert expected_plants(ParameterSet({"other": Parameter(1.0, "m")})).scenarios == {}


def test_every_tolerance_names_a_parameter_of_a_drive() -> None:
    """A parameter that is renamed takes its tolerance along."""
    drives = (PneumaticDrive(friction=Stribeck()), RotaryDrive(), FirstOrder(pade_order=2), SecondOrder())
    known = {n for drive in drives for n in drive.system().parameters}
    assert {n for names in TOLERANCES for n in names} <= known
