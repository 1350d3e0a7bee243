"""`LogFinding`: one thing about a log, with the signals that show it; `StatedAxis`: what is known of the axis."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array, Mask

LARGE_SHARE = 0.1
"""Share of a signal's largest value [1] beyond which its sign counts: lower counts noise, higher misses reversals."""
VIEW_STROKES = 1.0
"""Strokes to either side of an instant that a figure shows: with fewer a wrong sign looks like a lag, more blur it."""
MIN_VIEW_SAMPLES = 25
"""Samples to either side of an instant that its figure shows: fewer look like noise."""


class StatedAxis(NamedTuple):
    """What is known of the axis that a log is of: a piston's channels unless a plant names its own (angle, torque).

    Attributes
    ----------
    push : str
        The force or torque that drives the axis, positive in the direction of positive speed.
    forces : mapping of str to float
        The force on the body per unit of each channel that pushes it; empty where a channel is not logged, or a factor
        is not known.
    constant : float
        The force that no channel gives, as of a weight; NaN where a free parameter stands in it.
    inertia : float
        As stated; NaN where it is free.
    offset_parameter : str
        The parameter that takes a constant force.
    stops : tuple of float
        Positions at which the model has end stops.
    """

    position: str = "position"
    speed: str = "speed"
    push: str = "force"
    forces: Mapping[str, float] = {"force": 1.0}
    constant: float = math.nan
    inertia: float = math.nan
    inertia_name: str = "mass"
    inertia_unit: str = "kg"
    force_unit: str = "N"
    offset_parameter: str = ""
    stops: tuple[float, ...] = ()

    def net_force(self, channels: Mapping[str, Array]) -> Array:
        """The force on the body without friction, from channels; the constant counts as zero where it is unknown."""
        total = sum((weight * channels[n] for n, weight in self.forces.items()), np.zeros(1))
        return np.asarray(total + (0.0 if math.isnan(self.constant) else self.constant))


PISTON = StatedAxis()


class Panel(NamedTuple):
    """Curves over one axis of a figure: by name, in one SI unit."""

    unit: str
    curves: Mapping[str, Array]


@dataclass(frozen=True)
class Evidence:
    """The signals that contradict each other, over time.

    Attributes
    ----------
    t : ndarray, shape (n,)
        [s]
    contradiction : ndarray of bool, shape (n,)
        Where they contradict each other.
    view : tuple of (float, float)
        Begin and end of the time [s] in which this is plainest.
    label : str
        What is seen where they contradict each other.
    """

    t: Array
    panels: tuple[Panel, ...]
    contradiction: Mask
    view: tuple[float, float]
    label: str = "they contradict each other"


class Severity(StrEnum):
    """What a finding means for a fit.

    Attributes
    ----------
    FAULT
        A fit refuses the logs.
    DOUBT
        A fit takes the logs, and its estimates may be wrong.
    NOTE
        It is worth knowing.
    """

    FAULT = "fault"
    DOUBT = "doubt"
    NOTE = "note"


@dataclass(frozen=True, eq=False)
class LogFinding:
    """One thing about a log.

    Attributes
    ----------
    message : str
        What is found, with figures, and the remedy.
    fault : bool
        The log cannot be used so; otherwise it is worth knowing.
    check : str
        The name of the check that found it, by which a user accepts it.
    log : str
        The log's name.
    evidence : Evidence, optional
        What `plotting.plot_finding` draws.
    severity : Severity
        Of all logs together; a log alone knows faults and notes.
    rows : (int, int), optional
        First and last row of the log's file that show it; none where the whole log does, or comes from no file.
    """

    channel: str
    message: str
    fault: bool
    check: str = ""
    log: str = ""
    evidence: Evidence | None = None
    severity: Severity = Severity.NOTE
    rows: tuple[int, int] | None = None


def evidence(
    experiment: Experiment,
    *channels: str | Panel,
    where: Mask | None = None,
    at: int | None = None,
    motion: Array | None = None,
    label: str = "they contradict each other",
) -> Evidence:
    """The evidence of a finding.

    Parameters
    ----------
    *channels : str or Panel
        Each in a panel of its own.
    where : ndarray of bool, optional
        Where they contradict each other; by default everywhere.
    at : int, optional
        The sample about which to look; by default all are seen.
    motion : ndarray, optional
        The speed, whose strokes say how much is to be seen.
    label : str
        What is seen there.
    """
    log = experiment.trajectory
    panels = [c if isinstance(c, Panel) else Panel(experiment.unit(c), {c: log[c]}) for c in channels if c]
    everywhere = np.ones(len(log), dtype=bool)
    view = (float(log.t[0]), float(log.t[-1])) if at is None else view_about(log.t, at, motion)
    return Evidence(log.t, tuple(panels), everywhere if where is None else where, view, label)


def is_opposed(a: Array, b: Array) -> Mask:
    """Where two signals have opposite signs, both beyond a tenth of their largest value."""
    return np.asarray(np.sign(a) * np.sign(b) < 0) & _is_large(a) & _is_large(b)


def _is_large(a: Array) -> Mask:
    return np.asarray(np.abs(a) > LARGE_SHARE * np.nanmax(np.abs(a), initial=0.0))


def view_about(t: Array, at: int, motion: Array | None = None) -> tuple[float, float]:
    """Begin and end of a few strokes of the motion about a sample [s]; of an eighth of the log without motion."""
    duration = float(t[-1] - t[0])
    half = duration / 16
    if motion is not None and np.isfinite(motion).any():
        level = LARGE_SHARE * float(np.nanmax(np.abs(motion)))
        side = np.sign(motion[np.abs(motion) > level])
        half = VIEW_STROKES * duration / (1 + int(np.count_nonzero(np.diff(side))))
    half = max(half, MIN_VIEW_SAMPLES * float(np.median(np.diff(t))))
    return max(float(t[0]), float(t[at]) - half), min(float(t[-1]), float(t[at]) + half)
