"""CasADi Functions as cached machine code; the CasADi VM where there is no compiler. Both give the same answers.

`compiled` makes one Function callable; `Rollout` runs a sampled system over many segments at once, with forward
sensitivities. Binaries are cached by content (source, flags, compiler, CPU); logs, values and step sizes are arguments,
so one binary serves every log and every continuation step.
"""

import ctypes
import functools
import hashlib
import itertools
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.errors import ModelError, require

Array = NDArray[np.float64]
DRIVER = Path(__file__).with_suffix(".c")
FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
COMPILE_SECONDS = 300
log = logging.getLogger("pneuopt")


@dataclass(frozen=True, eq=False)
class Pieces:
    """The SX Functions of one sampled system, as `Rollout` runs them.

    Parameters
    ----------
    step : casadi.Function
        ``(t, h, x, u, p) -> (x_next, y)``.
    update : casadi.Function or None
        ``(t, x, u, p) -> x``.
    """

    step: ca.Function
    update: ca.Function | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """What `Rollout` returns for m segments of n samples.

    Attributes
    ----------
    y : ndarray, shape (m, n, n_outputs)
    x_end : ndarray, shape (m, n_states)
        State after the last sample's step.
    x : ndarray, shape (m, n, n_states), or None
        State at each sample, before the controller's update.
    dy : ndarray, shape (m, n, n_outputs, n_columns), or None
    dx_end : ndarray, shape (m, n_states, n_columns), or None
        Sensitivities; the columns are the start state, then the chosen parameters.
    """

    y: Array
    x_end: Array
    x: Array | None = None
    dy: Array | None = None
    dx_end: Array | None = None


class Rollout:
    """Run a sampled system over many segments at once.

    Parameters
    ----------
    pieces : Pieces
    wrt : sequence of int
        Positions in the parameter vector of which sensitivities are wanted.
    start : bool
        Whether sensitivities to the start state are wanted.
    threads : int, optional
        Default: one a processor.
    """

    def __init__(
        self, pieces: Pieces, wrt: Sequence[int] = (), start: bool = False, threads: int | None = None
    ) -> None:
        self._functions = _with_sensitivities(pieces, tuple(wrt), start)
        step = self._functions["step"]
        self.n_states, self.n_inputs, self.n_parameters = (step.size1_in(i) for i in (2, 3, 4))
        self.n_outputs = self._functions["output"].size1_out(0)
        self.n_columns = len(tuple(wrt)) + (self.n_states if start else 0)
        self._starts = self.n_states if start else 0
        self._threads = threads or os.cpu_count() or 1
        self._library = _build(_rollout_source(self._functions, self._sizes()))

    @property
    def is_compiled(self) -> bool:
        """Whether machine code runs; otherwise the CasADi VM does."""
        return self._library is not None

    def run(
        self,
        x0: ArrayLike,
        u: ArrayLike,
        p: ArrayLike,
        t: ArrayLike,
        h: ArrayLike,
        *,
        substeps: int = 1,
        states: bool = False,
    ) -> Run:
        """Integrate m segments of n samples each.

        Parameters
        ----------
        x0 : array_like, shape (m, n_states)
        u : array_like, shape (m, n, n_inputs)
            Held over each sample.
        p : array_like, shape (n_parameters,) or (m, n_parameters)
        t, h : array_like, shape (m, n)
            Instant of each sample and the step that follows it [s]; h = 0 pads a short segment.
        substeps : int
            Integration steps a sample.
        states : bool
            Whether to return the state at each sample.

        Returns
        -------
        Run
        """
        t, h, x0, u, p = (np.ascontiguousarray(a, dtype=np.float64) for a in (t, h, x0, u, p))
        wrong = f"t and h must have shape (m, n), got {t.shape}, {h.shape}"
        require(t.ndim == 2 and h.shape == t.shape, wrong, ModelError)
        m, n = t.shape
        expected = {"x0": (m, self.n_states), "u": (m, n, self.n_inputs)}
        for name, array in (("x0", x0), ("u", u)):
            require(array.shape == expected[name], f"{name}: {array.shape}, expected {expected[name]}", ModelError)
        require(p.shape in ((self.n_parameters,), (m, self.n_parameters)), f"p has shape {p.shape}", ModelError)
        require(substeps >= 1, f"substeps must be at least 1, got {substeps}", ModelError)
        run = self._run_compiled if self._library is not None else self._run_vm
        return run(x0, u, p, t, h, substeps, states)

    def _sizes(self) -> dict[str, int]:
        work = max(f.sz_w() for f in self._functions.values())
        sizes = {"NX": self.n_states, "NU": self.n_inputs, "NP": self.n_parameters, "NY": self.n_outputs}
        has_update = int("update" in self._functions)
        return sizes | {"NS": self.n_columns, "STARTS": self._starts, "WORK": work, "HAS_UPDATE": has_update}

    def _run_compiled(self, x0: Array, u: Array, p: Array, t: Array, h: Array, substeps: int, states: bool) -> Run:
        (m, n), ny, nx, ns = t.shape, self.n_outputs, self.n_states, self.n_columns
        y, x_end = np.empty((m, n, ny)), np.empty((m, nx))
        dy, dx_end = (np.empty((m, n, ns, ny)), np.empty((m, ns, nx))) if ns else (None, None)
        x = np.empty((m, n, nx)) if states else None
        stride = p.shape[1] if p.ndim == 2 else 0
        pointers = [a.ctypes.data if a is not None else None for a in (x0, u, p, t, h, y, dy, x, x_end, dx_end)]
        assert self._library is not None
        function = self._library.rollout
        function.argtypes = [ctypes.c_longlong] * 3 + [ctypes.c_int, ctypes.c_longlong] + [ctypes.c_void_p] * 10
        function.restype = None
        parts = max(1, min(self._threads, m))
        edges = [m * i // parts for i in range(parts + 1)]
        calls = [(a, b, n, substeps, stride, *pointers) for a, b in itertools.pairwise(edges)]
        if len(calls) == 1:
            function(*calls[0])
        else:
            list(_pool(self._threads).map(lambda call: function(*call), calls))
        return Run(y, x_end, x, _swapped(dy), _swapped(dx_end))

    def _run_vm(self, x0: Array, u: Array, p: Array, t: Array, h: Array, substeps: int, states: bool) -> Run:
        (m, n), ny, nx, ns = t.shape, self.n_outputs, self.n_states, self.n_columns
        update, step, output = (_mapped(self._functions.get(k), m) for k in ("update", "step", "output"))
        assert step is not None
        assert output is not None
        pm = np.broadcast_to(p, (m, self.n_parameters)).T
        x, S = x0.T, np.tile(np.eye(nx, ns) if self._starts else np.zeros((nx, ns)), (1, m))
        xs, ys, dys = [], [], []
        for j in range(n):
            tj, hj, uj = t[:, j], h[:, j] / substeps, u[:, j].T
            xs.append(x)
            if update is not None:
                x, S = update(tj, x, uj, pm, S)
            y, dy = output(tj, x, uj, pm, S)
            ys.append(y)
            dys.append(dy)
            for k in range(substeps):
                x, S = step(tj + k * hj, hj, x, uj, pm, S)
        run_y = np.stack([a.T for a in ys], axis=1) if ny else np.empty((m, n, 0))
        run_x = np.stack([a.T for a in xs], axis=1) if states else None
        if not ns:
            return Run(run_y, np.ascontiguousarray(x.T), run_x)
        run_dy = np.stack([_unstacked(a, ny, m, ns) for a in dys], axis=1)
        return Run(run_y, np.ascontiguousarray(x.T), run_x, run_dy, _unstacked(S, nx, m, ns))


def compiled(function: ca.Function) -> Callable[..., tuple[Array, ...]]:
    """Make an SX Function callable on arrays, as machine code where a compiler is found.

    Parameters
    ----------
    function : casadi.Function
        Inputs and outputs dense vectors, scalars or matrices.

    Returns
    -------
    callable
        ``f(*inputs) -> tuple of ndarray``: vectors flat, matrices of shape (rows, columns). Not thread-safe.
    """
    function = _dense(function, "system_function")
    shapes = [function.size_out(i) for i in range(function.n_out())]
    library = _build(_source({"f": function}))
    if library is None:
        return lambda *inputs: tuple(map(_shaped, map(np.array, function.call(list(inputs))), shapes))
    buffers = [_buffer(function.size_in(i)) for i in range(function.n_in())]
    results = [_buffer(shape) for shape in shapes]
    work = np.zeros(max(1, function.sz_w()))
    sz_arg, sz_res = max(1, function.sz_arg()), max(1, function.sz_res())
    arg = (ctypes.c_void_p * sz_arg)(*(b.ctypes.data for b in buffers))
    res = (ctypes.c_void_p * sz_res)(*(r.ctypes.data for r in results))
    call = library.system_function
    call.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
    pointers = (ctypes.addressof(arg), ctypes.addressof(res), None, work.ctypes.data, 0)

    def evaluate(*inputs: ArrayLike) -> tuple[Array, ...]:
        for i, (buffer, value) in enumerate(zip(buffers, inputs, strict=True)):
            size = value.size if isinstance(value, np.ndarray) else np.size(value)
            if size != buffer.size:
                raise ModelError(f"argument {i} has {size} numbers, expected {buffer.size}")
            buffer[...] = value
        call(*pointers)
        return tuple([result.copy() for result in results])

    evaluate.keep_alive = (library, arg, res, work)  # type: ignore[attr-defined]
    return evaluate


def compiler() -> str | None:
    """Path of the C compiler that is used: ``$PNEUOPT_CC``, ``$CC``, gcc, clang, cc; None if none is found."""
    chosen = os.environ.get("PNEUOPT_CC", os.environ.get("CC"))
    if chosen is not None:
        return shutil.which(chosen) if chosen else None
    return next(filter(None, map(shutil.which, ("gcc", "clang", "cc"))), None)


def cache_directory() -> Path:
    """Where binaries are kept: ``$PNEUOPT_CACHE`` or the platform's cache folder; a temporary one if unwritable."""
    home = Path.home() / ("AppData/Local" if os.name == "nt" else ".cache")
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME") or home
    folder = Path(os.environ.get("PNEUOPT_CACHE") or Path(base) / "pneuopt")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        return _temporary_folder(f"{folder}: {error.strerror or error}")


@functools.cache
def _temporary_folder(reason: str) -> Path:
    log.warning("the cache of compiled models cannot be written (%s): compiling anew in each run", reason)
    return Path(tempfile.mkdtemp(prefix="pneuopt-"))


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="pneuopt")


def _with_sensitivities(pieces: Pieces, wrt: tuple[int, ...], start: bool) -> dict[str, ca.Function]:
    """Each piece with S = dx/d(columns) carried along: (..., x, u, p, S) -> (value, its sensitivity)."""
    sx = {k: ca.SX.sym(k, pieces.step.size1_in(i)) for i, k in enumerate(("t", "h", "x", "u", "p"))}
    t, h, x, u, p = sx.values()
    ns = len(wrt) + (x.numel() if start else 0)
    S = ca.SX.sym("S", x.numel(), ns)
    dp = ca.SX(p.numel(), ns)
    for column, position in enumerate(wrt, ns - len(wrt)):
        dp[position, column] = 1

    def carried(name: str, arguments: list[ca.SX], value: ca.SX) -> ca.Function:
        directions = [_directional(value, x, p, S[:, c], dp[:, c]) for c in range(ns)]
        sensitivity = ca.horzcat(*directions) if ns else ca.SX(value.numel(), 0)
        # a bare "step" would be bound to the C library's own
        inputs, outputs = [*arguments, x, u, p, S], [ca.densify(value), ca.densify(sensitivity)]
        return ca.Function(f"system_{name}", inputs, outputs, {"cse": True})

    x_next, y = pieces.step(t, h, x, u, p)
    functions = {"step": carried("step", [t, h], x_next), "output": carried("output", [t], y)}
    if pieces.update is not None:
        functions["update"] = carried("update", [t], pieces.update(t, x, u, p))
    return functions


def _directional(value: ca.SX, x: ca.SX, p: ca.SX, dx: ca.SX, dp: ca.SX) -> ca.SX:
    return ca.jtimes(value, ca.vertcat(x, p), ca.vertcat(dx, dp))


def _dense(function: ca.Function, name: str) -> ca.Function:
    inputs = [ca.SX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    outputs = function.call(inputs)
    return ca.Function(name, inputs, [ca.densify(o) for o in outputs], {"cse": True})


def _source(functions: dict[str, ca.Function]) -> str:
    generator = ca.CodeGenerator("generated.c", {"with_header": False, "verbose": False})
    for function in functions.values():
        generator.add(function)
    return str(generator.dump())


def _rollout_source(functions: dict[str, ca.Function], sizes: dict[str, int]) -> str:
    defines = "".join(f"#define {k} {v}\n" for k, v in sizes.items())
    driver = DRIVER.read_text(encoding="utf-8")
    before, after = driver.split("#include GENERATED", 1)
    return defines + before + _source(functions) + after


@functools.cache
def _build(source: str) -> ctypes.CDLL | None:
    """Compile, or load from the cache; None where that cannot be done, which is said once."""
    cc = compiler()
    if cc is None:
        _say_once("no C compiler found: models run in the CasADi VM, with the same answers, about ten times slower")
        return None
    try:
        identity = [source, *FLAGS, _compiler_version(cc), platform.processor(), _cpu()]
        name = hashlib.sha256("\0".join(identity).encode()).hexdigest()[:32]
        return _loaded(cc, source, cache_directory() / f"{name}.so")
    except (OSError, subprocess.SubprocessError) as error:
        detail = getattr(error, "stderr", None) or str(error)
        _say_once(f"compiling with {cc} failed, the CasADi VM runs instead, with the same answers: {detail[:400]}")
        return None


def _loaded(cc: str, source: str, binary: Path) -> ctypes.CDLL:
    if binary.exists():
        try:
            return ctypes.CDLL(str(binary))
        except OSError:  # damaged on the disk; it is built anew
            log.debug("%s cannot be loaded, compiling it anew", binary)
    _compile(cc, source, binary)
    return ctypes.CDLL(str(binary))


def _compile(cc: str, source: str, binary: Path) -> None:
    with tempfile.TemporaryDirectory(dir=binary.parent) as folder:
        text, product = Path(folder) / "model.c", Path(folder) / binary.name
        text.write_text(source, encoding="utf-8")
        command = [cc, *FLAGS, str(text), "-o", str(product), "-lm"]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=COMPILE_SECONDS)
        product.replace(binary)


@functools.cache
def _say_once(message: str) -> None:
    log.warning("%s", message)


@functools.cache
def _compiler_version(cc: str) -> str:
    result = subprocess.run([cc, "--version"], capture_output=True, text=True, timeout=30, check=False)
    return cc + result.stdout


@functools.cache
def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    return "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))


def _mapped(function: ca.Function | None, m: int) -> Callable[..., tuple[Array, ...]] | None:
    if function is None:
        return None
    mapped = function.map(m)
    return lambda *inputs: tuple(np.array(a) for a in mapped.call([ca.DM(np.atleast_2d(i)) for i in inputs]))


def _unstacked(block: Array, rows: int, m: int, columns: int) -> Array:
    """(rows, m * columns) as CasADi's map stacks it -> (m, rows, columns)."""
    return np.ascontiguousarray(block.reshape(rows, m, columns).transpose(1, 0, 2))


def _swapped(array: Array | None) -> Array | None:
    return None if array is None else np.swapaxes(array, -1, -2)


def _buffer(shape: tuple[int, int]) -> Array:
    """Vectors flat, matrices in CasADi's column order."""
    return np.zeros(shape[0] * shape[1]) if 1 in shape else np.zeros(shape, order="F")


def _shaped(array: Array, shape: tuple[int, int]) -> Array:
    rows, columns = shape
    return array.ravel(order="F") if 1 in (rows, columns) else array.reshape(rows, columns, order="F")
