from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.io import savemat

from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import LogError

TIME = 0.1 * np.arange(12)


def written(folder: Path, variables: dict[str, object], *, version: Literal["4", "5"] = "5") -> Path:
    path = folder / "run.mat"
    savemat(path, variables, format=version)
    return path


@pytest.mark.parametrize("version", ["4", "5"])
@pytest.mark.parametrize("shape", [(12,), (12, 1), (1, 12)])
def test_rows_and_columns_are_vectors(tmp_path: Path, version: Literal["4", "5"], shape: tuple[int, ...]) -> None:
    path = written(tmp_path, {"time_s": TIME.reshape(shape), "force_N": TIME.reshape(shape)}, version=version)
    np.testing.assert_array_equal(read_log(path).trajectory["force"], TIME)


def test_the_fields_of_a_structure_are_columns_and_the_rest_is_left_alone(tmp_path: Path) -> None:
    log = {"time_s": TIME, "position_mm": np.arange(12, dtype=np.uint8), "rig": "B", "raw": np.zeros((12, 3))}
    run = read_log(written(tmp_path, {"log": log, "mass": 5.0, "note": "warm", "cells": np.array([1, "a"], object)}))
    assert run.trajectory.names == ("position",)
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.arange(12), rtol=1e-15)


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        (
            {"time_s": TIME, "force_N": TIME[:-1]},
            "column 'force_N' has 11 samples, column 'time_s' has 12; export them",
        ),
        ({"mass": 5.0}, "no vector of numbers; in MATLAB, save"),
        ({"force_N": TIME, "log": {"force_N": TIME}}, "two columns are named 'force_N'; rename one"),
        ({"time_s": TIME, "force_N": 1j * TIME}, "no channel but time"),
    ],
)
def test_refuses_variables_and_says_which(tmp_path: Path, variables: dict[str, object], said: str) -> None:
    path = written(tmp_path, variables)
    with pytest.raises(LogError) as error:
        read_log(path)
    assert str(error.value).startswith(f"{path}: {said}")


def test_version_7_3_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" + bytes(512))
    with pytest.raises(LogError, match=r"version 7\.3 \(HDF5\) is not read; in MATLAB, save it with the option '-v7'"):
        read_log(path)
