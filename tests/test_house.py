"""The rules of DESIGN and CONTRIBUTING that no other tool checks: depth, numbers, lengths, names, citations."""

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
PUBLIC = (ROOT / "pneuopt" / "__init__.pyi").read_text("utf-8")
PHYSICS = ("pneuopt/models/", "pneuopt/quantities/")  # constants of physics and of units stand beside their formulas
FOREIGN = {"argtypes", "restype", "keep_alive"}  # attributes of functions of ctypes
MAX_PACKAGE_LINES = 60229  # they only fall: lower this number with each change that shortens the package
LONE_FILES: Mapping[str, str] = {
    "pneuopt/cli/app.py": "loaded by __main__ after signals are heard, so that Ctrl-C is answered from the start",
    **dict.fromkeys(
        (f"pneuopt/cli/{n}.py" for n in ("check", "export", "info", "study", "track", "tune")),
        "a command, loaded when it runs, so that --help is quick",
    ),
    "pneuopt/dynamics/compiled/race.py": "the C structure of race.c: no other room holds ctypes",
    "pneuopt/files/first_files.py": "the text of files belongs to files; cli.init says what was written",
    "pneuopt/identification/explanations.py": "a subject of its own, what a model lacks: a row each",
    "pneuopt/models/pneumatic/logs.py": "what a drive's logs show, where it starts in them and what is wrong with them",
    "pneuopt/tuning/rival.py": "a subject of its own, a dither and the design without: which is handed out",
    "pneuopt/tuning/robust.py": "a subject of its own, a design for other plants: a row a way to find one",
    "pneuopt/tuning/structure.py": "a subject of its own, other parts of a controller: a row each",
    "pneuopt/tuning/gradients.py": "a solver of its own: minimax SQP along responses",
}
"""Files without a public name that one other file imports alone, each with the reason why it is no part of that one."""


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


def imports_in_package(sources: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Which file imports which, imports within functions and for typing included."""
    for name, text in sources.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module:
                homes = [f"{node.module}.{alias.name}" for alias in node.names] + [node.module]
                for home in dict.fromkeys(home.replace(".", "/") + ".py" for home in homes):
                    if home in sources and home != name:
                        yield name, home


def lone_files(sources: Mapping[str, str], public: str) -> list[str]:
    importers = defaultdict(set)
    for importer, home in imports_in_package(sources):
        importers[home].add(importer)
    homes = {n: n.removeprefix("pneuopt/").removesuffix(".py").replace("/", ".") for n in sources}
    lone = [n for n in sources if len(importers[n]) == 1 and f"from .{homes[n]} import" not in public]
    return [n for n in lone if not n.endswith(("/__init__.py", "tolerances.py"))]


def is_numeric(value: ast.expr | None) -> bool:
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    if isinstance(value, ast.UnaryOp):
        return is_numeric(value.operand)
    if isinstance(value, ast.BinOp):
        return is_numeric(value.left) and is_numeric(value.right)
    return isinstance(value, ast.Tuple) and bool(value.elts) and all(map(is_numeric, value.elts))


def loose_numbers(sources: Mapping[str, str]) -> Iterator[str]:
    for name, text in sources.items():
        if not name.endswith("/tolerances.py") and not name.startswith(PHYSICS):
            for node in ast.parse(text).body:
                if isinstance(node, ast.Assign | ast.AnnAssign) and is_numeric(node.value):
                    yield f"{name}:{node.lineno}"


def fields_by_file(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """The files whose classes declare each field."""
    files = defaultdict(set)
    for name, text in sources.items():
        for kind in (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ClassDef)):
            for node in ast.walk(kind):
                if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                    files[node.target.id].add(name)
                elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                    files[node.attr].add(name)
    return files


def attributes_written_elsewhere(sources: Mapping[str, str]) -> Iterator[str]:
    """Assignments to a field of an object whose class stands in another file."""
    files = fields_by_file(sources)
    for name, text in sources.items():
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Attribute) or not isinstance(node.ctx, ast.Store) or node.attr in FOREIGN:
                continue
            if files[node.attr] and name not in files[node.attr]:
                yield f"{name}:{node.lineno}: {ast.unparse(node)}"


def steered_by_words(sources: Mapping[str, str]) -> Iterator[str]:
    """Control flow by a key of `stats` or by a message's identity, and frozen objects written through `vars()`."""
    for name, text in sources.items():
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(r"in \w+(\.\w+)*\.stats\b|vars\(\w+\)\[|status is [A-Z_]{4,}", line):
                yield f"{name}:{number}"


def test_the_package_only_gets_shorter() -> None:
    assert sum(text.count("\n") for text in PACKAGE.values()) <= MAX_PACKAGE_LINES


def test_a_file_has_a_public_name_or_two_importers() -> None:
    assert sorted(lone_files(PACKAGE, PUBLIC)) == sorted(LONE_FILES)


def test_numbers_that_decide_stand_in_the_tolerances_of_their_room() -> None:
    assert list(loose_numbers(PACKAGE)) == []


def test_a_file_writes_no_attribute_of_another_files_class() -> None:
    assert list(attributes_written_elsewhere(PACKAGE)) == []


def test_the_program_reads_fields() -> None:
    assert list(steered_by_words(PACKAGE)) == []


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
        ("LIMIT = -2 * 1e-3\n", lambda s: list(loose_numbers(s)) == ["a.py:1"]),
        (
            "class State:\n    size: int\n",
            lambda s: list(attributes_written_elsewhere({**s, "b.py": "x.size = 1\n"})) != [],
        ),
        ("x = 1 if 'end' in fit.stats else 2\n", lambda s: list(steered_by_words(s)) == ["a.py:1"]),
        ("", lambda s: lone_files({**s, "b.py": "from a import f\n"}, "") == ["a.py"]),
    ],
)
def test_a_broken_rule_is_found_and_named(text: str, found: Callable[[Mapping[str, str]], bool]) -> None:
    assert found({"a.py": text})
