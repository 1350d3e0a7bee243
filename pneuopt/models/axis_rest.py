"""Rest or steady motion of a body that a known force or torque pushes against friction."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca

from pneuopt.dynamics.hooks import Axis, Rest
from pneuopt.dynamics.system import Symbols, System, define, names, stack
from pneuopt.quantities.errors import ConvergenceError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity


def with_rest(system: System, push: Quantity, axis: Axis) -> System:
    """The system with its axis and a `rest_hook`: the push that balances friction and load at a position and a speed.

    Friction states are steady at that speed; the system's other inputs are zero.

    Parameters
    ----------
    system : System
        Its states: position, speed and those of friction ("friction.*").
    push : Quantity
        The input that drives the body.

    Examples
    --------
    >>> from pneuopt.models.drive import ForceDrive
    >>> from pneuopt.models.friction import Viscous
    >>> drive = ForceDrive(Viscous()).system()
    >>> drive.rest_hook(drive.parameters.with_values({"friction.viscous": 80.0}), {"speed": 0.1}).inputs
    {'force': 8.0}
    """
    return replace(system, axis=axis, rest_hook=_PushedBodyRest(system, push, axis))


@dataclass(frozen=True, eq=False)
class _PushedBodyRest:
    """The rest hook of a body whose push is an input."""

    system: System
    push: Quantity
    axis: Axis

    def __call__(self, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        """Return the rest; `ConvergenceError` where a motion changes the push that it needs, that of a spring say."""
        held = (self.axis.position, self.axis.speed)
        others = ", ".join(sorted(outputs.keys() - set(held)))
        require(not others, f"this drive starts from {' and '.join(held)}, not from {others}; leave {others} out")
        y, v = (outputs.get(n, 0.0) for n in held)
        at = dict(zip(held, (y, v), strict=True))
        found = self._balance.equilibrium(at, parameters)
        if v and self._balance.linearise(found, at, parameters).B[0, 0]:
            moving = f"a motion at {self.axis.speed} {v:g} changes the {self.push.name} that {self.axis.position} needs"
            raise ConvergenceError(f"{moving}; start at rest", found)
        push, *inner = found.tolist()
        return Rest({**at, **dict(zip(names(self._balance.states[1:]), inner, strict=True))}, {self.push.name: push})

    @cached_property
    def _balance(self) -> System:
        """Push and friction as states whose rates vanish in a steady motion; position and speed are its inputs."""
        inner = [q for q in self.system.states if q.name not in (self.axis.position, self.axis.speed)]

        def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
            state = stack({n: {**x, **u}[n] for n in names(self.system.states)})
            inputs = stack({n: x.get(n, ca.SX(0)) for n in names(self.system.inputs)})
            xdot, _ = self.system.ode(t, state, inputs, stack(p))
            rates = dict(zip(names(self.system.states), ca.vertsplit(xdot), strict=True))
            return {self.push.name: rates[self.axis.speed], **{q.name: rates[q.name] for q in inner}}, {}

        held = [q for q in self.system.states if q not in inner]
        return define([self.push, *inner], held, [], self.system.parameters, rhs)
