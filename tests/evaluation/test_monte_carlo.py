import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pneuopt.evaluation.distributions import Normal
from pneuopt.evaluation.monte_carlo import monte_carlo
from pneuopt.evaluation.sampling import Sampling
from pneuopt.quantities.errors import InputError, UnknownNameError
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
        "range_low": [math.nan, math.nan, 50.0],
        "range_high": [math.nan, math.nan, 75.0],
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
    assert plants["friction.static"].max() == pytest.approx(75, abs=0.1)


def test_what_is_stated_goes_before_the_fit() -> None:
    spreads = {"friction.*": (65.0, 66.0)}
    plants = frame(monte_carlo(RIG, 50, covariance=COVARIANCE, estimates=ESTIMATES, spreads=spreads))
    assert plants.to_numpy().min() >= 65
    assert plants.to_numpy().max() <= 66


def test_the_first_plants_are_those_of_a_shorter_draw() -> None:
    given = {"covariance": COVARIANCE, "estimates": ESTIMATES, "seed": 4}
    long, short = monte_carlo(RIG, 20, **given), monte_carlo(RIG, 5, **given)  # type: ignore[arg-type]
    assert list(long.items())[:5] == list(short.items())


def test_a_draw_of_nothing_is_refused() -> None:
    for covariance in (None, pd.DataFrame([[1.0]], ["valve.gain"], ["valve.gain"])):
        with pytest.raises(InputError, match="nothing varies: state how a parameter spreads, or give a fit"):
            monte_carlo(RIG, 5, covariance=covariance)
    with pytest.raises(InputError, match="count must be at least 1, got 0"):
        monte_carlo(RIG, 0, covariance=COVARIANCE)
    with pytest.raises(UnknownNameError, match=r"load\.mas"):
        monte_carlo(RIG, 5, spreads={"load.mas": 0.1})
