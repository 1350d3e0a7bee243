"""`Page`: a program worded in one language, between the walk over its graph and the layout of a file."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pneuopt.export.identifiers import Identifiers
from pneuopt.export.program import C_NAMES, ControllerProgram
from pneuopt.export.writer import Assignment, Names, Syntax, write_expressions


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


def write_page(program: ControllerProgram, syntax: Syntax, places: Places, taken: Iterable[str] = ()) -> Page:
    """Word a program in a language; no value on the way has a name of the program or one that is `taken`."""
    parameters = [places.parameter.format(v.name) for v in program.parameters]
    inputs, states = [v.name for v in program.inputs], [v.name for v in program.states]
    outputs, known = [v.name for v in program.outputs], frozenset(parameters)
    used = [*program.names, *C_NAMES, *taken]
    free = Identifiers(used)
    first, after = ([free.claim(f"{n}_{what}") for n in states] for what in ("first", "next"))
    now = [free.claim(f"{n}_now") for n in outputs]
    used += [*first, *after, *now]
    given = [[v.name for v in program.start_inputs], parameters]
    begin = Names(given, first, (), frozenset(), program.constants, taken=frozenset(used))
    started = write_expressions(program.start, begin, syntax)
    used += [a.name for a in (*started.coefficients, *started.statements)]
    names = Names(
        [inputs, [places.state.format(n) for n in states], parameters],
        [*now, *after],
        program.terms,
        known,
        program.constants,
        places.coefficient,
        frozenset(used),
    )
    step = write_expressions(program.step, names, syntax)
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
        tuple(Assignment(n, started.results[begun]) for n, begun in zip(states, first, strict=True)),
        tuple(own),
        {v.name: found[made] + (" > 0.0" if v.is_flag else "") for v, made in zip(program.outputs, now, strict=True)},
        {n: found[made] for n, made in zip(states, after, strict=True)},
        frozenset(started.operations | step.operations),
    )
