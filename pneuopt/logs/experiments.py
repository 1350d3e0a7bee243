"""`Experiment`: a measured `Trajectory` with its noise and conditions; reading logs, cutting and resampling them."""

import hashlib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pneuopt.logs.columns import CHANNELS, read_channels
from pneuopt.logs.readers import read_table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, check_names, require
from pneuopt.quantities.intersample import Intersample, usual_intersample
from pneuopt.quantities.parameters import Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE, count_gauge_from, read_si, read_value

ACCEPTED_CHECKS = "accept"  # of a sidecar: the checks that its log need not pass


class Plant(Protocol):
    """What a log's reader asks of a plant, say a `System`."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Signals that drive it."""
        ...

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """Signals that sensors show."""
        ...


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
        object.__setattr__(self, "noise", dict(self.noise))
        object.__setattr__(self, "conditions", dict(self.conditions))

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


def read_log(
    path: str | Path,
    *,
    columns: Mapping[str, str | Mapping[str, str | float]] | None = None,
    sidecar: str | Path | None = None,
    plant: Plant | None = None,
    ambient_pressure: float = ATMOSPHERE,
) -> Experiment:
    """Read a log, and what its sidecar says about it.

    Parameters
    ----------
    path : str or Path
        Its suffix says the format: text (.csv, .txt, .tsv, .dat), .parquet or .mat (up to version 7). In a text, the
        first row names the columns; a comma, semicolon or tab separates them; the decimal mark is a point or a comma;
        an empty cell is a missing sample.
    columns : mapping, optional
        Channel to column, in place of the sidecar's [columns]: "t [ms]", or a mapping with `column`, `unit`,
        `centre` ("5 V", subtracted) and `scale` ("35 N/V", multiplied, or an encoder's "8192 count/rev"). Without
        either, the header has to say "position [mm]" or "position_mm".
    sidecar : str or Path, optional
        TOML with [columns], [noise], [conditions], [intersample] (force = "held", or "linear"); by default the file of
        the same name, if there is one. Before them, accept = ["work"] names checks that the log need not pass.
    plant : System, optional
        Its inputs and outputs, and their references, are channels in its units, beside and before the usual ones:
        torque [N*m] and angle [rad], say.
    ambient_pressure : float
        What gauge pressures, bar(g), count from [Pa]: the drive's "ambient.pressure".

    Returns
    -------
    Experiment

    Raises
    ------
    LogError, UnitError, UnknownNameError
        If anything in the files is missing, ambiguous or not a number; the message names file, row, column, remedy.
    """
    path = Path(path)
    sha256 = hashlib.sha256(_read_bytes(path)).hexdigest()
    side, sections = _read_sidecar(path, sidecar)
    entries, where = (columns, "columns") if columns is not None else (sections.get("columns"), f"{side}: columns")
    units = {} if plant is None else _plant_channels(plant)
    channels = {**CHANNELS, **units}
    with count_gauge_from(ambient_pressure):
        values = read_channels(read_table(path), entries, where, channels)
        conditions = {n: read_si(v, where=f"{side}: conditions.{n}") for n, v in sections.get("conditions", {}).items()}
    trajectory = Trajectory(values.pop("time"), values)
    noise = _read_noise(sections.get("noise", {}), trajectory, f"{side}: noise", channels)
    own = {n: unit for n, unit in units.items() if n in trajectory and CHANNELS.get(n) != unit}
    between = _read_intersample(sections.get("intersample", {}), trajectory, f"{side}: intersample")
    accept = tuple(sections.get(ACCEPTED_CHECKS, ()))
    return Experiment(trajectory, noise, conditions, path.stem, sha256, own, between, accept=accept)


def split(experiment: Experiment, duration: float) -> tuple[Experiment, ...]:
    """Cut into consecutive windows that do not overlap; the incomplete last one is dropped.

    Parameters
    ----------
    experiment : Experiment
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
        replace(experiment, trajectory=trajectory.rows(i, i + n), name=f"{experiment.name}@{k}")
        for k, i in enumerate(starts)
    )


def resample(experiment: Experiment, step: float) -> Experiment:
    """Bring onto a uniform grid: channels that are held keep their last value, others are interpolated linearly.

    Parameters
    ----------
    experiment : Experiment
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
    values = {n: np.interp(grid, old.t, c) if runs[n] is Intersample.LINEAR else c[held] for n, c in old.values.items()}
    return replace(experiment, trajectory=Trajectory(grid, values))


def differentiate(experiment: Experiment, *, window: float, position: str = "position") -> Experiment:
    """Add "speed": the slope of a parabola fitted to the positions around each sample (Savitzky-Golay on any grid).

    Parameters
    ----------
    experiment : Experiment
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
    speed = _local_slope(old.t, old[position], window / 2)
    return replace(experiment, trajectory=old.with_columns({"speed": speed}))


def _local_slope(t: Array, x: Array, reach: float) -> Array:
    """Slope at each sample of the least-squares parabola through the samples no farther than `reach`."""
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
    return slope


def _median_step(trajectory: Trajectory) -> float:
    require(len(trajectory) > 1, "a log of one sample has no time step")
    return float(np.median(np.diff(trajectory.t)))


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); check the name and the folder") from None


def _read_sidecar(path: Path, sidecar: str | Path | None) -> tuple[Path, Mapping[str, Any]]:
    side = path.with_suffix(".toml") if sidecar is None else Path(sidecar)
    if sidecar is None and not side.exists():
        return side, {}
    raw = _read_bytes(side)
    try:
        sections = tomllib.loads(raw.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise LogError(f"{side}: not valid TOML: {error}") from None
    other = f"{side}: is a drive, but has the name of the sidecar of {path.name}; rename one of them"
    require(sidecar is not None or "drive" not in sections, other, LogError)
    check_names("key", sections, (ACCEPTED_CHECKS, "columns", "noise", "conditions", "intersample"), str(side))
    accept = sections.get(ACCEPTED_CHECKS, [])
    is_list = isinstance(accept, list) and all(isinstance(name, str) for name in accept)
    require(
        is_list,
        f'{side}: {ACCEPTED_CHECKS} must list checks, as {ACCEPTED_CHECKS} = ["work"]; got {accept!r}',
        LogError,
    )
    for key, section in ((key, section) for key, section in sections.items() if key != ACCEPTED_CHECKS):
        require(isinstance(section, dict), f"{side}: {key} must be a section, [{key}]", LogError)
    return side, sections


def _plant_channels(plant: Plant) -> dict[str, str]:
    """The channels that a plant's log may hold: its signals, and the references of its outputs."""
    references = {f"{q.name}_reference": q.unit for q in plant.outputs}
    return {**{q.name: q.unit for q in (*plant.inputs, *plant.outputs)}, **references}


def _read_noise(
    entries: Mapping[str, Any], trajectory: Trajectory, where: str, channels: Mapping[str, str]
) -> dict[str, float]:
    check_names("channel", entries, trajectory, where)
    # A noise is a difference, so a pressure's takes no (a) or (g).
    return {c: read_value(v, channels[c].partition("(")[0], where=f"{where}.{c}") for c, v in entries.items()}


def _read_intersample(entries: Mapping[str, Any], trajectory: Trajectory, where: str) -> dict[str, Intersample]:
    check_names("channel", entries, trajectory, where)
    known = {kind.value: kind for kind in Intersample}
    for channel, word in entries.items():
        require(
            isinstance(word, str) and word in known,
            f"{where}.{channel} is {word!r}; it must be " + " or ".join(map(repr, known)),
            LogError,
        )
    return {channel: known[word] for channel, word in entries.items()}
