"""Run the manual's commands in a folder of their own, page by page, and compare what they print with what is shown.

    python docs/run_commands.py [--write] README.md docs/own_rig.md ...

A page that has commands names in a comment at its head what its folder holds: ``<!-- folder: data/own_rig/*.csv -->``,
paths of this checkout. In the order of the page are run: blocks of ``console`` (a line that begins with "$ " is a
command, the lines below it are what it prints) and blocks of ``toml`` that begin with "# name.toml" (each line replaces
the key of its name in that file); by themselves, as one program, blocks of ``python``. "..." stands for lines that are
left out; "exit status 1" as a last line is what the command ends with. With --write the numbers on the page become
those that were printed; a line whose words have changed is named, for a hand to mend it.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
# How far a printed number may lie from the one on the page: machines round differently, and a search amplifies it.
TOLERANCE = 0.02
LEFT_OUT = "..."
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.]*\d)")


@dataclass(frozen=True)
class Step:
    """A command with what it prints, an edit of a file, or Python; `line` is where it stands on the page."""

    kind: str
    text: str
    shown: tuple[str, ...] = ()
    line: int = 0


def pages() -> list[Path]:
    """The pages that have commands to run."""
    candidates = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [page for page in candidates if folder_of(page.read_text("utf-8"))]


def folder_of(text: str) -> str:
    """The paths that a page's folder holds; empty where it runs nothing."""
    found = re.search(r"^<!-- folder: (.+) -->$", text, re.MULTILINE)
    return found[1] if found else ""


def steps(text: str) -> Iterator[Step]:
    """What a page runs, in its order."""
    for block in re.finditer(r"^```(console|toml|python)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        kind, body = block.groups()
        first = text[: block.start(2)].count("\n")
        if kind == "toml":
            name = re.match(r"# (\S+\.toml)\b.*\n", body)
            if name:
                yield Step(name[1], body[name.end() :], (), first)
        elif kind == "python":
            yield Step("python", body, (), first)
        else:
            yield from _commands(body.splitlines(), first)


def _commands(lines: list[str], first: int) -> Iterator[Step]:
    begins = [k for k, line in enumerate(lines) if line.startswith("$ ")]
    for k, end in zip(begins, [*begins[1:], len(lines)], strict=True):
        yield Step("$", lines[k][2:], tuple(lines[k + 1 : end]), first + k + 1)


def run_page(page: Path, folder: Path, *, write: bool = False) -> list[str]:
    """Run a page in a folder; a sentence for each difference from what it shows."""
    text = fill(page, folder)
    differences, lines = list[str](), text.splitlines()
    for step in steps(text):
        where = f"{page.name}:{step.line}"
        if step.kind == "$":
            status, printed, said = run(step.text, folder)
            differences += [f"{where}: {step.text}: exit status {status}\n{printed}{said}"] * (
                status != expected_status(step.shown)
            )
            found, fresh = compare(step.shown, printed)
            lines[step.line : step.line + len(step.shown)] = fresh
            differences += [f"{where}: {step.text}: {difference}" for difference in found]
        elif step.kind != "python":
            replace_keys(folder / step.kind, step.text)
    if write:
        page.write_text("\n".join(lines) + "\n", "utf-8")
    return differences


def run_python(page: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the Python of a page as one program."""
    code = "".join(step.text for step in steps(fill(page, folder)) if step.kind == "python")
    return _call([sys.executable, "-c", code], folder)


def fill(page: Path, folder: Path) -> str:
    """Copy into a folder what a page expects there; the page's text."""
    text = page.read_text("utf-8")
    for pattern in folder_of(text).split():
        for path in sorted(ROOT.glob(pattern)):
            _copy(path, folder / (path.name if "*" in pattern else pattern))
    return text


def run(command: str, folder: Path) -> tuple[int, str, str]:
    """Exit status, output and messages of a line of the shell."""
    words = [word.strip("\"'") for word in re.findall(r'"[^"]*"|\S+', command.partition(" #")[0])]
    assert words[0] == "pneuopt", f"the manual's commands are those of pneuopt, not {words[0]}"
    done = _call([sys.executable, "-m", "pneuopt", *words[1:]], folder)
    return done.returncode, done.stdout, done.stderr


def replace_keys(path: Path, lines: str) -> None:
    """Put each key's line in the place of the one that the file has, once."""
    text = path.read_text("utf-8")
    for line in lines.splitlines():
        (old,) = re.findall(rf"^{re.escape(line.partition(' = ')[0])} = .*$", text, flags=re.MULTILINE)
        text = text.replace(old, line)
    path.write_text(text, "utf-8")


def expected_status(shown: tuple[str, ...]) -> int:
    """The exit status that the last line names, 0 by default."""
    found = re.fullmatch(r"exit status (\d+)", shown[-1]) if shown else None
    return int(found[1]) if found else 0


def compare(shown: tuple[str, ...], printed: str) -> tuple[list[str], list[str]]:
    """Where a page differs from what was printed, and its lines with the numbers that were printed."""
    actual = [line.rstrip() for line in printed.splitlines() if line.strip()]
    differences, fresh, k, may_skip = list[str](), list[str](), 0, not shown
    for line in shown:
        if not line.strip() or line.startswith("exit status"):
            fresh.append(line)
        elif line.strip() == LEFT_OUT:
            may_skip = True
            fresh.append(line)
        else:
            candidates = range(k, len(actual) if may_skip else min(k + 1, len(actual)))
            at = next((i for i in candidates if words_of(actual[i]) == words_of(line)), None)
            if at is None:
                differences.append(f"shows {line!r}, printed is {actual[k : k + 1]}")
                fresh.append(line)
                continue
            differences += [f"shows {line!r}, printed is {actual[at]!r}"] * (not is_close(line, actual[at]))
            fresh.append(line if is_close(line, actual[at]) and _squeeze(line) != _squeeze(actual[at]) else actual[at])
            k, may_skip = at + 1, False
    if shown and not may_skip and k < len(actual):
        differences.append(f"leaves out {actual[k]!r} without a sign")
    return differences, fresh


def words_of(line: str) -> str:
    """A line without its numbers and its layout."""
    return _squeeze(NUMBER.sub("#", line))


def is_close(shown: str, printed: str) -> bool:
    """Whether the numbers of two lines agree to `TOLERANCE`, or to the last digit that is shown."""
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= TOLERANCE * abs(float(a)) + 1.01 * _last_digit(a) for a, b in pairs)


def _last_digit(number: str) -> float:
    mantissa, _, exponent = number.lower().partition("e")
    return float(10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])))


def _squeeze(line: str) -> str:
    return " ".join(re.sub("─+", "─", line).split())


def _copy(path: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        shutil.copytree(path, place, dirs_exist_ok=True)
    else:
        shutil.copy(path, place)


def _call(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    shell = {"COLUMNS": "80", "NO_COLOR": "1", "TERM": "dumb", "PYTHONUTF8": "1"}
    search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, **shell, "PYTHONPATH": search}
    return subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, encoding="utf-8", check=False
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the printed numbers into the pages")
    parser.add_argument("pages", nargs="*", type=Path, default=pages())
    options, wrong = parser.parse_args(), list[str]()
    for shown_page in options.pages:
        with tempfile.TemporaryDirectory() as empty:
            wrong += run_page(shown_page.resolve(), Path(empty), write=options.write)
        with tempfile.TemporaryDirectory() as empty:
            wrong += [
                f"{shown_page}: {done.stderr}" for done in [run_python(shown_page, Path(empty))] if done.returncode
            ]
    print("\n".join([*wrong, f"{len(wrong)} differences"]))
    sys.exit(bool(wrong))
