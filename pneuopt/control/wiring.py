"""The connection of a plant and its controller: which signals are joined, and checks that they can be."""

from collections.abc import Mapping, Sequence
from math import inf
from typing import Protocol

import casadi as ca

from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols, System, names
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import Quantity



def evaluate_plant(
    plant: System, actuated: str, t: ca.SX, x: Symbols, u: Symbols, p: Symbols, command: ca.SX
) -> tuple[Signals, Signals]:
    """Rates and outputs of the plant under a command."""
    driven = {**u, actuated: command}
    xs, us = (ca.vertcat(*(v[n] for n in names(q))) for v, q in ((x, plant.states), (driven, plant.inputs)))
    xdot, y = plant.ode(t, xs, us, ca.vertcat(*(p[n] for n in plant.parameters)))
    states, outputs = names(plant.states), names(plant.outputs)
    return {n: xdot[k] for k, n in enumerate(states)}, {n: y[k] for k, n in enumerate(outputs)}


def select_signal(kind: str, name: str | None, known: Sequence[Quantity], usual: str | None) -> Quantity:
    """The signal of that name, by default the usual one or the only one.

    Raises
    ------
    ModelError
        If there are several; `UnknownNameError` if there is none of that name.
    """
    by_name = {q.name: q for q in known}
    if name is None:
        name = usual if usual in by_name else next(iter(by_name)) if len(by_name) == 1 else None
    field = "actuated" if kind == "input" else "measured"
    require(name is not None, f"the plant has the {kind}s {', '.join(by_name) or 'none'}; choose {field}=", ModelError)
    check_names(kind, [str(name)], by_name, f"ClosedLoop {field}")
    return by_name[str(name)]


def check_algebraic_loop(plant: System, command: str, output: str) -> None:
    """Refuse an algebraic loop: an output that depends on the command without any lag."""
    t, x, u = (ca.SX.sym(k, plant.ode.size1_in(i)) for i, k in enumerate("txu"))
    y = plant.ode(t, x, u, ca.SX.sym("p", plant.ode.size1_in(3)))[1]
    j, i = names(plant.inputs).index(command), names(plant.outputs).index(output)
    require(
        ca.jacobian(y[i], u[j]).nnz() == 0,
        f"algebraic loop: output {output!r} depends on input {command!r} without any lag; "
        "measure another output, or give the plant an actuator or a sensor with a lag",
        ModelError,
    )


class JoinedSignals(Protocol):
    """The signals of a `ClosedLoop` at which plant and controller meet."""

    @property
    def plant(self) -> System:
        """Without the controller."""
        ...

    @property
    def command(self) -> Quantity:
        """The plant's input that the controller drives."""
        ...

    @property
    def feedback(self) -> Quantity:
        """The plant's output that is fed back, by which the loop is judged."""
        ...

    @property
    def pid_signal(self) -> Quantity:
        """The plant's output that the PID controls."""
        ...


class CascadedLoop(JoinedSignals, Protocol):
    """What of a `ClosedLoop` decides whether it can be a cascade."""

    @property
    def outer(self) -> object:
        """The outer loop."""
        ...

    @property
    def feedforward(self) -> object:
        """The feedforward of the reference's jumps."""
        ...


def check_cascade(loop: CascadedLoop) -> None:
    """Refuse an outer loop of anything but the axis's position, and a feedforward of its jumps."""
    if loop.outer is None:
        return
    position = (loop.plant.axis or Axis()).position
    told = f"a PositionLoop controls the {position}, this loop {loop.feedback.name!r}; take measured={position!r}"
    require(loop.feedback.name == position, told, ModelError)
    check_algebraic_loop(loop.plant, loop.command.name, position)
    told = "a Feedforward is of jumps of what the PID follows, in a cascade a speed; take MotionFeedforward"
    require(loop.feedforward is None, told, ModelError)


def check_initial_command(command: float, value: Mapping[str, float], unit: str) -> None:
    """Refuse a start that takes a command beyond the limits."""
    low, high = value.get("pid.lower", -inf), value.get("pid.upper", inf)
    require(
        low <= command <= high,
        f"the loop cannot start at rest: it needs a command of {command:g} {unit}, the limits are {low:g} and {high:g}",
    )
