"""`judge_compensators`: whether what is added to a command against friction is useful, judged as a dither is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.dither_verdict import (
    NO_RIVAL,
    VERDICT_TONES,
    Usefulness,
    read_endings,
    weigh_changes,
    worst_metrics,
)
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report, report_verdict
from pneuopt.quantities.shown import Result

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class CompensatorVerdict(Result):
    """Verdict of `judge_compensators`: as text, the verdict in the first line and a reason in each further line.

    Attributes
    ----------
    usefulness : Usefulness
    reasons : tuple of str
        What decided, the price, and how the loops end, a sentence each.
    table : DataFrame
        As that of a `DitherVerdict`: a row for each metric, columns "without" and "with".
    baseline : str
        What "without" stands for: the same gains, or gains tuned without the compensators.
    names : tuple of str
        Of the compensators, as in a tuning's file.
    """

    usefulness: Usefulness
    reasons: tuple[str, ...]
    table: "pd.DataFrame"
    baseline: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        parts = " and ".join(f"the {name.replace('_', ' ')}" for name in self.names)
        head = f"{parts} {'are' if len(self.names) > 1 else 'is'} {self.usefulness.value}, against {self.baseline}"
        return "\n".join([head, *(f"  {reason}" for reason in self.reasons)])

    def summary(self) -> Report:
        """The verdict, then a reason a line."""
        return report_verdict(str(self), VERDICT_TONES[self.usefulness])


def judge_compensators(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    without: ParameterSet | None = None,
    band: Band = 0.02,
) -> CompensatorVerdict:
    """Evaluate a loop with its compensators and a rival without them, and say whether they are useful, and why.

    The criteria are those of `judge_dither`, in the same order. A dither that the loop has besides is in both.

    Parameters
    ----------
    loop : ClosedLoop
    references : Reference or sequence of Reference
    parameters : ParameterSet
        Values of the design with the compensators.
    without : ParameterSet, optional
        The rival: values tuned without them. By default the same gains, which are tuned for the compensators, so that
        the verdict is "useful with these gains" at best.
    band : float
        Half width of the settling band, a fraction of the step.

    Raises
    ------
    InputError
        If there is no compensator to judge.
    ConvergenceError
        If a simulation stops.
    """
    check_closed_loop(loop)
    check_parameters(parameters)
    require(bool(loop.compensators), "there is nothing to judge: ClosedLoop(plant, pid, compensators=(Knocker(),))")
    steps, full, bare = as_references(references), loop.complete(parameters), replace(loop, compensators=())
    plain = (full if without is None else full | without).select(bare.parameters)
    before, after = (read_endings(one, steps, p, band) for one, p in ((bare, plain), (loop, full)))
    table, hunts = worst_metrics(before, after), any(e.ending.hunts for e in after)
    narrowest = min(band_share(band, r) for r in steps)
    usefulness, changes = weigh_changes(table, narrowest, loop, [], hunts=hunts)
    notes = [n for which, endings in (("without", before), ("with", after)) for e in endings for n in e.describe(which)]
    rival = "gains tuned without it"
    if without is None:
        usefulness = Usefulness.HELPS_THESE_GAINS if usefulness is Usefulness.USEFUL else usefulness
        rival, notes = "the same gains without it", [*notes, NO_RIVAL]
    names = tuple(c.section for c in loop.compensators)
    return CompensatorVerdict(usefulness, (*changes, *dict.fromkeys(notes)), table, rival, names)
