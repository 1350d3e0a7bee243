import math

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t as student

from pneuopt.identification.identify import identify
from pneuopt.identification.propagation import ParameterValues, propagate_error, propagate_intervals
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import MotionDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.trajectories import Trajectory

LEVELS = {"friction.coulomb": 30.0, "friction.static": 42.0, "friction.stribeck_velocity": 0.025}
RIG = MotionDrive(Stribeck(), chamber=False)
KNOWN = RIG.parameters.with_values({**LEVELS, "friction.viscous": 60.0})


def log(seed: int) -> Experiment:
    speed = np.geomspace(1e-3, 0.3, 300) * np.where(np.arange(300) % 2, 1, -1)
    g = 30 + 12 * np.exp(-((speed / 0.025) ** 2))
    force = g * np.tanh(speed / 1e-3) + 60 * speed + 0.5 * np.random.default_rng(seed).standard_normal(300)
    return Experiment(Trajectory(np.arange(300) * 1e-2, {"speed": speed, "force": force}), {"force": 0.5}, name="map")


def ratio(p: ParameterValues) -> float:
    return p["friction.static"] / p["friction.coulomb"]


def slow(p: ParameterValues) -> float:
    """Friction at 10 mm/s [N]."""
    rise = p["friction.static"] - p["friction.coulomb"]
    g = p["friction.coulomb"] + rise * math.exp(-((0.01 / p["friction.stribeck_velocity"]) ** 2))
    return g + 0.01 * p["friction.viscous"]


def test_figures_made_of_estimates_spread_as_they_say() -> None:
    """Break-away ratio and friction at a speed, over noise draws: means and deviations as stated."""
    free = KNOWN.freed("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")
    fits = [identify(RIG.system(), [log(seed)], free) for seed in range(40)]
    for function, truth in ((ratio, 1.4), (slow, 30 + 12 * math.exp(-0.16) + 0.6)):
        found = [propagate_error(fit, function) for fit in fits]
        inside = sum(d.ci_low <= truth <= d.ci_high for d in found)
        assert inside >= 34
        drawn, stated = np.std([d.value for d in found]), np.mean([d.stderr for d in found])
        assert drawn == pytest.approx(stated, rel=0.35)
        quantile = student.ppf(0.975, fits[0].estimates["dof"].min())
        assert found[0].ci_high - found[0].value == pytest.approx(quantile * found[0].stderr, rel=1e-9)


def test_it_is_the_delta_method() -> None:
    fit = identify(RIG.system(), [log(0)], KNOWN.freed("friction.coulomb", "friction.static"))
    found, C = propagate_error(fit, ratio), fit.covariance.to_numpy()
    s, c = (fit.estimates["value"][n] for n in ("friction.static", "friction.coulomb"))
    order = list(fit.covariance.index)
    g = np.zeros(2)
    g[order.index("friction.static")], g[order.index("friction.coulomb")] = 1 / c, -s / c**2
    assert found.value == pytest.approx(s / c)
    assert found.stderr == pytest.approx(math.sqrt(g @ C @ g), rel=1e-5)
    values, intervals = propagate_intervals(fit, lambda p: [ratio(p), 7.0])
    assert values.tolist() == [found.value, 7.0]
    assert intervals.tolist() == [[found.ci_low, found.ci_high], [7.0, 7.0]]


def test_what_hangs_on_a_parameter_without_an_interval_has_none() -> None:
    fit = identify(RIG.system(), [log(0)], KNOWN.freed("friction.coulomb", "friction.static"))
    blind = pd.DataFrame(fit.covariance)
    blind.loc["friction.static"] = math.nan
    blind["friction.static"] = math.nan
    object.__setattr__(fit, "covariance", blind)
    assert math.isnan(propagate_error(fit, ratio).stderr)
    assert propagate_error(fit, lambda p: 2 * p["friction.coulomb"]).stderr > 0
