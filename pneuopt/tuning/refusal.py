"""`confirm_refusal`: before a certificate's refusal stands, a second search under the same certificate.

A search hands over one design, its best. Where that hunts, creeps, or breaks a limit after its horizon, others that
are worse by the objective may hold. The second search looks for designs with room to every limit, over the horizon and
over a longer one, and certifies several that lie apart.
"""

from dataclasses import replace

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.certifier import certified_objective
from pneuopt.tuning.confirmation import describe_confirmation, find_candidates
from pneuopt.tuning.relaxation import limit_excess
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.search import Search, end_point


def confirm_refusal(search: Search, refused: TuningResult) -> tuple[TuningResult, bool]:
    """A design that the certificate lets through, or the refused one's result, which says that none was found.

    The second tells whether a design stands whose improvement was interrupted.

    Parameters
    ----------
    search : Search
        Whose design was refused.
    refused : TuningResult
    """
    resting = search.among_resting()
    longer = resting.lengthen(rests=True)
    try:
        points, count = find_candidates(lambda at: _excess(resting, longer, at), search.space, search.progress)
        for k, point in enumerate(points):
            search.progress(f"certifying candidate {k + 1} of {len(points)} of the second search")
            held = search.certify_point(point)
            if held.status.converged:
                words = f"the first search's design was refused ({refused.status.verdict}); better ones may exist"
                best, is_stopped = _improve(search, longer, held)
                return replace(best, status=best.status.with_details(words)), is_stopped
    except KeyboardInterrupt:
        sentences = (f"nothing found so far: {refused.status.verdict}", "run again for an answer")
        return replace(refused, status=Status(Code.INTERRUPTED, sentences)), False
    failed = f"of {len(points)} designs that it finds none is certified" if points else "finds none that comes to rest"
    words = f"{describe_confirmation(count)}, {failed}, either"
    stats = {**refused.stats, "confirmation.simulations": float(count)}
    return replace(refused, status=refused.status.with_details(words), stats=stats), False


def _excess(resting: Search, longer: Search, points: Array) -> Array:
    """The largest relative excess over a limit; of points that keep all of them, over the longer horizon as well."""
    found = _excess_within(resting, points)
    kept = found <= 0
    if kept.any() and longer is not resting:
        found[kept] = np.maximum(found[kept], _excess_within(longer, points[kept]))
    return found


def _excess_within(search: Search, points: Array) -> Array:
    """The largest relative excess over a limit within a search's horizon, in which the response has to settle."""
    spec = search.tighten(0.0)
    return limit_excess(search.simulator.coarse(spec).values(points, spec), spec)


def _improve(search: Search, longer: Search, held: TuningResult) -> tuple[TuningResult, bool]:
    """A design that is certified, or a better one that a short search about it finds; whether that was interrupted."""
    margin = search.method.margin
    try:
        found = longer.find(margin, end_point(held, search.space), 1)
        if not (found.is_complete and found.status.converged):
            return held, found.status.code is Code.INTERRUPTED
        better = search.certify_roundings(search.restate(found), margin)
    except KeyboardInterrupt:
        return held, True
    before, after = (certified_objective(search.spec, result) for result in (held, better))
    return (better if better.status.converged and after < before else held), False
