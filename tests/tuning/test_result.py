"""The certificate of a search's point: limits, objective and defects decide, each by the independent figures."""

from collections.abc import Sequence

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.requirements import IAE
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.status import Code
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.screening import Screening
from pneuopt.tuning.tune import prepare_search, prepare_task


def certify_gains(Kp: float, Ki: float, accept: Sequence[Defect] = ()) -> TuningResult:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    given = loop.parameters.with_bounds({"pid.Kp": (0.0, 10.0), "pid.Ki": (0.0, 100.0)}).freed("pid.Kp", "pid.Ki")
    task = prepare_task(loop, Step(1.0), given, specify(IAE()), accept=accept)
    return prepare_search(task, Screening()).certify_point(np.array([Kp, Ki]))


def test_an_unstable_design_is_refused_unless_it_is_accepted_by_name() -> None:
    refused = certify_gains(0.5, 30.0)
    assert refused.status.code is Code.NOT_CERTIFIED
    assert "unstable" in refused.status.sentences[0]
    assert refused.parameters.value("pid.Ki") != 30.0
