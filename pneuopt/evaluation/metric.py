"""`Metric`: a record for each figure of a loop, which requirements, searches, files and tables read; `Requirement`."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import inf
from numbers import Real
from typing import Any, ClassVar

import numpy as np

from pneuopt.evaluation.step_record import RowReader, StepRecord
from pneuopt.quantities.arguments import check_argument
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require


class Sense(Enum):
    """Direction of a limit on a metric; the value is the name of the field that holds it."""

    AT_MOST = "max"
    AT_LEAST = "min"


class Source(Enum):
    """The signal or model that a metric is computed from."""

    RESPONSE = "the measured signal from the step on"
    COMMAND = "the command from the step on"
    METER = "the plant's meter from the step on"
    LINEAR_LOOP = "the loop linearised about the end of the response"


@dataclass(frozen=True, eq=False)
class Metric:
    """Name, unit and source of a figure of a loop, and how a requirement on it is checked.

    Parameters
    ----------
    name : str
        The row of `evaluate`, and the class of the requirement, if there is one.
    unit : str
        Unit of a limit on it, SI; "1" for a pure number. "{command}" and "{measured}" stand for the loop's units.
    source : Source
    percent : bool
        Whether tables show the metric in percent; a limit on it is a fraction all the same.
    sense : Sense
    limits : (float, float)
        A limit must lie between these, both excluded.
    advice : str
        Remedy that is added to the message about a limit outside them.
    floor : float
        Smaller values count as this one in an objective.
    resolution : float
        Difference on the scale of `requirement_value` below which two simulations agree, whatever the value: a share of
        a measured signal that no instrument shows, and more than the rounding of an integration.
    cost : callable, optional
        Maps the metric to a value that shall be small; needed where the metric itself shall be large.
    headline : bool
        Whether every table of a tuning shows it, even where no requirement names it.
    slope : callable, optional
        Maps a `StepRecord` to rows and their derivatives, shapes (m, R) and (m, R, N); the metric is the largest row,
        as a fraction where it is shown in percent. A gradient search cannot use a metric without one.
    channels : tuple of str
        Channels of the plant's meter that it needs.
    exact : bool
        Whether `TwoPhase` has an equation for it.
    shown : bool
        Whether the screen shows it and a study may ask for it.
    positions : bool
        Whether it says something of a loop on a position only, so that the screen shows it of no other.

    Raises
    ------
    InputError
        If its name or its unit is missing.
    """

    name: str
    unit: str
    source: Source
    percent: bool = False
    sense: Sense = Sense.AT_MOST
    limits: tuple[float, float] = (0.0, inf)
    advice: str = ""
    floor: float = -inf
    resolution: float = 1e-6
    cost: Callable[[Any], Any] | None = None
    headline: bool = False
    slope: RowReader | None = None
    channels: tuple[str, ...] = ()
    exact: bool = False
    shown: bool = True
    positions: bool = False

    def __post_init__(self) -> None:
        require(bool(self.name), f"a metric needs a name, the one in {self.unit!r} has none")
        require(bool(self.unit), f"{self.name}: a metric needs a unit; for a pure number write '1'")

    def unit_in(self, command: str, measured: str) -> str:
        """Unit of a limit in a loop, given the units of its command and its measured signal."""
        return self.unit.format(command=command, measured=measured)

    def shown_unit(self, command: str, measured: str) -> str:
        """Unit of the metric in a table, "%" or "l(ANR)" for example; empty for a pure number."""
        unit = self.unit_in(command, measured)
        return "%" if self.percent else "" if unit == "1" else unit

    @property
    def factor(self) -> float:
        """Ratio of the metric to its limit's scale: 100 for a metric in percent, whose limit is a fraction, else 1."""
        return 100 if self.percent else 1

    def largest(self, record: StepRecord) -> Array:
        """Metric of each response, the largest of its rows, shape (m,), in the unit that `evaluate` shows."""
        assert self.slope is not None
        return np.asarray(self.factor * np.maximum(self.floor, self.slope(record)[0].max(axis=1)))

    def requirement_value(self, metric: Any) -> Any:
        """Value that shall be small, from a metric or an array of them: percent as a fraction, a margin as 1/margin."""
        with np.errstate(divide="ignore"):
            return metric / self.factor if self.cost is None else self.cost(metric)

    def check_limit(self, limit: float | None) -> None:
        """Refuse a limit that no loop can keep, or that every loop keeps.

        Raises
        ------
        InputError
        """
        if limit is None:
            return
        check_argument(f"{self.name}: {self.sense.value}", limit, Real, "a number, as 0.05 for 5 %")
        (least, most), unit = self.limits, "" if self.unit == "1" or "{" in self.unit else f" {self.unit}"
        room = f"above {least:g}{unit}" + (" and finite" if most == inf else f" and below {most:g}, a fraction")
        message = f"{self.name}: {self.sense.value} must be {room}, got {limit}"
        require(least < limit < most, f"{message}; {self.advice}" if self.advice else message)


class Requirement:
    """A requirement on a loop: an objective, a weighted term of one, or, with a bound, a limit; a class each metric."""

    metric: ClassVar[Metric]

    def __post_init__(self) -> None:
        self.metric.check_limit(getattr(self, self.metric.sense.value))


@dataclass(frozen=True)
class AtMost(Requirement):
    """A metric that shall be small.

    Parameters
    ----------
    max : float, optional
        The largest allowed value, in the metric's unit, a fraction where the metric counts in percent.
    """

    max: float | None = None


@dataclass(frozen=True)
class AtLeast(Requirement):
    """A metric that shall be large; as a term its reciprocal is minimised.

    Parameters
    ----------
    min : float, optional
        The smallest allowed value, in the metric's unit.
    """

    min: float | None = None
