"""Ctrl-C, and checks that a caller asks for, end a run that goes on."""

import signal
import threading
import time
from unittest.mock import Mock

import pytest
from numpy.testing import assert_array_equal

from pneuopt.dynamics.compiled.rollout import Rollout, check_during_runs
from tests.dynamics.compiled.test_rollout import Case, needs_compiler

ENDLESS = 2**31 - 1  # steps a sample, as many as a C int counts


class StopRunError(Exception):
    """What a check raises."""


@needs_compiler
@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_ends_machine_code_that_would_run_for_minutes(threads: int) -> None:
    """2e9 steps of 0.1 us; without the flag that the loop reads, this test takes minutes."""
    case = Case("stribeck")
    rollout, main = case.rollout(threads=threads), threading.main_thread().ident
    assert main is not None
    alarm = threading.Timer(0.3, signal.pthread_kill, (main, signal.SIGINT))
    alarm.start()
    begun = time.process_time()
    with pytest.raises(KeyboardInterrupt):
        rollout.run(case.x0, case.u, case.p, case.t, case.h, substeps=ENDLESS)
    assert time.process_time() - begun < 10 * threads  # CPU time: .3 s on an idle machine
    alarm.join()
    assert_array_equal(case.run(rollout).y, case.run(case.rollout(threads=threads)).y)


@needs_compiler
def test_a_check_ends_machine_code_that_would_run_for_minutes() -> None:
    case, checks = Case("stribeck"), list[int]()

    def check() -> None:
        checks.append(1)
        if len(checks) == 3:
            raise StopRunError

    with pytest.raises(StopRunError), check_during_runs(check):
        case.rollout(threads=2).run(case.x0, case.u, case.p, case.t, case.h, substeps=ENDLESS)
    case.run(case.rollout(threads=2))
    assert len(checks) == 3  # before the run, twice during it, and none of the run outside


@pytest.mark.parametrize("lanes", [pytest.param(None, marks=needs_compiler), 0])
def test_a_check_ends_what_has_not_begun(lanes: int | None) -> None:
    case = Case("stribeck")
    with pytest.raises(StopRunError), check_during_runs(Mock(side_effect=StopRunError)):
        case.run(Rollout(case.system.pieces, lanes=lanes))
