"""A loop's response to a reference: its inputs, its sampling and its metrics.

`TuningCase` is one reference on one plant that a design must suit. `check_steps` and `check_travel` refuse, before
anything is simulated, what takes more steps than a budget and what leads a piston into its end stops.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np
from scipy.integrate import cumulative_trapezoid

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, Step
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED
from pneuopt.dynamics.tolerances import MAX_STEPS, SECONDS_A_STEP
from pneuopt.evaluation.metric import Band, band_share
from pneuopt.evaluation.metrics import BandCentre, Envelope, step_metrics
from pneuopt.evaluation.requirements import PUSH
from pneuopt.evaluation.scenarios import Factor, Scenarios, apply_scenario
from pneuopt.evaluation.tolerances import (
    MAX_READINGS_A_SAMPLE,
    MIN_READINGS_A_SAMPLE,
    POINTS_PER_READING,
    READINGS_A_HORIZON,
    SAMPLES_A_DITHER_PERIOD,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, HardwareError, InputError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value


def measure(
    loop: ClosedLoop,
    parameters: ParameterSet,
    reference: Reference,
    response: Trajectory,
    band: Band,
    envelope: Envelope = (),
) -> dict[str, float]:
    """Metrics of a simulated response off the plant's true signal, with the settling band around the reference."""
    return step_metrics(
        response.t,
        response[loop.feedback.name],
        reference.final,
        reference.initial,
        start=reference.at,
        band=band_share(band, reference),
        band_centre=BandCentre.REFERENCE,
        dither_period=loop.dither_period(parameters),
        control=response["control"],
        sample_time=loop.pid.sample_time,
        envelope=envelope,
        scale=None if reference.changes else reference.nominal_size,
        target=reference.values(response.t),
        push=reference.disturbance.get(PUSH, 0.0),
    )


def loop_inputs(loop: ClosedLoop, reference: Reference, step: float) -> Trajectory:
    """Inputs of the loop under a reference; those that the reference has no column for are zero."""
    run = reference.trajectory(step)
    columns, none = dict(run.values), np.zeros(len(run))
    if (
        loop.controller.sensed_signal.order == 1 and REFERENCE_SPEED in columns
    ):  # the reference is a speed, and this is its rate
        columns[REFERENCE_ACCELERATION] = columns[REFERENCE_SPEED]
    return Trajectory(run.t, {q.name: columns.get(q.name, none) for q in loop.inputs})


def sample_spacing(
    loop: ClosedLoop, reference: Reference, parameters: ParameterSet, samples_a_period: int = SAMPLES_A_DITHER_PERIOD
) -> float:
    """Spacing of the samples [s]: the controller's sample time, or a fine one that divides the step's instant."""
    if loop.pid.sample_time is not None:
        return loop.pid.sample_time
    rate = highest_dither_frequency(loop, parameters)
    longest = min(reference.horizon / READINGS_A_HORIZON, 1 / (samples_a_period * rate) if rate else np.inf)
    whole = reference.at if reference.at > 0 else reference.horizon
    return float(whole / math.ceil(whole / longest - 1e-9))


def readings_a_sample(loop: ClosedLoop, reference: Reference) -> int:
    """Readings of a response per sample of the controller."""
    h = loop.pid.sample_time
    if h is None:
        return 1
    return min(
        MAX_READINGS_A_SAMPLE, max(MIN_READINGS_A_SAMPLE, math.ceil(h * READINGS_A_HORIZON / reference.horizon - 1e-9))
    )


def highest_dither_frequency(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """Highest frequency that the dither may take in a tuning [Hz]; 0 without dither; `parameters` are complete."""
    if loop.dither is None:
        return 0.0
    frequency = parameters["dither.frequency"]
    return frequency.upper if frequency.free else frequency.value


def command_range(loop: ClosedLoop, p: ParameterSet) -> tuple[float, float, str]:
    """Lowest and highest command that still acts, and what saturates there: the controller or the final element."""
    low, high, whose = -math.inf, math.inf, "the command"
    if "pid.lower" in p:
        low, high = p.value("pid.lower"), p.value("pid.upper")
    element = loop.plant.axis.final_element if loop.plant.axis else None
    if element is not None and (limit := p.value(element.limit)) < min(-low, high):
        low, high, whose = -limit, limit, f"the {element.name}"
    return low, high, whose


@dataclass(frozen=True, eq=False)
class TuningCase:
    """One reference on one plant."""

    reference: Reference
    scenario: str = ""  # its name; empty for the nominal plant
    values: Mapping[str, float | Factor] = field(default_factory=dict)  # that differ from the nominal plant

    @property
    def label(self) -> str:
        """Heading of its column in a table: "0 to 0.2 [load.mass high]"."""
        return f"{self.reference.label} [{self.scenario}]" if self.scenario else self.reference.label

    def case_parameters(self, parameters: ParameterSet) -> ParameterSet:
        """Parameters of this case: its plant and gains."""
        return apply_scenario(parameters, self.values)

    def case_vectors(self, p: Array, order: Sequence[str]) -> Array:
        """Copy of parameter vectors, shape (m, n_parameters), with this case's values in place."""
        out = p.copy()
        for n, value in self.values.items():
            k = order.index(n)
            out[:, k] = p[:, k] * value.share if isinstance(value, Factor) else value
        return out

    def slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of this case's parameters to the candidate's, shape (n,); 0 where the scenario fixes a value."""
        values = (self.values.get(n, Factor(1.0)) for n in names)
        return np.array([v.share if isinstance(v, Factor) else 0.0 for v in values])

    def initial(self, loop: ClosedLoop, parameters: ParameterSet) -> Array:
        """State in which the loop waits for the step; an error of `ClosedLoop.initial` names the scenario."""
        values, step = self.case_parameters(parameters), self.reference
        try:
            return loop.initial(values, reference=step.origin, start=step.start)
        except ConvergenceError as error:
            raise ConvergenceError(f"{self._message_prefix}{error}", error.solution) from None
        except HardwareError as error:
            raise HardwareError(f"{self._message_prefix}{error}", error.parameter, error.remedy) from None
        except InputError as error:
            raise InputError(f"{self._message_prefix}{error}") from None

    @property
    def _message_prefix(self) -> str:
        return f"scenario {self.scenario!r}: " if self.scenario else ""


def cases(
    references: Sequence[Reference], scenarios: Scenarios, parameters: ParameterSet, tuned: Collection[str] = ()
) -> tuple[TuningCase, ...]:
    """Cases of every reference on the nominal plant, then on each scenario's, which changes `tuned` ones by factors."""
    labels = [r.label for r in references]
    twice = next((n for n in labels if labels.count(n) > 1), "")
    require(not twice, f"two references are {twice!r}, and tables name them by that label; leave one out")
    for name, values in scenarios.items():
        require(bool(name), "a scenario needs a name: {'heavy load': {'load.mass': 8.0}}")
        check_names("parameter", values, parameters, f"scenario {name!r}")
        for n in (n for n, value in values.items() if n in tuned and not isinstance(value, Factor)):
            message = f"scenario {name!r}: {n} is tuned, so no scenario can fix its value"
            remedy = f"for a tolerance around it write tolerances(parameters, {{{n!r}: 0.01}})"
            raise InputError(f"{message}; {remedy}")
    nominal = [TuningCase(r) for r in references]
    return (*nominal, *(TuningCase(r, name, values) for name, values in scenarios.items() for r in references))


def check_steps(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    *,
    plants: int = 1,
    max_steps: float = MAX_STEPS,
) -> None:
    """Refuse references whose responses, each on so many plants, take more steps together than a budget."""
    needed = [plants * simulation_steps(loop, reference, parameters) for reference in references]
    if sum(needed) <= max_steps:
        return
    longest = references[needed.index(max(needed))]
    on_plants = f" on {plants} plants" if plants > 1 else ""
    many = f" (one of {len(references)} references)" if len(references) > 1 else ""
    h, rate = loop.pid.sample_time, _analogue_frequency(loop, parameters)
    if rate and (h is None or SAMPLES_A_DITHER_PERIOD * rate * h > POINTS_PER_READING):
        key = f"dither.frequency is {write_value(rate, 'Hz', 7)}"
    elif h is not None:
        key = f"pid.sample_time is {write_value(h, 's', 4)}"
    else:
        key = f"the step is at {write_value(longest.at, 's', 4)}"
    seconds, digit = max(needed) * SECONDS_A_STEP, 10.0 ** math.floor(math.log10(sum(needed)))
    shown = f"{seconds / 3600:.2g} hours" if seconds > 7200 else f"{seconds / 60:.2g} minutes"
    time = shown if seconds <= 72 * 3600 else f"{seconds / 86400:.2g} days"
    budget = math.ceil(sum(needed) / digit) * digit  # rounded up to one digit
    raise InputError(
        f"reference {longest.label}{many}{on_plants} takes {max(needed):.2g} steps, about {time}: {key} over a horizon "
        f"of {write_value(longest.horizon, 's', 7)}; "
        f"change that, shorten the horizon, or raise the budget of {max_steps:.2g} steps: "
        f"max_steps={budget:.0e}, in a tuning's file steps under [budget]",
    )


def simulation_steps(loop: ClosedLoop, reference: Reference, parameters: ParameterSet) -> float:
    """Least number of steps that the independent simulation of a response takes."""
    spacing = sample_spacing(loop, reference, parameters)
    points = POINTS_PER_READING * readings_a_sample(loop, reference) * reference.horizon / spacing
    return max(points, SAMPLES_A_DITHER_PERIOD * _analogue_frequency(loop, parameters) * reference.horizon)


def _analogue_frequency(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """Frequency of a dither that the integration itself resolves [Hz]; 0 for one that is sampled, and without one."""
    sampled = loop.dither is not None and loop.pid.sample_time is not None and not loop.dither.analogue
    return 0.0 if sampled else highest_dither_frequency(loop, parameters)


def check_travel(loop: ClosedLoop, case: TuningCase, parameters: ParameterSet) -> None:
    """Refuse a reference that a piston cannot follow over its horizon without reaching an end stop."""
    stops = [g for g in loop.plant.validity_limits if g.state == "position"]
    states = [q.name for q in loop.plant.states]
    if not stops or "position" not in states or loop.feedback.name not in ("position", "speed"):
        return
    reference, own = case.reference, case.case_parameters(parameters)
    begin = float(case.initial(loop, parameters)[states.index("position")])
    for stop in stops:
        room = stop.side * (stop.limit(own) - begin)
        if loop.feedback.name == "position":
            far = float((stop.side * (_values(reference)[1] - begin)).max())
            remedy = "take a smaller step" if isinstance(reference, Step) else "take a shorter way"
        elif isinstance(reference, Step):
            lead, rest = stop.side * reference.initial * reference.at, reference.horizon - reference.at
            far = max(lead, lead + stop.side * reference.final * rest)
            fits = (room - lead) / (stop.side * reference.final) if reference.final else inf
            early = f"end it by horizon = {reference.at + fits:.3g} s"
            remedy = f"{early}, or start elsewhere, start={{'position': ...}}" if fits > 0 else "start elsewhere"
        else:
            far = float((stop.side * cumulative_trapezoid(*_values(reference)[::-1])).max())
            remedy = "take less speed, or start elsewhere"
        where = "front" if stop.side > 0 else "rear"
        require(
            far <= room,
            f"reference {case.label}: it leads the piston over {write_value(far, 'm', 4)}, but from position "
            f"{write_value(begin, 'm', 4)} to the {where} end stop there are {write_value(max(room, 0.0), 'm', 4)}; "
            f"{remedy}",
        )


def _values(reference: Reference, count: int = 2001) -> tuple[Array, Array]:
    """Instants over the horizon at which a reference's way is read, and the reference there."""
    t = np.linspace(0.0, reference.horizon, count)
    return t, reference.values(t)
