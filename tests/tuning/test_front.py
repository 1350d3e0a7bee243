"""Fronts: no design is beaten by brute force by more than stated, and what fails stays as a row."""

from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.plotting import plot_front
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.front import pareto_front
from pneuopt.tuning.method import Method
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.two_phase import TwoPhase

STEP = Step(1.0, horizon=1.2)
BOUNDS = {"pid.Kp": (0.02, 1.0), "pid.Ki": (0.1, 20.0)}
PAIR = (SettlingTime(), MaxSensitivity())


def oscillator(sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(SecondOrder().system(), PID(sample_time, limits=False))
    return loop, loop.parameters.with_values({"pid.Kp": 0.1, "pid.Ki": 1.0}).with_bounds(BOUNDS).freed(*BOUNDS)


@cache
def front(sample_time: float | None) -> pd.DataFrame:
    loop, given = oscillator(sample_time)
    method: Method = TwoPhase((20, 25), starts=1) if sample_time is None else Racing(16, 150)
    return pareto_front(loop, STEP, given, minimise=PAIR, subject_to=[Overshoot(0.05)], points=5, method=method)


@pytest.mark.parametrize("sample_time", [None, pytest.param(2e-3, marks=pytest.mark.slow)])
def test_no_design_is_beaten_by_brute_force(sample_time: float | None) -> None:
    """Of 40 x 40 gains none is better in both by more than 3 % of the settling time, the searches' margin."""
    loop, given = oscillator(sample_time)
    grid = np.stack(np.meshgrid(*(np.linspace(*b, 40) for b in BOUNDS.values())), axis=-1).reshape(-1, 2)
    values = Simulator(loop, [STEP], search_space(loop, given)).values(
        grid, specify(SettlingTime(), [MaxSensitivity(100.0)])
    )
    good = (values["Overshoot"] <= 0.05) & np.isfinite(values["SettlingTime"])
    found = front(sample_time)
    assert (found["error"] == "").all()
    for _, design in found.iterrows():
        rivals = values["SettlingTime"][good & (values["MaxSensitivity"] <= design["MaxSensitivity"])]
        assert design["SettlingTime"] <= rivals.min(initial=np.inf) * 1.03


@pytest.mark.parametrize("sample_time", [None, pytest.param(2e-3, marks=pytest.mark.slow)])
def test_a_front_is_a_front_and_certified(sample_time: float | None) -> None:
    found, (loop, given) = front(sample_time), oscillator(sample_time)
    assert len(found) == 5
    assert found["SettlingTime"].is_monotonic_increasing
    assert found["MaxSensitivity"].is_monotonic_decreasing
    assert (found["MaxSensitivity"] <= found["limit"] * (1 + 1e-9)).all()
    middle = found.iloc[2]
    own = evaluate(loop, STEP, given.with_values({n: float(middle[n]) for n in BOUNDS}))["0 to 1"]
    assert own["SettlingTime"] == pytest.approx(middle["SettlingTime"], rel=1e-9)
    assert own["Overshoot"] <= 5.0
    assert abs(middle["SettlingTime"] - middle["claimed SettlingTime"]) < 1e-3


def test_a_front_is_drawn() -> None:
    picture = plot_front(front(None), {"SettlingTime": "s", "MaxSensitivity": ""})
    (axes,) = picture.axes
    line = axes.lines[0]
    np.testing.assert_array_equal(line.get_xdata(), front(None)["MaxSensitivity"])
    assert axes.get_ylabel() == "SettlingTime [s]"


def test_requirements_that_agree_make_a_point() -> None:
    """Up to Ki = Kp/T a PI control of a lag does not overshoot: the fastest design is the best by both."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_values({"plant.time_constant": 0.1, "pid.Kp": 0.5, "pid.Ki": 5.0})
    free = given.with_bounds({"pid.Ki": (4.9, 5.1)}).freed("pid.Ki")
    found = pareto_front(loop, STEP, free, minimise=(SettlingTime(), Overshoot()), points=3, method=Racing(8, 30))
    assert len(found) == 1


def few(**options: Any) -> pd.DataFrame:
    loop, given = oscillator(1e-2)
    pair, method = (SettlingTime(), MaxSensitivity(1.5)), Racing(8, 30, polish=0)
    known: dict[str, Any] = {"minimise": pair, "subject_to": [Overshoot(0.05)], "points": 3, "method": method}
    return pareto_front(loop, STEP, given, **known | options)


def test_a_front_begins_and_ends_at_the_given_bounds() -> None:
    found = few(until=1.3, points=2)
    assert (found["error"] == "").all()
    assert 1.3 < found["limit"][0] <= 1.5
    assert found["limit"][1] == 1.3
    assert (found["MaxSensitivity"] <= found["limit"] * (1 + 1e-9)).all()
    assert found["SettlingTime"].is_monotonic_increasing


@pytest.mark.parametrize(("ended", "kept"), [(2, [0, 2]), (0, [])])
def test_ctrl_c_keeps_what_is_done(ended: int, kept: list[int]) -> None:
    """Between the ends, after two searches, and on the way to the first end, where not even the limits are known."""
    heard = list[str]()

    def interrupt(line: str) -> None:
        heard.append(line)
        if sum("fine samples, generation 1:" in earlier for earlier in heard) > ended:
            raise KeyboardInterrupt

    found = few(until=1.3, progress=interrupt)
    assert len(found) == 3
    assert [k for k, error in enumerate(found["error"]) if error == ""] == kept
    assert (found["error"].drop(kept) == "interrupted").all()
    assert found["SettlingTime"].notna().tolist() == [k in kept for k in range(3)]
