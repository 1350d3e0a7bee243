"""One log as thirty loggers and programs write it is the same experiment."""

import sys
from pathlib import Path

import numpy as np
import pytest

from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.units import ATMOSPHERE
from tests.logs.binary_styles import BINARY_STYLES
from tests.logs.styles import POSITION, PRESSURE, TEXT_STYLES, TIME, VOLTAGE, N

STYLES = {**TEXT_STYLES, **BINARY_STYLES}


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


@pytest.mark.parametrize(
    ("suffix", "package", "extra"),
    [
        (".xlsx", "openpyxl", "xlsx"),
        (".tdms", "nptdms", "tdms"),
        (".mf4", "asammdf", "mdf"),
        (".parquet", "pyarrow", "parquet"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, package: str, extra: str
) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_bytes(b"any")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"; run: pip install 'pneuopt\[{extra}\]'"):
        read_log(path)
