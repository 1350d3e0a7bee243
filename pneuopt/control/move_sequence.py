"""`MoveSequence`: moves one after the other, with dwells between them, as one experiment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pneuopt.control.moves import Move, sample_motion
from pneuopt.control.reference import describe_circumstances
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory

# Stops of a sequence that its label names; more make a heading that no table has room for.
MAX_LABELLED_STOPS = 4
LABEL_DECIMALS = 9  # of a stop in a label: more show what sums of distances leave of a zero, fewer hide micrometres


@dataclass(frozen=True)
class MoveSequence:
    """Moves of which each begins where and when the one before has ended, after its dwell.

    Metrics are those of the last move: they count from its beginning, after all that came before it has left its mark
    on friction and integral. `parts` gives the sequences that end with each move.

    Parameters
    ----------
    moves : sequence of Move
        The first says when and where the sequence begins, and how the plant starts; a disturbance comes with the last.

    Raises
    ------
    InputError
        If there is none, a later one has a beginning or a start of its own, or one before the last a disturbance.

    Examples
    --------
    >>> there = Move(0.2, speed=0.5, acceleration=5.0, dwell=0.5)
    >>> both = MoveSequence([there, replace(there, distance=-0.2)])
    >>> both.label, both.at, both.horizon
    ('0 to 0.2 to 0', 1.0, 2.0)
    """

    moves: tuple[Move, ...]

    def __init__(self, moves: Sequence[Move]) -> None:
        object.__setattr__(self, "moves", tuple(moves))
        require(len(self.moves) > 0, "MoveSequence: there is no move; give at least one Move")
        told = "MoveSequence: move {} begins where the one before ends; only the first has at, initial and start"
        for k, move in enumerate(self.moves[1:], 2):
            require(move.at == 0 and move.initial == 0 and not move.start, told.format(k))
        for k, move in enumerate(self.moves[:-1], 1):
            require(move.dwell >= 0, f"MoveSequence: move {k} ends by its dwell, which must not be negative")
            require(not move.disturbance, f"MoveSequence: only the last move may have a disturbance, move {k} has one")

    @cached_property
    def chain(self) -> tuple[Move, ...]:
        """The moves, each with the instant and the value at which it begins."""
        found = [self.moves[0]]
        for move in self.moves[1:]:
            found.append(replace(move, at=found[-1].horizon, initial=found[-1].final))
        return tuple(found)

    @property
    def parts(self) -> tuple["MoveSequence", ...]:
        """The sequences up to each move, so that each is once the last."""
        return tuple(MoveSequence(self.moves[:k]) for k in range(1, len(self.moves) + 1))

    @property
    def at(self) -> float:
        """Instant at which the last move begins [s]."""
        return self.chain[-1].at

    @property
    def origin(self) -> float:
        """Value at time 0 [unit of the measured signal]."""
        return self.moves[0].initial

    @property
    def initial(self) -> float:
        """Value before the last move [unit of the measured signal]."""
        return self.chain[-1].initial

    @property
    def final(self) -> float:
        """Value after the last move [unit of the measured signal]."""
        return self.chain[-1].final

    @property
    def size(self) -> float:
        """Distance of the last move [unit of the measured signal]."""
        return self.moves[-1].distance

    @property
    def nominal_size(self) -> float:
        """Distance of the last move, of which fractions are [unit of the measured signal]."""
        return self.moves[-1].distance

    @property
    def horizon(self) -> float:
        """End of the experiment [s]."""
        return self.chain[-1].horizon

    @property
    def start(self) -> Mapping[str, float]:
        """What else is known of the plant at time 0, by output [SI]."""
        return self.moves[0].start

    @property
    def disturbance(self) -> Mapping[str, float]:
        """By how much parameters or inputs of the plant change with the last move [their units]."""
        return self.moves[-1].disturbance

    @property
    def changes(self) -> bool:
        """A sequence always does."""
        return True

    @property
    def label(self) -> str:
        """How a table heads it."""
        stops = [self.origin, *(move.final for move in self.chain)]
        shown = [
            f"{round(stop, LABEL_DECIMALS) + 0.0:g}"
            for stop in (stops if len(stops) <= MAX_LABELLED_STOPS else stops[-2:])
        ]
        lead = f"move {len(self.moves)}, " if len(stops) > MAX_LABELLED_STOPS else ""
        return ", ".join([lead + " to ".join(shown), *describe_circumstances(self)])

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """The reference, its speed and its acceleration at any instants [s], each of shape (n,)."""
        found = self.chain[0].motion(t)
        for move in self.chain[1:]:
            begun = t >= move.at
            s, v, a = (np.where(begun, new, old) for new, old in zip(move.motion(t), found, strict=True))
            found = s, v, a
        return found

    def values(self, t: Array) -> Array:
        """The reference itself at any instants, shape (n,) [s]."""
        return self.motion(t)[0]

    def trajectory(self, step: float) -> Trajectory:
        """The columns of `Move.trajectory`, over all moves; they may begin between two samples."""
        return sample_motion(self, self.motion, step)

    def with_horizon(self, horizon: float) -> Self:
        """The same with another end of the experiment [s]."""
        return type(self)([*self.moves[:-1], replace(self.moves[-1], dwell=self._dwell(horizon))])

    def _dwell(self, horizon: float) -> float:
        last = self.chain[-1]
        return horizon - last.at - last.duration
