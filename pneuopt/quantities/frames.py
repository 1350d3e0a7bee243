"""`WideFrame`: a table that prints all its columns, in as many parts as the terminal needs; pandas leaves some out."""

from typing import Any

import pandas as pd

from pneuopt.quantities.report import Column, Report, Table


class WideFrame(pd.DataFrame):
    """A DataFrame that prints all its columns; the first ones are repeated where it goes on below."""

    @property
    def _constructor(self) -> Any:
        return WideFrame

    def __repr__(self) -> str:
        return self._report().to_text()

    def _repr_html_(self) -> str:
        return self._report().to_html()

    def _report(self, most_rows: int = 60) -> Report:
        """The table as a report; the index names its rows, or the first column where that only counts."""
        counts = isinstance(self.index, pd.RangeIndex) and self.index.name is None
        names = [] if counts else [", ".join(str(name or "") for name in self.index.names)]
        keys = (
            [] if counts else [", ".join(map(_format_cell, key if isinstance(key, tuple) else (key,)))]
            for key in self.index
        )
        values = self.itertuples(index=False, name=None)
        cells = [(*key, *map(_format_cell, row)) for key, row in zip(keys, values, strict=True)]
        dtypes = [self.iloc[:, k].dtype for k in range(self.shape[1])]
        numeric = [pd.api.types.is_numeric_dtype(d) and not pd.api.types.is_bool_dtype(d) for d in dtypes]
        heads = [Column(name, is_text=True) for name in names]
        heads += [Column(str(n), is_text=not numeric[k]) for k, n in enumerate(self.columns)]
        if len(cells) > most_rows:
            cells = [*cells[: most_rows // 2], ("...",) * len(heads), *cells[-(most_rows // 2) :]]
        return Report((Table(tuple(heads), tuple(cells)),)) if heads else Report()


def _format_cell(value: Any, digits: int = 6) -> str:
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return str(value)
