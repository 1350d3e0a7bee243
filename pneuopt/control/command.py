"""`added_command`: what is added to the PID's command before the clip: feedforward, compensators and dither."""

from collections.abc import Mapping
from typing import Any, Protocol

import casadi as ca

from pneuopt.control.compensation import Compensator, Instant, compensate
from pneuopt.control.dither import Dither
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.pid import PID
from pneuopt.control.position_loop import PositionLoop
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import with_prefix, without_prefix

ERROR = "error"
"""Beside the inputs of a cascade's inner controller: the error of the outer one."""


class CommandParts(Protocol):
    """The parts of a `ClosedLoop` that make its command."""

    @property
    def pid(self) -> PID:
        """The controller, which says whether the parts are sampled."""
        ...

    @property
    def dither(self) -> Dither | None:
        """The last to add."""
        ...

    @property
    def feedforward(self) -> Feedforward | None:
        """The first to add."""
        ...

    @property
    def compensators(self) -> tuple[Compensator, ...]:
        """They add between the two."""
        ...

    @property
    def outer(self) -> PositionLoop | None:
        """The outer loop of a cascade."""
        ...


def pid_reference(parts: CommandParts, u: Mapping[str, Any], position: Any, p: Mapping[str, Any]) -> dict[str, Any]:
    """The inputs as the PID and its compensators see them: a cascade's reference is a speed, and `ERROR` a position's.

    Parameters
    ----------
    parts : ClosedLoop
    u, p : mapping of str to casadi.SX
        The loop's inputs and parameters.
    position : casadi.SX
        What the loop is judged by, as the controller sees it.
    """
    if parts.outer is None:
        return dict(u)
    own = without_prefix(p, parts.outer.section)
    speed = parts.outer.set_point(u["reference"], u.get(REFERENCE_SPEED, 0.0), position, own)
    return {**u, "reference": speed, ERROR: u["reference"] - position}


def added_command(
    parts: CommandParts, t: ca.SX, x: Symbols, u: Symbols, measured: ca.SX, y: Symbols, p: Symbols
) -> tuple[Signals, ca.SX]:
    """What feedforward, compensators and dither, in this order, add to the PID's command.

    Parameters
    ----------
    parts : ClosedLoop
    t : casadi.SX
    x, u, p : mapping of str to casadi.SX
        The loop's states, inputs as `pid_reference` gives them, and parameters.
    measured : casadi.SX
        The measured signal, as the controller sees it.
    y : mapping of str to casadi.SX
        The plant's outputs that compensators read.

    Returns
    -------
    moved : dict
        The rates of the parts' states, or with a sampled PID their next values.
    added : casadi.SX
        [the command's unit]
    """
    moved, terms = added_terms(parts, t, x, u, measured, y, p)
    return moved, terms["dither"] + (terms["feedforward"] + terms["compensation"])


def added_terms(
    parts: CommandParts, t: ca.SX, x: Symbols, u: Symbols, measured: ca.SX, y: Symbols, p: Symbols
) -> tuple[Signals, Signals]:
    """The terms of `added_command`, "feedforward", "compensation" and "dither", in place of their sum."""
    moved, lead = _feedforward_terms(parts, x, u, p)
    bent = ca.SX(0)
    if parts.compensators:
        v = parts.pid.output(without_prefix(x, "pid"), u["reference"], measured, without_prefix(p, "pid"))
        rates = {n: u[n] for n in (REFERENCE_SPEED, REFERENCE_ACCELERATION) if n in u}
        error = u.get(ERROR, u["reference"] - measured)
        h = parts.pid.sample_time
        seen = Instant(t, u["reference"], measured, v + lead, h, rates, y, error, _elapsed_time(parts, x))
        own, bent = compensate(parts.compensators, seen, x, p)
        moved = moved | own
    return moved, {"feedforward": lead, "compensation": bent, "dither": _dither_command(parts, t, p)}


def _dither_command(parts: CommandParts, t: ca.SX, p: Symbols) -> ca.SX:
    """What the controller itself adds."""
    if parts.dither is None:
        return ca.SX(0)
    own = without_prefix(p, "dither")
    sampled_apart = parts.dither.analogue and parts.pid.sample_time is not None
    return own["offset"] if sampled_apart else own["offset"] + parts.dither.wave(t, own)


def _feedforward_terms(parts: CommandParts, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
    """The feedforward's state, its rate or with a sampled PID its next value, and what it adds to the command."""
    if parts.feedforward is None:
        return {}, ca.SX(0)
    own = (without_prefix(x, "feedforward"), u["reference"], without_prefix(p, "feedforward"))
    elapsed = _elapsed_time(parts, x)
    moved, added = parts.feedforward.rates(*own) if elapsed is None else parts.feedforward.update(*own, elapsed)
    return with_prefix(moved, "feedforward"), added


def _elapsed_time(parts: CommandParts, x: Symbols) -> ca.SX | float | None:
    """The time since the last good sample [s]; None of a continuous PID."""
    return None if parts.pid.sample_time is None else parts.pid.elapsed_time(without_prefix(x, "pid"))
