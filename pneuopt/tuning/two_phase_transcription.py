"""The settling-time problem of a linear loop written as a transcription with a free duration.

Phase "transient" is [0, Ts] with Ts unknown, phase "settled" the rest, where |y - r| <= band is a path limit; so the
settling time is a smooth function of the gains. Each further term of the objective (the overshoot and so on) is one
more unknown, which its path limit may not exceed. Fast dither leaves a linear loop's average alone; its offset is a
step at the command.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.dynamics.system import DiscreteSystem, System, discretise, names
from pneuopt.evaluation.band import band_number
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.evaluation.margins import frequency_grid, sensitivity_terms
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    MaxSensitivity,
    Overshoot,
    PeakControl,
    SettlingTime,
    SteadyStateError,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.transcription import Cost, Limit, Phase, Transcription, Where, regular_nodes
from pneuopt.tuning.space import Space, fastest_eigenvalue, rk4_substeps

# Requirements that the problem has an equation for, beside the settling time, which is its free duration.
EXACT_REQUIREMENTS = tuple(kind for kind in REQUIREMENT_KINDS if kind.metric.exact and kind is not SettlingTime)
# Upper bounds of the unknowns that stand for terms of the objective, as `Specification.limit` counts (fractions of the
# step, the command's unit, 1). A smaller one may cut off the optimum; a far larger one scales the unknown badly.
UNKNOWN_UPPER_BOUNDS = {"Overshoot": 10.0, "SteadyStateError": 10.0, "PeakControl": 1e6, "MaxSensitivity": 100.0}
SETTLING_PARAMETER = "SettlingTime"  # name of the unknown duration [s]
BAND_PARAMETER = "band.share"  # name of the settling band's factor, 1 as transcribed; a continuation moves it


def transcribe_two_phase(
    loop: ClosedLoop, references: Sequence[Reference], space: Space, spec: Specification, nodes: tuple[int, int]
) -> Transcription:
    """Write the two-phase problem, in which the references share one settling time, the largest.

    Parameters
    ----------
    loop : ClosedLoop
        A linear one.
    references : sequence of Reference
    space : Space
    spec : Specification
        Already tightened.
    nodes : tuple of int
        Shooting nodes of the transient and of the settled phase.

    Raises
    ------
    InputError
        If the state before the step depends on the gains, or a mode is too fast for the nodes.
    """
    free_loop = without_clip(loop)
    averaged = space.parameters.select(free_loop.parameters)
    if loop.dither:
        averaged = averaged.with_values({"dither.amplitude": 0.0}).fixed("dither.amplitude")
    extra = _extra_unknowns(references, spec)
    system = _extend_system(free_loop, extra, space, references, nodes)
    parameters = (averaged | extra).select(system.parameters)
    phases = [p for i, r in enumerate(references) for p in _reference_phases(loop, space, i, r, nodes)]
    parameters = parameters | _durations(references, spec, extra[SETTLING_PARAMETER])
    limits = [
        *_horizon_limits(references, parameters),
        *(q for i, r in enumerate(references) for q in _path_limits(loop, space, spec, system, i, r)),
        *_sensitivity_limit(free_loop, averaged, space, spec, parameters),
    ]
    return Transcription(system, parameters, tuple(phases), (), _costs(spec, parameters), tuple(limits))


def without_clip(loop: ClosedLoop) -> ClosedLoop:
    """The loop without its clip."""
    return replace(loop, pid=replace(loop.pid, limits=False))


def _extra_unknowns(references: Sequence[Reference], spec: Specification) -> ParameterSet:
    """The settling time, an unknown for each other term of the objective, and a number for each other limit."""
    horizon = min(r.horizon - r.at for r in references)
    most = min(spec.limit(SettlingTime), (1 - TAIL_SHARE) * horizon)  # metrics need the rest as the record's end
    free = spec.weight(SettlingTime) > 0
    given = {
        SETTLING_PARAMETER: Parameter(
            0.5 * most if free or not spec.concerns(SettlingTime) else most, "s", 1e-3 * most, most, free=free
        ),
        BAND_PARAMETER: Parameter(1.0, "1"),
    }
    for kind in EXACT_REQUIREMENTS:
        if spec.weight(kind) > 0:
            least = 1.0 if kind is MaxSensitivity else 0.0
            most = min(spec.limit(kind), UNKNOWN_UPPER_BOUNDS[kind.__name__])
            start = min(2.0, most) if kind is MaxSensitivity else min(1.0, most)
            given[kind.__name__] = Parameter(start, "1", least, most, free=True)
        elif spec.limit(kind) < math.inf:  # a number of the problem, which a continuation may move
            given[kind.__name__] = Parameter(spec.limit(kind), "1")
    return ParameterSet(given)


def _durations(references: Sequence[Reference], spec: Specification, settling: Parameter) -> ParameterSet:
    """The durations [s] of each reference, before its step and of its settled phase.

    Where the error at the end counts the settled phase ends with the horizon; otherwise it is as long as the record
    after the step, which shows more of the band.
    """
    found = {f"before.{i}": Parameter(r.at, "s") for i, r in enumerate(references) if r.at > 0}
    for i, r in enumerate(references):
        record = r.horizon - r.at
        if not spec.concerns(SteadyStateError):
            found[_settled_duration(i)] = Parameter(record, "s")
        elif settling.free:
            rest, least, most = (record - v for v in (settling.value, settling.upper, settling.lower))
            found[_settled_duration(i)] = Parameter(rest, "s", least, most, free=True)
        else:
            found[_settled_duration(i)] = Parameter(record - settling.value, "s")
    return ParameterSet(found)


def _settled_duration(i: int) -> str:
    """The name of the duration of reference i's settled phase."""
    return f"rest.{i}"


def _horizon_limits(references: Sequence[Reference], parameters: ParameterSet) -> list[Limit]:
    """The settled phase ends with the horizon, where its duration is unknown because the settling time is."""
    q, names_ = ca.SX.sym("q", len(parameters)), list(parameters)
    return [
        Limit(
            f"horizon {i}",
            ca.Function("limit", [q], [q[names_.index(SETTLING_PARAMETER)] + q[names_.index(_settled_duration(i))]]),
            r.horizon - r.at,
            r.horizon - r.at,
            Where.PARAMETERS,
        )
        for i, r in enumerate(references)
        if parameters[_settled_duration(i)].free
    ]


def _extend_system(
    loop: ClosedLoop, extra: ParameterSet, space: Space, references: Sequence[Reference], nodes: tuple[int, int]
) -> DiscreteSystem:
    """Discretise the loop with the extra unknowns among its parameters, so that path limits may depend on them."""
    system = loop.system()
    t, x, u, p = (ca.SX.sym(k, system.ode.size1_in(i)) for i, k in enumerate("txup"))
    more = ca.SX.sym("more", len(extra))
    ode = ca.Function(
        "ode", [t, x, u, ca.vertcat(p, more)], [*system.ode(t, x, u, p)], ["t", "x", "u", "p"], ["xdot", "y"]
    )
    longest = max(max(extra[SETTLING_PARAMETER].upper / nodes[0], r.horizon / nodes[1]) for r in references)
    own = Space(space.parameters.select(loop.parameters), space.names)
    rates = fastest_eigenvalue(loop, own.vectors(own.corners()), [np.zeros(len(loop.states))])
    steps = rk4_substeps(float(rates.max()), longest)
    return discretise(
        System(system.states, system.inputs, system.outputs, system.parameters | extra, ode), max(2, steps)
    )


def _reference_phases(
    loop: ClosedLoop, space: Space, i: int, reference: Reference, nodes: tuple[int, int]
) -> list[Phase]:
    """The phases of reference i: before the step, where there is such a time, transient and settled."""
    start = _state_before_step(loop, space, reference)
    disturbed = {disturbance_input(n): v for n, v in reference.disturbance.items()}
    after = [disturbed.get(n, 0.0) for n in names(loop.inputs)[1:]]

    def make_phase(name: str, n: int, value: float, duration: str, first: Array | None) -> Phase:
        inputs = np.tile([value, *(np.zeros(len(after)) if name == "before" else after)], (n, 1))
        grid, step = np.arange(n) / n, np.full(n, 1 / n)
        return Phase(f"{name}.{i}", grid, step, inputs, regular_nodes(n, 1), first, first is None, duration)

    moved = reference.at > 0
    before = [make_phase("before", nodes[0], reference.initial, f"before.{i}", start)] if moved else []
    transient = make_phase("transient", nodes[0], reference.final, SETTLING_PARAMETER, None if moved else start)
    return [*before, transient, make_phase("settled", nodes[1], reference.final, _settled_duration(i), None)]


def _state_before_step(loop: ClosedLoop, space: Space, reference: Reference) -> Array:
    """The loop's state before the step, shape (n_states,); `InputError` where it depends on the gains."""
    first = loop.initial(space.parameters, reference=reference.initial, start=reference.start)
    for share in (0.3, 0.8):
        gains = space.parameters_at(space.from_unit(np.full(len(space.names), share)))
        other = loop.initial(gains, reference=reference.initial, start=reference.start)
        scale = np.array([q.nominal for q in loop.states])
        require(
            bool(np.all(np.abs(first - other) <= 1e-9 * scale)),
            f"before the step the loop rests in a state that depends on its gains (reference {reference.initial:g}, or "
            "a load): the two-phase problem needs one that does not; step from zero, or use method=Racing()",
        )
    return first


def _path_limits(
    loop: ClosedLoop, space: Space, spec: Specification, system: DiscreteSystem, i: int, reference: Reference
) -> list[Limit]:
    """The path limits of reference i: settling band, overshoot, steady-state error, peak command and clip."""
    t, x, u, p = (ca.SX.sym(k, system.step.size1_in(j)) for k, j in zip("txup", (0, 2, 3, 4), strict=True))
    y = system.step(t, 0, x, u, p)[1]
    outputs, at = names(system.outputs), list(system.parameters).index
    error = (y[outputs.index(loop.feedback.name)] - u[0]) / reference.nominal_size
    control = y[outputs.index("control")]
    count = 3 if reference.at > 0 else 2
    transient, settled = count * i + count - 2, count * i + count - 1
    both = (transient, settled)

    def path_limit(name: str, value: ca.SX, lower: float, upper: float, where: Where, phases: tuple[int, ...]) -> Limit:
        return Limit(name, ca.Function("limit", [t, x, u, p], [value]), lower, upper, where, phases)

    def upper_limits(kind: type, value: ca.SX, where: Where, phases: tuple[int, ...]) -> list[Limit]:
        """Hold values below the limit of their kind, or below the unknown that stands for it in the objective."""
        if not spec.concerns(kind):
            return []
        return [path_limit(kind.__name__, value - p[at(kind.__name__)], -math.inf, 0.0, where, phases)]

    found = []
    if spec.concerns(SettlingTime):
        width = band_number(spec.band)
        inside, both_ends = error / p[at(BAND_PARAMETER)], (Where.NODES, Where.END)
        found += [path_limit("settling band", inside, -width, width, w, (settled,)) for w in both_ends]
    beyond = error if reference.changes else ca.vertcat(error, -error)
    found += upper_limits(Overshoot, beyond, Where.NODES, both)
    found += upper_limits(SteadyStateError, ca.vertcat(error, -error), Where.END, (settled,))
    found += upper_limits(PeakControl, ca.vertcat(control, -control), Where.NODES, both)
    if loop.pid.limits:
        ends = [space.parameters.value(f"pid.{n}") for n in ("lower", "upper")]
        if np.isfinite(ends).any():
            found.append(path_limit("the command's clip", control, ends[0], ends[1], Where.NODES, both))
    return found


def _sensitivity_limit(
    loop: ClosedLoop, averaged: ParameterSet, space: Space, spec: Specification, parameters: ParameterSet
) -> list[Limit]:
    """The limit on the sensitivity's peak: Ms^2 |1 + L|^2 >= 1 at every frequency of a grid."""
    if not spec.concerns(MaxSensitivity):
        return []
    grid = np.unique(
        np.concatenate(
            [
                _sensitivity_frequencies(loop, averaged, space.from_unit(np.full(len(space.names), k)), space)
                for k in (0.2, 0.8)
            ]
        )
    )
    terms = sensitivity_terms(loop, grid, averaged)
    q = ca.SX.sym("q", len(parameters))
    Ms = q[list(parameters).index("MaxSensitivity")]
    value = terms(q[: len(loop.parameters)]) * Ms**2
    return [Limit("MaxSensitivity", ca.Function("limit", [q], [value]), 1.0, math.inf, Where.PARAMETERS)]


def _sensitivity_frequencies(loop: ClosedLoop, averaged: ParameterSet, point: Array, space: Space) -> Array:
    """Frequencies around the loop's modes, where the sensitivity peaks [rad/s]."""
    own = Space(averaged, space.names).parameters_at(point)
    full = frequency_grid(open_loop(loop, own), 40)
    return np.asarray(full[(full > 30 * full[0]) & (full < full[-1] / 30)], dtype=float)


def _costs(spec: Specification, parameters: ParameterSet) -> tuple[Cost, ...]:
    """The objective: a weighted sum of the unknowns that stand for its terms."""
    q = ca.SX.sym("q", len(parameters))
    terms = {kind.metric.name: spec.weight(kind) for kind in REQUIREMENT_KINDS if kind.metric.exact}
    return tuple(
        Cost(n, ca.Function("cost", [q], [q[list(parameters).index(n)]]), Where.PARAMETERS, weight=weight)
        for n, weight in terms.items()
        if weight > 0
    )
