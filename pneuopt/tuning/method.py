"""`Method`: what a way to tune has to answer, the task that it gets, and the result that it hands over."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.evaluation.scenarios import Scenarios
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import ProgressCallback, Status
from pneuopt.shooting.solution import Solution
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space


@dataclass(frozen=True, eq=False)
class TuningTask:
    """What is to be tuned, everything checked.

    Attributes
    ----------
    loop : ClosedLoop
    references : tuple of Step
    scenarios : mapping of str to mapping
    space : Space
        The free gains, and every parameter of the loop.
    spec : Specification
        As asked for.
    """

    loop: ClosedLoop
    references: tuple[Step, ...]
    scenarios: Scenarios
    space: Space
    spec: Specification

    @property
    def horizon(self) -> float:
        """The shortest record after a step [s]."""
        return min(r.horizon - r.at for r in self.references)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a method hands over: a point before rounding, what is active there, figures; whether it came to its end.

    `stats` holds at least "optimum", the objective there, where the status is "converged".
    """

    point: Array
    status: Status
    active: tuple[str, ...]
    stats: Mapping[str, float]
    is_complete: bool = True


class LimitPath(Protocol):
    """A problem, prepared once, that is solved for one set of limits after the other."""

    def follow(self, start: Array, specs: Sequence[Specification]) -> list[Solution]:
        """Solve for one after the other, the first from gains of shape (n,)."""
        ...


class Method(Protocol):
    """A way to tune; nothing else asks for its type. A new one is a class, and a row in `METHODS`."""

    @property
    def margin(self) -> float:
        """How much tighter its limits are than those asked for, a fraction."""
        ...

    @property
    def peak_margin(self) -> float:
        """Of `margin` the share that limits on peaks of command and sensitivity get."""
        ...

    @property
    def digits(self) -> int | None:
        """Significant digits of the gains handed out; None: all."""
        ...

    @property
    def parameters_without_effect(self) -> tuple[str, ...]:
        """Parameters that what it solves does not depend on: they stay as given."""
        ...

    @property
    def successor(self) -> "Method | None":
        """What tunes in its place where it was chosen unasked and fails; None: its answer is final."""
        ...

    def check(self, task: TuningTask) -> None:
        """Refuse what it cannot tune: `InputError` names it and the remedy."""
        ...

    def suits(self, task: TuningTask) -> bool:
        """Whether it is the one to choose, of those that come after it in `METHODS`; it can tune what it suits."""
        ...

    def find(
        self,
        task: TuningTask,
        simulator: Simulator,
        spec: Specification,
        start: Array,
        attempt: int,
        progress: ProgressCallback,
    ) -> SearchResult:
        """The best point found; Ctrl-C ends a search by simulation with the best so far.

        Parameters
        ----------
        task : TuningTask
        simulator : Simulator
            Of the task's cases.
        spec : Specification
            The task's, tightened by the margin.
        start : ndarray, shape (n,)
        attempt : int
            0, or how often the certificate has failed: `start` is then what was found with less margin.
        progress : callable
            Hears a line of text a generation, start or program.
        """
        ...

    def shorten(self, margin: float) -> "Method":
        """A short search, from a point that is close."""
        ...

    def limit_path(self, task: TuningTask, spec: Specification) -> LimitPath | None:
        """What follows moving limits, `spec` the first of them, tightened; None where it can only search anew."""
        ...
