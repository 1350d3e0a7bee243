import numpy as np
import pandas as pd
import pytest

from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import LogError, UnitError, UnknownNameError
from pneuopt.quantities.trajectories import Trajectory
from tests.logs.styles import POSITION, PRESSURE, STAMPS, TIME

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
    with pytest.raises(LogError, match="run: row 8, column 'position': '12,5' is not a number; store the column as"):
        Experiment.from_frame(FRAME.assign(position=pd.Series(cells, dtype=object)), units=UNITS, name="run")


def test_what_a_frame_does_not_say_is_asked_for() -> None:
    with pytest.raises(UnitError, match="frame: column 'position': no unit"):
        Experiment.from_frame(FRAME, units={"time": "s"})
    with pytest.raises(UnknownNameError, match="frame: units: unknown column 'postion'; did you mean 'position'"):
        Experiment.from_frame(FRAME, units={"postion": "mm"})
    with pytest.raises(LogError, match=r"frame: no time; name a column"):
        Experiment.from_frame(FRAME.drop(columns="time"), units={"position": "mm"})
    with pytest.raises(LogError, match="two columns are named 'position'; rename one"):
        Experiment.from_frame(FRAME.set_axis(["time", "position", "position"], axis=1), units=UNITS)
    with pytest.raises(LogError, match="columns need names, as text"):
        Experiment.from_frame(FRAME.set_axis([0, 1, 2], axis=1))


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
