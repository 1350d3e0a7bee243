"""`Compensator`: a part that adds to the PID's command, feedforward or feedback of its own, and how several act.

They act in the order in which the loop has them, each on the command of those before it, after feedforward and before
dither and clip: what they add counts for the limits, and back-calculation unwinds it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.dither import DITHER_OFFSET
from pneuopt.control.sensor import SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols, stack
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity, with_prefix, without_prefix

LEAST_SMOOTHING = 1e-9  # [any unit] of a smooth sign: at zero it would jump, and a rest has no derivative
MAX_BISECTIONS = 120  # halvings of a bracket: fewer than some 60 leave digits of a double, more cost time
MAX_DOUBLINGS = 60  # of a bracket from 1 [command's unit] on: fewer than some 20 miss large commands


@dataclass(frozen=True)
class Instant:
    """What a compensator sees: the time [s], reference and measured signal, and the command so far.

    `sample_time` [s] is the controller's, None of a continuous one. `rates` are the motion inputs that the part asks
    for ("reference_speed", "reference_acceleration"), `readings` the plant's outputs, by name, and `error` that of the
    signal that the loop is judged by, which in a cascade is the position; a rest, where parts start, has none.
    `elapsed` [s] is the time since the last good sample of a sampled controller, over which differences are taken.
    """

    t: Any
    reference: Any
    measured: Any
    command: Any
    sample_time: float | None
    rates: Mapping[str, Any] = field(default_factory=dict)
    readings: Mapping[str, Any] = field(default_factory=dict)
    error: Any = 0.0
    elapsed: Any = None


@runtime_checkable
class Compensator(Protocol):
    """A frozen dataclass that adds to the command.

    Attributes
    ----------
    section : str
        Its section in a tuning's file, and the prefix of its parameters and states.
    size : str
        The parameter that is zero by default, with which it adds nothing.
    acts_always : bool
        Whether it is a function of the present command and signals, which the loop's rest and its linearisation
        include; a pulse is not, and is left out of them, as a dither is.
    without_gradient : tuple of str
        Parameters on which the response does not depend smoothly.

    A part with states is linear in them and in the signals that it remembers: `start` gives those of a loop at rest.
    """

    section: ClassVar[str]
    size: ClassVar[str]
    acts_always: ClassVar[bool]
    without_gradient: ClassVar[tuple[str, ...]]

    def check(self, on: SensedSignal, axis: Axis | None) -> None:
        """Raise `ModelError` where it does not fit the loop's signal, its plant or its sample time."""
        ...

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """Its parameters for a signal and a command's unit; a value outside their bounds cannot run."""
        ...

    def reads(self, on: SensedSignal) -> tuple[str, ...]:
        """Outputs of the plant that it reads beside the loop's own signal."""
        ...

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """Rates of the reference that it uses: names of the loop's inputs."""
        ...

    def states(self, on: SensedSignal, command: Quantity) -> tuple[Quantity, ...]:
        """What it remembers."""
        ...

    def start(self, on: SensedSignal, seen: Instant) -> list[Any]:
        """The states in a loop whose signals have been constant so far, or with a sampled PID since the last sample."""
        ...

    def act(self, seen: Instant, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states' rates, or with a sampled PID their next values, and what it adds to the command."""
        ...


class CompensatedLoop(Protocol):
    """What of a `ClosedLoop` its compensation depends on."""

    @property
    def compensators(self) -> tuple[Compensator, ...]:
        """In the order in which they act."""
        ...

    @property
    def parameters(self) -> ParameterSet:
        """The plant's and the controller's."""
        ...

    @property
    def readings(self) -> tuple[str, ...]:
        """The outputs of the plant that compensators read."""
        ...

    @property
    def compensation(self) -> ca.Function:
        """Of `compensation_function`."""
        ...


def check_compensators(given: object, on: SensedSignal, axis: Axis | None) -> None:
    """Refuse what is no tuple of compensators, two of one kind, and one that does not fit the loop."""
    parts = given if isinstance(given, tuple) else (given,)
    whole = isinstance(given, tuple) and all(isinstance(c, Compensator) and not isinstance(c, type) for c in parts)
    require(whole, f"compensators is a tuple of parts such as (Knocker(),), got {given!r}", ModelError)
    for n, part in enumerate(parts):
        same = any(part.section == other.section for other in parts[:n])
        require(not same, f"compensators has {type(part).__name__} twice; leave one out", ModelError)
        part.check(on, axis)
        absent = ", ".join(n for n in part.reads(on) if n not in on.outputs)
        had = f"the plant's outputs are {', '.join(on.outputs)}"
        told = f"{type(part).__name__} reads {absent}, which the plant does not have: {had}; leave it out"
        require(not absent, told, ModelError)


def check_values(
    compensators: Sequence[Compensator], known: ParameterSet, value: Mapping[str, float], count: float
) -> None:
    """Refuse a compensator's value outside the bounds that it declares, whatever a set's own bounds say.

    And a tolerance that the sensor's count, in the same unit, cannot tell from zero.
    """
    prefixes = tuple(f"{c.section}." for c in compensators)
    for name, q in known.items():
        runs = not name.startswith(prefixes) or q.lower <= value[name] <= q.upper
        require(runs, f"{name} must lie within [{q.lower:g}, {q.upper:g}] {q.unit}, got {value[name]:g}")
    for part in compensators:
        name = f"{part.section}.tolerance"
        if name in value and value[f"{part.section}.{part.size}"] > 0:
            told = f"{name} {value[name]:g} {known[name].unit} lies within a count of the sensor, {count:g}"
            require(value[name] > count, f"{told}: no error could be told from it; take at least {2 * count:g}")


def compensate(compensators: Sequence[Compensator], seen: Instant, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
    """Let compensators act one after the other.

    Parameters
    ----------
    compensators : sequence of Compensator
    seen : Instant
        Its command is that of PID and feedforward.
    x, p : mapping of str to casadi.SX
        The loop's states and parameters.

    Returns
    -------
    moved : dict
        As `Compensator.act` gives it, by the loop's names.
    added : casadi.SX
        The sum of what they add [the command's unit].
    """
    moved, added = Signals(), ca.SX(0)
    for part in compensators:
        now = replace(seen, command=seen.command + added)
        own, more = part.act(now, without_prefix(x, part.section), without_prefix(p, part.section))
        moved, added = moved | with_prefix(own, part.section), added + more
    return moved, added


def compensation_function(loop: CompensatedLoop, on: SensedSignal, command: Quantity) -> ca.Function:
    """The compensators that act always, under constant signals and a reference at rest, of the PID's command.

    Returns
    -------
    casadi.Function
        ``(command, reference, measured, readings, p) -> [compensated, slope, feedback]``: the command that they make
        of the PID's, and its derivatives to the PID's command and to the measured signal.
    """
    v, r, y = (ca.SX.sym(n) for n in ("command", "reference", "measured"))
    p: Signals = {n: ca.SX.sym(n) for n in loop.parameters}
    shown: Signals = {n: ca.SX.sym(n) for n in loop.readings}
    made = v
    for part in acting_always(loop):
        rates = dict.fromkeys(part.motion_inputs(on), ca.SX(0))
        seen = Instant(ca.SX(0), r, y, made, None, rates, shown)
        x = dict(zip((q.name for q in part.states(on, command)), map(ca.SX, part.start(on, seen)), strict=True))
        made = made + part.act(seen, x, without_prefix(p, part.section))[1]
    slopes = (ca.densify(ca.jacobian(made, signal)) for signal in (v, y))
    return ca.Function("compensation", [v, r, y, stack(shown), stack(p)], [made, *slopes])


def acting_always(loop: CompensatedLoop) -> tuple[Compensator, ...]:
    """The compensators that count in a loop's rest and margins."""
    return tuple(c for c in loop.compensators if c.acts_always)


def uncompensated_command(
    loop: CompensatedLoop, p: Array, reference: Any, measured: Any, command: ArrayLike, readings: ArrayLike = ()
) -> Array:
    """The PID's command of which the compensators that act always make another one.

    Parameters
    ----------
    loop : ClosedLoop
    p : ndarray, shape (n_parameters,) or (n_parameters, m)
    reference, measured : float or array_like, shape (m,)
        The signals at that instant.
    command : float or array_like, shape (m,)
        What the compensators make, which grows with the PID's command.
    readings : array_like, shape (n_readings,) or (n_readings, m)
        The outputs ``loop.readings``.

    Returns
    -------
    ndarray, shape (m,)
    """
    wanted = np.atleast_1d(np.asarray(command, dtype=float))
    if not acting_always(loop):
        return wanted
    shown = np.asarray(readings, dtype=float)
    return invert_increasing(lambda v: _evaluate_compensation(loop, p, reference, measured, v, shown)[0], wanted)


def compensation_slopes(
    loop: CompensatedLoop, p: Array, measured: ArrayLike, command: ArrayLike
) -> tuple[Array, Array]:
    """Slopes of the compensators that act always, at a steady operating point without dither.

    Parameters
    ----------
    loop : ClosedLoop
    p : ndarray, shape (n_parameters,) or (n_parameters, m)
    measured : float or array_like, shape (m,)
        The measured signal, which the reference equals there.
    command : float or array_like, shape (m,)
        What the actuator gets, the dither's offset included.

    Returns
    -------
    slope, feedback : ndarray, shape (m,)
        Derivatives of what they make to the PID's command and to the measured signal.
    """
    order = list(loop.parameters)
    offset = p[order.index(DITHER_OFFSET)] if DITHER_OFFSET in order else 0.0
    v = uncompensated_command(loop, p, measured, measured, np.asarray(command) - offset)
    _, slope, feedback = _evaluate_compensation(loop, p, measured, measured, v)
    return slope, feedback


def _evaluate_compensation(
    loop: CompensatedLoop, p: Array, reference: Any, measured: Any, v: Array, readings: ArrayLike = ()
) -> list[Array]:
    """What `CompensatedLoop.compensation` gives for m points at once, shape (m,) each."""
    rows = [np.broadcast_to(a, v.shape)[None] for a in (v, reference, measured)]
    shown = np.asarray(readings, dtype=float)
    rows.append(np.broadcast_to(shown[:, None] if shown.ndim == 1 else shown, (len(loop.readings), len(v))))
    given = p if np.ndim(p) > 1 else np.repeat(np.reshape(p, (-1, 1)), len(v), axis=1)
    return [np.asarray(found, dtype=float).ravel() for found in loop.compensation(*rows, given)]


def invert_increasing(function: Callable[[Array], Array], wanted: Array) -> Array:
    """Where an increasing function of shape (m,) takes the values wanted, entry by entry, by bisection.

    Examples
    --------
    >>> invert_increasing(lambda v: v**3, np.array([8.0, 0.0, -1.0])).round(12).tolist()
    [2.0, 0.0, -1.0]
    """
    reach = np.ones_like(wanted)
    for _ in range(MAX_DOUBLINGS):
        outside = (function(wanted - reach) > wanted) | (function(wanted + reach) < wanted)
        if not outside.any():
            break
        reach[outside] *= 2
    low, high = wanted - reach, wanted + reach
    for _ in range(MAX_BISECTIONS):
        middle = (low + high) / 2
        above = function(middle) > wanted
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.asarray(low)
