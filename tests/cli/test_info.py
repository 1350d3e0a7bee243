"""`pneuopt info`."""

import re
import tomllib
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest

from pneuopt.cli import info
from pneuopt.dynamics.compiled.toolchain import find_compiler
from tests.cli.test_app import run

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def lines() -> dict[str, str]:
    result = run("info")
    assert result.exit_code == 0, result.stdout
    return dict(re.split(r"\s\s+", line, maxsplit=1) for line in result.stdout.splitlines())


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_it_shows_compiler_cache_check_and_speed() -> None:
    shown = lines()
    assert str(find_compiler()) in shown["compiler"]
    assert "=native" in shown["flags"]
    assert re.search(r": \d+ models, [\d.e+]+ MB$", shown["cache"])
    assert shown["self-check"].startswith("good: machine code differs from the VM by ")
    assert re.fullmatch(r"ns a step: \d+ in the VM, \d+ compiled, \d+ in [248] lanes", shown["speed"])


def test_without_a_compiler_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, forget: object) -> None:
    monkeypatch.setenv("PNEUOPT_CC", "")
    shown = lines()
    assert shown["compiler"].startswith("none")
    assert shown["to add one"] == 'pip install "pneuopt[compiler]"'
    assert shown["self-check"].startswith("good: derivatives ")
    assert re.fullmatch(r"ns a step: \d+ in the VM", shown["speed"])


def test_a_self_check_that_fails_is_said_with_exit_status_1(monkeypatch: pytest.MonkeyPatch) -> None:
    good = info._check_itself()
    assert good.is_good
    assert good.derivative_error > 0
    for bad in (replace(good, distance=1e-6), replace(good, derivative_error=1e-3)):
        monkeypatch.setattr(info, "_check_itself", lambda bad=bad: bad)
        result = run("info")
        assert result.exit_code == 1
        assert "FAILED: please report it" in result.stdout


def test_a_package_that_is_not_installed_is_shown_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    every = [*PROJECT["dependencies"]]
    for extra, packages in PROJECT["optional-dependencies"].items():
        every += [f'{package} ; extra == "{extra}"' for package in packages]
    original = metadata.version

    def version(name: str) -> str:
        if name in ("ziglang", "npTDMS", "casadi"):
            raise metadata.PackageNotFoundError(name)
        return original(name) if name == "pneuopt" else "1.0"

    monkeypatch.setattr(info, "requires", lambda _: every)
    monkeypatch.setattr(info, "version", version)
    shown = info.package_versions()
    assert shown["ziglang"] == 'not installed: pip install "pneuopt[compiler]"'
    assert shown["npTDMS"] == 'not installed: pip install "pneuopt[tdms]"'
    assert shown["casadi"] == "MISSING"
    assert shown["openpyxl"] == "1.0"
