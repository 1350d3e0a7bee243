"""Studies: any function of a `ParameterSet` over named cases, in processes, as one tidy table.

A case that fails is a row with its reason, even where its process dies; Ctrl-C keeps what is done. Processes are
spawned anew on every system: the function travels by pickle, once to each of them, and so does what it holds on to
(a `System`, a `ClosedLoop`); machine code comes from the cache.
"""

import itertools
import os
import pickle
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import dataclass, field
from math import nan
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, PneuoptError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import ProgressCallback
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    import pandas as pd

CaseFunction = Callable[[ParameterSet], Any]
CaseValues = ParameterSet | Mapping[str, float]
Outcomes = Generator[tuple[str, "_Outcome"], None, None]
INTERRUPTED_CASE = "interrupted"
"""The `error` of a case that was not reached, or not finished, when the study was interrupted."""

_STUDY_COLUMNS = ("case", "seconds", "error")
_MAX_PROCESSES = 60  # Windows waits for 63 at once
_THREADS_REMEDY = "in this process, executor=ThreadPoolExecutor()"
_MAIN_GUARD_REMEDY = 'a script must call the study under `if __name__ == "__main__":`'


def grid(parameters: ParameterSet, axes: Mapping[str, Iterable[float]]) -> dict[str, dict[str, float]]:
    """Every combination of values, as named cases for `sweep`; the last axis runs fastest.

    Parameters
    ----------
    parameters : ParameterSet
        Gives units and bounds.
    axes : mapping of str to iterable of float
        Parameter to its values [its SI unit].

    Returns
    -------
    dict of str to dict of str to float
        "load.mass = 2 kg, load.force = 0 N" to the values by name.

    Raises
    ------
    InputError
        If a parameter is unknown, a value is outside its bounds or there twice, or there is none.

    Examples
    --------
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "stroke": Parameter(0.2, "m")})
    >>> grid(rig, {"load.mass": [2.0, 8.0], "stroke": [0.1]})["load.mass = 8 kg, stroke = 100 mm"]
    {'load.mass': 8.0, 'stroke': 0.1}
    """
    require(len(axes) > 0, "a grid needs an axis: a parameter and its values")
    check_names("parameter", axes, parameters, "axis")
    columns = [_label_axis(parameters, name, list(map(float, values))) for name, values in axes.items()]
    return {
        ", ".join(label for label, _ in point): dict(zip(axes, (value for _, value in point), strict=True))
        for point in itertools.product(*columns)
    }


def sweep(
    fn: CaseFunction,
    parameters: ParameterSet,
    cases: Mapping[str, CaseValues],
    *,
    executor: Executor | None = None,
    progress: ProgressCallback | None = None,
) -> "pd.DataFrame":
    """Evaluate a function of a `ParameterSet` for each case.

    Parameters
    ----------
    fn : callable
        ``fn(parameters)`` returns a number, a mapping, a Series or a DataFrame. For processes it must be a function of
        a module, or a `functools.partial` of one: ``partial(evaluate, loop, steps)``.
    parameters : ParameterSet
        What the cases have in common.
    cases : mapping of str to mapping of str to float, or to ParameterSet
        By the case's name the values that differ, as from `grid`; or all its parameters.
    executor : concurrent.futures.Executor, optional
        Where to compute: threads, a cluster's (dask: ``client.get_executor()``). By default one process a CPU.
    progress : callable, optional
        Called with a line of text after each case.

    Returns
    -------
    DataFrame
        A row a case, in their order. Columns: "case"; each parameter in which the cases differ from `parameters` [SI];
        the results ("value" for a number; of a DataFrame with one row the columns, with one column the rows, otherwise
        "row[column]"); "seconds", the time in `fn`; "error", empty where all is well, else the reason, and the results
        are missing.

    Raises
    ------
    InputError
        If a case's parameter is unknown or out of bounds, or the function cannot go to other processes.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"mass": Parameter(5.0, "kg"), "force": Parameter(10.0, "N")})
    >>> table = sweep(lambda p: p.value("force") / p.value("mass"), rig, grid(rig, {"mass": [2.0, 0.0]}),
    ...               executor=ThreadPoolExecutor())
    >>> table["value"].tolist(), table["error"].tolist()[1][:17]
    ([5.0, nan], 'ZeroDivisionError')
    """
    require(len(cases) > 0, "a study needs a case")
    runs = {str(name): _case_parameters(parameters, case, str(name)) for name, case in cases.items()}
    outcomes = _run_in_processes(fn, runs) if executor is None else _run_in_executor(executor, fn, runs)
    found: dict[str, _Outcome] = {}
    with closing(outcomes), suppress(KeyboardInterrupt):
        for name, outcome in outcomes:
            if outcome.error == INTERRUPTED_CASE:
                break
            found[name] = outcome
            if progress is not None:
                progress(_progress_text(found, len(runs)))
    return _study_table(parameters, runs, found)


@dataclass(frozen=True)
class _Outcome:
    """What one case gave, in plain numbers and text."""

    results: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = nan
    error: str = ""


def _label_axis(parameters: ParameterSet, name: str, values: list[float]) -> list[tuple[str, float]]:
    """The values with their labels; more digits only where six do not tell them apart."""
    require(len(values) > 0, f"axis {name}: no values")
    require(len(set(values)) == len(values), f"axis {name}: a value is there twice; leave one out")
    for value in values:
        _case_parameters(parameters, {name: value}, "axis")
    short, full = ([write_value(v, parameters[name].unit, digits) for v in values] for digits in (6, 17))
    labels = short if len(set(short)) == len(values) else full
    return [(f"{name} = {label}", value) for label, value in zip(labels, values, strict=True)]


def _case_parameters(parameters: ParameterSet, case: CaseValues, name: str) -> ParameterSet:
    if isinstance(case, ParameterSet):
        return case
    check_names("parameter", case, parameters, name)
    try:
        return parameters.with_values(case)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _run_in_processes(fn: CaseFunction, runs: Mapping[str, ParameterSet]) -> Outcomes:
    """Outcomes as they come; a worker has one case at a time, so a process that dies takes only its own with it."""
    packed, waiting, crew, began = _pickle_function(fn), deque(runs.items()), list[_Worker](), False
    try:
        for _ in range(min(len(runs), os.cpu_count() or 1, _MAX_PROCESSES)):
            crew.append(_Worker(packed))
        while crew and (waiting or any(worker.case is not None for worker in crew)):
            heard = wait([worker.pipe for worker in crew])
            for worker in [worker for worker in crew if worker.pipe in heard]:
                done = worker.receive()
                require(began or not worker.start_error, worker.start_error)
                began = True
                if not worker.is_alive:
                    crew.remove(worker)
                    crew += [_Worker(packed)] if waiting and not worker.start_error else []
                elif waiting:
                    worker.send_case(*waiting.popleft())
                if done is not None:
                    yield done
    finally:
        for worker in crew:
            worker.stop()


def _run_in_executor(executor: Executor, fn: CaseFunction, runs: Mapping[str, ParameterSet]) -> Outcomes:
    """Outcomes as they come, of somebody else's threads, processes or machines."""
    if isinstance(executor, ProcessPoolExecutor):
        _pickle_function(fn)
    futures: dict[Future[_Outcome], str] = {}
    try:
        for name, values in runs.items():
            futures[executor.submit(_evaluate_case, fn, values)] = name
        for future in as_completed(futures):
            yield futures[future], _future_outcome(future)
    finally:
        for future in futures:
            future.cancel()


class _Worker:
    """A spawned process that evaluates one function, and the case that it is at."""

    def __init__(self, packed: bytes) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve_worker, args=(theirs, packed))
        self._process.start()
        theirs.close()  # or its end would never be noticed
        self.case: str | None = None
        self.is_alive, self.start_error, self._is_ready = True, "", False

    def send_case(self, case: str, values: ParameterSet) -> None:
        """Let it evaluate a case."""
        self.case = case
        with suppress(OSError):  # it has died: `receive` will say so
            self.pipe.send(values)

    def receive(self) -> tuple[str, _Outcome] | None:
        """What it gave; None where it has only started, or has refused to (`start_error`)."""
        case, self.case = self.case, None
        try:
            answer = self.pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            self.is_alive = False
            if case is not None:
                return case, _Outcome(error=f"its process died (exit code {self._process.exitcode})")
            answer = f"the processes of a study cannot start; {_MAIN_GUARD_REMEDY}, or compute {_THREADS_REMEDY}"
        if case is not None:
            return case, answer
        self.start_error, self._is_ready, self.is_alive = answer, not answer, not answer
        return None

    def stop(self) -> None:
        """Let it end, at once if it is busy or not ready."""
        self.pipe.close()
        if self.case is not None or not self._is_ready:
            self._process.kill()
        self._process.join()


def _serve_worker(pipe: Connection, packed: bytes) -> None:
    """Evaluate one set of parameters after the other, until the other end hangs up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the first one decides
    try:
        fn = pickle.loads(packed)
    except Exception as error:
        where = "define it in a module that can be imported"
        pipe.send(
            f"the function cannot be loaded by other processes: {_reason(error)}; {where}, or compute {_THREADS_REMEDY}"
        )
        return
    pipe.send("")
    with suppress(EOFError, OSError):
        while True:
            pipe.send(_evaluate_case(fn, pipe.recv()))


def _pickle_function(fn: CaseFunction) -> bytes:
    try:
        return pickle.dumps(fn)
    except Exception as error:  # pickle raises what it likes
        raise InputError(
            f"the function cannot go to other processes ({error}); give a function of a module, or "
            f"functools.partial of one with what it needs, or compute {_THREADS_REMEDY}"
        ) from None


def _evaluate_case(fn: CaseFunction, values: ParameterSet) -> _Outcome:
    begun = time.perf_counter()
    try:
        result, seconds = fn(values), time.perf_counter() - begun
        return _Outcome(_plain_results(result), seconds)
    except KeyboardInterrupt:
        return _Outcome(error=INTERRUPTED_CASE)
    except (Exception, SystemExit) as error:
        return _Outcome(seconds=time.perf_counter() - begun, error=_reason(error))


def _future_outcome(future: "Future[_Outcome]") -> _Outcome:
    try:
        return future.result()
    except Exception as error:  # the executor's own: a broken pool, a cancelled future
        return _Outcome(error=_reason(error))


def _reason(error: BaseException) -> str:
    """One line; of an error that nobody raised on purpose, also where."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, PneuoptError) or not frames:
        return text
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"


def _plain_results(result: Any) -> dict[str, Any]:
    """A result as plain numbers and text, by name."""
    import pandas as pd

    if isinstance(result, pd.DataFrame):
        return _plain_results(_flatten_frame(result))
    entries = result if isinstance(result, Mapping | pd.Series) else {"value": result}
    return {str(name): _check_plain(value, str(name)) for name, value in entries.items()}


def _flatten_frame(frame: "pd.DataFrame") -> Mapping[str, Any]:
    if len(frame) == 1:
        return {str(column): frame[column].iloc[0] for column in frame}
    if len(frame.columns) == 1:
        return {str(row): value for row, value in frame.iloc[:, 0].items()}
    return {f"{row}[{column}]": value for column in frame for row, value in frame[column].items()}


def _check_plain(value: Any, name: str) -> Any:
    value = value.item() if getattr(value, "shape", None) == () else value
    if not isinstance(value, bool | int | float | str):
        raise InputError(f"{name} is {type(value).__name__}; return numbers or text, by name")
    return value


def _progress_text(found: Mapping[str, _Outcome], total: int) -> str:
    failed = sum(bool(outcome.error) for outcome in found.values())
    return f"{len(found)} of {total} cases" + (f", {failed} failed" if failed else "")


def _study_table(
    parameters: ParameterSet, runs: Mapping[str, ParameterSet], found: Mapping[str, _Outcome]
) -> "pd.DataFrame":
    import pandas as pd

    swept = list(dict.fromkeys(n for values in runs.values() for n in values if _differs(n, values, parameters)))
    outcomes = {
        name: _check_column_names(found.get(name, _Outcome(error=INTERRUPTED_CASE)), {*_STUDY_COLUMNS, *swept})
        for name in runs
    }
    results = dict.fromkeys(n for outcome in outcomes.values() for n in outcome.results)
    columns: dict[str, list[Any]] = {"case": list(runs)}
    columns |= {n: [v.value(n) if n in v else nan for v in runs.values()] for n in swept}
    columns |= {n: [outcome.results.get(n, nan) for outcome in outcomes.values()] for n in results}
    columns |= {n: [getattr(outcome, n) for outcome in outcomes.values()] for n in ("seconds", "error")}
    return pd.DataFrame(columns)


def _differs(name: str, values: ParameterSet, parameters: ParameterSet) -> bool:
    return name not in parameters or values.value(name) != parameters.value(name)


def _check_column_names(outcome: _Outcome, taken: set[str]) -> _Outcome:
    twice = taken.intersection(outcome.results)
    if not twice:
        return outcome
    said = f"{', '.join(sorted(twice))}: a result has the name of a column of the study; rename it"
    return _Outcome(seconds=outcome.seconds, error=said)
