"""`Defect`, and `find_defects`: how a response ends that was continued until it was decided, in words."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from math import isfinite, nan

import numpy as np

from pneuopt.evaluation.band import SettlingBand, entry_for_good
from pneuopt.evaluation.continuation import ContinuedResponse
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.evaluation.dither_ripple import describe_ripple
from pneuopt.evaluation.limit_cycle import LimitCycle, find_limit_cycle
from pneuopt.quantities.arrays import Array, Mask

# Share of the step below which a response has not moved: below it, a stuck drive whose friction gives way a little
# counts as a motion; above it, a response counts as none that creeps towards the reference.
MIN_MOTION = 0.1
# Overshoot of the continuation beyond the horizon's, as a share of the settling band, from which it takes its place.
# Below, the ripple's mean at the horizon's end decides; above, a larger overshoot goes unsaid.
MIN_LATER_OVERSHOOT = 1e-3
# Ratio of an oscillation's size in the last quarter of the record to that in the quarter before from which it grows.
# A lower one takes irregular hunting for growth; a higher one misses growth that takes many periods.
MIN_GROWTH = 1.1
# Share of the settling band that an oscillation inside it must reach for its growth to count, and a rest for a note
# that it lies near the edge. Smaller ones report what stays far inside; with larger ones only the edge itself counts.
GROWTH_SHARE, EDGE_SHARE = 0.5, 0.9
# Share of the range over half the record that a drift in one direction must cover to be creep: with less, slow hunting
# is creep too; with all of it, the least ringing on the drift hides it.
MIN_DRIFT_SHARE = 0.9
# Horizons within which a response must be in its band for good. With fewer, a design is refused whose user only
# underrated its settling; with more, one counts as settled that for its user's purposes never does.
LATEST_SETTLING = 4.0


class Defect(Enum):
    """What can be wrong with gains whatever was asked of them; the value is the word that files use."""

    UNSTABLE = "unstable"
    GROWS = "grows"
    HUNTS = "hunts"
    CREEPS = "creeps"
    NEVER_SETTLES = "never settles"
    STANDS_STILL = "stands still"
    MISSES_REFERENCE = "misses reference"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Finding:
    """A defect in one case.

    Attributes
    ----------
    defect : Defect
    case : str
        The case's label, a column of `evaluate`.
    sentence : str
        The defect in words, with its figures.
    """

    defect: Defect
    case: str
    sentence: str


@dataclass(frozen=True, eq=False)
class Ending:
    """The one answer to "how does a response end", read against a settling band; certificate and verdicts read it.

    Parameters
    ----------
    course : ContinuedResponse
    band : float
        Half width, a fraction of the step.
    case : str
        Its label.
    rest_error : float
        Distance from the reference at which it may rest outside the band, a fraction of the step.
    """

    course: ContinuedResponse
    band: float
    case: str
    rest_error: float = 0.0

    @property
    def defect(self) -> Defect | None:
        """How it ends where it neither settles nor rests where it may."""
        return self.description[0] if self.description else None

    @property
    def hunts(self) -> bool:
        """Whether it goes on to and fro, out of the band."""
        return self.defect is Defect.HUNTS

    @cached_property
    def description(self) -> tuple[Defect, str] | None:
        """The defect and its predicate, "hunts: ..."."""
        return _describe_defect(self)

    @cached_property
    def settling_time(self) -> float:
        """Instant after the step from which the mean stays in the band, to the grid [s]; inf where it does not."""
        return entry_for_good(self.course.at, self.is_inside(self.course.error))

    @property
    def is_settled(self) -> bool:
        """Whether the mean enters the band for good."""
        return isfinite(self.settling_time)

    def is_inside(self, error: Array) -> Mask:
        """Which errors, in steps, lie in the band."""
        return SettlingBand(0.0, self.band).contains(error)

    def returns(self, share: float) -> int:
        """How often the mean leaves the band from this share of the record on, having been inside."""
        inside = self.is_inside(self.course.error[self.course.since(share)])
        return int(np.sum(inside[:-1] & ~inside[1:]))

    @property
    def largest_overshoot(self) -> float:
        """The mean's largest distance beyond the reference, in steps; on either side where only a disturbance steps."""
        error = self.course.error
        return float(max(0.0, (error if self.course.reference.changes else np.abs(error)).max()))

    def refutes(self, settling_time: float) -> bool:
        """Whether the mean leaves the band after this instant, beyond the horizon [s]."""
        course = self.course
        return not self.is_inside(course.error[course.at > course.horizon]).all() and settling_time <= course.horizon

    @property
    def stands(self) -> bool:
        """Whether the mean stands, wherever that is."""
        return self.course.stands(self.band)

    @property
    def final_error(self) -> float:
        """Distance from the reference at the end, in steps, with its sign."""
        late = self.course.error[self.course.since(1 - TAIL_SHARE)]
        return float(late.mean())

    @cached_property
    def cycle(self) -> LimitCycle | None:
        """An oscillation that does not decay in the second half of the record [measured unit]."""
        course, size = self.course, abs(self.course.reference.nominal_size)
        least = GROWTH_SHARE * self.band * size
        return find_limit_cycle(course.at, size * course.error, start=course.at[-1] / 2, min_amplitude=least)

    @property
    def growth(self) -> float:
        """Ratio of the mean's range in the last quarter of the record to that in the quarter before."""
        at, error = self.course.at, self.course.error
        before = error[(at >= 0.5 * at[-1]) & (at < 0.75 * at[-1])]
        return float(np.ptp(error[self.course.since(0.75)]) / max(np.ptp(before), 1e-300))

    @property
    def drifts(self) -> bool:
        """Whether the mean moves in one direction over the second half of the record."""
        late = self.course.error[self.course.since(0.5)]
        return bool(abs(late[-1] - late[0]) >= MIN_DRIFT_SHARE * np.ptp(late))


def find_defects(ending: Ending) -> Iterator[Finding]:
    """The defect with which a response ends, if any."""
    if ending.description is not None:
        defect, words = ending.description
        yield Finding(defect, ending.case, f"at {ending.case} the loop {words}")


def _describe_defect(ending: Ending) -> tuple[Defect, str] | None:
    """The defect and its predicate, "hunts: ..."."""
    course, cycle = ending.course, ending.cycle
    moved, until = 1 + float(course.error.max()), f"{course.t[-1]:.3g} s after the step"
    if course.runs_away:
        return Defect.GROWS, f"runs away: {until} it is {abs(course.error[-1]):.3g} steps off"
    if course.stops:
        return Defect.UNDECIDED, f"is undecided: {course.stops}"
    if course.reference.changes and moved < MIN_MOTION:
        return Defect.STANDS_STILL, f"stands still: {until} it has moved by {100 * max(moved, 0.0):.2g} % of the step"
    if cycle is not None and ending.growth > MIN_GROWTH:
        return Defect.GROWS, f"swings more and more: {until} it has {cycle.describe(course.loop.feedback.unit)}"
    if ending.is_settled and ending.settling_time > LATEST_SETTLING * course.horizon:
        times = f"{ending.settling_time / course.horizon:.2g} times its horizon"
        return (
            Defect.CREEPS,
            f"creeps: it is in the band for good only {ending.settling_time:.3g} s after the step, {times}",
        )
    rests = ending.stands and abs(ending.final_error) <= max(ending.rest_error, ending.band)
    return None if ending.is_settled or rests else _describe_unrest(ending, cycle, until)


def _describe_unrest(ending: Ending, cycle: LimitCycle | None, until: str) -> tuple[Defect, str]:
    """The defect of a response that does not settle where it should, and its predicate."""
    off, returns = f"{100 * abs(ending.final_error):.3g} % of the step", ending.returns(0.5)
    if ending.course.is_cut:
        return Defect.UNDECIDED, f"is undecided: the budget of simulated instants ends {until}, it is {off} off"
    if ending.stands:
        return Defect.MISSES_REFERENCE, f"misses the reference: it rests {off} away from it"
    if cycle is not None:
        return Defect.HUNTS, f"hunts: it ends in {cycle.describe(ending.course.loop.feedback.unit)}"
    if returns > 1:
        return Defect.HUNTS, f"hunts: {until} it has left the band {returns} times in half that time"
    if ending.drifts:
        return Defect.CREEPS, f"creeps: {until} it is {off} away from the reference, and still moving"
    return Defect.NEVER_SETTLES, f"never settles: {until} it is {off} away from the reference"


def correct_metrics(ending: Ending, metrics: Mapping[str, float]) -> dict[str, float]:
    """The metrics of the horizon, less what the continuation refutes.

    SettlingTime is NaN where the mean leaves the band again or the loop does not settle, and the overshoot is that of
    the continuation where it is larger.
    """
    largest = ending.largest_overshoot
    times = [n for n in ("SettlingTime", "SettlingTimeRaw") if n in metrics]
    refuted = dict.fromkeys(times, nan) if ending.refutes(metrics["SettlingTime"]) else {}
    higher = {"Overshoot": 100 * largest, "OvershootDistance": largest * abs(ending.course.reference.nominal_size)}
    if largest <= metrics["Overshoot"] / 100 + MIN_LATER_OVERSHOOT * ending.band:
        higher = {}
    return {**metrics, **refuted, **higher}


def describe_ending(ending: Ending, metrics: Mapping[str, float]) -> Iterator[str]:
    """What a user should know of an ending that is no defect."""
    course, band, begins = ending.course, f"the band of {100 * ending.band:.3g} %", f"at {ending.case} the loop"
    if course.contact:
        yield f"at {ending.case} the certificate ends {course.t[-1]:.3g} s after the step: {course.contact}"
    if ending.refutes(metrics["SettlingTime"]):
        yield f"{begins} leaves {band} again after its horizon"
    if ending.is_settled and not ending.settling_time <= course.horizon:
        yield f"{begins} is in {band} for good only {ending.settling_time:.3g} s after the step, beyond the horizon"
    cycle = ending.cycle
    if cycle is not None and ending.is_settled:
        yield f"{begins} keeps {cycle.describe(course.loop.feedback.unit)}, inside {band}"
    if ending.stands and EDGE_SHARE * ending.band < abs(ending.final_error) <= ending.band:
        yield f"{begins} rests {100 * abs(ending.final_error):.3g} % off the reference, near the edge of {band}"
    ripple = describe_ripple(metrics, course.reference.nominal_size, ending.band)
    if ripple is not None:
        yield f"at {ending.case} {ripple}"
