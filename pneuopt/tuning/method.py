"""`Method`: what a way to tune must offer; `TuningTask`, which it is given, and `SearchResult`, which it returns.

`Agreement`: how many of a search's starts end in the best optimum, and how likely is one that none has seen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, isnan, nan
from typing import Protocol

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.scenarios import Scenarios
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import check_number
from pneuopt.quantities.status import ProgressCallback, Status
from pneuopt.shooting.full_space import Solution
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space


@dataclass(frozen=True, eq=False)
class TuningTask:
    """A loop, its references and scenarios, its free gains, what is asked of them, and defects that are accepted."""

    loop: ClosedLoop
    references: tuple[Reference, ...]
    scenarios: Scenarios
    space: Space
    spec: Specification
    accept: tuple[Defect, ...] = ()
    to_beat: float = inf  # an objective: a search that lags far behind it is given up

    @property
    def horizon(self) -> float:
        """The shortest record after a step [s]."""
        return min(r.horizon - r.at for r in self.references)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The point (n,) that a method found, before rounding, with the limits and bounds that are active there.

    `optimum` is the objective there, NaN where the method has none; `is_complete`: no Ctrl-C has ended the search.
    `others` (n,) are points apart in which it ended as well, the best first; `finalists` (k, n) lie apart from each
    other and are hardly worse.
    """

    point: Array
    status: Status
    active: tuple[str, ...]
    stats: Mapping[str, float] = field(default_factory=dict)
    optimum: float = nan
    simulations: int = 0
    agreement: "Agreement | None" = None
    is_complete: bool = True
    uses_simulator: bool = False
    others: tuple[Array, ...] = ()
    finalists: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def figures(self) -> dict[str, float]:
        """All figures as a `TuningResult.stats` shows them."""
        own = {} if self.agreement is None else self.agreement.stats
        own |= {} if isnan(self.optimum) else {"optimum": self.optimum}
        own |= {"simulations": float(self.simulations)} if self.simulations else {}
        return {**self.stats, **own}


class LimitPath(Protocol):
    """A problem that is prepared once and solved for one set of limits after the other."""

    def follow(self, start: Array, specs: Sequence[Specification]) -> list[Solution]:
        """Solve for one specification after the other, the first from gains of shape (n,), each from the one before."""


def check_method_options(method: "Method") -> None:
    """Refuse a margin, digits and a seed that are no numbers; `InputError` names the method and the option."""
    kind = type(method).__name__
    check_number(f"{kind}: margin", method.margin, "a fraction, as 0.03")
    if method.digits is not None:
        check_number(f"{kind}: digits", method.digits, "a whole number, or None for all", whole=True)
    check_number(f"{kind}: seed", getattr(method, "seed", 0), "a whole number, not below 0", least=0, whole=True)


class Method(Protocol):
    """A way to tune; nothing else asks for its type. A new one is a class, and a row in `METHODS`."""

    @property
    def margin(self) -> float:
        """By what fraction its limits are tighter than those asked for."""

    @property
    def peak_margin(self) -> float:
        """The share of `margin` by which limits on peaks of command and sensitivity are tightened."""

    @property
    def linear_margin(self) -> float:
        """Likewise on the sensitivities and the noise gain of a loop whose plant is linear."""

    @property
    def digits(self) -> int | None:
        """To how many significant digits the gains are rounded; None: not at all."""

    @property
    def parameters_without_effect(self) -> tuple[str, ...]:
        """Parameters on which its problem does not depend: they stay as given."""

    @property
    def successor(self) -> "Method | None":
        """The method to try next where this one was chosen by default and fails; None: its answer is final."""

    def check(self, task: TuningTask) -> None:
        """Refuse a task that it cannot tune: `InputError` names the reason and the remedy."""

    def suits(self, task: TuningTask) -> bool:
        """Whether it is to be chosen before those that follow it in `METHODS`; it can tune any task that it suits."""

    def find(
        self,
        task: TuningTask,
        simulator: Simulator,
        spec: Specification,
        start: Array,
        attempt: int,
        progress: ProgressCallback,
    ) -> SearchResult:
        """Search for the best point from a start (n,); Ctrl-C ends a search by simulation with the best so far.

        `attempt` counts the certificates that have failed; from 1 on `start` is the point found with less margin.
        """

    def shorten(self, margin: float, share: float = 1.0) -> "Method":
        """The method for a short search from a point that is close; of one that is closer still a share will do."""

    def limit_path(self, task: TuningTask, spec: Specification) -> LimitPath | None:
        """The problem prepared for moving limits, `spec` the first, tightened; None where each needs a new search."""


@dataclass(frozen=True)
class Agreement:
    """How many starts end in the best optimum, and what their ends tell of optima that were missed.

    `converged` and `optima`, the starts that end in an optimum and the different ones among them, are None where the
    method does not tell them apart; `spread` is the relative excess of the worst, or then of the second best. `unseen`
    is the chance that one start more ends in another optimum: of w optima from n independent starts
    ``w (w + 1)/(n (n - 1))`` (C. G. E. Boender and A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global
    optimization methods, Math. Program. 37 (1987) 59-80); fewer than three tell nothing, NaN.
    """

    starts: int
    agreeing: int
    converged: int | None = None
    optima: int | None = None
    spread: float = nan
    unseen: float = nan

    @property
    def stats(self) -> dict[str, float]:
        """The figures as a result's `stats` names them: "starts", "starts_agreeing" and so on."""
        found = {"starts": float(self.starts), "starts_agreeing": float(self.agreeing)}
        if self.converged is None or self.optima is None:
            return found | ({"starts_spread": self.spread} if isfinite(self.spread) else {})
        found |= {"starts_converged": float(self.converged), "starts_optima": float(self.optima)}
        return found | {"starts_spread": self.spread, "starts_unseen": self.unseen}


def compare_starts(objectives: Sequence[float], tolerance: float) -> Agreement:
    """Compare the objectives in which starts end, infinite where one found nothing, to within a relative tolerance."""
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
    return Agreement(len(objectives), agreeing, n, w, spread, unseen)


def describe_agreement(found: Agreement | None) -> tuple[str, str]:
    """Words on the agreement of a result's starts, and a sentence where some do not agree; empty where none ended."""
    if found is None or not found.starts:
        return "", ""
    words = f"{found.agreeing} of {found.starts} starts agree"
    if found.converged is None and found.agreeing < 2 and found.spread > 0:  # the spread is that of the two best
        return f"{words}, the next ends {100 * found.spread:.2g} % worse", ""
    if found.converged in (None, found.agreeing) or not found.spread > 0:
        return words, ""
    worse = f"others end up to {100 * found.spread:.2g} % worse"
    chance = f"one start more would find another optimum with a chance of {100 * found.unseen:.0f} %"
    return words, f"{worse}, {chance}" if isfinite(found.unseen) else worse
