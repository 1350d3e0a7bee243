"""The README's commands run as they stand there, in the order in which they stand."""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
REFUSED = {"--rig": 1}
"""Exit status of commands that say so: the design of the example is refused on its rig, as the text tells."""


def section(title: str) -> str:
    found = re.search(rf"^## {title}\n(.*?)(?=^## )", README, re.DOTALL | re.MULTILINE)
    assert found is not None, title
    return found[1]


def steps(text: str) -> Iterator[tuple[str, str]]:
    """Each command, ("$", line), and each edit of a file, (its name, the lines), in the order of the text."""
    for block in re.finditer(r"^    (pneuopt .*)$|^```toml\n# (\S+\.toml).*\n((?:.*\n)*?)```$", text, re.MULTILINE):
        command, file, lines = block.groups()
        yield ("$", command) if command else (file, lines)


def run(command: str) -> tuple[int, str]:
    words = shlex.split(command, comments=True)
    result = CliRunner().invoke(app, words[1:])
    return result.exit_code, result.output


def replace_keys(path: Path, lines: str) -> None:
    """Put each key's line in the place of the one that the file has, once."""
    text = path.read_text(encoding="utf-8")
    for line in lines.splitlines():
        (old,) = re.findall(rf"^{re.escape(line.partition(' = ')[0])} = .*$", text, flags=re.MULTILINE)
        text = text.replace(old, line)
    path.write_text(text, encoding="utf-8")


def test_the_readmes_commands_and_edits_are_seen() -> None:
    jobs, own = list(steps(section("The three jobs"))), list(steps(section("Your own rig")))
    assert [name for name, _ in jobs] == ["$"] * len(jobs)
    assert {words.split()[1] for _, words in jobs} == {"check", "identify", "tune", "simulate", "study", "export"}
    assert [words.split()[1] for name, words in own if name == "$"] == [
        "init", "check", "identify", "init", "simulate", "tune", "study", "export",
    ]  # fmt: skip
    assert {name for name, _ in own} == {"$", "run_01.toml", "run_02.toml", "drive.toml", "study.toml"}


@pytest.mark.slow
@pytest.mark.parametrize(("title", "logs"), [("The three jobs", "data"), ("Your own rig", "data/own_rig")])
def test_the_readmes_commands_run(title: str, logs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / logs, tmp_path / "rig" / (logs if logs == "data" else ""), dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path / "rig")
    for name, text in steps(section(title)):
        if name != "$":
            replace_keys(Path(name), text)
            continue
        status, output = run(text)
        expected = next((s for option, s in REFUSED.items() if option in text), 0)
        assert status == expected, f"{text}\n{output}"
