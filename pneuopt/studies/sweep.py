"""Studies: any function of a `ParameterSet` over named cases, in processes, as one tidy table (`sweep`).

A case that fails is a row with its reason, even where its process dies; Ctrl-C keeps what is done. Processes are
spawned, not forked, on every system: the function is pickled once for each of them, with all that it refers to (a
`System`, a `ClosedLoop`); machine code comes from the cache. First stand the ways to name cases, every combination of
values (`grid`) or the rows of a table (`read_cases`); corners and draws, the scenarios of `evaluation`, are cases as
they are. Last stands the sample time of a loop's controller as an axis of a study: a part of the loop's structure, no
parameter of it, so that a case that has it is of a loop of its own.
"""

import itertools
import math
import re
import time
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, suppress
from dataclasses import replace
from datetime import timedelta
from io import BytesIO
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.tolerances import MAX_STEPS
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.metric import Band
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.output import MAX_REASON, read_source
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Progress, ProgressReporter
from pneuopt.quantities.units import si_conversion, write_value
from pneuopt.studies.executors import (
    INTERRUPTED_CASE,
    CaseFunction,
    CaseValues,
    Outcome,
    Processes,
    run_in_executor,
    run_in_processes,
)
from pneuopt.studies.journal import CaseMarks, Journal
from pneuopt.studies.tolerances import MAX_TABLE_BYTES

if TYPE_CHECKING:
    import pandas as pd


_NAMES = "case"  # the column of a table that names its cases, as in the table that `sweep` returns


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
    columns = list[list[tuple[str, float]]]()
    for name, given in axes.items():
        values = list(map(float, given))
        require(len(values) > 0, f"axis {name}: no values")
        require(len(set(values)) == len(values), f"axis {name}: a value is there twice; leave one out")
        for value in values:
            check_case(parameters, {name: value}, "axis")
        # labels have six digits, or 17 where two labels would be equal
        short, full = ([write_value(v, parameters[name].unit, digits) for v in values] for digits in (6, 17))
        labels = short if len(set(short)) == len(values) else full
        columns.append([(f"{name} = {label}", value) for label, value in zip(labels, values, strict=True)])
    return {
        ", ".join(label for label, _ in point): dict(zip(axes, (value for _, value in point), strict=True))
        for point in itertools.product(*columns)
    }


def read_cases(parameters: ParameterSet, table: "pd.DataFrame | str | Path") -> dict[str, dict[str, float]]:
    """Read the cases of a table, a row each: plants that were measured, or that another tool has chosen.

    Parameters
    ----------
    parameters : ParameterSet
        Gives units and bounds.
    table : DataFrame, str or Path
        A column a parameter, "load.mass [kg]"; one without a unit is in the parameter's SI unit. A column "case" names
        the cases. A path is that of a CSV file.

    Returns
    -------
    dict of str to dict of str to float
        By the name of the case, or "row 1" and so on.

    Raises
    ------
    InputError
        If the file cannot be read, a parameter is unknown, a value is missing or outside its bounds, a name is there
        twice, or there is no row.

    Examples
    --------
    >>> import pandas as pd
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "stroke": Parameter(0.2, "m")})
    >>> read_cases(rig, pd.DataFrame({"case": ["short"], "stroke [mm]": [150], "load.mass": [4]}))
    {'short': {'stroke': 0.15, 'load.mass': 4.0}}
    """
    import pandas as pd

    where = "table" if isinstance(table, pd.DataFrame) else str(table)
    if isinstance(table, pd.DataFrame):
        frame = table
    else:
        try:
            frame = pd.read_csv(BytesIO(read_source(Path(table), MAX_TABLE_BYTES, "take fewer cases")))
        except ValueError as error:  # pandas' own errors among them
            reason = " ".join(str(error).split())[:MAX_REASON]
            raise InputError(f"{table}: is no table of cases in CSV ({reason})") from None
    heads = {column: re.fullmatch(r"(.*?)(?: \[(.*)\])?", str(column)) for column in frame if column != _NAMES}
    columns = {column: (head[1].strip(), head[2]) for column, head in heads.items() if head}
    names = [name for name, _ in columns.values()]
    check_names("parameter", names, parameters, where)
    require(len(frame) > 0 and len(names) > 0, f"{where}: no case; it needs a row, and a column of a parameter")
    require(len(set(names)) == len(names), f"{where}: a parameter has two columns; leave one out")
    labels = [f"row {k}" for k in range(1, len(frame) + 1)] if _NAMES not in frame else list(map(str, frame[_NAMES]))
    require(len(set(labels)) == len(labels), f"{where}: two cases have the same name")
    values = dict[str, list[float]]()
    for column, (name, written) in columns.items():
        numbers = pd.to_numeric(frame[column], errors="coerce").to_numpy(dtype=float)
        bad = [k for k, v in enumerate(numbers.tolist(), 1) if not math.isfinite(v)]
        require(not bad, f"{where}: {column}: row {bad[0] if bad else 0} is no number; every case needs its own")
        unit = parameters[name].unit
        factor, offset = si_conversion(unit if written is None else written, unit, where=f"{where}: {column}")
        values[name] = (factor * numbers + offset).tolist()
    cases = {label: {n: values[n][k] for n in names} for k, label in enumerate(labels)}
    for label, case in cases.items():
        check_case(parameters, case, f"{where}: {label}")
    return cases


def check_case(parameters: ParameterSet, case: CaseValues, name: str) -> None:
    """Raise `InputError`, which names the case, if it has an unknown parameter, or a value out of bounds."""
    if isinstance(case, ParameterSet):
        return
    known = {n: parameters[n] for n in case if n in parameters}
    if len(known) == len(case) and all(
        p.lower <= case[n] <= p.upper and (not p.log or case[n] > 0) for n, p in known.items()
    ):
        return  # certainly good; below, the words where it is not
    check_names("parameter", case, parameters, name)
    try:
        parameters.with_values(case)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


class CaseRows:
    """The table of a study while it grows, column by column: a row a case; one without an outcome is interrupted."""

    def __init__(self, parameters: ParameterSet, cases: Mapping[str, CaseValues]) -> None:
        self._parameters, self._cases = parameters, cases
        self.count, self.done, self.failed = len(cases), 0, 0  # cases, those with an outcome, those with an error
        self._places = {str(name): place for place, name in enumerate(cases)}
        nominal, swept = {n: p.value for n, p in parameters.items()}, dict[str, None]()
        for case in cases.values():
            values = {n: p.value for n, p in case.items()} if isinstance(case, ParameterSet) else case
            swept |= dict.fromkeys(n for n, v in values.items() if n not in swept and nominal.get(n) != v)
        self._swept = list(swept)  # the parameters in which the cases differ from what they have in common
        self._taken = {"case", "seconds", "error", *self._swept}
        self._results: dict[str, list[Any]] = {}
        self._seconds = array("d", [nan]) * len(cases)
        self._errors = [INTERRUPTED_CASE] * len(cases)

    def add(self, name: str, outcome: Outcome) -> None:
        """Put what a case gave into its row."""
        place, twice = self._places[name], self._taken.intersection(outcome.results)
        if twice:
            message = f"{', '.join(sorted(twice))}: a result has the name of a column of the study; rename it"
            outcome = Outcome(seconds=outcome.seconds, error=message)
        self._seconds[place], self._errors[place] = outcome.seconds, outcome.error
        for n, value in outcome.results.items():
            if n not in self._results:
                self._results[n] = [nan] * len(self._cases)
            self._results[n][place] = value
        self.done += 1
        self.failed += bool(outcome.error)

    def is_missing(self, name: str) -> bool:
        """Whether a case has no outcome yet."""
        return self._errors[self._places[name]] == INTERRUPTED_CASE

    def row(self, name: str) -> dict[str, Any]:
        """The row of a case that has an outcome, without the results that it lacks."""
        place, case = self._places[name], self._cases[name]
        row: dict[str, Any] = {"case": name} | {n: _value_of(n, case, self._parameters) for n in self._swept}
        row |= {n: column[place] for n, column in self._results.items() if not self._errors[place]}
        return row | {"seconds": self._seconds[place], "error": self._errors[place]}

    def columns(self) -> dict[str, list[Any]]:
        """The table's columns."""
        columns: dict[str, list[Any]] = {"case": list(self._places)}
        columns |= {n: [_value_of(n, case, self._parameters) for case in self._cases.values()] for n in self._swept}
        return columns | self._results | {"seconds": list(self._seconds), "error": self._errors}


def _value_of(name: str, case: CaseValues, parameters: ParameterSet) -> float:
    if isinstance(case, ParameterSet):
        return case.value(name) if name in case else nan
    return float(case[name]) if name in case else parameters.value(name) if name in parameters else nan


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
    >>> from pneuopt.studies.sweep import grid
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
        journal.append_rows(rows.row(name) for name in cases if not rows.is_missing(name))
    missing = ((name, values) for name, values in cases.items() if rows.is_missing(name))
    task = fn, parameters, missing, len(cases) - rows.done
    if executor is None or isinstance(executor, Processes):
        outcomes = run_in_processes(executor or Processes(), *task)
    else:
        outcomes = run_in_executor(executor, *task)
    report, meter = ProgressReporter(progress, "sweep"), _Meter(rows)
    with closing(outcomes), suppress(KeyboardInterrupt):
        for name, outcome in outcomes if rows.done < len(cases) else ():
            if outcome.error == INTERRUPTED_CASE:
                break
            rows.add(name, outcome)
            if journal is not None:
                journal.add(name, marks.of(cases[name]), outcome)
                journal.append_rows([rows.row(name)])
            report(meter.text(), rows.done, len(cases))
    return WideFrame(rows.columns())


class _Meter:
    """Progress of a study, with its rate and the time left once rates no longer jump."""

    def __init__(self, rows: CaseRows, rate_after: float = 5.0) -> None:
        self._rows, self._rate_after = rows, rate_after  # from the first case on [s]
        self._first: tuple[int, float] | None = None  # cases that were done as the first came, and when [s]

    def text(self) -> str:
        """A line; rate and time left are in it some seconds after the first case."""
        rows, now = self._rows, time.monotonic()
        done_before, begun = self._first = self._first or (rows.done, now)
        text = f"{rows.done} of {rows.count} cases" + (f", {rows.failed} failed" if rows.failed else "")
        if now - begun < self._rate_after:
            return text
        rate = (rows.done - done_before) / (now - begun)
        left = round((rows.count - rows.done) / rate)
        return f"{text}, {rate:.3g} a second, {timedelta(seconds=left)} left"


SAMPLE_TIME_AXIS = "pid.sample_time"
"""Its name in a study, as a tuning.toml has it."""


def with_sample_time(loop: ClosedLoop, parameters: ParameterSet) -> ParameterSet:
    """The parameters with the sample time of the loop's controller, which cases may change; a continuous one fails."""
    step = loop.pid.sample_time
    require(
        step is not None, f"{SAMPLE_TIME_AXIS}: the controller is continuous; give [pid] a sample_time in the tuning"
    )
    assert step is not None
    return parameters | ParameterSet({SAMPLE_TIME_AXIS: Parameter(step, "s", lower=0.0)})


def loop_at_sample_time(loop: ClosedLoop, parameters: ParameterSet) -> tuple[ClosedLoop, ParameterSet]:
    """The loop with the sample time of a case, and the case's other parameters; without one, both as they are."""
    if SAMPLE_TIME_AXIS not in parameters:
        return loop, parameters
    sampled = replace(loop, pid=replace(loop.pid, sample_time=parameters.value(SAMPLE_TIME_AXIS)))
    return sampled, parameters.select(n for n in parameters if n != SAMPLE_TIME_AXIS)


def evaluate_at_sample_time(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    band: Band = 0.02,
    max_steps: float = MAX_STEPS,
) -> "pd.DataFrame":
    """The metrics of a case that may have a sample time among its parameters; as `evaluate`."""
    sampled, others = loop_at_sample_time(loop, parameters)
    return evaluate(sampled, references, others, band=band, max_steps=max_steps)
