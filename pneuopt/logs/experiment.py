"""What was measured: an `Experiment`, a `Trajectory` with its noise and conditions; cutting and resampling it."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.logs.columns import CHANNELS, ChannelColumn, Plant, plant_channels, read_channels
from pneuopt.logs.table import LogTable, array_table, check_columns
from pneuopt.quantities.errors import LogError, check_names, require
from pneuopt.quantities.parameters import Intersample, as_tuple, check_argument, usual_intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE, count_gauge_from

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class LogSource:
    """Where a log's channels were read: file, rows and columns."""

    path: str  # a name where the log comes from no file
    first_row: int  # the number of the row that holds the first sample, as messages count rows; each sample has a row
    columns: Mapping[str, ChannelColumn]  # by channel, "time" among them
    unread: tuple[str, ...] = ()  # columns that are no channel
    sidecar: str = ""  # the file that says more about the log; empty where there is none
    sections: tuple[str, ...] = ()  # what stands in it


@dataclass(frozen=True, eq=False)
class Experiment:
    """What was measured, how well, and under which conditions.

    Parameters
    ----------
    trajectory : Trajectory
        The channels in SI units; NaN marks a missing sample.
    noise : mapping of str to float
        Standard deviation of a channel [its unit]; a channel without one gets it estimated.
    conditions : mapping of str to float
        Known values [SI] that override the parameter of that name in this log.
    name : str
        What tables call it.
    sha256 : str
        Of the file's bytes, for provenance.
    units : mapping of str to str
        SI units of channels for which `CHANNELS` says none, or another: an angular speed's "rad/s".
    intersample : mapping of str to Intersample
        How channels run between two samples, where that is not the usual: a command is held, what is measured is linear
        (`usual_intersample`).
    accept : tuple of str
        The checks that this log need not pass, for it is known to be right: "work", say, of a brake
        (`logs.doctor.CHECKS`).
    holes : tuple of (int, int)
        Ranges of samples without inputs, empty ones between two rows far apart: the state behind a hole does not follow
        from the state before it. `identify` finds them.
    remarks : tuple of str
        What its reader did that the user may want to know, a sentence each: rows that are skipped as metadata, say.
    source : LogSource, optional
        Where the channels were read: file, rows, columns and units. Windows and new grids have none.

    Raises
    ------
    InputError
        If the noise names an unknown channel or is not positive, or a condition is not finite.

    Examples
    --------
    >>> run = Experiment(Trajectory([0.0, 0.1], {"speed": [0.0, 0.2], "force": [1.0, 1.0]}), name="run_01")
    >>> run.select(["speed"]).with_noise({"speed": 1e-3}).noise
    {'speed': 0.001}
    """

    trajectory: Trajectory
    noise: Mapping[str, float] = field(default_factory=dict)
    conditions: Mapping[str, float] = field(default_factory=dict)
    name: str = ""
    sha256: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    intersample: Mapping[str, Intersample] = field(default_factory=dict)
    holes: tuple[tuple[int, int], ...] = ()
    accept: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    source: LogSource | None = None

    def __post_init__(self) -> None:
        where = self.name or "experiment"
        check_names("channel", self.noise, self.trajectory, f"{where}: noise")
        for channel, sigma in self.noise.items():
            require(
                0 < sigma < math.inf, f"{where}: noise of {channel!r} must be positive, got {sigma:g}; leave it out"
            )
        for parameter, value in self.conditions.items():
            require(math.isfinite(value), f"{where}: condition {parameter!r} must be finite, got {value}")
        check_names("channel", self.intersample, self.trajectory, f"{where}: intersample")
        for channel, kind in self.intersample.items():
            meant = "Intersample.HELD or Intersample.LINEAR"
            check_argument(f"{where}: intersample[{channel!r}]", kind, Intersample, meant)
        accept = as_tuple(f"{where}: accept", self.accept, str, 'the names of checks, as ["motion"]')
        object.__setattr__(self, "accept", accept)
        object.__setattr__(self, "noise", dict(self.noise))
        object.__setattr__(self, "conditions", dict(self.conditions))

    @classmethod
    def from_frame(
        cls,
        frame: "pd.DataFrame",
        *,
        units: Mapping[str, str] | None = None,
        columns: Mapping[str, str | bool | Mapping[str, str | float]] | None = None,
        name: str = "frame",
        plant: Plant | None = None,
        ambient_pressure: float = ATMOSPHERE,
    ) -> "Experiment":
        """Take a log from a pandas DataFrame, as `read_log` takes it from a file.

        Parameters
        ----------
        frame : DataFrame
            Its columns are called like channels, with their units ("position [mm]") or without. Its index is the time
            if it holds dates or durations, or is named so; dates count from the first.
        units : mapping of str to str, optional
            Units of columns whose name says none: {"time": "s", "position": "mm"}.
        columns, plant, ambient_pressure
            As for `read_log`.
        name : str
            What tables and messages call it.

        Raises
        ------
        LogError, UnitError, UnknownNameError
            As `read_log` does; rows are counted from 1.

        Examples
        --------
        >>> import pandas as pd
        >>> frame = pd.DataFrame({"time": range(10), "position [mm]": range(10)})
        >>> Experiment.from_frame(frame, units={"time": "ms"}).trajectory["position"][2].item()
        0.002
        """
        table = frame_table(frame, units or {}, name)
        with count_gauge_from(ambient_pressure):
            return experiment_from_table(table, columns or {}, f"{name}: columns", plant, name)

    def to_frame(self) -> "pd.DataFrame":
        """Tabulate: the index is "time [s]", a column a channel, "position [m]"; `from_frame` reads it back.

        Noise, conditions and what a sidecar says stay behind.
        """
        table = self.trajectory.to_frame()
        units = {n: f"{n} [{unit}]" for n in self.trajectory if (unit := self.unit(n))}
        return table.rename(columns=units).rename_axis("time [s]")

    def unit(self, channel: str) -> str:
        """The SI unit of a channel; empty where nothing says it."""
        return self.units.get(channel) or CHANNELS.get(channel, "")

    def select(self, names: Iterable[str]) -> "Experiment":
        """Keep the named channels, in that order, by copy."""
        kept = self.trajectory.select(names)
        noise = {n: sigma for n, sigma in self.noise.items() if n in kept}
        intersample = {n: kind for n, kind in self.intersample.items() if n in kept}
        return replace(self, trajectory=kept, noise=noise, intersample=intersample)

    def with_noise(self, noise: Mapping[str, float]) -> "Experiment":
        """Give the named channels a standard deviation [SI], by copy."""
        return replace(self, noise={**self.noise, **noise})

    def with_intersample(self, intersample: Mapping[str, Intersample]) -> "Experiment":
        """Say how the named channels run between two samples, by copy."""
        return replace(self, intersample={**self.intersample, **intersample})

    def accepting(self, *checks: str) -> "Experiment":
        """Let the log pass the named checks whatever they find, by copy."""
        return replace(self, accept=tuple(dict.fromkeys((*self.accept, *checks))))

    def with_conditions(self, conditions: Mapping[str, float]) -> "Experiment":
        """Override the named parameters [SI] in this log, by copy."""
        return replace(self, conditions={**self.conditions, **conditions})


def experiment_from_table(
    table: LogTable, columns: Mapping[str, Any], where: str, plant: Plant | None, name: str
) -> Experiment:
    """Give the columns of a table their meaning; `columns` says channel to column, and `where` whence that comes."""
    own = {} if plant is None else plant_channels(plant)
    read = read_channels(table, columns, where, {**CHANNELS, **own})
    trajectory = Trajectory(read.samples["time"], {n: y for n, y in read.samples.items() if n != "time"})
    units = {n: unit for n, unit in own.items() if n in trajectory and CHANNELS.get(n) != unit}
    used = {column.name for column in read.columns.values()}
    unread = tuple(n for n in table.names if n and n not in used)
    source = LogSource(str(table.path), table.first_row, read.columns, unread)
    return Experiment(trajectory, name=name, units=units, remarks=read.remarks, source=source)


def frame_table(frame: "pd.DataFrame", units: Mapping[str, str], name: str) -> LogTable:
    """The columns of a DataFrame, its first sample in row 1, and its index where that holds times or is named so."""
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


def split(experiment: Experiment, duration: float) -> tuple[Experiment, ...]:
    """Cut into consecutive windows that do not overlap; the incomplete last one is dropped.

    Parameters
    ----------
    duration : float
        Of a window [s]: each has exactly ``round(duration / median step)`` samples, and keeps its times.

    Returns
    -------
    tuple of Experiment
        Named "name@0", "name@1", ...

    Raises
    ------
    InputError
        If a window would hold fewer than two samples, or more than the log has.

    Examples
    --------
    >>> run = Experiment(Trajectory([0.0, 0.1, 0.2, 0.3, 0.4], {"speed": [0, 1, 2, 3, 4]}), name="run")
    >>> [(w.name, w.trajectory.t.tolist()) for w in split(run, 0.2)]
    [('run@0', [0.0, 0.1]), ('run@1', [0.2, 0.3])]
    """
    trajectory = experiment.trajectory
    step = _median_step(trajectory)
    n = round(duration / step)
    require(
        2 <= n <= len(trajectory),
        f"windows of {duration:g} s hold {n} samples of {experiment.name or 'the log'}, which has {len(trajectory)}, "
        f"one every {step:g} s; choose between {2 * step:g} and {len(trajectory) * step:g} s",
    )
    starts = range(0, len(trajectory) - n + 1, n)
    return tuple(
        replace(experiment, trajectory=trajectory.rows(i, i + n), name=f"{experiment.name}@{k}", source=None)
        for k, i in enumerate(starts)
    )


def resample(experiment: Experiment, step: float) -> Experiment:
    """Bring onto a uniform grid: channels that are held keep their last value, others are interpolated linearly.

    Parameters
    ----------
    step : float
        Of the new grid [s]. Nothing is filtered, so a step much longer than the log's aliases its noise.

    Returns
    -------
    Experiment
        A sample beside a missing one is missing, too.

    Raises
    ------
    InputError
        If the step is not positive, or longer than the log.
    """
    old = experiment.trajectory
    require(0 < step <= old.duration, f"a step of {step:g} s does not fit a log of {old.duration:g} s")
    grid = old.t[0] + step * np.arange(math.floor(old.duration / step * (1 + 1e-12)) + 1)
    grid[-1] = min(grid[-1], old.t[-1])
    # A grid point that rounding puts just before its sample still belongs to that sample.
    held = np.searchsorted(old.t, grid + 1e-9 * step, side="right") - 1
    runs = {n: experiment.intersample.get(n) or usual_intersample(n, experiment.unit(n)) for n in old}
    values = {n: np.interp(grid, old.t, old[n]) if runs[n] is Intersample.LINEAR else old[n][held] for n in old}
    return replace(experiment, trajectory=Trajectory(grid, values), source=None)


def differentiate(experiment: Experiment, *, window: float, position: str = "position") -> Experiment:
    """Add "speed": the slope of a parabola fitted to the positions around each sample (Savitzky-Golay on any grid).

    Parameters
    ----------
    window : float
        Width of the fit [s]; noise falls with its power 1.5, the bandwidth with its first.
    position : str
        The channel to differentiate [m].

    Returns
    -------
    Experiment
        NaN where the position is missing or its window holds fewer than three samples.

    Raises
    ------
    InputError
        If there is a speed already, or the window is too narrow for the log's step.

    Examples
    --------
    >>> run = Experiment(Trajectory([0.0, 0.1, 0.3, 0.4], {"position": [0.0, 0.01, 0.09, 0.16]}))
    >>> np.allclose(differentiate(run, window=0.6).trajectory["speed"], [0.0, 0.2, 0.6, 0.8])
    True
    """
    old = experiment.trajectory
    require("speed" not in old, "the log has a speed already; select the other channels first")
    step = _median_step(old)
    require(window >= 2 * step, f"a window of {window:g} s holds fewer than 3 samples; take {4 * step:g} s or more")
    t, x, reach = old.t, old[position], window / 2  # of the samples no farther than this from each
    known, n = np.isfinite(x), t.size
    first, last = np.searchsorted(t, t - reach * (1 + 1e-9)), np.searchsorted(t, t + reach * (1 + 1e-9), side="right")
    moments, loads = np.zeros((5, n)), np.zeros((3, n))
    every = np.arange(n)
    for shift in range(int((first - every).min()), int((last - every).max())):
        j = np.clip(every + shift, 0, n - 1)
        w = ((every + shift >= first) & (every + shift < last) & known[j]).astype(float)
        s, dx = (t[j] - t) / reach, np.where(w > 0, x[j] - x, 0.0)
        for power in range(5):
            moments[power] += w
            if power < 3:
                loads[power] += w * dx
            w = w * s
    enough = known & (moments[0] >= 3)
    normal = moments[np.add.outer(np.arange(3), np.arange(3))].transpose(2, 0, 1)[enough]
    slope = np.full(n, np.nan)
    slope[enough] = np.linalg.solve(normal, loads.T[enough][..., None])[:, 1, 0] / reach
    return replace(experiment, trajectory=old.with_columns({"speed": slope}))


def _median_step(trajectory: Trajectory) -> float:
    require(len(trajectory) > 1, "a log of one sample has no time step")
    return float(np.median(np.diff(trajectory.t)))
