"""The table of the paper's items: nothing is left out, and what it names is there."""

import re
from pathlib import Path

import pneuopt
from problems.paper import paper_crawl, paper_dither, paper_physical, paper_stroke, paper_tables

FOLDER = Path(__file__).parents[2] / "problems" / "paper"
TABLE = [line for line in (FOLDER / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("| ")][1:]
SCRIPTS = (paper_crawl, paper_dither, paper_physical, paper_stroke, paper_tables)
SOURCES = "\n".join(Path(str(script.__file__)).read_text(encoding="utf-8") for script in SCRIPTS)


def items() -> str:
    """The first column."""
    return "\n".join(line.split("|")[1].strip() for line in TABLE)


def test_every_equation_figure_and_table_is_there() -> None:
    numbers = {kind: set() for kind in ("eq.", "fig.", "table")}  # type: dict[str, set[int]]
    for kind, listed in re.findall(r"(eq\.|fig\.|table) (\d+(?:, \d+)*)", items()):
        numbers[kind] |= {int(n) for n in listed.split(", ")}
    assert numbers == {"eq.": set(range(1, 17)), "fig.": set(range(1, 9)), "table": {1, 2}}
    assert "conclusion" in items()


def test_every_item_is_reproduced_explained_beaten_or_said_to_be_missing() -> None:
    for line in TABLE:
        assert re.match(r"(R|E|B|not built) ?", line.split("|")[3].strip()), line


def test_what_it_names_is_there() -> None:
    root = FOLDER.parents[1]
    for name in re.findall(r"`([\w/.]+\.(?:py|toml))", "\n".join(TABLE)):
        assert (root / name).is_file() or (FOLDER / name).is_file(), name
    for name in re.findall(r"`([A-Z]\w+|plot_\w+)`", "\n".join(TABLE)):
        assert hasattr(pneuopt, name), name


def test_the_rows_that_it_names_are_rows_of_the_scripts() -> None:
    written = re.findall(r'"((?:\{[^"]*\}|[\w.:-])+)"', SOURCES)
    known = [re.compile(re.sub(r"\\\{.*?\\\}", r"[\\w.]+", re.escape(text))) for text in written]
    prefixes = [re.compile(pattern.pattern.partition(r"\.")[0]) for pattern in known]
    for name in re.findall(r"`([a-z]\w*(?:\.[\w*]+)+)`", "\n".join(TABLE)):
        if name.endswith((".py", ".toml")):
            continue
        found = (
            (p.fullmatch(name.split(".")[0]) for p in prefixes) if "*" in name else (p.fullmatch(name) for p in known)
        )
        assert any(found), name
