"""`examine_logs`: what the log doctor finds in logs of a plant; `check_content` refuses logs for it."""

from collections.abc import Iterable, Iterator, Sequence

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import Fittable, HasSystem
from pneuopt.identification.checks import as_experiments, check_logs
from pneuopt.identification.problem import as_estimation_model
from pneuopt.identification.stated_axis import stated_axis
from pneuopt.logs.checks.findings import LogFinding
from pneuopt.logs.doctor import examine
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import ParameterSet

QUIET_CHECKS = ("sampling",)
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
    found: dict[str, list[LogFinding]] = {}
    said: dict[str, str] = {}
    for finding in _find(system, experiments, parameters):
        if not finding.fault and finding.check not in QUIET_CHECKS:
            said.setdefault(finding.channel, f"{finding.log}: {finding.message}")
        elif finding.fault and finding.check in next(e.accept for e in experiments if e.name == finding.log):
            said.setdefault(finding.channel, f"{finding.log}: accepted as right: {finding.message}")
        elif finding.fault:
            found.setdefault(finding.channel, []).append(finding)
    for faults in found.values():
        name = faults[0].check
        remedy = f"if the log is right, accept = [{name!r}] in its sidecar, or --accept {name}"
        if len({fault.log for fault in faults}) > len(experiments) / 2:
            raise LogError(f"{faults[0].log}: {faults[0].message}; {remedy}", faults[0])
    return tuple(said.values())


def _find(system: Fittable, experiments: Iterable[Experiment], parameters: ParameterSet) -> Iterator[LogFinding]:
    for experiment in experiments:
        yield from examine(experiment, stated_axis(system.plant, experiment, parameters))
