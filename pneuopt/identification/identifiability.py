"""`identifiability`: which parameters a set of logs can identify, before and after a fit.

Every decision about it stands here; only a running search decides by itself which parameters its data do not determine
(`shooting`). `examine_logs`: what the log doctor finds in logs of a plant; `check_content` refuses logs for it.

A newcomer adds a rule that mends: ``rule(mended, finding, ambient) -> MendedLog | None`` and its row in `RULES`.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import Axis, IdentificationHints, Lack, Need, Start
from pneuopt.dynamics.runnable import Fittable, HasSystem, centre_name, check_smooth
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.identification.problem import (
    UNSEEN_CENTRE,
    EstimationProblem,
    as_estimation_model,
    as_experiments,
    check_free,
    check_logs,
    find_centre,
)
from pneuopt.identification.profiles import Profile
from pneuopt.identification.result import (
    IdentifiableRow,
    Verdict,
    find_partners,
    join_names,
    missing_excitation,
    remedy,
    summarise_motion,
    with_values_in_words,
)
from pneuopt.identification.tolerances import (
    HARMLESS_DEVIATION,
    INFORMATION_ROUNDING,
    LEVEL,
    MAX_EXPECTED_DEVIATION,
    MAX_INFLATION,
    MAX_PRIOR_DEVIATION,
    MAX_PRIOR_VARIANCE_SHARE,
    MAX_RELATIVE_DEVIATION,
    MIN_COMBINATION_SHARE,
    MIN_FORCE_SHARE,
    MIN_STOP_FORCE,
    UNIDENTIFIABLE_DEVIATION,
)
from pneuopt.identification.widths import estimated_widths, free_widths
from pneuopt.logs.doctor import PISTON, LogFinding, StatedAxis, examine
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.mending import MendedLog, convert, empty_cells, leave_out
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import InputError, LogError, require
from pneuopt.quantities.parameters import Intersample, ParameterSet, usual_intersample
from pneuopt.quantities.units import write_value
from pneuopt.shooting.least_squares import Fit, LeastSquares, start_search
from pneuopt.shooting.segments import segment

if TYPE_CHECKING:
    import pandas as pd


MAX_RELATIVE_INTERVAL = 4 * MAX_RELATIVE_DEVIATION  # width of a profile's interval over the value: rough beyond it


UNIDENTIFIED = "the logs do not identify"
ACTS_ONLY_TOGETHER = "acts only together"
VAGUER_THAN_PRIOR = "its standard deviation is as wide as a factor of ten"


def identifiability(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
) -> Verdict:
    """Find which free parameters the logs can identify, before anything is fitted.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`.
    experiments : Experiment or sequence of Experiment
        The logs, as read.
    parameters : ParameterSet
        As for `identify`.
    method : LeastSquares, optional
        Its segments and integration steps count.

    Returns
    -------
    Verdict
        From the equations of the fit at the model's own first start, at the noise that the logs declare or show, and
        from what the motion lacks: a fit of a right model has these deviations, one of a wrong model larger ones.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    check_smooth(as_estimation_model(system))
    problem = pose_problem(system, experiments, parameters, method or LeastSquares())
    return foresee(problem)


def verdict_from_sensitivities(problem: EstimationProblem, start: Start, variance: float = 1.0) -> Verdict:
    """The verdict from the search's own equations at a start or fit; `variance` of residuals in noise variances.

    Their last stage gives a fit its standard deviations. Where they are not finite all figures are NaN.
    """
    return _make_verdict(problem, start, _root_information(problem, start) / math.sqrt(variance))


def foresee(problem: EstimationProblem) -> Verdict:
    """The verdict before a fit at the first start, with all widths that the fit estimates, which nobody asks for."""
    wide = free_widths(problem)
    start, free, widths = wide.candidates[0], wide.unknowns().free_names, estimated_widths(wide.parameters)
    others = [n not in widths for n in free]
    order = np.argsort(others, kind="stable")  # widths first: what is left behind them is what they leave of the rest
    asked = replace(problem, parameters=wide.parameters.fixed(*widths))

    def root(given: EstimationProblem) -> Array:
        whole = np.linalg.qr(_root_information(given, start)[:, order]).R
        return np.asarray(whole[len(widths) :, len(widths) :])

    still = _still_inputs(problem)
    frozen = tuple(
        replace(e, trajectory=e.trajectory.with_columns({n: np.full(len(e.trajectory), v) for n, v in still.items()}))
        for e in problem.experiments
    )
    together = _indistinguishable(asked, root(replace(wide, experiments=frozen)), still) if still else {}
    return _make_verdict(asked, start, root(wide), together=together)


def _still_inputs(problem: EstimationProblem) -> dict[str, float]:
    """The means of measured inputs that hardly change in any log, but not of what drives the plant.

    A slope over one of them and what it adds to act alike, though the model tells them apart by the little change.
    """
    plant, out = problem.system.plant, dict[str, float]()
    force = plant.axis.force if plant.axis else ""
    for q in (q for q in plant.inputs if q.unit != force and usual_intersample(q.name, q.unit) is Intersample.LINEAR):
        values = [e.trajectory[q.name] for e in problem.experiments if q.name in e.trajectory]
        column = np.concatenate(values) if values else np.zeros(1)
        if MAX_INFLATION * float(np.std(column)) < abs(float(np.mean(column))):
            out[q.name] = float(np.mean(column))
    return out


def _indistinguishable(
    problem: EstimationProblem, root: Array, still: Mapping[str, float], rounding: float = 1e5
) -> dict[str, tuple[Lack, tuple[str, ...]]]:
    """Parameters that act only together with others where inputs stand still: which, why, and with which others.

    Of each group the one is named that may have either sign, as a slope has: without it the others have a meaning.
    """
    unknowns, (spread, alone, weak) = problem.unknowns(), _standard_deviations(root)
    free, out = unknowns.free_names, dict[str, tuple[Lack, tuple[str, ...]]]()
    for group in (np.flatnonzero(row) for row in weak):
        names, either = [free[i] for i in group], [free[i] for i in group if unknowns[free[i]].lower < 0]
        if (spread[group] > rounding * alone[group]).all() and either:
            units = {q.name: q.unit for q in problem.system.plant.inputs}
            levels = [f"{n} stays near {write_value(v, units[n], 3)}" for n, v in still.items()]
            lack = Lack(join_names(levels), "fix it, or log other levels", is_strict=True)
            out[either[-1]] = lack, tuple(n for n in names if n != either[-1])
    return out


def _root_information(problem: EstimationProblem, start: Start) -> Array:
    """A root of the information about the free parameters as searched, NaN where the model is too stiff to tell."""
    method = replace(problem.method, stages=problem.method.stages[-1:], progress=None)
    begun = start_search(segment(problem.transcription(start)), method)
    root = begun.iterate.equations.root_information()
    return root * np.nan if begun.setup.is_too_stiff else root


def verdict_from_covariance(
    problem: EstimationProblem, fit: Start, covariance: "pd.DataFrame", *, trusted: bool
) -> Verdict:
    """The verdict from the covariance of a fit, NaN at a bound.

    Where the model explains the logs to their noise (`trusted`) its deviations count whatever motion the logs lack.
    """
    unknowns = problem.unknowns().with_values(fit.parameters)
    chain = np.array([unknowns[str(n)].value if unknowns[str(n)].log else 1.0 for n in covariance.index])
    searched = covariance.to_numpy() / np.outer(chain, chain)
    keep = np.isfinite(np.diag(searched))
    root = np.zeros_like(searched)
    if keep.any():
        known = searched[np.ix_(keep, keep)]
        deviation = np.sqrt(np.diag(known))  # by which covariances of any units meet in one matrix
        values, vectors = np.linalg.eigh(known / np.outer(deviation, deviation))
        root[np.ix_(keep, keep)] = (vectors / np.sqrt(np.maximum(values, 1e-14))).T / deviation
    return _make_verdict(problem, fit, root, inside_bounds=keep, trusted=trusted)


def hold_unseen(problem: EstimationProblem) -> tuple[EstimationProblem, tuple[str, ...]]:
    """The problem with parameters held that act only together with others, and a sentence on each.

    A drive that moves one way shows the sum of friction and a constant force; a fit would part them by how a model that
    rounds stiction creeps at rest.
    """
    verdict, given = foresee(problem), problem.unknowns()
    if not len(verdict.unseen) < len(verdict.table):
        return problem, ()
    held = {n: given.value(n) for n in verdict.unseen}
    said = tuple(f"before the search: {UNIDENTIFIED} {n}: {verdict.reasons[n]}" for n in held)
    return replace(problem, fixed={**problem.fixed, **held}, unseen=frozenset(held)), said


def add_profiles(verdict: Verdict, profiles: Mapping[str, Profile]) -> Verdict:
    """The verdict with the intervals of profiles: a parameter with two open ends is unidentifiable."""
    reasons, identifiable = dict(verdict.reasons), verdict.table["identifiable"].copy()
    for name, found in profiles.items():
        is_unidentifiable = math.isinf(found.low) and math.isinf(found.high)
        identifiable[name] = bool(identifiable[name]) and not is_unidentifiable
        reasons.pop(name, None)
        if not found.high - found.low < MAX_RELATIVE_INTERVAL * abs(found.estimate):
            reasons[name] = f"{found.sentence}; {remedy(verdict.identification_hints, [name])}"
    return replace(verdict, table=verdict.table.assign(identifiable=identifiable), reasons=reasons)


def add_unidentifiable(verdict: Verdict, names: Sequence[str], local: Verdict, unchanged: Sequence[str]) -> Verdict:
    """The verdict with parameters marked that rest on a prior; their figures come from `local`, by sensitivities."""
    table, own = verdict.table.copy(), list(names)
    table.loc[own] = local.table.loc[own]
    table.loc[own, "identifiable"] = False
    groups = tuple(group for group in local.indistinguishable if {*group} & {*names})
    grouped = {n for group in groups for n in group}
    reasons = {n: reason for n, reason in verdict.reasons.items() if n not in names}
    vague = {n: f"{VAGUER_THAN_PRIOR}; {remedy(verdict.identification_hints, [n])}" for n in names if n not in grouped}
    reasons |= {**vague, **{n: local.reasons[n] for n in names if n in local.reasons}}
    ordered = tuple(str(n) for n in table.index if n in unchanged)
    return Verdict(table, (*verdict.indistinguishable, *groups), reasons, ordered, verdict.identification_hints)


def rejects_fixed_values(fit: Fit, first: Fit, held: int) -> bool:
    """Whether a likelihood-ratio test rejects the values of `held` parameters that `first` was free in.

    A rise of the gaps' cost alone does not count: finer integration steps show gaps that the first fit missed.
    """
    before, after = first.stats["cost"], fit.stats["cost"]
    rise = min(2 * (after - before), fit.chi_square - first.chi_square)
    noise = max(1.0, 2 * before / max(1, first.count))
    return not rise <= noise * chi2.ppf(LEVEL, held)


def prior_influenced(covariance: Array, prior_covariance: Array) -> Mask:
    """The mask of estimates whose variance the priors of held parameters dominate; covariances of shape (k, k)."""
    return np.asarray(np.diag(prior_covariance) > MAX_PRIOR_VARIANCE_SHARE * np.diag(covariance))


def prior_dominated(covariance: Array, prior_covariance: Array, values: Array, held: Iterable[float]) -> Mask:
    """The mask of estimates that lean on priors, and are not known well even so; nothing is that leans on a zero."""
    is_close = np.sqrt(np.diag(covariance)) <= MAX_PRIOR_DEVIATION * np.abs(values)
    is_close &= all(held)
    return prior_influenced(covariance, prior_covariance) & ~is_close


def _make_verdict(
    problem: EstimationProblem,
    start: Start,
    root: Array,
    inside_bounds: Mask | None = None,
    *,
    trusted: bool = False,
    together: Mapping[str, tuple[Lack, tuple[str, ...]]] = MappingProxyType({}),
) -> Verdict:
    """The verdict from a square root of the information matrix and from the logged motion."""
    import pandas as pd

    unknowns = problem.unknowns().with_values(start.parameters)
    free = {n: unknowns[n] for n in unknowns.free_names}
    names, (spread, alone, weak) = list(free), _standard_deviations(root)
    values = problem.parameters.with_values({n: v for n, v in start.parameters.items() if n in problem.parameters})
    seen = summarise_motion(problem.experiments, start.states, values, problem.parameters)
    rows, reasons, hints = {}, {}, with_values_in_words(_hints(problem), values)
    widths = estimated_widths(problem.parameters)
    lacks = {} if trusted else {n: lack for n in names if (lack := missing_excitation(hints, n, names, seen))}
    unseen = {n: find_partners(hints, n, names) for n, lack in lacks.items() if lack.is_strict}
    lacks |= {n: lack for n, (lack, _) in together.items()}
    unseen |= {n: partners for n, (_, partners) in together.items()}
    for i, (name, p) in enumerate(free.items()):
        if inside_bounds is not None and not inside_bounds[i]:
            rows[name] = [p.value, *[math.nan] * 4, True]
            if name not in widths:
                reasons[name] = "the best fit is at its bound, and the other intervals hold for that value only"
            continue
        unit, given, least = p.value if p.log else 1.0, problem.parameters[name.partition("[")[0]], float(p.unit == "1")
        is_offset = p.lower < 0 and not least  # whose usual size is unknown
        size = 1.0 if p.log else 0.0 if is_offset else max(abs(p.value), abs(given.value), least)
        relative = spread[i] / size if size > 0 else math.nan
        lack = lacks.get(name)
        with_it = [n for n, partners in unseen.items() if name in partners]
        is_unidentifiable = name not in widths and (
            bool(lack or with_it or math.isinf(spread[i]))
            or relative > (MAX_EXPECTED_DEVIATION if inside_bounds is None else UNIDENTIFIABLE_DEVIATION)
        )
        if with_it and lack is None:
            reasons[name] = f"it {ACTS_ONLY_TOGETHER} with {join_names(with_it)}"
        elif is_unidentifiable or (name not in widths and relative > MAX_RELATIVE_DEVIATION):
            reasons[name] = _unidentifiable_reason(alone[i], relative, lack, unseen.get(name), remedy(hints, [name]))
        inflation = spread[i] / alone[i] if math.isfinite(spread[i]) else spread[i]
        rows[name] = [p.value, unit * spread[i], relative, unit * alone[i], inflation, not is_unidentifiable]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=list(IdentifiableRow.__annotations__))
    groups = [tuple(names[i] for i in np.flatnonzero(row)) for row in weak]
    harmful = tuple(group for group in groups if _does_harm(table.loc[[*group]]) and not {*group} & {*unseen})
    return Verdict(table, harmful, reasons, identification_hints=hints, unseen=tuple(unseen))


def _does_harm(group: "pd.DataFrame") -> bool:
    """Whether parameters act alike so nearly that one of them is not known well."""
    inflation, relative = group[["inflation", "relative"]].max()
    return bool(inflation > MAX_INFLATION and relative > HARMLESS_DEVIATION)


def _hints(problem: EstimationProblem) -> IdentificationHints:
    """The plant's hints, and what a valve's command that stays on one side of its centre lacks."""
    plant = problem.system.plant
    hints, centre = plant.identification_hints, centre_name(plant)
    element = plant.axis.final_element if plant.axis else None
    if centre is None or element is None or problem.parameters[centre].source != UNSEEN_CENTRE:
        return hints
    lack = Lack(
        f"the command stays on one side of the {element.name}'s middle", "state it, or log both sides", is_strict=True
    )
    return replace(hints, needs={**hints.needs, centre: Need(lambda _: lack, frozenset({element.dead_zone}))})


def _unidentifiable_reason(
    alone: float, relative: float, lack: Lack | None, partners: Sequence[str] | None, usual_remedy: str
) -> str:
    """The reason why the logs do not identify a parameter, and the remedy."""
    if lack is not None and partners:
        return f"{lack.reason}, so that it {ACTS_ONLY_TOGETHER} with {join_names(partners)}; {lack.remedy}"
    if lack is not None:
        return f"{lack.reason}; {lack.remedy}"
    if math.isinf(alone):
        return "nothing measured depends on it; fix it, or log a run that does"
    message = (
        f"within {relative:.0%} (1 standard deviation)" if relative < UNIDENTIFIABLE_DEVIATION else VAGUER_THAN_PRIOR
    )
    return f"{message}; {usual_remedy}"


def _standard_deviations(root: Array) -> tuple[Array, Array, Mask]:
    """Standard deviations (all unknown; all others known), and the members of each weak combination."""
    size = np.linalg.norm(root, axis=0)
    if not np.isfinite(root).all():
        return size * np.nan, size * np.nan, np.zeros((0, len(size)), dtype=bool)
    informed = size > INFORMATION_ROUNDING * float(np.max(size, initial=0.0))
    with np.errstate(divide="ignore"):
        alone = np.where(informed, 1 / size, math.inf)
    spread, weak = alone.copy(), np.zeros((0, len(size)), dtype=bool)
    if informed.any():
        _, singular, right = np.linalg.svd(root[:, informed] / size[informed])
        inverse = 1 / np.maximum(singular, INFORMATION_ROUNDING)
        spread[informed] = np.linalg.norm(right * inverse[:, None], axis=0) / size[informed]
        parts = np.abs(right[inverse > MAX_INFLATION])
        member = parts > MIN_COMBINATION_SHARE * parts.max(axis=1, keepdims=True, initial=0.0)
        weak = np.zeros((len(member), len(size)), dtype=bool)
        weak[:, informed] = member
    return spread, alone, weak[weak.sum(axis=1) > 1]


QUIET_CHECKS = ("sampling", "dwells")
"""Checks whose notes are no doubts of the log: they would stand in the status of every fit."""


def examine_logs(
    system: HasSystem | ClosedLoop, experiments: Experiment | Iterable[Experiment], parameters: ParameterSet
) -> tuple[LogFinding, ...]:
    """Find what is wrong with logs before any fit, as `identify` does, in seconds.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`.
    experiments : Experiment or sequence of Experiment
        The logs, as read.
    parameters : ParameterSet
        Masses and forces that are not free are stated, and a log may contradict them.

    Returns
    -------
    tuple of LogFinding
        Of each log, faults first. `plotting.plot_finding` draws the signals that show one.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    model = as_estimation_model(system)
    return tuple(_find(model, check_logs(model, as_experiments(experiments), parameters), parameters))


def pose_problem(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Iterable[Experiment],
    parameters: ParameterSet,
    method: LeastSquares,
) -> EstimationProblem:
    """The estimation problem of logs that `identify` accepts."""
    model = as_estimation_model(system)
    logs = check_logs(model, experiments, parameters)
    parameters = find_centre(model, logs, parameters)
    check_free(logs, parameters)
    check_content(model, logs, parameters)
    return free_widths(EstimationProblem(model, tuple(logs), model.parameters | parameters, method))


def check_content(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """Refuse logs of which more than half show the same fault; return a sentence on each accepted fault and each doubt.

    A window of a good log may well stand still.
    """
    found, said = list(_find(system, experiments, parameters)), dict[str, str]()
    for finding in found:
        if not finding.fault and finding.check not in QUIET_CHECKS:
            said.setdefault(finding.channel, f"{finding.log}: {finding.message}")
        elif is_accepted(finding, experiments):
            said.setdefault(finding.channel, f"{finding.log}: accepted as right: {finding.message}")
    for finding in found:
        if is_refused(finding, found, experiments):
            raise LogError(f"{finding.log}: {finding.message}; {accept_remedy(finding)}", finding)
    return tuple(said.values())


def is_accepted(finding: LogFinding, experiments: Sequence[Experiment]) -> bool:
    """Whether a fault's log is right by what its user says."""
    return finding.fault and any(finding.check in e.accept for e in experiments if e.name == finding.log)


def is_refused(finding: LogFinding, found: Iterable[LogFinding], experiments: Sequence[Experiment]) -> bool:
    """Whether a fit refuses the logs for a fault: it is not accepted, and more than half of the logs show it."""
    alike = {f.log for f in found if f.fault and f.channel == finding.channel and not is_accepted(f, experiments)}
    return finding.fault and finding.log in alike and 2 * len(alike) > len(experiments)


def accept_remedy(finding: LogFinding) -> str:
    """The remedy for a log that is right all the same."""
    return f"if the log is right, accept = [{finding.check!r}] in its sidecar, or --accept {finding.check}"


def _find(system: Fittable, experiments: Iterable[Experiment], parameters: ParameterSet) -> Iterator[LogFinding]:
    for experiment in experiments:
        yield from examine(experiment, axis_from_model(system.plant, experiment, parameters))


def axis_from_model(plant: System, experiment: Experiment, parameters: ParameterSet) -> StatedAxis:
    """The channels of the plant's axis and the forces on it that are not free; a piston's by default."""
    if plant.axis is None:
        return PISTON._replace(forces={}, is_piston=_may_be_piston(plant, parameters))
    known = plant.parameters | parameters.select(n for n in parameters if n in plant.parameters)
    conditions = {n: value for n, value in experiment.conditions.items() if n in known}
    known = known.with_values(conditions).fixed(*conditions)
    body, axis = _Body(plant, plant.axis, known), plant.axis
    pushes = [q.name for q in plant.inputs if q.unit == axis.force]
    weights, constant = body.forces(body.vector)
    for name in known.free_names:
        others, moved = body.forces(body.with_change(name))
        weights = weights if _agree(others, weights) else {}
        constant = constant if _agree({"": moved}, {"": constant}) else math.nan
    if any(abs(body.asymmetry(p)) > 1e-6 for p in (body.vector, *map(body.with_change, known.free_names))):
        constant = math.nan
    if any(n.startswith("sensor.") and n.endswith(".offset") for n in known):
        constant = math.nan
    return StatedAxis(
        axis.position,
        axis.speed,
        pushes[0] if pushes else PISTON.push,
        forces=weights,
        constant=constant,
        inertia=math.nan if known[axis.inertia].free else known.value(axis.inertia),
        inertia_name=axis.inertia,
        inertia_unit=known[axis.inertia].unit,
        force_unit=axis.force,
        offset_parameter=body.offset_parameter(),
        stops=body.stops(),
    )


def _may_be_piston(plant: System, parameters: ParameterSet) -> bool:
    """Whether a plant without a body moves in metres, and forward in the long run by a positive command, as stated."""
    channels = [q for q in plant.outputs if q.name in (PISTON.position, PISTON.speed)]
    if any(q.unit not in ("m", "m/s") for q in channels):
        return False
    if not (channels and plant.inputs and plant.states):
        return True
    at = plant.linearise(np.zeros(len(plant.states)), {}, parameters)
    slow = 1e-6 * (1 + np.abs(at.A).max()) * np.eye(len(at.A))  # of an integrator, too, the gain is finite there
    return not (at.C @ np.linalg.solve(slow - at.A, at.B) + at.D)[0, 0] < 0


def _agree(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    return a.keys() == b.keys() and all(math.isclose(a[n], b[n], rel_tol=1e-6, abs_tol=1e-9) for n in a)


class _Body:
    """The body of a plant at rest: which signals push it, and how strongly."""

    def __init__(self, plant: System, axis: Axis, known: ParameterSet, change: float = 1e-3) -> None:
        self.plant, self.axis, self.known = plant, axis, known
        self.change = change  # [1] of a value or of its unit, for the slopes of the force
        self.vector = parameter_vector(plant.parameters, known)
        ends = [limit.limit(known) for limit in plant.validity_limits if limit.state == axis.position]
        self.ends = tuple(ends) if len(ends) == 2 else ()
        middle = {axis.position: sum(self.ends) / 2, axis.speed: 0.0}
        self.x = np.array([middle.get(s.name, s.nominal if s.unit.startswith("Pa") else 0.0) for s in plant.states])

    def force(self, vector: Array, signals: Mapping[str, float]) -> float:
        """The force on the body without friction at values of signals [SI], others at their base."""
        x = [signals.get(n, base) for n, base in zip(names(self.plant.states), self.x, strict=True)]
        u = [signals.get(n, 0.0) for n in names(self.plant.inputs)]
        rate = np.array(self.plant.ode(0, x, u, vector)[0]).ravel()[names(self.plant.states).index(self.axis.speed)]
        return float(rate * vector[list(self.plant.parameters).index(self.axis.inertia)])

    def forces(self, vector: Array) -> tuple[dict[str, float], float]:
        """The force on the body per unit of each signal that pushes it, and what is left without them."""
        states = dict(zip(names(self.plant.states), self.x, strict=True))
        base = {**states, **dict.fromkeys(names(self.plant.inputs), 0.0)}
        at_base, weights = self.force(vector, {}), dict[str, float]()
        for q in (*self.plant.states, *self.plant.inputs):
            if q.name == self.axis.speed or q.name.startswith("friction."):
                continue
            step = self.change * q.nominal
            weights[q.name] = (self.force(vector, {q.name: base[q.name] + step}) - at_base) / step
        sizes = {q.name: abs(weights.get(q.name, 0.0)) * q.nominal for q in (*self.plant.states, *self.plant.inputs)}
        pushes = {n: weight for n, weight in weights.items() if sizes[n] > MIN_FORCE_SHARE * max(sizes.values())}
        return pushes, float(at_base - sum(weight * base[n] for n, weight in pushes.items()))

    def asymmetry(self, vector: Array) -> float:
        """The friction at the nominal speed one way, less that of the other way."""
        fast = next(s.nominal for s in self.plant.states if s.name == self.axis.speed)
        ways = [self.force(vector, {self.axis.speed: speed}) for speed in (fast, -fast)]
        return sum(ways) - 2 * self.force(vector, {})

    def with_change(self, name: str) -> Array:
        """The vector with one parameter changed a little."""
        vector, k = self.vector.copy(), list(self.plant.parameters).index(name)
        vector[k] += self.change * (abs(vector[k]) or 1.0)
        return vector

    def offset_parameter(self) -> str:
        """The first parameter that is a constant force on the body."""
        weights, constant = self.forces(self.vector)
        for name in (n for n, p in self.known.items() if p.unit == self.axis.force):
            others, moved = self.forces(self.with_change(name))
            if _agree(others, weights) and not _agree({"": moved}, {"": constant}):
                return name
        return ""

    def stops(self, depth: float = 1e-3) -> tuple[float, ...]:
        """Both ends of the position, if the model's stops push back `depth` [m] beyond them; else none."""
        free = self.force(self.vector, {})
        found = []
        for end, other in zip(self.ends, self.ends[::-1], strict=True):
            beyond = end + math.copysign(depth, end - other)
            found.append(abs(self.force(self.vector, {self.axis.position: beyond}) - free) > MIN_STOP_FORCE)
        return self.ends if found and all(found) else ()


def find_exchange(model: Fittable, log: Experiment, parameters: ParameterSet) -> tuple[str, str] | None:
    """Two channels with which exchanged the log doctor finds no fault; None where there is no such pair, or several."""
    pairs = []
    for pair in combinations(log.trajectory, 2):
        with suppress(InputError):
            (full,) = check_logs(model, exchange(log, *pair), parameters)
            found = examine(full, axis_from_model(model.plant, full, parameters))
            pairs += [] if any(f.fault for f in found) else [pair]
    return pairs[0] if len(pairs) == 1 else None


def exchange(log: Experiment, a: str, b: str) -> Experiment:
    """The log with two columns exchanged; each is converted as the channel's own was. Noise levels of both are lost."""
    values, columns = {a: log.trajectory[b], b: log.trajectory[a]}, log.source.columns if log.source else {}
    if a in columns and b in columns:
        for name, other in ((a, b), (b, a)):
            raw = (log.trajectory[other] - columns[other].offset) / columns[other].factor
            values[name] = columns[name].factor * raw + columns[name].offset
    noise = {n: sigma for n, sigma in log.noise.items() if n not in (a, b)}
    return replace(log, trajectory=log.trajectory.with_columns(values), noise=noise, holes=())


Rule = Callable[[MendedLog, LogFinding, float], MendedLog | None]


def mend_findings(model: Fittable, mended: MendedLog, parameters: ParameterSet, ambient: float) -> MendedLog:
    """Mend the faults of a log by rules, each taken back where its fault stays; gauge pressures count from `ambient`.

    Where motion and force are both wrong nobody can tell what is right: `LogError`.
    """
    several = len({f.channel for f in _find_faults(model, mended.log, parameters)}) > 1
    pair = find_exchange(model, mended.log, parameters) if several else None
    if pair is not None:
        why = f"columns of {pair[0]} and {pair[1]} exchanged, for with them so nothing is wrong"
        return MendedLog(exchange(mended.log, *pair), mended.rows, (*mended.changes, why))
    tried, used = set[tuple[str, str]](), set[str]()
    while True:
        found = [f for f in _find_faults(model, mended.log, parameters) if _key(f) not in tried and f.check in RULES]
        if not found:
            break
        tried.add(_key(found[0]))
        changed = RULES[found[0].check](mended, found[0], ambient)
        if changed and _key(found[0]) not in {_key(f) for f in _find_faults(model, changed.log, parameters)}:
            mended = changed
            used.add(found[0].check)
    both = "the signs or sizes of two channels are wrong at once: is a column another channel? say in [columns] which"
    require(not used >= {"work", "scale"}, f"{mended.log.name}: {both}", LogError)
    return mended


def _key(finding: LogFinding) -> tuple[str, str]:
    return finding.check, finding.channel


def _find_faults(model: Fittable, log: Experiment, parameters: ParameterSet) -> list[LogFinding]:
    (full,) = check_logs(model, log, parameters)
    found = examine(full, axis_from_model(model.plant, full, parameters))
    return [f for f in found if f.fault and not is_accepted(f, [full])]


def _between_jumps(mended: MendedLog, finding: LogFinding, _: float) -> MendedLog | None:
    """A counter that loses steps and finds them again: nothing is known of the position in between."""
    if finding.evidence is None:
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finding.evidence.contradiction, [False]]).astype(int)))
    begins, ends = edges[::2] + 1, edges[1::2] - 1  # first sample behind a jump, last sample of its mark
    if begins.size % 2:
        return None
    lost = np.zeros(len(mended.log.trajectory), dtype=bool)
    for begin, end in zip(begins[::2], ends[1::2], strict=True):
        lost[begin:end] = True
    return empty_cells(mended, finding.channel, lost, "between two jumps")


RULES: dict[str, Rule] = {
    "jumps": _between_jumps,
    "stops": lambda mended, finding, _: (
        leave_out(mended, finding.evidence.contradiction, "at an end stop that the model has not")
        if finding.evidence is not None
        else None
    ),
    # a force that brakes on balance; of two pressures nobody knows which sensor is meant
    "work": lambda mended, finding, _: (
        convert(mended, finding.channel, -1.0, 0.0, "for it brakes the motion on balance")
        if finding.channel in mended.log.trajectory
        else None
    ),
    "scale": lambda mended, finding, _: convert(
        mended, finding.channel, 1e-3, 0.0, "for it moves as fast as mm that are read as m"
    ),
    "pressures": lambda mended, finding, ambient: (
        convert(mended, finding.channel, 1.0, ambient, "for it is a gauge pressure that is read as absolute")
        if "a vacuum" in finding.message
        else None
    ),
}
"""By the name of the check."""
