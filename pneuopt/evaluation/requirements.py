"""What a tuned loop shall do, as types: each is an objective, a weighted term of one, or with a bound a limit.

Values are fractions of the step's size, seconds, or the command's unit: `Overshoot(max=0.05)` is 5 %. Margins and the
like are those of the loop linearised about the state in which the response ends, the moving reference: friction counts
with its slope at that speed. A gain or phase margin has a `min`; as a term its reciprocal is minimised.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf
from typing import Any, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from pneuopt.quantities.errors import require

Value = TypeVar("Value", float, NDArray[np.float64])
PERCENT_METRICS = ("Overshoot", "SteadyStateError")
EnvelopeBounds = tuple[tuple[float, float, float], ...]


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
class RiseTime:
    """Time from 10 to 90 % of the change to the final value [s].

    Parameters
    ----------
    max : float, optional
        [s]
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class Ripple:
    """Peak to peak of the signal, not averaged, over the last dither periods or 5 % of the record [measured unit].

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class IAE:
    """Integral of the error's size from the step to the end of the horizon, over the step's size [s].

    Parameters
    ----------
    max : float, optional
        [s]
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class ISE:
    """Integral of the squared error likewise, over the square of the step's size [s].

    Parameters
    ----------
    max : float, optional
        [s]
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class ITAE:
    """Integral of the error's size times the time since the step, over the step's size [s^2].

    Parameters
    ----------
    max : float, optional
        [s^2]
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class StepEnvelope:
    """The response between bounds that vary over time: distance from their middle over their half width, the largest.

    Parameters
    ----------
    bounds : tuple of (float, float, float)
        Instants after the step [s], in order, each with the lower and upper bound that hold from then to the next, as
        fractions of the step: 0 is where it begins, 1 the reference.
    max : float or None
        1: the bounds are kept; None: a term only.

    Examples
    --------
    >>> tube = StepEnvelope(((0.0, -0.1, 1.1), (0.5, 0.95, 1.05)))
    """

    bounds: EnvelopeBounds
    max: float | None = 1.0

    def __post_init__(self) -> None:
        times = [t for t, _, _ in self.bounds]
        ordered = len(times) > 0 and times[0] >= 0 and all(a < b for a, b in pairwise(times))
        require(ordered, f"StepEnvelope: times count from the step and increase, got {times}")
        for t, lower, upper in self.bounds:
            proper = -inf < lower < upper < inf
            require(proper, f"StepEnvelope: at {t:g} s the bounds must be finite and in order, got {lower}, {upper}")
        _check_limit(self, 0.0)


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
class ControlRate:
    """Largest change of the command over time, dither included, the jump at the step left out [its unit/s].

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class AirUse:
    """What a pneumatic drive draws from its supply, from the step to the end of the horizon [l(ANR), ISO 8778].

    Parameters
    ----------
    max : float, optional
        [l(ANR)]
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


@dataclass(frozen=True)
class MaxComplementarySensitivity:
    """``Mt = max |L(jw)/(1 + L(jw))|``, the closed loop's resonance peak.

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


@dataclass(frozen=True)
class GainMargin:
    """Factor on the loop's gain, up or down, that makes it oscillate; at least 2 is usual.

    Parameters
    ----------
    min : float, optional
    """

    min: float | None = None

    def __post_init__(self) -> None:
        least = self.min
        require(least is None or 1 < least < inf, f"GainMargin: min is a factor above 1, got {least}; 2 is usual")


@dataclass(frozen=True)
class PhaseMargin:
    """Phase by which the loop at gain one stays clear of -180 deg [deg].

    Parameters
    ----------
    min : float, optional
        [deg]
    """

    min: float | None = None

    def __post_init__(self) -> None:
        least = self.min
        require(least is None or 0 < least < inf, f"PhaseMargin: min is an angle above 0 deg, got {least}; 45 is usual")


@dataclass(frozen=True)
class NoiseGain:
    """``max |C(jw)/(1 + L(jw))|``, from measurement noise to the command [its unit/measured unit]; see `noise_gain`.

    Parameters
    ----------
    max : float, optional
    """

    max: float | None = None

    def __post_init__(self) -> None:
        _check_limit(self, 0.0)


Robustness = MaxSensitivity | MaxComplementarySensitivity | GainMargin | PhaseMargin | NoiseGain
Requirement = (
    SettlingTime
    | RiseTime
    | Overshoot
    | SteadyStateError
    | Ripple
    | IAE
    | ISE
    | ITAE
    | StepEnvelope
    | PeakControl
    | ControlRate
    | AirUse
    | Robustness
)
ROBUSTNESS_REQUIREMENTS = (MaxSensitivity, MaxComplementarySensitivity, GainMargin, PhaseMargin, NoiseGain)
MINIMUM_REQUIREMENTS = (GainMargin, PhaseMargin)
REQUIREMENT_KINDS: tuple[type[Requirement], ...] = get_args(Requirement)


def upper_limit(requirement: Requirement) -> float:
    """The largest allowed value of `requirement_values`: a margin's is the reciprocal of its `min`; inf without."""
    if isinstance(requirement, MINIMUM_REQUIREMENTS):
        return inf if requirement.min is None else 1 / requirement.min
    return inf if requirement.max is None else requirement.max


def describe_value(requirement: Requirement, value: float) -> tuple[str, str]:
    """A value as `requirement_values` gives it, and what is allowed, as the user writes them: ("1.8", "at least 2").

    Examples
    --------
    >>> told(GainMargin(min=2.0), 1 / 1.8), told(Overshoot(max=0.05), 0.06)
    (('1.8', 'at least 2'), ('0.06', 'allowed 0.05'))
    """
    limit = (
        f"at least {requirement.min:.6g}"
        if isinstance(requirement, MINIMUM_REQUIREMENTS)
        else f"allowed {requirement.max:.6g}"
    )
    return f"{user_value(requirement, value):.6g}", limit


def user_value(requirement: Requirement, value: float) -> float:
    """A value as `requirement_values` gives it, as the user writes it: a margin itself."""
    if isinstance(requirement, MINIMUM_REQUIREMENTS):
        return 1 / value if value else inf
    return value


def user_limit(requirement: Requirement) -> float | None:
    """The limit as the user writes it, `max` or `min`."""
    return requirement.min if isinstance(requirement, MINIMUM_REQUIREMENTS) else requirement.max


def with_user_limit(requirement: Requirement, limit: float | None) -> Requirement:
    """The same with another limit, as the user writes it, `max` or `min`, by copy."""
    key: dict[str, Any] = {"min" if isinstance(requirement, MINIMUM_REQUIREMENTS) else "max": limit}
    return replace(requirement, **key)


def metric_name(requirement: Requirement) -> str:
    """The metric that a requirement reads, a column of `evaluate`."""
    return type(requirement).__name__


def requirement_values(metrics: Mapping[str, Value]) -> dict[str, Value]:
    """The requirements' values from metrics, numbers or arrays, all of which shall be small.

    Fractions where metrics are in percent; a margin's reciprocal, of a gain margin below one the margin itself.
    """
    return {k.__name__: _requirement_value(k, metrics[k.__name__]) for k in REQUIREMENT_KINDS if k.__name__ in metrics}


def _requirement_value(kind: type, metric: Value) -> Value:
    with np.errstate(divide="ignore"):
        if kind is GainMargin:
            return np.exp(-np.abs(np.log(metric)))  # type: ignore[no-any-return]
        if kind is PhaseMargin:
            return np.divide(1.0, np.abs(metric))  # type: ignore[no-any-return]
    return metric / (100 if kind.__name__ in PERCENT_METRICS else 1)


def _check_limit(requirement: Requirement, least: float) -> None:
    limit = getattr(requirement, "max", None)
    wrong = limit is not None and not least < limit < inf
    require(not wrong, f"{metric_name(requirement)}: max must be above {least:g} and finite, got {limit}")
