"""A design on the rig's own model: what breaks there is not certified, and is said in words."""

import pandas as pd
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.evaluation.specification import specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.karnopp import Karnopp
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.on_rig import certify_on_rig
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import TuningResult, prepare_search, prepare_task, tune

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
    assert result.stats["rejected.pid.Kp"] == 300.0
    assert result.on_rig is not None


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
