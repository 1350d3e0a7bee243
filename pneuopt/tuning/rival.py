"""The rival of a dithered design, tuned without dither, and the choice between the two.

A dither is handed out only where `judge_dither` finds it useful on the signal with its ripple, against gains that were
tuned without one; it costs air, and the valve's life.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.evaluation.dither import CRITERIA, NO_RIVAL, DitherVerdict, Usefulness, judge_dither
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.search import Search, certified_objective, end_point
from pneuopt.tuning.space import Space


@dataclass(frozen=True, eq=False)
class DitherChoice:
    """The design that is handed out and the search that found it, with the verdict on its dither and what is said.

    `rival` are the other design's tuned parameters.
    """

    search: Search
    result: TuningResult
    verdict: DitherVerdict | None = None
    rival: Mapping[str, float] = field(default_factory=dict)
    words: str = ""


def weigh_dither(search: Search, result: TuningResult, asked: Specification) -> DitherChoice:
    """The certified design with the verdict on its dither, or the one without, where the dither is not useful.

    `asked` is what the rival has to keep, whose signal is its own mean. Nothing is weighed without a certificate,
    without a dither that may be left out, or where the mean was asked for by name. Ctrl-C raises.
    """
    design, space, task = result.parameters, search.space, search.task
    by_name = search.spec.concerns(SettlingTime) and search.spec.settling is SettlingTime
    if not result.status.converged or DITHER_AMPLITUDE not in space.names or by_name:
        return DitherChoice(search, result)
    if space.parameters[DITHER_AMPLITUDE].lower > 0:
        return DitherChoice(search, result)
    other = rival_search(search, result, asked)
    rival, refused = None, "no gain is free beside the dither"
    if other is not None:
        try:
            rival = other.run()
            refused = rival.status.verdict
        except InputError as error:  # an encoder's counts may hide the band from a loop without dither
            refused = str(error)
    if rival is not None and rival.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    without = rival.parameters if rival is not None and rival.status.converged else None
    if design.value(DITHER_AMPLITUDE) == 0:
        return _choose_undithered(search, result, asked, other, rival)
    try:
        verdict = judge_dither(task.loop, task.references, design, without=without, band=task.spec.band)
    except ConvergenceError as error:
        return DitherChoice(search, result, words=f"no verdict on the dither: {error}")
    if other is None or rival is None or without is None:
        words = f"no gains were certified without dither: {refused}"
        reasons = tuple(words if reason == NO_RIVAL else reason for reason in verdict.reasons)
        return DitherChoice(search, result, replace(verdict, reasons=reasons), words=words)
    if verdict.usefulness is Usefulness.USEFUL:
        return DitherChoice(search, result, verdict, {n: without.value(n) for n in space.names})
    left_out = {n: design.value(n) for n in space.names}
    return DitherChoice(other, rival, verdict, left_out, f"left out: {str(verdict).splitlines()[0]}")


def _choose_undithered(
    search: Search, result: TuningResult, asked: Specification, other: Search | None, rival: TuningResult | None
) -> DitherChoice:
    """The better of two designs without dither; the first, whose signal is its own mean, as `asked` tells it."""
    plain = search.with_specification(asked, search.method)
    same = plain.certify_point(end_point(result, search.space), agreement=result.agreement)
    told = replace(same, stats={**result.stats, **same.stats}, finalists=result.finalists)
    choice = DitherChoice(plain, told) if told.status.converged else DitherChoice(search, result)
    if other is None or rival is None or not rival.status.converged:
        return choice
    before, after = (certified_objective(s.spec, r) for s, r in ((choice.search, choice.result), (other, rival)))
    return DitherChoice(other, rival) if after < before else choice


def rival_search(search: Search, result: TuningResult, asked: Specification) -> Search | None:
    """The search without dither, from the gains that were given; None where no gain beside the dither is free.

    A start at the dithered gains would favour the dither. It is given up where its first start ends so far behind that
    no verdict could prefer it.
    """
    names = tuple(n for n in search.space.names if n not in (DITHER_AMPLITUDE, DITHER_FREQUENCY))
    if not names:
        return None
    search.progress("tuning without dither")
    plain = switch_off_dither(search.space.parameters)
    to_beat = certified_objective(search.spec, result) * (1 + CRITERIA["SettlingTimeRaw"].relative)
    task = replace(search.task, space=Space(plain, names), spec=asked, to_beat=to_beat)
    return Search(task, search.method, search.progress)


def switch_off_dither(parameters: ParameterSet) -> ParameterSet:
    """The parameters with the dither's amplitude fixed at 0."""
    plain = parameters.with_bounds({DITHER_AMPLITUDE: (0.0, parameters[DITHER_AMPLITUDE].upper)})
    return plain.with_values({DITHER_AMPLITUDE: 0.0}).fixed(DITHER_AMPLITUDE, DITHER_FREQUENCY)
