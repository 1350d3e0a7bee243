"""`Outcome`: what one case of a study gave, in plain numbers and text, or why not; and a process's limit of memory."""

import math
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, PneuoptError
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd


CaseFunction = Callable[[ParameterSet], Any]
CaseValues = ParameterSet | Mapping[str, float]
INTERRUPTED_CASE = "interrupted"
"""The `error` of a case that was not reached, or not finished, when the study was interrupted."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one case gave."""

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

    if isinstance(result, pd.DataFrame):
        return _plain_results(_flatten_frame(result))
    plain: dict[str, Any] = {}
    for name, entry in (result if isinstance(result, Mapping | pd.Series) else {"value": result}).items():
        value = entry.item() if getattr(entry, "shape", None) == () else entry
        if not isinstance(value, bool | int | float | str):
            raise InputError(f"{name} is {type(value).__name__}; return numbers or text, by name")
        plain[str(name)] = value
    return plain


def _flatten_frame(frame: "pd.DataFrame") -> Mapping[str, Any]:
    if len(frame) == 1:
        return {str(column): frame[column].iloc[0] for column in frame}
    if len(frame.columns) == 1:
        return {str(row): value for row, value in frame.iloc[:, 0].items()}
    return {f"{row}[{column}]": value for column in frame for row, value in frame[column].items()}


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
