""""""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t as student

from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System
from pneuopt.identification import profiles, review
from pneuopt.identification.identify import identify
from pneuopt.identification.misfit import t_quantile
from pneuopt.identification.problem import EstimationProblem, check_logs
from pneuopt.identification.profiles import ParameterValues, Profile, profile, propagate_error, propagate_intervals
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tolerances import END_TOLERANCE
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Stribeck
from pneuopt.quantities.errors import InputError, UnknownNameError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares, solve_least_squares
from pneuopt.shooting.transcription import Transcription

LEVELS = {"friction.coulomb": 30.0, "friction.static": 42.0, "friction.stribeck_velocity": 0.025}
CURVE = ("friction.coulomb", "friction.static", "friction.stribeck_velocity")


def moved(static: float, noise: float, fastest: float = 0.2, seed: int = 0) -> Experiment:
    """A rig's log at speeds spread evenly over the logarithm, 1 mm/s to the fastest, both ways."""
    rng = np.random.default_rng(seed)
    speed = np.geomspace(1e-3, fastest, 300) * np.where(np.arange(300) % 2, 1, -1)
    g = 30.0 + (static - 30.0) * np.exp(-((speed / 0.025) ** 2))
    force = g * np.tanh(speed / 1e-3) + 60.0 * speed + noise * rng.standard_normal(300)
    t = np.arange(300) * 1e-2
    return Experiment(Trajectory(t, {"speed": speed, "force": force}), {"force": noise}, name="map")


def fitted(
    friction: FrictionModel, log: Experiment, *free: str, width: float | None = None
) -> tuple[System, IdentificationResult]:
    rig = MotionDrive(friction, chamber=False)
    known = {n: v for n, v in LEVELS.items() if n in rig.parameters} | {"friction.viscous": 60.0}
    known |= {} if width is None else {"friction.smoothing": width}
    return rig.system(), identify(rig.system(), [log], rig.parameters.with_values(known).freed(*free))


def test_of_a_linear_model_it_is_the_linear_interval() -> None:
    log = moved(30.0, 0.5)
    system, result = fitted(Coulomb(), log, "friction.coulomb", "friction.viscous")
    for name in ("friction.coulomb", "friction.viscous"):
        found, row = profile(system, [log], result, name), result.estimates.loc[name]
        assert not found.is_open
        assert found.low - row["value"] == pytest.approx(row["ci_low"] - row["value"], rel=0.01)
        assert found.high - row["value"] == pytest.approx(row["ci_high"] - row["value"], rel=0.01)
        deviance = np.interp(row["value"] + row["stderr"], found.curve["value"], found.curve["deviance"])
        assert deviance < 2.0
        assert len(found.curve) <= 5  # the estimate, two that show the curvature, and one at each end


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_of_a_drive_with_soft_gaps_it_is_the_linear_interval(seed: int) -> None:
    system = ForceDrive(Coulomb()).system()
    truth = ForceDrive(Coulomb()).parameters.with_values({"load.mass": 3.0})
    t = np.arange(0, 1.0, 1e-3)
    force = 60 * np.sin(2 * np.pi * 2 * t) + 30 * np.sin(2 * np.pi * 5 * t)
    run = simulate(system, Trajectory(t, {"force": force}), truth, intersample={"force": Intersample.LINEAR})
    noisy = run["position"] + 2e-5 * np.random.default_rng(seed).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"force": force, "position": noisy}), {"position": 2e-5}, name="run")
    stated = ParameterSet({"friction.smoothing": replace(truth["friction.smoothing"], source="known")})
    for known, near in ((truth | stated, 0.03), (truth, 0.05)):  # a width that is estimated bends the valley
        result = identify(system, [log], known.freed("load.mass", "friction.coulomb", "friction.viscous"))
        found, row = profile(system, [log], result, "friction.viscous"), result.estimates.loc["friction.viscous"]
        assert found.high - found.low == pytest.approx(row["ci_high"] - row["ci_low"], rel=near)


def test_a_weakly_identifiable_stribeck_velocity_has_unequal_sides() -> None:
    log = moved(42.0, 16.0)
    system, result = fitted(Stribeck(), log, *CURVE)
    found = profile(system, [log], result, "friction.stribeck_velocity")
    assert not found.is_open
    assert found.low < 0.025 < found.high
    below, above = math.log(found.estimate / found.low), math.log(found.high / found.estimate)
    assert max(below, above) > 1.15 * min(below, above)
    assert "m/s to" in found.sentence
    assert f"m/s, 95 % interval: {found.sentence}" in " ".join(repr(found).split())
    wider = profile(system, [log], result, "friction.stribeck_velocity", level=0.99)
    assert wider.low < found.low < found.high < wider.high


def test_a_profile_ends_at_a_bound_that_a_logarithm_there_and_back_exceeds() -> None:
    """A refit left the bound by a rounding, and the next one, which began there, was refused."""
    bound = next(b for b in np.linspace(0.028, 0.029, 100).tolist() if math.exp(math.log(b)) > b)
    log, rig = moved(42.0, 16.0), MotionDrive(Stribeck(), chamber=False)
    narrow = rig.parameters.with_values({**LEVELS, "friction.viscous": 60.0})
    narrow = narrow.with_bounds({"friction.stribeck_velocity": (1e-3, bound)})
    result = identify(rig.system(), [log], narrow.freed(*CURVE))
    found = profile(rig.system(), [log], result, "friction.stribeck_velocity")
    assert found.curve["value"].max() <= bound


def test_a_standard_deviation_reaches_the_farther_end_of_a_profile() -> None:
    """The curvature at the peak gave one of a third on the side on which the likelihood is flat."""
    _, result = fitted(Stribeck(), moved(42.0, 16.0), *CURVE)
    row = result.estimates.loc["friction.stribeck_velocity"]
    farther = max(row["ci_high"] - row["value"], row["value"] - row["ci_low"])
    assert farther > 1.3 * min(row["ci_high"] - row["value"], row["value"] - row["ci_low"])
    assert row["stderr"] * t_quantile(row["dof"].item(), 0.95) == pytest.approx(farther)
    deviations = np.sqrt(np.diag(result.covariance))
    assert deviations == pytest.approx(result.estimates["stderr"].to_numpy())


def test_a_curve_that_is_not_there_has_open_ends_and_no_interval() -> None:
    """Fitted to pure Coulomb friction of a known width, any Stribeck velocity will do."""
    log = moved(30.0, 0.5, seed=2)
    system, result = fitted(Stribeck(), log, *CURVE, width=1e-3)
    name = "friction.stribeck_velocity"
    found = profile(system, [log], result, name)
    assert found.is_open
    row = result.estimates.to_dict(orient="index")[name]
    assert row["note"] == "unidentifiable"
    assert math.isnan(float(row["stderr"]))
    assert (row["ci_low"], row["ci_high"]) == (-math.inf, math.inf)
    assert result.verdict is not None
    said = f"the logs do not identify {name}: anything from 0.0001 to 1 m/s fits as well; log"
    assert said in " ".join(result.verdict.sentences)
    assert np.isnan(result.covariance[name]).all()
    # nor its static friction: what leads to other values of one leads to other values of both
    assert f"the logs do not identify friction.static and {name}" in result.status.sentences
    assert result.estimates["ci_low"]["friction.coulomb"] < 30.0 < result.estimates["ci_high"]["friction.coulomb"]


@pytest.mark.parametrize("refits", [0, 3])
def test_an_interruption_between_or_within_refits_is_told(refits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C within a refit gives a fit that is marked, between two of them an exception."""
    fits: list[Fit] = []

    def interrupted(transcription: Transcription, method: LeastSquares) -> Fit:
        assert not method.checks_steps  # the fit has tried them
        if not refits:
            raise KeyboardInterrupt
        fits.append(solve_least_squares(transcription, method))
        return fits[-1] if len(fits) < refits else replace(fits[-1], status=Status(Code.INTERRUPTED))

    monkeypatch.setattr(profiles, "solve_least_squares", interrupted)
    rig, name = MotionDrive(Stribeck(), chamber=False), "friction.stribeck_velocity"
    given = rig.parameters.with_values({**LEVELS, "friction.viscous": 60.0}).freed(*CURVE)
    result = identify(rig.system(), [moved(42.0, 16.0)], given, throw=False)
    assert len(fits) == refits
    assert result.status.code is Code.INTERRUPTED
    assert result.status.verdict == f"the estimates are found, the interval of {name} is not"
    row = result.estimates.loc[name]
    assert np.isfinite(row[["stderr", "ci_low", "ci_high"]].to_numpy(dtype=float)).all()


def test_bad_input_is_named() -> None:
    log = moved(30.0, 0.5)
    system, result = fitted(Coulomb(), log, "friction.coulomb", "friction.viscous")
    with pytest.raises(UnknownNameError, match=r"friction\.colomb"):
        profile(system, [log], result, "friction.colomb")
    with pytest.raises(InputError, match="a level lies between 0 and 1, got 95"):
        profile(system, [log], result, "friction.coulomb", level=95)
    with pytest.raises(InputError, match="the result is of map, not of these logs"):
        profile(system, [log, log], result, "friction.coulomb")
    assert isinstance(result.parameters, ParameterSet)


def test_with_noise_of_the_states_no_interval_is_profiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error of a wrong model is in no profile of it; six refits of a log with hysteresis took 37 CPU s."""
    log = moved(42.0, 0.5)
    system, result = fitted(Stribeck(), log, *CURVE)
    logs = tuple(check_logs(system, [log], result.parameters))
    problem = EstimationProblem(system, logs, system.parameters | result.parameters, LeastSquares())
    known = result.estimates.drop("friction.smoothing")  # no interval of a width is profiled, for nobody asks for it
    doubtful = replace(result, estimates=known.assign(stderr=known["value"]))
    traced = list[str]()

    def trace(_: EstimationProblem, found: IdentificationResult, name: str) -> Profile:
        traced.append(name)
        raise KeyboardInterrupt

    monkeypatch.setattr(review, "trace_profile", trace)
    assert review._profiles(problem, doubtful)[1] == traced == ["friction.stribeck_velocity"]
    noisy = replace(doubtful, stats={**doubtful.stats, "gap_deviation": 1e-3})
    assert review._profiles(problem, noisy) == ({}, [])
    assert len(traced) == 1


def test_a_profile_that_jumps_over_its_level_is_not_followed_into_the_jump() -> None:
    """Refits of a log of 60 s ended at two optima; 20 of 26 refits, 50 CPU s, halved a jump down to rounding."""
    tried = list[float]()

    class Jump:
        centre = 0.0

        def refit_at(self, z: float) -> SimpleNamespace:
            tried.append(z)
            return SimpleNamespace(z=z)

        def deviance_root(self, point: SimpleNamespace) -> float:
            return 1.0 if point.z < math.pi / 4 or id(point) in again else 3.0

        def retry(self, point: SimpleNamespace, begin: SimpleNamespace) -> SimpleNamespace:
            assert begin.z < point.z
            return mended or point

    mended: Any = None
    again = set[int]()
    jump, near, far = cast("Any", (Jump(), SimpleNamespace(z=0.0), SimpleNamespace(z=1.0)))
    assert profiles._locate_crossing(jump, near, far, 2.0) is None
    assert len(tried) <= 8
    assert abs(tried[-1] - math.pi / 4) < 2 * END_TOLERANCE
    # a refit that was caught beyond the jump is no end: from this side it lies within
    mended = SimpleNamespace(z=0.8)
    again.add(id(mended))
    assert profiles._locate_crossing(jump, near, far, 2.0) is mended


class LinearRefits:
    """Refits of which the root of the deviance is a slope times the distance from the estimate."""

    def __init__(self, slope: float, probes: tuple[float, ...] = (), spread: float = 1.0) -> None:
        self.centre, self.slope, self.spread = 0.0, slope, spread
        self.parameter = replace(PROBED, log=False)
        self.points = [SimpleNamespace(z=z) for z in (0.0, *probes)]
        self.tried = list[float]()

    def refit_at(self, z: float) -> SimpleNamespace:
        self.tried.append(z)
        self.points.append(SimpleNamespace(z=z))
        return self.points[-1]

    def deviance_root(self, point: SimpleNamespace) -> float:
        return self.slope * abs(float(point.z))

    def to_search(self, value: float) -> float:
        return value

    value = to_search


PROBED = Parameter(0.0, "N", -1e3, 1e3, free=True)


def test_refits_begin_behind_a_probe_and_no_farther_than_the_linear_end() -> None:
    """A probe with next to no deviance led to a value three times as far as the end."""
    for slope, first in ((1.0, 1.01 * 1.0 + 1.0), (0.01, 1.05 * 2.0)):
        refits = LinearRefits(slope, probes=(1.0, -1.0))
        profiles._bracket(refits, 1, 2.0)  # type: ignore[arg-type]
        assert refits.tried[0] == pytest.approx(first)
    beyond = LinearRefits(2.5, probes=(1.0, -1.0))
    profiles._bracket(beyond, -1, 2.0)  # type: ignore[arg-type]
    assert beyond.tried == [pytest.approx(-0.8)]


@pytest.mark.parametrize(("last", "end"), [(0.985, 1.0), (0.9, math.inf), (1.015, 1.0)])
def test_an_end_is_placed_by_a_refit_close_to_the_level(last: float, end: float) -> None:
    refits = LinearRefits(2.0, probes=(0.5, last))
    assert profiles._interval_end(refits, 1, 2.0) == pytest.approx(end)  # type: ignore[arg-type]


def test_what_a_closed_profile_drags_has_an_interval_that_holds_where_it_went(monkeypatch: pytest.MonkeyPatch) -> None:
    """Static friction had 33 N +- 2 N, 16 deviations off, though the profile of its Stribeck velocity led it to 1e5."""
    log = moved(42.0, 0.5)
    system, result = fitted(Stribeck(), log, *CURVE)
    names = ("friction.static", "friction.coulomb")
    static, coulomb = (result.estimates["value"][n] for n in names)
    deviation = float(result.estimates["stderr"]["friction.coulomb"])
    curve = pd.DataFrame(
        {
            "value": [0.01, 0.02, 0.03, 0.04],
            "deviance": [3.0, 0.0, 3.5, 9.0],
            "friction.stribeck_velocity": [0.01, 0.02, 0.03, 0.04],
            "friction.static": [50.0, static, 41.0, 900.0],
            "friction.coulomb": coulomb + deviation * np.array([-1.0, 0.0, 1.0, 0.0]),
            "friction.smoothing": result.estimates["value"]["friction.smoothing"],
        }
    )
    name, unknown = "friction.stribeck_velocity", math.inf
    closed = Profile(name, "m/s", 0.02, 0.01, 0.03, 0.95, curve, dof=unknown)
    found = review._widen_dragged(result, {name: closed})
    before, rows = (each.estimates.to_dict(orient="index") for each in (result, found))
    row, quantile = rows["friction.static"], t_quantile(unknown, 0.95)
    assert row["ci_high"] == 50.0
    assert row["ci_low"] == min(41.0, before["friction.static"]["ci_low"])
    assert row["stderr"] == pytest.approx((50.0 - static) / quantile)
    variance = np.diag(found.covariance)[list(found.covariance.index).index("friction.static")]
    assert math.sqrt(variance) == pytest.approx(row["stderr"])
    assert rows["friction.coulomb"] == before["friction.coulomb"]
    own = Profile("friction.static", "N", static, 41.9, 42.1, 0.95, curve, dof=unknown)
    monkeypatch.setattr(review, "_profiles", lambda *_: ({name: closed}, []))
    logs = tuple(check_logs(system, [log], result.parameters))
    problem = EstimationProblem(system, logs, system.parameters | result.parameters, LeastSquares())
    reviewed, _ = review.review_fit(problem, result)
    assert reviewed.estimates["ci_high"]["friction.static"] == 50.0
    for bias, low in ((0.0, 0.01), (1e-3, 0.005)):  # a profile is of chance: the interval of a bias stays
        given = result.estimates.copy()
        given.loc[name, ["ci_low", "ci_high", "bias"]] = [0.005, 0.025, bias]
        reviewed, _ = review.review_fit(problem, replace(result, estimates=given))
        assert [reviewed.estimates[n][name] for n in ("ci_low", "ci_high")] == [low, 0.03]
    kept = review._widen_dragged(result, {name: closed, "friction.static": own}).estimates
    assert kept.to_dict(orient="index")["friction.static"] == before["friction.static"]


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
    g = np.zeros(len(order))  # nothing of the width, which nobody has stated
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
