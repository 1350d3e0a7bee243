"""Rollouts: machine code and the VM against the equations, shapes that are refused, and runs that Ctrl-C ends."""

import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.compiled import compiler, vm
from pneuopt.dynamics.compiled import rollout as codegen
from pneuopt.dynamics.compiled.compiler import find_compiler
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout, check_during_runs
from pneuopt.dynamics.system import DiscreteSystem, discretise, parameter_vector
from pneuopt.dynamics.tolerances import ARRAY_SEGMENTS
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, LuGre, PressureDependent, Stribeck
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError

Forget = Callable[[], None]
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def loop() -> DiscreteSystem:
    plant = ForceDrive(Stribeck()).system()
    return ClosedLoop(plant, PID(sample_time=2e-3), Dither(frequency=100.0)).discrete(4)


SYSTEMS: dict[str, Callable[[], DiscreteSystem]] = {
    "stribeck": lambda: discretise(ForceDrive(Stribeck()).system(), 5),
    "lugre": lambda: discretise(ForceDrive(LuGre()).system(), 4),
    "pressure": lambda: discretise(MotionDrive(PressureDependent(Coulomb())).system()),
    "sampled loop": loop,
}


class Case:
    """A system with segments of made-up data."""

    def __init__(self, name: str, m: int = 5, n: int = 6) -> None:
        self.system = SYSTEMS[name]()
        rng = np.random.default_rng(3)
        nominal = np.array([q.nominal for q in self.system.states])
        self.x0 = 0.2 * nominal * rng.standard_normal((m, len(nominal)))
        self.u = 0.3 * rng.standard_normal((m, n, len(self.system.inputs)))
        self.u *= np.array([q.nominal for q in self.system.inputs])
        p = parameter_vector(self.system.parameters, self.system.parameters)
        if name == "sampled loop":
            set_to = {"pid.Kp": 50.0, "pid.Ki": 100.0, "pid.Kd": 0.5, "pid.Tf": 0.01, "dither.amplitude": 5.0}
            set_to |= {"pid.lower": -400.0, "pid.upper": 400.0, "pid.Tt": 0.5}
            p = parameter_vector(self.system.parameters, self.system.parameters.with_values(set_to))
        self.p = p * (1 + 0.1 * rng.random((m, len(p))))
        self.h = np.full((m, n), 2e-3)
        self.h[1, 4:] = 0  # a short segment, padded
        self.t = 0.7 + 2e-3 * np.tile(np.arange(n), (m, 1))

    def rollout(self, wrt: tuple[int, ...] = (), start: bool = False, threads: int | None = 1) -> Rollout:
        return Rollout(self.system.pieces, wrt, start, threads)

    def run(self, rollout: Rollout, **changed: Array) -> codegen.RolloutResult:
        given = {"x0": self.x0, "u": self.u, "p": self.p, "t": self.t, "h": self.h, **changed}
        return rollout.run(**given, substeps=self.system.substeps, states=True)


def by_hand(case: Case) -> tuple[Array, Array]:
    """The same run, one CasADi call after another."""
    ys, ends = [], []
    for x, u, p, t, h in zip(case.x0, case.u, case.p, case.t, case.h, strict=True):
        y = []
        for tj, hj, uj in zip(t, h, u, strict=True):
            x = x if case.system.update is None else np.array(case.system.update(tj, x, uj, p)).ravel()  # noqa: PLW2901
            y.append(np.array(case.system.step(tj, 0, x, uj, p)[1]).ravel())
            for k in range(case.system.substeps):
                dt = hj / case.system.substeps
                x = np.array(case.system.step(tj + k * dt, dt, x, uj, p)[0]).ravel()  # noqa: PLW2901
        ys.append(y)
        ends.append(x)
    return np.array(ys), np.array(ends)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_run_is_what_the_steps_give_one_by_one(name: str) -> None:
    case = Case(name)
    run, (y, x_end) = case.run(case.rollout()), by_hand(case)
    assert_allclose(run.y, y, rtol=1e-9, atol=1e-12)
    assert_allclose(run.x_end, x_end, rtol=1e-9, atol=1e-12)
    assert run.x is not None
    assert_array_equal(run.x[:, 0], case.x0)
    assert run.dy is None
    assert run.dx_end is None


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("lanes", [None, 0])
def test_states_may_be_kept_at_some_samples_only(name: str, lanes: int | None) -> None:
    case = Case(name)
    rollout, given = Rollout(case.system.pieces, lanes=lanes), (case.x0, case.u, case.p, case.t, case.h)
    every, some, none = (rollout.run(*given, substeps=case.system.substeps, states=k).x for k in (1, 3, 0))
    assert every is not None
    assert some is not None
    assert some.shape[1] == 2
    assert_array_equal(some, every[:, ::3])
    assert none is None


def differences(case: Case, name: str, index: int, step: float) -> tuple[Array, Array]:
    """Central differences of outputs and end state to one entry of x0 or p, whose size is `step`."""
    rollout, base = case.rollout(), getattr(case, name)
    up, down = base.copy(), base.copy()
    up[:, index] += step
    down[:, index] -= step
    high, low = case.run(rollout, **{name: up}), case.run(rollout, **{name: down})
    return (high.y - low.y) / (2 * step), (high.x_end - low.x_end) / (2 * step)


@pytest.mark.parametrize("name", SYSTEMS)
def test_sensitivities_are_the_central_differences(name: str) -> None:
    case = Case(name)
    nx, wrt = case.x0.shape[1], tuple(range(case.p.shape[1]))
    run = case.run(case.rollout(wrt, start=True))
    assert run.dy is not None
    assert run.dx_end is not None
    assert run.dy.shape[-1] == run.dx_end.shape[-1] == nx + len(wrt)
    steps = [("x0", i, 1e-6 * q.nominal) for i, q in enumerate(case.system.states)]
    steps += [("p", i, 1e-6 * max(abs(case.p[:, i]).max(), 1e-2)) for i in wrt]
    for column, (which, index, step) in enumerate(steps):
        dy, dx_end = differences(case, which, index, step)
        for exact, found in ((dy, run.dy[..., column]), (dx_end, run.dx_end[..., column])):
            size = np.abs(exact).max(initial=0.0)
            # differences of 1e-6 lose half the digits, and tanh friction is sharply curved
            assert_allclose(found, exact, rtol=2e-4, atol=2e-4 * size + 1e-7, err_msg=f"{which}[{index}]")


def assert_alike(a: codegen.RolloutResult, b: codegen.RolloutResult) -> None:
    for field in ("y", "x_end", "x", "dy", "dx_end"):
        left, right = getattr(a, field), getattr(b, field)
        assert left.shape == right.shape, field
        assert_allclose(left, right, rtol=1e-9, atol=1e-9 * np.abs(right).max(initial=1e-3), err_msg=field)


@needs_compiler
@pytest.mark.parametrize("name", SYSTEMS)
def test_machine_code_and_the_casadi_vm_agree_to_rounding(name: str) -> None:
    case = Case(name)
    wrt = (0, 2, case.p.shape[1] - 1)
    fast = case.rollout(wrt, start=True)
    assert fast.uses_machine_code
    slow = Rollout(case.system.pieces, wrt, start=True, lanes=0)
    assert not slow.uses_machine_code
    assert_alike(case.run(fast), case.run(slow))


@needs_compiler
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("lanes", [1, 2, 8])
def test_the_number_of_lanes_changes_nothing(lanes: int, name: str) -> None:
    case = Case(name, m=9)
    wrt = (0, 2, case.p.shape[1] - 1)
    usual = case.rollout(wrt, start=True)
    other = Rollout(case.system.pieces, wrt, start=True, threads=1, lanes=lanes)
    assert other.lanes == lanes
    assert_alike(case.run(other), case.run(usual))


@needs_compiler
def test_lanes_are_as_many_as_pay_on_the_cpu() -> None:
    flags = compiler._cpu_identity().split()
    expected = 4 if "avx" in flags else 2  # eight, under AVX-512, took longer than four
    assert Case("stribeck").rollout().lanes == expected


@pytest.mark.parametrize("m", [1, 2, 3, 7, 8, 9])
def test_a_segment_does_not_depend_on_its_neighbours(m: int) -> None:
    case = Case("sampled loop", m=9)
    rollout = case.rollout((0, 1), start=True)
    whole = case.run(rollout)
    fields = {k: getattr(case, k)[9 - m :] for k in ("x0", "u", "p", "t", "h")}
    part = case.run(rollout, **fields)
    for field in ("y", "x_end", "x", "dy", "dx_end"):
        assert_array_equal(getattr(part, field), getattr(whole, field)[9 - m :], err_msg=field)


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_is_not_a_number_stays_in_its_segment(name: str) -> None:
    case = Case(name, m=9)
    rollout = case.rollout((0,), start=True)
    sound = case.run(rollout)
    case.x0[2], case.p[6] = np.nan, np.inf
    with np.errstate(all="ignore"):
        sick = case.run(rollout)
    others = [k for k in range(9) if k not in (2, 6)]
    for field in ("y", "x_end", "x", "dy", "dx_end"):
        assert_array_equal(getattr(sick, field)[others], getattr(sound, field)[others], err_msg=field)
    assert not np.isfinite(sick.y[6]).all()


def test_stage_by_stage_gives_the_sensitivities_of_the_step_as_a_whole() -> None:
    case = Case("lugre")
    wrt = tuple(range(case.p.shape[1]))
    whole = Rollout(Pieces(case.system.step, case.system.update), wrt, start=True, threads=1)
    assert_alike(case.run(case.rollout(wrt, start=True)), case.run(whole))


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_threads_change_nothing(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codegen, "UNSHARED_STEPS", 0)
    case = Case("lugre")
    one, many = (case.run(case.rollout((1,), start=True, threads=k)) for k in (1, threads))
    for field in ("y", "x_end", "dy", "dx_end"):
        assert_array_equal(getattr(one, field), getattr(many, field))


@needs_compiler
def test_a_brief_run_is_not_shared_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six segments took .36 ms by two threads, .13 by the one that calls: half of the time of a filter of states."""
    case, shared, pool = Case("stribeck"), list[int](), codegen._pool
    rollout = case.rollout(threads=2)

    def counted(threads: int) -> Executor:
        shared.append(threads)
        return pool(threads)

    monkeypatch.setattr(codegen, "_pool", counted)
    brief = case.run(rollout)
    assert not shared
    monkeypatch.setattr(codegen, "UNSHARED_STEPS", case.t.size * case.system.substeps - 1)
    assert_array_equal(case.run(rollout).y, brief.y)
    assert shared


def test_the_vm_runs_without_casadi_s_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call of a Function by matrices takes fifty times as long as a small model's arithmetic."""
    case = Case("sampled loop")
    rollout = Rollout(case.system.pieces, (0,), start=True, lanes=0)
    usual = case.run(rollout)

    original = ca.Function.call

    def refuse(function: ca.Function, arguments: Any, *options: Any) -> Any:
        assert all(isinstance(a, ca.MX) for a in arguments), "a Function was called by matrices"
        return original(function, arguments, *options)

    monkeypatch.setattr(ca.Function, "call", refuse)  # what a call of a Function calls
    again = case.run(rollout)
    assert_array_equal(again.x_end, usual.x_end)


@pytest.mark.parametrize("name", SYSTEMS)
def test_arrays_give_what_casadi_s_machine_gives(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there are many segments, in blocks of which the last is smaller."""
    case = Case(name, m=7)
    rollout = Rollout(case.system.pieces, (0, 1), start=True, lanes=0)
    usual = case.run(rollout)
    monkeypatch.setattr(vm, "ARRAY_SEGMENTS", 1)
    monkeypatch.setattr(vm, "BLOCK_SEGMENTS", 3)
    monkeypatch.setattr(vm, "bind_function", lambda *_: pytest.fail("CasADi's machine was called"))
    assert_alike(case.run(rollout), usual)


def test_arrays_and_folded_steps_are_for_what_they_suit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few segments run in CasADi's machine, with all steps of a sample in a call; many as arrays."""
    calls, bind = [0], vm.bind_function

    def count(*given: Any) -> Any:
        call = bind(*given)

        def counted() -> object:
            calls[0] += 1
            return call()

        return counted

    monkeypatch.setattr(vm, "bind_function", count)
    few, many = Case("stribeck", m=5, n=6), Case("stribeck", m=ARRAY_SEGMENTS, n=6)
    few.run(Rollout(few.system.pieces, lanes=0))
    assert calls == [2 * 6]  # the output and the step
    many.run(Rollout(many.system.pieces, threads=1, lanes=0))
    assert calls == [2 * 6]


@pytest.mark.parametrize("name", SYSTEMS)
def test_threads_of_the_vm_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case, found = Case(name, m=7), []
    monkeypatch.setattr(vm, "OPERATIONS_A_THREAD", 10)
    original, maps = ca.Function.map, list[tuple[object, ...]]()

    def count(function: ca.Function, *given: Any) -> Any:
        maps.append(given)
        return original(function, *given)

    monkeypatch.setattr(ca.Function, "map", count)
    for threads in (1, 3):
        rollout = Rollout(case.system.pieces, (0,), start=True, threads=threads, lanes=0)
        found.append(case.run(rollout))
    m = case.t.size if name == "pressure" else 7  # without a state each sample is a segment
    assert (m,) in maps
    assert (m, "thread", 3) in maps
    for field in ("y", "x_end", "x", "dy", "dx_end"):
        assert_array_equal(getattr(found[0], field), getattr(found[1], field))


@pytest.mark.parametrize("cc", [None, ""])
def test_one_vector_or_grid_serves_all_segments(
    cc: str | None, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    if cc is not None:
        monkeypatch.setenv("PNEUOPT_CC", cc)
    case = Case("stribeck")
    rollout = case.rollout((0,))
    for shared in ("p", "u", "th", "uth", "puth"):
        one = {n: np.array(getattr(case, n)[0]) for n in shared}
        each = {n: np.tile(a, (5, *[1] * a.ndim)) for n, a in one.items()}
        assert_array_equal(case.run(rollout, **one).y, case.run(rollout, **each).y)


def test_padding_freezes_the_state() -> None:
    case = Case("stribeck")
    full, short = case.run(case.rollout()), Case("stribeck")
    for field in ("u", "t", "h"):
        setattr(short, field, getattr(case, field)[:, :4])
    assert_array_equal(full.x_end[1], short.run(short.rollout()).x_end[1])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"x0": np.zeros((4, 2))}, r"x0: \(4, 2\), expected \(5, 2\)"),
        ({"u": np.zeros((5, 6, 3))}, r"u: \(5, 6, 3\), expected \(5, 6, 1\)"),
        ({"p": np.zeros(3)}, r"p has shape \(3,\)"),
        ({"h": np.zeros((5, 5))}, r"t and h must have shape"),
    ],
)
def test_wrong_shapes_are_refused(changed: dict[str, Array], message: str) -> None:
    case = Case("stribeck")
    with pytest.raises(ModelError, match=message):
        case.run(case.rollout(), **changed)


@pytest.mark.parametrize(
    ("count", "said"), [(0, "at least 1, got 0"), (2**40, "2147483647 at most, got 1099511627776")]
)
def test_no_substeps_and_more_than_the_c_int_counts_are_refused(count: int, said: str) -> None:
    case = Case("stribeck")
    with pytest.raises(ModelError, match=said):
        case.rollout().run(case.x0, case.u, case.p, case.t, case.h, substeps=count)


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_runs_on_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pool's threads are not copied, its queue is: before, the child waited for ever."""
    monkeypatch.setattr(codegen, "UNSHARED_STEPS", 0)
    case = Case("stribeck")
    rollout = case.rollout(threads=2)
    assert len(rollout._parts(len(case.x0))) > 1, "one part runs in the main thread"
    expected = case.run(rollout).y
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # ends a child that waits
        os._exit(0 if np.array_equal(case.run(rollout).y, expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("lanes", [pytest.param(None, marks=needs_compiler), 0])
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_gram_is_that_of_the_run_s_residuals(name: str, lanes: int | None) -> None:
    """Summed up on the way, it equals what the stored derivatives give; a missing sample counts nothing."""
    case = Case(name)
    rollout = Rollout(case.system.pieces, (0, 1), start=True, threads=2, lanes=lanes)
    run = case.run(rollout)
    rng = np.random.default_rng(5)
    measured = run.y + rng.standard_normal(run.y.shape)
    measured[0, 1] = measured[1, 4:] = np.nan
    weight = 1 + rng.random(measured.shape)
    found = rollout.gram(case.x0, case.u, case.p, case.t, case.h, measured, weight, substeps=case.system.substeps)
    assert run.dy is not None
    e = np.concatenate([run.dy, (run.y - measured)[..., None]], axis=-1) * weight[..., None]
    e = np.where(np.isfinite(measured)[..., None], e, 0.0).reshape(len(e), -1, e.shape[-1])
    assert_allclose(found.grams, np.swapaxes(e, 1, 2) @ e, rtol=1e-9, atol=1e-9 * np.abs(e).max() ** 2)
    assert_allclose(found.squares.sum(axis=1), found.grams[:, -1, -1], rtol=1e-12)
    derivatives = np.where(np.isfinite(measured), weight, 0.0)[..., None] * run.dy
    assert_allclose(found.sums, derivatives.sum(axis=1), rtol=1e-9, atol=1e-9 * np.abs(derivatives).max())
    assert_allclose(found.y, run.y, rtol=1e-12)
    assert_allclose(found.x_end, run.x_end, rtol=1e-12)
    assert run.dx_end is not None
    assert_allclose(found.dx_end, run.dx_end, rtol=1e-12)


def test_residuals_of_another_shape_are_refused() -> None:
    case = Case("stribeck")
    wrong = np.zeros((5, 6, 1))
    with pytest.raises(ModelError, match=r"measured: \(5, 6, 1\), expected \(5, 6, 2\)"):
        case.rollout((0,)).gram(case.x0, case.u, case.p, case.t, case.h, wrong, wrong)


ENDLESS = 2**31 - 1  # steps a sample, as many as a C int counts


class StopRunError(Exception):
    """What a check raises."""


@needs_compiler
@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_ends_machine_code_that_would_run_for_minutes(threads: int) -> None:
    """2e9 steps of 0.1 us; without the flag that the loop reads, this test takes minutes."""
    case = Case("stribeck")
    rollout, main = case.rollout(threads=threads), threading.main_thread().ident
    assert main is not None
    alarm = threading.Timer(0.3, signal.pthread_kill, (main, signal.SIGINT))
    alarm.start()
    begun = time.process_time()
    with pytest.raises(KeyboardInterrupt):
        rollout.run(case.x0, case.u, case.p, case.t, case.h, substeps=ENDLESS)
    assert time.process_time() - begun < 10 * threads  # CPU time: .3 s on an idle machine
    alarm.join()
    assert_array_equal(case.run(rollout).y, case.run(case.rollout(threads=threads)).y)


@needs_compiler
def test_a_check_ends_machine_code_that_would_run_for_minutes() -> None:
    case, checks = Case("stribeck"), list[int]()

    def check() -> None:
        checks.append(1)
        if len(checks) == 3:
            raise StopRunError

    with pytest.raises(StopRunError), check_during_runs(check):
        case.rollout(threads=2).run(case.x0, case.u, case.p, case.t, case.h, substeps=ENDLESS)
    case.run(case.rollout(threads=2))
    assert len(checks) == 3  # before the run, twice during it, and none of the run outside


@pytest.mark.parametrize("lanes", [pytest.param(None, marks=needs_compiler), 0])
def test_a_check_ends_what_has_not_begun(lanes: int | None) -> None:
    case = Case("stribeck")
    with pytest.raises(StopRunError), check_during_runs(Mock(side_effect=StopRunError)):
        case.run(Rollout(case.system.pieces, lanes=lanes))
