"""`check_feasibility`: refuse a tuning that cannot have an answer before any search, with figure and remedy."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf

import numpy as np

from pneuopt.control.averaging import is_affine
from pneuopt.control.dither import DITHER_AMPLITUDE
from pneuopt.control.linear_loop import ComposedLoops
from pneuopt.control.loop import ClosedLoop, find_rest, set_sliding_direction
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import describe_counts, sees_speed
from pneuopt.evaluation.margins import are_stable
from pneuopt.evaluation.metric import band_share
from pneuopt.evaluation.moves import check_motion
from pneuopt.evaluation.requirements import (
    FollowingError,
    NoiseGain,
    PeakControl,
    RiseTime,
    SettlingTime,
    SteadyStateError,
    metric_name,
    upper_limit,
)
from pneuopt.evaluation.response import TuningCase, check_travel, highest_dither_frequency
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import TAIL_SHARE
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value
from pneuopt.tuning.space import Space, shapes_linear_loop
from pneuopt.tuning.tolerances import JUST_BELOW, LEAST_GROWTH, MAX_CORNER_NAMES, POINTS_INSIDE

SIGNED_GAINS = ("pid.Kp", "pid.Ki", "pid.Kd", "pid.K")  # which turn with the actuator; times and ratios do not


def check_feasibility(loop: ClosedLoop, cases: Sequence[TuningCase], space: Space, spec: Specification) -> None:
    """Refuse a tuning that no gains within the bounds can make feasible, by an `InputError` with figure and remedy.

    The nominal plant's cases come first.
    """
    if loop.dither is not None:
        loop.dither.check(highest_dither_frequency(loop, space.parameters), loop.pid.sample_time)
    first = min((t for t, _, _ in spec.envelope), default=0.0)
    for case in cases:
        reference, record = case.reference, case.reference.horizon - case.reference.at
        for q in spec.limits:
            if isinstance(q, SettlingTime | RiseTime) and upper_limit(q) > (1 - TAIL_SHARE) * record:
                message = (
                    f"{metric_name(q)}: max {upper_limit(q):g} s is more than {record:g} s after the step can show"
                )
                needed = f"{reference.at + upper_limit(q) / (1 - TAIL_SHARE):.4g} s"
                raise InputError(
                    f"{message} (reference {reference.label}); lengthen its horizon to {needed}, or lower max"
                )
        message = f"StepEnvelope begins {first:g} s after the step, the record of reference {reference.label} ends"
        require(first < record, f"{message} after {record:g} s; lengthen its horizon, or let the bounds begin earlier")
        _check_following(case, loop, spec)
    _check_noise(loop, space, spec)
    # a dither moves the position over the edges of its counts, so that their mean tells it
    dithered = max(abs(v) for v in _parameter_range(space, DITHER_AMPLITUDE)) > 0
    counts = spec.concerns(SettlingTime) and not dithered and not sees_speed(loop)
    for case in cases:
        own = case.case_parameters(space.parameters)
        in_counts = describe_counts(loop, own, case.reference, spec.band) if counts else None
        require(in_counts is None, f"{_case_prefix(case)}{in_counts}")
        check_travel(loop, case, space.parameters)
        check_motion(loop, case, space.parameters)
        _check_hold(loop, case, space, spec)
    _check_stability(loop, cases[0], space, spec)


def _check_following(case: TuningCase, loop: ClosedLoop, spec: Specification) -> None:
    """Check that a signal as near to the reference as its following error allows can settle as early as asked."""
    most, reference, unit = spec.limit(FollowingError), case.reference, loop.feedback.unit
    if not most < inf or not reference.changes:
        return
    shown, prefix = write_value(most, unit, 3), _case_prefix(case)
    size = write_value(abs(reference.size), unit, 3)
    message = (
        f"{prefix}FollowingError: max {shown} is less than the step of {size}, its error at once; follow a move instead"
    )
    require(not isinstance(reference, Step) or most >= abs(reference.size), message)
    asked = min(spec.limit(SettlingTime), reference.horizon - reference.at)
    left = float(abs(reference.final - reference.values(np.array([reference.at + asked]))[0]))
    half = band_share(spec.band, reference) * abs(reference.nominal_size)
    message = f"{prefix}SettlingTime: max {asked:g} s comes when the reference still lacks {write_value(left, unit, 3)}"
    room = f"more than the band and FollowingError's max {shown}; raise one of them, or speed and acceleration"
    require(left <= half + most, f"{message}, {room}")


def _check_noise(loop: ClosedLoop, space: Space, spec: Specification) -> None:
    """Check that the least noise gain within the bounds keeps its limit."""
    if loop.is_composed:  # what the other paths add may turn the PID's gain either way
        return
    filters = [Tf + 0.5 * (loop.pid.sample_time or 0.0) for Tf in _parameter_range(space, "pid.Tf")]
    high = [d / Tf for d in _parameter_range(space, "pid.Kd") for Tf in filters if Tf]  # Tf as `linear_gains` has it
    Kp = _parameter_range(space, "pid.Kp")
    least = _nearest_to_zero(Kp[0] + min(high, default=0.0), Kp[1] + max(high, default=0.0))
    message = (
        f"NoiseGain: max {spec.limit(NoiseGain):g} is below |Kp + Kd/Tf|, at least {least:.4g} within the gains' bounds"
    )
    require(least <= spec.limit(NoiseGain), f"{message}; lower pid.Kp or pid.Kd, raise pid.Tf, or raise max")


def _check_hold(loop: ClosedLoop, case: TuningCase, space: Space, spec: Specification, bisections: int = 10) -> None:
    """Check that a command within the limits holds the reference to within the settling band.

    Bisections find the largest part that can be held, for the message: ten for its three digits.
    """
    reference = case.reference
    room = band_share(spec.band, reference) * reference.size  # 0 for a disturbance alone
    target = reference.final - room
    given = loop, case, space, spec
    obstacle = _find_obstacle(*given, target)
    if obstacle:
        low, high = 0.0, target
        for _ in range(bisections if not _find_obstacle(*given, 0.0) else 0):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if _find_obstacle(*given, middle) else (middle, high)
        most_held = f"; the most that can be held is {low:.3g} {loop.feedback.unit}" if low else ""
        raise InputError(f"{_case_prefix(case)}{obstacle}{most_held}")


def _find_operating_point(loop: ClosedLoop, case: TuningCase, space: Space, value: float) -> tuple[Array, float]:
    """The plant's state and the command at which an integral action holds the measured signal at a value."""
    own, acting = case.case_parameters(space.parameters), replace(loop, pid=PID(loop.pid.sample_time))
    own = own | ParameterSet({"pid.Ki": replace(acting.parameters["pid.Ki"], value=1.0)})
    start = {n: v for n, v in case.reference.start.items() if n == "position"}
    return find_rest(acting, set_sliding_direction(acting, own, value), value, start)


def plant_integrates(loop: ClosedLoop, case: TuningCase, space: Space) -> bool:
    """Whether the plant, linearised where the reference ends, has a pole at 0 that the measured signal shows.

    As in `_check_stability`, a motion is none that changes by less than `LEAST_GROWTH` over the horizon.
    """
    try:
        x, command = _find_operating_point(loop, case, space, case.reference.final)
        own = case.case_parameters(space.parameters).select(loop.plant.parameters)
        model = loop.plant.linearise(x, {loop.command.name: command}, own)
    except (ConvergenceError, InputError, ModelError):
        return False
    scale = np.array([q.nominal for q in loop.plant.states])
    _, sizes, rows = np.linalg.svd(model.A * scale / scale[:, None] * case.reference.horizon)
    shown = rows @ (model.C[model.outputs.index(loop.feedback.name)] * scale) / loop.feedback.nominal
    return bool((np.abs(shown[sizes < LEAST_GROWTH]) > LEAST_GROWTH).any())


def _find_obstacle(loop: ClosedLoop, case: TuningCase, space: Space, spec: Specification, value: float) -> str:
    """The reason why a value cannot be held, or the command that holds it is not allowed; empty where it can."""
    try:
        command = _find_operating_point(loop, case, space, value)[1]
    except ConvergenceError:
        command = 0.0  # no steady state is known
    except InputError as error:
        return str(error)
    own, unit = case.case_parameters(space.parameters), loop.command.unit
    takes = f"holding {value:.4g} {loop.feedback.unit} takes {command:.4g} {unit}"
    if loop.pid.limits:
        low, high = own.value("pid.lower"), own.value("pid.upper")
        if not low <= command <= high:
            return (
                f"{takes}, the controller's limits are {low:g} and {high:g} {unit}; take a smaller step, or widen them"
            )
    amplitude = _nearest_to_zero(*_parameter_range(space, "dither.amplitude"))
    if abs(command) + amplitude > spec.limit(PeakControl):
        beside = f" beside a dither of at least {amplitude:g} {unit}" if amplitude else ""
        most_allowed = f"PeakControl allows {spec.limit(PeakControl):g} {unit}"
        return f"{takes}{beside}, {most_allowed}; take a smaller step, or raise it"
    return ""


def _check_stability(loop: ClosedLoop, case: TuningCase, space: Space, spec: Specification) -> None:
    """Check that the bounds allow gains that may stabilise the loop, linearised where the reference ends.

    The closed loop's characteristic polynomial is negative at a real s > 0 where an odd number of real poles lies
    beyond s, and monotone in each gain of every form of a PID. Where it is negative at one s for all corners of the
    gains' bounds, it is so for all gains within. Of a sampled loop this holds for z = (1 + s h/2)/(1 - s h/2) > 1
    (`ComposedLoops`). Points within the bounds count as well, for a free dither need not act monotonically. A nonlinear
    loop may rest elsewhere where it may miss the reference; its growth counts within the horizon, and a slower one
    where other gains remove it, or it is a drift of the plant's own, as a piston's position has.
    """
    may_miss = spec.limit(SteadyStateError) < inf and not spec.concerns(SettlingTime)
    if may_miss and not is_affine(loop.plant):
        return
    names, order = [n for n in space.names if shapes_linear_loop(loop, n)], list(space.parameters)
    if len(names) > MAX_CORNER_NAMES:
        return
    box, rng = Space(case.case_parameters(space.parameters), tuple(names)), np.random.default_rng(0)
    p = box.vectors(np.vstack([box.corners(), box.from_unit(rng.random((POINTS_INSIDE, len(names))))]))
    free = np.isin(order, SIGNED_GAINS) & np.isin(order, names)
    changes = {
        "turn the sign of the gains' bounds": np.where(free, -1.0, 1.0),
        "turn the sign of the actuator": np.where(np.isin(order, SIGNED_GAINS), -1.0, 1.0),
        "widen the gains' bounds, for some gains ten times as large hold the loop": np.where(free, 10.0, 1.0),
    }
    try:
        at = _find_operating_point(loop, case, space, case.reference.final)
        growth = _common_growth(loop, _closed_loops(loop, p, *at), LEAST_GROWTH / case.reference.horizon)
        if not growth:
            return
        remedies = [words for words, by in changes.items() if are_stable(_closed_loops(loop, p * by, *at)).any()]
    except (ConvergenceError, InputError, ModelError, np.linalg.LinAlgError):
        return  # no linearisation, no proof
    if not (remedies or is_affine(loop.plant) or growth * case.reference.horizon >= 1):
        return
    ranges = {n: _parameter_range(space, n) for n in SIGNED_GAINS if any(_parameter_range(space, n))}
    words = ", ".join(f"{n} {f'within [{a:g}, {b:g}]' if a < b else f'= {a:g}'}" for n, (a, b) in ranges.items())
    end = write_value(case.reference.final, loop.feedback.unit, 3)
    message = f"every gain allowed makes the loop unstable: {words}; linearised at {end}, where the reference ends, "
    remedy = ", or ".join(remedies) or "neither turned signs nor gains ten times as large hold it"
    require(False, f"{message}a deviation grows e-fold in {1 / growth:.2g} s or less; {remedy}")


def _closed_loops(loop: ClosedLoop, p: Array, x: Array, command: float) -> Array:
    """State matrices of closed loops, shape (m, n, n), for parameters of shape (m, n_parameters)."""
    u = np.array([command * (q.name == loop.command.name) for q in loop.plant.inputs])
    A, B, C, D = ComposedLoops(loop)(p, np.tile(x, (len(p), 1)), np.tile(u, (len(p), 1))).loop
    return np.asarray(A - B @ C / (1 + D))


def _common_growth(loop: ClosedLoop, closed: Array, least: float) -> float:
    """The largest rate, above `least` [1/s], beyond which all loops have an odd number of real poles; 0 for none."""
    poles, h = np.linalg.eigvals(closed).astype(complex), loop.pid.sample_time
    real = np.where((poles.imag == 0) & (poles.real < (2 / h if h else inf)), poles.real, 0.0)
    ends = [least, *np.unique(real[real > least]).tolist()]
    rates = [JUST_BELOW * b for a, b in pairwise(ends) if JUST_BELOW * b > a]
    return max((s for s in rates if ((real > s).sum(axis=1) % 2).all()), default=0.0)


def _parameter_range(space: Space, n: str) -> tuple[float, float]:
    """The bounds of a free parameter, or twice the value of a fixed one; (0, 0) where the loop does not have it."""
    if n not in space.parameters:
        return 0.0, 0.0
    p = space.parameters[n]
    return (p.lower, p.upper) if n in space.names else (p.value, p.value)


def _nearest_to_zero(low: float, high: float) -> float:
    """The least absolute value of a range."""
    return 0.0 if low <= 0 <= high else min(abs(low), abs(high))


def _case_prefix(case: TuningCase) -> str:
    """The words with which a message about a case begins."""
    return f"reference {case.label}: "
