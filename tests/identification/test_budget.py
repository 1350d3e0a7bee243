"""The CPU time that an identification may take."""

import sys
import time

import numpy as np
import pytest

from pneuopt.identification.budget import CpuBudgetSpent
from pneuopt.identification.identify import identify
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.quantities.trajectories import Trajectory

identify_module = sys.modules[identify.__module__]
SYSTEM = ForceDrive(Stribeck()).system()
FREE = ("friction.coulomb", "friction.viscous")


def another_plants_log() -> tuple[Experiment, ParameterSet]:
    """A drive that no friction explains: it is pulled back, too."""
    t = np.arange(600) * 1e-3
    force = 60 * np.sin(2 * np.pi * 4 * t)
    position = 0.02 * np.sin(2 * np.pi * 4 * t - 2.5) + 0.002 * np.sin(2 * np.pi * 17 * t)
    return Experiment(Trajectory(t, {"force": force, "position": position}), {"position": 1e-6}), SYSTEM.parameters


def clock(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    """A CPU clock that a look at it moves on [s]."""
    seconds = iter(np.arange(0.0, 1e6, step))
    monkeypatch.setattr(time, "process_time", lambda: float(next(seconds)))


def test_when_the_cpu_time_is_over_the_best_so_far_is_handed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    log, given = another_plants_log()
    clock(monkeypatch, 0.1)
    fit = identify(SYSTEM, log, given.freed(*FREE), cpu_seconds=1.0, accept=["work"], throw=False)
    assert fit.status.code is Code.INTERRUPTED
    assert fit.status.verdict.startswith("1 CPU seconds were over: the best ")
    assert "give more CPU seconds, or a part of the logs" in fit.status.sentences
    assert "run again for an answer" not in fit.status.sentences
    clock(monkeypatch, 0.1)
    with pytest.raises(ConvergenceError, match="1 CPU seconds were over"):
        identify(SYSTEM, log, given.freed(*FREE), cpu_seconds=1.0, accept=["work"])


def test_no_time_at_all_and_too_little_for_a_fit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    log, given = another_plants_log()
    with pytest.raises(InputError, match="cpu_seconds must be positive, got 0"):
        identify(SYSTEM, log, given.freed(*FREE), cpu_seconds=0.0)

    def interrupted(*_: object, **__: object) -> None:
        raise CpuBudgetSpent

    monkeypatch.setattr(identify_module, "fit_from_starts", interrupted)
    with pytest.raises(InputError, match="1 CPU seconds were over before the first fit; give more"):
        identify(SYSTEM, log, given.freed(*FREE), cpu_seconds=1.0, accept=["work"])
