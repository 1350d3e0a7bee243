"""The sample time of a loop's controller as an axis of a study: a part of the loop's structure, no parameter of it.

A case that has it among its values is of a loop of its own, with which it is evaluated or tuned.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.simulate import MAX_STEPS
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet

if TYPE_CHECKING:
    import pandas as pd

SAMPLE_TIME_AXIS = "pid.sample_time"
"""Its name in a study, as a tuning.toml has it."""


def with_sample_time(loop: ClosedLoop, parameters: ParameterSet) -> ParameterSet:
    """The parameters with the sample time of the loop's controller among them, which cases may change.

    Raises
    ------
    InputError
        If the controller is continuous.
    """
    step = loop.pid.sample_time
    require(
        step is not None, f"{SAMPLE_TIME_AXIS}: the controller is continuous; give [pid] a sample_time in the tuning"
    )
    assert step is not None
    return parameters | ParameterSet({SAMPLE_TIME_AXIS: Parameter(step, "s", lower=0.0)})


def loop_at_sample_time(loop: ClosedLoop, parameters: ParameterSet) -> tuple[ClosedLoop, ParameterSet]:
    """The loop with the sample time of a case, and the case's other parameters; without one, both as they are."""
    if SAMPLE_TIME_AXIS not in parameters:
        return loop, parameters
    sampled = replace(loop, pid=replace(loop.pid, sample_time=parameters.value(SAMPLE_TIME_AXIS)))
    return sampled, parameters.select(n for n in parameters if n != SAMPLE_TIME_AXIS)


def evaluate_at_sample_time(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    band: Band = 0.02,
    max_steps: float = MAX_STEPS,
) -> "pd.DataFrame":
    """The metrics of a case that may have a sample time among its parameters; as `evaluate`."""
    own, given = loop_at_sample_time(loop, parameters)
    return evaluate(own, references, given, band=band, max_steps=max_steps)
