"""A design on the rig's own model: what breaks there is not certified, and is said in words."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import IAE, Overshoot, SettlingTime
from pneuopt.evaluation.rest_check import NoHunting, check_rest
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.evaluation.specification import specify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.karnopp import Karnopp
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import TuningResult, _remedies, _watch_rest, certify_on_rig, prepare_search, prepare_task, tune

STEP = Step(0.2, horizon=0.4)
SENSORS = {"speed": Sensor()}
LOOP = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=2e-3))
STICKING = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(sample_time=2e-3))


def given(Kp: float = 300.0, Ki: float = 15000.0) -> ParameterSet:
    bounds = {"pid.Kp": (0.95 * Kp, 1.05 * Kp)}
    return LOOP.parameters.with_values({"pid.Kp": Kp, "pid.Ki": Ki}).with_bounds(bounds).freed("pid.Kp")


def certified(limit: float) -> tuple[TuningResult, "pd.DataFrame"]:
    """A design as if a search had found it, with its smooth certificate, on a rig whose sensor lags."""
    spec = specify(SettlingTime(), [Overshoot(limit)])
    search = prepare_search(prepare_task(LOOP, STEP, given(), spec))
    design = search.certify_point(search.space.start)
    assert design.status.converged, design.status
    rig = Rig(STICKING, {"speed": Sensor(lag=5e-3)})
    own = design.parameters.select(n for n in design.parameters if n in STICKING.parameters)
    return certify_on_rig(search.task, design, rig), evaluate(rig, STEP, own)


def test_a_design_that_holds_there_keeps_its_gains_and_shows_the_figures_beside_the_smooth_ones() -> None:
    result, truth = certified(0.9)
    assert result.status.converged
    assert result.on_rig is not None
    there, again, smooth = (f.T["Overshoot"].to_list() for f in (result.on_rig, truth, result.certified))
    assert there == again
    assert there != smooth


def test_a_design_that_breaks_a_limit_there_is_not_converged_and_the_room_it_needs_is_computed() -> None:
    result, truth = certified(0.9)
    smooth, there = (float(f.to_numpy()[list(f.index).index("Overshoot"), 0]) for f in (result.certified, truth))
    assert there > smooth + 0.5, "the lag adds overshoot"
    limit = (smooth + there) / 2
    result, _ = certified(limit / 100)
    assert not result.status.converged
    assert result.status.verdict == f"on the rig Overshoot is {there:.3g} % at 0 to 0.2, the limit is {limit:.3g} %"
    room = limit - (there - smooth)
    assert str(result.status).endswith(
        f"the rig adds {there - smooth:.3g} % to Overshoot: "
        + (f"tune with at most {room:.3g} %" if room > 0 else "relax its limit")
    )
    assert result.parameters.value("pid.Kp") == given().value("pid.Kp")
    assert result.best["pid.Kp"] == 300.0
    assert result.on_rig is not None


def test_a_limit_is_relaxed_only_where_the_loop_settles_on_the_rig() -> None:
    """It would not help where the loop never settles."""
    spec = specify(SettlingTime(), [Overshoot(0.02)])
    search = prepare_search(prepare_task(LOOP, STEP, given(), spec))
    design = search.certify_point(search.space.start)
    settles = design.certified.copy()
    settles.loc["Overshoot"] = design.certified.loc["Overshoot"] + 50.0
    never = settles.copy()
    never.loc["SettlingTime"] = np.nan
    told = [list(_remedies(search.task, design, found)) for found in (settles, never)]
    assert [[line.endswith("relax its limit") for line in lines] for lines in told] == [[True], []]


def test_tune_takes_the_rig() -> None:
    quick = Racing(members=8, trials=20)
    rig = Rig(STICKING, SENSORS, Actuator(dead_zone=60.0))
    with pytest.raises(ConvergenceError, match=r"on the rig it never settles at 0 to 0\.2") as refused:
        tune(LOOP, STEP, given(400.0, 4000.0), minimise=SettlingTime(), rig=rig, plants={}, method=quick)
    assert refused.value.solution.parameters.value("pid.Kp") == 400.0


def test_another_loop_s_rig_is_refused_before_the_search() -> None:
    other = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(sample_time=1e-3))
    with pytest.raises(InputError, match="another PID; make the rig of the same loop"):
        tune(LOOP, STEP, given(), minimise=SettlingTime(), rig=Rig(other, SENSORS))


PUSHED = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=2e-3, dead_band=True), measured="position")
STUCK = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PUSHED.pid, measured="position")
HUNTING = {"pid.Kp": 5000.0, "pid.Ki": 100000.0, "pid.Kd": 200.0, "friction.stribeck_velocity": 1e-3}


@pytest.mark.slow  # 4 to 5 s
@pytest.mark.parametrize("width", [0.0, 0.01])
def test_a_loop_that_hunts_on_the_rig_is_not_certified_where_that_is_asked(width: float) -> None:
    step, rig = Step(0.1, horizon=0.6), Rig(STUCK, {"position": Sensor()})
    values = PUSHED.parameters.with_values(HUNTING | {"pid.dead_band": width})
    free = values.with_bounds({"pid.Kp": (4900.0, 5100.0)}).freed("pid.Kp")
    task = prepare_task(PUSHED, step, free, specify(IAE(), [NoHunting(8.0)]))
    design = prepare_search(task).certify_point(task.space.start)
    own = values.select(n for n in values if n in STUCK.parameters)
    on_rig = evaluate(rig, step, own)
    found = _watch_rest(task, replace(design, on_rig=on_rig), rig, own, NoHunting(8.0))
    assert found.rest is not None
    assert found.rest.duration == 8.0
    if width:
        assert found.rest.rests
        assert "on the rig it comes to rest, watched for 8 s" in str(found.status)
        return
    assert not found.status.converged
    assert re.match(
        r"on the rig at 0 to 0\.1 the loop hunts by \+-\S+ \S+, a cycle in .*: the integral pushes",
        found.status.verdict,
    )


def test_no_hunting_asks_for_a_rig_and_a_duration() -> None:
    with pytest.raises(InputError, match=r"NoHunting is read on the event-accurate model .*; give rig="):
        tune(LOOP, STEP, given(), minimise=SettlingTime(), subject_to=[NoHunting()], plants={})
    with pytest.raises(InputError, match="NoHunting: duration must be positive"):
        NoHunting(0.0)
    with pytest.raises(InputError, match="NoHunting: repeatability must be positive"):
        NoHunting(repeatability=0.0)
    one, rig = [NoHunting(repeatability=1e-4)], Rig(STICKING, SENSORS)
    with pytest.raises(InputError, match="repeatability is a range over references, and there is one; give more"):
        tune(LOOP, STEP, given(), minimise=SettlingTime(), subject_to=one, rig=rig, plants={})


def test_of_several_limits_on_rest_the_tightest_hold() -> None:
    asked = specify(IAE(), [NoHunting(8.0), NoHunting(20.0, 1e-3), NoHunting(5.0, 1e-4)]).rest
    assert asked == NoHunting(20.0, 1e-4)
    assert specify(IAE()).rest is None


@pytest.mark.slow  # 6 to 8 s
def test_a_design_that_stops_elsewhere_from_another_start_is_not_certified_where_that_is_asked() -> None:
    """Without an integral a body sticks short of the reference, on the side from which it comes."""
    steps = [Step(0.1, horizon=0.6), Step(-0.1, initial=0.2, horizon=0.6)]
    rig = Rig(STUCK, {"position": Sensor()})
    values = PUSHED.parameters.with_values(HUNTING | {"pid.Ki": 0.0})
    free = values.with_bounds({"pid.Kp": (4900.0, 5100.0)}).freed("pid.Kp")
    task = prepare_task(PUSHED, steps, free, specify(IAE(), [NoHunting(2.0)]))
    design = prepare_search(task).certify_point(task.space.start)
    own = values.select(n for n in values if n in STUCK.parameters)
    span = check_rest(rig, steps, own, duration=2.0).repeatability
    assert 1e-4 < span < 0.1
    wide, narrow = (_watch_rest(task, design, rig, own, NoHunting(2.0, k * span)) for k in (1.01, 0.99))
    assert "on the rig it comes to rest, watched for 2 s" in str(wide.status)
    assert not narrow.status.converged
    told = rf"on the rig its errors at rest range over {1e3 * span:.3g} mm, the limit of repeatability is \S+ mm"
    assert re.match(told, narrow.status.verdict)
    assert narrow.rest is not None
