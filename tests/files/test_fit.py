"""fit.toml: the covariance of a fit's estimates, from which a design's plants are drawn."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pneuopt.files.drive import read_covariance, read_drive, read_estimates, write_fit
from pneuopt.identification.result import IdentificationResult
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status

AXIS = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "coulomb"\n'


def fit_of(parameters: ParameterSet, covariance: pd.DataFrame) -> IdentificationResult:
    empty = pd.DataFrame()
    return IdentificationResult(parameters, empty, covariance, empty, {}, Status(Code.CONVERGED), {}, {})


def written(folder: Path, text: str, name: str = "drive.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_covariance_of_a_fit_is_in_its_file_without_what_the_logs_do_not_identify(tmp_path: Path) -> None:
    source = written(tmp_path, AXIS)
    _, rig = read_drive(source)
    names = ["load.mass", "load.force", "friction.coulomb"]
    matrix = np.array([[4.0, -1.5, np.nan], [-1.5, 1.0, np.nan], [np.nan, np.nan, np.nan]])
    result = fit_of(rig, pd.DataFrame(matrix, names, names))
    write_fit(tmp_path / "fit.toml", source, result)
    found = read_covariance(tmp_path / "fit.toml")
    assert found is not None
    assert list(found.index) == list(found.columns) == names[:2]
    assert found.to_numpy().tolist() == matrix[:2, :2].tolist()
    assert read_drive(tmp_path / "fit.toml")[1] == rig
    assert read_covariance(source) is None


def test_a_fit_without_a_covariance_gives_the_variances_of_its_estimates(tmp_path: Path) -> None:
    rows = '[estimates]\n"load.mass" = {value = 5.0, stderr = 0.2}\n"load.force" = {value = 1.0, stderr = nan}\n'
    found = read_covariance(written(tmp_path, AXIS + rows))
    assert found is not None
    assert found.to_dict() == {"load.mass": {"load.mass": pytest.approx(0.04)}}


def test_degrees_of_freedom_and_ranges_are_read_with_the_estimates(tmp_path: Path) -> None:
    rows = '"load.mass" = {value = 5.0, stderr = nan, dof = 3.5, range_low = 4.0, range_high = 6.0, mark = "exact"}\n'
    found = read_estimates(written(tmp_path, f'{AXIS}[estimates]\n{rows}"load.force" = {{value = 1.0}}\n'))
    assert found is not None
    assert found.loc["load.mass"].dropna().to_dict() == {"dof": 3.5, "range_low": 4.0, "range_high": 6.0}
    assert found.loc["load.force"].isna().all()
    assert read_estimates(written(tmp_path, AXIS)) is None


@pytest.mark.parametrize("rows", ['"load.mass" = 3', '"load.mass" = [1, 2]', '"a" = [1, 2]\n"b" = [3, 1]', "a = ['x']"])
def test_a_covariance_that_is_none_is_refused(tmp_path: Path, rows: str) -> None:
    with pytest.raises(InputError, match=r"fit.toml: \[covariance\] must hold a row of numbers .*run identify again"):
        read_covariance(written(tmp_path, f"{AXIS}[covariance]\n{rows}\n", "fit.toml"))
