import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import scipy.io
from scipy.io import savemat

from pneuopt.logs.mat import read_table
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import LogError
from tests.logs.binary_styles import BINARY_STYLES
from tests.logs.fuzz import damage_bytes

ROOT = Path(__file__).parents[2]
TIME = 0.1 * np.arange(12)
LOADMAT = """
import io, resource, sys, warnings
from scipy.io import loadmat
from tests.logs.test_mat import damaged_files
resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))
warnings.simplefilter("ignore")
for k, raw in enumerate(damaged_files(int(sys.argv[2]))):
    if k >= int(sys.argv[1]):
        print(k, flush=True)
        try:
            loadmat(io.BytesIO(raw), squeeze_me=True)
        except Exception:
            pass
"""
"""Reads damaged files with SciPy from the one that is said first, and prints the number of each before it is read."""


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


def test_scipy_reads_version_4_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A head that is damaged, but for which SciPy still takes its reader of version 5."""

    def fail(*_: object, **__: object) -> None:
        pytest.fail("SciPy's reader of version 5 was called")

    path = written(tmp_path, {"time_s": TIME, "force_N": TIME})
    raw = bytearray(path.read_bytes())
    raw[127:128] = b"X"
    path.write_bytes(raw)
    monkeypatch.setattr(scipy.io, "loadmat", fail)
    with pytest.raises(LogError, match=r"cannot be read as a \.mat file \(its head names no version from 4 to 7\)"):
        read_log(path)


def damaged_files(count: int) -> list[bytes]:
    """Logs of version 5 with bytes changed, cut out, put in or repeated: the same ones each time."""
    rng, bases = random.Random(0), []
    with tempfile.TemporaryDirectory() as folder:
        for style in (s for s in BINARY_STYLES.values() if s.suffix == ".mat"):
            style.write(Path(folder) / "run.mat")
            raw = (Path(folder) / "run.mat").read_bytes()
            bases.append(b"MATLAB 5.0 MAT-file".ljust(116) + raw[116:])  # without the time of writing
    return [damage_bytes(rng, rng.choice(bases)) for _ in range(count)]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
def test_damaged_files_end_scipys_process_and_not_ours() -> None:
    """Of 10,000 files 86 ended SciPy 1.17.1: once none of these does, use it, and delete our reader of version 5."""
    count, start, ends = 1000, 0, 0
    while start < count:
        command = [sys.executable, "-c", LOADMAT, str(start), str(count)]
        done = subprocess.run(command, capture_output=True, cwd=ROOT, check=False, timeout=600)
        ends += done.returncode < 0
        start = count if done.returncode == 0 else int(done.stdout.split()[-1]) + 1
    assert ends > 0
    read = 0
    for raw in damaged_files(count):
        try:
            read_table(Path("run.mat"), raw)
            read += 1
        except LogError:
            pass
    assert read > 0
