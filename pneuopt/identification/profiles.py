"""`profile`: a parameter's profile-likelihood interval; `propagate_error`: a figure of estimates, with its interval."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem
from pneuopt.identification.misfit import t_quantile
from pneuopt.identification.problem import EstimationProblem, as_estimation_model, check_logs
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.statistics import confidence_interval
from pneuopt.identification.tolerances import (
    END_TOLERANCE,
    MAX_LOG_PROBE,
    MAX_LOG_STEP,
    MAX_REFITS_A_SIDE,
    REFIT_ITERATIONS,
)
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import Fit, LeastSquares, Stage, solve_least_squares

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class Profile(Shown):
    """The profile likelihood of one parameter, with all others fitted again at each of its values.

    Attributes
    ----------
    name, unit : str
        Of the parameter.
    estimate : float
        The value of the fit [unit].
    low, high : float
        Ends of the confidence interval; infinite where the logs set no limit within the parameter's bounds.
    level : float
        Of confidence [1].
    curve : DataFrame
        A row a refit, by rising value: value, deviance (twice the cost above the least, in units that make its
        curvature at the estimate that of the estimate's standard error), and what the other parameters became.
    dof : float
        Degrees of freedom of the estimate's variance.
    """

    name: str
    unit: str
    estimate: float
    low: float
    high: float
    level: float
    curve: "pd.DataFrame"
    dof: float = math.inf

    @property
    def is_open(self) -> bool:
        """Whether an end of the interval is infinite."""
        return math.isinf(self.low) or math.isinf(self.high)

    def summary(self) -> Report:
        """The estimate and its interval."""
        lead = f"{self.name} = {self.estimate:.5g} {self.unit}, {100 * self.level:.4g} % interval"
        return Report((Line(f"{lead}: {self.sentence}"),))

    @property
    def threshold(self) -> float:
        """The deviance up to which a value lies within the interval."""
        return float(t_quantile(self.dof, self.level)) ** 2

    @property
    def sentence(self) -> str:
        """The interval in words."""
        low, high = f"{self.low:.5g} {self.unit}", f"{self.high:.5g} {self.unit}"
        tried = self.curve["value"]
        if math.isinf(self.low) and math.isinf(self.high):
            return f"anything from {tried.min():.2g} to {tried.max():.2g} {self.unit} fits as well"
        if math.isinf(self.high):
            return f"above {low}; the logs set no upper limit"
        if math.isinf(self.low):
            return f"below {high}; the logs set no lower limit"
        return f"{low} to {high}"


def profile(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Sequence[Experiment],
    result: IdentificationResult,
    name: str,
    *,
    level: float = 0.95,
    method: LeastSquares | None = None,
) -> Profile:
    """Profile-likelihood interval of one parameter: the others are fitted again at each of its values.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        The one that `result` was made with.
    experiments : Experiment or sequence of Experiment
        Those that `result` was made from.
    result : IdentificationResult
        A converged one: every refit starts from it, no start is searched for.
    name : str
        As in the result's estimates, "name[log]" for one of a log.
    level : float
        Of confidence.
    method : LeastSquares, optional
        The one that made the result.

    Returns
    -------
    Profile
        Its ends are where the deviance reaches the squared quantile of Student's t, chi-square's where the degrees of
        freedom are many (Venzon, Moolgavkar, Applied Statistics 37(1), 1988), in the units in which the curvature at
        the estimate is that of the estimate's own standard error.

    Raises
    ------
    InputError
        If the parameter is not among the estimates, or the logs are not those of the result.
    """
    check_names("estimate", [name], result.estimates.index)
    require(0 < level < 1, f"a level lies between 0 and 1, got {level:g}")
    model = as_estimation_model(system)
    logs = check_logs(model, experiments, result.parameters)
    given = tuple(e.name for e in logs)
    require(
        given == tuple(result.trajectories), f"the result is of {', '.join(result.trajectories)}, not of these logs"
    )
    logs = [e.with_noise(result.fit["noise"][e.name].to_dict()) for e in logs]
    problem = EstimationProblem(model, tuple(logs), model.parameters | result.parameters, method or LeastSquares())
    return trace_profile(problem, result, name, level)


def trace_profile(problem: EstimationProblem, result: IdentificationResult, name: str, level: float = 0.95) -> Profile:
    """The profile of a parameter of an estimation problem."""
    if problem.method.progress is not None:
        problem.method.progress(f"profile of {name}")
    refits = _Refits(problem, result, name)
    dof = float(result.estimates["dof"][name])
    target = float(t_quantile(dof, level))
    for side in (-1, 1):
        _bracket(refits, side, target)
    p = refits.parameter
    low, high = (_interval_end(refits, side, target) for side in (-1, 1))
    return Profile(name, p.unit, p.value, low, high, level, refits.curve(), dof)


class _ProfilePoint(NamedTuple):
    """A refit: the searched value at which the parameter is held, and the fit."""

    z: float
    fit: Fit

    @property
    def cost(self) -> float:
        return self.fit.stats["cost"]


class _Refits:
    """Fits with one parameter held, each started from the nearest one."""

    def __init__(self, problem: EstimationProblem, result: IdentificationResult, name: str) -> None:
        self.problem, self.name = problem, name
        self.start = problem.start_from(result)
        self.parameter = replace(problem.unknowns()[name], value=self.start.parameters[name])
        last, steps = Stage(result.stats["gap_deviation"], REFIT_ITERATIONS, refine=4), int(result.stats["substeps"])
        method = replace(problem.method, stages=(last,), substeps=max(1, steps // 4), progress=None)
        self.method = replace(method, checks_steps=False)
        stderr = float(result.estimates["stderr"][name])
        self.spread = stderr / self.parameter.value if self.parameter.log else stderr
        self.points: list[_ProfilePoint] = []
        self.refit_at(self.to_search(self.parameter.value))
        inflation = result.stats["variance_inflation"]
        self.scale = self._scale(result.stats["chi_square_ratio"] * inflation, limited=inflation <= 1)

    @property
    def centre(self) -> float:
        """The estimate, as searched."""
        return self.to_search(self.parameter.value)

    def to_search(self, value: float) -> float:
        """A value as it is searched; minus infinity for the logarithm of a bound that is not positive."""
        if self.parameter.log:
            return math.log(value) if value > 0 else -math.inf
        return value

    def value(self, z: float) -> float:
        """The parameter's value at a searched one; at a bound exactly the bound, which an exponential may exceed."""
        p = self.parameter
        return min(max(math.exp(z) if p.log else z, p.lower), p.upper)

    def refit_at(self, z: float, begin: _ProfilePoint | None = None) -> _ProfilePoint:
        """The fit with the parameter held there, from a refit or the nearest; `KeyboardInterrupt` if interrupted."""
        start = self.start
        if self.points:
            start = self.problem.start_from((begin or min(self.points, key=lambda known: abs(known.z - z))).fit)
        transcription = self.problem.transcription(start)
        held = replace(self.parameter, value=self.value(z), lower=self.value(z), upper=self.value(z))
        transcription = replace(transcription, parameters=transcription.parameters | ParameterSet({self.name: held}))
        fit = solve_least_squares(transcription, self.method)
        if fit.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        point = _ProfilePoint(z, fit)
        self.points.append(point)
        return point

    def retry(self, point: _ProfilePoint, begin: _ProfilePoint) -> _ProfilePoint:
        """The better of a refit and another one there that begins elsewhere."""
        again = self.refit_at(point.z, begin)
        self.points.remove(point if again.cost < point.cost else again)
        return min(point, again, key=lambda each: each.cost)

    def deviance_root(self, point: _ProfilePoint) -> float:
        """Distance from the best fit, in standard deviations were the model linear; infinite where nothing fits."""
        least = min(p.cost for p in self.points)
        return math.sqrt(max(0.0, 2 * (point.cost - least) / self.scale)) if math.isfinite(point.cost) else math.inf

    def curve(self) -> "pd.DataFrame":
        """All refits, by rising value."""
        import pandas as pd

        rows = []
        for point in sorted(self.points, key=lambda known: known.z):
            others = {n: point.fit.parameters.value(n) for n in self.start.parameters if n != self.name}
            rows.append({"value": self.value(point.z), "deviance": self.deviance_root(point) ** 2, **others})
        return pd.DataFrame(rows)

    def _scale(self, noise: float, *, limited: bool) -> float:
        """The cost that counts as one variance, by curvature, as weighted gaps rise less; `limited` to `noise`."""
        if not (math.isfinite(self.spread) and self.spread > 0):
            return noise
        step = min(self.spread, MAX_LOG_PROBE) if self.parameter.log else self.spread
        around = [self.centre + step, self.centre - step]
        lower, upper = self.to_search(self.parameter.lower), self.to_search(self.parameter.upper)
        if not all(lower <= z <= upper for z in around):
            return noise
        middle = self.points[0].cost
        rise = sum(self.refit_at(z).cost - middle for z in around)
        found = rise * (self.spread / step) ** 2
        most = noise if limited else math.inf
        return min(max(found, 0.1 * noise), most) if math.isfinite(found) else noise


def _bracket(refits: _Refits, side: int, target: float) -> None:
    """Refit on one side until the deviance exceeds the level, then closely around that point; or to the bound."""
    p = refits.parameter
    bound = refits.to_search(p.lower if side < 0 else p.upper)
    inside, first = refits.points[0], 1.05 * target * refits.spread  # a little beyond the end of the linear interval
    if p.log:
        first = min(first, MAX_LOG_STEP) if math.isfinite(first) else MAX_LOG_STEP
    elif not 0 < first < math.inf:
        first = 0.1 * max(abs(p.value), 1e-6)
    step = first
    probes = [point for point in refits.points if side * point.z > side * inside.z]  # of the curvature
    for _ in range(MAX_REFITS_A_SIDE):
        z = side * min(side * inside.z + step, side * bound)
        if z == inside.z:
            return
        is_probe = bool(probes)
        point = probes.pop() if is_probe else refits.refit_at(z)
        if refits.deviance_root(point) >= target:
            within = _locate_crossing(refits, inside, point, target)
            if within is None:
                return
            inside, step = within, first  # it was no crossing: on from there
            continue
        if _is_at_level(refits, point, target):
            return
        gained = refits.deviance_root(point) - refits.deviance_root(inside)
        away = abs(point.z - inside.z)
        wanted = (target - refits.deviance_root(point)) * away / gained if gained > 0 else math.inf
        longest = first - away if is_probe else 3 * step  # a probe says little of what lies far off
        inside, step = point, max(0.1 * step, min(1.01 * wanted, longest, MAX_LOG_STEP if p.log else math.inf))


def _interval_end(refits: _Refits, side: int, target: float) -> float:
    """The outermost crossing of the level on one side; infinite where the outermost refit lies within."""
    points = sorted(refits.points, key=lambda known: -side * known.z)
    for outside, inside in itertools.pairwise(points):
        a, b = refits.deviance_root(inside), refits.deviance_root(outside)
        if a < target <= b:
            share = (target - a) / (b - a) if math.isfinite(b) else 0.5
            return refits.value(inside.z + share * (outside.z - inside.z))
        if b < target:
            is_end = _is_at_level(refits, outside, target)
            return refits.value(refits.centre + target / b * (outside.z - refits.centre)) if is_end else side * math.inf
    return side * math.inf


def _is_at_level(refits: _Refits, point: _ProfilePoint, target: float) -> bool:
    """Whether a refit lies so near the level that no other one is needed."""
    return abs(refits.deviance_root(point) - target) < END_TOLERANCE * target


def _locate_crossing(
    refits: _Refits, inside: _ProfilePoint, outside: _ProfilePoint, target: float
) -> _ProfilePoint | None:
    """Locate a crossing of the level by false position on the deviance's root, nearly linear; or its jump.

    A refit beyond a jump may have been caught on its way: it is made again from this side, and is returned where it
    then lies within the level.
    """
    for _ in range(MAX_REFITS_A_SIDE):
        if abs(outside.z - inside.z) <= END_TOLERANCE * abs(outside.z - refits.centre):
            again = refits.retry(outside, inside)
            return again if refits.deviance_root(again) < target else None
        if _is_at_level(refits, outside, target) or _is_at_level(refits, inside, target):
            return None
        a, b = refits.deviance_root(inside), refits.deviance_root(outside)
        if not a < target <= b:  # a refit has found a better fit, from which all are counted now
            return None
        share = (target - a) / (b - a) if math.isfinite(b) else 0.5
        point = refits.refit_at(inside.z + min(max(share, 0.05), 0.95) * (outside.z - inside.z))
        inside, outside = (point, outside) if refits.deviance_root(point) < target else (inside, point)
    return None


ParameterValues = Mapping[str, float]


@dataclass(frozen=True)
class PropagatedValue:
    """A figure with its 95 % confidence interval.

    Attributes
    ----------
    value, stderr, ci_low, ci_high : float
        All but the value are NaN where the figure depends on a parameter without an interval.
    """

    value: float
    stderr: float
    ci_low: float
    ci_high: float


def propagate_error(result: IdentificationResult, function: Callable[[ParameterValues], float]) -> PropagatedValue:
    """Compute a function of the parameters, with its confidence interval by the delta method.

    Parameters
    ----------
    result : IdentificationResult
        Whose estimates and covariance count.
    function : callable
        Takes all parameters' values by name, "name[log]" for one of a log; returns a number.

    Returns
    -------
    PropagatedValue
        ``stderr = sqrt(g C g')`` with g the slope at the estimates (central differences) and C their covariance: right
        where the function is nearly linear within the intervals. Its interval has the fewest degrees of freedom among
        the estimates that the figure depends on.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> import pandas as pd
    >>> from pneuopt.quantities.parameters import Parameter, ParameterSet
    >>> names = ["static", "coulomb"]
    >>> fit = SimpleNamespace(
    ...     parameters=ParameterSet({n: Parameter(v, "N") for n, v in zip(names, (60.0, 40.0))}),
    ...     estimates=pd.DataFrame({"value": [60.0, 40.0], "dof": [900.0, 3.0]}, index=names),
    ...     covariance=pd.DataFrame([[4.0, 0.0], [0.0, 1.0]], index=names, columns=names),
    ... )
    >>> ratio = propagate_error(fit, lambda p: p["static"] / p["coulomb"])
    >>> ratio.value, round(ratio.stderr, 4), round(ratio.ci_high, 4)
    (1.5, 0.0625, 1.6989)
    """
    values, slopes = _linearise(result, lambda p: [function(p)])
    value, spread = float(values[0]), float(_deviations(result, slopes)[0])
    used = result.covariance.index[slopes[0] != 0]
    dof = float(result.estimates["dof"][used].min()) if len(used) else math.inf
    return PropagatedValue(value, spread, *confidence_interval(value, spread, log=False, dof=dof))


def propagate_intervals(
    result: IdentificationResult, function: Callable[[ParameterValues], ArrayLike]
) -> tuple[Array, Array]:
    """Figures (n,) with their 95 % intervals (n, 2), NaN where a parameter of theirs has none; as `propagate_error`."""
    values, slopes = _linearise(result, function)
    dof = result.estimates["dof"][result.covariance.index].to_numpy(dtype=float)
    spreads, degrees = _deviations(result, slopes), [min(dof[row != 0], default=math.inf) for row in slopes]
    every = zip(values.tolist(), spreads.tolist(), degrees, strict=True)
    return values, np.array([confidence_interval(v, s, log=False, dof=d) for v, s, d in every])


def _linearise(
    result: IdentificationResult, function: Callable[[ParameterValues], ArrayLike], step: float = 1e-3
) -> tuple[Array, Array]:
    """The figures at the estimates, shape (n,), and their slopes (n, k) by these over a step [standard deviations]."""
    known = {n: p.value for n, p in result.parameters.items()}
    found = {str(n): float(v) for n, v in result.estimates["value"].items()}
    at = {**known, **{n: known[n.partition("[")[0]] if math.isnan(v) else v for n, v in found.items()}}
    variances = np.diag(result.covariance.to_numpy(dtype=float))
    slopes = []
    for name, variance in zip(map(str, result.covariance.index), variances, strict=True):
        change = step * math.sqrt(variance) if variance > 0 else 1e-6 * max(abs(at[name]), 1e-6)
        up, down = (np.asarray(function({**at, name: at[name] + side * change}), dtype=float) for side in (1, -1))
        slopes.append((up - down) / (2 * change))
    value = np.asarray(function(at), dtype=float)
    return value, np.stack(slopes, axis=-1) if slopes else np.zeros((len(value), 0))


def _deviations(result: IdentificationResult, slopes: Array) -> Array:
    """Standard deviations of figures with these slopes, shape (n,)."""
    used = np.any(slopes != 0, axis=0)  # parameters without an interval do no harm where no figure depends on them
    covariance = result.covariance.to_numpy(dtype=float)[np.ix_(used, used)]
    return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", slopes[:, used], covariance, slopes[:, used])))
