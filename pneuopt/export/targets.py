"""`export_controller`: a tuned controller as the files of another language."""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum

from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.export.header import Header, make_header
from pneuopt.export.identifiers import RESERVED_FILES, Identifiers, reserved_as
from pneuopt.export.languages import write_c99
from pneuopt.export.program import ControllerProgram, controller_program
from pneuopt.export.python_class import write_python
from pneuopt.export.reference_run import make_reference_run
from pneuopt.export.structured_text import write_structured_text
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet


class Language(Enum):
    """In what a controller is written."""

    C = "c"
    STRUCTURED_TEXT = "st"
    PYTHON = "python"


_WRITERS: Mapping[Language, Callable[[ControllerProgram, Header], dict[str, str]]] = {
    Language.C: lambda program, header: write_c99(program, header, make_reference_run(program)),
    Language.STRUCTURED_TEXT: write_structured_text,
    Language.PYTHON: write_python,
}


def export_controller(
    loop: ClosedLoop,
    parameters: ParameterSet,
    language: Language,
    *,
    name: str = "controller",
    centre: float = 0.0,
    origin: Sequence[str] = (),
) -> dict[str, str]:
    """Write the sampled controller of a loop in another language.

    Parameters
    ----------
    loop : ClosedLoop
        With a sample time.
    parameters : ParameterSet
        A missing one has the loop's default.
    language : Language
        C99 with a test, one function block of IEC 61131-3 structured text, or a Python class without dependencies.
    name : str
        Of the structure, block or class, and of the files.
    centre : float
        On the wire to the valve while the command is zero [the command's unit].
    origin : sequence of str
        What the files shall say of where the gains come from; any text.

    Returns
    -------
    dict of str to str
        Texts by the names of the files.

    Raises
    ------
    InputError
        If the name is no identifier, is reserved in a language, or is that of a number in the block; if the parameters
        cannot run; `ModelError` if the controller is continuous.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.models.linear import FirstOrder
    >>> loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3, limits=False))
    >>> list(export_controller(loop, loop.parameters, Language.C))
    ['controller.h', 'controller.c', 'controller_test.c']
    """
    check_closed_loop(loop)
    program = controller_program(loop, parameters, centre)
    header = make_header(name, loop, parameters, centre, origin)
    _check_block_name(header, program)
    return _WRITERS[language](program, header)


def _check_block_name(header: Header, program: ControllerProgram) -> None:
    """Refuse a name that a language, the file system or a number of the block has."""
    within = {n.casefold() for n in program.names}
    taken = [n for n in header.own_names if n.casefold() in within]
    reserved = "a file that compilers or Windows have" if header.name.casefold() in RESERVED_FILES else None
    what = reserved_as(header.name) or reserved or (f"{taken[0]}, a number of the block" if taken else None)
    free = Identifiers([*program.names, *RESERVED_FILES]).claim(f"{header.name}_control", f"{header.name}_block")
    require(what is None, f"--name {header.name}: is {what}; take another, as --name {free}")
