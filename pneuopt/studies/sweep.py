"""Studies: any function of a `ParameterSet` over named cases, in processes, as one tidy table.

A case that fails is a row with its reason, even where its process dies; Ctrl-C keeps what is done. Processes are
spawned, not forked, on every system: the function is pickled once for each of them, with all that it refers to (a
`System`, a `ClosedLoop`); machine code comes from the cache.
"""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import closing, suppress
from datetime import timedelta
from typing import TYPE_CHECKING

from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import Progress, ProgressReporter
from pneuopt.studies.cases import check_case
from pneuopt.studies.executors import run_in_executor
from pneuopt.studies.journal import CaseMarks, Journal
from pneuopt.studies.outcome import INTERRUPTED_CASE, CaseFunction, CaseValues
from pneuopt.studies.processes import Processes, run_in_processes
from pneuopt.studies.rows import CaseRows

if TYPE_CHECKING:
    import pandas as pd

_RATE_AFTER = 5.0  # time after the first case until a rate is shown [s]: earlier ones jump


def sweep(
    fn: CaseFunction,
    parameters: ParameterSet,
    cases: Mapping[str, CaseValues],
    *,
    executor: Executor | Processes | None = None,
    progress: Callable[[Progress], None] | None = None,
    journal: Journal | None = None,
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
    executor : concurrent.futures.Executor or Processes, optional
        Where to compute: processes of this machine, with limits of time and memory a case, by default one process a
        CPU; threads; a cluster's (`open_executor`). The table is the same.
    progress : callable, optional
        Called with a `Progress`, a line of text that knows how many cases are done, after each case; with the rate and
        the time left, once there is something to say.
    journal : Journal, optional
        Keeps each case on the disk as it comes; those that it has already, with the same values, are not computed
        again.

    Returns
    -------
    DataFrame
        A row a case, in their order. Columns: "case"; each parameter in which the cases differ from `parameters` [SI];
        the results ("value" for a number; of a DataFrame with one row the columns, with one column the rows, otherwise
        "row[column]"); "seconds", the time in `fn`; "error", empty where all is well, else the reason: what `fn`
        raised, a process that died twice, a limit, or results of NaN alone. The results are missing then.

    Raises
    ------
    InputError
        If a case's parameter is unknown or out of bounds, or the function cannot go to other processes.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from pneuopt.quantities.parameters import Parameter
    >>> from pneuopt.studies.cases import grid
    >>> rig = ParameterSet({"mass": Parameter(5.0, "kg"), "force": Parameter(10.0, "N")})
    >>> table = sweep(lambda p: p.value("force") / p.value("mass"), rig, grid(rig, {"mass": [2.0, 0.0]}),
    ...               executor=ThreadPoolExecutor())
    >>> table["value"].tolist(), table["error"].tolist()[1][:17]
    ([5.0, nan], 'ZeroDivisionError')
    """
    from pneuopt.quantities.frames import WideFrame  # now: what is interrupted has no seconds left to import pandas

    require(len(cases) > 0, "a study needs a case")
    cases = {str(name): values for name, values in cases.items()}
    for name, values in cases.items():
        check_case(parameters, values, name)
    rows, marks = CaseRows(parameters, cases), CaseMarks(parameters)
    if journal is not None:
        for name, values in cases.items():
            if (outcome := journal.find(name, marks.of(values))) is not None:
                rows.add(name, outcome)
        journal.show(rows.row(name) for name in cases if not rows.is_missing(name))
    missing = ((name, values) for name, values in cases.items() if rows.is_missing(name))
    given = fn, parameters, missing, len(cases) - rows.done
    if executor is None or isinstance(executor, Processes):
        outcomes = run_in_processes(executor or Processes(), *given)
    else:
        outcomes = run_in_executor(executor, *given)
    report, meter = ProgressReporter(progress, "sweep"), _Meter(rows)
    with closing(outcomes), suppress(KeyboardInterrupt):
        for name, outcome in outcomes if rows.done < len(cases) else ():
            if outcome.error == INTERRUPTED_CASE:
                break
            rows.add(name, outcome)
            if journal is not None:
                journal.add(name, marks.of(cases[name]), outcome)
                journal.show([rows.row(name)])
            report(meter.text(), rows.done, len(cases))
    return WideFrame(rows.columns())


class _Meter:
    """How far a study is, how fast it goes and how long it will take."""

    def __init__(self, rows: CaseRows) -> None:
        self._rows = rows
        self._first: tuple[int, float] | None = None  # cases that were done as the first came, and when [s]

    def text(self) -> str:
        """A line; rate and time left are in it some seconds after the first case."""
        rows, now = self._rows, time.monotonic()
        known, begun = self._first = self._first or (rows.done, now)
        text = f"{rows.done} of {rows.count} cases" + (f", {rows.failed} failed" if rows.failed else "")
        if now - begun < _RATE_AFTER:
            return text
        rate = (rows.done - known) / (now - begun)
        left = round((rows.count - rows.done) / rate)
        return f"{text}, {rate:.3g} a second, {timedelta(seconds=left)} left"
