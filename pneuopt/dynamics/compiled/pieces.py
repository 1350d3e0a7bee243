"""The pieces of a sampled system with their sensitivities, symbolically and as the C of a run over segments."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import casadi as ca

from pneuopt.dynamics.compiled.c_writer import CFunction, write_c
from pneuopt.dynamics.compiled.compiler import warn_once
from pneuopt.dynamics.partitioned_step import OwnRate, partitioned_step
from pneuopt.dynamics.runge_kutta import rk4

C_SOURCE_FOLDER = Path(__file__).parent
INPUT_RATES = {
    "t": 1,
    "u": 1,
    "p": 0,
    "x": 2,
    "S": 2,
}  # how often the inputs of a piece change: an index into `c_writer.RATES`
PIECE_OUTPUTS = {"step": ("x_next", "S_next"), "output": ("y", "dy"), "update": ("x_next", "S_next")}
STEP_INPUT_RATES = {"t": 2, "h": 1, "u": 1, "p": 0, "x": 2, "S": 2}


def prepare_rollout(
    step: ca.Function,
    update: ca.Function | None,
    ode: ca.Function | None,
    wrt: Sequence[int],
    start: bool,
    implicit: int | None = None,
) -> tuple[dict[str, ca.Function], str]:
    """The pieces of a sampled system (see `rollout.Pieces`) with their sensitivities, and the C of a run of them.

    Parameters
    ----------
    update, ode : casadi.Function or None
    wrt : sequence of int
        Positions in the parameter vector of which sensitivities are wanted.
    start : bool
        Whether sensitivities to the start state are wanted.
    implicit : int, optional
        Position of the state in which the steps of an ODE are implicit (`partitioned_step`), in place of RK4's.

    Returns
    -------
    functions : dict of str to casadi.Function
        "step", "output" and, if there is one, "update": ``(..., x, u, p, S) -> (value, its sensitivity)``; of an ODE
        in RK4 steps "rate", too: ``(t, x, u, p) -> (xdot, its Jacobians to x and to the chosen parameters)``.
    source : str
        Empty where an operation has no form in C, which is said once.
    """
    return prepare_by_content(str(step.serialize()), _serialize(update), _serialize(ode), tuple(wrt), start, implicit)


@functools.lru_cache(maxsize=64)
def prepare_by_content(
    step: str, update: str | None, ode: str | None, wrt: tuple[int, ...], start: bool, implicit: int | None
) -> tuple[dict[str, ca.Function], str]:
    """`prepare_rollout` of serialised Functions, cached by their content."""
    given = ca.Function.deserialize(step), _deserialize(update), _deserialize(ode)
    functions = _with_sensitivities(*given, wrt, start, implicit)
    try:
        return functions, _rollout_source(functions, len(wrt), start)
    except NotImplementedError as missing:
        warn_once(f"no C for {missing}: this model runs in the CasADi VM, about ten times slower")
        return functions, ""


def _serialize(function: ca.Function | None) -> str | None:
    return None if function is None else str(function.serialize())


def _deserialize(content: str | None) -> ca.Function | None:
    return None if content is None else ca.Function.deserialize(content)


def _with_sensitivities(
    step: ca.Function,
    update: ca.Function | None,
    ode: ca.Function | None,
    wrt: Sequence[int],
    start: bool,
    implicit: int | None,
) -> dict[str, ca.Function]:
    """Each piece with S = dx/d(columns) carried along: (..., x, u, p, S) -> (value, its sensitivity)."""
    t, h, x, u, p = (ca.SX.sym(k, step.size1_in(i)) for i, k in enumerate(("t", "h", "x", "u", "p")))
    S = ca.SX.sym("S", x.numel(), len(wrt) + (x.numel() if start else 0))

    def value_sensitivity(value: ca.SX) -> ca.SX:
        """The value's sensitivity: its Jacobian first, which is cheaper than each column through every operation."""
        fixed = ca.SX(value.numel(), S.size2() - len(wrt))
        return ca.mtimes(ca.jacobian(value, x), S) + ca.horzcat(fixed, ca.jacobian(value, p)[:, list(wrt)])

    def piece_function(name: str, arguments: list[ca.SX], value: ca.SX, sensitivity: ca.SX) -> ca.Function:
        # a bare "step" would be bound to the C library's own
        outputs = [ca.densify(value), ca.densify(sensitivity)]
        return ca.Function(f"system_{name}", [*arguments, x, u, p, S], outputs, {"cse": True})

    x_next, y = step(t, h, x, u, p)
    S_next = value_sensitivity(x_next)
    if ode is not None:
        rate = ca.Function(
            "rate", [t, x, u, p, S], [ca.horzcat(*(f(ode(t, x, u, p)[0]) for f in (ca.densify, value_sensitivity)))]
        )
        both = _advance(lambda at, z: rate(at, z[:, 0], u, p, z[:, 1:]), ode, implicit, (t, h, x, u, p, S))
        x_next, S_next = both[:, 0], both[:, 1:]
    functions = {
        "step": piece_function("step", [t, h], x_next, S_next),
        "output": piece_function("output", [t], y, value_sensitivity(y)),
    }
    if ode is not None and implicit is None:
        xdot = ode(t, x, u, p)[0]
        slopes = [ca.densify(xdot), ca.jacobian(xdot, x), ca.jacobian(xdot, p)[:, list(wrt)]]
        functions["rate"] = ca.Function("system_rate", [t, x, u, p], slopes, {"cse": True})
    if update is not None:
        after = update(t, x, u, p)
        functions["update"] = piece_function("update", [t], after, value_sensitivity(after))
    return functions


def _advance(
    rate: Callable[[ca.SX, ca.SX], ca.SX], ode: ca.Function, implicit: int | None, symbols: tuple[ca.SX, ...]
) -> ca.SX:
    """The states and sensitivities, a column each, after a step of RK4 or one that is implicit in a state."""
    t, h, x, u, p, S = symbols
    both = ca.horzcat(x, S)
    if implicit is None:
        return rk4(rate, t, h, both)
    row, xdot = implicit, ode(t, x, u, p)[0]
    column = ca.jacobian(xdot, x)[:, row]
    own = ca.Function("own", [t, x, u, p], [ca.densify(f) for f in (xdot[row], column[row], column)])

    def value(at: ca.SX, there: ca.SX) -> tuple[ca.SX, ca.SX]:
        found, slope, _ = own(at, there, u, p)
        return found, slope

    return partitioned_step(rate, OwnRate(row, value, lambda at, there: own(at, there, u, p)[2]), t, h, both)


def _rollout_source(functions: dict[str, ca.Function], chosen: int, start: bool) -> str:
    """The run in C: sizes, lanes, and the driver around the pieces."""
    nx, nu, np_ = (functions["step"].size1_in(i) for i in (2, 3, 4))
    starts = nx if start else 0
    sizes = {"NX": nx, "NU": nu, "NP": np_, "NY": functions["output"].size1_out(0)}
    sizes |= {"STARTS": starts, "NS": starts + chosen, "HAS_UPDATE": int("update" in functions)}
    pieces = []
    for name, results in PIECE_OUTPUTS.items():
        text, kept = "", 0
        if name in functions:
            arguments = ("t", "h", "x", "u", "p", "S") if name == "step" else ("t", "x", "u", "p", "S")
            rates = STEP_INPUT_RATES if name == "step" else INPUT_RATES
            text, kept = write_c(CFunction(name, functions[name], arguments, results), rates)
        pieces.append(text)
        sizes |= {f"{name.upper()}_KEPT": kept}
    defines = (f"#define {k} {v}" for k, v in sizes.items())
    lanes, driver = ((C_SOURCE_FOLDER / name).read_text(encoding="utf-8") for name in ("lanes.h", "rollout.c"))
    before, after = driver.split("#include PIECES", 1)
    race = "" if starts + chosen else (C_SOURCE_FOLDER / "race.c").read_text(encoding="utf-8")
    return "\n".join([*defines, lanes, before, *pieces, after, race])
