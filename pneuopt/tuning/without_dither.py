"""`tune_without_dither`: the rival with which `judge_dither` compares a dithered design."""

from collections.abc import Sequence
from typing import Any

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Reference
from pneuopt.evaluation.specification import Objective
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet, check_parameters
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.tune import tune


def tune_without_dither(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: Objective,
    **options: Any,
) -> TuningResult:
    """Tune the same loop with the dither's amplitude fixed at 0: the rival of a dithered design in `judge_dither`.

    It is a whole search, and takes about as long as that for the design with dither; a warm start at the dithered
    gains alone would favour the dither.

    Parameters
    ----------
    loop : ClosedLoop
    references : Reference or sequence of Reference
    parameters : ParameterSet
        As given to `tune` for the design with dither; the dither's offset stays free if it is.
    minimise : Requirement, mapping of Requirement to weight, or Specification
    **options
        Those of `tune`: `subject_to`, `scenarios`, `method`, `throw` and so on. `plants` are by default none.

    Raises
    ------
    InputError
        If the loop has no dither, or no gain beside the dither's amplitude and frequency is free.
    ConvergenceError
        As `tune`: if no gains without dither keep the limits, for example.

    Examples
    --------
    >>> from pneuopt.control.dither import Dither
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.evaluation.requirements import SettlingTime
    >>> from pneuopt.models.linear import FirstOrder
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False), Dither(50.0))
    >>> given = loop.parameters.with_values({"dither.amplitude": 0.1})
    >>> given = given.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    >>> rival = tune_without_dither(loop, Step(1.0), given, minimise=SettlingTime())
    >>> rival.parameters.value("dither.amplitude")
    0.0
    """
    check_closed_loop(loop)
    check_parameters(parameters)
    require(loop.dither is not None, "this loop has no dither to leave out: tune it with `tune`")
    full = loop.complete(parameters)
    plain = full.with_bounds({DITHER_AMPLITUDE: (0.0, full[DITHER_AMPLITUDE].upper)})
    plain = plain.with_values({DITHER_AMPLITUDE: 0.0}).fixed(DITHER_AMPLITUDE, DITHER_FREQUENCY)
    return tune(loop, references, plain, minimise=minimise, **{"plants": {}, **options})
