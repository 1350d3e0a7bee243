"""What stays in the cache of compiled models.

Which compiler is found, and how it is called.
"""

import importlib.util
import logging
import os
import platform
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled import compiler
from pneuopt.dynamics.compiled import compiler as library_cache
from pneuopt.dynamics.compiled import compiler as toolchain
from pneuopt.dynamics.compiled.compiler import (
    Compiler,
    explain_missing_compiler,
    find_compiler,
    find_library,
    keep_library,
    trim_cache,
)
from pneuopt.dynamics.compiled.functions import compile_function
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.system import discretise, parameter_vector
from pneuopt.dynamics.tolerances import NOTICE_TIME
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck

Forget = Callable[[], None]
needs_compiler = pytest.mark.skipif(toolchain.find_compiler() is None, reason="no C compiler")
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
    caplog.clear()  # where this machine has no compiler, that was said
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
    assert toolchain.find_compiler() is None


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
    shutil.rmtree(library_cache.cache_directory())


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


BUILD = """
from pneuopt.dynamics.compiled.compiler import compile_library
assert compile_library("int answer(void) { return 42; }").answer() == 42
"""


def build_in_process(cache: Path) -> subprocess.CompletedProcess[str]:
    settings = {**os.environ, "PNEUOPT_CACHE": str(cache)}
    return subprocess.run([sys.executable, "-c", BUILD], env=settings, capture_output=True, text=True, check=False)


@needs_compiler
def test_a_library_damaged_anywhere_is_built_anew(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Cut at twenty places, or with a byte changed there: none of them is handed to the loader."""
    source = "int answer(void) { return 42; }"
    monkeypatch.setenv("PNEUOPT_CACHE", str(tmp_path))
    cc = toolchain.find_compiler()
    assert cc is not None
    compiler._load_library(cc, toolchain.COMPILER_FLAGS, source)
    (binary,) = tmp_path.iterdir()
    whole = binary.read_bytes()
    identity = "\0".join(
        [
            source,
            *toolchain.COMPILER_FLAGS,
            str(cc),
            cc.identity,
            platform.processor(),
            compiler._cpu_identity(),
        ]
    )
    assert library_cache.find_library(tmp_path, identity) == binary
    for k in range(20):
        place = len(whole) * k // 20
        for damaged in (whole[:place], whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :], whole + b"0"):
            binary.unlink(missing_ok=True)  # the loaded one must not be touched
            binary.write_bytes(damaged)
            binary.chmod(0o600)
            assert library_cache.find_library(tmp_path, identity) is None
            assert not binary.exists()
    binary.write_bytes(whole[: len(whole) // 2])
    assert build_in_process(tmp_path).returncode == 0
    assert binary.read_bytes() == whole


@needs_compiler
def test_a_library_of_another_model_or_writable_by_others_is_not_loaded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    product = tmp_path / "product"
    product.write_bytes(b"one")
    one = library_cache.keep_library(tmp_path, "one", product)
    assert one.stat().st_mode & 0o777 == 0o600
    assert library_cache.find_library(tmp_path, "one") == one
    stolen = tmp_path / one.name.replace(library_cache._digest("one"), library_cache._digest("two"))
    os.link(one, stolen)
    assert library_cache.find_library(tmp_path, "two") is None
    one.chmod(0o666)
    assert library_cache.find_library(tmp_path, "one") is None
    product.write_bytes(b"one")
    one = library_cache.keep_library(tmp_path, "one", product)
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    assert library_cache.find_library(tmp_path, "one") is None


@needs_compiler
@needs_shell
def test_a_cache_in_which_anybody_may_write_is_not_used(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    done = build_in_process(shared)
    assert done.returncode == 0, done.stderr
    assert "other users may exchange files in it" in done.stderr
    assert list(shared.iterdir()) == []
    shared.chmod(0o1777)
    assert build_in_process(shared).stderr == ""
    assert len(list(shared.iterdir())) == 1


@needs_shell
@needs_compiler
@pytest.mark.parametrize("home", ["none", "read-only"])
def test_without_a_home_models_are_compiled_in_a_folder_that_is_removed(home: str, tmp_path: Path) -> None:
    """The temporary folders of runs do not gather."""
    (tmp_path / "tmp").mkdir()
    (tmp_path / "file").touch()
    settings = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME", "PNEUOPT_CACHE")}
    settings |= {"TMPDIR": str(tmp_path / "tmp")} | ({"HOME": str(tmp_path / "file")} if home == "read-only" else {})
    nameless = "import pathlib\ndef home(): raise RuntimeError('no home')\npathlib.Path.home = home\n"
    program = (nameless if home == "none" else "") + BUILD
    done = subprocess.run([sys.executable, "-c", program], env=settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "cannot be written" in done.stderr
    assert list((tmp_path / "tmp").iterdir()) == []


@needs_compiler
@needs_shell
def test_a_compiler_without_vectors_gives_one_lane(
    monkeypatch: pytest.MonkeyPatch, forget: Forget, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    usual, cc = fallen(fall()), toolchain.find_compiler()
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

    def interrupted(command: list[str], _: object) -> None:
        Path(command[-2]).write_bytes(b"half a fi")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(compiler, "_run_compiler", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fall()
    assert list(tmp_path.iterdir()) == []
    assert fall().uses_machine_code


@needs_shell
def test_an_interruption_ends_the_compiler_and_what_it_started(tmp_path: Path) -> None:
    """A driver that starts another process, as gcc starts cc1; the pipe ends when neither holds it any more."""
    alive, held = os.pipe()
    text = "import os, subprocess, sys, time; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'], "
    text += f"close_fds=False); os.write({held}, b'1'); time.sleep(60)"
    program = [sys.executable, "-c", text]
    main = threading.main_thread().ident
    assert main is not None

    def interrupt() -> None:
        os.read(alive, 1)
        signal.pthread_kill(main, signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        popen = subprocess.Popen
        patch.setattr(subprocess, "Popen", lambda *given, **settings: popen(*given, pass_fds=(held,), **settings))
        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            compiler._run_compiler(program)
    thread.join()
    os.close(held)
    assert os.read(alive, 1) == b""
    os.close(alive)


@needs_compiler
def test_two_processes_may_build_the_same_at_once(tmp_path: Path) -> None:
    source = "int answer(void) { return 42; }"
    program = "from pneuopt.dynamics.compiled.compiler import compile_library\n"
    program += f"assert compile_library({source!r}).answer() == 42"
    settings = {**os.environ, "PNEUOPT_CACHE": str(tmp_path)}
    running = [subprocess.Popen([sys.executable, "-c", program], env=settings) for _ in range(2)]
    assert [process.wait(60) for process in running] == [0, 0]
    assert len(list(tmp_path.iterdir())) == 1


DAY = 24 * 3600.0


def library(folder: Path, name: str, days: float, size: int = 100) -> Path:
    path = folder / f"{name}.so"
    path.write_bytes(b"x" * size)
    then = time.time() - days * DAY
    os.utime(path, (then, then))
    return path


def left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_was_not_used_for_half_a_year_goes(tmp_path: Path) -> None:
    library(tmp_path, "new", 0)
    library(tmp_path, "spring", 170)
    library(tmp_path, "winter", 190)
    (tmp_path / "zig").mkdir()
    trim_cache(tmp_path)
    assert left(tmp_path) == {"new.so", "spring.so", "zig"}


def test_too_many_go_from_the_one_unused_for_longest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library_cache, "LARGEST_SIZE", 250)
    for k in range(4):
        library(tmp_path, f"l{k}", k)
    trim_cache(tmp_path)
    assert left(tmp_path) == {"l0.so", "l1.so"}


def test_what_a_killed_process_left_goes_after_a_day(tmp_path: Path) -> None:
    for name, days in (("compile-a", 0.1), ("compile-b", 2.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.c").touch()
        then = time.time() - days * DAY
        os.utime(tmp_path / name, (then, then))
    trim_cache(tmp_path)
    assert left(tmp_path) == {"compile-a"}


def test_a_use_counts_and_a_new_library_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    product = tmp_path / "product"
    product.write_bytes(b"one")
    one = keep_library(tmp_path, "one", product)
    then = time.time() - 2 * NOTICE_TIME
    os.utime(one, (then, then))
    assert find_library(tmp_path, "one") == one
    assert time.time() - one.stat().st_mtime < NOTICE_TIME
    monkeypatch.setattr(library_cache, "LARGEST_SIZE", 2)
    product.write_bytes(b"two")
    two = keep_library(tmp_path, "two", product)
    assert left(tmp_path) == {two.name}


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
