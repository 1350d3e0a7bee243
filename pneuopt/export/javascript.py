"""`write_loop_javascript`: a closed loop as JavaScript for a page, from the expressions that `simulate` runs.

`loop_integrator.js` beside this file holds what is no expression: the Runge-Kutta steps and the walk over samples.
"""

import json
from collections.abc import Sequence
from importlib import resources

import casadi as ca

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import FRICTION_DIRECTION
from pneuopt.export.writer import (
    ARITHMETIC,
    COMPARED,
    SELECT,
    Binding,
    Form,
    Names,
    Syntax,
    infix,
    unary_calls,
    write_expressions,
)

JAVASCRIPT = Syntax(
    {
        **ARITHMETIC,
        ca.OP_EQ: infix("===", Binding.COMPARISON),
        ca.OP_NE: infix("!==", Binding.COMPARISON),
        ca.OP_AND: Form("({0} && {1})", needs=COMPARED),
        ca.OP_OR: Form("({0} || {1})", needs=COMPARED),
        ca.OP_NOT: Form("!({0})"),
        ca.OP_FMIN: Form("Math.min({0}, {1})"),
        ca.OP_FMAX: Form("Math.max({0}, {1})"),
        ca.OP_FABS: Form("Math.abs({0})"),
        ca.OP_POW: Form("Math.pow({0}, {1})"),
        ca.OP_CONSTPOW: Form("Math.pow({0}, {1})"),
        ca.OP_ATAN2: Form("Math.atan2({0}, {1})"),
        ca.OP_HYPOT: Form("Math.hypot({0}, {1})"),
        ca.OP_IF_ELSE_ZERO: Form("({0} ? {1} : 0.0)"),
        SELECT: Form("({0} ? {1} : {2})"),
        **unary_calls(
            "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil sign",
            "Math.{}",
        ),
    },
    infinity="Infinity",
    truth=Form("({0} ? 1.0 : 0.0)"),
    condition=Form("{0} !== 0.0", Binding.COMPARISON, (Binding.SUM,)),
)


def write_loop_javascript(loop: ClosedLoop) -> str:
    """A loop as JavaScript: ``makeLoop(p)`` binds parameters, ``simulateLoop(...)`` integrates; no module, no library.

    ``simulateLoop(p, x0, reference, horizon, points)`` gives ``{t, states, outputs}``, an array a state and an output
    at ``points + 1`` equal instants; null where the loop is too stiff or leaves what its model describes. Parameters,
    states and outputs are those of the loop, in its order, which ``LOOP`` names. The reference is ``{at, initial,
    final, inputs}``, the last one optional: what other inputs are from that instant on, ``[[place, value], ...]``.

    Parameters
    ----------
    loop : ClosedLoop

    Returns
    -------
    str

    Raises
    ------
    NotImplementedError
        If the loop has an operation that JavaScript has no word for, or a friction that sticks (`Karnopp`).
    """
    if FRICTION_DIRECTION in loop.parameters:
        raise NotImplementedError("a friction that sticks is simulated from event to event, which the page does not do")
    sampled = loop.pid.sample_time is not None
    system = loop.hold_system() if sampled else loop.system()
    sizes = len(loop.states), len(loop.inputs), len(loop.parameters)
    t, *symbols = ca.SX.sym("t"), *(ca.SX.sym(n, size) for n, size in zip("xup", sizes, strict=True))
    found, measured = system.ode(t, *symbols)
    results = ca.densify(ca.vertcat(found, measured))
    names = [*(f"dx[{k}]" for k in range(sizes[0])), *(f"y[{k}]" for k in range(len(loop.outputs)))]
    parts = [_method("rates", "t, x, u, dx, y", ca.Function("rates", [t, *symbols], [results]), names)]
    if sampled:
        after = ca.Function("update", [t, *symbols], [ca.densify(loop.update(t, *symbols))])
        parts.append(_method("update", "t, x, u, after", after, [f"after[{k}]" for k in range(sizes[0])]))
    about = {
        "parameters": list(loop.parameters),
        "states": [q.name for q in loop.states],
        "outputs": [q.name for q in loop.outputs],
        "inputs": [q.name for q in loop.inputs],
        "nominal": [q.nominal for q in loop.states],
        "sampleTime": loop.pid.sample_time,
    }
    coefficients = [line for own, _ in parts for line in own]
    methods = [line for _, own in parts for line in own]
    integrator = resources.files(__package__).joinpath("loop_integrator.js").read_text("utf-8")
    head = f"const LOOP = {json.dumps(about, ensure_ascii=True).replace('<', chr(92) + 'u003c')};"
    body = [head, "function makeLoop(p) {", *coefficients, "  return {", *methods, "  };", "}"]
    return "\n".join(body) + "\n" + integrator


def _method(name: str, signature: str, function: ca.Function, results: Sequence[str]) -> tuple[list[str], list[str]]:
    """What depends on the parameters alone, and the method that computes the rest."""
    counts = [function.numel_in(k) for k in range(1, 4)]
    inputs = [["t"], *([f"{n}[{k}]" for k in range(count)] for n, count in zip("xup", counts, strict=True))]
    known = frozenset(inputs[3])
    own = [f"r{k}" for k in range(len(results))]  # an entry that is used again has this name
    found = write_expressions(function, Names(inputs, own, parameters=known, coefficient=f"{name}_{{}}"), JAVASCRIPT)
    coefficients = [f"  const {name}_{a.name} = {a.text};" for a in found.coefficients]
    lines = [f"    {name}({signature}) {{"]
    lines += [f"      const {a.name} = {a.text};" for a in found.statements]
    lines += [f"      {place} = {text};" for place, text in zip(results, found.results.values(), strict=True)]
    return coefficients, [*lines, "    },"]
