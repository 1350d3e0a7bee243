"""`Transcription`: a multiple-shooting problem as data: phases, nodes, residuals, costs, limits.

Its pieces are small SX functions of one node, from which each solver of this room builds what it needs.
All numbers that a problem depends on stand in one `ParameterSet`; ``"name[phase]"`` overrides
``"name"`` in that phase, which is how conditions of a log and parameters of its own (`per_log`) are written.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import casadi as ca
import numpy as np

from pneuopt.dynamics.system import DiscreteSystem, names
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import ParameterSet


class Where(Enum):
    """The nodes at which a cost or limit holds, or the parameters."""

    START = "start"
    NODES = "nodes"
    END = "end"
    PARAMETERS = "parameters"


@dataclass(frozen=True, eq=False)
class Phase:
    """A run of n samples on one time grid."""

    name: str
    # t, h (n,): instant of each sample and the step that follows it [s]; as fractions of the duration where that is
    # free
    t: Array
    h: Array
    inputs: Array  # (n, n_inputs): held over each step
    nodes: Indices  # (m,): samples at which a segment begins; the first is 0
    start: Array | None = None  # (n_states,): the start state where it is known; otherwise it is solved for
    follows: bool = False  # the phase begins where the previous one ends
    # name of the parameter that is the phase's duration
    duration: str | None = None
    guess: Array | None = None  # (n, n_states): states to start the solver from
    # those of the nodes that do not continue the segment before them: holes of a log
    breaks: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    def __post_init__(self) -> None:
        n = len(self.t)
        require(
            len(self.h) == n and len(self.inputs) == n, f"{self.name}: t, h and inputs differ in length", ModelError
        )
        ordered = len(self.nodes) > 0 and self.nodes[0] == 0 and bool(np.all(np.diff(self.nodes) > 0))
        require(
            ordered and self.nodes[-1] < n, f"{self.name}: nodes must begin at 0 and increase below {n}", ModelError
        )
        require(
            bool(np.isin(self.breaks, self.nodes[1:]).all()), f"{self.name}: a break must be an inner node", ModelError
        )
        require(
            not (self.follows and self.start is not None), f"{self.name}: it follows a phase, so no start", ModelError
        )

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.t)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measured outputs of one phase: ``(y - measured) / noise``, NaN marks a missing sample."""

    phase: int
    outputs: tuple[str, ...]
    measured: Array  # (n, len(outputs))
    # standard deviations [unit of the output], (len(outputs),), or (len(outputs), n) where samples differ
    noise: Array


@dataclass(frozen=True, eq=False)
class Cost:
    """`weight` times a scalar, summed over where it holds."""

    name: str
    # ``(t, x, u, p) -> scalar``; for `Where.PARAMETERS` ``(q) -> scalar`` of all the problem's parameters
    function: ca.Function
    where: Where
    phases: tuple[int, ...] = ()  # empty: every phase
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class Limit:
    """``lower <= function <= upper`` wherever it holds."""

    name: str  # appears in messages: which limit is violated, which is active
    # ``(t, x, u, p) -> vector``; for `Where.PARAMETERS` ``(q) -> vector`` of all the problem's parameters
    function: ca.Function
    lower: float
    upper: float
    where: Where
    phases: tuple[int, ...] = ()  # empty: every phase


@dataclass(frozen=True, eq=False)
class Transcription:
    """A multiple-shooting problem as data, apart from the methods that solve it."""

    system: DiscreteSystem
    # the system's parameters, overrides ``"name[phase]"``, durations; the free ones are unknowns, as are the states
    parameters: ParameterSet
    phases: tuple[Phase, ...]
    residuals: tuple[Residuals, ...] = ()
    costs: tuple[Cost, ...] = ()
    limits: tuple[Limit, ...] = ()

    def __post_init__(self) -> None:
        require(len(self.phases) > 0, "a problem needs at least one phase", ModelError)
        require(not self.phases[0].follows, "the first phase cannot follow another", ModelError)
        check_names("parameter", self.system.parameters, self.parameters)
        for phase in self.phases:
            if phase.duration is not None:
                check_names("parameter", [phase.duration], self.parameters, phase.name)
        for residual in self.residuals:
            check_names("output", residual.outputs, names(self.system.outputs), self.phases[residual.phase].name)

    def parameter_positions(self, phase: Phase) -> Indices:
        """Positions, among the problem's parameters, of the system's parameter vector in this phase."""
        position = {n: i for i, n in enumerate(self.parameters)}
        return np.array(
            [position.get(f"{n}[{phase.name}]", position[n]) for n in self.system.parameters], dtype=np.intp
        )

    @property
    def free(self) -> Indices:
        """Positions of the free parameters among the problem's parameters."""
        return np.array([i for i, p in enumerate(self.parameters.values()) if p.free], dtype=np.intp)


def regular_nodes(n: int, samples: int, breaks: Sequence[int] | Indices = ()) -> Indices:
    """Nodes at every `samples`-th of n samples, counted anew from each break; the last segment takes the rest.

    >>> regular_nodes(10, 4, [5]).tolist()
    [0, 4, 5, 9]
    """
    runs = itertools.pairwise([0, *breaks, n])
    return np.concatenate([np.arange(a, b, max(1, samples), dtype=np.intp) for a, b in runs])


def phases_of(term: Cost | Limit, transcription: Transcription) -> Sequence[int]:
    """The phases in which a term holds."""
    return term.phases or range(len(transcription.phases))
