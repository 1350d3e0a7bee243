"""`check_feasibility`: refuse a tuning that cannot have an answer before any search, with figure and remedy."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from pneuopt.control.dither import DITHER_AMPLITUDE
from pneuopt.control.linear_loop import linear_plant
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Reference, Step
from pneuopt.control.rest import find_rest, set_sliding_direction
from pneuopt.evaluation.band import band_share
from pneuopt.evaluation.cases import TuningCase
from pneuopt.evaluation.counts import describe_counts, sees_speed
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.evaluation.margins import frequency_response
from pneuopt.evaluation.motion_requirements import FollowingError
from pneuopt.evaluation.move_check import check_motion
from pneuopt.evaluation.requirements import NoiseGain, PeakControl, RiseTime, SettlingTime, metric_name, upper_limit
from pneuopt.evaluation.response import highest_dither_frequency
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.travel import check_travel
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value
from pneuopt.tuning.space import Space

# Frequencies at which the sign of the plant's static gain is read [rad per horizon]. A high one may meet phase lag that
# turns the sign, a low one a drift slower than the horizon, or rounding errors; so they have to agree.
STATIC_SIGN_FREQUENCIES = (1e-3, 0.1)
# Bisections for the largest part of a reference that can be held. Fewer make the message's figure coarse; each more
# costs an equilibrium.
BISECTION_STEPS = 10


def check_feasibility(loop: ClosedLoop, cases: Sequence[TuningCase], space: Space, spec: Specification) -> None:
    """Refuse a tuning that no gains within the bounds can make feasible.

    Parameters
    ----------
    loop : ClosedLoop
    cases : sequence of TuningCase
        The nominal plant's cases first.
    space : Space
    spec : Specification

    Raises
    ------
    InputError
        If a limit lies beyond the horizon, settling and following error contradict each other, the dither cannot be
        sampled, the settling band is below half a count of an encoder, the stroke is too short for a reference or the
        drive too weak for a move, no command holds it, or none that the limits allow, or all gains allowed have the
        wrong sign.
    """
    _check_dither(loop, space)
    for case in cases:
        _check_horizon(case.reference, spec)
        _check_following(case, loop, spec)
    _check_noise(loop, space, spec)
    for case in cases:
        _check_counts(loop, case, space, spec)
        check_travel(loop, case, space.parameters)
        check_motion(loop, case, space.parameters)
        _check_hold(loop, case, space, spec)
    _check_sign(loop, cases[0], space)


def _check_dither(loop: ClosedLoop, space: Space) -> None:
    """Check that the controller's samples resolve the dither's highest frequency."""
    if loop.dither is not None:
        loop.dither.check(highest_dither_frequency(loop, space.parameters), loop.pid.sample_time)


def _check_horizon(reference: Reference, spec: Specification) -> None:
    """Check that a reference's record is long enough for the limits on times to be read."""
    record = reference.horizon - reference.at
    for q in spec.limits:
        if isinstance(q, SettlingTime | RiseTime) and upper_limit(q) > (1 - TAIL_SHARE) * record:
            message = f"{metric_name(q)}: max {upper_limit(q):g} s is more than {record:g} s after the step can show"
            needed = f"{reference.at + upper_limit(q) / (1 - TAIL_SHARE):.4g} s"
            require(False, f"{message} (reference {reference.label}); lengthen its horizon to {needed}, or lower max")
    first = min((t for t, _, _ in spec.envelope), default=0.0)
    message = f"StepEnvelope begins {first:g} s after the step, the record of reference {reference.label} ends after"
    require(first < record, f"{message} {record:g} s; lengthen its horizon, or let the bounds begin earlier")


def _check_following(case: TuningCase, loop: ClosedLoop, spec: Specification) -> None:
    """Check that a signal as near to the reference as its following error allows can settle as early as asked."""
    most, reference, unit = spec.limit(FollowingError), case.reference, loop.feedback.unit
    if not most < inf or not reference.changes:
        return
    shown, prefix = write_value(most, unit, 3), _case_prefix(case)
    size = write_value(abs(reference.size), unit, 3)
    told = (
        f"{prefix}FollowingError: max {shown} is less than the step of {size}, its error at once; follow a move instead"
    )
    require(not isinstance(reference, Step) or most >= abs(reference.size), told)
    asked = min(spec.limit(SettlingTime), reference.horizon - reference.at)
    left = float(abs(reference.final - reference.values(np.array([reference.at + asked]))[0]))
    half = band_share(spec.band, reference) * abs(reference.nominal_size)
    told = f"{prefix}SettlingTime: max {asked:g} s comes when the reference still lacks {write_value(left, unit, 3)}"
    room = f"more than the band and FollowingError's max {shown}; raise one of them, or speed and acceleration"
    require(left <= half + most, f"{told}, {room}")


def _check_noise(loop: ClosedLoop, space: Space, spec: Specification) -> None:
    """Check that the least noise gain within the bounds keeps its limit."""
    if loop.is_composed:  # what the other paths add may turn the PID's gain either way
        return
    Tf = _parameter_range(space, "pid.Tf")[1] + 0.5 * (loop.pid.sample_time or 0.0)  # as `linear_gains` has it
    least = _least_size(space, "pid.Kp") + (_least_size(space, "pid.Kd") / Tf if Tf else 0.0)
    message = (
        f"NoiseGain: max {spec.limit(NoiseGain):g} is below Kp + Kd/Tf, at least {least:.4g} within the gains' bounds"
    )
    require(least <= spec.limit(NoiseGain), f"{message}; lower pid.Kp or pid.Kd, raise pid.Tf, or raise max")


def _check_counts(loop: ClosedLoop, case: TuningCase, space: Space, spec: Specification) -> None:
    """Check that a controller that sees a position in counts can tell whether it is in the settling band.

    Under dither it can, in the mean: the ripple moves the position over the edges of counts. Of a speed it can as well.
    """
    dithered = max(abs(v) for v in _parameter_range(space, DITHER_AMPLITUDE)) > 0
    if dithered or sees_speed(loop) or not spec.concerns(SettlingTime):
        return
    told = describe_counts(loop, case.case_parameters(space.parameters), case.reference, spec.band)
    require(told is None, f"{_case_prefix(case)}{told}")


def _check_hold(loop: ClosedLoop, case: TuningCase, space: Space, spec: Specification) -> None:
    """Check that a command within the limits holds the reference to within the settling band."""
    reference = case.reference
    room = band_share(spec.band, reference) * reference.size  # 0 for a disturbance alone
    target = reference.final - room

    def find_obstacle(share: float) -> str:
        """The reason why a part of the reference cannot be held; empty where it can."""
        try:
            command = _holding_command(loop, case, space, share * target)
        except InputError as error:
            return str(error)
        return _describe_command_excess(loop, case, space, spec, command, share * target)

    obstacle = find_obstacle(1.0)
    if obstacle:
        low, high = 0.0, 1.0
        for _ in range(BISECTION_STEPS if not find_obstacle(0.0) else 0):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if find_obstacle(middle) else (middle, high)
        most_held = f"; the most that can be held is {low * target:.3g} {loop.feedback.unit}" if low else ""
        require(False, f"{_case_prefix(case)}{obstacle}{most_held}")


def _holding_command(loop: ClosedLoop, case: TuningCase, space: Space, value: float) -> float:
    """The command that holds the measured signal at a value; 0 where no steady state is known."""
    try:
        return _find_operating_point(loop, case, space, value)[1]
    except ConvergenceError:
        return 0.0


def _find_operating_point(loop: ClosedLoop, case: TuningCase, space: Space, value: float) -> tuple[Array, float]:
    """The plant's state and the command at which an integral action holds the measured signal at a value."""
    own, acting = case.case_parameters(space.parameters), replace(loop, pid=PID(loop.pid.sample_time))
    own = own | ParameterSet({"pid.Ki": replace(acting.parameters["pid.Ki"], value=1.0)})
    start = {n: v for n, v in case.reference.start.items() if n == "position"}
    return find_rest(acting, set_sliding_direction(acting, own, value), value, start)


def _describe_command_excess(
    loop: ClosedLoop, case: TuningCase, space: Space, spec: Specification, command: float, value: float
) -> str:
    """The reason why a command that holds a value is not allowed; empty where it is."""
    own, unit = case.case_parameters(space.parameters), loop.command.unit
    takes = f"holding {value:.4g} {loop.feedback.unit} takes {command:.4g} {unit}"
    if loop.pid.limits:
        low, high = own.value("pid.lower"), own.value("pid.upper")
        if not low <= command <= high:
            return (
                f"{takes}, the controller's limits are {low:g} and {high:g} {unit}; take a smaller step, or widen them"
            )
    amplitude = _least_size(space, "dither.amplitude")
    if abs(command) + amplitude > spec.limit(PeakControl):
        beside = f" beside a dither of at least {amplitude:g} {unit}" if amplitude else ""
        most_allowed = f"PeakControl allows {spec.limit(PeakControl):g} {unit}"
        return f"{takes}{beside}, {most_allowed}; take a smaller step, or raise it"
    return ""


def _check_sign(loop: ClosedLoop, case: TuningCase, space: Space) -> None:
    """Check that the bounds allow gains of the sign that makes the feedback negative."""
    sign = _static_sign(loop, case, space)
    gains = {n: [sign * v for v in _parameter_range(space, n)] for n in ("pid.Kp", "pid.Ki", "pid.Kd", "pid.K")}
    best = {n: max(ends) for n, ends in gains.items()}
    wrong = [n for n, ends in gains.items() if max(ends) <= 0 and min(ends) < 0]
    hopeless = best["pid.Ki"] < 0 or (wrong and all(v <= 0 for v in best.values()))
    if sign and hopeless:
        words = ", ".join(f"{n} within [{', '.join(f'{v:g}' for v in _parameter_range(space, n))}]" for n in wrong)
        moves = f"{loop.feedback.name} {'rises' if sign > 0 else 'falls'} with {loop.command.name}"
        remedy = "turn the sign of the gains' bounds, or of the actuator"
        require(False, f"{words}: every gain allowed has the wrong sign, for the plant's {moves}; {remedy}")


def _static_sign(loop: ClosedLoop, case: TuningCase, space: Space) -> float:
    """The sign of the plant's response to a slow command at the reference's final value; 0 where it is unknown."""
    reference, own = case.reference, case.case_parameters(space.parameters)
    try:
        x, command = _find_operating_point(loop, case, space, reference.final)
        plant = linear_plant(loop, own, x, {loop.command.name: command})
        frequencies = np.array(STATIC_SIGN_FREQUENCIES) / reference.horizon
        slow, faster = (frequency_response(plant, factor * frequencies) for factor in (1, 2))
    except (ConvergenceError, InputError, ModelError, np.linalg.LinAlgError):
        return 0.0
    first, *others = [_response_sign(complex(s), complex(f)) for s, f in zip(slow, faster, strict=True)]
    return first if all(sign == first for sign in others) else 0.0


def _response_sign(slow: complex, faster: complex) -> float:
    """The sign of a plant's response, by those at a frequency and at twice it."""
    if abs(slow.real) >= abs(slow.imag):
        return float(np.sign(slow.real))
    # It integrates, or a drifting position counters: k s/(s - d), whose phase a stable and an unstable d turn opposite
    # ways; its real part has the sign of k for both.
    return float(np.sign(-slow.imag if abs(faster) < abs(slow) else slow.real))


def _parameter_range(space: Space, n: str) -> tuple[float, float]:
    """The bounds of a free parameter, or twice the value of a fixed one; (0, 0) where the loop does not have it."""
    if n not in space.parameters:
        return 0.0, 0.0
    p = space.parameters[n]
    return (p.lower, p.upper) if n in space.names else (p.value, p.value)


def _least_size(space: Space, n: str) -> float:
    """The least absolute value that a parameter may have."""
    low, high = _parameter_range(space, n)
    return 0.0 if low <= 0 <= high else min(abs(low), abs(high))


def _case_prefix(case: TuningCase) -> str:
    """The words with which a message about a case begins."""
    return f"reference {case.label}: "
