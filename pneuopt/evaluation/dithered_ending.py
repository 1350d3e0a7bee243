"""`read_ending`: how a response ends with its ripple: its error over the last cycles, its settling, its ripple."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite

import numpy as np

from pneuopt.evaluation.band import Band, band_share, entry_for_good
from pneuopt.evaluation.continuation import ContinuedResponse, continue_response
from pneuopt.evaluation.defects import Ending
from pneuopt.evaluation.dither_mean import FINAL_PERIODS, TAIL_SHARE, period_mean
from pneuopt.evaluation.dither_ripple import describe_ripple, measure_ripple
from pneuopt.evaluation.evaluate import CaseEvaluation
from pneuopt.quantities.arrays import Array

# Cycles of a hunting loop, at its end, over which its error is the largest one: fewer miss the worst of irregular
# cycles, more reach back into the transient.
LAST_CYCLES = 3


@dataclass(frozen=True, eq=False)
class DitheredEnding:
    """How a response ends.

    Attributes
    ----------
    metrics : dict of str to float
        Those of `evaluate`, with the settling times and the error of the continued response, infinite where it never
        settles, and RemainingError, the largest error of the signal itself over the last cycles [% of the step].
    ending : Ending
        Of the response, continued until it is decided.
    ripple : float
        Peak to peak of its dither's ripple in the end [measured unit].
    speed : float or None
        The largest mean speed of a body that is positioned [its unit]; None where the reference is a speed.
    ripple_note : str or None
        Sentence where only the mean settles.
    """

    metrics: dict[str, float]
    ending: Ending
    ripple: float
    speed: float | None
    ripple_note: str | None

    def describe(self, which: str) -> Iterator[str]:
        """What a table of metrics does not show, a sentence each; `which` is "with" or "without" the dither."""
        course, cycle = self.ending.course, self.ending.cycle
        if cycle is not None:
            yield f"{which} it the loop ends in {cycle.describe(course.loop.feedback.unit)}"
        if self.ripple_note is not None:
            yield self.ripple_note
        if course.contact and self.ending.hunts:
            until = f"{course.t[-1]:.3g} s after the step"
            yield f"{which} it the response is judged until {until}: {course.contact}"


def read_ending(found: CaseEvaluation, band: Band) -> DitheredEnding:
    """Continue a response until it stands, shows whether it hunts or meets a limit, and read how it ends.

    Parameters
    ----------
    found : CaseEvaluation
    band : float or Tolerance
        Half width of the settling band, a fraction of the step or in the measured unit.

    Raises
    ------
    ConvergenceError
        If the simulation stops.
    """
    share = band_share(band, found.case.reference)
    course, size = continue_response(found, share), abs(found.case.reference.nominal_size)
    ending = Ending(course, share, found.case.label)
    begin, mean = begin_of_end(ending), np.abs(course.error)
    t, raw = (
        course.t[course.before_contact],
        np.abs(course.signal[course.before_contact] - course.reference.final) / size,
    )
    errors = {
        "RemainingError": 100 * float(raw[t >= begin].max()),
        "SteadyStateError": 100 * float(mean[course.at >= begin].max()),
    }
    settled = {
        "SettlingTime": _settling_time(ending, found.metrics["SettlingTime"], course.at, mean),
        "SettlingTimeRaw": _settling_time(ending, found.metrics["SettlingTimeRaw"], t, raw),
    }
    return DitheredEnding(
        {**found.metrics, **errors, **settled},
        ending,
        _ripple(course),
        _largest_speed(found),
        describe_ripple(found.metrics, size, share),
    )


def begin_of_end(ending: Ending) -> float:
    """Instant from which the error counts as the one in the end: that of the last cycles of a loop that hunts [s].

    It lies before the last instant at which a mean over the dither's period is known.
    """
    end, cycle = float(ending.course.at[-1]), ending.cycle
    if cycle is not None:
        return end - LAST_CYCLES / cycle.frequency
    if ending.stands or ending.drifts:
        return end - max(TAIL_SHARE * end, FINAL_PERIODS * (ending.course.period or 0.0))
    return end / 2


def _settling_time(ending: Ending, within_horizon: float, t: Array, error: Array) -> float:
    """That within the horizon, if the continuation does not refute it; else its own; infinite for never [s]."""
    inside = ending.is_inside(error)
    if isfinite(within_horizon) and inside[t > ending.course.horizon].all():
        return within_horizon
    return entry_for_good(t, inside)


def _ripple(course: ContinuedResponse) -> float:
    """Peak to peak of what repeats with the dither in the end [measured unit]."""
    if course.period is None:
        return 0.0
    signal, k = course.signal[None], len(course.at)
    means = period_mean(course.t, signal, course.reference.initial, course.period, course.at)
    return float(measure_ripple(course.at, signal[:, :k] - means, course.period)[0])


def _largest_speed(found: CaseEvaluation) -> float | None:
    """The largest mean speed of a positioned body within the horizon [its unit]; None for other loops."""
    axis, period, run = found.loop.plant.axis, found.loop.dither_period(found.parameters), found.response
    if axis is None or found.loop.feedback.name != axis.position or axis.speed not in run:
        return None
    speed = run[axis.speed]
    if period is not None and period <= run.t[-1] - run.t[0]:
        at = run.t[run.t <= run.t[-1] - period / 2]
        speed = period_mean(run.t, speed[None], float(speed[0]), period, at)[0]
    return float(speed[np.abs(speed).argmax()])
