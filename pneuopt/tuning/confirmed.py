"""`Confirmed`: a fast search's answer, and full-space multiple shooting from it, which confirms or betters it.

From random starts IPOPT finds next to nothing on a plant with friction (NUMERICS section 5); from a search's answer it
took 8 iterations on T32 without dither. It shares the model with the search, but neither its gradients nor its path:
what it cannot move from is a local optimum.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.shooting.full_space import FullSpace, prepare_full_space, solve_from
from pneuopt.shooting.solution import Solution
from pneuopt.tuning.condensed import Condensed
from pneuopt.tuning.screening import Screening
from pneuopt.tuning.simulator import Simulator, to_records
from pneuopt.tuning.space import Space
from pneuopt.tuning.two_phase import TwoPhase, check_exact, transcribe_two_phase

MAX_CONFIRMED_DIFFERENCE = 0.01  # relative difference of two objectives up to which a search's answer is confirmed
BAND_TIGHTENING = 0.015  # by which the problem's band is tighter than the search's: between nodes a response grazes it
LIMIT_TOLERANCE = 1e-4  # by which a limit may be missed before the certificate decides


@dataclass(frozen=True)
class Confirmed:
    """A fast method, then IPOPT on all nodes of the two-phase problem from its answer. For one plant, without dither.

    The result's status says what came of it: "confirmed", "bettered", or "not converged", when the fast answer stands.

    Parameters
    ----------
    first : Condensed or Screening
    nodes : tuple of int
        Shooting nodes of the transient and of the settled phase.
    solver : FullSpace
    """

    first: Condensed | Screening = field(default_factory=Condensed)
    nodes: tuple[int, int] = (60, 80)
    solver: FullSpace = field(
        default_factory=lambda: FullSpace(max_iterations=150, first_barrier=1e-4, max_seconds=300.0)
    )

    @property
    def margin(self) -> float:
        """Of the first method."""
        return self.first.margin

    @property
    def digits(self) -> int | None:
        """Of the first method."""
        return self.first.digits


def check_confirmable(loop: ClosedLoop, space: Space, spec: Specification) -> None:
    """Refuse what the two-phase problem cannot say: `InputError` names it and the remedy."""
    require(
        loop.pid.sample_time is None, "Confirmed needs a continuous controller; use its first= as the method itself"
    )
    amplitude = space.parameters["dither.amplitude"] if loop.dither else None
    still = amplitude is None or not (amplitude.free or amplitude.value)
    require(still, "Confirmed sees the response itself, not its average: fix dither.amplitude at 0, or use Condensed()")
    check_exact(spec)


def confirm(
    simulator: Simulator,
    references: Sequence[Step],
    spec: Specification,
    method: Confirmed,
    point: Array,
    values: Mapping[str, float],
) -> tuple[Array, str]:
    """The better, by the search's own simulation, of its answer and of what full space makes of it; and the verdict.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
        Already tightened.
    point : ndarray, shape (n,)
    values : mapping of str to float
        What the requirements read there, from which the problem's further unknowns start.
    """
    space = Space(simulator.space.parameters_at(point), simulator.space.names)
    posed = TwoPhase(nodes=method.nodes, solver=method.solver)
    transcription = transcribe_two_phase(
        simulator.loop, references, space, spec.tighten(BAND_TIGHTENING, BAND_TIGHTENING / 10), posed
    )
    given = transcription.parameters
    known = {n: float(np.clip(values[n], given[n].lower, given[n].upper)) for n in spec.kinds if given[n].free}
    transcription = replace(transcription, parameters=given.with_values(known))
    solution = solve_from(prepare_full_space(transcription, method.solver), transcription.parameters)
    moved = np.array([solution.parameters.value(n) for n in space.names])
    after = to_records(simulator.values(moved[None], spec))[0]
    before, cost = spec.objective(values), spec.objective(after)
    better = solution.status.converged and cost < before and not spec.violations(after, LIMIT_TOLERANCE)
    return (moved if better else point), describe_confirmation(solution, before, cost if better else np.inf)


def describe_confirmation(solution: Solution, before: float, after: float) -> str:
    """What came of it, in words.

    Parameters
    ----------
    before, after : float
        Objectives of both points by the search's own simulation; inf where the second one is not the better.

    Examples
    --------
    >>> from pneuopt.quantities.status import Code, Status
    >>> from types import SimpleNamespace
    >>> done = SimpleNamespace(status=Status(Code.CONVERGED), stats={"cost": 0.2, "iterations": 8.0})
    >>> describe_confirmation(done, 0.21, 0.2)
    'full space: bettered from 0.21 to 0.2 in 8 iterations'
    >>> describe_confirmation(done, 0.201, np.inf)
    'full space: confirmed, a local optimum within 0.5 % after 8 iterations'
    >>> describe_confirmation(done, 0.3, np.inf)
    "full space: ended in 0.2 after 8 iterations, which the simulation does not show; the search's 0.3 stands"
    """
    if not solution.status.converged:
        return f"full space: not converged ({solution.status.message}); the search's answer stands"
    count, cost = f"{solution.stats['iterations']:.0f} iterations", solution.stats["cost"]
    if after < before * (1 - MAX_CONFIRMED_DIFFERENCE):
        return f"full space: bettered from {before:.6g} to {after:.6g} in {count}"
    within = abs(min(after, cost) - before) / abs(before)
    if within <= MAX_CONFIRMED_DIFFERENCE:
        return f"full space: confirmed, a local optimum within {100 * within:.2g} % after {count}"
    why = "which is worse" if cost > before else "which the simulation does not show"
    return f"full space: ended in {cost:.6g} after {count}, {why}; the search's {before:.6g} stands"
