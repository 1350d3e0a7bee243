"""`check_steps`: refuse simulations that take more steps than a budget, before they begin, and name the key."""

import math
from collections.abc import Sequence

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.simulate import MAX_STEPS, SECONDS_A_STEP
from pneuopt.evaluation.response import (
    SAMPLES_A_DITHER_PERIOD,
    highest_dither_frequency,
    readings_a_sample,
    sample_spacing,
)
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value

# Points of the simulated record for each reading of a search: with one, the record would miss what happens between the
# search's readings just as the search does; more cost time in proportion.
POINTS_PER_READING = 4


def check_steps(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    *,
    plants: int = 1,
    max_steps: float = MAX_STEPS,
) -> None:
    """Refuse references whose responses take more steps than a budget.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Reference
    parameters : ParameterSet
        Every parameter of the loop.
    plants : int
        On how many plants each reference is followed.
    max_steps : float
        The budget, for all responses together.

    Raises
    ------
    InputError
        With the steps, the minutes that they take, what makes them so many, and how to raise the budget.
    """
    needed = [plants * simulation_steps(loop, reference, parameters) for reference in references]
    if sum(needed) <= max_steps:
        return
    longest = references[needed.index(max(needed))]
    on_plants = f" on {plants} plants" if plants > 1 else ""
    many = f" (one of {len(references)} references)" if len(references) > 1 else ""
    key = _finest_key(loop, longest, parameters)
    require(
        False,
        f"reference {longest.label}{many}{on_plants} takes {max(needed):.2g} steps, about "
        f"{_duration(max(needed) * SECONDS_A_STEP)}: {key} over a horizon of {write_value(longest.horizon, 's', 7)}; "
        f"change that, shorten the horizon, or raise the budget of {max_steps:.2g} steps: "
        f"max_steps={_round_up(sum(needed)):.0e}, in a tuning's file steps under [budget]",
    )


def simulation_steps(loop: ClosedLoop, reference: Reference, parameters: ParameterSet) -> float:
    """How many steps the independent simulation of a response takes, at least."""
    spacing = sample_spacing(loop, reference, parameters)
    points = POINTS_PER_READING * readings_a_sample(loop, reference) * reference.horizon / spacing
    return max(points, SAMPLES_A_DITHER_PERIOD * _analogue_frequency(loop, parameters) * reference.horizon)


def _analogue_frequency(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """Frequency of a dither that the integration itself resolves [Hz]; 0 for one that is sampled, and without one."""
    sampled = loop.dither is not None and loop.pid.sample_time is not None and not loop.dither.analogue
    return 0.0 if sampled else highest_dither_frequency(loop, parameters)


def _finest_key(loop: ClosedLoop, reference: Reference, parameters: ParameterSet) -> str:
    """What sets the steps of a response, with its value: the dither, the sample time, or the step's instant."""
    h, rate = loop.pid.sample_time, _analogue_frequency(loop, parameters)
    if rate and (h is None or SAMPLES_A_DITHER_PERIOD * rate * h > POINTS_PER_READING):
        return f"dither.frequency is {write_value(rate, 'Hz', 7)}"
    if h is not None:
        return f"pid.sample_time is {write_value(h, 's', 4)}"
    return f"the step is at {write_value(reference.at, 's', 4)}"


def _round_up(value: float) -> float:
    """A number rounded up to one digit."""
    digit = 10.0 ** math.floor(math.log10(value))
    return math.ceil(value / digit) * digit


def _duration(seconds: float) -> str:
    """Minutes, or hours, in words."""
    if not math.isfinite(seconds) or seconds > 72 * 3600:
        return f"{seconds / 86400:.2g} days"
    return f"{seconds / 3600:.2g} hours" if seconds > 7200 else f"{seconds / 60:.2g} minutes"
