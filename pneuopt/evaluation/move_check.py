"""`check_move`: refuse a move that no controller can make, with what can be made; `shortest_move`: the fastest left.

Two bounds that hold whatever the controller does. In steady motion at the move's largest speed the command must lie
within its limits: what the valve lets through at the supply's pressure. And at full command, from rest, the body must
have come half way, and have accelerated as much, as the first half of the move asks for: what supply, valve, friction
and load leave of the force. A move that passes may still be followed badly.
"""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from math import copysign, inf

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveSequence
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.cases import TuningCase
from pneuopt.evaluation.response import command_range
from pneuopt.evaluation.travel import check_travel
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value

# Share of a move over which full command is tried first, and the factor on it where that is too short to come half
# way: larger ones run far beyond the move's end, where a cylinder's model ends; smaller ones try again more often.
FIRST_PUSH, PUSH_FACTOR = 0.1, 1.4
# Instants at which full command is read: fewer blur its times and its peak; more cost time in proportion.
PUSH_SAMPLES = 300
LONGEST_PUSH = 60.0  # [s], of what hardly moves: a shorter one refuses creeping drives, a longer one takes long
PUSH_TOLERANCE = 1e-7  # of the simulation: its figures are shown with three digits
# Bisections of a speed or a share of the limits. Fewer make the figures coarse; each more costs an equilibrium.
MOVE_BISECTIONS = 20
# Largest factor on a move's speeds that is tried for the shortest move: a larger one would end beyond any drive.
MOST_FACTOR = 64.0
# Share of what full command can that a message and the shortest move allow: nearer 1 the samples of a run refuse what
# was advised; lower it gives speed away.
ALLOWED_SHARE = 0.98


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
    for _ in range(MOVE_BISECTIONS if low < MOST_FACTOR else 0):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if can.find_obstacle(scale_move(move, middle)) else (middle, high)
    require(low > 0, f"reference {move.label}: {can.find_obstacle(move)}")
    return scale_move(move, ALLOWED_SHARE * low)


def scale_move(move: Move, factor: float) -> Move:
    """The same move, `factor` times as fast.

    Examples
    --------
    >>> scale_move(Move(0.2, speed=0.5, acceleration=5.0, jerk=100.0), 2.0).duration
    0.275
    """
    speed, acceleration, jerk = move.speed * factor, move.acceleration * factor**2, move.jerk * factor**3
    return replace(move, speed=speed, acceleration=acceleration, jerk=jerk)


@dataclass(frozen=True, eq=False)
class _Abilities:
    """What a plant can at most, forwards along a move.

    Attributes
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
        Of the case.
    limits : tuple of (float, float, str)
        Of the command, and whose they are.
    position : float
        At the start [its unit].
    side : float
        The direction of the move, 1 or -1.
    push : Trajectory
        From rest at full command: "way", "speed" and "acceleration" along the move.
    """

    loop: ClosedLoop
    parameters: ParameterSet
    limits: tuple[float, float, str]
    position: float
    side: float
    push: Trajectory

    def find_obstacle(self, move: Move) -> str:
        """The reason why a move cannot be made, with what can; empty where none is found."""
        half = move.duration / 2
        speed, acceleration = (float(np.abs(a).max()) for a in move.motion(move.at + np.linspace(0, half, 200))[1:])
        return self._speed_obstacle(speed) or self._force_obstacle(move, acceleration, half)

    def _speed_obstacle(self, speed: float) -> str:
        """Where no command within the limits keeps up the speed."""
        if self._moves_steadily(speed):
            return ""
        low, high = 0.0, speed
        for _ in range(MOVE_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._moves_steadily(middle) else (low, middle)
        most, wanted = (self._write(v, "/s") for v in (low, speed))
        least, most_allowed, whose = self.limits
        of = f"{whose}'s limits {least:.3g} and {most_allowed:.3g} {self.loop.command.unit}"
        return f"it moves at {wanted}, within {of} the plant moves at {most} at most; lower its speed"

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

    def _force_obstacle(self, move: Move, acceleration: float, half: float) -> str:
        """Where full command from rest does not come so far, or not accelerate so much."""
        way, reached = abs(move.distance) / 2, float(self.push["acceleration"].max())
        told = f"full command ({self._full_command}) from rest"
        if acceleration > reached:
            wanted, most = (self._write(v, "/s^2") for v in (acceleration, ALLOWED_SHARE * reached))
            return f"it accelerates with {wanted}, {told} with {most}; lower its acceleration"
        ahead = np.maximum.accumulate(self.push["way"])
        time = float(np.interp(way, ahead, self.push.t)) if ahead[-1] >= way else inf
        if time > half:
            best = f"takes {time:.3g} s" if time < inf else f"has not come so far in {self.push.t[-1]:.3g} s"
            least = f", so that the move takes {2 * time:.3g} s at least" if time < inf else ""
            return f"its first half takes {half:.3g} s, {told} {best}{least}; lower its acceleration and speed"
        return ""

    @cached_property
    def _full_command(self) -> str:
        return f"{self.limits[1 if self.side > 0 else 0]:.3g} {self.loop.command.unit}"

    def _write(self, value: float, per: str) -> str:
        return write_value(value, f"{self.loop.feedback.unit}{per}", 3)


def _abilities(loop: ClosedLoop, case: TuningCase, parameters: ParameterSet) -> _Abilities | None:
    """What the plant of a case can; None where the loop is not on an axis's position, or nothing limits the command."""
    own, axis, move = case.case_parameters(parameters), loop.plant.axis, case.reference
    limits = command_range(loop, own)
    if axis is None or loop.feedback.name != axis.position or not np.isfinite(limits[:2]).all():
        return None
    assert isinstance(move, Move)
    side = copysign(1.0, move.distance)
    x = case.initial(loop, parameters)[: len(loop.plant.states)]
    forwards = limits[1] if side > 0 else limits[0]
    push = _push_half_way(loop, own, x, forwards, move)
    if push["way"].max() <= 0:  # the actuator is turned
        push = _push_half_way(loop, own, x, limits[0] if side > 0 else limits[1], move)
    return _Abilities(loop, own, limits, move.initial, side, push)


def _push_half_way(loop: ClosedLoop, own: ParameterSet, x: Array, command: float, move: Move) -> Trajectory:
    """The plant from rest at a constant command, along the move, until it has come half way or hardly moves."""
    duration, half = FIRST_PUSH * move.duration, abs(move.distance) / 2
    while True:
        run = _push(loop, own, x, command, duration)
        side, position = copysign(1.0, move.distance), run[_axis(loop).position]
        way, speed = side * (position - position[0]), side * run[_axis(loop).speed]
        if way.max() >= half or duration >= LONGEST_PUSH or run.t[-1] < duration:
            return Trajectory(run.t, {"way": way, "speed": speed, "acceleration": np.gradient(speed, run.t)})
        duration *= PUSH_FACTOR


def _push(loop: ClosedLoop, own: ParameterSet, x: Array, command: float, duration: float) -> Trajectory:
    """The plant's run at a constant command; shorter where the model ends, beyond an end stop for instance."""
    inputs = {q.name: np.full(2, command if q.name == loop.command.name else 0.0) for q in loop.plant.inputs}
    ends, t = np.array([0.0, duration]), np.linspace(0.0, duration, PUSH_SAMPLES + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # it may well meet an end stop, later than it matters
        try:
            return simulate(
                loop.plant, Trajectory(ends, inputs), own, initial=x, t_out=t, rtol=PUSH_TOLERANCE, atol=PUSH_TOLERANCE
            )
        except ConvergenceError as error:
            if isinstance(error.solution, Trajectory) and len(error.solution) > 2:
                return error.solution
            raise


def _axis(loop: ClosedLoop) -> Axis:
    axis = loop.plant.axis
    assert axis is not None
    return axis
