"""Write the site's pages: those beside this file, README, CHANGELOG and others, docstrings, scripts, commands' help.

    python docs/make_pages.py FOLDER

keys.md, outputs.md and commands.md get their tables from the declarations. A source's link to a file that is no page of
the site ends this, so that nothing is moved without its readers.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType

from PIL import Image

import pneuopt
from pneuopt.cli.info import format_markdown
from pneuopt.files.keys import list_keys
from pneuopt.files.outputs import describe_outputs

ROOT = Path(__file__).parents[1]
BY_HAND = sorted(path.name for path in Path(__file__).parent.glob("*.md"))
PAGES = {  # of the site, for the files that the sources link to
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "data/README.md": "data.md",
    "problems/README.md": "gallery.md",
    "problems/paper/README.md": "paper.md",
    **{f"docs/{name}": name for name in BY_HAND},
}
ROOMS = {  # whose public names have a page, in the order in which data go through them
    "logs": "Logs",
    "models": "Plants and friction",
    "identification": "Identification",
    "experiments": "The next experiment",
    "control": "The loop",
    "evaluation": "Requirements and certificates",
    "tuning": "Tuning",
    "studies": "Studies",
    "dynamics": "Systems and their simulation",
    "shooting": "Multiple shooting",
    "files": "Files",
    "plotting": "Figures",
    "report": "Reports",
    "export": "Exports",
    "quantities": "Numbers, trajectories, errors",
}
CONTENTS = {  # the site's pages by what a reader comes for
    "Learn": ["own_rig", "how_to", "concepts", "logs", "certificate", "export", "install"],
    "Look up": ["commands", "keys", "outputs", "reference", "api/index"],
    "Understand": ["theory", "validated", "decisions"],
    "Results": ["gallery", "paper", "data"],
    "Project": ["contributing", "changelog", "security"],
}
FOLDER = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "pages"


def write(page: str, text: str) -> None:
    """A page of the site."""
    path = FOLDER / page
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def localise(text: str, folder: str) -> str:
    """A source's text with its links turned into the site's; figures are copied into it."""

    def turn(found: re.Match[str]) -> str:
        label, target = found[1], found[2]
        path, _, anchor = target.partition("#")
        if not path or target.startswith(("http:", "https:")):
            return found[0]
        file = (ROOT / folder / path).resolve().relative_to(ROOT).as_posix()
        assert (ROOT / file).exists(), f"{folder or 'README'}: a link to {target}, which is not there"
        if file.endswith(".png"):
            copy_figure(file)
            return f"{label}](figures/{Path(file).name})"
        if file.endswith(".py"):
            return f"{label}](gallery.md#{Path(file).stem.replace('_', '-')})"
        assert file in PAGES, f"{folder or 'README'}: a link to {target}, of which the site has no page"
        return f"{label}]({PAGES[file]}{'#' * bool(anchor)}{anchor})"

    return link_names(re.sub(r"(?<=\[)([^\]]*)\]\(([^)\s]+)\)", turn, text))


def link_names(text: str) -> str:
    """Public names between backticks become links to their pages; code stays as it is."""
    is_code, lines = False, list[str]()
    for line in text.splitlines():
        is_code ^= line.startswith("```")
        is_text = not (is_code or line.startswith(("    ", "```")))
        lines.append(re.sub(r"`(po\.)?(\w+)`", lambda m: link_to(m[2], m[0]), line) if is_text else line)
    return "\n".join(lines)


def link_to(name: str, text: str) -> str:
    """The link to a public name's page; the text itself where it is none."""
    is_public = not name.startswith("_") and name in pneuopt.__all__
    return f"{{py:obj}}`{name} <pneuopt.{name}>`" if is_public else text


def copy_figure(file: str) -> None:
    """A figure of the checkout, into the site."""
    (FOLDER / "figures").mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / file, FOLDER / "figures")


def public_names() -> dict[str, list[str]]:
    """The package's public names by the room in which they are written; the .pyi is what lazy_loader reads."""
    rooms = defaultdict(list)
    tree = ast.parse((ROOT / "pneuopt" / "__init__.pyi").read_text("utf-8"))
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module:
            rooms[node.module.split(".")[0]] += [alias.asname or alias.name for alias in node.names]
    return {room: sorted(names, key=str.lower) for room, names in rooms.items()}


def write_api() -> None:
    """A page a room, with its public names, and one that lists them."""
    names = public_names()
    assert set(names) <= set(ROOMS), f"rooms without a title: {set(names) - set(ROOMS)}"
    index = ["# Python", "", "`import pneuopt as po` has every public name; a module's path is private.", ""]
    pages = [room for room in ROOMS if room in names]
    for room in pages:
        docstring = ast.get_docstring(ast.parse((ROOT / "pneuopt" / room / "__init__.py").read_text("utf-8"))) or ""
        parts = [f"# {ROOMS[room]}", "", docstring.partition("\n\n")[0], ""]
        for name in names[room]:
            parts += ["```{eval-rst}", *describe(name), "```", ""]
        write(f"api/{room}.md", "\n".join(parts))
        links = ", ".join(f"{{py:obj}}`{name} <pneuopt.{name}>`" for name in names[room])
        index += [f"## [{ROOMS[room]}]({room}.md)", "", links, ""]
    write("api/index.md", "\n".join([*index, *table_of_contents("", pages, hidden=True)]))


def describe(name: str) -> list[str]:
    """The directive that describes a public name: a class with its members, a function, a module, or a value."""
    value = getattr(pneuopt, name)
    if isinstance(value, type):
        return [f".. autoclass:: pneuopt.{name}", "   :members:"]
    if isinstance(value, ModuleType):
        return [f".. automodule:: pneuopt.{name}"]
    return [f".. autofunction:: pneuopt.{name}" if callable(value) else f".. autodata:: pneuopt.{name}"]


def table_of_contents(caption: str, pages: list[str], *, hidden: bool) -> list[str]:
    """The directive that puts pages into the navigation."""
    options = [f":caption: {caption}"] * bool(caption) + [":hidden:"] * hidden + [":maxdepth: 1"]
    return ["```{toctree}", *options, "", *pages, "```", ""]


def describe_commands() -> str:
    """The help of each command, at 80 columns."""
    environment = {**os.environ, "COLUMNS": "80", "NO_COLOR": "1", "TERM": "dumb"}

    def ask(*words: str) -> str:
        command = [sys.executable, "-m", "pneuopt", *words, "--help"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, cwd=ROOT)
        return done.stdout.replace("python -m pneuopt", "pneuopt").strip()

    first = ask()
    names = re.findall(r"^  ([a-z][a-z-]+) {2,}\S", first.partition("Commands:")[2], re.MULTILINE)
    assert len(names) > 5, f"no commands in {first!r}"
    parts = ["", f"```text\n{first}\n```", ""]
    for name in names:
        parts += [f"## pneuopt {name}", "", f"```text\n{ask(name)}\n```", ""]
    return "\n".join(parts)


def scripts() -> Iterator[tuple[str, str, str]]:
    """Group, path with arguments, and result of each script in problems/README.md; a group's lead has no path."""
    text = (ROOT / "problems" / "README.md").read_text("utf-8")
    for group, body in re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL):
        lead, _, table = body.partition("| script |")
        yield group, "", lead.strip()
        for call, result in re.findall(r"^\| `(.+?)` \| (.*?) \|[^|]*\|$", table, re.MULTILINE):
            yield group, call, result


def escape_asterisks(text: str) -> str:
    """A docstring for Markdown: "rows frame.*" names rows, it begins no emphasis; code keeps its asterisks."""
    lines = (line if line.startswith("    ") else re.sub(r"(?<=[\w.])\*", r"\\*", line) for line in text.splitlines())
    return "\n".join(lines)


def figures_of(script: Path) -> list[Path]:
    """What a script has drawn: with `--out out` in this checkout, else as it is kept in docs/figures."""
    places = [ROOT / "docs" / "figures", ROOT / "out"]  # a later one replaces an earlier one's figures
    stems = {own.stem for own in script.parent.glob("*.py")} - {script.stem}
    found = {f.name: f for place in places for f in sorted(place.glob(f"{script.stem}*.png"))}
    longer = [stem for stem in stems if stem.startswith(script.stem)]  # b32_partial.png is no figure of b32.py
    return [f for name, f in found.items() if not any(name.startswith(stem) for stem in longer)]


def drawing_command(figure: Path, call: str) -> str:
    """What has drawn a figure, with its counts, as `finish` of problems/shared/claims.py writes into it."""
    with Image.open(figure) as image:
        return str(image.info.get("Description", f"python {call} --out out"))


def write_gallery() -> None:
    """Every claim script with its result, its figures (`figures_of`) and the command that draws them."""
    lead = (ROOT / "problems" / "README.md").read_text("utf-8").partition("\n## ")[0]
    parts = [localise(lead, "problems"), ""]
    for group, call, result in scripts():
        if not call:
            parts += [f"## {group}", "", localise(result, "problems"), ""]
            continue
        path = ROOT / call.split()[0]
        text = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
        parts += [
            f"### {path.stem.replace('_', ' ')}",
            "",
            localise(result[:1].upper() + result[1:], "problems") + ".",
            "",
        ]
        for figure in figures_of(path):
            copy_figure(figure.relative_to(ROOT).as_posix())
            parts += [f"![The figure of {path.stem}](figures/{figure.name})", ""]
            parts += [f"*Drawn by* `{drawing_command(figure, call)}`", ""]
        parts += [escape_asterisks(text), ""]
    write("gallery.md", "\n".join(parts))


TABLES: Mapping[str, Callable[[], str]] = {  # at the ends of pages written by hand
    "keys.md": lambda: format_markdown(list_keys()),
    "outputs.md": describe_outputs,
    "commands.md": describe_commands,
}


def write_all() -> None:
    """All pages."""
    contents = [line for caption, pages in CONTENTS.items() for line in table_of_contents(caption, pages, hidden=True)]
    for source, page in PAGES.items():
        if page == "gallery.md":
            continue
        text = localise((ROOT / source).read_text("utf-8"), str(Path(source).parent))
        end = "\n".join(["", *contents]) if page == "index.md" else TABLES.get(page, str)()
        write(page, text + "\n" + end)
    write_api()
    write_gallery()


if __name__ == "__main__":
    shutil.rmtree(FOLDER, ignore_errors=True)
    write_all()
