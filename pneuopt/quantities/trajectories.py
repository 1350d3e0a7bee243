"""`Trajectory`: a time grid and named columns, the one shape of data that every verb takes and returns."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, UnknownNameError, require

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Named columns over a strictly increasing time grid; read-only.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time [s].
    values : mapping of str to array_like, each of shape (n,)
        The columns in SI units; NaN marks a missing sample.

    Examples
    --------
    >>> run = Trajectory([0.0, 1.0, 2.0], {"speed": [0.0, 0.5, 1.0]})
    >>> run["speed"][-1].item(), run.names
    (1.0, ('speed',))
    """

    t: Array
    values: Mapping[str, Array]

    def __init__(self, t: ArrayLike, values: Mapping[str, ArrayLike]) -> None:
        grid = _read_only_copy(t)
        require(grid.ndim == 1 and grid.size > 0, f"a trajectory needs a time grid of shape (n,), got {grid.shape}")
        require(bool(np.isfinite(grid).all()), "a trajectory's time must be finite")
        back = np.flatnonzero(np.diff(grid) <= 0)
        where = f"sample {back[0] + 1} at {grid[back[0] + 1]:g} s follows {grid[back[0]]:g} s" if back.size else ""
        require(not back.size, f"a trajectory's time must increase strictly; {where}")
        columns = {name: _read_only_copy(column) for name, column in values.items()}
        for name, column in columns.items():
            require(column.shape == grid.shape, f"column {name!r} has shape {column.shape}, time has {grid.shape}")
        object.__setattr__(self, "t", grid)
        object.__setattr__(self, "values", columns)

    def __getitem__(self, name: str) -> Array:
        try:
            return self.values[name]
        except KeyError:
            raise UnknownNameError("channel", name, self.values) from None

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def names(self) -> tuple[str, ...]:
        """The columns' names, in order."""
        return tuple(self.values)

    @property
    def duration(self) -> float:
        """From the first sample to the last [s]."""
        return float(self.t[-1] - self.t[0])

    def matrix(self, names: Iterable[str]) -> Array:
        """The named columns side by side, shape (n, len(names))."""
        columns = [self[name] for name in names]
        return np.column_stack(columns) if columns else np.empty((len(self), 0))

    def with_columns(self, columns: Mapping[str, ArrayLike]) -> "Trajectory":
        """Add or replace columns, by copy."""
        return Trajectory(self.t, {**self.values, **columns})

    def select(self, names: Iterable[str]) -> "Trajectory":
        """Keep the named columns, in that order."""
        return Trajectory(self.t, {name: self[name] for name in names})

    def rows(self, start: int, stop: int) -> "Trajectory":
        """Keep the samples `start:stop`."""
        return Trajectory(self.t[start:stop], {n: c[start:stop] for n, c in self.values.items()})

    def interpolate(self, t: ArrayLike) -> "Trajectory":
        """Interpolate linearly onto another grid; before the first and after the last sample, their values stay."""
        grid = np.asarray(t, dtype=float)
        return Trajectory(grid, {n: np.interp(grid, self.t, c) for n, c in self.values.items()})

    def fill_gaps(self, name: str) -> Array:
        """The column with its missing samples interpolated linearly; one without any sample is a `LogError`."""
        column = self[name]
        known = np.isfinite(column)
        require(bool(known.any()), f"channel {name!r} has no samples", LogError)
        return np.interp(self.t, self.t[known], column[known])

    def to_frame(self) -> "pd.DataFrame":
        """Tabulate: the index is the time [s], a column a signal."""
        import pandas as pd

        return pd.DataFrame(dict(self.values), index=pd.Index(self.t, name="time"))


def _read_only_copy(values: ArrayLike) -> Array:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
