"""`Outcome`: what one case of a study gave, in plain numbers and text, or why it gave nothing."""

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, PneuoptError
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd

CaseFunction = Callable[[ParameterSet], Any]
INTERRUPTED_CASE = "interrupted"
"""The `error` of a case that was not reached, or not finished, when the study was interrupted."""


@dataclass(frozen=True)
class Outcome:
    """What one case gave.

    Attributes
    ----------
    results : mapping of str to bool, int, float or str
    seconds : float
        Time in the function [s].
    error : str
        Why there are no results; empty where all is well.
    """

    results: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = nan
    error: str = ""


def evaluate_case(fn: CaseFunction, values: ParameterSet) -> Outcome:
    """Call the function; whatever it raises becomes the outcome's error, so an outcome always fits through a pipe."""
    begun = time.perf_counter()
    try:
        result, seconds = fn(values), time.perf_counter() - begun
        return Outcome(_plain_results(result), seconds)
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
