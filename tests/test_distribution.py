"""The wheel and the sdist hold the package, all of it and nothing else, and run without a compiler."""

import os
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = {
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "pneuopt").rglob("*")
    if path.suffix in (".py", ".pyi", ".c", ".h", ".typed", ".html", ".js")
}
ABOUT = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE", "top_level.txt"}


def pip(*words: str) -> None:
    """Run pip without a network; build by the setuptools that is installed."""
    line = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *words, "--no-deps", "--no-index"]
    done = subprocess.run([*line, "--no-build-isolation"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def build_sdist(folder: Path) -> Path:
    program = f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (sdist,) = folder.glob("*.tar.gz")
    return sdist


def wheel_names(folder: Path) -> set[str]:
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        return set(file.namelist())


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_sdist(tmp_path_factory.mktemp("sdist"))


def run_installed(folder: Path, words: Sequence[str]) -> "subprocess.CompletedProcess[str]":
    """Run Python where only this folder has the package, on a path without a compiler."""
    settings = {k: v for k, v in os.environ.items() if k not in ("PNEUOPT_CC", "CC")}
    settings |= {"PYTHONPATH": str(folder), "PATH": str(folder), "PNEUOPT_CACHE": str(folder / "cache")}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=settings, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_the_wheel_of_the_sdist_holds_the_package_and_nothing_else(sdist: Path, tmp_path: Path) -> None:
    pip("wheel", "--wheel-dir", str(tmp_path), str(sdist))
    names = wheel_names(tmp_path)
    about = {name.partition(".dist-info/")[2] for name in names if ".dist-info/" in name}
    assert {name for name in names if ".dist-info/" not in name} == PACKAGE
    assert about == ABOUT


@pytest.mark.slow
def test_the_sdist_holds_the_sources_and_no_rubbish(sdist: Path) -> None:
    with tarfile.open(sdist) as file:
        names = {name.partition("/")[2] for name in file.getnames() if not file.getmember(name).isdir()}
    assert names >= PACKAGE | {"pyproject.toml", "README.md", "LICENSE", "PKG-INFO"}
    folders = {name.split("/")[0] for name in names if "/" in name}
    assert folders <= {"pneuopt", "pneuopt.egg-info", "tests"}


@pytest.mark.slow
def test_what_is_installed_from_the_sdist_runs_without_a_compiler(sdist: Path, tmp_path: Path) -> None:
    pip("install", "--target", str(tmp_path), str(sdist))
    where = run_installed(tmp_path, ["-c", "import pneuopt; print(pneuopt.__file__)"])
    assert where.stdout.startswith(str(tmp_path)), where.stderr
    done = run_installed(tmp_path, ["-m", "pneuopt", "info"])
    assert done.returncode == 0
    assert done.stderr.startswith("no C compiler found")
    assert len(done.stderr.splitlines()) == 1
    assert "compiler" in done.stdout
