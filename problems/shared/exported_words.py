"""The words and literals of a block in structured text, read from its text alone: which are wrong."""

import re
from collections import Counter
from collections.abc import Iterator

from pneuopt.export.identifiers import reserved_as
from pneuopt.export.tolerances import MAX_IDENTIFIER

_USED = """
    function_block end_function_block var_input var_output var constant end_var bool int dint lreal if then
    elsif else end_if or and not
    true false sel min max abs exp ln sin cos sqrt lreal_to_lint lint_to_lreal
"""
USED_WORDS = frozenset(_USED.split())
"""What of the language an exported block uses."""
OWN_WORD = "a word of the exported files"  # as `reserved_as` calls it: the layout has it, no variable may
PLAIN = re.compile(r"[A-Za-z](?:_?[A-Za-z0-9])*")
LITERAL = re.compile(r"\d+\.\d+(?:E-?\d+)?")
LARGEST_REAL, SMALLEST_REAL = 3.4e38, 1.2e-38  # of IEEE 754's single precision, as some compilers read every literal


def code_of(source: str) -> str:
    """A source without its comments; a comment within a comment is left, and found wrong."""
    return re.sub(r"\(\*.*?\*\)", " ", source, flags=re.DOTALL)


def declared_names(source: str) -> list[str]:
    """Of the block and its variables, in their order."""
    code = code_of(source)
    return [
        *re.findall(r"FUNCTION_BLOCK\s+(\S+)", code)[:1],
        *re.findall(r"^\s*(\S+)\s*:\s*(?:LREAL|BOOL|INT|DINT)\b", code, re.M),
    ]


def wrong_names(source: str) -> list[str]:
    """Declared names that are reserved, no identifiers, too long or given twice, and words that are not declared."""
    declared = declared_names(source)
    twice = {n for n, count in Counter(n.casefold() for n in declared).items() if count > 1}
    wrong = [
        n
        for n in declared
        if reserved_as(n) not in (None, OWN_WORD) or not PLAIN.fullmatch(n) or len(n) > MAX_IDENTIFIER
    ]
    known = {n.casefold() for n in declared} | USED_WORDS
    used = re.findall(r"(?<![\w.])[^\W\d]\w*", LITERAL.sub(" 0 ", code_of(source)))
    return [*wrong, *sorted(twice), *sorted({n for n in used if n.casefold() not in known})]


def wrong_literals(source: str) -> list[str]:
    """Numbers that are no real literals, or not read by what takes each for a REAL."""
    return [text for text in _numbers(code_of(source)) if not LITERAL.fullmatch(text) or not _fits(float(text))]


def _numbers(code: str) -> Iterator[str]:
    return (m[0] for m in re.finditer(r"(?<![\w.])[0-9][\w.]*(?:(?<=[eE])[+-]\d+)?", code))


def _fits(value: float) -> bool:
    return value == 0 or SMALLEST_REAL <= abs(value) <= LARGEST_REAL
