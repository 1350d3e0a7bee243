"""What a certificate refuses, whatever was asked of a design."""

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import Certificate, Defect, certificate
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.parameters import ParameterSet


def second_order(Kp: float, Ki: float) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    return loop, loop.parameters.with_values({"pid.Kp": Kp, "pid.Ki": Ki})


def routh_limit(parameters: ParameterSet, Kp: float) -> float:
    """The largest Ki of a PI controller on ``K w^2/(s^2 + 2 d w s + w^2)``: ``2 d w (1 + K Kp)/K``."""
    K, w, d = (parameters.value(n) for n in ("plant.gain", "plant.natural_frequency", "plant.damping"))
    return float(2 * d * w * (1 + K * Kp) / K)


def defects(found: Certificate) -> list[Defect]:
    return [finding.defect for finding in found.findings]


def test_a_loop_on_either_side_of_the_limit_of_stability() -> None:
    loop, values = second_order(0.5, 1.0)
    limit = routh_limit(values, 0.5)
    found = [certificate(loop, Step(1.0), second_order(0.5, share * limit)[1]) for share in (0.3, 1.05)]
    assert Defect.UNSTABLE not in defects(found[0])
    assert Defect.UNSTABLE in defects(found[1])
    assert "unstable" in found[1].findings[0].sentence
    assert np.array_equal([bool(np.all(f.margins["stable"])) for f in found], [True, False])
