"""`added_command`: what is added to the PID's command before the clip: feedforward and dither."""

from typing import Protocol

import casadi as ca

from pneuopt.control.dither import Dither
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.pid import PID
from pneuopt.control.wiring import Signals
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import with_prefix, without_prefix


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


def added_command(parts: CommandParts, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
    """What feedforward and dither add to the PID's command.

    Parameters
    ----------
    parts : ClosedLoop
    t : casadi.SX
    x, u, p : mapping of str to casadi.SX
        The loop's states, inputs and parameters.

    Returns
    -------
    moved : dict
        The rates of the parts' states, or with a sampled PID their next values.
    added : casadi.SX
        [the command's unit]
    """
    lead, added = _feedforward_terms(parts, x, u, p)
    return lead, _dither_command(parts, t, p) + added


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
    h = parts.pid.sample_time
    moved, added = parts.feedforward.rates(*own) if h is None else parts.feedforward.update(*own, h)
    return with_prefix(moved, "feedforward"), added
