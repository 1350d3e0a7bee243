"""`WideFrame`: a table that prints all its columns, in as many parts as the terminal needs; pandas leaves some out."""

from typing import Any

import pandas as pd

from pneuopt.quantities.report import Column, Report, Table

MAX_SHOWN_ROWS = 60
"""Rows that are printed: of more, the first and the last, as pandas does; more scroll the header away."""
SHOWN_DIGITS = 6
"""Significant digits of a printed number: more make the columns wider, fewer hide what a good fit knows."""


class WideFrame(pd.DataFrame):
    """A DataFrame that prints all its columns; the first ones are repeated where it goes on below."""

    @property
    def _constructor(self) -> Any:
        return WideFrame

    def __repr__(self) -> str:
        return self._report().to_text()

    def _repr_html_(self) -> str:
        return self._report().to_html()

    def _report(self) -> Report:
        """The table as a report; its index, or where that only counts its first column, names the rows."""
        counts = isinstance(self.index, pd.RangeIndex) and self.index.name is None
        names = [] if counts else [", ".join(str(name or "") for name in self.index.names)]
        half = MAX_SHOWN_ROWS // 2
        keys = (
            [] if counts else [", ".join(map(_format_cell, key if isinstance(key, tuple) else (key,)))]
            for key in self.index
        )
        values = self.itertuples(index=False, name=None)
        cells = [(*key, *map(_format_cell, row)) for key, row in zip(keys, values, strict=True)]
        heads = [Column(name, is_text=True) for name in names]
        heads += [Column(str(n), is_text=not _is_numeric(self.iloc[:, k])) for k, n in enumerate(self.columns)]
        if len(cells) > MAX_SHOWN_ROWS:
            cells = [*cells[:half], ("...",) * len(heads), *cells[-half:]]
        return Report((Table(tuple(heads), tuple(cells)),)) if heads else Report()


def _is_numeric(column: "pd.Series[Any]") -> bool:
    return pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)


def _format_cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{SHOWN_DIGITS}g}"
    return str(value)
