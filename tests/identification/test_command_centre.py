"""A valve's command that was logged from 0 to 10 V is counted from 5 V; one about 0 V stays as it is."""

import warnings

import numpy as np
import pytest

import pneuopt as po
from pneuopt.identification.checks import check_logs

DRIVE = po.PneumaticDrive(friction=po.Viscous())


def logged(centre: float, rest: float = 0.05, swing: float = 2.0) -> po.Experiment:
    """A piston that stands between two strokes, while its command rests a little off the valve's middle."""
    t = np.arange(600) * 2e-3
    moving = np.where((t > 0.2) & (t < 0.5), 1.0, np.where((t > 0.8) & (t < 1.1), -1.0, 0.0))
    position = 0.05 + np.cumsum(moving) * 2e-3 * 0.1 + 1e-6 * np.sin(1e3 * t)
    command = centre + np.where(moving == 0, rest, swing * moving)
    pressures = {f"pressure_{s}": 3e5 + 1e4 * np.sin(9 * t) for s in "ab"}
    return po.Experiment(po.Trajectory(t, {"valve_voltage": command, "position": position, **pressures}), name="run")


def checked(log: po.Experiment) -> po.Experiment:
    return check_logs(DRIVE.system(), [log], DRIVE.parameters)[0]


def test_a_command_from_0_to_10_V_is_counted_from_5_V_in_words() -> None:
    words = r'run: valve_voltage rests at 5.05 V .* the valve is closed at 5 V.* centre = "5 V"'
    with pytest.warns(po.PhysicsWarning, match=words):
        found = checked(logged(5.0))
    np.testing.assert_allclose(found.trajectory["valve_voltage"], logged(0.0).trajectory["valve_voltage"], atol=1e-12)


@pytest.mark.parametrize(
    ("centre", "rest", "swing"),
    [(0.0, 0.05, 2.0), (0.0, 0.05, 5.0), (2.0, 0.05, 1.0), (5.0, 2.0, 4.0), (5.0, 0.05, 6.0)],
    ids=["about zero", "full range about zero", "rests at 2 V", "held by 7 V", "beyond 10 V"],
)
def test_another_command_stays_as_it_is(centre: float, rest: float, swing: float) -> None:
    log = logged(centre, rest, swing)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = checked(log)
    np.testing.assert_array_equal(found.trajectory["valve_voltage"], log.trajectory["valve_voltage"])


def test_the_valves_span_counts_and_a_log_knows_its_own() -> None:
    log = logged(5.0).with_conditions({"valve.span": 10.0})
    np.testing.assert_array_equal(checked(log).trajectory["valve_voltage"], log.trajectory["valve_voltage"])


def test_a_log_without_motion_sensors_counts_as_a_whole() -> None:
    log = logged(5.0).select(["valve_voltage", "pressure_a", "pressure_b"])
    with pytest.warns(po.PhysicsWarning, match="closed at 5 V"):
        assert abs(float(np.median(checked(log).trajectory["valve_voltage"]))) < 1
