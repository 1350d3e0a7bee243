"""A plant identified inside its loop, simple or composed, from logs that hold the reference but not the command."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.compensators import (
    AccelerationFeedback,
    DeadZoneInverse,
    FrictionFeedforward,
    Knocker,
    MotionFeedforward,
    PressureFeedback,
)
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveSequence
from pneuopt.control.pid import PID
from pneuopt.control.sensor import SensorLag
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.forecast import predict, validate
from pneuopt.identification.identify import identify
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.logs.experiment import Experiment
from pneuopt.models.catalog import s25
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

TRUTH = {"load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
GAINS = {"pid.Kp": 300.0, "pid.Ki": 2000.0, "pid.Kd": 1.0, "pid.Tf": 5e-3, "pid.lower": -60.0, "pid.upper": 60.0}
NOISE = {"position": 2e-5, "speed": 1e-3}


def loop_of(h: float = 2e-3, sensor: SensorLag | None = None) -> ClosedLoop:
    return ClosedLoop(ForceDrive(Coulomb()).system(), PID(sample_time=h), sensor=sensor)


def given(loop: ClosedLoop) -> ParameterSet:
    return loop.parameters.with_values({**TRUTH, **GAINS})


def logged(loop: ClosedLoop, *channels: str, h: float = 1e-3, seed: int = 0) -> tuple[Experiment, Trajectory]:
    """A speed loop that starts, stops and turns, in and out of saturation; and the truth."""
    t = np.arange(round(1.5 / h)) * h
    wanted = np.select([t < 0.1, t < 0.4, t < 0.7, t < 1.0, t < 1.2], [0.0, 0.3, -0.2, 0.05, 0.4], -0.1)
    run = simulate(loop, Trajectory(t, {"reference": wanted}), given(loop), initial=[0.0] * len(loop.states))
    random = np.random.default_rng(seed)
    noisy = {n: run[n] + NOISE[n] * random.standard_normal(t.size) for n in channels}
    log = Experiment(Trajectory(t, {"speed_reference": wanted, **noisy}), {n: NOISE[n] for n in channels}, name="loop")
    return log, run


@pytest.mark.parametrize(("h", "channels"), [(2e-3, ("position",)), (1e-3, ("position", "speed")), (4e-3, ("speed",))])
def test_a_plant_is_identified_in_its_saturated_loop(h: float, channels: tuple[str, ...]) -> None:
    loop = loop_of(h)
    log, run = logged(loop, *channels)
    assert np.mean(np.abs(run["control"]) >= GAINS["pid.upper"]) > 0.03
    start = given(loop).with_values({n: loop.parameters.value(n) for n in TRUTH}).freed(*TRUTH)
    fit = identify(loop, [log], start)
    for name, row in fit.estimates.loc[[*TRUTH]].iterrows():
        assert abs(row["value"] - TRUTH[str(name)]) < 4 * row["stderr"], name
        assert row["value"] == pytest.approx(TRUTH[str(name)], rel=0.02)
    assert fit.stats["chi_square_ratio"] == pytest.approx(1, abs=0.15)


def test_the_controller_is_replayed_exactly_along_an_exact_log() -> None:
    """The held-out run is the truth, and so is the command that the start reconstructs once the integral is known."""
    loop = loop_of()
    log, run = logged(loop, "position", "speed")
    exact = log.trajectory.with_columns({"speed": run["speed"]})
    from_rest, empty = LoggedLoop(loop).starts({"loop": Log(exact, given(loop).freed("load.mass"))})
    assert "from rest" in from_rest.label
    assert "empty integral" in empty.label
    held = np.append(run["control"][:-1][::2], 0.0)
    np.testing.assert_allclose(empty.states["loop"]["pid.command"][1::2], held[: len(held) - 1], atol=1e-6)
    assert validate(loop, [log], given(loop))["fit_percent"].min() > 99
    # what the derivative was at the first sample, a noisy log hardly shows; it fades within a few Tf
    np.testing.assert_allclose(predict(loop, log, given(loop))["control"][50:], run["control"][50:], atol=1.0)


def test_a_lagging_sensor_is_part_of_the_loop() -> None:
    loop = loop_of(sensor=SensorLag(4e-3))
    log, _ = logged(loop, "position", "speed")
    fit = identify(loop, [log], given(loop).freed("friction.coulomb", "load.mass"))
    assert fit.estimates["value"]["load.mass"] == pytest.approx(3.0, rel=0.01)


def speed_steps(loop: ClosedLoop, known: ParameterSet) -> Experiment:
    """A log of a speed loop's reference and its noisy position, while the reference steps up and back."""
    t = np.arange(600) * 1e-3
    wanted = np.where(t < 0.1, 0.0, np.where(t < 0.35, 0.3, -0.2))
    run = simulate(loop, Trajectory(t, {"reference": wanted}), known, initial=[0.0] * len(loop.states))
    noisy = run["position"] + NOISE["position"] * np.random.default_rng(1).standard_normal(t.size)
    return Experiment(Trajectory(t, {"speed_reference": wanted, "position": noisy}), {"position": NOISE["position"]})


def test_a_delay_and_a_feedforward_are_part_of_the_loop() -> None:
    drive = ForceDrive(Coulomb()).system()
    loop = ClosedLoop(drive, PID(2e-3, delay=1), feedforward=Feedforward(0.05))
    known = given(loop).with_values({"feedforward.gain": 100.0})
    fit = identify(loop, [speed_steps(loop, known)], known.freed("friction.coulomb", "load.mass"))
    assert fit.estimates["value"]["load.mass"] == pytest.approx(3.0, rel=0.01)


def test_what_compensators_add_is_part_of_the_loop() -> None:
    """Their pulses and their inverse are replayed from the log's first sample on."""
    drive = ForceDrive(Coulomb()).system()
    loop = ClosedLoop(drive, PID(2e-3), compensators=(Knocker(), DeadZoneInverse()))
    sizes = {"knocker.amplitude": 8.0, "knocker.smoothing": 2.0, "dead_zone_inverse.width": 5.0}
    known = given(loop).with_values({**sizes, "dead_zone_inverse.smoothing": 2.0})
    fit = identify(loop, [speed_steps(loop, known)], known.freed("friction.coulomb", "load.mass"))
    assert fit.estimates["value"]["load.mass"] == pytest.approx(3.0, rel=0.01)


def test_a_position_loop_needs_some_motion_to_start_from() -> None:
    drive = ForceDrive(Coulomb()).system()
    loop = ClosedLoop(drive, PID(sample_time=1e-3), measured="position")
    t = np.arange(100) * 1e-3
    log = Trajectory(t, {"position_reference": np.ones(100), "speed": np.sin(t)})
    held = LoggedLoop(loop)
    start, *_ = held.starts({"a": Log(log, loop.parameters)})
    assert start.states["a"]["pid.integral"][0] == 0.0
    with pytest.raises(LogError, match="the loop feeds back 'position'"):
        held.starts({"a": Log(log.select(["position_reference"]), loop.parameters)})


H = 2e-3
AXIS_TRUTH = {"load.mass": 3.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
AXIS_NOISE = {"position": 5e-6, "pressure_a": 200.0, "pressure_b": 200.0}
INNER = {"pid.Kp": 300.0, "pid.Ki": 3000.0, "position_loop.Kp": 20.0, "position_loop.weight": 1.0}
OUTER = {"pid.Kp": 4000.0, "pid.Ki": 8000.0, "pid.Kd": 150.0, "pid.Tf": 4e-3}
PUSHED = {"motion_feedforward.speed": 50.0, "motion_feedforward.acceleration": 2.5, "friction_feedforward.level": 20.0}
MOVES = (Move(0.1, speed=0.4, acceleration=8.0, dwell=0.1), Move(-0.06, speed=0.05, acceleration=2.0, dwell=0.1))


def cascade(*parts: Any) -> tuple[ClosedLoop, dict[str, float]]:
    pid = PID(H, limits=False)
    drive = ForceDrive(Coulomb()).system()
    return ClosedLoop(drive, pid, measured="position", outer=PositionLoop(), compensators=parts), AXIS_TRUTH | INNER


def fed_forward() -> tuple[ClosedLoop, dict[str, float]]:
    parts, drive = (MotionFeedforward(), AccelerationFeedback(), FrictionFeedforward()), ForceDrive(Coulomb()).system()
    given = AXIS_TRUTH | OUTER | PUSHED | {"acceleration_feedback.gain": 0.5, "acceleration_feedback.filter": 8e-3}
    return ClosedLoop(drive, PID(H, limits=False, delay=1), measured="position", compensators=parts), given


def pressure_fed() -> tuple[ClosedLoop, dict[str, float]]:
    drive, known = PneumaticDrive(friction=Stribeck()), s25()[1]
    loop = ClosedLoop(drive.system(), PID(H, limits=False), measured="position", compensators=(PressureFeedback(),))
    gains = {"pid.Kp": 30.0, "pid.Kd": 0.5, "pid.Tf": 5e-3, "pressure_feedback.gain": 3e-6}
    own = {n: known.value(n) for n in drive.parameters if n in known}
    return loop, own | gains | {"friction.smoothing": 2e-3, "load.mass": 3.0, "friction.viscous": 60.0}


COMPOSITIONS = {
    "cascade": cascade,
    "cascade with feedforward": lambda: cascade(MotionFeedforward()),
    "feedforward and acceleration": fed_forward,
}


def logged_moves(
    loop: ClosedLoop, given: ParameterSet, origin: float = 0.0, *channels: str, log_rates: bool = False
) -> Experiment:
    """The loop along the moves, by an integration that shares no step with the fit's, with noise."""
    moves = MoveSequence([replace(MOVES[0], at=0.05, initial=origin), *MOVES[1:]])
    driven = moves.trajectory(H)
    x0 = loop.initial(given, reference=origin)
    run = simulate(loop, driven.select([q.name for q in loop.inputs]), given, initial=x0)
    rng = np.random.default_rng(7)
    shown = {n: run[n] + AXIS_NOISE[n] * rng.standard_normal(len(driven)) for n in ("position", *channels)}
    rates = {"speed_reference": driven["reference_speed"]} if log_rates else {}
    columns = {"position_reference": driven["reference"], **rates, **shown}
    return Experiment(Trajectory(driven.t, columns), {n: AXIS_NOISE[n] for n in shown}, name="moves")


@pytest.mark.parametrize(
    ("name", "log_rates"),
    [
        ("cascade", True),
        pytest.param("cascade", False, marks=pytest.mark.slow),
        pytest.param("cascade with feedforward", False, marks=pytest.mark.slow),
        pytest.param("feedforward and acceleration", False, marks=pytest.mark.slow),
        pytest.param("feedforward and acceleration", True, marks=pytest.mark.slow),
    ],
)
def test_a_plant_is_identified_under_a_composed_controller(name: str, log_rates: bool) -> None:
    loop, values = COMPOSITIONS[name]()
    given = loop.parameters.with_values(values)
    log = logged_moves(loop, given, log_rates=log_rates)
    start = given.with_values({n: loop.parameters.value(n) for n in AXIS_TRUTH}).freed(*AXIS_TRUTH)
    fit = identify(loop, [log], start)
    for parameter, row in fit.estimates.loc[[*AXIS_TRUTH]].iterrows():
        assert row["value"] == pytest.approx(AXIS_TRUTH[str(parameter)], rel=0.02), parameter
        assert abs(row["value"] - AXIS_TRUTH[str(parameter)]) < 4 * row["stderr"], parameter
    assert fit.stats["chi_square_ratio"] == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_a_pneumatic_drive_is_identified_under_pressure_feedback() -> None:
    loop, values = pressure_fed()
    given = loop.parameters.with_values(values)
    log = logged_moves(loop, given, 0.08, "pressure_a", "pressure_b")
    wanted = {n: given.value(n) for n in ("friction.coulomb", "friction.viscous", "load.mass")}
    fit = identify(loop, [log], given.with_values({n: 1.3 * v for n, v in wanted.items()}).freed(*wanted))
    for parameter, row in fit.estimates.iterrows():
        assert row["value"] == pytest.approx(wanted[str(parameter)], rel=0.02), parameter


def test_the_controller_of_a_cascade_is_replayed_as_it_ran() -> None:
    """Along exact signals the start's states are those that the loop itself had."""
    loop, values = cascade(MotionFeedforward())
    given = loop.parameters.with_values(values)
    driven = MoveSequence([replace(MOVES[0], at=0.05), *MOVES[1:]]).trajectory(H)
    x0 = loop.initial(given)
    run = simulate(loop, driven.select([q.name for q in loop.inputs]), given, initial=x0)
    columns = {"position_reference": driven["reference"], "speed_reference": driven["reference_speed"]}
    exact = Trajectory(driven.t, columns | {"position": run["position"], "speed": run["speed"]})
    start = LoggedLoop(loop).starts({"a": Log(exact, given.freed("load.mass"))})[0]
    np.testing.assert_allclose(start.states["a"]["pid.command"][1:], run["control"][:-1], atol=1e-5)


def test_rates_are_differences_of_the_reference_at_the_controllers_samples() -> None:
    """Two samples of the log for each of the controller's: what is between them is held."""
    loop, _ = fed_forward()
    t = np.arange(9) * H / 2
    r = np.repeat((np.arange(5) * H) ** 2, 2)[:9]
    log = Trajectory(t, {"position_reference": r, "position": r})
    held = LoggedLoop(loop)
    found = held.input_matrix(log, "a")
    names = [q.name for q in held.discrete().inputs]
    speed, acceleration = (found[:, names.index(f"reference_{n}")] for n in ("speed", "acceleration"))
    np.testing.assert_allclose(speed[2:6], 2 * H * np.array([1, 1, 2, 2]))
    np.testing.assert_allclose(acceleration[2:6], [1.5, 1.5, 2.0, 2.0], atol=1e-9)  # an end's slope is one-sided
    assert speed[0] == speed[1]
    beside = log.with_columns({"speed_reference": np.full(9, 7.0)})
    np.testing.assert_array_equal(held.input_matrix(beside, "a")[:, names.index("reference_speed")], 7.0)


@pytest.mark.parametrize("name", [*COMPOSITIONS, "pressure"])
def test_the_step_of_the_loop_has_the_derivatives_of_its_differences(name: str) -> None:
    """Of the sampled update and of the held step to states and free parameters, away from where they switch."""
    loop, values = {**COMPOSITIONS, "pressure": pressure_fed}[name]()
    given = loop.parameters.with_values(values)
    discrete, p = LoggedLoop(loop).discrete(), loop.parameter_vector(given)
    x, u = loop.initial(given, reference=0.08), np.ones(len(discrete.inputs))
    x[:2] += [0.013, 0.11]
    u[0] = 0.1
    assert discrete.update is not None
    xs, ps = ca.SX.sym("x", len(x)), ca.SX.sym("p", len(p))
    stepped = discrete.step(0.0, 1e-5, discrete.update(0.0, xs, u, ps), u, ps)[0]
    whole = ca.Function("whole", [xs, ps], [stepped, ca.jacobian(stepped, xs), ca.jacobian(stepped, ps)])
    _, by_x, by_p = (np.asarray(m) for m in whole(x, p))
    nominal = np.array([q.nominal for q in discrete.states])
    own = by_x / nominal[:, None] * nominal
    found = _differences(lambda v: np.asarray(whole(v, p)[0]).ravel(), x, nominal) / nominal[:, None] * nominal
    np.testing.assert_allclose(own, found, rtol=1e-3, atol=1e-6 * np.abs(own).max())
    free = [list(loop.parameters).index(n) for n in ("load.mass", "pid.Kp")]
    own, sizes = by_p[:, free] / nominal[:, None], np.abs(p) + 1e-3
    found = _differences(lambda v: np.asarray(whole(x, v)[0]).ravel(), p, sizes)[:, free] / nominal[:, None]
    np.testing.assert_allclose(own, found, rtol=1e-3, atol=1e-6 * np.abs(own).max())


def _differences(function: Any, at: Array, sizes: Array) -> Array:
    columns = []
    for k, value in enumerate(at):
        h = 1e-5 * sizes[k]
        up, down = at.copy(), at.copy()
        up[k], down[k] = value + h, value - h
        columns.append((function(up) - function(down)) / (2 * h))
    return np.column_stack(columns)
