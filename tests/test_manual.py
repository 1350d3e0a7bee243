"""The door and the manual: README is short, and the commands of each page run and print what the page shows."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
MAX_BYTES, MAX_COLUMNS, MAX_PYTHON_LINES = 10_000, 120, 12


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("run_commands", ROOT / "docs" / "run_commands.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


manual = load()
PAGES = manual.pages()


def verbs(page: str) -> list[str]:
    steps = manual.steps((ROOT / page).read_text("utf-8"))
    return [step.text.split()[1] if step.kind == "$" else step.kind for step in steps]


def test_the_door_is_short() -> None:
    text = README.read_text("utf-8")
    assert len(text.encode()) <= MAX_BYTES
    assert max(len(line) for line in text.splitlines()) <= MAX_COLUMNS
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert sum(bool(line) for line in code.splitlines()) <= MAX_PYTHON_LINES
    assert re.findall(r"!\[.*?\]\((.*?)\)", text) == ["docs/figures/rig_demo_before_after.png"], "one picture"


def test_the_pages_commands_and_edits_are_seen() -> None:
    assert [page.name for page in PAGES] == ["README.md", "how_to.md", "own_rig.md"]
    assert verbs("README.md") == ["identify", "simulate", "tune", "export", "python"]
    assert set(verbs("docs/how_to.md")) == {"check", "identify", "tune", "simulate", "study", "export", "python"}
    assert verbs("docs/own_rig.md") == [
        "init", "run_01.toml", "drive.toml", "check", "identify", "init", "run_02.toml", "simulate", "tune",
        "study.toml", "study", "export",
    ]  # fmt: skip


def test_every_relative_link_leads_to_a_file() -> None:
    sources = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "problems").rglob("README.md")]
    for source in [*sources, ROOT / "data" / "README.md"]:
        for target in re.findall(r"(?<!`)\]\(([^)\s:]+)\)", source.read_text("utf-8")):
            path, _, anchor = target.partition("#")
            file = (source.parent / path) if path else source
            assert file.exists(), f"{source.name}: {target}"
            if anchor and file.suffix == ".md":
                titles = re.findall(r"^#+ (.+)$", file.read_text("utf-8"), re.MULTILINE)
                assert anchor in {re.sub(r"[^\w -]", "", t.lower()).replace(" ", "-") for t in titles}, target


def test_what_a_page_shows_is_compared_line_by_line() -> None:
    printed = "converged: 12 iterations\n\nname    value\n──────\nKp     1.5004 N\nwrote a.toml\n"
    shown = ("converged: 12 iterations", "...", "Kp 1.500 N", "...")
    assert manual.compare(shown, printed) == ([], [shown[0], "...", "Kp 1.500 N", "..."])
    assert manual.compare((), printed) == ([], [])
    (wrong,), lines = manual.compare(("...", "Kp 1.3 N", "..."), printed)
    assert wrong == "shows 'Kp 1.3 N', printed is 'Kp     1.5004 N'"
    assert lines == ["...", "Kp     1.5004 N", "..."], "what --write puts there"
    (changed,), _ = manual.compare(("...", "Ki 1.5 N", "..."), printed)
    assert changed.startswith("shows 'Ki 1.5 N'")
    (left_out,), _ = manual.compare(("converged: 12 iterations",), printed)
    assert left_out == "leaves out 'name    value' without a sign"


def test_an_exit_status_is_compared(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    block = "<!-- folder: LICENSE -->\n```console\n$ pneuopt keys no_such_key_at_all\n```\n"
    page.write_text(block, encoding="utf-8")
    (wrong,) = manual.run_page(page, tmp_path)
    status = re.search(r"exit status (\d)", wrong)
    assert status is not None
    page.write_text(block.replace("\n```\n", f"\n...\nexit status {status[1]}\n```\n"), encoding="utf-8")
    assert manual.run_page(page, tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_pages_commands_print_what_it_shows(page: Path, tmp_path: Path) -> None:
    assert manual.run_page(page, tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES[:2], ids=lambda page: page.name)
def test_a_pages_python_runs(page: Path, tmp_path: Path) -> None:
    done = manual.run_python(page, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "friction.coulomb" in done.stdout
    assert "SettlingTime" in done.stdout


@pytest.mark.slow
def test_the_two_commands_of_the_door_are_those_of_make() -> None:
    named = re.findall(r"^    make (\w+)", README.read_text("utf-8"), re.MULTILINE)
    assert named == ["demo", "test"]
    for target in named:
        done = subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
