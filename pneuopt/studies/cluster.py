"""`open_executor`: the executor of a study by a word, as the command line has it; a cluster's is dask's."""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

from pneuopt.quantities.errors import InputError
from pneuopt.studies.executors import UNKNOWN_WORKERS
from pneuopt.studies.processes import Processes

LOCAL_CLUSTER = "dask"
"""The word for a cluster of dask on this machine, which is there for the study alone."""
_SCHEMES = ("tcp://", "tls://", "ws://", "wss://", "ucx://")
_CONNECT_SECONDS = 10.0  # patience with a scheduler [s]: shorter gives up on a slow net, longer looks like a hang

_OWN_CLUSTER: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": 0,  # the study itself tries again, case by case
    "distributed.scheduler.work-stealing-interval": "1s",
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), 1
    ),
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
    distributed = _import_distributed()
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
        client = distributed.Client(where, timeout=_CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(f"executor {where}: there is no dask scheduler ({' '.join(str(error).split())})") from None
    with client:
        yield client


def _import_distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError(
            "dask is not installed; pip install 'pneuopt[cluster]', or give a number of processes"
        ) from None
    return distributed
