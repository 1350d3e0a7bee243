"""A pandas DataFrame as the table of a log."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.logs.arrays import array_table
from pneuopt.logs.table import Table, check_columns
from pneuopt.quantities.errors import LogError, check_names, require

if TYPE_CHECKING:
    import pandas as pd


def frame_table(frame: "pd.DataFrame", units: Mapping[str, str], name: str) -> Table:
    """The columns of a DataFrame, and its index where that is the time.

    Parameters
    ----------
    frame : DataFrame
        Its index counts as the column "time" where it holds dates or durations, or is named so.
    units : mapping of str to str
        By column.
    name : str
        Of the log, for messages.

    Returns
    -------
    Table
        Its first sample is row 1.
    """
    require(all(isinstance(column, str) for column in frame.columns), f"{name}: columns need names, as text", LogError)
    columns = {str(column): _array(frame.iloc[:, i]) for i, column in enumerate(frame.columns)}
    check_columns(name, [str(column) for column in frame.columns])
    index = frame.index
    if index.dtype.kind in "Mm" or str(index.name or "").casefold().startswith("time"):
        columns = {str(index.name or "time"): _array(index.to_series()), **columns}
    check_names("column", units, columns, f"{name}: units")
    return array_table(name, columns, units)


def _array(series: "pd.Series[Any]") -> Any:
    """A column as NumPy has it; a time in a zone is counted in UTC, and what is missing is NaN."""
    import pandas as pd

    kind = series.dtype
    if isinstance(kind, pd.DatetimeTZDtype):
        return series.dt.tz_convert("UTC").dt.tz_localize(None).to_numpy()
    if pd.api.types.is_bool_dtype(kind) or not pd.api.types.is_numeric_dtype(kind):
        return series.to_numpy()
    return series.to_numpy(dtype=np.float64, na_value=np.nan)
