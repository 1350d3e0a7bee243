"""Which compiler is found, and how it is called."""

import importlib.util
import os
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled import toolchain
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.compiled.toolchain import Compiler, explain_missing_compiler, find_compiler
from pneuopt.dynamics.system import discretise, parameter_vector
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck

Forget = Callable[[], None]
GCC = shutil.which("gcc") or shutil.which("clang")
needs_gcc = pytest.mark.skipif(GCC is None or os.name == "nt", reason="no C compiler on the path")


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path) -> Path:
    """No compiler on the path, in the environment, or as a package."""
    for name in ("PNEUOPT_CC", "CC"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    return tmp_path


def program(path: Path, text: str = "#!/bin/sh\n") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_without_any_it_is_said_what_to_install(bare: Path) -> None:
    assert find_compiler() is None
    assert explain_missing_compiler().startswith("no C compiler found: ")
    assert 'pip install "pneuopt[compiler]"' in explain_missing_compiler()
    assert "\n" not in explain_missing_compiler()


def test_a_chosen_one_that_is_not_there_is_named(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PNEUOPT_CC", "no-such-compiler -v")
    assert find_compiler() is None
    assert explain_missing_compiler().startswith("PNEUOPT_CC='no-such-compiler -v' names no program: ")
    monkeypatch.setenv("PNEUOPT_CC", "'half quoted")
    assert find_compiler() is None


@pytest.mark.skipif(os.name == "nt", reason="the compilers here are shell scripts")
def test_the_order_is_chosen_named_on_the_path_packaged(
    bare: Path, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    zig = program(bare / "site" / "ziglang" / "zig")
    spec = SimpleNamespace(submodule_search_locations=[str(zig.parent)])
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec)
    forget()
    assert find_compiler() == Compiler((str(zig), "cc"))
    clang = program(bare / "clang")
    assert find_compiler() == Compiler((str(clang),))
    mine = program(bare / "my folder" / "cc of mine")
    monkeypatch.setenv("CC", "gone")  # a name of another machine is passed over
    assert find_compiler() == Compiler((str(clang),))
    monkeypatch.setenv("CC", "clang -m64")
    assert find_compiler() == Compiler((str(clang), "-m64"))
    monkeypatch.setenv("PNEUOPT_CC", str(mine))  # a path with blanks is no command with arguments
    assert find_compiler() == Compiler((str(mine),))
    monkeypatch.setenv("PNEUOPT_CC", f"'{mine}' -v 'a b'")
    assert find_compiler() == Compiler((str(mine), "-v", "a b"))
    monkeypatch.setenv("PNEUOPT_CC", "")
    assert find_compiler() is None


def test_apple_s_placeholder_is_no_compiler(bare: Path, monkeypatch: pytest.MonkeyPatch, forget: Forget) -> None:
    """Without Apple's tools a call of /usr/bin/gcc opens a window that offers to install them."""
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(toolchain, "_has_apple_tools", lambda: False)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert find_compiler() is None
    monkeypatch.setattr(toolchain, "_has_apple_tools", lambda: True)
    assert find_compiler() == Compiler(("/usr/bin/gcc",))


def run_stribeck() -> tuple[Rollout, dict[str, np.ndarray]]:
    """A drive with friction over 40 samples, with its sensitivities."""
    system = discretise(ForceDrive(Stribeck()).system(), 5)
    p = parameter_vector(system.parameters, system.parameters)
    rollout = Rollout(system.pieces, (0, 1), start=True, threads=1)
    t, h = np.tile(np.arange(40) * 1e-3, (5, 1)), np.full((5, 40), 1e-3)
    u = np.linspace(-80, 80, 200).reshape(5, 40, 1)
    found = rollout.run(np.zeros((5, 2)), u, p, t, h, substeps=5)
    assert found.dx_end is not None
    return rollout, {"x_end": found.x_end, "y": found.y, "dx_end": found.dx_end}


@needs_gcc
def test_a_command_with_arguments_compiles(monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path) -> None:
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path))
    monkeypatch.setenv("PNEUOPT_CC", f"{GCC} -DMINE=1")
    rollout, _ = run_stribeck()
    assert rollout.uses_machine_code


@pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="the extra compiler is not installed")
def test_the_packaged_compiler_gives_what_the_vm_gives(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path
) -> None:
    """Where there is neither a compiler on the path nor a home; it leaves nothing beside the cache."""
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path / "cache"))
    for name in ("PNEUOPT_CC", "CC", "HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    rollout, compiled = run_stribeck()
    assert rollout.uses_machine_code
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
    forget()
    monkeypatch.setenv("PNEUOPT_CC", "")
    rollout, interpreted = run_stribeck()
    assert not rollout.uses_machine_code
    for name, expected in interpreted.items():
        assert_allclose(compiled[name], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max(), err_msg=name)
