"""`advise`: what would let a design hold on more plants, computed from those on which it was tried."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.expected_plants import PlantAxis
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import metric_name, requirement_values, user_limit
from pneuopt.evaluation.specification import Specification

if TYPE_CHECKING:
    import pandas as pd

# Defects that the lanes of a simulation show, by the metric that has no finite figure then.
LANE_DEFECTS = {"SettlingTime": Defect.NEVER_SETTLES, "MaxSensitivity": Defect.UNSTABLE}
NO_REST = "has no rest"  # of a plant on which the loop cannot wait for its step
DEFECT_WORDS = frozenset({NO_REST, *(defect.value for defect in Defect)})
# Digits to which a relaxed limit is rounded, away from what is asked; fewer give away more than is needed.
RELAXED_DIGITS = 3
# Parameters that an advice names, at most: more are no longer a hint where the trouble comes from.
MAX_ADVISED_AXES = 3


def find_breaks(row: Mapping[str, float], spec: Specification, accept: Collection[Defect] = ()) -> tuple[str, ...]:
    """What breaks on a plant: defects, then limits by the name of their metric.

    Parameters
    ----------
    row : mapping of str to float
        Its metrics, SettlingTime and MaxSensitivity among them.
    spec : Specification
    accept : collection of Defect
        Defects that do not count.
    """
    defects = {n: defect.value for n, defect in LANE_DEFECTS.items() if not math.isfinite(row[n])}
    limits = [metric_name(q) for q in spec.violations(requirement_values(row))]
    named = [word for word in defects.values() if Defect(word) not in accept]
    return (*named, *(n for n in limits if n not in defects))


def advise(
    loop: ClosedLoop,
    spec: Specification,
    plants: "pd.DataFrame",
    broken: Mapping[str, tuple[str, ...]],
    certified: "pd.DataFrame",
    axes: Mapping[PlantAxis, "pd.DataFrame"],
) -> tuple[tuple[str, ...], tuple[PlantAxis, ...]]:
    """Advice where a design breaks on plants: what to relax, and what to tune over.

    Parameters
    ----------
    loop : ClosedLoop
        Gives the units.
    spec : Specification
    plants, certified : DataFrame
        Of a `DesignValidation`.
    broken : mapping of str to tuple of str
        Likewise.
    axes : mapping of PlantAxis to DataFrame
        Of what varies the metrics with that alone at its low and its high end, a column each.

    Returns
    -------
    sentences : tuple of str
    suggested : tuple of PlantAxis
        What of it to tune over.
    """
    if not broken:
        return (), ()
    suggested, reason = _culprits(spec, axes)
    names = " and ".join(a.label for a in suggested)
    remedy = f"{reason}: {names}; tune over that too" if names else "tune over such plants: add them to the scenarios"
    return (*_relaxation(loop, spec, plants, broken, certified), remedy), suggested


def _relaxation(
    loop: ClosedLoop,
    spec: Specification,
    plants: "pd.DataFrame",
    broken: Mapping[str, tuple[str, ...]],
    certified: "pd.DataFrame",
) -> list[str]:
    """With which limits the same gains hold on all plants but those where no limit helps."""
    lost = [n for n, found in broken.items() if DEFECT_WORDS & set(found)]
    sound = plants.loc[[n for n in plants.index if n not in lost]]
    limits = [q for q in spec.limits if any(metric_name(q) in broken.get(str(n), ()) for n in sound.index)]
    own = [str(c) for c in certified if not any(str(c).endswith(f"[{n}]") for n in lost)]
    texts = [_relaxed_limit(q, [*sound[metric_name(q)], *certified[own].T[metric_name(q)]], loop) for q in limits]
    sentences = [f"with {' and '.join(texts)} these gains hold on {len(sound)} of {len(plants)}"] if texts else []
    count = f"{len(lost)} plant{'s' if len(lost) > 1 else ''}"
    return [*sentences, *([f"no relaxed limit helps on {count}, where the loop fails"] if lost else [])]


def _relaxed_limit(requirement: Requirement, values: Sequence[float], loop: ClosedLoop) -> str:
    """The limit that the worst value keeps, rounded away from what is asked: "Overshoot <= 4.44 %"."""
    metric, least = requirement.metric, requirement.metric.sense is Sense.AT_LEAST
    worst = max(values, key=metric.requirement_value)
    digit = 10.0 ** (math.floor(math.log10(abs(worst))) + 1 - RELAXED_DIGITS)
    value = (math.floor if least else math.ceil)(worst / digit) * digit
    unit = metric.shown_unit(loop.command.unit, loop.feedback.unit)
    asked = metric.factor * (user_limit(requirement) or 0.0)
    return f"{metric.name} {'>=' if least else '<='} {value:.{RELAXED_DIGITS}g} {unit}".strip() + f" (now {asked:.4g})"


def _culprits(spec: Specification, axes: Mapping[PlantAxis, "pd.DataFrame"]) -> tuple[tuple[PlantAxis, ...], str]:
    """What breaks a limit on its own, the worst first; else what comes nearest to it."""
    ends = {a: [{str(n): v for n, v in row.items()} for row in found.to_dict().values()] for a, found in axes.items()}
    worst = {a: max((_worst_excess(row, spec) for row in rows), default=math.inf) for a, rows in ends.items()}
    order = sorted(worst, key=lambda a: -worst[a])
    alone = [a for a in order if worst[a] > 0]
    if alone:
        return tuple(alone[:MAX_ADVISED_AXES]), "what breaks it most, each alone"
    return tuple(order[:MAX_ADVISED_AXES]), "nothing breaks it alone, most is done by"


def _worst_excess(row: Mapping[str, float], spec: Specification) -> float:
    """By what share the worst limit is exceeded; infinite where the loop never settles or is unstable."""
    if not all(math.isfinite(row[n]) for n in LANE_DEFECTS):
        return math.inf
    return max(spec.excess(requirement_values(row)).values(), default=-math.inf)
