"""Requirements on a tuned loop, a class each: an objective, a weighted term of one, or, with a bound, a limit.

Values are fractions of the step's size, seconds, or the command's unit: `Overshoot(max=0.05)` is 5 %. Margins,
sensitivities and the noise gain are those of the loop linearised about the state in which the response ends; in a speed
loop that state moves, and friction counts with its slope at that speed. A gain or phase margin has a `min`; as a term
its reciprocal is minimised. Distances on a positioning axis are in the measured unit, whatever the step.

A new requirement is a class with its `Metric`, and a row of `REQUIREMENT_KINDS`. The rows that it reads off a response
stand first, the scales of values and limits last.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import inf
from typing import Any, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.metric import (
    AtLeast,
    AtMost,
    Band,
    Metric,
    Sense,
    Source,
    StepRecord,
    Tolerance,
    ValuesAndSlopes,
    control_rate_rows,
    envelope_rows,
    iae_rows,
    ise_rows,
    itae_rows,
    overshoot_rows,
    peak_control_rows,
    steady_state_rows,
    trapezoidal_weights,
    without_slopes,
)
from pneuopt.evaluation.metric import Requirement as Requirement  # noqa: PLC0414 - who names a kind reads it here
from pneuopt.evaluation.tolerances import NO_OVERSHOOT
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import ANR_DENSITY

PUSH = "load.force"  # the disturbance against which a loop is stiff
AIR_CHANNEL, POWER_CHANNEL = "air", "power"  # of a meter: mass flow from the supply [kg/s], power from the source [W]
FOLLOWING_METRICS = frozenset({"FollowingError", "FollowingErrorRMS"})  # they need the reference at every instant


def overshoot_distance_rows(record: StepRecord) -> ValuesAndSlopes:
    """The distance beyond the reference's end; under a disturbance alone on either side."""
    values, slopes = overshoot_rows(record)
    return abs(record.size) * values, abs(record.size) * slopes


def following_error_rows(record: StepRecord) -> ValuesAndSlopes:
    """The distance from the reference at that instant, a row each side."""
    error, slopes = _following_error(record)
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def following_rms_rows(record: StepRecord) -> ValuesAndSlopes:
    """The root of the mean square of the distance from the reference."""
    (error, slopes), weights = _following_error(record), trapezoidal_weights(record.nodes)
    weights = weights / weights.sum()
    root = np.sqrt(np.einsum("k,mk->m", weights, error**2))
    by_unknown = np.einsum("mk,mkn->mn", weights * error, slopes) / np.maximum(root, 1e-300)[:, None]
    return root[:, None], by_unknown[:, None]


def compliance_rows(record: StepRecord) -> ValuesAndSlopes:
    """The distance from the reference, either side, over the force that pushes; zero where none does."""
    error, slopes = record.error
    share = abs(record.size / record.push) if record.push else 0.0
    return share * np.concatenate([error, -error], axis=1), share * np.concatenate([slopes, -slopes], axis=1)


def _following_error(record: StepRecord) -> ValuesAndSlopes:
    """Signal less reference at the nodes [measured unit]."""
    error, slopes = record.error
    wanted = 0.0 if record.wanted is None else record.wanted
    return record.size * (error - wanted), record.size * slopes


def energy_rows(record: StepRecord) -> ValuesAndSlopes:
    """Integral of the power from the step to the end of the record [J]."""
    return record.integrate_meter(POWER_CHANNEL)


def air_rows(record: StepRecord) -> ValuesAndSlopes:
    """Volume of the air that is drawn from the step to the end of the record [l(ANR)].

    Examples
    --------
    A gram a second for two seconds:

    >>> import numpy as np
    >>> from pneuopt.evaluation.metrics import meter_record
    >>> run = meter_record(np.array([0.0, 1.0, 2.0]), {"air": np.full((1, 3), 1e-3)}, 0.0)
    >>> round(air_rows(run)[0].item(), 4)
    1.6878
    """
    mass, slopes = record.integrate_meter(AIR_CHANNEL)
    factor = 1e3 / ANR_DENSITY  # [l/kg]
    return factor * mass, factor * slopes


def travel_rows(record: StepRecord) -> ValuesAndSlopes:
    """Distance that the spool travels in both directions together."""
    spool, _ = record.meter["spool"]
    return without_slopes(np.abs(np.diff(spool, axis=1)).sum(axis=1)[:, None])


@final
class OvershootDistance(AtMost):
    """Distance of the response beyond the reference's end [measured unit]; under a disturbance alone, either side.

    Parameters
    ----------
    max : float, optional
        [measured unit]
    """

    metric = Metric(
        "OvershootDistance",
        "{measured}",
        Source.RESPONSE,
        floor=0.0,
        resolution=1e-8,
        slope=overshoot_distance_rows,
        positions=True,
    )


@final
class FollowingError(AtMost):
    """Largest distance from the reference at any instant [measured unit]; of a step it is the step at least.

    Parameters
    ----------
    max : float, optional
        [measured unit]
    """

    metric = Metric(
        "FollowingError", "{measured}", Source.RESPONSE, resolution=1e-8, slope=following_error_rows, positions=True
    )


@final
class FollowingErrorRMS(AtMost):
    """Root of the mean square distance from the reference, from its beginning to the horizon [measured unit].

    Parameters
    ----------
    max : float, optional
        [measured unit]
    """

    metric = Metric(
        "FollowingErrorRMS", "{measured}", Source.RESPONSE, resolution=1e-8, slope=following_rms_rows, positions=True
    )


@final
class Compliance(AtMost):
    """Largest deviation over the load force that steps, as ``Step(0.0, ..., disturbance={"load.force": 50.0})`` has it.

    Its reciprocal is the dynamic stiffness. References without that disturbance have none: 0.

    Parameters
    ----------
    max : float, optional
        [measured unit/N]
    """

    metric = Metric(
        "Compliance", "{measured}/N", Source.RESPONSE, resolution=1e-10, slope=compliance_rows, positions=True
    )


@final
class EnergyUse(AtMost):
    """Energy that the plant draws from its source, from the step to the end of the horizon [J].

    Which power counts is what the plant's meter shows. Of a pneumatic drive it is the air power: the work that the air
    drawn could do in an isothermal expansion from supply to ambient pressure. An ideal gas of mass m with p V = m R T
    does ``integral of p dV = m R T ln(p_s/p_o)`` on that way, which is p_s V ln(p_s/p_o) for its volume V at the
    supply's state, both pressures absolute; at ambient temperature it is the exergy of the compressed air. A compressor
    takes more by its own losses. Of an axis pushed by a force it is the motor's mechanical power where the motor
    drives, ``max(F v, 0)``: braking power goes into the brake resistor and counts nothing, as in drives that cannot
    feed back.

    Parameters
    ----------
    max : float, optional
        [J]

    References
    ----------
    M. J. Moran, H. N. Shapiro: Fundamentals of Engineering Thermodynamics, Wiley: work of an ideal gas at constant
    temperature, and flow exergy.
    """

    metric = Metric("EnergyUse", "J", Source.METER, slope=energy_rows, channels=(POWER_CHANNEL,))


Value = TypeVar("Value", float, NDArray[np.float64])
EnvelopeBounds = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class SettlingTime(Requirement):
    """Time after the step from which the response stays within the band around the reference [s].

    Under a dither it is that of the mean over the dither's period. Where `tune` chooses the dither's amplitude itself,
    the signal with its ripple has to settle as well, and its time is minimised (`SettlingTimeRaw`): a dither that
    shakes the signal out of the band gains nothing.

    Parameters
    ----------
    band : float or Tolerance
        Half width, as a fraction of the step, or in the measured unit: ``Tolerance(1e-4)`` is 0.1 mm of a position.
    max : float, optional
        [s]
    mean : bool, optional
        True: the mean alone counts, whatever is tuned.
    """

    metric = Metric("SettlingTime", "s", Source.RESPONSE, headline=True, exact=True)
    band: Band = 0.02
    max: float | None = None
    mean: bool | None = None

    def __post_init__(self) -> None:
        proper = isinstance(self.band, Tolerance) or 0 < self.band < 1
        message = f"{type(self).__name__}: band is a fraction between 0 and 1, got {self.band}; 2 % is 0.02"
        require(proper, f"{message}, 0.1 mm is Tolerance(1e-4)")
        object.__setattr__(self, "mean", self.mean or None)  # false asks for nothing
        super().__post_init__()


@final
class SettlingTimeRaw(SettlingTime):
    """Time from which the signal itself stays within the band, a dither's ripple included [s].

    Parameters
    ----------
    band : float or Tolerance
        As that of `SettlingTime`.
    max : float, optional
        [s]
    """

    metric = Metric("SettlingTimeRaw", "s", Source.RESPONSE)


@final
class RiseTime(AtMost):
    """Time from 10 to 90 % of the step [s]; a response that never reaches 90 % of the reference has none."""

    metric = Metric("RiseTime", "s", Source.RESPONSE)


_share_of_step = partial(
    Metric,
    unit="1",
    source=Source.RESPONSE,
    percent=True,
    limits=(0.0, 1.0),
    floor=0.0,
    resolution=1e-5,
    headline=True,
    exact=True,
)


@final
class Overshoot(AtMost):
    """Distance of the response beyond the reference, as a fraction of the step; a `max` of 0 stands for 0.01 %."""

    metric = _share_of_step("Overshoot", advice="5 % is 0.05", slope=overshoot_rows)

    def __post_init__(self) -> None:
        if self.max == 0:
            object.__setattr__(self, "max", NO_OVERSHOOT)
        super().__post_init__()


@final
class SteadyStateError(AtMost):
    """Distance from the reference at the end of the horizon, as a fraction of the step."""

    metric = _share_of_step("SteadyStateError", advice="2 % is 0.02", slope=steady_state_rows)


@final
@dataclass(frozen=True)
class StepEnvelope(Requirement):
    """Bounds on the response that vary over time: the largest distance from their middle over their half width.

    Parameters
    ----------
    bounds : tuple of (float, float, float)
        Instants after the step [s], in order, each with the lower and upper bound that hold from then to the next, as
        fractions of the step: 0 is where it begins, 1 the reference.
    max : float or None
        1 keeps the response within the bounds; None makes it a term of the objective only.

    Examples
    --------
    >>> tube = StepEnvelope(((0.0, -0.1, 1.1), (0.5, 0.95, 1.05)))
    """

    metric = Metric("StepEnvelope", "1", Source.RESPONSE, slope=envelope_rows)
    bounds: EnvelopeBounds
    max: float | None = 1.0

    def __post_init__(self) -> None:
        times = [t for t, _, _ in self.bounds]
        ordered = len(times) > 0 and times[0] >= 0 and all(a < b for a, b in pairwise(times))
        require(ordered, f"StepEnvelope: times count from the step and increase, got {times}")
        for t, lower, upper in self.bounds:
            proper = -inf < lower < upper < inf
            require(proper, f"StepEnvelope: at {t:g} s the bounds must be finite and in order, got {lower}, {upper}")
        super().__post_init__()


@final
class IAE(AtMost):
    """Integral of the absolute error from the step to the end of the horizon, over the step's size [s]."""

    metric = Metric("IAE", "s", Source.RESPONSE, resolution=1e-7, slope=iae_rows)


@final
class ISE(AtMost):
    """Integral of the squared error from the step to the end of the horizon, over the square of the step's size [s]."""

    metric = Metric("ISE", "s", Source.RESPONSE, resolution=1e-7, slope=ise_rows)


@final
class ITAE(AtMost):
    """Integral of the absolute error times the time since the step, over the step's size [s^2]."""

    metric = Metric("ITAE", "s^2", Source.RESPONSE, resolution=1e-8, slope=itae_rows)


@final
class PeakControl(AtMost):
    """Largest absolute command, dither included [the command's unit]."""

    metric = Metric("PeakControl", "{command}", Source.COMMAND, headline=True, slope=peak_control_rows, exact=True)


@final
class ControlRate(AtMost):
    """Largest rate of change of the command, dither included, without the jump at the step [its unit/s]."""

    metric = Metric("ControlRate", "{command}/s", Source.COMMAND, slope=control_rate_rows)


@final
class Ripple(AtMost):
    """Peak to peak of the raw signal over the last 5 % of the record, or of a dither's ripple if larger [its unit]."""

    metric = Metric("Ripple", "{measured}", Source.RESPONSE, resolution=1e-8)


@final
class AirUse(AtMost):
    """Air consumption of a pneumatic drive from the step to the end of the horizon [l(ANR), ISO 8778]."""

    metric = Metric("AirUse", "l(ANR)", Source.METER, slope=air_rows, channels=(AIR_CHANNEL,))


@final
class MaxSensitivity(AtMost):
    """``Ms = max |1/(1 + L(jw))|``, the reciprocal of the Nyquist curve's distance from -1; 1.2 is cautious, 2 bold."""

    metric = Metric("MaxSensitivity", "1", Source.LINEAR_LOOP, limits=(1.0, inf), headline=True, exact=True)


@final
class MaxComplementarySensitivity(AtMost):
    """``Mt = max |L(jw)/(1 + L(jw))|``, the closed loop's resonance peak."""

    metric = Metric("MaxComplementarySensitivity", "1", Source.LINEAR_LOOP)


@final
class GainMargin(AtLeast):
    """Factor on the loop's gain, up or down, at which the loop oscillates; at least 2 is usual."""

    metric = Metric(
        "GainMargin",
        "1",
        Source.LINEAR_LOOP,
        sense=Sense.AT_LEAST,
        limits=(1.0, inf),
        advice="it is a factor, 2 is usual",
        cost=lambda margin: np.exp(-np.abs(np.log(margin))),
    )


@final
class PhaseMargin(AtLeast):
    """Distance of the open loop's phase from -180 deg where its gain is one [deg]."""

    metric = Metric(
        "PhaseMargin",
        "deg",
        Source.LINEAR_LOOP,
        sense=Sense.AT_LEAST,
        advice="45 is usual",
        cost=lambda margin: np.divide(1.0, np.abs(margin)),
    )


@final
class NoiseGain(AtMost):
    """``max |C(jw)/(1 + L(jw))|``, the gain from measurement noise to the command [its unit/measured unit].

    It counts from 0.3 rad over the horizon on: slower noise is a drift of the sensor.
    """

    metric = Metric("NoiseGain", "{command}/({measured})", Source.LINEAR_LOOP)


REQUIREMENT_KINDS: tuple[type[Requirement], ...] = (
    SettlingTime,
    SettlingTimeRaw,
    RiseTime,
    Overshoot,
    OvershootDistance,
    SteadyStateError,
    FollowingError,
    FollowingErrorRMS,
    Compliance,
    StepEnvelope,
    IAE,
    ISE,
    ITAE,
    PeakControl,
    ControlRate,
    Ripple,
    AirUse,
    EnergyUse,
    MaxSensitivity,
    MaxComplementarySensitivity,
    GainMargin,
    PhaseMargin,
    NoiseGain,
)
"""Every kind of requirement, a row each, in the order of the tables."""

ROBUSTNESS_REQUIREMENTS = tuple(kind for kind in REQUIREMENT_KINDS if kind.metric.source is Source.LINEAR_LOOP)


_REPORTED_METRICS = (
    Metric("LimitCycleAmplitude", "{measured}", Source.RESPONSE),
    Metric("LimitCycleFrequency", "Hz", Source.RESPONSE),
    Metric("StickShare", "1", Source.RESPONSE),
    Metric("ValveTravel", "half travels", Source.METER, slope=travel_rows, channels=("spool",)),
    Metric("FrictionSlope", "N*s/m", Source.LINEAR_LOOP),
    Metric("SettlingMin", "{measured}", Source.RESPONSE, shown=False),
    Metric("SettlingMax", "{measured}", Source.RESPONSE, shown=False),
    Metric("OvershootFinal", "1", Source.RESPONSE, percent=True, shown=False),
    Metric("Undershoot", "1", Source.RESPONSE, percent=True, shown=False),
    Metric("Peak", "{measured}", Source.RESPONSE, shown=False),
    Metric("PeakTime", "s", Source.RESPONSE, shown=False),
    Metric("SteadyStateValue", "{measured}", Source.RESPONSE, shown=False),
)
METRICS: Mapping[str, Metric] = {
    metric.name: metric
    for source in Source
    for metric in (*(kind.metric for kind in REQUIREMENT_KINDS), *_REPORTED_METRICS)
    if metric.source is source
}
"""Every metric by name, grouped by source: those that a requirement may limit, and those that are reported only."""


def upper_limit(requirement: Requirement) -> float:
    """Largest allowed value, on the scale of `requirement_values`: 1/min of a margin; inf without a limit."""
    limit = user_limit(requirement)
    if limit is None:
        return inf
    return 1 / limit if requirement.metric.sense is Sense.AT_LEAST else limit


def describe_value(requirement: Requirement, value: float) -> tuple[str, str]:
    """A value of `requirement_values` and its limit, written as the user writes them: ("1.8", "at least 2")."""
    words = "at least" if requirement.metric.sense is Sense.AT_LEAST else "allowed"
    return f"{user_value(requirement, value):.6g}", f"{words} {user_limit(requirement):.6g}"


def user_value(requirement: Requirement, value: float) -> float:
    """A value of `requirement_values` on the user's scale: a margin itself, not its reciprocal."""
    if requirement.metric.sense is Sense.AT_LEAST:
        return 1 / value if value else inf
    return value


def user_limit(requirement: Requirement) -> float | None:
    """Limit on the user's scale, `max` or `min`; None without."""
    limit: float | None = getattr(requirement, requirement.metric.sense.value)
    return limit


def with_user_limit(requirement: Requirement, limit: float | None) -> Requirement:
    """Copy of a requirement with another limit on the user's scale, `max` or `min`."""
    key: dict[str, Any] = {requirement.metric.sense.value: limit}
    same: Any = requirement
    return replace(same, **key)  # type: ignore[no-any-return]


def with_upper_limit(requirement: Requirement, value: float) -> Requirement:
    """Copy of a requirement with another limit, on the scale of `requirement_values`."""
    return with_user_limit(requirement, 1 / value if requirement.metric.sense is Sense.AT_LEAST else value)


def metric_name(requirement: Requirement) -> str:
    """Name of the metric that a requirement limits, a row of `evaluate`."""
    return requirement.metric.name


def requirement_values(metrics: Mapping[str, Value]) -> dict[str, Value]:
    """Values of the requirements, from metrics or arrays of them: small is good, percent as a fraction, 1/margin."""
    limited = (kind.metric for kind in REQUIREMENT_KINDS if kind.metric.name in metrics)
    return {metric.name: metric.requirement_value(metrics[metric.name]) for metric in limited}


def larger_is_better(metric: str) -> bool:
    """Whether the smallest value of a metric is its worst."""
    return metric in METRICS and METRICS[metric].sense is Sense.AT_LEAST


def percent_factor(metric: str) -> float:
    """Ratio of a metric to its limit's scale: 100 for a metric in percent, else 1."""
    return METRICS[metric].factor if metric in METRICS else 1
