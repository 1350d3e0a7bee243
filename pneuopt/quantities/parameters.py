"""Signals (`Quantity`) and numbers (`Parameter`, `ParameterSet`): immutable, named, in SI units, edited by copy.

Behind them `Intersample`, how a signal runs between two samples of a log, and the checks of the verbs' arguments: one
thing as well as several, and an error that says which argument came as what.
"""

import fnmatch
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from math import inf
from numbers import Integral, Real
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, TypeVar

from pneuopt.quantities.errors import InputError, UnknownNameError, check_names, require

if TYPE_CHECKING:
    import pandas as pd


T = TypeVar("T")


@dataclass(frozen=True)
class Quantity:
    """A signal: a state, an input or an output.

    Parameters
    ----------
    name : str
        The field's term, in snake case; parts are prefixed ("pid.integral").
    unit : str
        SI unit of the signal. "Pa(a)" and "Pa(g)" mark pressure levels, absolute and gauge.
    nominal : float
        The signal's usual size, by which solvers scale it [unit].
    lower, upper : float
        Physical range [unit].
    """

    name: str
    unit: str
    nominal: float = 1.0
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        require(self.nominal > 0, f"{self.name}: nominal must be positive, got {self.nominal}")
        require(self.lower < self.upper, f"{self.name}: lower {self.lower} is not below upper {self.upper}")


@dataclass(frozen=True)
class Parameter:
    """A number with its unit, bounds and source.

    Parameters
    ----------
    value, lower, upper : float
        Linear SI values; `lower <= value <= upper` is checked, never repaired.
    unit : str
        SI unit.
    log : bool
        Solvers work on its logarithm; the value must be positive, and a bound of zero or below is then no bound.
    free : bool
        It is to be identified or tuned.
    per_log : bool
        Each experiment has a value of its own (a sensor offset, say).
    source : str
        Where the number comes from.
    meaning : str
        What the number is, for lists of keys; two parameters that differ in it alone are equal.
    stated : bool
        Whether a file or a user has stated the value, be it the default's; two parameters that differ in it alone are
        equal.
    """

    value: float
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    log: bool = False
    free: bool = False
    per_log: bool = False
    source: str = ""
    meaning: str = field(default="", compare=False, repr=False)
    stated: bool = field(default=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        require(not math.isnan(self.value), f"a parameter's value is NaN [{self.unit}]; give a number")
        require(
            self.lower <= self.upper, f"lower bound {self.lower:g} lies above upper bound {self.upper:g} {self.unit}"
        )
        require(
            self.lower <= self.value <= self.upper,
            f"value {self.value:g} {self.unit} lies outside its bounds [{self.lower:g}, {self.upper:g}]; "
            "move the value or the bounds",
        )
        require(not self.log or self.value > 0, f"a log parameter must be positive, got {self.value:g} {self.unit}")


class ParameterSet(Mapping[str, Parameter]):
    """An immutable, ordered mapping from name to `Parameter`.

    Examples
    --------
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "friction.coulomb": Parameter(40.0, "N")})
    >>> rig.freed("friction.*").free_names
    ('friction.coulomb',)
    >>> rig.with_values({"load.mass": 6.0}).value("load.mass")
    6.0
    """

    def __init__(self, parameters: Mapping[str, Parameter] | Iterable[tuple[str, Parameter]] = ()) -> None:
        self._parameters = dict(parameters)

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._parameters[name]
        except KeyError:
            raise UnknownNameError("parameter", name, self._parameters) from None

    def __contains__(self, name: object) -> bool:
        return name in self._parameters

    def get(self, name: str, default: Any = None) -> Any:
        """The parameter of that name; `default` where there is none."""
        return self._parameters.get(name, default)  # Mapping's own catches a KeyError only

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def __hash__(self) -> int:
        return hash(frozenset(self._parameters.items()))  # a mapping's equality knows no order

    def __or__(self, other: "ParameterSet") -> "ParameterSet":
        """Join two sets; on a shared name the right one wins."""
        return ParameterSet({**self._parameters, **other._parameters})

    def __repr__(self) -> str:
        width = max((len(n) for n in self), default=0)
        lines = []
        for name, p in self.items():
            marks = ", ".join(m for m in ("free", "log", "per_log") if getattr(p, m))
            finite = math.isfinite(p.lower) or math.isfinite(p.upper)
            bounds = f" in [{p.lower:g}, {p.upper:g}]" if finite else ""
            source = f"  # {p.source}" if p.source else ""
            lines.append(f"{name:<{width}}  {p.value:g} {p.unit}{bounds}{' ' * bool(marks)}{marks}{source}")
        return "\n".join(lines)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        return tuple(n for n, p in self.items() if p.free)

    def value(self, name: str) -> float:
        """The value of one parameter [its unit]."""
        return self[name].value

    def match_names(self, *patterns: str) -> tuple[str, ...]:
        """Names that match any of the shell patterns; a pattern without a match is an error."""
        names: list[str] = []
        for pattern in patterns:
            found = fnmatch.filter(self, pattern)
            if not found:
                raise UnknownNameError("parameter", pattern, self)
            names += [n for n in found if n not in names]
        return tuple(names)

    def freed(self, *patterns: str) -> "ParameterSet":
        """Mark the matching parameters as free, by copy."""
        return self._with_parameters({n: replace(self[n], free=True) for n in self.match_names(*patterns)})

    def fixed(self, *patterns: str) -> "ParameterSet":
        """Mark the matching parameters as fixed, by copy."""
        return self._with_parameters({n: replace(self[n], free=False) for n in self.match_names(*patterns)})

    def per_log(self, *patterns: str) -> "ParameterSet":
        """Give each experiment its own value of the matching parameters, by copy."""
        return self._with_parameters({n: replace(self[n], per_log=True) for n in self.match_names(*patterns)})

    def with_values(self, values: Mapping[str, float]) -> "ParameterSet":
        """Give the named parameters new values, by copy; one outside its bounds is an error that names it.

        The sources of the old values go with them.
        """
        edits = {n: self._replace_fields(n, value=float(v), source="", stated=True) for n, v in values.items()}
        return self._with_parameters(edits)

    def with_bounds(self, bounds: Mapping[str, tuple[float, float]]) -> "ParameterSet":
        """Give the named parameters new bounds, by copy."""
        return self._with_parameters({n: self._replace_fields(n, lower=lo, upper=up) for n, (lo, up) in bounds.items()})

    def select(self, names: Iterable[str]) -> "ParameterSet":
        """Keep the named parameters, in that order."""
        return ParameterSet({n: self[n] for n in names})

    def with_prefix(self, prefix: str) -> "ParameterSet":
        """Put `prefix.` before every name."""
        return ParameterSet({f"{prefix}.{n}": p for n, p in self.items()})

    def to_frame(self) -> "pd.DataFrame":
        """Tabulate: a row a parameter, a column a field."""
        import pandas as pd

        fields = ["value", "unit", "lower", "upper", "log", "free", "per_log", "source"]
        rows = {n: [getattr(p, f) for f in fields] for n, p in self.items()}
        return pd.DataFrame.from_dict(rows, orient="index", columns=fields)

    def _replace_fields(self, name: str, **fields: float | str) -> Parameter:
        try:
            return replace(self[name], **fields)  # type: ignore[arg-type]
        except InputError as error:
            if isinstance(error, UnknownNameError):
                raise
            raise InputError(f"{name}: {error}") from None

    def _with_parameters(self, edits: Mapping[str, Parameter]) -> "ParameterSet":
        check_names("parameter", edits, self)
        return ParameterSet({**self._parameters, **edits})


def without_prefix(values: Mapping[str, T], prefix: str) -> dict[str, T]:
    """The entries ``prefix.name`` by their own name."""
    return {n.removeprefix(f"{prefix}."): v for n, v in values.items() if n.startswith(f"{prefix}.")}


def with_prefix(values: Mapping[str, T], prefix: str) -> dict[str, T]:
    """The entries under the name ``prefix.name``."""
    return {f"{prefix}.{n}": v for n, v in values.items()}


# What sensors show: a signal in one of these units varies between samples. With a command's unit here, its steps are
# smeared over a sample; without a sensor's, it comes half a sample late.
MEASURED_UNITS = frozenset(["N", "N*m", "Pa", "Pa(a)", "Pa(g)", "m", "m/s", "m/s^2", "rad", "rad/s", "rad/s^2", "K"])
COMMAND_SUFFIX = "_reference"  # of the name of a set-point, which a controller holds whatever its unit


class Intersample(Enum):
    """How a signal runs between two samples."""

    HELD = "held"
    LINEAR = "linear"


def usual_intersample(name: str, unit: str) -> Intersample:
    """How a signal of this name and SI unit usually runs between two samples.

    A measured force, torque, pressure, motion or temperature is linear, and so is what has no unit; a set-point, and a
    command in any other unit, is held by the controller that gives it.
    """
    measured = (not unit or unit in MEASURED_UNITS) and not name.endswith(COMMAND_SUFFIX)
    return Intersample.LINEAR if measured else Intersample.HELD


def as_tuple(argument: str, given: T | Iterable[T], kind: type[T], meant: str) -> tuple[T, ...]:
    """Make a tuple of one or several objects of a kind; an `InputError` says what the argument takes, as `meant`."""
    if isinstance(given, kind):
        return (given,)
    if isinstance(given, str | PurePath) or not isinstance(given, Iterable):
        raise wrong_argument(argument, given, meant)
    several = tuple(given)
    for one in several:
        if not isinstance(one, kind):
            raise wrong_argument(argument, one if isinstance(given, list | tuple) else given, meant)
    return several


def check_argument(argument: str, given: object, kind: type | tuple[type, ...], meant: str) -> None:
    """Raise `InputError` where an argument is not of its kind, so that swapped ones are named."""
    if not isinstance(given, kind):
        raise wrong_argument(argument, given, meant)


def check_number(
    argument: str, given: object, meant: str, *, least: float = -inf, most: float = inf, whole: bool = False
) -> None:
    """Raise `InputError` where an argument is no number from `least` to `most`, NaN among them, or not whole."""
    if not isinstance(given, Integral if whole else Real) or isinstance(given, bool):
        is_number = isinstance(given, Real) and not isinstance(given, bool)
        raise (
            InputError(f"{argument} takes {meant}; got {given}")
            if is_number
            else wrong_argument(argument, given, meant)
        )
    if not least <= float(given) <= most:
        raise InputError(f"{argument} takes {meant}; got {given}")


def check_parameters(given: object) -> None:
    """Raise `InputError` where `parameters` is no `ParameterSet`."""
    meant = "a ParameterSet, such as read_drive, a fit's .parameters or a loop's .parameters give"
    check_argument("parameters", given, ParameterSet, meant)


def wrong_argument(argument: str, given: Any, meant: str) -> InputError:
    """The error that names the argument, what it takes, and what came."""
    kind = given.__name__ if isinstance(given, type) else type(given).__name__
    came = f"the class {kind}" if isinstance(given, type) else f"an object of type {kind}"
    came = f"{str(given)!r} ({kind})" if isinstance(given, str | PurePath) else came
    return InputError(f"{argument} takes {meant}; got {came}")
