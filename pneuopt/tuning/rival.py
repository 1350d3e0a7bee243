"""The rival of a dithered design, tuned without dither, and the choice between the two.

A dither is handed out only where `judge_dither` finds it useful on the signal with its ripple, against gains that were
tuned without one; it costs air, and the valve's life.
"""

from dataclasses import replace

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.evaluation.dither import CRITERIA, Usefulness, judge_dither
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.search import Search, certified_objective, end_point
from pneuopt.tuning.space import Space


def weigh_dither(search: Search, result: TuningResult, asked: Specification) -> TuningResult:
    """The certified design with the verdict on its dither, or the one without, where the dither is not useful.

    `asked` is what the rival has to keep, whose signal is its own mean. A result without a certificate, without a
    dither that may be left out, or where the mean was asked for by name, is returned as it is.
    """
    design, space = result.parameters, search.space
    may_go = DITHER_AMPLITUDE in space.names and space.parameters[DITHER_AMPLITUDE].lower == 0
    by_name = search.spec.concerns(SettlingTime) and search.spec.settling is SettlingTime
    if not (result.status.converged and may_go and design.value(DITHER_AMPLITUDE) > 0) or by_name:
        return result
    rival = find_rival(search, result, asked)
    if rival is not None and rival.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    held = rival is not None and rival.status.converged
    task = search.task
    without = rival.parameters if held and rival is not None else None
    try:
        verdict = judge_dither(task.loop, task.references, design, without=without, band=task.spec.band)
    except ConvergenceError as error:
        return replace(result, status=result.status.with_details(f"no verdict on the dither: {error}"))
    refused = "no gain is free beside the dither" if rival is None else rival.status.verdict
    if without is None:
        words = f"no gains were certified without dither: {refused}"
        return replace(result, dither=verdict, status=result.status.with_details(words))
    gains = {n: without.value(n) for n in search.space.names}
    if verdict.usefulness is Usefulness.USEFUL or rival is None:
        return replace(result, dither=verdict, rival=gains)
    left_out = {n: design.value(n) for n in search.space.names}
    words = f"left out: {str(verdict).splitlines()[0]}"
    given = search.space.parameters.with_values(gains)
    return replace(rival, parameters=given, dither=verdict, rival=left_out, status=rival.status.with_details(words))


def find_rival(search: Search, result: TuningResult, asked: Specification) -> TuningResult | None:
    """The tuning without dither, which begins at the dithered gains; None where no gain beside the dither is free.

    It is given up where it lags so far behind that no verdict could prefer it.
    """
    names = tuple(n for n in search.space.names if n not in (DITHER_AMPLITUDE, DITHER_FREQUENCY))
    if not names:
        return None
    search.progress("tuning without dither")
    plain = undithered(search.space.parameters).with_values(
        dict(zip(search.space.names, end_point(result, search.space).tolist(), strict=True)) | {DITHER_AMPLITUDE: 0.0}
    )
    to_beat = certified_objective(search.spec, result) * (1 + CRITERIA["SettlingTimeRaw"].relative)
    task = replace(search.task, space=Space(plain, names), spec=asked, to_beat=to_beat)
    try:
        return Search(task, search.method, search.progress).run()
    except InputError:  # an encoder's counts may hide the band from a loop without dither
        return None


def undithered(parameters: ParameterSet) -> ParameterSet:
    """The parameters with the dither's amplitude fixed at 0."""
    plain = parameters.with_bounds({DITHER_AMPLITUDE: (0.0, parameters[DITHER_AMPLITUDE].upper)})
    return plain.with_values({DITHER_AMPLITUDE: 0.0}).fixed(DITHER_AMPLITUDE, DITHER_FREQUENCY)
