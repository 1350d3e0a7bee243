"""`python -m pneuopt`, and what the command `pneuopt` starts."""

from collections.abc import Callable
from typing import NoReturn

from pneuopt.cli.guard import run_guarded


def main() -> NoReturn:
    """Run the command line and end the process."""
    run_guarded(_load_app)


def _load_app() -> Callable[[], object]:
    from pneuopt.cli.app import app

    return app


if __name__ == "__main__":
    main()
