"""Where a study computes its cases: processes of this machine (`Processes`), a cluster, or any executor.

`open_executor` opens one by a word, as the command line has it. `CaseQueue` decides which cases are computed next, how
many in one go, and which of them again. A case that crashes, or takes too long or too much memory, costs no other: the
processes (`run_in_processes`) are loky's executors of one process each, so that one that dies names the cases that it
had; they are tried again one by one, and one that dies twice has its reason in the table. Processes are spawned, not
forked, on every system, and have one thread each for linear algebra. With an executor of the interface of
`concurrent.futures` (`run_in_executor`) the same queue decides; whether a dead worker harms others is up to it.

`Outcome`: what one case of a study gave, in plain numbers and text, or why not; and a process's limit of memory.
"""

import functools
import math
import os
import pickle
import re
import signal
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import inf, nan
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for_connections
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, PneuoptError, require
from pneuopt.quantities.parameters import ParameterSet, check_number
from pneuopt.quantities.results import Result
from pneuopt.studies.tolerances import (
    CONNECT_SECONDS,
    LIMIT_SHARE,
    MAX_PROCESSES,
    TRIES,
    UNKNOWN_WORKERS,
)

if TYPE_CHECKING:
    import loky


CaseFunction = Callable[[ParameterSet], Any]
CaseValues = ParameterSet | Mapping[str, float]
INTERRUPTED_CASE = "interrupted"
"""The `error` of a case that was not reached, or not finished, when the study was interrupted."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of one case, or why it has none."""

    results: Mapping[str, Any] = field(default_factory=dict)  # by name, bool, int, float or str
    seconds: float = nan  # time in the function [s]
    error: str = ""  # why there are no results, or none that is a number; empty where all is well


def evaluate_cases(fn: CaseFunction, parameters: ParameterSet, cases: Iterable[CaseValues]) -> list[Outcome]:
    """Evaluate cases one after another; an interruption is the last outcome."""
    outcomes: list[Outcome] = []
    for values in cases:
        outcomes.append(evaluate_case(fn, parameters, values))
        if outcomes[-1].error == INTERRUPTED_CASE:
            break
    return outcomes


def evaluate_case(fn: CaseFunction, parameters: ParameterSet, values: CaseValues) -> Outcome:
    """Call the function; whatever it raises becomes the outcome's error, so an outcome always fits through a pipe."""
    begun = time.perf_counter()
    try:
        case = values if isinstance(values, ParameterSet) else parameters.with_values(values)
        begun = time.perf_counter()
        result, seconds = fn(case), time.perf_counter() - begun
        results = _plain_results(result)
        numbers = [v for v in results.values() if isinstance(v, float | int) and not isinstance(v, bool)]
        error = ""  # a NaN among numbers says something, a metric that a response lacks; NaN alone is no result
        if numbers and all(math.isnan(v) for v in numbers):
            error = f"{next(iter(results))} is NaN" if len(results) == 1 else "all its numbers are NaN"
        return Outcome(results, seconds, error)
    except KeyboardInterrupt:
        return Outcome(error=INTERRUPTED_CASE)
    except (Exception, SystemExit) as error:
        return Outcome(seconds=time.perf_counter() - begun, error=describe_error(error))


def describe_error(error: BaseException) -> str:
    """One line; of an error that nobody raised on purpose, also where."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, PneuoptError) or not frames:
        return text
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"


def _plain_results(result: Any) -> dict[str, Any]:
    """A result as plain numbers and text, by name."""
    import pandas as pd

    if isinstance(result, Result):
        result = result.row()
    if isinstance(result, pd.DataFrame):
        if len(result) == 1:
            result = {column: result[column].iloc[0] for column in result}  # each of its own type
        elif len(result.columns) == 1:
            result = result.iloc[:, 0]
        else:
            result = {f"{row}[{column}]": value for column in result for row, value in result[column].items()}
    plain: dict[str, Any] = {}
    for name, entry in (result if isinstance(result, Mapping | pd.Series) else {"value": result}).items():
        value = entry.item() if getattr(entry, "shape", None) == () else entry
        if not isinstance(value, bool | int | float | str):
            raise InputError(f"{name} is {type(value).__name__}; return numbers or text, by name")
        plain[str(name)] = value
    return plain


def limit_memory(megabytes: float) -> None:
    """Let this process have so much more memory [MiB] than it has now; beyond it an allocation fails."""
    if sys.platform != "linux" or megabytes == math.inf:
        return
    import resource

    with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123 - no file of ours
        pages = int(file.read().split()[5])  # data and stack
    most = pages * resource.getpagesize() + int(megabytes * 2**20)
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    # data alone are limited, not the address space, of which threads reserve gigabytes that they never touch
    resource.setrlimit(resource.RLIMIT_DATA, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


@dataclass(frozen=True)
class Processes:
    """Processes of this machine as the executor of a study, and what a case may take in them.

    Parameters
    ----------
    count : int, optional
        By default one a CPU; the table is the same whatever their number.
    seconds : float
        Time of a case on the clock [s]; one that takes longer is killed with its process.
    megabytes : float
        Memory that a case may take beyond what its process has when the study begins [MiB]; Linux alone.
    """

    count: int | None = None
    seconds: float = inf
    megabytes: float = inf

    def __post_init__(self) -> None:
        if self.count is not None:
            check_number("Processes: count", self.count, "a whole number of processes, or None", whole=True)
        check_number("Processes: seconds", self.seconds, "a time in seconds, as 60.0")
        check_number("Processes: megabytes", self.megabytes, "a size in MiB, as 500.0")
        require(self.count is None or self.count >= 1, f"there must be a process at least, got {self.count}")
        require(self.seconds > 0, f"the time limit of a case must be positive, got {self.seconds:g} s")
        require(self.megabytes > 0, f"the memory limit of a case must be positive, got {self.megabytes:g} MB")
        on_linux = sys.platform == "linux" or self.megabytes == inf
        require(on_linux, "a memory limit of cases needs Linux; leave it out, and compute fewer cases at once")

    @property
    def time_reason(self) -> str:
        """Why a case that took too long has no result."""
        return f"killed: took longer than the {self.seconds:g} s that a case may take"

    @property
    def memory_reason(self) -> str:
        """Why a case that needs too much memory has no result."""
        return f"needs more memory than the {self.megabytes:g} MB that a case may take"


LOCAL_CLUSTER = "dask"
"""The word for a cluster of dask on this machine, which is there for the study alone."""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_SCHEMES = ("tcp://", "tls://", "ws://", "wss://", "ucx://")

_OWN_CLUSTER: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": 0,  # the study itself tries again, case by case
    "distributed.scheduler.work-stealing-interval": "1s",
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(_THREAD_VARIABLES, 1),
}
"""What a cluster that is there for one study does not need: its sampling profiler, monitors many times a second, and
memory that is given back to the system after each array. They took as much CPU time as a sixth of the cases
(problems/speed/study_executors.py)."""


@contextmanager
def open_executor(where: str) -> Iterator[Executor | Processes]:
    """Open the executor that a word names, for as long as a study runs.

    Parameters
    ----------
    where : str
        A number of processes of this machine; "dask", a cluster of dask on this machine; or the address of a dask
        scheduler, "tcp://host:8786", whose workers have this version of pneuopt. A worker should have one thread.

    Yields
    ------
    Executor or Processes

    Raises
    ------
    InputError
        If the word is none of these, dask is not installed, or there is no scheduler at the address.

    Examples
    --------
    >>> with open_executor("2") as executor:
    ...     executor
    Processes(count=2, seconds=inf, megabytes=inf)
    """
    if where.isdecimal():
        yield Processes(int(where))
        return
    if where != LOCAL_CLUSTER and not where.startswith(_SCHEMES):
        raise InputError(f"executor {where!r}: give a number of processes, dask, or a scheduler, tcp://host:8786")
    try:
        import distributed
    except ImportError:
        message = "dask is not installed; pip install 'pneuopt[cluster]', or give a number of processes"
        raise InputError(message) from None
    with _make_client(distributed, where) as client:
        executor = client.get_executor(pure=False)  # otherwise a chunk that is tried again is given its old error
        workers = sum(client.nthreads().values())
        executor._max_workers = workers if where == LOCAL_CLUSTER else max(workers, UNKNOWN_WORKERS)
        yield executor


@contextmanager
def _make_client(distributed: Any, where: str) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster of its own, whose workers have one thread each."""
    import dask

    if where == LOCAL_CLUSTER:
        with (
            dask.config.set(_OWN_CLUSTER),
            distributed.LocalCluster(threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL") as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = distributed.Client(where, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(f"executor {where}: there is no dask scheduler ({' '.join(str(error).split())})") from None
    with client:
        yield client


@dataclass(frozen=True)
class Chunk:
    """Cases that one process computes in one go, by name; and how often they were tried before."""

    cases: Mapping[str, CaseValues]
    tries: int = 0


class CaseQueue:
    """Hands cases out in chunks of about half a second: longer ones lose more with a process, shorter cost to send.

    Of `most_seconds` [s] where a limit of time is lower; large cases in one chunk would fill the memory.
    """

    def __init__(
        self,
        cases: Iterable[tuple[str, CaseValues]],
        count: int,
        workers: int,
        *,
        most_seconds: float = inf,
        usual_seconds: float = 0.5,
        most_cases: int = 1000,
    ) -> None:
        self._fresh, self._again, self._suspect = iter(cases), deque[Chunk](), deque[Chunk]()
        self._left, self._workers, self._most_cases = count, workers, most_cases
        self._seconds = min(usual_seconds, most_seconds)
        self._done, self._spent = 0, 0.0

    def __bool__(self) -> bool:
        return self._left > 0 or bool(self._again or self._suspect)

    def take(self, *, alone: bool = True) -> Chunk | None:
        """The next chunk, or None; those whose process has died come last, if nothing else runs (`alone`)."""
        if self._again:
            return self._again.popleft()
        size = 1
        if self._done:
            by_time = self._seconds * self._done / max(self._spent, 1e-9)
            size = max(1, math.ceil(min(by_time, self._most_cases, self._left / (2 * self._workers))))
        cases = dict(next(self._fresh) for _ in range(min(size, self._left)))
        self._left -= len(cases)
        if cases:
            return Chunk(cases)
        # a worker of a cluster that dies takes along what waits for it
        return self._suspect.popleft() if alone and self._suspect else None

    def measure(self, outcomes: Sequence[Outcome]) -> None:
        """Learn from a chunk how long cases take."""
        self._done += len(outcomes)
        self._spent += sum(o.seconds for o in outcomes if o.seconds > 0)

    def give_back(self, chunk: Chunk, reason: str) -> Iterator[tuple[str, Outcome]]:
        """Take back a chunk whose process died: its cases are tried one by one; one that dies twice gets the reason."""
        if len(chunk.cases) > 1:
            self._again.extend(Chunk({name: values}) for name, values in chunk.cases.items())
        elif chunk.tries + 1 < TRIES:
            self._suspect.append(Chunk(chunk.cases, chunk.tries + 1))
        else:
            for name in chunk.cases:
                yield name, Outcome(error=reason)


Outcomes = Generator[tuple[str, Outcome], None, None]
_THREADS_REMEDY = "in this process, executor=ThreadPoolExecutor()"
_NO_START = (
    'the processes of a study cannot start; a script must call the study under `if __name__ == "__main__":`, '
    f"or compute {_THREADS_REMEDY}"
)
_packed = b""  # of a spawned process: its function, as it came
_task: "tuple[CaseFunction, ParameterSet, Processes] | None" = None  # of a spawned process: what it evaluates


def run_in_processes(
    chosen: Processes,
    fn: CaseFunction,
    parameters: ParameterSet,
    cases: Iterable[tuple[str, CaseValues]],
    count: int,
) -> Outcomes:
    """Evaluate cases in spawned processes and yield each outcome as it comes; the function travels by pickle."""
    wanted = min(count, chosen.count or os.cpu_count() or 1, MAX_PROCESSES)
    queue = CaseQueue(cases, count, wanted, most_seconds=LIMIT_SHARE * chosen.seconds)
    crew = _Crew(pickle_function(fn, parameters, chosen), chosen)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="A worker was restarted")  # its chunk is given to its successor
        try:
            for _ in range(wanted):
                crew.start()
            while crew.busy:
                for run, future in crew.wait():
                    yield from _receive(crew, queue, run, future)
                for late in crew.stop_late():
                    if late.chunk is not None:  # a case alone gets the reason, several are tried one by one
                        yield from queue.give_back(Chunk(late.chunk.cases, TRIES), chosen.time_reason)
                    if queue:
                        crew.start()
            while chunk := queue.take():
                yield from ((name, Outcome(error="no process could be started for it")) for name in chunk.cases)
        finally:
            crew.shut_down()


@dataclass(frozen=True, eq=False)
class _Run:
    """Work of a process; without a chunk it loads the function. `deadline` is of `time.monotonic` [s]."""

    process: "loky.ProcessPoolExecutor"
    chunk: Chunk | None
    deadline: float


class _Crew:
    """The processes of a study, and what each computes now."""

    def __init__(self, packed: bytes, limits: Processes) -> None:
        self._packed, self.limits, self.began = packed, limits, False
        self._processes: list[loky.ProcessPoolExecutor] = []
        self.busy: dict[Future[list[Outcome]], _Run] = {}

    def start(self) -> None:
        """Start a process, which follows this one; loky puts another in its place where its memory grows."""
        import loky

        arguments = (self._packed,)
        process = loky.ProcessPoolExecutor(1, context=get_context("spawn"), initializer=_begin, initargs=arguments)
        self._processes.append(process)
        added = {n: "1" for n in _THREAD_VARIABLES if n not in os.environ}  # what the user has said goes first
        os.environ.update(added)  # it starts with one thread for linear algebra
        mask = getattr(signal, "pthread_sigmask", None)  # not on Windows
        before = mask and mask(signal.SIG_BLOCK, {signal.SIGINT})  # it inherits this: no Ctrl-C while it imports
        try:
            self.busy[process.submit(_load_task)] = _Run(process, None, inf)
        finally:
            if mask:
                mask(signal.SIG_SETMASK, before)
            for n in added:
                del os.environ[n]

    def give(self, process: "loky.ProcessPoolExecutor", chunk: Chunk) -> None:
        """Let a process compute a chunk."""
        run = _Run(process, chunk, time.monotonic() + self.limits.seconds)
        self.busy[process.submit(_evaluate_chunk, list(chunk.cases.values()))] = run

    def wait(self) -> list[tuple[_Run, "Future[list[Outcome]]"]]:
        """Wait until a process is done, or has had its time; those that are done, in the order of their chunks."""
        patience = min(run.deadline for run in self.busy.values()) - time.monotonic()
        done = wait(self.busy, None if patience == inf else max(patience, 0.0), FIRST_COMPLETED).done
        return [(self.busy.pop(future), future) for future in list(self.busy) if future in done]

    def stop_late(self) -> list[_Run]:
        """Kill the processes that had their time; returns what they computed."""
        now = time.monotonic()
        late = {future: run for future, run in self.busy.items() if run.deadline <= now and not future.done()}
        for future, run in late.items():
            del self.busy[future]
            self.remove(run.process)
        return list(late.values())

    def remove(self, process: "loky.ProcessPoolExecutor") -> None:
        """Give a process up."""
        self._processes.remove(process)
        process.shutdown(kill_workers=True)

    def shut_down(self) -> None:
        """End all processes, those that compute at once."""
        computing = {run.process for run in self.busy.values()}
        for process in self._processes:
            process.shutdown(kill_workers=process in computing)


def _receive(
    crew: _Crew, queue: CaseQueue, run: _Run, future: "Future[list[Outcome]]"
) -> Iterator[tuple[str, Outcome]]:
    """Outcomes of a process; it, or another if it died, goes on with the next chunk."""
    try:
        outcomes = future.result()
    except BrokenProcessPool as error:
        require(crew.began, _NO_START)
        crew.remove(run.process)
        if run.chunk is not None:
            code = re.search(r"\((-?\w+)\)", str(error))  # loky gives it in words only, and not on Windows
            reason = "its process died twice" + (f" (exit code {code[1]})" if code else "")
            yield from queue.give_back(run.chunk, reason)
        if queue and run.chunk is not None:
            crew.start()
        return
    crew.began = True
    queue.measure(outcomes)
    chunk = queue.take()
    if chunk is not None:
        crew.give(run.process, chunk)
    if run.chunk is not None:
        yield from zip(run.chunk.cases, outcomes, strict=False)  # fewer outcomes where the last is an interruption


def _begin(packed: bytes) -> None:
    """In a spawned process: keep the function; ignore Ctrl-C, which reaches all processes; end when the first has."""
    global _packed  # noqa: PLW0603 - the state of a worker process, which serves one study
    _packed = packed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def end_with(sentinel: int) -> None:  # the first process may be killed without a word to the others
        wait_for_connections([sentinel])
        os._exit(1)

    if parent is not None:
        threading.Thread(target=end_with, args=(parent.sentinel,), daemon=True).start()


def _load_task() -> list[Outcome]:
    """In a spawned process: unpack the function, once for all its cases."""
    global _task  # noqa: PLW0603 - the state of a worker process, which serves one study
    import pandas as pd  # noqa: F401 - of the results: no case's time

    try:
        _task = pickle.loads(_packed)
    except Exception as error:  # whatever its module raises when imported
        raise InputError(
            f"the function cannot be loaded by other processes: {describe_error(error)}; "
            f"define it in a module that can be imported, or compute {_THREADS_REMEDY}"
        ) from None
    assert _task is not None
    limit_memory(_task[2].megabytes)
    return []


def _evaluate_chunk(cases: list[CaseValues]) -> list[Outcome]:
    """In a spawned process: evaluate its function."""
    if _task is None:  # in a process that stands in for one that had grown
        _load_task()
    assert _task is not None
    fn, parameters, limits = _task
    outcomes = evaluate_cases(fn, parameters, cases)
    if limits.megabytes == inf:
        return outcomes
    lacking = Outcome(error=limits.memory_reason)  # an allocation has failed, in Python or in C++
    return [replace(lacking, seconds=o.seconds) if re.search("MemoryError|bad_alloc", o.error) else o for o in outcomes]


def pickle_function(fn: CaseFunction, *others: object) -> bytes:
    """A function with what it needs, as it travels to other processes; `InputError` if it cannot."""
    try:
        return pickle.dumps((fn, *others))
    except Exception as error:  # pickle raises what it likes
        raise InputError(
            f"the function cannot go to other processes ({error}); give a function of a module, or "
            f"functools.partial of one with what it needs, or compute {_THREADS_REMEDY}"
        ) from None


def run_in_executor(
    executor: Executor,
    fn: CaseFunction,
    parameters: ParameterSet,
    cases: Iterable[tuple[str, CaseValues]],
    count: int,
    chunks_a_worker: int = 3,
) -> Outcomes:
    """Evaluate cases in an executor and yield each outcome as it comes.

    With fewer chunks that wait for each worker it is idle while a result travels; more fill the memory.
    """
    workers = int(getattr(executor, "_max_workers", None) or UNKNOWN_WORKERS)
    queue, running = CaseQueue(cases, count, workers), dict[Future[list[Outcome]], Chunk]()
    try:
        task: Callable[[list[CaseValues]], list[Outcome]] = _Task(pickle_function(fn, parameters))
    except ValueError:  # what cannot be pickled goes as it is, to threads, or by cloudpickle
        if isinstance(executor, ProcessPoolExecutor):
            raise
        task = functools.partial(evaluate_cases, fn, parameters)
    try:
        while queue or running:
            while len(running) < chunks_a_worker * workers and (chunk := queue.take(alone=not running)):
                try:
                    running[executor.submit(task, list(chunk.cases.values()))] = chunk
                except BrokenExecutor as error:  # broken for good, it costs its cases
                    yield from ((name, Outcome(error=describe_error(error))) for name in chunk.cases)
            done = wait(running, return_when=FIRST_COMPLETED).done
            for future in [future for future in running if future in done]:  # in the order of the cases
                chunk = running.pop(future)
                try:
                    outcomes = future.result()
                except Exception as error:  # the executor's own: a dead worker, a broken pool, a cancelled future
                    yield from queue.give_back(chunk, describe_error(error))
                    continue
                queue.measure(outcomes)
                yield from zip(chunk.cases, outcomes, strict=False)  # fewer where the last is an interruption
    finally:
        for future in running:
            future.cancel()


class _Task:
    """A function with its parameters, which a worker unpacks once for all chunks that it gets."""

    def __init__(self, packed: bytes) -> None:
        self._packed = packed

    def __call__(self, cases: list[CaseValues]) -> list[Outcome]:
        """Evaluate cases."""
        return evaluate_cases(*_unpack(self._packed), cases)


_unpack: Callable[[bytes], tuple[CaseFunction, ParameterSet]] = functools.lru_cache(maxsize=2)(pickle.loads)
