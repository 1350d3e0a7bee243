"""`pneuopt info`.

`pneuopt keys`: what may stand in the files, and what --json writes, on the screen and as Markdown.
"""

import re
import tomllib
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pneuopt.cli import info
from pneuopt.cli.app import app
from pneuopt.dynamics.compiled.compiler import find_compiler
from pneuopt.dynamics.compiled.rollout import SelfCheck, check_machine_code
from pneuopt.files.keys import list_keys
from pneuopt.files.outputs import OUTPUTS
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
    found = list[SelfCheck]()

    def keep(*given: Any) -> SelfCheck:
        found.append(check_machine_code(*given))
        return found[-1]

    monkeypatch.setattr(info, "check_machine_code", keep)
    assert run("info").exit_code == 0
    (good,) = found
    assert good.is_good
    assert good.derivative_error > 0
    for bad in (replace(good, distance=1e-6), replace(good, derivative_error=1e-3)):
        monkeypatch.setattr(info, "check_machine_code", lambda *_, bad=bad: bad)
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


def run_of_keys(*words: str, width: int = 80) -> tuple[int, str]:
    result = CliRunner(env={"COLUMNS": str(width)}).invoke(app, ["keys", *words])
    return result.exit_code, result.output


@pytest.mark.parametrize("width", [60, 80])
def test_the_screen_shows_every_key_within_its_width(width: int) -> None:
    code, output = run_of_keys(width=width)
    assert code == 0
    assert max(map(len, output.splitlines())) <= width
    assert [r.full_name for r in list_keys() if f"  {r.full_name}" not in output] == []


@pytest.mark.parametrize("width", [60, 80])
def test_the_screen_shows_every_member_of_what_json_writes_within_its_width(width: int) -> None:
    code, output = run_of_keys("--outputs", width=width)
    assert code == 0
    assert max(map(len, output.splitlines())) <= width
    for name, written in OUTPUTS.items():
        own = output.partition(f"\n{name}: " if name != next(iter(OUTPUTS)) else f"{name}: ")[2].partition("\n\n")[0]
        assert [m for m, held in written.members.items() if f"  {m}: {held.holds.value}" not in own] == []


def test_markdown_has_a_row_for_each_key_and_member() -> None:
    keys, outputs = run_of_keys("--markdown")[1], run_of_keys("--outputs", "--markdown")[1]
    assert [
        r.full_name for r in list_keys() if f"`{r.full_name}`" not in keys and f"**[{r.section}]**" not in keys
    ] == []
    assert all(f"| `{member}` |" in outputs for written in OUTPUTS.values() for member in written.members)


def test_a_word_beside_outputs_is_refused_not_ignored() -> None:
    assert run_of_keys("mass", "--outputs") == (2, "error: --outputs shows all outputs: give no WORD beside it\n")


def test_a_word_finds_sections_keys_and_meanings() -> None:
    mass = ['  load.mass [kg] = "5 kg"', "    mass that moves, piston and rod included; pneumatic, force only"]
    assert run_of_keys("mass")[1].splitlines()[1:3] == mass
    assert "  sensor.lag [s]" in run_of_keys("[sensor]")[1]
    assert "  valve.conductance" in run_of_keys("ISO 6358")[1]
    assert "tuning.toml" not in run_of_keys("log.toml")[1]


def test_a_word_that_no_key_has_is_met_with_the_nearest() -> None:
    code, output = run_of_keys("stribek_velocity")
    assert (code, output) == (2, "error: no key has 'stribek_velocity' in it; did you mean 'stribeck_velocity'?\n")
    assert "leave it out to see all" in run_of_keys("zzzz")[1]
