"""`ProgressLines`: what a long computation says on its way, a line every few seconds on standard error."""

import sys

import pneuopt as po

PAUSE = 5.0
"""Time between two lines [s]: less fills a record, more looks like a hang."""


class ProgressLines:
    """A `progress=` of a step of a script.

    Parameters
    ----------
    step : str
        What the script calls it; said at the begin of each line.
    """

    def __init__(self, step: str) -> None:
        self._step, self._said = step, -PAUSE

    def __call__(self, report: po.Progress) -> None:
        """Print a report, unless the one before is young."""
        if report.seconds - self._said >= PAUSE:
            self._said = report.seconds
            print(f"{self._step}, {report.seconds:.0f} s: {report}", file=sys.stderr, flush=True)
