"""`check_move`: refuse a move that no controller can make; `excitation_run`: moves whose log shows friction and valve.

Two bounds hold whatever the controller does. In steady motion at the move's largest speed the command must lie within
its limits: what the valve lets through at the supply's pressure. And at full command, from rest, the body must have
come half way, and have accelerated as much, as the first half of the move asks for: what supply, valve, friction and
load leave of the force. A move that passes may still be followed badly. `shortest_move` is the fastest that passes.

An excitation run is one that a plain position controller can play. Its fast and medium moves over most of the stroke,
both ways, show the valve's conductance, viscous friction and the mass; slow ones stick and slip, or creep along the
falling branch of a Stribeck curve; the shortest ones, each from a dwell, break away and cross the valve's dead zone.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil, copysign, inf, log

import numpy as np

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveSequence
from pneuopt.control.pid import PID
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.runnable import command_centre
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.margins import margins
from pneuopt.evaluation.response import TuningCase, check_travel, command_range
from pneuopt.evaluation.tolerances import (
    ALLOWED_SHARE,
    GAIN_STEP,
    GUESS_SHARE,
    GUESSED_SENSITIVITY,
    LEAST_DWELL,
    LEAST_FAST_SPEED,
    LEAST_MARGIN,
    LEAST_SPAN,
    LONGEST_PUSH,
    LONGEST_STEP,
    MARGIN_SHARE,
    MEDIUM,
    MOST_FACTOR,
    REST_BEFORE,
    SETTLED_SHARE,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, PhysicsWarning, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value


def check_move(loop: ClosedLoop, move: Move | MoveSequence, parameters: ParameterSet) -> None:
    """Refuse a move that the stroke, the valve or the force cannot make.

    Parameters
    ----------
    loop : ClosedLoop
        On the position of an axis; others are not checked, nor is a command without limits.
    move : Move or MoveSequence
    parameters : ParameterSet

    Raises
    ------
    InputError
        One message with what can be made: the distance left, the largest speed, or acceleration, or the shortest time.
    """
    case, full = TuningCase(move), loop.complete(parameters)
    check_travel(loop, case, full)
    check_motion(loop, case, full)


def check_motion(loop: ClosedLoop, case: TuningCase, parameters: ParameterSet) -> None:
    """Refuse a case whose move the valve or the force cannot make; `check_travel` sees to the stroke."""
    reference = case.reference
    moves = reference.chain if isinstance(reference, MoveSequence) else (reference,)
    for move in (m for m in moves if isinstance(m, Move)):
        can = _abilities(loop, replace(case, reference=move), parameters)
        obstacle = "" if can is None else can.find_obstacle(move)
        require(not obstacle, f"reference {case.label}: {obstacle}")


def shortest_move(loop: ClosedLoop, move: Move, parameters: ParameterSet) -> Move:
    """The fastest move of the same shape that passes `check_move`: time is scaled, and the three limits with it.

    Parameters
    ----------
    loop : ClosedLoop
        On the position of an axis, with a command that is limited.
    move : Move
        Feasible or not.
    parameters : ParameterSet

    Returns
    -------
    Move
        With speed, acceleration and jerk scaled by k, k^2 and k^3.

    Raises
    ------
    InputError
        If the stroke is too short, nothing limits the command, or full command does not move the body so far.
    """
    case, full = TuningCase(move), loop.complete(parameters)
    check_travel(loop, case, full)
    can = _abilities(loop, case, full)
    if can is None:
        raise InputError("shortest_move: nothing limits this move; it needs an axis under a command with limits")
    low, high = 0.0, 1.0
    while high < MOST_FACTOR and not can.find_obstacle(scale_move(move, high)):
        low, high = high, 2 * high
    if low < MOST_FACTOR:
        low = _bisect(lambda factor: not can.find_obstacle(scale_move(move, factor)), low, high)
    require(low > 0, f"reference {move.label}: {can.find_obstacle(move)}")
    return scale_move(move, ALLOWED_SHARE * low)


def scale_move(move: Move, factor: float) -> Move:
    """The same move, `factor` times as fast."""
    speed, acceleration, jerk = move.speed * factor, move.acceleration * factor**2, move.jerk * factor**3
    return replace(move, speed=speed, acceleration=acceleration, jerk=jerk)


def _bisect(holds: Callable[[float], bool], low: float, high: float, halvings: int = 20) -> float:
    """The largest value for which a condition holds, given one for which it does and one for which it does not."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


@dataclass(frozen=True, eq=False)
class _Abilities:
    """Abilities of a plant, forwards along a move."""

    loop: ClosedLoop
    parameters: ParameterSet  # of the case
    limits: tuple[float, float, str]  # of the command, and whose they are
    position: float  # at the start [its unit]
    side: float  # the direction of the move, 1 or -1
    push: Trajectory  # from rest at full command: "way", "speed" and "acceleration" along the move

    def find_obstacle(self, move: Move) -> str:
        """The reason why a move cannot be made, with what can; empty where none is found."""
        half = move.duration / 2
        speed, acceleration = (float(np.abs(a).max()) for a in move.motion(move.at + np.linspace(0, half, 200))[1:])
        if not self._moves_steadily(speed):
            most, wanted = (self._write(v, "/s") for v in (_bisect(self._moves_steadily, 0.0, speed), speed))
            least, most_allowed, whose = self.limits
            of = f"{whose}'s limits {least:.3g} and {most_allowed:.3g} {self.loop.command.unit}"
            return f"it moves at {wanted}, within {of} the plant moves at {most} at most; lower its speed"
        way, reached = abs(move.distance) / 2, float(self.push["acceleration"].max())
        full = f"{self.limits[1 if self.side > 0 else 0]:.3g} {self.loop.command.unit}"
        message = f"full command ({full}) from rest"
        if acceleration > reached:
            wanted, most = (self._write(v, "/s^2") for v in (acceleration, ALLOWED_SHARE * reached))
            return f"it accelerates with {wanted}, {message} with {most}; lower its acceleration"
        ahead = np.maximum.accumulate(self.push["way"])
        time = float(np.interp(way, ahead, self.push.t)) if ahead[-1] >= way else inf
        if time > half:
            best = f"takes {time:.3g} s" if time < inf else f"has not come so far in {self.push.t[-1]:.3g} s"
            shortest = f", so that the move takes {2 * time:.3g} s at least" if time < inf else ""
            return f"its first half takes {half:.3g} s, {message} {best}{shortest}; lower its acceleration and speed"
        return ""

    def _moves_steadily(self, speed: float) -> bool:
        hook, axis = self.loop.plant.rest_hook, self.loop.plant.axis
        if hook is None or axis is None:
            return True
        try:
            rest = hook(self.parameters, {axis.position: self.position, axis.speed: self.side * speed})
        except (InputError, ConvergenceError):
            return False
        low, high, _ = self.limits
        return low <= rest.inputs.get(self.loop.command.name, 0.0) <= high

    def _write(self, value: float, per: str) -> str:
        return write_value(value, f"{self.loop.feedback.unit}{per}", 3)


def _abilities(loop: ClosedLoop, case: TuningCase, parameters: ParameterSet) -> _Abilities | None:
    """Abilities of a case's plant; None where the loop is not on an axis's position, or nothing limits the command."""
    own, axis, move = case.case_parameters(parameters), loop.plant.axis, case.reference
    limits = command_range(loop, own)
    if axis is None or loop.feedback.name != axis.position or not np.isfinite(limits[:2]).all():
        return None
    assert isinstance(move, Move)
    side = copysign(1.0, move.distance)
    x = case.initial(loop, parameters)[: len(loop.plant.states)]
    forwards = limits[1] if side > 0 else limits[0]
    push = _push_half_way(loop, axis, own, x, forwards, move)
    if push["way"].max() <= 0:  # the actuator is turned
        push = _push_half_way(loop, axis, own, x, limits[0] if side > 0 else limits[1], move)
    return _Abilities(loop, own, limits, move.initial, side, push)


def _push_half_way(
    loop: ClosedLoop,
    axis: Axis,
    own: ParameterSet,
    x: Array,
    command: float,
    move: Move,
    *,
    first: float = 0.1,  # share of the move over which the command is tried first
    factor: float = 1.4,  # from one duration to the next
    samples: int = 300,
    tolerance: float = 1e-7,  # its figures are shown with three digits
) -> Trajectory:
    """The plant from rest at a constant command, along the move, until it has come half way or hardly moves."""
    duration, half, side = first * move.duration, abs(move.distance) / 2, copysign(1.0, move.distance)
    inputs = {q.name: np.full(2, command if q.name == loop.command.name else 0.0) for q in loop.plant.inputs}
    while True:
        held, t = Trajectory(np.array([0.0, duration]), inputs), np.linspace(0.0, duration, samples + 1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PhysicsWarning)  # it may well meet an end stop, later than it matters
            try:
                run = simulate(loop.plant, held, own, initial=x, t_out=t, rtol=tolerance, atol=tolerance)
            except ConvergenceError as error:
                if not isinstance(error.solution, Trajectory) or len(error.solution) <= 2:
                    raise
                run = error.solution  # up to where the model ends, beyond an end stop for instance
        position = run[axis.position]
        way, speed = side * (position - position[0]), side * run[axis.speed]
        if way.max() >= half or duration >= LONGEST_PUSH or run.t[-1] < duration:
            return Trajectory(run.t, {"way": way, "speed": speed, "acceleration": np.gradient(speed, run.t)})
        duration *= factor


@dataclass(frozen=True, eq=False)
class ExcitationRun:
    """A run that excites what an identification needs.

    Attributes
    ----------
    loop : ClosedLoop
        The plant under the proportional position controller for which the run is made.
    parameters : ParameterSet
        Of the plant as guessed, and the controller's.
    moves : MoveSequence
    between : tuple of (float, float)
        Positions that the reference stays between [m].
    response : Trajectory
        The run simulated on the plant as guessed: "position", "control" and so on.
    centre : float
        What is on the wire to the valve while the loop's command is zero [the command's unit].
    """

    loop: ClosedLoop
    parameters: ParameterSet
    moves: MoveSequence
    between: tuple[float, float]
    response: Trajectory
    centre: float = 0.0

    @property
    def duration(self) -> float:
        """Duration of the run [s]."""
        return self.moves.horizon

    @property
    def fastest(self) -> float:
        """Largest speed of the reference [m/s]."""
        return max(move.speed for move in self.moves.moves)

    @property
    def following_error(self) -> float:
        """Largest distance of the simulated position from the reference [m]."""
        position = self.response[self.loop.feedback.name]
        return float(np.abs(self.moves.values(self.response.t) - position).max())


def excitation_run(
    plant: System,
    parameters: ParameterSet,
    *,
    sample_time: float = 1e-3,
    between: tuple[float, float] | None = None,
    speed: float = inf,
) -> ExcitationRun:
    """Plan a run of moves from which friction, valve and mass of an axis are identified.

    Parameters
    ----------
    plant : System
        A drive whose valve moves an axis between two end stops.
    parameters : ParameterSet
        As guessed; the run leaves the drive half of its speed for a guess that is wrong.
    sample_time : float
        Of the controller [s].
    between : (float, float), optional
        Positions that the reference stays between [m]; by default the stroke less a tenth at either end.
    speed : float
        Limit of the moves' speed [m/s]; by default half of what the drive can.

    Returns
    -------
    ExcitationRun

    Raises
    ------
    ModelError
        If the plant is no such drive.
    InputError
        If there is no room, the limit is too slow, or the controller cannot move the drive so; with what can be.
    """
    axis, stops = plant.axis, [g for g in plant.validity_limits if g.state == "position"]
    if axis is None or axis.final_element is None or len(stops) != 2 or plant.rest_hook is None:
        message = 'an excitation run needs a drive whose valve moves an axis between two end stops, kind = "pneumatic"'
        raise ModelError(f"{message}; for another drive plan one with pneuopt next-experiment")
    loop, known = ClosedLoop(plant, PID(sample_time), measured=axis.position), plant.parameters | parameters
    plant.check(known)
    ends = _room(plant, known, between)
    least, most = write_value(LEAST_FAST_SPEED, "m/s"), write_value(speed, "m/s", 3)
    message = f"a run with a speed of {most} at most does not tell viscous friction from Coulomb's"
    require(speed >= LEAST_FAST_SPEED, f"{message}; allow {least} or more")
    low, high, _ = command_range(loop, loop.complete(known))
    p = loop.complete(known).with_values({"pid.lower": low, "pid.upper": high})
    fast = _fast_move(loop, p, ends, speed)
    p = p.with_values({"pid.Kp": _plain_gain(loop, p, ends, fast.speed)})
    command = _sliding(loop, p, sum(_end_stops(plant, p)) / 2, fast.speed)[1][loop.command.name]
    moves = _sequence(ends, fast, p.value("pid.Kp") * fast.speed / abs(command))
    for move in {(abs(m.distance), m.speed): m for m in moves.chain}.values():
        check_move(loop, replace(move, at=0.0), p)
    # in fixed steps: what is read from the response has three digits
    given, discrete = moves.trajectory(sample_time), loop.discrete()
    x0, u = loop.initial(p, reference=moves.origin)[None], given["reference"][None, :, None]
    h, substeps = np.full((1, len(given)), sample_time), ceil(sample_time / LONGEST_STEP)
    run = Rollout(discrete.pieces).run(x0, u, loop.parameter_vector(p), given.t[None], h, substeps=substeps)
    sound = bool(np.isfinite(run.y).all())
    require(sound, "the run cannot be simulated: the drive in the file meets its end stops or cannot be controlled so")
    response = Trajectory(given.t, dict(zip(names(discrete.outputs), run.y[0].T, strict=True)))
    position, (low, high), (rear, front) = response[loop.feedback.name], ends, _end_stops(plant, p)
    beyond = max(low - float(position.min()), float(position.max()) - high)
    message = f"the plain controller overshoots the run by {write_value(beyond, 'm', 3)}"
    fits = beyond < GUESS_SHARE * min(low - rear, front - high)
    require(fits, f"{message}; allow a lower speed, or correct mass and valve in the drive's file")
    return ExcitationRun(loop, p, moves, ends, response, command_centre(plant, known))


def _room(plant: System, p: ParameterSet, between: tuple[float, float] | None) -> tuple[float, float]:
    """The positions that the reference stays between."""
    rear, front = _end_stops(plant, p)
    margin = max(MARGIN_SHARE * (front - rear), LEAST_MARGIN)
    low, high = (rear + margin, front - margin) if between is None else between
    low, high = map(_place, (low, high))
    shown = [write_value(x, "m", 3) for x in (low, high, rear, front)]
    inside = rear < low and high < front
    message = f"the run would go from {shown[0]} to {shown[1]}, and the end stops are at {shown[2]} and {shown[3]}"
    require(inside, f"{message}; keep the run between them")
    way = f"{write_value(max(high - low, 0.0), 'm', 3)} from {shown[0]} to {shown[1]}"
    room = f"an excitation run needs a way of {write_value(LEAST_SPAN, 'm')}, there are {way}"
    require(high - low >= LEAST_SPAN, f"{room}; correct [cylinder] stroke, or say between which positions it may move")
    return low, high


def _fast_move(loop: ClosedLoop, p: ParameterSet, ends: tuple[float, float], speed: float) -> Move:
    """The fastest move of the run: a share of what the drive can both ways, within the limit of speed."""
    low, high = ends
    shape = Move(high - low, speed=1.0, acceleration=10.0 / (high - low), initial=low)
    both = (shape, replace(shape, distance=low - high, initial=high))
    fastest = [shortest_move(loop, move, p) for move in both]
    own = GUESS_SHARE * min(move.speed for move in fastest)
    least, most = (write_value(v / GUESS_SHARE, "m/s", 3) for v in (LEAST_FAST_SPEED, own))
    message = f"the drive moves at {most} at most, by its file, and an excitation run needs {least}"
    require(own >= LEAST_FAST_SPEED, f"{message}; correct valve, supply and load in the drive's file")
    acceleration = GUESS_SHARE**2 * min(move.acceleration for move in fastest)
    return replace(shape, speed=_round(min(own, speed)), acceleration=_round(acceleration))


def _plain_gain(
    loop: ClosedLoop, p: ParameterSet, ends: tuple[float, float], speed: float, first: float = 100.0, tries: int = 80
) -> float:
    """The largest proportional gain that keeps the sensitivity at both ends and in the middle, sliding both ways.

    The first one that is tried moves the command by so many times its range over the span.
    """
    places = [(x, side * v) for x in (*ends, sum(ends) / 2) for side in (1, -1) for v in (speed, MEDIUM * speed)]
    points = [_sliding(loop, p, x, v) for x, v in places]
    gain = first * p.value("pid.upper") / (ends[1] - ends[0])
    for _ in range(tries):
        tried = p.with_values({"pid.Kp": gain})
        found = (margins(open_loop(loop, tried, x, u)) for x, u in points)
        if all(m.stable and m.max_sensitivity <= GUESSED_SENSITIVITY for m in found):
            return _round(gain)
        gain *= GAIN_STEP
    message = "no proportional gain moves this drive with a sensitivity of"
    raise InputError(f"{message} {GUESSED_SENSITIVITY:g}; correct mass, friction and valve in the drive's file")


def _sliding(loop: ClosedLoop, p: ParameterSet, position: float, speed: float) -> tuple[Array, dict[str, float]]:
    """The plant's state and inputs in steady motion."""
    hook, axis = loop.plant.rest_hook, loop.plant.axis
    assert hook is not None
    assert axis is not None
    rest = hook(p, {axis.position: position, axis.speed: speed})
    return np.array([rest.states[n] for n in names(loop.plant.states)]), dict(rest.inputs)


# The stops of a run: an end or the middle, the way from it [share of the span], the speed [share of the fast moves'].
STOPS = (
    *(("high", 0.0, 1.0), ("low", 0.0, 1.0), ("middle", 0.0, MEDIUM), ("high", 0.0, MEDIUM), ("low", 0.0, MEDIUM)),
    *(("low", 0.4, 0.15), ("low", 0.0, 0.15), ("low", 0.08, 0.03), ("low", 0.0, 0.03), ("middle", 0.0, 1.0)),
    *(("middle", 0.01, 0.15), ("middle", 0.0, 0.15), ("middle", -0.01, 0.15), ("middle", 0.0, 0.15)),
    *(("high", 0.0, 1.0), ("high", -0.08, 0.03), ("high", 0.0, 0.03), ("middle", 0.0, MEDIUM)),
)


def _sequence(ends: tuple[float, float], fast: Move, gain: float) -> MoveSequence:
    """The moves, which begin and end in the middle, under a loop with a gain of speed over error [1/s]."""
    (low, high), moves = ends, list[Move]()
    span, middle = high - low, _place((low + high) / 2)
    at, places = middle, {"low": low, "middle": middle, "high": high}
    for place, way, share in STOPS:
        stop, speed = _place(places[place] + way * span), share * fast.speed
        dwell = max(LEAST_DWELL, log(speed / (gain * SETTLED_SHARE * span)) / gain)
        pause = round(dwell, 2)  # as a file shows it whole
        moves.append(Move(_place(stop - at), speed=_round(speed), acceleration=fast.acceleration, dwell=pause))
        at = stop
    return MoveSequence([replace(moves[0], at=REST_BEFORE, initial=middle), *moves[1:]])


def _place(x: float) -> float:
    """A position [m] as a file shows it whole."""
    return round(x, 5)


def _end_stops(plant: System, p: ParameterSet) -> tuple[float, float]:
    rear, front = sorted(float(g.limit(p)) for g in plant.validity_limits if g.state == "position")
    return rear, front


def _round(value: float, digits: int = 3) -> float:
    """To digits that count, as the run's file shows them."""
    return float(f"{value:.{digits}g}")
