"""`python -m pneuopt`, and what the command `pneuopt` starts."""

import signal
from collections.abc import Callable
from typing import NoReturn


def main() -> NoReturn:
    """Run the command line and end the process."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until somebody listens, Ctrl-C ends this without a traceback
    from pneuopt.cli.run import run_guarded

    run_guarded(_load_app)


def _load_app() -> Callable[[], object]:
    from pneuopt.cli.app import app

    return app


if __name__ == "__main__":
    main()
