"""One tree of errors: `InputError` for what the user can mend, `ConvergenceError` for what a solver could not do."""

import difflib
from collections.abc import Iterable
from typing import Any

MAX_SHOWN = 80
"""Length of an unknown name in a message [character]: more hides the remedy behind it."""


class PneuoptError(Exception):
    """Base of every error that pneuopt raises on purpose."""


class InputError(PneuoptError, ValueError):
    """Something that the user gave cannot be used; the message names the place, the value and the remedy."""


class UnitError(InputError):
    """A unit is missing, unknown, ambiguous or of another dimension."""


class UnknownNameError(InputError):
    """A name that comes from data is not known; the message offers the nearest one."""

    def __init__(self, kind: str, name: str, known: Iterable[str], where: str = "") -> None:
        known, name = sorted(known), str(name)  # what a file gives for a name may be a number
        near = difflib.get_close_matches(name[:MAX_SHOWN], known, n=1, cutoff=0.5)
        name = name if len(name) < MAX_SHOWN else name[:MAX_SHOWN] + "..."
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known) or 'none'}"
        super().__init__(f"{where + ': ' if where else ''}unknown {kind} {name!r}; {hint}")


class LogError(InputError):
    """A log cannot be read, or contradicts itself; the message names the file, row and column."""

    def __init__(self, message: str, finding: Any = None) -> None:
        super().__init__(message)
        self.finding = finding  # what the log doctor found, which `plotting.plot_finding` draws


class ModelError(InputError):
    """A model, its parameters and its data do not fit together."""


class HardwareError(InputError):
    """A value that no hardware has; the message says which values are possible."""

    def __init__(self, message: str, parameter: str = "", remedy: str = "") -> None:
        super().__init__(message)
        self.parameter, self.remedy = parameter, remedy


class PhysicsWarning(UserWarning):
    """A simulation leaves what its model describes (end stop, empty chamber); a log contradicts it, or says little."""


class ConvergenceError(PneuoptError):
    """A solver stopped without an answer that may be trusted.

    Attributes
    ----------
    solution : object
        The last iterate, of the type that the verb returns, marked as not converged; None where there is none.
    """

    def __init__(self, message: str, solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution


def require(condition: bool, message: str, error: type[PneuoptError] = InputError) -> None:
    """Raise `error` with `message` unless `condition` holds."""
    if not condition:
        raise error(message)


def check_names(kind: str, names: Iterable[str], known: Iterable[str], where: str = "") -> None:
    """Raise `UnknownNameError` for the first of `names` that is not in `known`."""
    known = set(known)
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise UnknownNameError(kind, name, known, where)
