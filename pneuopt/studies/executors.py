"""Somebody else's threads, processes or machines: anything with the interface of `concurrent.futures`."""

import functools
import pickle
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait

from pneuopt.quantities.parameters import ParameterSet
from pneuopt.studies.outcome import CaseFunction, CaseValues, Outcome, describe_error, evaluate_cases
from pneuopt.studies.processes import Outcomes, pickle_function
from pneuopt.studies.queue import CaseQueue, Chunk

_CHUNKS_A_WORKER = 3
"""Chunks that wait for each worker [1]: fewer leave it idle while a result travels, more fill the memory."""
_ChunkFunction = Callable[[list[CaseValues]], list[Outcome]]
UNKNOWN_WORKERS = 64
"""Workers [1] of an executor that does not say how many it has, or of a cluster that may grow: more make chunks so
small that each costs more to send than to compute, fewer leave workers idle."""


def run_in_executor(
    executor: Executor,
    fn: CaseFunction,
    parameters: ParameterSet,
    cases: Iterable[tuple[str, CaseValues]],
    count: int,
) -> Outcomes:
    """Evaluate cases in an executor and yield each outcome as it comes; parameters as of `run_in_processes`."""
    workers = int(getattr(executor, "_max_workers", None) or UNKNOWN_WORKERS)
    queue, task = CaseQueue(cases, count, workers), _make_task(executor, fn, parameters)
    running: dict[Future[list[Outcome]], Chunk] = {}
    try:
        while queue or running:
            while len(running) < _CHUNKS_A_WORKER * workers and (chunk := queue.take(alone=not running)):
                yield from _submit(executor, task, chunk, running)
            done = wait(running, return_when=FIRST_COMPLETED).done
            for future in [future for future in running if future in done]:  # in the order of the cases
                yield from _receive(future, running.pop(future), queue)
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


@functools.lru_cache(maxsize=2)
def _unpack(packed: bytes) -> tuple[CaseFunction, ParameterSet]:
    fn, parameters = pickle.loads(packed)
    return fn, parameters


def _make_task(executor: Executor, fn: CaseFunction, parameters: ParameterSet) -> _ChunkFunction:
    """What the executor is given; a function that cannot be pickled goes as it is, to threads, or by cloudpickle."""
    try:
        return _Task(pickle_function(fn, parameters))
    except ValueError:
        if isinstance(executor, ProcessPoolExecutor):
            raise
        return functools.partial(evaluate_cases, fn, parameters)


def _submit(
    executor: Executor,
    task: _ChunkFunction,
    chunk: Chunk,
    running: dict["Future[list[Outcome]]", Chunk],
) -> Iterator[tuple[str, Outcome]]:
    """Submit a chunk; an executor that is broken for good costs its cases."""
    try:
        running[executor.submit(task, list(chunk.cases.values()))] = chunk
    except BrokenExecutor as error:
        yield from ((name, Outcome(error=describe_error(error))) for name in chunk.cases)


def _receive(future: "Future[list[Outcome]]", chunk: Chunk, queue: CaseQueue) -> Iterator[tuple[str, Outcome]]:
    """What a chunk gave; one whose worker died is tried again."""
    try:
        outcomes = future.result()
    except Exception as error:  # the executor's own: a dead worker, a broken pool, a cancelled future
        yield from queue.give_back(chunk, describe_error(error))
        return
    queue.measure(outcomes)
    yield from zip(chunk.cases, outcomes, strict=False)  # fewer outcomes where the last is an interruption
