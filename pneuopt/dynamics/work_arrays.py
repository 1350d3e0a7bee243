"""`WorkArrays`: LSODA restarts with the work arrays that it had; SciPy 1.17 never frees those that a run has seen.

A sampled loop restarts at each sample: a megabyte of lost arrays for each second that is simulated at 1 kHz.
"""

from typing import Any

from pneuopt.quantities.arrays import Array


class WorkArrays:
    """The work arrays of an integration, one pair for all its restarts."""

    def __init__(self) -> None:
        self._kept = list[Array]()

    def give_to(self, solver: Any) -> None:
        """Let SciPy's LSODA, just restarted, work in these; in its own the first time.

        Parameters
        ----------
        solver : ode or LSODA
            SciPy's. No public name leads to its arrays: one that does not show them where this one does keeps its own,
            with the same answer.
        """
        integrator: Any = getattr(getattr(solver, "_lsoda_solver", solver), "_integrator", None)
        fresh = [getattr(integrator, name, None) for name in ("rwork", "iwork")]
        handed = getattr(integrator, "call_args", [])[4:6]
        if len(handed) != len(fresh) or any(a is None or a is not b for a, b in zip(fresh, handed, strict=True)):
            return
        self._kept = self._kept or handed
        for own, new in zip(self._kept, fresh, strict=True):
            own[:] = new
        integrator.call_args[4:6] = integrator.rwork, integrator.iwork = self._kept
