"""`Page`: a program worded in one language, between the walk over its graph and the layout of a file."""

from collections.abc import Mapping
from dataclasses import dataclass

from pneuopt.export.expression_writer import Assignment, Names, Syntax, write_expressions
from pneuopt.export.program import ControllerProgram


@dataclass(frozen=True)
class Places:
    """How a language reaches the numbers of a block; {} stands for the name.

    Attributes
    ----------
    parameter, state, coefficient : str
    """

    parameter: str = "{}"
    state: str = "{}"
    coefficient: str = "{}"


@dataclass(frozen=True)
class Page:
    """A program in one language.

    Attributes
    ----------
    coefficients : tuple of Assignment
        What is computed when parameters are set.
    start : tuple of Assignment
        The first states, each once, after `start_locals`.
    start_locals, locals : tuple of Assignment
        Values on the way.
    outputs, states : mapping of str to str
        What each becomes, in terms of the locals; no state is read here that has been written. A flag's is a condition.
    operations : frozenset of int
        CasADi's operations in all of them.
    """

    coefficients: tuple[Assignment, ...]
    start_locals: tuple[Assignment, ...]
    start: tuple[Assignment, ...]
    locals: tuple[Assignment, ...]
    outputs: Mapping[str, str]
    states: Mapping[str, str]
    operations: frozenset[int]


def write_page(program: ControllerProgram, syntax: Syntax, places: Places) -> Page:
    """Word a program in a language."""
    parameters = [places.parameter.format(v.name) for v in program.parameters]
    inputs, states = [v.name for v in program.inputs], [v.name for v in program.states]
    outputs, after = [v.name for v in program.outputs], [f"{n}_next" for n in states]
    known = frozenset(parameters)
    first = [f"{n}_first" for n in states]
    begin = Names([[v.name for v in program.start_inputs], parameters], first, (), frozenset(), program.constants)
    names = Names(
        [inputs, [places.state.format(n) for n in states], parameters],
        [*(f"{n}_now" for n in outputs), *after],
        program.terms,
        known,
        program.constants,
        places.coefficient,
    )
    started, step = write_expressions(program.start, begin, syntax), write_expressions(program.step, names, syntax)
    own = [*step.statements]
    found: dict[str, str] = {}
    local = {a.name for a in own} | set(inputs)
    for name, text in step.results.items():
        if text not in local:
            own.append(Assignment(name, text))
        found[name] = text if text in local else name
    return Page(
        tuple(step.coefficients),
        (*started.coefficients, *started.statements),
        tuple(Assignment(n, started.results[f"{n}_first"]) for n in states),
        tuple(own),
        {v.name: found[f"{v.name}_now"] + (" > 0.0" if v.is_flag else "") for v in program.outputs},
        {n: found[f"{n}_next"] for n in states},
        frozenset(started.operations | step.operations),
    )
