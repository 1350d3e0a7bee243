"""`ExperimentDesign`: a planned experiment: what to play, what its log will tell, and what its log has told.

`DOptimal`, `AOptimal`, `Precision`, `WantedPrecision` judge a plan by one number (Atkinson, Donev, Tobias, Optimum
Experimental Designs, with SAS, 2007, chapter 10). A newcomer adds a class like these: the parameters that it is about,
and its figure of their covariance.

`linked_information`: what a log that is cut into linked segments tells about parameters, once it is identified.
`identify` weighs gaps as if the states jumped there a little, and its covariance is the sandwich B^-1 M B^-1
(`NormalEquations.covariance`): B is the Gram matrix of data and gaps with the nodes eliminated, M that of the data
alone. Its inverse B M^-1 B is the information here: with B itself, a planned run of an EMPS axis promised intervals
three times as wide as its fit had, and other runs seemed the best (problems/identify/next_experiment.py).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pneuopt.experiments.tolerances import LARGEST, REACHED_ROOM, SINGULAR, STATE_RIDGE, UNINFORMED
from pneuopt.identification.result import IdentificationResult, join_names
from pneuopt.identification.statistics import confidence_interval
from pneuopt.identification.tolerances import UNIDENTIFIABLE_DEVIATION
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import TIED, Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Result
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class ExperimentDesign(Result):
    """A planned experiment.

    Attributes
    ----------
    channel : str
        What is excited: the loop's reference ("position_reference"), or the plant's command.
    runs : tuple of Trajectory
        Each run as the estimates predict it: excitation, command, outputs and states.
    blocks : tuple of tuple of str
        The blocks of each run in words; they are equally long.
    table : DataFrame
        A row a free parameter: value, unit, target; stderr_before, that of the logs in hand (NaN: they tell nothing);
        stderr_after, with the planned runs; stderr_alone, by these runs alone; the ends of the 95 % interval before and
        after; narrower, their ratio; identifiable, after the runs.
    limits : mapping of str to (float, float)
        What the runs keep.
    room : mapping of str to float
        By limit, how far the runs stay within, as a share of its width, negative; 0: they touch it.
    criterion : str
    stats : mapping of str to float
        The criterion "before" and "after", as a relative standard deviation; the runs "tried"; "origin", the excitation
        at the start; "plants", for which the runs were chosen.
    units : mapping of str to str
        Of the channels.
    """

    channel: str
    runs: tuple[Trajectory, ...]
    blocks: tuple[tuple[str, ...], ...]
    table: "pd.DataFrame"
    limits: Mapping[str, tuple[float, float]]
    room: Mapping[str, float]
    criterion: str
    stats: Mapping[str, float]
    units: Mapping[str, str]

    @property
    def excitation(self) -> Trajectory:
        """The signal to play; of several runs take ``runs``."""
        require(len(self.runs) == 1, f"{len(self.runs)} runs are planned: take design.runs[0], [1], ...")
        return self.runs[0].select([self.channel])

    @property
    def active_limits(self) -> tuple[str, ...]:
        """The limits that the runs touch."""
        return tuple(n for n, room in self.room.items() if room > -REACHED_ROOM)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Free parameters that stay unidentifiable, with the logs in hand and the planned runs."""
        return tuple(str(n) for n, good in self.table["identifiable"].items() if not good)

    def write_csv(self, path: str | Path, *, units: bool = True) -> tuple[Path, ...]:
        """Write what a controller plays: time and excitation; several runs into files "name_1.csv", "name_2.csv", ...

        Parameters
        ----------
        path : str or Path
        units : bool
            Whether the header holds the units, as `read_log` reads them.

        Returns
        -------
        tuple of Path
            The files.

        Raises
        ------
        InputError
            If a file cannot be written.
        """
        place, unit = Path(path), self.units[self.channel]
        several = len(self.runs) > 1
        files = tuple(place.with_stem(f"{place.stem}_{k}") if several else place for k in range(1, len(self.runs) + 1))
        head = f"time [s],{self.channel} [{unit}]" if units else f"time,{self.channel}"
        for file, run in zip(files, self.runs, strict=True):
            rows = (f"{t:.9g},{v:.9g}" for t, v in zip(run.t.tolist(), run[self.channel].tolist(), strict=True))
            write_text(file, "\n".join([head, *rows]) + "\n")
        return files

    def compare(self, fit: IdentificationResult, *, alone: bool = False) -> "pd.DataFrame":
        """Predicted against achieved, once the run is logged and identified.

        Parameters
        ----------
        fit : IdentificationResult
            Of the logs in hand and the new ones together.
        alone : bool
            Whether it is of the new logs alone.

        Returns
        -------
        DataFrame
            A row a parameter: planned_value and value; stderr_before, stderr_predicted and stderr_achieved; ratio, the
            achieved over the predicted one; shift, the change of the value in predicted standard deviations.
        """
        from pneuopt.quantities.frames import WideFrame

        found = fit.estimates
        check_names("parameter", self.table.index, [str(n) for n in found.index], "the fit's free parameters")
        rows = {}
        for name, row in self.table.iterrows():
            predicted, achieved = row["stderr_alone" if alone else "stderr_after"], float(found["stderr"][str(name)])
            value = float(found["value"][str(name)])
            rows[str(name)] = {
                "planned_value": row["value"],
                "value": value,
                "unit": row["unit"],
                "stderr_before": row["stderr_before"],
                "stderr_predicted": predicted,
                "stderr_achieved": achieved,
                "ratio": achieved / predicted,
                "shift": (value - row["value"]) / predicted,
            }
        return WideFrame.from_dict(rows, orient="index")

    def summary(self) -> Report:
        """The gain of the runs, intervals before and after, the limits that they touch, and what is played in words."""
        rows = []
        for name, row in self.table.iterrows():
            ends = [_join(row["before_low"], row["before_high"]), _join(row["after_low"], row["after_high"])]
            mark = "asked" if row["target"] else "" if row["identifiable"] else "unidentifiable"
            shrunk = format_number(row["narrower"], 3)
            rows.append((str(name), format_number(row["value"], 4), *ends, shrunk, str(row["unit"]), mark))
        heads = number_columns("value", "95 % now", "95 % after", "narrower")
        intervals = Table((*text_columns("parameter"), *heads, *text_columns("unit", "")), tuple(rows))
        figures = f"{self.stats['before']:.2g} to {self.stats['after']:.2g}"
        tried = f"{self.stats['tried']:.0f} excitations of {self.stats['plants']:.0f} plants"
        remarks = [f"{self.criterion}: relative standard deviation from {figures}; {tried} were tried"]
        if others := [n for n in self.unidentifiable if not self.table["target"][n]]:
            remarks.append(f"still unidentifiable: {join_names(others)}, which nobody has asked for")
        if self.active_limits:
            remarks.append(f"limits that are reached: {join_names(self.active_limits)}; wider ones would allow more")
        shown, steps = 8, list[Line]()
        start = write_value(self.stats["origin"], self.units[self.channel], 4)
        for k, blocks in enumerate(self.blocks, 1):
            lead = f"run {k}: " if len(self.blocks) > 1 else ""
            more = f"; and {len(blocks) - shown} more" if len(blocks) > shown else ""
            steps.append(Line(lead + "; ".join(blocks[:shown]) + more, indent=2))
        begin = Line(f"{self.channel} begins at {start}; about that, each block as long as the others:")
        return Report((self._verdict(), *(Line(r, indent=2) for r in remarks), intervals, begin, *steps))

    def _verdict(self, useful: float = 1.5) -> Line:
        """The ratio by which the targets' intervals shrink; below a `useful` one runs are hardly worth their time."""
        wanted = self.table[self.table["target"]]
        lost = [str(n) for n in wanted.index if n in self.unidentifiable]
        length = write_value(float(self.runs[0].t[-1] + self.runs[0].t[1]), "s", 3)
        lead = f"{len(self.runs)} runs of {length}" if len(self.runs) > 1 else f"a run of {length}"
        if lost:
            return Line(
                f"{lead} does not identify {join_names(lost)}, whatever is played within these limits", Tone.BAD
            )
        ratios = wanted["narrower"].dropna()
        if not len(ratios):
            worst = 100 * float((wanted["stderr_after"] / wanted["value"].abs()).max())
            return Line(
                f"{lead} gives {join_names(list(map(str, wanted.index)))} to {worst:.2g} % or better", Tone.GOOD
            )
        least, most = float(ratios.min()), float(ratios.max())
        many = f"{least:.1f} to {most:.1f} times" if most > 1.05 * least else f"{least:.1f} times"
        tone = Tone.GOOD if least >= useful else Tone.DOUBTFUL
        return Line(f"{lead} makes the asked intervals {many} narrower", tone)


def tabulate_design(
    parameters: ParameterSet, free: Sequence[str], targets: Sequence[str], known: Array, gained: Array
) -> "pd.DataFrame":
    """The table of an `ExperimentDesign` from the information of the logs in hand and of the planned runs."""
    from pneuopt.quantities.frames import WideFrame

    sizes = np.array([abs(parameters.value(n)) or 1.0 for n in free])
    spreads = [_deviations(f, sizes) for f in (known, known + gained, gained)]
    rows = {}
    for i, name in enumerate(free):
        p = parameters[name]
        before, after, alone = (float(s[i]) for s in spreads)
        ends = [confidence_interval(p.value, s, log=p.log) for s in (before, after)]
        rows[name] = {
            "value": p.value,
            "unit": p.unit,
            "target": name in targets,
            "stderr_before": before,
            "stderr_after": after,
            "stderr_alone": alone,
            **dict(zip(("before_low", "before_high", "after_low", "after_high"), (*ends[0], *ends[1]), strict=True)),
            "narrower": before / after,
            "identifiable": after <= UNIDENTIFIABLE_DEVIATION * sizes[i],
        }
    return WideFrame.from_dict(rows, orient="index")


def _deviations(information: Array, sizes: Array) -> Array:
    """Standard deviations by an information matrix, in the parameters' units; NaN where it tells nothing."""
    scaled = information * np.outer(sizes, sizes)
    values, vectors = np.linalg.eigh(scaled)
    informed = values > 1e-12 * max(float(values[-1]), 1e-300)
    if not informed.any():
        return np.full(len(sizes), np.nan)
    variance = (vectors[:, informed] ** 2 / values[informed]).sum(axis=1)
    lost = (vectors[:, ~informed] ** 2).sum(axis=1) > 1e-6
    return np.asarray(np.where(lost, np.nan, np.sqrt(variance)) * sizes)


def _join(low: float, high: float) -> str:
    """An interval with the digits that show a fiftieth of it."""
    if not math.isfinite(low):
        return "-"
    share = (high - low) / max(abs(low), abs(high))
    digits = min(12, max(3, 2 - math.floor(math.log10(share)))) if share > 0 else 5
    return f"{low:.{digits}g}{TIED}to {high:.{digits}g}"


class Criterion(Protocol):
    """The figure that a planned experiment is to make small."""

    @property
    def targets(self) -> tuple[str, ...]:
        """Names or shell patterns of the parameters; empty: all free ones."""
        ...

    def deviation(self, covariance: Array) -> Array:
        """The figure of covariances of the targets, each in units of its value; shape (..., k, k) -> (...)."""
        ...


class DOptimal:
    """The volume of the targets' joint confidence region: the geometric mean of its half axes.

    Parameters
    ----------
    *targets : str
        Names or shell patterns, "friction.*"; none: every free parameter.

    Examples
    --------
    >>> round(float(DOptimal().deviation(np.diag([0.01, 0.04]) ** 2)), 4)
    0.02
    """

    def __init__(self, *targets: str) -> None:
        self.targets = targets

    def __repr__(self) -> str:
        return f"DOptimal({', '.join(map(repr, self.targets))})"

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        sign, log = np.linalg.slogdet(covariance)
        return np.asarray(np.where(sign > 0, np.exp(log / (2 * covariance.shape[-1])), np.inf))


class AOptimal:
    """The root mean square of the targets' relative standard deviations: the worst-known ones count most.

    Parameters
    ----------
    *targets : str
        As for `DOptimal`.

    Examples
    --------
    >>> round(float(AOptimal().deviation(np.diag([0.01, 0.07]) ** 2)), 4)
    0.05
    """

    def __init__(self, *targets: str) -> None:
        self.targets = targets

    def __repr__(self) -> str:
        return f"AOptimal({', '.join(map(repr, self.targets))})"

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        variances = np.diagonal(covariance, axis1=-2, axis2=-1)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(np.mean(variances, axis=-1)))


@dataclass(frozen=True)
class Precision:
    """The relative standard deviation of one parameter, whatever becomes of the others.

    Parameters
    ----------
    parameter : str
    """

    parameter: str

    @property
    def targets(self) -> tuple[str, ...]:
        """The parameter."""
        return (self.parameter,)

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(covariance[..., 0, 0]))


class WantedPrecision:
    """Each target's relative standard deviation over the one that is wanted: nearly the largest of these ratios.

    At 1 or below, each parameter is known as well as is wanted; above, the one counts that is farthest from it.

    Parameters
    ----------
    wanted : mapping of str to float
        By the parameter's name its relative standard deviation [1].

    Raises
    ------
    InputError
        If one is not positive.

    Examples
    --------
    >>> wanted = WantedPrecision({"friction.coulomb": 0.01, "friction.viscous": 0.1})
    >>> round(float(wanted.deviation(np.diag([0.02, 0.02]) ** 2)), 2)
    2.0
    """

    def __init__(self, wanted: Mapping[str, float]) -> None:
        wrong = [n for n, size in wanted.items() if not 0 < size < math.inf]
        require(bool(wanted), "WantedPrecision: name a parameter and its relative standard deviation")
        require(not wrong, f"WantedPrecision: the standard deviation of {', '.join(wrong)} must be positive")
        self.wanted = dict(wanted)

    def __repr__(self) -> str:
        return f"WantedPrecision({self.wanted})"

    @property
    def targets(self) -> tuple[str, ...]:
        """The parameters."""
        return tuple(self.wanted)

    def deviation(self, covariance: Array) -> Array:
        """See `Criterion`."""
        with np.errstate(invalid="ignore"):
            ratios = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)) / np.array(list(self.wanted.values()))
            return np.asarray(np.sum(ratios**LARGEST, axis=-1) ** (1 / LARGEST))


def linked_information(grams: Array, ends: Array, jumps: Array, eliminated: int = 0) -> Array:
    """The information (m, k, k) of m logs' linked segments about parameters, as the estimates of `identify` have it.

    By each segment's Gram matrix and derivatives of its end about start state and parameters, in unit noise, and the
    deviations of the gaps; the first `eliminated` parameters are each log's own.
    """
    m, count, n, width = ends.shape
    gaps, follows = _gap_information(ends[:, :-1], 1 / jumps**2), list[Array]()
    found = grams[:, 0]
    for j in range(count - 1):
        ahead, response = _advance(found, gaps[:, j], n)
        follows.append(response)
        found = ahead + grams[:, j + 1]
    last = n + eliminated
    response = -_scaled_inverse(found[:, :last, :last], SINGULAR) @ found[:, :last, last:]
    bread = found[:, last:, last:] + np.swapaxes(found[:, :last, last:], 1, 2) @ response
    k = width - last
    parameters = np.concatenate([response[:, n:], np.broadcast_to(np.eye(k), (m, k, k))], axis=1)
    node, meat = response[:, :n], np.zeros((m, k, k))
    for j in reversed(range(count)):
        if j < count - 1:
            node = follows[j][:, :, :n] @ node + follows[j][:, :, n:] @ parameters
        moves = np.concatenate([node, parameters], axis=1)
        meat += np.swapaxes(moves, 1, 2) @ grams[:, j] @ moves
    return _symmetric(bread @ _scaled_inverse(meat, UNINFORMED) @ bread)


def _gap_information(ends: Array, weight: Array) -> Array:
    """The information of each gap about its two nodes' states and the parameters, shape (..., 2 n + w, 2 n + w).

    In nominal sizes: x_next = ends (x, p) + w, with w of variances 1 / `weight`, shape (n,).
    """
    n = len(weight)
    slopes = np.concatenate([ends[..., :n], np.broadcast_to(-np.eye(n), (*ends.shape[:-1], n)), ends[..., n:]], axis=-1)
    out = (np.swapaxes(slopes, -1, -2) * weight) @ slopes
    place = np.arange(n)
    out[..., place, place] += STATE_RIDGE
    return np.asarray(out)


def _advance(information: Array, gap: Array, n: int) -> tuple[Array, Array]:
    """The information about the next node's state and the parameters from that about this node's, shape (m, k, k).

    And how this node's state follows those, shape (m, n, k); `gap` is of `_gap_information`.
    """
    out, mixed = gap[:, n:, n:].copy(), gap[:, :n, n:].copy()
    out[:, n:, n:] += information[:, n:, n:]
    mixed[:, :, n:] += information[:, :n, n:]
    response = np.asarray(-np.linalg.solve(gap[:, :n, :n] + information[:, :n, :n], mixed), dtype=np.float64)
    return _symmetric(out + np.swapaxes(mixed, 1, 2) @ response), response


def _scaled_inverse(information: Array, smallest: float) -> Array:
    """The pseudoinverse of symmetric matrices of mixed units, shape (m, k, k)."""
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
    scale = size[:, :, None] * size[:, None, :]
    return np.asarray(np.linalg.pinv(information / scale, rcond=smallest, hermitian=True) / scale)


def _symmetric(values: Array) -> Array:
    return np.asarray((values + np.swapaxes(values, 1, 2)) / 2)
