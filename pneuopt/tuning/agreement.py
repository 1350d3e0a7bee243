"""Agreement of a search's starts: how many end in the best optimum, and how likely is one that none has seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan


@dataclass(frozen=True)
class Agreement:
    """What the objectives in which several starts end tell of optima that were missed.

    Attributes
    ----------
    starts, converged, agreeing : int
        Starts, those that end in an optimum, and those that end in the best one.
    optima : int
        Different optima among them.
    spread : float
        Relative excess of the worst of them over the best; NaN without two.
    unseen : float
        The chance that one start more ends in an optimum that none has seen, by C. G. E. Boender and A. H. G. Rinnooy
        Kan, Bayesian stopping rules for multistart global optimization methods, Math. Program. 37 (1987) 59-80: with w
        optima from n starts ``w (w + 1)/(n (n - 1))``. It takes starts as independent; NaN of fewer than three, which
        tell nothing.

    Examples
    --------
    >>> found = compare_starts([0.94, 0.9402, 1.223, float("inf")], 1e-3)
    >>> found.converged, found.agreeing, found.optima, round(found.spread, 3), found.unseen
    (3, 2, 2, 0.301, 1.0)
    """

    starts: int
    converged: int
    agreeing: int
    optima: int
    spread: float
    unseen: float

    @property
    def stats(self) -> dict[str, float]:
        """The figures as a result's `stats` names them: "starts", "starts_agreeing" and so on."""
        figures = {"_converged": self.converged, "_agreeing": self.agreeing, "_optima": self.optima}
        return {
            "starts": float(self.starts),
            **{f"starts{n}": float(v) for n, v in figures.items()},
            "starts_spread": self.spread,
            "starts_unseen": self.unseen,
        }


def compare_starts(objectives: Sequence[float], tolerance: float) -> Agreement:
    """Compare the objectives in which starts end.

    Parameters
    ----------
    objectives : sequence of float
        Infinite where a start found nothing.
    tolerance : float
        Relative difference of two objectives below which they count as one optimum.
    """
    found = sorted(value for value in objectives if isfinite(value))
    best, n = found[0] if found else inf, len(found)
    optima = list[float]()
    for value in found:
        if not optima or value - optima[-1] > tolerance * abs(optima[-1]):
            optima.append(value)
    w = len(optima)
    agreeing = sum(value - best <= tolerance * abs(best) for value in found)
    spread = (found[-1] - best) / abs(best) if n > 1 and best else nan
    unseen = min(1.0, w * (w + 1) / (n * (n - 1))) if n > 2 else nan
    return Agreement(len(objectives), n, agreeing, w, spread, unseen)


def describe_agreement(stats: Mapping[str, float]) -> tuple[str, str]:
    """Words on the agreement of a result's starts, and a sentence where some do not agree; empty where none has ended.

    Examples
    --------
    >>> print(*describe_agreement(compare_starts([0.94, 0.94, 0.94, 1.223], 1e-3).stats), sep="; ")
    3 of 4 starts agree; others end up to 30 % worse, one start more would find another optimum with a chance of 50 %
    """
    if not stats.get("starts"):
        return "", ""
    agreeing, starts = stats["starts_agreeing"], stats["starts"]
    words = f"{agreeing:.0f} of {starts:.0f} starts agree"
    if agreeing == stats.get("starts_converged", starts) or not stats.get("starts_spread", nan) > 0:
        return words, ""
    unseen, worse = stats.get("starts_unseen", nan), f"others end up to {100 * stats['starts_spread']:.2g} % worse"
    chance = f"one start more would find another optimum with a chance of {100 * unseen:.0f} %"
    return words, f"{worse}, {chance}" if isfinite(unseen) else worse
