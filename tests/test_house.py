"""The rules of CONTRIBUTING that no other tool checks: lengths, names, and what code cites."""

import ast
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_FUNCTION_LINES = 40  # without its docstring
PARTICIPLES = {"converged", "fixed", "freed"}  # edits and a property that users know from other libraries
NO_PARTICIPLES = {"feed", "need", "seed", "speed"}
FOLDERS = ("pneuopt", "problems", "tests")
SOURCES = {p.relative_to(ROOT).as_posix(): p.read_text("utf-8") for f in FOLDERS for p in (ROOT / f).rglob("*.py")}
PACKAGE = {name: text for name, text in SOURCES.items() if name.startswith("pneuopt/")}


def long_functions(sources: Mapping[str, str]) -> Iterator[str]:
    for name, text in sources.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and node.body:
                body = node.body[1 if ast.get_docstring(node) is not None else 0 :]
                if body and (body[-1].end_lineno or 0) - body[0].lineno >= MAX_FUNCTION_LINES:
                    yield f"{name}: {node.name}"


def participles(sources: Mapping[str, str]) -> Iterator[str]:
    for name, text in sources.items():
        for node in ast.walk(ast.parse(text)):
            word = node.name.strip("_") if isinstance(node, ast.FunctionDef) else ""
            if word.endswith("ed") and "_" not in word and word not in PARTICIPLES | NO_PARTICIPLES:
                yield f"{name}: {word}"


def constants_with_several_homes(sources: Mapping[str, str]) -> dict[str, list[str]]:
    homes = defaultdict(list)
    for name, text in sources.items():
        nodes = [n for n in ast.parse(text).body if isinstance(n, ast.Assign | ast.AnnAssign)]
        targets = [t for n in nodes for t in (n.targets if isinstance(n, ast.Assign) else [n.target])]
        for constant in {t.id for t in targets if isinstance(t, ast.Name) and re.fullmatch("_?[A-Z][A-Z0-9_]+", t.id)}:
            homes[constant].append(name)
    return {constant: names for constant, names in homes.items() if len(names) > 1}


def missing_citations(sources: Mapping[str, str]) -> list[str]:
    cited = {(name, page) for name, text in sources.items() for page in re.findall(r"\b[A-Z]{4,}\.md\b", text)}
    return [f"{name}: {page}" for name, page in sorted(cited) if not (ROOT / page).exists()]


def test_functions_are_short() -> None:
    assert list(long_functions(PACKAGE)) == []


def test_functions_are_verbs_or_the_noun_that_they_return() -> None:
    assert list(participles(PACKAGE)) == []


def test_a_constant_has_one_home() -> None:
    assert constants_with_several_homes(PACKAGE) == {}


def test_code_cites_only_files_that_are_here() -> None:
    assert missing_citations(SOURCES) == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("def solved():\n    return 1\n", lambda s: list(participles(s)) == ["a.py: solved"]),
        ("def f():\n" + "    x = 1\n" * 41, lambda s: list(long_functions(s)) == ["a.py: f"]),
        (
            "STEP = 1\n",
            lambda s: constants_with_several_homes({**s, "b.py": "STEP = 2\n"}) == {"STEP": ["a.py", "b.py"]},
        ),
        ("# see NOWHERE" + ".md\n", lambda s: missing_citations(s) == ["a.py: NOWHERE" + ".md"]),
    ],
)
def test_a_broken_rule_is_found_and_named(text: str, found: Callable[[Mapping[str, str]], bool]) -> None:
    assert found({"a.py": text})
