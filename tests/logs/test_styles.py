"""One log as twenty loggers write it is the same experiment."""

from pathlib import Path

import numpy as np
import pytest

from pneuopt.logs.read_log import read_log
from pneuopt.quantities.units import ATMOSPHERE
from tests.logs.styles import POSITION, PRESSURE, TEXT_STYLES, TIME, VOLTAGE, N

STYLES = {**TEXT_STYLES}


@pytest.mark.parametrize("name", STYLES)
def test_a_logger_s_file_is_read_right(tmp_path: Path, name: str) -> None:
    style = STYLES[name]
    path = tmp_path / f"run{style.suffix}"
    style.write(path)
    run = read_log(path, columns=style.columns or None)
    assert set(run.trajectory.names) == {"position", "valve_voltage", "pressure_a"}
    assert len(run.trajectory) == N
    np.testing.assert_allclose(run.trajectory.t - run.trajectory.t[0], TIME, atol=2e-6)
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.array(POSITION), rtol=1e-12)
    np.testing.assert_allclose(run.trajectory["valve_voltage"], VOLTAGE, rtol=1e-12)
    np.testing.assert_allclose(run.trajectory["pressure_a"], 1e5 * np.array(PRESSURE) + ATMOSPHERE, rtol=1e-12)
    assert style.remark in run.remarks or not style.remark
