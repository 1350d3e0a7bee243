import logging
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled import compiler
from pneuopt.dynamics.compiled.functions import compile_function
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout

Forget = Callable[[], None]
needs_compiler = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler")
needs_shell = pytest.mark.skipif(os.name == "nt", reason="the compilers here are shell scripts")


def fall(drag: float = 0.1) -> Rollout:
    """A body that falls through air: one step of Euler; each drag is a source of its own."""
    t, h, x, u, p = (ca.SX.sym(n, k) for n, k in (("t", 1), ("h", 1), ("x", 2), ("u", 1), ("p", 1)))
    rate = ca.vertcat(x[1], u - p * ca.exp(-drag * x[0]) * x[1])
    return Rollout(Pieces(ca.Function("step", [t, h, x, u, p], [x + h * rate, x[0]])), (0,), threads=1)


def fallen(rollout: Rollout) -> np.ndarray[Any, np.dtype[np.float64]]:
    t, h = np.tile(np.arange(4) * 0.1, (3, 1)), np.full((3, 4), 0.1)
    return rollout.run(np.ones((3, 2)), np.ones((3, 4, 1)), [0.3], t, h).x_end


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [r.getMessage() for r in caplog.records if r.name == "pneuopt" and r.levelno >= logging.WARNING]


def test_without_a_compiler_one_line_says_so(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PNEUOPT_CC", "")
    for drag in (0.1, 0.2):
        assert not fall(drag).uses_machine_code
    compile_function(ca.Function("f", [ca.SX.sym("a")], [1]))
    assert len(warnings_in(caplog)) == 1
    assert "no C compiler found" in warnings_in(caplog)[0]


def script(folder: Path, text: str) -> str:
    path = folder / "cc"
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.mark.skipif(os.name == "nt", reason="the broken compilers here are shell scripts")
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("#!/bin/sh\necho 'model.c: no licence' >&2; exit 1\n", "no licence"),
        ("#!/bin/sh\nexit 0\n", "No such file"),
        ("#!/bin/sh\nexit 3\n", "it ended with exit status 3"),
        ("#!/bin/sh\nkill -9 $$\n", "it was killed by signal 9"),
        ("not a program", "Exec format error"),
        (
            '#!/bin/sh\nwhile [ "$1" != -o ]; do shift || exit 0; done; echo junk > "$2"\n',
            "invalid ELF header|too short",
        ),
    ],
)
def test_a_broken_compiler_is_a_warning_not_a_crash(
    text: str,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
    forget: Forget,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    fast = fallen(fall())
    forget()
    monkeypatch.setenv("PNEUOPT_CC", script(tmp_path, text))
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path / "cache"))
    slow, again = fall(), fall()
    assert not slow.uses_machine_code
    assert not again.uses_machine_code
    assert_allclose(fallen(slow), fast, rtol=1e-14)
    (warning,) = warnings_in(caplog)
    assert "failed, the CasADi VM runs instead" in warning
    assert re.search(reason, warning), warning


def test_a_compiler_that_is_not_there_counts_as_none(monkeypatch: pytest.MonkeyPatch, forget: Forget) -> None:
    monkeypatch.setenv("PNEUOPT_CC", "no-such-compiler")
    assert compiler.find_compiler() is None


@needs_compiler
def test_an_unwritable_cache_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("PNEUOPT_CACHE", str(blocked / "cache"))
    assert fall(0.1).uses_machine_code
    assert fall(0.2).uses_machine_code
    assert len(warnings_in(caplog)) == 1
    assert "cannot be written" in warnings_in(caplog)[0]
    shutil.rmtree(compiler.cache_directory())


@needs_compiler
def test_a_cached_binary_is_loaded_and_a_damaged_one_built_anew(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path
) -> None:
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path))
    assert fall().uses_machine_code
    (binary,) = tmp_path.iterdir()
    built = binary.stat().st_mtime_ns
    forget()
    assert fall().uses_machine_code
    assert binary.stat().st_mtime_ns == built
    forget()
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    shutil.copy(binary, damaged / binary.name)  # the loaded one must not be touched
    (damaged / binary.name).write_bytes(b"junk")
    monkeypatch.setenv("PNEUOPT_CACHE", str(damaged))
    assert fall().uses_machine_code
    assert (damaged / binary.name).stat().st_size > 1000


@needs_compiler
@needs_shell
def test_a_compiler_without_vectors_gives_one_lane(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    usual, cc = fallen(fall()), compiler.find_compiler()
    forget()
    text = f'#!/bin/sh\ncase "$*" in *SIMD*) echo "no vectors" >&2; exit 1;; esac\nexec {cc} "$@"\n'
    monkeypatch.setenv("PNEUOPT_CC", script(tmp_path, text))
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path / "cache"))
    for drag in (0.1, 0.2):
        assert fall(drag).uses_machine_code
        assert fall(drag).lanes == 1
    assert_allclose(fallen(fall()), usual, rtol=1e-14)
    (warning,) = warnings_in(caplog)
    assert "compiles no SIMD lanes" in warning
    assert "no vectors" in warning


@needs_compiler
def test_an_interrupted_compilation_leaves_nothing_behind(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path
) -> None:
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path))
    run = subprocess.run

    def interrupted(command: list[str], **settings: Any) -> object:
        if "--version" in command:
            return run(command, **settings)
        Path(command[-2]).write_bytes(b"half a fi")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fall()
    assert list(tmp_path.iterdir()) == []
    assert fall().uses_machine_code


@needs_compiler
def test_two_processes_may_build_the_same_at_once(tmp_path: Path) -> None:
    source = "int answer(void) { return 42; }"
    program = "from pneuopt.dynamics.compiled.compiler import compile_library\n"
    program += f"assert compile_library({source!r}).answer() == 42"
    settings = {**os.environ, "PNEUOPT_CACHE": str(tmp_path)}
    running = [subprocess.Popen([sys.executable, "-c", program], env=settings) for _ in range(2)]
    assert [process.wait(60) for process in running] == [0, 0]
    assert len(list(tmp_path.iterdir())) == 1
