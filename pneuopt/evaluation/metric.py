"""`Metric`: one record a figure of a loop, which requirements, searches, files and screen read; and what limits one."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Any, ClassVar

import numpy as np

from pneuopt.evaluation.step_record import RowReader, StepRecord
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require


class Sense(Enum):
    """Which side of a metric a limit stands on; the value is the name of the limit."""

    AT_MOST = "max"
    AT_LEAST = "min"


class Source(Enum):
    """What a metric is read from."""

    RESPONSE = "the measured signal from the step on"
    COMMAND = "the command from the step on"
    METER = "the plant's meter from the step on"
    LINEAR_LOOP = "the loop linearised about the end of the response"


@dataclass(frozen=True, eq=False)
class Metric:
    """What a figure of a loop is called, counted in, read from, and how a requirement on it counts.

    Parameters
    ----------
    name : str
        The row of `evaluate`, and the class of the requirement, if there is one.
    unit : str
        SI, of a limit on it; "1": a number alone. "{command}" and "{measured}" stand for the loop's own units.
    source : Source
    percent : bool
        The metric counts in percent, a limit is a fraction.
    sense : Sense
    limits : (float, float)
        Between which a limit has to be, both excluded.
    advice : str
        What the message about a limit that is not between them adds.
    floor : float
        The smallest value that counts in an objective.
    cost : callable, optional
        Metrics to values that shall be small, where they are no values that shall be small already.
    headline : bool
        It stands in every table of a tuning, whatever was asked for.
    slope : callable, optional
        Of a `StepRecord`: rows and their derivatives, shapes (m, R) and (m, R, N), of which the metric is the largest,
        a fraction where it counts in percent; without one no gradient search knows the metric.
    channels : tuple of str
        Of the plant's meter, that it is read from.
    exact : bool
        `TwoPhase` has an equation for it.
    shown : bool
        It stands on the screen and may be asked for in a study.

    Raises
    ------
    InputError
        If it has no name or no unit.
    """

    name: str
    unit: str
    source: Source
    percent: bool = False
    sense: Sense = Sense.AT_MOST
    limits: tuple[float, float] = (0.0, inf)
    advice: str = ""
    floor: float = -inf
    cost: Callable[[Any], Any] | None = None
    headline: bool = False
    slope: RowReader | None = None
    channels: tuple[str, ...] = ()
    exact: bool = False
    shown: bool = True

    def __post_init__(self) -> None:
        require(bool(self.name), f"a metric needs a name, the one in {self.unit!r} has none")
        require(bool(self.unit), f"{self.name}: a metric needs a unit; of a number alone it is '1'")

    def unit_in(self, command: str, measured: str) -> str:
        """The unit of a limit, in a loop whose command and measured signal have these."""
        return self.unit.format(command=command, measured=measured)

    def shown_unit(self, command: str, measured: str) -> str:
        """The unit of the metric in a table, "%" or "l(ANR)" say; empty for a number alone."""
        unit = self.unit_in(command, measured)
        return "%" if self.percent else "" if unit == "1" else unit

    @property
    def factor(self) -> float:
        """The metric over the fraction that a limit is: 100 where it counts in percent, else 1."""
        return 100 if self.percent else 1

    def largest(self, record: StepRecord) -> Array:
        """The metric of each response, the largest of its rows, shape (m,), in the unit of `evaluate`."""
        assert self.slope is not None
        return np.asarray(self.factor * np.maximum(self.floor, self.slope(record)[0].max(axis=1)))

    def requirement_value(self, metric: Any) -> Any:
        """What shall be small, of a number or an array: a fraction of a percentage, a margin's reciprocal."""
        with np.errstate(divide="ignore"):
            return metric / self.factor if self.cost is None else self.cost(metric)

    def check_limit(self, limit: float | None) -> None:
        """Refuse a limit that no loop can keep, or that every loop keeps.

        Raises
        ------
        InputError
        """
        (least, most), unit = self.limits, "" if self.unit == "1" or "{" in self.unit else f" {self.unit}"
        room = f"above {least:g}{unit}" + (" and finite" if most == inf else f" and below {most:g}, a fraction")
        message = f"{self.name}: {self.sense.value} must be {room}, got {limit}"
        require(limit is None or least < limit < most, f"{message}; {self.advice}" if self.advice else message)


class Requirement:
    """What a loop shall do: an objective, a weighted term of one, or with a bound a limit; a class for each metric."""

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
