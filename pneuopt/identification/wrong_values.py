"""`FixedValueTest`: whether a fixed value that is wrong explains why a model misses its logs, and which one.

Each fixed parameter counts as one more unknown where a search has ended, and the gradient of the cost by it tells how
much of the misfit its freeing would take away (Rao's score test, Proc. Cambridge Philos. Soc. 44, 1948): one run with
more sensitivities for all of them. The promise is linear, and a wrong model promises much; so the best are tried, each
by a fit with it freed, and one is named by what that fit has found.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.width_bias import fixed_widths
from pneuopt.quantities.status import Code
from pneuopt.quantities.units import write_value
from pneuopt.shooting.least_squares import MAX_CHI_SQUARE_RATIO, Fit, SearchEnd, solve_least_squares, start_search
from pneuopt.shooting.segments import segment

# share of the misfit [1] that a freed value must explain by the linearised equations to be tried: lower tries what does
# not help, higher passes over what is far off
MIN_PROMISED_SHARE = 0.5
# the same by a fit, to be named: lower blames a value for an error of the model, higher misses it beside another one
MIN_EXPLAINED_SHARE = 0.8
# iterations of a stage of a trial, and of its last one again where the equations by then promise enough: a value that
# explains the logs takes 17 in all, more are lost on what does not
TRIAL_ITERATIONS, LAST_TRIAL_ITERATIONS = 4, 10
MAX_FREED_TRIALS = 2  # values that are tried: more take time, fewer miss one whose promise is not the largest
MAX_TESTS = 2  # fits of one problem that are tested: more take time, fewer miss what the first one is too far off for
# change of a value in its deviations [1] below which it is not wrong: lower blames chance
MIN_CHANGE = 4.0
# the same over the given value [1]: lower names what a scale or a data sheet leaves open, and what a friction law that
# is a little wrong asks for (1.3 % of the mass, where a Coulomb law meets a Stribeck curve)
MIN_RELATIVE_CHANGE = 0.03
# share of the misfit [1] from which a value explains all of it: others are then tried only if they promise as much
WHOLE_SHARE = 0.98
# squared residuals above the best trial's, in variances of its residuals, up to which logs do not tell two values
# apart: lower names one of two by chance, higher names what fits worse
ALIKE_SQUARES = 20.0
# what a user knows better than any value of a rig: of values that logs do not tell apart, it is named last
NATURE = ("ambient.", "gas.")


@dataclass(frozen=True)
class WrongValue:
    """A fixed value that is wrong by the logs.

    Attributes
    ----------
    name : str
    given, found : float
        The fixed value, and that of a fit with it freed [unit].
    unit : str
    share : float
        Of the squared residuals beyond the noise that this fit explains [1].
    squares : float
        And gaps that this fit leaves, in noise variances.
    alike : tuple of str
        Other fixed values of which each would explain as much.
    lag : float
        The dead time in place of which the value may stand [s]; 0 where it is no bandwidth, or not a lower one.
    """

    name: str
    given: float
    found: float
    unit: str
    share: float
    squares: float
    alike: tuple[str, ...] = ()
    lag: float = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether it explains the misfit but for a small rest."""
        return self.share >= WHOLE_SHARE

    def __str__(self) -> str:
        found, given = (write_value(v, self.unit, 3) for v in (self.found, self.given))
        others = f"; {' or '.join(self.alike)} would explain as much" if self.alike else ""
        lag = f"; a dead time of {write_value(self.lag, 's', 2)} before it looks the same" if self.lag else ""
        return (
            f"freeing {self.name} explains {self.share:.0%} of the misfit, with {found} in place of {given}{lag}"
            f"{others}: correct it, or free it"
        )


@dataclass
class FixedValueTest:
    """The test of the fixed values of one problem, after the searches that have missed its logs.

    Attributes
    ----------
    found : WrongValue or None
        The value that explains most of the misfit.
    tests : int
        How many fits have been tested.
    """

    found: WrongValue | None = None
    tests: int = field(default=0)

    def explains(self, problem: EstimationProblem, fit: Fit) -> bool:
        """Whether a fixed value explains most of what a fit misses; `found` then names it.

        Parameters
        ----------
        problem : EstimationProblem
        fit : Fit
            Any, of that problem.

        Returns
        -------
        bool
        """
        is_cut = fit.status.code in (Code.INTERRUPTED, Code.DIVERGED)
        if (
            is_cut
            or problem.weights
            or self.tests >= MAX_TESTS
            or not _misses_logs(fit)
            or not math.isfinite(fit.stats["cost"])
        ):
            return False
        self.tests += 1
        self.found = find_wrong_value(problem, fit)
        return self.found is not None


def find_wrong_value(problem: EstimationProblem, fit: Fit) -> WrongValue | None:
    """The fixed value whose freeing explains most of the misfit of a fit; None where none explains enough.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
        With residuals beyond the noise.

    Returns
    -------
    WrongValue or None

    Raises
    ------
    KeyboardInterrupt
        If a trial is interrupted, by Ctrl-C or at the end of a CPU budget.
    """
    without, freed = _promised_squares(problem, fit)
    excess = (without if fit.jumps is not None else 2 * fit.stats["cost"]) - fit.count
    promised = [((without - squares) / max(excess, without - fit.count), name) for name, squares in freed.items()]
    worthwhile = sorted((p for p in promised if p[0] >= MIN_PROMISED_SHARE), reverse=True)[:MAX_FREED_TRIALS]
    trials = list[WrongValue]()
    for share, name in worthwhile:
        if trials and trials[-1].is_whole and share < WHOLE_SHARE * worthwhile[0][0]:
            break
        trials += [found] if (found := _try_freed(problem, fit, name, excess)) else []
    if not trials:
        return None
    least = min(trial.squares for trial in trials)
    level = least + ALIKE_SQUARES * max(1.0, least / fit.count)
    alike = sorted(
        (t for t in trials if t.squares <= level), key=lambda trial: (trial.name.startswith(NATURE), trial.squares)
    )
    return replace(alike[0], alike=tuple(t.name for t in alike[1:]), lag=_dead_time(problem, alike[0]))


def _dead_time(problem: EstimationProblem, value: WrongValue) -> float:
    """The dead time that delays slow commands as a lower bandwidth of the final control element does [s]; or 0."""
    axis = problem.system.plant.axis
    element = axis.final_element if axis is not None else None
    if element is None or value.name != element.bandwidth:
        return 0.0
    return max(0.0, (1 / value.found - 1 / value.given) / (2 * math.pi))


def _misses_logs(fit: Fit) -> bool:
    """Whether residuals and gaps of a fit are beyond the noise, or gaps stand for noise of the states."""
    return 2 * fit.stats["cost"] > MAX_CHI_SQUARE_RATIO * fit.count or fit.jumps is not None


def _promised_squares(problem: EstimationProblem, fit: Fit) -> tuple[float, dict[str, float]]:
    """The squares with tight gaps by the equations linearised at a fit, and those with each fixed value freed."""
    names = _fixed_values(problem)
    if not names:
        return math.nan, {}
    freed = replace(problem, parameters=problem.parameters.freed(*names))
    here = replace(problem.method, stages=problem.method.stages[-1:], progress=None)
    begun = start_search(segment(freed.transcription(freed.start_from(fit))), here)
    equations, scaling, free = begun.iterate.equations, begun.setup.scaling, freed.unknowns().free_names
    tested = np.isin(free, names)
    movable = scaling.has_effect(equations) & ~scaling.fixed & ~scaling.at_bound(begun.iterate.z)
    squares = {name: equations.promised_squares(movable & (~tested | (np.array(free) == name))) for name in names}
    return equations.promised_squares(movable & ~tested), squares


def _fixed_values(problem: EstimationProblem) -> list[str]:
    """The fixed parameters that may be wrong: all but widths, and what each log has or states by itself."""
    stated = {n for e in problem.experiments for n in e.conditions} | set(fixed_widths(problem))
    fixed = {n: p for n, p in problem.parameters.items() if not (p.free or p.per_log) and n not in stated}
    return [n for n, p in fixed.items() if p.lower < p.value < p.upper]


def _try_freed(problem: EstimationProblem, fit: Fit, name: str, excess: float) -> WrongValue | None:
    """What a fit with a value freed explains; None where that is too little, or it hardly changes."""
    freed = replace(problem, parameters=problem.parameters.freed(name))
    found = _search_freed(freed, fit, 1 + (1 - MIN_EXPLAINED_SHARE) * excess / fit.count)
    if found is None:
        return None
    place, given = found.parameters.free_names.index(name), problem.parameters[name]
    squares = 2 * found.stats["cost"]
    share = 1 - (squares - fit.count) / excess
    value, deviation = found.parameters.value(name), math.inf
    if found.covariance is not None:
        noise = max(1.0, found.chi_square / found.count)
        deviation = math.sqrt(noise * found.covariance[place, place])
    least = max(MIN_CHANGE * deviation, MIN_RELATIVE_CHANGE * abs(given.value))
    is_clear = abs(value - given.value) > least and not found.at_bound[place]
    if not (share >= MIN_EXPLAINED_SHARE and is_clear and found.jumps is None):
        return None
    return WrongValue(name, given.value, value, given.unit, min(1.0, share), squares)


def _search_freed(freed: EstimationProblem, fit: Fit, allowed: float) -> Fit | None:
    """A short search with a value freed; None where its squares a sample would stay above those that are allowed."""
    *others, last = (replace(stage, iterations=TRIAL_ITERATIONS) for stage in freed.method.stages[1:])
    method = replace(freed.method, max_misfit=allowed, allows_state_noise=False)
    found = fit
    for stages in ((*others, replace(last, refine=1)), (replace(last, iterations=LAST_TRIAL_ITERATIONS),)):
        found = solve_least_squares(freed.transcription(freed.start_from(found)), replace(method, stages=stages))
        if found.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        optimum, is_left = found.optimum, found.end is SearchEnd.ABANDONED
        if is_left or optimum is None or optimum.equations.promised_squares(optimum.keep) > allowed * fit.count:
            return None
    return found
