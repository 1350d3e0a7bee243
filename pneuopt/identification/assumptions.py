"""`list_assumptions`: the values that a fit uses and that nobody has stated, with the keys that state them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pneuopt.dynamics.excitation import DEFAULT_WIDTH
from pneuopt.dynamics.runnable import Fittable
from pneuopt.identification.checks import outputs_in_log
from pneuopt.identification.repairs import input_behaviour
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import estimate_noise
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.units import ATMOSPHERE, write_value

AMBIENT_PRESSURE = "ambient.pressure"  # the parameter of a drive that its gauge pressures count from
SIDECAR = "the log's sidecar"
DRIVE_FILE = "the drive's file"


@dataclass(frozen=True)
class Assumption:
    """A value that stands in no file.

    Attributes
    ----------
    name : str
        A parameter, an option, or "noise of position".
    value : float, str or bool
        [unit]; a word; a flag.
    unit : str
    key : str
        What states it: "[noise] position".
    file : str
        Where: `SIDECAR` or `DRIVE_FILE`.
    reason : str
        What it is, or where it comes from.
    """

    name: str
    value: float | str | bool
    unit: str
    key: str
    file: str
    reason: str

    @property
    def text(self) -> str:
        """The value with its unit, as a file has it."""
        if isinstance(self.value, bool):
            return str(self.value).lower()
        return f'"{self.value if isinstance(self.value, str) else write_value(self.value, self.unit, 6)}"'


def list_assumptions(
    system: Fittable, given: Sequence[Experiment], checked: Sequence[Experiment], parameters: ParameterSet
) -> tuple[Assumption, ...]:
    """The noise, the behaviour between samples and the fixed parameters that nobody has stated.

    Parameters
    ----------
    system : Fittable
    given, checked : sequence of Experiment
        The logs as read, and as `check_logs` returns them, with all noise levels.
    parameters : ParameterSet
        As the user gives them; what is free is no assumption.

    Returns
    -------
    tuple of Assumption
        The logs' first.
    """
    logs = (*_noise_levels(system, given, checked), *_behaviour(system, given), *_gauge_zero(system, given))
    return (*logs, *_defaults(system.parameters, parameters))


def _noise_levels(system: Fittable, given: Sequence[Experiment], checked: Sequence[Experiment]) -> Iterator[Assumption]:
    units = {q.name: q.unit.partition("(")[0] for q in system.outputs}
    found: dict[str, float] = {}
    for log, full in zip(given, checked, strict=True):
        for channel in outputs_in_log(system, full):
            if channel not in log.noise and channel not in found:
                found[channel] = float(f"{full.noise[channel]:.3g}")
                shown = estimate_noise(full.trajectory[channel], full.trajectory.t)
                how = "its resolution, as the logs show" if shown.is_quantisation else "white, as the logs show"
                yield Assumption(
                    f"noise of {channel}", found[channel], units[channel], f"[noise] {channel}", SIDECAR, how
                )


def _behaviour(system: Fittable, given: Sequence[Experiment]) -> Iterator[Assumption]:
    said: dict[str, str] = {}
    for log in given:
        for channel, kind in input_behaviour(system, log).items():
            if channel not in log.intersample:
                said[channel] = kind.value
    for channel, word in said.items():
        why = "as a command runs between samples" if word == "held" else "as a measured channel runs between samples"
        yield Assumption(f"{channel} between samples", word, "", f"[intersample] {channel}", SIDECAR, why)


def _gauge_zero(system: Fittable, given: Sequence[Experiment]) -> Iterator[Assumption]:
    """The zero of gauge pressures in logs of a drive that has no ambient pressure."""
    if AMBIENT_PRESSURE in system.parameters:
        return
    columns = [column for log in given if log.source for column in log.source.columns.values()]
    if any("(g)" in column.unit for column in columns):
        yield Assumption("zero of gauge pressures", ATMOSPHERE, "Pa(a)", "bar(a)", "the log's units", "the standard's")


def _defaults(defaults: ParameterSet, given: ParameterSet) -> Iterator[Assumption]:
    for name, usual in defaults.items():
        used = given.get(name, usual)
        if used.free or used.stated or used != usual:
            continue
        section, _, key = name.partition(".")
        yield Assumption(name, used.value, used.unit, f"[{section}] {key}", DRIVE_FILE, _reason(used))


def _reason(p: Parameter) -> str:
    if p.source == DEFAULT_WIDTH:
        return f"{p.meaning}; identify chooses it by the logs"
    return f"{p.meaning} ({p.source})" if p.source else p.meaning
