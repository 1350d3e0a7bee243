"""What a tuned loop shall do, as types: each is an objective, a weighted term of one, or with `max` a limit.

Values are fractions of the step's size, seconds, or the command's unit: `Overshoot(max=0.05)` is 5 %.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pneuopt.errors import require

Value = TypeVar("Value", float, NDArray[np.float64])
PERCENT = ("Overshoot", "SteadyStateError")


@dataclass(frozen=True)
class SettlingTime:
    """Time after the step from which the response stays within the band around the reference [s].

    Parameters
    ----------
    band : float
        Half width, as a fraction of the step.
    max : float, optional
        [s]
    """

    band: float = 0.02
    max: float | None = None

    def __post_init__(self) -> None:
        require(0 < self.band < 1, f"SettlingTime: band is a fraction between 0 and 1, got {self.band}; 2 % is 0.02")
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class Overshoot:
    """How far the response passes the reference, as a fraction of the step.

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)
        require((self.max or 0) < 1, f"Overshoot: max is a fraction below 1, got {self.max}; 5 % is 0.05")


@dataclass(frozen=True)
class SteadyStateError:
    """Distance from the reference at the end of the horizon, as a fraction of the step.

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)
        require((self.max or 0) < 1, f"SteadyStateError: max is a fraction below 1, got {self.max}; 2 % is 0.02")


@dataclass(frozen=True)
class PeakControl:
    """Largest absolute command, dither included [the command's unit].

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class MaxSensitivity:
    """``Ms = max |1/(1 + L(jw))|``, the inverse of the Nyquist curve's distance from -1; 1.2 is careful, 2 is bold.

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 1.0)


Requirement = SettlingTime | Overshoot | SteadyStateError | PeakControl | MaxSensitivity


@dataclass(frozen=True, eq=False)
class Specification:
    """An objective and its limits, checked.

    Attributes
    ----------
    weights : mapping of Requirement to float
        The terms of the objective.
    limits : tuple of Requirement
        Each with its `max`; at most one of a kind, the tightest.
    band : float
        The settling band, the same wherever one is named; 2 % otherwise.
    """

    weights: Mapping[Requirement, float]
    limits: tuple[Requirement, ...]
    band: float

    def limit(self, kind: type) -> float:
        """The largest value allowed for this kind of requirement; inf where there is none."""
        return next((q.max for q in self.limits if isinstance(q, kind) and q.max is not None), inf)

    def weight(self, kind: type) -> float:
        """The weight of this kind of requirement in the objective; 0 where it is no term."""
        return next((w for q, w in self.weights.items() if isinstance(q, kind)), 0.0)

    def concerns(self, kind: type) -> bool:
        """Whether this kind of requirement is a term or a limit."""
        return self.weight(kind) > 0 or self.limit(kind) < inf

    def tightened(self, margin: float, peaks: float) -> "Specification":
        """Bands and fractions smaller by `margin`, a share; peak control and sensitivity by the share `peaks`.

        An optimum lies on its limits: found on tightened ones, it keeps those asked for when simulated and printed.
        """
        room = {"SettlingTime": 0.0, "PeakControl": peaks, "MaxSensitivity": peaks}
        limits = tuple(replace(q, max=(q.max or 0.0) * (1 - room.get(name(q), margin))) for q in self.limits)
        return replace(self, limits=limits, band=self.band * (1 - margin))

    def without(self, kind: type) -> "Specification":
        """The same without the limit of this kind, by copy."""
        return replace(self, limits=tuple(q for q in self.limits if not isinstance(q, kind)))

    def with_band(self, band: float) -> "Specification":
        """Another settling band, by copy."""
        return replace(self, band=band)

    def objective(self, values: Mapping[str, float]) -> float:
        """The weighted sum, of values by kind as `read` gives them."""
        return sum(weight * values[name(q)] for q, weight in self.weights.items())

    def violated(self, values: Mapping[str, float], slack: float = 0.0) -> tuple[Requirement, ...]:
        """The limits that `values` do not keep, NaN among them; `slack` is relative."""
        return tuple(q for q in self.limits if not values[name(q)] <= (q.max or 0.0) * (1 + slack))


def specify(
    minimise: Requirement | Mapping[Requirement, float], subject_to: Sequence[Requirement] = ()
) -> Specification:
    """Check an objective and its limits.

    Parameters
    ----------
    minimise : Requirement, or mapping of Requirement to weight
        A term with a `max` is a limit as well.
    subject_to : sequence of Requirement

    Raises
    ------
    InputError
        If a limit has no `max`, a weight is not positive, a kind is weighted twice, or the bands differ.

    Examples
    --------
    >>> spec = specify({SettlingTime(): 1.0, Overshoot(): 2.0}, [MaxSensitivity(1.6)])
    >>> spec.objective({"SettlingTime": 0.3, "Overshoot": 0.05, "MaxSensitivity": 1.5})
    0.4
    """
    weights = dict(minimise) if isinstance(minimise, Mapping) else {minimise: 1.0}
    require(len(weights) > 0, "minimise is empty: name at least one requirement, SettlingTime() say")
    for q in (*weights, *subject_to):
        require(isinstance(q, Requirement), f"{q!r} is no requirement; write {_types()}, as in Overshoot(max=0.05)")
    for q, weight in weights.items():
        require(0 < weight < inf, f"the weight of {name(q)} must be positive, got {weight:g}")
    for q in subject_to:
        require(q.max is not None, f"{name(q)} in subject_to has no limit; write {name(q)}(max=...)")
    terms = [name(q) for q in weights]
    require(len(set(terms)) == len(terms), f"minimise names a kind of requirement twice: {', '.join(terms)}")
    bands = {q.band for q in (*weights, *subject_to) if isinstance(q, SettlingTime)}
    require(len(bands) <= 1, f"settling bands differ: {sorted(bands)}; one band holds for the whole tuning")
    limits: dict[str, Requirement] = {}
    for q in (*weights, *subject_to):
        tightest = limits.get(name(q))
        if q.max is not None and (tightest is None or q.max < (tightest.max or inf)):
            limits[name(q)] = q
    return Specification(weights, tuple(limits.values()), next(iter(bands), 0.02))


def name(requirement: Requirement) -> str:
    """The metric that a requirement reads, a column of `evaluate`."""
    return type(requirement).__name__


def read(metrics: Mapping[str, Value]) -> dict[str, Value]:
    """The requirements' values from metrics, numbers or arrays: fractions where those are in percent."""
    kinds = [k.__name__ for k in Requirement.__args__]
    return {k: metrics[k] / (100 if k in PERCENT else 1) for k in kinds if k in metrics}


def _types() -> str:
    return ", ".join(k.__name__ for k in Requirement.__args__)


def _check_limit(requirement: Requirement, least: float) -> None:
    limit = requirement.max
    wrong = limit is not None and not least < limit < inf
    require(not wrong, f"{name(requirement)}: max must be above {least:g} and finite, got {limit}")
