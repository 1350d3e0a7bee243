"""What several tests share."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pneuopt import compiler, kernels
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.simulate import simulate
from pneuopt.trajectories import Trajectory

CACHES = (compiler.build, compiler.say_once, compiler._compiler_version, compiler._temporary_folder, kernels.prepared)
DRIVE = """# my axis
[drive]
kind = "force"
[load]
mass = { value = "5 kg", lower = "1 kg", upper = "20 kg", free = true }   # weighed
[friction]
model = "coulomb"
coulomb = { value = "40 N", free = true }
viscous = { value = "10 N*s/m", free = true }
smoothing = "5 mm/s"
"""
TUNING = """# my speed loop
[pid]
sample_time = "2 ms"
Kp = { value = "100 N*s/m", lower = "10 N*s/m", upper = "600 N*s/m", free = true }   # by hand
Ki = "4000 N/m"
limits = ["-200 N", "200 N"]
[[reference]]
step = "0.2 m/s"
horizon = "0.3 s"
[minimise]
settling_time = { band = "5 %" }
[limits]
overshoot = "10 %"
"""


def _forget() -> None:
    for cache in CACHES:
        cache.cache_clear()


@pytest.fixture
def forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Nothing is remembered of what was built or said, before and after; call it to forget again."""
    _forget()
    yield _forget
    _forget()


@pytest.fixture(scope="session")
def axis_truth() -> dict[str, float]:
    """What made the logs of `folder`."""
    return {"load.mass": 6.0, "friction.coulomb": 25.0, "friction.viscous": 40.0, "friction.smoothing": 5e-3}


@pytest.fixture(scope="session")
def axis_logs(axis_truth: dict[str, float]) -> dict[str, str]:
    """Two generated logs (ForceDrive with Coulomb friction, 20 um of noise) as text, by name."""
    system = ForceDrive(Coulomb()).system()
    texts = {}
    for seed, name in enumerate(("run_01", "run_02")):
        t = np.arange(0, 1.0, 2e-3)
        force = 60 * np.sin(2 * np.pi * 1.7 * t) + 30 * np.sin(2 * np.pi * 3.1 * t + seed)
        run = simulate(system, Trajectory(t, {"force": force}), system.parameters.with_values(axis_truth), rtol=1e-6)
        position = 1e3 * (run["position"] + 2e-5 * np.random.default_rng(seed).standard_normal(len(t)))
        rows = [f"{a:.4f},{b:.5f},{c:.5f}" for a, b, c in zip(t, force, position, strict=True)]
        texts[name] = "\n".join(["time [s],force [N],position [mm]", *rows]) + "\n"
    return texts


@pytest.fixture
def folder(tmp_path: Path, axis_logs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a command runs: drive.toml, tuning.toml and two logs, on a terminal of 80 columns."""
    for name, text in axis_logs.items():
        (tmp_path / f"{name}.csv").write_text(text, encoding="utf-8")
    (tmp_path / "drive.toml").write_text(DRIVE, encoding="utf-8")
    (tmp_path / "tuning.toml").write_text(TUNING, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path
