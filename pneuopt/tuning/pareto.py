"""`pareto_front`: what one requirement costs in terms of another, as a table of certified designs."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.simulate import MAX_STEPS
from pneuopt.evaluation.requirements import (
    Requirement,
    metric_name,
    upper_limit,
    user_limit,
    with_user_limit,
)
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.specification import specify
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import Progress, ProgressReporter
from pneuopt.tuning.front import Front
from pneuopt.tuning.method import Method
from pneuopt.tuning.tune import prepare_search, prepare_task

if TYPE_CHECKING:
    import pandas as pd


def pareto_front(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: tuple[Requirement, Requirement],
    subject_to: Sequence[Requirement] = (),
    scenarios: Scenarios = NO_SCENARIOS,
    points: int = 15,
    until: float | None = None,
    max_steps: float = MAX_STEPS,
    method: Method | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> "pd.DataFrame":
    """Tune for every compromise between two requirements: designs none of which is better than another by both.

    Parameters
    ----------
    loop, references, parameters, subject_to, scenarios, max_steps, method, progress
        As for `tune`.
    minimise : (Requirement, Requirement)
        Two kinds; a bound of theirs is a limit as well, and with that of the second the front begins.
    points : int
        Number of designs, the two ends included; at least 2.
    until : float, optional
        The bound of the second with which the front ends; by default the best value that it can have.

    Returns
    -------
    DataFrame
        A row a design, from the best by the first requirement to the best by the second. Columns: both requirements'
        names, certified, the worst over references and scenarios, as the user writes them (a fraction where
        `Overshoot.max` is one); "claimed" and a name, by the search; "limit", what the second was held to; the gains;
        "solver_seconds", where a solver follows the front of a linear loop; "seconds"; "error", empty where the
        design is certified, else the reason, and the figures are missing. One row where one design is best by both.
        Ctrl-C leaves the designs found so far, the others as rows with the reason "interrupted".

    Raises
    ------
    InputError
        As `tune`; if both requirements are of one kind, or the front would end before it begins.
    ConvergenceError
        If an end of the front cannot be found; `solution` is its `TuningResult`.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.evaluation.requirements import PeakControl, SettlingTime
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> given = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 50.0})
    >>> given = given.with_bounds({"pid.Kp": (1.0, 20.0), "pid.Ki": (10.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    >>> front = pareto_front(loop, Step(1.0), given, minimise=(SettlingTime(), PeakControl()), points=4)
    >>> bool(front["SettlingTime"].is_monotonic_increasing), bool(front["PeakControl"].is_monotonic_decreasing)
    (True, True)
    """
    first, second = minimise
    require(
        metric_name(first) != metric_name(second),
        f"both requirements are {metric_name(first)}; a front needs two kinds",
    )
    require(points >= 2, f"a front needs at least 2 points, got {points}")
    last = None if until is None else upper_limit(with_user_limit(second, until))
    message = f"a front from {metric_name(second)} {user_limit(second)} until {until} ends before it begins"
    require(last is None or last < upper_limit(second), message)
    spec = specify({first: 1.0, second: 1.0}, subject_to)
    task = prepare_task(loop, references, parameters, spec, scenarios, max_steps=max_steps)
    both = prepare_search(task, method, ProgressReporter(progress, "pareto_front"))
    front = Front(both, first, second, last)
    with suppress(KeyboardInterrupt):
        front.find_designs(points)
    return front.to_frame()
