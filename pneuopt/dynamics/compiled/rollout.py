"""`Rollout`: a sampled system over many segments at once, each in a SIMD lane, with forward sensitivities.

It is cached machine code, or runs in the CasADi VM where there is no compiler, with the same answers. Logs, values and
step sizes are arguments, so one binary serves every log and every continuation step.
"""

import ctypes
import functools
import itertools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.dynamics.compiled.c_writer import CFunction, write_c
from pneuopt.dynamics.compiled.compiler import compile_library, warn_once
from pneuopt.dynamics.compiled.vm import run_in_vm
from pneuopt.dynamics.integrators import OwnRate, partitioned_step, rk4
from pneuopt.dynamics.tolerances import (
    BLOCK_SEGMENTS,
    BRIEF_STEPS,
    CHECK_SECONDS,
    LARGEST_DERIVATIVE_ERROR,
    LARGEST_DISTANCE,
    UNSHARED_STEPS,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require

_check: ContextVar[Callable[[], None]] = ContextVar("check", default=lambda: None)


@contextmanager
def check_during_runs(check: Callable[[], None]) -> Iterator[None]:
    """Call `check` before each run and now and then during it, in this context; what it raises ends the run."""
    token = _check.set(check)
    try:
        yield
    finally:
        _check.reset(token)


@dataclass(frozen=True, eq=False)
class Pieces:
    """The SX Functions of one sampled system, as `Rollout` runs them."""

    step: ca.Function  # ``(t, h, x, u, p) -> (x_next, y)``
    update: ca.Function | None = None  # ``(t, x, u, p) -> x``
    # ``(t, x, u, p) -> (xdot, y)``, of which `step` is the RK4 step: its sensitivities are cheaper stage by stage
    ode: ca.Function | None = None
    # position of the state in which the ODE is integrated implicitly (`partitioned_step`), in place of RK4
    implicit: int | None = None


@dataclass(frozen=True, eq=False)
class RolloutResult:
    """The outputs, end states and sensitivities of m segments of n samples."""

    y: Array  # (m, n, n_outputs)
    x_end: Array  # (m, n_states): state after the last sample's step
    # (m, ceil(n / states), n_states): state at each so many samples, before the controller's update
    x: Array | None = None
    dy: Array | None = None  # (m, n, n_outputs, n_columns), or None
    # (m, n_states, n_columns), or None: sensitivities; the columns are the start state, then the chosen parameters
    dx_end: Array | None = None


@dataclass(frozen=True, eq=False)
class Gram:
    """The normal equations of the residuals of m segments; s sensitivity columns, as for `RolloutResult`."""

    grams: Array  # (m, s + 1, s + 1): sum over samples and outputs of e e', with e = [dy | y - measured], weighted
    squares: Array  # (m, n_outputs): sum over samples of each output's squared residuals, weighted
    # (m, n_outputs, s): sum over samples of each output's weighted derivatives, of the residuals that count
    sums: Array
    y: Array  # (m, n, n_outputs)
    x_end: Array  # (m, n_states)
    dx_end: Array  # (m, n_states, s)


class Rollout:
    """Run a sampled system over many segments at once, with sensitivities to parameters `wrt` and to the `start` state.

    `lanes` are segments that a processor runs at once, a power of 2, by default what pays; 0 is the CasADi VM.
    """

    def __init__(
        self,
        pieces: Pieces,
        wrt: Sequence[int] = (),
        start: bool = False,
        threads: int | None = None,
        lanes: int | None = None,
    ) -> None:
        self._functions, source = prepare_rollout(pieces.step, pieces.update, pieces.ode, wrt, start, pieces.implicit)
        step = self._functions["step"]
        self.n_states, self.n_inputs, self.n_parameters = (step.size1_in(i) for i in (2, 3, 4))
        self.n_outputs = self._functions["output"].size1_out(0)
        self.n_columns = len(tuple(wrt)) + (self.n_states if start else 0)
        self._starts = self.n_states if start else 0
        self._threads = threads or processor_count()
        choices = ("SIMD", "LANES=1") if lanes is None else (f"LANES={lanes}",)
        self._library = compile_library(source, *choices) if source and lanes != 0 else None
        self.lanes = 0 if self._library is None else ctypes.c_int.in_dll(self._library, "rollout_lanes").value

    @property
    def uses_machine_code(self) -> bool:
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
        states: int = 0,
    ) -> RolloutResult:
        """Integrate m segments from x0 (m, n_states) over n samples at t with steps h [s], (m, n) or (n,) for all.

        So are u (m, n, n_inputs), which is held, and p (m, n_parameters); h = 0 pads; `states`: each so many samples.
        """
        _check.get()()
        x, us, ps, ts, hs = self._check_arrays(x0, u, p, t, h, substeps)
        m, n, ny, nx, ns = len(x), ts.shape[-1], self.n_outputs, self.n_states, self.n_columns
        if self._library is None:
            us, ts, hs = np.broadcast_to(us, (m, n, self.n_inputs)), *(np.broadcast_to(a, (m, n)) for a in (ts, hs))
            run = run_in_vm(self._functions, (x, us, ps, ts, hs), self._starts, substeps, states, self._threads)
            if not self.n_columns:
                return RolloutResult(run.y, run.x_end, run.x)
            return RolloutResult(run.y, run.x_end, run.x, _swap_last_axes(run.dy), _swap_last_axes(run.dx_end))
        y, x_end = np.empty((m, n, ny)), np.empty((m, nx))
        dy, dx_end = (np.empty((m, n, ns, ny)), np.empty((m, ns, nx))) if ns else (None, None)
        kept = np.empty((m, -(-n // states), nx)) if states else None
        others = None, None, y, dy, kept, x_end, dx_end, None, None, None
        self._call_library((x, us, ps, ts, hs), substeps, states, others)
        return RolloutResult(y, x_end, kept, _swap_last_axes(dy), _swap_last_axes(dx_end))

    def gram(
        self,
        x0: ArrayLike,
        u: ArrayLike,
        p: ArrayLike,
        t: ArrayLike,
        h: ArrayLike,
        measured: ArrayLike,
        weight: ArrayLike,
        *,
        substeps: int = 1,
    ) -> Gram:
        """Integrate as `run` does, and sum up the residuals' normal equations without storing their derivatives.

        `measured` and `weight`, one over the noise, are (m, n, n_outputs); NaN: no residual.
        """
        _check.get()()
        given = self._check_arrays(x0, u, p, t, h, substeps)
        require(
            given[1].ndim == 3 and given[3].ndim == 2, "gram: each segment has its own inputs and instants", ModelError
        )
        y, w = (np.ascontiguousarray(a, dtype=np.float64) for a in (measured, weight))
        shape = (*given[3].shape, self.n_outputs)
        for name, array in (("measured", y), ("weight", w)):
            require(array.shape == shape, f"{name}: {array.shape}, expected {shape}", ModelError)
        if self._library is None:
            return self._gram_vm(given, y, w, substeps)
        m, nx, ns = len(given[0]), self.n_states, self.n_columns
        grams, squares = np.empty((m, ns + 1, ns + 1)), np.empty((m, self.n_outputs))
        sums = np.empty((m, ns, self.n_outputs))
        outputs, x_end, dx_end = np.empty(shape), np.empty((m, nx)), np.empty((m, ns, nx))
        self._call_library(given, substeps, 0, (y, w, outputs, None, None, x_end, dx_end, grams, squares, sums))
        return Gram(grams, squares, np.swapaxes(sums, 1, 2), outputs, x_end, np.swapaxes(dx_end, 1, 2))

    def _check_arrays(
        self, x0: ArrayLike, u: ArrayLike, p: ArrayLike, t: ArrayLike, h: ArrayLike, substeps: int
    ) -> tuple[Array, Array, Array, Array, Array]:
        t, h, x0, u, p = (np.ascontiguousarray(a, dtype=np.float64) for a in (t, h, x0, u, p))
        wrong = f"t and h must have shape (m, n) or (n,), got {t.shape}, {h.shape}"
        require(t.ndim in (1, 2) and h.shape == t.shape, wrong, ModelError)
        m, n = len(x0) if t.ndim == 1 else len(t), t.shape[-1]
        expected = {"x0": (m, self.n_states), "u": (n, self.n_inputs) if u.ndim == 2 else (m, n, self.n_inputs)}
        for name, array in (("x0", x0), ("u", u)):
            require(array.shape == expected[name], f"{name}: {array.shape}, expected {expected[name]}", ModelError)
        require(p.shape in ((self.n_parameters,), (m, self.n_parameters)), f"p has shape {p.shape}", ModelError)
        require(substeps >= 1, f"substeps must be at least 1, got {substeps}", ModelError)
        most = int(np.iinfo(np.intc).max)  # a C int counts them
        require(substeps <= most, f"substeps may be {most} at most, got {substeps}", ModelError)
        return x0, u, p, t, h

    def _gram_vm(self, given: tuple[Array, ...], measured: Array, weight: Array, substeps: int) -> Gram:
        parts = []
        for i in range(0, len(measured), BLOCK_SEGMENTS):
            _check.get()()
            x0, u, p, t, h, y, w = (a if a.ndim == 1 else a[i : i + BLOCK_SEGMENTS] for a in (*given, measured, weight))
            run = run_in_vm(self._functions, (x0, u, p, t, h), self._starts, substeps, 0, self._threads)
            dy, dx_end = (np.swapaxes(a, -1, -2) for a in (run.dy, run.dx_end))
            e = np.concatenate([dy, (run.y - y)[..., None]], axis=-1) * w[..., None]
            e = np.where(np.isfinite(y)[..., None], e, 0.0)
            flat = e.reshape(len(y), -1, e.shape[-1])
            squares, sums = np.sum(e[..., -1] ** 2, axis=1), e[..., :-1].sum(axis=1)
            parts.append((np.swapaxes(flat, 1, 2) @ flat, squares, sums, run.y, run.x_end, dx_end))
        return Gram(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def _call_library(
        self, given: tuple[Array, ...], substeps: int, states: int, others: tuple[Array | None, ...]
    ) -> None:
        """Run the machine code, the segments shared out to the threads."""
        assert self._library is not None
        (x0, u, p, t, _), n = given, given[3].shape[-1]
        m = len(x0)
        function, stop = self._library.rollout, ctypes.c_int(0)
        function.argtypes = [ctypes.c_longlong] * 3 + [ctypes.c_int] + [ctypes.c_longlong] * 4 + [ctypes.c_void_p] * 16
        function.restype = None
        arrays = (*given, *others)
        pointers = [a.ctypes.data if a is not None else None for a in arrays]
        strides = p.shape[1] if p.ndim == 2 else 0, n if u.ndim == 3 else 0, n if t.ndim == 2 else 0
        at = ctypes.addressof(stop)
        steps = m * n * substeps
        parts = self._parts(m) if steps > UNSHARED_STEPS else [(0, m)]
        calls = [(a, b, n, substeps, *strides, states or 1, *pointers, at) for a, b in parts]
        self._share_out(function, calls, steps, stop, arrays)

    def race(self, course: Any, m: int, steps: int, arrays: Sequence[Any]) -> None:
        """Run the race of m candidates that a struct Race of race.c describes, by pointers to `arrays`."""
        assert self._library is not None
        function, stop = self._library.race, ctypes.c_int(0)
        function.argtypes, function.restype = [ctypes.c_void_p, ctypes.c_longlong, ctypes.c_longlong], None
        course.stop = ctypes.addressof(stop)
        calls = [(ctypes.addressof(course), a, b) for a, b in self._parts(m)]
        self._share_out(function, calls, steps, stop, (course, *arrays))

    def _parts(self, m: int) -> list[tuple[int, int]]:
        """Begin and end of each thread's part of m segments."""
        blocks = -(-m // self.lanes)
        parts = max(1, min(self._threads, blocks))
        return list(itertools.pairwise(min(m, blocks * i // parts * self.lanes) for i in range(parts + 1)))

    def _share_out(
        self,
        function: Callable[..., None],
        calls: Sequence[tuple[object, ...]],
        steps: int,
        stop: ctypes.c_int,
        kept: tuple[Any, ...],
    ) -> None:
        """Make the calls, each in a thread of its own; Ctrl-C or a check stops them, since this thread only waits.

        A single short call of so many steps is made here: a thread would take longer than its work.
        """
        if len(calls) == 1 and steps <= BRIEF_STEPS * self.lanes:
            function(*calls[0])
            return
        running = [_pool(self._threads).submit(_call_part, function, call, (stop, *kept)) for call in calls]
        try:
            for each in running:
                while not wait([each], CHECK_SECONDS).done:
                    _check.get()()
                each.result()
        except BaseException:
            stop.value = 1
            wait(running)
            raise


def _call_part(function: Callable[..., None], call: tuple[object, ...], kept: tuple[Any, ...]) -> None:  # noqa: ARG001
    """Run a thread's part; it holds what they point to, which Ctrl-C in the main thread must not free."""
    function(*call)


def processor_count() -> int:
    """Processors that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux only
    return len(allowed(0)) if allowed else os.cpu_count() or 1


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="pneuopt")


if hasattr(os, "register_at_fork"):  # a forked child has the pool's locks, but no threads: it would wait for ever
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _swap_last_axes(array: Array | None) -> Array | None:
    return None if array is None else np.swapaxes(array, -1, -2)


C_SOURCE_FOLDER = Path(__file__).parent
INPUT_RATES = {"t": 1, "u": 1, "p": 0, "x": 2, "S": 2}  # how often inputs change: an index into `c_writer.RATES`
PIECE_OUTPUTS = {"step": ("x_next", "S_next"), "output": ("y", "dy"), "update": ("x_next", "S_next")}
STEP_INPUT_RATES = {"t": 2, "h": 1, "u": 1, "p": 0, "x": 2, "S": 2}


def prepare_rollout(
    step: ca.Function,
    update: ca.Function | None,
    ode: ca.Function | None,
    wrt: Sequence[int],
    start: bool,
    implicit: int | None = None,
) -> tuple[dict[str, ca.Function], str]:
    """The pieces of a sampled system, ``(..., x, u, p, S) -> (value, its sensitivity)``, and their C, "" if none.

    Of an ODE in RK4 steps "rate", too: ``(t, x, u, p) -> (xdot, its Jacobians to x and to the chosen parameters)``.
    """
    return prepare_by_content(str(step.serialize()), _serialize(update), _serialize(ode), tuple(wrt), start, implicit)


@functools.lru_cache(maxsize=64)
def prepare_by_content(
    step: str, update: str | None, ode: str | None, wrt: tuple[int, ...], start: bool, implicit: int | None
) -> tuple[dict[str, ca.Function], str]:
    """`prepare_rollout` of serialised Functions, cached by their content."""
    given = ca.Function.deserialize(step), _deserialize(update), _deserialize(ode)
    functions = _with_sensitivities(*given, wrt, start, implicit)
    try:
        return functions, _rollout_source(functions, len(wrt), start)
    except NotImplementedError as missing:
        warn_once(f"no C for {missing}: this model runs in the CasADi VM, about ten times slower")
        return functions, ""


def _serialize(function: ca.Function | None) -> str | None:
    return None if function is None else str(function.serialize())


def _deserialize(content: str | None) -> ca.Function | None:
    return None if content is None else ca.Function.deserialize(content)


def _with_sensitivities(
    step: ca.Function,
    update: ca.Function | None,
    ode: ca.Function | None,
    wrt: Sequence[int],
    start: bool,
    implicit: int | None,
) -> dict[str, ca.Function]:
    """Each piece with S = dx/d(columns) carried along: (..., x, u, p, S) -> (value, its sensitivity)."""
    t, h, x, u, p = (ca.SX.sym(k, step.size1_in(i)) for i, k in enumerate(("t", "h", "x", "u", "p")))
    S = ca.SX.sym("S", x.numel(), len(wrt) + (x.numel() if start else 0))

    def value_sensitivity(value: ca.SX) -> ca.SX:
        """The value's sensitivity: its Jacobian first, which is cheaper than each column through every operation."""
        fixed = ca.SX(value.numel(), S.size2() - len(wrt))
        return ca.mtimes(ca.jacobian(value, x), S) + ca.horzcat(fixed, ca.jacobian(value, p)[:, list(wrt)])

    def piece_function(name: str, arguments: list[ca.SX], value: ca.SX, sensitivity: ca.SX) -> ca.Function:
        # a bare "step" would be bound to the C library's own
        outputs = [ca.densify(value), ca.densify(sensitivity)]
        return ca.Function(f"system_{name}", [*arguments, x, u, p, S], outputs, {"cse": True})

    x_next, y = step(t, h, x, u, p)
    S_next = value_sensitivity(x_next)
    if ode is not None:
        rate = ca.Function(
            "rate", [t, x, u, p, S], [ca.horzcat(*(f(ode(t, x, u, p)[0]) for f in (ca.densify, value_sensitivity)))]
        )
        both = _advance(lambda at, z: rate(at, z[:, 0], u, p, z[:, 1:]), ode, implicit, (t, h, x, u, p, S))
        x_next, S_next = both[:, 0], both[:, 1:]
    functions = {
        "step": piece_function("step", [t, h], x_next, S_next),
        "output": piece_function("output", [t], y, value_sensitivity(y)),
    }
    if ode is not None and implicit is None:
        xdot = ode(t, x, u, p)[0]
        slopes = [ca.densify(xdot), ca.jacobian(xdot, x), ca.jacobian(xdot, p)[:, list(wrt)]]
        functions["rate"] = ca.Function("system_rate", [t, x, u, p], slopes, {"cse": True})
    if update is not None:
        after = update(t, x, u, p)
        functions["update"] = piece_function("update", [t], after, value_sensitivity(after))
    return functions


def _advance(
    rate: Callable[[ca.SX, ca.SX], ca.SX], ode: ca.Function, implicit: int | None, symbols: tuple[ca.SX, ...]
) -> ca.SX:
    """The states and sensitivities, a column each, after a step of RK4 or one that is implicit in a state."""
    t, h, x, u, p, S = symbols
    both = ca.horzcat(x, S)
    if implicit is None:
        return rk4(rate, t, h, both)
    row, xdot = implicit, ode(t, x, u, p)[0]
    column = ca.jacobian(xdot, x)[:, row]
    own = ca.Function("own", [t, x, u, p], [ca.densify(f) for f in (xdot[row], column[row], column)])

    def value(at: ca.SX, there: ca.SX) -> tuple[ca.SX, ca.SX]:
        found, slope, _ = own(at, there, u, p)
        return found, slope

    return partitioned_step(rate, OwnRate(row, value, lambda at, there: own(at, there, u, p)[2]), t, h, both)


def _rollout_source(functions: dict[str, ca.Function], chosen: int, start: bool) -> str:
    """The run in C: sizes, lanes, and the driver around the pieces."""
    nx, nu, np_ = (functions["step"].size1_in(i) for i in (2, 3, 4))
    starts = nx if start else 0
    sizes = {"NX": nx, "NU": nu, "NP": np_, "NY": functions["output"].size1_out(0)}
    sizes |= {"STARTS": starts, "NS": starts + chosen, "HAS_UPDATE": int("update" in functions)}
    pieces = []
    for name, results in PIECE_OUTPUTS.items():
        text, kept = "", 0
        if name in functions:
            arguments = ("t", "h", "x", "u", "p", "S") if name == "step" else ("t", "x", "u", "p", "S")
            rates = STEP_INPUT_RATES if name == "step" else INPUT_RATES
            text, kept = write_c(CFunction(name, functions[name], arguments, results), rates)
        pieces.append(text)
        sizes |= {f"{name.upper()}_KEPT": kept}
    defines = (f"#define {k} {v}" for k, v in sizes.items())
    lanes, driver = ((C_SOURCE_FOLDER / name).read_text(encoding="utf-8") for name in ("lanes.h", "rollout.c"))
    before, after = driver.split("#include PIECES", 1)
    race = "" if starts + chosen else (C_SOURCE_FOLDER / "race.c").read_text(encoding="utf-8")
    return "\n".join([*defines, lanes, before, *pieces, after, race])


WAYS = {"vm": 0, "scalar": 1, "lanes": None}  # the lanes of a Rollout


@dataclass(frozen=True)
class SelfCheck:
    """What was found."""

    nanoseconds: dict[str, float]  # CPU time of a step, by "vm", "scalar" and "lanes"; without a compiler by "vm" alone
    # the largest of machine code from the VM, of states and sensitivities, relative to their largest value; 0 without
    # a compiler
    distance: float
    derivative_error: float  # the largest distance of sensitivities from central differences, likewise
    lanes: int  # segments that run at once; 0 without a compiler

    @property
    def is_good(self) -> bool:
        """Whether both agree."""
        return self.distance <= LARGEST_DISTANCE and self.derivative_error <= LARGEST_DERIVATIVE_ERROR


def check_machine_code(
    pieces: Pieces,
    x0: Array,
    u: Array,
    p: Array,
    step: float,
    *,
    segments: int = 40,
    samples: int = 25,
    substeps: int = 10,
    difference: float = 1e-6,
) -> SelfCheck:
    """Run a system each way, with sensitivities to all parameters that are not zero, and without, by steps [s].

    Segments get the largest inputs `u` (n_inputs,) from -1 to 1 times; a central difference is relative.
    """
    shares = np.linspace(-1, 1, segments * samples).reshape(segments, samples, 1)
    t, h = np.tile(np.arange(samples) * step, (segments, 1)), np.full((segments, samples), step)
    wrt = tuple(np.flatnonzero(p).tolist())

    def run(rollout: Rollout, values: Array = p) -> RolloutResult:
        return rollout.run(np.tile(x0, (segments, 1)), shares * u, values, t, h, substeps=substeps)

    found, nanoseconds, lanes = dict[str, Array](), dict[str, float](), 0
    for way, number in WAYS.items():
        plain = Rollout(pieces, threads=1, lanes=number)
        if number != 0 and not plain.uses_machine_code:
            break
        seconds = []
        for _ in range(2):  # the faster one counts
            began = time.process_time()
            run(plain)
            seconds.append(time.process_time() - began)
        nanoseconds[way] = 1e9 * min(seconds) / (segments * samples * substeps)
        slope = run(Rollout(pieces, wrt, threads=1, lanes=number)).dx_end
        assert slope is not None
        found[way], lanes = slope, max(lanes, plain.lanes)
    plain = Rollout(pieces, threads=1, lanes=0)
    differences = np.empty_like(found["vm"])
    for column, k in enumerate(wrt):
        ends = [run(plain, np.where(np.arange(len(p)) == k, p * (1 + sign * difference), p)).x_end for sign in (1, -1)]
        differences[..., column] = (ends[0] - ends[1]) / (2 * difference * p[k])
    distance = max(_distance(slope, found["vm"]) for slope in found.values())
    return SelfCheck(nanoseconds, distance, _distance(differences, found["vm"]), lanes)


def _distance(a: Array, b: Array) -> float:
    """The largest, each column relative to its largest value."""
    size = np.abs(b).max(axis=(0, 1))
    size[size == 0] = 1.0
    return float(np.max(np.abs(a - b) / size))
