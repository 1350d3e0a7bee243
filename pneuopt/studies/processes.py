"""Where a study computes its cases: in processes of its own, or in an executor that the user gives.

Our own are loky's executors of one process each: if a process dies, its executor breaks, and that names the case.
"""

import os
import pickle
import re
import signal
import threading
from collections import deque
from collections.abc import Generator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, as_completed, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for_connections
from typing import TYPE_CHECKING

from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.studies.outcome import CaseFunction, Outcome, describe_error, evaluate_case

if TYPE_CHECKING:
    import loky

Outcomes = Generator[tuple[str, Outcome], None, None]
_MAX_PROCESSES = 60
"""Processes at once: Windows cannot wait for more than 63, and each takes memory for CasADi and the model."""
_THREADS_REMEDY = "in this process, executor=ThreadPoolExecutor()"
_NO_START = (
    'the processes of a study cannot start; a script must call the study under `if __name__ == "__main__":`, '
    f"or compute {_THREADS_REMEDY}"
)
_function: CaseFunction | None = None  # of a spawned process: what it evaluates


def run_in_processes(fn: CaseFunction, runs: Mapping[str, ParameterSet]) -> Outcomes:
    """Evaluate cases in spawned processes, one a CPU, and yield each outcome as it comes.

    Parameters
    ----------
    fn : callable
        It travels by pickle, once to each process.
    runs : mapping of str to ParameterSet
        Parameters by the name of the case.

    Yields
    ------
    tuple of str and Outcome

    Raises
    ------
    InputError
        If the function cannot travel, or no process can start.
    """
    packed, waiting = _pickle_function(fn), deque(runs.items())
    crew: list[loky.ProcessPoolExecutor] = []
    busy: dict[Future[Outcome | None], tuple[loky.ProcessPoolExecutor, str | None]] = {}
    began = False

    def start_process() -> None:
        crew.append(_spawn_process())
        busy[crew[-1].submit(_load_function, packed)] = crew[-1], None

    try:
        for _ in range(min(len(runs), os.cpu_count() or 1, _MAX_PROCESSES)):
            start_process()
        while busy:
            future = next(iter(wait(busy, return_when=FIRST_COMPLETED).done))
            process, case = busy.pop(future)
            outcome = _process_outcome(future, began=began)
            began = True
            if isinstance(future.exception(), BrokenProcessPool):
                crew.remove(process)
                if waiting and case is not None:
                    start_process()
            elif waiting:
                name, values = waiting.popleft()
                busy[process.submit(_evaluate, values)] = process, name
            if case is not None and outcome is not None:
                yield case, outcome
    finally:
        computing = {process for process, _ in busy.values()}
        for process in crew:
            process.shutdown(kill_workers=process in computing)


def run_in_executor(executor: Executor, fn: CaseFunction, runs: Mapping[str, ParameterSet]) -> Outcomes:
    """Evaluate cases in somebody else's threads, processes or machines, and yield each outcome as it comes."""
    if isinstance(executor, ProcessPoolExecutor):
        _pickle_function(fn)
    futures: dict[Future[Outcome], str] = {}
    try:
        for name, values in runs.items():
            futures[executor.submit(evaluate_case, fn, values)] = name
        for future in as_completed(futures):
            yield futures[future], _executor_outcome(future)
    finally:
        for future in futures:
            future.cancel()


def _spawn_process() -> "loky.ProcessPoolExecutor":
    """An executor of one process, which follows this one."""
    import loky

    return loky.ProcessPoolExecutor(1, context=get_context("spawn"), initializer=_follow_parent)


def _follow_parent() -> None:
    """In a spawned process: ignore Ctrl-C, which reaches all processes of a terminal, and end when the first has."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """Wait for the end of the first process, which may be killed without a word to the others."""
    wait_for_connections([sentinel])
    os._exit(1)


def _load_function(packed: bytes) -> None:
    """In a spawned process: unpack the function, once for all its cases."""
    global _function  # noqa: PLW0603 - the state of a worker process, which serves one study
    try:
        _function = pickle.loads(packed)
    except Exception as error:  # whatever its module raises when imported
        raise InputError(
            f"the function cannot be loaded by other processes: {describe_error(error)}; "
            f"define it in a module that can be imported, or compute {_THREADS_REMEDY}"
        ) from None


def _evaluate(values: ParameterSet) -> Outcome:
    """In a spawned process: evaluate its function."""
    assert _function is not None, "_load_function comes first"
    return evaluate_case(_function, values)


def _process_outcome(future: "Future[Outcome | None]", *, began: bool) -> Outcome | None:
    """What a process gave; None where it has only started, and an `InputError` where none can."""
    try:
        return future.result()
    except BrokenProcessPool as error:
        require(began, _NO_START)
        code = re.search(r"\((-?\d+)\)", str(error))  # loky gives it in words only, and not on Windows
        return Outcome(error="its process died" + (f" (exit code {code[1]})" if code else ""))


def _executor_outcome(future: "Future[Outcome]") -> Outcome:
    try:
        return future.result()
    except Exception as error:  # the executor's own: a broken pool, a cancelled future
        return Outcome(error=describe_error(error))


def _pickle_function(fn: CaseFunction) -> bytes:
    try:
        return pickle.dumps(fn)
    except Exception as error:  # pickle raises what it likes
        raise InputError(
            f"the function cannot go to other processes ({error}); give a function of a module, or "
            f"functools.partial of one with what it needs, or compute {_THREADS_REMEDY}"
        ) from None
