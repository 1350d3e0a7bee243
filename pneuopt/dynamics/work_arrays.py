"""`WorkArrays`: LSODA restarts with the work arrays that it had; SciPy 1.17 never frees those that a run has seen.

A sampled loop restarts at each sample: a megabyte of lost arrays for each second that is simulated at 1 kHz.
"""

from typing import Any

from pneuopt.quantities.arrays import Array


class WorkArrays:
    """The work arrays of an integration, one pair for all its restarts."""

    def __init__(self) -> None:
        self._kept = list[Array]()

    def give_to(self, integrator: Any) -> None:
        """Let SciPy's LSODA, just restarted, work in these; in its own the first time.

        Parameters
        ----------
        integrator : lsoda
            SciPy's: `_integrator` of an `ode`.
        """
        fresh = integrator.call_args[4:6]
        self._kept = self._kept or fresh
        for own, new in zip(self._kept, fresh, strict=True):
            own[:] = new
        integrator.call_args[4:6] = integrator.rwork, integrator.iwork = self._kept
