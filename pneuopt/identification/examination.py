"""`examine_logs`: what the log doctor finds in logs of a plant; `check_content` refuses logs for it."""

from collections.abc import Iterable, Sequence

from pneuopt.dynamics.runnable import Fittable
from pneuopt.dynamics.system import System
from pneuopt.logs.checks.findings import PISTON, LogFinding, StatedAxis
from pneuopt.logs.doctor import CHECKS, examine
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import LogError, check_names


def check_content(system: Fittable, experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Refuse logs of which more than half show the same fault; a window of a good log may well stand still.

    Returns
    -------
    tuple of str
        A sentence for each fault that the logs accept by name.

    Raises
    ------
    LogError
        With the finding and its evidence.
    """
    found: dict[str, list[LogFinding]] = {}
    accepted: dict[str, str] = {}
    for finding in _find_faults(system, experiments):
        if finding.check in next(e.accept for e in experiments if e.name == finding.log):
            accepted.setdefault(finding.channel, f"{finding.log}: accepted as right: {finding.message}")
        else:
            found.setdefault(finding.channel, []).append(finding)
    for faults in found.values():
        name = faults[0].check
        remedy = f"if the log is right, accept = [{name!r}] in its sidecar, or --accept {name}"
        if len({fault.log for fault in faults}) > len(experiments) / 2:
            raise LogError(f"{faults[0].log}: {faults[0].message}; {remedy}", faults[0])
    return tuple(accepted.values())


def _find_faults(system: Fittable, experiments: Sequence[Experiment]) -> Iterable[LogFinding]:
    for experiment in experiments:
        check_names("check", experiment.accept, CHECKS, f"{experiment.name}: accept")
        yield from (finding for finding in examine(experiment, _stated_axis(system.plant)) if finding.fault)


def _stated_axis(plant: System) -> StatedAxis:
    """The channels of the plant's axis: its motion, and the input that drives it; a piston's if it declares none."""
    if plant.axis is None:
        return PISTON
    pushes = [q.name for q in plant.inputs if q.unit == plant.axis.force]
    return StatedAxis(plant.axis.position, plant.axis.speed, *pushes[:1])
