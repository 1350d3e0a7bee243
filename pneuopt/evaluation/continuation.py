"""`continue_response`: a response beyond its horizon, until it is plain whether it has come to rest."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.dynamics.simulate import continue_simulation
from pneuopt.evaluation.dither_mean import period_mean
from pneuopt.evaluation.evaluate import CaseEvaluation
from pneuopt.evaluation.response import readings_a_sample, sample_spacing
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError
from pneuopt.quantities.trajectories import Trajectory

# Horizons to which a response is continued at most: with fewer, hunting that begins with a slow integral goes unseen;
# more cost time in proportion.
MAX_HORIZONS = 16
# Instants that a continuation may simulate. Below, a loop of 10 kHz or with a fast dither stays undecided; above, its
# certificate takes minutes.
MAX_CONTINUATION_INSTANTS = 200_000
# Tolerance of a continuation, relative; its absolute one is a hundredth. A smaller one costs twice the time for digits
# of which only a share of the settling band counts.
CONTINUATION_TOLERANCE = 1e-8
# Peak to peak of the mean over half the record, as a share of the settling band, that counts as standing. A larger one
# takes slow creep for rest; a smaller one continues responses whose ringing has all but gone.
STANDING_SHARE = 0.1
# Change of the command, were it to drift on to the last horizon, as a share of its largest size, that counts as none.
# A larger one misses an integral that pushes a stuck drive towards its break-away; a smaller one continues responses
# for the last of their decay.
COMMAND_DRIFT_SHARE = 0.01
# Share of a record before a contact with a validity limit that is not judged: the rounded edge of an end stop slows a
# piston some millimetres before it. With less, a speed that holds until the stop creeps; more hides what it did there.
CONTACT_SHARE = 0.1
# Size of the error, in steps, from which a response counts as running away: a lower one takes a large overshoot for
# it, from a higher one on numbers overflow.
RUNAWAY_ERROR = 100.0


@dataclass(frozen=True, eq=False)
class ContinuedResponse:
    """What a response does from the step on, as far as it was simulated.

    Attributes
    ----------
    loop : ClosedLoop
    reference : Reference
    period : float or None
        The time over which dither is averaged [s].
    t : ndarray, shape (n,)
        Time since the step [s].
    signal, command : ndarray, shape (n,)
        The measured signal and the command, dither included [their units].
    contact : str
        The validity limit that ended the simulation, the end of the stroke say, in words; empty where none did.
    stops : str
        Why the integration stopped, where it did.
    is_cut : bool
        Whether the budget of simulated instants ended it.
    is_stable : bool
        Whether the linear loop is stable: where it is not, a response that stands does so for a while only.
    """

    loop: ClosedLoop
    reference: Reference
    period: float | None
    t: Array
    signal: Array
    command: Array
    contact: str = ""
    stops: str = ""
    is_cut: bool = False
    is_stable: bool = True

    @property
    def horizon(self) -> float:
        """The stated horizon, counted from the step [s]."""
        return self.reference.horizon - self.reference.at

    @property
    def is_over(self) -> bool:
        """Whether there is nothing left to simulate."""
        over = self.t[-1] >= (1 - 1e-9) * MAX_HORIZONS * self.horizon
        return bool(over or self.contact or self.stops or self.is_cut or self.runs_away)

    @property
    def runs_away(self) -> bool:
        """Whether the error has left every sensible size."""
        return bool(np.abs(self.error[-1]) > RUNAWAY_ERROR)

    @property
    def before_contact(self) -> slice:
        """The instants of `t` that are judged: those shortly before a contact are left out."""
        left_out = CONTACT_SHARE * self.t[-1] if self.contact else 0.0
        return slice(int(np.searchsorted(self.t, self.t[-1] - left_out, side="right")))

    @cached_property
    def at(self) -> Array:
        """Instants of `before_contact` at which the mean over a dither's period is known [s]."""
        t = self.t[self.before_contact]
        return np.asarray(t[t <= self.t[-1] - (self.period or 0.0) / 2])

    @cached_property
    def error(self) -> Array:
        """The mean signal's distance from the reference in steps, positive beyond it, at the instants `at`."""
        return (self._mean(self.signal, self.reference.initial) - self.reference.final) / self.reference.nominal_size

    @cached_property
    def mean_command(self) -> Array:
        """The command's mean at the instants `at` [its unit]."""
        return self._mean(self.command, float(self.command[0]))

    def since(self, share: float) -> slice:
        """The instants of `at` from this share of the record on."""
        return slice(int(np.searchsorted(self.at, share * self.at[-1])), None)

    def stands(self, band: float) -> bool:
        """Whether the mean signal stands over the second half of the record, wherever that is."""
        return bool(np.ptp(self.error[self.since(0.5)]) <= STANDING_SHARE * band)

    def is_decided(self, band: float) -> bool:
        """Whether signal and command stand and the linear loop is stable, or nothing is left to simulate."""
        ahead = 2 * (MAX_HORIZONS * self.horizon / self.t[-1] - 1)  # halves of the record still to come
        drift = np.ptp(self.mean_command[self.since(0.5)]) * ahead
        quiet = self.is_stable and self.stands(band) and drift <= COMMAND_DRIFT_SHARE * np.abs(self.command).max()
        return self.is_over or bool(quiet)

    def _mean(self, values: Array, initial: float) -> Array:
        if self.period is None:
            return values[: len(self.at)]
        return np.asarray(period_mean(self.t, values[None], initial, self.period, self.at)[0])


def continue_response(found: CaseEvaluation, band: float) -> ContinuedResponse:
    """Continue a response by its own length again and again until it is decided.

    Parameters
    ----------
    found : CaseEvaluation
        Of a loop, with its response up to the horizon.
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    ContinuedResponse
        It ends where signal and command stand, at `MAX_HORIZONS` horizons, at a contact with a validity limit, or
        where the budget of simulated instants ends.
    """
    loop, run, reference = found.loop, found.response, found.case.reference
    since = run.t >= reference.at - 1e-12 * max(1.0, reference.at)
    period = loop.dither_period(found.parameters)
    t, y, u = (run.t[since] - reference.at, run[loop.feedback.name][since], run["control"][since])
    stable = bool(np.isfinite(found.metrics["MaxSensitivity"]))
    course = ContinuedResponse(loop, reference, period, t, y, u, contact=_limit_in_horizon(found), is_stable=stable)
    left = MAX_CONTINUATION_INSTANTS
    while not course.is_decided(band):
        inputs, instants = _next_inputs(found, run.t[-1], course)
        left -= len(instants)
        if left < 0:
            return replace(course, is_cut=True)
        x = np.array([run[q.name][-1] for q in loop.states])
        try:
            run, met = continue_simulation(
                loop,
                inputs,
                found.parameters,
                x,
                t_out=instants,
                rtol=CONTINUATION_TOLERANCE,
                atol=CONTINUATION_TOLERANCE / 100,
            )
        except ConvergenceError as error:
            return replace(course, stops=str(error))
        course = _append(course, run, str(met[0]) if met else "")
    return course


def _limit_in_horizon(found: CaseEvaluation) -> str:
    """The validity limit that the response meets within its horizon, in words; beyond it there is no model."""
    for limit in found.loop.plant.validity_limits:
        values, edge = found.response[limit.state], limit.limit(found.parameters)
        if np.any(limit.side * (edge - values[1:]) <= 0):
            return f"{limit.event} within the horizon"
    return ""


def _append(course: ContinuedResponse, run: Trajectory, contact: str) -> ContinuedResponse:
    t, y, u = (run.t[1:] - course.reference.at, run[course.loop.feedback.name][1:], run["control"][1:])
    return replace(
        course,
        t=np.concatenate([course.t, t]),
        signal=np.concatenate([course.signal, y]),
        command=np.concatenate([course.command, u]),
        contact=contact,
    )


def _next_inputs(found: CaseEvaluation, begin: float, course: ContinuedResponse) -> tuple[Trajectory, Array]:
    """Inputs that stay as they were after the step for once more the record's length, and instants to report."""
    loop, reference, h = found.loop, found.case.reference, found.loop.pid.sample_time
    length = min(course.t[-1], MAX_HORIZONS * course.horizon - course.t[-1])
    spacing = sample_spacing(loop, reference, found.parameters)
    count = max(1, int(np.ceil(length / spacing - 1e-9)))
    t = begin + spacing * np.arange(count + 1)
    held = {"reference": reference.final, **{disturbance_input(n): v for n, v in reference.disturbance.items()}}
    columns = {q.name: np.full(len(t), held.get(q.name, 0.0)) for q in loop.inputs}
    readings = 1 if h is None else readings_a_sample(loop, reference)
    return Trajectory(t, columns), np.linspace(t[0], t[-1], readings * count + 1)
