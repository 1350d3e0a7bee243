"""What a command says of an error that a user can mend, and the status with which it then ends."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from pneuopt.cli.run import interruption_status
from pneuopt.cli.tolerances import EXIT_BAD_INPUT, EXIT_FAILURE, EXIT_INTERRUPTED
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning
from pneuopt.quantities.output import read_once


@contextmanager
def report_errors() -> Iterator[None]:
    """Turn an error that a user can mend into one message and an exit status, and a `PhysicsWarning` into one line."""
    try:
        with warnings.catch_warnings(), read_once():
            warnings.simplefilter("always", PhysicsWarning)
            warnings.showwarning = _warning_printer()
            yield
    except InputError as error:
        _say(f"error: {error}")
        raise typer.Exit(EXIT_BAD_INPUT) from None
    except ConvergenceError as error:
        _say(f"NOT converged: {error}")
        raise typer.Exit(EXIT_FAILURE) from None
    except KeyboardInterrupt:
        _say("interrupted: no file was left half-written")
        raise typer.Exit(interruption_status() or EXIT_INTERRUPTED) from None


def _say(sentence: str) -> None:
    """Say a sentence on standard error, on a terminal in lines that end between words."""
    from pneuopt.cli.shared import make_console, show_sentence

    show_sentence(make_console(error=True), sentence)


def _warning_printer() -> Callable[..., None]:
    """A function that prints each warning once, as soon as it comes."""
    printed: set[str] = set()

    def print_warning(message: Warning | str, *_: object) -> None:
        line = f"warning: {message}"
        if line not in printed:
            printed.add(line)
            _say(line)

    return print_warning
