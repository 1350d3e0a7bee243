""""""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.logs.experiment import Experiment, differentiate, resample, split
from pneuopt.quantities.errors import InputError, LogError
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from tests.logs.styles import POSITION, PRESSURE, STAMPS, TIME


def ramp(n: int = 1001, step: float = 1e-3) -> Experiment:
    t = 5.0 + step * np.arange(n)
    return Experiment(
        Trajectory(t, {"position": t - 5.0, "valve_voltage": np.arange(n)}), {"position": 1e-5}, name="run"
    )


def test_split_cuts_equal_windows_that_do_not_overlap() -> None:
    run = ramp()
    windows = split(run, 0.25)
    assert [len(w.trajectory) for w in windows] == [250] * 4
    assert [w.name for w in windows] == ["run@0", "run@1", "run@2", "run@3"]
    np.testing.assert_array_equal(np.concatenate([w.trajectory.t for w in windows]), run.trajectory.t[:1000])
    assert windows[3].noise == run.noise


@pytest.mark.parametrize("duration", [1e-3, 2.0, 0.0, -1.0])
def test_split_refuses_windows_that_do_not_fit(duration: float) -> None:
    with pytest.raises(InputError, match="run"):
        split(ramp(), duration)


def test_resample_interpolates_measurements_and_holds_commands() -> None:
    run = resample(ramp(), 2.5e-3)
    np.testing.assert_allclose(run.trajectory.t, 5.0 + 2.5e-3 * np.arange(401))
    np.testing.assert_allclose(run.trajectory["position"], run.trajectory.t - 5.0, atol=1e-12)
    np.testing.assert_array_equal(run.trajectory["valve_voltage"], np.floor(2.5 * np.arange(401)))


def test_resample_onto_its_own_grid_changes_nothing() -> None:
    run = ramp()
    again = resample(run, 1e-3)
    np.testing.assert_allclose(again.trajectory["position"], run.trajectory["position"], atol=1e-12)
    np.testing.assert_array_equal(again.trajectory["valve_voltage"], run.trajectory["valve_voltage"])


def test_resample_leaves_a_hole_open() -> None:
    t = 0.1 * np.arange(12)
    run = resample(Experiment(Trajectory(t, {"position": np.where(t > 0.55, t, np.nan)})), 0.05)
    missing = np.isnan(run.trajectory["position"])
    assert missing[run.trajectory.t < 0.55].all()
    assert not missing[run.trajectory.t > 0.65].any()


@pytest.mark.parametrize("step", [0.0, -1e-3, 2.0])
def test_resample_refuses_a_step(step: float) -> None:
    with pytest.raises(InputError):
        resample(ramp(), step)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(-1, 1), st.floats(-2, 2))
def test_the_slope_of_a_parabola_is_exact_on_any_grid(seed: int, speed: float, acceleration: float) -> None:
    t = 1e3 + np.cumsum(np.random.default_rng(seed).uniform(0.5e-3, 1.5e-3, 200))
    s = t - t[0]
    run = Experiment(Trajectory(t, {"position": 0.1 + speed * s + acceleration * s**2}))
    got = differentiate(run, window=0.01).trajectory["speed"]
    np.testing.assert_allclose(got, speed + 2 * acceleration * s, atol=1e-9)


def test_differentiate_agrees_with_savgol() -> None:
    from scipy.signal import savgol_filter

    t = 1e-3 * np.arange(10_000)
    x = np.sin(7 * t) + 1e-5 * np.random.default_rng(1).normal(size=t.size)
    got = differentiate(Experiment(Trajectory(t, {"position": x})), window=0.03).trajectory["speed"]
    expected = savgol_filter(x, 31, 2, deriv=1, delta=1e-3)
    np.testing.assert_allclose(got[15:-15], expected[15:-15], atol=1e-9)


def test_differentiate_leaves_holes() -> None:
    t = 1e-3 * np.arange(100)
    holed = np.where((t > 0.0195) & (t < 0.0305), np.nan, t**2)
    got = differentiate(Experiment(Trajectory(t, {"position": holed})), window=0.01).trajectory["speed"]
    np.testing.assert_array_equal(np.isnan(got), np.isnan(holed))
    np.testing.assert_allclose(got[~np.isnan(got)], 2 * t[~np.isnan(got)], atol=1e-9)


def test_an_experiment_is_edited_by_copy() -> None:
    run = ramp()
    edited = run.with_noise({"valve_voltage": 0.02}).with_conditions({"load.mass": 4.0})
    assert (run.noise, run.conditions) == ({"position": 1e-5}, {})
    assert (edited.noise, edited.conditions) == ({"position": 1e-5, "valve_voltage": 0.02}, {"load.mass": 4.0})
    kept = edited.select(["valve_voltage"])
    assert (kept.trajectory.names, kept.noise) == (("valve_voltage",), {"valve_voltage": 0.02})


def test_resample_holds_what_is_said_to_be_held() -> None:
    plain = ramp()
    held = resample(plain.with_intersample({"position": Intersample.HELD}), 2.5e-3)
    assert not np.array_equal(held.trajectory["position"], resample(plain, 2.5e-3).trajectory["position"])
    assert set(held.trajectory["position"]) <= set(plain.trajectory["position"])


FRAME = pd.DataFrame({"time": TIME, "position": POSITION, "p_A": PRESSURE})
UNITS = {"time": "s", "position": "mm"}


@pytest.mark.parametrize(
    ("frame", "units"),
    [
        (FRAME, UNITS),
        (FRAME.rename(columns={"time": "time [s]", "position": "position [mm]"}), {}),
        (FRAME.set_index("time"), UNITS),
        (FRAME.drop(columns="time").set_axis(pd.DatetimeIndex(STAMPS).tz_convert("Asia/Tokyo")), {"position": "mm"}),
        (FRAME.drop(columns="time").set_axis(pd.to_timedelta(TIME, unit="s")), {"position": "mm"}),
        (FRAME.assign(time=STAMPS), {"position": "mm"}),
        (FRAME.astype({"position": "Float64"}), UNITS),
    ],
    ids=["units", "names", "index", "dates", "durations", "stamps", "nullable"],
)
def test_a_frame_is_a_log(frame: pd.DataFrame, units: dict[str, str]) -> None:
    sensor = {"pressure_a": {"column": "p_A", "unit": "bar(g)"}}
    run = Experiment.from_frame(frame, units=units, columns=sensor, name="run", ambient_pressure=1e5)
    assert (run.name, run.trajectory.names) == ("run", ("pressure_a", "position"))
    np.testing.assert_allclose(run.trajectory.t, TIME, atol=1e-12)
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.array(POSITION), rtol=1e-14)
    np.testing.assert_allclose(run.trajectory["pressure_a"], 1e5 * (np.array(PRESSURE) + 1), rtol=1e-14)


def test_a_missing_cell_is_nan_and_text_is_refused() -> None:
    holes = pd.array([None, *POSITION[1:]], dtype="Float64")
    assert np.isnan(Experiment.from_frame(FRAME.assign(position=holes), units=UNITS).trajectory["position"][0])
    cells: list[object] = [None, *POSITION[1:]]
    cells[7] = "12,5"
    with pytest.raises(LogError, match="run: row 8, column 'position'"):
        Experiment.from_frame(FRAME.assign(position=pd.Series(cells, dtype=object)), units=UNITS, name="run")


def test_a_log_goes_to_pandas_and_back() -> None:
    t = np.array([0.0, 0.1, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
    position = np.where(t == 0.4, np.nan, 0.02 * t)
    log = Experiment(Trajectory(t, {"position": position, "pressure_a": 1e5 + t, "mine": t}), units={"mine": "N*m"})
    frame = log.to_frame()
    assert frame.columns.tolist() == ["position [m]", "pressure_a [Pa(a)]", "mine [N*m]"]
    back = Experiment.from_frame(frame.drop(columns="mine [N*m]"))
    assert back.trajectory.t.tolist() == t.tolist()
    for name in ("position", "pressure_a"):
        np.testing.assert_allclose(back.trajectory[name], log.trajectory[name], rtol=1e-15)
