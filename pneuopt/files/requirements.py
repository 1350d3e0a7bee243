"""Requirements as files name them: `settling_time` and so on, and their bounds with units."""

import re
from collections.abc import Mapping
from typing import Any

from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.metric import Requirement
from pneuopt.evaluation.requirements import REQUIREMENT_KINDS
from pneuopt.quantities.errors import UnitError, require
from pneuopt.quantities.units import read_value

REQUIREMENTS_BY_KEY: Mapping[str, type[Requirement]] = {
    re.sub("(?<=[a-z])(?=[A-Z])", "_", kind.__name__).lower(): kind for kind in REQUIREMENT_KINDS
}
"""By its key each kind of requirement."""

NORMAL_VOLUME = "(ANR)"  # what a volume of air is followed by that counts at ISO 8778's state


def bound_units(loop: ClosedLoop) -> dict[str, str]:
    """The unit of each requirement's bound, by key; "1" of what is a number alone.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.models.drive import ForceDrive
    >>> from pneuopt.models.friction import Viscous
    >>> units = bound_units(ClosedLoop(ForceDrive(Viscous()).system(), PID()))
    >>> units["peak_control"], units["ripple"], units["overshoot"]
    ('N', 'm/s', '1')
    """
    command, measured = loop.command.unit, loop.feedback.unit.partition("(")[0]
    units = {key: kind.metric.unit_in(command, measured) for key, kind in REQUIREMENTS_BY_KEY.items()}
    return {key: unit.removesuffix(NORMAL_VOLUME) for key, unit in units.items()}


def read_bound(key: str, given: Any, unit: str, where: str) -> float:
    """Read a requirement's bound.

    Parameters
    ----------
    key : str
    given : object
        As written: "5 %", "150 N", 1.4, "2 l(ANR)".
    unit : str
        Of `bound_units`.
    where : str
        What the message of an error begins with.

    Raises
    ------
    UnitError
        If it cannot be read.
    """
    if REQUIREMENTS_BY_KEY[key].metric.unit.endswith(NORMAL_VOLUME):
        normal = isinstance(given, str) and given.strip().endswith(NORMAL_VOLUME)
        require(normal, f'{where}: {given!r}: air is counted at 20 degC and 100 kPa (ANR): "2 l(ANR)"', UnitError)
        given = given.strip().removesuffix(NORMAL_VOLUME)
    return read_value(given, unit, where=where)
