import control
import numpy as np
import pytest

from pneuopt.certify import evaluate, respond
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.margins import frequency_response, margins, robustness
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import SensorLag
from pneuopt.errors import InputError, ModelError
from pneuopt.instruments import Encoder, Sensor
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic_drive import PneumaticDrive
from pneuopt.requirements import MaxSensitivity, SettlingTime
from pneuopt.rig import Rig
from pneuopt.system import define
from pneuopt.tune import tune
from pneuopt.tuning.two_phase import TwoPhase

LAG = 5e-3


def first_order(sample_time: float | None = None) -> ClosedLoop:
    """1/(0.05 s + 1) under a PI, seen through a lag."""
    return ClosedLoop(FirstOrder().system(), PID(sample_time, limits=False), sensor=SensorLag(LAG))


def test_the_open_loop_has_the_sensors_pole() -> None:
    loop = first_order()
    p = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 30.0})
    s, w = control.tf("s"), np.geomspace(0.1, 1e3, 30)
    gain, T = (p.value(n) for n in p if n in loop.plant.parameters)
    expected = gain / (T * s + 1) * (2 + 30 / s) / (LAG * s + 1)
    ours = frequency_response(loop.open_loop(p), w)
    assert ours == pytest.approx(np.array([expected(1j * v) for v in w]), rel=1e-9)
    x, numbers = np.zeros((1, len(loop.plant.states))), loop.numbers(p)[None]
    found = robustness(loop, np.geomspace(1.0, 1e3, 2000))(numbers, x, np.zeros(1), ("MaxSensitivity",))
    assert found["MaxSensitivity"][0] == pytest.approx(margins(loop.open_loop(p)).max_sensitivity, rel=1e-4)


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_the_response_is_the_plants_and_the_controller_sees_it_late(sample_time: float | None) -> None:
    loop = first_order(sample_time)
    p = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 30.0})
    run = respond(loop, Step(1.0, horizon=0.5), p)
    s = control.tf("s")
    gain, T = (p.value(n) for n in p if n in loop.plant.parameters)
    plant, controller = gain / (T * s + 1), 2 + 30 / s
    closed = control.minreal(plant * controller / (1 + plant * controller / (LAG * s + 1)), verbose=False)
    expected = control.step_response(closed, run.t).outputs
    assert run["speed"] == pytest.approx(expected, abs=1e-6 if sample_time is None else 0.02)
    assert np.max(np.abs(run["speed"] - run["sensor.reading"])) > 0.05


def test_it_begins_at_the_truth() -> None:
    loop = ClosedLoop(PneumaticDrive().system(), PID(1e-3), sensor=SensorLag(LAG))
    x = loop.initial(loop.parameters, reference=0.2, start={"position": 0.05})
    state = dict(zip([q.name for q in loop.states], x, strict=True))
    assert state["sensor.reading"] == state["speed"] == 0.2


def test_requirements_are_read_on_the_true_signal() -> None:
    """A lag hides overshoot from the controller; the tuner and the certificate see it."""
    loop = first_order()
    given = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 300.0})
    metrics, run = evaluate(loop, Step(1.0, horizon=0.5), given)["0 to 1"], respond(loop, Step(1.0, horizon=0.5), given)
    assert metrics["Overshoot"] == pytest.approx(100 * (run["speed"].max() - 1), rel=1e-6)
    assert metrics["Overshoot"] > 100 * (run["sensor.reading"].max() - 1) + 1


def test_tuning_knows_the_lag() -> None:
    bounds, found = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 500.0)}, {}
    for lag in (1e-3, 2e-2):
        loop = ClosedLoop(FirstOrder().system(), PID(limits=False), sensor=SensorLag(lag))
        given = loop.parameters.with_bounds(bounds).freed(*bounds)
        best = tune(
            loop,
            Step(1.0, horizon=0.5),
            given,
            minimise=SettlingTime(),
            subject_to=[MaxSensitivity(1.6)],
            method=TwoPhase((20, 25), starts=1),
        )
        found[lag] = best.certified["0 to 1"]["SettlingTime"]
    assert found[2e-2] > 2 * found[1e-3]


def test_a_rig_has_sensors_of_its_own() -> None:
    """The loop's lag is what its tuner assumes; behind a rig's encoder it counts no second time."""
    drive = ForceDrive(Viscous()).system()
    seen, plain = (ClosedLoop(drive, PID(1e-3), sensor=sensor) for sensor in (SensorLag(LAG), None))
    values = {"pid.Kp": 300.0, "pid.Ki": 4000.0}
    sensors, encoder = {"position": Sensor(resolution=1e-6)}, Encoder(filter_time=LAG)
    runs = [
        respond(Rig(loop, sensors, encoder=encoder), Step(0.1, horizon=0.2), loop.parameters.with_values(values))
        for loop in (seen, plain)
    ]
    assert np.array_equal(runs[0]["speed"], runs[1]["speed"])
    smooth = respond(seen, Step(0.1, horizon=0.2), seen.parameters.with_values(values))
    assert np.max(np.abs(np.interp(runs[0].t, smooth.t, smooth["speed"]) - runs[0]["speed"])) < 2e-3


def test_an_output_without_lag_needs_a_sensor() -> None:
    u, y = FirstOrder().system().inputs[0], FirstOrder().system().outputs[0]
    direct = define(
        [y],
        [u],
        [y],
        FirstOrder().system().parameters,
        lambda _t, x, v, _p: ({y.name: -x[y.name]}, {y.name: v[u.name]}),
    )
    with pytest.raises(ModelError, match="a sensor with a lag"):
        ClosedLoop(direct, PID())
    assert ClosedLoop(direct, PID(), sensor=SensorLag(LAG)).states[1].name == "sensor.reading"


def test_a_lag_of_zero_is_no_sensor() -> None:
    with pytest.raises(InputError, match="leave the sensor out"):
        SensorLag(0.0)
