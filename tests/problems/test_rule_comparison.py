"""Tuning rules: figures and sensitivities they are known for; what the comparison says of designs that lose."""

from math import inf
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.tune import rule_comparison
from problems.tune.rule_comparison import SETS, integrator_rules, lag_rules, oscillator_rules

RULES = {"simc": inf, "amigo_pi": inf, "amigo_pid": inf}


def standard(gains: po.ParallelForm) -> tuple[float, float, float]:
    """The gain, the integral and the derivative time."""
    return gains.Kp, gains.Kp / gains.Ki, gains.Kd / gains.Kp


def largest_sensitivity(gains: po.ParallelForm, gain: float, dead_time: float, pole: float) -> float:
    """Ms with ``gain exp(-L s)/(s + pole)``, the delay exact, the derivative without a filter as rules have it."""
    s = 1j * np.logspace(-3, 3, 20001)
    controller = gains.Kp + gains.Ki / s + gains.Kd * s
    return float(np.max(1 / np.abs(1 + controller * gain * np.exp(-dead_time * s) / (s + pole))))


def test_rules_by_hand() -> None:
    # by Skogestad's half rule 1/((s + 1)(.2 s + 1)) is about exp(-.1 s)/(1.1 s + 1)
    assert standard(lag_rules(1.0, 1.1, 0.1)["simc"]) == pytest.approx((5.5, 0.8, 0.0))
    assert standard(integrator_rules(1.0, 1.0)["simc"]) == pytest.approx((0.5, 8.0, 0.0))
    rules = lag_rules(1.0, 1.04, 0.075)
    assert standard(rules["amigo_pi"]) == pytest.approx((4.13, 0.539, 0.0), rel=2e-3)
    assert standard(rules["amigo_pid"]) == pytest.approx((6.44, 0.361, 0.0367), rel=2e-3)


def test_simc_has_the_sensitivities_that_its_paper_states() -> None:
    assert largest_sensitivity(lag_rules(2.0, 1.0, 0.5)["simc"], 2.0, 0.5, 1.0) == pytest.approx(1.59, abs=0.005)
    assert largest_sensitivity(integrator_rules(2.0, 0.5)["simc"], 2.0, 0.5, 0.0) == pytest.approx(1.70, abs=0.005)


@pytest.mark.parametrize("dead_time", [0.1, 0.3, 1.0, 2.0])
def test_amigo_has_the_robustness_that_it_is_made_for(dead_time: float) -> None:
    # both are fits to designs with 1.4
    lag, pure = lag_rules(2.0, 1.0, dead_time), integrator_rules(2.0, dead_time)
    assert largest_sensitivity(lag["amigo_pid"], 2.0, dead_time, 1.0) == pytest.approx(1.4, abs=0.02)
    assert largest_sensitivity(pure["amigo_pid"], 2.0, dead_time, 0.0) == pytest.approx(1.4, abs=0.02)
    assert largest_sensitivity(pure["amigo_pi"], 2.0, dead_time, 0.0) == pytest.approx(1.4, abs=0.02)
    assert 1.2 < largest_sensitivity(lag["amigo_pi"], 2.0, dead_time, 1.0) < 1.4


def test_an_integrator_is_a_slow_lag() -> None:
    slow, pure = lag_rules(3e6, 1e6, 0.2), integrator_rules(3.0, 0.2)
    for name, gains in pure.items():
        assert standard(slow[name]) == pytest.approx(standard(gains), rel=1e-4)


def test_simc_for_an_oscillator_cancels_it() -> None:
    gain, frequency, damping, dead_time = 3.0, 10.0, 0.1, 0.06
    gains, s = oscillator_rules(gain, frequency, damping, dead_time)["simc"], 1j * np.logspace(-1, 3, 200)
    plant = gain * frequency**2 / (s**2 + 2 * damping * frequency * s + frequency**2)
    controller = gains.Kp + gains.Ki / s + gains.Kd * s / (gains.Tf * s + 1)
    np.testing.assert_allclose(controller * plant, 1 / (2 * dead_time * s * (gains.Tf * s + 1)), rtol=1e-9)


@pytest.mark.parametrize("seed", range(9))
def test_every_rule_lies_in_the_box_and_no_start_is_one(seed: int) -> None:
    given = list(SETS.values())[seed % len(SETS)](np.random.default_rng((seed, 9)))
    for gains in given.rules.values():
        for name in given.parameters.free_names:
            value, known = getattr(gains, name.removeprefix("pid.")), given.parameters[name]
            assert known.lower <= value <= known.upper
    assert all(given.parameters.value("pid.Ki") < 0.5 * gains.Ki for gains in given.rules.values() if gains.Ki > 0)


def rows(*found: dict[str, object]) -> pd.DataFrame:
    good = {"kind": "lag", "outcome": "certified", "tuned": 1.0, "de": 1.0, "cpu": 2.0, **RULES, "simc": 1.2}
    return pd.DataFrame([good | {"seed": seed} | row for seed, row in enumerate(found)])


def held(table: pd.DataFrame) -> tuple[list[float], list[bool]]:
    claims = rule_comparison.main(table).set_index("name")
    asked = claims.loc[["lag.certified", "lag.not_worse", "lag.near_de"]]
    return asked["value"].tolist(), asked["holds"].tolist()


def test_all_that_win_hold() -> None:
    assert held(rows({}, {"de": 0.995}, {"de": inf, "simc": inf})) == ([3, 3, 3], [True, True, True])


def test_a_design_that_a_rule_beats_fails() -> None:
    assert held(rows({}, {"amigo_pi": 0.999})) == ([2, 1, 2], [True, False, True])


def test_a_design_that_evolution_beats_by_two_percent_fails() -> None:
    assert held(rows({}, {"de": 0.98})) == ([2, 2, 1], [True, True, False])


def test_a_design_that_is_not_certified_fails_even_without_rivals() -> None:
    assert held(rows({}, {"outcome": "rejected", "tuned": inf, "de": inf, "simc": inf})) == ([1, 1, 1], [False] * 3)


def test_what_had_no_rival_is_said() -> None:
    claims = rule_comparison.main(rows({}, {"de": inf, "simc": inf}, {"de": 0.5})).set_index("name")["value"]
    assert claims[["lag.with_rule", "lag.de.certified"]].tolist() == [2, 2]
    assert claims["lag.over_rule"] == pytest.approx(1 / 1.2)
    assert claims["lag.over_de"] == pytest.approx(2.0)


@pytest.mark.slow
def test_one_is_compared_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rule_comparison, "TIMES", 1.0)
    found = pd.DataFrame([rule_comparison.compared(0)])
    assert found["outcome"].tolist() == ["certified"]
    assert np.isfinite(found[["tuned", "simc", "amigo_pi", "amigo_pid", "de"]].to_numpy(dtype=float)).all()
    assert found["tuned"].item() <= rule_comparison.best_rule(found).item()
    rule_comparison.figure(found).savefig(tmp_path / "picture.png")
