"""Studies: any function of a `ParameterSet` over named cases, in processes, as one tidy table.

A case that fails is a row with its reason, even where its process dies; Ctrl-C keeps what is done. Processes are
spawned, not forked, on every system: the function is pickled once for each of them, with all that it refers to (a
`System`, a `ClosedLoop`); machine code comes from the cache.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import closing, suppress
from math import nan
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import Progress, ProgressReporter
from pneuopt.studies.cases import CaseValues, case_parameters
from pneuopt.studies.journal import Journal
from pneuopt.studies.outcome import INTERRUPTED_CASE, CaseFunction, Outcome
from pneuopt.studies.processes import run_in_executor, run_in_processes

if TYPE_CHECKING:
    import pandas as pd

_STUDY_COLUMNS = ("case", "seconds", "error")


def sweep(
    fn: CaseFunction,
    parameters: ParameterSet,
    cases: Mapping[str, CaseValues],
    *,
    executor: Executor | None = None,
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
    executor : concurrent.futures.Executor, optional
        Where to compute: threads, a cluster's (dask: ``client.get_executor()``). By default one process a CPU.
    progress : callable, optional
        Called with a `Progress`, a line of text that knows how many cases are done, after each case.
    journal : Journal, optional
        Keeps each case on the disk as it comes; those that it has already are not computed again.

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
    >>> from pneuopt.studies.cases import grid
    >>> rig = ParameterSet({"mass": Parameter(5.0, "kg"), "force": Parameter(10.0, "N")})
    >>> table = sweep(lambda p: p.value("force") / p.value("mass"), rig, grid(rig, {"mass": [2.0, 0.0]}),
    ...               executor=ThreadPoolExecutor())
    >>> table["value"].tolist(), table["error"].tolist()[1][:17]
    ([5.0, nan], 'ZeroDivisionError')
    """
    from pneuopt.quantities.frames import WideFrame  # now: what is interrupted has no seconds left to import pandas

    require(len(cases) > 0, "a study needs a case")
    runs = {str(name): case_parameters(parameters, case, str(name)) for name, case in cases.items()}
    found = {} if journal is None else {name: journal.known[name] for name in runs if name in journal.known}
    missing = {name: values for name, values in runs.items() if name not in found}
    outcomes = run_in_processes(fn, missing) if executor is None else run_in_executor(executor, fn, missing)
    report = ProgressReporter(progress, "sweep")
    with closing(outcomes), suppress(KeyboardInterrupt):
        for name, outcome in outcomes if missing else ():
            if outcome.error == INTERRUPTED_CASE:
                break
            found[name] = outcome
            if journal is not None:
                journal.add(name, outcome)
            report(_progress_text(found, len(runs)), len(found), len(runs))
    return WideFrame(_study_columns(parameters, runs, found))


def _progress_text(found: Mapping[str, Outcome], total: int) -> str:
    failed = sum(bool(outcome.error) for outcome in found.values())
    return f"{len(found)} of {total} cases" + (f", {failed} failed" if failed else "")


def _study_columns(
    parameters: ParameterSet, runs: Mapping[str, ParameterSet], found: Mapping[str, Outcome]
) -> dict[str, list[Any]]:
    swept = list(dict.fromkeys(n for values in runs.values() for n in values if _differs(n, values, parameters)))
    outcomes = {
        name: _check_column_names(found.get(name, Outcome(error=INTERRUPTED_CASE)), {*_STUDY_COLUMNS, *swept})
        for name in runs
    }
    results = dict.fromkeys(n for outcome in outcomes.values() for n in outcome.results)
    columns: dict[str, list[Any]] = {"case": list(runs)}
    columns |= {n: [v.value(n) if n in v else nan for v in runs.values()] for n in swept}
    columns |= {n: [outcome.results.get(n, nan) for outcome in outcomes.values()] for n in results}
    columns |= {n: [getattr(outcome, n) for outcome in outcomes.values()] for n in ("seconds", "error")}
    return columns


def _differs(name: str, values: ParameterSet, parameters: ParameterSet) -> bool:
    return name not in parameters or values.value(name) != parameters.value(name)


def _check_column_names(outcome: Outcome, taken: set[str]) -> Outcome:
    twice = taken.intersection(outcome.results)
    if not twice:
        return outcome
    said = f"{', '.join(sorted(twice))}: a result has the name of a column of the study; rename it"
    return Outcome(seconds=outcome.seconds, error=said)
