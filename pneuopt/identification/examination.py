"""`examine_logs`: what the log doctor finds in logs of a plant; `check_content` refuses logs for it.

`pose_problem` makes the estimation problem of logs that pass.
"""

from collections.abc import Iterable, Iterator, Sequence

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import Fittable, HasSystem
from pneuopt.identification.checks import as_experiments, check_free, check_logs
from pneuopt.identification.command_centre import find_centre
from pneuopt.identification.problem import EstimationProblem, as_estimation_model
from pneuopt.identification.stated_axis import stated_axis
from pneuopt.logs.checks.findings import LogFinding
from pneuopt.logs.doctor import examine
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.least_squares import LeastSquares

QUIET_CHECKS = ("sampling", "dwells")
"""Checks whose notes are no doubts of the log: they would stand in the status of every fit."""


def examine_logs(
    system: HasSystem | ClosedLoop, experiments: Experiment | Iterable[Experiment], parameters: ParameterSet
) -> tuple[LogFinding, ...]:
    """Find what is wrong with logs before any fit, as `identify` does, in seconds.

    Parameters
    ----------
    system : drive, System or ClosedLoop
    experiments : Experiment or sequence of Experiment
    parameters : ParameterSet
        Masses and forces that are not free are stated, and a log may contradict them.

    Returns
    -------
    tuple of LogFinding
        Of each log, faults first. `plotting.plot_finding` draws the signals that show one.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    model = as_estimation_model(system)
    return tuple(_find(model, check_logs(model, as_experiments(experiments), parameters), parameters))


def pose_problem(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Iterable[Experiment],
    parameters: ParameterSet,
    method: LeastSquares,
) -> EstimationProblem:
    """The estimation problem of logs that `identify` accepts, before any width is chosen.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    model = as_estimation_model(system)
    logs = check_logs(model, experiments, parameters)
    parameters = find_centre(model, logs, parameters)
    check_free(logs, parameters)
    check_content(model, logs, parameters)
    return EstimationProblem(model, tuple(logs), model.parameters | parameters, method)


def check_content(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """Refuse logs of which more than half show the same fault; a window of a good log may well stand still.

    Returns
    -------
    tuple of str
        A sentence for each fault that the logs accept by name, and for each doubt.

    Raises
    ------
    LogError
        With the finding and its evidence.
    """
    found, said = list(_find(system, experiments, parameters)), dict[str, str]()
    for finding in found:
        if not finding.fault and finding.check not in QUIET_CHECKS:
            said.setdefault(finding.channel, f"{finding.log}: {finding.message}")
        elif is_accepted(finding, experiments):
            said.setdefault(finding.channel, f"{finding.log}: accepted as right: {finding.message}")
    for finding in found:
        if is_refused(finding, found, experiments):
            raise LogError(f"{finding.log}: {finding.message}; {accept_remedy(finding)}", finding)
    return tuple(said.values())


def is_accepted(finding: LogFinding, experiments: Sequence[Experiment]) -> bool:
    """Whether a fault's log is right by what its user says."""
    return finding.fault and any(finding.check in e.accept for e in experiments if e.name == finding.log)


def is_refused(finding: LogFinding, found: Iterable[LogFinding], experiments: Sequence[Experiment]) -> bool:
    """Whether a fit refuses the logs for a fault: it is not accepted, and more than half of the logs show it."""
    alike = {f.log for f in found if f.fault and f.channel == finding.channel and not is_accepted(f, experiments)}
    return finding.fault and finding.log in alike and 2 * len(alike) > len(experiments)


def accept_remedy(finding: LogFinding) -> str:
    """How a user says that a log is right all the same."""
    return f"if the log is right, accept = [{finding.check!r}] in its sidecar, or --accept {finding.check}"


def _find(system: Fittable, experiments: Iterable[Experiment], parameters: ParameterSet) -> Iterator[LogFinding]:
    for experiment in experiments:
        yield from examine(experiment, stated_axis(system.plant, experiment, parameters))
