"""Arguments of the verbs: one thing as well as several, and an error that says which argument came as what."""

from collections.abc import Iterable
from math import inf
from numbers import Integral, Real
from pathlib import PurePath
from typing import Any, TypeVar

from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet

T = TypeVar("T")


def as_tuple(argument: str, given: T | Iterable[T], kind: type[T], meant: str) -> tuple[T, ...]:
    """Make a tuple of one or several.

    Parameters
    ----------
    argument : str
        Its name, for the message.
    given : object of `kind`, or an iterable of them
    meant : str
        What the argument takes, for the message.

    Raises
    ------
    InputError
        If something else came.

    Examples
    --------
    >>> as_tuple("sizes", 2.0, float, "a float or several"), as_tuple("sizes", [1.0, 2.0], float, "a float or several")
    ((2.0,), (1.0, 2.0))
    """
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
    """Raise `InputError` where an argument is no number from `least` to `most`, NaN among them, or not whole.

    Examples
    --------
    >>> check_number("members", 40, "a whole number of at least 5", least=5, whole=True)
    >>> check_number("members", 4, "a whole number of at least 5", least=5, whole=True)
    Traceback (most recent call last):
    ...
    pneuopt.quantities.errors.InputError: members takes a whole number of at least 5; got 4
    """
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
