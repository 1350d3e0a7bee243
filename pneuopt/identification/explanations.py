"""`explain_misfit`: what a model lacks where it misses its logs, tried by short fits and named only if it explains.

Each row of `EXPLANATIONS` poses the problem again with one thing more: inputs that act late, or through backlash, by an
amount that is searched; or free parameters of friction, a leak, an offset, a line. Each is fitted from where the search
has ended, in windows of the motion's horizon (`free_run`): no gap takes a misfit there, so that the squares which an
explanation takes away are those of a prediction. All together take no more CPU time than the search did.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np

from pneuopt.dynamics.system import Symbols, System, names
from pneuopt.identification.free_run import motion_horizon
from pneuopt.identification.problem import EstimationProblem, outputs_in_log
from pneuopt.identification.review import promised_squares
from pneuopt.identification.tolerances import (
    ALIKE_SQUARES,
    BACKLASH_SHARES,
    DEAD_TIME_SAMPLES,
    MIN_EXPLAINED_SHARE,
    REFINED_AMOUNTS,
    STRIBECK_SHARES,
    TURN_SHARE,
    WHOLE_SHARE,
    WINDOW_ITERATIONS,
)
from pneuopt.identification.widths import estimated_widths
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.quantities.units import write_value
from pneuopt.shooting.least_squares import CpuBudget, Fit, solve_least_squares

FREED = "freed to explain a misfit"  # the source of a fixed parameter that is tried
Terms = tuple[Symbols, Symbols, Symbols]  # that are added to the rates of states, to inputs and to outputs


class Explanation(NamedTuple):
    """A row: what a model may lack."""

    name: str
    suits: Callable[[EstimationProblem], bool]
    add: Callable[[EstimationProblem, Fit, float], EstimationProblem]  # so much of it to the problem of a fit
    describe: Callable[[EstimationProblem, Fit, float], str]  # it in words, from the fit with it
    # what to try in this order, until the squares rise [add's unit]; nothing to search where only parameters are free
    amounts: Callable[[EstimationProblem], Sequence[float]] = lambda _: (0.0,)


class Trial(NamedTuple):
    """The fit with so much of an explanation, in words."""

    words: str
    amount: float
    fit: Fit

    @property
    def squares(self) -> float:
        """Squared residuals, in noise variances; infinite where the model is not finite."""
        squares = 2 * self.fit.stats["cost"]
        return squares if math.isfinite(squares) else math.inf


class Found(NamedTuple):
    """A sentence on what explains most of a misfit, or on what was tried; empty where nothing suits."""

    sentence: str
    explains: bool


def explain_misfit(problem: EstimationProblem, fit: Fit, cpu_seconds: float) -> Found:
    """Try what the model of a fit may lack."""
    if not isinstance(problem.system, System) or not problem.system.states:
        return Found("", False)
    horizon, budget = motion_horizon(problem), CpuBudget(max(cpu_seconds, 1e-9))
    last = replace(problem.method.stages[-1], iterations=WINDOW_ITERATIONS, refine=1)
    method = replace(
        problem.method, segment_time=horizon, stages=(last,), budget=budget, allows_state_noise=False, progress=None
    )
    # a width that is free stops a search from a wrong model's values
    widths = {n: problem.parameters.value(n) for n in estimated_widths(problem.parameters)}
    problem, trials = replace(problem, window=horizon, method=method, fixed=widths), dict[str, Trial]()
    try:
        without = Trial("", 0.0, _fit_shortly(problem, fit))
        for row in EXPLANATIONS:
            if row.suits(problem):
                trials[row.name] = found = _try(row, problem, without)
                if without.squares - found.squares > WHOLE_SHARE * (without.squares - fit.count):
                    break
    except KeyboardInterrupt:  # the budget, too
        pass
    if not trials:
        return Found("", False)
    best = min(trials.values(), key=lambda trial: trial.squares)
    # the fit itself may be better, for its widths are free
    missed = min(without.squares, 2 * fit.stats["cost"]) if fit.jumps is None else without.squares
    share = (missed - best.squares) / (missed - fit.count)
    if not share >= MIN_EXPLAINED_SHARE:
        return Found(f"tried, but none explains the misfit: {', '.join(trials)}", False)
    scale = max(1.0, best.squares / fit.count)
    most = best.squares + ALIKE_SQUARES * scale
    alike = "".join(f"; {t.words} explains as much" for t in trials.values() if t is not best and t.squares <= most)
    gain = 0.5 * (missed - best.squares) / scale
    size = f"explains {min(1.0, share):.0%} of the misfit, the log-likelihood gains {gain:.3g}"
    return Found(f"{best.words} {size}{alike}", True)


def _fit_shortly(problem: EstimationProblem, near: Fit) -> Fit:
    fit = solve_least_squares(problem.transcription(problem.start_from(near)), problem.method)
    if fit.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    return fit


def _try(row: Explanation, problem: EstimationProblem, without: Trial) -> Trial:
    """The best trial of a row: its amounts in turn, then where parabolas through the best and its sides are lowest."""
    trials = [without]

    def try_amount(amount: float, near: Fit) -> None:
        richer = row.add(problem, near, amount)
        fit = _fit_shortly(richer, near)
        trials.append(Trial(row.describe(richer, fit, amount), amount, fit))

    amounts = row.amounts(problem)
    for amount in amounts:
        try_amount(amount, trials[-1].fit)
        if trials[-1].squares > trials[-2].squares:
            break
    for _ in range(REFINED_AMOUNTS if len(amounts) > 1 else 0):
        lowest = _lowest([(trial.amount, trial.squares) for trial in trials])
        if lowest is None:
            break
        try_amount(lowest, min(trials, key=lambda trial: trial.squares).fit)
    return min(trials[1:], key=lambda trial: trial.squares)


def _lowest(points: Sequence[tuple[float, float]]) -> float | None:
    """Where the parabola through the lowest point and its neighbours is lowest; None where it has one at most."""
    ordered = sorted(point for point in points if math.isfinite(point[1]))
    k = int(np.argmin([squares for _, squares in ordered])) if ordered else 0
    if not 0 < k < len(ordered) - 1:
        return None
    x, y = np.array(ordered[k - 1 : k + 2]).T
    a, b, _ = np.polyfit((x - x[1]) / np.ptp(x), y, 2)
    return float(x[1] - np.ptp(x) * b / (2 * a)) if a > 0 else None


def _with_inputs(change: Callable[[float, Array, Array], Array]) -> Callable[..., EstimationProblem]:
    """A row's `add` that changes every input, `change(amount, t, values)`, before it reaches the plant."""

    def change_log(log: Experiment, inputs: Sequence[str], amount: float) -> Experiment:
        run = log.trajectory
        columns = {n: change(amount, run.t, run.fill_gaps(n)) for n in inputs}
        return replace(log, trajectory=run.with_columns(columns))

    def add(problem: EstimationProblem, _fit: Fit, amount: float) -> EstimationProblem:
        inputs = names(problem.system.inputs)
        return replace(problem, experiments=tuple(change_log(e, inputs, amount) for e in problem.experiments))

    return add


def _delay(amount: float, t: Array, values: Array) -> Array:
    return np.interp(t - amount, t, values)


def _dead_times(problem: EstimationProblem) -> list[float]:
    step = max(float(np.median(np.diff(e.trajectory.t))) for e in problem.experiments)
    return [count * step for count in DEAD_TIME_SAMPLES]


def _take_up(amount: float, _t: Array, values: Array) -> Array:
    """A signal behind a play of this share of its range."""
    half, last, out = 0.5 * amount * float(np.ptp(values)), float(values[0]), np.empty(len(values))
    for k, value in enumerate(values.tolist()):
        last = min(max(last, value - half), value + half)
        out[k] = last
    return out


def _add_terms(
    problem: EstimationProblem, extra: Mapping[str, Parameter], terms: Callable[[ca.SX, Symbols, Symbols], Terms]
) -> EstimationProblem:
    """The problem with terms in its equations, `terms(t, x, p)`, and their free parameters."""
    system, free = problem.system.plant, ParameterSet({n: replace(p, free=True) for n, p in extra.items()})
    states, inputs, outputs = (names(signals) for signals in (system.states, system.inputs, system.outputs))
    known = *system.parameters, *free
    t, x, u, p = ca.SX.sym("t"), *(ca.SX.sym(n, len(s)) for n, s in (("x", states), ("u", inputs), ("p", known)))
    own = (dict(zip(s, ca.vertsplit(v), strict=True)) for s, v in ((states, x), (known, p)))
    signals = zip(terms(t, *own), (states, inputs, outputs), strict=True)
    in_rates, in_inputs, in_outputs = (ca.vertcat(*(term.get(n, ca.SX(0)) for n in s)) for term, s in signals)
    xdot, y = system.ode(t, x, u + in_inputs, p[: len(system.parameters)])
    ode = ca.Function("ode", [t, x, u, p], [xdot + in_rates, y + in_outputs], ["t", "x", "u", "p"], ["xdot", "y"])
    richer = replace(system, parameters=system.parameters | free, ode=ode, meter=None)
    return replace(problem, system=richer, parameters=problem.parameters | free)


def _lacks_friction(kind: str, problem: EstimationProblem) -> bool:
    """Whether an axis has no such parameter of friction, or one that is known to be zero."""
    own = (p for n, p in problem.parameters.items() if n.rpartition(".")[2] == kind)
    return problem.system.plant.axis is not None and not any(p.free or p.value for p in own)


def _add_friction(kind: str, problem: EstimationProblem, fit: Fit, amount: float) -> EstimationProblem:
    """Friction of a kind; `amount` is its Stribeck velocity over the root mean square of the speed."""
    axis, name = problem.system.plant.axis, f"lacking.{kind}"
    assert axis is not None
    runs = [(run.t, run[axis.speed]) for run in fit.trajectories]
    typical = float(np.sqrt(np.mean(np.concatenate([v for _, v in runs]) ** 2)))
    force = float(np.sqrt(np.mean(np.concatenate([np.gradient(v, t) for t, v in runs]) ** 2)))
    start = TURN_SHARE * force * fit.parameters.value(axis.inertia) / (typical if kind == "viscous" else 1.0)

    def terms(_t: ca.SX, x: Symbols, p: Symbols) -> Terms:
        speed = x[axis.speed]
        side = ca.tanh(speed / (TURN_SHARE * typical))
        slow = ca.exp(-((speed / (amount * typical)) ** 2)) if kind == "static" else 1.0
        return {axis.speed: -p[name] * (speed if kind == "viscous" else side * slow) / p[axis.inertia]}, {}, {}

    unit = next(q.unit for q in problem.system.states if q.name == axis.speed)
    unit = f"{axis.force}/({unit})" if kind == "viscous" else axis.force
    return _add_terms(problem, {name: Parameter(start, unit, 0.0)}, terms)


def _describe_friction(kind: str, _problem: EstimationProblem, fit: Fit, _amount: float) -> str:
    noun = {"coulomb": "Coulomb friction", "static": "static friction above Coulomb's"}.get(kind, f"{kind} friction")
    found = fit.parameters[f"lacking.{kind}"]
    return f"{noun}, {found.value:.3g} {found.unit},"


def _leaks(problem: EstimationProblem) -> dict[str, Parameter]:
    """Leaks that are known to be zero, freed at a thousandth of their largest value."""
    zero = ((n, p) for n, p in problem.parameters.items() if n.endswith("leak") and not p.free and p.value == 0)
    return {n: replace(p, free=True, value=1e-3 * p.upper) for n, p in zero if math.isfinite(p.upper)}


def _add_leaks(problem: EstimationProblem, _fit: Fit, _amount: float) -> EstimationProblem:
    return replace(problem, parameters=problem.parameters | ParameterSet(_leaks(problem)))


def _add_offset(problem: EstimationProblem, _fit: Fit, _amount: float) -> EstimationProblem:
    """A constant beside the first input, which drives the system."""
    driving, name = problem.system.inputs[0], "lacking.offset"
    return _add_terms(
        problem, {name: Parameter(0.0, driving.unit)}, lambda _t, _x, p: ({}, {driving.name: p[name]}, {})
    )


def _describe_offset(problem: EstimationProblem, fit: Fit, _amount: float) -> str:
    found = fit.parameters["lacking.offset"]
    return f"an offset of {problem.system.inputs[0].name}, {write_value(found.value, found.unit, 3)},"


def _add_lines(problem: EstimationProblem, _fit: Fit, _amount: float) -> EstimationProblem:
    """A straight line in time beside each logged output: its sensor's offset and drift."""
    logged = {n for e in problem.experiments for n in outputs_in_log(problem.system, e)}
    units = {q.name: q.unit for q in problem.system.outputs if q.name in logged}
    offsets = {f"lacking.{n}": Parameter(0.0, unit) for n, unit in units.items()}
    drifts = {f"lacking.{n}.rate": Parameter(0.0, f"{unit}/s") for n, unit in units.items()}

    def terms(t: ca.SX, _x: Symbols, p: Symbols) -> Terms:
        return {}, {}, {n: p[f"lacking.{n}"] + p[f"lacking.{n}.rate"] * t for n in units}

    return _add_terms(problem, offsets | drifts, terms)


def _free_fixed(problem: EstimationProblem, fit: Fit, _amount: float) -> EstimationProblem:
    """The problem with that fixed value freed which promises most, by the equations linearised at the fit."""
    squares = {n: s for n, s in promised_squares(problem, fit)[1].items() if math.isfinite(s)}
    best = sorted(squares, key=lambda n: squares[n])[:1]
    freed = ParameterSet({n: replace(problem.parameters[n], free=True, source=FREED) for n in best})
    return replace(problem, parameters=problem.parameters | freed)


def _describe_freed(problem: EstimationProblem, fit: Fit, _amount: float) -> str:
    freed = {n: p for n, p in problem.parameters.items() if p.source == FREED}
    found = {
        n: (write_value(fit.parameters.value(n), p.unit, 3), write_value(p.value, p.unit, 3)) for n, p in freed.items()
    }
    return " and ".join(f"{n} of {new} in place of {given}" for n, (new, given) in found.items())


EXPLANATIONS = (
    *(
        Explanation(
            f"{kind} friction",
            partial(_lacks_friction, kind),
            partial(_add_friction, kind),
            partial(_describe_friction, kind),
        )
        for kind in ("coulomb", "viscous")
    ),
    Explanation("a leak", lambda problem: bool(_leaks(problem)), _add_leaks, lambda *_: "a leak"),
    Explanation("an offset of the input", lambda _: True, _add_offset, _describe_offset),
    Explanation("a fixed value", lambda _: True, _free_fixed, _describe_freed),
    Explanation(
        "a dead time",
        lambda _: True,
        _with_inputs(_delay),
        lambda _problem, _fit, amount: f"a dead time of {write_value(amount, 's', 3)}",
        _dead_times,
    ),
    Explanation("a line in time", lambda _: True, _add_lines, lambda *_: "a straight line in time beside the outputs"),
    Explanation(
        "static friction",
        partial(_lacks_friction, "static"),
        partial(_add_friction, "static"),
        partial(_describe_friction, "static"),
        lambda _: STRIBECK_SHARES,
    ),
    Explanation(
        "backlash",
        lambda _: True,
        _with_inputs(_take_up),
        lambda _problem, _fit, amount: f"backlash of {amount:.2g} of the inputs' range",
        lambda _: BACKLASH_SHARES,
    ),
)
