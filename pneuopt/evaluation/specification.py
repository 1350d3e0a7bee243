"""`Specification`: the checked objective and limits of a tuning; it weighs values and finds violated limits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from types import MappingProxyType
from typing import Any, TypeGuard

from pneuopt.evaluation.limit_cycle import NoHunting
from pneuopt.evaluation.metric import Band, Tolerance
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    EnvelopeBounds,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    Requirement,
    SettlingTime,
    SettlingTimeRaw,
    SteadyStateError,
    StepEnvelope,
    metric_name,
    upper_limit,
    with_upper_limit,
)
from pneuopt.evaluation.tolerances import STABILITY_SENSITIVITY, TAIL_SHARE
from pneuopt.quantities.errors import require

Kind = type | tuple[type, ...]
LINEAR_PEAKS = (MaxSensitivity, MaxComplementarySensitivity, NoiseGain)
NO_WEIGHTS: Mapping[Requirement, float] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Specification:
    """Objective and limits of a tuning, checked by `specify`."""

    weights: Mapping[Requirement, float]  # of the terms of the objective; empty where a file only describes a loop
    limits: tuple[Requirement, ...]  # at most one of a kind, the tightest
    band: Band  # half width of the settling band; 2 % unless a requirement names another
    rest: NoHunting | None = None  # how a loop shall end on its rig; None where that is not asked

    @property
    def envelope(self) -> EnvelopeBounds:
        """Bounds of the `StepEnvelope`; empty without one."""
        return next((q.bounds for q in (*self.weights, *self.limits) if isinstance(q, StepEnvelope)), ())

    @property
    def metric_names(self) -> tuple[str, ...]:
        """Names of the metrics that it limits or minimises."""
        return tuple(dict.fromkeys(metric_name(q) for q in (*self.weights, *self.limits)))

    @property
    def settling(self) -> type[SettlingTime]:
        """The kind of settling time that counts: of the signal with its ripple where that is asked for."""
        return SettlingTimeRaw if self.concerns(SettlingTimeRaw) else SettlingTime

    def limit(self, kind: Kind) -> float:
        """Largest value allowed for this kind of requirement, as `upper_limit`; inf without a limit."""
        return next((upper_limit(q) for q in self.limits if isinstance(q, kind)), inf)

    def weight(self, kind: Kind) -> float:
        """Weight of this kind of requirement in the objective; 0 where it is no term."""
        return next((w for q, w in self.weights.items() if isinstance(q, kind)), 0.0)

    def concerns(self, kind: Kind) -> bool:
        """Whether this kind of requirement is a term or a limit."""
        return self.weight(kind) > 0 or self.limit(kind) < inf

    def tighten(self, margin: float, peaks: float, linear: float | None = None) -> "Specification":
        """Copy with band and limits smaller by the share `margin`; peak control and sensitivities by the share `peaks`.

        So an optimum, which lies on its limits, still keeps those requested once its gains are rounded and simulated.
        `linear` is the share for the peaks of a linear loop's responses, which no simulation blurs; None: as others.
        """
        room: dict[type, float] = {SettlingTime: 0.0, SettlingTimeRaw: 0.0}
        room |= dict.fromkeys((PeakControl, MaxSensitivity, MaxComplementarySensitivity), peaks)
        room |= {} if linear is None else dict.fromkeys(LINEAR_PEAKS, linear)
        limits = tuple(with_upper_limit(q, upper_limit(q) * (1 - room.get(type(q), margin))) for q in self.limits)
        return replace(self, limits=limits, band=self.band * (1 - margin))

    def with_stability(self) -> "Specification":
        """Copy for a search, which may return stable loops only: with a limit on the sensitivity, infinite without."""
        if self.limit(MaxSensitivity) < inf:
            return self
        return replace(self, limits=(*self.limits, MaxSensitivity(STABILITY_SENSITIVITY)))

    def with_rest(self, record: float) -> "Specification":
        """Copy for a search, whose designs shall come to rest at the reference within a record of this length [s]."""
        latest = (1 - TAIL_SHARE) * record  # what settles later than that counts as not settled
        if self.limit(SettlingTime) <= latest:
            return self
        return replace(self, limits=(*self.without(SettlingTime).limits, self.settling(self.band, latest)))

    def on_signal(self) -> "Specification":
        """Copy in which the signal has to settle, with its ripple, wherever the mean was not asked for by name."""
        weights, limits = dict[Requirement, float](), list(self.limits)
        for q, weight in self.weights.items():
            own = SettlingTimeRaw(q.band) if _leaves_open(q) else q
            weights[own] = weights.get(own, 0.0) + weight
        if self.limit(SettlingTimeRaw) == inf:
            limits += [SettlingTimeRaw(q.band, q.max) for q in self.limits if _leaves_open(q)]
        return replace(self, weights=weights, limits=tuple(limits))

    def without(self, kind: Kind) -> "Specification":
        """Copy without the limit of this kind."""
        return replace(self, limits=tuple(q for q in self.limits if not isinstance(q, kind)))

    def with_band(self, band: Band) -> "Specification":
        """Copy with another settling band."""
        return replace(self, band=band)

    def objective(self, values: Mapping[str, float]) -> float:
        """Weighted sum of values by metric, as `requirement_values` gives them."""
        return sum(weight * values[metric_name(q)] for q, weight in self.weights.items())

    @property
    def resolution(self) -> float:
        """Difference of the objective below which two simulations agree: its terms' resolutions, weighted."""
        return sum(weight * q.metric.resolution for q, weight in self.weights.items())

    def excess(self, values: Mapping[str, Any]) -> dict[Requirement, Any]:
        """Shares by which values of `requirement_values` exceed each limit: negative is room, NaN breaks it too.

        Examples
        --------
        >>> spec = specify(SettlingTime(), [MaxSensitivity(1.6)])
        >>> round(spec.excess({"MaxSensitivity": 2.0})[MaxSensitivity(1.6)], 6)
        0.25
        """
        return {q: values[metric_name(q)] / upper_limit(q) - 1 for q in self.limits}

    def violations(self, values: Mapping[str, float], slack: float = 0.0) -> tuple[Requirement, ...]:
        """Limits that `values` violate; `slack` is relative to the limit."""
        return tuple(q for q, share in self.excess(values).items() if not share <= slack)


def _leaves_open(q: Requirement) -> TypeGuard[SettlingTime]:
    """Whether a requirement asks for a settling time and does not say whether that of the mean will do."""
    return type(q) is SettlingTime and not q.mean


Objective = Requirement | Mapping[Requirement, float] | Specification


def specify(minimise: Objective, subject_to: Sequence[Requirement | NoHunting] = ()) -> Specification:
    """Check an objective and its limits: a term with a bound is a limit as well, a Specification comes alone."""
    if isinstance(minimise, Specification):
        require(len(subject_to) == 0, "minimise is a Specification, which holds its limits; leave subject_to out")
        spec = minimise
    else:
        spec = specify_limits(subject_to, dict(minimise) if isinstance(minimise, Mapping) else {minimise: 1.0})
    require(len(spec.weights) > 0, "minimise is empty: name at least one requirement, SettlingTime() for example")
    return spec


def specify_limits(
    subject_to: Sequence[Requirement | NoHunting], weights: Mapping[Requirement, float] = NO_WEIGHTS
) -> Specification:
    """Check limits that may stand without an objective, as a file that only describes a loop has them."""
    asked = [q for q in subject_to if isinstance(q, NoHunting)]
    rest = NoHunting(max(q.duration for q in asked), min(q.repeatability for q in asked)) if asked else None
    limited = [q for q in subject_to if not isinstance(q, NoHunting)]
    known = ", ".join(k.__name__ for k in REQUIREMENT_KINDS)
    for q in (*weights, *limited):
        require(isinstance(q, Requirement), f"{q!r} is no requirement; write {known}, as in Overshoot(max=0.05)")
    for q, weight in weights.items():
        require(0 < weight < inf, f"the weight of {metric_name(q)} must be positive, got {weight:g}")
    for q in limited:
        message = f"{metric_name(q)} in subject_to has no limit; write {metric_name(q)}({q.metric.sense.value}=...)"
        require(upper_limit(q) < inf, message)
    terms = [metric_name(q) for q in weights]
    require(len(set(terms)) == len(terms), f"minimise names a kind of requirement twice: {', '.join(terms)}")
    bands = {q.band for q in (*weights, *limited) if isinstance(q, SettlingTime)}
    require(len(bands) <= 1, f"settling bands differ: {sorted(bands, key=str)}; one band holds for the whole tuning")
    tubes = {q.bounds for q in (*weights, *limited) if isinstance(q, StepEnvelope)}
    require(len(tubes) <= 1, "two StepEnvelopes differ; join them to one")
    for tube in tubes:
        _check_envelope(tube, (*weights, *limited), next(iter(bands), 0.02))
    limits: dict[str, Requirement] = {}
    for q in (*weights, *limited):
        if upper_limit(q) < (upper_limit(limits[metric_name(q)]) if metric_name(q) in limits else inf):
            limits[metric_name(q)] = q
    return Specification(weights, tuple(limits.values()), next(iter(bands), 0.02), rest)


def _check_envelope(tube: EnvelopeBounds, requirements: Sequence[Requirement], band: Band) -> None:
    """Refuse an envelope that contradicts another requirement, so that no response keeps both."""
    start, (last, low, up) = tube[0], tube[-1]
    allows_start = start[0] > 0 or start[1] <= 0 <= start[2]
    message = f"StepEnvelope: at the step itself the bounds are {start[1]:g} to {start[2]:g}, but the response is at 0"
    require(allows_start, f"{message}; let them include 0 there, or begin later")
    for q in requirements:
        share = None if isinstance(band, Tolerance) else band
        near = share if isinstance(q, SettlingTime) else q.max if isinstance(q, SteadyStateError) else None
        other = f"{metric_name(q)} asks for 1 to within {near}"
        message = f"StepEnvelope: from {last:g} s on the bounds are {low:g} to {up:g}, {other}"
        require(near is None or (low <= 1 + near and up >= 1 - near), f"{message}; move the bounds, or leave one out")
        if isinstance(q, Overshoot) and q.max is not None:
            t, lower, _ = max(tube, key=lambda row: row[1])
            message = f"StepEnvelope: from {t:g} s on the lower bound is {lower:g}, Overshoot allows {1 + q.max:g}"
            require(lower <= 1 + q.max, f"{message}; lower the bound, or raise Overshoot's max")
