import control
import numpy as np
import pytest

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import define
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.margins import batch_margin_function, frequency_response, margins
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.evaluation.scenarios import Scenarios, corners
from pneuopt.evaluation.specification import specify
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import ModelError
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import tune
from pneuopt.tuning.two_phase import TwoPhase

LAG = 5e-3
QUICK = Racing(members=8, trials=40, polish=16)


def first_order(sample_time: float | None = None) -> ClosedLoop:
    """1/(0.05 s + 1) under a PI, seen through a lag."""
    return ClosedLoop(FirstOrder().system(), PID(sample_time, limits=False), sensor=SensorLag(LAG))


def test_the_open_loop_has_the_sensors_pole() -> None:
    loop = first_order()
    p = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 30.0})
    s, w = control.tf("s"), np.geomspace(0.1, 1e3, 30)
    gain, T = (p.value(f"plant.{n}") for n in ("gain", "time_constant"))
    expected = gain / (T * s + 1) * (2 + 30 / s) / (LAG * s + 1)
    ours = frequency_response(open_loop(loop, p), w)
    assert ours == pytest.approx(np.array([expected(1j * v) for v in w]), rel=1e-9)
    x, numbers = np.zeros((1, len(loop.plant.states))), loop.parameter_vector(p)[None]
    found = batch_margin_function(loop, np.geomspace(1.0, 1e3, 2000))(
        numbers, x[None], np.zeros((1, 1, 1)), ("MaxSensitivity",)
    )
    assert found["MaxSensitivity"][0] == pytest.approx(margins(open_loop(loop, p)).max_sensitivity, rel=1e-4)


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_the_response_is_the_plants_and_the_controller_sees_it_late(sample_time: float | None) -> None:
    loop = first_order(sample_time)
    p = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 30.0})
    run = respond(loop, Step(1.0, horizon=0.5), p)
    s = control.tf("s")
    gain, T = (p.value(f"plant.{n}") for n in ("gain", "time_constant"))
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
            plants={},
        )
        found[lag] = best.certified["0 to 1"]["SettlingTime"]
    assert found[2e-2] > 2 * found[1e-3]


def test_a_rig_has_sensors_of_its_own() -> None:
    """The loop's lag is what its tuner assumes; behind a rig's encoder it counts no second time."""
    drive = ForceDrive(Viscous()).system()
    seen, plain = (ClosedLoop(drive, PID(1e-3), sensor=sensor) for sensor in (SensorLag(LAG), None))
    values = {"pid.Kp": 300.0, "pid.Ki": 4000.0}
    sensors, encoder = {"position": Sensor(resolution=1e-6)}, Encoder(filter=LAG)
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
    with pytest.raises(ModelError, match="algebraic loop"):
        ClosedLoop(direct, PID())
    assert ClosedLoop(direct, PID(), sensor=SensorLag(LAG)).states[1].name == "sensor.reading"


def encoder_loop(encoder: Encoder, measured: str = "speed") -> ClosedLoop:
    return ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), sensor=encoder, measured=measured)


SPEED_GAINS = {"pid.Kp": 300.0, "pid.Ki": 4000.0}


@pytest.mark.parametrize("resolution", [1e-5, 2e-4])
def test_an_encoder_shows_what_a_rigs_does(resolution: float) -> None:
    """`Rig` rounds and differentiates on its own; from rest the responses are the same, count by count."""
    loop = encoder_loop(Encoder(resolution, LAG))
    given = loop.parameters.with_values(SPEED_GAINS)
    rig = Rig(ClosedLoop(loop.plant, PID(1e-3)), {"position": Sensor(resolution=resolution)}, encoder=Encoder(0.0, LAG))
    ours, theirs = respond(loop, Step(0.1, horizon=0.2), given), respond(rig, Step(0.1, horizon=0.2), given)
    assert np.interp(theirs.t, ours.t, ours["speed"]) == pytest.approx(theirs["speed"], abs=1e-6)
    counts = Rig(rig.model, {"position": Sensor()}, encoder=Encoder(resolution, LAG))
    assert respond(counts, Step(0.1, horizon=0.2), given)["speed"] == pytest.approx(theirs["speed"], abs=1e-12)


def test_a_position_loop_sees_the_counts() -> None:
    loop = encoder_loop(Encoder(1e-3), "position")
    values = {"pid.Kp": 400.0, "pid.Kd": 40.0, "pid.Tf": 5e-3}
    assert [n for n in loop.parameters if n.startswith("sensor.")] == ["sensor.resolution"]
    run = respond(loop, Step(0.05, horizon=0.2), loop.parameters.with_values(values))
    at = run.t % 1e-3 < 1e-9
    expected = 1e-3 * np.floor(run["position"][at] / 1e-3 + 0.5)
    assert run["sensor.reading"][at] == pytest.approx(expected, abs=1e-12)


def test_a_fine_encoder_is_a_lag_of_its_filter_and_half_a_sample() -> None:
    drive = ForceDrive(Viscous()).system()
    loops = [ClosedLoop(drive, PID(1e-3), sensor=sensor) for sensor in (Encoder(1e-9, LAG), SensorLag(LAG + 5e-4))]
    runs = [respond(loop, Step(0.1, horizon=0.2), loop.parameters.with_values(SPEED_GAINS)) for loop in loops]
    assert runs[0]["speed"] == pytest.approx(runs[1]["speed"], abs=2e-4)
    fine, lagging = (open_loop(loop, loop.parameters.with_values(SPEED_GAINS)) for loop in loops)
    assert margins(fine).max_sensitivity == pytest.approx(margins(lagging).max_sensitivity, rel=2e-3)


@pytest.mark.parametrize("h", [1e-3, 5e-3])
@pytest.mark.parametrize("filter_time", [0.0, LAG])
def test_an_encoders_margins_are_those_of_the_sampled_loop(h: float, filter_time: float) -> None:
    """Against the exact z-transform: the position's zero-order hold, difference, filter, controller."""
    loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(h), sensor=Encoder(1e-5, filter_time))
    given = loop.parameters.with_values(SPEED_GAINS)
    plant = control.tf([1], [given.value("load.mass"), given.value("friction.viscous"), 0])
    w = np.geomspace(1.0, 0.99 * np.pi / h, 4000)
    z = np.exp(1j * w * h)
    slope = (1 - 1 / z) / h
    L = control.sample_system(plant, h, "zoh")(z) * slope / (1 + filter_time * slope) * (300 + 4000 / slope)
    ours = open_loop(loop, given)
    assert margins(ours).max_sensitivity == pytest.approx(np.max(1 / np.abs(1 + L)), rel=1e-5)
    x, numbers = np.zeros((1, 2)), loop.parameter_vector(given)[None]
    found = batch_margin_function(loop, np.geomspace(1.0, 1e3, 2000))(
        numbers, x[None], np.zeros((1, 1, 1)), ("MaxSensitivity",)
    )
    assert found["MaxSensitivity"][0] == pytest.approx(margins(ours).max_sensitivity, rel=1e-4)


@pytest.mark.parametrize("step", [Step(0.1, horizon=0.4), Step(0.1, at=0.05, initial=0.0537, horizon=0.4)])
def test_search_and_certificate_count_alike(step: Step) -> None:
    loop = encoder_loop(Encoder(2e-5, LAG))
    given = loop.parameters.with_values(SPEED_GAINS).with_bounds({"pid.Kp": (50.0, 600.0)}).freed("pid.Kp")
    (claimed,) = Simulator(loop, [step], search_space(loop, given)).table(np.array([300.0]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    assert np.isfinite(certified["SettlingTime"])
    for name in ("SettlingTime", "Overshoot", "PeakControl", "MaxSensitivity"):
        assert claimed[name] == pytest.approx(certified[name], rel=1e-3, abs=2e-4), name


def test_counts_are_tuned_without_gradients() -> None:
    loop = encoder_loop(Encoder(2e-5, LAG))
    given = loop.parameters.with_values(SPEED_GAINS).with_bounds({"pid.Kp": (50.0, 600.0)}).freed("pid.Kp")

    def tuned(loop: ClosedLoop, method: Racing, scenarios: Scenarios) -> bool:
        step, limits = Step(0.1, horizon=0.3), [Overshoot(0.1)]
        goal = SettlingTime()
        found = tune(loop, step, given, minimise=goal, subject_to=limits, method=method, scenarios=scenarios, plants={})
        return found.status.converged

    assert tuned(loop, QUICK, corners(given, {"load.mass": 0.1}))
    assert tuned(encoder_loop(Encoder(0.0, LAG)), QUICK, {})


def test_an_encoder_has_no_derivatives() -> None:
    with pytest.raises(ModelError, match="no derivatives through an Encoder"):
        LoggedLoop(encoder_loop(Encoder(1e-5)))
